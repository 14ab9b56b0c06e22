"""What is evaluated: which episodes, by which protocol."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from turbopi.realtime import way_named
from turbopi.sim import SimSettings, Simulator, Task
from turbopi.sim.base import MAX_PX, faults_named
from turbopi.support.errors import ConfigError

MAX_CONTROL_HZ = 10_000
VideoChoice = Literal["sample", "all", "none"]


@dataclass(frozen=True)
class Protocol:
    """Everything that decides what happens in an episode, besides the policy. The defaults are openpi's.

    replan       actions of a chunk that are carried out before the policy is asked again: the execution horizon
    image_px     images are resized to this square with padding before they are sent to the policy
    max_steps    control steps after the wait; None: the suite's own limit
    execution    how chunks join: one of turbopi.realtime.WAYS
    delay        control steps from an observation to the chunk computed from it, simulated
    control_hz   in real time: control steps that the world makes in a second of the wall clock, whatever the policy
                 does; delays are measured then. None: the world waits for the policy
    """

    simulator: str
    suite: str
    sim: SimSettings = field(default_factory=SimSettings)
    replan: int = 5
    image_px: int = 224
    max_steps: int | None = None
    execution: str = "sync"
    delay: int = 0
    control_hz: float | None = None

    def __post_init__(self) -> None:
        way_named(self.execution)
        if self.control_hz is not None and not 0 < self.control_hz <= MAX_CONTROL_HZ:
            raise ConfigError(f"control_hz={self.control_hz} should be above 0, at most {MAX_CONTROL_HZ}")
        if self.control_hz is not None and self.delay:
            raise ConfigError(f"a delay of {self.delay} steps can't be simulated in real time, where it is measured")
        if not 0 <= self.delay <= 1000:
            raise ConfigError(f"the delay is {self.delay} control steps; it should be from 0 to 1000")
        for name, value in (("replan", self.replan), ("image_px", self.image_px), ("max_steps", self.max_steps)):
            if value is not None and value < 1:
                raise ConfigError(f"{name}={value} should be at least 1")
        if self.image_px > MAX_PX:
            raise ConfigError(f"image_px={self.image_px} should be {MAX_PX} at most")


@dataclass(frozen=True)
class VideoPlan:
    """Which episodes are filmed: with "sample" every failure, and successes among a task's first initial states.

    smooth   draw at every control step instead of only where the policy looks: four times slower without a GPU
    """

    which: VideoChoice = "sample"
    successes: int = 1
    smooth: bool = False

    def __post_init__(self) -> None:
        if self.which not in ("sample", "all", "none"):
            raise ConfigError(f"videos are {self.which!r}; choose sample, all or none")
        if self.successes < 0:
            raise ConfigError(f"{self.successes} successes a task can't be filmed; it should be 0 or more")


@dataclass(frozen=True)
class Job:
    """One episode to run."""

    task: Task
    initial_state: int
    video: str | None = None  # the file's name without its ending, if it is filmed
    keep_success: bool = False  # whether a video of a success is kept too

    @property
    def key(self) -> tuple[int, int]:
        return self.task.index, self.initial_state


def noise_seed(seed: int, task: int, initial_state: int, step: int) -> int:
    """The seed of the noise that a chunk starts from: the same for any backend, whatever ran before."""
    low, high = np.random.SeedSequence([seed, task, initial_state, step]).generate_state(2)
    return int(low) | int(high) << 32


def choose_tasks(simulator: Simulator, suite: str, wanted: Sequence[int] | None) -> list[Task]:
    """The tasks with these indices, or all. Raises ConfigError, listing what there is."""
    with faults_named(simulator, "tasks()"):
        tasks = {task.index: task for task in simulator.tasks(suite)}
    unknown = [index for index in wanted or () if index not in tasks]
    if unknown:
        names = "\n".join(f"  {task.index}: {task.instruction}" for task in tasks.values())
        raise ConfigError(f"{suite} has no task {', '.join(map(str, unknown))}; its tasks are\n{names}")
    return [tasks[index] for index in sorted(set(tasks if wanted is None else wanted))]


def make_jobs(
    tasks: Sequence[Task], initial_states: Sequence[int] | None, trials: int | None, videos: VideoPlan
) -> list[Job]:
    """Every task from each of these initial states (all of them unless given), or from the first `trials` of them.

    Raises ConfigError for initial states that a task doesn't have.
    """
    jobs = []
    for task in tasks:
        states = range(task.num_initial_states) if initial_states is None else sorted(set(initial_states))
        if trials is not None:
            if not 1 <= trials <= len(states):
                raise ConfigError(
                    f"{trials} trials of task {task.index} aren't possible: from 1 to {len(states)} are, one from each "
                    "initial state"
                )
            states = states[:trials]
        if not states:
            raise ConfigError(f"task {task.index} has no initial states, so no episode of it can be run")
        if states[0] < 0 or states[-1] >= task.num_initial_states:
            raise ConfigError(
                f"task {task.index} has the initial states 0 to {task.num_initial_states - 1}; "
                f"it has no {states[-1] if states[0] >= 0 else states[0]}"
            )
        for number, state in enumerate(states):
            name = f"task{task.index:02d}_state{state:02d}" if videos.which != "none" else None
            jobs.append(Job(task, state, name, videos.which == "all" or number < videos.successes))
    return jobs


def parse_numbers(option: str, text: str) -> list[int]:
    """ "0,2,5-7" as [0, 2, 5, 6, 7]. Raises ConfigError, naming the option."""
    numbers: list[int] = []
    for part in text.split(","):
        found = re.fullmatch(r"\s*([0-9]{1,6})(?:-([0-9]{1,6}))?\s*", part)
        if found is None:
            raise ConfigError(f"{option} is {text!r}; expected whole numbers and ranges, such as 0,2,5-7")
        first, last = int(found[1]), int(found[2] or found[1])
        if last < first:
            raise ConfigError(f"{option} is {text!r}: there is nothing in the range {part.strip()}")
        numbers += range(first, last + 1)
    return numbers
