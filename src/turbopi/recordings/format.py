"""Recordings on disk: one .npz for each call, readable with plain NumPy, nothing pickled.

    <record dir>/<UTC time of the start>/manifest.json     format, metadata of the policy, start time
                                         index.jsonl       one line for each call: file, time, infer_ms
                                         000000.npz …

An .npz holds each array under its keys joined with "/" ("observation/observation/image", "result/actions") and one
more member, "index": UTF-8 JSON, as bytes, of everything that isn't an array and of where the arrays belong. Joined
keys alone can't be split again, since openpi's own keys contain "/".

    node = {"dict": [[key, node], ...]} | {"list": [node, ...]} | {"array": member} | {"scalar": member}
         | {"bytes": base64} | {"value": string, number, boolean or null}
         | {"image": member} | {"image_chw": member}

An image is uint8[h, w, 3], or [3, h, w], whose member holds a PNG or JPEG file. Files with images are of version 2.

A folder with an `observation.json` is an observation written by hand: see observation_folder.py.
"""

import base64
import io
import json
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from turbopi.recordings.observation_folder import load_folder
from turbopi.support.errors import ObservationError
from turbopi.support.files import write_whole
from turbopi.support.reading import Npz, is_finite, listing, parse_json, shown
from turbopi.support.reading.arrays import is_unicode
from turbopi.support.text import kind_of

FORMAT = "turbopi-recording"
VERSION, WITH_IMAGES = 1, 2

RecordImages = Literal["exact", "png", "jpeg"]
RECORD_IMAGES: tuple[RecordImages, ...] = get_args(RecordImages)
_SAVED = {"png": {"compress_level": 1}, "jpeg": {"quality": 95, "subsampling": 0}}


@dataclass(frozen=True)
class RecordedCall:
    """One recorded call. `time` is the wall clock when it ended, in seconds since 1970."""

    observation: dict[str, Any]
    result: dict[str, Any]
    time: float


# --- one call ---------------------------------------------------------------------------------------------------------


def save_call(path: Path, call: RecordedCall, images: RecordImages = "exact") -> None:
    """Write `call`, whole or not at all. Raises OutputError, and ObservationError for what can't be stored.

    images  how the observation's are written: as they are, "png" (the same pixels, smaller and slower), or "jpeg" (far
            smaller, pixels nearly the same)
    """
    members: dict[str, np.ndarray] = {}
    observation = _to_node(call.observation, "observation", members, images)
    index = {
        "format": FORMAT,
        "version": VERSION if images == "exact" else WITH_IMAGES,
        "time": call.time,
        "observation": observation,
        "result": _to_node(call.result, "result", members),
    }
    members["index"] = np.frombuffer(json.dumps(index).encode(), np.uint8)
    # a robot's calls come many a second: the last ones may be lost in a power cut, as those that still wait are
    write_whole(path, lambda stream: np.savez(stream, **members), sync=False)  # type: ignore[arg-type]


def load_call(path: str | Path) -> RecordedCall:
    """Read one recorded call. Raises ObservationError if `path` isn't one, or can't be read."""
    with Npz(path) as members:
        if "index" not in members:
            raise ObservationError(f"{path} is an .npz without an index, so not a recorded call")
        return _to_call(members, path)


def _to_call(members: Npz, path: str | Path, *, result: bool = True) -> RecordedCall:
    """The call; without `result`, its arrays aren't read, and it is empty."""
    index = parse_json(
        members["index"].tobytes(), f"{path} has a damaged index: it", ObservationError, depth=200, nan=True
    )
    try:
        if index["format"] != FORMAT or index["version"] not in (VERSION, WITH_IMAGES):
            raise ObservationError(
                f"{path} is a {shown(index['format'])} of version {shown(index['version'])}; this reads {FORMAT} of "
                f"version {VERSION} or {WITH_IMAGES}"
            )
        observation = _from_node(index["observation"], members)
        answer = _from_node(index["result"], members) if result else {}
        if not isinstance(observation, dict) or not isinstance(answer, dict) or not is_finite(index["time"]):
            raise ValueError("the observation and the result should be dicts, the time a number")
        return RecordedCall(observation, answer, float(index["time"]))
    except ObservationError:
        raise
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        reason = shown(error) if isinstance(error, KeyError) else str(error)
        raise ObservationError(f"{path} has a damaged index: {type(error).__name__} {reason}") from error


def _to_node(
    value: object, name: str, members: dict[str, np.ndarray], images: RecordImages = "exact"
) -> dict[str, object]:
    if isinstance(value, dict):
        for key in value:
            if not isinstance(key, str):
                raise ObservationError(f"can't record the key {key!r} in {name}: keys must be strings")
        return {"dict": [[key, _to_node(item, f"{name}/{key}", members, images)] for key, item in value.items()]}
    if isinstance(value, list | tuple):
        return {"list": [_to_node(item, f"{name}/{i}", members, images) for i, item in enumerate(value)]}
    if isinstance(value, bytes):
        return {"bytes": base64.b64encode(value).decode()}
    if value is None or isinstance(value, str | bool | int | float):
        return {"value": value.item() if isinstance(value, np.generic) else value}
    if isinstance(value, np.ndarray | np.generic) and value.dtype.kind not in "VOc":
        array, member = np.asarray(value), _member_name(name, members)
        if array.dtype.kind == "U" and not is_unicode(array.tobytes(), array.dtype):  # reading would refuse it
            raise ObservationError(f"can't record {name}: its text holds half a Unicode character, or what is none")
        kind = None if images == "exact" else _image_kind(array)
        if kind is not None:
            members[member] = _encoded(array if kind == "image" else array.transpose(1, 2, 0), images)
            return {kind: member}
        members[member] = array
        return {"array" if isinstance(value, np.ndarray) else "scalar": member}
    raise ObservationError(f"can't record {name}: it is {kind_of(value)}")


