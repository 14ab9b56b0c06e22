"""Images: openpi's way bit for bit, LeRobot's against an independent computation, refusals."""

import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from turbopi.preprocess import images
from turbopi.preprocess.images import WAYS, all_fitted, fitted, resize_into, resize_unit_into, resize_with_pad
from turbopi.robots.images import parse_chw_image, parse_image, parse_unit_image, to_uint8
from turbopi.support.errors import ObservationError

GOLDEN = np.load(Path(__file__).parent / "golden" / "preprocess" / "resize.npz")
RESIZED = [name for name in GOLDEN.files if re.search(r"/out_\d+x\d+$", name)]


def noise(*shape: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(256, size=shape, dtype=np.uint8)


@pytest.mark.parametrize("name", RESIZED)
def test_resize_is_openpis_bit_for_bit(name: str) -> None:
    case, _, size = name.rpartition("/out_")
    height, width = map(int, size.split("x"))
    np.testing.assert_array_equal(resize_with_pad(GOLDEN[f"{case}/in"], height, width), GOLDEN[name])


def test_golden_resizes_cover_both_directions_and_batches() -> None:
    assert len(RESIZED) >= 6
    assert any(GOLDEN[name].ndim == 5 for name in RESIZED)


def test_float_pictures_truncate_as_openpis_and_uint8_passes() -> None:
    np.testing.assert_array_equal(to_uint8(GOLDEN["to_uint8/in"]), GOLDEN["to_uint8/out"], strict=True)
    image = noise(4, 5, 3)
    assert to_uint8(image) is image


def test_a_picture_of_the_right_size_is_returned_itself() -> None:
    image = noise(24, 32, 3)
    assert resize_with_pad(image, 24, 32) is image


def test_transposed_pictures_resize_as_contiguous_ones() -> None:
    planes = noise(3, 50, 40)
    target = np.zeros((2, 32, 32, 3), np.uint8)
    resize_into(planes.transpose(1, 2, 0), target[0])
    resize_into(np.ascontiguousarray(planes.transpose(1, 2, 0)), target[1])
    np.testing.assert_array_equal(target[0], target[1])
    assert target.any()


SIZES = ((480, 640), (720, 1280), (1080, 1920), (640, 480), (211, 1999), (224, 400), (900, 224), (224, 224))


@pytest.mark.slow
@pytest.mark.parametrize("cores", [1, 2, 3, 16])
@pytest.mark.parametrize("way", WAYS)
def test_pictures_that_threads_resize_are_to_the_last_bit_those_of_one(
    monkeypatch: pytest.MonkeyPatch, way: Any, cores: int
) -> None:
    monkeypatch.setattr(images, "usable_processors", lambda: cores)
    images._threads.cache_clear()
    camera_images = [noise(h, w, 3, seed=h) for h, w in SIZES]
    turned = [one.transpose(1, 0, 2) for one in camera_images]
    for given_ in (
        camera_images,
        turned,
        [camera_images[0]],
        [camera_images[0], noise(30, 40, 3)],
        [noise(30, 40, 3)],
        [],
    ):
        for found, one in zip(all_fitted(given_, 224, way), given_, strict=True):
            np.testing.assert_array_equal(found, fitted(one, 224, way), strict=True)
    with pytest.raises(ObservationError, match="1x300000 pixels is too narrow"):
        all_fitted([camera_images[0], noise(1, 300000, 3)], 224, way)
    images._threads.cache_clear()


@pytest.mark.slow
def test_a_forked_child_has_threads_of_its_own() -> None:
    code = """
import os, numpy as np
from turbopi.preprocess import images
images.usable_processors = lambda: 2
arrays = [np.ones((480, 640, 3), np.uint8)] * 2
images.all_fitted(arrays, 224, "openpi")
child = os.fork()
images.all_fitted(arrays, 224, "openpi")
if child:
    assert os.waitpid(child, 0)[1] == 0
"""
    subprocess.run([sys.executable, "-W", "ignore", "-c", code], check=True, timeout=120)


@given(h=st.integers(1, 90), w=st.integers(1, 90), height=st.integers(8, 40), width=st.integers(8, 40))
@settings(max_examples=60, deadline=None)
def test_resized_pictures_fill_one_axis_and_are_black_around(h: int, w: int, height: int, width: int) -> None:
    ratio = max(h / height, w / width)
    rows, columns = int(h / ratio), int(w / ratio)
    white = np.full((h, w, 3), 255, np.uint8)
    if min(rows, columns) < 1:
        with pytest.raises(ObservationError, match=f"{h}x{w} pixels is too narrow"):
            resize_with_pad(white, height, width)
        return
    out = resize_with_pad(white, height, width)
    assert out.shape == (height, width, 3)
    assert out.dtype == np.uint8
    top, left = (height - rows) // 2, (width - columns) // 2
    assert (out[top : top + rows, left : left + columns] == 255).all()
    assert int(out.astype(np.int64).sum()) == 255 * 3 * rows * columns  # nothing else
    assert rows >= height - 1 or columns >= width - 1  # openpi's rounding may lose a pixel


@pytest.mark.parametrize("parse", [parse_image, parse_unit_image])
def test_both_layouts_and_dtypes_give_one_picture(parse: Any) -> None:
    image = noise(20, 30, 3)
    as_float = image / np.float32(255)
    for dtype in (np.float32, np.float64):
        given_ = as_float.astype(dtype)
        np.testing.assert_array_equal(parse(given_, "x"), parse(given_.transpose(2, 0, 1), "x"))
    np.testing.assert_array_equal(parse(image, "x"), parse(image.transpose(2, 0, 1), "x"))
    np.testing.assert_array_equal(parse(image, "x"), image)


def test_a_first_axis_of_three_counts_as_chw() -> None:
    assert parse_image(noise(3, 20, 3), "x").shape == (20, 3, 3)  # openpi's rule, even where both axes fit


BAD: list[tuple[Any, str]] = [
    (np.zeros((20, 30, 3), np.int64), "cam has dtype int64; send uint8"),
    (np.zeros((20, 30, 3), np.bool_), "cam has dtype bool"),
    (np.array("image"), "cam is text .*data:image/png;base64,.*; send uint8"),
    (b"\xff\xd8\xff\xe0", "cam is bytes: decode a JPEG or PNG first; send uint8"),
    (np.array(["a", None], object), "cam has dtype object; send uint8"),
    (np.zeros((20, 30), np.uint8), r"cam has shape \(20, 30\); send one image"),
    (np.zeros((1, 20, 30, 3), np.uint8), "without a batch axis"),
    (np.zeros((0, 30, 3), np.uint8), "cam is empty"),
    (np.zeros((20, 30, 4), np.uint8), r"cam has shape \(20, 30, 4\); one axis"),
    (np.zeros((20, 30, 1), np.uint8), r"cam has shape \(20, 30, 1\); one axis"),
    (np.full((20, 30, 3), 255.0), "cam is a float image with values from 255 to 255"),
    (np.full((20, 30, 3), -0.1), "cam is a float image with values from -0.1"),
    (np.full((20, 30, 3), np.nan), "cam is a float image with values from nan"),
    ([[[1, 2, 3], [1, 2]]], "cam isn't an image"),
    (None, "cam is None; send uint8"),
]


@pytest.mark.parametrize(("value", "message"), BAD)
def test_what_is_no_picture_is_refused(value: Any, message: str) -> None:
    for parse in (parse_image, parse_unit_image):
        with pytest.raises(ObservationError, match=message):
            parse(value, "cam")


def test_chw_robots_take_the_images_of_json_which_are_hwc() -> None:
    image, ambiguous = noise(20, 30, 3), noise(3, 20, 3)
    for either in (image, image.transpose(2, 0, 1)):
        np.testing.assert_array_equal(parse_chw_image(either, "cam_high"), image)
    np.testing.assert_array_equal(parse_chw_image(ambiguous, "cam_high"), ambiguous.transpose(1, 2, 0))
    with pytest.raises(ObservationError, match=r"cam_high has shape \(20, 30, 4\), but this robot's images are CHW, "):
        parse_chw_image(noise(20, 30, 4), "cam_high")


# LeRobot's way


def bilinear(image: np.ndarray, rows: int, columns: int) -> np.ndarray:
    """Bilinear interpolation without averaging, pixel centres at half coordinates, edges repeated; float64."""

    def weights(old: int, new: int) -> np.ndarray:
        matrix = np.zeros((new, old))
        for i in range(new):
            x = max((i + 0.5) * old / new - 0.5, 0.0)
            low = min(int(x), old - 1)
            high = min(low + 1, old - 1)
            matrix[i, low] += 1 - (x - low)
            matrix[i, high] += x - low
        return matrix

    return np.einsum("ih,jw,hwc->ijc", weights(image.shape[0], rows), weights(image.shape[1], columns), image)


@pytest.mark.parametrize(("h", "w"), [(64, 64), (48, 64), (90, 20), (10, 16), (31, 33)])
@pytest.mark.parametrize("dtype", [np.uint8, np.float32])
def test_lerobots_resize_is_bilinear_without_averaging(h: int, w: int, dtype: type) -> None:
    image = noise(h, w, 3) if dtype == np.uint8 else np.random.default_rng(0).random((h, w, 3), np.float32)
    unit = image.astype(np.float64) / (255 if dtype == np.uint8 else 1)
    ratio = max(h / 32, w / 32)
    rows, columns = int(h / ratio), int(w / ratio)
    expected = np.full((32, 32, 3), -1.0)
    top, left = (32 - rows) // 2, (32 - columns) // 2
    expected[top : top + rows, left : left + columns] = 2 * bilinear(unit, rows, columns) - 1
    out = np.full((32, 32, 3), -1, np.float32)
    resize_unit_into(image, out)
    np.testing.assert_allclose(out, expected, atol=1e-5)  # torch places pixels in float32


def test_lerobots_resize_isnt_openpis() -> None:
    image = noise(64, 64, 3)
    out = np.full((32, 32, 3), -1, np.float32)
    resize_unit_into(image, out)
    openpis = resize_with_pad(image, 32, 32) / 255 * 2 - 1
    assert np.abs(out - openpis).max() > 0.2  # openpi averages when it shrinks


def test_lerobots_pictures_of_the_right_size_are_only_scaled() -> None:
    image = noise(32, 32, 3)
    out = np.full((32, 32, 3), -1, np.float32)
    resize_unit_into(image, out)
    np.testing.assert_array_equal(out, image / np.float32(255) * np.float32(2) - np.float32(1))
    unit = np.asarray(image / np.float32(255))
    unit.flags.writeable = False  # as a decoded message is
    again = np.full((32, 32, 3), -1, np.float32)
    resize_unit_into(unit, again)
    np.testing.assert_array_equal(again, out)
