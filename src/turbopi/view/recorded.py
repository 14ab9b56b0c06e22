"""The calls of a recording, in their order, and what is missing of it."""

import io
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from turbopi.recordings import load_call, recorded_files
from turbopi.support.action_groups import images_of, task_of
from turbopi.support.errors import ObservationError
from turbopi.support.reading import is_finite, read_json
from turbopi.view.calls import EncodedImage, ViewedCall, ViewedTrouble


def policy_of(recording: Path) -> dict[str, Any]:
    """The policy's metadata in the recording's manifest, empty if there is none."""
    folder = recorded_files(recording)[0].parent
    if not (folder / "manifest.json").is_file():
        return {}
    metadata = read_json(folder / "manifest.json", ObservationError).get("metadata")
    return metadata if isinstance(metadata, dict) else {}


def recorded(recording: Path) -> Iterator[ViewedCall | ViewedTrouble]:
    """Every call of a `--record` folder, of one run in it, or the one in a file; and gaps and damaged files.

    Raises ObservationError if there is no call at all.
    """
    files = recorded_files(recording)
    expected: dict[Path, int] = {}  # run -> number of its next file
    number, time = 0, None
    for file in files:
        in_run = int(file.stem) if file.stem.isdigit() else 0
        missing = in_run - expected.get(file.parent, in_run)
        expected[file.parent] = in_run + 1
        try:
            call = load_call(file)
        except ObservationError as error:
            if len(files) == 1:
                raise
            number += missing + 1
            yield ViewedTrouble(time or file.stat().st_mtime, str(error))
            continue
        if missing > 0:
            lacks = "1 call is" if missing == 1 else f"{missing} calls are"
            yield ViewedTrouble(call.time, f"{lacks} missing before {file.name}", serious=False)
        number, time = number + missing + 1, call.time
        yield ViewedCall(
            robot="",
            number=number,
            time=call.time,
            prompt=task_of(call.observation, call.result),
            actions=_actions(call.result),
            camera_images={
                name: as_png(camera_image)
                for name, camera_image in images_of(call.observation).items()
                if camera_image.size
            },
            numbers=numbers_of(call.observation),
            timing=_timing(call.result),
        )


def as_png(camera_image: np.ndarray) -> EncodedImage:
    """(uint8|float)[h, w, 3] without loss, but for floats in [0, 1], which become uint8."""
    if camera_image.dtype != np.uint8:
        camera_image = np.round(255 * np.nan_to_num(camera_image)).astype(np.uint8)
    stream = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(camera_image)).save(stream, "PNG", compress_level=1)
    return EncodedImage(stream.getvalue(), "image/png")


def numbers_of(observation: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """The arrays of numbers in an observation, by key: float64[n]."""
    return {
        key: value.astype(np.float64)
        for key, value in observation.items()
        if isinstance(value, np.ndarray) and value.ndim == 1 and value.size and value.dtype.kind in "fiu"
    }


def _actions(result: Mapping[str, Any]) -> np.ndarray | None:
    actions = result.get("actions")
    if isinstance(actions, np.ndarray) and actions.ndim == 2 and actions.size and actions.dtype.kind == "f":
        return actions.astype(np.float64)
    return None


def _timing(result: Mapping[str, Any]) -> dict[str, float]:
    """The policy's stages, and as "server" what the server measured around the policy."""
    reported = result.get("policy_timing")
    stages = {key.removesuffix("_ms"): value for key, value in reported.items()} if isinstance(reported, dict) else {}
    server = result.get("server_timing")
    if isinstance(server, dict):
        stages["server"] = server.get("infer_ms")
    return {stage: float(value) for stage, value in stages.items() if is_finite(value)}
