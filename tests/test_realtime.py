"""The executor beside a robot: never late, never an old action as a new one, and every refusal counted."""

import json
import re
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure
from realtime_fakes import HZ, Clock, LinePolicy, Loop, started

from turbopi.realtime import WAYS, OutOfActions, RealTimeExecutor
from turbopi.realtime.messages import NOTES
from turbopi.support.errors import ConfigError, ObservationError

RTC = [name for name, way in WAYS.items() if way.mode is not None]


def kinds(loop: Loop) -> str:
    """One letter a command: fresh, slowed, held, waiting."""
    return "".join(command.kind[0] for command in loop.commands)


# --- the ways to run --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("execution", [name for name in WAYS if name != "sync"])
def test_the_robot_never_waits_for_a_policy_that_is_as_fast_as_expected(execution: str) -> None:
    loop, policy = started(execution, seconds=2 / HZ, execution_horizon=4)
    policy.seconds = 0.0
    loop.run(60, delay=2)
    assert kinds(loop) == "ww" + "f" * 58  # `Loop` checks that none is repeated or left out
    report = loop.executor.report()
    assert report["delays"]["max"] == report["delays"]["median"] == report["expected_delay"] == 2
    assert not report["dropped"] and not report["late"]
    reported = [call["previous"] for call in policy.calls]
    assert reported[0] is None
    if execution in RTC:
        for previous in reported[1:]:
            assert (previous.delay, previous.execution_horizon, previous.mode) == (2, 4, execution)
            assert len(previous.left_over) == 6
    else:
        assert reported == [None] * len(reported) and not any(call["model_actions"] for call in policy.calls)


def test_an_observation_is_wanted_from_the_execution_horizon_until_the_chunk_is_there() -> None:
    loop, policy = started("async", execution_horizon=4)
    assert loop.executor.wants_observation
    wanted = []
    for _ in range(10):
        loop.step(delay=2)
        wanted.append(loop.executor.wants_observation)
    #                  the first chunk is there after 2 steps; its rows 0 to 3; the second one is computed; rows 2 and 3
    assert wanted == [True, True, *[False] * 3, True, True, True, False, True]
    assert len(policy.calls) == 2
    cold, _ = started("async", warm=False)
    assert cold.executor.wants_observation  # to warm up with


def test_each_chunk_and_each_seam_can_be_looked_up() -> None:
    loop, _ = started("rtc", execution_horizon=4)
    loop.run(20, delay=2)
    inferred, seams = loop.executor.inferred, loop.executor.seams
    assert [(one.chunk, one.begun, one.ended, one.outcome) for one in inferred[:3]] == [
        *((0, 0, 2, "used"), (1, 6, 8, "used"), (2, 10, 12, "used")),
    ]
    assert [(seam.chunk, seam.step, seam.delay, seam.reported) for seam in seams[:2]] == [(1, 8, 2, 2), (2, 12, 2, 2)]
    inferred[0].outcome = "changed"
    assert loop.executor.inferred[0].outcome == "used"


def test_sync_holds_while_the_policy_thinks() -> None:
    loop, _ = started("sync", execution_horizon=3, hold_action="last")
    loop.run(20, delay=2)
    assert kinds(loop)[:17] == "wwfffhhfffhhfffhh"
    held = loop.commands[5]
    assert held.action is not None and held.action[0] == 2.0 and held.remaining == 0


def test_a_rising_delay_is_learnt() -> None:
    loop, policy = started("rtc", execution_horizon=5, delay_window=3)
    loop.run(40, delay=1)
    loop.run(40, delay=3)
    report = loop.executor.report()
    assert report["expected_delay"] == 3 and report["late"] >= 1
    assert policy.calls[-1]["previous"].delay == 3


def test_trained_drops_what_comes_later_than_told() -> None:
    loop, _ = started("rtc_trained", execution_horizon=4)
    loop.run(30, delay=0)
    loop.run(6, delay=2)
    report = loop.executor.report()
    assert report["dropped"] == {"late": 1}
    assert report["last_problem"].startswith("late: 2 actions were carried out")


# --- the warm-up ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("execution", ["async", "rtc"])
def test_the_warm_up_never_counts_as_a_delay_but_its_last_calls_are_expected(execution: str) -> None:
    loop, policy = started(execution, seconds=3 / HZ, execution_horizon=4)
    report = loop.executor.report()
    assert report["delays"] is None and report["expected_delay"] == 3 and report["chunks"] == 0
    assert report["warm_up_seconds"] == pytest.approx((5 if execution == "async" else 4 + 1) * 3 / HZ, rel=0.5)
    assert not policy.calls  # the chunks of the warm-up are nobody's


