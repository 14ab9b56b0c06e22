"""What a policy with memory keeps of one robot's episode, and what of it goes into the model.

As LeRobot's own policy: one entry an observation, the first of an episode in the place of all that came before it. A
frame from before the episode is there, but masked. Images are kept as they enter the model (0.6 MB each): what the
robot's cameras send is mostly larger, and each is fitted once.
"""

import dataclasses
from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from turbopi.config import MemoryConfig
from turbopi.models.observation import ModelInputs, PastInputs
from turbopi.preprocess.pipeline import Pipeline
from turbopi.realtime.messages import keeps_episode
from turbopi.support.errors import ConfigError, ObservationError

PAD = "_is_pad"  # behind a key, as LeRobot's data sets: which of its frames are from before the episode


def refuse_memory(metadata: Mapping[str, Any], what: str) -> None:
    """Raise ConfigError if a policy of this metadata has memory, which `what` isn't made for."""
    if keeps_episode(metadata):
        why = "has memory" if "memory" in metadata else "acts on subtasks"
        raise ConfigError(
            f"this policy {why}, and {what} doesn't keep a robot's history. `turbopi infer`, `serve`, `verify`, "
            "`bench` and `inspect` take it, and so does UnifiedPolicy"
        )


class History:
    """What a policy keeps of one robot's episode. `UnifiedPolicy.new_history` makes one; calls use it one at a time.

    observations  recorded since the episode began
    """

    observations = 0

    def reset(self) -> None:
        """A new episode: what was recorded is forgotten."""
        self.observations = 0


class ObservationHistory(History):
    """Of a policy with memory."""

    def __init__(self, memory: MemoryConfig) -> None:
        self._memory = memory
        self.reset()

    def reset(self) -> None:
        super().reset()
        self._images: dict[str, deque[np.ndarray]] = {}  # by camera: of one that was missing, what came
        self._states: deque[np.ndarray] = deque(maxlen=self._memory.length)

    def describe(self, pipeline: Pipeline) -> dict[str, Any]:
        """Plain values; "bytes": of the images of all cameras, once it has all of its entries."""
        cameras = max(getattr(pipeline.robot, "camera_counts", None) or (1,)) if self._memory.visual else 0
        of_images = self._memory.length * cameras * 3 * 4 * pipeline.config.model.image_size**2
        return dataclasses.asdict(self._memory) | {"bytes": of_images}

    def record(self, cameras: Sequence[str], inputs: ModelInputs) -> None:
        """Add an observation: the names of its cameras, and what the model sees of it."""
        if self._memory.visual:
            for camera, image, valid in zip(cameras, inputs.images, inputs.image_mask, strict=True):
                if valid:
                    self._add(self._images.setdefault(camera, deque(maxlen=self._memory.length)), image.copy())
        if self._memory.proprioceptive:
            self._add(self._states, inputs.state)
        self.observations += 1

    @staticmethod
    def _add(entries: deque[np.ndarray], entry: np.ndarray) -> None:
        assert entries.maxlen is not None
        entries.extend([entry] * (1 if entries else entries.maxlen))

    def with_past(self, cameras: Sequence[str], inputs: ModelInputs) -> ModelInputs:
        """The inputs of the observation that was recorded last, with what came before it."""
        memory, ages = self._memory, range(self._memory.length - 1, -1, -self._memory.stride)
        seen = np.array([age < self.observations for age in ages])
        parts: dict[str, np.ndarray] = {}
        if memory.visual:
            shape = (len(cameras), memory.frames - 1, *inputs.images.shape[1:])
            black = 0 if inputs.images.dtype == np.uint8 else -1
            parts["images"] = images = np.full(shape, black, inputs.images.dtype)
            parts["image_mask"] = seen[None, :-1] & inputs.image_mask[:, None]
            for row, camera in enumerate(cameras):
                for place, age in enumerate(ages[:-1] if inputs.image_mask[row] else ()):
                    images[row, place] = self._images[camera][-1 - age]
        if memory.proprioceptive:
            parts["states"] = np.stack([self._states[-1 - age] for age in ages])
            parts["state_mask"] = seen
        return dataclasses.replace(inputs, past=PastInputs(**parts))


def given_frames(observation: Mapping[str, Any], memory: MemoryConfig) -> list[dict[str, Any]] | None:
    """The observations of an episode that one observation holds as LeRobot's data sets give them, oldest first.

    Images [F, h, w, 3] or [F, 3, h, w], states [F, d], and bool[F] under KEY_is_pad: True for frames from before the
    episode, which are left out. None: it holds the current frame alone.

    Raises ObservationError for another number of frames, and where only a part has them.
    """
    if not isinstance(observation, Mapping):
        return None
    arrays = {key: one for key, one in observation.items() if isinstance(one, np.ndarray) and not key.endswith(PAD)}
    images = [key for key, one in arrays.items() if one.ndim in (3, 4)]
    framed = {key for key, one in arrays.items() if one.ndim == 4 or (one.ndim == 2 and one.dtype.kind in "fiu")}
    if not framed:
        return None
    states = framed.difference(images)
    if (memory.visual and framed.isdisjoint(images)) or (memory.proprioceptive and not states):
        raise ObservationError(
            f"{', '.join(sorted(framed))} have frames, and this policy remembers more: give all of them"
        )
    if odd := [key for key in images if (key in framed) != memory.visual] + [
        key for key in states if not memory.proprioceptive
    ]:
        raise ObservationError(
            f"{odd[0]} has shape {list(arrays[odd[0]].shape)}, and this policy remembers "
            f"{'images' if memory.visual else 'states'} of {memory.frames} frames"
        )
    padded: set[tuple[bool, ...]] = set()
    for key in framed:
        pad = np.asarray(observation.get(key + PAD, np.zeros(memory.frames, np.bool_)))
        if len(arrays[key]) != memory.frames or pad.shape != (memory.frames,) or pad.dtype != np.bool_:
            raise ObservationError(
                f"{key} has shape {list(arrays[key].shape)} and {key + PAD} {list(pad.shape)}; this policy remembers "
                f"{memory.frames} frames"
            )
        padded.add(tuple(pad.tolist()))
    first = min(padded)
    begins = sum(first)
    if len(padded) > 1 or any(first[begins:]) or begins == memory.frames:
        raise ObservationError(
            f"only the first frames of an episode are padded, the same of all keys, and not {sorted(padded)}"
        )
    rest = {key: value for key, value in observation.items() if not key.endswith(PAD)}
    return [
        {key: value[place] if key in framed else value for key, value in rest.items()}
        for place in range(begins, memory.frames)
    ]
