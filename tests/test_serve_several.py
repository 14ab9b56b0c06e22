"""Several robots and simulators at one server, through sockets: order, deadlines, batches, batch messages."""

import asyncio
import contextlib
import logging
import re
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from prometheus_client.parser import text_string_to_metric_families
from serve_fakes import OBSERVATION, BatchingFakePolicy, FakePolicy, PipelinedFakePolicy, http_get, observation
from test_serve_real_time import Joins
from test_serve_server import client, eventually, infer, metric, refused, served
from websockets.asyncio.client import ClientConnection
from websockets.exceptions import ConnectionClosedError

from turbopi import UnifiedPolicy
from turbopi.policy.shipped import CHASE_POLICY
from turbopi.realtime.messages import SCHEDULING_KEYS
from turbopi.realtime.wire import pack, unpack
from turbopi.recordings import iter_recording
from turbopi.serve import PolicyServer, ServerOptions, running
from turbopi.serve.calls import PolicyCalls
from turbopi.serve.metrics import Metrics
from turbopi.serve.real_time import RealTime
from turbopi.serve.requests import (
    MAX_BATCH_ROWS,
    SchedulingOptions,
    batch_row,
    check_batch_shapes,
    read_scheduling,
    stack_answers,
)
from turbopi.serve.scheduling.batch_times import BatchTimes
from turbopi.serve.scheduling.schedule import Request, Schedule
from turbopi.serve.worker import Ran, Worker
from turbopi.support.errors import ConfigError, ObservationError

PAYING = {1: 0.010, 2: 0.014, 4: 0.022, 8: 0.038}


