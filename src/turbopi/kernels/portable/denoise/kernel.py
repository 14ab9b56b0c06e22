"""An action expert's denoising loop in one cooperative kernel for compute capability 8.0 and newer: sizes and launch.

It needs no clusters, no copy engine and no more than 99 KB of a block's shared memory. How it works: sizes.cu.

Shapes: N steps, L layers, T suffix tokens, D width, n query heads of K columns, A action_dim.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from turbopi.kernels.arguments import Parameter, Struct
from turbopi.kernels.interface import State
from turbopi.kernels.nvrtc import Kernel, compile_for, native_arch
from turbopi.kernels.portable.denoise.host import (
    OF_LAUNCH,
    CooperativeDenoiser,
    Launched,
    check_covered,
    end_tensors,
    ends,
    model_sizes,
)
from turbopi.kernels.portable.denoise.packing import (
    CHUNK_BYTES,
    PI05,
    Expert,
    Form,
    PackedExpert,
    Tables,
    WeightNumbers,
    tiles,
)
from turbopi.support.errors import BackendUnavailable

PARTS = ("primitives", "product", "finish", "attention_by_warps", "attention", "kernel")  # behind sizes.cu and Args
MAX_SUFFIX = 64
SHARED_BYTES = 99 * 1024  # what a block has on every GPU from 8.0 on
MAX_SPLITS, MAX_SPLIT_KEYS = 16, 256  # shares of the keys: as many as are combined at once; what fits a block
MAX_WHOLE_KEYS = 448  # of heads of 64 columns: what fits a block as one share
PREPARE_THREADS = 256
PHASES = ("qkv", "attention", "combine", "out", "gate_up", "down", "embed", "advance", "mix")  # of the trace
LOOKS = 1 << 24  # at a barrier's counter, before a block gives up: 2 to 20 seconds, and a barrier takes microseconds
LARGE_L2 = 32 << 20  # bytes: a layer's weights, and what else is read meanwhile


@dataclass(frozen=True)
class Choices:
    """How a launch uses a multiprocessor; they change the speed and nothing else."""

    warps: int  # of a block, a multiple of 4
    sums: int  # tiles of 16 tokens by 8 channels that a warp adds up at once, 4 registers each
    weights: int  # loads of 16 bytes that a lane has on their way, at most
    activations: int  # the same of activations, in groups of 8 tokens
    ahead: bool  # weights of later phases go to L2, where L2 is large
    ranges: int = 1  # of tokens: a block has tiles of a product for one of them
    wide_ranges: int = 1  # the same of q|k|v and gate|up, which have more channels
    across_at_once: bool = False  # across, a block makes a head's queries for up to 8 tokens and attends with them


FEW = Choices(warps=16, sums=8, weights=8, activations=8, ahead=True)  # up to 16 tokens
MANY = Choices(warps=8, sums=16, weights=8, activations=14, ahead=True)


NARROW = Choices(warps=16, sums=8, weights=8, activations=7, ahead=True)  # of SmolVLA's width
# On a GPU of as many multiprocessors as an H200: on fewer a block has so many tiles that addresses are spilled
IN_RANGES = Choices(
    warps=16, sums=4, weights=12, activations=8, ahead=True, ranges=2, wide_ranges=4, across_at_once=True
)
MANY_IN_RANGES = replace(FEW, ranges=2, wide_ranges=2)
MANY_BLOCKS = 132


def choices(suffix: int, form: Form = PI05, blocks: int = 0) -> Choices:
    in_ranges = suffix > 16 and blocks >= MANY_BLOCKS
    if not form.modulated:
        return IN_RANGES if in_ranges else NARROW
    return FEW if suffix <= 16 else MANY_IN_RANGES if in_ranges else MANY


def unavailable(device: torch.device, weights: WeightNumbers = "bf16") -> str | None:
    """Why the kernel can't run on this device, or None if it can."""
    if device.type != "cuda":
        return "the portable denoising kernel needs an NVIDIA GPU"
    major, minor = torch.cuda.get_device_capability(device)
    needed = (8, 9) if weights == "fp8" else (8, 0)
    if (major, minor) < needed:
        what = "" if weights == "bf16" else f" in {weights.upper()}"
        return (
            f"the portable denoising kernel{what} needs compute capability {needed[0]}.{needed[1]} or newer, "
            f"this GPU has {major}.{minor}"
        )
    return None


