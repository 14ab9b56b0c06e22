"""Whose turn it is: earliest deadline first, robots before simulators, batches where they pay.

When more requests come than can be served (a place or a firm deadline was refused within CROWDED_SECONDS), claims come
before deadlines. A source's claim is its usual pause before a request, from its last request, answer or refusal on;
pauses longer than LONG turns count the same. So a robot with five requests a second has a strong claim, and a client
that sends its next request at once has a weak one, however often it was refused. Of about equal claims the earlier
deadline decides. The order goes by this, and so does who gives way in a full line: simulators to robots, then a source
that has more than its share of the places, then the weakest claim, then the latest deadline. A quarter of the places
are safe: those of the sources that were served longest ago, so that no source is refused for ever. Neither a short
deadline nor a new connection is a claim.

A pure decision: nothing here waits, and time is an argument (seconds of any steady clock). worker.py calls `decide`
whenever something has changed or at the moment `Decision.wake`, and runs the turn that it gets.

What holds:

- Requests with the same deadline, priority, size and, in a crowd, claim run in the order in which they came.
- A request may be overtaken (a turn goes to a newer one) OVERTAKEN times. Of requests that were, the oldest gets at
  least every other turn: nothing starves, not even simulators.
- A request with a firm deadline that it can't meet is refused: on arrival, if its wait and its run are already too
  long; else as soon as that is so. Without a firm deadline, nothing is refused for being late.
- A turn has no more observations than the table T(B) says is worth it, nor than fit the earliest deadline in it.
"""

import math
from collections import Counter, OrderedDict, deque
from collections.abc import Callable, Hashable, Iterable
from dataclasses import dataclass, field
from itertools import accumulate
from operator import attrgetter
from statistics import median
from typing import Any, Literal

from turbopi.serve.scheduling.batch_times import SAFE, BatchTimes
from turbopi.serve.scheduling.think_time import Pauses, ThinkTimes

Priority = Literal["robot", "simulator"]
PRIORITIES: tuple[Priority, ...] = ("robot", "simulator")

OVERTAKEN = 16
ACTIVE_SECONDS = 1.0  # a source with a request within it may send one soon: worth waiting for
TIGHT_SECONDS = 10.0  # for so long a robot's deadline limits how long a turn of others may be
GAPS = 32  # times between two arrivals, the last ones: their median is how soon the next one comes
LATE_TIMER = 0.0005  # seconds that a wait ends before the last moment: a late timer must not shrink the batch
PATIENCE = 4.0  # usual gaps without an arrival, after which the wait for more requests ends
CROWDED_SECONDS = 1.0
LONG = 8.0  # turns: a source that pauses so long takes a ninth of the policy's time at most
NEW = 1 / 16  # the claim of a source that wasn't seen lately: weaker than a robot's
WEAKEST = 12  # levels of claims, from 0; one is a factor of √2
SAFE_PLACES = 1 / 4  # of the line: those of the sources that were served longest ago
EXPIRY_MARGIN = 1e-4  # seconds after the moment from which a deadline can't be met, so that rounding doesn't matter


@dataclass(eq=False)
class Request:
    """Observations that wait for one run of the policy.

    arrived   when it came
    deadline  when its answer is wanted
    firm      the client said so: it is refused if it can't have its answer by then
    source    the client (a connection)
    session   its name, if it has one: a newer request of the session replaces one that waits
    rows      observations in it; they run together
    later     observations of the same message in later requests: the deadline is for the last of them
    alone     never in a batch with others
    joins     it joins a chunk or requests model_actions: runs with such a request have a table T(B) of their own
    message   the client's, if all of it is this observation; not read here
    call      what to run; not read here
    answer    sends its result at once, from any thread; not read here
    """

    arrived: float
    deadline: float
    firm: bool = False
    priority: Priority = "robot"
    source: Hashable = None
    session: str | None = None
    rows: int = 1
    later: int = 0
    alone: bool = False
    joins: bool = False
    continued: bool = False  # of a message that has its place in the line already
    slowed: bool = False  # its source is read more slowly than it sends: its pauses say nothing, and it has no claim
    message: bytes | memoryview | None = None
    call: Any = None
    answer: Callable[[Any], object] | None = None
    number: int = field(default=0, init=False)  # in the order in which they came
    overtaken: int = field(default=0, init=False)
    order: tuple[float, ...] = field(default=(), init=False)  # robots, then the earliest deadline, then who came first
    in_crowd: tuple[float, ...] = field(default=(), init=False)  # the same, with the claim before the deadline
    queued: float = field(default=0.0, init=False)  # when it was added
    level: int = field(default=WEAKEST, init=False)  # of its claim; 0 is the strongest
    served: float = field(default=0.0, init=False)  # when its source was answered last, or came first


