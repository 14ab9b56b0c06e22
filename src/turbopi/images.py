"""Pictures: from what a robot sends to what the vision tower reads.

Two ways, because a model must see pictures resized as they were in its training:

- openpi's: everything becomes uint8; Pillow's bilinear filter (which averages when it shrinks) on uint8; black padding.
- LeRobot's: float32 in [0, 1]; bilinear without averaging; black padding; then [-1, 1]. LeRobot 0.4 padded with -1
  before that, so with -3 after it.

Both keep the aspect ratio and centre the picture. Sources: openpi's `image_tools.py` and policies; LeRobot's
`vla_utils.resize_with_pad_torch` and `PI05Policy._preprocess_images` (0.6.1).
"""

import warnings
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from turbopi.errors import ObservationError
from turbopi.reading import open_file

PICTURE_FORMATS = ("PNG", "JPEG", "WEBP", "BMP", "PPM")  # of files: each is decoded by Pillow itself, in this process
MAX_PIXELS = 50_000_000  # of a picture in a file
_MODES = ("1", "L", "LA", "P", "PA", "RGB", "RGBA", "RGBX", "CMYK", "YCbCr")  # 8 bits a channel, or fewer


def read_picture(file: str | Path) -> np.ndarray:
    """The picture in a file, RGB uint8[h, w, 3]; transparency is dropped.

    Raises ObservationError for what is none of PICTURE_FORMATS (whatever its name; an EPS would be handed to
    Ghostscript), is damaged, has more than MAX_PIXELS, which is checked before anything is decoded, or has more than 8
    bits a channel, which Pillow would clip.
    """
    with open_file(file, ObservationError) as stream:
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # refused below
                image = Image.open(stream, formats=PICTURE_FORMATS)
            if image.width * image.height > MAX_PIXELS:
                raise ObservationError(
                    f"{file} has {image.width} x {image.height} pixels; at most {MAX_PIXELS} are read"
                )
            if image.mode not in _MODES:
                raise ObservationError(
                    f"{file} has pixels of mode {image.mode}; expected 8 bits a channel, such as RGB"
                )
            return np.array(image.convert("RGB"))
        except ObservationError:
            raise
        except Exception as reason:  # damage makes Pillow's decoders raise a dozen classes
            why = " ".join(str(reason).split())[:200].replace(repr(stream), "it")
            raise ObservationError(
                f"{file} is neither a readable picture nor .npy: {why}. Pictures are read as "
                + ", ".join(PICTURE_FORMATS)
            ) from reason


def parse_image(value: Any, name: str) -> np.ndarray:
    """One picture as openpi's LIBERO and DROID robots take it: uint8[h, w, 3].

    `value` is uint8 in [0, 255] or float in [0, 1], HWC or CHW; it counts as CHW when its first axis is 3.
    Raises ObservationError, naming `name`, for anything else.
    """
    image = check_image(value, name)
    if image.shape[0] == 3:
        image = image.transpose(1, 2, 0)
    return to_uint8(_check_rgb(image, name), name)


def parse_chw_image(value: Any, name: str) -> np.ndarray:
    """One picture that must be CHW, as openpi's ALOHA clients send it: uint8[h, w, 3]."""
    image = check_image(value, name)
    if image.shape[0] != 3:
        raise ObservationError(
            f"{name} has shape {image.shape}, but this robot's pictures are CHW: (3, height, width). "
            f"Send numpy.transpose(image, (2, 0, 1)) of an HWC picture"
        )
    return to_uint8(image.transpose(1, 2, 0), name)


def parse_unit_image(value: Any, name: str) -> np.ndarray:
    """One picture as LeRobot takes it: (uint8|float32)[h, w, 3], float32 in [0, 1]; CHW or HWC as `parse_image`."""
    image = check_image(value, name)
    if image.shape[0] == 3:
        image = image.transpose(1, 2, 0)
    image = _check_rgb(image, name)
    if image.dtype != np.uint8:
        _check_unit_range(image, name)
        image = image.astype(np.float32, copy=False)
    return image


def check_image(value: Any, name: str) -> np.ndarray:
    """`value` as a non-empty array with three axes, uint8 or float; raises ObservationError otherwise."""
    try:
        image = np.asarray(value)
    except Exception as error:
        raise ObservationError(f"{name} isn't a picture: {error}") from error
    if image.dtype != np.uint8 and image.dtype.kind != "f":
        raise ObservationError(f"{name} has dtype {image.dtype}; send uint8 in [0, 255] or float in [0, 1]")
    if image.ndim != 3:
        raise ObservationError(
            f"{name} has shape {image.shape}; send one picture, (height, width, 3) or (3, height, width), "
            f"without a batch axis"
        )
    if image.size == 0:
        raise ObservationError(f"{name} is empty: its shape is {image.shape}")
    return image


