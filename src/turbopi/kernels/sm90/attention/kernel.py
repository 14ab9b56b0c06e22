"""Attention without materialised logits through wgmma and TMA, for compute capability 9.0.

Two kernels: narrow.cu has 64 rows of queries a CTA, whose warpgroups take tiles of keys in turn; that is soonest where
there are fewer CTAs than multiprocessors. wide.cu has 64 rows for each warpgroup and loads keys less often.

Twins: `vision_attention` of `kernels.plain`, its `attention` without a suffix, and `packed_attention` of
`kernels.plain_batch`. The kernels for all other GPUs, and for heads that this one doesn't take, are in
kernels/portable/{attention,batch}.py.
"""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from turbopi.kernels.ahead import MadeOnce
from turbopi.kernels.arguments import TENSOR_MAP, Parameter, Parameters
from turbopi.kernels.dependent_launch import result_dtype
from turbopi.kernels.interface import Segments
from turbopi.kernels.nvrtc import compile_cubin
from turbopi.kernels.portable.attention import LOG2_E
from turbopi.kernels.sm90 import instructions
from turbopi.kernels.sm90.instructions import SHARED_BYTES, DependentKernel
from turbopi.quantization.fp8 import E4M3

PARAMETERS = Parameters(
    (
        *(Parameter(TENSOR_MAP, f"map_{name}") for name in "qkv"),
        Parameter("Element*", "out"),  # bfloat16, E4M3 or int8: common.cu
        Parameter("const long long*", "length"),
        *(Parameter("int", name) for name in ("rows", "keys", "heads", "k_first", "v_first", "tiles", "units")),
        Parameter("float", "scale"),
        Parameter("float", "inverse"),
        Parameter("const int4*", "segments", "packed rows: see `kernels.interface.Segments`"),
    )
)
PARAMETERS_INT8 = Parameters(
    (*PARAMETERS.all, Parameter("u16*", "marked"), Parameter("int", "mark_pitch"), Parameter("int", "marks_of"))
)


ENOUGH_UNITS = 0.7  # wide ones, by multiprocessor: then they are sooner (docs/dev/log.md, "Attention of batches")
MOST_OF_FOUR = 72  # columns for which four wide warpgroups have registers
# Three wide warpgroups: the most columns; the part of the rows that four give the busiest multiprocessor, at most; what
# a unit takes there that is filled in part.
MOST_OF_THREE, GAIN_OF_THREE, PARTIAL = 64, 0.85, 0.6


