"""Whose turn it is: the decision alone, over simulated time in which a turn takes exactly what the table says."""

import math
from collections.abc import Sequence
from copy import deepcopy
from dataclasses import dataclass, field
from heapq import heappop, heappush
from itertools import count
from random import Random
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from turbopi.serve.scheduling.batch_times import FRESH_SECONDS, GAIN, HISTORY, LONGEST_PAUSE, PAUSE, BatchTimes
from turbopi.serve.scheduling.schedule import LATE_TIMER, OVERTAKEN, Decision, Priority, Refused, Request, Schedule
from turbopi.serve.scheduling.think_time import MAX_SOURCES, ThinkTimes

T1 = 0.01
PAYING = {1: 0.010, 2: 0.014, 4: 0.022, 8: 0.038}  # seconds by size, of an engine that batches
SERIAL = {1: 0.010, 2: 0.020, 4: 0.040, 8: 0.080}  # of one that runs B observations one by one
ROBOT: Priority = "robot"
SIMULATOR: Priority = "simulator"


def table(seconds: dict[int, float]) -> BatchTimes:
    times = BatchTimes(max(seconds))
    for size, value in seconds.items():
        times.measured(size, value)
    return times


def request(
    at: float = 0.0,
    within: float = 1.0,
    *,
    firm: bool = False,
    priority: Priority = ROBOT,
    source: int = 0,
    session: str | None = None,
    rows: int = 1,
    alone: bool = False,
) -> Request:
    return Request(at, at + within, firm, priority, source, session, rows, alone=alone)


def begin(schedule: Schedule, now: float) -> list[Request]:
    """The turn that begins now."""
    decision = schedule.decide(now)
    assert decision.turn, decision
    return list(decision.turn)


# --- simulated time ---------------------------------------------------------------------------------------------------


@dataclass
class Turn:
    requests: tuple[Request, ...]
    started: float
    ended: float
    waited: tuple[Request, ...]  # those that waited when it began, and weren't in it
    crowded: bool  # more had come than could be served

    @property
    def rows(self) -> int:
        return sum(one.rows for one in self.requests)


@dataclass
class History:
    """What became of each request."""

    turns: list[Turn] = field(default_factory=list)
    refused: dict[Request, Refused] = field(default_factory=dict)
    idle: float = 0.0  # seconds in which requests waited and no turn ran

    def turn_of(self, one: Request) -> Turn | None:
        found = [turn for turn in self.turns if one in turn.requests]
        assert len(found) <= 1, "it ran twice"
        return found[0] if found else None


def simulate(schedule: Schedule, arrivals: Sequence[Request]) -> History:
    """Run all arrivals through, until nothing waits."""
    history, coming = History(), sorted(arrivals, key=lambda one: one.arrived)
    now, ends, wake, at = 0.0, math.inf, math.inf, 0

    def refuse(all_refused: Sequence[Refused]) -> None:
        for one in all_refused:
            assert one.request not in history.refused, "it was answered twice"
            history.refused[one.request] = one

    for _ in range(100 * len(coming) + 100):
        arrives = coming[at].arrived if at < len(coming) else math.inf
        then = min(arrives, ends, wake)
        if then == math.inf:
            assert schedule.waiting == 0 and not schedule.running, "requests wait and nothing will happen"
            return history
        if schedule.waiting and not schedule.running:
            history.idle += max(0.0, then - now)
        now = max(now, then)
        if then == ends:
            schedule.freed(now, history.turns[-1].ended - history.turns[-1].started)
            ends = math.inf
        elif then == arrives:
            refuse(schedule.add(coming[at], now))
            at += 1
        decision = schedule.decide(now)
        refuse(decision.refused)
        if decision.turn:
            rows = sum(one.rows for one in decision.turn)
            formed = schedule.times.seconds(rows, now) if rows <= schedule.times.formed_largest(now) else None
            ends = now + (schedule.times.total(rows, now) if formed is None else formed)
            history.turns.append(Turn(decision.turn, now, ends, tuple(schedule._waiting), now < schedule.crowded_until))
        wake = math.inf if decision.wake is None else decision.wake
    raise AssertionError("it never ends")


milliseconds = st.integers(0, 400).map(lambda value: value / 1e3)


@st.composite
def arrivals(draw: st.DrawFn, *, plain: bool = False) -> list[Request]:
    """Requests of up to eight sources; `plain` ones have all the same default deadline."""
    made = []
    for _ in range(draw(st.integers(1, 40))):
        at, source = draw(milliseconds), draw(st.integers(0, 7))
        if plain:
            made.append(request(at, 1.0, source=source))
            continue
        firm = draw(st.booleans())
        within = draw(st.integers(1, 300)) / 1e3 if firm else 1.0
        made.append(
            request(
                at,
                within,
                firm=firm,
                source=source,
                priority=draw(st.sampled_from([ROBOT, SIMULATOR])),
                session=draw(st.sampled_from([None, None, "a", "b"])),
                rows=draw(st.sampled_from([1, 1, 1, 2])),
                alone=draw(st.booleans()),
            )
        )
    return made


