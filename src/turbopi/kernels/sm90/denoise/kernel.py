"""The whole denoising loop of Pi0.5 in one kernel of resident thread block clusters: its sizes and launch.

Ten steps read the action expert's 311 M weights ten times and do little else, so the loop is a race between memory and
the delay of some thousand dependent operations. One kernel keeps its clusters resident, streams the weights through
shared memory without pause, and passes activations through distributed shared memory; only sums over heads or hidden
units cross clusters. How: docs/dev/denoising_kernel.md and sizes.cu. Why it is safe: barriers.cu.

Shapes: N steps, L layers, T suffix tokens, D width, n query heads of K columns, A action_dim.
"""

from pathlib import Path

import torch
from torch import Tensor

from turbopi.config import ModelConfig
from turbopi.kernels.arguments import Parameter, Struct, enumeration
from turbopi.kernels.interface import KeptStep, State, TokenInputs
from turbopi.kernels.nvrtc import Kernel, compile_cubin
from turbopi.kernels.portable.denoise.host import (
    OF_LAUNCH,
    CooperativeDenoiser,
    Launched,
    check_covered,
    end_tensors,
    ends,
    model_sizes,
)
from turbopi.kernels.sm90 import instructions
from turbopi.kernels.sm90.denoise.packing import (
    BLOCK,
    RANKS,
    WARPS,
    Arrangement,
    PackedExpert,
    Tables,
    most,
)
from turbopi.support.errors import BackendError, BackendUnavailable

FOLDER = Path(__file__).parent.parent  # has instructions.cu, too
# Of the kernel, in their order; {form}: "few" or "many" tokens; {times}: "one_time" or "token_times"; {observations}:
# "alone" or a "pair"; {kept}: "kept" for a way back or "nothing_kept".
PARTS = (
    *("sizes", "barriers", "{form}/memory", "cta", "{observations}", "primitives", "wgmma", "producer", "product"),
    *("stream", "{form}/stream", "residual", "{kept}", "project", "feed_forward", "{times}"),
    *("{form}/project", "{form}/feed_forward", "score", "attention", "{form}/attention", "combine"),
    *("layer", "step", "{form}/step", "watch", "{form}/loop", "kernel"),
)
THREADS = (WARPS + 4) * 32
WAITS = {  # what a CTA waits for: the kernel's enum, and what users are told
    "WAIT_NONE": "nothing",
    "WAIT_X": "the stream",
    "WAIT_Q": "queries",
    "WAIT_TOPS": "largest logits",
    "WAIT_COMB": "outputs",
    "WAIT_ATT": "attention",
    "WAIT_X2": "attention's sums",
    "WAIT_HID": "hidden units",
    "WAIT_X1": "feed-forward sums",
    "WAIT_V": "v_t",
    "WAIT_GO": "the next step",
    "FINISHED": "its end",
}
MARKS = {  # up to where the tracer counts cycles, in the order in which a layer comes there: the kernel's enum
    "MARK_STREAM_FOR_ATTENTION": "the stream is here",
    "MARK_QKV_MULTIPLIED": "q|k|v multiplied",
    "MARK_QKV_SENT": "queries sent, keys and values published",
    "MARK_QUERIES_HERE": "all ranks' queries are here",
    "MARK_PREFIX_SCORED": "prefix keys scored",
    "MARK_ROWS_HERE": "of warps that score rows: keys here",
    "MARK_ROWS_SCORED": "of warps that score rows: scored",
    "MARK_ROWS_WEIGHED": "of warps that score rows: weights stored, tops sent",
    "MARK_WEIGHTS_STORED": "weights stored; beyond 16 tokens: of all warps",
    "MARK_OUTPUTS_SENT": "this warp's part of the outputs sent",
    "MARK_TOPS_HERE": "largest logits of all ranks here",
    "MARK_OUTPUTS_HERE": "partial outputs of all ranks here",
    "MARK_COMBINED": "combined, attention sent",
    "MARK_ATTENTION_HERE": "all ranks' attention here",
    "MARK_OUT_PUBLISHED": "out multiplied, its sums published",
    "MARK_OUT_SUMS_HERE": "all clusters' sums of out here",
    "MARK_SLICE_AFTER_ATTENTION": "slice of the stream sent",
    "MARK_STREAM_FOR_FEED_FORWARD": "the stream is here",
    "MARK_GATE_UP_MULTIPLIED": "gate|up multiplied",
    "MARK_HIDDEN_SENT": "hidden units sent",
    "MARK_HIDDEN_HERE": "all ranks' hidden units here",
    "MARK_DOWN_PUBLISHED": "down multiplied, its sums published",
    "MARK_DOWN_SUMS_HERE": "all clusters' sums of down here",
    "MARK_SLICE_AFTER_FEED_FORWARD": "slice of the stream sent",
    "MARK_EMBEDDED": "x_t embedded",
    "MARK_STEP_DONE": "the step's Euler step done",
}
FEW = 16  # tokens: up to so many take the form in few/
MAX_SUFFIX = 56  # beyond it too little shared memory is left for weights on their way

