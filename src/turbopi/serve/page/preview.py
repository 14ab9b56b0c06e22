"""A preview of one answered call, for people."""

import io
from collections.abc import Mapping, Sequence

import numpy as np
from PIL import Image

from turbopi.realtime.wire import unpack
from turbopi.serve.page.messages import Preview, Thumbnail, clean
from turbopi.support.action_groups import images_of, task_of

THUMBNAIL = 224  # pixels of the longer side
IMAGES = 4
ARRAYS, NUMBERS = 4, 64  # of an observation; of one array
ACTIONS = 16_384  # numbers of a chunk


def make_preview(
    number: int,
    time: float,
    message: bytes | None,
    reply: Mapping[str, object],
    state: Sequence[float],
    timing: Mapping[str, float],
) -> Preview:
    """What to show of a call: the `message` that was answered, and its `reply`. Never raises for what is in them.

    Without the message, which is too long to store, there is less to show.
    """
    observation = {} if message is None else unpack(message)
    return Preview(
        number=number,
        time=time,
        prompt=clean(task_of(observation, reply)),
        actions=_chunk(reply.get("actions")),
        state=list(state[:NUMBERS]),
        numbers=_numbers(observation),
        images=_images(observation),
        timing=dict(timing),
        note="" if message is not None else "the observation is too large to be shown",
    )


def _chunk(actions: object) -> list[list[float | None]]:
    if not isinstance(actions, np.ndarray) or actions.ndim != 2 or actions.dtype.kind != "f" or actions.size > ACTIONS:
        return []
    rows: list[list[float | None]] = actions.tolist()
    return rows


def _numbers(observation: Mapping[str, object]) -> dict[str, list[float | None]]:
    found = {
        clean(key, 60): value.tolist()
        for key, value in observation.items()
        if isinstance(value, np.ndarray) and value.ndim == 1 and value.dtype.kind in "fiu" and 0 < value.size <= NUMBERS
    }
    return dict(list(found.items())[:ARRAYS])


def _images(observation: Mapping[str, object]) -> dict[str, Thumbnail]:
    shown = list(images_of(observation).items())[:IMAGES]
    return {clean(camera, 60): thumbnail(image) for camera, image in shown if image.size}


def thumbnail(pixels: np.ndarray) -> Thumbnail:
    """A small JPEG of (uint8|float)[h, w, 3]; floats are in [0, 1]."""
    height, width = pixels.shape[:2]
    step = max(1, max(height, width) // (2 * THUMBNAIL))
    small = pixels[::step, ::step]
    if small.dtype != np.uint8:
        small = (255 * np.nan_to_num(np.clip(small.astype(np.float32), 0, 1))).astype(np.uint8)
    image = Image.fromarray(np.ascontiguousarray(small))
    image.thumbnail((THUMBNAIL, THUMBNAIL))
    stream = io.BytesIO()
    image.save(stream, "JPEG", quality=80)
    return Thumbnail(stream.getvalue(), width, height)