class Compared(Schedule):
    """Asks a copy at each arrival whether the request begins alone, and compares what it does then with what it did."""

    copy: Schedule | None = None
    began_alone = 0

    def add(self, request: Request, now: float) -> list[Refused]:
        copy, same = deepcopy((self, request))
        if copy.begin_alone(same, now):
            copy.note(same, now)
            self.copy = copy
        return super().add(request, now)

    def decide(self, now: float) -> Decision:
        copy, self.copy = self.copy, None
        decision = super().decide(now)
        if copy is not None:
            assert len(decision.turn) == len(copy._running) == 1 and not decision.refused and decision.wake is None
            for name in ("_until", "_exhausted_last", "_gaps", "_last_arrival", "_number", "crowded_until", "waiting"):
                assert getattr(copy, name) == getattr(self, name)
            for name in ("order", "in_crowd", "queued", "level", "served", "number"):
                assert getattr(copy._running[0], name) == getattr(decision.turn[0], name)
            self.began_alone += 1
        return decision


tables = st.sampled_from([PAYING, SERIAL, {1: T1}, {1: 0.01, 2: 0.011, 4: 0.03, 5: 0.031}])
limits = st.integers(0, 20)


@settings(max_examples=100, deadline=None)
@given(arrivals(), tables, limits)
def test_a_request_that_begins_alone_is_the_turn_that_it_would_have_got(
    made: list[Request], seconds: dict[int, float], limit: int
) -> None:
    simulate(Compared(limit, table(seconds)), made)


@pytest.mark.parametrize(("sources", "seconds", "alone"), [(1, PAYING, 5), (2, SERIAL, 5), (2, PAYING, 1)])
def test_a_request_begins_alone_unless_another_client_may_come_soon(
    sources: int, seconds: dict[int, float], alone: int
) -> None:
    schedule = Compared(4, table(seconds) if seconds is PAYING else None)
    simulate(schedule, [request(number * 0.1, source=number % sources) for number in range(5)])
    assert schedule.began_alone == alone


@settings(max_examples=100, deadline=None)
@given(arrivals(), tables, limits)
def test_every_request_has_one_turn_or_one_refusal(made: list[Request], seconds: dict[int, float], limit: int) -> None:
    history = simulate(Schedule(limit, table(seconds)), made)
    for one in made:
        assert (history.turn_of(one) is not None) != (one in history.refused)
    for one, refused in history.refused.items():
        assert refused.text.startswith(refused.kind) and (refused.kind != "late" or one.firm)
        assert refused.kind != "replaced" or one.session is not None


@pytest.mark.slow
@settings(max_examples=100, deadline=None)
@given(arrivals(), tables, limits)
def test_a_turn_is_a_batch_only_where_the_table_says_it_is_sooner(
    made: list[Request], seconds: dict[int, float], limit: int
) -> None:
    times = table(seconds)
    for turn in simulate(Schedule(limit, times), made).turns:
        assert len({one.priority for one in turn.requests}) == 1
        if len(turn.requests) > 1:
            assert not any(one.alone for one in turn.requests)
            assert turn.rows <= max(seconds)
            together = times.seconds(turn.rows, turn.started)
            assert together is not None and together < turn.rows * T1


@pytest.mark.slow
@settings(max_examples=100, deadline=None)
@given(arrivals(), tables, limits)
def test_who_runs_meets_the_deadline_that_it_gave(made: list[Request], seconds: dict[int, float], limit: int) -> None:
    history = simulate(Schedule(limit, table(seconds)), made)
    for turn in history.turns:
        for one in turn.requests:
            assert not one.firm or turn.ended <= one.deadline + 1e-9


@settings(max_examples=100, deadline=None)
@given(arrivals(), tables, limits)
def test_a_turn_is_of_the_earliest_deadline_and_of_robots_first(
    made: list[Request], seconds: dict[int, float], limit: int
) -> None:
    for turn in simulate(Schedule(limit, table(seconds)), made).turns:
        if turn.crowded:
            continue
        head = turn.requests[0]
        if head.overtaken >= OVERTAKEN:
            continue
        fresh = [one for one in turn.waited if one.overtaken - (one.number < turn.requests[0].number) < OVERTAKEN]
        for other in fresh:
            assert head.priority == ROBOT or other.priority == SIMULATOR
            if other.priority == head.priority:
                assert head.deadline <= other.deadline


@settings(max_examples=100, deadline=None)
@given(arrivals(plain=True))
def test_without_deadlines_and_batches_it_is_first_come_first_served(made: list[Request]) -> None:
    """Nobody begins later than in a line of one call at a time."""
    history = simulate(Schedule(40, table({1: T1})), made)
    served = [turn.requests[0] for turn in history.turns]
    assert served == sorted(served, key=lambda one: one.number)
    free = 0.0
    for turn in history.turns:
        (one,) = turn.requests
        assert turn.started == pytest.approx(max(free, one.arrived))
        free = turn.ended
    assert history.idle == 0.0


@settings(max_examples=100, deadline=None)
@given(arrivals(plain=True))
def test_batches_of_equal_deadlines_never_change_the_order(made: list[Request]) -> None:
    served = [one for turn in simulate(Schedule(40, table(PAYING)), made).turns for one in turn.requests]
    assert served == sorted(served, key=lambda one: one.number)


@settings(max_examples=100, deadline=None)
@given(arrivals(), tables, limits)
def test_only_so_many_that_came_later_go_first(made: list[Request], seconds: dict[int, float], limit: int) -> None:
    history = simulate(Schedule(limit, table(seconds)), made)
    for one in made:
        before = [turn for turn in history.turns if one in turn.waited]
        overtaking = sum(max(other.number for other in turn.requests) > one.number for turn in before)
        assert overtaking <= OVERTAKEN + 2 * (limit + 1)