@pytest.fixture
def pays(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The table T(B) says that batches pay, whatever this machine takes for them."""

    def measure(calls: PolicyCalls) -> None:
        for size, seconds in PAYING.items():
            if size <= calls.times.largest:
                calls.times.measured(size, seconds)

    with monkeypatch.context() as patch:
        patch.setattr(PolicyCalls, "_measure", measure)
        patch.setattr(BatchTimes, "ran", lambda self, rows, seconds, now: None)
        yield


def times_of(server: PolicyServer) -> BatchTimes:
    """T(B), of a server that computes itself."""
    assert isinstance(server._calls, PolicyCalls)
    return server._calls.times


def asks(prompt: str, **keys: Any) -> bytes:
    return pack({**observation(prompt), **{f"turbopi/{key}": value for key, value in keys.items()}})


async def answer(connection: ClientConnection) -> dict[str, Any] | str:
    """The next answer: a result, or the text of a refusal."""
    reply = await asyncio.wait_for(connection.recv(), 60)
    return reply if isinstance(reply, str) else dict(unpack(reply))


async def prompt_of(connection: ClientConnection) -> str:
    reply = await answer(connection)
    assert isinstance(reply, dict), reply
    return str(reply["prompt"])


class Line:
    """Clients whose requests wait behind one that `hold`s the policy."""

    def __init__(self, server: PolicyServer, policy: FakePolicy) -> None:
        self.server, self.policy, self.stack = server, policy, contextlib.AsyncExitStack()
        self.holder: ClientConnection

    async def __aenter__(self) -> "Line":
        self.holder = await self.stack.enter_async_context(client(self.server))
        await self.holder.send(pack(observation("hold")))
        await eventually(self.policy.started.is_set)
        return self

    async def __aexit__(self, *of: object) -> None:
        self.policy.release.set()
        await self.stack.aclose()

    async def client(self) -> ClientConnection:
        return await self.stack.enter_async_context(client(self.server))

    async def wait(self, prompt: str, **keys: Any) -> ClientConnection:
        """A new client whose request waits."""
        connection = await self.client()
        before = metric(self.server, "turbopi_queue_depth")
        await connection.send(asks(prompt, **keys))
        await eventually(lambda: metric(self.server, "turbopi_queue_depth") == before + 1)
        return connection

    async def go(self) -> None:
        self.policy.release.set()
        assert await prompt_of(self.holder) == "hold"


# --- order ------------------------------------------------------------------------------------------------------------


def test_the_earliest_deadline_goes_first_and_robots_before_simulators() -> None:
    async def test(server: PolicyServer, policy: FakePolicy) -> None:
        async with Line(server, policy) as line:
            waiting = [
                await line.wait("simulator", priority="simulator", deadline_ms=20_000),
                await line.wait("plain"),  # the server's default, 40 s
                await line.wait("later", deadline_ms=50_000),
                await line.wait("sooner", control_hz=50, left=1500),  # 30 s
            ]
            await line.go()
            assert {await prompt_of(one) for one in waiting} == {"simulator", "plain", "later", "sooner"}
            assert policy.seen == ["hold", "sooner", "plain", "later", "simulator"]

    served(test, deadline_ms=40_000)


def test_keys_of_the_scheduler_never_reach_the_policy() -> None:
    async def test(server: PolicyServer, policy: FakePolicy) -> None:
        async with client(server) as connection:
            keys: list[dict[str, Any]] = [
                {"deadline_ms": 60_000, "priority": "robot"},
                {"control_hz": 1, "left": np.int64(50), "priority": "simulator"},
                {"session": "arm"},
                {"batch": 1},
            ]
            for number, of in enumerate(keys):
                obs = observation(str(number))
                if "batch" in of:
                    obs = {key: value[None] if isinstance(value, np.ndarray) else value for key, value in obs.items()}
                await connection.send(pack({**obs, **{f"turbopi/{key}": value for key, value in of.items()}}))
                assert isinstance(await answer(connection), dict)
                assert set(policy.observations[str(number)]) == set(OBSERVATION)

    served(test)


def test_what_cannot_meet_its_deadline_is_refused_while_the_policy_is_still_busy() -> None:
    async def test(server: PolicyServer, policy: FakePolicy) -> None:
        async with Line(server, policy) as line:
            late = await line.client()
            text = await refused(late, asks("late", deadline_ms=1))
            assert text.startswith("late: ") and text.endswith(
                "but its deadline is 1.0 ms: ask earlier, or give it more time"
            )
            assert not policy.release.is_set()
            await line.go()
            assert (await infer(late, observation("on")))["prompt"] == "on"  # the connection stays
            assert "late" not in policy.seen
            assert metric(server, "turbopi_errors_total", kind="late") == 1
            assert metric(server, "turbopi_refused_requests_total", kind="late", priority="robot") == 1

    served(test)


def test_slack_is_counted_for_deadlines_that_were_given() -> None:
    async def test(server: PolicyServer, policy: FakePolicy) -> None:
        async with client(server) as connection:
            await infer(connection, observation("plain"))
            await connection.send(asks("met", deadline_ms=60_000, priority="simulator"))
            assert await prompt_of(connection) == "met"
            await eventually(lambda: metric(server, "turbopi_slack_seconds_count", priority="simulator") == 1)
        assert metric(server, "turbopi_slack_seconds_bucket", priority="simulator", le="0.0") == 0
        assert metric(server, "turbopi_slack_seconds_count", priority="robot") == 0
        for priority in ("robot", "simulator"):
            assert metric(server, "turbopi_scheduled_requests_total", priority=priority) == 1
            assert metric(server, "turbopi_deadline_misses_total", priority=priority) == 0
        _, _, body = await http_get(server.port, "/metrics")
        families = {family.name: family for family in text_string_to_metric_families(body)}
        assert families["turbopi_slack_seconds"].type == families["turbopi_batch_size"].type == "histogram"

    served(test)


def test_an_answer_after_its_deadline_is_a_miss() -> None:
    metrics = Metrics()
    metrics.slack(-0.03, "robot")
    metrics.slack(0.03, "robot")

    def value(name: str, **labels: str) -> float | None:
        return metrics.registry.get_sample_value(name, {"priority": "robot", **labels})

    assert value("turbopi_deadline_misses_total") == 1
    assert [value("turbopi_slack_seconds_bucket", le=le) for le in ("-0.05", "0.0", "0.05")] == [0, 1, 2]


def test_a_newer_observation_of_a_session_replaces_the_one_that_waits() -> None:
    async def test(server: PolicyServer, policy: FakePolicy) -> None:
        async with Line(server, policy) as line:
            older = await line.wait("older", session="arm")
            other = await line.wait("other", session="leg")
            newer = await line.client()
            await newer.send(asks("newer", session="arm"))
            text = await answer(older)
            assert text == "replaced: a newer observation of session 'arm' came before this one had its turn"
            await line.go()
            assert [await prompt_of(one) for one in (newer, other)] == ["newer", "other"]
            assert "older" not in policy.seen
            await older.send(asks("again", session="arm"))
            assert await prompt_of(older) == "again"
            assert metric(server, "turbopi_refused_requests_total", kind="replaced", priority="robot") == 1

    served(test)


def test_a_full_line_has_a_place_for_a_robot_as_long_as_a_simulator_waits() -> None:
    async def test(server: PolicyServer, policy: FakePolicy) -> None:
        async with Line(server, policy) as line:
            simulator = await line.wait("simulator", priority="simulator")
            robot = await line.client()
            await robot.send(pack(observation("robot")))
            text = await answer(simulator)
            assert isinstance(text, str) and text.startswith(
                "busy: 1 requests wait already (--queue-limit 1); try again later"
            )
            assert "busy" in await refused(await line.client(), pack(observation("one more robot")))
            await line.go()
            assert await prompt_of(robot) == "robot"

    served(test, queue_limit=1)


class HoldingJoins(Joins):
    """Joins chunks; an observation with "hold" waits for `release`."""

    def __init__(self) -> None:
        super().__init__()
        fake = FakePolicy()
        self.started, self.release, self.overlaps = fake.started, fake.release, 0

    def infer(self, obs: Any, **arguments: Any) -> dict[str, Any]:
        if obs.get("hold"):
            self.started.set()
            assert self.release.wait(120)
        return super().infer({key: value for key, value in obs.items() if key != "hold"}, **arguments)


def test_a_session_that_joins_chunks_goes_on_from_the_chunk_that_its_robot_has() -> None:
    """A request that was replaced leaves no chunk behind; one that runs isn't replaced."""

    async def test(server: PolicyServer, policy: HoldingJoins) -> None:
        def of(place: int, **keys: Any) -> bytes:
            requested = {"session": "arm", "mode": "rtc", "step": place, "delay": 1} | keys
            return pack({"place": place, **{f"turbopi/{key}": value for key, value in requested.items()}})

        async with client(server) as first, client(server) as second, client(server) as holder:
            await first.send(of(0))
            assert isinstance(await answer(first), dict)
            await holder.send(pack({"place": 0, "hold": True}))
            await eventually(policy.started.is_set)
            await first.send(of(2))
            await eventually(lambda: metric(server, "turbopi_queue_depth") == 1)
            await second.send(of(3))
            assert str(await answer(first)).startswith("replaced: ")
            policy.release.set()
            joined = await answer(second)
            assert isinstance(joined, dict) and joined["real_time"]["row"] == 3  # since the first chunk
            policy.started.clear()
            policy.release.clear()
            await first.send(pack({**unpack(of(5)), "hold": True}))
            await eventually(policy.started.is_set)
            text = await refused(second, of(6))
            assert text.startswith("bad observation: session 'arm' has a request that isn't answered yet")
            policy.release.set()
            assert isinstance(await answer(first), dict)

    served(test, policy_class=HoldingJoins)  # type: ignore[arg-type]


def test_a_request_that_was_replaced_does_not_free_its_session_for_a_third() -> None:
    waiting = True
    options = ServerOptions(execution="rtc", control_hz=50)
    sessions = RealTime(Joins().metadata, options, Metrics(), waits=lambda name: waiting)
    requested = {"place": 0, "turbopi/session": "a"}
    older, newer = sessions.plan(requested, "c"), sessions.plan(requested, "d")
    waiting = False  # the newer one runs
    sessions.release(older)
    with pytest.raises(ObservationError, match="session 'a' has a request that isn't answered yet"):
        sessions.plan(requested, "e")
    sessions.release(newer)
    sessions.plan(requested, "e")


def test_a_session_may_be_for_the_order_alone_where_the_policy_joins_chunks() -> None:
    with running(Joins(), execution="rtc", control_hz=50) as server:
        requested = server._real_time.plan({"place": 0, "turbopi/session": "a", "turbopi/mode": "none"}, "c")
        assert requested.name == "a" and requested.arguments == {} and requested.observation == {"place": 0}
        for keys in ({"turbopi/mode": "none"}, {"turbopi/mode": "none", "turbopi/session": "a", "turbopi/step": 1}):
            with pytest.raises(ObservationError, match="'none' joins nothing: it needs turbopi/session"):
                server._real_time.plan({"place": 0, **keys}, "c")


# --- batches ----------------------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("pays")
def test_requests_that_wait_run_together_and_each_client_gets_its_own_answer() -> None:
    async def test(server: PolicyServer, policy: BatchingFakePolicy) -> None:
        async with Line(server, policy) as line:
            waiting = [await line.wait(str(number)) for number in range(5)]
            await line.go()
            replies = [await answer(one) for one in waiting]
            assert [reply["prompt"] for reply in replies] == list("01234")  # type: ignore[index]
            assert policy.batches == [["0", "1", "2", "3"]]  # four are as soon as five would be, a row
            assert replies[0]["server_timing"]["batch"] == 4 and "batch" not in replies[4]["server_timing"]  # type: ignore[index]
            assert metric(server, "turbopi_batch_size_bucket", le="1.0") == 2
            assert metric(server, "turbopi_batch_size_sum") == 6
            assert len(policy.threads) == 1

    served(test, policy_class=BatchingFakePolicy)


@pytest.mark.usefixtures("pays")
@pytest.mark.parametrize("fault", ["nan state", "nan actions", "answer nan", "crash"])
def test_one_that_spoils_a_batch_is_refused_alone(fault: str) -> None:
    async def test(server: PolicyServer, policy: BatchingFakePolicy) -> None:
        async with Line(server, policy) as line:
            waiting = [await line.wait("0"), await line.client(), await line.wait("2"), await line.wait("3")]
            bad = observation(fault)
            if fault == "nan state":
                bad["observation/state"] = np.full(8, np.nan)
            await waiting[1].send(pack(bad))
            await eventually(lambda: metric(server, "turbopi_queue_depth") == 4)
            await line.go()
            assert [await prompt_of(waiting[at]) for at in (0, 2, 3)] == ["0", "2", "3"]
            text = await answer(waiting[1])
            expected = {"nan state": "bad observation: obs", "nan actions": "bad actions: the", "crash": "Traceback"}
            assert isinstance(text, str) and text.startswith(expected.get(fault, 'bad actions: "actions" has nan at'))
            assert len(policy.batches) == 1
            if fault == "crash":
                assert times_of(server).measured_largest == 8  # not the batch's fault
                with pytest.raises(ConnectionClosedError):
                    await waiting[1].recv()
            policy.started.clear()
            policy.release.clear()
            await line.holder.send(pack(observation("hold")))
            await eventually(policy.started.is_set)
            for at in (0, 2, 3):
                await waiting[at].send(pack(observation(f"again {at}")))
            if fault == "nan state":
                await waiting[1].send(pack(observation("good now")))
            await eventually(lambda: metric(server, "turbopi_queue_depth") == 3 + (fault == "nan state"))
            await line.go()
            assert {await prompt_of(waiting[at]) for at in (0, 2, 3)} == {"again 0", "again 2", "again 3"}
            assert sorted(policy.batches[1]) == ["again 0", "again 2", "again 3"][: len(policy.batches[1])]
            assert len(policy.batches[1]) > 1  # batches go on
            if fault == "nan state":
                assert await prompt_of(waiting[1]) == "good now"
                assert all("good now" not in batch for batch in policy.batches)  # the first one after a bad one

    served(test, policy_class=BatchingFakePolicy)


@pytest.mark.usefixtures("pays")
@pytest.mark.parametrize("how", ["raises", "returns too few"])
def test_batches_that_fail_for_themselves_are_given_up_and_their_observations_run(how: str) -> None:
    async def test(server: PolicyServer, policy: BatchingFakePolicy) -> None:
        async with Line(server, policy) as line:
            policy.no_batch = how == "raises"
            waiting = [await line.wait("short" if how != "raises" else str(number)) for number in range(2)]
            await line.go()
            assert [isinstance(await answer(one), dict) for one in waiting] == [True, True]
            assert len(policy.batches) == 1 and times_of(server).formed_largest(0.0) == 1

    served(test, policy_class=BatchingFakePolicy)


@pytest.mark.usefixtures("pays")
def test_a_device_lost_in_a_batch_is_told_to_all_in_it() -> None:
    async def test(server: PolicyServer, policy: BatchingFakePolicy) -> None:
        async with Line(server, policy) as line:
            waiting = [await line.wait("0"), await line.wait("lost")]
            await line.go()
            for one in waiting:
                assert str(await answer(one)).startswith("the device is lost: CUDA error")
            assert server.lost is not None

    served(test, policy_class=BatchingFakePolicy)


@pytest.mark.usefixtures("pays")
def test_who_leaves_while_it_waits_is_in_no_batch() -> None:
    async def test(server: PolicyServer, policy: BatchingFakePolicy) -> None:
        async with Line(server, policy) as line:
            waiting = [await line.wait(str(number)) for number in range(3)]
            await waiting[1].close()
            await eventually(lambda: metric(server, "turbopi_queue_depth") == 2)
            await line.go()
            assert [await prompt_of(waiting[at]) for at in (0, 2)] == ["0", "2"]
            assert policy.batches == [["0", "2"]]

    served(test, policy_class=BatchingFakePolicy)


@pytest.mark.usefixtures("pays")
def test_company_is_waited_for_and_who_waits_for_it_is_served_without_it() -> None:
    """Four robots that ask together: the first one's request waits for the others, not for ever."""

    async def test(server: PolicyServer, policy: BatchingFakePolicy) -> None:
        async with contextlib.AsyncExitStack() as stack:
            robots = [await stack.enter_async_context(client(server)) for _ in range(4)]
            for step in range(30):
                for robot in robots:
                    await robot.send(pack(observation(str(step))))
                assert [await prompt_of(robot) for robot in robots] == [str(step)] * 4
            assert await prompt_of_one(robots[0]) == "alone"

    async def prompt_of_one(robot: ClientConnection) -> str:
        await robot.send(pack(observation("alone")))
        return await prompt_of(robot)

    served(test, policy_class=BatchingFakePolicy)


def test_batches_are_measured_at_warm_up_and_no_larger_ones_than_asked_for_are_run(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("turbopi.serve.calls.SIZE_SECONDS", float("inf"))
    policy = BatchingFakePolicy()
    with running(policy, max_batch=6) as server:
        assert times_of(server).sizes == [1, 2, 4, 6]
        assert {len(batch) for batch in policy.batches} == {2, 4, 6} and set(policy.seen) == {"example"}
    policy = BatchingFakePolicy()
    with running(policy) as server:
        assert times_of(server).sizes == [1, 2, 4, 8]
    policy = BatchingFakePolicy()
    with running(policy, max_batch=1):
        assert policy.seen == []


def test_batches_that_would_take_long_to_measure_are_not_formed() -> None:
    class Slow(BatchingFakePolicy):
        def infer(self, obs: dict[str, Any]) -> dict[str, Any]:
            time.sleep(0.7)
            return super().infer(obs)

    policy = Slow()
    with running(policy) as server:
        assert times_of(server).measured_largest == 1 and len(policy.seen) == 1


def test_a_size_that_fails_at_warm_up_is_left_out_or_refused_if_it_was_asked_for(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("turbopi.serve.calls.SIZE_SECONDS", float("inf"))

    class Small(BatchingFakePolicy):
        def infer_batch(self, observations: list[dict[str, Any]]) -> list[dict[str, Any]]:
            if len(observations) > 2:
                raise RuntimeError("out of memory")
            return super().infer_batch(observations)

    with running(Small()) as server:
        assert times_of(server).measured_largest == 2
    with (
        pytest.raises(ConfigError, match=r"batches of 4 fail: RuntimeError: out of memory. Choose a smaller --max-b"),
        running(Small(), max_batch=8),
    ):
        pass


def test_batches_that_do_not_pay_are_said(caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch) -> None:
    def measure_size(calls: PolicyCalls, size: int, times: BatchTimes, arguments: dict[str, Any]) -> bool:
        for _ in range(3):
            times.measured(size, 0.01 * size)
        return True

    monkeypatch.setattr(PolicyCalls, "_measure_size", measure_size)
    with running(BatchingFakePolicy(), max_batch=4):
        pass
    assert "--max-batch is 4, but batches of this policy take as long as their observations one by one" in caplog.text
    assert "(ms by size: 1: 10.0, 2: 20.0, 4: 40.0)" in caplog.text


def test_a_table_of_single_calls_alone_is_not_logged(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(PolicyCalls, "_measure_size", lambda *of_a_slow_policy: False)
    with caplog.at_level(logging.INFO, "turbopi"), running(BatchingFakePolicy()):
        pass
    assert "by their size" not in caplog.text


@pytest.mark.parametrize(
    ("policy", "options", "text"),
    [
        (FakePolicy, {"max_batch": 2}, "max_batch=2 was asked for, but this policy has no infer_batch and no ex"),
        (PipelinedFakePolicy, {"max_batch": 2}, "this policy is pipelined, and takes one observation at a time"),
        (FakePolicy, {"max_batch": 0}, "max_batch=0 should be from 1 to 64"),
        (FakePolicy, {"max_batch": 65}, "max_batch=65 should be from 1 to 64"),
        (FakePolicy, {"deadline_ms": 0}, "deadline_ms=0 should be more than 0 and at most 60000"),
        (FakePolicy, {"deadline_ms": float("nan")}, "deadline_ms=nan should be more than 0"),
        (
            Joins,
            {"max_batch": 2, "execution": "rtc", "control_hz": 50},
            "runs requests that join a chunk one by one, a",
        ),
    ],
)
def test_options_that_cannot_be_right_are_refused(policy: Any, options: dict[str, Any], text: str) -> None:
    with pytest.raises(ConfigError, match=text):
        PolicyServer(policy(), **options)
    assert PolicyServer(FakePolicy(), max_batch=1).options.max_batch == 1


def test_a_fault_of_the_server_on_the_thread_leaves_nobody_waiting() -> None:
    def run(turn: tuple[Request, ...]) -> Ran:
        raise ZeroDivisionError("a fault")

    async def main() -> None:
        worker = Worker(Schedule(4), run)
        answers = [worker.submit(Request(0.0, 1.0)) for _ in range(2)]
        for answer in answers:
            (result,) = await asyncio.wait_for(answer, 60)
            assert result.error == "policy" and "ZeroDivisionError: a fault" in result.text
        worker.stop()
        await worker.drain()
        (result,) = await worker.submit(Request(0.0, 1.0))
        assert result.error == "stopping" and not worker.running
        worker.close()

    asyncio.run(main())


# --- batch messages ---------------------------------------------------------------------------------------------------


def batch(rows: int, **keys: Any) -> dict[str, Any]:
    """Observations whose state is their row's number."""
    return {
        "observation/image": np.zeros((rows, 2, 2, 3), np.uint8),
        "observation/state": np.repeat(np.arange(rows, dtype=np.float64)[:, None], 8, axis=1),
        "prompt": [f"row {number}" for number in range(rows)],
        "turbopi/batch": rows,
        **keys,
    }


@pytest.mark.usefixtures("pays")
def test_a_batch_message_is_answered_with_the_chunks_of_its_rows() -> None:
    async def test(server: PolicyServer, policy: BatchingFakePolicy) -> None:
        async with client(server) as connection:
            reply = await infer(connection, batch(11))
            assert reply["actions"].shape == (11, 2, 8)
            np.testing.assert_array_equal(reply["actions"][:, 1, 3], np.arange(11))
            assert reply["prompt"] == [f"row {number}" for number in range(11)]
            assert [len(of) for of in policy.batches] == [8, 2] and policy.seen[-1] == "row 10"
            assert policy.observations["row 4"]["observation/image"].shape == (2, 2, 3)
            assert reply["policy_timing"] == {"infer_ms": 3.0}  # of its three runs
            assert reply["server_timing"].keys() == {"infer_ms", "batch"} and reply["server_timing"]["batch"] == 8
            shared = await infer(connection, {**batch(2), "prompt": "both"})
            assert shared["prompt"] == ["both", "both"]
            assert metric(server, "turbopi_scheduled_requests_total", priority="simulator") == 2
            assert metric(server, "turbopi_requests_total") == 2

    served(test, policy_class=BatchingFakePolicy)


def test_a_policy_without_batches_runs_the_rows_one_by_one() -> None:
    async def test(server: PolicyServer, policy: FakePolicy) -> None:
        async with client(server) as connection:
            reply = await infer(connection, batch(3))
            assert reply["actions"].shape == (3, 2, 8) and policy.seen == ["row 0", "row 1", "row 2"]

    for policy_class in (FakePolicy, PipelinedFakePolicy):
        served(test, policy_class=policy_class)


@pytest.mark.usefixtures("pays")
@pytest.mark.parametrize("rows", [3, 12])
def test_the_row_that_is_wrong_is_named(rows: int) -> None:
    async def test(server: PolicyServer, policy: BatchingFakePolicy) -> None:
        async with client(server) as connection:
            bad = batch(rows)
            bad["observation/state"][2] = np.nan
            text = await refused(connection, pack(bad))
            assert text.startswith(f"bad observation: row 2 of {rows} (from 0): observation/state holds nan")
            prompts = [*bad["prompt"][:-1], "nan actions"]
            text = await refused(connection, pack({**batch(rows), "prompt": prompts}))
            assert text.startswith(f"bad actions: row {rows - 1} of {rows} (from 0): the actions hold nan")
            assert (await infer(connection, batch(rows)))["actions"].shape[0] == rows

    served(test, policy_class=BatchingFakePolicy)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"turbopi/batch": 4}, r"'observation/image' has shape \[3, 2, 2, 3\], but turbopi/batch is 4"),
        ({"prompt": ["a", "b"]}, "'prompt' has 2 texts, but turbopi/batch is 3"),
        ({"prompt": ["a", "b", 3]}, r"'prompt' is a list; in a batch it should be an array \[3, …\]"),
        ({"images": {"left": np.zeros((2, 4))}}, r"'images/left' has shape \[2, 4\]"),
        ({"turbopi/batch": 0}, f"turbopi/batch is 0; it should be a whole number from 1 to {MAX_BATCH_ROWS}"),
        ({"turbopi/batch": MAX_BATCH_ROWS + 1}, "turbopi/batch is 1025"),
        ({"turbopi/batch": 2.0}, "turbopi/batch is 2.0"),
        ({"turbopi/session": "a"}, "turbopi/batch and turbopi/session were both given"),
        ({"turbopi/model_actions": True}, "turbopi/batch and turbopi/model_actions were both given"),
    ],
)
def test_a_batch_message_that_cannot_be_meant_is_refused(change: dict[str, Any], text: str) -> None:
    async def test(server: PolicyServer, policy: FakePolicy) -> None:
        async with client(server) as connection:
            await connection.send(pack({**batch(3), **change}))
            reply = str(await answer(connection))
            assert reply.startswith("bad observation: ")
            assert re.search(text, reply), reply
            assert policy.seen == []

    served(test)


