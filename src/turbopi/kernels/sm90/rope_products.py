"""The prefix's queries, keys and values with RoPE in their product's epilogue, for compute capability 9.0."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from turbopi.kernels.interface import Ops
from turbopi.kernels.sm90.gemm.bf16 import Tile, Turning, beside_each_other, matmul
from turbopi.kernels.sm90.gemm.fp8 import matmul_fp8
from turbopi.kernels.tile_table import whole_64
from turbopi.quantization.fp8 import Matrix, ScaledMatrix

# By [rows in whole 64, out, in]: a head is whole tiles
ROPE_TILES = {
    (320, 2560, 2048): Tile(1, 128),
    (320, 512, 2048): Tile(1, 32),
    (576, 2560, 2048): Tile(3, 64),
    (576, 512, 2048): Tile(1, 64),
}


@dataclass(frozen=True)
class QkvProduct:
    """A product that isn't made before it is known where keys and values go."""

    x: Tensor
    weight: Matrix
    tile: Tile


class RopeProducts:
    """`linear` and `rope_split` around those of `ops`, for sizes that ROPE_TILES has.

    multiplying  is told each matrix that `ops` aren't given, and may say which one to bring into L2
    """

    def __init__(self, ops: Ops, multiplying: Callable[[Matrix], Tensor | None] = lambda matrix: None) -> None:
        self._ops, self._multiplying = ops, multiplying
        # by the weight's address; the weight stays with it, so that no other one can come to lie there
        self._turned: dict[int, tuple[Matrix, Matrix]] = {}

    def linear(self, x: Any, weight: Matrix, bias: Tensor | None = None, out: Tensor | None = None) -> Any:
        tile = ROPE_TILES.get((whole_64(len(x)), weight.shape[0], weight.shape[1])) if isinstance(x, Tensor) else None
        if tile is None or bias is not None or out is not None:
            return self._ops.linear(x, weight, bias, out)
        return QkvProduct(x, weight, tile)

    def rope_split(self, qkv: Tensor | QkvProduct, cos: Tensor, sin: Tensor, k_out: Tensor, v_out: Tensor) -> Tensor:
        if not isinstance(qkv, QkvProduct):
            return self._ops.rope_split(qkv, cos, sin, k_out, v_out)
        head_dim = k_out.shape[1]
        weight, turning = self._with_neighbours(qkv.weight, head_dim), Turning(cos, sin, k_out, v_out)
        ahead = self._multiplying(weight)
        if isinstance(weight, ScaledMatrix):
            q = matmul_fp8(qkv.x, weight, qkv.tile, "plain", turning=turning, ahead=ahead)
        else:
            q = matmul(qkv.x, weight, qkv.tile, "plain", turning=turning, ahead=ahead)
        return q.view(-1, head_dim)

    def _with_neighbours(self, weight: Matrix, head_dim: int) -> Matrix:
        """The matrix with the rows of each pair beside each other."""
        data = weight.data if isinstance(weight, ScaledMatrix) else weight
        key = data.data_ptr()
        if key not in self._turned:
            order = beside_each_other(len(data), head_dim, data.device)
            if isinstance(weight, ScaledMatrix):
                moved = weight.data.view(torch.uint8)[order].view(weight.numbers)
                made: Matrix = replace(weight, data=moved, scale=weight.scale[order].contiguous())
            else:
                made = weight[order]
            self._turned[key] = weight, made
        return self._turned[key][1]
