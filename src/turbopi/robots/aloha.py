"""ALOHA: two ViperX arms with a gripper each, a camera above and one at each wrist.

openpi's base models saw these arms in another convention: some joints turn the other way, and grippers are angles, not
positions. `adapt_to_pi` converts both ways. Source: openpi's `aloha_policy.py` (constants from Interbotix and Trossen).
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from turbopi.robots.base import (
    Robot,
    RobotInputs,
    action_mask,
    listed,
    names_in,
    optional_prompt,
    random_image,
    read_state,
    require,
    with_missing_cameras,
)
from turbopi.robots.images import parse_chw_image
from turbopi.support.errors import ObservationError

CAMERA_OF = {
    "cam_high": "base_0_rgb",
    "cam_left_wrist": "left_wrist_0_rgb",
    "cam_right_wrist": "right_wrist_0_rgb",
}
IGNORED = "cam_low"  # clients send it, no model reads it
_ACCEPTED = frozenset((*CAMERA_OF, IGNORED))
KEYS = ("state", *(f"images/{camera}" for camera in CAMERA_OF), "prompt")

_FLIP = np.array([1.0, -1, -1, 1, 1, 1, 1] * 2)
_GRIPPERS = slice(6, 14, 7)  # 6 and 13
_GRIPPER_POSITION = (0.01844, 0.058)  # m, closed and open
_GRIPPER_JOINT = (-0.6213, 1.4910)  # rad, closed and open, in the robot's actions
_PI_GRIPPER = (0.5476, 1.6296)  # rad, what the base models call 0 and 1
_SMOLVLA_GRIPPER = (0.4, 1.5)  # rad, what LeRobot's SmolVLA calls 0 and 1
_ARM, _HORN = 0.036, 0.022  # m, the gripper's linkage


@dataclass(frozen=True)
class Aloha(Robot):
    """openpi's ALOHA keys.

    in      state   float[14]: left joints 6, left gripper, right joints 6, right gripper
            images/cam_high (required), images/cam_left_wrist, images/cam_right_wrist   (uint8|float)[3, h, w]
            images/cam_low is accepted and ignored; any other camera is refused
            prompt
    out     [H, 14], absolute joint positions and grippers

    adapt_to_pi     convert to the base models' joints and grippers; False for the simulator and for robots whose data
                    wasn't converted in training
    delta_actions   the model's joint actions are relative to the state, as openpi trains them
    """

    adapt_to_pi: bool = True
    delta_actions: bool = True

    name = "aloha"
    state_dim = 14
    action_dim = 14
    camera_counts = (1, 2, 3)

    @property
    def delta_mask(self) -> tuple[bool, ...] | None:  # type: ignore[override]
        return action_mask((6, -1, 6, -1)) if self.delta_actions else None

    @property
    def reset_pose(self) -> list[float] | None:  # type: ignore[override]
        """Six joints of either arm, from openpi's policy metadata; the simulator has none."""
        return [0.0, -1.5, 1.5, 0.0, 0.0, 0.0] if self.adapt_to_pi else None

    def inputs(self, observation: Mapping[str, object]) -> RobotInputs:
        sent = names_in(observation, "images")
        if unexpected := set(sent) - _ACCEPTED:
            raise ObservationError(
                f"unexpected cameras in images: {listed(sorted(unexpected))}; expected "
                f"{', '.join((*CAMERA_OF, IGNORED))}"
            )
        camera_images = {}
        for name, camera in CAMERA_OF.items():
            if name in sent or name == "cam_high":
                key = f"images/{name}"
                camera_images[camera] = parse_chw_image(require(observation, key, KEYS), key)
        images, mask = with_missing_cameras(camera_images, like="base_0_rgb")
        state = read_state(require(observation, "state", KEYS), "state", self.state_dim)
        return RobotInputs(images, mask, self._to_pi(state), optional_prompt(observation))

    def _to_pi(self, state: np.ndarray) -> np.ndarray:
        return turned(state, gripper_to_angle) if self.adapt_to_pi else state

    def outputs(self, actions: np.ndarray) -> np.ndarray:
        actions = actions[:, : self.action_dim]
        return turned(actions, gripper_from_angle) if self.adapt_to_pi else actions

    def example(self, rng: np.random.Generator) -> dict[str, Any]:
        camera_images = {camera: np.ascontiguousarray(random_image(rng).transpose(2, 0, 1)) for camera in CAMERA_OF}
        return {"state": rng.random(self.state_dim), "images": camera_images, "prompt": "transfer cube"}


def turned(values: np.ndarray, gripper: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """[..., 14 at least]: joints that turn the other way, `gripper` of the grippers, and what is behind them."""
    joints = len(_FLIP)
    found = np.concatenate((_FLIP * values[..., :joints], values[..., joints:]), -1)
    found[..., _GRIPPERS] = gripper(found[..., _GRIPPERS])
    return found


def smolvla_state(state: np.ndarray) -> np.ndarray:
    """A normalised state as SmolVLA sees it with LeRobot's `adapt_to_pi_aloha`: it turns normalised numbers."""
    return turned(state, lambda position: gripper_to_angle(position, _SMOLVLA_GRIPPER))


def smolvla_actions(actions: np.ndarray) -> np.ndarray:
    """SmolVLA's actions as they are un-normalised then."""
    low, high = _SMOLVLA_GRIPPER
    closed, opened = _GRIPPER_JOINT
    return turned(actions, lambda value: (value * (high - low) + low - closed) / (opened - closed))


def gripper_to_angle(position: np.ndarray, scale: tuple[float, float] = _PI_GRIPPER) -> np.ndarray:
    """The robot's gripper state (0 closed, 1 open, linear in position) in the base models' scale (linear in angle)."""
    closed, opened = _GRIPPER_POSITION
    length = position * (opened - closed) + closed
    with np.errstate(divide="ignore", over="ignore"):  # far outside the gripper's range; clipped below
        sine = (_HORN**2 + length**2 - _ARM**2) / (2 * _HORN * length)
    low, high = scale
    return np.asarray((np.arcsin(np.minimum(np.maximum(sine, -1.0), 1.0)) - low) / (high - low))


def gripper_from_angle(value: np.ndarray) -> np.ndarray:
    """A model's gripper action in the robot's scale (both linear in angle)."""
    closed, opened = _GRIPPER_JOINT
    low, _ = _PI_GRIPPER
    return np.asarray((value + low - closed) / (opened - closed))
