"""How chunks join: no action twice, none left out, and every chunk told of exactly what runs."""

import json
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from turbopi.realtime import WAYS, ChunkQueue, DelayEstimate, Request, Seam, way_named
from turbopi.realtime.running_chunk import RunningChunk
from turbopi.support.errors import ConfigError

RTC = [name for name, way in WAYS.items() if way.mode is not None]
ASYNC = [name for name, way in WAYS.items() if not way.stands_still]


class Line:
    """A robot on a line and its policy. The place is the number of actions carried out, and a chunk counts on from it:
    so row i of a chunk taken at place n is n + i. `model_actions` are the same, divided by 1000, in two columns.
    """

    def __init__(self, horizon: int, offset: float = 0.0) -> None:
        self.horizon, self.offset, self.place = horizon, offset, 0
        self.done: list[float] = []
        self.requests: list[Request] = []

    def answer(self, request: Request, ago: int = 0) -> dict[str, Any]:
        self.requests.append(request)
        rows = np.arange(self.horizon) + self.place - ago + self.offset * request.number
        result: dict[str, Any] = {"actions": rows[:, None].astype(np.float64)}
        if request.model_actions:
            result["model_actions"] = np.stack([rows, rows], axis=1).astype(np.float32)
            result["anchor"] = np.array([float(request.number)])
        return result


def run(queue: ChunkQueue, line: Line, delays: list[int], steps: int) -> None:
    """`steps` control steps, the chunks' delays taken in turn."""
    due, result = -1, None
    for step in range(steps):
        if result is not None and step >= due:
            queue.arrive(result)
            result = None
        if queue.wants_observation:
            due, result = step + delays[len(line.requests) % len(delays)], line.answer(queue.observe())
            if step >= due:
                queue.arrive(result)
                result = None
        action = queue.next_action()
        if action is not None:
            line.done.append(float(action.values[0]))
            line.place += 1


@given(
    name=st.sampled_from(list(WAYS)),
    horizon=st.integers(1, 12),
    s=st.integers(1, 12),
    delays=st.lists(st.integers(0, 15), min_size=1, max_size=6),
    percentile=st.sampled_from([0.0, 50.0, 100.0]),
)
def test_no_action_is_carried_out_twice_or_left_out(
    name: str, horizon: int, s: int, delays: list[int], percentile: float
) -> None:
    s = min(s, horizon)
    queue = ChunkQueue(name, execution_horizon=s, delay=DelayEstimate(percentile=percentile))
    line = Line(horizon)
    run(queue, line, delays, 80)
    np.testing.assert_allclose(line.done, np.arange(len(line.done)), atol=1e-9)
    assert len(line.done) + queue.empty_steps == queue.steps == 80
    assert len(line.requests) == queue.chunks + sum(queue.dropped.values()) + (queue.in_flight is not None)


@given(
    name=st.sampled_from(RTC),
    horizon=st.integers(1, 12),
    s=st.integers(1, 12),
    delays=st.lists(st.integers(0, 15), min_size=1, max_size=6),
    most=st.none() | st.integers(0, 4),
)
def test_the_policy_is_told_what_runs(name: str, horizon: int, s: int, delays: list[int], most: int | None) -> None:
    s = min(s, horizon)
    queue = ChunkQueue(name, execution_horizon=s, delay=DelayEstimate(), trained_max_delay=most)
    line = Line(horizon)
    places: list[int] = []
    answer = line.answer

    def noting(request: Request, ago: int = 0) -> dict[str, Any]:
        places.append(line.place)
        return answer(request, ago)

    line.answer = noting  # type: ignore[method-assign]
    run(queue, line, delays, 60)
    for place, request in zip(places, line.requests, strict=True):
        reported = request.previous
        if reported is None:
            continue
        assert reported.mode == name and reported.execution_horizon is not None
        np.testing.assert_array_equal(reported.left_over[:, 0], place + np.arange(len(reported.left_over)))
        assert reported.left_over.dtype == np.float32 and 1 <= len(reported.left_over) <= horizon
        assert 0 <= reported.delay <= horizon - reported.execution_horizon <= len(reported.left_over)
        assert reported.execution_horizon >= s
        assert reported.anchor is not None and reported.anchor[0] < request.number
        if name == "rtc_trained" and most is not None:
            assert reported.delay <= most


