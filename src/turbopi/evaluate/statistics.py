"""Success rates with their uncertainty, and the paired comparison of two runs.

- One rate: Wilson's score interval (Wilson 1927; Newcombe 1998), which holds near 0 and 1 and for few episodes.
- Two runs on the same episodes: McNemar's exact test on the episodes that only one of them solved, and the interval of
  Bonett and Price (2012) for the difference of the rates.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from msgspec import Struct

Z95 = 1.959963984540054
PERCENTILES = (50, 90, 95, 99)


def wilson(successes: int, trials: int, z: float = Z95) -> tuple[float, float]:
    """The score interval of a rate, each end in [0, 1]; (0, 1) when nothing was tried."""
    assert 0 <= successes <= trials
    if trials == 0:
        return 0.0, 1.0
    rate, z2 = successes / trials, z * z
    centre = (rate + z2 / (2 * trials)) / (1 + z2 / trials)
    half = z / (1 + z2 / trials) * math.sqrt(rate * (1 - rate) / trials + z2 / (4 * trials * trials))
    low = 0.0 if successes == 0 else max(0.0, centre - half)  # exact ends, not 1e-17
    high = 1.0 if successes == trials else min(1.0, centre + half)
    return low, high


class RateDocument(Struct, frozen=True):
    """A rate as result files have it."""

    successes: int
    trials: int
    rate: float | None  # None: of nothing
    wilson95: tuple[float, float]


class PairedDocument(Struct, frozen=True):
    """A paired comparison as result files have it: counts of episodes, and what follows from them."""

    pairs: int
    both: int
    only_first: int
    only_second: int
    neither: int
    difference: float | None  # the second rate less the first
    difference95: tuple[float, float]
    mcnemar_p: float


class Percentiles(Struct, frozen=True):
    """How values are spread, in their own unit."""

    p50: float
    p90: float
    p95: float
    p99: float
    mean: float
    max: float
    count: int


@dataclass(frozen=True)
class Rate:
    """Successes among the episodes that came to a verdict."""

    successes: int
    trials: int

    @property
    def value(self) -> float | None:
        return self.successes / self.trials if self.trials else None

    @property
    def interval(self) -> tuple[float, float]:
        return wilson(self.successes, self.trials)

    @property
    def document(self) -> RateDocument:
        return RateDocument(self.successes, self.trials, self.value, self.interval)

    def __str__(self) -> str:
        if self.value is None:
            return "-"
        low, high = self.interval
        return f"{100 * self.value:.1f} % [{100 * low:.1f}, {100 * high:.1f}]"


@dataclass(frozen=True)
class Paired:
    """Two runs on the same episodes: how many both, only the first, only the second, and neither solved."""

    both: int
    only_first: int
    only_second: int
    neither: int

    @classmethod
    def of(cls, outcomes: Sequence[tuple[bool, bool]]) -> "Paired":
        counts = [sum(1 for pair in outcomes if pair == wanted) for wanted in _CELLS]
        return cls(*counts)

    @property
    def pairs(self) -> int:
        return self.both + self.only_first + self.only_second + self.neither

    @property
    def difference(self) -> float | None:
        """The second rate less the first."""
        return (self.only_second - self.only_first) / self.pairs if self.pairs else None

    @property
    def interval(self) -> tuple[float, float]:
        """Of the difference, 95 %, Bonett and Price; (-1, 1) when there are no pairs."""
        if not self.pairs:
            return -1.0, 1.0
        n = self.pairs + 2
        first, second = (self.only_first + 1) / n, (self.only_second + 1) / n
        half = Z95 * math.sqrt((first + second - (second - first) ** 2) / n)
        return max(-1.0, second - first - half), min(1.0, second - first + half)

    @property
    def p_value(self) -> float:
        """McNemar's exact two-sided test: a fair coin for each episode that only one run solved."""
        n, fewer = self.only_first + self.only_second, min(self.only_first, self.only_second)
        return min(1.0, 2 * sum(math.comb(n, k) for k in range(fewer + 1)) / 2**n)

    @property
    def document(self) -> PairedDocument:
        cells = (self.both, self.only_first, self.only_second, self.neither)
        return PairedDocument(self.pairs, *cells, self.difference, self.interval, self.p_value)


_CELLS = ((True, True), (True, False), (False, True), (False, False))


def percentiles(values: Sequence[float]) -> Percentiles | None:
    """None of nothing."""
    if not len(values):
        return None
    p50, p90, p95, p99 = map(float, np.percentile(values, PERCENTILES))
    return Percentiles(p50, p90, p95, p99, float(np.mean(values)), float(np.max(values)), len(values))
