"""The prefix's second RMSNorm without a pass of its own, for compute capability 9.0.

`out` adds its result to the residual stream and leaves a copy that is normed but for a factor of each row; GeGLU's
product multiplies that in, as it is linear up to there. See gemm/base.cu. In bfloat16 the copy is the stream times the
norm's scale; in E4M3, whose numbers don't reach as far, it is also divided by the rms that the row had before `out`.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor

from turbopi.kernels.dependent_launch import dependent_launch, launch_dependents, result_dtype, wait_for_producer
from turbopi.kernels.interface import Ops
from turbopi.kernels.portable import norms
from turbopi.kernels.portable.norms import _add_residual
from turbopi.kernels.portable.rounding import as_stored
from turbopi.kernels.sm90.gemm.bf16 import Copy, Sums, Tile, clusters, matmul
from turbopi.kernels.sm90.gemm.fp8 import HEADROOM, NO_EPS, matmul_fp8
from turbopi.kernels.sm90.gemm.products import as_input, chosen_fp8, chosen_geglu, num_sms
from turbopi.kernels.tile_table import NO_TILES, TileTable, whole_64
from turbopi.quantization.fp8 import E4M3, Matrix, ScaledMatrix

# Of `out`, by [rows in whole 64, out, in]: all tiles in one wave, and room for a row's numbers beside the sums
OUT_TILES = {(320, 2048, 2048): Tile(1, 80), (576, 2048, 2048): Tile(2, 80)}


@triton.jit
def _norm_and_squares_kernel(
    x, y, scale, out, normed, squares, rows, width, eps, inverse,
    HAS_Y: tl.constexpr, SPLITS: tl.constexpr, SCALED: tl.constexpr, BLOCK: tl.constexpr, PDL: tl.constexpr,
):  # fmt: skip
    row = tl.program_id(0)
    cols = tl.arange(0, BLOCK)
    mask = cols < width
    factor = tl.load(scale + cols, mask, 0.0)
    wait_for_producer(PDL)
    launch_dependents(PDL)
    if HAS_Y:
        a = _add_residual(x, y, x, out, row, rows, cols, width, mask, SPLITS, False)
    else:
        a = tl.load(x + row * width + cols, mask, 0.0).to(tl.float32)
    total = tl.sum(a * a, 0)
    tl.store(squares + row * 2 + 1, total)  # the sum beside it stays 0: nothing is centred
    result = a * tl.rsqrt(total / width + eps) * factor
    if SCALED:
        result *= inverse
    tl.store(normed + row * width + cols, as_stored(result, normed), mask)


def norm_and_squares(
    x: Tensor, y: Tensor | None, scale: Tensor, eps: float, inverse: float | None, sums: Sums
) -> tuple[Tensor, Tensor]:
    """`norms.residual_rms_norm`, and the squares of each row's sum into `sums`, which has one part, zeros before."""
    rows, width = norms._checked(x, y)
    out, normed = (x if y is None else torch.empty_like(x)), torch.empty_like(x, dtype=result_dtype(x, inverse))
    block = triton.next_power_of_2(width)
    _norm_and_squares_kernel[(rows,)](
        x, x if y is None else y, scale, out, normed, sums.parts, rows, width, eps, inverse or 1.0,
        HAS_Y=y is not None, SPLITS=norms._splits(y), SCALED=inverse is not None, BLOCK=block,
        num_warps=norms._warps(2 * block), **dependent_launch(x),
    )  # fmt: skip
    return out, normed


@dataclass(frozen=True)
class OutProduct:
    """`out`, which isn't made before the norm brings the residual stream to add it to."""

    x: Tensor
    weight: Matrix
    tile: Tile


@dataclass(frozen=True)
class NearlyNormed:
    """The RMSNorm of a stream, but for each row's factor, which `sums` tell."""

    copy: Tensor  # E4M3 of HEADROOM times smaller numbers, or bfloat16
    sums: Sums
    made: Callable[[], Tensor]  # the norm itself


