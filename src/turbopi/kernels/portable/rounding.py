"""Numbers to eight bits: what kernels store, the damage that int8 can't hold, and weights with error feedback.

Twin of the last: `quantization.rounding.columns_with_feedback`.
"""

from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor

from turbopi.quantization.fp8 import E4M3

ROWS = 16  # of a program, one warp: a row's columns depend on each other, so rows are all there is to share


@triton.jit
def _to_e4m3(x):
    """float32 as E4M3 holds it: by hand, as Triton's interpreter rounds differently."""
    damaged = x != x
    x = tl.clamp(x, -448.0, 448.0)
    bits = x.to(tl.int32, bitcast=True)
    normal = ((bits + 0x7FFFF + ((bits >> 20) & 1)) & -0x100000).to(tl.float32, bitcast=True)  # to nearest even
    small = (x + 24576.0) - 24576.0  # in steps of 2^-9
    return tl.where(damaged, float("nan"), tl.where(tl.abs(x) < 0.015625, small, normal))


@triton.jit
def _e4m3_byte(x, rounded):
    """The byte of `rounded`, which is `_to_e4m3` of x, with the sign of x. Whole numbers alone: below compute
    capability 8.9 Triton hasn't the type.
    """
    size = tl.abs(rounded)
    normal = (size.to(tl.int32, bitcast=True) >> 20) - (120 << 3)  # exponents begin at 2^-7, with three bits behind
    byte = tl.where(size < 0.015625, (size * 512.0).to(tl.int32), normal)
    sign = (x.to(tl.int32, bitcast=True) >> 24) & 0x80
    return (tl.where(x != x, 0x7F, byte) | sign).to(tl.uint8)


@triton.jit
def _to_int8(x):
    """float32 as int8 holds it: to nearest even, saturated, 0 for NaN."""
    x = tl.clamp(tl.where(x == x, x, 0.0), -127.0, 127.0)
    return (x + 12582912.0) - 12582912.0  # 1.5 * 2^23: no fraction has room beside it


@triton.jit
def as_stored(x, out):
    """float32 x as what `out` points to: of int8 as `quantization.int8` rounds, else as Triton does."""
    if out.dtype.element_ty == tl.int8:
        x = _to_int8(x)
    return x.to(out.dtype.element_ty)


@triton.jit
def damaged(x, AXIS: tl.constexpr):
    """Along this axis of float32 x, where something isn't finite: what int8 can't hold, see `quantization.int8`."""
    return tl.max(tl.where(tl.abs(x) < float("inf"), 0, 1), AXIS) != 0  # NaN is below nothing


@triton.jit
def _feedback_kernel(
    weight, inverse, order, errors, answers, out, rows, columns,
    NUM: tl.constexpr, R: tl.constexpr, ROWS: tl.constexpr,
):  # fmt: skip
    row = tl.program_id(0).to(tl.int64) * ROWS + tl.arange(0, ROWS)
    valid, direction = row < rows, tl.arange(0, R)
    by = tl.load(inverse + row, valid, 1.0)
    scale = tl.div_rn(1.0, by)
    left = tl.zeros((ROWS, R), tl.float32)
    at = tl.load(order)
    exact = tl.load(weight + row * columns + at, valid, 0.0).to(tl.float32)
    for column in range(columns):
        following = tl.load(order + tl.minimum(column + 1, columns - 1))  # asked for before it is needed
        next_exact = tl.load(weight + row * columns + following, valid, 0.0).to(tl.float32)
        error = tl.load(errors + column * NUM + direction, direction < NUM, 0.0)
        answer = tl.load(answers + column * NUM + direction, direction < NUM, 0.0)
        wanted = exact - tl.sum(left * answer[None, :], 1)
        if out.dtype.element_ty == tl.int8:
            rounded = _to_int8(wanted * by)
            stored = rounded.to(tl.int8)
        else:  # bytes of E4M3
            rounded = _to_e4m3(wanted * by)
            stored = _e4m3_byte(wanted * by, rounded)
        left += (rounded * scale - exact)[:, None] * error[None, :]
        tl.store(out + row * columns + at, stored, valid)
        at, exact = following, next_exact


def marks(stream: Tensor | None, unused: Tensor) -> dict[str, Any]:
    """Arguments of a kernel that marks int8's damage in `stream` [tokens, width]; None: it doesn't.

    Triton takes no argument named "stream" itself.
    """
    given = unused if stream is None else stream
    return {"residual": given, "stride": given.stride(0), "MARKS": stream is not None}


def round_with_feedback(
    weight: Tensor,
    inverse: Tensor,
    order: Tensor,
    errors: Tensor,
    answers: Tensor,
    numbers: torch.dtype = E4M3,
) -> Tensor:
    """Weight [out, in] -> e4m3 or int8[out, in] of weight * inverse. `order`, `errors`, `answers`: of
    `quantization.rounding.feedback`.
    """
    weight = weight.contiguous()
    rows, columns = weight.shape
    num = errors.shape[1]
    assert order.shape == (columns,) and errors.shape == answers.shape == (columns, num)
    assert errors.is_contiguous() and answers.is_contiguous() and inverse.is_contiguous()
    assert inverse.shape == (rows,)
    out = torch.empty(rows, columns, dtype=numbers, device=weight.device)
    stored = out.view(torch.uint8) if numbers == E4M3 else out  # which every GPU has
    _feedback_kernel[(triton.cdiv(rows, ROWS),)](
        weight, inverse, order, errors, answers, stored, rows, columns,
        NUM=num, R=triton.next_power_of_2(num), ROWS=ROWS, num_warps=1,
    )  # fmt: skip
    return out
