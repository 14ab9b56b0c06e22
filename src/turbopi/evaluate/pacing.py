"""The wall clock as the world's: when control steps are due, and what it showed."""

import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import Annotated

from msgspec import Meta, Struct

from turbopi.evaluate.statistics import Percentiles, percentiles

_Count = Annotated[int, Meta(ge=0, le=10**9)]
_Time = Annotated[float, Meta(ge=0, le=1e12)]
LATE = 0.1  # of a control step: operating systems wake a process a little late
TOLERATED = 0.01  # of the control steps may begin late in what is called real time


class Pacer:
    """Control steps at their rate by the wall clock: step n is due n / hz seconds after the first.

    The clock is never slowed. A step that can't begin when it is due, as the simulator is still at the one before or
    the machine is busy elsewhere, begins as soon as it can, and those after it are due when they ever were. It counts
    as late beyond LATE of a control step.
    """

    def __init__(
        self,
        hz: float,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], object] = time.sleep,
    ) -> None:
        self._hz, self._clock, self._sleep = hz, clock, sleep
        self.begin()

    def begin(self) -> None:
        """The first step is due now."""
        self._begun = self._began = self._clock()
        self._steps = 0
        self.late_ms: list[float] = []  # of the steps that were late
        self.step_ms: list[float] = []  # from the beginning of each step to the simulator being done with it

    def wait(self) -> None:
        """Return when the next control step is due."""
        due = self._begun + self._steps / self._hz
        now = self._clock()
        if self._steps:
            self.step_ms.append((now - self._began) * 1e3)
        while now < due:
            self._sleep(due - now)
            now = self._clock()
        if now - due > LATE / self._hz:
            self.late_ms.append((now - due) * 1e3)
        self._began = now
        self._steps += 1

    @property
    def seconds(self) -> float:
        """Of the wall clock, from the first step to the beginning of the last one."""
        return self._began - self._begun


class Paced(Struct, frozen=True):
    """What the wall clock showed in an episode.

    delays       control steps from an observation to its chunk, for every chunk that came
    latency_ms   from an observation to the policy's answer, for each of them: with the pipes on the way
    dropped      chunks that were never carried out, by reason (docs/real_time.md)
    late_ms      of each control step that began late: how late
    step_ms      the simulator's own time for a step, with its images: median and longest
    seconds      from the first control step to the beginning of the last one
    """

    delays: list[_Count]
    latency_ms: list[_Time]
    dropped: dict[str, _Count]
    late_ms: list[_Time]
    step_ms: tuple[_Time, _Time]
    seconds: _Time


class PacedSummary(Struct, frozen=True):
    """What the wall clock showed in all episodes of a run.

    delay_steps, latency_ms   measured, of all chunks that came; None: none did
    dropped                   chunks that were never carried out, by reason
    steps, late_steps         control steps, and those that began late
    late_ms                   how late these were; None: none was
    longest_step_ms           the simulator's slowest step
    speed                     of the world, by the rate it was to have: below 1 if the simulator couldn't keep up
    """

    delay_steps: Percentiles | None
    latency_ms: Percentiles | None
    dropped: Mapping[str, int]
    steps: int
    late_steps: int
    late_ms: Percentiles | None
    longest_step_ms: float
    speed: float | None

    @property
    def is_real_time(self) -> bool:
        return self.late_steps <= TOLERATED * self.steps


def summarise_paced(episodes: Sequence[tuple[int, Paced]], control_hz: float) -> PacedSummary | None:
    """Of episodes, each with its control steps. None without one."""
    if not episodes:
        return None
    dropped: Counter[str] = Counter()
    for _, paced in episodes:
        dropped.update(paced.dropped)
    late = [ms for _, paced in episodes for ms in paced.late_ms]
    seconds = sum(paced.seconds for _, paced in episodes)
    planned = sum(max(0, steps - 1) for steps, _ in episodes) / control_hz
    return PacedSummary(
        delay_steps=percentiles([delay for _, paced in episodes for delay in paced.delays]),
        latency_ms=percentiles([ms for _, paced in episodes for ms in paced.latency_ms]),
        dropped=dict(sorted(dropped.items())),
        steps=sum(steps for steps, _ in episodes),
        late_steps=len(late),
        late_ms=percentiles(late),
        longest_step_ms=max(paced.step_ms[1] for _, paced in episodes),
        speed=round(planned / seconds, 4) if seconds else None,
    )


def allows_for_lateness(summary: PacedSummary, control_hz: float) -> str | None:
    """What a reader must know of control steps that began late; None if none did."""
    if summary.late_ms is None:
        return None
    share = 100 * summary.late_steps / max(summary.steps, 1)
    speed = "" if summary.speed is None else f"; the world's time ran at {summary.speed:.3f} of the clock's"
    text = (
        f"{summary.late_steps} of {summary.steps} control steps ({share:.2g} %) began late, by "
        f"{summary.late_ms.p50:.1f} ms in the median and {summary.late_ms.max:.1f} ms at most: the simulator's slowest "
        f"step took {summary.longest_step_ms:.1f} ms, where {control_hz:g} Hz leaves {1e3 / control_hz:.1f} ms for one"
        f"{speed}."
    )
    if summary.is_real_time:
        return text
    return f"NOT REAL TIME. {text} These aren't the delays of a robot at this rate: give a lower --control-hz."


def rate_given(control_hz: float, own_hz: float | None) -> str:
    """How fast the world is: `own_hz` is the rate of the simulator's robot."""
    text = f"{control_hz:g} control steps a second"
    if own_hz is None or control_hz == own_hz:
        return text
    motion = "slow" if control_hz < own_hz else "fast"
    return f"{text}, where the simulator's robot makes {own_hz:g}: {motion} motion"


def knows_pace(summary: PacedSummary, control_hz: float) -> str:
    """The measured delays, in a line."""
    dropped = ", ".join(f"{count} {reason}" for reason, count in summary.dropped.items()) or "none"
    if summary.delay_steps is None or summary.latency_ms is None:
        return f"real time at {control_hz:g} Hz: no chunk came; dropped: {dropped}"
    delay, latency = summary.delay_steps, summary.latency_ms
    return (
        f"measured at {control_hz:g} Hz: delay {delay.p50:.0f} control steps in the median, p95 {delay.p95:.0f}, at "
        f"most {delay.max:.0f}; observation to answer p50 {latency.p50:.1f}, p95 {latency.p95:.1f}, "
        f"p99 {latency.p99:.1f} ms; chunks dropped: {dropped}"
    )
