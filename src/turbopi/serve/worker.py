"""One thread that runs the policy, in the turns that scheduling/schedule.py decides."""

import asyncio
import contextlib
import logging
import queue
import threading
import time
import traceback
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Future
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeVar

from turbopi.serve.requests import STOPPING, Result
from turbopi.serve.scheduling.schedule import Refused, Request, Schedule

logger = logging.getLogger(__name__)

R = TypeVar("R")

DRAIN_SECONDS = 10.0


@dataclass(frozen=True)
class Ran:
    """The results of a turn.

    results  of each request: a result of each of its rows; a Future of these, if its work goes on elsewhere; or None:
             the request runs again, in a turn of its own
    seconds  in the policy, if such a turn usually takes as long
    """

    results: Sequence[list[Result] | Future[list[Result]] | None]
    seconds: float | None = None


class Worker:
    """Runs turns, one at a time, always on the same thread. For the event loop's thread alone.

    One thread because a policy isn't re-entrant, and always the same one because a CUDA device is chosen per thread.
    `run(requests)` is called on it; it never raises. A turn may also only begin its work (a Future among its results):
    then the next turn begins while that work runs.
    """

    def __init__(self, schedule: Schedule, run: Callable[[tuple[Request, ...]], Ran] | None = None) -> None:
        self.schedule, self._run = schedule, run
        # A queue and not an executor, whose Future costs a turn twice as much as the queue does.
        self._work: queue.SimpleQueue[Callable[[], None] | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._run_work, name="turbopi-inference", daemon=True)
        self._closed = False
        self._turns = 0  # on the thread or on their way
        self._waiting: dict[Request, asyncio.Future[list[Result]]] = {}  # until they have their results
        self._background: set[Future[Any]] = set()  # work that turns began
        self._idle: asyncio.Future[None] | None = None  # `drain` waits for it
        self._timer: asyncio.TimerHandle | None = None
        self._begun: tuple[Request, float] | None = None  # what the schedule doesn't know of yet
        self._stopping = False

    @property
    def waiting(self) -> int:
        """Requests that wait for their turn."""
        return self.schedule.waiting

    @property
    def running(self) -> bool:
        """Whether a turn is on the thread, or work that a turn began still runs."""
        return bool(self._turns or self._background)

    async def call(self, function: Callable[[], R]) -> R:
        """`function()` on the thread: before there are requests. Raises what it raises."""
        answer: Future[R] = Future()

        def perform() -> None:
            try:
                answer.set_result(function())
            except BaseException as error:
                answer.set_exception(error)

        self._put(perform)
        return await asyncio.wrap_future(answer)

    def submit(self, request: Request) -> "asyncio.Future[list[Result]]":
        """A result of each row of the request, once it had its turn; one with an error if it is refused a turn.

        Cancelled while it waits, it never runs; cancelled while it runs, its results are dropped.
        """
        results: asyncio.Future[list[Result]] = asyncio.get_running_loop().create_future()
        if self._stopping:
            results.set_result([STOPPING])
            return results
        self._waiting[request] = results
        results.add_done_callback(partial(self._remove_cancelled, request))
        self._note_begun()
        now = time.perf_counter()
        if self.schedule.begin_alone(request, now):
            self._begin((request,))
            self._begun = request, now
        else:
            self._refuse(self.schedule.add(request, now))
            self._next()
        return results

    def stop(self) -> None:
        """Refuse the requests that wait, and all new ones; the running turn goes on."""
        self._stopping = True
        for request in self.schedule.stop():
            self._answer(request, [STOPPING])
        self._set_timer(None)

    async def drain(self) -> None:
        """Wait for the running turn to end, if there is one, and for all work that turns began. Call `stop` first.

        A policy that never ends blocks nothing: after DRAIN_SECONDS and twice its usual time the log says so, and its
        requests are refused.
        """
        if not self.running:
            return
        usual = self.schedule.times.seconds(1, time.perf_counter()) or 0.0
        seconds = DRAIN_SECONDS + 2 * usual * max(self._turns, len(self._background))
        self._idle = asyncio.get_running_loop().create_future()
        try:
            await asyncio.wait_for(self._idle, seconds)
        except asyncio.TimeoutError:
            text = "stopping without %d calls of the policy, which haven't ended within %.0f s"
            logger.error(text, self._turns + len(self._background), seconds)
            for request in tuple(self._waiting):
                self._answer(request, [STOPPING])

    def close(self) -> None:
        """Let the thread end. It isn't waited for."""
        self._stopping = True
        self._set_timer(None)
        if not self._closed:
            self._closed = True
            self._work.put(None)

    # --- turns --------------------------------------------------------------------------------------------------------

    def _next(self) -> None:
        """Begin the next turn, if it is time for one; else be called again when it may be."""
        decision = self.schedule.decide(time.perf_counter())
        self._refuse(decision.refused)
        self._set_timer(decision.wake)
        if decision.turn:
            self._begin(decision.turn)

    def _begin(self, turn: tuple[Request, ...]) -> None:
        self._turns += 1
        self._put(partial(self._run_turn, turn, asyncio.get_running_loop()))

    def _note_begun(self) -> None:
        """Have the schedule learn of the request that began alone: not at once, as the policy would wait for that."""
        begun, self._begun = self._begun, None
        if begun is not None:
            self.schedule.note(*begun)

    def _ended(self, turn: tuple[Request, ...], ran: Ran) -> None:
        self._turns -= 1
        self._note_begun()
        self.schedule.freed(time.perf_counter(), ran.seconds)
        for request, results in zip(turn, ran.results, strict=True):
            if results is None and request in self._waiting:
                self.schedule.put_back(request)
        self._next()  # first: the policy shouldn't wait for what follows
        for request, results in zip(turn, ran.results, strict=True):  # no client should wait for what others cause
            if request.answer is not None and request in self._waiting and isinstance(results, list):
                with contextlib.suppress(Exception):  # its task finds the same fault, and says so
                    request.answer(*results)
        for request, results in zip(turn, ran.results, strict=True):
            if isinstance(results, Future):
                self._answer_later(request, results)
            elif results is not None:
                self._answer(request, results)
        self._check_idle()

    def _answer_later(self, request: Request, future: "Future[list[Result]]") -> None:
        """Answer the request in the event loop when `future` is done.

        A Future stores its callbacks: if one referred to the Future, its observations would stay in memory until the
        next garbage collection.
        """
        loop = asyncio.get_running_loop()

        def done(ended: "Future[list[Result]]") -> None:
            if not loop.is_closed():
                loop.call_soon_threadsafe(self._finished, request, ended)

        self._background.add(future)
        future.add_done_callback(done)

    def _finished(self, request: Request, future: "Future[list[Result]]") -> None:
        self._background.discard(future)
        self._answer(request, future.result())
        self._check_idle()

    def _check_idle(self) -> None:
        if self._idle is not None and not self.running:
            if not self._idle.done():
                self._idle.set_result(None)
            self._idle = None

    def _refuse(self, refused: Iterable[Refused]) -> None:
        for one in refused:
            self._answer(one.request, [Result(0.0, error=one.kind, text=one.text)])

    def _answer(self, request: Request, results: list[Result]) -> None:
        waiting = self._waiting.pop(request, None)
        if waiting is not None and not waiting.done():
            waiting.set_result(results)

    def _remove_cancelled(self, request: Request, results: "asyncio.Future[list[Result]]") -> None:
        if results.cancelled():
            self._waiting.pop(request, None)
            self.schedule.remove(request)

    def _set_timer(self, when: float | None) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        if when is not None:
            self._timer = asyncio.get_running_loop().call_later(max(0.0, when - time.perf_counter()), self._next)

    # --- the thread ---------------------------------------------------------------------------------------------------

    def _put(self, work: Callable[[], None]) -> None:
        if self._closed:
            raise RuntimeError("this worker is closed")
        if self._thread.ident is None:
            self._thread.start()
        self._work.put(work)

    def _run_work(self) -> None:
        while (work := self._work.get()) is not None:
            work()
            del work  # an idle thread must not hold an observation in memory

    def _run_turn(self, turn: tuple[Request, ...], loop: asyncio.AbstractEventLoop) -> None:
        """Run a turn, on the thread."""
        assert self._run is not None
        try:
            ran = self._run(turn)
        except BaseException as error:  # a fault of this server: its requests must be answered all the same
            text = "".join(traceback.format_exception(error))
            ran = Ran([[Result(0.0, error="policy", text=text)] * request.rows for request in turn])
        with contextlib.suppress(RuntimeError):  # the loop is closed: no request waits
            loop.call_soon_threadsafe(self._ended, turn, ran)