@dataclass(frozen=True)
class Refused:
    """A request that gets no run, why, and the text for its client."""

    request: Request
    kind: Literal["busy", "late", "replaced"]
    text: str


@dataclass(frozen=True)
class Decision:
    """What to do now.

    turn     requests to run together; empty: none yet
    refused  requests to answer with a refusal
    wake     when to call `decide` again, if nothing changes before; None: not at all
    """

    turn: tuple[Request, ...] = ()
    refused: tuple[Refused, ...] = ()
    wake: float | None = None


_ORDER: Callable[[Request], tuple[float, ...]] = attrgetter("order")
_IN_CROWD: Callable[[Request], tuple[float, ...]] = attrgetter("in_crowd")


class _Recent:
    """What sources did last, for a while."""

    def __init__(self, seconds: float) -> None:
        self._seconds = seconds
        self._last: OrderedDict[Hashable, tuple[float, float]] = OrderedDict()

    def note(self, source: Hashable, value: float, now: float) -> None:
        self._last[source] = (now, value)
        self._last.move_to_end(source)
        self._drop(now)

    def others(self, now: float, source: Hashable) -> bool:
        """Whether any but this source did."""
        self._drop(now)
        return len(self._last) > (source in self._last)

    def values(self, now: float) -> dict[Hashable, float]:
        self._drop(now)
        return {source: value for source, (_, value) in self._last.items()}

    def _drop(self, now: float) -> None:
        while self._last and next(iter(self._last.values()))[0] < now - self._seconds:
            self._last.popitem(last=False)