def test_simulators_get_their_turn_beside_robots_without_end() -> None:
    """Two robots that ask again at once would leave no turn for anybody else."""
    schedule, numbers = Schedule(16, table({1: T1})), count()
    simulator = request(0.0, priority=SIMULATOR, source=99)
    schedule.add(simulator, 0.0)
    now, turns = 0.0, 0
    for robot in (1, 2):
        schedule.add(request(now, source=robot), now)
    while True:
        (one,) = begin(schedule, now)
        if one is simulator:
            break
        turns += 1
        now += T1
        schedule.freed(now, T1)
        schedule.add(request(now, source=int(one.source)), now)  # type: ignore[call-overload]
        assert next(numbers) < 100, "the simulator starves"
    assert turns == OVERTAKEN


def test_those_overtaken_too_often_take_every_other_turn_at_most() -> None:
    schedule = Schedule(16, table({1: T1}))
    simulators = [request(0.0, priority=SIMULATOR, source=10 + number) for number in range(3)]
    for one in simulators:
        one.overtaken = OVERTAKEN
        schedule.add(one, 0.0)
    for number in range(4):
        schedule.add(request(0.0, source=number), 0.0)
    kinds = []
    for step in range(7):
        (one,) = begin(schedule, step * T1)
        kinds.append(one.priority[0])
        schedule.freed((step + 1) * T1, T1)
    assert "".join(kinds) == "srsrsrr"


# --- deadlines --------------------------------------------------------------------------------------------------------


def test_an_earlier_deadline_goes_first() -> None:
    schedule = Schedule(16, table({1: T1}))
    patient, urgent, plain = request(within=0.5, firm=True), request(within=0.1, firm=True), request(within=0.3)
    for one in (patient, urgent, plain):
        assert schedule.add(one, 0.0) == []
    for expected in (urgent, plain, patient):
        assert begin(schedule, 0.0) == [expected]
        schedule.freed(0.0, T1)


def test_what_is_hopeless_is_refused_when_it_comes_with_the_numbers() -> None:
    schedule = Schedule(16, table({1: T1}))
    schedule.add(request(), 0.0)
    begin(schedule, 0.0)
    schedule.add(request(within=0.02), 0.0)  # it goes first
    late = request(0.004, within=0.025, firm=True)
    (refused,) = schedule.add(late, 0.004)
    assert refused.request is late and refused.kind == "late"
    assert "would need 26.0 ms more (16.0 ms until its turn, 10.0 ms in the policy)" in refused.text
    assert "its deadline is 25.0 ms" in refused.text
    assert schedule.add(request(0.004, within=0.0265, firm=True), 0.004) == []


def test_what_becomes_hopeless_while_it_waits_is_refused_at_that_moment() -> None:
    schedule = Schedule(16, table({1: T1}))
    schedule.add(request(), 0.0)
    begin(schedule, 0.0)
    waits = request(within=0.025, firm=True)
    assert schedule.add(waits, 0.0) == []
    decision = schedule.decide(0.0)
    assert decision.refused == () and decision.wake == pytest.approx(
        0.015, abs=1e-3
    )  # the running turn is overdue then
    assert decision.wake is not None
    (refused,) = schedule.decide(decision.wake).refused
    assert refused.request is waits and refused.kind == "late" and schedule.waiting == 0


def test_without_a_deadline_of_its_own_nothing_is_refused_for_being_late() -> None:
    schedule = Schedule(16, table({1: T1}))
    waits = request(within=0.001)
    assert schedule.add(waits, 0.0) == []
    assert begin(schedule, 5.0) == [waits]


def test_runs_that_join_a_chunk_have_times_of_their_own() -> None:
    schedule = Schedule(16, table(PAYING))

    def joining(within: float) -> Request:
        one = request(within=within, firm=True, alone=True)
        one.joins = True
        return one

    for _ in range(3):
        schedule.add(joining(1.0), 0.0)
        begin(schedule, 0.0)
        schedule.freed(0.0, 0.030)
    assert [one.kind for one in schedule.add(joining(0.029), 0.0)] == ["late"]
    assert schedule.add(joining(0.031), 0.0) == []
    (refused,) = schedule.add(request(within=0.035, firm=True), 0.0)  # behind the one that joins
    assert "(30.0 ms until its turn, 10.0 ms in the policy)" in refused.text
    begin(schedule, 0.0)
    assert [one.kind for one in schedule.add(request(within=0.035, firm=True), 0.0)] == ["late"]
    assert schedule.add(request(within=0.041, firm=True), 0.0) == []


def test_before_anything_was_measured_only_the_past_is_too_late() -> None:
    schedule = Schedule(16)
    soon, past = request(within=1e-6, firm=True), request(0.0, within=0.1, firm=True)
    assert schedule.add(soon, 0.0) == []
    (refused,) = schedule.add(past, 0.2)
    assert refused.request is past
    assert begin(schedule, 0.0) == [soon]


def test_all_rows_of_a_message_count_for_its_deadline() -> None:
    schedule = Schedule(16, table({1: T1}))
    first = request(within=0.05, firm=True)
    first.later = 4  # 5 rows of 10 ms: just in time
    assert schedule.add(first, 0.0) == []
    too_many = request(within=0.05, firm=True)
    too_many.later = 5
    assert [one.kind for one in Schedule(16, table({1: T1})).add(too_many, 0.0)] == ["late"]


def test_a_pipelined_policys_wait_is_shorter_than_its_answers() -> None:
    turns = table({1: 0.004})
    schedule = Schedule(16, table({1: T1}), turns)
    schedule.add(request(), 0.0)
    begin(schedule, 0.0)
    assert schedule.add(request(within=0.015, firm=True), 0.0) == []
    (refused,) = schedule.add(request(within=0.0135, firm=True), 0.0)
    assert "4.0 ms until its turn, 10.0 ms in the policy" in refused.text