def test_a_server_that_joins_chunks_or_is_strict_refuses_what_it_cannot_do_at_once() -> None:
    async def joins(server: PolicyServer, policy: HoldingJoins) -> None:
        async with client(server) as connection:
            message = pack({"place": np.zeros(2), "turbopi/batch": 2})
            assert "joins each client's chunks (--execution): a batch joins none" in await refused(connection, message)

    served(joins, policy_class=HoldingJoins, execution="rtc", control_hz=50)  # type: ignore[arg-type]

    class Strict(BatchingFakePolicy):
        def __init__(self) -> None:
            super().__init__()
            self.metadata["strict"] = True

    async def strict(server: PolicyServer, policy: Strict) -> None:
        async with client(server) as connection:
            text = await refused(connection, pack(batch(5)))
            assert "turbopi/batch is 5, and the largest batch that warm-up covered is 4" in text
            assert (await infer(connection, batch(4)))["actions"].shape[0] == 4

    served(strict, policy_class=Strict, max_batch=4)


def test_others_have_their_turn_between_the_rows_of_a_message() -> None:
    async def test(server: PolicyServer, policy: FakePolicy) -> None:
        many = batch(20, **{"turbopi/priority": "robot"})
        many["prompt"][0] = "hold"
        async with client(server) as simulator, client(server) as robot, client(server) as other:
            await simulator.send(pack(many))
            await eventually(policy.started.is_set)
            for number, one in enumerate((robot, other)):
                await one.send(pack(observation(f"between {number}")))
                await eventually(lambda waits=number + 1: metric(server, "turbopi_queue_depth") == waits)  # type: ignore[misc]
            policy.release.set()
            assert [await prompt_of(one) for one in (robot, other)] == ["between 0", "between 1"]
            assert isinstance(await answer(simulator), dict)
            assert policy.seen[:4] == ["hold", "between 0", "between 1", "row 1"]

    served(test)


