"""Real-time execution over the wire: what clients may ask, sessions, and a server that survives all of it."""

import asyncio
import io
import json
import os
import platform
import subprocess
import sys
import threading
from collections.abc import Iterator, Mapping
from http.client import HTTPConnection
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
from prometheus_client.parser import text_string_to_metric_families
from rich.console import Console
from serve_fakes import FakePolicy, http_get
from websockets.sync.client import connect

from turbopi import UnifiedPolicy
from turbopi.checkpoint import random_checkpoint
from turbopi.realtime import ChunkQueue, RealTimeExecutor
from turbopi.realtime.client import RealTimeClient, ServerLost, ServerRefused
from turbopi.realtime.messages import KEYS, message, read_message
from turbopi.realtime.running_chunk import JoinMode, RunningChunk
from turbopi.realtime.wire import pack, unpack
from turbopi.recordings import iter_recording
from turbopi.serve import PolicyServer, ServerOptions, run, running
from turbopi.serve import real_time as sessions_module
from turbopi.serve.metrics import Metrics
from turbopi.serve.options import JOINING
from turbopi.serve.real_time import RealTime
from turbopi.support.errors import ActionError, ConfigError, ObservationError

pytestmark = pytest.mark.usefixtures("two_layers")

H, A = 10, 3
REAL_TIME = {"modes": ["rtc", "rtc_identity", "rtc_trained"], "trained_max_delay": 2, "execution_horizon": None}


class Joins:
    """A policy that joins chunks: row i of a chunk is the observation's place + i."""

    def __init__(self, modes: list[str] | None = None) -> None:
        self.metadata: dict[str, Any] = {"policy": "joins", "real_time": dict(REAL_TIME)}
        if modes is not None:
            self.metadata["real_time"]["modes"] = modes
        self.calls: list[RunningChunk | None] = []
        self.seen: list[set[str]] = []
        self.warm: list[dict[str, Any]] = []
        self.anchor = False

    def warmup(self, **arguments: Any) -> None:
        self.warm.append(arguments)

    def infer(
        self, obs: Mapping[str, Any], *, previous: RunningChunk | None = None, model_actions: bool = False
    ) -> dict[str, Any]:
        self.calls.append(previous)
        self.seen.append(set(obs))
        if "place" not in obs:
            raise ObservationError("the key 'place' is missing")
        rows = np.arange(H) + float(obs["place"])
        result: dict[str, Any] = {"actions": rows[:, None].copy()}
        if obs.get("bad"):
            raise ActionError("the actions hold nan at [0, 0]")
        if model_actions:
            result["model_actions"] = np.repeat(rows[:, None], A, axis=1).astype(np.float32)
            if self.anchor:
                result["anchor"] = np.array([1.5, float(obs["place"])])
        return result


class Clock:
    now = 50.0

    def __call__(self) -> float:
        return self.now


def real_time(policy: Joins | None = None, **options: Any) -> tuple[RealTime, Joins, Clock, Metrics]:
    policy, clock, metrics = policy or Joins(), Clock(), Metrics()
    return RealTime(policy.metadata, ServerOptions(**options), metrics, clock), policy, clock, metrics


def call(
    server: RealTime, policy: Joins, obs: dict[str, Any], connection: str = "c", seconds: float = 0.0
) -> dict[str, Any]:
    """A request that takes `seconds`, and its answer."""
    plan = server.plan(obs, connection)
    assert isinstance(server._clock, Clock)
    try:
        server._clock.now += seconds
        return server.finish(plan, policy.infer(plan.observation, **plan.arguments))
    finally:
        server.release(plan)


# --- messages ---------------------------------------------------------------------------------------------------------


def test_a_running_chunk_comes_through_a_message_as_it_was() -> None:
    sent = RunningChunk(np.ones((4, A), np.float32), 2, 5, "rtc_identity", np.arange(3.0), "linear", 7.0)
    observation, requested = read_message(unpack(pack(message({"a": 1}, sent, True))))
    got = requested.previous
    assert observation == {"a": 1} and requested.model_actions and got is not None and got.anchor is not None
    np.testing.assert_array_equal(got.left_over, sent.left_over)
    np.testing.assert_array_equal(got.anchor, np.arange(3.0))
    assert (got.delay, got.execution_horizon, got.mode, got.schedule, got.max_guidance_weight) == (
        *(2, 5, "rtc_identity", "linear", 7.0),
    )
    bare = RunningChunk(np.ones((4, A), np.float32), 0)
    _, requested = read_message(unpack(pack(message({}, bare))))
    assert (
        requested.previous is not None
        and requested.previous.schedule is None
        and requested.previous.execution_horizon is None
    )
    assert read_message({"a": 1})[1].previous is None


LEFT = np.zeros((4, A), np.float32)
LARGE = np.zeros((4, A))
LARGE[2, 1] = 1


