"""Matrix products by the library, with what its epilogues can do."""

import torch
import torch.nn.functional as F
from torch import Tensor

from turbopi.kernels.portable import activations


def linear(x: Tensor, weight: Tensor, bias: Tensor | None = None, out: Tensor | None = None) -> Tensor:
    if out is None:
        return F.linear(x, weight, bias)
    return torch.mm(x, weight.t(), out=out) if bias is None else torch.addmm(bias, x, weight.t(), out=out)


def linear_gelu(x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    return torch._addmm_activation(bias, x, weight.t(), use_gelu=True)  # on CUDA: tanh's GELU, in the epilogue


def linear_geglu(x: Tensor, gate_up: Tensor) -> Tensor:
    return activations.geglu(F.linear(x, gate_up))