MAX_ROWS = 1 << 16  # of the table, by token: 16 bits say which one a token takes


def unavailable(device: torch.device) -> str | None:
    """Why the kernel can't run on this device, or None if it can."""
    if device.type != "cuda":
        return "the denoising kernel needs an NVIDIA GPU"
    major, minor = torch.cuda.get_device_capability(device)
    if (major, minor) != (9, 0):
        return f"the denoising kernel is written for compute capability 9.0, this GPU has {major}.{minor}"
    return None


ARGS = Struct(
    "Args",
    (
        Parameter("const unsigned char*", "weights", "fragments [L][layer_bytes], a CTA's in the order of their use"),
        Parameter("const long long*", "starts", "[NC * S]: where a CTA's begin in a layer, bytes"),
        Parameter("const float*", "table", "[N][2L+1][3][D]: scale, shift, gate"),
        Parameter("const float*", "shifted", "[N][L][NC * S][TILES][16]: W shift"),
        *ends("[D][A]"),
        Parameter("unsigned char*", "keys", "bf16 [L][2][KEY_TILES][QT] fragments: the cache as tensor cores take it"),
        *OF_LAUNCH,
        Parameter("uint4*", "scratch", "zero at the start"),
        Parameter("u32*", "hang", "[NC * S] host memory: see `watch`"),
        Parameter("long long*", "clock", "[2] host memory: cycles and nanoseconds of a launch, of CTA 0"),
        Parameter("u32*", "trace", "[NC * S][64] cycles up to each mark, with TP_TRACED_WARP"),
        Parameter("long long", "layer_stride"),
        Parameter("long long", "layer_bytes"),
        Parameter("int", "steps"),
        Parameter("float", "dt"),
        Parameter("float", "eps"),
        Parameter("u32", "zero", "0, which the compiler doesn't know"),
        Parameter("const float*", "row_scales", "[L][NC * S][TILES][16]: FP8; those of out and down are in the gates"),
        Parameter("const float*", "values_times", "[L]: FP8, makes attention's outputs fit E4M3; a power of two"),
    ),
)

ARGS_OF_PAIR = Struct(
    "Args",
    tuple(
        Parameter("const int*", "segments", "[3]: first row of either observation, and the first behind them")
        if parameter.name == "length"
        else parameter
        for parameter in ARGS.fields
    ),
)

ARGS_BY_TOKEN = Struct(
    "Args",
    (
        *ARGS.fields,
        Parameter("const int*", "token_rows", "[N][T]: which row of `table`, `shifted` and `out_shift`"),
        Parameter("const float*", "token_steps", "[N][T]: in place of dt"),
        Parameter("const float*", "token_times", "[N][T]"),
        Parameter("const float*", "target", "[T][A]: of guidance"),
        Parameter("const float*", "gain", "[N][T]"),
    ),
)


ARGS_KEEPING = Struct(
    "Args",
    (
        *ARGS_BY_TOKEN.fields,
        Parameter("unsigned short*", "kept_x", "bf16 [2L+1][T][D] the stream in front of each norm"),
        Parameter("unsigned short*", "kept_q", "bf16 [L][T * n][HD]"),
        Parameter("unsigned short*", "kept_gate_up", "bf16 [L][T][2F]"),
        Parameter("unsigned char*", "own_k", "bf16 [L][T][HD] the suffix's keys, layer_stride bytes a layer"),
        Parameter("unsigned char*", "own_v"),
        Parameter("int", "keys_ready", "`keys` is as a launch before made it"),
    ),
)


def arguments(by_token: bool, pair: bool, keep: bool) -> Struct:
    """What a form of the kernel takes."""
    return ARGS_KEEPING if keep else ARGS_BY_TOKEN if by_token else ARGS_OF_PAIR if pair else ARGS


