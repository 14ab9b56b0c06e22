"""Before the network: images as LeRobot brings them to the model's size, with their order and masks."""

from collections.abc import Mapping, Sequence

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from turbopi.support.errors import ObservationError


def images_of(
    observation: Mapping[str, NDArray[np.generic]],
    cameras: Sequence[str],
    size: Sequence[int] | None,
    empty_cameras: int,
) -> tuple[Tensor, Tensor]:
    """(float32[C, 3, h, w] in [-1, 1], mask bool[C]) of an observation's images (uint8|float32)[h, w, 3].

    The cameras that the observation has come first, in the config's order, so a missing one moves those behind it.
    Then `empty_cameras` of the missing ones, at most, as images of -1 under a mask; more are absent.
    size  [width, height], LeRobot's resize_imgs_with_padding; None: images stay as they are

    Raises ObservationError if the observation has none of them.
    """
    if not any(name in observation for name in cameras):
        raise ObservationError(f"the observation has none of the cameras {', '.join(cameras)}: at least one is needed")
    present = [resize_with_padding(observation[name], size) for name in cameras if name in observation]
    missing = min(len(cameras) - len(present), empty_cameras)
    absent = [torch.full_like(present[-1], -1.0)] * missing
    return torch.stack(present + absent), torch.tensor([True] * len(present) + [False] * missing)


def resize_with_padding(image: NDArray[np.generic], size: Sequence[int] | None) -> Tensor:
    """(uint8 [0, 255] | float32 [0, 1])[h, w, 3] -> float32[3, height, width] in [-1, 1].

    Bilinear without antialiasing; what is missing is black, left and top alone (LeRobot's resize_with_pad).
    """
    x = torch.from_numpy(np.ascontiguousarray(image)).permute(2, 0, 1)
    x = x.float() / 255 if x.dtype == torch.uint8 else x.float()
    if size is not None and (x.shape[2], x.shape[1]) != tuple(size):
        width, height = size
        ratio = max(x.shape[2] / width, x.shape[1] / height)
        shape = (int(x.shape[1] / ratio), int(x.shape[2] / ratio))
        x = F.interpolate(x[None], size=shape, mode="bilinear", align_corners=False)[0]
        x = F.pad(x, (max(0, width - shape[1]), 0, max(0, height - shape[0]), 0))
    return x * 2 - 1
