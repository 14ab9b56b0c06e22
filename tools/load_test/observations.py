"""What the clients send: observations of a robot, with other images for each client and call."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from turbopi.recordings import load_observation
from turbopi.robots import create_robot
from turbopi.support.errors import ConfigError

OF_A_CLIENT = 4  # in turns, so that no image is the one before: a backend may not copy that again


def image_size(text: str) -> tuple[int, int]:
    """(height, width) of "640x480". Raises ConfigError."""
    width, _, height = text.partition("x")
    if not (width.isascii() and width.isdigit() and height.isascii() and height.isdigit()):
        raise ConfigError(f"--images {text}: expected WIDTHxHEIGHT, such as 640x480")
    if not (0 < int(width) <= 8192 and 0 < int(height) <= 8192):
        raise ConfigError(f"--images {text}: expected 1 to 8192 pixels each way")
    return int(height), int(width)


def is_image(value: object) -> bool:
    return isinstance(value, np.ndarray) and value.dtype == np.uint8 and value.ndim == 3 and 3 in value.shape


def with_new_images(value: Any, size: tuple[int, int] | None, rng: np.random.Generator) -> Any:
    """An observation, or a part of it, with images of random pixels in the same layout, [h, w, 3] or [3, h, w].

    size  height and width of each; None: as they are
    """
    if isinstance(value, Mapping):
        return {key: with_new_images(item, size, rng) for key, item in value.items()}
    if not is_image(value):
        return value
    shape = value.shape
    if size is not None:
        shape = (*size, 3) if shape[-1] == 3 else (3, *size)
    return rng.integers(0, 256, shape, dtype=np.uint8)


def shapes(value: Any) -> list[tuple[int, ...]]:
    """Of all images of an observation."""
    if isinstance(value, Mapping):
        return [shape for item in value.values() for shape in shapes(item)]
    return [value.shape] if is_image(value) else []


def observations(
    robot: str | None, file: Path | None, size: tuple[int, int] | None, clients: int, seed: int
) -> tuple[str, Sequence[Sequence[dict[str, Any]]]]:
    """(the robot's name or the file's, OF_A_CLIENT observations for each client).

    robot  a name or the path of a robot's .json, whose example is sent
    file   or a recorded observation, `load_observation`'s; its state and prompt are sent unchanged

    Raises ConfigError for a robot that isn't known, CheckpointError or ObservationError for a file that isn't one.
    """
    rng = np.random.default_rng(seed)
    if file is not None:
        name, own = str(file), load_observation(file)
    else:
        assert robot is not None
        name, own = robot, create_robot(robot).example(rng)
    made = [[with_new_images(own, size, rng) for _ in range(OF_A_CLIENT)] for _ in range(clients)]
    if size is not None and not shapes(own):
        raise ConfigError(f"--images: the observations of {name} have no uint8 images [h, w, 3] or [3, h, w]")
    return name, made
