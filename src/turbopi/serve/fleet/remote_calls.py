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
from turbopi.serve.requests import MAX_BATCH_ROWS, STOPPING, Result
from turbopi.serve.scheduling.schedule import Request

ROUTER_LINE = 256  # requests that may wait for a replica while none is there
ROWS_AT_ONCE = 8  # observations of one batch message that are at the replicas


class RemoteCalls:
    """Has requests computed by the replicas of `handle`, and counts their times by replica in `metrics`.

    The line is at the replicas: each has its own, with the deadlines and priorities of its requests, and forms its own
    batches. No request of a session replaces another: they may be at different replicas.

    watch             over the cluster, from `warm_up` to `close`; None: no watch
    on_lost(reason)   is called when Ray has ended; requests that wait are answered then
    """

    largest = MAX_BATCH_ROWS  # a batch message's observations are requests of their own: there is nothing to split

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
        self._running: set[asyncio.Future[list[Result]]] = set()
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
        return bool(self._running)

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

    def submit(
        self, request: Request, observation: dict[str, Any], arguments: Mapping[str, Any]
    ) -> "asyncio.Future[list[Result]]":
        """Begin the request; one result. Cancelling it cancels it at the replica, too, unless it runs already."""

        async def one() -> list[Result]:
            return [await self.run(observation, arguments, Line.of(request, time.perf_counter()))]

        return self._follow(one())

    async def submit_batch(
        self, make: Callable[[int, int], Request], row: Callable[[int], dict[str, Any]], rows: int
    ) -> list[Result]:
        """A result of each row, up to the first few that hold an error. Each row is a request of its own."""
        results: list[Result] = []
        while len(results) < rows and all(result.error is None for result in results):
            few = range(len(results), min(rows, len(results) + ROWS_AT_ONCE))
            submitted = [self.submit(make(1, rows - index - 1), row(index), {}) for index in few]
            results += [result for (result,) in await asyncio.gather(*submitted)]
        return results

    def stop(self) -> None:
        self._stopping = True

    async def drain(self) -> None:
        if self._running:
            await asyncio.wait(tuple(self._running))

    def close(self) -> None:
        self._stopping = True
        if self._watch is not None:
            self._watch.stop()

    def _lose(self, reason: str) -> None:
        """Ray has ended: answer all requests with the reason."""
        self._lost_for = reason
        self._on_lost(reason)
        loop = asyncio.get_running_loop()
        for work in self._running:  # `run` makes an answer of the cancellation, but only once it has begun: so not yet
            loop.call_soon(work.cancel)

    def _follow(self, work: Coroutine[Any, Any, list[Result]]) -> "asyncio.Future[list[Result]]":
        task = asyncio.ensure_future(work)
        self._running.add(task)
        task.add_done_callback(self._running.discard)
        return task

    async def run(self, observation: dict[str, Any], arguments: Mapping[str, Any], line: Line) -> Result:
        """One request. Cancelling it cancels it at the replica, too, unless it runs already."""
        if self._lost_for is not None:
            return Result(0.0, error="lost", text=self._lost_for)
        if self._stopping:
            return STOPPING
        from grpc import RpcError
        from ray.exceptions import RayActorError, RayTaskError
        from ray.serve.exceptions import BackPressureError, DeploymentUnavailableError

        requested = time.perf_counter()
        response = self._handle.infer.remote(observation, arguments, line)
        try:
            answer: Answer = await asyncio.wait_for(_result(response), self._answer_seconds)
        except asyncio.TimeoutError:
            response.cancel()
            return self._lost(requested, f"no replica answered within {self._answer_seconds:g} s; ask again")
        except asyncio.CancelledError:
            if self._lost_for is not None:
                return Result(time.perf_counter() - requested, error="lost", text=self._lost_for)
            response.cancel()
            raise
        except BackPressureError:
            return Result(0.0, error="busy", text=f"busy: {ROUTER_LINE} requests wait for a replica; try again")
        except DeploymentUnavailableError as error:
            return self._lost(requested, f"there is none: {error.message}")
        except RayTaskError:  # raised by our code there
            raise
        except (RayActorError, RpcError):
            return self._lost(requested, "its process ended, or can't be reached, during this request; ask again")
        return self._record(answer, time.perf_counter() - requested)

    def _record(self, answer: Answer, total: float) -> Result:
        """Count its times in the metrics, and return the result. `total`: seconds since it was requested here."""
        result = answer.result
        if result.error == "stopping":
            return Result(0.0, error="busy", text="busy: the replica is being replaced; try again")
        if result.error in ("busy", "late", "replaced"):
            return result
        labels = (answer.replica, answer.checkpoint)
        self._inference.labels(*labels).observe(result.seconds)
        self._waiting.labels(*labels).observe(max(0.0, answer.seconds - result.seconds))
        self._metrics.inference_seconds.observe(result.seconds)
        self._metrics.queue_seconds.observe(max(0.0, total - result.seconds))
        self._metrics.batch_size.observe(result.batch)
        # Replicas count their runs for themselves, and have clocks of their own.
        return replace(result, run=hash((answer.replica, result.run)), began=0.0)

    def _lost(self, requested: float, text: str) -> Result:
        return Result(time.perf_counter() - requested, error="replica", text=text)


async def _result(response: Any) -> Any:
    return await response