def test_a_slow_first_call_is_not_expected_again() -> None:
    loop, policy = started("rtc", warm=False, execution_horizon=4)
    slow = [30.0, 10.0]

    def change(result: dict[str, Any]) -> dict[str, Any]:
        policy.clock.now += slow.pop(0) if slow else 1 / HZ
        return result

    policy.change = change
    loop.hand.at_once = True
    assert loop.executor.warm_up({"place": 0}) > 40
    assert loop.executor.report()["expected_delay"] == 1
    reported = [call["previous"] for call in policy.calls]
    assert reported[0] is None and all(
        previous.execution_horizon == 4 for previous in reported[1:]
    )  # both ways are warm


@pytest.mark.parametrize("execution", ["paint", "rtc_trained"])
def test_a_mode_that_costs_nothing_without_a_delay_is_timed_with_one(execution: str) -> None:
    loop, policy = started(execution, warm=False, execution_horizon=4)

    def slow(result: dict[str, Any]) -> dict[str, Any]:
        previous = policy.calls[-1]["previous"]
        policy.clock.now += (3 if previous is not None and previous.delay else 1) / HZ
        return result

    policy.change = slow
    loop.hand.at_once = True
    loop.executor.warm_up({"place": 0})
    assert loop.executor.report()["expected_delay"] == 3


def test_without_a_warm_up_the_first_observation_warms_up_in_the_background() -> None:
    loop, policy = started("async", warm=False)
    loop.step()
    loop.step()
    assert kinds(loop) == "ww" and len(loop.hand.waiting) == 1
    loop.step(answer=True)
    assert [call["obs"]["place"] for call in policy.calls] == [0.0] * 3
    loop.step(answer=True)
    assert kinds(loop) == "wwwf" and loop.executor.report()["observations"]["warm-up"] == 2


def test_the_policys_own_warm_up_is_called_first() -> None:
    loop, policy = started("async", warm=False)
    called: list[int] = []
    policy.warmup = lambda: called.append(len(policy.calls))  # type: ignore[attr-defined]
    loop.hand.at_once = True
    loop.executor.warm_up({"place": 0})
    assert called == [0]


@pytest.mark.parametrize(
    ("execution", "seconds", "text"),
    [
        ("rtc", 6 / HZ, "120 ms, 6 control steps at 50 Hz: with chunks of 10 actions and an execution horizon of 5"),
        ("rtc_trained", 5 / HZ, "trained with delays up to 4"),
        ("async", 1.5, "max_observation_age_s is 1. Raise it, or choose fewer denoising steps"),
    ],
)
def test_a_policy_that_is_too_slow_is_refused_before_the_robot_moves(execution: str, seconds: float, text: str) -> None:
    with pytest.raises(ConfigError, match=text):
        started(execution, seconds=seconds)


@pytest.mark.parametrize(
    ("execution", "steps", "text"),
    [
        ("sync", 20, None),
        ("async", 5, None),
        ("async", 6, "6 control steps at 50 Hz, but chunks of 10 actions have only 5 left.*at most 4, or a lower"),
        ("ensemble", 20, "no action at the end of each chunk. Choose a lower control_hz"),
    ],
)
def test_a_warm_up_warns_of_a_robot_that_will_run_out_of_actions(
    execution: str, steps: int, text: str | None, caplog: pytest.LogCaptureFixture
) -> None:
    started(execution, seconds=steps / HZ)
    assert bool(caplog.messages) == (text is not None)
    assert text is None or re.search(text, caplog.messages[0])


def test_what_a_background_warm_up_finds_stops_the_control_loop() -> None:
    loop, _ = started("rtc", warm=False, seconds=6 / HZ)
    loop.step()
    loop.hand.answer()
    with pytest.raises(ConfigError, match="joins chunks up to a delay of 5"):
        loop.executor.next_action()


def test_a_background_warm_up_that_fails_is_tried_again() -> None:
    loop, policy = started("async", warm=False)
    policy.error = ObservationError("a camera is missing")
    loop.step()
    loop.step(answer=True)
    assert "a camera is missing" in loop.executor.report()["last_error"]
    policy.error = None
    loop.run(3, delay=0)
    assert kinds(loop)[-1] == "f"


