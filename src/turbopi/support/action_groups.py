"""What people are shown of an observation and its action chunk: its images, and the actions by groups of one unit."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import pi
from typing import Any

import numpy as np


@dataclass(frozen=True)
class ActionGroup:
    """Action dimensions that share one unit, and so one axis.

    limits   what the unit's values range over: the axis shows at least that, so that noise looks as small as it is
    """

    title: str
    unit: str
    names: dict[int, str]  # dimension -> what it moves
    limits: tuple[float, float] | None = None

    def label(self, index: int) -> str:
        """What a dimension moves, for a place where the group's title isn't shown."""
        name = self.names[index]
        return name if name == self.title or name.startswith("action ") else f"{self.title} {name}"


def _numbered(prefix: str, indices: Sequence[int]) -> dict[int, str]:
    return {index: f"{prefix} {number}" for number, index in enumerate(indices, start=1)}


# LIBERO: inputs of robosuite's OSC_POSE controller, whose output_max is 0.05 m and 0.5 rad
_GROUPS: dict[str, list[ActionGroup]] = {
    "libero": [
        ActionGroup("translation", "1 = 0.05 m a step", {0: "x", 1: "y", 2: "z"}, (-1, 1)),
        ActionGroup("rotation", "1 = 0.5 rad a step", {3: "about x", 4: "about y", 5: "about z"}, (-1, 1)),
        ActionGroup("gripper", "−1 open, 1 closed", {6: "gripper"}, (-1, 1)),
    ],
    "droid": [
        ActionGroup("joint velocities", "1 = the fastest command", _numbered("joint", range(7)), (-1, 1)),
        ActionGroup("gripper", "0 open, 1 closed", {7: "gripper"}, (0, 1)),
    ],
    "aloha": [
        ActionGroup("left arm", "rad", _numbered("joint", range(6)), (-pi, pi)),
        ActionGroup("right arm", "rad", _numbered("joint", range(7, 13)), (-pi, pi)),
        ActionGroup("grippers", "0 closed, 1 open", {6: "left", 13: "right"}, (0, 1)),
    ],
}


def known_groups(robot: str) -> list[ActionGroup]:
    """The groups of a robot that comes with Turbo-Pi; none for others."""
    return _GROUPS.get(robot, [])


def action_groups(robot: str, dims: int, names: Sequence[str] | None = None) -> list[ActionGroup]:
    """How the dimensions of a robot's actions belong together; for an unknown robot, groups of eight to be legible.

    names   of an unknown robot's actions, where a dataset has them
    """
    groups = known_groups(robot)
    if sum(len(group.names) for group in groups) == dims:
        return groups
    eights = [range(start, min(start + 8, dims)) for start in range(0, dims, 8)]
    return [
        ActionGroup(
            f"actions {eight[0]} to {eight[-1]}",
            "the robot's units",
            {index: names[index] if names is not None and len(names) == dims else f"action {index}" for index in eight},
        )
        for eight in eights
    ]


def names_of(metadata: Mapping[str, Any], feature: str) -> list[str] | None:
    """The names of a policy's "state" or "actions" as its metadata's "features" tell them; None if they don't."""
    features = metadata.get("features")
    known = features.get(feature) if isinstance(features, Mapping) else None
    if not isinstance(known, list) or not all(isinstance(one, Mapping) for one in known):
        return None  # the policy may be of another make
    return [str(one.get("name", "")) for one in known]


def images_of(observation: Mapping[str, Any], below: str = "") -> dict[str, np.ndarray]:
    """The images in an observation of any robot, by key, as [h, w, 3] to look at."""
    found: dict[str, np.ndarray] = {}
    for key, value in observation.items():
        name = f"{below}/{key}" if below else str(key)
        if isinstance(value, Mapping):
            found |= images_of(value, name)
        elif isinstance(value, np.ndarray) and value.ndim == 3 and value.dtype.kind in "fiu":
            camera_image = value.transpose(1, 2, 0) if value.shape[0] == 3 else value
            if camera_image.shape[-1] == 3:
                found[name] = camera_image if camera_image.dtype == np.uint8 else np.clip(camera_image, 0, 1)
    return found


def task_of(observation: Mapping[str, Any], answer: Mapping[str, Any]) -> str:
    """`prompt_of`, and the subtask that the answer's actions are made of, if that is another text."""
    prompt, subtask = prompt_of(observation), answer.get("subtask")
    return f"{prompt} → {subtask}" if isinstance(subtask, str) and subtask != prompt else prompt


def prompt_of(observation: Mapping[str, Any]) -> str:
    """What an observation of any robot says that the task is: its `prompt`, `task` or only text; "" without one."""
    texts = {key: value for key, value in observation.items() if isinstance(value, str)}
    for key in ("prompt", "task"):
        if key in texts:
            return texts[key]
    own = [text for key, text in texts.items() if not key.startswith("turbopi/")]
    return own[0] if len(own) == 1 else ""