@pytest.mark.parametrize(
    ("requested", "text"),
    [
        ({"speed": 1}, "turbopi/speed is no key of this server"),
        ({"mode": "fast"}, "turbopi/mode is 'fast'; it should be one of rtc, rtc_identity, rtc_trained"),
        ({"mode": np.zeros(2)}, "turbopi/mode is array"),
        ({"schedule": np.zeros(2)}, "turbopi/schedule is array"),
        ({"delay": -1}, "turbopi/delay is -1"),
        ({"delay": 1.5}, "turbopi/delay is 1.5"),
        ({"delay": True}, "turbopi/delay is True"),
        ({"delay": np.ones(2)}, "turbopi/delay is array"),
        ({"execution_horizon": 0}, "turbopi/execution_horizon is 0; it should be a whole number from 1"),
        ({"schedule": "cubic"}, "turbopi/schedule is 'cubic'"),
        ({"max_guidance_weight": -1.0}, "max_guidance_weight is -1.0"),
        ({"max_guidance_weight": "x"}, "max_guidance_weight is 'x'"),
        ({"session": ""}, "turbopi/session is ''"),
        ({"session": "x" * 65}, "1 to 64 characters"),
        ({"session": 5}, "turbopi/session is 5"),
        ({"step": "5"}, "turbopi/step is '5'"),
        ({"reset": 1}, "turbopi/reset is 1; it should be true or false"),
        ({"model_actions": "yes"}, "turbopi/model_actions is 'yes'"),
        ({"seed": -1}, "turbopi/seed is -1; it should be a whole number from 0"),
        ({"seed": 0.5}, "turbopi/seed is 0.5"),
        ({"previous": LEFT}, "turbopi/previous came without turbopi/mode"),
        ({"previous": LEFT, "mode": "rtc"}, "turbopi/previous came without turbopi/delay"),
        ({"previous": LEFT[0], "mode": "rtc", "delay": 1}, r"turbopi/previous has shape \[3\]"),
        ({"previous": LEFT[:0], "mode": "rtc", "delay": 1}, r"shape \[0, 3\]"),
        ({"previous": [1.0], "mode": "rtc", "delay": 1}, "turbopi/previous is list"),
        (
            {"previous": LEFT + np.nan, "mode": "rtc", "delay": 1},
            r"previous has nan at \[0, 0\]; all should be finite in",
        ),
        ({"previous": LARGE * 1e39, "mode": "rtc", "delay": 1}, r"previous has 1e\+39 at \[2, 1\]; .* in float32"),
        ({"previous": LARGE * 1e20, "mode": "rtc", "delay": 1}, r"previous has 1e\+20 at \[2, 1\], whose square isn't"),
        ({"previous": LARGE * -1e20, "mode": "rtc", "delay": 1}, r"previous has -1e\+20 at \[2, 1\], whose square"),
        ({"previous": LEFT, "mode": "rtc", "delay": 1, "anchor": np.array([1, np.inf])}, r"anchor has inf at \[1\]"),
        ({"previous": LEFT, "mode": "rtc", "delay": 1, "session": "a"}, "either the client keeps"),
        ({"anchor": np.zeros(2)}, "turbopi/anchor came without turbopi/previous"),
    ],
)
def test_what_cannot_be_meant_is_refused_by_name_and_value(requested: dict[str, Any], text: str) -> None:
    with pytest.raises(ObservationError, match=text):
        read_message({"place": 0, **{f"turbopi/{key}": value for key, value in requested.items()}})


# --- a client that keeps its chunk ------------------------------------------------------------------------------------


def test_a_plain_request_goes_to_the_policy_as_it_came() -> None:
    server, policy, _, _ = real_time()
    answer = call(server, policy, {"place": 3})
    assert set(answer) == {"actions"} and policy.calls == [None] and policy.seen == [{"place"}]


@pytest.mark.parametrize("execution", [None, "rtc"])
def test_a_seed_is_the_policys_whatever_else_is_asked(execution: JoinMode | None) -> None:
    server, _, _, _ = real_time(execution=execution, control_hz=None if execution is None else 50)
    seeded = {"place": 0, "turbopi/seed": 2**64 - 1}
    plans = [server.plan({**seeded, **more}, "c") for more in ({}, {"turbopi/model_actions": True})]
    assert [plan.arguments["seed"] for plan in plans] == [2**64 - 1] * 2
    assert all(set(plan.observation) == {"place"} for plan in plans)
    assert server.plan({"place": 0}, "d").arguments.get("seed") is None


