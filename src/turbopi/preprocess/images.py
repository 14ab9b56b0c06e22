"""Images resized to what the vision tower reads.

Two ways, because a model must see images resized as they were in its training:

- openpi's: everything becomes uint8; Pillow's bilinear filter (which averages when it shrinks) on uint8; black padding.
- LeRobot's: float32 in [0, 1]; bilinear without averaging; black padding; then [-1, 1]. LeRobot 0.4 padded with -1
  before that, so with -3 after it.

Both keep the aspect ratio and centre the image; LeRobot's SmolVLA pads left and top alone, and clamps nothing. Sources:
openpi's `image_tools.py` and policies; LeRobot's `vla_utils.resize_with_pad_torch`, `PI05Policy._preprocess_images` and
`SmolVLAPolicy.prepare_images` (0.6.1).
"""

import math
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache, lru_cache

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from turbopi.config import ImageResize
from turbopi.support.errors import ObservationError
from turbopi.support.processors import usable_processors


@dataclass(frozen=True)
class _Way:
    """float_images: the model gets float32 in [-1, 1], else uint8. padding: around an image, as the model gets it.

    low, high  where a resized image in [0, 1] is clamped
    centred    else the image is at the bottom right
    """

    float_images: bool
    padding: int
    low: float = 0.0
    high: float = 1.0
    centred: bool = True


RESIZES: dict[ImageResize, _Way] = {
    "openpi": _Way(False, 0),
    "lerobot": _Way(True, -1),
    "lerobot_0.4": _Way(True, -3, low=-1.0),
}  # Pi0's
WAYS: dict[ImageResize, _Way] = RESIZES | {
    "lerobot_smolvla": _Way(True, -1, low=-math.inf, high=math.inf, centred=False),
}


def fitted(camera_image: np.ndarray, size: int, resize: ImageResize) -> np.ndarray:
    """Image (uint8|float32)[h, w, 3] as the model gets it, [size, size, 3]; the same array if it is that already.

    float32 is in [0, 1], and LeRobot's ways alone take it. Raises ObservationError if the image is too narrow.
    """
    way = WAYS[resize]
    if not way.float_images and camera_image.shape == (size, size, 3) and camera_image.flags.c_contiguous:
        return camera_image
    out: np.ndarray = np.empty((size, size, 3), np.float32 if way.float_images else np.uint8)
    if camera_image.shape != out.shape:
        out.fill(way.padding)  # which stays where the image doesn't reach
    if way.float_images:
        resize_unit_into(camera_image, out, way)
    else:
        resize_into(camera_image, out)
    return out


LARGE = 1 << 18  # bytes of an image; of smaller ones handing work to threads costs as much as it saves


def all_fitted(camera_images: Sequence[np.ndarray], size: int, resize: ImageResize) -> list[np.ndarray]:
    """`fitted` of each, the same bytes. In openpi's way large images are resized in threads of our own; LeRobot's way
    has PyTorch's.
    """
    large = max((one.size for one in camera_images), default=0) > LARGE
    if usable_processors() == 1 or len(camera_images) == 1 or WAYS[resize].float_images or not large:
        return [fitted(one, size, resize) for one in camera_images]
    for one in camera_images:
        placement(one.shape, (size, size, 3))  # refuses before anything starts
    return list(_threads().map(lambda one: fitted(one, size, resize), camera_images))


@cache
def _threads() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(usable_processors(), "turbopi-images")


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_threads.cache_clear)  # a child has no threads but the one that forked


def _resized(image: np.ndarray, width: int, height: int) -> np.ndarray:
    """uint8[h, w, 3] by Pillow, across and then down, as openpi's did: since 13.0 it takes tall images down first."""
    if not image.flags.c_contiguous:
        packed = np.empty(image.shape, np.uint8)
        copy_image(image, packed)
        image = packed
    made = Image.fromarray(image)
    for size in ((width, made.height), (width, height)):
        if made.size != size:
            made = made.resize(size, Image.Resampling.BILINEAR)
    return np.asarray(made)


