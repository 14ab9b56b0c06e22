"""Matrix products: a `ScaledMatrix`'s in Triton, bfloat16's by the library, with what its epilogues can do.

Twins: `kernels.plain`.
"""

import torch
import torch.nn.functional as F
from torch import Tensor

from turbopi.kernels.plain import as_input
from turbopi.kernels.portable import activations
from turbopi.kernels.portable.gemm.kernel import product
from turbopi.quantization.fp8 import E4M3, Matrix, ScaledMatrix

# Whether the bfloat16 product of GeGLU is Triton's, with GeGLU in its epilogue, or cuBLAS's with a kernel behind it.
# Set by what `python -m product_tiles` measures.
BF16_GEGLU_IN_EPILOGUE = False


def linear(x: Tensor, weight: Matrix, bias: Tensor | None = None, out: Tensor | None = None) -> Tensor:
    if isinstance(weight, ScaledMatrix):
        return product(x, weight, bias=bias, out=out)
    if out is None:
        return F.linear(x, weight, bias)
    return torch.mm(x, weight.t(), out=out) if bias is None else torch.addmm(bias, x, weight.t(), out=out)


def residual_linear(x: Tensor, weight: Matrix, bias: Tensor | None = None) -> Tensor:
    """As `linear`; of a ScaledMatrix perhaps as parts [splits, tokens, out], which the norms add up."""
    return product(x, weight, "parts", bias) if isinstance(weight, ScaledMatrix) else F.linear(x, weight, bias)


def linear_gelu(
    x: Tensor, weight: Matrix, bias: Tensor, inverse: float | None = None, numbers: torch.dtype = E4M3
) -> Tensor:
    if isinstance(weight, ScaledMatrix):
        return product(x, weight, "gelu", bias, inverse=inverse, numbers=numbers)
    result = torch._addmm_activation(bias, x, weight.t(), use_gelu=True)  # on CUDA: tanh's GELU, in the epilogue
    return as_input(result, x.dtype, inverse, numbers)


def linear_geglu(x: Tensor, gate_up: Matrix, inverse: float | None = None, numbers: torch.dtype = E4M3) -> Tensor:
    if isinstance(gate_up, ScaledMatrix) or BF16_GEGLU_IN_EPILOGUE:
        return product(x, gate_up, "geglu", inverse=inverse, numbers=numbers)
    return activations.geglu(F.linear(x, gate_up), inverse, numbers)