class Schedule:
    """Requests that wait for a policy that runs one turn at a time.

    queue_limit  requests that may wait while a turn runs
    times        T(B); one that forms no batches by default
    turns        seconds until the next turn may begin, where that isn't T(B): a pipelined policy
    joining      T(B) of runs in which a chunk is joined; by default they form no batches
    """

    def __init__(
        self,
        queue_limit: int,
        times: BatchTimes | None = None,
        turns: BatchTimes | None = None,
        joining: BatchTimes | None = None,
    ) -> None:
        self.queue_limit = queue_limit
        self.times = BatchTimes() if times is None else times
        self._turns = self.times if turns is None else turns
        self._joining = BatchTimes() if joining is None else joining
        self._waiting: list[Request] = []
        self._running: tuple[Request, ...] = ()
        self._until = 0.0  # when the running turn is expected to end
        self._free_since = -math.inf
        self._number = 0
        self._exhausted_last = False  # the last turn went to one that had been overtaken too often
        self._active = _Recent(ACTIVE_SECONDS)
        self._tight = _Recent(TIGHT_SECONDS)
        self._last_arrival = -math.inf
        self._gaps: deque[float] = deque(maxlen=GAPS)
        self._think_times = ThinkTimes()
        self._pauses = Pauses()
        # When one was refused a place last: the numbers and sources of those that waited, and what it was.
        self._line: list[int] = []
        self._sources: frozenset[Hashable] = frozenset()
        self._refused: tuple[Priority, int, float, float] | None = None
        self.crowded_until = -math.inf  # claims come before deadlines until then

    @property
    def waiting(self) -> int:
        """Requests that wait."""
        return len(self._waiting)

    @property
    def running(self) -> bool:
        return bool(self._running)

    def waits(self, session: str) -> bool:
        """Whether a request of that session waits: a newer one would replace it."""
        return any(request.session == session for request in self._waiting)

    # --- requests come and go -----------------------------------------------------------------------------------------

    def add(self, request: Request, now: float) -> list[Refused]:
        """A request has come. Those that are refused for it: an older one, or itself."""
        self.note(request, now)
        if (late := self._late_on_arrival(request, now)) is not None:
            return self._refuse([late], now)
        refused = self._replace(request)
        if not request.continued and self.waiting >= self._places:
            self.crowded_until = now + CROWDED_SECONDS
            evicted = request if self._no_better(request) else self._evicted(request)
            text = f"busy: {self.queue_limit} requests wait already (--queue-limit {self.queue_limit}); try again"
            if evicted is not request:
                text += " later: this one gave its place to another that pauses longer, or is more urgent"
                self._waiting.remove(evicted)
            refused.append(Refused(evicted, "busy", text))
            if evicted is request:
                if request.source not in self._sources:  # not for having more than its share
                    self._refused = request.priority, request.level, request.deadline, request.served
                return self._refuse(refused, now)
        self._waiting.append(request)
        if request.firm and request.priority == "robot":
            self._tight.note(request.source, request.deadline - request.arrived, now)
        return self._refuse(refused, now)

    def begin_alone(self, request: Request, now: float) -> bool:
        """Whether a request that has just come is the next turn at once: it is then, and `note` must be called for it.

        That is what `add` and `decide` would find, some 50 us later: nothing runs or waits, it has no deadline of its
        own, and nobody may come soon to run together with it.
        """
        if self._running or self._waiting or request.firm or request.continued:
            return False
        times, turns = (self._joining,) * 2 if request.joins else (self.times, self._turns)
        if not request.alone and times.formed_largest(now) > request.rows:
            own = (request.source,)
            if self._active.others(now, request.source) or self._think_times.expected(now, ACTIVE_SECONDS, own):
                return False
        request.queued = now
        self._running, self._exhausted_last = (request,), False
        self._until = now + turns.total(request.rows, now)
        return True

    def remove(self, request: Request) -> None:
        """Its client has left."""
        if request in self._waiting:
            self._waiting.remove(request)

    def put_back(self, request: Request) -> None:
        """It was in a batch that failed: it waits again, where it was in the order, and runs alone."""
        request.alone = True
        self._waiting.append(request)

    def stop(self) -> list[Request]:
        """All that wait, which wait no more."""
        waiting, self._waiting = self._waiting, []
        return waiting

    def freed(self, now: float, seconds: float | None) -> None:
        """The running turn has ended: the next one may begin.

        seconds  that it took, for T(B); None if they say nothing of how long such a turn takes
        """
        if seconds is not None:
            rows = sum(request.rows for request in self._running)
            times = self._turn_times(self._running)
            times.ran(rows, seconds, now)
            times.seconds(1, now)  # it is kept until the next request comes, which then needn't wait for it
        for request in self._running:
            if not request.later:
                self._think_times.answered(request.source, now)
                self._pauses.served(request.source, now)
        self._running, self._free_since = (), now

    @property
    def _places(self) -> int:
        return self.queue_limit + (not self._running)  # with nothing running, one of those that wait is about to

    def _replace(self, request: Request) -> list[Refused]:
        older = [one for one in self._waiting if request.session is not None and one.session == request.session]
        for one in older:
            self._waiting.remove(one)
        text = f"replaced: a newer observation of session {request.session!r} came before this one had its turn"
        return [Refused(one, "replaced", text) for one in older]

    def _refuse(self, refused: list[Refused], now: float) -> list[Refused]:
        """A source that was refused begins its pause anew."""
        for one in refused:
            self._pauses.refused(one.request.source, now)
        return refused

    def _no_better(self, request: Request) -> bool:
        """Whether its claim is no stronger than one that the same line refused: then nothing else is compared."""
        if self._refused is None or request.source in self._sources:
            return False
        if [one.number for one in self._waiting] != self._line:
            return False
        priority, level, deadline, served = self._refused
        same = request.priority == priority
        return same and request.level >= level and request.deadline >= deadline and request.served >= served

    def _evicted(self, request: Request) -> Request:
        """The one of a full line and a newcomer that gets no place; the module says by which rule."""
        some = [one for one in self._waiting if not one.continued]
        some.append(request)
        if any(one.priority != request.priority for one in some):
            some = [one for one in some if one.priority == "simulator"]
        places = Counter([one.source for one in self._waiting])
        self._line, self._sources = [one.number for one in self._waiting], frozenset(places)
        self._refused = None
        places[request.source] += 1
        most = max([places[one.source] for one in some])
        if most > max(1, self._places // len(places)):
            return min([one for one in some if places[one.source] == most], key=_strength)
        weakest = min(some, key=_strength)
        safe = int(len(some) * SAFE_PLACES)
        if not safe or sum([one.served < weakest.served for one in some]) >= safe:
            return weakest
        longest_ago = sorted(some, key=lambda one: one.served)[:safe]
        return min([one for one in some if one not in longest_ago], key=_strength)

    def note(self, request: Request, now: float) -> None:
        """A request has come: give it its number, and learn how soon others follow."""
        self._number += 1
        request.number, request.queued = self._number, now
        if not request.continued:
            self._think_times.requested(request.source, now)
            claim, request.served = self._pauses.requested(request.source, LONG * self._seconds(request, now), NEW, now)
            request.level = min(WEAKEST, int(-2 * math.log2(claim))) if claim > 0 and not request.slowed else WEAKEST
        priority = PRIORITIES.index(request.priority)
        request.order = priority, request.deadline, request.number
        request.in_crowd = priority, request.level, request.deadline, request.number
        if not (request.alone or request.continued):
            if now - self._last_arrival <= ACTIVE_SECONDS:
                self._gaps.append(now - self._last_arrival)
            self._last_arrival = now
            self._active.note(request.source, 0.0, now)

    # --- deadlines ----------------------------------------------------------------------------------------------------

    def _late_on_arrival(self, request: Request, now: float) -> Refused | None:
        if not request.firm:
            return None
        order = self._order(now)
        before = [one for one in self._waiting if order(one) < order(request)]
        others = [one for one in before if not one.alone]
        together = sum(one.rows for one in others)
        wait = self._until_free(now) + sum(self._turn_seconds((one,), now) for one in before if one.alone)
        run = self._seconds(request, now)
        if self._turns is self.times and not request.alone:  # it may run together with those before it
            rows = together + request.rows + request.later
            wait += max(0.0, self._times((*others, request)).total(rows, now) - run)
        else:
            wait += self._turn_seconds(others, now)
        if now + wait + run <= request.deadline:
            return None
        if before:
            self.crowded_until = now + CROWDED_SECONDS
        return self._late(request, now, wait, run)

    def _expired(self, now: float) -> list[Refused]:
        """Those that wait and can't meet their deadline any more; they wait no longer."""
        if not any(one.firm for one in self._waiting):  # nearly always
            return []
        wait = self._until_free(now)
        late = [one for one in self._waiting if one.firm and now + wait + self._seconds(one, now) > one.deadline]
        for one in late:
            self._waiting.remove(one)
        return self._refuse([self._late(one, now, wait, self._seconds(one, now)) for one in late], now)

    def _until_free(self, now: float) -> float:
        """Seconds until the running turn is expected to end."""
        return max(0.0, self._until - now) if self._running else 0.0

    def _seconds(self, request: Request, now: float) -> float:
        """From the beginning of its turn to the actions of all rows of its message, if they run on their own."""
        return (self._joining if request.joins else self.times).total(request.rows + request.later, now)

    def _turn_seconds(self, requests: Iterable[Request], now: float) -> float:
        """Seconds that turns of these, which may run together, take."""
        requests = tuple(requests)
        return self._turn_times(requests).total(sum(request.rows for request in requests), now)

    def _times(self, requests: Iterable[Request]) -> BatchTimes:
        """T(B) of runs of these."""
        return self._joining if any(request.joins for request in requests) else self.times

    def _turn_times(self, requests: Iterable[Request]) -> BatchTimes:
        """The same, until the next turn may begin."""
        return self._joining if any(request.joins for request in requests) else self._turns

    def _late(self, request: Request, now: float, wait: float, run: float) -> Refused:
        waited, deadline = now - request.arrived, request.deadline - request.arrived
        text = (
            f"late: {waited * 1e3:.1f} ms after the request came, its answer would need {(wait + run) * 1e3:.1f} ms "
            f"more ({wait * 1e3:.1f} ms until its turn, {run * 1e3:.1f} ms in the policy), but its deadline is "
            f"{deadline * 1e3:.1f} ms: ask earlier, or give it more time"
        )
        return Refused(request, "late", text)

    def _next_expiry(self, now: float) -> float | None:
        """When the first of those that wait can't meet its deadline any more, if nothing happens before."""
        moments = [one.deadline - self._seconds(one, now) for one in self._waiting if one.firm]
        return min(moments) + EXPIRY_MARGIN if moments else None

    def _order(self, now: float) -> Callable[[Request], tuple[float, ...]]:
        """Robots first, then in a crowd the strongest claim, then the earliest deadline, then who came first."""
        return _IN_CROWD if now < self.crowded_until else _ORDER

    # --- turns --------------------------------------------------------------------------------------------------------

    def decide(self, now: float) -> Decision:
        """The next turn, if one may begin. It then runs until `freed`."""
        refused = tuple(self._expired(now))
        wake = self._next_expiry(now)
        if self._running or not self._waiting:
            return Decision((), refused, wake)
        head, exhausted = self._head(now)
        group = self._candidates(head, now)
        rows = sum(request.rows for request in group)
        waits = not (exhausted or head.alone or len(group) < self.waiting)
        until = self._batch_window(group, rows, now) if waits else -math.inf
        if until > now:
            return Decision((), refused, until if wake is None else min(until, wake))
        turn = self._best_turn(group, now)
        for request in turn:
            self._waiting.remove(request)
        last = max(request.number for request in turn)
        for request in self._waiting:
            request.overtaken += request.number < last
        self._running, self._exhausted_last = turn, exhausted
        self._until = now + self._turn_seconds(turn, now)
        refused += tuple(self._expired(now))  # those for whom this turn takes too long
        return Decision(turn, refused, self._next_expiry(now))

    def _head(self, now: float) -> tuple[Request, bool]:
        """Whose turn it is, and whether that is because it was overtaken too often: such turns aren't two in a row."""
        exhausted = [request for request in self._waiting if request.overtaken >= OVERTAKEN]
        others = [request for request in self._waiting if request.overtaken < OVERTAKEN]
        if exhausted and not (self._exhausted_last and others):
            return min(exhausted, key=lambda request: request.number), True
        return min(others, key=self._order(now)), False

    def _candidates(self, head: Request, now: float) -> list[Request]:
        """The head, and behind it in their order those that may run together with it."""
        if head.alone:
            return [head]
        others = (one for one in self._waiting if one is not head and not one.alone and one.priority == head.priority)
        return [head, *sorted(others, key=self._order(now))]

    def _best_turn(self, group: list[Request], now: float) -> tuple[Request, ...]:
        """The first of a group, as many as pay and meet the deadlines.

        If some join a chunk and others don't, these may pay more without the others.
        """
        alike = [request for request in group if request.joins == group[0].joins]
        turns = [self._first_that_pay(some, now) for some in ([group] if len(alike) == len(group) else [group, alike])]
        return max(turns, key=lambda turn: sum(request.rows for request in turn))

    def _first_that_pay(self, group: list[Request], now: float) -> tuple[Request, ...]:
        if len(group) == 1:
            return tuple(group)
        rows = sum(request.rows for request in group)
        longest = self._longest(group, now)
        late = self._late_unless_together(group, rows, now, longest)
        best = rows if late else self._times(group).best(rows, now, longest)
        turn, taken = [group[0]], group[0].rows
        for request in group[1:]:
            if taken + request.rows > best:
                break
            turn.append(request)
            taken += request.rows
        return tuple(turn)

    def _late_unless_together(self, group: list[Request], rows: int, now: float, longest: float) -> bool:
        """Whether all in one run are in time, and in the runs that pay most they aren't: a wait leaves room for one."""
        times, first = self._times(group), min(request.deadline for request in group)
        if now + times.total(rows, now) <= first or rows > times.formed_largest(now):
            return False
        together = times.seconds(rows, now)
        if together is None or together > min(longest, first - now):
            return False
        ahead = accumulate(request.rows for request in group)
        return any(now + times.total(done, now) > one.deadline for done, one in zip(ahead, group, strict=True))

    def _longest(self, group: Iterable[Request], now: float) -> float:
        """Seconds that a batch may take: for the deadlines in it, and for a robot whose request may come while it runs.

        A robot whose deadline is shorter than two runs has no guarantee, and none is tried for it.
        """
        group = tuple(group)
        alone = self._times(group).seconds(1, now) or 0.0
        slacks = [one.deadline - now for one in group if one.firm]
        sources = {request.source for request in group}
        tight = (within - alone for source, within in self._tight.values(now).items() if source not in sources)
        slacks += [slack for slack in tight if slack >= alone]
        return max(alone, min(slacks, default=math.inf))

    def part(self, rows: int, now: float) -> int:
        """Of `rows` observations of one message, how many to run together."""
        return self.times.best(rows, now, self._longest((), now))

    def _batch_window(self, group: list[Request], rows: int, now: float) -> float:
        """Until when to wait for more requests; not at all if that isn't later than now.

        The wait must save more time than it takes. Clients that were answered and have a short think time are waited
        for as long as the saving after they were expected; else any client at the usual pace, as long as the saving
        and not longer than a few usual gaps after the last arrival. Only while all deadlines of the group leave room
        for T(B).
        """
        times = self._times(group)
        sources = {request.source for request in group}
        places = min(self._places - len(group), times.formed_largest(now) - rows)
        if places < 1:
            return -math.inf
        opened = max(self._free_since, min(request.arrived for request in group))
        deadline = min(request.deadline for request in group)
        together = times.total(rows, now)

        def saving(more: int) -> float:
            return together + times.total(more, now) - times.total(rows + more, now)

        def latest(more: int) -> float:
            safe = times.seconds(rows + more, now, SAFE)
            return -math.inf if safe is None else deadline - safe - LATE_TIMER

        expected = self._think_times.expected(now, ACTIVE_SECONDS, sources)[:places]
        for more in range(len(expected), 0, -1):
            when, last = expected[more - 1]
            if when - now < saving(more) and (until := min(last, when + saving(more), latest(more))) > now:
                return until
        most = min(places, len(self._active.values(now).keys() - sources))
        if most < 1 or len(self._gaps) < GAPS // 4:
            return -math.inf
        gap = median(self._gaps)
        until = max(
            (min(opened + saving(more), latest(more)) for more in range(1, most + 1) if saving(more) > more * gap),
            default=-math.inf,
        )
        return min(until, self._last_arrival + PATIENCE * gap)


def _strength(request: Request) -> tuple[int, float, int]:
    """Smallest for the one that gives its place to another."""
    return -request.level, -request.deadline, -request.number