def test_a_client_that_keeps_its_chunk_gets_model_actions_and_the_anchor() -> None:
    server, policy, _, _ = real_time()
    policy.anchor = True
    first = call(server, policy, message({"place": 0}, None, True))
    assert first["real_time"] == {"joined": False}
    reported = RunningChunk(first["model_actions"][4:], 2, 4, "rtc", first["anchor"])
    answer = call(server, policy, message({"place": 4}, reported, True))
    assert answer["real_time"] == {"joined": True, "mode": "rtc", "delay": 2}
    np.testing.assert_array_equal(answer["anchor"], [1.5, 4.0])
    got = policy.calls[1]
    assert got is not None and got.anchor is not None
    np.testing.assert_array_equal(got.left_over, reported.left_over)
    assert "model_actions" not in call(server, policy, message({"place": 4}, reported))
    assert policy.seen[1] == {"place"}


def test_a_mode_that_the_policy_has_not_is_refused_with_those_it_has() -> None:
    server, policy, _, _ = real_time(Joins(["rtc"]))
    with pytest.raises(ObservationError, match=r"'rtc_trained', which this policy can't: it offers \['rtc'\]"):
        call(server, policy, message({"place": 0}, RunningChunk(LEFT, 1, mode="rtc_trained")))


def test_a_policy_that_joins_nothing_says_so() -> None:
    policy = Joins()
    del policy.metadata["real_time"]
    server, *_ = real_time(policy)
    with pytest.raises(ObservationError, match="joins no chunks"):
        server.plan(message({"place": 0}, None, True), "c")
    with pytest.raises(ObservationError, match="joins no chunks"):
        server.plan(message({"place": 0}, seed=3), "c")
    assert server.metadata == {}
    with pytest.raises(ConfigError, match="execution='rtc' was asked for, which this policy can't: it offers none"):
        real_time(policy, execution="rtc", control_hz=50)


# --- sessions ---------------------------------------------------------------------------------------------------------


def test_a_plain_client_gets_joined_chunks_by_the_servers_clock() -> None:
    server, policy, clock, metrics = real_time(execution="rtc", control_hz=50, execution_horizon=4)
    first = call(server, policy, {"place": 0}, seconds=0.03)
    assert "model_actions" not in first and first["real_time"] == {"joined": False, "mode": "rtc"}
    clock.now += 0.07  # 0.1 s since the first observation came: 5 actions
    second = call(server, policy, {"place": 5}, seconds=0.05)
    reported = policy.calls[1]
    assert reported is not None and (reported.delay, reported.execution_horizon, reported.mode) == (2, 5, "rtc")
    np.testing.assert_array_equal(reported.left_over[:, 0], np.arange(5, 10))
    about = {"joined": True, "mode": "rtc", "row": 5, "row_by": "clock", "delay": 2, "execution_horizon": 5}
    assert second["real_time"] == {**about, "delay_cut": False}
    clock.now += 10
    late = call(server, policy, {"place": 9})
    assert policy.calls[2] is None and late["real_time"]["joined"] is False and late["real_time"]["row"] >= H
    text = metrics.text()
    assert 'turbopi_real_time_requests_total{joined="yes"} 1.0' in text
    assert 'turbopi_real_time_requests_total{joined="no"} 2.0' in text
    assert "turbopi_real_time_delay_steps_sum 2.0" in text
    assert "turbopi_real_time_seam_gap_sum 0.0" in text and "turbopi_real_time_sessions 1.0" in text


def test_a_client_that_counts_its_actions_is_exact_whatever_the_clock_says() -> None:
    server, policy, clock, _ = real_time(execution="rtc", control_hz=50)
    call(server, policy, {"place": 0, "turbopi/step": 100})
    clock.now += 3600
    answer = call(server, policy, {"place": 6, "turbopi/step": 106, "turbopi/delay": 3})
    reported = policy.calls[1]
    assert reported is not None and reported.delay == 3 and reported.left_over[0, 0] == 6
    assert answer["real_time"]["row_by"] == "step" and answer["real_time"]["row"] == 6


def test_a_reset_begins_a_new_episode() -> None:
    server, policy, _, _ = real_time(execution="rtc", control_hz=50)
    call(server, policy, {"place": 0, "turbopi/step": 100})
    call(server, policy, {"place": 0, "turbopi/step": 0, "turbopi/reset": True})
    call(server, policy, {"place": 2, "turbopi/step": 2})
    assert policy.calls[1] is None and policy.calls[2] is not None


def test_every_connection_is_a_session_and_a_name_outlives_its_connection() -> None:
    server, policy, _, metrics = real_time(execution="rtc", control_hz=50)
    call(server, policy, {"place": 0, "turbopi/step": 0}, "one")
    call(server, policy, {"place": 0, "turbopi/step": 5}, "two")
    assert policy.calls == [None, None]
    server.closed("one")
    call(server, policy, {"place": 0, "turbopi/step": 1}, "one")
    assert policy.calls[2] is None
    for connection in ("one", "three"):
        call(server, policy, {"place": 0, "turbopi/session": "arm", "turbopi/step": 1}, connection)
        server.closed(connection)
    assert policy.calls[3] is None and policy.calls[4] is not None
    assert 'turbopi_real_time_sessions_dropped_total{reason="closed"} 2.0' in metrics.text()