def test_a_server_that_keeps_the_running_chunk_is_told_what_it_must_know() -> None:
    loop, policy = started("async", warm=False, execution_horizon=4)
    policy.metadata["real_time"]["execution"] = "rtc"
    executor = RealTimeExecutor(
        policy, control_hz=HZ, execution="async", execution_horizon=4, clock=loop.clock, inference=loop.hand
    )
    loop = Loop(executor, loop.clock, loop.hand)
    loop.hand.at_once = True
    executor.warm_up({"place": 0})
    loop.hand.at_once = False
    assert [call["obs"].get("turbopi/reset") for call in policy.calls] == [True] * 3
    policy.calls.clear()
    loop.run(20, delay=1)
    reported = [{key: value for key, value in call["obs"].items() if key != "place"} for call in policy.calls]
    own = {"turbopi/execution_horizon": 4}
    assert reported[0] == {"turbopi/reset": True, "turbopi/step": 0, "turbopi/delay": 0, **own}
    assert reported[1] == {"turbopi/reset": False, "turbopi/step": 4, "turbopi/delay": 1, **own}
    loop.run(12, delay=9)  # longer than fits: H − s = 6
    loop.run(6, delay=0)
    assert executor.report()["expected_delay"] == 9
    assert policy.calls[-1]["obs"]["turbopi/delay"] <= 6
    policy.change = lambda result: {"actions": result["actions"] * np.nan}  # a chunk that the robot never carries out
    loop.run(9, delay=0)
    assert policy.calls[-1]["obs"]["turbopi/reset"] is True
    policy.change = lambda result: result
    assert all(call["obs"]["place"] == call["obs"]["turbopi/step"] for call in policy.calls)
    executor.reset()
    policy.calls.clear()
    loop.run(1, delay=0)
    assert policy.calls[-1]["obs"]["turbopi/reset"] is True


# --- a policy in trouble ----------------------------------------------------------------------------------------------


def test_the_robot_runs_out_of_actions_at_a_known_time() -> None:
    loop, _ = started("async", execution_horizon=4)
    loop.run(6, delay=0)  # the second chunk took over at step 4
    assert loop.executor.remaining == 8
    loop.run(12, delay=10**6)  # from here on the policy is silent
    assert kinds(loop)[6:] == "f" * 8 + "h" * 4
    assert [command.remaining for command in loop.commands[6:]] == [*range(7, -1, -1), 0, 0, 0, 0]


def test_an_answer_after_the_robot_stood_still_goes_on_where_it_stands() -> None:
    loop, _ = started("rtc", execution_horizon=4)
    loop.run(6, delay=0)
    loop.run(12, delay=10**6)
    assert kinds(loop).endswith("hhhh")
    loop.step(answer=True)  # `Loop` checks its place: six actions were carried out since the observation, then none
    assert kinds(loop).endswith("hf")
    assert loop.executor.report()["late"] == 1


@pytest.mark.parametrize(
    ("hold_action", "expected"),
    [
        (None, None),
        ("last", [13.0]),
        (np.array([0.0]), [0.0]),
        (np.array([np.nan]), [13.0]),
    ],
)
def test_holding_commands_what_was_chosen_and_says_that_it_holds(
    hold_action: Any, expected: list[float] | None
) -> None:
    loop, _ = started("async", execution_horizon=4, hold_action=hold_action)
    loop.run(6, delay=0)
    loop.run(9, delay=10**6)
    command = loop.commands[-1]
    assert command.kind == "held" and command.chunk is None
    assert (None if command.action is None else list(command.action)) == expected


def test_slowing_down_makes_the_last_actions_last_twice_as_long() -> None:
    loop, _ = started("async", execution_horizon=4, on_empty="slow_down")
    loop.run(8, delay=0)
    loop.run(20, delay=10**6)
    assert kinds(loop)[8:] == "ffsfsfsfhhhhhhhhhhhh" or kinds(loop)[8:].startswith("ff" + "sf" * 4 + "h")
    slowed = next(command for command in loop.commands if command.kind == "slowed")
    place = loop.commands[loop.commands.index(slowed) - 1].action
    assert slowed.action is not None and place is not None and slowed.action[0] == place[0] + 0.5
    assert loop.commands[-1].action is not None  # positions: it holds the last one


def test_raising_says_why_there_is_no_action() -> None:
    loop, _ = started("async", execution_horizon=4, on_empty="raise")
    loop.run(6, delay=0)
    loop.run(8, delay=10**6)
    with pytest.raises(OutOfActions, match="no action for control step 14: the policy has been computing for 7"):
        loop.step()


