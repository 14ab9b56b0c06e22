"""A robot as a LeRobot checkpoint describes it: the keys of its config.json's features.

LeRobot renames an observation's keys, puts the cameras that it has first, in its config's order, and masks the others
after them. Sources: LeRobot's `RenameObservationsProcessorStep` and `PI05Policy._preprocess_images` (0.6.1).
"""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

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
from turbopi.robots.images import parse_unit_image
from turbopi.support.errors import ConfigError, ObservationError

logger = logging.getLogger(__name__)

STATE, TASK, IMAGES = "observation.state", "task", "observation.images."


@dataclass(frozen=True)
class LeRobot(Robot):
    """LeRobot's keys.

    in      observation.images.*   (uint8|float)[3, h, w] or [h, w, 3], uint8 in [0, 255] or float in [0, 1]
            observation.state      float[state_dim]
            task                   text
    out     [H, action_dim]

    image_keys           the checkpoint's cameras, full keys in its order. One that an observation lacks is masked, as
                         in LeRobot, and the log warns once; cameras of other names aren't read
    num_missing_cameras  LeRobot's empty_cameras after them: masked, unless an observation has observation.images.empty_
                         camera_0, ...
    camera_order         all of these keys, in the checkpoint's order, where that is another
    rename_map           observations' keys -> the checkpoint's; where an observation has both, the later one is read
    relative_dims        per action, whether the model's is relative to the state
    action_names         the recording robot's key of each action, where the checkpoint has them
    """

    image_keys: Sequence[str]
    state_dim: int = field()  # field(): no default, where the protocol has one
    action_dim: int = field()
    num_missing_cameras: int = 0
    rename_map: Mapping[str, str] | None = None
    relative_dims: Sequence[bool] | None = None
    action_names: Sequence[str] | None = None
    camera_order: Sequence[str] | None = None

    name = "lerobot"

    def __post_init__(self) -> None:
        if isinstance(self.image_keys, str) or not self.image_keys or len({*self.image_keys}) != len(self.image_keys):
            raise ConfigError(f"image_keys must be a list of different keys, got {self.image_keys!r}")
        for option, least in (("state_dim", 1), ("action_dim", 1), ("num_missing_cameras", 0)):
            value = getattr(self, option)
            if not isinstance(value, int) or value < least:
                raise ConfigError(f"{option} must be an integer of at least {least}, got {value!r}")
        renames = {} if self.rename_map is None else self.rename_map
        if not isinstance(renames, Mapping) or not all(
            isinstance(text, str) for pair in renames.items() for text in pair
        ):
            raise ConfigError(f"rename_map must be an object of keys and their new names, got {self.rename_map!r}")
        relative = () if self.relative_dims is None else self.relative_dims
        if not isinstance(relative, list | tuple) or not all(isinstance(flag, bool) for flag in relative):
            raise ConfigError(f"relative_dims must be a list of true and false, got {self.relative_dims!r}")
        if len(relative) > min(self.action_dim, self.state_dim):
            raise ConfigError(
                f"relative_dims has {len(relative)} dimensions, but there are {self.action_dim} of actions and "
                f"{self.state_dim} of the state"
            )
        order, count = self.camera_order, len(self.image_keys) + self.num_missing_cameras
        if order is not None and not (
            isinstance(order, list | tuple)
            and all(isinstance(key, str) for key in order)
            and len({*order}) == len(order) == count
            and {*order} >= {*self.image_keys}
        ):
            raise ConfigError(
                f"camera_order must be a list of {count} different keys: image_keys and num_missing_cameras = "
                f"{self.num_missing_cameras} more, got {order!r}"
            )
        names = self.action_names
        if names is not None and not (
            isinstance(names, list | tuple)
            and all(isinstance(name, str) for name in names)
            and len({*names}) == len(names) == self.action_dim
        ):
            raise ConfigError(f"action_names must be a list of {self.action_dim} different names, got {names!r}")

    @property
    def delta_mask(self) -> tuple[bool, ...] | None:  # type: ignore[override]
        return None if self.relative_dims is None else tuple(self.relative_dims)

    @property
    def features(self) -> dict[str, object]:
        """What LeRobot on a robot's computer needs to know of the checkpoint: a part of the policy's metadata."""
        return {
            "robot_cameras": list(map(self.sent_as, self.image_keys)),
            "robot_action_names": None if self.action_names is None else list(self.action_names),
        }

    @property
    def camera_counts(self) -> tuple[int, ...]:  # type: ignore[override]
        return tuple(range(1, len(self.image_keys) + 1))

    @cached_property
    def _warned(self) -> set[tuple[str, ...]]:
        """Missing cameras that the log has said: at most every choice of the checkpoint's."""
        return set()

    @cached_property
    def _cameras(self) -> Sequence[str]:
        """All keys that images are read from: of the checkpoint's cameras, and of LeRobot's empty ones."""
        if self.camera_order is not None:
            return self.camera_order
        return (*self.image_keys, *(f"{IMAGES}empty_camera_{i}" for i in range(self.num_missing_cameras)))

    @cached_property
    def _expected(self) -> tuple[str, ...]:
        """What an observation should have, for a message."""
        return (*map(self.sent_as, self.image_keys), self.sent_as(STATE), TASK)

    def inputs(self, observation: Mapping[str, object]) -> RobotInputs:
        named = self._renamed(observation)
        present = [key for key in self._cameras if has(named, key)]
        absent = [key for key in self.image_keys if key not in present]
        others = [key for key in names_in_prefix(named, IMAGES) if key not in self._cameras]
        if not present:
            theirs = f"the observation's cameras are {listed(others)}" if others else "the observation has no camera"
            raise ObservationError(
                f"{theirs}; this checkpoint's are "
                f"{', '.join(map(self.sent_as, self.image_keys))}. Rename them; a camera that the robot doesn't have "
                "can be left out"
            )
        missing = tuple(map(self.sent_as, absent))
        if missing and missing not in self._warned:  # not at every step of an episode
            self._warned.add(missing)
            logger.warning(
                "the observation lacks %s, which is masked, as in LeRobot: the model acts without it", listed(missing)
            )
        images = {key: parse_unit_image(find(named, key), key) for key in present}
        black = black_like(next(iter(images.values())))
        spare = (key for key in self._cameras if key not in self.image_keys)
        masked = [*absent, *(f"missing_{i}" for i, key in enumerate(spare) if key not in present)]
        return RobotInputs(
            images | dict.fromkeys(masked, black),
            dict.fromkeys(present, True) | dict.fromkeys(masked, False),
            read_state(require(named, STATE, self._expected), STATE, self.state_dim),
            self._prompt(observation),
            in_order=True,
            missing=missing,
            unread=tuple(others),
        )

    def _renamed(self, observation: Mapping[str, object]) -> Mapping[str, object]:
        if not self.rename_map:
            return observation
        return {self.rename_map.get(key, key): value for key, value in observation.items()}

    def sent_as(self, key: str) -> str:
        """What observations call a key of the checkpoint's."""
        return next((old for old, new in (self.rename_map or {}).items() if new == key), key)

    def _prompt(self, observation: Mapping[str, object]) -> str | None:
        if TASK not in observation:
            return None
        task = observation[TASK]
        if isinstance(task, list | tuple) and len(task) == 1:  # LeRobot's collated form
            task = task[0]
        return read_prompt(task, TASK)

    def outputs(self, actions: np.ndarray) -> np.ndarray:
        return actions[:, : self.action_dim]

    def example(self, rng: np.random.Generator) -> dict[str, Any]:
        camera_images = {self.sent_as(key): rng.random((3, 224, 224), dtype=np.float32) for key in self.image_keys}
        state = rng.uniform(-1, 1, self.state_dim).astype(np.float32)
        return {
            **camera_images,
            self.sent_as(STATE): state,
            TASK: "pick up the black bowl and place it on the plate",
        }
