"""The action expert's products on the tokens of several observations: each brings the next matrix into the L2 cache.

All matrices of the expert are streamed once in a denoising step, and between two products the memory has nothing to do:
attention and norms read little. A product's last loads are on their way long before it ends; then it asks for the next.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from torch import Tensor

from turbopi.kernels.interface import GemmaLayer, Ops
from turbopi.kernels.portable import batch_steps
from turbopi.kernels.sm90.gemm.bf16 import matmul
from turbopi.kernels.sm90.gemm.fp8 import matmul_fp8
from turbopi.kernels.sm90.gemm.products import (
    as_input,
    bf16_tile,
    chosen_fp8,
    chosen_geglu,
    num_sms,
    tuned_linear,
    tuned_linear_geglu,
    tuned_residual_linear,
)
from turbopi.kernels.tile_table import NO_TILES, TileTable
from turbopi.quantization.fp8 import Matrix, ScaledMatrix


class ExpertProducts:
    """Those of `gemm/products.py`, in the same tiles. A matrix that the library multiplies asks for nothing."""

    def __init__(self, layers: Sequence[GemmaLayer[Any]], tiles: TileTable = NO_TILES) -> None:
        self._tiles = tiles  # measured on this GPU
        order = [numbers(one) for layer in layers for one in (layer.qkv, layer.out, layer.gate_up, layer.down)]
        self._next = {one.data_ptr(): behind for one, behind in zip(order, order[1:] + order[:1], strict=True)}

    def linear(self, x: Tensor, weight: Matrix) -> Tensor:
        if isinstance(weight, ScaledMatrix):
            columns, inner = weight.shape
            tile = chosen_fp8(self._tiles, "plain", len(x), columns, inner, num_sms(x.device))
            assert tile is not None, "the library has no such product"
            return matmul_fp8(x, weight, tile, "plain", ahead=self._behind(weight))
        bf16 = bf16_tile(self._tiles, "plain", x, weight)
        if bf16 is None:
            return tuned_linear(x, weight, tiles=self._tiles)
        return matmul(x, weight, bf16, "plain", ahead=self._behind(weight))

    def residual_linear(self, x: Tensor, weight: Matrix) -> Tensor:
        return tuned_residual_linear(x, weight, ahead=self._behind(weight), tiles=self._tiles)

    def linear_geglu(self, x: Tensor, gate_up: Matrix, inverse: float | None = None) -> Tensor:
        rows, hidden, inner, sms = len(x), gate_up.shape[0] // 2, gate_up.shape[1], num_sms(x.device)
        if isinstance(gate_up, ScaledMatrix):
            tile = chosen_fp8(self._tiles, "geglu", rows, hidden, inner, sms)
            assert tile is not None, "the library has no such product"
            return matmul_fp8(x, gate_up, tile, "geglu", inverse=inverse, ahead=self._behind(gate_up))
        tile = chosen_geglu(self._tiles, rows, hidden, inner, sms)
        if tile is None:
            return tuned_linear_geglu(x, gate_up, inverse, tiles=self._tiles)
        return as_input(matmul(x, gate_up, tile, "geglu", ahead=self._behind(gate_up)), inverse)

    def _behind(self, matrix: Matrix) -> Tensor | None:
        return self._next.get(numbers(matrix).data_ptr())


def expert(ops: Ops, layers: Sequence[GemmaLayer[Any]], *, tiles: TileTable = NO_TILES) -> Ops:
    """The expert's operations on a batch's tokens."""
    products = ExpertProducts(layers, tiles)
    return replace(
        batch_steps.expert(ops, layers),
        linear=products.linear,
        residual_linear=products.residual_linear,
        linear_geglu=products.linear_geglu,
    )


def numbers(matrix: Matrix) -> Tensor:
    return matrix.data if isinstance(matrix, ScaledMatrix) else matrix
