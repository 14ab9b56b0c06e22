"""The vision tower's products with the LayerNorms and the residual stream between them, for compute capability 9.0."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from turbopi.kernels.sm90.gemm.bf16 import Copy, Epilogue, Folded, Sums, Tile, matmul
from turbopi.kernels.sm90.gemm.fp8 import GATHERING_SMS, HEADROOM, FoldedFp8, matmul_fp8
from turbopi.kernels.sm90.gemm.products import (
    added,
    as_input,
    bf16_tile,
    chosen_fp8,
    tuned_linear,
    tuned_linear_gelu,
    tuned_residual_linear,
)
from turbopi.kernels.sm90.instructions import multiprocessors
from turbopi.kernels.sm90.norms import layer_norm
from turbopi.kernels.tile_table import NO_TILES, TileTable
from turbopi.quantization.fp8 import E4M3, Matrix, ScaledMatrix


@dataclass(frozen=True)
class Product:
    """A product that isn't made before the norm brings the residual stream to add it to."""

    x: Tensor
    weight: Matrix
    bias: Tensor
    tile: Tile


@dataclass(frozen=True)
class Normed:
    """LayerNorm of x, made only where the product behind it can't do it."""

    x: Tensor
    sums: Sums
    scale: Tensor
    shift: Tensor
    eps: float

    def made(self) -> Tensor:
        return layer_norm.residual_layer_norm(self.x, None, self.scale, self.shift, self.eps)[1]


@dataclass(frozen=True)
class NormedCopy:
    """LayerNorm of the residual stream for a product of E4M3 numbers, of which there is a copy nearly normed."""

    copy: Tensor  # e4m3: see `gemm.Copy`
    sums: Sums  # of the stream, in the copy's units
    scale: Tensor
    shift: Tensor