def check_hwc(value: Any, name: str) -> np.ndarray:
    """`check_image`, and the last axis is RGB's; raises ObservationError otherwise."""
    return _check_rgb(check_image(value, name), name)


def _check_rgb(image: np.ndarray, name: str) -> np.ndarray:
    if image.shape[-1] != 3:
        raise ObservationError(f"{name} has shape {image.shape}; one axis, the first or the last, must be RGB's 3")
    return image


def to_uint8(image: np.ndarray, name: str = "image") -> np.ndarray:
    """Float pictures in [0, 1] to uint8 by truncation of 255 * x, as openpi; uint8 passes."""
    if image.dtype == np.uint8:
        return image
    _check_unit_range(image, name)
    return np.asarray((255 * image).astype(np.uint8))


def _check_unit_range(image: np.ndarray, name: str) -> None:
    # The bounds are where truncation to uint8 would wrap around; NaN fails both comparisons.
    low, high = float(image.min()), float(image.max())
    if not (low > -1 / 255 and high < 256 / 255):
        raise ObservationError(
            f"{name} is a float picture with values from {low:g} to {high:g}; float pictures are in [0, 1]. "
            f"Send uint8 for [0, 255]"
        )


def resize_with_pad(images: np.ndarray, height: int, width: int) -> np.ndarray:
    """uint8[*b, h, w, 3] to uint8[*b, height, width, 3], as openpi: aspect ratio kept, centred, padded with 0.

    Pictures that have the size already are returned as they are.
    """
    if images.shape[-3:-1] == (height, width):
        return images
    flat = images.reshape(-1, *images.shape[-3:])
    resized = np.zeros((len(flat), height, width, images.shape[-1]), np.uint8)
    for image, out in zip(flat, resized, strict=True):
        resize_into(image, out)
    return resized.reshape(*images.shape[:-3], *resized.shape[1:])


def resize_into(image: np.ndarray, out: np.ndarray) -> None:
    """`resize_with_pad` of one uint8[h, w, 3] into `out` uint8[height, width, 3], which holds the padding's zeros."""
    if image.shape == out.shape:
        _copy(image, out)
        return
    rows, columns = _placement(image.shape, out.shape)
    if not image.flags.c_contiguous:
        packed = np.empty(image.shape, np.uint8)
        _copy(image, packed)
        image = packed
    size = (columns.stop - columns.start, rows.stop - rows.start)
    out[rows, columns] = np.asarray(Image.fromarray(image).resize(size, Image.Resampling.BILINEAR))


def _copy(image: np.ndarray, out: np.ndarray) -> None:
    """Copy by channel, which is four times faster than all at once where `image` is a transposed CHW picture."""
    if image.flags.c_contiguous:
        out[:] = image
        return
    for channel in range(image.shape[-1]):
        out[..., channel] = image[..., channel]


def resize_unit_into(image: np.ndarray, out: np.ndarray, *, low: float = 0.0) -> None:
    """LeRobot's way: one picture in [0, 1] into `out` float32[height, width, 3] in [-1, 1], which holds the padding.

    image   uint8[h, w, 3], divided by 255 first, or float32[h, w, 3] in [0, 1]
    low     what is below it becomes it where a picture is resized: 0, in LeRobot 0.4 -1
    """
    planes = np.empty((3, *image.shape[:2]), np.float32)  # by channel: torch's layout, and faster than a transpose
    for channel in range(3):
        if image.dtype == np.uint8:
            np.divide(image[..., channel], 255, out=planes[channel], dtype=np.float32)
        else:
            planes[channel] = image[..., channel]
    if image.shape != out.shape:
        rows, columns = _placement(image.shape, out.shape)
        out = out[rows, columns]
        tensor = torch.from_numpy(planes)[None]
        resized = torch.nn.functional.interpolate(tensor, size=out.shape[:2], mode="bilinear", align_corners=False)
        planes = resized[0].clamp_(low, 1.0).numpy()
    for channel in range(3):
        out[..., channel] = planes[channel] * np.float32(2) - np.float32(1)


def _placement(shape: tuple[int, ...], target: tuple[int, ...]) -> tuple[slice, slice]:
    """Rows and columns of a `target`-sized frame that a picture of `shape` fills, its aspect ratio kept."""
    ratio = max(shape[1] / target[1], shape[0] / target[0])
    h, w = int(shape[0] / ratio), int(shape[1] / ratio)
    if h < 1 or w < 1:
        raise ObservationError(
            f"a picture of {shape[0]}x{shape[1]} pixels is too narrow: resized to {target[0]}x{target[1]} "
            f"with its aspect ratio kept, nothing of it is left"
        )
    top, left = (target[0] - h) // 2, (target[1] - w) // 2
    return slice(top, top + h), slice(left, left + w)
