"""Compile what a sequence of kernels needs on all cores of the host, before the sequence runs for the first time.

A kernel is compiled where it is launched first, so a sequence's kernels would be compiled one after the other. In
`compiling_ahead` launches of our kernels only note what has to be compiled. NVRTC and Triton release Python's lock
while they compile, so threads are enough. Predicted and measured: docs/dev/log/portable.md.
"""

import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import ExitStack, contextmanager
from functools import cache
from typing import Any, Final, Generic, ParamSpec, TypeVar, cast

from turbopi.support.processors import usable_processors

Given = ParamSpec("Given")
Made = TypeVar("Made")

MOST_THREADS: Final = 16
_NOTING: Final = threading.local()  # `pool` and `made`: in a thread that is in `compiling_ahead`


class _Noted:
    """In place of a kernel that is being compiled."""

    max_clusters: Final = 1 << 20  # no tile is refused, and none is taken for another

    def launch_dependent(self, *given: Any) -> None:
        """Nothing is launched."""


def noting() -> bool:
    """Whether this thread is in `compiling_ahead`, where no kernel may be launched: nothing computed its inputs."""
    return getattr(_NOTING, "pool", None) is not None


@contextmanager
def compiling_ahead() -> Iterator[None]:
    """In this thread, kernels of `MadeOnce` and Triton's aren't launched; at the end all of them are compiled.

    What fails to compile is compiled again, and fails, when it is launched. One thread of the process at a time.
    """
    threads = min(MOST_THREADS, usable_processors())
    with ThreadPoolExecutor(threads, thread_name_prefix="compiling") as pool, ExitStack() as triton:
        _NOTING.pool, _NOTING.made = pool, {}
        try:
            _note_triton(triton, pool)
            yield
            wait(_NOTING.made.values())
        finally:
            del _NOTING.pool, _NOTING.made


class MadeOnce(Generic[Given, Made]):
    """`functools.cache` for what compiles and loads a kernel; in `compiling_ahead` another thread makes it."""

    def __init__(self, make: Callable[Given, Made]) -> None:
        self._made: Any = cache(make)
        self.cache_clear: Callable[[], None] = self._made.cache_clear

    def __call__(self, *key: Given.args, **none: Given.kwargs) -> Made:
        if not noting():
            return cast(Made, self._made(*key))
        noted: dict[Any, Future[Made]] = _NOTING.made
        if (self, key) not in noted:
            noted[self, key] = _NOTING.pool.submit(self._made, *key)
        return cast(Made, _Noted())


def _note_triton(stack: ExitStack, pool: ThreadPoolExecutor) -> None:
    """Until `stack` is closed, this thread's launches of Triton's kernels compile in `pool` and do nothing else. A
    Triton without `AsyncCompileMode` compiles each where it is noted.
    """
    try:
        from triton.runtime.jit import JITFunction
    except ImportError:
        return
    run = JITFunction.run

    def noted(function: Any, *given: Any, grid: Any, warmup: bool, **named: Any) -> Any:
        return run(function, *given, grid=grid, warmup=warmup or noting(), **named)

    JITFunction.run = noted
    stack.callback(setattr, JITFunction, "run", run)
    try:
        from triton.runtime._async_compile import AsyncCompileMode
    except ImportError:
        return
    stack.enter_context(AsyncCompileMode(pool, ignore_errors=True))
