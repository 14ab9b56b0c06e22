"""A layer of the vision tower for compute capability 9.0, with its LayerNorms and residual stream in the GEMMs.

Where there is a tile for it, the GEMM in front of a LayerNorm adds the residual stream and sums up its rows, and the
GEMM behind the norm normalises with these sums: no norm is launched. A GEMM that adds the stream can also leave an E4M3
copy for the GEMM behind the norm. For that it must know which one comes, so it is deferred until then, in the
`VisionStream` itself. What is kept from call to call depends on the weights alone.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from turbopi.kernels.interface import Affine, AffineMatrix, VisionLayer, VisionStream
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
from turbopi.quantization.fp8 import E4M3, Matrix, ScaledMatrix, input_of


@dataclass(frozen=True)
class Deferred:
    """A GEMM that adds the residual stream; it runs where the matmul behind the next norm is known."""

    x: Tensor
    weight: Matrix
    bias: Tensor
    tile: Tile
    following: Matrix  # that is multiplied next

    def run(self, stream: Tensor, ahead: Tensor, copy: Copy | None = None) -> tuple[Tensor, Sums]:
        """The residual stream with this GEMM's result, and its rows' sums, in the units of the copy if there is one."""
        m, n = stream.shape
        sums = Sums.allocate(self.tile, m, n, stream.device)
        fused: dict[str, Any] = {"residual": stream, "sums_out": sums, "copy": copy, "ahead": ahead}
        if isinstance(self.weight, ScaledMatrix):
            return matmul_fp8(self.x, self.weight, self.tile, "bias", self.bias, **fused), sums
        return matmul(self.x, self.weight, self.tile, "bias", self.bias, **fused), sums


class FusedVision:
    """`kernels.interface.VisionOps`. attention: (qkv, images, heads, inverse=…) -> what goes into `out`."""

    def __init__(self, attention: Callable[..., Tensor], tiles: TileTable = NO_TILES) -> None:
        self._attention = attention
        self._tiles = tiles  # measured on this GPU
        # by the weight's address; the weight stays with it, so that no other one can come to lie there
        self._folded: dict[int, tuple[Tensor, Folded]] = {}
        self._folded_fp8: dict[int, FoldedFp8] = {}
        self._scaled: dict[int, tuple[Tensor, tuple[Tensor, Tensor]]] = {}  # by the norm's address, as above

    def layer(
        self, layer: VisionLayer, stream: VisionStream, *, images: int, heads: int, eps: float, following: Matrix
    ) -> VisionStream:
        stream, qkv = self._normed_linear(stream, layer.norm1, layer.qkv, "bias", eps, following=layer.out[0])
        attended = self._attention(qkv, images, heads, **input_of(layer.out[0]))
        stream = self._add(stream, attended, layer.out, layer.fc1[0])
        stream, hidden = self._normed_linear(
            *(stream, layer.norm2, layer.fc1, "gelu", eps), following=layer.fc2[0], **input_of(layer.fc2[0])
        )
        return self._add(stream, hidden, layer.fc2, following)

    def finish(self, stream: VisionStream, norm: Affine, eps: float) -> Tensor:
        if stream.pending is None:
            return stream.x
        if isinstance(stream.pending, Deferred):
            return stream.pending.run(stream.x, _data(stream.pending.following))[0]
        return layer_norm.residual_layer_norm(stream.x, stream.pending, *norm, eps)[0]

    def project(self, stream: VisionStream, norm: Affine, projector: AffineMatrix, eps: float, out: Tensor) -> None:
        self._normed_linear(stream, norm, projector, "bias", eps, out=out)

    def _add(self, stream: VisionStream, x: Tensor, affine: AffineMatrix, following: Matrix) -> VisionStream:
        """The residual stream with a matmul's result added or pending."""
        assert stream.pending is None, "a norm lies between two matmuls that are added"
        weight, bias = affine
        if (tile := self._residual_tile(x, weight)) is not None:
            return replace(stream, pending=Deferred(x, weight, bias, tile, following))
        ahead = _data(following)
        if added(stream.x, x, weight, bias, ahead, tiles=self._tiles):
            return VisionStream(stream.x)
        return VisionStream(stream.x, tuned_residual_linear(x, weight, bias, ahead, tiles=self._tiles))

    def _residual_tile(self, x: Tensor, weight: Matrix) -> Tile | None:
        """Of a GEMM that adds the residual stream; None: it isn't made that way."""
        if (sms := multiprocessors(x.device)) < GATHERING_SMS:
            return None
        if isinstance(weight, ScaledMatrix):
            n, k = weight.shape
            return chosen_fp8(self._tiles, "residual", x.shape[0], n, k, sms)
        return bf16_tile(self._tiles, "residual", x, weight)

    def _normed_linear(
        self,
        stream: VisionStream,
        norm: Affine,
        affine: AffineMatrix,
        epilogue: Epilogue,
        eps: float,
        *,
        following: Matrix | None = None,
        inverse: float | None = None,
        out: Tensor | None = None,
    ) -> tuple[VisionStream, Tensor]:
        """(the stream with what was pending, the matmul of its LayerNorm), in as few kernels as there are tiles for.

        following: the matrix that is multiplied next, to be fetched into L2; None behind the tower
        inverse: the result is E4M3
        """
        x, pending, (weight, bias) = stream.x, stream.pending, affine
        takes = weight.inverse if isinstance(weight, ScaledMatrix) else None
        ahead = None if following is None else _data(following)
        if not isinstance(pending, Deferred):
            x, normed = layer_norm.residual_layer_norm(x, pending, *norm, eps, takes)
            return VisionStream(x), self._linear(normed, affine, epilogue, inverse, out, ahead)
        if isinstance(weight, ScaledMatrix) and stream.sums is not None:
            m, n = x.shape
            sums = Sums.allocate(pending.tile, m, n, x.device)
            scaled = self._for_copies(norm, weight.inverse)
            copy = Copy(torch.empty_like(x, dtype=E4M3), stream.sums, *scaled, eps, sums)
            x, of_copy = pending.run(x, weight.data, copy)
            rows, inner = weight.shape
            tile = chosen_fp8(self._tiles, epilogue, m, rows, inner, multiprocessors(x.device))
            assert tile is not None and tile.splits == 1, "a norm is multiplied whole"
            tile = replace(tile, overlap=False)  # what follows its sums needs more registers than that leaves
            folded_fp8 = self._fold_fp8(weight, norm)
            result = matmul_fp8(*(copy.out, folded_fp8, tile, epilogue, bias, out, inverse), sums=of_copy, ahead=ahead)
            return VisionStream(x, sums=sums), result
        folding = None if isinstance(weight, ScaledMatrix) else self._folding_tile(x, weight, epilogue)
        if folding is None or isinstance(weight, ScaledMatrix):
            x, sums = pending.run(x, _data(weight))
            normed = layer_norm.residual_layer_norm(x, None, *norm, eps, takes)[1]
            return VisionStream(x, sums=sums), self._linear(normed, affine, epilogue, inverse, out, ahead)
        folded = self._fold(weight, bias, norm)
        x, sums = pending.run(x, folded.data)
        result = matmul(x, folded, folding, epilogue, out=out, sums=sums, eps=eps, ahead=ahead)
        return VisionStream(x, sums=sums), as_input(result, result.dtype, inverse)

    def _linear(
        self,
        x: Tensor,
        affine: AffineMatrix,
        epilogue: Epilogue,
        inverse: float | None,
        out: Tensor | None,
        ahead: Tensor | None,
    ) -> Tensor:
        if epilogue == "gelu":
            return tuned_linear_gelu(x, *affine, inverse, ahead, tiles=self._tiles)
        return tuned_linear(x, *affine, out, ahead, tiles=self._tiles)

    def _folding_tile(self, x: Tensor, weight: Tensor, epilogue: Epilogue) -> Tile | None:
        """Of a bfloat16 GEMM that normalises its input; None: a norm is launched in front of it."""
        tile = bf16_tile(self._tiles, epilogue, x, weight)
        return None if tile is None or tile.splits > 1 or tile.overlap else tile

    def _fold(self, weight: Tensor, bias: Tensor, norm: Affine) -> Folded:
        key = weight.data_ptr()
        if key not in self._folded:
            self._folded[key] = weight, Folded.fold(weight, bias, *norm)
        return self._folded[key][1]

    def _fold_fp8(self, weight: ScaledMatrix, norm: Affine) -> FoldedFp8:
        key = weight.data.data_ptr()
        if key not in self._folded_fp8:
            self._folded_fp8[key] = FoldedFp8.fold(weight, *norm)
        return self._folded_fp8[key]

    def _for_copies(self, norm: Affine, inverse: float) -> tuple[Tensor, Tensor]:
        """A LayerNorm's weights as `Copy` wants them."""
        scale, shift = norm
        key = scale.data_ptr()
        if key not in self._scaled:
            by = inverse / HEADROOM
            self._scaled[key] = scale, (scale.float() * by, shift.float() * by)
        return self._scaled[key][1]


def _data(matrix: Matrix) -> Tensor:
    """What may be fetched into L2 before the matrix is multiplied."""
    return matrix.data if isinstance(matrix, ScaledMatrix) else matrix