def test_the_parts_of_a_message_keep_its_place_and_know_what_comes_later() -> None:
    made: list[Request] = []

    def make(rows: int, later: int) -> Request:
        made.append(Request(0.0, 1.0, rows=rows, later=later))
        return made[-1]

    async def main() -> None:
        calls = PolicyCalls(FakePolicy(), ServerOptions(), Metrics(), lambda reason: None)
        results = await calls.submit_batch(make, lambda index: observation(str(index)), 3)
        assert [result.answer["prompt"] for result in results if result.answer] == ["0", "1", "2"]
        calls.worker.close()

    asyncio.run(main())
    assert [(part.continued, part.later) for part in made] == [(False, 2), (True, 1), (True, 0)]


def test_a_pipelined_policys_times_are_learned_from_its_answers() -> None:
    async def test(server: PolicyServer, policy: PipelinedFakePolicy) -> None:
        async with client(server) as connection:
            reply = await infer(connection, observation("one"))
        seconds = times_of(server).seconds(1, time.perf_counter())
        assert seconds is not None and seconds * 1e3 == pytest.approx(reply["server_timing"]["infer_ms"])

    served(test, policy_class=PipelinedFakePolicy)


def test_a_message_whose_client_left_or_whose_server_stops_runs_no_more_rows() -> None:
    async def leaves(server: PolicyServer, policy: FakePolicy) -> None:
        async with client(server) as simulator:
            await simulator.send(pack({**batch(5), "prompt": ["hold", *"1234"]}))
            await eventually(policy.started.is_set)
        await eventually(lambda: metric(server, "turbopi_clients") == 0)
        policy.release.set()
        async with client(server) as other:
            await infer(other, observation("other"))
        assert policy.seen == ["hold", "other"]

    served(leaves)

    async def stops(server: PolicyServer, policy: FakePolicy) -> None:
        async with client(server) as simulator:
            await simulator.send(pack({**batch(5), "prompt": ["hold", *"1234"]}))
            await eventually(policy.started.is_set)
            stopping = asyncio.create_task(server.stop())
            await asyncio.sleep(0)
            policy.release.set()
            assert await answer(simulator) == "the server is shutting down"
            await stopping
        assert policy.seen == ["hold"]

    async def main() -> None:
        policy = FakePolicy()
        server = PolicyServer(policy, port=0)
        await server.start()
        await asyncio.wait_for(stops(server, policy), 60)

    asyncio.run(main())


