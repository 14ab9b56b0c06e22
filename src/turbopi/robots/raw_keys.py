"""A robot that sends what LeRobot's `robot.get_observation()` returns: a number a joint, and images by camera.

    {"shoulder_pan.pos": -3.1, …, "gripper.pos": 40.0, "front": uint8[480, 640, 3], "task": "fold the towel"}

It stands on the `LeRobot` robot of a checkpoint, and puts these keys into that one's: the joints in order become
`observation.state`, camera `front` becomes `observation.images.front`. Sources: LeRobot 0.6.1, its robots'
`observation_features` and `action_features`, `build_dataset_frame`, `rollout/context.py`.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from turbopi.robots.base import Robot, RobotInputs, find, has, keys_of, listed, read_state, require
from turbopi.robots.lerobot import IMAGES, STATE, TASK, LeRobot
from turbopi.support.errors import ConfigError, ObservationError
from turbopi.support.reading import listing, read_json, shown

_ARM = (
    *("shoulder_pan.pos", "shoulder_lift.pos", "elbow_flex.pos"),
    *("wrist_flex.pos", "wrist_roll.pos", "gripper.pos"),
)
ROBOT_TYPES: dict[str, tuple[str, ...]] = {
    **dict.fromkeys(("so100_follower", "so101_follower", "koch_follower", "omx_follower"), _ARM),
    "bi_so_follower": tuple(f"{side}_{key}" for side in ("left", "right") for key in _ARM),
    "lekiwi": (*(f"arm_{key}" for key in _ARM), "x.vel", "y.vel", "theta.vel"),
}
ALIASES = {"so100": "so100_follower", "so101": "so101_follower"}
_FIELDS = ("robot_type", "joints", "action_keys", "cameras", "task_key", "named_actions")
_NUMBERS = (".pos", ".vel")  # what LeRobot's policies read of a robot's numbers


@dataclass(frozen=True)
class RawDescription:
    """What is known of such a robot without a checkpoint: a `robot_type` alone, or the fields of a file.

    robot_type     one of ROBOT_TYPES, or with `joints` any name
    joints         keys of the state, in the order in which the model was trained; None: the type's
    action_keys    keys of the actions, in the model's order; None: the checkpoint's own names, or the joints
    cameras        the robot's name -> the checkpoint's, with or without "observation.images."; all are required. None:
                   the checkpoint's own names, of which some may be missing, as in LeRobot
    task_key       of the prompt
    named_actions  whether answers hold the actions under `action_keys`, too
    """

    robot_type: str
    joints: tuple[str, ...] | None = None
    action_keys: tuple[str, ...] | None = None
    cameras: Mapping[str, str] | None = None
    task_key: str = TASK
    named_actions: bool = True

    def on(self, checkpoint: LeRobot) -> "RawKeys":
        """The robot for a checkpoint, which is described by its own robot. Raises ConfigError if they don't fit."""
        joints, recorded = self.joints or ROBOT_TYPES[self.robot_type], checkpoint.action_names
        if self.action_keys is None and recorded is not None:
            if set(recorded) != set(joints):
                raise ConfigError(
                    f"robot {self.robot_type} has {listed(joints)}, but the checkpoint's actions are "
                    f"{listed(recorded)}. Is it for another robot? If not, say `joints` and `action_keys` in a .json"
                )
            if self.joints is None:  # the order of the recording robot, which had the same keys
                joints = tuple(recorded)
        actions = self.action_keys or recorded or joints
        for what, keys, width in (
            ("numbers of state", joints, checkpoint.state_dim),
            ("actions", actions, checkpoint.action_dim),
        ):
            if len(keys) != width:
                raise ConfigError(
                    f"robot {self.robot_type} has {len(keys)} {what}, {listed(keys)}, but the checkpoint has {width}"
                )
        return RawKeys(self.robot_type, checkpoint, joints, tuple(actions), self._sent(checkpoint), self)

    def _sent(self, checkpoint: LeRobot) -> dict[str, str]:
        """The robot's name of each camera -> the key under which the checkpoint's robot reads it."""
        by_name = {key.removeprefix(IMAGES): checkpoint.sent_as(key) for key in checkpoint.image_keys}
        if self.cameras is None:
            return {sent.removeprefix(IMAGES): sent for sent in by_name.values()}
        for camera, name in self.cameras.items():
            if name.removeprefix(IMAGES) not in by_name:
                raise ConfigError(
                    f"cameras[{camera!r}] is {shown(name)}, but the checkpoint's cameras are {listed(by_name)}"
                )
        return {camera: by_name[name.removeprefix(IMAGES)] for camera, name in self.cameras.items()}


