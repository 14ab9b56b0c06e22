"""No particular robot: the model's own cameras, state and actions, for base checkpoints and experiments."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from turbopi.config import CAMERAS
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
from turbopi.robots.images import parse_image
from turbopi.support.errors import ObservationError


@dataclass(frozen=True)
class Plain(Robot):
    """The model's own words.

    in      images/{base_0_rgb, left_wrist_0_rgb, right_wrist_0_rgb}   (uint8|float)[h, w, 3] or [3, h, w]; at least
            one, the others are masked; the folder may be called `image`, as inside openpi
            image_mask/{the same}   bool, may be left out; False: as if there were no such image
            state   float[s], for Pi0 s up to the model's action_dim
            prompt
    out     [H, action_dim], all of the model's dimensions
    """

    name = "plain"
    camera_counts = tuple(range(1, len(CAMERAS) + 1))

    def inputs(self, observation: Mapping[str, object]) -> RobotInputs:
        folder, sent = self._sent(observation)
        keys = (*(f"{folder}/{camera}" for camera in CAMERAS), "state", "prompt")
        unexpected = sorted(set(sent) - set(CAMERAS))
        if unexpected or not sent:
            got = listed(unexpected) if unexpected else "no camera"
            raise ObservationError(f"{folder} has {got}; expected at least one of {', '.join(CAMERAS)}")
        camera_images = {
            camera: parse_image(find(observation, f"{folder}/{camera}"), f"{folder}/{camera}") for camera in sent
        }
        camera_images = self._unmasked(observation, folder, camera_images)
        images, mask = with_missing_cameras(camera_images, like=next(iter(camera_images)))
        state = read_state(require(observation, "state", keys), "state", None)
        return RobotInputs(images, mask, state, optional_prompt(observation))

    def _unmasked(
        self, observation: Mapping[str, object], folder: str, camera_images: dict[str, np.ndarray]
    ) -> dict[str, np.ndarray]:
        """Those that `image_mask` doesn't leave out."""
        masks = {}
        for camera in names_in(observation, "image_mask"):
            key = f"image_mask/{camera}"
            value = find(observation, key)
            if camera not in CAMERAS:
                raise ObservationError(f"{key} is of no camera; the model's are {', '.join(CAMERAS)}")
            if isinstance(value, np.ndarray) and value.size == 1:
                value = value.item()
            if not isinstance(value, bool | np.bool_):
                raise ObservationError(f"{key} is {str(value)[:60]}; expected true or false")
            masks[camera] = bool(value)
            if masks[camera] and camera not in camera_images:
                raise ObservationError(f"{key} is True, but {folder} has no {camera}")
        left = {camera: camera_image for camera, camera_image in camera_images.items() if masks.get(camera, True)}
        if not left:
            raise ObservationError(
                f"image_mask leaves out all of {', '.join(camera_images)}; the model needs one camera"
            )
        return left

    def _sent(self, observation: Mapping[str, object]) -> tuple[str, list[str]]:
        """The folder that the images are in, and their names."""
        images, image = names_in(observation, "images"), names_in(observation, "image")
        if images and image:
            raise ObservationError("the observation has images in both `images` and `image`; send one of the two")
        return ("image", image) if image else ("images", images)

    def outputs(self, actions: np.ndarray) -> np.ndarray:
        return actions

    def example(self, rng: np.random.Generator) -> dict[str, Any]:
        return {
            "images": {camera: random_image(rng) for camera in CAMERAS},
            "state": rng.uniform(-1, 1, 8),
            "prompt": "pick up the red block",
        }
