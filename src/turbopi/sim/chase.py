"""A built-in dynamic task: catch a target that runs around a post and turns back without warning. NumPy alone.

It has LIBERO's observations and actions, as the reacher. Unlike there, and unlike in LIBERO, time matters: whoever
acts on an old image runs the wrong way, and one that stands still while thinking is too slow.

    target   runs on a circle around the post, and turns back at random moments, which nobody can foresee
    tip      action[:2], cut to length 1, moves it by SPEED in that direction; the other numbers do nothing
    post     a tip that touches it is stopped for good: the episode can't be solved any more
    solved   when the tip has been within RADIUS of the target for HOLD steps in a row
    images the whole table, and its part around the tip: the target in red, where it was TRAIL steps ago in green,
             the tip in blue, the post in grey
    state    position x, y of the tip, then six zeros

Where the target is behind the post there are two ways around it, so that two chunks may disagree.

`Chase` holds N episodes at once, for training; the environment is one of N = 1.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from turbopi.sim.base import SimSettings, Task

SPEED = 0.065  # of the tip, along its way, in a step
RADIUS = 0.09
HOLD = 6
POST = 0.22  # radius, with the tip's own
TURN = 1 / 22  # chance in a step that the target turns back
TRAIL = 3
MAX_STEPS = 60
NUM_INITIAL_STATES = 1000
INSTRUCTION = "catch the runner"
VIEWS = (1.0, 0.4)  # half the width of what the cameras see
BLOB = 0.09  # width of what is drawn, standard deviation
_DRAWN = 4096  # random numbers of an episode; they begin again after that


@dataclass
class Chase:
    """N episodes. Everything is an array with N rows; `surprise` float64[N, M] decides when targets turn back,
    and begins again after M steps."""

    tip: np.ndarray  # float64[N, 2]
    angle: np.ndarray  # float64[N]  of the target
    orbit: np.ndarray  # float64[N]  radius of its circle
    pace: np.ndarray  # float64[N]  its way in a step; negative: clockwise
    before: np.ndarray  # float64[N, TRAIL, 2]  where it was, oldest first
    surprise: np.ndarray
    time: int = 0

    @classmethod
    def start(cls, generators: Sequence[np.random.Generator]) -> "Chase":
        """The tip on one side of the post, the target on the other, more or less."""
        drawn = np.array([generator.uniform(0, 1, 6) for generator in generators])
        surprise = np.array([generator.uniform(0, 1, _DRAWN) for generator in generators])
        side = 2 * np.pi * drawn[:, 0]
        tip = polar(side, 0.5 + 0.35 * drawn[:, 1])
        angle = side + np.pi + (drawn[:, 2] - 0.5) * 1.6
        orbit, pace = 0.45 + 0.3 * drawn[:, 3], (0.03 + 0.012 * drawn[:, 4]) * np.where(drawn[:, 5] < 0.5, -1, 1)
        target = polar(angle, orbit)
        return cls(tip, angle, orbit, pace, np.repeat(target[:, None], TRAIL, axis=1), surprise).cleared()

    def cleared(self) -> "Chase":
        self.held = np.zeros(len(self.tip), np.int64)
        self.stopped = np.zeros(len(self.tip), np.bool_)
        return self

    def rows(self, rows: np.ndarray) -> "Chase":
        """Some of the episodes, int64[M], as they are now."""
        arrays = {item.name: getattr(self, item.name)[rows] for item in fields(self) if item.name != "time"}
        chosen = Chase(**arrays, time=self.time).cleared()
        chosen.held, chosen.stopped = self.held[rows], self.stopped[rows]
        return chosen

    @property
    def target(self) -> np.ndarray:
        """float64[N, 2]"""
        return polar(self.angle, self.orbit)

    def step(self, actions: np.ndarray) -> np.ndarray:
        """One control step with actions float64[N, ≥ 2]; bool[N]: solved after it."""
        self.before = np.concatenate((self.before[:, 1:], self.target[:, None]), axis=1)
        self.pace = np.where(self.surprise[:, self.time % self.surprise.shape[1]] < TURN, -self.pace, self.pace)
        self.angle = self.angle + self.pace / self.orbit
        self.time += 1
        way = SPEED * cut(actions[:, :2])
        self.tip = np.where(self.stopped[:, None], self.tip, np.clip(self.tip + way, -1, 1))
        self.stopped |= np.linalg.norm(self.tip, axis=1) < POST
        near = np.linalg.norm(self.tip - self.target, axis=1) < RADIUS
        self.held = np.where(near & ~self.stopped, self.held + 1, 0)
        solved: np.ndarray = self.held >= HOLD
        return solved

    def draw(self, px: int) -> np.ndarray:
        """uint8[N, 2, px, px, 3]: the table, and the part around the tip."""
        centre = np.zeros_like(self.tip)
        views = [self._view(centre, VIEWS[0], px), self._view(self.tip, VIEWS[1], px)]
        return np.stack(views, axis=1)

    def _view(self, centre: np.ndarray, half_width: float, px: int) -> np.ndarray:
        axis = ((np.arange(px) + 0.5) / px * 2 - 1) * half_width
        shown = (self.target, self.before[:, 0], self.tip)
        layers = [_blobs(axis, place - centre) for place in shown]
        x, y = axis[None, :] + centre[:, :1], axis[None, :] - centre[:, 1:]  # y grows upwards, rows downwards
        post = x[:, None, :] ** 2 + y[:, :, None] ** 2 < POST**2
        camera_image = np.stack(layers, axis=-1) * 215 + 40 * post[..., None]
        drawn: np.ndarray = np.rint(camera_image).astype(np.uint8)
        return drawn


def polar(angle: np.ndarray, radius: np.ndarray) -> np.ndarray:
    """float64[N] twice to float64[N, 2]"""
    return radius[..., None] * np.stack((np.cos(angle), np.sin(angle)), axis=-1)


def cut(vectors: np.ndarray) -> np.ndarray:
    """float64[N, 2], none longer than 1."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1)