# --- who gets a place -------------------------------------------------------------------------------------------------


def test_the_newest_observation_of_a_session_replaces_the_one_that_waits_and_not_the_one_that_runs() -> None:
    schedule = Schedule(1, table({1: T1}))
    running, older, newer = (request(session="arm", source=number) for number in range(3))
    schedule.add(running, 0.0)
    assert begin(schedule, 0.0) == [running]
    assert schedule.add(older, 0.0) == [] and schedule.waits("arm") and not schedule.waits("leg")
    (refused,) = schedule.add(newer, 0.0)  # though there is no place beside it
    assert refused.request is older and refused.kind == "replaced" and "session 'arm'" in refused.text
    schedule.freed(0.01, T1)
    assert begin(schedule, 0.01) == [newer]


def test_a_robot_takes_the_place_of_the_last_simulator_when_all_are_taken() -> None:
    schedule = Schedule(2, table({1: T1}))
    schedule.add(request(), 0.0)
    begin(schedule, 0.0)
    first, last = (request(priority=SIMULATOR, within=within) for within in (1.0, 2.0))
    schedule.add(first, 0.0)
    schedule.add(last, 0.0)
    (refused,) = schedule.add(request(priority=SIMULATOR, within=3.0), 0.0)
    assert refused.request.deadline == 3.0 and refused.text.startswith("busy: 2 requests wait already")
    (refused,) = schedule.add(request(), 0.0)
    assert refused.request is last and refused.kind == "busy" and schedule.waiting == 2
    schedule.add(request(), 0.0)
    full = request()
    assert [one.request for one in schedule.add(full, 0.0)] == [full]  # only robots are left


def test_a_request_that_is_late_itself_replaces_nothing() -> None:
    schedule = Schedule(16, table({1: T1}))
    schedule.add(request(), 0.0)
    begin(schedule, 0.0)
    waits = request(session="arm", source=1)
    schedule.add(waits, 0.0)
    (refused,) = schedule.add(request(within=0.001, firm=True, session="arm", source=2), 0.0)
    assert refused.kind == "late" and schedule.waits("arm")
    # a newer one doesn't wait for the one that it replaces
    assert [one.request for one in schedule.add(request(within=0.021, firm=True, session="arm"), 0.0)] == [waits]


@dataclass
class Crowd:
    """Clients that ask again so soon after each answer (`pause`) or refusal (`retry`, else the same).

    others    how many; `each` requests at once; as sources that are always new if they `reconnect`
    within    seconds of their deadlines
    """

    others: int
    pause: float = 0.001
    retry: float | None = None
    within: float = 1.0
    firm: bool = False
    each: int = 1
    reconnect: bool = False
    priority: Priority = ROBOT


def beside(crowd: Crowd, robots: Sequence[float | None], seconds: float = 5.0, limit: int = 16) -> float:
    """The part of a robot's requests that get answers in time, beside a crowd and other robots; the worst one's.

    Turns take 20 ms. Each robot asks five times a second, with jitter, but not before it is answered. `robots` has
    their deadlines; None: the default one of a second, which isn't their own.
    """
    schedule, randoms, events, order = Schedule(limit, table({1: 0.02})), Random(0), list[Any](), count()
    wanted, good, now, wake = [0] * len(robots), [0] * len(robots), 0.0, -1.0

    def at(when: float, what: str, who: Any) -> None:
        heappush(events, (when, next(order), what, who))

    def replied(one: Request, answered: bool) -> None:
        kind, number, counts = one.call
        if kind == "robot":
            wanted[number] += counts
            good[number] += counts and answered and now <= one.deadline
            at(max(now, one.arrived + 0.2 * randoms.uniform(0.7, 1.3)), "ask", (kind, number))
        else:
            pause = crowd.pause if answered or crowd.retry is None else crowd.retry
            at(now + pause * randoms.uniform(1, 1.1), "ask", (kind, number))

    for number in range(crowd.others * crowd.each):
        at(0.01 * randoms.random(), "ask", ("other", number % crowd.others))
    for number in range(len(robots)):
        at(1.0 + 0.013 * number, "ask", ("robot", number))
    while now < seconds:
        now, _, what, who = heappop(events)
        if what == "ask":
            if who[0] == "robot":
                own, known = robots[who[1]], now > 1.5  # nobody knows a robot in its first request
                one = Request(now, now + (own or 1.0), own is not None, source=who, call=(*who, known))
            else:
                source = object() if crowd.reconnect else who
                one = Request(now, now + crowd.within, crowd.firm, crowd.priority, source, call=(*who, False))
            for refused in schedule.add(one, now):
                replied(refused.request, False)
        elif what == "end":
            schedule.freed(now, 0.02)
            for one in who:
                replied(one, True)
        decision = schedule.decide(now)
        for refused in decision.refused:
            replied(refused.request, False)
        if decision.turn:
            at(now + 0.02, "end", decision.turn)
        if decision.wake is not None and not now < wake <= decision.wake:
            wake = max(now, decision.wake)
            at(wake, "wake", None)
    return min(got / ask for got, ask in zip(good, wanted, strict=True))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("others", "pause"),
    [(17, 0.001), (24, 0.001), (40, 0.001), (150, 0.01), (17, 0.1), (40, 0.05), (40, 0.1), (150, 0.05), (150, 0.1)],
)
@pytest.mark.parametrize("own", [0.2, None], ids=["deadline", "plain"])
def test_a_robot_is_served_beside_a_crowd_that_asks_again_at_once(others: int, pause: float, own: float | None) -> None:
    assert beside(Crowd(others, pause), [own]) >= 0.95