def test_a_late_message_of_many_rows_says_all_of_them() -> None:
    async def test(server: PolicyServer, policy: FakePolicy) -> None:
        for _ in range(3):
            times_of(server).measured(1, 0.01)
        async with client(server) as connection:
            text = await refused(connection, pack(batch(20, **{"turbopi/deadline_ms": 150})))
            assert "200.0 ms in the policy), but its deadline is 150.0 ms" in text
            assert metric(server, "turbopi_refused_requests_total", kind="late", priority="simulator") == 1
            assert policy.seen == []

    served(test)


def test_a_batch_message_is_recorded_as_the_calls_of_its_rows(tmp_path: Path) -> None:
    async def test(server: PolicyServer, policy: FakePolicy) -> None:
        async with client(server) as connection:
            await infer(connection, batch(3))

    served(test, record_dir=tmp_path)
    calls = list(iter_recording(tmp_path))
    assert [obs["prompt"] for obs, _ in calls] == ["row 0", "row 1", "row 2"]
    for number, (obs, actions) in enumerate(calls):
        assert obs["observation/image"].shape == (2, 2, 3) and actions.shape == (2, 8)
        assert (obs["observation/state"] == number).all() and (actions == number).all()


def test_rows_and_their_results_are_views_and_stacks() -> None:
    both = {"a": np.arange(4).reshape(2, 2), "in": {"text": ["x", "y"]}, "rate": 5.0, "none": None, "n": np.float32(1)}
    check_batch_shapes(both, 2)
    second = batch_row(both, 1)
    assert second["in"] == {"text": "y"} and second["rate"] == 5.0 and second["none"] is None and second["n"] == 1
    np.testing.assert_array_equal(second["a"], [2, 3])
    assert np.shares_memory(second["a"], both["a"])
    found = stack_answers(
        [{"a": np.zeros(2), "b": {"c": np.ones(3)}, "d": np.zeros(n), "e": n, "only": 1} for n in (1, 2)]
    )
    assert found["a"].shape == (2, 2) and found["b"]["c"].shape == (2, 3) and found["e"] == [1, 2]
    assert isinstance(found["d"], list)