def test_raising_names_the_policys_own_error() -> None:
    loop, policy = started("async", execution_horizon=4, on_empty="raise")
    loop.run(6, delay=0)
    policy.error = RuntimeError("CUDA error")
    loop.run(8, delay=0)
    with pytest.raises(OutOfActions, match="failed: RuntimeError: CUDA error") as caught:
        loop.run(2, delay=0)
    assert isinstance(caught.value.__cause__, RuntimeError)


def test_raising_is_patient_with_sync_for_as_long_as_its_answer_would_count() -> None:
    loop, _ = started("sync", execution_horizon=2, on_empty="raise", max_observation_age_s=0.2)
    loop.run(10, delay=3)
    with pytest.raises(OutOfActions):
        loop.run(20, delay=10**6)
    assert kinds(loop).endswith("h" * 10)


@pytest.mark.parametrize("execution", ["sync", "async"])
def test_raising_ends_the_wait_for_a_policy_that_fails_at_once_again_and_again(execution: str) -> None:
    loop, policy = started(execution, execution_horizon=2, on_empty="raise", max_observation_age_s=0.2)
    policy.error = RuntimeError("the server is lost")
    with pytest.raises(OutOfActions, match="failed: RuntimeError: the server is lost"):
        loop.run(20, delay=0)
    assert kinds(loop) == "w" * 11
    loop.executor.reset()
    policy.error = None
    loop.run(6, delay=0)  # of which 2 are of each chunk
    policy.error = RuntimeError("lost again")
    loop.run(2, delay=0)
    with pytest.raises(OutOfActions, match="lost again"):
        loop.run(20, delay=0)
    assert set(kinds(loop)[11:]) <= set("wfh") and kinds(loop).endswith("h" * 10 if execution == "sync" else "f")


def test_raising_is_patient_with_the_first_warm_up_until_that_fails() -> None:
    loop, policy = started("async", warm=False, on_empty="raise", max_observation_age_s=0.2)
    for _ in range(50):
        loop.step()  # it compiles
    policy.error = RuntimeError("no such server")
    loop.hand.answer()
    with pytest.raises(OutOfActions, match=r"the warm-up failed .*no such server"):
        loop.step()
    policy.error = None
    loop.executor.observe({"place": 0})
    loop.hand.answer()
    assert loop.step().kind == "waiting"  # warm: the first chunk has its time
    assert loop.step(answer=True).kind == "fresh"


def test_raising_when_a_sync_robot_gets_no_observation() -> None:
    loop, _ = started("sync", execution_horizon=2, on_empty="raise", max_observation_age_s=0.2)
    loop.run(3, delay=0)
    for _ in range(loop.executor.remaining + 11):  # the actions that are left, and as long as it is patient
        loop.step(observe=False)
    with pytest.raises(OutOfActions, match="no observation came in time"):
        loop.step(observe=False)


def test_raising_when_no_observation_comes() -> None:
    loop, _ = started("async", execution_horizon=4, on_empty="raise")
    loop.run(6, delay=0)
    while loop.executor.remaining:
        loop.step(observe=False)
    with pytest.raises(OutOfActions, match="no observation came in time"):
        loop.step(observe=False)


def test_a_policy_that_raises_is_asked_again_and_the_running_chunk_goes_on() -> None:
    loop, policy = started("rtc", execution_horizon=4)
    loop.run(6, delay=0)
    policy.error = ObservationError("the state has 7 numbers, expected 8")
    loop.run(4, delay=0)
    policy.error = None
    loop.run(10, delay=0)
    report = loop.executor.report()
    assert set(kinds(loop)[1:]) == {"f"} and report["dropped"]["failed"] >= 1
    assert report["last_error"] == "ObservationError: the state has 7 numbers, expected 8"


def test_the_log_says_that_the_policy_fails_that_the_robot_holds_and_that_both_are_over(
    caplog: pytest.LogCaptureFixture,
) -> None:
    loop, policy = started("rtc", execution_horizon=4)
    loop.run(6, delay=0)
    for _ in range(2):  # the same failure a second time is a new one
        caplog.clear()
        policy.error = ConnectionError("no server")
        loop.run(40, delay=0)  # 0.8 s, of which the running chunk covers less than 0.2
        policy.error = None
        loop.run(2, delay=0)
        assert caplog.messages == [
            "the policy failed: ConnectionError: no server",
            "the robot holds: the last chunk was dropped (failed: ConnectionError: no server)",
            "the policy answers again",
            caplog.messages[-1],
        ]
        after = re.fullmatch(r"the robot moves again, after (0\.\d) s", caplog.messages[-1])
        assert after is not None and 0.5 < float(after[1]) <= 0.8
        loop.run(6, delay=0)


