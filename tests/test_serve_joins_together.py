"""Sessions that join chunks run together: which requests may, what is measured, and that each gets its own answer."""

import asyncio
import contextlib
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import pytest
from test_begin import OnCpu
from test_running_chunk import trained_policy
from test_serve_real_time import H
from test_serve_schedule import PAYING, SERIAL, begin, closed_loop, request, table
from test_serve_server import client, eventually, metric, served
from test_serve_several import HoldingJoins, answer
from websockets.asyncio.client import ClientConnection

from turbopi.realtime.running_chunk import RunningChunk
from turbopi.realtime.wire import pack
from turbopi.serve import PolicyServer, running
from turbopi.serve.calls import PolicyCalls
from turbopi.serve.metrics import Metrics
from turbopi.serve.scheduling.batch_times import BatchTimes
from turbopi.serve.scheduling.schedule import Request, Schedule
from turbopi.support.errors import ConfigError, ObservationError

pytestmark = pytest.mark.usefixtures("two_layers")

GUIDED: dict[str, Any] = {"execution": "rtc", "control_hz": 50.0}


class Together(HoldingJoins):
    """Has `infer_batch`; `batches` are the modes of each, None for one that joins nothing."""

    batch_modes: tuple[str, ...] = ("rtc", "rtc_trained")

    def __init__(self) -> None:
        super().__init__()
        self.batches: list[list[str | None]] = []
        self.fault: type[Exception] | None = None

    def example_observation(self) -> dict[str, Any]:
        return {"place": 0}

    def infer(self, obs: Any, *, seed: int | None = None, **arguments: Any) -> dict[str, Any]:
        return super().infer(obs, **arguments)

    def infer_batch(
        self,
        observations: Sequence[Mapping[str, Any]],
        *,
        previous: Sequence[RunningChunk | None] = (),
        model_actions: Sequence[bool] = (),
    ) -> list[dict[str, Any]]:
        count = len(observations)
        chunks, reported = previous or [None] * count, model_actions or [False] * count
        self.batches.append([None if one is None else one.mode for one in chunks])
        if self.fault is not None:
            raise self.fault("a batch")
        rows = zip(observations, chunks, reported, strict=True)
        return [self.infer(obs, previous=chunk, model_actions=wants) for obs, chunk, wants in rows]


