"""A robot as a LeRobot checkpoint describes it: the keys of its config.json's features.

LeRobot puts the cameras that an observation has first, in its config's order, and masks the others after them. Source:
LeRobot's `PI05Policy._preprocess_images` (0.6.1).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from turbopi.errors import ConfigError, ObservationError
from turbopi.images import parse_unit_image
from turbopi.robots.base import (
    Robot,
    RobotInputs,
    black_like,
    find,
    has,
    listed,
    names_in_prefix,
    read_prompt,
    read_state,
    require,
)

STATE, TASK, IMAGES = "observation.state", "task", "observation.images."


@dataclass(frozen=True)
class LeRobot(Robot):
    """LeRobot's keys.

    in      observation.images.*   (uint8|float)[3, h, w] or [h, w, 3], uint8 in [0, 255] or float in [0, 1]
            observation.state      float[state_dim]
            task                   text
    out     [H, action_dim]

    image_keys           the checkpoint's cameras, full keys in its order. One that an observation lacks is masked, as
                         LeRobot does, unless the observation has a camera of another name: then one of them is
                         misspelt, and it is refused
    num_missing_cameras  masked cameras after them (LeRobot's empty_cameras)
    """

    image_keys: Sequence[str]
    state_dim: int = field()  # field(): no default, where the protocol has one
    action_dim: int = field()
    num_missing_cameras: int = 0

    name = "lerobot"

    def __post_init__(self) -> None:
        if isinstance(self.image_keys, str) or not self.image_keys or len({*self.image_keys}) != len(self.image_keys):
            raise ConfigError(f"image_keys must be a list of different keys, got {self.image_keys!r}")
        for option, least in (("state_dim", 1), ("action_dim", 1), ("num_missing_cameras", 0)):
            value = getattr(self, option)
            if not isinstance(value, int) or value < least:
                raise ConfigError(f"{option} must be an integer of at least {least}, got {value!r}")

    def inputs(self, observation: Mapping[str, Any]) -> RobotInputs:
        expected = (*self.image_keys, STATE, TASK)
        present = [key for key in self.image_keys if has(observation, key)]
        absent = [key for key in self.image_keys if key not in present]
        self._check_cameras(observation, present, absent)
        images = {key: parse_unit_image(find(observation, key), key) for key in present}
        black = black_like(next(iter(images.values())))
        masked = [*absent, *(f"missing_{i}" for i in range(self.num_missing_cameras))]
        return RobotInputs(
            images | dict.fromkeys(masked, black),
            dict.fromkeys(present, True) | dict.fromkeys(masked, False),
            read_state(require(observation, STATE, expected), STATE, self.state_dim),
            self._prompt(observation),
            in_order=True,
        )

    def _check_cameras(self, observation: Mapping[str, Any], present: list[str], absent: list[str]) -> None:
        others = [key for key in names_in_prefix(observation, IMAGES) if key not in self.image_keys]
        if present and not (absent and others):
            return
        raise ObservationError(
            f"the observation's cameras are {listed([*present, *others])}; "
            f"this checkpoint's are {', '.join(self.image_keys)}. Rename them; a camera that the robot "
            f"doesn't have can be left out"
        )

    def _prompt(self, observation: Mapping[str, Any]) -> str | None:
        if TASK not in observation:
            return None
        task = observation[TASK]
        if isinstance(task, list | tuple) and len(task) == 1:  # LeRobot's collated form
            task = task[0]
        return read_prompt(task, TASK)

    def outputs(self, actions: np.ndarray) -> np.ndarray:
        return actions[:, : self.action_dim]

    def example(self, rng: np.random.Generator) -> dict[str, Any]:
        pictures = {key: rng.random((3, 224, 224), dtype=np.float32) for key in self.image_keys}
        state = rng.uniform(-1, 1, self.state_dim).astype(np.float32)
        return {**pictures, STATE: state, TASK: "pick up the black bowl and place it on the plate"}