def test_a_client_may_ask_for_a_session_where_the_server_was_not_started_for_it() -> None:
    server, policy, _, _ = real_time()
    requested = {
        "turbopi/session": "arm",
        "turbopi/mode": "rtc_identity",
        "turbopi/delay": 1,
        "turbopi/model_actions": True,
    }
    call(server, policy, {"place": 0, "turbopi/step": 0, **requested})
    answer = call(server, policy, {"place": 3, "turbopi/step": 3, **requested})
    reported = policy.calls[1]
    assert reported is not None and reported.mode == "rtc_identity" and "model_actions" in answer


def test_sessions_are_bounded_and_dropped_by_a_rule(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sessions_module, "MAX_SESSIONS", 2)
    server, policy, clock, metrics = real_time(execution="rtc", control_hz=50)

    def ask(name: str) -> bool:
        call(server, policy, {"place": 0, "turbopi/session": name, "turbopi/step": 1})
        return policy.calls[-1] is not None

    assert [ask("a"), ask("b"), ask("a"), ask("c")] == [False, False, True, False]  # "b" was used least recently
    assert [ask("a"), ask("b")] == [True, False]
    clock.now += sessions_module.IDLE_SECONDS + 1
    assert ask("a") is False
    text = metrics.text()
    assert 'sessions_dropped_total{reason="full"} 2.0' in text and 'sessions_dropped_total{reason="idle"} 2.0' in text
    one = server.plan({"place": 0, "turbopi/session": "x", "turbopi/step": 1}, "c")
    two = server.plan({"place": 0, "turbopi/session": "y", "turbopi/step": 1}, "c")
    with pytest.raises(ObservationError, match="session 'x' has a request that isn't answered yet"):
        ask("x")
    assert ask("z") is False and ask("a") is True, "requests that aren't answered take no session's place"
    server.release(one)
    server.release(two)
    assert ask("z") is True


def test_requests_without_actions_end_no_session_and_leave_none() -> None:
    server, policy, _, metrics = real_time(execution="rtc", control_hz=50)
    for step in range(2):
        call(server, policy, {"place": 0, "turbopi/session": "arm", "turbopi/step": step}, "robot")
        for number in range(2 * sessions_module.MAX_SESSIONS):
            more = {} if number % 2 else {"turbopi/reset": True}
            requested = {"place": 0, "turbopi/session": f"x{number}", "turbopi/step": 1, **more}
            server.release(server.plan(requested, "other"))  # refused: busy, late, …
            with pytest.raises(ObservationError):  # refused at once
                server.plan({**requested, "turbopi/execution_horizon": H + 1, "turbopi/mode": "fast"}, "other")
        assert len(server._named) == 1
    assert policy.calls[-1] is not None and "turbopi_real_time_sessions 1.0" in metrics.text()


def test_a_connection_with_many_sessions_loses_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sessions_module, "MAX_SESSIONS", 4)
    server, policy, _, _ = real_time(execution="rtc", control_hz=50)

    def joined(name: str, connection: str) -> bool:
        call(server, policy, {"place": 0, "turbopi/session": name, "turbopi/step": 1}, connection)
        return policy.calls[-1] is not None

    assert not joined("arm", "robot") and not joined("leg", "another")
    for number in range(10):
        assert not joined(f"x{number}", "greedy")
    assert joined("arm", "robot") and joined("x9", "greedy") and not joined("x0", "greedy")
    server.closed("greedy")  # then its sessions are one group, still the largest
    assert not joined("new", "a new one") and joined("arm", "robot") and joined("leg", "another")


def test_a_refused_newer_request_leaves_the_waiting_one_the_sessions() -> None:
    waiting = True
    server, policy, _, _ = real_time(execution="rtc", control_hz=50)
    server._waits = lambda name: waiting
    requested = {"place": 0, "turbopi/session": "arm", "turbopi/step": 1}
    first = server.plan(requested, "robot")
    server.release(server.plan(requested, "other"))  # late itself: the first one still waits
    waiting = False  # it runs
    with pytest.raises(ObservationError, match="isn't answered yet"):
        server.plan(requested, "other")
    server.finish(first, policy.infer(first.observation, **first.arguments))
    server.release(first)
    call(server, policy, {**requested, "turbopi/step": 2})
    assert policy.calls[-1] is not None


def test_a_request_without_actions_leaves_the_sessions_chunk_as_it_is() -> None:
    server, policy, _, _ = real_time(execution="rtc", control_hz=50)
    call(server, policy, {"place": 0, "turbopi/step": 0})
    with pytest.raises(ActionError):
        call(server, policy, {"place": 2, "turbopi/step": 2, "bad": True})
    call(server, policy, {"place": 4, "turbopi/step": 4})
    reported = policy.calls[-1]
    assert reported is not None and reported.left_over[0, 0] == 4


