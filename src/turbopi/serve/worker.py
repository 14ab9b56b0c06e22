"""One thread that runs the policy, for the turns that schedule.py decides about."""

import asyncio
import time
import traceback
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeVar

from turbopi.serve.outcome import Outcome
from turbopi.serve.schedule import Request, Schedule

R = TypeVar("R")

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

    def __init__(
        self,
        schedule: Schedule,
        run: Callable[[tuple[Request, ...]], Ran] | None = None,
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:
        self.schedule = schedule
        self._run, self._clock = run, clock
        self._executor = ThreadPoolExecutor(1, thread_name_prefix="turbopi-inference")
        self._answers: dict[Request, asyncio.Future[list[Outcome]]] = {}
        self._going: set[Future[Any]] = set()  # turns and work that they began
        self._timer: asyncio.TimerHandle | None = None
        self._stopping = False

    @property
    def waiting(self) -> int:
        """Requests that wait for their turn."""
        return self.schedule.waiting

    @property
    def running(self) -> bool:
        """A turn is on the thread, or what one began goes on."""
        return bool(self._going)

    async def call(self, function: Callable[[], R]) -> R:
        """`function()` on the thread: before there are requests. Raises what it raises."""
        return await asyncio.get_running_loop().run_in_executor(self._executor, function)

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
        for refused in self.schedule.add(request, self._clock()):
            self._answer(refused.request, [Outcome(0.0, wrong=refused.kind, text=refused.text)])
        self._next()
        return answer

    def stop(self) -> None:
        """Turn away the requests that wait, and all that come; the running turn goes on."""
        self._stopping = True
        for request in self.schedule.stop():
            self._answer(request, [STOPPING])
        self._set_timer(None)

    async def drain(self) -> None:
        """Wait for the running turn to end, if there is one, and for all that turns began. Call `stop` first."""
        while self._going:
            await asyncio.wait([asyncio.wrap_future(future) for future in tuple(self._going)])
            await asyncio.sleep(0)  # for what `_ended` begins

    def close(self) -> None:
        """Let the thread end. It isn't waited for."""
        self._stopping = True
        self._set_timer(None)
        self._executor.shutdown(wait=False, cancel_futures=True)

    # --- turns --------------------------------------------------------------------------------------------------------

    def _next(self) -> None:
        """Begin the next turn, if it is time for one; else be called again when it may be."""
        decision = self.schedule.decide(self._clock())
        for refused in decision.refused:
            self._answer(refused.request, [Outcome(0.0, wrong=refused.kind, text=refused.text)])
        self._set_timer(decision.wake)
        if decision.turn:
            assert self._run is not None
            self._follow(self._executor.submit(self._run, decision.turn), partial(self._ended, decision.turn))

    def _ended(self, turn: tuple[Request, ...], future: "Future[Ran]") -> None:
        if future.cancelled():
            return
        if (error := future.exception()) is not None:  # a fault of this server: nobody shall wait for ever
            text = "".join(traceback.format_exception(error))
            ran = Ran([[Outcome(0.0, wrong="policy", text=text)] * request.rows for request in turn])
        else:
            ran = future.result()
        self.schedule.freed(self._clock(), ran.seconds)
        for request, answer in zip(turn, ran.answers, strict=True):
            if answer is None and request in self._answers:
                self.schedule.put_back(request)
        self._next()  # first: the policy shouldn't wait for what follows
        for request, answer in zip(turn, ran.answers, strict=True):
            if isinstance(answer, Future):
                self._follow(answer, partial(self._finished, request))
            elif answer is not None:
                self._answer(request, answer)

    def _finished(self, request: Request, future: "Future[list[Outcome]]") -> None:
        self._answer(request, future.result())

    def _follow(self, future: Future[R], then: Callable[[Future[R]], None]) -> None:
        """Call `then` in the event loop when `future` is done.

        A Future keeps its callbacks: none may refer to it, or what they hold (observations) would wait for the garbage
        collector.
        """
        loop = asyncio.get_running_loop()

        def tell(done: Future[R]) -> None:
            if not loop.is_closed():
                loop.call_soon_threadsafe(self._followed, done, then)

        self._going.add(future)
        future.add_done_callback(tell)

    def _followed(self, future: Future[R], then: Callable[[Future[R]], None]) -> None:
        self._going.discard(future)
        then(future)

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
            self._timer = asyncio.get_running_loop().call_later(max(0.0, when - self._clock()), self._next)