def resize_with_pad(images: np.ndarray, height: int, width: int) -> np.ndarray:
    """uint8[*b, h, w, 3] to uint8[*b, height, width, 3], as openpi: aspect ratio kept, centred, padded with 0.

    Images that have the size already are returned as they are.
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
        copy_image(image, out)
        return
    rows, columns = placement(image.shape, out.shape)
    out[rows, columns] = _resized(image, columns.stop - columns.start, rows.stop - rows.start)


def copy_image(image: np.ndarray, out: np.ndarray) -> None:
    """Copy an image: by channel, which is four times faster than all at once where it is a transposed CHW one."""
    if image.flags.c_contiguous:
        out[:] = image
        return
    for channel in range(image.shape[-1]):
        out[..., channel] = image[..., channel]


def resize_unit_into(image: np.ndarray, out: np.ndarray, way: _Way = RESIZES["lerobot"]) -> None:
    """LeRobot's way: one image in [0, 1] into `out` float32[height, width, 3] in [-1, 1], which holds the padding.

    image   uint8[h, w, 3], divided by 255 first, or float32[h, w, 3] in [0, 1]
    """
    planes = np.empty((3, *image.shape[:2]), np.float32)  # by channel: torch's layout, and faster than a transpose
    for channel in range(3):
        if image.dtype == np.uint8:
            np.divide(image[..., channel], 255, out=planes[channel], dtype=np.float32)
        else:
            planes[channel] = image[..., channel]
    if image.shape != out.shape:
        rows, columns = placement(image.shape, out.shape, way.centred)
        out = out[rows, columns]
        tensor = torch.from_numpy(planes)[None]
        resized = torch.nn.functional.interpolate(tensor, size=out.shape[:2], mode="bilinear", align_corners=False)
        planes = resized[0].clamp_(way.low, way.high).numpy()
    for channel in range(3):
        out[..., channel] = planes[channel] * np.float32(2) - np.float32(1)


def fit_unit(images: Tensor, size: tuple[int, int], resize: ImageResize) -> Tensor:
    """LeRobot's ways on any device: float32[B, h, w, 3] in [0, 1] to float32[B, *size, 3] in [-1, 1]."""
    way = WAYS[resize]
    out = torch.full((len(images), *size, 3), float(way.padding), device=images.device)
    if out.shape == images.shape:
        return images * 2 - 1
    rows, columns = placement(tuple(images.shape[1:]), tuple(out.shape[1:]), way.centred)
    within = (rows.stop - rows.start, columns.stop - columns.start)
    planes = images.permute(0, 3, 1, 2)
    planes = torch.nn.functional.interpolate(planes, size=within, mode="bilinear", align_corners=False)
    out[:, rows, columns] = (planes.clamp(way.low, way.high) * 2 - 1).permute(0, 2, 3, 1)
    return out


@lru_cache(maxsize=16)  # the same few in every call
def placement(shape: tuple[int, ...], target: tuple[int, ...], centred: bool = True) -> tuple[slice, slice]:
    """Rows and columns of a `target`-sized frame that an image of `shape` fills, its aspect ratio kept.

    centred  else it is at the bottom right

    Raises ObservationError if nothing of it would be left.
    """
    ratio = max(shape[1] / target[1], shape[0] / target[0])
    h, w = int(shape[0] / ratio), int(shape[1] / ratio)
    if h < 1 or w < 1:
        raise ObservationError(
            f"an image of {shape[0]}x{shape[1]} pixels is too narrow: resized to {target[0]}x{target[1]} "
            f"with its aspect ratio kept, nothing of it is left"
        )
    top, left = target[0] - h, target[1] - w
    if centred:
        top, left = top // 2, left // 2
    return slice(top, top + h), slice(left, left + w)
