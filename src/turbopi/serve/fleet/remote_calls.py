"""A server's requests, computed by the replicas of a fleet (fleet.py), across Ray Serve."""

import asyncio
import time
from collections.abc import Callable, Coroutine, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

from prometheus_client import Histogram

from turbopi.serve.fleet.replica import Answer, Line
from turbopi.serve.fleet.watch import Watch
from turbopi.serve.metrics import BUCKETS, Metrics
from turbopi.serve.outcome import Outcome
from turbopi.serve.scheduling.schedule import Request
from turbopi.serve.scheduling.worker import STOPPING
from turbopi.serve.urgency import MAX_ROWS

ROUTER_LINE = 256  # requests that may wait for a replica while none is there
ROWS_AT_ONCE = 8  # observations of one batch message that are at the replicas


class RemoteCalls:
    """Has requests computed by the replicas of `handle`, and keeps their times by replica in `metrics`.

    The line is at the replicas: each has its own, with the deadlines and priorities of its requests, and forms its own
    batches. No request of a session replaces another: they may be at different replicas.

    watch             over the cluster, from `warm_up` to `close`; None: nobody looks
    on_lost(reason)   is called when Ray has ended; requests that wait are answered then
    """

    largest = MAX_ROWS  # a batch message's observations are requests of their own: there is nothing to split

    def __init__(
        self,
        handle: Any,
        metrics: Metrics,
        answer_seconds: float,
        watch: Watch | None = None,
        on_lost: Callable[[str], None] = lambda reason: None,
    ) -> None:
        self._handle, self._metrics, self._answer_seconds = handle, metrics, answer_seconds
        self._watch, self._on_lost = watch, on_lost
        self._going: set[asyncio.Future[list[Outcome]]] = set()
        self._stopping = False
        self._lost_for: str | None = None  # why no replica can ever answer again

        def histogram(name: str, text: str) -> Histogram:
            return Histogram(name, text, ["replica", "checkpoint"], buckets=BUCKETS, registry=metrics.registry)

        self._inference = histogram("turbopi_replica_inference_seconds", "In the policy, by replica")
        self._waiting = histogram("turbopi_replica_queue_seconds", "Waiting for the policy at a replica, by replica")

    @property
    def waiting(self) -> int:
        """Not known here: they wait at the replicas."""
        return 0

    @property
    def running(self) -> bool:
        return bool(self._going)

    @property
    def unwell(self) -> str | None:
        return None if self._watch is None else self._watch.unwell

    def waits(self, session: str) -> bool:
        return False

    async def warm_up(self, **arguments: Any) -> None:
        """Replicas warm up before their first request; what begins here is the watch over the cluster."""
        if self._watch is not None:
            loop = asyncio.get_running_loop()
            self._watch.start(lambda reason: loop.call_soon_threadsafe(partial(self._lose, reason)))

    def ask(
        self, request: Request, observation: dict[str, Any], arguments: Mapping[str, Any]
    ) -> "asyncio.Future[list[Outcome]]":
        """Begin it; an outcome of one row. Cancelling it cancels it at the replica, too, unless it runs already."""

        async def one() -> list[Outcome]:
            return [await self.run(observation, arguments, Line.of(request, time.perf_counter()))]

        return self._follow(one())

    async def ask_rows(
        self, make: Callable[[int, int], Request], row: Callable[[int], dict[str, Any]], rows: int
    ) -> list[Outcome]:
        """An outcome of each row, up to the first few of which one is wrong. Each is a request of its own."""
        outcomes: list[Outcome] = []
        while len(outcomes) < rows and all(outcome.wrong is None for outcome in outcomes):
            few = range(len(outcomes), min(rows, len(outcomes) + ROWS_AT_ONCE))
            asked = [self.ask(make(1, rows - index - 1), row(index), {}) for index in few]
            outcomes += [outcome for (outcome,) in await asyncio.gather(*asked)]
        return outcomes

    def stop(self) -> None:
        self._stopping = True

    async def drain(self) -> None:
        if self._going:
            await asyncio.wait(tuple(self._going))

    def close(self) -> None:
        self._stopping = True
        if self._watch is not None:
            self._watch.stop()

    def _lose(self, reason: str) -> None:
        """Ray has ended: answer all requests with the reason."""
        self._lost_for = reason
        self._on_lost(reason)
        loop = asyncio.get_running_loop()
        for work in self._going:  # `run` makes an answer of the cancellation, but only once it has begun: so not yet
            loop.call_soon(work.cancel)

    def _follow(self, work: Coroutine[Any, Any, list[Outcome]]) -> "asyncio.Future[list[Outcome]]":
        task = asyncio.ensure_future(work)
        self._going.add(task)
        task.add_done_callback(self._going.discard)
        return task

    async def run(self, observation: dict[str, Any], arguments: Mapping[str, Any], line: Line) -> Outcome:
        """One request. Cancelling it cancels it at the replica, too, unless it runs already."""
        if self._lost_for is not None:
            return Outcome(0.0, wrong="lost", text=self._lost_for)
        if self._stopping:
            return STOPPING
        from grpc import RpcError
        from ray.exceptions import RayActorError, RayTaskError
        from ray.serve.exceptions import BackPressureError, DeploymentUnavailableError

        asked = time.perf_counter()
        response = self._handle.infer.remote(observation, arguments, line)
        try:
            answer: Answer = await asyncio.wait_for(_result(response), self._answer_seconds)
        except asyncio.TimeoutError:
            response.cancel()
            return self._lost(asked, f"no replica answered within {self._answer_seconds:g} s; ask again")
        except asyncio.CancelledError:
            if self._lost_for is not None:
                return Outcome(time.perf_counter() - asked, wrong="lost", text=self._lost_for)
            response.cancel()
            raise
        except BackPressureError:
            return Outcome(0.0, wrong="busy", text=f"busy: {ROUTER_LINE} requests wait for a replica; try again")
        except DeploymentUnavailableError as error:
            return self._lost(asked, f"there is none: {error.message}")
        except RayTaskError:  # raised by our code there
            raise
        except (RayActorError, RpcError):
            return self._lost(asked, "its process ended, or can't be reached, during this request; ask again")
        return self._noted(answer, time.perf_counter() - asked)

    def _noted(self, answer: Answer, total: float) -> Outcome:
        """The outcome, its times in the metrics. `total`: seconds since it was asked for here."""
        outcome = answer.outcome
        if outcome.wrong == "stopping":
            return Outcome(0.0, wrong="busy", text="busy: the replica is being replaced; try again")
        if outcome.wrong in ("busy", "late", "replaced"):
            return outcome
        labels = (answer.replica, answer.checkpoint)
        self._inference.labels(*labels).observe(outcome.seconds)
        self._waiting.labels(*labels).observe(max(0.0, answer.seconds - outcome.seconds))
        self._metrics.inference_seconds.observe(outcome.seconds)
        self._metrics.queue_seconds.observe(max(0.0, total - outcome.seconds))
        self._metrics.batch_size.observe(outcome.together)
        return replace(outcome, run=hash((answer.replica, outcome.run)))  # replicas count their runs for themselves

    def _lost(self, asked: float, text: str) -> Outcome:
        return Outcome(time.perf_counter() - asked, wrong="replica", text=text)


async def _result(response: Any) -> Any:
    return await response