def test_a_chunk_with_nan_is_refused_and_counted() -> None:
    loop, policy = started("async", execution_horizon=4)
    loop.run(6, delay=0)

    def poisoned(result: dict[str, Any]) -> dict[str, Any]:
        result["actions"][3] = np.nan
        return result

    policy.change = poisoned
    loop.run(20, delay=0)
    assert loop.executor.report()["dropped"]["not_finite"] >= 1
    assert all(np.isfinite(command.action).all() for command in loop.commands if command.action is not None)


class OnGpu:
    def __array__(self, *_: Any, **__: Any) -> np.ndarray:
        raise TypeError("can't convert cuda:0 device type tensor to numpy")


@pytest.mark.parametrize(
    "result", [None, {}, [], {"actions": "no"}, {"actions": np.zeros((3, 1))}, {"actions": OnGpu()}]
)
def test_an_answer_that_is_no_chunk_is_refused(result: Any) -> None:
    loop, policy = started("async", execution_horizon=4)
    loop.run(6, delay=0)
    policy.change = lambda _: result
    loop.run(20, delay=0)
    assert set(loop.executor.report()["dropped"]) == {"malformed"} and kinds(loop)[-1] == "h"


def test_a_jump_beyond_the_limit_is_refused_and_counted() -> None:
    loop, policy = started("async", execution_horizon=4, max_jump=1.5)
    loop.run(6, delay=0)
    policy.change = lambda result: {"actions": result["actions"] + 5}
    loop.run(12, delay=0)
    assert loop.executor.report()["dropped"]["jump"] >= 1 and kinds(loop)[-1] == "h"


def test_a_chunk_with_a_note_that_holds_is_dropped_and_others_are_not() -> None:
    loop, policy = started("sync", hold_on=["camera_black"])
    notes = [{"kind": "camera_size", "names": ["front"], "text": "it has another size"}]
    policy.change = lambda result: result | {NOTES: notes}
    loop.run(6, delay=0)
    assert loop.executor.report()["dropped"] == {} and kinds(loop)[-1] == "f"
    notes.append({"kind": "camera_black", "names": ["front"], "text": "camera front is black"})
    loop.run(24, delay=0)
    assert kinds(loop)[-1] == "h"
    report = loop.executor.report()
    assert report["dropped"]["noted"] >= 1 and {one["kind"] for one in report["notes"]} == {
        "camera_size",
        "camera_black",
    }
    notes.pop()
    loop.run(12, delay=0)
    assert kinds(loop)[-1] == "f"


@pytest.mark.parametrize("wrong", ["camera_black", ["camera_blak"], 3])
def test_kinds_of_notes_that_are_none_are_refused(wrong: Any) -> None:
    with pytest.raises(ConfigError, match=r"hold_on has .*; it should be a list of some of state_range, "):
        started("async", hold_on=wrong)


# --- time -------------------------------------------------------------------------------------------------------------


def test_stale_observations_and_those_from_the_future_are_refused() -> None:
    loop, policy = started("async", max_observation_age_s=0.3)
    executor, clock = loop.executor, loop.clock
    assert not executor.observe({"place": 0}, taken_at=clock.now - 0.31)
    assert not executor.observe({"place": 0}, taken_at=clock.now + 5)
    assert not executor.observe({"place": 0}, taken_at=float("nan"))
    assert not loop.hand.waiting
    assert executor.observe({"place": 0}, taken_at=clock.now - 0.29)
    seen = executor.report()["observations"]
    assert (seen["stale"], seen["from the future"], seen["used"], seen["given"]) == (2, 1, 1, 4)
    assert policy.calls == []


def test_a_chunk_whose_observation_has_become_stale_is_refused() -> None:
    loop, _ = started("async", execution_horizon=4, max_observation_age_s=0.2)
    loop.run(6, delay=0)
    loop.run(16, delay=10**6)
    assert kinds(loop)[-1] == "h"
    loop.step(answer=True)
    assert kinds(loop)[-1] == "h" and loop.executor.report()["dropped"] == {"stale": 1}


def test_an_older_observation_counts_the_actions_since() -> None:
    loop, policy = started("rtc", execution_horizon=4)
    loop.run(4, delay=0)
    taken, place = loop.clock.now - 1.5 / HZ, loop.place - 1  # one action was given out since
    loop.place, here = place, loop.place
    assert loop.executor.observe({"place": loop.place}, taken_at=taken)
    loop.place = here
    assert policy.calls[:1] and len(loop.hand.waiting) == 1
    loop.step(observe=False, answer=True)  # `Loop` checks the place
    assert policy.calls[-1]["previous"].left_over[0, 0] == place


