"""Cameras' images to the vision tower's size on the device, to the last bit as `preprocess.images` does it on a CPU.

Sources: Pillow's `Resample.c` (precompute_coeffs, normalize_coeffs_8bpc), PyTorch's `UpSampleKernel.cpp`.
"""

import math
from collections import OrderedDict
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from turbopi.config import ImageResize
from turbopi.engine.flat import Staged
from turbopi.kernels.interface import PILLOW_BITS, SOURCE, Taps
from turbopi.preprocess.images import WAYS, copy_image, placement

MOST_SIZES = 16  # of images whose weights are cached


class Resizer:
    """What `Ops.resize_images` needs of images of any size: their bytes on the device, and `table`."""

    def __init__(self, images: Tensor) -> None:
        self._images = images
        self._device = images.device
        self._sources = Staged({"table": ((len(images), len(SOURCE)), torch.int64)}, self._device)
        self._rows, self.table = self._sources.writable()["table"], self._sources.tensors["table"]
        self._staged: list[tuple[Tensor, Tensor] | None] = [None] * len(images)  # bytes on the host and on the device
        self._taps: OrderedDict[tuple[int, int, bool, bool], tuple[Taps, Taps, int, int]] = (
            OrderedDict()
        )  # see `_place`

    def upload(self, images: Sequence[np.ndarray | None], resize: ImageResize) -> None:
        """Send images uint8[h, w, 3], without waiting; None: `images` stays as it is. All may change afterwards.

        Raises ObservationError for an image that is too narrow.
        """
        rows = np.zeros_like(self._rows)
        for camera, image in enumerate(images):
            if image is not None:
                rows[camera] = self._send(camera, image, resize)
        if not np.array_equal(rows, self._rows):  # `_rows` is what `table` has: a call that fails above changes neither
            self._sources.writable()["table"][:] = rows
            self._sources.send()

    def _send(self, camera: int, image: np.ndarray, resize: ImageResize) -> tuple[int, ...]:
        """A row of the table."""
        way = WAYS[resize]
        low = 0 if way.low == -math.inf else int(way.low)  # of bytes nothing is below 0
        rows, columns, top, left = self._place(image.shape[0], image.shape[1], way.centred)
        host, device = self._stage(camera, image.size)
        copy_image(image, host.numpy().reshape(image.shape))
        device.copy_(host, non_blocking=True)
        taps = (columns.first, columns.weights, rows.first, rows.weights)
        sizes = (image.shape[1], image.shape[0], columns.weights.shape[1], rows.weights.shape[1])
        filled = (len(rows.first), len(columns.first))
        return device.data_ptr(), *(one.data_ptr() for one in taps), *sizes, top, left, *filled, low

    def _stage(self, camera: int, size: int) -> tuple[Tensor, Tensor]:
        staged = self._staged[camera]
        if staged is None or len(staged[0]) < size:
            host = torch.empty(size, dtype=torch.uint8, pin_memory=self._images.is_cuda)
            staged = self._staged[camera] = host, torch.empty(size, dtype=torch.uint8, device=self._device)
        host, device = staged
        return host[:size], device[:size]

    def _place(self, height: int, width: int, centred: bool) -> tuple[Taps, Taps, int, int]:
        """Taps of rows and columns, and where the image begins. Those used last are cached, at least a call's own."""
        key = (height, width, self._images.dtype == torch.uint8, centred)
        if key not in self._taps:
            rows, columns = placement((height, width, 3), tuple(self._images.shape[1:]), centred)
            made = taps_of(height, rows, key[2]), taps_of(width, columns, key[2])
            down, across = (Taps(one.first.to(self._device), one.weights.to(self._device)) for one in made)
            self._taps[key] = down, across, rows.start, columns.start
            if len(self._taps) > MOST_SIZES:
                self._taps.popitem(last=False)
        self._taps.move_to_end(key)
        return self._taps[key]


def taps_of(had: int, wanted: slice, pillow: bool) -> Taps:
    """Of an axis of `had` numbers that is to fill `wanted` ones; on the host."""
    first, weights = (pillow_taps if pillow else linear_taps)(had, wanted.stop - wanted.start)
    return Taps(torch.from_numpy(first), torch.from_numpy(weights))


def pillow_taps(had: int, wanted: int) -> tuple[np.ndarray, np.ndarray]:
    """Of an axis: int32[wanted] the first number that counts, int32[wanted, taps] weights in units of 2^-22.

    A triangle whose half is a number of the result wide, or one of the image if that is more.
    """
    scale = had / wanted
    support = max(scale, 1.0)
    centre = (np.arange(wanted) + 0.5) * scale
    first = np.maximum((centre - support + 0.5).astype(np.int64), 0)
    behind = np.minimum((centre + support + 0.5).astype(np.int64), had)
    taps = np.arange(int(np.ceil(support)) * 2 + 1)
    weights = np.maximum(1 - np.abs((taps + first[:, None] - centre[:, None] + 0.5) * (1 / support)), 0)
    weights[taps >= (behind - first)[:, None]] = 0
    weights /= weights.cumsum(1)[:, -1:]  # added up in Pillow's order
    return first.astype(np.int32), (weights * (1 << PILLOW_BITS) + 0.5).astype(np.int32)


def linear_taps(had: int, wanted: int) -> tuple[np.ndarray, np.ndarray]:
    """Of an axis: int32[wanted] the first of two neighbours, float32[wanted, 2] their weights."""
    scale = np.float32(had) / np.float32(wanted)
    middle = (np.arange(wanted, dtype=np.float32) + np.float32(0.5)).astype(np.float64)
    at = np.maximum((np.float64(scale) * middle - 0.5).astype(np.float32), 0)  # one fused multiply-add
    first = np.minimum(at.astype(np.int64), had - 1)
    second = np.clip(at - first.astype(np.float32), 0, 1).astype(np.float32)
    return first.astype(np.int32), np.stack((np.float32(1) - second, second), 1)
