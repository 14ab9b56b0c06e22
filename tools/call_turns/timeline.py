"""One call's kernels in order, with the gaps between them, by PyTorch's profiler."""

import json
import re
import statistics
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch.profiler import ProfilerActivity, profile

NAMES = 46  # characters of a kernel's name
ON_DEVICE = ("kernel", "gpu_memcpy", "gpu_memset")
ON_HOST = ("cuda_runtime", "cuda_driver")


@dataclass(frozen=True)
class Ran:
    """What ran on the device: microseconds since the first one's start.

    A kernel with dependent launch starts while the one before it ends, so `end` tells more than `start`.
    """

    name: str
    start: float
    end: float
    grid: tuple[int, ...] = ()
    stream: int = 0


def profiled(call: Callable[[], Any]) -> tuple[list[Ran], list[tuple[str, float, float]]]:
    """What ran on the device in one call, by its end, and the host's CUDA calls (name, start, microseconds)."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "trace.json"
        with profile(activities=[ProfilerActivity.CPU, ProfilerActivity.CUDA]) as profiler:
            call()
            torch.cuda.synchronize()
        profiler.export_chrome_trace(str(file))
        events = json.loads(file.read_text())["traceEvents"]
    return in_order(events)


def in_order(events: Sequence[Mapping[str, Any]]) -> tuple[list[Ran], list[tuple[str, float, float]]]:
    device = [e for e in events if e.get("cat") in ON_DEVICE]
    first = min((e["ts"] for e in device), default=0.0)
    ran = [
        Ran(
            shortened(e["name"]),
            e["ts"] - first,
            e["ts"] - first + e["dur"],
            tuple(e.get("args", {}).get("grid", ())),
            int(e.get("args", {}).get("stream", 0)),
        )
        for e in device
    ]
    host = [(str(e["name"]), e["ts"] - first, float(e["dur"])) for e in events if e.get("cat") in ON_HOST]
    return sorted(ran, key=lambda one: one.end), sorted(host, key=lambda one: one[1])


def shortened(name: str) -> str:
    """Without template arguments and parameters of the library's kernels."""
    name = re.sub(r"^void |\(.*\)$", "", name)
    while (shorter := re.sub(r"<[^<>]*>", "", name)) != name:
        name = shorter
    return name.rsplit("::", 1)[-1][:NAMES]


@dataclass(frozen=True)
class Step:
    """One of several calls' kernels at one place in the order: medians over the calls, microseconds.

    step      from the end of whatever ended before it to its own end: these add up to the whole
    gap       from that end to its start; negative: it started before
    duration  as the profiler has it, with the time in which it waited for others
    """

    name: str
    grid: tuple[int, ...]
    stream: int
    step: float
    gap: float
    duration: float


def steps(calls: Sequence[Sequence[Ran]]) -> list[Step]:
    """Medians over calls that ran the same kernels. Raises ValueError for calls that didn't."""
    if len({len(call) for call in calls}) != 1:
        raise ValueError(f"calls ran {sorted({len(call) for call in calls})} kernels; profile them again")
    found = []
    for i, one in enumerate(calls[0]):
        before = [max((ran.end for ran in call[:i]), default=call[i].start) for call in calls]
        found.append(
            Step(
                one.name,
                one.grid,
                one.stream,
                statistics.median(max(0.0, call[i].end - end) for call, end in zip(calls, before, strict=True)),
                statistics.median(call[i].start - end for call, end in zip(calls, before, strict=True)),
                statistics.median(call[i].end - call[i].start for call in calls),
            )
        )
    return found


def summary(found: Sequence[Step]) -> Iterator[str]:
    """Lines by kernel, grid and what ran before: the neighbours decide the gap."""
    groups: dict[tuple[Any, ...], list[Step]] = {}
    before = "-"
    for one in found:
        groups.setdefault((one.name, one.grid, before), []).append(one)
        before = one.name
    yield f"{'kernel':{NAMES}} {'grid':>14} {'behind':30} {'times':>5} {'step':>7} {'gap':>7} {'dur.':>7} {'sum':>8}"
    for (name, grid, behind), these in sorted(groups.items(), key=lambda item: -sum(one.step for one in item[1])):
        step, gap, duration = (
            statistics.median(getattr(one, field) for one in these) for field in ("step", "gap", "duration")
        )
        total = sum(one.step for one in these)
        yield (
            f"{name:{NAMES}} {_grid(grid):>14} {behind[:30]:30} {len(these):5} {step:7.2f} {gap:7.2f} {duration:7.2f} "
            f"{total:8.1f}"
        )
    yield f"all: {sum(one.step for one in found):.1f} us, {len(found)} kernels and copies"


def in_full(found: Sequence[Step]) -> Iterator[str]:
    """A line for each, in order."""
    yield f"{'#':>4} {'kernel':{NAMES}} {'grid':>14} {'stream':>6} {'step':>7} {'gap':>7} {'dur.':>7} {'end':>8}"
    end = 0.0
    for i, one in enumerate(found):
        end += one.step
        yield (
            f"{i:4} {one.name:{NAMES}} {_grid(one.grid):>14} {one.stream:6} {one.step:7.2f} {one.gap:7.2f} "
            f"{one.duration:7.2f} {end:8.1f}"
        )


def _grid(grid: tuple[int, ...]) -> str:
    return "x".join(map(str, grid))