def test_an_observation_from_before_the_running_chunk_waits_for_a_newer_one() -> None:
    loop, _ = started("async", execution_horizon=1)
    loop.run(3, delay=0)
    assert not loop.executor.observe({"place": 0}, taken_at=loop.clock.now - 2.5 / HZ)
    assert loop.executor.report()["observations"]["before the running chunk"] == 1


@pytest.mark.parametrize("jump", [0.7, -0.01])
def test_a_jump_of_the_clock_drops_all_actions(jump: float) -> None:
    loop, _ = started("async", execution_horizon=4)
    loop.run(6, delay=0)
    loop.clock.now += jump - 1 / HZ
    command = loop.step(observe=False)
    assert command.kind == "held"
    report = loop.executor.report()
    assert report["clock_jumps"] == 1 and report["dropped"] == {"clock_jump": 1}
    loop.step()
    loop.step(answer=True)
    assert kinds(loop)[-1] == "f"


@pytest.mark.parametrize("jump", [600.0, -600.0])
def test_after_a_jump_of_the_clock_observations_are_used_again(jump: float) -> None:
    loop, _ = started("async", execution_horizon=4)
    executor, clock = loop.executor, loop.clock
    for steps in (20, 20):
        for _ in range(steps):
            executor.observe({"place": loop.place}, taken_at=clock.now)
            loop.step(observe=False, answer=bool(loop.hand.waiting))
        fresh, clock.now = executor.report()["commands"]["fresh"], clock.now + jump
    assert fresh >= 36 and executor.report()["clock_jumps"] == 1


@pytest.mark.parametrize("event", ["reset", "clock jump"])
def test_an_observation_from_before_a_reset_or_a_jump_of_the_clock_waits_for_a_newer_one(event: str) -> None:
    loop, _ = started("async", execution_horizon=4)
    loop.run(6, delay=0)
    executor, clock, taken, place = loop.executor, loop.clock, loop.clock.now - 2.5 / HZ, loop.place - 2
    if event == "reset":
        executor.reset()
    else:
        clock.now += 0.7
        loop.step(observe=False)
    # It is young enough. Its chunk would be entered at row 0, and carry out again what came after it.
    assert not executor.observe({"place": place}, taken_at=taken) and not loop.hand.waiting
    assert executor.report()["observations"]["before it began anew"] == 1
    assert executor.observe({"place": loop.place}, taken_at=clock.now)
    loop.step(observe=False, answer=True)  # `Loop` checks the place
    assert kinds(loop)[-1] == "f"


def test_a_new_episode_drops_the_old_ones_chunks() -> None:
    loop, _ = started("rtc", execution_horizon=4)
    loop.run(4, delay=0)
    loop.step()
    loop.executor.reset()
    loop.place = 500.0
    loop.clock.now += 60
    loop.step(answer=True)  # the old episode's answer
    loop.step(answer=True) if loop.hand.waiting else loop.step()
    loop.run(3, delay=0)
    report = loop.executor.report()
    assert report["dropped"]["reset"] >= 1 and report["clock_jumps"] == 0
    assert kinds(loop)[5] == "w" and loop.place > 500


# --- threads ----------------------------------------------------------------------------------------------------------


class Gated:
    """A policy that computes until its gate is opened."""

    def __init__(self) -> None:
        self.metadata: dict[str, Any] = {}
        self.gate, self.entered = threading.Event(), threading.Event()
        self.gate.set()
        self.threads: set[int] = set()

    def infer(self, obs: Any) -> dict[str, Any]:
        self.threads.add(threading.get_ident())
        self.entered.set()
        assert self.gate.wait(60)
        return {"actions": np.zeros((4, 2))}


def test_no_call_of_the_control_loop_waits_for_the_policy() -> None:
    policy = Gated()
    with RealTimeExecutor(
        policy, control_hz=50, execution="async", max_pause_s=1e6, max_observation_age_s=1e6
    ) as executor:
        executor.warm_up({})
        policy.gate.clear()
        policy.entered.clear()
        assert executor.observe({})
        assert policy.entered.wait(60)
        assert executor.next_action().kind == "waiting"  # while the policy is inside
        assert not executor.observe({})
        future = executor._pending[0] if executor._pending else None
        assert future is not None and not future.done()
        policy.gate.set()
        future.result(60)
        assert executor.next_action().kind == "fresh"
        assert policy.threads == {executor._inference._thread.ident}  # type: ignore[attr-defined]


