"""One episode, in a worker process: the simulator is stepped, the policy is asked across a pipe."""

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np

from turbopi.evaluate.frames import Frame
from turbopi.evaluate.plan import Job
from turbopi.sim import Environment, SimSettings

# Asks the policy at a step: observation -> actions float64[H, d]. Raises NoActions if it has none that can be used
Ask = Callable[[int, dict[str, object]], np.ndarray]


@dataclass
class Ending:
    """What the worker found out. `status` as in results.Episode, without crash."""

    status: str
    steps: int
    message: str | None = None
    frames: list[Frame] = field(default_factory=list)


def run_episode(
    environment: Environment,
    job: Job,
    ask: Ask,
    *,
    replan: int,
    max_steps: int,
    image_keys: tuple[str, ...],
    film: Callable[[Frame], None] | None = None,
    smooth: bool = False,
) -> Ending:
    """Reset, then ask and act until the task is solved or the steps are used up."""
    environment.reset(job.initial_state)
    step, chunk, count = 0, np.zeros((1, 1)), 0
    while step < max_steps:
        observation = environment.observation()
        try:
            chunk = ask(step, observation)
        except NoActions as none:
            return Ending("aborted", step, f"step {step}: {none}; the episode was aborted")
        count = min(replan, max_steps - step)
        if film is not None:
            film(Frame(step, [observation[key] for key in image_keys], chunk, count, 0))
        problem = _problem(chunk)
        if problem is not None:
            return Ending("aborted", step, f"step {step}: {problem}")
        for done, action in enumerate(chunk[:count], start=1):
            success = environment.step(action, look=done == count)
            step += 1
            if success:
                if film is not None:
                    film(Frame(step, environment.draw(), chunk, count, done))
                return Ending("success", step)
            if film is not None and smooth and done < count:
                film(Frame(step, environment.draw(), chunk, count, done))
    if film is not None:
        film(Frame(step, environment.draw(), chunk, count, count))
    return Ending("failure", step)


def _problem(chunk: np.ndarray) -> str | None:
    """Why a chunk can't be carried out, or None."""
    bad = ~np.isfinite(chunk)
    if bad.any():
        row, column = np.argwhere(bad)[0]
        return (
            f"the policy's actions aren't finite ({chunk[row, column]} at [{row}, {column}]); the episode was aborted"
        )
    return None


class Worker:
    """Runs jobs that come through a connection, holding the environment of the last task.

    Messages out   ("observation", step, observation)   answered with ("actions", chunk), ("problem", text) or ("stop",)
                   ("finished", status, steps, message, seconds, video)
                   ("crashed", traceback, seconds)
                   ("unavailable", text)   nothing can be simulated here at all
    """

    def __init__(self, connection: Connection, setup: "WorkerSetup") -> None:
        from turbopi.sim import create

        self.connection, self.setup = connection, setup
        self.simulator = create(setup.simulator)
        self.environment: Environment | None = None
        self.task = -1

    def run(self, job: Job) -> None:
        setup, start = self.setup, time.perf_counter()
        frames: list[Frame] = []
        ending = run_episode(
            self._environment(job.task.index),
            job,
            self._ask,
            replan=setup.replan,
            max_steps=setup.max_steps or job.task.max_steps,
            image_keys=self.simulator.image_keys,
            film=frames.append if job.video else None,
            smooth=setup.smooth,
        )
        seconds = time.perf_counter() - start
        message, video = ending.message, None
        if frames and (ending.status != "success" or job.keep_success):
            try:
                video = self._write_video(job, frames, ending.status)
            except OSError as error:  # a full disk, no ffmpeg: the verdict stands
                message = f"{message or ''} the video couldn't be written: {error}".strip()
        self.connection.send(("finished", ending.status, ending.steps, message, seconds, video))

    def _write_video(self, job: Job, frames: list[Frame], status: str) -> str:
        """Its path inside the results' folder."""
        from turbopi.evaluate.video import write_video

        setup = self.setup
        fps = self.simulator.control_hz / (1 if setup.smooth else setup.replan)
        video = f"videos/{job.video}_{status}.mp4"
        caption = f"{job.task.instruction}  (task {job.task.index}, initial state {job.initial_state})"
        write_video(Path(setup.folder) / video, frames, caption, status, self.simulator.robot, fps)
        return video

    def forget(self) -> None:
        """Drop the environment: after an error it may be in any state."""
        environment, self.environment, self.task = self.environment, None, -1
        if environment is not None:
            environment.close()

    def _environment(self, task: int) -> Environment:
        if self.environment is None or self.task != task:
            self.forget()
            self.environment = self.simulator.open(self.setup.suite, task, self.setup.sim)
            self.task = task
        return self.environment

    def _ask(self, step: int, observation: dict[str, object]) -> np.ndarray:
        self.connection.send(("observation", step, observation))
        answer = self.connection.recv()
        if answer[0] == "stop":
            raise Stopped
        if answer[0] == "problem":
            raise NoActions(answer[1])
        return np.asarray(answer[1])


class NoActions(Exception):
    """The policy found itself that its actions can't be used."""


class Stopped(Exception):
    """The run ended while this episode was under way."""


@dataclass(frozen=True)
class WorkerSetup:
    """What every worker is told when it starts."""

    simulator: str
    suite: str
    sim: SimSettings
    replan: int
    max_steps: int | None
    smooth: bool
    folder: str