@pytest.mark.slow
@pytest.mark.parametrize(
    "crowd",
    [
        Crowd(40, 0.01, within=60.0, firm=True),
        Crowd(40, 0.01, within=0.4, firm=True),
        Crowd(40, 0.01, within=0.2, firm=True),
        Crowd(40, 0.01, within=0.05, firm=True),
        Crowd(40, 0.01, within=0.021, firm=True),
        Crowd(40, 0.01, within=0.001, firm=True),
        Crowd(40, 0.03, within=0.1, firm=True),
        Crowd(40, 0.01, retry=0.1),
        Crowd(17, 0.01, each=4),
        Crowd(1, 0.01, each=40),
        Crowd(40, 0.01, reconnect=True),
        Crowd(40, 0.01, reconnect=True, within=0.05, firm=True),
        Crowd(40, 0.01, priority=SIMULATOR),
        Crowd(150, 0.3),
        Crowd(150, 1.0),
    ],
    ids=str,
)
def test_no_crowd_takes_a_robots_turn(crowd: Crowd) -> None:
    assert beside(crowd, [0.2]) >= 0.95


@pytest.mark.slow
def test_several_robots_are_served_beside_a_crowd() -> None:
    assert beside(Crowd(40, 0.01), [0.2, None, 0.2, 0.1, 0.2]) >= 0.95
    assert beside(Crowd(40, 0.01, within=0.2, firm=True), [0.2] * 5) >= 0.95
    assert beside(Crowd(40, 0.01), [0.2], limit=4) >= 0.95


def test_a_robot_in_a_crowd_of_others_like_it_has_its_share() -> None:
    """150 that ask three times a second are too much: a robot that asks more often gets some answers, too."""
    assert beside(Crowd(150, 0.3), [None], 12.0) >= 0.05


def test_a_source_with_more_than_its_share_of_a_full_line_gives_way() -> None:
    schedule = Schedule(4, table({1: T1}))
    schedule.add(request(source=9), 0.0)
    begin(schedule, 0.0)
    greedy = [request(source=1, within=0.5) for _ in range(3)]
    for one in (*greedy, request(source=2, within=2.0)):
        assert schedule.add(one, 0.0) == []
    (refused,) = schedule.add(request(source=3, within=3.0), 0.0)
    assert refused.request is greedy[-1] and "gave its place" in refused.text


def test_a_source_that_is_slowed_has_no_claim_from_its_pauses() -> None:
    schedule = Schedule(1, table({1: T1}))
    schedule.add(request(source=9), 0.0)
    begin(schedule, 0.0)
    for source in (1, 2):  # both pause until 0.5
        schedule.add(first := request(0.0, source=source), 0.0)
        schedule.remove(first)
    slowed = request(0.5, source=1)
    slowed.slowed = True
    assert schedule.add(slowed, 0.5) == []
    assert [one.request for one in schedule.add(request(0.5, source=2), 0.5)] == [slowed]


def test_a_message_of_many_rows_keeps_its_place() -> None:
    schedule = Schedule(1, table({1: T1}))
    schedule.add(request(), 0.0)
    begin(schedule, 0.0)
    schedule.add(request(), 0.0)
    part = request()
    part.continued = True
    assert schedule.add(part, 0.0) == []


# --- batches ----------------------------------------------------------------------------------------------------------


def waiting(schedule: Schedule, number: int, **of: float) -> list[Request]:
    """So many that waited while another turn ran, which has just ended at 1.0."""
    schedule.add(request(0.99, source=-1), 0.99)
    begin(schedule, 0.99)
    made = [request(0.99, source=one, **of) for one in range(number)]  # type: ignore[arg-type]
    for one in made:
        schedule.add(one, 0.99)
    schedule.freed(1.0, None)
    return made


def test_those_that_wait_run_together_where_that_pays() -> None:
    schedule = Schedule(16, table(PAYING))
    made = waiting(schedule, 8)
    assert begin(schedule, 1.0) == made
    schedule = Schedule(16, table(SERIAL))
    assert len(waiting(schedule, 8)) == 8 and len(begin(schedule, 1.0)) == 1


def test_the_size_is_the_one_that_makes_the_most_a_second() -> None:
    schedule = Schedule(16, table({1: 0.0075, 2: 0.0124, 4: 0.02, 8: 0.037}))
    waiting(schedule, 5)
    assert len(begin(schedule, 1.0)) == 4  # the engine would round 5 up to 8


def test_a_batch_keeps_the_deadlines_in_it() -> None:
    schedule = Schedule(16, table(PAYING))
    made = waiting(schedule, 7)
    tight = request(1.0, within=0.023, firm=True, source=50)
    schedule.add(tight, 1.0)
    assert begin(schedule, 1.0) == [tight, *made[:3]]  # 22 ms; one more would take 38


def test_a_batch_is_no_longer_than_a_robot_with_a_deadline_can_wait() -> None:
    """It asked a second ago, and may ask again while the batch runs."""
    schedule = Schedule(16, table(PAYING))
    schedule.add(request(0.0, within=0.03, firm=True, source=50), 0.0)
    begin(schedule, 0.0)
    schedule.freed(0.01, T1)
    waiting(schedule, 8)
    assert len(begin(schedule, 1.0)) == 2  # 14 ms, and 10 for the robot
    later = Schedule(16, table(PAYING))
    later.add(request(-20.0, within=0.03, firm=True, source=50), -20.0)
    begin(later, -20.0)
    later.freed(-19.99, T1)
    waiting(later, 8)
    assert len(begin(later, 1.0)) == 8