def test_the_old_name_of_the_reported_delay_is_found_with_a_warning() -> None:
    seam = Seam(step=8, chunk=1, delay=2, carried_out=2, reported=3, jump=np.zeros(7), gap=None)
    with pytest.warns(DeprecationWarning, match=r"Seam\.reported"):
        assert getattr(seam, "told") == 3  # noqa: B009
    assert not hasattr(seam, "no_such_name")


@given(horizon=st.integers(2, 16), s=st.integers(1, 16), d=st.integers(0, 16), name=st.sampled_from(ASYNC))
def test_a_delay_that_fits_leaves_no_step_without_an_action(horizon: int, s: int, d: int, name: str) -> None:
    s, d = min(s, horizon - 1), min(d, horizon)
    if d > min(s, horizon - s):
        return
    queue = ChunkQueue(name, execution_horizon=s, delay=d)
    line = Line(horizon)
    run(queue, line, [d], 50)
    assert queue.empty_steps == d  # before the first chunk
    assert not queue.dropped and not queue.late and not queue.cut_delays
    assert [request.step for request in line.requests[1:4]] == [d + s + i * s for i in range(3)]
    for seam in queue.seams:
        assert seam.delay == seam.carried_out == d
        assert seam.reported == (d if name in RTC else None)
        assert seam.jump == pytest.approx([1.0])
        assert (seam.gap is None) == (d + s == horizon)  # the running chunk has just ended
        assert seam.gap is None or seam.gap == pytest.approx([0.0])


def test_sync_stands_still_while_the_policy_thinks() -> None:
    queue, line = ChunkQueue("sync", execution_horizon=2), Line(4)
    run(queue, line, [3], 20)
    assert line.done == [float(i) for i in range(len(line.done))]
    assert queue.steps == 20 and queue.empty_steps == 12  # of every five steps, three
    assert all(seam.delay == 3 and seam.carried_out == 0 for seam in queue.seams)


def test_async_jumps_where_the_chunks_disagree_and_the_seam_says_so() -> None:
    queue, line = ChunkQueue("async", execution_horizon=3), Line(8, offset=10.0)
    run(queue, line, [2], 12)
    assert line.done[:6] == [0, 1, 2, 3, 4, 15]
    seam = queue.seams[0]
    assert (seam.step, seam.chunk, seam.delay) == (7, 1, 2)
    assert seam.jump == pytest.approx([11.0]) and seam.gap == pytest.approx([10.0])


def test_ensemble_averages_what_both_chunks_have() -> None:
    queue, line = ChunkQueue("ensemble", execution_horizon=3), Line(6, offset=10.0)
    run(queue, line, [0], 7)
    assert line.done[:6] == pytest.approx([0, 1, 2, 3 + 7, 4 + 7, 5 + 7])  # the first chunk ends at place 5
    assert line.done[6] == pytest.approx(0.3 * 16 + 0.7 * 26)
    only_new = ChunkQueue("ensemble", execution_horizon=3, old_weight=0)
    line = Line(6, offset=10.0)
    run(only_new, line, [0], 4)
    assert line.done[3] == 13


def late_chunk(name: str) -> tuple[ChunkQueue, Line, str | None]:
    """A second chunk that was told a delay of 1 and comes after 2."""
    queue, line = ChunkQueue(name, execution_horizon=3, delay=1), Line(8)
    run(queue, line, [0], 3)
    result = line.answer(queue.observe())
    assert line.requests[1].previous is not None and line.requests[1].previous.delay == 1
    for _ in range(2):
        assert queue.next_action() is not None
    return queue, line, queue.arrive(result)


def test_trained_drops_a_chunk_that_comes_later_than_it_was_told() -> None:
    queue, _, reason = late_chunk("rtc_trained")
    assert reason == "late" and queue.dropped == {"late": 1} and queue.chunks == 1
    assert "2 actions were carried out" in queue.last_problem and "told 1" in queue.last_problem
    action = queue.next_action()
    assert action is not None and action.chunk == 0 and action.row == 5  # the running chunk goes on
    assert queue.wants_observation


