"""LayerNorm of many rows, for compute capability 9.0: see layer_norm.cu.

Twin: `residual_layer_norm` of `kernels.plain`.
"""

from typing import Any, Final

import torch
from torch import Tensor

from turbopi.kernels.ahead import MadeOnce
from turbopi.kernels.arguments import Parameter, Parameters
from turbopi.kernels.nvrtc import compile_cubin
from turbopi.kernels.portable import norms
from turbopi.kernels.sm90 import instructions
from turbopi.kernels.sm90.instructions import DependentKernel
from turbopi.quantization.fp8 import E4M3

# Vision's 512 rows have their norms in products, and of 256 a block for each row is as fast.
ROWS = 1024
WARPS: Final = 4  # of a block, each with a row
MOST_WIDTH: Final = 2048  # numbers of a row that a warp holds in registers, with their weights


def takes(x: Tensor, y: Tensor | None, weight: Tensor) -> bool:
    """Whether the norm of x + y is made by this kernel."""
    width = x.shape[1]
    alike = x.dtype == weight.dtype == torch.bfloat16 and (y is None or (y.dim() == 2 and y.dtype == x.dtype))
    return alike and x.shape[0] >= ROWS and width % 8 == 0 and width <= MOST_WIDTH


def residual_layer_norm(
    x: Tensor, y: Tensor | None, weight: Tensor, bias: Tensor, eps: float, inverse: float | None = None
) -> tuple[Tensor, Tensor]:
    """(x + y, its LayerNorm, with `inverse` in E4M3). What this kernel doesn't take is left to portable/norms.py."""
    if not takes(x, y, weight):
        return norms.residual_layer_norm(x, y, weight, bias, eps, inverse)
    assert all(one.is_contiguous() for one in (x, weight, bias)) and (y is None or y.is_contiguous())
    assert y is None or y.shape == x.shape, f"{x.shape} + {y.shape}"
    total = x if y is None else torch.empty_like(x)
    out = torch.empty_like(x, dtype=x.dtype if inverse is None else E4M3)
    tensors = {"x": x, "y": y, "sum": total, "weight": weight, "bias": bias, "out": out}
    given: dict[str, Any] = {name: None if one is None else one.data_ptr() for name, one in tensors.items()}
    given |= {"M": len(x), "eps": eps, "inverse": 1.0 if inverse is None else inverse}
    kernel = _kernel(x.shape[1], y is not None, inverse is not None, x.device)
    kernel.launch_dependent(-(-len(x) // WARPS), given)
    return total, out


def parameters(in_fp8: bool) -> Parameters:
    return Parameters(
        (
            Parameter("const uint4*", "x", "bf16 [M][WIDTH], as y, sum and out, which may be e4m3"),
            Parameter("const uint4*", "y"),
            Parameter("uint4*", "sum"),
            Parameter("const uint4*", "weight", "bf16 [WIDTH]"),
            Parameter("const uint4*", "bias"),
            Parameter("uint2*" if in_fp8 else "uint4*", "out"),
            Parameter("int", "M"),
            Parameter("float", "eps"),
            Parameter("float", "inverse"),
        )
    )


def constants(width: int, has_y: bool, in_fp8: bool) -> dict[str, int]:
    """What layer_norm.cu is compiled with."""
    return {"TP_WIDTH": width, "TP_HAS_Y": int(has_y), "TP_FP8": int(in_fp8), "TP_THREADS": 32 * WARPS}


def source(in_fp8: bool) -> str:
    generated = f"#define NORM_PARAMETERS {parameters(in_fp8).declarations}\n"
    return instructions.source("norms/layer_norm.cu", generated=generated)


@MadeOnce
def _kernel(width: int, has_y: bool, in_fp8: bool, device: torch.device) -> DependentKernel:
    with torch.cuda.device(device):
        cubin = compile_cubin(source(in_fp8), "sm_90a", constants(width, has_y, in_fp8))
        return DependentKernel(cubin, "layer_norm", parameters(in_fp8), shared_bytes=0, threads=32 * WARPS, cluster=1)
