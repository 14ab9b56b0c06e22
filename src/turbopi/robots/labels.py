"""What people call the numbers of a robot's state, its actions and its cameras, and their units where known."""

from collections import Counter
from typing import Any, NamedTuple

from turbopi.robots.base import Robot
from turbopi.robots.described import Described
from turbopi.robots.lerobot import IMAGES, LeRobot
from turbopi.robots.raw_keys import RawKeys
from turbopi.support.action_groups import known_groups


class Label(NamedTuple):
    """unit  "" where it isn't known"""

    name: str
    unit: str = ""


def _joints(side: str = "") -> list[Label]:
    return [Label(f"{side}joint {number}", "rad") for number in range(1, 7)]


_STATES = {  # as their openpi clients send them
    "libero": [
        *(Label(axis, "m") for axis in "xyz"),
        *(Label(f"axis-angle {axis}", "rad") for axis in "xyz"),
        *(Label(f"finger {number}", "m") for number in (1, 2)),
    ],
    "droid": [*_joints(), Label("joint 7", "rad"), Label("gripper", "0 open, 1 closed")],
    "aloha": [
        label for side in ("left ", "right ") for label in (*_joints(side), Label(f"{side}gripper", "0 closed, 1 open"))
    ],
}
_CAMERAS = {
    "libero": {"base_0_rgb": "observation/image", "left_wrist_0_rgb": "observation/wrist_image"},
    "droid": {
        "base_0_rgb": "observation/exterior_image_1_left",
        "left_wrist_0_rgb": "observation/wrist_image_left",
        "wrist_0_rgb": "observation/wrist_image_left",
    },
    "aloha": {
        "base_0_rgb": "images/cam_high",
        "left_wrist_0_rgb": "images/cam_left_wrist",
        "right_wrist_0_rgb": "images/cam_right_wrist",
    },
}


def state_labels(robot: Robot, width: int) -> list[Label]:
    """Of the first `width` numbers of the robot's state; "value 3" where nobody named them, counted from 0."""
    known: list[Label] = _STATES.get(robot.name, []) if is_built_in(robot) else []
    if isinstance(robot, RawKeys):
        known = [Label(name) for name in robot.joints]
    elif isinstance(robot, Described):
        known = [
            Label(key if count == 1 else f"{key}[{index}]")
            for key, count in robot.state.items()
            for index in range(count)
        ]
    return _filled(known, "value", width)


def action_labels(robot: Robot, width: int) -> list[Label]:
    """Of the first `width` actions, in the order of the statistics; "action 3" where nobody named them, from 0."""
    if not is_built_in(robot):  # its own `outputs` may reorder them
        return _filled([], "action", width)
    keys: Any = robot.keys if isinstance(robot, RawKeys) else robot.action_keys or getattr(robot, "action_names", None)
    if keys is not None:
        return _filled([Label(str(key)) for key in keys], "action", width)
    groups = [] if isinstance(robot, Described) else known_groups(robot.name)
    often = Counter(name for group in groups for name in group.names.values())
    known = {
        index: Label(name if often[name] == 1 else f"{group.title} {name}", group.unit)
        for group in groups
        for index, name in group.names.items()
    }
    return _filled([known[index] for index in sorted(known)], "action", width)


def camera_label(robot: Robot, camera: str) -> str:
    """The key under which the robot sends what it calls `camera` in its `inputs`."""
    if isinstance(robot, RawKeys):
        sent = {robot.checkpoint.sent_as(key): key for key in robot.checkpoint.image_keys}
        return next((raw for raw, key in robot.cameras.items() if sent.get(key) == camera), camera)
    if isinstance(robot, LeRobot):
        return robot.sent_as(camera).removeprefix(IMAGES)
    if isinstance(robot, Described):
        return next((key for key, name in robot.cameras.items() if name == camera), camera)
    return _CAMERAS.get(robot.name, {}).get(camera, camera) if is_built_in(robot) else camera


def is_built_in(robot: Robot) -> bool:
    """Whether its class comes with Turbo-Pi: then its actions are the model's, in their order."""
    return type(robot).__module__.startswith("turbopi.")


def _filled(known: list[Label], what: str, width: int) -> list[Label]:
    return [*known[:width], *(Label(f"{what} {index}") for index in range(len(known), width))]
