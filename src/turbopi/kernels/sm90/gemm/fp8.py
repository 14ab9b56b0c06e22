"""Matrix products of numbers of eight bits, for compute capability 9.0: kernel.cu compiled for E4M3 or int8.

Twins: `kernels.plain`' products with a `ScaledMatrix`. The results are bfloat16, of the same numbers for a product that
reads them next (`inverse`), or parts of the sums ("partial", "parts") for the norms of `norms.py` to add up. Sums of
int8 are whole and exact, so nothing of them is promoted.
"""

from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import torch
from torch import Tensor

from turbopi.kernels.ahead import MadeOnce
from turbopi.kernels.sm90.gemm.bf16 import (
    SPLIT,
    Copy,
    Epilogue,
    Sums,
    Tile,
    build,
    copied_parts,
    copy_arguments,
    fitted,
    launch,
    layout,
    matrix_map,
    norm_arguments,
    parameters,
    product_arguments,
    size_arguments,
    tile_constants,
)
from turbopi.kernels.sm90.gemm.tiles import TILES_FP8
from turbopi.kernels.sm90.instructions import WHOLE_COLUMNS, DependentKernel
from turbopi.quantization.fp8 import ALIGNMENT, ScaledMatrix

DEPTH = 128  # of a step along the inner axis
PROMOTE = 4  # steps after which the tensor cores' sums, of some 14 bits, are added up in float32
# Of sums shorter than these steps the tensor cores lose too little to matter: 2e-3 of 8192 random products, where
# rounding to E4M3 costs 4e-2; products of one sign lose more, so longer sums are promoted.
UNPROMOTED_STEPS = 17
PROMOTED_COLUMNS = {1: 184, 2: 192, 3: 112}  # by warpgroups: of wider tiles the sums don't fit registers twice


# A `Copy` of a stream may be so many times larger than calibration saw in its norm before it saturates, as the stream
# grows between two norms. Costs nothing: the numbers below 2^-6, which lose precision, are far below any deviation.
HEADROOM = 16.0
NO_EPS = 1e-12  # the sums of a copy have it; what is left keeps a variance that rounding made 0 from dividing


@dataclass(frozen=True)
class FoldedFp8:
    """An E4M3 matrix behind a LayerNorm whose input comes as a `Copy`, HEADROOM times smaller than calibrated."""

    matrix: ScaledMatrix
    scale: Tensor  # float32[N]: the matrix's, for such a copy
    of_scale: Tensor  # float32[N]: the matrix times the norm's scale
    of_shift: Tensor  # float32[N]: the matrix times its shift

    @classmethod
    def fold(cls, matrix: ScaledMatrix, scale: Tensor, shift: Tensor) -> "FoldedFp8":
        wide = matrix.dequantized()
        return cls(matrix, matrix.scale * HEADROOM, wide @ scale.float(), wide @ shift.float())


def promotion(tile: Tile, k: int) -> int:
    """Steps between two promotions of sums over k values; 0: none is needed, or the tile is too wide."""
    return 0 if _short(tile, k) or tile.columns > PROMOTED_COLUMNS[tile.warpgroups] else PROMOTE


