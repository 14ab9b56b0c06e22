"""Images as robots send them, checked: what their observations' readers use."""

from typing import TypeGuard

import numpy as np

from turbopi.support.errors import ObservationError

_UINT8 = np.dtype(np.uint8)


def is_rgb8(value: object) -> TypeGuard[np.ndarray]:
    """Whether it is an image uint8[h, w, 3], which needs no other check and no conversion."""
    return type(value) is np.ndarray and value.dtype == _UINT8 and value.shape[2:] == (3,) and value.size > 0


def parse_image(value: object, name: str) -> np.ndarray:
    """One image as openpi's LIBERO and DROID robots take it: uint8[h, w, 3].

    `value` is uint8 in [0, 255] or float in [0, 1], HWC or CHW; it counts as CHW when its first axis is 3.
    Raises ObservationError, naming `name`, for anything else.
    """
    if is_rgb8(value) and len(value) != 3:
        return value
    image = check_image(value, name)
    if image.shape[0] == 3:
        image = image.transpose(1, 2, 0)
    return to_uint8(_check_rgb(image, name), name)


def parse_chw_image(value: object, name: str) -> np.ndarray:
    """One image as openpi's ALOHA clients send it, CHW: uint8[h, w, 3]. HWC, as JSON has it, where only that is RGB."""
    image = check_image(value, name)
    if image.shape[0] != 3 and image.shape[-1] == 3:
        return to_uint8(image, name)
    if image.shape[0] != 3:
        raise ObservationError(
            f"{name} has shape {image.shape}, but this robot's images are CHW, (3, height, width), or HWC"
        )
    return to_uint8(image.transpose(1, 2, 0), name)


def parse_unit_image(value: object, name: str) -> np.ndarray:
    """One image as LeRobot takes it: (uint8|float32)[h, w, 3], float32 in [0, 1]; CHW or HWC as `parse_image`."""
    image = check_image(value, name)
    if image.shape[0] == 3:
        image = image.transpose(1, 2, 0)
    image = _check_rgb(image, name)
    if image.dtype != _UINT8:
        _check_unit_range(image, name)
        image = image.astype(np.float32, copy=False)
    return image


def check_image(value: object, name: str) -> np.ndarray:
    """`value` as a non-empty array with three axes, uint8 or float; raises ObservationError otherwise."""
    try:
        image = np.asarray(value)
    except Exception as error:
        raise ObservationError(f"{name} isn't an image: {error}") from error
    if image.dtype != _UINT8 and image.dtype.kind != "f":
        raise ObservationError(f"{name} {_what(value, image)}; send uint8 in [0, 255] or float in [0, 1]")
    if image.ndim != 3:
        raise ObservationError(
            f"{name} has shape {image.shape}; send one image, (height, width, 3) or (3, height, width), "
            f"without a batch axis"
        )
    if image.size == 0:
        raise ObservationError(f"{name} is empty: its shape is {image.shape}")
    return image


def _what(value: object, image: np.ndarray) -> str:
    """What came instead of an image, for a message."""
    if value is None:
        return "is None"
    if image.dtype.kind == "S":
        return "is bytes: decode a JPEG or PNG first"
    if image.dtype.kind == "U":
        return "is text (images in JSON begin with data:image/png;base64, or data:image/jpeg;base64,)"
    return f"has dtype {image.dtype}"


def check_hwc(value: object, name: str) -> np.ndarray:
    """`check_image`, and the last axis is RGB's; raises ObservationError otherwise."""
    return _check_rgb(check_image(value, name), name)


def _check_rgb(image: np.ndarray, name: str) -> np.ndarray:
    if image.shape[-1] != 3:
        raise ObservationError(f"{name} has shape {image.shape}; one axis, the first or the last, must be RGB's 3")
    return image


def to_uint8(image: np.ndarray, name: str = "image") -> np.ndarray:
    """Float images in [0, 1] to uint8 by truncation of 255 * x, as openpi; uint8 passes."""
    if image.dtype == _UINT8:
        return image
    _check_unit_range(image, name)
    return np.asarray((255 * image).astype(np.uint8))


def _check_unit_range(image: np.ndarray, name: str) -> None:
    # The bounds are where truncation to uint8 would wrap around; NaN fails both comparisons.
    low, high = float(image.min()), float(image.max())
    if not (low > -1 / 255 and high < 256 / 255):
        raise ObservationError(
            f"{name} is a float image with values from {low:g} to {high:g}; float images are in [0, 1]. "
            f"Send uint8 for [0, 255]"
        )