@pytest.fixture
def pays(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The tables T(B) say that batches pay, of those that join chunks twice as long."""

    def measure(calls: PolicyCalls) -> None:
        for times, factor in ((calls.times, 1), (calls.joining, 2)):
            for size, seconds in PAYING.items():
                if size <= times.largest:
                    times.measured(size, factor * seconds)

    with monkeypatch.context() as patch:
        patch.setattr(PolicyCalls, "_measure", measure)
        patch.setattr(BatchTimes, "ran", lambda self, rows, seconds, now: None)
        yield


class Robots:
    """Sessions whose next requests wait behind one that holds the policy."""

    def __init__(self, server: PolicyServer, policy: Together, count: int) -> None:
        self.server, self.policy, self.count, self.stack = server, policy, count, contextlib.AsyncExitStack()
        self.all: list[ClientConnection] = []

    async def __aenter__(self) -> "Robots":
        for number in range(self.count):
            self.all.append(await self.stack.enter_async_context(client(self.server)))
            await self.ask(number, 10 * number, step=0, delay=1)
            assert isinstance(await answer(self.all[number]), dict)
        holder = await self.stack.enter_async_context(client(self.server))
        await holder.send(pack({"place": 0, "hold": True}))
        await eventually(self.policy.started.is_set)
        return self

    async def __aexit__(self, *of: object) -> None:
        self.policy.release.set()
        await self.stack.aclose()

    async def ask(self, number: int, place: float, bad: bool = False, **keys: Any) -> None:
        obs = {"place": place, **({"bad": True} if bad else {})}
        await self.all[number].send(pack({**obs, **{f"turbopi/{key}": value for key, value in keys.items()}}))

    async def answers(self, waiting: int) -> list[dict[str, Any] | str]:
        await eventually(lambda: metric(self.server, "turbopi_queue_depth") == waiting)
        self.policy.batches.clear()
        self.policy.release.set()
        return [await answer(one) for one in self.all]


@pytest.mark.usefixtures("pays")
def test_sessions_run_together_and_each_joins_its_own_chunk() -> None:
    async def test(server: PolicyServer, policy: Together) -> None:
        async with Robots(server, policy, 4) as robots:
            for number in range(4):
                await robots.ask(number, 10 * number + 3, step=3, delay=number)
            replies = await robots.answers(4)
            assert policy.batches == [["rtc"] * 4]
            for number, reply in enumerate(replies):
                assert isinstance(reply, dict) and reply["server_timing"]["batch"] == 4
                assert reply["real_time"]["joined"] and reply["real_time"]["delay"] == number
                np.testing.assert_array_equal(reply["actions"][:, 0], np.arange(H) + 10 * number + 3)
                assert "model_actions" not in reply
            lefts = [one.left_over[0, 0] for one in policy.calls[-4:] if one is not None]
            assert lefts == [3, 13, 23, 33], "what is left of each one's own"

    served(test, policy_class=Together, **GUIDED)  # type: ignore[arg-type]


@pytest.mark.usefixtures("pays")
def test_who_joins_nothing_yet_or_at_all_runs_beside_those_that_do() -> None:
    async def test(server: PolicyServer, policy: Together) -> None:
        async with Robots(server, policy, 4) as robots:
            await robots.ask(0, 1, step=1, delay=1)
            await robots.ask(1, 2, step=0, delay=1, reset=True)
            await robots.ask(2, 3, session="c", mode="none")
            await robots.ask(3, 4, session="d", mode="rtc", step=4, delay=1, model_actions=True)
            replies = await robots.answers(4)
            assert policy.batches == [["rtc", None, None, None]]
            joined = [reply.get("real_time", {}).get("joined") for reply in replies]  # type: ignore[union-attr]
            assert joined == [True, False, None, False]
            assert ["model_actions" in reply for reply in replies] == [False, False, False, True]

    served(test, policy_class=Together, **GUIDED)  # type: ignore[arg-type]


@pytest.mark.usefixtures("pays")
def test_another_mode_or_a_seed_runs_alone() -> None:
    """No such batch was measured; and who gives a seed wants the same answer every time."""

    async def test(server: PolicyServer, policy: Together) -> None:
        async with Robots(server, policy, 4) as robots:
            await robots.ask(0, 1, step=1, delay=1)
            await robots.ask(1, 2, step=1, delay=1)
            await robots.ask(2, 3, step=1, delay=1, mode="rtc_trained")
            await robots.ask(3, 4, step=1, delay=1, seed=7)
            assert all(isinstance(reply, dict) for reply in await robots.answers(4))
            assert policy.batches == [["rtc", "rtc"]]

    served(test, policy_class=Together, **GUIDED)  # type: ignore[arg-type]


@pytest.mark.usefixtures("pays")
def test_without_execution_requests_that_join_run_alone() -> None:
    async def test(server: PolicyServer, policy: Together) -> None:
        async with client(server) as one, client(server) as other, client(server) as holder:
            await holder.send(pack({"place": 0, "hold": True}))
            await eventually(policy.started.is_set)
            for connection in (one, other):
                await connection.send(pack({"place": 1, "turbopi/model_actions": True}))
            await eventually(lambda: metric(server, "turbopi_queue_depth") == 2)
            policy.release.set()
            assert isinstance(await answer(one), dict) and isinstance(await answer(other), dict)
            assert policy.batches == []

    served(test, policy_class=Together)  # type: ignore[arg-type]


@pytest.mark.usefixtures("pays")
@pytest.mark.parametrize("fault", [None, ObservationError, RuntimeError])
def test_one_that_spoils_a_batch_does_not_take_the_others_chunks(fault: type[Exception] | None) -> None:
    async def test(server: PolicyServer, policy: Together) -> None:
        async with Robots(server, policy, 4) as robots:
            policy.fault = fault
            for number in range(4):
                await robots.ask(number, 10 * number + 3, bad=fault is None and number == 2, step=3, delay=1)
            replies = await robots.answers(4)
            assert policy.batches == [["rtc"] * 4]
            for number, reply in enumerate(replies):
                if fault is None and number == 2:
                    assert isinstance(reply, str) and reply.startswith("bad actions: ")
                else:
                    assert isinstance(reply, dict) and reply["real_time"]["joined"]
            assert isinstance(server._calls, PolicyCalls)
            assert server._calls.joining.formed_largest(0.0) == (2 if fault is RuntimeError else 8)
            assert server._calls.times.measured_largest == 8

    served(test, policy_class=Together, **GUIDED)  # type: ignore[arg-type]


def test_batches_that_join_are_measured_on_a_chunk_of_the_servers_mode(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("turbopi.serve.calls.SIZE_SECONDS", float("inf"))
    policy = Together()
    with running(policy, max_batch=4, execution="rtc_trained", control_hz=50) as server:
        assert isinstance(server._calls, PolicyCalls)
        assert server._calls.times.sizes == server._calls.joining.sizes == [1, 2, 4]
        assert policy.warm[0]["real_time"] == "rtc_trained"
    assert {(len(batch), batch[0]) for batch in policy.batches} == {
        *((2, None), (4, None)),
        *((2, "rtc_trained"), (4, "rtc_trained")),
    }
    chunks = [one for one in policy.calls if one is not None]
    assert {(len(one.left_over), one.delay, one.mode) for one in chunks} == {(H, 1, "rtc_trained")}


def test_a_size_that_fails_where_chunks_are_joined_leaves_the_plain_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("turbopi.serve.calls.SIZE_SECONDS", float("inf"))

    class Small(Together):
        def infer_batch(self, observations: Any, **arguments: Any) -> list[dict[str, Any]]:
            if len(observations) > 2 and any(arguments.get("previous", ())):
                raise RuntimeError("out of memory")
            return super().infer_batch(observations, **arguments)

    with running(Small(), **GUIDED) as server:
        assert isinstance(server._calls, PolicyCalls)
        assert (server._calls.times.measured_largest, server._calls.joining.measured_largest) == (8, 2)
    with (
        pytest.raises(ConfigError, match="batches that join chunks of 4 fail: RuntimeError: out of memory"),
        running(Small(), max_batch=4, **GUIDED),
    ):
        pass


@pytest.mark.parametrize("mode", ["rtc_identity", "rtc"])
def test_a_policy_whose_batches_do_not_join_in_the_servers_mode_forms_none(mode: str) -> None:
    class Fewer(Together):
        batch_modes = ("rtc_trained",)

    class Silent(Together):
        batch_modes = ()

    for kind in (Fewer, Silent):
        calls = PolicyServer(kind(), execution=mode, control_hz=50)._calls
        assert isinstance(calls, PolicyCalls) and calls.times.largest == calls.joining.largest == 1
        with pytest.raises(ConfigError, match=r"max_batch=4 was asked for, but this policy runs .* one by one"):
            PolicyServer(kind(), execution=mode, control_hz=50, max_batch=4)


# --- whose turn it is -------------------------------------------------------------------------------------------------


def joining(**how: Any) -> Request:
    one = request(**how)
    one.joins = True
    return one


def line(*requests: Request, joins: dict[int, float] | None = None) -> Schedule:
    schedule = Schedule(16, table(PAYING), joining=table(joins or {size: 2 * s for size, s in PAYING.items()}))
    for one in requests:
        assert schedule.add(one, 0.0) == []
    return schedule


def test_a_run_in_which_some_join_is_timed_as_those_that_do() -> None:
    """Four of them take 44 ms: then three plain ones keep the first one's deadline, and four don't."""
    requests = [joining(within=0.050, firm=True), *(request() for _ in range(3))]
    schedule = line(*requests)
    assert begin(schedule, 0.0) == requests
    (late,) = schedule.add(request(within=0.053, firm=True), 0.0)
    assert "(44.0 ms until its turn, 10.0 ms in the policy)" in late.text
    tight = [joining(within=0.030, firm=True), *(request() for _ in range(3))]
    assert begin(line(*tight), 0.0) == tight[:2], "two take 28 ms"


def test_where_joining_does_not_pay_plain_ones_run_without_it() -> None:
    plain, other = [request() for _ in range(2)], joining()
    serial = {size: 2 * seconds for size, seconds in SERIAL.items()}
    schedule = line(plain[0], other, plain[1], joins=serial)
    assert begin(schedule, 0.0) == plain
    schedule.freed(0.014, 0.014)
    assert begin(schedule, 0.014) == [other]


def test_times_of_what_ran_go_into_the_table_of_its_kind() -> None:
    schedule = line(joining(), request(), joining(), request())
    assert len(begin(schedule, 0.0)) == 4
    schedule.freed(0.5, 0.5)
    for _ in range(2):
        for one in (joining(), request(), joining(), request()):
            schedule.add(one, 0.5)
        begin(schedule, 0.5)
        schedule.freed(0.5, 0.5)
    assert schedule._joining.seconds(4, 0.5) == 0.5 and schedule.times.seconds(4, 0.5) == PAYING[4]


@pytest.mark.parametrize("late", [0, 1, 4])
def test_sessions_that_ask_again_at_once_are_waited_for_by_the_times_of_those_that_join(late: int) -> None:
    returns = [0.002 + 0.0004 * number for number in range(8)]
    begins = [0.02 if number < late else 0.0001 * number for number in range(8)]
    schedule = Schedule(16, table(SERIAL), joining=table(PAYING))
    rows = closed_loop(schedule, 2.0, returns, begins, joins=True)
    assert rows[12:] == [8] * (len(rows) - 12), rows


def test_sessions_are_not_waited_for_where_joining_together_does_not_pay() -> None:
    """Though plain ones would be: the policy is never idle."""
    rows = closed_loop(Schedule(16, table(PAYING), joining=table(SERIAL)), 2.0, [0.001] * 2, [0.0] * 2, joins=True)
    assert set(rows) == {1} and len(rows) >= 2.0 / SERIAL[1] - 1, len(rows)


# --- a real policy ----------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.usefixtures("pays")
@pytest.mark.parametrize("mode", ["rtc", "rtc_identity", "rtc_trained"])
def test_a_real_policys_joined_chunks_are_those_of_their_session_in_any_company(mode: str) -> None:
    policy: Any = trained_policy(OnCpu)
    policy.warmup = lambda **_: 0.0  # it would run every prompt length, as there are no graphs
    drawn = policy._noise
    policy._noise = lambda rows, horizon, given, seed: drawn(rows, horizon, None, [0] * rows)  # the same for every row
    observations = [policy.example_observation(seed) for seed in range(4)]
    expected = []
    for one in observations:
        first = policy.infer(one, model_actions=True)["model_actions"]
        expected.append(policy.infer(one, previous=RunningChunk(first[3:], 2, 5, mode))["actions"])  # type: ignore[arg-type]
    sizes: set[int] = set()

    async def ask(connection: ClientConnection, number: int, step: int) -> dict[str, Any]:
        keys = {"turbopi/delay": 2, "turbopi/execution_horizon": 5, "turbopi/step": step}
        await connection.send(pack({**observations[number], **keys}))
        reply = await answer(connection)
        assert isinstance(reply, dict), reply
        sizes.add(reply["server_timing"].get("batch", 1))
        return reply

    async def main() -> None:
        async with (
            PolicyServer(policy, port=0, max_batch=4, execution=mode, control_hz=50) as server,
            contextlib.AsyncExitStack() as stack,
        ):
            robots = [await stack.enter_async_context(client(server)) for _ in observations]
            for step in (0, 3):
                replies = await asyncio.gather(*(ask(one, number, step) for number, one in enumerate(robots)))
            for reply, actions in zip(replies, expected, strict=True):
                assert reply["real_time"]["joined"]
                np.testing.assert_allclose(reply["actions"], actions, rtol=0, atol=1e-4)

    asyncio.run(main())
    assert max(sizes) > 1, "nothing ran together"


def test_calls_without_a_server_measure_nothing_that_joins() -> None:
    from turbopi.serve import ServerOptions

    calls = PolicyCalls(Together(), ServerOptions(), Metrics(), on_lost=lambda reason: None)
    assert calls.joining.largest == 1 and calls.times.largest == 8
    calls.close()