def test_closing_does_not_wait_for_ever_for_a_policy_that_hangs() -> None:
    policy = Gated()
    executor = RealTimeExecutor(policy, control_hz=50, execution="async")
    executor.warm_up({})
    policy.gate.clear()
    executor.observe({})
    assert executor.close(timeout_s=0.01) is False
    policy.gate.set()
    with pytest.raises(ConfigError, match="closed"):
        executor.next_action()
    with pytest.raises(ConfigError, match="closed"):
        executor.observe({})


def test_a_process_ends_though_the_policy_hangs() -> None:
    code = """
import threading
from turbopi.realtime import RealTimeExecutor
class Hanging:
    calls = 0
    def infer(self, obs):
        self.calls += 1
        if self.calls > 3:
            threading.Event().wait()
        return {"actions": [[0.0]] * 4}
with RealTimeExecutor(Hanging(), control_hz=50, execution="async") as executor:
    executor.warm_up({})
    executor.observe({})
    print(executor.next_action().kind)
    executor.close(0.01)
    executor.close = lambda: None
"""
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert (ended.stdout, ended.returncode) == ("waiting\n", 0), ended.stderr


def test_the_policy_may_exit_without_ending_the_robot() -> None:
    policy = Gated()
    with RealTimeExecutor(policy, control_hz=50, execution="async", max_pause_s=1e6) as executor:
        executor.warm_up({})
        policy.infer = lambda obs: sys.exit(3)  # type: ignore[method-assign]
        executor.observe({})
        assert executor._pending is not None
        with pytest.raises(SystemExit):
            executor._pending[0].result(60)
        assert executor.next_action().kind == "waiting"
        assert executor.report()["last_error"] == "SystemExit: 3"


# --- what is refused at the start -------------------------------------------------------------------------------------


class OpenpiClient:
    """As openpi's WebsocketClientPolicy: no argument but the observation."""

    def get_server_metadata(self) -> dict[str, Any]:
        return {"real_time": {"modes": ["rtc"]}}

    def infer(self, obs: dict[str, Any]) -> dict[str, Any]:
        return {"actions": np.zeros((4, 2))}


@pytest.mark.parametrize("execution", list(WAYS))
def test_openpis_client_runs_what_needs_nothing_of_the_model(execution: str) -> None:
    if execution in RTC:
        with pytest.raises(ConfigError, match=r"OpenpiClient.infer doesn't take: .*RealTimeClient.*'sync', 'async'"):
            RealTimeExecutor(OpenpiClient(), control_hz=50, execution=execution)  # type: ignore[arg-type]
    else:
        RealTimeExecutor(OpenpiClient(), control_hz=50, execution=execution).close()  # type: ignore[arg-type]


@pytest.mark.parametrize("execution", RTC)
def test_a_way_that_the_policy_does_not_offer_is_refused(execution: str) -> None:
    with pytest.raises(ConfigError, match="offers no real-time modes"):
        started(execution, modes=())
    others = tuple(name for name in RTC if name != execution)
    hint = "trained_max_delay" if execution == "rtc_trained" else "execution 'sync', 'async'"
    offered = f"{execution}' isn't offered by this policy, which offers {', '.join(others)}; .*{hint}"
    with pytest.raises(ConfigError, match=offered):
        started(execution, modes=others)


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"control_hz": 0}, "control_hz is 0"),
        ({"control_hz": float("nan")}, "control_hz is nan"),
        ({"control_hz": 1e9}, "at most 10000"),
        ({"execution": "fast"}, "execution='fast' is no way to run"),
        ({"execution_horizon": 0}, "execution horizon is 0"),
        ({"on_empty": "stop"}, "on_empty is 'stop'; choose one of hold, slow_down, raise"),
        ({"hold_action": "first"}, "hold_action is 'first'"),
        ({"hold_action": [[1.0]]}, "hold_action"),
        ({"max_observation_age_s": -1}, "max_observation_age_s is -1"),
        ({"max_pause_s": 0}, "max_pause_s is 0"),
        ({"max_jump": -1}, "max_jump is -1"),
        ({"delay_percentile": 101}, "percentile is 101"),
        ({"delay_percentile": "x"}, "percentile is 'x'; it should be a number from 0 to 100"),
        ({"delay_window": 2.5}, "window is 2.5; it should be a whole number of delays, from 1"),
        ({"old_weight": None}, "old_weight is None; it should be a number from 0 to 1"),
        ({"schedule": "steep"}, "schedule is 'steep'; expected one of"),
        ({"schedule": "ones"}, "schedule say how rtc and rtc_identity guide; async doesn't guide: leave them out"),
        ({"max_guidance_weight": float("nan")}, "max_guidance_weight is nan; expected 0 to 1e6"),
        ({"infer_arguments": 5}, "infer_arguments is 5; it should be a mapping"),
        ({"execution": ["rtc"]}, r"execution=\['rtc'\] is no way to run; choose one of"),
        ({"policy": object()}, "object is no policy"),
    ],
)
def test_options_that_cannot_be_right_are_refused(options: dict[str, Any], text: str) -> None:
    given: dict[str, Any] = {"policy": LinePolicy(Clock()), "control_hz": 50, "execution": "async", **options}
    with pytest.raises(ConfigError, match=text):
        RealTimeExecutor(given.pop("policy"), **given)


