"""A policy that sees, a simulator that breaks, and a short way to run them: for the tests of the evaluation."""

import os
import time
from collections.abc import Callable, Sequence
from multiprocessing import connection
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from turbopi.evaluate.plan import Job, Protocol, VideoPlan, choose_tasks, make_jobs
from turbopi.evaluate.results import Results
from turbopi.evaluate.run import evaluate, prepare
from turbopi.evaluate.sources import LocalPolicy, PolicySource
from turbopi.sim import SimSettings, SimulatorUnavailable, create
from turbopi.sim.reacher import SPEED, ReacherEnvironment, ReacherSimulator

if TYPE_CHECKING:
    import pytest

NO_VIDEOS = VideoPlan("none")
HORIZON = 10


class SeekingPolicy:
    """Finds the goal in the image and goes there: it solves every task of the reacher, if its images are current.

    `trouble` maps a call's number (from 0) to what it does instead: "nan", or an exception to raise.
    """

    def __init__(self, trouble: dict[int, Any] | None = None, width: int = 7, horizon: int = HORIZON) -> None:
        self.trouble, self.width, self.horizon = trouble or {}, width, horizon
        self.metadata = {"robot": "libero", "backend": "scripted", "precision": "f32", "num_denoising_steps": 1}
        self.batches: list[int] = []
        self.seeds: list[int] = []

    def infer_batch(self, observations: Sequence[dict[str, Any]], seed: Sequence[int]) -> list[dict[str, Any]]:
        trouble = self.trouble.get(len(self.batches))
        self.batches.append(len(observations))
        self.seeds += seed
        if isinstance(trouble, BaseException):
            raise trouble
        chunks = [self._chunk(observation) for observation in observations]
        if trouble == "nan":
            chunks[0][2, 1] = np.nan
        return [{"actions": chunk, "policy_timing": {"infer_ms": 2.0}} for chunk in chunks]

    def warmup(self, **arguments: Any) -> float:
        return 0.0

    def infer(self, observation: dict[str, Any]) -> dict[str, Any]:
        return self.infer_batch([observation], [0])[0]

    def _chunk(self, observation: dict[str, Any]) -> np.ndarray:
        position, goal = observation["observation/state"][:2], find_goal(observation["observation/image"])
        actions = np.zeros((self.horizon, self.width))
        for action in actions:
            action[:2] = np.clip((goal - position) / SPEED, -1, 1)
            position = position + SPEED * action[:2]
        return actions


def find_goal(camera_image: np.ndarray) -> np.ndarray:
    """The coloured dot's centre, in the reacher's coordinates; (0, 0) if there is none."""
    spread = camera_image.max(axis=2).astype(int) - camera_image.min(axis=2)
    rows, columns = np.nonzero(spread > 80)
    if not len(rows):
        return np.zeros(2)
    px = camera_image.shape[0]
    return np.array([(columns.mean() + 0.5) / px * 2 - 1, 1 - (rows.mean() + 0.5) / px * 2]) * 1.1


class TroubledSimulator(ReacherSimulator):
    """The reacher, but some initial states break it."""

    RAISES, DIES = 3, 4

    def open(self, suite: str, task: int, settings: SimSettings) -> ReacherEnvironment:
        inner = super().open(suite, task, settings)
        return _TroubledEnvironment(inner.color, task, settings)


class _TroubledEnvironment(ReacherEnvironment):
    def reset(self, initial_state: int) -> None:
        super().reset(initial_state)
        if initial_state == TroubledSimulator.RAISES:
            raise RuntimeError("the physics exploded")
        if initial_state == TroubledSimulator.DIES:
            os._exit(11)


class ExplodingSimulator(ReacherSimulator):
    """The reacher, but from one initial state its physics explode."""

    def open(self, suite: str, task: int, settings: SimSettings) -> ReacherEnvironment:
        inner = super().open(suite, task, settings)
        return _ExplodingEnvironment(inner.color, task, settings)


class _ExplodingEnvironment(ReacherEnvironment):
    def reset(self, initial_state: int) -> None:
        super().reset(initial_state)
        if initial_state == TroubledSimulator.RAISES:
            self.position = np.array([self.position[0], np.nan])


class BrokenSimulator(ReacherSimulator):
    """Can't do anything at all."""

    def open(self, suite: str, task: int, settings: SimSettings) -> ReacherEnvironment:
        raise RuntimeError("no such scene")


class GatheringSimulator(ReacherSimulator):
    """Its environments wait for each other before their first episode: as many as $GATHER_COUNT, in $GATHER_FOLDER."""

    def open(self, suite: str, task: int, settings: SimSettings) -> ReacherEnvironment:
        folder = Path(os.environ["GATHER_FOLDER"])
        (folder / str(os.getpid())).touch()
        while len(list(folder.iterdir())) < int(os.environ["GATHER_COUNT"]):
            time.sleep(0.005)
        return super().open(suite, task, settings)


class BlindSimulator(ReacherSimulator):
    """As LIBERO where OpenGL fails."""

    def open(self, suite: str, task: int, settings: SimSettings) -> ReacherEnvironment:
        raise SimulatorUnavailable("MuJoCo can't draw with egl here")


def jobs_for(
    simulator: str = "reacher",
    tasks: Sequence[int] = (0,),
    states: Sequence[int] = (0, 1),
    videos: VideoPlan = NO_VIDEOS,
) -> list[Job]:
    made = create(simulator)
    return make_jobs(choose_tasks(made, made.suites[0], tasks), states, None, videos)


def run(
    folder: Path,
    policy: Any,
    *,
    simulator: str = "reacher",
    tasks: Sequence[int] = (0,),
    states: Sequence[int] = (0, 1),
    videos: VideoPlan = NO_VIDEOS,
    workers: int = 1,
    max_batch: int = 1,
    restart: bool = False,
    seeding: Any = "episode",
    **protocol: Any,
) -> Results:
    """`evaluate` with small images; `policy` is a policy or a source."""
    source: PolicySource = policy if hasattr(policy, "label") else LocalPolicy(policy)
    settings = SimSettings(seeding=seeding, camera_px=64, wait_steps=2)
    made = create(simulator)
    chosen = Protocol(simulator, made.suites[0], settings, image_px=64, **protocol)
    jobs = jobs_for(simulator, tasks, states, videos)
    results = prepare(folder, chosen, source, made, jobs, restart=restart)
    return evaluate(results, chosen, source, made, jobs, num_workers=workers, max_batch=max_batch, videos=videos)


def gathering(monkeypatch: "pytest.MonkeyPatch", folder: Path, workers: int) -> Callable[[], int]:
    """Has GatheringSimulator begin when so many workers are there, which meet in `folder`.

    What is returned waits up to 0.1 s, and says how many workers have asked, whether the schedule has read that or not.
    """
    listened: list[Any] = []  # the connections that the schedule listens to
    read: list[Any] = []  # those that it has read from
    wait = connection.wait

    def listening(to: list[Any], timeout: float | None = None) -> list[Any]:
        listened[:] = to
        ready = wait(to, timeout)
        read.extend(ready)
        return ready

    def requested() -> int:
        known = [*read, *wait(listened, 0.1)]
        return sum(one in known for one in listened)

    folder.mkdir()
    monkeypatch.setenv("GATHER_FOLDER", str(folder))
    monkeypatch.setenv("GATHER_COUNT", str(workers))
    monkeypatch.setattr(connection, "wait", listening)
    return requested