ARGS = Struct(
    "Args",
    (
        Parameter("const unsigned char*", "weights", "[L] qkv, out, gate|up, down: [tile][chunk][8][64 bytes]"),
        Parameter("const float*", "table", "[N][2L+1][3][D]: scale, shift, gate"),
        Parameter("const float*", "shifted", "[N][L][channels of qkv, gate|up]: W shift"),
        Parameter("const float*", "row_scales", "[L][channels of qkv, gate|up]: FP8, INT8"),
        Parameter("const float*", "attended_times", "[L]: FP8"),
        *ends("[A][D]"),
        Parameter("const unsigned char*", "mix", "where the time is mixed in: [tile][chunk][8][64 bytes]"),
        Parameter("const float*", "mix_b", "[D]"),
        *OF_LAUNCH,
        Parameter("float*", "x", "[T][D] the residual stream"),
        Parameter("float*", "squares", "[T][D/8] of x, added up by tiles"),
        Parameter("unsigned char*", "stream", "[piece][T][columns of a piece] x times a norm's scale; zeros beyond D"),
        Parameter("unsigned char*", "attended", "the same of attention's outputs"),
        Parameter("unsigned char*", "hidden", "the same of the feed-forward's hidden units"),
        Parameter("unsigned char*", "queries", "bf16 [T * n][K]"),
        Parameter("unsigned char*", "keys", "bf16 [T][K] of the suffix"),
        Parameter("unsigned char*", "values"),
        Parameter("float*", "partial", "[row tile][share of keys][16][K] outputs"),
        Parameter("float*", "tops", "[row tile][share of keys][16][2] largest logit, sum of weights"),
        Parameter("float*", "rope", "[T][K/2][2] cosine, sine"),
        Parameter("u32*", "counter", "of the grid's barrier"),
        Parameter("u32*", "hang", "host memory: arrivals that a block waited for when it gave up"),
        Parameter("u32*", "trace", "[blocks][PHASES][2] cycles at work and at the barrier behind it, with TP_TRACE"),
        Parameter("long long", "layer_stride"),
        Parameter("int", "steps"),
        Parameter("float", "dt"),
        Parameter("float", "eps"),
        Parameter("float", "logit_scale"),
    ),
)