class PrefixNorms:
    """`residual_linear`, `residual_rms_norm` and `linear_geglu` around those of `ops`, for sizes that OUT_TILES has.

    multiplying  is told each matrix that `ops` aren't given
    """

    def __init__(
        self, ops: Ops, tiles: TileTable = NO_TILES, multiplying: Callable[[Matrix], object] = lambda matrix: None
    ) -> None:
        self._ops, self._tiles, self._multiplying = ops, tiles, multiplying
        self._before: tuple[Tensor, Sums] | None = None  # the stream and its sums, as the last norm left it
        self._squares: dict[tuple[int, torch.device], Sums] = {}  # by rows: what `norm_and_squares` writes
        self._ones: dict[tuple[int, torch.device], Sums] = {}  # by rows: sums of a stream that is copied as it is
        self._scaled: dict[tuple[int, float], tuple[Tensor, tuple[Tensor, Tensor]]] = {}  # by the norm's address, as
        self._matrices: dict[int, ScaledMatrix] = {}  # by the weight's; both stay with it

    def residual_linear(self, x: Tensor, weight: Matrix, bias: Tensor | None = None) -> Any:
        tile = OUT_TILES.get((whole_64(len(x)), weight.shape[0], weight.shape[1]))
        if bias is not None or tile is None:
            return self._ops.residual_linear(x, weight, bias)
        self._multiplying(weight)
        return OutProduct(x, weight, tile)

    def residual_rms_norm(
        self,
        x: Tensor,
        y: Tensor | OutProduct | None,
        gate: Tensor | None,
        scale: Tensor,
        shift: Tensor | None,
        eps: float,
        inverse: float | None = None,
    ) -> tuple[Tensor, Any]:
        before, self._before = self._before, None
        if isinstance(y, OutProduct):
            known = before[1] if before is not None and before[0] is x else None
            units = self._sums_of_ones(x, eps) if inverse is None else known
            if units is not None:
                return self._add(x, y, scale, eps, inverse, units)
        product: Tensor | None = self._ops.residual_linear(y.x, y.weight) if isinstance(y, OutProduct) else y
        if inverse is None or gate is not None or shift is not None or scale.dim() != 1:
            return self._ops.residual_rms_norm(x, product, gate, scale, shift, eps, inverse)
        key = len(x), x.device
        if key not in self._squares:
            self._squares[key] = Sums(torch.zeros(1, len(x), 2, device=x.device))
        x, normed = norm_and_squares(x, product, scale, eps, inverse, self._squares[key])
        self._before = x, self._squares[key]
        return x, normed

    def linear_geglu(self, x: Tensor | NearlyNormed, gate_up: Matrix, inverse: float | None = None) -> Tensor:
        if not isinstance(x, NearlyNormed):
            return self._ops.linear_geglu(x, gate_up, inverse)
        in_fp8 = isinstance(gate_up, ScaledMatrix)
        tile = self._tile(len(x.copy), gate_up.shape[0] // 2, gate_up.shape[1], num_sms(x.copy.device), in_fp8)
        if tile is None:
            return self._ops.linear_geglu(x.made(), gate_up, inverse)
        if not isinstance(gate_up, ScaledMatrix):
            return as_input(matmul(x.copy, gate_up, tile, "geglu", sums=x.sums, eps=NO_EPS), inverse)
        key = gate_up.data.data_ptr()
        if key not in self._matrices:
            self._matrices[key] = replace(gate_up, scale=gate_up.scale * HEADROOM)
        return matmul_fp8(x.copy, self._matrices[key], tile, "geglu", inverse=inverse, sums=x.sums)

    def _add(
        self, x: Tensor, y: OutProduct, scale: Tensor, eps: float, inverse: float | None, units: Sums
    ) -> tuple[Tensor, NearlyNormed]:
        rows, width = x.shape
        sums, plain = (Sums.allocate(y.tile, rows, width, x.device) for _ in range(2))
        out = torch.empty_like(x, dtype=x.dtype if inverse is None else E4M3)
        copy = Copy(out, units, *self._for_copies(scale, inverse), eps, plain)
        if isinstance(y.weight, ScaledMatrix):
            added = matmul_fp8(y.x, y.weight, y.tile, "bias", residual=x, sums_out=sums, copy=copy)
        else:
            added = matmul(y.x, y.weight, y.tile, "bias", residual=x, sums_out=sums, copy=copy)

        def made() -> Tensor:
            return norms.residual_rms_norm(added, None, None, scale, None, eps, inverse)[1]

        return added, NearlyNormed(out, sums, made)

    def _tile(self, rows: int, hidden: int, width: int, sms: int, in_fp8: bool) -> Tile | None:
        """GeGLU's, if it can make up for the rest of a norm: each CTA keeps to its rows."""
        if in_fp8:
            tile = chosen_fp8(self._tiles, "geglu", rows, hidden, width, sms)
        else:
            tile = chosen_geglu(self._tiles, rows, hidden, width, sms)
        if tile is None or not tile.overlap:
            return None
        m_groups = -(-rows // (tile.rows * tile.cluster_m))
        n_groups = -(-2 * hidden // (tile.columns * tile.cluster_n))
        return tile if clusters(tile, m_groups * n_groups, sms // tile.cluster) % m_groups == 0 else None

    def _sums_of_ones(self, x: Tensor, eps: float) -> Sums:
        """Of rows whose factor is 1."""
        key, width = (len(x), x.device), x.shape[1]
        if key not in self._ones:
            parts = torch.tensor([0.0, width * (1 - eps)], device=x.device).repeat(1, len(x), 1)
            self._ones[key] = Sums(parts)
        return self._ones[key]

    def _for_copies(self, scale: Tensor, inverse: float | None) -> tuple[Tensor, Tensor]:
        """A norm's scale and no shift, as `Copy` wants them."""
        by = 1.0 if inverse is None else inverse / HEADROOM
        key = scale.data_ptr(), by
        if key not in self._scaled:
            self._scaled[key] = scale, (scale.float() * by, torch.zeros_like(scale, dtype=torch.float32))
        return self._scaled[key][1]
