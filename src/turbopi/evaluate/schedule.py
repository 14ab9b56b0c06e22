"""The scheduler: hands episodes to workers, and their observations, several at once, to the one policy.

It is one loop in one thread. While the policy computes, further observations collect in the pipes; they are the next
batch. With `max_batch` 1 every request is computed alone: rounding then doesn't depend on which episodes happened to be
asked together, and a run repeats bit for bit.
"""

import contextlib
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from multiprocessing import connection
from typing import Any

import numpy as np

from turbopi.evaluate.checks import actions_needed
from turbopi.evaluate.motion import Motion
from turbopi.evaluate.pacing import Paced
from turbopi.evaluate.plan import Job, Protocol, noise_seed
from turbopi.evaluate.results import Episode, Status, writable
from turbopi.evaluate.sources import Answer, PolicyRefused, PolicySource
from turbopi.evaluate.worker import WorkerSetup
from turbopi.evaluate.workers import LOG, WorkerHandle
from turbopi.preprocess.images import resize_with_pad
from turbopi.sim import Simulator
from turbopi.support.errors import ConfigError, TurboPiError

MAX_CRASHES_IN_A_ROW = 5
SILENCE_S = 600.0  # a worker that says nothing for so long hangs
_POLL_S = 1.0

OnEpisode = Callable[[Episode, Job], None]
# Is told of every answered request: job, step, the observation as the policy got it, the noise's seed, the answer
OnAnswer = Callable[[Job, int, dict[str, object], int, Answer], None]


class TooManyCrashes(TurboPiError):
    """The simulator crashes all the time: there is no point in going on."""


@dataclass
class _Running:
    """What is known of the episode that a worker is at."""

    call_ms: list[float] = field(default_factory=list)
    infer_ms: list[float] = field(default_factory=list)
    batch: list[int] = field(default_factory=list)


@dataclass(frozen=True)
class _Request:
    worker: WorkerHandle
    job: Job
    step: int | None  # None: a warm-up, which nothing is counted of
    observation: dict[str, object]
    seed: int
    arguments: Mapping[str, Any]  # what else the policy is told


