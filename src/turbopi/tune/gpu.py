"""What measuring on a GPU takes, whatever the operation: a clock, cold weights, poisoned memory, compilers at work."""

import math
import os
import statistics
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import torch
from torch import Tensor

from turbopi.backends.device_lost import Guard
from turbopi.kernels.tile_table import Knobs
from turbopi.tune.race import MARGIN, Round, first_line
from turbopi.tune.shapes import Operation

INVERSE = 30.0  # 1 / scale of results that leave in E4M3
ROUND_MICROSECONDS = 300.0  # a round is at least as long, so that the clock's own error doesn't count
CALLS = 8  # of a graph at least
MOST_REPLAYS = 50
SLACK, REFERENCES = 0.006, 1.25  # an error may be the first and so many times the reference's
L2_BYTES = 50 << 20  # where PyTorch doesn't tell
STREAMED = 3  # times the L2 cache: copies of a weight that take turns, so that none is found there, as in a call
MOST_MEMORY = 0.25  # of what is free, for such copies


class GpuBench(ABC):
    """A `race.Bench` of an operation on a GPU. A subclass makes inputs and runs the operation."""

    exact: Tensor  # float32, what the result is to be
    reference_error: float  # of the plain operation in the same numbers
    copies: int  # of the inputs, which take turns
    margin = MARGIN  # of the usual time that a tile must gain

    def __init__(self, operation: Operation, device: torch.device, seed: int = 1) -> None:
        self.operation, self.device = operation, device
        self._generator = torch.Generator(device).manual_seed(seed)
        self._guard = Guard(device)
        self._pool: Any = None

    @abstractmethod
    def run(self, knobs: Knobs, copy: int, out: Tensor | None = None) -> Tensor:
        """The operation in these tiles, on one of the copies; into `out` where the operation takes one."""

    def in_call(self, knobs: Knobs, copy: int) -> object:
        """What is timed: the operation with the kernels that a call runs around it, where they matter to its tiles."""
        return self.run(knobs, copy)

    def out_for(self, knobs: Knobs) -> Tensor | None:
        """Memory for a result, all NaN; None: the operation allocates its own."""
        return None

    def random(self, *shape: int) -> Tensor:
        return random(shape, self._generator)

    @property
    def bound(self) -> float:
        return SLACK + REFERENCES * self.reference_error

    def prepare(self, candidates: Sequence[Knobs]) -> Mapping[int, str]:
        def compiled(knobs: Knobs) -> str | None:
            try:
                self.run(knobs, 0)
            except Exception as failure:  # what doesn't compile is a result
                self._guard.examine(failure)
                return first_line(failure)
            return None

        with self._guard, ThreadPoolExecutor(workers(), initializer=self._enter) as pool:
            found = list(pool.map(compiled, candidates))
            torch.cuda.synchronize(self.device)
        # once more one by one, should a compiler not have liked the company
        found = [why and compiled(knobs) for why, knobs in zip(found, candidates, strict=True)]
        return {place: why for place, why in enumerate(found) if why is not None}

    def error(self, knobs: Knobs) -> float:
        out = self.out_for(knobs)
        with self._guard:
            if out is None:
                poison(self.exact.numel() * 4, self.device)
            result = self.whole(self.run(knobs, 0, out))
            return relative(result, self.exact)

    def whole(self, result: Tensor) -> Tensor:
        """In float32: parts are added up, E4M3 is what it stands for."""
        wide = result.float()
        wide = wide.sum(0) if wide.dim() == 3 else wide
        return wide / INVERSE if self.operation.out_fp8 else wide

    def timer(self, knobs: Knobs) -> Round:
        """The operation as `in_call` runs it, over all copies."""
        calls = math.ceil(CALLS / self.copies) * self.copies

        def run() -> None:
            for call in range(calls):
                self.in_call(knobs, call % self.copies)

        return self.captured(run, calls, ROUND_MICROSECONDS)

    def captured(self, run: Callable[[], object], calls: int, least: float) -> Round:
        """What times `run` as a CUDA graph: microseconds of one of its `calls`. It must have been run once before.

        least  microseconds that a round takes at least
        """
        with self._guard:
            if self._pool is None:
                self._pool = torch.cuda.graph_pool_handle()
            torch.cuda.synchronize(self.device)
            graph = torch.cuda.CUDAGraph()
            with torch.cuda.graph(graph, pool=self._pool):
                run()
            once = replayed(graph, 1, self.device)
            replays = max(1, min(MOST_REPLAYS, math.ceil(least / max(once, 1.0))))

        def measure() -> float:
            with self._guard:
                return replayed(graph, replays, self.device) / (replays * calls)

        return measure

    def _enter(self) -> None:
        """A thread that compiles needs the GPU's context, for what it loads."""
        torch.cuda.set_device(self.device)
        torch.zeros(1, device=self.device)


