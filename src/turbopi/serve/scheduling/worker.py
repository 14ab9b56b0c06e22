"""One thread that runs the policy, for the turns that schedule.py decides about."""

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

from turbopi.serve.outcome import Outcome
from turbopi.serve.scheduling.schedule import Refused, Request, Schedule

logger = logging.getLogger(__name__)

R = TypeVar("R")

DRAIN_SECONDS = 10.0
STOPPING = Outcome(0.0, wrong="stopping", text="the server is shutting down")


@dataclass(frozen=True)
class Ran:
    """What became of a turn.

    answers  of each request: an outcome of each of its rows; a Future of that, if its work goes on elsewhere; or None:
             it shall run again, alone
    seconds  in the policy, if they tell how long such a turn takes
    """

    answers: Sequence[list[Outcome] | Future[list[Outcome]] | None]
    seconds: float | None = None


class Worker:
    """Runs turns, one at a time, always on the same thread. For the event loop's thread alone.

    One thread because a policy isn't re-entrant, and always the same one because a CUDA device is chosen per thread.
    `run(requests)` is called on it; it never raises. A turn may also only begin its work (a Future among its answers):
    then the next turn begins while that goes on.
    """

    def __init__(self, schedule: Schedule, run: Callable[[tuple[Request, ...]], Ran] | None = None) -> None:
        self.schedule, self._run = schedule, run
        # A queue and not an executor, whose Future costs a turn twice as much as the queue does.
        self._work: queue.SimpleQueue[Callable[[], None] | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._perform, name="turbopi-inference", daemon=True)
        self._closed = False
        self._turns = 0  # on the thread or on their way
        self._answers: dict[Request, asyncio.Future[list[Outcome]]] = {}
        self._going: set[Future[Any]] = set()  # work that turns began
        self._idle: asyncio.Future[None] | None = None  # `drain` waits for it
        self._timer: asyncio.TimerHandle | None = None
        self._stopping = False

    @property
    def waiting(self) -> int:
        """Requests that wait for their turn."""
        return self.schedule.waiting

    @property
    def running(self) -> bool:
        """A turn is on the thread, or what one began goes on."""
        return bool(self._turns or self._going)

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

    def ask(self, request: Request) -> "asyncio.Future[list[Outcome]]":
        """An outcome of each row of the request, once it has them: what is wrong if it gets no turn.

        Cancelled while it waits, it never runs; while it runs, that ends unheard.
        """
        answer: asyncio.Future[list[Outcome]] = asyncio.get_running_loop().create_future()
        if self._stopping:
            answer.set_result([STOPPING])
            return answer
        self._answers[request] = answer
        answer.add_done_callback(partial(self._left, request))
        self._refuse(self.schedule.add(request, time.perf_counter()))
        self._next()
        return answer

    def stop(self) -> None:
        """Turn away the requests that wait, and all that come; the running turn goes on."""
        self._stopping = True
        for request in self.schedule.stop():
            self._answer(request, [STOPPING])
        self._set_timer(None)

    async def drain(self) -> None:
        """Wait for the running turn to end, if there is one, and for all that turns began. Call `stop` first.

        A policy that never ends holds nobody: after DRAIN_SECONDS and twice its usual time the log says so, and its
        requests are turned away.
        """
        if not self.running:
            return
        usual = self.schedule.times.seconds(1, time.perf_counter()) or 0.0
        seconds = DRAIN_SECONDS + 2 * usual * max(self._turns, len(self._going))
        self._idle = asyncio.get_running_loop().create_future()
        try:
            await asyncio.wait_for(self._idle, seconds)
        except asyncio.TimeoutError:
            text = "stopping without %d calls of the policy, which haven't ended within %.0f s"
            logger.error(text, self._turns + len(self._going), seconds)
            for request in tuple(self._answers):
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
            self._turns += 1
            self._put(partial(self._take, decision.turn, asyncio.get_running_loop()))

    def _ended(self, turn: tuple[Request, ...], ran: Ran) -> None:
        self._turns -= 1
        self.schedule.freed(time.perf_counter(), ran.seconds)
        for request, answer in zip(turn, ran.answers, strict=True):
            if answer is None and request in self._answers:
                self.schedule.put_back(request)
        self._next()  # first: the policy shouldn't wait for what follows
        for request, answer in zip(turn, ran.answers, strict=True):
            if isinstance(answer, Future):
                self._follow(answer, request)
            elif answer is not None:
                self._answer(request, answer)
        self._look_if_idle()

    def _follow(self, future: "Future[list[Outcome]]", request: Request) -> None:
        """Answer the request in the event loop when `future` is done.

        A Future keeps its callbacks: none may refer to it, or what they hold (observations) would wait for the garbage
        collector.
        """
        loop = asyncio.get_running_loop()

        def tell(done: "Future[list[Outcome]]") -> None:
            if not loop.is_closed():
                loop.call_soon_threadsafe(self._finished, request, done)

        self._going.add(future)
        future.add_done_callback(tell)

    def _finished(self, request: Request, future: "Future[list[Outcome]]") -> None:
        self._going.discard(future)
        self._answer(request, future.result())
        self._look_if_idle()

    def _look_if_idle(self) -> None:
        if self._idle is not None and not self.running:
            if not self._idle.done():
                self._idle.set_result(None)
            self._idle = None

    def _refuse(self, refused: Iterable[Refused]) -> None:
        for one in refused:
            self._answer(one.request, [Outcome(0.0, wrong=one.kind, text=one.text)])

    def _answer(self, request: Request, outcomes: list[Outcome]) -> None:
        answer = self._answers.pop(request, None)
        if answer is not None and not answer.done():
            answer.set_result(outcomes)

    def _left(self, request: Request, answer: "asyncio.Future[list[Outcome]]") -> None:
        if answer.cancelled():
            self._answers.pop(request, None)
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

    def _perform(self) -> None:
        while (work := self._work.get()) is not None:
            work()
            del work  # a thread that waits holds nothing

    def _take(self, turn: tuple[Request, ...], loop: asyncio.AbstractEventLoop) -> None:
        """On the thread: a turn."""
        assert self._run is not None
        try:
            ran = self._run(turn)
        except BaseException as error:  # a fault of this server: nobody shall wait for ever
            text = "".join(traceback.format_exception(error))
            ran = Ran([[Outcome(0.0, wrong="policy", text=text)] * request.rows for request in turn])
        with contextlib.suppress(RuntimeError):  # the loop is closed: nobody waits
            loop.call_soon_threadsafe(self._ended, turn, ran)
