"""What an evaluation needs of a simulator: one class that lists tasks and opens environments, one that is stepped.

Modules of simulators are imported by worker processes, many at once: they import neither torch nor matplotlib.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Annotated, Any, Literal, Protocol

import numpy as np
from msgspec import Meta, Struct

from turbopi.support.errors import ConfigError, TurboPiError
from turbopi.support.text import kind_of

Seeding = Literal["episode", "task"]


class SimulatorUnavailable(TurboPiError):
    """A simulator can't run on this machine; the message says why and what to do."""


MAX_PX = 4096  # of an image's width and height
_Count = Annotated[int, Meta(ge=0, le=10**9)]


class Task(Struct, frozen=True):
    """One task of a suite, as result files have it, too."""

    index: _Count
    name: str
    instruction: str
    num_initial_states: _Count
    max_steps: _Count  # openpi's limit, in control steps after the wait


@dataclass(frozen=True)
class SimSettings:
    """How episodes begin and what cameras deliver. The defaults are openpi's.

    seeding   "episode": the environment is seeded before every reset, with `episode_seed`, so that an episode is the
              same whatever ran before it. "task": seeded once for each task, as openpi does; the n-th reset of a task
              then depends on how many came before.
    """

    seed: int = 7
    seeding: Seeding = "episode"
    wait_steps: int = 10
    camera_px: int = 256

    def __post_init__(self) -> None:
        if self.seeding not in ("episode", "task"):
            raise ConfigError(f"seeding={self.seeding!r} isn't one; choose episode or task")
        for name, least, most in (("seed", 0, 2**32 - 1), ("wait_steps", 0, 1000), ("camera_px", 16, MAX_PX)):
            value = getattr(self, name)
            if not least <= value <= most:
                raise ConfigError(f"{name}={value} should be from {least} to {most}")

    def episode_seed(self, task: int, initial_state: int) -> int:
        """What the environment's random generator is seeded with: 32 bits."""
        if self.seeding == "task":
            return self.seed
        return int(np.random.SeedSequence([self.seed, task, initial_state]).generate_state(1)[0])


class Environment(Protocol):
    """One task. Its images are drawn only when they are asked for, as drawing takes most of a simulator's time."""

    def reset(self, initial_state: int) -> None:
        """Begin an episode from that initial state and wait until things have come to rest. Draws the images."""

    def observation(self) -> dict[str, Any]:
        """What a policy is sent: images uint8[px, px, 3], state float64[d], prompt, under the robot's keys.

        Only after `reset` or a `step` with look=True.
        """

    def step(self, action: np.ndarray, look: bool) -> bool:
        """One control step; True if the task is solved after it. `look`: the images are needed after this step."""

    def draw(self) -> list[np.ndarray]:
        """What the cameras see now, for a video: uint8[px, px, 3] each. Changes nothing in the simulation."""

    def close(self) -> None:
        """Free the renderer and whatever else is held."""


class Simulator(Protocol):
    """A family of tasks behind one install."""

    name: str
    robot: str  # whose keys its observations have: turbopi.robots
    action_dim: int
    control_hz: float
    image_keys: tuple[str, ...]
    suites: tuple[str, ...]  # the first is the default
    # Simulators may have, besides: motion_dim, how many of an action's first numbers move the robot (None: all), for
    # measures of smoothness; and standing_still(last action) -> action, which a way to run needs in which it stands

    def check(self) -> list[str]:
        """Raise SimulatorUnavailable if it can't run here. Returns warnings to show."""

    def tasks(self, suite: str) -> Sequence[Task]:
        """The tasks of a suite, named as in `suites`; call `check` before."""

    def open(self, suite: str, task: int, settings: SimSettings) -> Environment:
        """An environment for one task, in this process. Raises SimulatorUnavailable where nothing can be drawn."""

    def example(self, settings: SimSettings) -> dict[str, Any]:
        """An observation of the same keys, shapes and dtypes, without a simulator."""

    def versions(self) -> dict[str, str]:
        """Of the libraries that decide what happens, and the renderer."""


@contextmanager
def faults_named(simulator: Simulator, part: str) -> Iterator[None]:
    """What a simulator of the user's own raises in `part` becomes a ConfigError that names both."""
    try:
        yield
    except Exception as error:
        if isinstance(error, TurboPiError) or type(simulator).__module__.startswith("turbopi."):
            raise
        raise ConfigError(
            f"{part} of the simulator {simulator.name} failed: {type(error).__name__}: {error}; --debug shows where"
        ) from error


def observation_problem(observation: Any, image_keys: Sequence[str]) -> str | None:
    """What of an observation no policy can be sent, whichever it is; None if nothing is wrong.

    image_keys   where its images are, uint8[h, w, 3]
    """
    if not isinstance(observation, dict):
        return f"the observation is {kind_of(observation)}; it should be a dict of keys and values"
    for key in image_keys:
        if key not in observation:
            return f"the observation has no {key!r}; it has {', '.join(map(str, observation)) or 'nothing'}"
        camera_image = observation[key]
        fits = isinstance(camera_image, np.ndarray) and camera_image.dtype == np.uint8 and camera_image.size
        if not fits or camera_image.ndim != 3 or camera_image.shape[2] != 3:
            found = (
                f"{camera_image.dtype}{list(camera_image.shape)}"
                if isinstance(camera_image, np.ndarray)
                else type(camera_image).__name__
            )
            return f"{key!r} is {found}; an image should be uint8[h, w, 3]"
    for key, value in observation.items():
        numbers = np.atleast_1d(value) if isinstance(value, float | np.ndarray | np.floating) else np.zeros(0)
        if numbers.dtype.kind == "f" and not np.isfinite(numbers).all():
            first = np.argwhere(~np.isfinite(numbers))[0]
            place = ", ".join(map(str, first))
            return f"{key!r} isn't finite: {numbers[tuple(first)]} at [{place}]"
    return None


def full_suite_name(simulator: Simulator, suite: str) -> str:
    """`suite` as in `simulator.suites`: "spatial" for "libero_spatial" will do. Raises ConfigError if there is none."""
    for known in simulator.suites:
        if suite.lower() in (known, known.removeprefix(f"{simulator.name}_")):
            return known
    raise ConfigError(f"unknown suite {suite!r} of {simulator.name}; choose one of {', '.join(simulator.suites)}")
