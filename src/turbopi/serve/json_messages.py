"""A request in JSON as the msgpack message that means the same, and an answer as JSON.

image      "data:image/png;base64,…" or "data:image/jpeg;base64,…" -> RGB uint8[h, w, 3]; a list: [B, h, w, 3]
numbers    nested lists of one shape -> float64; of true and false -> bool
all else   as it is
"""

import base64
import io
from typing import Any

import msgspec
import numpy as np

from turbopi.realtime.wire import MAX_DEPTH, MAX_VALUES, WireError, pack
from turbopi.support.reading.images import decode_image
from turbopi.support.reading.json import parse_json

_IMAGE = "data:image/"
_FORMATS = {"data:image/png;base64": "PNG", "data:image/jpeg;base64": "JPEG"}


def from_json(body: bytes, max_bytes: int) -> bytes:
    """The msgpack message of a JSON body.

    max_bytes  of all its images, decoded

    Raises WireError for what is no such JSON or holds more than MAX_VALUES values, and ObservationError for an image
    that can't be decoded.
    """
    if body.count(b",") + body.count(b"[") + body.count(b"{") > MAX_VALUES:  # before anything is built
        raise WireError(f"more than {MAX_VALUES} values in one body: send images as base64 PNG or JPEG, not as lists")
    value = parse_json(body, "the body", WireError, depth=MAX_DEPTH)
    if not isinstance(value, dict):
        raise WireError(f"a request is an object of observation keys to values, not a JSON {type(value).__name__}")
    return pack(_Images(max_bytes).in_place(value, ""))


def to_json(answer: dict[str, Any]) -> bytes:
    """An answer as JSON: arrays as nested lists, numbers that aren't finite as null, what JSON doesn't know as text."""
    return msgspec.json.encode(answer, enc_hook=_plain)


class _Images:
    """Decodes the images of a body, up to `left` bytes."""

    def __init__(self, left: int) -> None:
        self._left = left

    def in_place(self, value: Any, name: str) -> Any:
        """`value` with arrays where the policy expects them; `name` is its place, for errors."""
        if isinstance(value, dict):
            return {key: self.in_place(item, f"{name}/{key}" if name else key) for key, item in value.items()}
        if isinstance(value, str):
            return self._image(value, name) if value.startswith(_IMAGE) else value
        if not isinstance(value, list):
            return value
        if value and all(isinstance(item, str) for item in value):
            if not any(item.startswith(_IMAGE) for item in value):
                return value
            images = [self._image(item, f"{name}[{row}]") for row, item in enumerate(value)]
            if len({image.shape for image in images}) > 1:
                raise WireError(f"{name}: the images of a list must have one size")
            return np.stack(images)
        return _numbers(value, name)

    def _image(self, text: str, name: str) -> np.ndarray:
        head, _, content = text.partition(",")
        if head not in _FORMATS:
            raise WireError(f"{name}: an image begins with {' or '.join(_FORMATS)}, not {head[:60]!r}")
        try:
            data = base64.b64decode(content, validate=True)
        except ValueError as error:
            raise WireError(f"{name}: an image's base64 can't be decoded: {error}") from error
        image = decode_image(io.BytesIO(data), name, most=self._left // 3, formats=(_FORMATS[head],))
        self._left -= image.nbytes
        return image


def _numbers(value: list[Any], name: str) -> np.ndarray:
    kinds, level = set[type](), value
    while level:
        kinds |= {type(item) for item in level if not isinstance(item, list)}
        level = [part for item in level if isinstance(item, list) for part in item]
    if not (kinds <= {int, float} or kinds == {bool}):
        found = ", ".join(sorted(kind.__name__ for kind in kinds))
        raise WireError(f"{name}: a list holds numbers, or true and false, or texts; this one holds {found}")
    try:
        return np.array(value, bool if bool in kinds else np.float64)
    except ValueError as error:
        raise WireError(f"{name}: the rows of nested lists must have one length") from error


def _plain(value: Any) -> Any:
    return value.tolist() if hasattr(value, "tolist") else str(value)