@dataclass(frozen=True)
class AttentionTile:
    """How attention is cut: `keys` keys at a time for each of some warpgroups."""

    dim: int  # columns of a head
    keys: int
    warpgroups: int = 2
    sharing: int = 1  # CTAs in a cluster, which load keys and values together
    wide: bool = False  # each warpgroup has rows of its own: wide.cu
    queries: int = 1  # units of rows whose queries have room in a CTA; wide ones alone

    @property
    def rows(self) -> int:
        """Of queries in a CTA."""
        return 64 * self.warpgroups if self.wide else 64

    @property
    def threads(self) -> int:
        """Of a CTA: the consumers' and the producer's."""
        return 128 * (self.warpgroups + 1)

    @property
    def stages(self) -> int:
        """Tiles of keys or values in flight: as many as fit, beside the queries, 1 KB of alignment and the barriers."""
        panels = -(-self.dim // 64)
        beside = 2048 + self.queries * self.rows * panels * 128
        return min(12, (SHARED_BYTES - beside) // (self.keys * panels * 128))

    def holds(self, keys: int) -> bool:
        """Whether shared memory takes so many keys and values at once."""
        return 2 * self.warpgroups * -(-keys // (self.keys * self.warpgroups)) <= self.stages


def takes(dim: int) -> bool:
    """Whether there is a kernel for heads of that many columns."""
    return dim % 8 == 0 and 16 <= dim <= 256


def prefix_attention(
    q: Tensor,
    k: Tensor,
    v: Tensor,
    length: Tensor,
    heads: int,
    inverse: float | None = None,
    tile: AttentionTile | None = None,
    *,
    numbers: torch.dtype = E4M3,
) -> Tensor:
    """Rows q [tokens * n, K] over the first `length` (int64[1], on the device, at least 1) keys -> [tokens, n * K].

    k, v [keys, K]; what lies beyond `length` has no influence. With `inverse` the result leaves as `numbers`, E4M3 or
    int8, whose damage is marked in `v`. All bfloat16 and contiguous.
    """
    assert all(t.is_contiguous() and t.dtype == torch.bfloat16 for t in (q, k, v))
    assert length.dtype == torch.int64 and length.numel() == 1
    rows, dim = q.shape
    tile = tile or AttentionTile(dim, keys=64)
    out = q.new_empty(rows // heads, heads * dim, dtype=result_dtype(q, inverse, numbers))
    _launch(tile, (q, k, v), (1, 1, 1), (0, 0, 0), out, length, rows, k.shape[0], 1, inverse, marked=v)
    return out


def packed_attention(
    q: Tensor,
    k: Tensor,
    v: Tensor,
    segments: Segments,
    heads: int,
    inverse: float | None = None,
    tile: AttentionTile | None = None,
    *,
    numbers: torch.dtype = E4M3,
) -> Tensor:
    """Each row of q [R * n, K] over the keys of its own segment: k, v [R, K] -> [R, n * K]; `inverse`, `numbers` as
    above.
    """
    assert all(t.is_contiguous() and t.dtype == torch.bfloat16 for t in (q, k, v))
    assert segments.tiles.is_contiguous() and segments.tiles.dtype == torch.int32 and segments.tiles.shape[1] == 4
    rows, dim = q.shape
    out = q.new_empty(rows // heads, heads * dim, dtype=result_dtype(q, inverse, numbers))
    tile = tile or AttentionTile(dim, keys=80, wide=True)
    _launch(tile, (q, k, v), (1, 1, 1), (0, 0, 0), out, None, rows, k.shape[0], 1, inverse, segments.tiles, marked=v)
    return out


def vision_attention(
    qkv: Tensor,
    images: int,
    heads: int,
    inverse: float | None = None,
    tile: AttentionTile | None = None,
    *,
    numbers: torch.dtype = E4M3,
    stream: Tensor | None = None,
) -> Tensor:
    """Self-attention inside each image: [V * tokens, 3W], q before k before v, heads inside -> [V * tokens, W].

    bfloat16, contiguous. With `inverse` the result leaves as `numbers`, E4M3 or int8, whose damage is marked in
    `stream` [V * tokens, …] or, without one, in the rows' first query.
    """
    assert qkv.is_contiguous() and qkv.dtype == torch.bfloat16
    rows, width = qkv.shape[0], qkv.shape[1] // 3
    tokens, dim = rows // images, width // heads
    out = qkv.new_empty(rows, width, dtype=result_dtype(qkv, inverse, numbers))
    tile = tile or _vision_tile(tokens, dim, images * heads, instructions.multiprocessors(qkv.device))
    places = (3 * heads,) * 3
    given = tile, (qkv,) * 3, places, (0, heads, 2 * heads), out, None, tokens, tokens, images * heads, inverse
    _launch(*given, marked=qkv if stream is None else stream)
    return out


def _vision_tile(tokens: int, dim: int, groups: int, sms: int) -> AttentionTile:
    for warpgroups in (4, 2):
        tile = AttentionTile(dim, 64, warpgroups, wide=True, queries=2 if dim <= 128 else 1)
        fits = warpgroups == 2 or dim <= MOST_OF_FOUR
        if fits and (units := groups * -(-tokens // tile.rows)) >= ENOUGH_UNITS * sms:
            four = warpgroups == 4 and dim <= MOST_OF_THREE
            if four and _rows_of_three(tokens, groups, sms) <= GAIN_OF_THREE * -(-units // sms) * tile.rows:
                return replace(tile, warpgroups=3, keys=128)
            return tile
    tile = AttentionTile(dim, keys=128 if dim <= 128 else 64)
    pair = replace(tile, sharing=2)
    return pair if -(-tokens // 64) % 2 == 0 and pair.holds(tokens) else tile


def _rows_of_three(tokens: int, groups: int, sms: int) -> float:
    """Rows that the busiest CTA of three warpgroups has, where a unit of fewer rows counts for `PARTIAL` of one."""
    rows = 64 * 3
    whole, partial = groups * (tokens // rows), groups * (tokens % rows > 0)
    return rows * max(-(-whole // sms), (whole + PARTIAL * partial) / sms)


def _launch(
    tile: AttentionTile,
    matrices: tuple[Tensor, ...],
    heads: tuple[int, ...],
    first: tuple[int, ...],
    out: Tensor,
    length: Tensor | None,
    rows: int,
    keys: int,
    groups: int,
    inverse: float | None,
    segments: Tensor | None = None,
    *,
    marked: Tensor,
) -> None:
    """matrices q, k, v of `heads` heads side by side, theirs beginning with the `first`; groups of images and heads.

    rows and keys: of one image. `segments` int32[blocks, 4]: of packed rows. marked bfloat16[tokens, …]: where int8's
    damage shows.
    """
    packed = segments is not None
    count = out.shape[-1] // tile.dim if length is None and not packed else 1  # query heads beside each other
    boxes = (64, tile.keys // tile.sharing, tile.keys // tile.sharing)
    maps = [
        instructions.tensor_map(
            matrix.data_ptr(),
            (tile.dim, width, matrix.numel() // (width * tile.dim)),
            (tile.dim, width * tile.dim),
            (64, 1, box),
        )
        for matrix, width, box in zip(matrices, heads, boxes, strict=True)
    ]
    tiles = -(-rows // tile.rows) if segments is None else len(segments) * 64 // tile.rows
    assert tile.sharing == 1 or (tiles % tile.sharing == 0 and tile.holds(keys)), "who shares never waits for a slot"
    units = tiles * groups
    whole = length is None and not packed and keys == tile.keys * tile.warpgroups
    in_int8 = out.dtype == torch.int8
    kernel = _kernel(tile, inverse is not None, whole, packed, in_int8, out.device)
    given = {
        **dict(zip(("map_q", "map_k", "map_v"), maps, strict=True)),
        "out": out.data_ptr(),
        "length": None if length is None else length.data_ptr(),
        "rows": rows,
        "keys": keys,
        "heads": count,
        "k_first": first[1],
        "v_first": first[2],
        "tiles": tiles,
        "units": units,
        "scale": tile.dim**-0.5 * LOG2_E,
        "inverse": 1.0 if inverse is None else inverse,
        "segments": None if segments is None else segments.data_ptr(),
    }
    if in_int8:
        assert marked.dtype == torch.bfloat16 and len(marked) == len(out), "each token has a place for its damage"
        of = out.numel() // (len(out) * tile.dim * count)  # rows of one token: its heads, or all beside each other
        given |= {"marked": marked.data_ptr(), "mark_pitch": marked.stride(0), "marks_of": of}
    kernel.launch_dependent(min(units, kernel.max_clusters) if tile.wide else units, given)


def constants(
    tile: AttentionTile, out_fp8: bool, whole: bool = False, packed: bool = False, in_int8: bool = False
) -> dict[str, int]:
    """What the kernel is compiled with; `whole`: for the keys that its warpgroups take at once, all seen."""
    return {
        "TP_DIM": tile.dim,
        "TP_WGS": tile.warpgroups,
        "TP_KEYS": tile.keys,
        "TP_STAGES": tile.stages,
        "TP_OUT_FP8": int(out_fp8),
        "TP_OUT_INT8": int(in_int8),
        "TP_SHARING": tile.sharing,
        "TP_QUERIES": tile.queries,
        "TP_WHOLE": int(whole),
        "TP_PACKED": int(packed),
    }


def source(tile: AttentionTile, in_int8: bool = False) -> str:
    """The kernel with the instructions for a tile."""
    logits = instructions.wgmma("mma_logits", tile.keys)
    values = instructions.wgmma("mma_values", tile.dim, from_registers=True, across=True)
    parameters = f"#define ATTENTION_PARAMETERS {(PARAMETERS_INT8 if in_int8 else PARAMETERS).declarations}"
    files = [f"attention/{name}.cu" for name in ("common", "wide" if tile.wide else "narrow")]
    return instructions.source(*files, generated=f"{logits}\n{values}\n{parameters}\n")


@MadeOnce
def _kernel(
    tile: AttentionTile, out_fp8: bool, whole: bool, packed: bool, in_int8: bool, device: torch.device
) -> DependentKernel:
    takes = PARAMETERS_INT8 if in_int8 else PARAMETERS
    with torch.cuda.device(device):
        cubin = compile_cubin(source(tile, in_int8), "sm_90a", constants(tile, out_fp8, whole, packed, in_int8))
        return DependentKernel(
            cubin, "attention", takes, shared_bytes=SHARED_BYTES, threads=tile.threads, cluster=tile.sharing
        )