def test_who_is_too_late_by_the_turn_that_begins_is_told_at_once() -> None:
    schedule = Schedule(16, table({1: T1}))
    robot = request(within=1.0)
    simulator = request(within=0.015, firm=True, priority=SIMULATOR)
    assert schedule.add(simulator, 0.0) == []
    schedule.add(robot, 0.0)
    decision = schedule.decide(0.0)
    assert decision.turn == (robot,)
    assert [one.request for one in decision.refused] == [simulator]
    assert "(10.0 ms until its turn, 10.0 ms in the policy)" in decision.refused[0].text


def test_a_deadline_that_no_turn_could_leave_room_for_limits_no_batch() -> None:
    schedule = Schedule(16, table(PAYING))
    schedule.add(request(0.0, within=0.019, firm=True, source=50), 0.0)
    begin(schedule, 0.0)
    schedule.freed(0.01, T1)
    waiting(schedule, 8)
    assert len(begin(schedule, 1.0)) == 8


def test_one_that_was_in_a_failed_batch_runs_alone_in_its_place() -> None:
    schedule = Schedule(16, table(PAYING))
    made = waiting(schedule, 3)
    turn = begin(schedule, 1.0)
    schedule.freed(1.01, None)
    for one in turn:
        schedule.put_back(one)
    schedule.add(request(1.01, source=9), 1.01)
    assert [begin_and_end(schedule, 1.01)[0] for _ in range(3)] == made


def begin_and_end(schedule: Schedule, now: float) -> list[Request]:
    turn = begin(schedule, now)
    schedule.freed(now, None)
    return turn


def test_a_message_of_several_rows_is_a_part_of_a_batch() -> None:
    schedule = Schedule(16, table(PAYING))
    first, pair, last = request(source=1), request(source=2, rows=2), request(source=3, rows=6)
    for one in (first, pair, last):
        schedule.add(one, 0.0)
    assert begin(schedule, 0.0) == [first, pair]  # 9 rows are too many
    assert schedule.part(20, 0.0) == 8 and schedule.part(4, 0.0) == 4
    assert Schedule(16, table(SERIAL)).part(20, 0.0) == 1


# --- waiting for company ----------------------------------------------------------------------------------------------


def cohort(schedule: Schedule, rounds: int = 6, robots: int = 4, apart: float = 0.0002) -> float:
    """Robots that asked together, again and again: the time of the last round's end."""
    now = 0.0
    for _ in range(rounds):
        for robot in range(robots):
            schedule.add(request(now, source=robot), now)
            now += apart
        while schedule.waiting:
            decision = schedule.decide(now)
            now = now if decision.turn else decision.wake or now
            if decision.turn:
                now += schedule.times.total(sum(one.rows for one in decision.turn), now)
                schedule.freed(now, None)
    return now


def test_company_that_comes_at_once_is_waited_for_and_then_no_longer() -> None:
    schedule = Schedule(16, table(PAYING))
    now = cohort(schedule)
    for robot in range(3):
        schedule.add(request(now, source=robot), now)
        decision = schedule.decide(now)
        assert not decision.turn and decision.wake is not None and now < decision.wake < now + 0.002
    schedule.add(request(now, source=3), now)
    assert len(begin(schedule, now)) == 4  # all are there


def test_a_late_timer_does_not_shrink_the_batch_that_was_waited_for() -> None:
    schedule = Schedule(16, table(PAYING))
    now = cohort(schedule, apart=0.001)
    sent = [request(now, source=robot, within=0.0245, firm=True) for robot in range(3)]
    for one in sent:
        assert not schedule.add(one, now)
    wake = schedule.decide(now).wake
    assert wake is not None and now < wake
    sent.append(request(wake, source=3))
    assert not schedule.add(sent[-1], wake)
    assert begin(schedule, wake + 0.9 * LATE_TIMER) == sent, "four take 22 ms, and the first three had 24.5"


def test_who_waited_in_vain_is_in_time() -> None:
    """Three of 10, 14 and 22 ms (by size) as they pay most, two and one, take 24 ms; the wait left room for 22."""
    schedule = Schedule(16, table(PAYING))
    now = cohort(schedule, apart=0.001)
    sent = [request(now, source=robot, within=0.0245) for robot in range(3)]
    for one in sent:
        assert not schedule.add(one, now)
    wake = schedule.decide(now).wake
    assert wake is not None and now + 0.0005 < wake < now + 0.0025
    assert begin(schedule, wake) == sent
    loose = Schedule(16, table(PAYING))
    for one in [request(0.0, source=robot, within=0.025) for robot in range(3)]:
        loose.add(one, 0.0)
    assert len(begin(loose, 0.0)) == 2


def test_company_that_does_not_come_is_waited_for_a_few_gaps_alone() -> None:
    schedule = Schedule(16, table(PAYING))
    now = cohort(schedule)
    one = request(now, source=0)
    schedule.add(one, now)
    wake = schedule.decide(now).wake
    assert wake is not None and begin(schedule, wake) == [one]