def kernel_sizes(
    config: Expert,
    *,
    blocks: int,
    cache_rows: int,
    suffix: int,
    weights: WeightNumbers,
    choice: Choices,
    form: Form = PI05,
) -> dict[str, int]:
    """The kernel's compile-time constants."""
    g, keys = config.expert, cache_rows + suffix
    row_tiles = _row_tiles(config, suffix)
    splits = max(min(blocks // row_tiles, MAX_SPLITS), 1, -(-keys // MAX_SPLIT_KEYS))
    if g.head_dim <= 64 and keys <= MAX_WHOLE_KEYS:
        splits = 1  # a share takes less time than the phase that would put several together
    # Across at once, a warp has 16 keys and a block up to 8 tokens of a head
    enough = cache_rows <= choice.warps * 16 and g.num_heads * -(-suffix // 8) <= blocks
    at_once = choice.across_at_once and form.self_every != 1 and g.head_dim <= 64 and splits == 1 and enough
    key_tiles = -(-keys // 8)
    split_keys = -(-key_tiles // splits) * 8
    return {
        **model_sizes(config, suffix),
        "TP_BLOCKS": blocks,
        "TP_WARPS": choice.warps,
        "TP_SUMS": max(choice.sums, -(-suffix // 16)),
        "TP_WEIGHTS_IN_FLIGHT": choice.weights,
        "TP_ACTIVATIONS_IN_FLIGHT": choice.activations,
        "TP_RANGES": choice.ranges,
        "TP_WIDE_RANGES": choice.wide_ranges,
        "TP_AHEAD": int(choice.ahead),
        "TP_KV_HEADS": g.num_kv_heads,
        "TP_CACHE_ROWS": cache_rows if g.num_kv_heads > 1 else 0,
        "TP_MODULATED": int(form.modulated),
        "TP_SELF_EVERY": form.self_every,
        "TP_ACROSS_AT_ONCE": int(at_once),
        "TP_CAUSAL": int(form.causal),
        "TP_SILU": int(form.silu),
        "TP_SPLITS": splits,
        "TP_SPLIT_KEYS": -(-split_keys // 16) * 16,
        "TP_FP8": int(weights == "fp8"),
        "TP_INT8": int(weights == "int8"),
        "TP_SHARED_BYTES": SHARED_BYTES,
        "TP_LOOKS": LOOKS,
        "TP_TRACE": 0,
    }


def _row_tiles(config: Expert, suffix: int) -> int:
    """Tiles of 16 rows of queries, each of one key/value head."""
    g = config.expert
    return g.num_kv_heads * -(-suffix * (g.num_heads // g.num_kv_heads) // 16)


def source() -> str:
    folder = Path(__file__).parent
    parts = ((folder / f"{part}.cu").read_text() for part in PARTS)
    return "\n".join(((folder / "sizes.cu").read_text(), ARGS.source, *parts))


def compiled(arch: str, sizes: dict[str, int], *, folder: Path | None = None) -> bytes:
    """The kernel's machine code ("sm_80") or PTX ("compute_80"). Raises BackendError with the compiler's log."""
    return compile_for(source(), arch, sizes, folder=folder)


@dataclass(frozen=True)
class Mixing:
    """How the time is mixed into the tokens: out(silu(x_t into + the step's bias)) + out_bias."""

    into: Tensor  # float32[D, A]
    biases: Tensor  # float32[N, D]
    out: Tensor  # [D, D]
    out_bias: Tensor  # float32[D]


class PortableDenoiser(CooperativeDenoiser):
    """The loop for a fixed number of steps and suffix tokens; capturable in a CUDA graph.

    `table` float32[N, 2L + 1, 3, D] is the modulation (`engine.weights.modulation`), `small` holds action_in_proj and
    action_out_proj, `cache_rows` is an upper bound of the valid cache rows. Every token has the same time. Raises
    BackendError for a suffix that it doesn't cover, BackendUnavailable for a GPU or a loop with times by token.

    mixing  of a form that isn't modulated; `table` is float32[1, 2L + 1, 3, D] then: norms' weights, zeros, ones
    choice, blocks  how it is launched; default: as `choices` has it, one block for each multiprocessor
    arch    what it is compiled for: the GPU at hand, or PTX for an older one ("compute_80")
    traced  slower, and `trace` then says where cycles went
    """

    def __init__(
        self,
        config: Expert,
        packed: PackedExpert,
        small: State,
        table: Tensor,
        *,
        mixing: Mixing | None = None,
        cache_rows: int,
        suffix: int,
        device: torch.device,
        num_steps: int | None = None,
        by_token: bool = False,
        choice: Choices | None = None,
        blocks: int | None = None,
        arch: str | None = None,
        traced: bool = False,
    ) -> None:
        if by_token or num_steps is not None:
            raise BackendUnavailable("the portable denoising kernel has no times by token")
        reason = unavailable(device, packed.numbers)
        check_covered("the portable denoising kernel", reason, suffix, MAX_SUFFIX)
        blocks = blocks or multiprocessors(device)
        choice = choice or choices(suffix, packed.form, blocks)
        if not has_large_l2(device):
            choice = replace(choice, ahead=False)
        assert (mixing is None) == packed.form.modulated, "one or the other brings in the time"
        sizes = kernel_sizes(
            config,
            blocks=blocks,
            cache_rows=cache_rows,
            suffix=suffix,
            weights=packed.numbers,
            choice=choice,
            form=packed.form,
        )
        sizes["TP_TRACE"] = int(traced)
        loop, prepare = load(device, sizes, arch)
        prepared = suffix * max(config.expert.head_dim // 2, config.action_dim)
        super().__init__(
            config,
            steps=len(table if mixing is None else mixing.biases),
            suffix=suffix,
            arguments=ARGS,
            tensors=tensors(packed, small, table.to(device).float().contiguous(), sizes, mixing),
            numbers={"logit_scale": config.expert.head_dim**-0.5},
            prepare=Launched(prepare, -(-prepared // PREPARE_THREADS), PREPARE_THREADS),
            loop=Launched(loop, blocks, choice.warps * 32),
        )
        self._phases = phases(sizes)

    def clock_mhz(self) -> None:
        """This kernel doesn't measure it."""

    def why_it_trapped(self) -> str | None:
        """After a launch that failed: where a block waited for seconds before it gave up, or None."""
        return stuck(int(self._tensors["hang"]) // self._loop.blocks, self._phases)

    def trace(self) -> Tensor:  # of a kernel that was made with `traced`
        """int64[blocks, PHASES, 2]: cycles of all launches so far at work, and at the barrier behind it."""
        return self._tensors["trace"].long() & 0xFFFFFFFF


def multiprocessors(device: torch.device) -> int:
    return int(torch.cuda.get_device_properties(device).multi_processor_count)


def has_large_l2(device: torch.device) -> bool:
    return int(torch.cuda.get_device_properties(device).L2_cache_size) >= LARGE_L2


def phases(sizes: dict[str, int]) -> list[str]:
    """Of a step, in words: behind each is a barrier of the whole grid."""
    of_layer = [one for one in PHASES[:6] if one != "combine" or sizes["TP_SPLITS"] > 1]
    layers = [f"phase {phase} of layer {layer}" for layer in range(sizes["TP_DEPTH"]) for phase in of_layer]
    return ["embed", *([] if sizes["TP_MODULATED"] else ["mix"]), *layers, "advance"]


def stuck(barrier: int, phases: list[str]) -> str | None:
    """Where the barrier with this number, from 1 on, is in the loop; None: no block gave up."""
    if not barrier:
        return None
    step, place = divmod(barrier - 1, len(phases))
    return f"blocks of the denoising kernel waited for seconds for one another behind {phases[place]} in step {step}"


def load(device: torch.device, sizes: dict[str, int], arch: str | None = None) -> tuple[Kernel, Kernel]:
    """The loop, and what runs in front of it."""
    code = compiled(arch or native_arch(torch.cuda.get_device_capability(device)), sizes)
    with torch.cuda.device(device):
        loop = Kernel(code, "turbopi_portable_denoise", SHARED_BYTES)
        return loop, Kernel(code, "turbopi_portable_denoise_prepare", 0)


def tensors(
    packed: PackedExpert, small: State, table: Tensor, sizes: dict[str, int], mixing: Mixing | None
) -> dict[str, Tensor]:
    """What the kernel reads beside a launch's own, and its scratch memory, on the table's device."""
    g, device, suffix = packed.config.expert, table.device, sizes["TP_TOKENS"]
    made = Tables.make(packed, table)

    def scratch(*shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
        return torch.zeros(*shape, dtype=dtype, device=device)

    def activation(columns: int) -> Tensor:
        chunk = CHUNK_BYTES // packed.weights.element_size()
        size = chunk * (1 if packed.numbers == "fp8" else 2)
        return scratch(-(-columns // chunk), suffix, size, dtype=torch.uint8)

    shares = _row_tiles(packed.config, suffix) * sizes["TP_SPLITS"]
    into = small["action_in_proj.weight"].to(device) if mixing is None else mixing.into
    of_ends = end_tensors(packed.config, small, table, out_w=small["action_out_proj.weight"], in_w=into.T)
    if mixing is not None:
        out = tiles(mixing.out.to(torch.bfloat16))
        of_ends |= {"in_b": mixing.biases.contiguous(), "mix": out, "mix_b": mixing.out_bias.contiguous()}
    return {
        "weights": packed.weights,
        "table": made.modulation,
        "shifted": made.shifted,
        "row_scales": made.row_scales,
        "attended_times": made.attended_times,
        "mix": scratch(0),
        "mix_b": scratch(0),
        **of_ends,
        "x": scratch(suffix, g.width),
        "squares": scratch(suffix, g.width // 8),
        "stream": activation(g.width),
        "attended": activation(g.num_heads * g.head_dim),
        "hidden": activation(g.mlp_dim),
        "queries": scratch(suffix * g.num_heads, g.head_dim, dtype=torch.bfloat16),
        "keys": scratch(g.num_kv_heads * suffix, g.head_dim, dtype=torch.bfloat16),
        "values": scratch(g.num_kv_heads * suffix, g.head_dim, dtype=torch.bfloat16),
        "partial": scratch(shares, 16, g.head_dim),
        "tops": scratch(shares, 16, 2),
        "rope": scratch(1 if packed.form.self_every == 1 else 2, suffix, g.head_dim // 2, 2),
        "counter": scratch(1, dtype=torch.int32),
        "hang": torch.zeros(1, dtype=torch.int32, pin_memory=device.type == "cuda"),  # see `why_it_trapped`
        "trace": scratch(sizes["TP_BLOCKS"], len(PHASES), 2, dtype=torch.int32),
    }