def random(shape: Sequence[int], generator: torch.Generator) -> Tensor:
    """Normal numbers in bfloat16, on the generator's device."""
    return torch.randn(shape, generator=generator, device=generator.device).to(torch.bfloat16)


def prefixes_in_a_row(batch: int, rows: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """First row and number of rows of each observation's prefix, int32[batch + 1], all as long; the last is empty."""
    starts = torch.arange(batch + 1, dtype=torch.int32, device=device) * rows
    lengths = torch.full_like(starts, rows)
    lengths[-1] = 0  # of the padding
    return starts, lengths


def workers() -> int:
    return max(1, min(16, os.cpu_count() or 1))


def replayed(graph: torch.cuda.CUDAGraph, times: int, device: torch.device) -> float:
    """Microseconds of so many replays in a row."""
    begin, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))  # type: ignore[no-untyped-call]
    begin.record()
    for _ in range(times):
        graph.replay()
    end.record()
    torch.cuda.synchronize(device)
    return float(begin.elapsed_time(end)) * 1000


def cold_copies(weight_bytes: int, device: torch.device) -> int:
    """How many copies of a weight take turns so that the L2 cache has none of them when it is read."""
    cache = getattr(torch.cuda.get_device_properties(device), "L2_cache_size", 0) or L2_BYTES
    free = torch.cuda.mem_get_info(device)[0]
    wanted = math.ceil(STREAMED * cache / weight_bytes)
    return max(2, min(wanted, int(MOST_MEMORY * free / weight_bytes)))


def poison(size: int, device: torch.device) -> None:
    """Fill free memory with NaN, so that what an operation leaves out of its result shows.

    What was freed goes back to the driver first; the next allocations, up to four times `size` bytes, take the poisoned
    blocks.
    0xFF is NaN in E4M3, and in any float whose bytes are all 0xFF.
    """
    torch.cuda.synchronize(device)
    torch.cuda.empty_cache()
    blocks = [torch.full((max(size, 2 << 20) * 4,), 0xFF, dtype=torch.uint8, device=device)]
    blocks += [torch.full((1 << 20,), 0xFF, dtype=torch.uint8, device=device) for _ in range(8)]  # of small ones' pool
    torch.cuda.synchronize(device)
    del blocks


def poisoned(shape: tuple[int, ...], dtype: torch.dtype, device: torch.device) -> Tensor:
    """A tensor of bytes 0xFF: all NaN."""
    size = math.prod(shape) * dtype.itemsize
    return torch.full((size,), 0xFF, dtype=torch.uint8, device=device).view(dtype).view(shape)


def relative(result: Tensor, exact: Tensor) -> float:
    return float((result.float() - exact).norm() / exact.norm())


def steadiness(device: torch.device, rounds: int = 40) -> list[float]:
    """Times in microseconds of one and the same copy in memory, again and again: how steady the GPU is."""
    source = torch.zeros(64 << 20, dtype=torch.uint8, device=device)
    target = torch.empty_like(source)
    run: Callable[[], object] = lambda: target.copy_(source)  # noqa: E731
    run()
    torch.cuda.synchronize(device)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        run()
    for _ in range(20):  # until the clock has risen
        replayed(graph, 10, device)
    times = [replayed(graph, 5, device) / 5 for _ in range(rounds)]
    assert statistics.median(times) > 0
    return times