@pytest.mark.parametrize("why", ["nobody else", "rare", "does not pay", "no slack", "no place", "another waits"])
def test_nobody_waits_for_company_in_vain(why: str) -> None:
    schedule = Schedule(0 if why == "no place" else 16, table(SERIAL if why == "does not pay" else PAYING))
    now = 0.0
    if why == "nobody else":
        now = cohort(schedule, robots=1, rounds=40)
    elif why == "rare":
        for step in range(40):  # two robots, each ten times a second: a batch of two saves 6 ms
            now = step * 0.05
            schedule.add(request(now, source=step % 2), now)
            begin_and_end(schedule, now)
        now += 0.05
    elif why == "no place":
        for step in range(40):
            now = step * 0.0002
            schedule.add(request(now, source=step % 4), now)
            begin_and_end(schedule, now)
    else:
        now = cohort(schedule)
    tight = why == "no slack"
    one = request(now, source=0, within=0.0135 if tight else 1.0, firm=tight)
    schedule.add(one, now)
    if why == "another waits":
        schedule.add(request(now, source=7, priority=SIMULATOR), now)
    assert begin(schedule, now) == [one]


# --- clients that ask again at once -----------------------------------------------------------------------------------


def closed_loop(
    schedule: Schedule,
    seconds: float,
    returns: Sequence[float],
    begins: Sequence[float],
    leave: float = math.inf,
    joins: bool = False,
) -> list[int]:
    """Rows of each turn, of clients that ask again so long after their answers; from `leave` on, client 0 doesn't."""
    times = schedule._joining if joins else schedule.times
    coming = sorted((at, source) for source, at in enumerate(begins))
    now, ends, wake, turn, rows = 0.0, math.inf, math.inf, list[Request](), list[int]()
    while now < seconds:
        now = min(coming[0][0] if coming else math.inf, ends, wake)
        if now == ends:
            schedule.freed(now, times.total(len(turn), now))
            sources = [source for source in range(len(returns)) if any(ran.source == source for ran in turn)]
            coming += [(now + returns[source], source) for source in sources]
            coming, ends = sorted(one for one in coming if one[1] != 0 or one[0] < leave), math.inf
        while coming and coming[0][0] <= now:
            one = request(now, source=coming.pop(0)[1])
            one.joins = joins
            assert not schedule.add(one, now)
        decision = schedule.decide(now)
        wake = math.inf if decision.wake is None else decision.wake
        if decision.turn:
            turn, ends = list(decision.turn), now + times.total(len(decision.turn), now)
            rows.append(len(turn))
    return rows


H100_BF16 = {1: 0.0079, 2: 0.0134, 4: 0.025, 8: 0.041}


@pytest.mark.parametrize("seconds", [PAYING, H100_BF16], ids=["paying", "h100"])
@pytest.mark.parametrize("late", [0, 1, 4])
def test_clients_that_ask_again_at_once_come_into_one_batch(seconds: dict[int, float], late: int) -> None:
    """Whoever asked in the middle of the others' turn would stay out of step: alone, then seven, then alone."""
    returns = [0.002 + 0.0004 * number for number in range(8)]
    begins = [0.02 if number < late else 0.0001 * number for number in range(8)]
    rows = closed_loop(Schedule(16, table(seconds)), 2.0, returns, begins)
    assert rows[12:] == [8] * (len(rows) - 12), rows


def test_clients_that_take_longer_than_they_save_are_not_waited_for() -> None:
    returns = [0.002] * 4 + [0.02] * 4  # they would save 14 ms
    rows = closed_loop(Schedule(16, table({1: 0.01, 4: 0.02, 8: 0.04})), 2.0, returns, [0.0] * 4 + [0.01] * 4)
    assert set(rows[12:]) == {4}, rows


def test_a_client_that_is_late_is_waited_for_no_longer_than_it_saves() -> None:
    """It may have gone elsewhere: to another replica of a fleet."""
    schedule, now = Schedule(16, table(PAYING)), 0.0
    for _ in range(5):  # client 1 asks again 0.3 s after its answer, again and again
        schedule.add(request(now, source=1), now)
        begin(schedule, now)
        schedule.freed(now, None)
        now += 0.3
    late = now + 0.001  # it was expected, and isn't there
    one = request(late, source=0)
    schedule.add(one, late)
    saves = 2 * PAYING[1] - PAYING[2]
    wake = schedule.decide(late).wake
    assert wake is not None and late < wake <= now + saves + 1e-9
    assert begin(schedule, wake) == [one]


def test_a_client_that_left_is_waited_for_once() -> None:
    schedule = Schedule(16, table(PAYING))
    rows = closed_loop(schedule, 2.0, [0.002] * 8, [0.0] * 8, leave=1.0)
    assert set(rows[-20:]) == {7}
    schedule.freed(2.1, None)
    others = [request(2.101, source=number) for number in range(1, 8)]
    for one in others:
        schedule.add(one, 2.101)
    assert begin(schedule, 2.101) == others, "not for the one that left"


def test_think_times_are_forgotten_with_their_clients() -> None:
    times = ThinkTimes()
    for source in range(3000):
        for now in (0.0, 1.0):
            times.answered(source, now)
            times.requested(source, now + 0.001)
        times.answered(source, 2.0)
    assert len(times.expected(2.0, 1.0, ())) <= MAX_SOURCES
    assert times.expected(3.5, 1.0, ()) == [] and not times._answered