def _image_kind(array: np.ndarray) -> str | None:
    """What an array is written as, if it is an image."""
    if array.dtype != np.uint8 or array.ndim != 3 or not array.size:
        return None
    return "image" if array.shape[2] == 3 else "image_chw" if array.shape[0] == 3 else None


def _encoded(pixels: np.ndarray, images: RecordImages) -> np.ndarray:
    """uint8[n], the file of an image uint8[h, w, 3]."""
    from PIL import Image

    stream = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(pixels)).save(stream, images.upper(), **_SAVED[images])
    return np.frombuffer(stream.getvalue(), np.uint8)


def _member_name(name: str, taken: dict[str, np.ndarray]) -> str:
    """`name` as the name of a file in an archive: short, harmless, and new."""
    safe = re.sub(r"[^A-Za-z0-9_./ -]", "_", name)[:120].replace("..", "_")
    base = f"{safe}_" if safe.endswith((".npy", "/")) else safe
    member, n = base, 1
    while member in taken:
        n += 1
        member = f"{base}#{n}"
    return member


def _from_node(node: Any, members: Mapping[str, np.ndarray]) -> Any:
    """What `_to_node` was given. Only the arrays that are named are read. ValueError, ... for what it didn't make."""
    if not isinstance(node, dict) or len(node) != 1:
        raise ValueError(f"{shown(node)} should have one kind and its content")
    ((kind, content),) = node.items()
    match kind, content:
        case "dict", list():
            if not all(isinstance(pair, list) and len(pair) == 2 and isinstance(pair[0], str) for pair in content):
                raise ValueError(f"{shown(content)} should be pairs of a key and a value")
            found = {key: _from_node(item, members) for key, item in content}
            if len(found) < len(content):
                raise ValueError(f"a key of {shown(list(found))} is there twice")
            return found
        case "list", list():
            return [_from_node(item, members) for item in content]
        case "bytes", str():
            return base64.b64decode(content, validate=True)
        case "array", str():
            return members[content]
        case (("image" | "image_chw"), str()):
            from turbopi.support.reading.images import decode_image

            pixels = decode_image(io.BytesIO(members[content].tobytes()), content)
            return pixels if kind == "image" else np.ascontiguousarray(pixels.transpose(2, 0, 1))
        case "scalar", str():
            scalar = members[content]
            if scalar.ndim:
                raise ValueError(f"{shown(content)} has shape {list(scalar.shape)}; expected a single value")
            return scalar[()]
        case "value", str() | int() | float() | None:
            return content
    raise ValueError(f"{shown(node)} is no value of a recording")


# --- folders ----------------------------------------------------------------------------------------------------------


def recorded_files(path: str | Path) -> list[Path]:
    """The recorded calls in a folder: one run's, or all runs' below a `--record` folder, in order of time.

    Raises ObservationError if there are none.
    """
    path = Path(path)
    if path.is_file():
        return [path]
    files = sorted(path.glob("*.npz")) or sorted(path.glob("*/*.npz"))
    if not files:
        raise ObservationError(f"{path} holds no recording: expected NNNNNN.npz files, in it or one folder below")
    return files


def iter_recording(path: str | Path) -> Iterator[tuple[dict[str, Any], np.ndarray]]:
    """(observation, actions [H, d]) of every recorded call in `path`: a `--record` folder, one run in it, or one file.

    Observations are as the client sent them, before any preprocessing. Raises ObservationError for a damaged file.
    """
    for file in recorded_files(path):
        call = load_call(file)
        if "actions" not in call.result:
            raise ObservationError(f"{file} holds no actions, only {listing(list(call.result)) or 'nothing'}")
        actions = call.result["actions"]
        if not isinstance(actions, np.ndarray) or actions.ndim != 2 or actions.dtype.kind != "f":
            raise ObservationError(f"{file}: its actions are {shown(actions)}; expected an array of numbers [H, d]")
        yield call.observation, actions


def load_observation(path: str | Path) -> dict[str, Any]:
    """One observation from a file or folder. Takes

    - a recorded call (.npz), or a folder of them: the first one's observation;
    - any other .npz: each array under its own name as key, 0-dimensional strings as str;
    - a folder with `observation.json`: see observation_folder.py.

    Raises ObservationError if `path` is none of these, or damaged. At most 512 MB of arrays are read.
    """
    path = Path(path)
    if not path.exists():
        raise ObservationError(f"{path} doesn't exist")
    if path.is_dir() and (path / "observation.json").is_file():
        return load_folder(path)
    with Npz(recorded_files(path)[0]) as members:
        if "index" in members:
            return _to_call(members, path, result=False).observation
        return {name: str(a) if a.ndim == 0 and a.dtype.kind == "U" else a for name, a in members.items()}
