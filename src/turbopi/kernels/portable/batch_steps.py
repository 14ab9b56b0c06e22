"""Denoising of several observations, between the expert's products: the norm, and what leads from a step to the next.

Twins: `kernels.plain.residual_rms_norm`, `kernels.plain_batch.end_step`. Both load their constants, and let the next
kernel's blocks start and load theirs, before they wait for the kernel in front.
"""

from dataclasses import replace

import torch
import triton
import triton.language as tl
from torch import Tensor

from turbopi.kernels import plain_batch
from turbopi.kernels.dependent_launch import (
    dependent_launch,
    launch_dependents,
    prefetch,
    result_dtype,
    wait_for_producer,
)
from turbopi.kernels.interface import Ops, StepEnd
from turbopi.kernels.portable import norms
from turbopi.kernels.portable.norms import _add_residual
from turbopi.kernels.portable.rounding import as_stored
from turbopi.quantization.fp8 import E4M3

MOST_ROWS = 264  # of `end_step`'s kernel, two a multiprocessor of Hopper: each reads both projections whole
LINE = 32  # float32 numbers that memory hands over at once


@triton.jit
def _norm_kernel(
    x, y, gate, scale, shift, out, normed, rows, width, eps, inverse,
    HAS_Y: tl.constexpr, SPLITS: tl.constexpr, HAS_GATE: tl.constexpr, HAS_SHIFT: tl.constexpr, SCALED: tl.constexpr,
    BLOCK: tl.constexpr, LINES: tl.constexpr, PDL: tl.constexpr,
):  # fmt: skip
    """As the kernel of `norms.residual_rms_norm`; gate, scale and shift are those of all rows."""
    row = tl.program_id(0)
    cols = tl.arange(0, BLOCK)
    mask = cols < width
    factor = tl.load(scale + cols, mask, 0.0)
    offset = tl.load(shift + cols, mask & HAS_SHIFT, 0.0)
    if HAS_GATE:
        prefetch(gate + tl.minimum(tl.arange(0, LINES) * 32, width - 1), PDL)
    launch_dependents(PDL)
    wait_for_producer(PDL)
    if HAS_Y:
        a = _add_residual(x, y, gate, out, row, rows, cols, width, mask, SPLITS, HAS_GATE)
    else:
        a = tl.load(x + row * width + cols, mask, 0.0).to(tl.float32)
    result = a * tl.rsqrt(tl.sum(a * a, 0) / width + eps) * factor + offset
    if SCALED:
        result *= inverse
    tl.store(normed + row * width + cols, as_stored(result, normed), mask)


def residual_rms_norm(
    x: Tensor,
    y: Tensor | None,
    gate: Tensor | None,
    scale: Tensor,
    shift: Tensor | None,
    eps: float,
    inverse: float | None = None,
    numbers: torch.dtype = E4M3,
) -> tuple[Tensor, Tensor]:
    """As `norms.residual_rms_norm`. A gate, scale and shift [D] must have been written before the kernel in front of
    this one began.
    """
    if scale.dim() == 2:
        return norms.residual_rms_norm(x, y, gate, scale, shift, eps, inverse, numbers)
    _check(x, y, gate, scale, shift)
    rows, width = x.shape
    out = x if y is None else torch.empty_like(x)
    normed = torch.empty_like(x, dtype=result_dtype(x, inverse, numbers))
    block = triton.next_power_of_2(width)
    _norm_kernel[(rows,)](
        x, x if y is None else y, scale if gate is None else gate, scale, scale if shift is None else shift, out,
        normed, rows, width, eps, inverse or 1.0, HAS_Y=y is not None, SPLITS=_splits(y), HAS_GATE=gate is not None,
        HAS_SHIFT=shift is not None, SCALED=inverse is not None, BLOCK=block, LINES=triton.cdiv(block, LINE),
        num_warps=norms._warps(2 * block), **dependent_launch(x),
    )  # fmt: skip
    return out, normed