@pytest.mark.parametrize("name", ["rtc", "rtc_identity"])
def test_guided_enters_a_late_chunk_later_and_counts_it(name: str) -> None:
    queue, _, reason = late_chunk(name)
    assert reason is None and queue.late == 1 and not queue.dropped
    action = queue.next_action()
    assert action is not None and action.chunk == 1 and action.row == 2 and action.takes_over
    assert float(action.values[0]) == 5.0


def test_a_trained_checkpoint_whose_delays_are_all_too_long_goes_on_from_standstill() -> None:
    queue, line = (
        ChunkQueue("rtc_trained", execution_horizon=2, delay=DelayEstimate(), trained_max_delay=1),
        Line(4),
    )
    run(queue, line, [3], 60)
    assert queue.dropped["late"] and queue.cut_delays  # told 1 at most
    assert queue.chunks > 3  # as the robot stands still once it has no actions, and then needs no join
    assert line.done == [float(i) for i in range(len(line.done))]


def test_a_chunk_that_comes_after_its_last_action_is_dropped() -> None:
    queue, line = ChunkQueue("async", execution_horizon=1), Line(4)
    run(queue, line, [0], 1)
    result = line.answer(queue.observe(ago=1))
    for _ in range(3):
        queue.next_action()
    assert queue.arrive(result) == "used_up"
    assert "4 actions were carried out" in queue.last_problem


@pytest.mark.parametrize(
    ("result", "reason", "text"),
    [
        ({"actions": np.full((4, 1), np.nan)}, "not_finite", "NaN"),
        ({"actions": np.full((4, 1), np.inf)}, "not_finite", "NaN"),
        ({"actions": np.full((4, 1), -1.7e308)}, "not_finite", "beyond float32"),
        ({"state": 1}, "malformed", 'no "actions"; its keys: state'),
        (None, "malformed", "is None"),
        ({"actions": None}, "malformed", "NoneType"),
        ({"actions": "none"}, "malformed", "str"),
        ({"actions": np.zeros((0, 1))}, "malformed", "[0, 1]"),
        ({"actions": np.zeros(4)}, "malformed", "float64[4]"),
        ({"actions": [[1.0], [1.0, 2.0]]}, "malformed", "list"),
        ({"actions": np.zeros((4, 2))}, "malformed", "shape [4, 2]; those before had [4, 1]"),
        ({"actions": np.zeros((5, 1))}, "malformed", "shape [5, 1]; those before had [4, 1]"),
    ],
)
def test_what_is_no_chunk_is_refused_and_the_running_one_goes_on(
    result: dict[str, Any], reason: str, text: str
) -> None:
    queue, line = ChunkQueue("async", execution_horizon=1), Line(4)
    run(queue, line, [0], 1)
    queue.observe()
    assert queue.arrive(result) == reason
    assert text in queue.last_problem and queue.dropped == {reason: 1}
    action = queue.next_action()
    assert action is not None and float(action.values[0]) == 1.0 and action.chunk == 0


@pytest.mark.parametrize("name", RTC)
@pytest.mark.parametrize(
    ("model_actions", "text"),
    [(None, 'no "model_actions"'), (np.zeros((3, 2)), "float64[3, 2]"), (np.zeros(4), "[4]"), ("x", "str")],
)
def test_a_policy_that_gives_no_model_actions_is_told_so(name: str, model_actions: Any, text: str) -> None:
    queue = ChunkQueue(name)
    assert queue.observe().arguments == {"previous": None, "model_actions": True}
    result = {"actions": np.zeros((4, 1))}
    if model_actions is not None:
        result["model_actions"] = model_actions
    assert queue.arrive(result) == "malformed"
    assert text in queue.last_problem


@pytest.mark.parametrize(
    ("anchor", "reason", "text"),
    [
        ("x", "malformed", '"anchor" isn\'t an array of numbers but str'),
        ([[1.0], [2.0, 3.0]], "malformed", "but list"),
        (np.array([0.0, np.nan]), "not_finite", "NaN"),
    ],
)
def test_an_anchor_that_is_none_drops_the_chunk(anchor: Any, reason: str, text: str) -> None:
    queue = ChunkQueue("rtc")
    queue.observe()
    result = {"actions": np.zeros((4, 1)), "model_actions": np.zeros((4, 2)), "anchor": anchor}
    assert queue.arrive(result) == reason
    assert text in queue.last_problem and queue.next_action() is None


