"""Matrix products: a `ScaledMatrix`'s in Triton, bfloat16's by the library, with what its epilogues can do.

Twins: `kernels.plain`. `tiles` are those that were measured on this GPU.
"""

import torch
import torch.nn.functional as F
from torch import Tensor

from turbopi.kernels.plain import as_input
from turbopi.kernels.portable import activations
from turbopi.kernels.portable.gemm.kernel import product
from turbopi.kernels.portable.gemm.tiles import tuned_tile
from turbopi.kernels.tile_table import NO_TILES, TileTable
from turbopi.quantization.fp8 import E4M3, Matrix, ScaledMatrix


def linear(
    x: Tensor, weight: Matrix, bias: Tensor | None = None, out: Tensor | None = None, *, tiles: TileTable = NO_TILES
) -> Tensor:
    if isinstance(weight, ScaledMatrix):
        return product(x, weight, bias=bias, out=out, tiles=tiles)
    if out is None:
        return F.linear(x, weight, bias)
    return torch.mm(x, weight.t(), out=out) if bias is None else torch.addmm(bias, x, weight.t(), out=out)


def residual_linear(x: Tensor, weight: Matrix, bias: Tensor | None = None, *, tiles: TileTable = NO_TILES) -> Tensor:
    """As `linear`; of a ScaledMatrix perhaps as parts [splits, tokens, out], which the norms add up."""
    if isinstance(weight, ScaledMatrix):
        return product(x, weight, "parts", bias, tiles=tiles)
    return F.linear(x, weight, bias)


def linear_gelu(
    x: Tensor,
    weight: Matrix,
    bias: Tensor,
    inverse: float | None = None,
    numbers: torch.dtype = E4M3,
    stream: Tensor | None = None,
    *,
    tiles: TileTable = NO_TILES,
) -> Tensor:
    if isinstance(weight, ScaledMatrix):
        return product(x, weight, "gelu", bias, inverse=inverse, numbers=numbers, stream=stream, tiles=tiles)
    result = torch._addmm_activation(bias, x, weight.t(), use_gelu=True)  # on CUDA: tanh's GELU, in the epilogue
    return as_input(result, x.dtype, inverse, numbers, stream)


def linear_geglu(
    x: Tensor,
    gate_up: Matrix,
    inverse: float | None = None,
    numbers: torch.dtype = E4M3,
    stream: Tensor | None = None,
    *,
    tiles: TileTable = NO_TILES,
) -> Tensor:
    """In bfloat16 with GeGLU in the epilogue of a tile that was measured to be faster, else behind cuBLAS."""
    shape = x.shape[0], gate_up.shape[0] // 2, x.shape[1]
    if isinstance(gate_up, ScaledMatrix) or tuned_tile(tiles, "bf16", "geglu", *shape) is not None:
        return product(x, gate_up, "geglu", inverse=inverse, numbers=numbers, stream=stream, tiles=tiles)
    return activations.geglu(F.linear(x, gate_up), inverse, numbers, stream)