def test_a_measured_delay_that_does_not_fit_is_cut_and_said() -> None:
    server, policy, _, _ = real_time(execution="rtc_trained", control_hz=50)
    call(server, policy, {"place": 0, "turbopi/step": 0}, seconds=0.2)
    answer = call(server, policy, {"place": 5, "turbopi/step": 5})
    assert answer["real_time"]["delay"] == 2 and answer["real_time"]["delay_cut"] is True
    fixed, policy, _, _ = real_time(execution="rtc", control_hz=50, delay_steps=0)
    call(fixed, policy, {"place": 0, "turbopi/step": 0}, seconds=0.2)
    assert call(fixed, policy, {"place": 5, "turbopi/step": 5})["real_time"]["delay"] == 0


@pytest.mark.parametrize(
    ("options", "first", "second", "text"),
    [
        ({}, None, {"step": 1}, "turbopi/step need a session"),
        ({}, None, {"session": "a"}, "turbopi/session came without turbopi/mode"),
        ({}, None, {"session": "a", "mode": "rtc"}, "send turbopi/step and turbopi/delay"),
        ({}, {"session": "a", "mode": "rtc", "step": 0}, {"session": "a", "mode": "rtc", "step": 1}, "--control-hz"),
        ({"execution": "rtc"}, {"step": 5}, {"step": 4}, "turbopi/step is 4, after 5 in the request before"),
        ({"execution": "rtc"}, {"step": 5}, {}, "always or never"),
        ({"execution": "rtc"}, {}, {"step": 5}, "always or never"),
        ({"execution": "rtc"}, {"step": 0}, {"step": 5, "delay": 6}, "turbopi/delay is 6 .* H − s = 5: at most 5 fit"),
        ({"execution": "rtc"}, {"step": 0}, {"step": 8, "delay": 3}, "at most 2 fit"),
        ({"execution": "rtc_trained"}, {"step": 0}, {"step": 5, "delay": 3}, "trained with delays up to 2"),
        ({"execution": "rtc"}, {"step": 0}, {"step": 1, "execution_horizon": 11}, "horizon is 11, .* have 10 actions"),
        ({"execution": "rtc"}, None, {"step": 1, "model_actions": True}, "for sessions, but here the client keeps"),
    ],
)
def test_what_the_server_cannot_know_or_join_is_refused(
    options: dict[str, Any], first: dict[str, Any] | None, second: dict[str, Any], text: str
) -> None:
    if "execution" in options:
        options = {**options, "control_hz": 50}
    server, policy, _, _ = real_time(**options)
    if first is not None:
        call(server, policy, {"place": 0, **{f"turbopi/{key}": value for key, value in first.items()}})
    with pytest.raises(ObservationError, match=text):
        call(server, policy, {"place": 0, **{f"turbopi/{key}": value for key, value in second.items()}})


@pytest.mark.parametrize("mode", sorted({*get_args(JoinMode)} - {"rtc", "rtc_identity"}))
@pytest.mark.parametrize("option", [{"schedule": "linear"}, {"max_guidance_weight": 1.0}], ids=repr)
def test_options_of_guidance_are_refused_by_modes_that_do_not_guide(mode: Any, option: dict[str, Any]) -> None:
    options: dict[str, Any] = {"turbopi/" + name: value for name, value in option.items()}
    why = f"turbopi/{next(iter(option))} say how rtc and rtc_identity guide; {mode} doesn't guide"
    for execution, requested in (
        (None, {"mode": mode, "previous": LEFT, "delay": 1}),
        (None, {"mode": mode, "session": "arm", "step": 0}),
        (mode, {"step": 0}),
    ):
        server, *_ = real_time(Joins([mode]), execution=execution, control_hz=50)
        message = {"place": 0, **{f"turbopi/{key}": value for key, value in requested.items()}}
        server.plan(message, "c")
        with pytest.raises(ObservationError, match=why):
            server.plan(message | options, "another")
    with pytest.raises(ConfigError, match=f"{next(iter(option))} say how"):
        ChunkQueue(mode, **option)


def test_a_server_joins_by_the_ways_there_are() -> None:
    assert get_args(JoinMode) == JOINING


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"execution": "async", "control_hz": 50}, "execution='async' isn't a server's: it joins chunks by rtc"),
        ({"execution": "rtc"}, "needs the robots' control rate"),
        ({"control_hz": 0}, "control_hz=0 should be more than 0"),
        ({"execution_horizon": 0}, "execution_horizon=0 should be 1 or more"),
        ({"delay_steps": -1}, "delay_steps=-1 should be 0 or more"),
    ],
)
def test_options_that_cannot_be_right_are_refused(options: dict[str, Any], text: str) -> None:
    with pytest.raises(ConfigError, match=text):
        ServerOptions(**options)