class Scheduler:
    """Runs jobs with a policy on `num_workers` processes.

    on_episode   called in this thread when an episode has ended, whatever its end
    """

    def __init__(
        self,
        protocol: Protocol,
        setup: WorkerSetup,
        source: PolicySource,
        simulator: Simulator,
        *,
        num_workers: int,
        max_batch: int,
        on_episode: OnEpisode,
        on_answer: OnAnswer | None = None,
    ) -> None:
        assert num_workers >= 1 and max_batch >= 1
        self._protocol, self._setup, self._source = protocol, setup, source
        self._image_keys, self._action_dim = simulator.image_keys, simulator.action_dim
        self._num_workers = num_workers
        self._max_batch = min(max_batch, source.max_batch or max_batch)
        self._on_episode, self._on_answer = on_episode, on_answer
        self._workers: list[WorkerHandle] = []
        self._running: dict[WorkerHandle, _Running] = {}
        self._crashes_in_a_row = 0

    def run(self, jobs: Sequence[Job]) -> None:
        """All jobs. Raises what the policy raises, SimulatorUnavailable, or TooManyCrashes; workers are ended first."""
        self._jobs = list(jobs)
        self._requests: list[_Request] = []
        try:
            for _ in range(min(self._num_workers, len(self._jobs))):
                self._workers.append(WorkerHandle(self._setup))
            for worker in tuple(self._workers):
                self._assign(worker)
            while self._running:
                self._receive(wait=not self._requests)
                if self._requests:
                    self._answer()
        finally:
            for worker in self._workers:
                if worker.job is not None:
                    worker.kill()  # in the middle of an episode that nobody waits for
            for worker in self._workers:
                if worker.process.is_alive():
                    worker.close()

    # --- workers ------------------------------------------------------------------------------------------------------

    def _assign(self, worker: WorkerHandle) -> None:
        job = self._next_job(worker)
        if job is None:
            self._running.pop(worker, None)
            return
        self._jobs.remove(job)
        self._running[worker] = _Running()
        worker.begin(job)

    def _next_job(self, worker: WorkerHandle) -> Job | None:
        """Preferably of the task that the worker has open; else of the one with most to do and fewest to do it."""
        for job in self._jobs:
            if job.task.index == worker.task:
                return job
        taken = Counter(other.task for other in self._workers if other is not worker and other.job is not None)
        waiting = Counter(job.task.index for job in self._jobs)
        if self._protocol.sim.seeding == "task":  # one worker a task: another would repeat all of its resets
            waiting = Counter({task: count for task, count in waiting.items() if not taken[task]})
        if not waiting:
            return None
        chosen = max(waiting, key=lambda task: (waiting[task] / (1 + taken[task]), -task))
        return next(job for job in self._jobs if job.task.index == chosen)

    def _receive(self, *, wait: bool) -> None:
        """Handle what the workers have sent; if `wait`, until one has."""
        by_connection = {worker.connection: worker for worker in self._running}
        ready = connection.wait(list(by_connection), _POLL_S if wait else 0)
        for one in ready:
            worker = by_connection[one]  # type: ignore[index]
            self._handle(worker, worker.receive())
        requesting = {request.worker for request in self._requests}
        for worker in tuple(self._running):
            if worker not in requesting and time.monotonic() - worker.heard > SILENCE_S:
                self._lost(worker, f"the simulator said nothing for {SILENCE_S:.0f} s and was ended")

    def _handle(self, worker: WorkerHandle, message: tuple[Any, ...]) -> None:
        assert worker.job is not None
        match message:
            case ("observation", step, observation, arguments):
                self._requests.append(self._request(worker, worker.job, step, observation, arguments))
            case ("finished", status, steps, text, seconds, video, motion, paced):
                self._crashes_in_a_row = 0
                self._end(worker, status, steps, seconds, text, video, motion, paced)
                self._assign(worker)
            case ("crashed", text, seconds):
                worker.task = None
                self._end(worker, "crash", 0, seconds, text)
                self._assign(worker)
            case ("died", code):
                self._lost(worker, f"the worker's process ended (exit code {code}); see {LOG}")
            case ("unavailable", text):
                from turbopi.sim import SimulatorUnavailable

                worker.job = None
                raise SimulatorUnavailable(text)
            case ("unfit", text):
                worker.job = None
                raise ConfigError(f"--execution {self._protocol.execution} can't be run in real time: {text}")
            case _:
                raise AssertionError(f"a worker sent {message[:1]}")

    def _lost(self, worker: WorkerHandle, why: str) -> None:
        """Replace a worker whose process is gone, or should be."""
        seconds = time.monotonic() - worker.started
        worker.kill()
        self._workers.remove(worker)
        self._requests = [request for request in self._requests if request.worker is not worker]
        self._end(worker, "crash", 0, seconds, why)
        self._running.pop(worker)
        fresh = WorkerHandle(self._setup)
        self._workers.append(fresh)
        self._assign(fresh)

    def _end(
        self,
        worker: WorkerHandle,
        status: Status,
        steps: int,
        seconds: float,
        message: str | None,
        video: str | None = None,
        motion: Motion | None = None,
        paced: Paced | None = None,
    ) -> None:
        job, worker.job = worker.job, None
        assert job is not None
        reported = self._running[worker]
        seed = self._protocol.sim.episode_seed(job.task.index, job.initial_state)
        episode = Episode(
            task=job.task.index,
            initial_state=job.initial_state,
            status=status,
            steps=steps,
            seed=seed,
            seconds=round(seconds, 2),
            call_ms=[round(ms, 3) for ms in reported.call_ms],
            infer_ms=[round(ms, 3) for ms in reported.infer_ms],
            batch=reported.batch,
            message=None if message is None else writable(message),
            video=video,
            motion=motion,
            real_time=paced,
        )
        self._on_episode(episode, job)
        if status != "crash":
            return
        self._crashes_in_a_row += 1
        if self._crashes_in_a_row >= MAX_CRASHES_IN_A_ROW:
            last = (message or "").strip().splitlines()[-1:] or ["no message"]
            raise TooManyCrashes(
                f"the simulator crashed {self._crashes_in_a_row} times in a row; the last time: {last[0]} "
                f"({self._setup.folder}/{LOG} has more). What was finished is kept; the same command continues"
            )

    # --- the policy ---------------------------------------------------------------------------------------------------

    def _request(
        self,
        worker: WorkerHandle,
        job: Job,
        step: int | None,
        observation: dict[str, object],
        arguments: Mapping[str, Any],
    ) -> _Request:
        px = self._protocol.image_px
        resized = {key: resize_with_pad(np.asarray(observation[key]), px, px) for key in self._image_keys}
        seed = noise_seed(self._protocol.sim.seed, *job.key, step or 0)
        return _Request(worker, job, step, observation | resized, seed, arguments)

    def _answer(self) -> None:
        """One batch of the waiting requests, oldest first."""
        batch, self._requests = self._requests[: self._max_batch], self._requests[self._max_batch :]
        start = time.perf_counter()
        observations, seeds = [request.observation for request in batch], [request.seed for request in batch]
        if any(request.arguments for request in batch):
            answers = self._source.infer(observations, seeds, [request.arguments for request in batch])
        else:
            answers = self._source.infer(observations, seeds)
        call_ms = (time.perf_counter() - start) * 1e3
        for request, answer in zip(batch, answers, strict=True):
            if request.step is not None:
                reported = self._running[request.worker]
                reported.call_ms.append(call_ms)
                reported.batch.append(len(batch))
                if answer.infer_ms is not None:
                    reported.infer_ms.append(answer.infer_ms)
            request.worker.heard = time.monotonic()
            if answer.problem is not None:
                reply: tuple[str, object] = ("problem", answer.problem)
            else:
                self._check_shape(answer.actions)
                reply = ("actions", {"actions": answer.actions, **answer.for_next})
                if self._on_answer is not None and request.step is not None:
                    self._on_answer(request.job, request.step, request.observation, request.seed, answer)
            with contextlib.suppress(OSError):  # it died meanwhile; the next message from it is its end
                request.worker.connection.send(reply)

    def _check_shape(self, actions: np.ndarray) -> None:
        """A policy that fitted at the beginning may answer otherwise later."""
        horizon, width = actions.shape
        least = actions_needed(self._protocol)
        if width != self._action_dim or horizon < least:
            raise PolicyRefused(
                f"the policy answered with actions of shape {list(actions.shape)}; expected at least "
                f"{least} actions of {self._action_dim} numbers. What was finished is kept"
            )
