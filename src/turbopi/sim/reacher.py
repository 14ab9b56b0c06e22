"""A tiny built-in simulator: a point in the plane that should reach a goal. It needs nothing to be installed.

It has LIBERO's observations and actions, so that any policy for LIBERO can be run in it: to try the evaluation itself
in seconds, and to test it. Scores in it say nothing about a robot.

    state    position x, y, then six zeros
    action   its first two numbers move the point, by SPEED at most along each axis; the others do nothing
    solved   when the point is within RADIUS of the goal
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from turbopi.sim.base import SimSettings, Task

SPEED = 0.05
RADIUS = 0.06
COLORS = ("red", "green", "blue")
_RGB = {"red": (200, 40, 40), "green": (30, 140, 60), "blue": (40, 80, 200)}
NUM_INITIAL_STATES = 50


class ReacherSimulator:
    """Three tasks, one a colour; the goal is drawn in it."""

    name = "reacher"
    robot = "libero"
    action_dim = 7
    motion_dim = 2
    control_hz = 20.0
    image_keys = ("observation/image", "observation/wrist_image")
    suites = ("reacher_colors",)

    def check(self) -> list[str]:
        return []

    def tasks(self, suite: str) -> Sequence[Task]:
        return [
            Task(index, f"reach_the_{color}_dot", f"reach the {color} dot", NUM_INITIAL_STATES, 40)
            for index, color in enumerate(COLORS)
        ]

    def open(self, suite: str, task: int, settings: SimSettings) -> "ReacherEnvironment":
        return ReacherEnvironment(COLORS[task], task, settings)

    def example(self, settings: SimSettings) -> dict[str, Any]:
        environment = ReacherEnvironment(COLORS[0], 0, settings)
        environment.reset(0)
        return environment.observation()

    def standing_still(self, last: np.ndarray) -> np.ndarray:
        return np.zeros_like(last)

    def versions(self) -> dict[str, str]:
        return {}


class ReacherEnvironment:
    """The point starts where the initial state says; the seed places the goal, as it places LIBERO's fixtures."""

    def __init__(self, color: str, task: int, settings: SimSettings) -> None:
        self.color, self.task, self.settings = color, task, settings
        self.position, self.goal = np.zeros(2), np.zeros(2)
        self._images: list[np.ndarray] = []

    def reset(self, initial_state: int) -> None:
        if self.settings.seeding == "episode":
            seeds = [self.settings.episode_seed(self.task, initial_state)]
        else:
            seeds = [self.settings.seed, initial_state]  # the n-th draw of the task's generator
        self.goal = np.random.default_rng(seeds).uniform(0.2, 0.8, 2)
        self.position = np.random.default_rng(1000 + initial_state).uniform(-0.9, 0.0, 2)
        for step in range(self.settings.wait_steps + 1):
            self.step(np.zeros(7), look=step == self.settings.wait_steps)

    def observation(self) -> dict[str, Any]:
        assert self._images, "the step before took no images"
        base, wrist = self._images
        return {
            "observation/image": base,
            "observation/wrist_image": wrist,
            "observation/state": np.concatenate([self.position, np.zeros(6)]),
            "prompt": f"reach the {self.color} dot",
        }

    def step(self, action: np.ndarray, look: bool) -> bool:
        self.position = np.clip(self.position + SPEED * np.clip(action[:2], -1, 1), -1, 1)
        self._images = self.draw() if look else []
        return bool(np.linalg.norm(self.position - self.goal) < RADIUS)

    def draw(self) -> list[np.ndarray]:
        """The whole plane, and its part around the point."""
        return [self._view(np.zeros(2), 1.1), self._view(self.position, 0.3)]

    def close(self) -> None:
        self._images = []

    def _view(self, centre: np.ndarray, half_width: float) -> np.ndarray:
        px = self.settings.camera_px
        camera_image = np.full((px, px, 3), 235, np.uint8)
        axis = (np.arange(px) + 0.5) / px * 2 - 1
        for place, radius, color in ((self.goal, RADIUS, _RGB[self.color]), (self.position, RADIUS / 2, (20, 20, 20))):
            x, y = (place - centre) / half_width
            inside = (axis[None, :] - x) ** 2 + (axis[:, None] + y) ** 2 < (radius / half_width) ** 2
            camera_image[inside] = color
        return camera_image
