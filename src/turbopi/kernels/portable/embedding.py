"""What the model is given, as it wants it.

Twins: `kernels.plain.patch_rows`, `kernels.plain.embed_patches`, `kernels.plain.embed_prompt`.
"""

import torch
import triton
import triton.language as tl
from torch import Tensor

from turbopi.kernels.dependent_launch import dependent_launch, launch_dependents, wait_for_producer


@triton.jit
def _patch_kernel(
    images, out, size, side, width, IS_UINT8: tl.constexpr, PATCH: tl.constexpr, BLOCK: tl.constexpr, PDL: tl.constexpr
):  # fmt: skip
    row = tl.program_id(0)
    patch_row, patch_col, image = row // side % side, row % side, row // (side * side)
    value = tl.arange(0, BLOCK)
    channel, y, x = value // (PATCH * PATCH), value // PATCH % PATCH, value % PATCH
    at = ((image * size + patch_row * PATCH + y) * size + patch_col * PATCH + x) * 3 + channel
    wait_for_producer(PDL)
    launch_dependents(PDL)
    colour = tl.load(images + at, value < width, 0).to(tl.float32)
    if IS_UINT8:
        colour = tl.div_rn(colour, 255.0) * 2 - 1
    tl.store(out + row * width + value, colour, value < width)


@triton.jit
def _odd_kernel(images, out, size, side, width, PATCH: tl.constexpr, BLOCK: tl.constexpr, PDL: tl.constexpr):
    row = tl.program_id(0)
    patch_row, patch_col, image = row // side % side, row % side, row // (side * side)
    value = tl.arange(0, BLOCK)
    channel, y, x = value // (PATCH * PATCH), value // PATCH % PATCH, value % PATCH
    at = ((image * size + patch_row * PATCH + y) * size + patch_col * PATCH + x) * 3 + channel
    wait_for_producer(PDL)
    launch_dependents(PDL)
    odd = (tl.load(images + at, value < width, 0).to(tl.float32) * 2 - 255).to(out.dtype.element_ty)
    tl.store(out + row * 2 * width + value, odd, value < width)
    tl.store(out + (row * 2 + 1) * width + value, odd, value < width)


@triton.jit
def _position_kernel(x, position, out, tokens, width, BLOCK: tl.constexpr, PDL: tl.constexpr):
    row = tl.program_id(0)
    cols = tl.arange(0, BLOCK)
    added = tl.load(position + row % tokens * width + cols, cols < width, 0.0)
    wait_for_producer(PDL)
    launch_dependents(PDL)
    total = tl.load(x + row * width + cols, cols < width, 0.0) + added
    tl.store(out + row * width + cols, total.to(out.dtype.element_ty), cols < width)


@triton.jit
def _embed_kernel(tokens, table, out, width, scale, BLOCK: tl.constexpr, PDL: tl.constexpr):
    row = tl.program_id(0)
    cols = tl.arange(0, BLOCK)
    wait_for_producer(PDL)
    launch_dependents(PDL)
    token = tl.load(tokens + row)
    x = tl.load(table + token * width + cols, cols < width, 0.0).to(tl.float32)
    tl.store(out + row * width + cols, (x * scale).to(out.dtype.element_ty), cols < width)


def patch_rows(images: Tensor, patch: int) -> Tensor:
    """Images (uint8|float32)[V, S, S, 3] -> their patches in [-1, 1], float32[V * tokens, 3 * patch * patch]."""
    assert images.is_contiguous(), "images are read as they lie in memory"
    n, size = images.shape[:2]
    side, width = size // patch, 3 * patch * patch
    out = torch.empty(n * side * side, width, device=images.device)
    _patch_kernel[(n * side * side,)](
        images, out, size, side, width,
        IS_UINT8=images.dtype == torch.uint8, PATCH=patch, BLOCK=triton.next_power_of_2(width), **dependent_launch(out),
    )  # fmt: skip
    return out


def odd_rows(images: Tensor, patch: int, dtype: torch.dtype = torch.bfloat16) -> Tensor:
    """255 times `patch_rows` of uint8 images, twice side by side: [V * tokens, 2 * 3 * patch * patch].

    These are the odd numbers 2 u - 255, which bfloat16 holds exactly.
    """
    assert images.is_contiguous() and images.dtype == torch.uint8
    n, size = images.shape[:2]
    side, width = size // patch, 3 * patch * patch
    out = torch.empty(n * side * side, 2 * width, device=images.device, dtype=dtype)
    _odd_kernel[(n * side * side,)](
        images, out, size, side, width, PATCH=patch, BLOCK=triton.next_power_of_2(width), **dependent_launch(out)
    )
    return out


def split_in_two(weight: Tensor) -> Tensor:
    """float32[W, K] / 255 as the sum of two bfloat16 matrices (16 bits of it), side by side: [W, 2K]."""
    weight = weight / 255
    upper = weight.bfloat16()
    return torch.cat((upper, (weight - upper.float()).bfloat16()), dim=1)


def add_position(x: Tensor, position: Tensor, dtype: torch.dtype) -> Tensor:
    """x float32[V * tokens, W] + position float32[tokens, W], in `dtype`."""
    assert x.is_contiguous() and position.is_contiguous()
    rows, width = x.shape
    out = torch.empty(rows, width, device=x.device, dtype=dtype)
    _position_kernel[(rows,)](
        x, position, out, position.shape[0], width, BLOCK=triton.next_power_of_2(width), **dependent_launch(x)
    )
    return out


def embed_prompt(tokens: Tensor, table: Tensor, out: Tensor) -> None:
    """Rows of `table` [vocab, D] times √D, rounded to its dtype, into `out` [P, D]. tokens int64[P]."""
    assert table.is_contiguous() and out.is_contiguous() and tokens.is_contiguous(), "rows are read as they lie"
    width = table.shape[1]
    _embed_kernel[(len(tokens),)](
        tokens, table, out, width, width**0.5, BLOCK=triton.next_power_of_2(width), **dependent_launch(out)
    )
