"""Think time: from an answer to the same client's next request. Computed from given times; no clock of its own.

Clients of a short think time, such as simulators and robots that stand still meanwhile, send their next requests
together a few milliseconds after a batch. schedule.py waits for them where that saves time.
"""

from collections import OrderedDict, deque
from collections.abc import Container, Hashable
from dataclasses import dataclass

HISTORY = 5  # think times of a source, the last ones
MIN_SAMPLES = 2  # fewer say nothing
TYPICAL = 3 / 4  # the quantile of these that counts as a source's usual think time
# GIVE_UP_FACTOR * its usual think time + GIVE_UP_SECONDS after its answer, a source isn't expected any more.
GIVE_UP_FACTOR = 2.0
GIVE_UP_SECONDS = 0.0005
MAX_SOURCES = 1024  # sources that are remembered
MEAN_OF = 4  # a new pause counts as one of so many


class ThinkTimes:
    """When sources that were answered are expected to send their next requests."""

    def __init__(self) -> None:
        self._answered: OrderedDict[Hashable, float] = OrderedDict()  # those without a new request
        self._seconds: OrderedDict[Hashable, deque[float]] = OrderedDict()  # the one with the last request at the end

    def answered(self, source: Hashable, now: float) -> None:
        """A turn with a source's request has ended."""
        self._answered[source] = now
        self._answered.move_to_end(source)
        if len(self._answered) > MAX_SOURCES:
            self._answered.popitem(last=False)

    def requested(self, source: Hashable, now: float) -> None:
        """A source's request has come."""
        answered = self._answered.pop(source, None)
        if answered is None:
            return
        self._seconds.setdefault(source, deque(maxlen=HISTORY)).append(now - answered)
        self._seconds.move_to_end(source)
        if len(self._seconds) > MAX_SOURCES:
            self._seconds.popitem(last=False)

    def expected(self, now: float, within: float, but: Container[Hashable]) -> list[tuple[float, float]]:
        """(when it is expected, when it isn't any more) of each source that may send a request soon, in order of time.

        within  seconds: a source that was answered longer ago isn't expected
        but     sources that are left out
        """
        while self._answered and next(iter(self._answered.values())) < now - within:
            self._answered.popitem(last=False)  # its requests are too rare to wait for
        found = []
        for source, answered in self._answered.items():
            if source not in but and (usual := self._usual(source)) is not None:
                last = answered + usual * GIVE_UP_FACTOR + GIVE_UP_SECONDS
                if last > now:
                    found.append((answered + usual, last))
        return sorted(found)

    def _usual(self, source: Hashable) -> float | None:
        """Seconds from an answer to the next request; None if that isn't known."""
        seconds = self._seconds.get(source)
        if seconds is None or len(seconds) < MIN_SAMPLES:
            return None
        return sorted(seconds)[min(len(seconds) - 1, int(TYPICAL * len(seconds)))]


@dataclass
class _Source:
    event: float  # its last request, answer or refusal
    served: float  # its last answer; before that, when it came first
    usual: float  # its pauses, as parts of a long one: a mean of the last few
    pauses: int = 0  # in that mean


class Pauses:
    """How long sources usually pause before a request, and when they were served last."""

    def __init__(self) -> None:
        self._sources: OrderedDict[Hashable, _Source] = OrderedDict()  # the one with the last event at the end

    def requested(self, source: Hashable, long: float, new: float, now: float) -> tuple[float, float]:
        """A request has come. Its source's usual pause, from 0 to 1, and when that was served last or came first.

        long  seconds of a pause that counts as 1
        new   the pause of a source that wasn't seen lately
        """
        known = self._sources.get(source)
        if known is None:
            known = self._sources[source] = _Source(now, now, new)
            if len(self._sources) > MAX_SOURCES:
                self._sources.popitem(last=False)
        else:
            pause = now - known.event
            known.pauses = min(known.pauses + 1, MEAN_OF)
            known.usual += ((1.0 if pause >= long else pause / long) - known.usual) / known.pauses
            self._note(source, known, now)
        return known.usual, known.served

    def refused(self, source: Hashable, now: float) -> None:
        """A request of the source was refused."""
        if (known := self._sources.get(source)) is not None:
            self._note(source, known, now)

    def served(self, source: Hashable, now: float) -> None:
        """A turn with a request of the source has ended."""
        if (known := self._sources.get(source)) is not None:
            known.served = now
            self._note(source, known, now)

    def _note(self, source: Hashable, known: _Source, now: float) -> None:
        known.event = now
        self._sources.move_to_end(source)
