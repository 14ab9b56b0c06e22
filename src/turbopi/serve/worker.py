"""One thread that runs the policy, and the short line in front of it."""

import asyncio
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, TypeVar

A = TypeVar("A")
R = TypeVar("R")


class Busy(Exception):
    """The line is full."""


class Stopping(Exception):
    """The worker takes no more calls."""


class Worker:
    """Runs one call at a time, first come first served, always on the same thread.

    One thread because a policy isn't re-entrant, and always the same one because a CUDA device is chosen per thread.
    The line is a fair lock held by the running call: a call that gives up waiting leaves nothing behind. A call may
    also only begin its work (`begin`): then the next one has its turn while that goes on elsewhere.
    """

    def __init__(self, queue_limit: int) -> None:
        self.queue_limit = queue_limit
        self.waiting = 0
        self._turn = asyncio.Lock()
        self._executor = ThreadPoolExecutor(1, thread_name_prefix="turbopi-inference")
        self._begun: set[Future[Any]] = set()  # work that goes on though its call has left the thread
        self._stopping = False

    @property
    def running(self) -> bool:
        """A call is on the thread, or about to be, or what one began goes on."""
        return self._turn.locked() or bool(self._begun)

    async def call(self, function: Callable[[A], R], argument: A) -> R:
        """`function(argument)` on the thread. Cancelled while waiting, it never runs; while running, it ends unheard.

        Raises Busy if `queue_limit` calls are waiting already, and Stopping once `stop` was called.
        """
        if self._turn.locked() and self.waiting >= self.queue_limit:
            raise Busy
        self.waiting += 1
        try:
            await self._turn.acquire()
        finally:
            self.waiting -= 1
        if self._stopping:
            self._turn.release()
            raise Stopping
        call = asyncio.get_running_loop().run_in_executor(self._executor, function, argument)
        call.add_done_callback(lambda _: self._turn.release())  # when it has ended, not when its caller leaves
        return await asyncio.shield(call)

    async def begin(self, function: Callable[[A], "Future[R]"], argument: A) -> R:
        """The result of the Future that `function(argument)` returns; only the function itself takes the thread.

        Cancelled once that has run, the work goes on unheard. Raises what `call` raises, and what the Future holds.
        """

        def begun(argument: A) -> "Future[R]":
            future = function(argument)
            self._begun.add(future)
            future.add_done_callback(self._begun.discard)
            return future

        return await asyncio.shield(asyncio.wrap_future(await self.call(begun, argument)))

    def stop(self) -> None:
        """Turn away the calls that wait, and all that come; the running one goes on."""
        self._stopping = True

    async def drain(self) -> None:
        """Wait for the running call to end, if there is one, and for all that calls began. Call `stop` first."""
        async with self._turn:
            pass
        if going := [asyncio.wrap_future(future) for future in tuple(self._begun)]:
            await asyncio.wait(going)

    def close(self) -> None:
        """Let the thread end. It isn't waited for."""
        self.stop()
        self._executor.shutdown(wait=False, cancel_futures=True)