def _blobs(axis: np.ndarray, places: np.ndarray) -> np.ndarray:
    """float64[N, px, px]: a soft dot at each place."""
    across = np.exp(-(((axis - places[:, :1]) / BLOB) ** 2) / 2)
    down = np.exp(-(((axis + places[:, 1:]) / BLOB) ** 2) / 2)
    return down[:, :, None] * across[:, None, :]


class ChaseSimulator:
    """One task; an initial state is where everything begins and when the target will turn."""

    name = "chase"
    robot = "libero"
    action_dim = 7
    motion_dim = 2
    control_hz = 20.0
    image_keys = ("observation/image", "observation/wrist_image")
    suites = ("chase_post",)

    def check(self) -> list[str]:
        return []

    def tasks(self, suite: str) -> Sequence[Task]:
        return [Task(0, "catch_the_runner", INSTRUCTION, NUM_INITIAL_STATES, MAX_STEPS)]

    def open(self, suite: str, task: int, settings: SimSettings) -> "ChaseEnvironment":
        return ChaseEnvironment(task, settings)

    def example(self, settings: SimSettings) -> dict[str, Any]:
        environment = ChaseEnvironment(0, settings)
        environment.reset(0)
        return environment.observation()

    def versions(self) -> dict[str, str]:
        return {}

    def standing_still(self, last: np.ndarray) -> np.ndarray:
        return np.zeros_like(last)


class ChaseEnvironment:
    def __init__(self, task: int, settings: SimSettings) -> None:
        self.task, self.settings = task, settings
        self.reset(0)

    def reset(self, initial_state: int) -> None:
        seeds = [self.settings.episode_seed(self.task, initial_state), initial_state]
        self.world = Chase.start([np.random.default_rng(seeds)])
        for _ in range(self.settings.wait_steps):
            self.world.step(np.zeros((1, 7)))
        self.world.cleared()
        self._images: list[np.ndarray] = self.draw()

    def observation(self) -> dict[str, Any]:
        assert self._images, "the step before took no images"
        base, wrist = self._images
        return {
            "observation/image": base,
            "observation/wrist_image": wrist,
            "observation/state": np.concatenate([self.world.tip[0], np.zeros(6)]),
            "prompt": INSTRUCTION,
        }

    def step(self, action: np.ndarray, look: bool) -> bool:
        solved = bool(self.world.step(np.asarray(action)[None])[0])
        self._images = self.draw() if look else []
        return solved

    def draw(self) -> list[np.ndarray]:
        return list(self.world.draw(self.settings.camera_px)[0])

    def close(self) -> None:
        self._images = []
