"""Residual addition and the norm behind it in one pass: one row a program.

Twins: `residual_rms_norm` and `residual_layer_norm` of `kernels.plain`. `y` may also be [splits, tokens, D], float32
or as x: the partial sums of a product split over its inner axis, added up here in float32. With `inverse` the norm
leaves as `numbers`, E4M3 or int8, rounded once from float32: see `quantization.fp8`. int8's damage is marked in the
residual stream.
"""

import torch
import triton
import triton.language as tl
from torch import Tensor

from turbopi.kernels.dependent_launch import dependent_launch, launch_dependents, result_dtype, wait_for_producer
from turbopi.kernels.portable.rounding import as_stored, damaged
from turbopi.quantization.fp8 import E4M3


@triton.jit
def _add_residual(x, y, gate, out, row, rows, cols, width, mask, SPLITS, HAS_GATE):
    """x + y * gate, stored and rounded as stored; y is one matrix or SPLITS partial sums; the gate is this row's."""
    dtype = out.dtype.element_ty
    a = tl.load(x + row * width + cols, mask, 0.0).to(tl.float32)
    if SPLITS == 0:
        b = tl.load(y + row * width + cols, mask, 0.0).to(tl.float32)
    else:
        b = tl.zeros_like(a)
        for split in tl.static_range(SPLITS):
            b += tl.load(y + (split * rows + row) * width + cols, mask, 0.0).to(tl.float32)
    if HAS_GATE:
        b = (b * tl.load(gate + cols, mask, 0.0).to(dtype).to(tl.float32)).to(dtype).to(tl.float32)
    total = (a + b).to(dtype)
    tl.store(out + row * width + cols, total, mask)
    return total.to(tl.float32)


@triton.jit
def _rms_norm_kernel(
    x, y, gate, scale, shift, out, normed, rows, width, eps, inverse,
    HAS_Y: tl.constexpr, SPLITS: tl.constexpr, HAS_GATE: tl.constexpr, HAS_SHIFT: tl.constexpr,
    BY_ROW: tl.constexpr, SCALED: tl.constexpr, BLOCK: tl.constexpr, PDL: tl.constexpr,
):  # fmt: skip
    row = tl.program_id(0)
    cols = tl.arange(0, BLOCK)
    mask = cols < width
    if BY_ROW:
        scale += row * width
        if HAS_SHIFT:
            shift += row * width
        if HAS_GATE:
            gate += row * width
    if BY_ROW:  # gathered by the kernel before, perhaps; one for all rows is a constant
        wait_for_producer(PDL)
    factor = tl.load(scale + cols, mask, 0.0)
    if not BY_ROW:
        wait_for_producer(PDL)
    launch_dependents(PDL)
    if HAS_Y:
        a = _add_residual(x, y, gate, out, row, rows, cols, width, mask, SPLITS, HAS_GATE)
    else:
        a = tl.load(x + row * width + cols, mask, 0.0).to(tl.float32)
    result = a * tl.rsqrt(tl.sum(a * a, 0) / width + eps) * factor
    if HAS_SHIFT:
        result += tl.load(shift + cols, mask, 0.0)
    if SCALED:
        result *= inverse
    tl.store(normed + row * width + cols, as_stored(result, normed), mask)
    if normed.dtype.element_ty == tl.int8:  # by the thread that has stored the row's first number
        tl.store(out + row * width + cols, float("nan"), (cols == 0) & damaged(result, 0))


@triton.jit
def _layer_norm_kernel(
    x, y, weight, bias, out, normed, rows, width, eps, inverse,
    HAS_Y: tl.constexpr, SPLITS: tl.constexpr, SCALED: tl.constexpr, BLOCK: tl.constexpr, PDL: tl.constexpr,
):  # fmt: skip
    row = tl.program_id(0)
    cols = tl.arange(0, BLOCK)
    mask = cols < width
    factor = tl.load(weight + cols, mask, 0.0).to(tl.float32)
    offset = tl.load(bias + cols, mask, 0.0).to(tl.float32)
    launch_dependents(PDL)
    wait_for_producer(PDL)
    if HAS_Y:
        a = _add_residual(x, y, x, out, row, rows, cols, width, mask, SPLITS, False)
    else:
        a = tl.load(x + row * width + cols, mask, 0.0).to(tl.float32)
    centred = tl.where(mask, a - tl.sum(a, 0) / width, 0.0)
    result = centred * tl.rsqrt(tl.sum(centred * centred, 0) / width + eps) * factor + offset
    if SCALED:
        result *= inverse
    tl.store(normed + row * width + cols, as_stored(result, normed), mask)
    if normed.dtype.element_ty == tl.int8:  # by the thread that has stored the row's first number
        tl.store(out + row * width + cols, float("nan"), (cols == 0) & damaged(result, 0))


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
    """(x + y * gate, its RMSNorm * scale + shift). x [tokens, D] contiguous; the others [D], or all [tokens, D]."""
    rows, width = _checked(x, y)
    assert all(one is None or (one.dim() == scale.dim() and one.is_contiguous()) for one in (gate, scale, shift))
    out, normed = (
        (x if y is None else torch.empty_like(x)),
        torch.empty_like(x, dtype=result_dtype(x, inverse, numbers)),
    )
    block = triton.next_power_of_2(width)
    warps = _warps(2 * block)  # twice LayerNorm's, for parts to add up
    _rms_norm_kernel[(rows,)](
        x, _or(y, x), _or(gate, scale), scale, _or(shift, scale), out, normed, rows, width, eps, inverse or 1.0,
        HAS_Y=y is not None, SPLITS=_splits(y), HAS_GATE=gate is not None,
        HAS_SHIFT=shift is not None, BY_ROW=scale.dim() == 2, SCALED=inverse is not None, BLOCK=block, num_warps=warps,
        **dependent_launch(x),
    )  # fmt: skip
    return out, normed


def residual_layer_norm(
    x: Tensor,
    y: Tensor | None,
    weight: Tensor,
    bias: Tensor,
    eps: float,
    inverse: float | None = None,
    numbers: torch.dtype = E4M3,
) -> tuple[Tensor, Tensor]:
    """(x + y, its LayerNorm). x [tokens, W] contiguous."""
    rows, width = _checked(x, y)
    out, normed = (
        (x if y is None else torch.empty_like(x)),
        torch.empty_like(x, dtype=result_dtype(x, inverse, numbers)),
    )
    block = triton.next_power_of_2(width)
    _layer_norm_kernel[(rows,)](
        x, _or(y, x), weight, bias, out, normed, rows, width, eps, inverse or 1.0,
        HAS_Y=y is not None, SPLITS=_splits(y), SCALED=inverse is not None, BLOCK=block, num_warps=_warps(block),
        **dependent_launch(x),
    )  # fmt: skip
    return out, normed


def _checked(x: Tensor, y: Tensor | None) -> tuple[int, int]:
    assert x.is_contiguous() and (y is None or y.is_contiguous()), "rows are read as they lie in memory"
    assert y is None or y.shape[-2:] == x.shape
    return x.shape[0], x.shape[1]


def _splits(y: Tensor | None) -> int:
    """0: y is one matrix."""
    return 0 if y is None or y.dim() == 2 else y.shape[0]


def _or(tensor: Tensor | None, unused: Tensor) -> Tensor:
    return unused if tensor is None else tensor


def _warps(block: int) -> int:
    return max(1, min(8, block // 512))