# --- what a request says of itself ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("keys", "scheduling"),
    [
        ({}, SchedulingOptions(1.0)),
        ({"deadline_ms": 80}, SchedulingOptions(0.08, True)),
        ({"deadline_ms": np.float32(0.5)}, SchedulingOptions(0.0005, True)),
        ({"deadline_ms": np.array(60_000)}, SchedulingOptions(60.0, True)),
        ({"control_hz": 50, "left": 20}, SchedulingOptions(0.4, True)),
        ({"left": 20}, SchedulingOptions(0.8, True)),  # at the server's 25 Hz
        ({"control_hz": 1, "left": 100_000}, SchedulingOptions(60.0, True)),
        ({"priority": "simulator"}, SchedulingOptions(1.0, priority="simulator")),
        ({"batch": 3}, SchedulingOptions(1.0, priority="simulator", batch=3)),
        ({"batch": 3, "priority": "robot", "deadline_ms": 50}, SchedulingOptions(0.05, True, "robot", 3)),
    ],
)
def test_a_requests_scheduling_options_are_read(keys: dict[str, Any], scheduling: SchedulingOptions) -> None:
    received = {"x": 1, **{f"turbopi/{key}": value for key, value in keys.items()}}
    assert read_scheduling(received, 1000.0, 25.0) == scheduling


