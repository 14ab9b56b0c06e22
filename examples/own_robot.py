"""Your own robot, as a file and as a class: two ways to say which keys it sends and what it does with actions.

    python examples/own_robot.py                                 # both, on random weights
    turbopi serve CHECKPOINT --robot examples/my_arm.json        # the file
    PYTHONPATH=examples turbopi serve CHECKPOINT --robot own_robot:DegreeArm      # the class, whose code then runs

A file is enough where the model was trained in the robot's units. This class converts: its joints are in degrees, its
gripper counts from 0 (open) to 255 (closed), while the model was trained on radians and on 1 for open.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from turbopi import Robot, RobotInputs, UnifiedPolicy
from turbopi.checkpoint import random_checkpoint
from turbopi.robots import optional_prompt, parse_image, read_state, require

KEYS = ("camera", "degrees", "gripper", "prompt")


class DegreeArm(Robot):
    name = "degree_arm"
    state_dim = 7
    action_dim = 7
    default_prompt = "fold the towel"

    def inputs(self, observation: Mapping[str, object]) -> RobotInputs:
        """The robot's keys and units, in the model's. The readers raise errors that name key, value and expectation."""
        joints = read_state(require(observation, "degrees", KEYS), "degrees", 6)
        gripper = read_state(require(observation, "gripper", KEYS), "gripper", 1)
        return RobotInputs(
            images={"base_0_rgb": parse_image(require(observation, "camera", KEYS), "camera")},
            image_mask={"base_0_rgb": True},
            state=np.concatenate([np.radians(joints), 1 - gripper / 255]),
            prompt=optional_prompt(observation),
        )

    def outputs(self, actions: np.ndarray) -> np.ndarray:
        """The way back."""
        return np.concatenate([np.degrees(actions[:, :6]), 255 * (1 - actions[:, 6:7])], axis=1)

    def example(self, rng: np.random.Generator) -> dict[str, Any]:
        """A random observation, for warm-up."""
        return {
            "camera": rng.integers(256, size=(480, 640, 3), dtype=np.uint8),
            "degrees": rng.uniform(-90, 90, 6),
            "gripper": rng.uniform(0, 255, 1),
            "prompt": "fold the towel",
        }


def main() -> None:
    checkpoint = random_checkpoint("pi05_tiny")  # your folder's path in place of it
    camera_image = np.zeros((480, 640, 3), np.uint8)
    joints = np.array([10.0, -20.0, 30.0, 0.0, 45.0, 90.0])

    file = UnifiedPolicy(checkpoint, robot=str(Path(__file__).with_name("my_arm.json")))
    seen = {"front_camera": camera_image, "wrist_camera": camera_image, "joint_position": np.radians(joints)}
    print("my_arm.json:", file.infer({**seen, "gripper_position": 0.5}, seed=0)["actions"].shape)

    own = UnifiedPolicy(checkpoint, robot=DegreeArm())
    print(
        "DegreeArm:", own.infer({"camera": camera_image, "degrees": joints, "gripper": 128.0}, seed=0)["actions"].shape
    )


if __name__ == "__main__":
    main()
