"""Cameras' images to the vision tower's size. Reference: `kernels.plain.resize_image`, which says what is computed."""

import torch
import triton
import triton.language as tl
from torch import Tensor

from turbopi.kernels.interface import PILLOW_BITS, SOURCE

BLOCK = 256


@triton.jit
def _inside(at, side, top, left, rows, columns):
    """Row and column in the resized image, colour, and whether the image is there."""
    colour, x, y = at % 3, at // 3 % side - left, at // (3 * side) - top
    return y, x, colour, (y >= 0) & (y < rows) & (x >= 0) & (x < columns)


@triton.jit
def _pillow(
    at, side, image, x_first, x_weights, y_first, y_weights,
    width, height, x_taps, y_taps, top, left, rows, columns, BITS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    y, x, colour, here = _inside(at, side, top, left, rows, columns)
    x_from, y_from = tl.load(x_first + x, here, 0), tl.load(y_first + y, here, 0)
    half = 1 << (BITS - 1)
    total = tl.full((BLOCK,), half, tl.int32)
    for j in range(y_taps):
        row = tl.minimum(y_from + j, height - 1) * width  # taps beyond the image weigh 0
        across = tl.full((BLOCK,), half, tl.int32)
        for i in range(x_taps):
            weight = tl.load(x_weights + x * x_taps + i, here, 0)
            across += tl.load(image + (row + tl.minimum(x_from + i, width - 1)) * 3 + colour, here, 0) * weight
        total += tl.minimum(tl.maximum(across >> BITS, 0), 255) * tl.load(y_weights + y * y_taps + j, here, 0)
    return tl.where(here, tl.minimum(tl.maximum(total >> BITS, 0), 255), 0)


@triton.jit
def _pair(image, row, x0, x1, left_weight, right_weight, colour, here):
    left = tl.div_rn(tl.load(image + (row + x0) * 3 + colour, here, 0).to(tl.float32), 255.0)
    right = tl.div_rn(tl.load(image + (row + x1) * 3 + colour, here, 0).to(tl.float32), 255.0)
    return tl.fma(left, left_weight, right * right_weight)


@triton.jit
def _linear(
    at, side, image, x_first, x_weights, y_first, y_weights, width, height, top, left, rows, columns, low
):  # fmt: skip
    y, x, colour, here = _inside(at, side, top, left, rows, columns)
    x0, y0 = tl.load(x_first + x, here, 0), tl.load(y_first + y, here, 0)
    x1, y1 = tl.minimum(x0 + 1, width - 1), tl.minimum(y0 + 1, height - 1)
    left_weight, right_weight = tl.load(x_weights + 2 * x, here, 0), tl.load(x_weights + 2 * x + 1, here, 0)
    upper = _pair(image, y0 * width, x0, x1, left_weight, right_weight, colour, here)
    lower = _pair(image, y1 * width, x0, x1, left_weight, right_weight, colour, here)
    value = tl.fma(upper, tl.load(y_weights + 2 * y, here, 0), lower * tl.load(y_weights + 2 * y + 1, here, 0))
    return tl.where(here, tl.minimum(tl.maximum(value, low), 1.0), low) * 2 - 1


@triton.jit
def _resize_kernel(
    table, out, side, PILLOW: tl.constexpr, BITS: tl.constexpr, FIELDS: tl.constexpr, BLOCK: tl.constexpr
):
    camera = tl.program_id(1)
    source = table + camera * FIELDS
    image = tl.load(source).to(tl.pointer_type(tl.uint8))
    x_first = tl.load(source + 1).to(tl.pointer_type(tl.int32))
    y_first = tl.load(source + 3).to(tl.pointer_type(tl.int32))
    width, height = tl.load(source + 5).to(tl.int32), tl.load(source + 6).to(tl.int32)
    top, left = tl.load(source + 9).to(tl.int32), tl.load(source + 10).to(tl.int32)
    rows, columns = tl.load(source + 11).to(tl.int32), tl.load(source + 12).to(tl.int32)
    at = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    if rows > 0:
        if PILLOW:
            x_weights = tl.load(source + 2).to(tl.pointer_type(tl.int32))
            y_weights = tl.load(source + 4).to(tl.pointer_type(tl.int32))
            x_taps, y_taps = tl.load(source + 7).to(tl.int32), tl.load(source + 8).to(tl.int32)
            value = _pillow(
                at, side, image, x_first, x_weights, y_first, y_weights,
                width, height, x_taps, y_taps, top, left, rows, columns, BITS, BLOCK,
            )  # fmt: skip
        else:
            x_weights = tl.load(source + 2).to(tl.pointer_type(tl.float32))
            y_weights = tl.load(source + 4).to(tl.pointer_type(tl.float32))
            low = tl.load(source + 13).to(tl.float32)
            value = _linear(
                at, side, image, x_first, x_weights, y_first, y_weights, width, height, top, left, rows, columns, low
            )
        numbers = side * side * 3
        tl.store(out + camera * numbers + at, value.to(out.dtype.element_ty), at < numbers)


def resize_images(table: Tensor, images: Tensor) -> None:
    """Images of which `table` int64[V, SOURCE] tells into `images` (uint8|float32)[V, S, S, 3]."""
    cameras, side = images.shape[:2]
    grid = (triton.cdiv(side * side * 3, BLOCK), cameras)
    pillow = images.dtype == torch.uint8
    _resize_kernel[grid](table, images, side, PILLOW=pillow, BITS=PILLOW_BITS, FIELDS=len(SOURCE), BLOCK=BLOCK)
