"""No particular robot: the model's own cameras, state and actions, for base checkpoints and experiments."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from turbopi.config import CAMERAS
from turbopi.errors import ObservationError
from turbopi.images import parse_image
from turbopi.robots.base import (
    Robot,
    RobotInputs,
    find,
    listed,
    names_in,
    optional_prompt,
    random_image,
    read_state,
    require,
    with_missing_cameras,
)


@dataclass(frozen=True)
class Plain(Robot):
    """The model's own words.

    in      images/{base_0_rgb, left_wrist_0_rgb, right_wrist_0_rgb}   (uint8|float)[h, w, 3] or [3, h, w]; at least
            one, the others are masked; the folder may be called `image`, as inside openpi
            state   float[s], s up to the model's action_dim
            prompt
    out     [H, action_dim], all of the model's dimensions
    """

    name = "plain"

    def inputs(self, observation: Mapping[str, Any]) -> RobotInputs:
        folder, sent = self._sent(observation)
        keys = (*(f"{folder}/{camera}" for camera in CAMERAS), "state", "prompt")
        unexpected = sorted(set(sent) - set(CAMERAS))
        if unexpected or not sent:
            got = listed(unexpected) if unexpected else "no camera"
            raise ObservationError(f"{folder} has {got}; expected at least one of {', '.join(CAMERAS)}")
        pictures = {
            camera: parse_image(find(observation, f"{folder}/{camera}"), f"{folder}/{camera}") for camera in sent
        }
        images, mask = with_missing_cameras(pictures, like=sent[0])
        state = read_state(require(observation, "state", keys), "state", None)
        return RobotInputs(images, mask, state, optional_prompt(observation))

    def _sent(self, observation: Mapping[str, Any]) -> tuple[str, list[str]]:
        """The folder that the pictures are in, and their names."""
        images, image = names_in(observation, "images"), names_in(observation, "image")
        if images and image:
            raise ObservationError("the observation has pictures in both `images` and `image`; send one of the two")
        return ("image", image) if image else ("images", images)

    def outputs(self, actions: np.ndarray) -> np.ndarray:
        return actions

    def example(self, rng: np.random.Generator) -> dict[str, Any]:
        return {
            "images": {camera: random_image(rng) for camera in CAMERAS},
            "state": rng.uniform(-1, 1, 8),
            "prompt": "pick up the red block",
        }
