"""An observation written by hand: a folder with an `observation.json` and the images that it names.

A JSON object like the observation, in which

    {"file": "wrist.png"}                    is that image of the folder, RGB uint8 [h, w, 3]
    {"file": "wrist.png", "layout": "chw"}   the same as [3, h, w]
    {"file": "wrist.npy"}                    is the array of that file
    [0, 0.5, [1, 2]]                         a list of numbers, is a float64 array

and everything else is what it is.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from turbopi.support.errors import ObservationError
from turbopi.support.reading import file_inside, is_finite, read_json, read_npy, shown
from turbopi.support.reading.images import read_image

FILE = "observation.json"
_MAX_BYTES = 64 * 2**20  # numbers may be written out


def load_folder(folder: Path) -> dict[str, Any]:
    """The observation. Raises ObservationError, naming the file or the key, for whatever can't be read."""
    described = read_json(folder / FILE, ObservationError, limit=_MAX_BYTES)
    return {key: _from_json(item, key, folder) for key, item in described.items()}


def _from_json(value: object, name: str, folder: Path) -> object:
    if isinstance(value, dict) and "file" in value:
        return _load_file(value, name, folder)
    if isinstance(value, dict):
        return {key: _from_json(item, f"{name}/{key}", folder) for key, item in value.items()}
    if isinstance(value, list):
        for leaf in _leaves(value):
            if not is_finite(leaf):
                raise ObservationError(f"{name!r} must be a list of numbers, but holds {shown(leaf)}")
        try:
            return np.array(value, np.float64)
        except ValueError as error:  # rows of different lengths
            raise ObservationError(f"{name!r} must be a list of numbers: {error}") from error
    return value


def _leaves(value: object) -> Iterator[object]:
    if isinstance(value, list):
        for item in value:
            yield from _leaves(item)
    else:
        yield value


def _load_file(value: dict[str, object], name: str, folder: Path) -> np.ndarray:
    layout, named = value.get("layout", "hwc"), str(value["file"])
    is_array = named.endswith(".npy")
    if set(value) - {"file", "layout"} or layout not in ("hwc", "chw") or (is_array and "layout" in value):
        raise ObservationError(
            f'{name!r} must be {{"file": ..., "layout": "hwc" or "chw"}}, without a layout for .npy, not {shown(value)}'
        )
    file = file_inside(folder, value["file"], repr(name), ObservationError)
    if not file.resolve().is_relative_to(folder.resolve()) or not file.is_file():
        raise ObservationError(f"{name!r} names the file {shown(named)}, which isn't in {folder}")
    if is_array:
        return read_npy(file)
    pixels = read_image(file)
    return np.ascontiguousarray(pixels.transpose(2, 0, 1)) if layout == "chw" else pixels
