"""The kernel that resizes images: to the last bit what the CPU makes of them."""

from collections.abc import Sequence

import numpy as np
import pytest
import torch
from conftest import gpu_or_interpreter
from test_resize import SIDE, SIZES, camera_image

from turbopi.config import ImageResize
from turbopi.engine.resize import Resizer
from turbopi.preprocess.images import WAYS as ALL_WAYS
from turbopi.preprocess.images import fitted

pytest.importorskip("triton", reason="Triton isn't installed")

from turbopi.kernels.portable.resize import resize_images

ON_GPU = torch.cuda.is_available()
DEVICE = torch.device("cuda" if ON_GPU else "cpu")
pytestmark = gpu_or_interpreter()
side = SIDE if ON_GPU else 28  # the interpreter is slow


def resized(given: Sequence[np.ndarray | None], way: ImageResize) -> np.ndarray:
    """None: a camera whose image stays, which is 77 everywhere."""
    dtype = torch.float32 if ALL_WAYS[way].float_images else torch.uint8
    images = torch.full((len(given), side, side, 3), 77, dtype=dtype, device=DEVICE)
    resizer = Resizer(images)
    resizer.upload(given, way)
    resize_images(resizer.table, images)
    return images.cpu().numpy()


def check(found: np.ndarray, image: np.ndarray, way: ImageResize) -> None:
    if ALL_WAYS[way].float_images and not ON_GPU:  # the interpreter has no fused multiply-add
        np.testing.assert_allclose(found, fitted(image, side, way), rtol=0, atol=1e-6)
    else:
        np.testing.assert_array_equal(found, fitted(image, side, way))


@pytest.mark.slow
@pytest.mark.parametrize("way", ALL_WAYS)
@pytest.mark.parametrize("size", SIZES if ON_GPU else ((37, 53), (28, 80), (100, 61)))
def test_pictures_are_resized_as_on_a_cpu(size: tuple[int, int], way: ImageResize) -> None:
    image = camera_image(*size)
    check(resized([image], way)[0], image, way)


@pytest.mark.slow
@pytest.mark.parametrize("way", ["openpi", "lerobot"])
def test_cameras_of_different_sizes_and_layouts_come_each_to_its_place(way: ImageResize) -> None:
    turned = camera_image(40, 60).transpose(1, 0, 2)  # not in one piece
    given = [camera_image(60, 80), None, turned, camera_image(side, side)]
    for found, image in zip(resized(given, way), given, strict=True):
        if image is None:
            assert (found == 77).all()
        else:
            check(found, image, way)