@dataclass(frozen=True)
class RawKeys(Robot):
    """A robot with LeRobot's raw keys, for one checkpoint: see the module, and `RawDescription`.

    in      a number for each of `joints`, (uint8|float)[h, w, 3] or [3, h, w] for each camera, text at the task's key
    out     [H, action_dim], in the order of `keys`
    """

    name: str = field()  # field(): no default, where the protocol has one
    checkpoint: LeRobot = field()
    joints: tuple[str, ...] = field()
    keys: tuple[str, ...] = field()
    cameras: Mapping[str, str] = field()
    described: RawDescription = field()

    @property
    def state_dim(self) -> int:  # type: ignore[override]
        return self.checkpoint.state_dim

    @property
    def action_dim(self) -> int:  # type: ignore[override]
        return self.checkpoint.action_dim

    @property
    def delta_mask(self) -> tuple[bool, ...] | None:  # type: ignore[override]
        return self.checkpoint.delta_mask

    @property
    def action_keys(self) -> tuple[str, ...] | None:  # type: ignore[override]
        return self.keys if self.described.named_actions else None

    @property
    def camera_counts(self) -> tuple[int, ...]:  # type: ignore[override]
        return self.checkpoint.camera_counts if self.described.cameras is None else (len(self.cameras),)

    @cached_property
    def _expected(self) -> tuple[str, ...]:
        return (*self.joints, *self.cameras, self.described.task_key)

    def inputs(self, observation: Mapping[str, object]) -> RobotInputs:
        numbers = [read_state(require(observation, key, self._expected), key, 1) for key in self.joints]
        others = [str(key) for key in observation if str(key).endswith(_NUMBERS) and key not in self.joints]
        if others:
            raise ObservationError(
                f"the observation has {listed(others)}, which robot {self.name} doesn't; its joints are "
                f"{listed(self.joints)}"
            )
        with np.errstate(over="ignore"):  # the pipeline refuses what isn't finite
            named: dict[str, object] = {self.checkpoint.sent_as(STATE): np.concatenate(numbers).astype(np.float32)}
        named |= self._images(observation)
        if has(observation, self.described.task_key):
            named[TASK] = find(observation, self.described.task_key)
        return self.checkpoint.inputs(named)

    def _images(self, observation: Mapping[str, object]) -> dict[str, object]:
        """The images under the checkpoint's keys. Without `cameras` in the description, images of other names are
        handed on, too: they are `unread`.
        """
        if self.described.cameras is not None:
            return {sent: require(observation, raw, self._expected) for raw, sent in self.cameras.items()}
        if not any(camera in observation for camera in self.cameras):
            raise ObservationError(
                f"the observation has none of the checkpoint's cameras, {listed(self.cameras)}. It has "
                f"{listed(keys_of(observation))}; `cameras` in a robot's .json maps the names"
            )
        return {
            self.cameras.get(key, IMAGES + str(key)): value
            for key, value in observation.items()
            if key in self.cameras or getattr(value, "ndim", 0) == 3
        }

    def outputs(self, actions: np.ndarray) -> np.ndarray:
        return self.checkpoint.outputs(actions)

    def example(self, rng: np.random.Generator) -> dict[str, Any]:
        camera_images = {camera: rng.integers(256, size=(480, 640, 3), dtype=np.uint8) for camera in self.cameras}
        numbers = {key: float(rng.uniform(-1, 1)) for key in self.joints}
        return {**numbers, **camera_images, self.described.task_key: "pick up the red block"}


def raw_description(robot: object) -> RawDescription | None:
    """The robot type of that name, or what the .json at that path describes; None if it is of another kind.

    Raises ConfigError, naming file and field, for a description that isn't right.
    """
    if not isinstance(robot, str | Path):
        return None
    name = ALIASES.get(str(robot), str(robot))
    if name in ROBOT_TYPES:
        return RawDescription(name)
    if not name.endswith(".json"):
        return None
    path = Path(robot).expanduser()
    described = read_json(path, ConfigError)
    if not isinstance(described, dict) or "robot_type" not in described:
        return None
    try:
        return _parsed(described)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None


def _parsed(described: dict[str, Any]) -> RawDescription:
    if unknown := sorted(described.keys() - {*_FIELDS}):
        raise ConfigError(f"unknown field {listing(unknown)}; a robot with robot_type has {', '.join(_FIELDS)}")
    robot_type = described["robot_type"]
    _expect(isinstance(robot_type, str) and robot_type != "", "robot_type", "text", robot_type)
    robot_type = ALIASES.get(robot_type, robot_type)
    keys: dict[str, tuple[str, ...] | None] = {}
    for name in ("joints", "action_keys"):
        value = described.get(name)
        right = isinstance(value, list) and all(isinstance(key, str) for key in value) and len(set(value)) == len(value)
        _expect(value is None or (right and value != []), name, "a list of different keys", value)
        keys[name] = None if value is None else tuple(value)
    if keys["joints"] is None and robot_type not in ROBOT_TYPES:
        raise ConfigError(f"robot_type {shown(robot_type)} needs `joints`; known without are {', '.join(ROBOT_TYPES)}")
    cameras = described.get("cameras")
    right = isinstance(cameras, dict) and cameras != {} and all(isinstance(name, str) for name in cameras.values())
    _expect(cameras is None or right, "cameras", "an object: the robot's name -> the checkpoint's", cameras)
    if cameras is not None and len({name.removeprefix(IMAGES) for name in cameras.values()}) < len(cameras):
        raise ConfigError(f"cameras gives one of the checkpoint's cameras to two names: {shown(cameras)}")
    task_key, named = described.get("task_key", TASK), described.get("named_actions", True)
    _expect(isinstance(task_key, str) and task_key != "", "task_key", "text", task_key)
    _expect(isinstance(named, bool), "named_actions", "true or false", named)
    return RawDescription(robot_type, keys["joints"], keys["action_keys"], cameras, task_key, named)


def _expect(right: bool, name: str, expected: str, got: object) -> None:
    if not right:
        raise ConfigError(f"{name} must be {expected}, got {shown(got)}")
