"""The whole denoising loop of Pi0.5 in one kernel of resident thread block clusters: its weights, sizes and launch.

Ten steps read the action expert's 311 M weights ten times and do little else, so the loop is a race between memory and
the delay of some thousand dependent operations. One kernel keeps its clusters resident, streams the weights through
shared memory without pause, and passes activations through distributed shared memory; only sums over heads or hidden
units cross clusters. How, and why it is safe, is said in denoise_base.cu.

Shapes: N steps, L layers, T suffix tokens, D width, F feed-forward width, n query heads of K columns, A action_dim.
"""

import ctypes
from dataclasses import dataclass
from importlib.resources import files

import numpy as np
import torch
from torch import Tensor

from turbopi.config import ModelConfig
from turbopi.engine.weights import GemmaLayer, State
from turbopi.errors import BackendError, BackendUnavailable
from turbopi.kernels.denoise import _affine, _inverse_frequencies, unavailable
from turbopi.kernels.nvrtc import Kernel, compile_cubin

PARTS = ("denoise_base.cu", "denoise_product.cu", "denoise_attention.cu", "denoise_loop.cu")
BLOCK = 16  # rows of a tile, columns of a block
WARPS = 16  # that multiply
THREADS = (WARPS + 4) * 32
RANKS = 8  # CTAs of a cluster
MAX_SUFFIX = 56  # beyond it too little shared memory is left for weights on their way


def refusal(config: ModelConfig) -> str | None:
    """Why the kernel can't run this model, or None if it can."""
    g = config.expert
    if config.kind != "pi05":
        return f"it covers Pi0.5, this model is {config.kind}"
    if g.num_kv_heads != 1:
        return f"it needs one key/value head, this model has {g.num_kv_heads}"
    if g.width % BLOCK or g.mlp_dim % BLOCK:
        return f"widths must be multiples of {BLOCK}: width {g.width}, mlp_dim {g.mlp_dim}"
    if g.head_dim % BLOCK or g.head_dim > 256:
        return f"head_dim must be a multiple of {BLOCK} up to 256, it is {g.head_dim}"
    if config.action_dim % 4 or config.action_dim > WARPS * 32:
        return f"action_dim must be a multiple of 4 up to {WARPS * 32}, it is {config.action_dim}"
    return None


