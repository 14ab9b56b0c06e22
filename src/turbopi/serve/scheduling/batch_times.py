"""T(B): how long the policy takes for B observations together. From measured times alone; no clock of its own."""

import math
from bisect import bisect_left, insort
from collections import deque

HISTORY = 50  # times of one size, the last ones
MIN_RUNS = 3  # recent runs that a size needs: with fewer, its times of the warm-up count
FRESH_SECONDS = 60.0  # a size that didn't run for so long has its times of the warm-up again
GAIN = 0.95  # a batch must take less than 0.95 * B * T(1): measurement noise of a few percent must form none
# Seconds without batches of a size that failed: the first time, and at most, as each failure doubles them. Memory that
# another program took for a moment is back soon; batches that never fit cost a failed run every ten minutes.
PAUSE, LONGEST_PAUSE = 1.0, 600.0
TYPICAL, SAFE = 0.5, 0.95  # quantiles: of a usual run; of nearly every run


class _Times:
    """The times of one size, in order of time and in order of size."""

    def __init__(self) -> None:
        self.last = -math.inf
        self._in_time: deque[float] = deque()
        self._sorted: list[float] = []

    def add(self, seconds: float, now: float) -> None:
        if len(self._in_time) == HISTORY:
            del self._sorted[bisect_left(self._sorted, self._in_time.popleft())]
        self._in_time.append(seconds)
        insort(self._sorted, seconds)
        self.last = now

    def reliable(self, now: float) -> bool:
        """Whether there are enough of them, and the last one isn't too old."""
        return len(self._in_time) >= MIN_RUNS and now - self.last <= FRESH_SECONDS

    def quantile(self, part: float) -> float:
        """The smallest time that is at least as long as `part` of all."""
        return self._sorted[max(0, math.ceil(part * len(self._sorted)) - 1)]


class BatchTimes:
    """The table T(B), measured at warm-up (`measured`) and updated by what runs (`ran`).

    Each size has its last 50 times; a size without times of its own counts as the next larger one that has some, as
    engines round up, too. What was measured at warm-up holds again for a size that didn't run for a minute: so a
    size that was slow once, beside another program, isn't given up for ever.

    largest  observations of one batch, at most. Batches are formed of sizes up to the largest one that was measured at
             warm-up: without a measurement, there are none
    """

    def __init__(self, largest: int = 1) -> None:
        self.largest = largest
        self.measured_largest = 1  # the largest batch that may be formed at all
        self._warm: dict[int, _Times] = {}
        self._recent: dict[int, _Times] = {}
        # The size that failed, until when it isn't formed, and for how long after the next failure.
        self._failed, self._failed_until, self._pause = 0, -math.inf, PAUSE
        # A cache: the schedule needs the same values many times while clients wait. It holds from one moment to
        # another, and until a time is added.
        self._seconds: dict[tuple[int, float], float | None] = {}
        self._totals: dict[int, float] = {}
        self._cached_from, self._cached_until = math.inf, -math.inf

    def measured(self, rows: int, seconds: float) -> None:
        """A run at warm-up."""
        self._warm.setdefault(rows, _Times()).add(seconds, 0.0)
        self.measured_largest = self._measured_up_to(self.largest)
        self._clear()

    def ran(self, rows: int, seconds: float, now: float) -> None:
        """A run for requests, which ended at `now`."""
        self._recent.setdefault(rows, _Times()).add(seconds, now)
        if self._failed and rows >= self._failed:
            self._failed, self._failed_until, self._pause = 0, -math.inf, PAUSE
        self._clear()

    def limit(self, rows: int) -> None:
        """No batches of more, ever: warm-up couldn't measure them."""
        self.largest = min(self.largest, max(1, rows))
        self.measured_largest = self._measured_up_to(self.largest)
        self._clear()

    def failed(self, rows: int, now: float) -> float:
        """A batch failed, and not by an observation's fault: for a while neither its size nor a larger one is formed.

        Returns for how many seconds: twice as long as before, until a batch of the size works again.
        """
        self._failed = min(self._failed or rows, rows)
        pause, self._pause = self._pause, min(2 * self._pause, LONGEST_PAUSE)
        self._failed_until = now + pause
        self._clear()
        return pause

    def formed_largest(self, now: float) -> int:
        """The largest batch that may be formed now: none as large as one that failed a moment ago."""
        if now < self._failed_until:
            return self._measured_up_to(min(self.largest, self._failed - 1))
        return self.measured_largest

    def _measured_up_to(self, most: int) -> int:
        return max((rows for rows in self._warm if rows <= most), default=1)

    @property
    def sizes(self) -> list[int]:
        """Those that were measured at warm-up."""
        return sorted(self._warm)

    def seconds(self, rows: int, now: float, part: float = TYPICAL) -> float | None:
        """T(rows), the `part`-quantile of its last times; None if neither that size nor a larger one was measured."""
        self._expire(now)
        if (rows, part) not in self._seconds:
            times = self._times(rows, now)
            self._seconds[rows, part] = None if times is None else times.quantile(part)
        return self._seconds[rows, part]

    def _clear(self) -> None:
        self._cached_from, self._cached_until = math.inf, -math.inf

    def _expire(self, now: float) -> None:
        """Forget what was found if it doesn't hold now."""
        if not self._cached_from <= now <= self._cached_until:
            self._seconds, self._totals = {}, {}
            self._cached_from = now
            self._cached_until = min(
                (times.last + FRESH_SECONDS for times in self._recent.values() if times.reliable(now)), default=math.inf
            )
            if now < self._failed_until:
                self._cached_until = min(self._cached_until, math.nextafter(self._failed_until, now))

    def _times(self, rows: int, now: float) -> _Times | None:
        good = {size: times for size, times in self._recent.items() if times.reliable(now)}
        of_size = self._warm | good or self._recent  # before anything is known well, what there is
        size = min((size for size in of_size if size >= rows), default=None)
        return None if size is None else of_size[size]

    def best(self, rows: int, now: float, longest: float = math.inf) -> int:
        """Of `rows` observations that wait, how many to run together: as many as make the most a second.

        That is 1 unless a batch is sooner than its observations one by one: T(B) < 0.95 * B * T(1).

        longest  seconds that the run may take; one observation may take longer
        """
        most = min(rows, self.formed_largest(now))
        single = self.seconds(1, now) if most > 1 else None
        if single is None:
            return 1
        best, best_each = 1, single * GAIN
        for size in range(2, most + 1):
            seconds = self.seconds(size, now)
            assert seconds is not None  # as a size that is no smaller was measured
            if seconds <= longest and seconds / size < best_each:
                best, best_each = size, seconds / size
        return best

    def total(self, rows: int, now: float) -> float:
        """Seconds for `rows` observations in as many runs as they need; 0 as long as nothing was measured."""
        if rows == 1:  # nearly always
            return self.seconds(1, now) or 0.0
        self._expire(now)
        if rows not in self._totals:
            seconds, remaining = 0.0, rows
            while remaining > 0:
                best = self.best(remaining, now)
                runs = remaining // best
                seconds += runs * (self.seconds(best, now) or 0.0)
                remaining -= runs * best
            self._totals[rows] = seconds
        return self._totals[rows]
