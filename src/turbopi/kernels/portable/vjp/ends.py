"""The ends of a guided step of one observation, around the way back through the expert. Twins: `kernels.backward`.

All is float32; what enters a product of the way back has its operand's dtype.
"""

import torch
import triton
import triton.language as tl
from torch import Tensor

from turbopi.kernels.dependent_launch import dependent_launch, launch_dependents, wait_for_producer
from turbopi.kernels.portable.vjp.tiles import power_dividing, token_rows


@triton.jit
def _pull_kernel(
    x_t, v_t, times, target, weights, out, error, d_out, tokens, actions, width,
    ROWS: tl.constexpr, ACTIONS: tl.constexpr, COLUMNS: tl.constexpr, PDL: tl.constexpr,
):  # fmt: skip
    """All tokens, COLUMNS columns of the final norm's result; the first program keeps the error."""
    m, a = tl.arange(0, ROWS), tl.arange(0, ACTIONS)
    n = tl.program_id(0) * COLUMNS + tl.arange(0, COLUMNS)
    there, at = (m < tokens)[:, None] & (a < actions)[None, :], m[:, None] * actions + a[None, :]
    matrix = tl.load(out + (a[:, None] * width + n[None, :]), (a < actions)[:, None], 0.0)
    time, weight = tl.load(times + m, m < tokens, 0.0)[:, None], tl.load(weights + m, m < tokens, 0.0)[:, None]
    wanted, x = tl.load(target + at, there, 0.0), tl.load(x_t + at, there, 0.0)
    wait_for_producer(PDL)
    launch_dependents(PDL)
    missing = (wanted - (x - time * tl.load(v_t + at, there, 0.0))) * weight
    if tl.program_id(0) == 0:
        tl.store(error + at, missing, there)
    result = tl.dot(time * missing, matrix, input_precision="ieee")
    tl.store(d_out + (m[:, None] * width + n[None, :]), result.to(d_out.dtype.element_ty), (m < tokens)[:, None])


def pull(
    x_t: Tensor, v_t: Tensor, times: Tensor, target: Tensor, weights: Tensor, out: Tensor, dtype: torch.dtype
) -> tuple[Tensor, Tensor]:
    """See the twin."""
    _check(x_t, v_t, times, target, weights, out)
    (tokens, actions), width = x_t.shape, out.shape[1]
    error, d_out, columns = torch.empty_like(x_t), x_t.new_empty(tokens, width, dtype=dtype), power_dividing(width, 32)
    _pull_kernel[(width // columns,)](
        x_t, v_t, times, target, weights, out, error, d_out, tokens, actions, width,
        ROWS=token_rows(tokens), ACTIONS=max(16, triton.next_power_of_2(actions)), COLUMNS=columns, num_warps=4,
        **dependent_launch(x_t),
    )  # fmt: skip
    return error, d_out


@triton.jit
def _move_kernel(
    d_tokens, into, x_t, v_t, error, gain, steps, next_x, actions, width,
    ACTIONS: tl.constexpr, BLOCK: tl.constexpr, PDL: tl.constexpr,
):  # fmt: skip
    """One token. The matrix is a constant, and so are v_t and the error, which kernels long ago wrote."""
    row = tl.program_id(0)
    a, d = tl.arange(0, ACTIONS), tl.arange(0, BLOCK)
    there, at = a < actions, row * actions + a
    matrix = tl.load(into + (d[:, None] * actions + a[None, :]), (d < width)[:, None] & there[None, :], 0.0)
    v, missing, x = tl.load(v_t + at, there, 0.0), tl.load(error + at, there, 0.0), tl.load(x_t + at, there, 0.0)
    wait_for_producer(PDL)
    launch_dependents(PDL)
    back = tl.load(d_tokens + row * width + d, d < width, 0.0)
    v -= tl.load(gain + row) * (missing - tl.sum(back[:, None] * matrix, 0))
    tl.store(v_t + at, v, there)
    tl.store(next_x + at, x + tl.load(steps + row) * v, there)


def move(
    d_tokens: Tensor, into: Tensor, x_t: Tensor, v_t: Tensor, error: Tensor, gain: Tensor, steps: Tensor, next_x: Tensor
) -> None:
    """See the twin."""
    _check(d_tokens, into, x_t, v_t, error, gain, steps, next_x)
    width, actions = into.shape
    _move_kernel[(len(x_t),)](
        d_tokens, into, x_t, v_t, error, gain, steps, next_x, actions, width,
        ACTIONS=triton.next_power_of_2(actions), BLOCK=triton.next_power_of_2(width), num_warps=8,
        **dependent_launch(x_t),
    )  # fmt: skip


def _check(*tensors: Tensor) -> None:
    assert all(one.is_contiguous() and one.dtype == torch.float32 for one in tensors), [one.dtype for one in tensors]