@pytest.mark.parametrize(
    ("keys", "text"),
    [
        ({"deadline_ms": 0}, "turbopi/deadline_ms is 0: that has passed when the request comes"),
        ({"deadline_ms": -5}, "turbopi/deadline_ms is -5: that has passed"),
        ({"deadline_ms": 60_001}, "turbopi/deadline_ms is 60001; it should be a number, more than 0 and at most 60000"),
        ({"deadline_ms": float("nan")}, "turbopi/deadline_ms is nan"),
        ({"deadline_ms": float("inf")}, "turbopi/deadline_ms is inf"),
        ({"deadline_ms": "50"}, "turbopi/deadline_ms is '50'"),
        ({"deadline_ms": True}, "turbopi/deadline_ms is True"),
        ({"deadline_ms": np.ones(2)}, "turbopi/deadline_ms is array"),
        ({"deadline_ms": None}, "turbopi/deadline_ms is None"),
        ({"deadline_ms": 10**400}, "turbopi/deadline_ms is 1000"),
        ({"deadline_ms": 50, "left": 5}, "turbopi/deadline_ms and turbopi/left were both given"),
        ({"deadline_ms": 50, "control_hz": 5}, "turbopi/deadline_ms and turbopi/control_hz were both given"),
        ({"control_hz": 50}, "turbopi/control_hz came without turbopi/left"),
        ({"control_hz": 0, "left": 5}, "turbopi/control_hz is 0; it should be more than 0"),
        ({"control_hz": 20_000, "left": 5}, "turbopi/control_hz is 20000"),
        ({"left": 5}, "turbopi/left came without turbopi/control_hz"),
        ({"left": 0, "control_hz": 50}, "turbopi/left is 0, so the deadline has passed when the request comes"),
        ({"left": -1, "control_hz": 50}, "turbopi/left is -1; it should be a whole number from 0"),
        ({"left": 1.5, "control_hz": 50}, "turbopi/left is 1.5"),
        ({"priority": "high"}, "turbopi/priority is 'high'; it should be one of robot, simulator"),
        ({"priority": np.zeros(2)}, "turbopi/priority is array"),
        ({"priority": ["robot"]}, "turbopi/priority is .'robot'"),
    ],
)
def test_scheduling_options_that_cannot_be_right_are_refused(keys: dict[str, Any], text: str) -> None:
    with pytest.raises(ObservationError, match=text):
        read_scheduling({"x": 1, **{f"turbopi/{key}": value for key, value in keys.items()}}, 1000.0)