@pytest.mark.parametrize(
    ("options", "longest", "why"),
    [
        ({"execution": "rtc"}, 5, "chunks of 10 actions and an execution horizon of 5 at most 5 control steps fit"),
        ({"execution": "rtc", "execution_horizon": 8}, 2, "chunks of 10 .* horizon of 8 at most 2 control steps fit"),
        ({"execution": "rtc", "execution_horizon": 2}, 5, "an execution horizon of 2 at most 5 control steps fit"),
        ({}, 5, "at most 5 control steps fit"),  # of named sessions
        ({"execution": "rtc_trained"}, 2, "this checkpoint was trained with delays up to 2"),
    ],
)
def test_a_fixed_delay_that_would_be_cut_in_every_call_is_refused(
    options: dict[str, Any], longest: int, why: str
) -> None:
    policy = Joins()
    policy.metadata["action_horizon"] = H
    real_time(policy, **options, control_hz=50, delay_steps=longest)
    with pytest.raises(ConfigError, match=f"^delay_steps={longest + 1} was asked for, but .*{why}"):
        real_time(policy, **options, control_hz=50, delay_steps=longest + 1)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({}, ("by rtc:", "50 actions a second (--control-hz), 5 of 10 before", "delay is measured here")),
        ({"execution": "rtc_trained", "delay_steps": 2}, ("by rtc_trained:", "the delay is 2 control steps.")),
        ({"execution_horizon": 6, "control_hz": 12.5}, ("12.5 actions a second", "6 of 10 before")),
    ],
)
def test_a_server_says_how_it_joins_in_one_line(options: dict[str, Any], words: tuple[str, ...]) -> None:
    policy, console = Joins(), Console(file=io.StringIO(), width=60)
    policy.metadata["action_horizon"] = H

    def serve_forever(self: PolicyServer, ready: Any, stopping: Any) -> None:
        ready(self)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(PolicyServer, "serve_forever", serve_forever)
        run(policy, **{"execution": "rtc", "control_hz": 50, **options}, console=console)
        run(policy, console=console)
    lines = [line for line in console.file.getvalue().splitlines() if line.startswith("Joins")]  # type: ignore[attr-defined]
    assert len(lines) == 1 and all(word in lines[0] for word in words), lines
    assert lines[0].endswith("A request's turbopi/step, turbopi/delay and turbopi/execution_horizon come first")


# --- through a socket -------------------------------------------------------------------------------------------------


def test_posts_join_chunks_in_a_named_session_and_need_one() -> None:
    with running(Joins(), execution="rtc", control_hz=50) as server:
        client = HTTPConnection("127.0.0.1", server.port)

        def post(**more: Any) -> dict[str, Any]:
            body = json.dumps({"place": 0.0, **{f"turbopi/{key}": value for key, value in more.items()}})
            client.request("POST", "/v1/actions", body, {"Content-Type": "application/json"})
            answer: dict[str, Any] = json.loads(client.getresponse().read())
            return answer

        for _ in range(2):
            assert "a POST needs turbopi/session here" in post(step=1)["error"]["text"]
        assert post(session="arm", step=1)["real_time"]["joined"] is False
        client.close()  # the session isn't the connection's
        joined = post(session="arm", step=3)["real_time"]
        assert (joined["joined"], joined["row"], joined["row_by"]) == (True, 2, "step")
        assert post(mode="none", session="arm")["actions"]
        client.close()


@pytest.fixture
def served() -> Iterator[tuple[PolicyServer, Joins]]:
    policy = Joins()
    with running(policy, execution="rtc", control_hz=50) as server:
        yield server, policy


def test_the_greeting_says_what_a_server_offers(served: tuple[PolicyServer, Joins]) -> None:
    server, policy = served
    with RealTimeClient("127.0.0.1", server.port) as client:
        reported = client.metadata["real_time"]
    assert (
        reported["modes"] == REAL_TIME["modes"]
        and reported["trained_max_delay"] == 2
        and reported["execution"] == "rtc"
    )
    assert reported["keys"] == [f"turbopi/{key}" for key in KEYS] and reported["sessions"]["most"] == 256
    assert policy.warm == [{"real_time": "rtc"}]


def test_the_server_survives_every_refusal(served: tuple[PolicyServer, Joins]) -> None:
    server, policy = served
    bad: list[dict[str, Any]] = [
        {"turbopi/delay": -1},
        {"turbopi/previous": LEFT},
        {"turbopi/speed": 1},
        {"turbopi/step": 3, "turbopi/delay": 99},
        {"turbopi/step": 0},
    ]
    with connect(server.url, compression=None) as socket:
        socket.recv()
        socket.send(pack({"place": 0, "turbopi/step": 2}))
        assert isinstance(socket.recv(30), bytes)
        for requested in bad:
            socket.send(pack({"place": 0, **requested}))
            reply = socket.recv(30)
            assert isinstance(reply, str) and reply.startswith("bad observation: "), requested
        socket.send(pack({"place": 3, "turbopi/step": 3}))
        reply = socket.recv(30)
        assert isinstance(reply, bytes) and unpack(reply)["real_time"]["joined"]
    assert len(policy.calls) == 2
    status, _, text = asyncio.run(http_get(server.port, "/metrics"))
    errors = {
        sample.labels["kind"]: sample.value
        for family in text_string_to_metric_families(text)
        for sample in family.samples
        if sample.name == "turbopi_errors_total"
    }
    assert status == 200 and errors["observation"] == len(bad)


