"""A server's requests, computed by the replicas of a fleet (fleet.py), and which replica computes which."""

import asyncio
import itertools
import logging
import random
import time
from collections.abc import Callable, Coroutine, Mapping
from contextlib import suppress
from dataclasses import replace
from functools import partial
from typing import Any

from prometheus_client import Histogram

from turbopi.realtime.wire import pack
from turbopi.serve.fleet.channel import PLACES, Place, connect, messages, send
from turbopi.serve.fleet.replica import CLOSING, Answer, Line
from turbopi.serve.fleet.session_affinity import SessionAffinity
from turbopi.serve.fleet.watch import Watch
from turbopi.serve.metrics import BUCKETS, Metrics
from turbopi.serve.requests import MAX_BATCH_ROWS, STOPPING, Result
from turbopi.serve.scheduling.schedule import Request

logger = logging.getLogger(__name__)

MOST_WAITING = 256  # requests that may wait for a replica while none is there
ROWS_AT_ONCE = 8  # observations of one batch message that are at the replicas
LOOK_SECONDS = 0.25  # between two looks at which replicas there are


class _Replica:
    """The way to a replica, and the requests that wait for its answers. `leaving`: it gets no more."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._writer, self._numbers = writer, itertools.count(1)
        self.requests: dict[int, asyncio.Future[Answer]] = {}
        self.leaving = False
        self.reads = asyncio.ensure_future(self._read(reader))  # to its end

    def request(self, head: tuple[Any, ...], message: bytes) -> "asyncio.Future[Answer]":
        """Its answer, or a ConnectionError. Cancelled, it is given up at the replica, too, unless it runs already."""
        number, answer = next(self._numbers), asyncio.get_running_loop().create_future()
        self.requests[number] = answer
        answer.add_done_callback(partial(self._end, number))
        send(self._writer, (number, *head), message)
        return answer

    def leave(self) -> None:
        self.leaving = True
        if not self.requests:
            self._writer.close()

    def _end(self, number: int, answer: "asyncio.Future[Answer]") -> None:
        del self.requests[number]
        if answer.cancelled():
            send(self._writer, (number,))
        if self.leaving:
            self.leave()

    async def _read(self, reader: asyncio.StreamReader) -> None:
        try:
            async for (number, answer), _ in messages(reader):
                if number == CLOSING:
                    self.leave()
                elif (waits := self.requests.get(number)) is not None and not waits.done():
                    waits.set_result(answer)
        finally:
            self.leaving = True
            self._writer.close()
            for waits in self.requests.values():
                if not waits.done():
                    waits.set_exception(ConnectionResetError())


class RemoteCalls:
    """Has requests computed by a fleet's replicas, and counts their times by replica in `metrics`.

    A request goes to the replica that has the fewest of this server. By Ray Serve's count, which is old, two replicas
    gave eight robots 1.5 times the answers of one, by this 2.0 times (docs/dev/log/serving.md). A client of a short
    think time goes to the replica that answered it (session_affinity.py).

    The line is at the replicas: each has its own, with the deadlines and priorities of its requests, and forms its own
    batches. No request of a session replaces another: they may be at different replicas.

    fleet             its name in channel.PLACES
    want()            is called when a request waits and no replica is there
    watch             over the cluster, from `warm_up` to `close`; None: no watch
    on_lost(reason)   is called when Ray has ended; requests that wait are answered then
    """

    largest = MAX_BATCH_ROWS  # a batch message's observations are requests of their own: there is nothing to split

    def __init__(
        self,
        fleet: str,
        metrics: Metrics,
        answer_seconds: float,
        want: Callable[[], object] = lambda: None,
        watch: Watch | None = None,
        on_lost: Callable[[str], None] = lambda reason: None,
    ) -> None:
        self._fleet, self._metrics, self._answer_seconds = fleet, metrics, answer_seconds
        self._want, self._watch, self._on_lost = want, watch, on_lost
        self._replicas: dict[str, _Replica] = {}
        self._affinity = SessionAffinity()
        self._without = 0  # requests that wait for a replica
        self._looks: asyncio.Task[None] | None = None
        self._unreached: str | None = None
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
        return (None if self._watch is None else self._watch.unwell) or (None if self._replicas else self._unreached)

    @property
    def reaches_any(self) -> bool:
        """Whether there is a replica. On any thread."""
        return bool(self._replicas)

    def waits(self, session: str) -> bool:
        return False

    async def warm_up(self, **arguments: Any) -> None:
        """Replicas warm up before their first request; what begins here is the way to them, and the watch."""
        await self._look()
        self._looks = asyncio.ensure_future(self._keep_looking())
        if self._watch is not None:
            loop = asyncio.get_running_loop()
            self._watch.start(lambda reason: loop.call_soon_threadsafe(partial(self._lose, reason)))

    def submit(
        self, request: Request, observation: dict[str, Any], arguments: Mapping[str, Any]
    ) -> "asyncio.Future[list[Result]]":
        """Begin the request; one result. Cancelling it cancels it at the replica, too, unless it runs already."""

        async def one() -> list[Result]:
            return [await self.run(request, observation, arguments)]

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
        if self._looks is not None:
            self._looks.cancel()
        for one in self._replicas.values():
            one.reads.cancel()

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

    async def run(self, request: Request, observation: dict[str, Any], arguments: Mapping[str, Any]) -> Result:
        """One request. Cancelling it cancels it at the replica, too, unless it runs already."""
        if self._lost_for is not None:
            return Result(0.0, error="lost", text=self._lost_for)
        if self._stopping:
            return STOPPING
        requested = time.perf_counter()
        deadline = requested + self._answer_seconds
        message = pack(observation) if request.message is None else bytes(request.message)
        try:
            if (name := self._choose(request)) is None:
                if self._without >= MOST_WAITING:
                    return Result(
                        0.0, error="busy", text=f"busy: {MOST_WAITING} requests wait for a replica; try again"
                    )
                name = await self._wait_for_one(request, deadline)
            now = time.perf_counter()
            answering = self._replicas[name].request((arguments, Line.of(request, now)), message)
            answer = await asyncio.wait_for(answering, deadline - now)
        except asyncio.TimeoutError:
            return self._lost(requested, f"no replica answered within {self._answer_seconds:g} s; ask again")
        except asyncio.CancelledError:
            if self._lost_for is not None:
                return Result(time.perf_counter() - requested, error="lost", text=self._lost_for)
            raise
        except ConnectionError:
            return self._lost(requested, "its process ended, or can't be reached, during this request; ask again")
        self._affinity.answered(request.source, name, time.monotonic())
        result = self._record(answer, time.perf_counter() - requested)
        if request.answer is not None and result.error is None:
            with suppress(Exception):  # its task finds the same fault, and says so
                request.answer(result)
        return result

    def _record(self, answer: Answer, total: float) -> Result:
        """Count its times in the metrics, and return the result. `total`: seconds since it was requested here."""
        result = answer.result
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

    # --- replicas -----------------------------------------------------------------------------------------------------

    def _choose(self, request: Request) -> str | None:
        """The replica that gets the request; None: there is none."""
        counts = {name: len(one.requests) for name, one in self._replicas.items() if not one.leaving}
        name: Any = self._affinity.replica_for(request.source, counts, time.monotonic())
        if name is None and counts:
            name = min(random.sample(list(counts), len(counts)), key=counts.__getitem__)
        return name

    async def _wait_for_one(self, request: Request, deadline: float) -> str:
        if not self._without:
            self._want()
        self._without += 1
        try:
            while (name := self._choose(request)) is None:
                if time.perf_counter() >= deadline:
                    raise asyncio.TimeoutError
                await asyncio.sleep(LOOK_SECONDS)
            return name
        finally:
            self._without -= 1

    async def _keep_looking(self) -> None:
        while True:
            await asyncio.sleep(LOOK_SECONDS)
            await self._look()

    async def _look(self) -> None:
        """Reach the replicas that Ray Serve knows, and leave those that it knows no more."""
        places = PLACES.get(self._fleet, {})
        for name in self._replicas.keys() - places.keys():
            self._replicas[name].leave()
        new = places.keys() - self._replicas.keys()
        failures = await asyncio.gather(*(self._reach(name, places[name]) for name in new))  # a machine may be gone
        unreached = next(filter(None, failures), None)
        if unreached is not None and unreached != self._unreached:
            logger.warning("%s", unreached)
        self._unreached = unreached

    async def _reach(self, name: str, place: Place) -> str | None:
        """Why it can't be reached; None if it was."""
        try:
            self._replicas[name] = one = _Replica(*await connect(place))
        except ConnectionError as error:
            return str(error)
        one.reads.add_done_callback(partial(self._left, name))
        return None

    def _left(self, name: str, reads: object) -> None:
        del self._replicas[name]