anything = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(-(2**63), 2**64 - 1),
    st.floats(),
    st.text(max_size=5),
    st.binary(max_size=5),
    st.lists(st.integers(), max_size=2),
    st.dictionaries(st.text(max_size=2), st.integers(), max_size=2),
    st.sampled_from(["robot", "simulator"]),
    st.builds(
        lambda dtype, shape: np.zeros(shape, dtype),
        st.sampled_from(["f4", "f8", "i4", "u8", "?", "U3", "S3", "M8[s]", "m8[s]", "f2"]),
        st.sampled_from([(), (0,), (1,), (2, 3)]),
    ),
    st.sampled_from([np.timedelta64(5, "s"), np.datetime64(5, "s"), np.float16(5), np.uint8(5), np.bool_(True)]),
)


@settings(max_examples=300, deadline=None)
@given(st.dictionaries(st.sampled_from(SCHEDULING_KEYS), anything), st.dictionaries(st.text(max_size=3), anything))
def test_whatever_the_keys_hold_it_is_meant_or_refused(keys: dict[str, Any], entries: dict[str, Any]) -> None:
    received = {**entries, **{f"turbopi/{key}": value for key, value in keys.items()}}
    try:
        scheduling = read_scheduling(received, 1000.0)
        if scheduling.batch is not None:
            check_batch_shapes(entries, scheduling.batch)
            batch_row(entries, scheduling.batch - 1)
    except ObservationError:
        return
    assert 0 < scheduling.deadline <= 60 and scheduling.priority in ("robot", "simulator")
    assert scheduling.batch is None or 1 <= scheduling.batch <= MAX_BATCH_ROWS


def test_such_a_refusal_is_a_text_frame_and_the_connection_stays() -> None:
    async def test(server: PolicyServer, policy: FakePolicy) -> None:
        async with client(server) as connection:
            text = await refused(connection, asks("never", deadline_ms=-1))
            assert text.startswith("bad observation: turbopi/deadline_ms is -1")
            text = await refused(connection, asks("never", deadlin_ms=5))
            assert "turbopi/deadlin_ms is no key of this server" in text and "turbopi/deadline_ms" in text
            assert (await infer(connection, observation("on")))["prompt"] == "on"
            assert policy.seen == ["on"]

    served(test)


# --- a real policy ----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def small() -> UnifiedPolicy:
    policy: Any = UnifiedPolicy(CHASE_POLICY, backend="pytorch", precision="f32", device="cpu", num_denoising_steps=2)
    drawn = policy._noise

    def noise(rows: int, horizon: int, given: Any, seed: Any) -> np.ndarray:
        return drawn(rows, horizon, None, [0] * rows)

    policy._noise = noise  # the same for every row
    return policy


@pytest.mark.usefixtures("pays")
def test_a_real_policys_actions_are_those_of_its_observation_in_any_company(small: UnifiedPolicy) -> None:
    observations = [small.example_observation(seed) for seed in range(4)]
    expected = [small.infer(one)["actions"] for one in observations]
    sizes: set[int] = set()

    async def main() -> None:
        async with PolicyServer(small, port=0, max_batch=4) as server:

            async def robot(number: int) -> None:
                async with client(server) as connection:
                    for _ in range(3):
                        reply = await infer(connection, observations[number])
                        np.testing.assert_allclose(reply["actions"], expected[number], rtol=0, atol=2e-5)
                        sizes.add(reply["server_timing"].get("batch", 1))

            await asyncio.gather(*(robot(number) for number in range(4)))
            together: dict[str, Any] = {
                key: np.stack([one[key] for one in observations])
                if isinstance(value, np.ndarray)
                else [one[key] for one in observations]
                for key, value in observations[0].items()
            }
            async with client(server) as simulator:
                reply = await infer(simulator, {**together, "turbopi/batch": 4})
                assert reply["actions"].shape == np.stack(expected).shape
                np.testing.assert_allclose(reply["actions"], np.stack(expected), rtol=0, atol=2e-5)
                assert reply["policy_timing"]["total_ms"] > 0
                together["observation/state"] = together["observation/state"].copy()
                together["observation/state"][3, 0] = np.nan
                text = await refused(simulator, pack({**together, "turbopi/batch": 4}))
                assert text.startswith("bad observation: row 3 of 4 (from 0): ")

    asyncio.run(main())
    assert max(sizes) > 1, "nothing ran together"