class VisionProducts:
    """The tower's products: those in front of a LayerNorm add the residual stream themselves, those behind norm it."""

    def __init__(self, tiles: TileTable = NO_TILES) -> None:
        self._tiles = tiles  # measured on this GPU
        # by the weight's address; the weight stays with it, so that no other one can come to lie there
        self._folded: dict[int, tuple[Tensor, Folded]] = {}
        self._folded_fp8: dict[int, FoldedFp8] = {}
        self._scaled: dict[int, tuple[Tensor, tuple[Tensor, Tensor]]] = {}  # by the norm's address, as above
        self._stream: Normed | None = None  # the residual stream and its sums, as the last product left it
        self._behind: dict[int, Tensor] = {}  # which matrix came behind the one at this address last time: a hint
        self._last: Tensor | None = None

    def add_linear(self, stream: Tensor, x: Tensor, weight: Matrix, bias: Tensor | None = None) -> bool:
        if self._residual_tile(x, weight, bias) is not None:
            return False
        return added(stream, x, weight, bias, lambda: None if bias is None else self._next(weight), tiles=self._tiles)

    def residual_linear(self, x: Tensor, weight: Matrix, bias: Tensor | None = None) -> Tensor | Product:
        tile = self._residual_tile(x, weight, bias)
        if tile is None or bias is None:
            ahead = None if bias is None else self._next(weight)
            return tuned_residual_linear(x, weight, bias, ahead, tiles=self._tiles)
        return Product(x, weight, bias, tile)

    def _residual_tile(self, x: Tensor, weight: Matrix, bias: Tensor | None) -> Tile | None:
        """Of a product that is made when the norm behind it brings the stream."""
        if bias is None or (sms := multiprocessors(x.device)) < GATHERING_SMS:
            return None
        if isinstance(weight, ScaledMatrix):
            return chosen_fp8(self._tiles, "residual", x.shape[0], weight.shape[0], weight.shape[1], sms)
        return bf16_tile(self._tiles, "residual", x, weight)

    def residual_layer_norm(
        self,
        x: Tensor,
        y: Tensor | Product | None,
        weight: Tensor,
        bias: Tensor,
        eps: float,
        inverse: float | None = None,
    ) -> tuple[Tensor, Tensor | Normed | NormedCopy]:
        before, self._stream = self._stream, None
        if not isinstance(y, Product):
            return layer_norm.residual_layer_norm(x, y, weight, bias, eps, inverse)
        ahead, copy = self._next(y.weight), None
        sums = plain = Sums.allocate(y.tile, x.shape[0], x.shape[1], x.device)
        if inverse is not None and before is not None and before.x is x:
            plain = Sums.allocate(y.tile, x.shape[0], x.shape[1], x.device)
            copy = Copy(
                torch.empty_like(x, dtype=E4M3), before.sums, *self._for_copies(weight, bias, inverse), eps, plain
            )
        if isinstance(y.weight, ScaledMatrix):
            x = matmul_fp8(y.x, y.weight, y.tile, "bias", y.bias, residual=x, sums_out=sums, copy=copy, ahead=ahead)
        else:
            x = matmul(y.x, y.weight, y.tile, "bias", y.bias, residual=x, sums_out=sums, copy=copy, ahead=ahead)
        self._stream = Normed(x, plain, weight, bias, eps)
        if copy is not None:
            return x, NormedCopy(copy.out, sums, weight, bias)
        if inverse is not None:  # of the first layer's input nothing is known
            return layer_norm.residual_layer_norm(x, None, weight, bias, eps, inverse)
        return x, self._stream

    def linear(
        self, x: Tensor | Normed | NormedCopy, weight: Matrix, bias: Tensor | None = None, out: Tensor | None = None
    ) -> Tensor:
        if isinstance(x, NormedCopy):
            return self._from_copy(x, weight, bias, "bias", out)
        if isinstance(x, Normed):
            if (made := self._normed(x, weight, bias, "bias", out)) is not None:
                return made
            x = x.made()
        ahead = None if bias is None else self._next(weight)
        if out is not None:  # as in `_normed`
            ahead = None
        return tuned_linear(x, weight, bias, out, ahead, tiles=self._tiles)

    def linear_gelu(
        self, x: Tensor | Normed | NormedCopy, weight: Matrix, bias: Tensor, inverse: float | None = None
    ) -> Tensor:
        if isinstance(x, NormedCopy):
            return self._from_copy(x, weight, bias, "gelu", inverse=inverse)
        if isinstance(x, Normed):
            if (made := self._normed(x, weight, bias, "gelu")) is not None:
                return as_input(made, inverse)
            x = x.made()
        return tuned_linear_gelu(x, weight, bias, inverse, self._next(weight), tiles=self._tiles)

    def _normed(
        self, x: Normed, weight: Matrix, bias: Tensor | None, epilogue: Epilogue, out: Tensor | None = None
    ) -> Tensor | None:
        if (
            isinstance(weight, ScaledMatrix)
            or bias is None
            or (tile := bf16_tile(self._tiles, epilogue, x.x, weight)) is None
            or tile.splits > 1
            or tile.overlap
        ):
            return None
        key = weight.data_ptr()
        if key not in self._folded:
            self._folded[key] = weight, Folded.fold(weight, bias, x.scale, x.shift)
        folded = self._folded[key][1]
        ahead = self._next(folded.data)
        if out is not None:  # the tower's result: what comes behind it is the next call's
            ahead = None
        return matmul(x.x, folded, tile, epilogue, out=out, sums=x.sums, eps=x.eps, ahead=ahead)

    def _for_copies(self, scale: Tensor, shift: Tensor, inverse: float) -> tuple[Tensor, Tensor]:
        """A LayerNorm's weights as `Copy` wants them."""
        key = scale.data_ptr()
        if key not in self._scaled:
            by = inverse / HEADROOM
            self._scaled[key] = scale, (scale.float() * by, shift.float() * by)
        return self._scaled[key][1]

    def _from_copy(
        self,
        x: NormedCopy,
        weight: Matrix,
        bias: Tensor | None,
        epilogue: Epilogue,
        out: Tensor | None = None,
        inverse: float | None = None,
    ) -> Tensor:
        assert isinstance(weight, ScaledMatrix), "only such a matrix's input is asked for in E4M3"
        key = weight.data.data_ptr()
        if key not in self._folded_fp8:
            self._folded_fp8[key] = FoldedFp8.fold(weight, x.scale, x.shift)
        rows, (columns, inner) = x.copy.shape[0], weight.shape
        tile = chosen_fp8(self._tiles, epilogue, rows, columns, inner, multiprocessors(x.copy.device))
        assert tile is not None and tile.splits == 1, "a norm is multiplied whole"
        tile = replace(tile, overlap=False)  # what follows such a product's sums needs more registers than that leaves
        ahead = self._next(weight)
        return matmul_fp8(x.copy, self._folded_fp8[key], tile, epilogue, bias, out, inverse, sums=x.sums, ahead=ahead)

    def _next(self, matrix: Matrix) -> Tensor | None:
        """What may be fetched into L2 during a product: the matrix that came behind this one last time."""
        data = matrix.data if isinstance(matrix, ScaledMatrix) else matrix
        if self._last is not None:
            self._behind[self._last.data_ptr()] = data
        self._last = data
        return self._behind.get(data.data_ptr())