@triton.jit
def _step_kernel(
    x, y, gate, scale, shift, out_weight, out_bias, in_weight, in_bias, x_t, x_next, v_t, tokens,
    rows, width, actions, eps, step,
    SPLITS: tl.constexpr, HAS_GATE: tl.constexpr, BLOCK: tl.constexpr, ACTIONS: tl.constexpr, SHARE: tl.constexpr,
    PDL: tl.constexpr,
):  # fmt: skip
    """One row. SHARE: lines of `in_weight` that this program has brought into the L2 cache."""
    row = tl.program_id(0).to(tl.int64)
    cols, a = tl.arange(0, BLOCK), tl.arange(0, ACTIONS)
    mask, used = cols < width, a < actions
    both = used[:, None] & mask[None, :]
    factor, offset = tl.load(scale + cols, mask, 0.0), tl.load(shift + cols, mask, 0.0)
    projection = tl.load(out_weight + (a[:, None] * width + cols[None, :]), both, 0.0)
    v = tl.load(out_bias + a, used, 0.0)
    line = tl.program_id(0) * SHARE + tl.arange(0, SHARE)
    prefetch(in_weight + tl.minimum(line * 32, width * actions - 1), PDL)
    launch_dependents(PDL)
    wait_for_producer(PDL)
    total = _add_residual(x, y, gate, x, row, rows, cols, width, mask, SPLITS, HAS_GATE)
    normed = total * tl.rsqrt(tl.sum(total * total, 0) / width + eps) * factor + offset
    dtype = tokens.dtype.element_ty
    v += tl.sum(projection * normed.to(dtype).to(tl.float32)[None, :], 1)
    moved = tl.load(x_t + row * actions + a, used, 0.0) + step * v
    tl.store(v_t + row * actions + a, v, used)
    tl.store(x_next + row * actions + a, moved, used)
    back = tl.load(in_weight + (cols[:, None] * actions + a[None, :]), mask[:, None] & used[None, :], 0.0)
    token = tl.load(in_bias + cols, mask, 0.0) + tl.sum(back * moved[None, :], 1)
    tl.store(tokens + row * width + cols, token.to(dtype), mask)


def end_step(
    x: Tensor,
    y: Tensor,
    gate: Tensor | None,
    end: StepEnd,
    x_t: Tensor,
    x_next: Tensor,
    v_t: Tensor,
) -> Tensor:
    """See `kernels.plain_batch.end_step`. All contiguous. The gate and what `end` has must have been written before the
    kernel in front of this one began.
    """
    if len(x) > MOST_ROWS:
        if y.dim() == 3:
            y = y.float().sum(0)
        return plain_batch.end_step(x, y.to(x.dtype), gate, end, x_t, x_next, v_t)
    _check(x, y, gate, end.scale, end.shift)
    weights = (*end.out, *end.into)
    assert all(one.is_contiguous() for one in (*weights, x_t, x_next, v_t)), "rows are read as they lie in memory"
    (rows, width), actions = x.shape, x_t.shape[1]
    tokens = torch.empty_like(x)
    lines = triton.cdiv(width * actions, LINE * rows)
    _step_kernel[(rows,)](
        x, y, end.scale if gate is None else gate, end.scale, end.shift, *weights, x_t, x_next, v_t, tokens,
        rows, width, actions, end.eps, end.step, SPLITS=_splits(y), HAS_GATE=gate is not None,
        BLOCK=triton.next_power_of_2(width), ACTIONS=triton.next_power_of_2(actions),
        SHARE=triton.next_power_of_2(lines), num_warps=16, **dependent_launch(x),
    )  # fmt: skip
    return tokens


def expert(ops: Ops) -> Ops:
    """The expert's operations on a batch's tokens, of any `ops`."""
    return replace(ops, residual_rms_norm=residual_rms_norm)


def _splits(y: Tensor | None) -> int:
    """0: y is one matrix."""
    return 0 if y is None or y.dim() == 2 else len(y)


def _check(x: Tensor, y: Tensor | None, gate: Tensor | None, scale: Tensor, shift: Tensor | None) -> None:
    given = (x, y, gate, scale, shift)
    assert all(one is None or one.is_contiguous() for one in given), "rows are read as they lie in memory"
    assert y is None or y.shape[-2:] == x.shape
    assert all(one is None or one.shape == x.shape[1:] for one in (gate, scale, shift)), "one for all rows"