def test_ways_that_need_nothing_ask_nothing_of_the_policy() -> None:
    for name in ("sync", "async", "ensemble"):
        queue, line = ChunkQueue(name), Line(4)
        run(queue, line, [0], 10)
        assert all(request.arguments == {} for request in line.requests)


def test_a_jump_beyond_the_limit_refuses_the_chunk() -> None:
    queue, line = ChunkQueue("async", execution_horizon=2, max_jump=2.0), Line(6, offset=10.0)
    run(queue, line, [0], 6)
    assert line.done == [0, 1, 2, 3, 4, 5]  # the first chunk alone
    assert queue.dropped["jump"] >= 3
    assert "from the last command to its first action" in queue.last_problem
    assert "allows 2" in queue.last_problem


def test_a_jump_inside_a_chunk_counts_from_the_row_that_is_entered() -> None:
    queue, line = ChunkQueue("async", execution_horizon=1, max_jump=np.array([2.0])), Line(6)
    run(queue, line, [0], 1)
    jumping = line.answer(queue.observe())
    jumping["actions"][0] = -50.0  # passed already when it comes
    queue.next_action()
    assert queue.arrive(jumping) is None
    jumping = line.answer(queue.observe())
    jumping["actions"][:, 0] = [2, 3, 4, 9, 10, 11]
    assert queue.arrive(jumping) == "jump"
    assert "moves by 5 in one step, inside it" in queue.last_problem


def test_a_limit_of_infinity_lets_a_gripper_jump() -> None:
    queue = ChunkQueue("async", max_jump=np.array([1.0, np.inf]))
    queue.observe()
    assert queue.arrive({"actions": np.array([[0.0, -1.0], [0.5, 100.0]])}) is None
    wrong = ChunkQueue("async", max_jump=np.ones(3))
    wrong.observe()
    with pytest.raises(ConfigError, match="max_jump has 3 numbers, but the policy's actions have 2"):
        wrong.arrive({"actions": np.zeros((4, 2))})


def test_an_observation_of_some_actions_ago_counts_from_then() -> None:
    queue, line = ChunkQueue("rtc", execution_horizon=3, delay=2), Line(8)
    run(queue, line, [0], 4)
    assert queue.oldest_useful == 1  # the second chunk took over before the last action
    queue, line = ChunkQueue("rtc", execution_horizon=3, delay=2), Line(8)
    run(queue, line, [0], 3)
    assert queue.oldest_useful == 3
    request = queue.observe(ago=2)
    assert request.previous is not None and request.previous.left_over[0, 0] == 1  # of place 1
    line.requests.append(request)
    assert queue.arrive(Line.answer(line, request, ago=2)) is None
    assert queue.delays[-1] == 2
    action = queue.next_action()
    assert action is not None and action.row == 2 and float(action.values[0]) == 3.0


def test_an_observation_from_before_the_running_chunk_is_of_no_use() -> None:
    queue, line = ChunkQueue("rtc", execution_horizon=2, delay=1), Line(8)
    run(queue, line, [0], 2)
    with pytest.raises(ValueError, match="3 actions ago; at most 2"):
        queue.observe(ago=3)


def test_an_interruption_drops_what_runs_and_what_is_in_flight() -> None:
    queue, line = ChunkQueue("rtc", execution_horizon=2, delay=1), Line(8)
    run(queue, line, [0], 2)
    result = line.answer(queue.observe())
    queue.interrupt("clock_jump")
    assert queue.next_action() is None and not queue.wants_observation
    assert queue.arrive(result) == "clock_jump"
    assert queue.dropped == {"clock_jump": 2}
    assert queue.wants_observation and queue.observe().previous is None
    queue.fail("failed", "no answer")
    assert queue.last_problem == "failed: no answer" and queue.dropped["failed"] == 1


def test_a_new_episode_forgets_the_last_command() -> None:
    queue, line = ChunkQueue("async", execution_horizon=2, max_jump=2.0), Line(6)
    run(queue, line, [0], 3)
    queue.reset()
    line.place = 1000
    run(queue, line, [0], 2)
    assert line.done[-2:] == [1000, 1001]