def kernel_sizes(
    arrangement: Arrangement,
    *,
    cache_rows: int,
    suffix: int,
    shared_bytes: int,
    fp8: bool = False,
    by_token: bool = False,
    pair: bool = False,
    keep: bool = False,
) -> dict[str, int]:
    """The kernel's compile-time constants.

    by_token  every token has its own time (token_times.cu)
    keep      by token, what a way back needs is kept (kept.cu)
    pair      the suffix is that of two observations (pair.cu), the cache's rows, too
    """
    config, g = arrangement.config, arrangement.config.expert
    groups = most(suffix, 8)
    stream = arrangement.clusters // 2 * (g.width // BLOCK) * groups * 32
    scratch = 4 * stream + suffix * g.head_dim
    if suffix > FEW:
        words = 8 if fp8 else 16  # of a block's activations of 8 tokens
        scratch += (4 * g.width // BLOCK * words + RANKS * 4) * groups + arrangement.blocks
        head, hidden = g.head_dim // BLOCK, most(g.mlp_dim // BLOCK, arrangement.clusters)
        scratch += arrangement.clusters * groups * (head * (16 + words) + hidden * words)
    return {
        **model_sizes(config, suffix),
        "TP_RANKS": RANKS,
        "TP_KEY_TILES": most(cache_rows, BLOCK),
        "TP_FP8": int(fp8),
        # Larger slots of weights are faster, if enough of them fit.
        "TP_ROUND_FRAGMENTS": 4 if suffix <= (40 if cache_rows <= 1024 else 24) else 2,
        "TP_SHARED_BYTES": shared_bytes,
        "TP_SCRATCH_WORDS": scratch,
        **({"TP_BY_TOKEN": 1} if by_token else {}),
        **({"TP_PAIR": 1} if pair else {}),
        **({"TP_KEEP": 1} if keep else {}),
    }


def source(suffix: int, fp8: bool, by_token: bool = False, pair: bool = False, keep: bool = False) -> str:
    columns = most(suffix, 8) * 8
    numbers: instructions.Numbers = "e4m3" if fp8 else "bf16"
    products = (
        instructions.wgmma("add_product", columns, numbers=numbers),
        instructions.wgmma("add_from_registers", columns, numbers=numbers, from_registers=True),
        instructions.wgmma("add_rows", columns, from_registers=True),
        instructions.wgmma("add_keys", 2 * 8),
    )
    args = arguments(by_token, pair, keep)
    generated = (*products, enumeration("What", tuple(WAITS)), enumeration("Mark", tuple(MARKS)), args.source)
    which = {
        "form": "few" if suffix <= FEW else "many",
        "times": "token_times" if by_token else "one_time",
        "observations": "pair" if pair else "alone",
        "kept": "kept" if keep else "nothing_kept",
    }
    files = (f"denoise/{part.format(**which)}.cu" for part in PARTS)
    return instructions.source(*files, generated="\n".join(generated) + "\n", folder=FOLDER)


def compiled(arch: str, sizes: dict[str, int], *, folder: Path | None = None) -> bytes:
    """The kernel's machine code. Raises BackendUnavailable if a block has too little shared memory for these sizes."""
    try:
        which = (name in sizes for name in ("TP_BY_TOKEN", "TP_PAIR", "TP_KEEP"))
        text = source(sizes["TP_TOKENS"], bool(sizes["TP_FP8"]), *which)
        return compile_cubin(text, arch, sizes, folder=folder)
    except BackendError as e:
        if "too little shared memory" not in str(e):
            raise
        tokens, keys = sizes["TP_TOKENS"], sizes["TP_KEY_TILES"] * BLOCK
        raise BackendUnavailable(
            f"{tokens} suffix tokens and {keys} cache rows leave the denoising kernel too little of a "
            f"block's {sizes['TP_SHARED_BYTES']} bytes of shared memory"
        ) from e


def megahertz(cycles: int, nanoseconds: int) -> float | None:
    """A clock in MHz, or None if no time was measured."""
    return cycles / nanoseconds * 1e3 if nanoseconds else None


def stuck(words: list[int]) -> str | None:
    """What the blocks' words of `watch` (watch.cu) say, or None: none has said anything."""
    waits = sorted({(word & 0xFFFFF, word >> 20 & 0x7FF) for word in words if word})
    reported = tuple(WAITS.values())
    where = ", ".join(f"layer {layer} for {reported[what]}" for layer, what in waits[:8])
    return f"blocks of the denoising kernel waited for seconds (counted over all steps): {where}" if waits else None


def _beside_each_other(shifted: Tensor) -> Tensor:
    """float32[..., 16] with rows i and i + 8 of a tile, which a lane has, beside each other: [..., 8, 2]."""
    return shifted.view(*shifted.shape[:-1], 2, 8).mT.contiguous()


def _room_to_keep(config: ModelConfig, suffix: int, device: torch.device) -> tuple[KeptStep, dict[str, Tensor]]:
    """Where a launch keeps what a way back needs, and what else it takes: gains of 0, as it doesn't guide, and room for
    the step's x_t, which nobody reads.
    """
    g = config.expert

    def room(*shape: int) -> Tensor:
        return torch.zeros(*shape, dtype=torch.bfloat16, device=device)

    kept = KeptStep(
        stream=room(2 * g.depth + 1, suffix, g.width),
        q=room(g.depth, suffix * g.num_heads, g.head_dim),
        gate_up=room(g.depth, suffix, 2 * g.mlp_dim),
    )
    shapes = {"gain": (1, suffix), "x_t": (2, suffix, config.action_dim)}
    return kept, {name: torch.zeros(*shape, device=device) for name, shape in shapes.items()}


class DenoiseKernel(CooperativeDenoiser):
    """The loop for a fixed number of steps and suffix tokens; capturable in a CUDA graph.

    `table` float32[N, 2L + 1, 3, D] is the modulation (`engine.weights.modulation`), `small` holds action_in_proj and
    action_out_proj, `cache_rows` is an upper bound of the valid cache rows. Raises BackendError for a model or suffix
    that it doesn't cover, BackendUnavailable for a GPU, or more cache rows than fit.

    by_token  every token has a time of its own in each of `num_steps` steps: a launch then takes `TokenInputs`, and
        `table` float32[U, 2L + 1, 3, D] has a row for each time that occurs
    pair  the suffix is that of two observations, half of it each, and so are the cache's rows: for `launch_pair`
    keep  of a kernel by token with one step: for `launch_step`, which keeps what a way back needs
    """

    def __init__(
        self,
        config: ModelConfig,
        packed: PackedExpert,
        small: State,
        table: Tensor,
        *,
        cache_rows: int,
        suffix: int,
        device: torch.device,
        num_steps: int | None = None,
        by_token: bool = False,
        pair: bool = False,
        keep: bool = False,
    ) -> None:
        assert not keep or (by_token and num_steps == 1 and not packed.fp8), "bfloat16 is kept, of one step"
        assert by_token == (num_steps is not None), "by token the table doesn't tell the number of steps"
        assert not (pair and by_token), "two observations have one time"
        assert not by_token or len(table) <= MAX_ROWS, len(table)
        check_covered("the denoising kernel", unavailable(device), suffix, MAX_SUFFIX)
        if pair and (suffix <= FEW or suffix % 2):
            raise BackendError(f"two observations have an even number of tokens above {FEW}, not {suffix}")
        arrangement, g = packed.arrangement, config.expert
        properties = torch.cuda.get_device_properties(device)
        assert table.shape[1:] == (2 * g.depth + 1, 3, g.width), table.shape
        sizes = kernel_sizes(
            arrangement,
            cache_rows=cache_rows,
            suffix=suffix,
            fp8=packed.fp8,
            shared_bytes=properties.shared_memory_per_block_optin,  # type: ignore[attr-defined]
            by_token=by_token,
            pair=pair,
            keep=keep,
        )
        with torch.cuda.device(device):
            arch = f"sm_{properties.major}{properties.minor}a"
            cubin = compiled(arch, sizes)
            loop = Launched(Kernel(cubin, "turbopi_denoise", sizes["TP_SHARED_BYTES"]), arrangement.blocks, THREADS)
            tiles = g.depth * sizes["TP_KEY_TILES"]
            prepare = Launched(Kernel(cubin, "turbopi_denoise_prepare", 0), tiles, 256)
            fitting = loop.kernel.max_active_clusters(RANKS, THREADS)
            if fitting < arrangement.clusters:
                raise BackendUnavailable(
                    f"the denoising kernel needs {arrangement.clusters} clusters of {RANKS} multiprocessors at once, "
                    f"{torch.cuda.get_device_name(device)} holds {fitting}"
                )
        self._by_token, self._pair = by_token, pair
        self._kept = _room_to_keep(config, suffix, device) if keep else None
        self._table = table.to(device).float().contiguous()
        tables = Tables.make(packed, self._table)
        tensors = {
            "weights": packed.weights,
            "starts": packed.starts,
            "table": tables.modulation,
            "row_scales": tables.row_scales,
            "shifted": _beside_each_other(tables.shifted) if by_token else tables.shifted,
            "values_times": tables.values_times,
            **end_tensors(
                *(config, small, self._table),
                out_w=small["action_out_proj.weight"].T,
                in_w=small["action_in_proj.weight"],
            ),
            "keys": torch.empty(
                g.depth * 2 * sizes["TP_KEY_TILES"] * BLOCK * g.head_dim, dtype=torch.bfloat16, device=device
            ),
            "scratch": torch.empty(4 * sizes["TP_SCRATCH_WORDS"], dtype=torch.int32, device=device),
            "hang": torch.zeros(arrangement.blocks, dtype=torch.int32, pin_memory=True),  # see `why_it_trapped`
            "clock": torch.zeros(2, dtype=torch.int64, pin_memory=True),  # see `clock_mhz`
            "trace": torch.zeros(arrangement.blocks, 64, dtype=torch.int32, device=device),
        }
        super().__init__(
            config,
            steps=len(table) if num_steps is None else num_steps,
            suffix=suffix,
            arguments=arguments(by_token, pair, keep),
            tensors=tensors,
            numbers={"layer_bytes": packed.layer_bytes, "zero": 0},
            prepare=prepare,
            loop=loop,
        )

    def launch_step(
        self, step: int, x_t: Tensor, cache_k: Tensor, cache_v: Tensor, length: Tensor, v_t: Tensor, tokens: TokenInputs
    ) -> KeptStep:
        """See `kernels.interface.KeepingDenoiser`."""
        assert self._kept is not None and length.dtype == torch.int64, length.dtype
        kept, beside = self._kept
        of_step = {name: getattr(tokens, name)[step : step + 1] for name in ("rows", "steps", "times")}
        one = TokenInputs(**of_step, target=tokens.target, gain=beside["gain"])
        own_k, own_v = (cache[:, cache.shape[1] - self._suffix :] for cache in (cache_k, cache_v))
        self._launch(
            *(x_t, cache_k, cache_v, beside["x_t"], v_t[None]),
            length=length,
            kept_x=kept.stream,
            kept_q=kept.q,
            kept_gate_up=kept.gate_up,
            own_k=own_k,
            own_v=own_v,
            keys_ready=int(step > 0),
            **self._token_tensors(one),
        )
        return kept

    def launch_pair(
        self, noise: Tensor, cache_k: Tensor, cache_v: Tensor, segments: Tensor, x_t: Tensor, v_t: Tensor
    ) -> None:
        """See `kernels.interface.PairDenoiser`."""
        assert self._pair and segments.shape == (3,) and segments.dtype == torch.int32 and segments.is_contiguous()
        beside = noise.flatten(0, 1), cache_k, cache_v, x_t.flatten(1, 2), v_t.flatten(1, 2)
        assert all(t.is_contiguous() for t in (noise, x_t, v_t)), "the kernel writes where they lie"
        self._launch(*beside, segments=segments)

    def _token_tensors(self, tokens: TokenInputs | None) -> dict[str, Tensor]:
        assert (tokens is not None) == self._by_token, "a kernel by token takes `tokens`, another doesn't"
        if tokens is None:
            return {}
        by_step = self._steps, self._suffix
        given = {
            "token_rows": (tokens.rows, by_step),
            "token_steps": (tokens.steps, by_step),
            "token_times": (tokens.times, by_step),
            "target": (tokens.target, (self._suffix, self._config.action_dim)),
            "gain": (tokens.gain, by_step),
        }
        for name, (t, shape) in given.items():
            dtype = torch.int32 if name == "token_rows" else torch.float32
            assert t.shape == shape and t.dtype == dtype and t.is_contiguous(), (name, t.shape, t.dtype)
            assert t.device == self._table.device, (name, t.device)
        return {name: t for name, (t, _) in given.items()}

    def clock_mhz(self) -> float | None:
        """The multiprocessors' clock during the last launch that has ended, in MHz, which may be lower than what
        nvidia-smi says; None before the first.
        """
        return megahertz(*self._tensors["clock"].tolist())

    def why_it_trapped(self) -> str | None:
        """After a launch that failed: where blocks waited for seconds before they gave up, or None."""
        return stuck(self._tensors["hang"].tolist())