def test_actions_that_are_not_finite_are_told_with_the_left_over_that_was_joined(
    served: tuple[PolicyServer, Joins],
) -> None:
    server, _ = served
    joined = {"turbopi/previous": LARGE * 1e18, "turbopi/mode": "rtc", "turbopi/delay": 1}
    with connect(server.url, compression=None) as socket:
        socket.recv()
        for requested in (joined, {}):
            socket.send(pack({"place": 0, "bad": True, **requested}))
            reply = socket.recv(30)
            assert isinstance(reply, str) and reply.startswith("bad actions: the actions hold nan at [0, 0]")
            assert ("turbopi/previous has values up to 1e+18" in reply) == bool(requested)


def test_a_recording_of_joined_calls_is_read_back(tmp_path: Path) -> None:
    with (
        running(Joins(), execution="rtc", control_hz=50, record_dir=tmp_path) as server,
        RealTimeClient("127.0.0.1", server.port) as client,
    ):
        client.infer({"place": 0.0, "turbopi/step": 0})
        client.infer({"place": 2.0, "turbopi/step": 2, "turbopi/reset": False})
    calls = list(iter_recording(tmp_path))
    assert [actions[0, 0] for _, actions in calls] == [0.0, 2.0]


def test_the_client_raises_what_the_server_says() -> None:
    with running(FakePolicy()) as server, RealTimeClient("127.0.0.1", server.port) as client:
        state = np.linspace(-1, 1, 8)
        assert client.infer({"observation/state": state})["actions"].shape == (2, 8)
        with pytest.raises(ObservationError, match="'observation/state' is missing"):
            client.infer({"prompt": "no state"})
        with pytest.raises(ActionError, match="hold nan"):
            client.infer({"observation/state": state, "prompt": "nan actions"})
        with pytest.raises(ConfigError, match="offers no real-time modes"):
            client.infer({"observation/state": state}, model_actions=True)
        with pytest.raises(ServerRefused, match="CUDA error: invalid argument"):
            client.infer({"observation/state": state, "prompt": "crash"})
        assert client.infer({"observation/state": state})["actions"].shape == (2, 8)  # connected anew


def test_the_client_refuses_a_mode_before_it_is_sent() -> None:
    offered = r"doesn't offer 'rtc_trained'; it offers \['rtc'\]"
    with (
        running(Joins(["rtc"])) as server,
        RealTimeClient("127.0.0.1", server.port) as client,
        pytest.raises(ConfigError, match=offered),
    ):
        client.infer({"place": 0}, previous=RunningChunk(LEFT, 1, mode="rtc_trained"))


def test_a_server_that_went_away_is_connected_again_once_it_is_back() -> None:
    with running(Joins()) as server:
        port = server.port
        client = RealTimeClient("127.0.0.1", port)
        client.infer({"place": 0})
    with pytest.raises(ServerLost, match="went away"):
        client.infer({"place": 0})
    with pytest.raises(ServerLost, match=f"no policy server at ws://127.0.0.1:{port}"):
        client.infer({"place": 0})
    with running(Joins(), port=port):
        assert client.infer({"place": 4})["actions"][0, 0] == 4
        client.close()


def test_a_server_that_hangs_costs_the_robot_no_more_than_its_patience() -> None:
    policy = FakePolicy()
    with running(policy) as server:
        client = RealTimeClient("127.0.0.1", server.port, answer_s=0.05)
        with pytest.raises(ServerLost, match=r"no answer within 0\.05 s"):
            client.infer({"observation/state": np.zeros(8), "prompt": "hold"})
        policy.release.set()
        client.close()


def test_a_wrong_address_and_a_wrong_key_are_configuration() -> None:
    with pytest.raises(ConfigError, match="no address of a server"):
        RealTimeClient("ws://[")
    with running(Joins(), api_key="right") as server:
        with pytest.raises(ConfigError, match="wants its API key"):
            RealTimeClient("127.0.0.1", server.port)
        RealTimeClient("127.0.0.1", server.port, api_key="right").close()