def share(count: int, parts: int, index: int) -> range:
    """Which of `count` things part `index` of `parts` has."""
    return range(count * index // parts, count * (index + 1) // parts)


def most(count: int, parts: int) -> int:
    return -(-count // parts)


@dataclass(frozen=True)
class Arrangement:
    """Who does what: see denoise_base.cu."""

    config: ModelConfig
    clusters: int

    @property
    def blocks(self) -> int:
        return self.clusters * RANKS

    @property
    def max_tiles(self) -> tuple[int, int, int, int]:
        """A CTA's tiles at most: queries, keys and values, gate|up, and of a product back into the stream."""
        g = self.config.expert
        hidden = most(g.mlp_dim // BLOCK, self.clusters)
        kv = most(g.head_dim // 8, g.num_heads * RANKS)
        return most(g.head_dim // BLOCK, RANKS), kv, most(2 * hidden, RANKS), most(g.width // BLOCK, RANKS)

    def query_rows(self, cluster: int, rank: int) -> Tensor:
        """int64[tiles, 16] rows of q|k|v: of a tile 8 columns of the head's first half, then RoPE's partners."""
        if cluster >= self.config.expert.num_heads:
            return torch.empty(0, BLOCK, dtype=torch.int64)
        head_dim = self.config.expert.head_dim
        tiles = torch.tensor(share(head_dim // BLOCK, RANKS, rank), dtype=torch.int64)
        return cluster * head_dim + _rope_rows(tiles, head_dim)

    def key_value_rows(self, cluster: int, rank: int) -> Tensor:
        """int64[tiles, 16] rows of q|k|v: keys in RoPE's pairs, values as they are."""
        g = self.config.expert
        if cluster >= g.num_heads:
            return torch.empty(0, BLOCK, dtype=torch.int64)
        mine = torch.tensor(share(g.head_dim // 8, g.num_heads * RANKS, cluster * RANKS + rank), dtype=torch.int64)
        keys, values = mine[mine < g.head_dim // BLOCK], mine[mine >= g.head_dim // BLOCK] - g.head_dim // BLOCK
        value_rows = (g.num_heads + 1) * g.head_dim + values[:, None] * BLOCK + torch.arange(BLOCK)
        return torch.cat((g.num_heads * g.head_dim + _rope_rows(keys, g.head_dim), value_rows))

    def hidden(self, cluster: int) -> range:
        units = share(self.config.expert.mlp_dim // BLOCK, self.clusters, cluster)
        return range(units.start * BLOCK, units.stop * BLOCK)

    def gate_up_rows(self, cluster: int, rank: int) -> Tensor:
        """int64[tiles, 16] rows of gate|up: of a tile 8 units' gate, then their up."""
        hidden = self.hidden(cluster)
        tiles = torch.tensor(share(len(hidden) // 8, RANKS, rank), dtype=torch.int64)
        units = hidden.start + tiles[:, None] * 8 + torch.arange(8)
        return torch.cat((units, units + self.config.expert.mlp_dim), dim=1)

    def stream_rows(self, rank: int) -> Tensor:
        """int64[tiles, 16] columns of the stream: of a tile the even ones, then the odd ones."""
        tiles = torch.tensor(share(self.config.expert.width // BLOCK, RANKS, rank), dtype=torch.int64)
        return tiles[:, None] * BLOCK + torch.cat((torch.arange(0, BLOCK, 2), torch.arange(1, BLOCK, 2)))

    def out_columns(self, cluster: int) -> Tensor:
        """int64[K] columns of a head's attention in the order in which they are kept: i and i + 8 in turn."""
        head_dim = self.config.expert.head_dim
        pairs = torch.stack((torch.arange(8), torch.arange(8) + 8), dim=1).flatten()
        return cluster * head_dim + (torch.arange(0, head_dim, BLOCK)[:, None] + pairs).flatten()


def _rope_rows(tiles: Tensor, head_dim: int) -> Tensor:
    first = tiles[:, None] * 8 + torch.arange(8)
    return torch.cat((first, first + head_dim // 2), dim=1)


def _groups(tiles: int, wide: bool) -> list[tuple[int, int, int]]:
    """(tiles, tiles of one warp, parts of the reduction) of each group that a product is multiplied in."""
    groups = []
    while tiles > 0:
        size = next(n for n in (8, 4, 2, 1) if tiles >= n)
        per_warp = 2 if size == 8 and wide else 1
        groups.append((size, per_warp, WARPS // (size // per_warp)))
        tiles -= size
    return groups


def fragments(tiles: Tensor, max_tiles: int, wide: bool, padding: int) -> Tensor:
    """[tiles, 16, columns] -> flat, in the order in which a CTA's warps read it; filled up with `padding`."""
    count, _, columns = tiles.shape
    blocks = columns // BLOCK
    # a fragment is 32 lanes (g, t) x 8 values: rows g and g + 8 of columns 4t, 4t + 1, then of 4t + 2, 4t + 3
    ordered = tiles.view(count, 2, 8, blocks, 4, 2, 2).permute(0, 3, 2, 4, 5, 1, 6).reshape(count, blocks, 256)
    out, first = [], 0
    for size, per_warp, parts in _groups(max_tiles, wide):
        if first >= count:
            break
        steps = most(blocks, parts)
        padded = tiles.new_full((size, steps * parts, 256), padding)
        here = ordered[first : first + size]
        padded[: len(here), :blocks] = here
        shape = per_warp, size // per_warp, steps, parts, 256
        out.append(padded.view(shape).permute(2, 0, 1, 3, 4).flatten())
        first += size
    return torch.cat(out) if out else tiles.new_empty(0)


@dataclass(frozen=True)
class PackedExpert:
    """The expert's matrices in the kernel's order. One serves kernels of any number of steps and suffix tokens."""

    arrangement: Arrangement
    weights: Tensor  # bfloat16[L, elements]: of a layer each CTA's qkv, out, gate|up, down
    index: Tensor  # int32[elements]: which element of qkv, out, gate|up, down, 0 each is
    starts: Tensor  # int64[CTAs]: where a CTA's begin in a layer, bytes

    @classmethod
    def pack(cls, config: ModelConfig, layers: list[GemmaLayer], clusters: int | None = None) -> "PackedExpert":
        """`clusters`: at least one per head, which is also the default.

        Raises BackendError for sizes that the kernel doesn't cover.
        """
        reason = refusal(config)
        if reason is not None:
            raise BackendError(f"the denoising kernel can't run this model: {reason}")
        heads = config.expert.num_heads
        arrangement = Arrangement(config, clusters or heads)
        if arrangement.clusters < heads:
            raise BackendError(f"{clusters} clusters are fewer than the model's {heads} heads; give {heads} or more")
        streams = _streams(arrangement)
        device = layers[0].qkv.device
        index = torch.cat(streams).to(device)
        starts = np.cumsum([0, *(2 * len(stream) for stream in streams[:-1])])
        packed = torch.empty(len(layers), len(index), dtype=torch.bfloat16, device=device)
        for row, layer in zip(packed, layers, strict=True):
            parts = (layer.qkv, layer.out, layer.gate_up, layer.down)
            flat = torch.cat([*(part.to(torch.bfloat16).flatten() for part in parts), row.new_zeros(1)])
            torch.index_select(flat, 0, index, out=row)
        return cls(arrangement, packed, index, torch.from_numpy(starts).to(device))

    def matrices(self, layer: int) -> tuple[Tensor, ...]:
        """A layer's qkv, out, gate|up and down, as they were before packing."""
        shapes = _shapes(self.arrangement.config)
        sizes = [rows * columns for rows, columns in shapes]
        flat = self.weights.new_zeros(sum(sizes) + 1)
        flat[self.index] = self.weights[layer]
        return tuple(part.view(shape) for part, shape in zip(torch.split(flat[:-1], sizes), shapes, strict=True))


def _shapes(config: ModelConfig) -> list[tuple[int, int]]:
    g = config.expert
    width = g.num_heads * g.head_dim
    return [(width + 2 * g.head_dim, g.width), (g.width, width), (2 * g.mlp_dim, g.width), (g.width, g.mlp_dim)]


def _streams(a: Arrangement) -> list[Tensor]:
    """int32 of each CTA: the elements of qkv, out, gate|up, down in the order in which it reads them."""
    shapes = _shapes(a.config)
    offsets = np.cumsum([0, *(rows * columns for rows, columns in shapes)]).tolist()
    padding = offsets[-1]
    qkv, out, gate_up, down = (
        torch.arange(start, start + rows * columns, dtype=torch.int32).view(rows, columns)
        for start, (rows, columns) in zip(offsets[:-1], shapes, strict=True)
    )
    queries, keys_values, gates, slice_tiles = a.max_tiles
    streams = []
    for cluster in range(a.clusters):
        hidden = a.hidden(cluster)
        for rank in range(RANKS):
            rows = a.stream_rows(rank)
            products = []
            if cluster < a.config.expert.num_heads:
                columns = a.out_columns(cluster)
                products = [
                    fragments(qkv[a.query_rows(cluster, rank)], queries, True, padding),
                    fragments(qkv[a.key_value_rows(cluster, rank)], keys_values, True, padding),
                    fragments(out[rows][:, :, columns], slice_tiles, False, padding),
                ]
            products += [
                fragments(gate_up[a.gate_up_rows(cluster, rank)], gates, True, padding),
                fragments(down[rows][:, :, hidden.start : hidden.stop], slice_tiles, False, padding),
            ]
            streams.append(torch.cat(products))
    return streams


def shifted_rows(packed: PackedExpert, table: Tensor) -> Tensor:
    """float32[N, L, CTAs, tiles, 16]: what the norms' shifts add to the products behind them."""
    a = packed.arrangement
    queries, keys_values, gates, _ = a.max_tiles
    num_qkv = _shapes(a.config)[0][0]
    padding = num_qkv + 2 * a.config.expert.mlp_dim
    index = torch.full((a.blocks, queries + keys_values + gates, BLOCK), padding)
    for cta in range(a.blocks):
        cluster, rank = divmod(cta, RANKS)
        first = 0
        for rows, room in (
            (a.query_rows(cluster, rank), queries),
            (a.key_value_rows(cluster, rank), keys_values),
            (a.gate_up_rows(cluster, rank) + num_qkv, gates),
        ):
            index[cta, first : first + len(rows)] = rows
            first += room
    index = index.to(table.device)
    layers = []
    for i in range(a.config.expert.depth):
        qkv, _, gate_up, _ = packed.matrices(i)
        products = [table[:, 2 * i + j, 1].double() @ m.double().T for j, m in enumerate((qkv, gate_up))]
        layers.append(torch.cat((*products, products[0].new_zeros(len(table), 1)), dim=1).float()[:, index])
    return torch.stack(layers, dim=1).contiguous()


class _Args(ctypes.Structure):
    """`Args` of denoise_base.cu."""

    _fields_ = (
        *((name, ctypes.c_void_p) for name in ("weights", "starts", "table", "shifted", "out_w", "out_shift", "in_w")),
        *((name, ctypes.c_void_p) for name in ("in_b", "inv_freq", "cache_k", "cache_v", "length", "noise", "x_t")),
        *((name, ctypes.c_void_p) for name in ("v_t", "scratch", "hang", "trace")),
        ("layer_stride", ctypes.c_longlong),
        ("layer_bytes", ctypes.c_longlong),
        ("steps", ctypes.c_int),
        ("dt", ctypes.c_float),
        ("eps", ctypes.c_float),
        ("zero", ctypes.c_uint32),
    )


def kernel_sizes(arrangement: Arrangement, *, cache_rows: int, suffix: int, shared_bytes: int) -> dict[str, int]:
    """The kernel's compile-time constants."""
    config, g = arrangement.config, arrangement.config.expert
    stream = arrangement.clusters * (g.width // BLOCK) * most(suffix, 8) * 32
    return {
        "TP_D": g.width,
        "TP_F": g.mlp_dim,
        "TP_L": g.depth,
        "TP_NH": g.num_heads,
        "TP_HD": g.head_dim,
        "TP_T": suffix,
        "TP_A": config.action_dim,
        "TP_S": RANKS,
        "TP_NC": arrangement.clusters,
        "TP_KEYS": most(cache_rows, RANKS),
        "TP_RPS": 4 if suffix <= 24 else 2,
        "TP_SMEM": shared_bytes,
        "TP_SCRATCH": 4 * stream + suffix * g.head_dim,
    }


def source() -> str:
    return "".join((files("turbopi.kernels") / part).read_text() for part in PARTS)


class DenoiseKernel:
    """The loop for a fixed number of steps and suffix tokens; capturable in a CUDA graph.

    `table` float32[N, 2L + 1, 3, D] is the modulation (`engine.weights.modulation`), `small` holds action_in_proj and
    action_out_proj, `cache_rows` is an upper bound of the valid cache rows. Raises BackendError for a model, suffix or
    GPU that it doesn't cover.
    """

    def __init__(
        self,
        config: ModelConfig,
        packed: PackedExpert | list[GemmaLayer],
        small: State,
        table: Tensor,
        *,
        cache_rows: int,
        suffix: int,
        device: torch.device,
    ) -> None:
        reason = unavailable(device)
        if reason is not None:
            raise BackendUnavailable(reason)
        if not 1 <= suffix <= MAX_SUFFIX:
            raise BackendError(f"the denoising kernel takes 1 to {MAX_SUFFIX} suffix tokens, not {suffix}")
        self._config = config
        self._packed = packed if isinstance(packed, PackedExpert) else PackedExpert.pack(config, packed)
        arrangement = self._packed.arrangement
        g, properties = config.expert, torch.cuda.get_device_properties(device)
        assert table.shape[1:] == (2 * g.depth + 1, 3, g.width), table.shape
        sizes = kernel_sizes(
            arrangement,
            cache_rows=cache_rows,
            suffix=suffix,
            shared_bytes=properties.shared_memory_per_block_optin,  # type: ignore[attr-defined]
        )
        self._suffix, self._blocks = suffix, arrangement.blocks
        self._table = table.to(device).float().contiguous()
        self._tensors = {
            "weights": self._packed.weights,
            "starts": self._packed.starts,
            "table": self._table,
            "shifted": shifted_rows(self._packed, self._table),
            "out_w": small["action_out_proj.weight"].float().T.contiguous(),
            "out_shift": _affine(small, "action_out_proj", self._table[:, -1, 1].double()).float().contiguous(),
            "in_w": small["action_in_proj.weight"].float().contiguous(),
            "in_b": small["action_in_proj.bias"].float().contiguous(),
            "inv_freq": _inverse_frequencies(config, device),
            "scratch": torch.empty(4 * sizes["TP_SCRATCH"], dtype=torch.int32, device=device),
            "hang": torch.zeros(self._blocks, dtype=torch.int32, pin_memory=True),  # where they waited
            "trace": torch.zeros(self._blocks, 64, dtype=torch.int32, device=device),
        }
        with torch.cuda.device(device):
            arch = f"sm_{properties.major}{properties.minor}a"
            self._kernel = Kernel(compile_cubin(source(), arch, sizes), "turbopi_denoise", sizes["TP_SMEM"])
            fitting = self._kernel.max_active_clusters(RANKS, THREADS)
            if fitting < arrangement.clusters:
                raise BackendUnavailable(
                    f"the denoising kernel needs {arrangement.clusters} clusters of {RANKS} multiprocessors at once, "
                    f"{torch.cuda.get_device_name(device)} holds {fitting}"
                )

    def launch(self, noise: Tensor, cache_k: Tensor, cache_v: Tensor, length: Tensor, x_t: Tensor, v_t: Tensor) -> None:
        """Denoise on the current stream.

        noise float32[T, A]; cache_k, cache_v bfloat16[L, rows, K], the first `length` (int64[1], on the device) rows
        valid and the others never read; written: x_t float32[N + 1, T, A], v_t float32[N, T, A].
        """
        steps, g, chunk = self._table.shape[0], self._config.expert, (self._suffix, self._config.action_dim)
        assert noise.shape == chunk and x_t.shape == (steps + 1, *chunk) and v_t.shape == (steps, *chunk)
        assert cache_k.stride() == cache_v.stride() and cache_k.stride()[1:] == (g.head_dim, 1), cache_k.stride()
        assert cache_k.dtype == cache_v.dtype == torch.bfloat16 and length.dtype == torch.int64
        assert all(t.is_contiguous() and t.dtype == torch.float32 for t in (noise, x_t, v_t))
        named = {**self._tensors, "cache_k": cache_k, "cache_v": cache_v, "length": length, "noise": noise}
        pointers = {name: t.data_ptr() for name, t in {**named, "x_t": x_t, "v_t": v_t}.items()}
        args = _Args(
            **pointers,
            layer_stride=cache_k.stride(0) * 2,
            layer_bytes=self._packed.weights.stride(0) * 2,
            steps=steps,
            dt=float(np.float32(-1.0 / steps)),
            eps=self._config.rms_norm_eps,
            zero=0,
        )
        self._tensors["scratch"].zero_()  # no exchange has been used yet
        self._kernel.launch(self._blocks, THREADS, args)
