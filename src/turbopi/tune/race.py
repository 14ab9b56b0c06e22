"""Candidates timed in turns, and which of them wins. Knows neither kernels nor GPUs: they come as a `Bench`.

Every candidate runs once in every round, so a clock that changes, or another program, hits all of them. The few best
of some rounds run more rounds against the usual tile. A candidate whose result is wrong isn't timed.
"""

import math
import statistics
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

from turbopi.kernels.tile_table import Knobs
from turbopi.support.errors import DeviceLost

ROUNDS, FINAL_ROUNDS = 7, 31
FINALISTS = 5  # beside the usual tile
MARGIN = 0.01  # of the time of one operation alone: see `Bench.margin`
MOST_SPREAD = 0.15  # the interquartile range over the median; beyond it the GPU counts as busy

Round = Callable[[], float]  # microseconds of one call, as one round measures it


class Bench(Protocol):
    """One operation with its inputs on the device."""

    def prepare(self, candidates: Sequence[Knobs]) -> Mapping[int, str]:
        """Compile them all. Returns why candidates, by their place, can't be: what doesn't compile is left out."""

    def error(self, knobs: Knobs) -> float:
        """The result's relative rms error, of memory that held NaN before; NaN for one that isn't finite."""

    @property
    def bound(self) -> float:
        """What the error may be."""

    @property
    def margin(self) -> float:
        """Of the usual time that a tile must gain, or the usual one stays: less is noise."""

    def timer(self, knobs: Knobs) -> Round:
        """What measures a round of it."""


class UsualFails(Exception):
    """The tile that runs without a table can't be measured here."""


@dataclass(frozen=True)
class Timed:
    """A candidate: the median of its rounds in microseconds, and its interquartile range over the median."""

    knobs: Knobs
    microseconds: float
    spread: float


@dataclass(frozen=True)
class Raced:
    """usual: what runs without a table; best: the fastest, or the usual one. refused: why, by a tile's place."""

    usual: Timed
    best: Timed
    timed: int
    refused: Mapping[int, str]


def race(bench: Bench, candidates: Sequence[Knobs], *, advance: Callable[[], None] = lambda: None) -> Raced:
    """Time the candidates, of which the first one is the usual; `advance` is told of each that is checked.

    Raises UsualFails where the usual tile itself fails: then there is nothing to compare with.
    """
    refused = dict(bench.prepare(candidates))
    timers: dict[int, Round] = {}
    for place, knobs in enumerate(candidates):
        if place not in refused:
            timer, why = checked(bench, knobs)
            if timer is not None:
                timers[place] = timer
            elif why is not None:
                refused[place] = why
        advance()
    if 0 not in timers:
        raise UsualFails(f"the usual tile {dict(candidates[0])} fails: {refused[0]}")
    first = in_turns(timers, ROUNDS)
    others = sorted((place for place in first if place), key=lambda place: statistics.median(first[place]))
    final = in_turns({place: timers[place] for place in (0, *others[:FINALISTS])}, FINAL_ROUNDS)
    rows = {place: timed(candidates[place], times) for place, times in final.items()}
    return Raced(rows[0], winner(rows, bench.margin), len(timers), refused)


def checked(bench: Bench, knobs: Knobs) -> tuple[Round | None, str | None]:
    """The timer of a candidate whose result is right, or why it can't be taken."""
    try:
        why = wrong(bench.error(knobs), bench.bound)
        return (bench.timer(knobs), None) if why is None else (None, why)
    except DeviceLost:
        raise
    except Exception as failure:  # a tile that doesn't run is a result
        return None, first_line(failure)


def wrong(error: float, bound: float) -> str | None:
    """What is wrong with a result, by its error; None if it is right."""
    if not math.isfinite(error):
        return "its result isn't finite, or it left out rows or columns"
    return f"its error is {error:.2g}; at most {bound:.2g} is right" if error > bound else None


def in_turns(timers: dict[int, Round], rounds: int) -> dict[int, list[float]]:
    """Every one in every round, in order and then in reverse, so that a clock that drifts favours none."""
    times: dict[int, list[float]] = {place: [] for place in timers}
    for number in range(rounds):
        for place in reversed(timers) if number % 2 else timers:
            times[place].append(timers[place]())
    return times


def timed(knobs: Knobs, times: Sequence[float]) -> Timed:
    return Timed(knobs, statistics.median(times), spread(times))


def spread(times: Sequence[float]) -> float:
    """The interquartile range over the median."""
    low, median, high = statistics.quantiles(times, n=4)
    return (high - low) / median


def winner(rows: Mapping[int, Timed], margin: float) -> Timed:
    """The fastest, if it gains more than the margin on the usual one, which is at place 0."""
    best = min(rows.values(), key=lambda row: row.microseconds)
    return best if best.microseconds < rows[0].microseconds * (1 - margin) else rows[0]


def first_line(failure: BaseException) -> str:
    """What an exception says, short."""
    lines = [line.strip() for line in str(failure).splitlines() if line.strip()]
    return (lines[-1] if lines else type(failure).__name__)[:200]


def busy(spreads: Iterable[float]) -> bool:
    """Whether these times vary so much that they say little."""
    return any(one > MOST_SPREAD for one in spreads)
