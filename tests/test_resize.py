"""Images resized by a backend: to the last bit what `preprocess.images.fitted` makes of them on a CPU."""

import ctypes
import dataclasses
from typing import Any

import numpy as np
import pytest
import torch
from policy_helpers import policy_on
from test_begin import OnCpu

from turbopi.checkpoint import random_checkpoint
from turbopi.config import ImageResize
from turbopi.engine.resize import MOST_SIZES, Resizer, taps_of
from turbopi.kernels import plain
from turbopi.kernels.interface import SOURCE, Ops
from turbopi.policy.policy import UnifiedPolicy
from turbopi.preprocess.images import RESIZES, fitted, placement
from turbopi.support.errors import ObservationError

pytestmark = pytest.mark.usefixtures("two_threads")
SIDE = 224  # PyTorch sums in another order where a result's height and width are 128 together, or less
# (height, width): cameras' own, larger and smaller, odd, square, narrow, one axis kept, already of the size
SIZES = (
    *((480, 640), (720, 1280), (1080, 1920), (640, 480), (240, 320), (37, 53), (53, 37), (300, 300), (1, 40)),
    *((SIDE, 300), (300, SIDE), (SIDE, SIDE), (SIDE - 1, SIDE), (3, 2), (SIDE * 2, SIDE * 2)),
)
WAYS = tuple(RESIZES)


def camera_image(height: int, width: int, seed: int = 0) -> np.ndarray:
    """With black and white in it, where rounding ends."""
    values = np.random.default_rng(seed).integers(-64, 320, (height, width, 3))
    return values.clip(0, 255).astype(np.uint8)


def plainly(image: np.ndarray, way: ImageResize, side: int = SIDE) -> np.ndarray:
    """By the kernel's twin."""
    floats = RESIZES[way].float_images
    out = torch.full((side, side, 3), 77, dtype=torch.float32 if floats else torch.uint8)
    rows, columns = placement(image.shape, (side, side))
    taps = taps_of(image.shape[0], rows, not floats), taps_of(image.shape[1], columns, not floats)
    plain.resize_image(torch.from_numpy(image), out, *taps, rows.start, columns.start, RESIZES[way].low)
    return out.numpy()


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("size", SIZES)
def test_the_plain_operation_equals_pillow_and_lerobot_to_the_last_bit(size: tuple[int, int], way: ImageResize) -> None:
    image = camera_image(*size)
    found = plainly(image, way)
    assert found.dtype == fitted(image, SIDE, way).dtype
    np.testing.assert_array_equal(found, fitted(image, SIDE, way))


def test_bytes_and_weights_of_every_camera_are_where_the_table_says() -> None:
    resizer = Resizer(torch.zeros((3, 28, 28, 3), dtype=torch.uint8))
    turned = camera_image(90, 160).transpose(1, 0, 2)  # not in one piece
    frozen = camera_image(30, 20)
    frozen.flags.writeable = False  # as messages are
    resizer.upload([turned, None, frozen], "openpi")
    first, nothing, last = (dict(zip(SOURCE, row, strict=True)) for row in resizer.table.tolist())
    assert set(nothing.values()) == {0}
    for row, image in ((first, turned), (last, frozen)):
        assert (row["height"], row["width"]) == image.shape[:2]
        np.testing.assert_array_equal(at(row["image"], ctypes.c_uint8, image.size).reshape(image.shape), image)
        rows, columns = placement(image.shape, (28, 28))
        assert (row["top"], row["left"]) == (rows.start, columns.start)
        assert (row["rows"], row["columns"]) == (rows.stop - rows.start, columns.stop - columns.start)
        for axis, had, wanted in (("x", row["width"], columns), ("y", row["height"], rows)):
            taps = taps_of(had, wanted, True)
            assert row[f"{axis}_taps"] == taps.weights.shape[1]
            weights = at(row[f"{axis}_weights"], ctypes.c_int32, taps.weights.numel())
            np.testing.assert_array_equal(weights, taps.weights.flatten())
            np.testing.assert_array_equal(at(row[f"{axis}_first"], ctypes.c_int32, len(taps.first)), taps.first)


class Full(Resizer):
    """Pinned memory holds no image of more than `room` bytes."""

    room = 1 << 30

    def _stage(self, camera: int, size: int) -> tuple[torch.Tensor, torch.Tensor]:
        if size > self.room:
            raise torch.cuda.OutOfMemoryError("pinned memory")
        return super()._stage(camera, size)


