"""x @ weightᵀ with its epilogue: one tile of the result a program. E4M3 or bfloat16 in, float32 sums, of E4M3 also
float16 ones (`quantization.fp8`); int8 in, int32 sums.

Twins: the products of `kernels.plain` with a `ScaledMatrix`, and `linear_geglu` of bfloat16. Triton makes wgmma,
mma.sync or tcgen05 of the same source, as the GPU has it.
"""

from functools import lru_cache

import torch
import triton
import triton.language as tl
from torch import Tensor

from turbopi.kernels.dependent_launch import (
    capability,
    dependent_launch,
    launch_dependents,
    result_dtype,
    wait_for_producer,
)
from turbopi.kernels.portable.activations import gelu_tanh
from turbopi.kernels.portable.gemm.tiles import STEP_BYTES, Epilogue, Tile, best_tile, promotes, tuned_tile
from turbopi.kernels.portable.rounding import as_stored, damaged, marks
from turbopi.kernels.tile_table import NO_TILES, Numbers, TileTable
from turbopi.quantization.fp8 import ALIGNMENT, E4M3, HALF_BLOCK, Matrix, ScaledMatrix

GROUP = 8  # rows of tiles that are computed together, so that they read the same weights from the L2 cache
ANYWHERE = (9, 0)  # the GPU that the interpreter's tiles are chosen for


@triton.jit
def _sum(a, b, acc, PROMOTE: tl.constexpr, HALF: tl.constexpr, DEPTH: tl.constexpr):
    """acc + a bᵀ; with PROMOTE the tensor cores begin at 0 and the sum is float32; with HALF they add in float16."""
    if HALF:
        return acc + tl.dot(a, b.T, out_dtype=tl.float16).to(tl.float32)
    if PROMOTE:
        return acc + tl.dot(a, b.T, max_num_imprecise_acc=DEPTH)
    return tl.dot(a, b.T, acc, input_precision="ieee", out_dtype=acc.dtype)


@triton.jit
def _product_kernel(
    x, weight, scale, bias, out, rows, columns, inner, inverse, residual, stride,
    GELU: tl.constexpr, GEGLU: tl.constexpr, HAS_BIAS: tl.constexpr, HAS_SCALE: tl.constexpr, SCALED: tl.constexpr,
    MARKS: tl.constexpr, PROMOTE: tl.constexpr, HALF: tl.constexpr, WHOLE: tl.constexpr, SPLIT: tl.constexpr,
    GROUP: tl.constexpr, BLOCK_M: tl.constexpr, BLOCK_N: tl.constexpr, DEPTH: tl.constexpr, PDL: tl.constexpr,
):  # fmt: skip
    """Tile [BLOCK_M, BLOCK_N] of the result. WHOLE: DEPTH divides `inner`. GEGLU: weight has 2 * columns rows."""
    along_m, along_n = tl.cdiv(rows, BLOCK_M), tl.cdiv(columns, BLOCK_N)
    program, split = tl.program_id(0), tl.program_id(1)
    first = program // (GROUP * along_n) * GROUP
    height = tl.minimum(along_m - first, GROUP)
    m = (first + program % (GROUP * along_n) % height) * BLOCK_M + tl.arange(0, BLOCK_M)
    n = program % (GROUP * along_n) // height * BLOCK_N + tl.arange(0, BLOCK_N)
    d = tl.arange(0, DEPTH)
    # rows past the end are computed from others, and not stored
    a_at = x + ((m % rows)[:, None] * inner + d[None, :])
    b_at = weight + ((n % columns)[:, None] * inner + d[None, :])
    SUMS: tl.constexpr = tl.int32 if x.dtype.element_ty == tl.int8 else tl.float32
    acc = tl.zeros((BLOCK_M, BLOCK_N), SUMS)
    up = tl.zeros((BLOCK_M, BLOCK_N), SUMS)
    up_at = b_at + columns * inner
    steps = tl.cdiv(inner, DEPTH)
    begin, end = 0, steps
    if SPLIT:
        begin, end = steps * split // tl.num_programs(1), steps * (split + 1) // tl.num_programs(1)
    wait_for_producer(PDL)
    for step in range(begin, end):
        at = step * DEPTH
        if WHOLE:
            a, b = tl.load(a_at + at), tl.load(b_at + at)
        else:
            a = tl.load(a_at + at, d[None, :] < inner - at, 0.0)
            b = tl.load(b_at + at, d[None, :] < inner - at, 0.0)
        acc = _sum(a, b, acc, PROMOTE, HALF, DEPTH)
        if GEGLU:
            c = tl.load(up_at + at) if WHOLE else tl.load(up_at + at, d[None, :] < inner - at, 0.0)
            up = _sum(a, c, up, PROMOTE, HALF, DEPTH)
    launch_dependents(PDL)
    there = n < columns
    acc, up = acc.to(tl.float32), up.to(tl.float32)
    if HAS_SCALE:
        acc *= tl.load(scale + n, there, 0.0)[None, :]
        if GEGLU:
            up *= tl.load(scale + columns + n, there, 0.0)[None, :]
    if HAS_BIAS:
        added = tl.load(bias + n, there & (split == 0), 0.0).to(tl.float32)
        acc += added[None, :]
    if GELU or GEGLU:
        acc = gelu_tanh(acc)
    if GEGLU:
        acc *= up
    if SCALED:
        acc *= inverse
    to = out + ((split * rows + m)[:, None] * columns + n[None, :])
    tl.store(to, as_stored(acc, out), (m < rows)[:, None] & there[None, :])
    if MARKS:
        tl.store(residual + m * stride, float("nan"), (m < rows) & damaged(acc, 1))


