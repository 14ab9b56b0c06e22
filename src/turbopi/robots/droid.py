"""DROID: a Franka arm with exterior cameras and one at its wrist."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from turbopi.robots.base import (
    Robot,
    RobotInputs,
    black_like,
    optional_prompt,
    random_image,
    read_state,
    require,
    with_missing_cameras,
)
from turbopi.robots.images import parse_image

KEYS = (
    "observation/exterior_image_1_left",
    "observation/wrist_image_left",
    "observation/joint_position",
    "observation/gripper_position",
    "prompt",
)


@dataclass(frozen=True)
class Droid(Robot):
    """openpi's DROID keys.

    in      observation/exterior_image_1_left, observation/wrist_image_left   (uint8|float)[h, w, 3] or [3, h, w]
            observation/joint_position   float[7];   observation/gripper_position   float[1] or a scalar
            prompt
    out     [H, 8]: 7 joint velocities, gripper position

    wrist_last   a black image stands between the two cameras: so in openpi's pi0_fast_droid
    """

    wrist_last: bool = False

    name = "droid"
    state_dim = 8
    action_dim = 8
    camera_counts = (2,)

    def inputs(self, observation: Mapping[str, object]) -> RobotInputs:
        base = parse_image(require(observation, KEYS[0], KEYS), KEYS[0])
        wrist = parse_image(require(observation, KEYS[1], KEYS), KEYS[1])
        if self.wrist_last:
            images = {"base_0_rgb": base, "base_1_rgb": black_like(base), "wrist_0_rgb": wrist}
            mask = {camera: camera != "base_1_rgb" for camera in images}
        else:
            images, mask = with_missing_cameras({"base_0_rgb": base, "left_wrist_0_rgb": wrist}, like="base_0_rgb")
        joints = read_state(require(observation, KEYS[2], KEYS), KEYS[2], 7)
        gripper = read_state(require(observation, KEYS[3], KEYS), KEYS[3], 1)
        state = np.concatenate([joints, gripper])
        return RobotInputs(images, mask, state, optional_prompt(observation), in_order=self.wrist_last)

    def outputs(self, actions: np.ndarray) -> np.ndarray:
        return actions[:, : self.action_dim]

    def example(self, rng: np.random.Generator) -> dict[str, Any]:
        return {
            "observation/exterior_image_1_left": random_image(rng),
            "observation/wrist_image_left": random_image(rng),
            "observation/joint_position": rng.random(7),
            "observation/gripper_position": rng.random(1),
            "prompt": "put the marker in the cup",
        }