@pytest.mark.parametrize(
    ("second", "error"), [(camera_image(90, 160), torch.cuda.OutOfMemoryError), (camera_image(1, 90), ObservationError)]
)
def test_a_call_that_fails_at_its_second_camera_hides_nothing_from_the_next(
    second: np.ndarray, error: type[Exception]
) -> None:
    resizer = Full(torch.zeros((2, 28, 28, 3), dtype=torch.uint8))
    first, changed = [camera_image(40, 30), camera_image(30, 20)], camera_image(30, 40)
    resizer.upload(first, "openpi")
    resizer.room = changed.size
    with pytest.raises(error):
        resizer.upload([changed, second], "openpi")
    resizer.upload([changed, first[1]], "openpi")
    for row, image in zip(resizer.table.tolist(), (changed, first[1]), strict=True):
        source = dict(zip(SOURCE, row, strict=True))
        assert (source["height"], source["width"]) == image.shape[:2]
        np.testing.assert_array_equal(at(source["image"], ctypes.c_uint8, image.size).reshape(image.shape), image)


def at(address: int, kind: Any, count: int) -> np.ndarray:
    return np.ctypeslib.as_array((kind * count).from_address(address))


def test_few_sizes_are_kept_and_those_of_the_last_call_among_them() -> None:
    resizer = Resizer(torch.zeros((4, 28, 28, 3), dtype=torch.uint8))
    for size in range(60, 60 + 2 * MOST_SIZES):
        sizes = [60, size, size + 1, size + 2]
        resizer.upload([camera_image(side, side) for side in sizes], "openpi")
        assert len(resizer._taps) <= MOST_SIZES
        assert {(side, side, True, True) for side in sizes} <= set(resizer._taps)


@pytest.fixture(scope="module")
def reference() -> UnifiedPolicy:
    return UnifiedPolicy(
        random_checkpoint("pi05_tiny"), backend="pytorch", device="cpu", precision="f32", robot="plain"
    )


@pytest.fixture(scope="module")
def policy(reference: UnifiedPolicy) -> UnifiedPolicy:
    return policy_on(OnCpu, random_checkpoint("pi05_tiny"), robot="plain")


class Resizing(OnCpu):
    """With an operation that does on the host what the kernel does."""

    def _make_ops(self) -> Ops:
        return dataclasses.replace(super()._make_ops(), resize_images=resize_by_table)


def resize_by_table(table: torch.Tensor, images: torch.Tensor) -> None:
    for row, out in zip(table.tolist(), images, strict=True):
        if (source := dict(zip(SOURCE, row, strict=True)))["rows"]:
            size = (source["height"], source["width"], 3)
            image = at(source["image"], ctypes.c_uint8, size[0] * size[1] * 3).reshape(size)
            out.copy_(torch.from_numpy(fitted(image, len(out), "openpi")))


@pytest.mark.slow
@pytest.mark.parametrize("size", [(480, 640), (224, 224)])
def test_a_backend_that_resizes_launches_vision_in_the_form_that_its_pictures_need(
    reference: UnifiedPolicy, size: tuple[int, int]
) -> None:
    policy = policy_on(Resizing, random_checkpoint("pi05_tiny"), robot="plain")
    backend: Any = policy.backend
    seen = {"base_0_rgb": camera_image(*size), "left_wrist_0_rgb": camera_image(224, 224, seed=1)}
    observation = {"images": seen, "state": np.zeros(7), "prompt": "pick"}
    for _ in range(2):
        ours, theirs = (one.infer(observation, seed=3)["actions"] for one in (policy, reference))
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-4)
    assert backend.reported == ["run" if size == (224, 224) else "run_resized", "answer"] * 2


@pytest.mark.parametrize("size", [(480, 640), (224, 224)])
def test_a_policys_actions_are_those_of_pictures_resized_on_the_host(
    policy: UnifiedPolicy, reference: UnifiedPolicy, size: tuple[int, int]
) -> None:
    cameras = ("base_0_rgb", "left_wrist_0_rgb")
    seen = {camera: camera_image(*size, seed=i) for i, camera in enumerate(cameras)}
    seen[cameras[1]] = camera_image(224, 224, seed=1)  # one of them has the size
    observation = {"images": seen, "state": np.zeros(7), "prompt": "pick"}
    ours, theirs = (one.infer(observation, seed=3)["actions"] for one in (policy, reference))
    np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-4)
    for camera_images in seen.values():
        camera_images[:] = 0  # the caller's to change again
    assert not np.allclose(policy.infer(observation, seed=3)["actions"], theirs, rtol=0, atol=1e-4)


def test_a_picture_that_is_too_narrow_is_refused_and_the_next_call_works(policy: UnifiedPolicy) -> None:
    observation = {"images": {"base_0_rgb": camera_image(1, 500)}, "state": np.zeros(7), "prompt": "pick"}
    with pytest.raises(ObservationError, match="1x500 pixels is too narrow"):
        policy.infer(observation)
    observation["images"] = {"base_0_rgb": camera_image(48, 64)}
    assert np.isfinite(policy.infer(observation)["actions"]).all()