def matmul_fp8(
    a: Tensor,
    weight: ScaledMatrix | FoldedFp8,
    tile: Tile,
    epilogue: Epilogue,
    bias: Tensor | None = None,
    out: Tensor | None = None,
    inverse: float | None = None,
    promote: int | None = None,
    *,
    residual: Tensor | None = None,
    sums_out: Sums | None = None,
    sums: Sums | None = None,
    copy: Copy | None = None,
    stream: Tensor | None = None,
    ahead: Tensor | None = None,
) -> Tensor:
    """a (e4m3|int8)[M, K] @ weightᵀ of the same numbers with the epilogue -> bfloat16[M, N], or with `inverse` of these
    numbers, round(… * inverse); "partial" -> float32, "parts" -> bfloat16[splits, M, N]. "added" as of `bf16.matmul`.

    int8's damage is marked in `stream` [M, width], bfloat16: see `quantization.int8`.

    With "bias" alone, `residual` bfloat16[M, N] is added, the sums of the result's rows go into `sums_out`, and a
    `copy` may leave, too. With a `FoldedFp8` ("bias" or "gelu"), a is a `Copy` and `sums` its `sums_out`: its LayerNorm
    is multiplied.
    weight [N, K], for "geglu" [2N, K]; bias bfloat16[N] of any epilogue but "geglu" and "parts". All contiguous, K a
    multiple of 16, N of 8.
    """
    folded, weight = (weight, weight.matrix) if isinstance(weight, FoldedFp8) else (None, weight)
    assert (folded is None) == (sums is None) and (folded is None or epilogue in ("bias", "gelu"))
    assert not tile.gather or folded is None, "sums are gathered after that"
    assert copy is None or (residual is not None and sums is None and inverse is None)
    m, k = a.shape
    n = weight.shape[0] // 2 if epilogue == "geglu" else weight.shape[0]
    assert a.dtype == weight.numbers and a.is_contiguous() and weight.data.is_contiguous()
    assert k % ALIGNMENT == 0 and n % 8 == 0 and weight.shape[1] == k, f"{a.shape} @ {weight.shape}"
    columns, groups = layout(tile, epilogue, m, n, -(-k // DEPTH), residual, sums_out)
    whole = weight.numbers == torch.int8
    promote = 0 if whole else promotion(tile, k) if promote is None else promote
    tile = fitted(tile, groups, -(-k // DEPTH), a.device)
    partial = epilogue == "partial"
    assert bias is None or (bias.dtype == torch.bfloat16 and epilogue not in ("plain", "geglu", "parts"))
    assert out is not None or epilogue != "added"
    if out is None:
        shape = (tile.splits, m, n) if epilogue in SPLIT else (m, n)
        out = torch.empty(shape, dtype=_result_dtype(partial, inverse, a.dtype), device=a.device)
    assert out.is_contiguous() and out.dtype == _result_dtype(partial, inverse, a.dtype)
    assert stream is None or (whole and inverse is not None and stream.dtype == torch.bfloat16 and len(stream) == m)
    assert not (promote and tile.overlap), "no registers are left for sums that are promoted"
    normed = 0 if sums is None else sums.count
    copied = copied_parts(copy, m, n)
    form = inverse is not None, promote, residual is not None, normed, copied, whole, stream is not None
    kernel = _kernel(tile, epilogue, form, a.device)
    given = {
        "map_a": matrix_map(a.data_ptr(), m, k, tile.rows // tile.cluster_n, fp8=True),
        "map_w": matrix_map(weight.data.data_ptr(), weight.shape[0], k, columns // tile.cluster_m, fp8=True),
        **product_arguments(out, bias, residual, sums_out),
        "scale": (weight if folded is None else folded).scale.data_ptr(),
        "inverse": 1.0 if inverse is None else inverse,
        **({} if folded is None else norm_arguments(sums, k, NO_EPS, folded.of_scale, folded.of_shift)),
        **copy_arguments(copy, n),
        **({} if stream is None else {"marked": stream.data_ptr(), "mark_pitch": stream.stride(0)}),
        **size_arguments(m, n, -(-k // DEPTH), groups),
    }
    launch(kernel, tile, groups, given, ahead)
    return out


def _result_dtype(partial: bool, inverse: float | None, numbers: torch.dtype) -> torch.dtype:
    return torch.float32 if partial else torch.bfloat16 if inverse is None else numbers


def constants(
    tile: Tile,
    epilogue: Epilogue,
    out_fp8: bool,
    promote: int,
    residual: bool = False,
    normed: int = 0,
    copied: int = 0,
    whole: bool = False,
    marks: bool = False,
) -> dict[str, int]:
    """What kernel.cu is compiled with. whole: for int8; marks: its damage."""
    own = {"TP_FP8": 1, "TP_OUT_FP8": int(out_fp8), "TP_PROMOTE": promote, "TP_NORMED": normed, "TP_COPY": copied}
    own |= {"TP_INT8": int(whole), "TP_MARKS": int(marks)}
    if out_fp8:
        own["TP_APART"] = 0  # such blocks go in fours, which may need more room than `Tile.apart` counts
    return tile_constants(tile, epilogue, residual, factors=2 if normed else 1, promoted=promote > 0) | own


@MadeOnce
def _kernel(tile: Tile, epilogue: Epilogue, form: Any, device: torch.device) -> DependentKernel:
    """form: what `constants` takes behind these"""
    sizes = constants(tile, epilogue, *form)
    takes = parameters(
        fp8=True,
        residual=sizes["TP_RESIDUAL"] > 0,
        normed=sizes["TP_NORMED"] > 0,
        copied=sizes["TP_COPY"] > 0,
        marks=sizes["TP_MARKS"] > 0,
    )
    return build(takes, sizes, tile, device)


# -- which tile --------------------------------------------------------------------------------------------------------

# Clock cycles, fitted to 200 measurements on an H200 (median error 5 %): of a product besides its tiles, of a tile for
# each of its results (with GELU twice as many), of a step, and of its loads for each byte. A step's products take
# rows * columns / 32. Partial sums cost as much again in the norm that adds them up, those in bfloat16 half.
FIXED, WRITING, STEP, LOADING, ADDING = 2300, 0.098, 205, 0.013, 0.00042

GATHERING_SMS = 132  # on a GPU or a part of one with fewer, the clusters that gather sums may not all fit at once


MOST_SPLIT = 1536  # rows: of more the tiles fill the GPU without, and parts would only have to be added up


def candidates(epilogue: Epilogue, rows: int = 0) -> list[Tile]:
    """All that may be worth trying for so many rows."""
    unit = 16 if epilogue == "geglu" else 8
    found = [
        Tile(warpgroups, columns, splits=splits)
        for warpgroups in (1, 2, 3)
        for columns in range(2 * unit, 257, unit)
        if 64 * warpgroups * columns <= 192 * 192
        for splits in ((1, 2, 3, 4) if epilogue in SPLIT and rows <= MOST_SPLIT else (1,))
    ]
    return [tile for tile in found if tile.stages(factors=1, lines=epilogue == "parts") >= 3]


def cost(tile: Tile, m: int, n: int, k: int, epilogue: Epilogue, sms: int) -> float:
    """Estimated clock cycles of a product."""
    columns = tile.columns // 2 if epilogue == "geglu" else tile.columns
    waves = -(-(-(-m // tile.rows) * -(-n // columns) * tile.splits) // sms)
    steps = -(-k // DEPTH) / tile.splits
    step = max(tile.rows * tile.columns / 32, (tile.rows + tile.columns) * DEPTH * LOADING) + STEP
    writing = tile.rows * tile.columns * WRITING * (2 if epilogue in ("gelu", "geglu") else 1)
    adding = (4 if epilogue == "parts" else 8) * m * n * tile.splits * ADDING if tile.splits > 1 else 0
    return waves * (steps * step + writing) + FIXED + adding


@cache
def best_tile(m: int, n: int, k: int, epilogue: Epilogue, sms: int, whole: bool = False) -> Tile:
    """The measured tile for a @ weightᵀ of [m, k] and [n, k] (GeGLU: [2n, k]), else that of least estimated cost.

    whole: of int8, whose sums aren't promoted; E4M3's measured tile if it multiplies int8, too
    """
    m = -(-m // 64) * 64
    measured = TILES_FP8.get((m, n, k))
    if measured is not None and (sms >= GATHERING_SMS or not measured.gather):
        if not whole:
            return measured
        if takes_whole(measured := replace(measured, overlap=False)):
            return measured
    fitting = [tile for tile in candidates(epilogue, m) if tile.splits <= -(-k // DEPTH)]
    if whole:
        fitting = [tile for tile in fitting if takes_whole(tile)]
    elif -(-k // DEPTH) > UNPROMOTED_STEPS:  # long sums need room for promotion
        fitting = [tile for tile in fitting if _short(tile, k) or promotion(tile, k)]
    best = min(fitting, key=lambda tile: cost(tile, m, n, k, epilogue, sms))
    return replace(best, cluster_n=2) if epilogue == "geglu" else best


def takes_whole(tile: Tile) -> bool:
    """Whether int8 may be multiplied so: there are widths that its instruction hasn't."""
    return tile.columns in WHOLE_COLUMNS and not tile.overlap


def _short(tile: Tile, k: int) -> bool:
    return -(-k // DEPTH) <= UNPROMOTED_STEPS * tile.splits
