"""GeGLU behind a product that hasn't it in its epilogue. Twin: `kernels.plain.geglu`."""

import torch
import triton
import triton.language as tl
from torch import Tensor

from turbopi.kernels.dependent_launch import dependent_launch, launch_dependents, result_dtype, wait_for_producer
from turbopi.kernels.portable.rounding import as_stored, damaged, marks
from turbopi.quantization.fp8 import E4M3


@triton.jit
def gelu_tanh(x):
    """0.5 x (1 + tanh(√(2/π) (x + 0.044715 x³))), written as x · sigmoid of twice the argument; x float32."""
    return x / (1 + tl.exp2(x * (-2.302208198 - 0.1029432397 * x * x)))  # 2 √(2/π) log2(e), times 0.044715


@triton.jit
def _geglu_kernel(
    gate_up, out, hidden, inverse, residual, stride,
    SCALED: tl.constexpr, MARKS: tl.constexpr, BLOCK: tl.constexpr, PDL: tl.constexpr,
):  # fmt: skip
    wait_for_producer(PDL)
    launch_dependents(PDL)
    row = tl.program_id(1).to(tl.int64)
    cols = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mask = cols < hidden
    gate = gelu_tanh(tl.load(gate_up + row * 2 * hidden + cols, mask, 0.0).to(tl.float32))
    up = tl.load(gate_up + (row * 2 + 1) * hidden + cols, mask, 0.0).to(tl.float32)
    result = gate * up
    if SCALED:
        result *= inverse
    tl.store(out + row * hidden + cols, as_stored(result, out), mask)
    if MARKS:
        tl.store(residual + row * stride, float("nan"), damaged(result, 0))


def geglu(
    gate_up: Tensor,
    inverse: float | None = None,
    numbers: torch.dtype = E4M3,
    stream: Tensor | None = None,
) -> Tensor:
    """[tokens, 2F], gate columns before up columns -> [tokens, F]; the product isn't rounded in between.

    With `inverse` the result leaves as `numbers`, E4M3 or int8: see `quantization.fp8`, and for `stream` [tokens, D]
    `kernels.plain`.
    """
    assert gate_up.is_contiguous(), "gate_up is read as it lies in memory"
    rows, hidden = gate_up.shape[0], gate_up.shape[1] // 2
    out = gate_up.new_empty(rows, hidden, dtype=result_dtype(gate_up, inverse, numbers))
    block = min(2048, triton.next_power_of_2(hidden))
    _geglu_kernel[(triton.cdiv(hidden, block), rows)](
        gate_up, out, hidden, inverse or 1.0, SCALED=inverse is not None, BLOCK=block, num_warps=max(1, block // 256),
        **marks(stream, out), **dependent_launch(gate_up),
    )  # fmt: skip
    return out