def test_a_robots_client_needs_websockets_msgpack_and_numpy_alone() -> None:
    code = """
import sys
class Refuse:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in BLOCKED:
            raise ImportError(f"{name} isn't installed here")
BLOCKED = {"torch", "msgspec", "matplotlib", "safetensors", "PIL", "typer", "rich", "sentencepiece", "tensorstore",
           "jinja2", "psutil", "packaging", "prometheus_client"}
sys.meta_path.insert(0, Refuse())
import turbopi.realtime.client, turbopi.realtime
foreign = {name.split(".")[0] for name in sys.modules} & (BLOCKED | {"websockets", "msgpack", "numpy"})
print(sorted(foreign))
"""
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert (ended.stdout, ended.returncode) == ("['msgpack', 'numpy', 'websockets']\n", 0), ended.stderr


# --- the whole way, with a model --------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def tiny() -> UnifiedPolicy:
    return UnifiedPolicy(random_checkpoint("pi05_tiny"), backend="pytorch", precision="f32", num_denoising_steps=2)


def drive(executor: RealTimeExecutor, observation: dict[str, Any], chunks: int) -> list[str]:
    """A control loop without a clock of its own, until so many chunks have taken over."""
    kinds: list[str] = []
    pause = threading.Event()
    for _ in range(20_000):
        executor.observe(observation)
        command = executor.next_action()
        kinds.append(command.kind)
        if command.takes_over:
            chunks -= 1
            if not chunks:
                break
        pause.wait(0.001)
    return kinds


@pytest.mark.slow
@pytest.mark.parametrize("execution", ["sync", "rtc", "rtc_identity"])
@pytest.mark.parametrize("remote", [False, True])
def test_the_executor_runs_a_real_policy_here_and_on_a_server(
    tiny: UnifiedPolicy, execution: Any, remote: bool
) -> None:
    observation = tiny.example_observation()
    with running(tiny) as server, RealTimeClient("127.0.0.1", server.port) as client:
        policy: Any = client if remote else tiny
        patient: dict[str, Any] = {"max_observation_age_s": 600, "max_pause_s": 600}
        with RealTimeExecutor(policy, control_hz=0.5, execution=execution, **patient) as executor:
            executor.warm_up(observation)
            kinds = drive(executor, observation, chunks=3)
            report = json.loads(json.dumps(executor.report()))
    assert report["chunks"] == 3 and "fresh" in kinds, report
    assert report["last_error"] is None and not set(report["dropped"]) - {"used_up"}


def test_a_plain_client_of_a_joining_server_gets_the_chunk_that_the_policy_computes(tiny: UnifiedPolicy) -> None:
    observation = tiny.example_observation()
    with running(tiny, execution="rtc_identity", control_hz=50) as server, connect(server.url) as socket:
        socket.recv()
        answers = []
        for step in (0, 3):
            socket.send(pack({**observation, "turbopi/step": step, "turbopi/delay": 1}))
            reply = socket.recv(120)
            assert isinstance(reply, bytes), reply
            answers.append(unpack(reply)["real_time"])
    assert [answer["joined"] for answer in answers] == [False, True] and answers[1]["row"] == 3


def test_what_the_model_cannot_join_is_refused_with_values_and_the_server_goes_on(tiny: UnifiedPolicy) -> None:
    observation, width = tiny.example_observation(), tiny.config.model.action_dim
    horizon = tiny.config.model.action_horizon
    good = np.zeros((horizon - 1, width), np.float32)
    refused = [
        (RunningChunk(good[:, 1:], 1, 1), f"have {width - 1} values, but this model's have {width}"),
        (RunningChunk(np.zeros((horizon + 1, width), np.float32), 1, 1), f"has {horizon + 1} actions"),
        (RunningChunk(good, 2, horizon - 1), f"delay of 2 and an execution horizon of {horizon - 1} don't fit"),
    ]
    with running(tiny) as server, RealTimeClient("127.0.0.1", server.port) as client:
        for previous, text in refused:
            with pytest.raises(ObservationError, match=text):
                client.infer(observation, previous=previous)
        with pytest.raises(ConfigError, match="doesn't offer 'rtc_trained'"):
            client.infer(observation, previous=RunningChunk(good, 1, 1, "rtc_trained"))
        answer = client.infer(observation, previous=RunningChunk(good, 1, 1), model_actions=True)
        assert answer["model_actions"].shape == (horizon, width) and answer["real_time"]["joined"]


FAULTS = """
import resource, sys

def faults(copies=20):
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(copies):
        blocks = [b"x" * 1_843_500 for _ in range(3)]  # copies of a message with two images of 640 x 480
        del blocks
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

from turbopi.realtime.client import _keep_freed_memory
_keep_freed_memory()
faults(1)
print(faults())
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="another C library keeps freed memory in its own way")
def test_a_clients_copies_of_a_message_get_the_memory_of_those_before() -> None:
    environment = {
        name: value for name, value in os.environ.items() if not name.startswith(("MALLOC_", "GLIBC_", "LD_"))
    }
    done = subprocess.run([sys.executable, "-c", FAULTS], env=environment, capture_output=True, text=True, check=True)
    assert int(done.stdout) < 600  # without it: 26,000, one for each 4 KiB