def product(
    x: Tensor,
    weight: Matrix,
    epilogue: Epilogue = "plain",
    bias: Tensor | None = None,
    out: Tensor | None = None,
    inverse: float | None = None,
    tile: Tile | None = None,
    numbers: torch.dtype = E4M3,
    *,
    stream: Tensor | None = None,
    tiles: TileTable = NO_TILES,
) -> Tensor:
    """x [M, K] @ weightᵀ + bias, then the epilogue -> [M, N] in the weight's dtype, or with `inverse` in `numbers`.

    x is of the numbers of a `ScaledMatrix`, else as the weight. weight [N, K], of "geglu" [2N, K], gate rows before up
    rows; bias [N]. "parts" -> [splits, M, N], whose sum is the result; of one split [M, N]. All contiguous, K a
    multiple of 16. Without a `tile`, that of `tiles`, else the cost model's. `stream` [M, width]: see `kernels.plain`.
    """
    data = weight.data if isinstance(weight, ScaledMatrix) else weight
    m, k = x.shape
    n = data.shape[0] // 2 if epilogue == "geglu" else data.shape[0]
    assert data.shape[1] == k and k % ALIGNMENT == 0, f"{tuple(x.shape)} @ {tuple(data.shape)}"
    assert x.dtype == data.dtype and x.is_contiguous() and data.is_contiguous(), "rows are read as they lie in memory"
    assert bias is None or (epilogue != "geglu" and bias.shape == (n,))
    scaled, on = isinstance(weight, ScaledMatrix), gpu(x.device)
    half = isinstance(weight, ScaledMatrix) and weight.half_sums
    multiplied: Numbers = "bf16" if not scaled else "int8" if data.dtype == torch.int8 else "fp8"
    tile = tile or (None if half else tuned_tile(tiles, multiplied, epilogue, m, n, k))  # FP8's may have no room
    tile = tile or best_tile(on[0], scaled, epilogue, m, n, k, on[1], half)
    assert tile.splits == 1 or epilogue == "parts"
    assert max(x.numel(), data.numel(), tile.splits * m * n) < 1 << 31, "places are counted in 32 bits"
    depth = STEP_BYTES if scaled else STEP_BYTES // 2
    assert not half or depth == HALF_BLOCK, "a float16 sum is one step's"
    block_n = tile.columns // 2 if epilogue == "geglu" else tile.columns
    if out is None:
        dtype = weight.dtype if inverse is None else result_dtype(x, inverse, numbers)
        out = torch.empty((m, n) if tile.splits == 1 else (tile.splits, m, n), dtype=dtype, device=x.device)
    assert out.is_contiguous() and out.shape[-2:] == (m, n), "the result is written as it lies in memory"
    grid = (triton.cdiv(m, tile.rows) * triton.cdiv(n, block_n), tile.splits)
    _product_kernel[grid](
        x, data, weight.scale if isinstance(weight, ScaledMatrix) else x, x if bias is None else bias, out, m, n, k,
        1.0 if inverse is None else inverse,
        GELU=epilogue == "gelu", GEGLU=epilogue == "geglu", HAS_BIAS=bias is not None, HAS_SCALE=scaled,
        SCALED=inverse is not None, PROMOTE=x.dtype == E4M3 and promotes(on[0], k), HALF=half, WHOLE=k % depth == 0,
        SPLIT=tile.splits > 1, GROUP=GROUP, BLOCK_M=tile.rows, BLOCK_N=block_n, DEPTH=depth,
        num_warps=tile.warps, num_stages=tile.stages, **marks(stream, out), **dependent_launch(x),
    )  # fmt: skip
    return out


@lru_cache
def gpu(device: torch.device) -> tuple[tuple[int, int], int]:
    """Compute capability and multiprocessors."""
    if device.type != "cuda":
        return ANYWHERE, 132
    return capability(device), torch.cuda.get_device_properties(device).multi_processor_count
