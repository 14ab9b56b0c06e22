"""Recordings on disk: one .npz for each call, readable with plain NumPy, nothing pickled.

    <record dir>/<UTC time of the start>/manifest.json     format, metadata of the policy, start time
                                         index.jsonl       one line for each call: file, time, infer_ms
                                         000000.npz …

An .npz holds each array under its keys joined with "/" ("observation/observation/image", "result/actions") and one
more member, "index": UTF-8 JSON, as bytes, of everything that isn't an array and of where the arrays belong. Joined
keys alone can't be split again, since openpi's own keys contain "/".

    node = {"dict": [[key, node], ...]} | {"list": [node, ...]} | {"array": member} | {"scalar": member}
         | {"bytes": base64} | {"value": string, number, boolean or null}

A folder with an `observation.json` is an observation written by hand: see `load_observation`.
"""

import base64
import json
import re
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from turbopi.errors import ObservationError
from turbopi.files import write_whole

FORMAT = "turbopi-recording"
VERSION = 1


@dataclass(frozen=True)
class Call:
    """One recorded call. `time` is the wall clock when it ended, in seconds since 1970."""

    observation: dict[str, Any]
    result: dict[str, Any]
    time: float


# --- one call ---------------------------------------------------------------------------------------------------------


def save_call(path: Path, call: Call) -> None:
    """Write `call` to `path`, whole or not at all. Raises OSError, and ObservationError for what can't be stored."""
    members: dict[str, np.ndarray] = {}
    index = {
        "format": FORMAT,
        "version": VERSION,
        "time": call.time,
        "observation": _to_node(call.observation, "observation", members),
        "result": _to_node(call.result, "result", members),
    }
    members["index"] = np.frombuffer(json.dumps(index).encode(), np.uint8)
    # a robot's calls come many a second: the last ones may be lost in a power cut, as those that still wait are
    write_whole(path, lambda stream: np.savez(stream, **members), sync=False)  # type: ignore[arg-type]


def load_call(path: str | Path) -> Call:
    """Read one recorded call. Raises ObservationError if `path` isn't one, OSError if it can't be read."""
    members = _read_npz(Path(path))
    if "index" not in members:
        raise ObservationError(f"{path} is an .npz without an index, so not a recorded call")
    return _to_call(members, path)


def _to_call(members: dict[str, np.ndarray], path: str | Path) -> Call:
    try:
        index = json.loads(members["index"].tobytes())
        if index["format"] != FORMAT or index["version"] != VERSION:
            raise ObservationError(
                f"{path} is a {index['format']} of version {index['version']}; this reads {FORMAT} of version {VERSION}"
            )
        observation = _from_node(index["observation"], members)
        return Call(observation, _from_node(index["result"], members), float(index["time"]))
    except ObservationError:
        raise
    except (KeyError, TypeError, ValueError, AttributeError, RecursionError) as error:
        raise ObservationError(f"{path} has a damaged index: {error!r}") from error


def _read_npz(path: Path) -> dict[str, np.ndarray]:
    try:
        archive = np.load(path, allow_pickle=False)
        if isinstance(archive, np.lib.npyio.NpzFile):
            with archive:
                return {name: archive[name] for name in archive.files}
    except (ValueError, EOFError, zipfile.BadZipFile) as error:
        # of what is neither, NumPy says that it holds pickles
        reason = error if zipfile.is_zipfile(path) else "it is no zip archive"
        raise ObservationError(f"{path} isn't a readable .npz file: {reason}") from error
    raise ObservationError(f"{path} isn't an .npz file")


def _to_node(value: Any, name: str, members: dict[str, np.ndarray]) -> dict[str, Any]:
    if isinstance(value, dict):
        for key in value:
            if not isinstance(key, str):
                raise ObservationError(f"can't record the key {key!r} in {name}: keys must be strings")
        return {"dict": [[key, _to_node(item, f"{name}/{key}", members)] for key, item in value.items()]}
    if isinstance(value, list | tuple):
        return {"list": [_to_node(item, f"{name}/{i}", members) for i, item in enumerate(value)]}
    if isinstance(value, bytes):
        return {"bytes": base64.b64encode(value).decode()}
    if value is None or isinstance(value, str | bool | int | float):
        return {"value": value.item() if isinstance(value, np.generic) else value}
    if isinstance(value, np.ndarray | np.generic) and value.dtype.kind not in "VOc":
        member = _member_name(name, members)
        members[member] = np.asarray(value)
        return {"array" if isinstance(value, np.ndarray) else "scalar": member}
    raise ObservationError(f"can't record {name}: it is a {type(value).__name__}")


