"""The thread on which the policy runs."""

import queue
import threading
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any, Protocol


class Inference(Protocol):
    """Runs one call after the other, somewhere else."""

    def begin(self, call: Callable[[], Any]) -> "Future[Any]":
        """Have it run after those that were begun before. The Future gets what it returns or raises."""

    def close(self, timeout_s: float) -> bool:
        """Take no more calls. Whether the running one ended in time."""


class BackgroundThread:
    """One thread for all calls: a CUDA device is chosen by thread. A daemon: a policy that hangs lets the process
    end.
    """

    def __init__(self, name: str = "turbopi-realtime") -> None:
        self._calls: queue.SimpleQueue[tuple[Callable[[], Any], Future[Any]] | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def begin(self, call: Callable[[], Any]) -> "Future[Any]":
        future: Future[Any] = Future()
        self._calls.put((call, future))
        return future

    def close(self, timeout_s: float) -> bool:
        self._calls.put(None)
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def _run(self) -> None:
        while (job := self._calls.get()) is not None:
            call, future = job
            try:
                future.set_result(call())
            except BaseException as error:  # sys.exit() in a policy, too, must not leave the robot without an answer
                future.set_exception(error)
            del job, call, future  # an idle thread holds no observation