def test_one_slow_return_of_five_changes_nothing_and_two_do() -> None:
    times = ThinkTimes()
    for now, seconds in enumerate((0.002, 0.002, 0.003, 0.002, 0.5, 0.5)):
        times.answered("robot", now)
        times.requested("robot", now + seconds)
        times.answered("robot", now + 0.6)
        usual = [when - now - 0.6 for when, _ in times.expected(now + 0.6, 1.0, ())]
        assert usual == ([] if now == 0 else pytest.approx([{3: 0.003, 4: 0.003, 5: 0.5}.get(now, seconds)])), now
        times._answered.clear()


# --- the table --------------------------------------------------------------------------------------------------------


def test_a_size_counts_as_the_next_larger_one_that_was_measured() -> None:
    times = table(PAYING)
    assert [times.seconds(rows, 0.0) for rows in (1, 2, 3, 5, 8, 9)] == [0.01, 0.014, 0.022, 0.038, 0.038, None]


def test_what_runs_replaces_what_was_measured_until_it_is_old() -> None:
    times = table(PAYING)
    times.ran(8, 0.2, 1.0)
    times.ran(8, 0.2, 1.0)
    assert times.seconds(8, 1.0) == 0.038  # two may have been disturbed
    times.ran(8, 0.2, 1.0)
    assert times.seconds(8, 1.0) == 0.2 and times.best(8, 1.0) == 4
    assert times.seconds(8, 1.1 + FRESH_SECONDS) == 0.038 and times.best(8, 1.1 + FRESH_SECONDS) == 8


def test_a_size_without_times_of_its_own_gets_them_by_running() -> None:
    times = table(PAYING)
    for _ in range(3):
        times.ran(3, 0.018, 1.0)
    assert times.seconds(3, 1.0) == 0.018 and times.seconds(4, 1.0) == 0.022


def test_the_last_times_alone_count() -> None:
    times = BatchTimes()
    for number in range(2 * HISTORY):
        times.ran(1, float(number), float(number))
    assert times.seconds(1, 99.0) == 74.0  # the median of 50 to 99
    assert times.seconds(1, 99.0, 0.95) == 97.0
    assert times.seconds(1, 1e6) == 74.0, "nothing better is known"


@given(st.lists(st.floats(1e-3, 1.0), min_size=1, max_size=120), st.sampled_from([0.5, 0.95, 1.0]))
def test_a_quantile_is_one_of_the_last_times_and_no_less_than_that_part(values: list[float], part: float) -> None:
    times = BatchTimes()
    for number, value in enumerate(values):
        times.ran(1, value, float(number))
    last, found = values[-HISTORY:], times.seconds(1, float(len(values)), part)
    assert found in last
    assert found is not None and sum(value <= found for value in last) >= part * len(last)


def test_without_measurements_there_are_no_batches() -> None:
    times = BatchTimes(8)
    times.ran(1, 0.01, 0.0)
    assert times.best(8, 0.0) == 1 and times.measured_largest == 1


def test_a_size_that_warm_up_could_not_measure_is_never_formed() -> None:
    times = table(PAYING)
    times.limit(7)
    assert times.best(8, 0.0) == 4 and times.measured_largest == 4
    times.limit(1)
    assert times.best(8, 0.0) == 1


def test_a_size_that_failed_while_serving_is_tried_again_later_each_time() -> None:
    times, now = table(PAYING), 0.0
    for pause in (1.0, 2.0, 4.0, 8.0):
        assert times.failed(8, now) == pause
        assert times.best(8, now) == times.formed_largest(now) == 4 and times.measured_largest == 8
        assert times.best(8, now + 0.99 * pause) == 4
        now += pause
        assert times.best(8, now) == 8
        times.ran(4, 0.022, now)  # says nothing of larger ones
    for _ in range(20):
        times.failed(8, now)
    assert times.failed(8, now) == LONGEST_PAUSE
    times.ran(8, 0.038, now + LONGEST_PAUSE)
    assert times.best(8, now + LONGEST_PAUSE) == 8 and times.failed(8, now + LONGEST_PAUSE) == PAUSE


def test_while_a_size_pauses_smaller_ones_may_fail_too() -> None:
    times = table(PAYING)
    times.failed(8, 0.0)
    times.failed(2, 0.5)
    assert times.best(8, 1.1) == 1 and times.best(8, 2.5) == 8


def test_a_gain_of_a_few_percent_is_none() -> None:
    assert table({1: 0.01, 2: 0.02 * GAIN}).best(2, 0.0) == 1
    assert table({1: 0.01, 2: 0.0199 * GAIN}).best(2, 0.0) == 2


@given(st.lists(st.tuples(st.sampled_from(["ran", "measured", "failed", "ask"]), st.integers(1, 9), st.floats(0, 90))))
def test_what_was_looked_up_before_changes_no_answer(events: list[tuple[str, int, float]]) -> None:
    """Answers are kept until something is added or grows old."""
    times, now, log = table(PAYING), 0.0, list[tuple[str, int, float]]()
    for what, rows, value in events:
        now += value if what == "ask" else 0.0
        log.append((what, rows, now))
        fresh = table(PAYING)
        for reported, size, at in log:
            if reported == "ran":
                fresh.ran(size, 0.011 * size, at)
            elif reported == "measured":
                fresh.measured(size, 0.009 * size)
            elif reported == "failed":
                fresh.failed(size, at)
        if what == "ran":
            times.ran(rows, 0.011 * rows, now)
        elif what == "measured":
            times.measured(rows, 0.009 * rows)
        elif what == "failed":
            times.failed(rows, now)
        for size in (1, 3, 8):
            assert times.seconds(size, now) == fresh.seconds(size, now)
            assert times.best(size, now) == fresh.best(size, now)
            assert times.total(size, now) == fresh.total(size, now)