def test_a_policy_with_memory_is_warned_of_as_its_history_would_lack_observations(
    caplog: pytest.LogCaptureFixture,
) -> None:
    policy = Gated()
    for metadata, warnings in (({}, 0), ({"memory": {"visual": 4}}, 1)):
        policy.metadata = metadata
        RealTimeExecutor(policy, control_hz=50, execution="async").close()
        assert sum("this policy has memory" in one.message for one in caplog.records) == warnings


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"execution_horizon": 11}, "execution horizon is 11, but the policy's chunks have 10"),
        ({"hold_action": np.zeros(3)}, "hold_action has 3 numbers, but the policy's actions have 1"),
        ({"max_jump": np.ones(3)}, "max_jump has 3 numbers, but the policy's actions have 1"),
    ],
)
def test_what_does_not_fit_the_policys_chunks_is_refused_by_the_warm_up(options: dict[str, Any], text: str) -> None:
    with pytest.raises(ConfigError, match=text):
        started("async", **options)


# --- the report -------------------------------------------------------------------------------------------------------


def test_the_report_is_a_json_document_of_what_happened() -> None:
    loop, _ = started("rtc", execution_horizon=4, infer_arguments={"num_steps": 5})
    loop.run(30, delay=2)
    report = json.loads(json.dumps(loop.executor.report()))
    assert report["execution"] == "rtc" and report["control_hz"] == 50
    assert report["commands"] == {"fresh": 28, "waiting": 2}
    assert report["chunks"] == report["delays"]["count"] == 7
    assert report["seam_jumps"] == {"count": 6, "mean": 1.0, "median": 1.0, "p95": 1.0, "max": 1.0}
    assert report["latency_ms"]["max"] == 0


def test_the_plot_has_a_row_for_each_dimension_and_one_for_the_delays(tmp_path: Path, drawn: list[Figure]) -> None:
    loop, _ = started("async", execution_horizon=4)
    loop.run(20, delay=2)
    loop.run(20, delay=10**6)
    loop.executor.report(plot=tmp_path / "run.png")
    assert (tmp_path / "run.png").read_bytes()[:4] == b"\x89PNG"
    command, delays = drawn[0].axes
    chunks = [c for c in loop.commands if c.takes_over]
    assert len([line for line in command.lines if line.get_linestyle() == ":"]) == len(chunks)
    assert len(delays.collections) == len(chunks) + 1  # one is in flight
    line = command.lines[0].get_ydata()
    fresh = [c.action[0] if c.action is not None else np.nan for c in loop.commands]
    np.testing.assert_array_equal(np.asarray(line, dtype=float), fresh)


def test_a_plot_of_nothing_is_a_plot(tmp_path: Path) -> None:
    loop, _ = started("sync")
    loop.executor.report(plot=tmp_path / "empty.png")
    with pytest.raises(ConfigError, match="can't write the plot"):
        loop.executor.report(plot=tmp_path / "empty.tiff2")


def test_a_robots_computer_needs_numpy_alone() -> None:
    code = """
import sys
class Refuse:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in BLOCKED:
            raise ImportError(f"{name} isn't installed here")
BLOCKED = {"torch", "msgspec", "msgpack", "websockets", "matplotlib", "safetensors", "PIL", "typer", "rich",
           "sentencepiece", "tensorstore", "jinja2", "psutil", "packaging", "prometheus_client"}
sys.meta_path.insert(0, Refuse())
import turbopi.realtime, turbopi.realtime
policy = type("Policy", (), {"infer": lambda self, obs: {}})()
turbopi.realtime.RealTimeExecutor(policy, control_hz=50, execution="async").close()
print(sorted(BLOCKED & set(sys.modules)))
"""
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert (ended.stdout, ended.returncode) == ("[]\n", 0), ended.stderr
