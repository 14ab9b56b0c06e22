"""A worker process's side: the simulator is stepped here, and the policy is asked across a pipe."""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from turbopi.evaluate.episode import Ending, Execution, NoActions, run_episode
from turbopi.evaluate.frames import Frame
from turbopi.evaluate.plan import Job
from turbopi.evaluate.real_time import RealTimeLoop
from turbopi.sim import Environment, SimSettings
from turbopi.sim.base import observation_problem


class Worker:
    """Runs jobs that come through a connection, holding the environment of the last task.

    It sends       ("observation", step, observation, arguments)   answered with ("actions", what infer returned),
                                                                   ("problem", text) or ("stop",). step None: to warm
                                                                   the policy up
                   ("finished", status, steps, message, seconds, video, motion, paced)
                   ("crashed", traceback, seconds)
                   ("unavailable", text)   nothing can be simulated here at all
                   ("unfit", text)         the policy can't be run in this way in real time
    """

    def __init__(self, connection: Connection, setup: "WorkerSetup") -> None:
        from turbopi.sim import create

        self.connection, self.setup = connection, setup
        self.simulator = create(setup.simulator)
        self.environment: Environment | None = None
        self.task = -1
        self.loop: RealTimeLoop | None = None

    def run(self, job: Job) -> None:
        start = time.perf_counter()
        frames: list[Frame] = []
        ending = self._episode(job, frames.append if job.video else None)
        seconds = time.perf_counter() - start
        message, video = ending.message, None
        if frames and (ending.status != "success" or job.keep_success):
            try:
                video = self._write_video(job, frames, ending.status)
            except OSError as error:  # a full disk, no ffmpeg: the verdict stands
                message = f"{message or ''} the video couldn't be written: {error}".strip()
        reported = (ending.status, ending.steps, message, seconds, video, ending.motion, ending.paced)
        self.connection.send(("finished", *reported))

    def _episode(self, job: Job, on_frame: Callable[[Frame], None] | None) -> Ending:
        setup, environment = self.setup, self._environment(job.task.index)
        execution = Execution(
            setup.execution,
            setup.replan,
            setup.delay,
            getattr(self.simulator, "standing_still", None),
            getattr(self.simulator, "motion_dim", None),
        )
        most, keys = setup.max_steps or job.task.max_steps, self.simulator.image_keys
        if setup.control_hz is None:
            return run_episode(
                *(environment, job, self._ask, execution),
                max_steps=most,
                image_keys=keys,
                on_frame=on_frame,
                smooth=setup.smooth,
            )
        if self.loop is None:
            width = self.simulator.action_dim
            self.loop = RealTimeLoop(self._ask, setup.offered, execution, setup.control_hz, action_dim=width)
        return self.loop.run(environment, job, max_steps=most, image_keys=keys, on_frame=on_frame)

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

    def _ask(self, step: int | None, observation: dict[str, object], arguments: Mapping[str, Any]) -> Mapping[str, Any]:
        problem = observation_problem(observation, self.simulator.image_keys)
        if problem is not None:
            raise BadObservation(f"{problem}: the simulator has gone wrong")
        self.connection.send(("observation", step, observation, arguments))
        answer = self.connection.recv()
        if answer[0] == "stop":
            raise Stopped
        if answer[0] == "problem":
            raise NoActions(answer[1])
        result: Mapping[str, Any] = answer[1]
        return result


class BadObservation(Exception):
    """The simulator gives what no policy can be sent."""


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
    control_hz: float | None = None
    offered: Mapping[str, Any] = field(default_factory=dict)  # what the policy offers for chunks that join