@pytest.mark.parametrize(
    ("s", "d", "text"),
    [
        (20, 0, "execution horizon is 20, but the policy's chunks have 10"),
        (8, 3, "at most 2 here"),
        (3, 4, "at most 3 here"),
        (None, 6, "at most 5 here"),
    ],
)
def test_horizons_that_cannot_fit_are_an_error_with_the_numbers(s: int | None, d: int, text: str) -> None:
    queue = ChunkQueue("rtc", execution_horizon=s, delay=d)
    queue.observe()
    with pytest.raises(ConfigError, match=text):
        queue.arrive({"actions": np.zeros((10, 1)), "model_actions": np.zeros((10, 2))})


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"execution_horizon": 0}, "execution horizon is 0"),
        ({"execution_horizon": 2.5}, "execution horizon is 2.5"),
        ({"execution_horizon": True}, "execution horizon is True"),
        ({"delay": -1}, "a delay is -1"),
        ({"delay": 1.5}, "a delay is 1.5"),
        ({"old_weight": 1.5}, "old_weight is 1.5"),
        ({"max_jump": 0}, "max_jump is 0"),
        ({"max_jump": np.nan}, "max_jump is nan"),
        ({"max_jump": "much"}, "max_jump is 'much'"),
    ],
)
def test_settings_that_cannot_be_right_are_refused(options: dict[str, Any], text: str) -> None:
    with pytest.raises(ConfigError, match=text):
        ChunkQueue("async", **options)


def test_an_unknown_way_is_refused_with_those_there_are() -> None:
    with pytest.raises(
        ConfigError, match="execution='fast' is no way to run; choose one of sync, async, ensemble, rtc, rtc_ident"
    ):
        way_named("fast")


def test_a_checkpoint_is_not_told_a_longer_delay_than_it_was_trained_with() -> None:
    with pytest.raises(ConfigError, match=r"delay is 4 control steps, but .* trained with delays up to 3"):
        ChunkQueue("rtc_trained", delay=4, trained_max_delay=3)
    ChunkQueue("rtc", delay=4, trained_max_delay=3)  # the guided ways don't care


@given(
    delays=st.lists(st.integers(0, 50), min_size=1, max_size=30),
    window=st.integers(1, 10),
    percentile=st.floats(0, 100),
)
def test_the_expected_delay_is_one_of_the_last(delays: list[int], window: int, percentile: float) -> None:
    estimate = DelayEstimate(7, percentile=percentile, window=window)
    assert estimate.steps == 7
    for delay in delays:
        estimate.add(delay)
    last = delays[-window:]
    assert estimate.steps in last
    assert sum(delay <= estimate.steps for delay in last) >= len(last) * percentile / 100 - 1e-9


def test_the_largest_of_the_window_is_a_percentile_of_100() -> None:
    estimate = DelayEstimate(percentile=100, window=3)
    for delay in (9, 1, 2, 3):
        estimate.add(delay)
    assert estimate.steps == 3
    with pytest.raises(ConfigError, match="percentile is 101"):
        DelayEstimate(percentile=101)
    with pytest.raises(ConfigError, match="window is 0"):
        DelayEstimate(window=0)


def test_the_report_is_a_json_document() -> None:
    queue, line = ChunkQueue("rtc", execution_horizon=3, delay=DelayEstimate()), Line(8, offset=0.5)
    run(queue, line, [2, 3], 40)
    report = json.loads(json.dumps(queue.report()))
    assert report["chunks"] == queue.chunks and report["steps"] == 40
    assert report["seam_gaps"]["max"] == pytest.approx(0.5)
    assert report["delays"]["max"] == 3
    assert json.loads(json.dumps(ChunkQueue("sync").report()))["delays"] is None


def test_requests_hold_what_infer_takes() -> None:
    queue, line = ChunkQueue("rtc_identity", execution_horizon=3, schedule="linear", max_guidance_weight=10.0), Line(8)
    run(queue, line, [0], 4)
    previous = line.requests[1].arguments["previous"]
    assert isinstance(previous, RunningChunk)
    assert (previous.mode, previous.schedule, previous.max_guidance_weight) == ("rtc_identity", "linear", 10.0)
