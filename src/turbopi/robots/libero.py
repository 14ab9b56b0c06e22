"""LIBERO, the simulation benchmark: a Franka arm with a camera at its base and one at its wrist.

openpi's client turns both images by 180 degrees before it sends them; the models were trained on those.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from turbopi.robots.base import (
    Robot,
    RobotInputs,
    action_mask,
    optional_prompt,
    random_image,
    read_state,
    require,
    with_missing_cameras,
)
from turbopi.robots.images import parse_image

KEYS = ("observation/image", "observation/wrist_image", "observation/state", "prompt")


@dataclass(frozen=True)
class Libero(Robot):
    """openpi's LIBERO keys.

    in      observation/image, observation/wrist_image   (uint8|float)[h, w, 3] or [3, h, w]
            observation/state   float[8]: end effector position 3, axis-angle 3, gripper 2
            prompt
    out     [H, 7]: position 3, rotation 3, gripper

    delta_actions   the first six actions are relative to the state: so in openpi's pi0_libero, not in pi05_libero
    """

    delta_actions: bool = False

    name = "libero"
    state_dim = 8
    action_dim = 7
    camera_counts = (2,)

    @property
    def delta_mask(self) -> tuple[bool, ...] | None:  # type: ignore[override]
        return action_mask((6, -1)) if self.delta_actions else None

    def inputs(self, observation: Mapping[str, object]) -> RobotInputs:
        base = parse_image(require(observation, KEYS[0], KEYS), KEYS[0])
        wrist = parse_image(require(observation, KEYS[1], KEYS), KEYS[1])
        images, mask = with_missing_cameras({"base_0_rgb": base, "left_wrist_0_rgb": wrist}, like="base_0_rgb")
        state = read_state(require(observation, KEYS[2], KEYS), KEYS[2], self.state_dim)
        return RobotInputs(images, mask, state, optional_prompt(observation))

    def outputs(self, actions: np.ndarray) -> np.ndarray:
        return actions[:, : self.action_dim]

    def example(self, rng: np.random.Generator) -> dict[str, Any]:
        return {
            "observation/image": random_image(rng),
            "observation/wrist_image": random_image(rng),
            "observation/state": rng.random(self.state_dim),
            "prompt": "pick up the black bowl and place it on the plate",
        }
