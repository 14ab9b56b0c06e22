"""One episode, in a worker process: the simulator is stepped, the policy is asked across a pipe."""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np

from turbopi.evaluate.frames import Frame, Reel
from turbopi.evaluate.motion import Commands, Motion
from turbopi.evaluate.plan import Job
from turbopi.execution import ChunkQueue
from turbopi.sim import Environment, SimSettings

# Asks the policy at a step: observation, what else it is told (`Request.arguments`) -> what `infer` returns, "actions"
# float64[H, d] at least. Raises NoActions if it has none that can be used
Ask = Callable[[int, dict[str, object], Mapping[str, Any]], Mapping[str, Any]]
# The action with which the robot stands still, after this one
StandStill = Callable[[np.ndarray], np.ndarray]


@dataclass
class Ending:
    """What the worker found out. `status` as in results.Episode, without crash."""

    status: str
    steps: int
    message: str | None = None
    motion: Motion | None = None
    commands: Commands = field(default_factory=Commands)


@dataclass(frozen=True)
class Execution:
    """How chunks are carried out.

    way           turbopi.execution.WAYS
    horizon       actions of a chunk after which the policy is asked again
    delay         control steps from an observation to the chunk computed from it. The episode's clock starts when the
                  first chunk is there
    stand_still   where the way, or the delay, leaves the robot without an action; None: that can't be
    motion_dims   the first dimensions of an action, which move the robot
    """

    way: str
    horizon: int
    delay: int = 0
    stand_still: StandStill | None = None
    motion_dims: int | None = None


def run_episode(
    environment: Environment,
    job: Job,
    ask: Ask,
    execution: Execution,
    *,
    max_steps: int,
    image_keys: tuple[str, ...],
    film: Callable[[Frame], None] | None = None,
    smooth: bool = False,
) -> Ending:
    """Reset, then ask and act until the task is solved or the steps are used up.

    The policy's answer is there at once, and joins the running chunk `delay` steps later: exact, and repeatable.
    """
    environment.reset(job.initial_state)
    queue = ChunkQueue(execution.way, execution_horizon=execution.horizon, delay=execution.delay)
    commands, reel = Commands(), Reel(film, smooth)
    answer: Mapping[str, Any] = {}
    due, step, status, message = -1, 0, "failure", None
    refused: np.ndarray | None = None

    while step < max_steps:
        arrives = queue.in_flight is not None and step == due
        if arrives:
            queue.arrive(answer)
        if reel.wants(takes_over=arrives) and not queue.wants_observation:
            reel.picture(step, environment.draw())
        if queue.wants_observation:
            observation = environment.observation()
            request = queue.observe()
            reel.picture(step, [observation[key] for key in image_keys])
            reel.asked(step)
            try:
                answer = ask(step, observation, request.arguments)
            except NoActions as none:
                status, message = "aborted", f"step {step}: {none}; the episode was aborted"
                break
            reel.answered(request.number, answer["actions"])
            problem = _problem(answer["actions"])
            if problem is not None:
                status, message, refused = "aborted", f"step {step}: {problem}", answer["actions"]
                break
            due = step + (execution.delay if request.number else 0)
            if due == step:
                queue.arrive(answer)
        action = queue.next_action()
        if action is None:
            assert execution.stand_still is not None
            values = execution.stand_still(commands.values[-1])
            reel.act(values)
        else:
            values = action.values
            reel.act(values, action.chunk, action.row)
            if action.takes_over and action.chunk:
                commands.seams.append(step)
        commands.values.append(values)
        step += 1
        arrives = queue.in_flight is not None and due == step
        look = queue.wants_observation or (arrives and execution.delay >= execution.horizon)
        if environment.step(values, look=look):
            status = "success"
            break
    if film is not None and status != "aborted":
        reel.picture(step, environment.draw())
    reel.end(refused)
    dims = execution.motion_dims or (len(commands.values[0]) if commands.values else 0)
    return Ending(status, step, message, commands.motion(queue, dims), commands)


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

    Messages out   ("observation", step, observation, arguments)   answered with ("actions", what infer returned),
                                                                   ("problem", text) or ("stop",)
                   ("finished", status, steps, message, seconds, video, motion)
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
            Execution(
                setup.execution,
                setup.replan,
                setup.delay,
                getattr(self.simulator, "standing_still", None),
                getattr(self.simulator, "motion_dim", None),
            ),
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
        self.connection.send(("finished", ending.status, ending.steps, message, seconds, video, ending.motion))

    def _write_video(self, job: Job, frames: list[Frame], status: str) -> str:
        """Its path inside the results' folder."""
        from turbopi.evaluate.video import write_video

        setup = self.setup
        video = f"videos/{job.video}_{status}.mp4"
        caption = f"{job.task.instruction}  (task {job.task.index}, initial state {job.initial_state})"
        write_video(
            Path(setup.folder) / video, frames, caption, status, self.simulator.robot, self.simulator.control_hz
        )
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

    def _ask(self, step: int, observation: dict[str, object], arguments: Mapping[str, Any]) -> Mapping[str, Any]:
        self.connection.send(("observation", step, observation, arguments))
        answer = self.connection.recv()
        if answer[0] == "stop":
            raise Stopped
        if answer[0] == "problem":
            raise NoActions(answer[1])
        result: Mapping[str, Any] = answer[1]
        return result


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
    execution: str = "sync"
    delay: int = 0