def _member_name(name: str, taken: dict[str, np.ndarray]) -> str:
    """`name` as the name of a file in an archive: short, harmless, and new."""
    safe = re.sub(r"[^A-Za-z0-9_./ -]", "_", name)[:120].replace("..", "_")
    base = f"{safe}_" if safe.endswith((".npy", "/")) else safe
    member, n = base, 1
    while member in taken:
        n += 1
        member = f"{base}#{n}"
    return member


def _from_node(node: dict[str, Any], members: dict[str, np.ndarray]) -> Any:
    ((kind, content),) = node.items()
    if kind == "dict":
        return {key: _from_node(item, members) for key, item in content}
    if kind == "list":
        return [_from_node(item, members) for item in content]
    if kind == "bytes":
        return base64.b64decode(content)
    if kind == "array":
        return members[content]
    if kind == "scalar":
        return members[content][()]
    if kind == "value":
        return content
    raise ValueError(f"unknown kind of value {kind!r}")


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
            raise ObservationError(f"{file} holds no actions, only {list(call.result)}")
        yield call.observation, call.result["actions"]


def load_observation(path: str | Path) -> dict[str, Any]:
    """One observation from a file or folder. Takes

    - a recorded call (.npz), or a folder of them: the first one's observation;
    - any other .npz: each array under its own name as key, 0-dimensional strings as str;
    - a folder with `observation.json`: a JSON object like the observation, in which {"file": "wrist.png"} stands for
      the picture (RGB uint8 [h, w, 3]; [3, h, w] with "layout": "chw") or the .npy array in that folder, and a list
      of numbers for a float64 array.

    Raises ObservationError if `path` is none of these.
    """
    path = Path(path)
    if not path.exists():
        raise ObservationError(f"{path} doesn't exist")
    if path.is_dir() and (path / "observation.json").is_file():
        return _load_by_hand(path)
    members = _read_npz(recorded_files(path)[0])
    if "index" in members:
        return _to_call(members, path).observation
    return {name: str(a) if a.ndim == 0 and a.dtype.kind == "U" else a for name, a in members.items()}


def _load_by_hand(folder: Path) -> dict[str, Any]:
    try:
        value = json.loads((folder / "observation.json").read_text(encoding="utf-8"))
    except ValueError as error:
        raise ObservationError(f"{folder / 'observation.json'} isn't JSON: {error}") from error
    if not isinstance(value, dict):
        raise ObservationError(f"{folder / 'observation.json'} must hold an object, not a {type(value).__name__}")
    return {key: _from_json(item, key, folder) for key, item in value.items()}


def _from_json(value: Any, name: str, folder: Path) -> Any:
    if isinstance(value, dict) and "file" in value:
        return _load_file(value, name, folder)
    if isinstance(value, dict):
        return {key: _from_json(item, f"{name}/{key}", folder) for key, item in value.items()}
    if isinstance(value, list):
        try:
            return np.array(value, np.float64)
        except (TypeError, ValueError) as error:
            raise ObservationError(f"{name!r} must be a list of numbers: {error}") from error
    return value


def _load_file(value: dict[str, Any], name: str, folder: Path) -> np.ndarray:
    unknown = set(value) - {"file", "layout"}
    layout, file = value.get("layout", "hwc"), folder / str(value["file"])
    if unknown or layout not in ("hwc", "chw"):
        raise ObservationError(f'{name!r} must be {{"file": ..., "layout": "hwc" or "chw"}}, not {value}')
    if not file.resolve().is_relative_to(folder.resolve()) or not file.is_file():
        raise ObservationError(f"{name!r} names the file {value['file']!r}, which isn't in {folder}")
    if file.suffix == ".npy":
        try:
            return np.asarray(np.load(file, allow_pickle=False))
        except (ValueError, EOFError) as error:
            with file.open("rb") as stream:
                is_array = stream.read(6) == b"\x93NUMPY"
            reason = error if is_array else "it doesn't begin as one"
            raise ObservationError(f"{file} isn't a readable .npy file: {reason}") from error
    from PIL import Image, UnidentifiedImageError

    try:
        with Image.open(file) as image:
            pixels = np.asarray(image.convert("RGB"))  # uint8 [h, w, 3]
    except (UnidentifiedImageError, OSError) as error:
        raise ObservationError(f"{file} is neither a readable picture nor .npy: {error}") from error
    return np.ascontiguousarray(pixels.transpose(2, 0, 1)) if layout == "chw" else pixels
