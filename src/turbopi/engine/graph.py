"""CUDA graphs, and what their capture shares with the rest of the process.

A capture is thread-local: other threads may allocate, launch and wait for their own streams meanwhile. What they may
not do is to wait for the whole device or to empty the allocator's cache; PyTorch does both when a capture begins. So
this project's code captures, waits for a device and empties the cache under `CAPTURING`, one thread at a time. A
program around it should do so in other threads when warm-up has ended; it should also not come close to the end of the
GPU's memory before, where PyTorch empties the cache by itself. Nor may another thread draw random numbers from the
default CUDA generator of PyTorch while a graph is captured: every capture takes that one, and the draw fails ("Offset
increment outside graph capture"). A generator of its own works.
"""

import gc
import itertools
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, nullcontext
from typing import Any

import torch

from turbopi.kernels.ahead import compiling_ahead
from turbopi.kernels.nvrtc import capturing
from turbopi.models.pi0.exact import exact_float32

Mark = Callable[[str], None]  # is called with each stage at its end, or with `HEAD`
HEAD = "head"  # the mark that cuts a sequence: what is before it is a graph of its own, launched first

CAPTURING = threading.RLock()  # of the process: policies on other devices, too


@contextmanager
def preparing(device: torch.device) -> Iterator[None]:
    """Around whatever loads, packs or compiles for a device: it is the thread's current one, on which kernels are
    loaded, and float32 is exact whatever the caller has set.
    """
    with exact_float32(), torch.cuda.device(device) if device.type == "cuda" else nullcontext():
        yield


@contextmanager
def building(device: torch.device) -> Iterator[None]:
    """`preparing` around whatever captures, too: one thread at a time."""
    with CAPTURING, preparing(device):
        yield


@contextmanager
def uncollected() -> Iterator[None]:
    """Without Python's garbage collector. It may run at any line, and destroying a graph or an event that was freed
    earlier breaks the capture of the thread in which it happens.
    """
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


def empty_cache() -> None:
    """Give the allocator's free memory back to the device, when nobody captures."""
    if torch.cuda.is_available():
        with CAPTURING:
            torch.cuda.empty_cache()


def collect_and_empty_cache() -> None:
    """The same, of what only circles of references still hold, too."""
    gc.collect()
    empty_cache()


class Graph:
    """A sequence of kernels captured once, with timing events at its start and at the end of each stage.

    On some machines the host takes more than a microsecond for each kernel of a graph, and the device begins when all
    are launched. So a sequence may mark where its `HEAD` ends: that is a graph of its own, on which the device works
    while the host launches the rest. There may be several heads, one behind the other: then the host can copy what the
    next one reads while the device works on the one before.

    after   the graph that is launched before each time this one is: its stages are this one's first, and the next one
            begins where they end, so that it has in it whatever time the device waits in between for this launch.
            Without one the first stage begins with what `launch` is given
    like    a graph in whose place this one may be launched: others that are `after` that one are after both

    Replays go to the current stream that the calling thread has on the graph's device, whichever its current device is.
    """

    def __init__(
        self,
        run: Callable[[Mark], None],
        pool: Any,
        stream: torch.cuda.Stream,
        after: "Graph | None" = None,
        like: "Graph | None" = None,
    ) -> None:
        self._device = stream.device
        self._events: dict[str, torch.cuda.Event] = {} if after is None else dict(after._events)
        self._start: torch.cuda.Event | None = None
        if like is not None:
            self._start, self._events = like._start, like._events
        elif after is None:
            self._start = self._events["start"] = torch.cuda.Event(enable_timing=True)  # type: ignore[no-untyped-call]
        self._parts: list[torch.cuda.CUDAGraph] = []  # in order
        with building(stream.device):
            stream.wait_stream(torch.cuda.current_stream(stream.device))
            with torch.cuda.stream(stream):
                with compiling_ahead():
                    run(lambda stage: None)
                run(lambda stage: None)  # allocates whatever the kernels need, outside the capture
            stream.synchronize()
            self._capture(run, pool, stream)

    def launch(self, *before: Callable[[], None]) -> None:
        """Run the captured kernels again on what their input buffers hold now.

        before  the first is done before the first graph is launched, the second before the one behind the first `HEAD`,
                and so on. Each may launch kernels. If one raises, no graph from its own on is launched

        On the current stream, without waiting for it.
        """
        assert len(before) <= len(self._parts), f"{len(before)} things to do before {len(self._parts)} graphs"
        if self._start is not None:
            self._start.record(torch.cuda.current_stream(self._device))
        for part, first in itertools.zip_longest(self._parts, before):
            if first is not None:
                first()
            part.replay()

    def replay(self) -> None:
        """`launch`, and wait for whatever the current stream has to do."""
        self.launch()
        torch.cuda.current_stream(self._device).synchronize()

    def stage_ms(self) -> dict[str, float]:
        """Milliseconds of each stage of the last replay, from the end of the one before. Their sum leaves none out."""
        pairs = itertools.pairwise(self._events.items())
        return {name: start.elapsed_time(end) for (_, start), (name, end) in pairs}

    def _capture(self, run: Callable[[Mark], None], pool: Any, stream: torch.cuda.Stream) -> None:
        with capturing() as self._kernels, uncollected(), ExitStack() as graph:  # kernels live as long as their graph

            def begin() -> None:
                self._parts.append(torch.cuda.CUDAGraph())
                options: dict[str, Any] = {"pool": pool, "stream": stream, "capture_error_mode": "thread_local"}
                graph.enter_context(torch.cuda.graph(self._parts[-1], **options))

            def mark(stage: str) -> None:
                if stage == HEAD:
                    graph.close()
                    begin()
                else:
                    self._mark(stage)

            begin()
            run(mark)

    def _mark(self, stage: str) -> None:
        if stage not in self._events:
            self._events[stage] = torch.cuda.Event(enable_timing=True, external=True)  # type: ignore[no-untyped-call]
        self._events[stage].record(torch.cuda.current_stream(self._device))
