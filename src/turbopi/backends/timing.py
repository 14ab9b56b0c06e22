"""Stage times that are true on a GPU too: events on its stream, read after the work is done."""

import time

import torch


class StageTimer:
    """Marks the end of each stage; the first one starts at construction.

    On a GPU the marks are CUDA events and cost no synchronisation; `milliseconds` waits for the last of them.
    """

    def __init__(self, device: torch.device) -> None:
        self._device = device
        self._names: list[str] = []
        self._marks: list[torch.cuda.Event | float] = [self._now()]

    def mark(self, stage: str) -> None:
        self._names.append(stage)
        self._marks.append(self._now())

    def milliseconds(self) -> dict[str, float]:
        """Stage -> milliseconds since the mark before it."""
        if not isinstance(last := self._marks[-1], float):
            last.synchronize()  # not the device: another thread may be capturing a graph
        return {
            name: _elapsed_ms(start, end)
            for name, start, end in zip(self._names, self._marks, self._marks[1:], strict=False)
        }

    def _now(self) -> "torch.cuda.Event | float":
        if self._device.type != "cuda":
            return time.perf_counter()
        event = torch.cuda.Event(enable_timing=True)  # type: ignore[no-untyped-call]
        event.record(torch.cuda.current_stream(self._device))
        return event


def _elapsed_ms(start: "torch.cuda.Event | float", end: "torch.cuda.Event | float") -> float:
    if isinstance(start, float):
        assert isinstance(end, float)
        return (end - start) * 1e3
    assert not isinstance(end, float)
    return float(start.elapsed_time(end))
