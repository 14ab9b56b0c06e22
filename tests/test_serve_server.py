"""The server, through its socket: openpi's protocol, its limits, and that it goes on whatever clients do."""

import asyncio
import contextlib
import gc
import logging
import os
import random
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from prometheus_client import Histogram
from prometheus_client.parser import text_string_to_metric_families
from serve_fakes import NO_CHUNKS, FakePolicy, PipelinedFakePolicy, http_get, observation
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed, ConnectionClosedError, InvalidStatus

from turbopi.realtime import RealTimeClient
from turbopi.realtime.wire import pack, unpack
from turbopi.recordings import iter_recording, load_call
from turbopi.serve import PolicyServer, ServerOptions, running
from turbopi.serve.launch import addresses
from turbopi.serve.limits import Limits
from turbopi.serve.requests import ClientLeft, ClientRequest, RequestHandler, Result
from turbopi.serve.server import SWITCH_SECONDS
from turbopi.support.errors import ConfigError, DeviceLost


def served(
    test: Callable[..., Awaitable[None]], *, policy_class: type[FakePolicy] = FakePolicy, **options: Any
) -> None:
    """Run `test(server, policy)` beside a server on a free port."""

    async def main() -> None:
        policy = policy_class()
        try:
            async with PolicyServer(policy, port=0, **options) as server:
                try:
                    await asyncio.wait_for(test(server, policy), 150)
                finally:
                    policy.release.set()
        finally:
            assert policy.overlaps == 0

    asyncio.run(main())


@contextlib.asynccontextmanager
async def client(server: PolicyServer, **options: Any) -> AsyncIterator[ClientConnection]:
    """A connection that has received its metadata."""
    async with connect(server.url, compression=None, max_size=None, **options) as connection:
        assert isinstance(await connection.recv(), bytes)
        yield connection


async def infer(connection: ClientConnection, obs: dict[str, Any]) -> dict[str, Any]:
    await connection.send(pack(obs))
    reply = await asyncio.wait_for(connection.recv(), 60)
    assert isinstance(reply, bytes), reply
    return dict(unpack(reply))


async def refused(connection: ClientConnection, message: bytes | str) -> str:
    """The text frame that answers `message`."""
    await connection.send(message)
    reply = await asyncio.wait_for(connection.recv(), 60)
    assert isinstance(reply, str), reply
    return reply


async def eventually(condition: Callable[[], bool]) -> None:
    for _ in range(6000):  # a minute: the machine may be busy
        if condition():
            return
        await asyncio.sleep(0.01)
    raise AssertionError("it never happened")


def metric(server: PolicyServer, name: str, **labels: str) -> float:
    value = server.metrics.registry.get_sample_value(name, labels)
    assert value is not None, name
    return value


# --- the protocol -----------------------------------------------------------------------------------------------------


def test_the_first_frame_is_the_metadata() -> None:
    async def test(server: PolicyServer, policy: FakePolicy) -> None:
        async with connect(server.url) as connection:
            frame = await connection.recv()
            assert isinstance(frame, bytes)
            assert unpack(frame) == policy.metadata
            assert connection.protocol.extensions == []  # no compression, though this client offers it

    served(test)


def test_a_request_gets_the_policys_result_and_server_timing() -> None:
    async def test(server: PolicyServer, policy: FakePolicy) -> None:
        async with client(server) as connection:
            first = await infer(connection, observation("one"))
            assert set(first) == {"actions", "policy_timing", "prompt", "server_timing"}
            np.testing.assert_array_equal(first["actions"], np.stack([observation()["observation/state"]] * 2))
            assert first["actions"].dtype == np.float64
            assert set(first["server_timing"]) == {"infer_ms"}
            second = await infer(connection, observation("two"))
            assert set(second["server_timing"]) == {"infer_ms", "prev_total_ms"}
            assert second["server_timing"]["infer_ms"] > 0
            assert second["server_timing"]["prev_total_ms"] >= first["server_timing"]["infer_ms"]

    served(test)


def test_infer_ms_is_the_policys_time_without_the_queue() -> None:
    async def test(server: PolicyServer, policy: FakePolicy) -> None:
        async with client(server) as first, client(server) as second:
            await first.send(pack(observation("hold")))
            await eventually(policy.started.is_set)
            await second.send(pack(observation("quick")))
            await eventually(lambda: metric(server, "turbopi_queue_depth") == 1)
            waiting = time.perf_counter()
            await asyncio.sleep(0.1)
            released = time.perf_counter()
            policy.release.set()
            slow, quick = unpack(bytes(await first.recv())), unpack(bytes(await second.recv()))  # type: ignore[arg-type]
            ended = time.perf_counter()
            assert slow["server_timing"]["infer_ms"] >= (released - waiting) * 1e3
            assert quick["server_timing"]["infer_ms"] <= (ended - released) * 1e3
            await eventually(lambda: metric(server, "turbopi_queue_seconds_count") == 2)
            assert metric(server, "turbopi_queue_seconds_sum") >= released - waiting

    served(test)


def test_clients_get_their_own_answers_one_inference_at_a_time_on_one_thread() -> None:
    async def test(server: PolicyServer, policy: FakePolicy) -> None:
        async def robot(number: int) -> None:
            async with client(server) as connection:
                for step in range(5):
                    reply = await infer(connection, observation(f"{number}/{step}"))
                    assert reply["prompt"] == f"{number}/{step}"

        await asyncio.gather(*(robot(number) for number in range(8)))
        assert policy.warmed_up
        assert len(policy.seen) == 40
        assert len(policy.threads) == 1

    served(test)


def test_requests_sent_ahead_are_answered_in_order() -> None:
    async def test(server: PolicyServer, policy: FakePolicy) -> None:
        async with client(server) as connection:
            for number in range(5):
                await connection.send(pack(observation(str(number))))
            replies = [unpack(bytes(await connection.recv())) for _ in range(5)]  # type: ignore[arg-type]
            assert [reply["prompt"] for reply in replies] == list("01234")

    served(test)


def test_requests_leave_nothing_running() -> None:
    async def test(server: PolicyServer, policy: FakePolicy) -> None:
        async with client(server) as connection:
            await infer(connection, observation())
            before = len(asyncio.all_tasks())
            for _ in range(20):
                await infer(connection, observation())
            assert len(asyncio.all_tasks()) <= before + 1

    served(test)


def test_a_client_may_come_back() -> None:
    async def test(server: PolicyServer, policy: FakePolicy) -> None:
        for number in range(3):
            async with client(server) as connection:
                reply = await infer(connection, observation(str(number)))
                assert set(reply["server_timing"]) == {"infer_ms"}  # a new connection has no previous call
        await eventually(lambda: metric(server, "turbopi_clients") == 0)

    served(test)


# --- the client's faults ----------------------------------------------------------------------------------------------

BAD_MESSAGES: dict[str, tuple[bytes | str, str]] = {
    "text": ("hello", "bad request: a request is a binary frame with a msgpack map, not a text frame"),
    "not msgpack": (b"\xc1\xc1", "bad request: not a msgpack message: byte 0 is 0xc1"),
    "json": (b'{"prompt": "x"}', "bad request: not a msgpack message"),
    "empty": (b"", "bad request: not a msgpack message: it ends after 0 bytes"),
    "not a map": (pack([1, 2]), "a request is a map of observation keys to values, not list"),
    "an array": (pack(np.zeros(3)), "a request is a map of observation keys to values, not ndarray"),
    "bytes keys": (pack({b"prompt": "x"}), "the keys of an observation are strings"),
    "missing key": (pack({"prompt": "x"}), "bad observation: the key 'observation/state' is missing"),
    "NaN state": (pack({**observation(), "observation/state": np.full(8, np.nan)}), "holds nan at \\[0\\]"),
    "wrong shape": (
        pack(observation()).replace(b"\xc4\x05shape\x91\x08", b"\xc4\x05shape\x91\x09"),
        "'observation/state': shape \\[9\\] of <f8 needs 72 bytes of data, but 64 came",
    ),
    "wrong dtype": (
        pack(observation()).replace(b"\xa3<f8", b"\xa3|O8"),
        "'observation/state': dtype '\\|O8' is refused: void, object and complex",
    ),
}


@pytest.mark.parametrize("name", BAD_MESSAGES)
def test_a_bad_message_gets_its_reason_and_the_connection_stays(name: str) -> None:
    message, reason = BAD_MESSAGES[name]

    async def test(server: PolicyServer, policy: FakePolicy) -> None:
        async with client(server) as connection:
            assert re.search(reason, await refused(connection, message))
            assert (await infer(connection, observation("after")))["prompt"] == "after"
            kind = "observation" if name in ("missing key", "NaN state") else "malformed"
            assert metric(server, "turbopi_errors_total", kind=kind) == 1
            assert metric(server, "turbopi_requests_total") == 2

    served(test)


def test_hundreds_of_random_messages_are_answered_on_one_connection() -> None:
    async def test(server: PolicyServer, policy: FakePolicy) -> None:
        generator = random.Random(0)
        valid = pack(observation())
        async with client(server) as connection:
            for _ in range(300):
                await refused(connection, b"\x81" + generator.randbytes(generator.randrange(60)))
                damaged = bytearray(valid)
                damaged[generator.randrange(len(valid))] ^= 1 << generator.randrange(8)
                await connection.send(bytes(damaged))
                await asyncio.wait_for(connection.recv(), 60)
            assert (await infer(connection, observation("after")))["prompt"] == "after"

    served(test, limits=Limits(work_rate=1e6))


def test_a_long_error_is_cut() -> None:
    async def test(server: PolicyServer, policy: FakePolicy) -> None:
        async with client(server) as connection:
            reply = await refused(connection, pack({f"key{i}": 1 for i in range(1900)}))
            assert reply.startswith("bad observation: the key 'observation/state' is missing")
            assert len(reply) == 4000

    served(test)


def test_a_message_over_the_limit_is_refused_with_1009_and_the_server_goes_on() -> None:
    async def test(server: PolicyServer, policy: FakePolicy) -> None:
        async with client(server) as connection:
            with pytest.raises(ConnectionClosedError) as closed:
                await refused(connection, pack({"x": np.zeros(2**20, np.uint8)}))
            assert closed.value.rcvd is not None
            assert closed.value.rcvd.code == 1009
            assert "524288" in closed.value.rcvd.reason  # the limit
        async with client(server) as connection:
            await infer(connection, observation())
        await eventually(lambda: metric(server, "turbopi_errors_total", kind="too_large") == 1)

    served(test, max_message_mb=0.5)


def test_a_full_queue_says_busy_and_the_connection_stays() -> None:
    async def test(server: PolicyServer, policy: FakePolicy) -> None:
        async with client(server) as running, client(server) as waiting, client(server) as third:
            await running.send(pack(observation("hold")))
            await eventually(policy.started.is_set)
            assert metric(server, "turbopi_inference_in_progress") == 1
            await waiting.send(pack(observation("waits")))
            await eventually(lambda: metric(server, "turbopi_queue_depth") == 1)
            reply = await refused(third, pack(observation("too much")))
            assert reply == "busy: 1 requests wait already (--queue-limit 1); try again"
            policy.release.set()
            await running.recv()
            await waiting.recv()
            await infer(third, observation("again"))
            assert policy.seen == ["hold", "waits", "again"]
            assert metric(server, "turbopi_errors_total", kind="busy") == 1
            # the answer is sent by the policy's thread, before the event loop knows that its turn has ended
            await eventually(lambda: metric(server, "turbopi_inference_in_progress") == 0)

    served(test, queue_limit=1)


@pytest.mark.parametrize(
    ("how", "said"),
    [("ends", r"disconnected"), ("closes", r"disconnected: it closed with 1000 \(OK\)")],
)
def test_the_log_says_plainly_who_came_and_left(how: str, said: str, caplog: pytest.LogCaptureFixture) -> None:
    """openpi's client ends without a closing message: nothing went wrong, and nothing is said of frames."""

    async def test(server: PolicyServer, policy: FakePolicy) -> None:
        async with client(server) as connection:
            await infer(connection, observation("one"))
            await eventually(lambda: metric(server, "turbopi_request_seconds_count") == 1)
            if how == "ends":
                connection.transport.close()
            else:
                await connection.close()
            await eventually(lambda: metric(server, "turbopi_clients") == 0)

    with caplog.at_level(logging.INFO, "turbopi"):
        served(test)
    reported = [message for message in caplog.messages if "connected" in message]
    assert len(reported) == 2
    assert re.fullmatch(r"127\.0\.0\.1:\d+ connected", reported[0])
    assert re.fullmatch(rf"127\.0\.0\.1:\d+ {said}", reported[1])


def test_an_answer_is_counted_before_it_is_sent(monkeypatch: pytest.MonkeyPatch) -> None:
    """The policy's thread does both: who reads the metrics behind an answer finds it there."""
    observe = Histogram.observe

    def late(self: Histogram, *arguments: Any) -> None:
        if threading.current_thread() is not threading.main_thread():
            time.sleep(0.05)
        observe(self, *arguments)

    async def test(server: PolicyServer, policy: FakePolicy) -> None:
        async with client(server) as connection:
            await infer(connection, observation("one"))
            for name in ("queue_seconds", "batch_size", "inference_seconds"):
                assert metric(server, f"turbopi_{name}_count") == 1, name

    monkeypatch.setattr(Histogram, "observe", late)
    served(test)


def test_who_leaves_with_its_answer_has_been_answered(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The policy's thread sends it: the client may be gone before the task of its connection wakes."""
    results_of = RequestHandler._results

    async def lost(self: RequestHandler, request: ClientRequest) -> list[Result]:
        await results_of(self, request)
        raise ClientLeft

    async def test(server: PolicyServer, policy: FakePolicy) -> None:
        async with client(server) as connection:
            await infer(connection, observation("one"))
        await eventually(lambda: metric(server, "turbopi_clients") == 0)
        assert metric(server, "turbopi_request_seconds_count") == 1
        assert metric(server, "turbopi_errors_total", kind="disconnected") == 0

    monkeypatch.setattr(RequestHandler, "_results", lost)
    with caplog.at_level(logging.INFO, "turbopi"):
        served(test)
    assert not any("left during" in message for message in caplog.messages)


def test_the_log_says_whose_request_is_refused(caplog: pytest.LogCaptureFixture) -> None:
    async def test(server: PolicyServer, policy: FakePolicy) -> None:
        async with client(server) as connection:
            host, port = connection.local_address[:2]
            assert (await refused(connection, b"\xc1")).startswith("bad request: ")
            assert any(line.startswith(f"{host}:{port}: bad request: ") for line in caplog.messages)

    served(test)


@pytest.mark.parametrize("how", ["close", "abort"])
def test_a_client_that_leaves_costs_nothing(how: str) -> None:
    async def leave(connection: ClientConnection) -> None:
        if how == "close":
            await connection.close()
        else:
            connection.transport.abort()

    async def test(server: PolicyServer, policy: FakePolicy) -> None:
        async with client(server) as running, client(server) as queued, client(server) as stays:
            await running.send(pack(observation("hold: leaves while it runs")))
            await eventually(policy.started.is_set)
            await queued.send(pack(observation("leaves while it waits")))
            await stays.send(pack(observation("stays")))
            await eventually(lambda: metric(server, "turbopi_queue_depth") == 2)
            await leave(running)
            await leave(queued)
            await eventually(lambda: metric(server, "turbopi_queue_depth") == 1)
            policy.release.set()
            assert unpack(bytes(await stays.recv()))["prompt"] == "stays"  # type: ignore[arg-type]
            assert policy.seen == ["hold: leaves while it runs", "stays"]
            assert metric(server, "turbopi_errors_total", kind="disconnected") == 2
            assert metric(server, "turbopi_clients") == 1

    served(test)


# --- our faults -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("prompt", "last_line"),
    [
        ("crash", "RuntimeError: CUDA error: invalid argument"),
        ("stop iteration", "StopIteration"),
        ("exit", "SystemExit: 3"),
        ("unpackable", "turbopi.realtime.wire.WireError: can't send a builtins.object"),
    ],
)
def test_a_failing_policy_sends_its_traceback_closes_1011_and_the_server_goes_on(prompt: str, last_line: str) -> None:
    async def test(server: PolicyServer, policy: FakePolicy) -> None:
        async with client(server) as other:
            async with client(server) as connection:
                text = await refused(connection, pack(observation(prompt)))
                assert text.startswith("Traceback (most recent call last):")
                assert text.strip().splitlines()[-1].startswith(last_line)
                with pytest.raises(ConnectionClosedError) as closed:
                    await connection.recv()
                assert closed.value.rcvd is not None
                assert closed.value.rcvd.code == 1011
                assert closed.value.rcvd.reason == "internal server error: the last frame has the traceback"
            await infer(other, observation("a client that was there"))
            async with client(server) as new:
                await infer(new, observation("a new client"))
            assert metric(server, "turbopi_errors_total", kind="policy") == 1

    served(test)


@pytest.mark.parametrize("policy_class", [FakePolicy, PipelinedFakePolicy])
def test_actions_that_no_robot_may_get_are_a_text_frame_and_the_connection_stays(
    policy_class: type[FakePolicy],
) -> None:
    async def test(server: PolicyServer, policy: FakePolicy) -> None:
        async with client(server) as connection:
            assert await refused(connection, pack(observation("nan actions"))) == (
                "bad actions: the actions hold nan at [0, 3]"
            )
            assert (await infer(connection, observation("after")))["prompt"] == "after"
            assert metric(server, "turbopi_errors_total", kind="actions") == 1
            assert metric(server, "turbopi_errors_total", kind="policy") == 0

    served(test, policy_class=policy_class)


@pytest.mark.parametrize("policy_class", [FakePolicy, PipelinedFakePolicy])
def test_whatever_a_policy_answers_clients_get_chunks_of_finite_numbers_alone(policy_class: type[FakePolicy]) -> None:
    async def test(server: PolicyServer, policy: FakePolicy) -> None:
        async with client(server) as connection:
            for name in NO_CHUNKS:
                assert (await refused(connection, pack(observation(f"answer {name}")))).startswith("bad actions: "), (
                    name
                )
            assert (await infer(connection, observation("after")))["prompt"] == "after"
            assert metric(server, "turbopi_errors_total", kind="actions") == len(NO_CHUNKS)

    served(test, policy_class=policy_class)


def test_a_policys_lists_of_numbers_reach_clients_as_arrays() -> None:
    class Lists(FakePolicy):
        def infer(self, obs: dict[str, Any]) -> dict[str, Any]:
            return {"actions": [[1, 2.5]], "progress": float("nan")}  # what else it answers is its own affair

    async def test(server: PolicyServer, policy: FakePolicy) -> None:
        async with client(server) as connection:
            answer = await infer(connection, observation())
            assert isinstance(answer["actions"], np.ndarray) and answer["actions"].tolist() == [[1, 2.5]]
            assert np.isnan(answer["progress"])

    served(test, policy_class=Lists)


@pytest.mark.parametrize("policy_class", [FakePolicy, PipelinedFakePolicy])
def test_once_the_device_is_lost_every_request_is_refused_with_the_reason(policy_class: type[FakePolicy]) -> None:
    lost = "the device is lost: CUDA error: an illegal memory access was encountered"

    async def test(server: PolicyServer, policy: FakePolicy) -> None:
        async with client(server) as first, client(server) as other:
            assert server.lost is None
            assert await refused(first, pack(observation("lost"))) == lost
            assert server.lost == "CUDA error: an illegal memory access was encountered"
            for connection in (first, other):
                assert await refused(connection, pack(observation("after"))) == lost
            assert policy.seen == ["lost"]
            assert metric(server, "turbopi_errors_total", kind="lost") == 3

    served(test, policy_class=policy_class)


def test_a_device_that_is_lost_is_noticed_though_its_client_left() -> None:
    async def test(server: PolicyServer, policy: FakePolicy) -> None:
        async with client(server) as connection:
            await connection.send(pack(observation("hold lost")))
            await eventually(policy.started.is_set)
        await eventually(lambda: metric(server, "turbopi_clients") == 0)
        policy.release.set()
        await eventually(lambda: server.lost is not None)

    served(test)


def test_serving_for_ever_ends_with_the_reason_when_the_device_is_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("turbopi.serve.server.LOST_NOTICE", 0.1)

    def crash(server: PolicyServer) -> None:
        async def call() -> None:
            async with client(server) as connection:
                await refused(connection, pack(observation("lost")))
                with pytest.raises(ConnectionClosed) as closed:
                    await connection.recv()
                assert closed.value.rcvd is not None
                assert closed.value.rcvd.code == 1001

        threads.append(threading.Thread(target=lambda: asyncio.run(call())))
        threads[0].start()

    threads: list[threading.Thread] = []
    with pytest.raises(DeviceLost, match="an illegal memory access"):
        PolicyServer(FakePolicy(), port=0).serve_forever(on_ready=crash)
    threads[0].join(30)
    assert not threads[0].is_alive()


def test_threads_and_the_garbage_collector_are_as_before_after_a_server() -> None:
    usual, met, kept = sys.getswitchinterval(), list[float](), list[int]()

    def look(_: PolicyServer) -> None:
        met.append(sys.getswitchinterval())
        kept.append(gc.get_freeze_count())
        raise RuntimeError("seen")

    with pytest.raises(RuntimeError, match="seen"):
        PolicyServer(FakePolicy(), port=0).serve_forever(on_ready=look)
    assert met == [pytest.approx(SWITCH_SECONDS)] and usual > SWITCH_SECONDS
    assert sys.getswitchinterval() == usual
    assert kept[0] > 10_000, "a full collection would look through all modules among requests"
    assert gc.get_freeze_count() < 1_000
    gc.freeze()
    try:
        before = gc.get_freeze_count()
        with pytest.raises(RuntimeError, match="seen"):
            PolicyServer(FakePolicy(), port=0).serve_forever(on_ready=look)
        assert gc.get_freeze_count() >= before, "what the program around has frozen stays so"
    finally:
        gc.unfreeze()


# --- health, pings, metrics -------------------------------------------------------------------------------------------


def test_health_and_pings_are_answered_while_an_inference_runs() -> None:
    async def test(server: PolicyServer, policy: FakePolicy) -> None:
        async with client(server) as connection:
            await connection.send(pack(observation("hold")))
            await eventually(policy.started.is_set)
            for _ in range(5):
                status, _, body = await http_get(server.port, "/healthz")
                assert (status, body) == (200, "OK\n")
                await asyncio.wait_for(await connection.ping(), 60)
            assert not policy.release.is_set()  # it runs on until here
            policy.release.set()
            await connection.recv()

    served(test)


def test_metrics_are_prometheus_text_and_count() -> None:
    async def test(server: PolicyServer, policy: FakePolicy) -> None:
        async with client(server) as connection:
            await infer(connection, observation())
            await infer(connection, observation())
            await refused(connection, b"")
            status, headers, body = await http_get(server.port, "/metrics?x=1")
        assert status == 200
        assert headers["content-type"].startswith("text/plain; version=")
        assert int(headers["content-length"]) == len(body)
        families = {family.name: family for family in text_string_to_metric_families(body)}
        samples = {
            (sample.name, *sample.labels.values()): sample.value
            for family in families.values()
            for sample in family.samples
        }
        assert samples["turbopi_requests_total",] == 3
        assert samples["turbopi_clients",] == 1
        assert samples["turbopi_errors_total", "malformed"] == 1
        assert samples["turbopi_errors_total", "policy"] == 0
        assert samples["turbopi_inference_seconds_count",] == 2
        assert samples["turbopi_request_seconds_bucket", "+Inf"] == 2
        assert samples["turbopi_queue_depth",] == 0
        assert samples["turbopi_inference_in_progress",] == 0
        assert families["turbopi_request_seconds"].type == "histogram"

    served(test)


# --- who may come in --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "headers",
    [
        [],
        [("Authorization", "Api-Key wrong")],
        [("Authorization", "Api-Key secre")],
        [("Authorization", "Api-Key secret2")],
        [("Authorization", "Bearer secret")],
        [("Authorization", "secret")],
        [("Authorization", "Api-Key sécret")],
        [("Authorization", "Api-Key wrong"), ("Authorization", "Api-Key secret")],
        [("Authorization", "Api-Key secret"), ("Authorization", "Api-Key wrong")],
    ],
)
def test_without_the_right_api_key_nobody_gets_in(headers: list[tuple[str, str]]) -> None:
    async def test(server: PolicyServer, policy: FakePolicy) -> None:
        with pytest.raises(InvalidStatus) as refusal:
            await connect(server.url, additional_headers=headers)
        response = refusal.value.response
        assert response.status_code == 401
        assert response.headers["WWW-Authenticate"] == "Api-Key"
        assert b"Authorization: Api-Key <key>" in (response.body or b"")
        assert metric(server, "turbopi_errors_total", kind="unauthorized") == 1
        assert policy.seen == []

    served(test, api_key="secret")


def test_the_api_key_opens_everything_and_health_needs_none() -> None:
    async def test(server: PolicyServer, policy: FakePolicy) -> None:
        async with client(server, additional_headers={"Authorization": "Api-Key secret"}) as connection:
            await infer(connection, observation())
        assert (await http_get(server.port, "/healthz"))[0] == 200
        assert (await http_get(server.port, "/metrics"))[0] == 401
        assert (await http_get(server.port, "/metrics", "Authorization: Api-Key secret"))[0] == 200

    served(test, api_key="secret")


def test_a_page_from_elsewhere_is_refused() -> None:
    async def test(server: PolicyServer, policy: FakePolicy) -> None:
        with pytest.raises(InvalidStatus) as refusal:
            await connect(server.url, origin="https://evil.example")  # type: ignore[arg-type]
        assert refusal.value.response.status_code == 403
        async with client(server, origin=f"http://127.0.0.1:{server.port}") as connection:
            await infer(connection, observation())

    served(test)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"port": 70000}, "port=70000 should be from 0 to 65535"),
        ({"max_message_mb": 0}, "max_message_mb=0 should be more than 0 and finite"),
        ({"max_message_mb": float("nan")}, "max_message_mb=nan should be more than 0 and finite"),
        ({"max_message_mb": float("inf")}, "max_message_mb=inf should be"),
        ({"queue_limit": -1}, "queue_limit=-1 should be 0 or more"),
        ({"api_key": ""}, "the API key must be printable ASCII without spaces, and not empty"),
        ({"api_key": "a b"}, "the API key must be"),
        ({"api_key": "schlüssel"}, "the API key must be"),
    ],
)
def test_options_that_cannot_be_right_are_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        PolicyServer(FakePolicy(), **options)


# --- start and stop ---------------------------------------------------------------------------------------------------


class WarmsUpForLong(FakePolicy):
    """Its warm-up begins with `started` and ends with `release`."""

    def warmup(self) -> None:
        self.started.set()
        assert self.release.wait(120)


def test_no_client_gets_in_before_the_warm_up_is_done() -> None:
    async def main() -> None:
        policy = WarmsUpForLong()
        server = PolicyServer(policy, port=0)
        start = asyncio.create_task(server.start())
        await eventually(policy.started.is_set)
        with pytest.raises(OSError, match=r"refused|Connect call failed"):
            await asyncio.open_connection("127.0.0.1", server.port)
        policy.release.set()
        await start
        assert (await http_get(server.port, "/healthz"))[0] == 200
        await server.stop()

    asyncio.run(main())


def test_a_taken_port_is_said_before_the_warm_up() -> None:
    policy = FakePolicy()
    with (
        running(FakePolicy()) as server,
        pytest.raises(ConfigError, match=rf"can't listen on ws://127.0.0.1:{server.port}: .*in use"),
        running(policy, port=server.port),
    ):
        pass
    assert not policy.warmed_up


def test_a_port_that_another_server_takes_during_the_warm_up_is_said_and_nothing_is_left_open(tmp_path: Path) -> None:
    """Linux lets both bind the port, as long as neither listens."""

    async def main() -> None:
        policy = WarmsUpForLong()
        late = PolicyServer(policy, port=0, record_dir=tmp_path)
        start = asyncio.create_task(late.start())
        await eventually(policy.started.is_set)
        async with PolicyServer(FakePolicy(), port=late.port) as first:
            policy.release.set()
            with pytest.raises(ConfigError, match=rf"can't listen on {first.url}: .*in use.*another --host or --port"):
                await start
        assert not any(thread.name == "turbopi-recorder" for thread in threading.enumerate())

    asyncio.run(main())


@pytest.mark.parametrize("host", ["robot..lab", "x" * 70])
def test_a_host_that_is_no_name_is_refused_in_words(host: str) -> None:
    with pytest.raises(ConfigError, match=r"can't listen on ws://.*another --host"), running(FakePolicy(), host=host):
        pass


def test_a_failing_warm_up_ends_the_start() -> None:
    class Broken(FakePolicy):
        def warmup(self) -> None:
            raise RuntimeError("out of memory")

    with pytest.raises(RuntimeError, match="out of memory"), running(Broken()):
        pass


def test_stopping_finishes_the_running_inference_and_says_goodbye() -> None:
    async def main() -> None:
        policy = FakePolicy()
        server = PolicyServer(policy, port=0)
        await server.start()
        async with client(server) as idle, client(server) as running, client(server) as waiting:
            await running.send(pack(observation("hold")))
            await eventually(policy.started.is_set)
            await waiting.send(pack(observation("waits")))
            await eventually(lambda: metric(server, "turbopi_queue_depth") == 1)
            stop = asyncio.create_task(server.stop())
            with pytest.raises(ConnectionClosed) as closed:
                await idle.recv()
            assert closed.value.rcvd is not None
            assert (closed.value.rcvd.code, closed.value.rcvd.reason) == (1001, "the server is shutting down")
            with pytest.raises(OSError, match=r"refused|Connect call failed"):
                await asyncio.open_connection("127.0.0.1", server.port)
            policy.release.set()
            assert unpack(bytes(await running.recv()))["prompt"] == "hold"  # type: ignore[arg-type]
            assert await waiting.recv() == "the server is shutting down"
            for connection in (running, waiting):
                with pytest.raises(ConnectionClosed) as closed:
                    await connection.recv()
                assert closed.value.rcvd is not None
                assert closed.value.rcvd.code == 1001
            await asyncio.wait_for(stop, 60)
        assert policy.seen == ["hold"]

    asyncio.run(main())


async def stop_while_the_client_has_left(policy: FakePolicy) -> None:
    """Asserts that stopping a server waits for what the policy is at, and then ends."""
    server = PolicyServer(policy, port=0)
    await server.start()
    async with client(server) as leaving:
        await leaving.send(pack(observation("hold")))
        await eventually(policy.started.is_set)
    stop = asyncio.create_task(server.stop())
    await asyncio.sleep(0.2)
    assert not stop.done()
    policy.release.set()
    await asyncio.wait_for(stop, 60)


def test_stopping_waits_for_an_inference_whose_client_left() -> None:
    asyncio.run(stop_while_the_client_has_left(FakePolicy()))


PROGRAM = """
import sys
from rich.console import Console
from serve_fakes import FakePolicy
from turbopi.serve import run

run(FakePolicy(), port=0, record_dir=sys.argv[1], console=Console(width=200))
"""


@contextlib.contextmanager
def program(record_dir: Path) -> Iterator[tuple[subprocess.Popen[str], str, str]]:
    """A process that serves: the process, the server's address, and what it printed."""
    tests = Path(__file__).parent
    environment = {**os.environ, "PYTHONPATH": f"{tests.parent / 'src'}{os.pathsep}{tests}", "PYTHONUNBUFFERED": "1"}
    command = [sys.executable, "-W", "error", "-c", PROGRAM, str(record_dir)]
    with subprocess.Popen(
        command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        try:
            assert process.stdout is not None
            printed = ""
            while "Ctrl-C" not in printed:
                line = process.stdout.readline()
                assert line, process.communicate()[1]
                printed += line
            yield process, next(word for word in printed.split() if word.startswith("ws://")), printed
        finally:
            process.kill()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_run_prints_the_address_and_ends_cleanly_on_a_signal(number: signal.Signals, tmp_path: Path) -> None:
    async def call(url: str) -> None:
        async with connect(url) as connection:
            await connection.recv()
            await infer(connection, observation("hello"))

    with program(tmp_path) as (process, url, printed):
        asyncio.run(call(url))
        process.send_signal(number)
        rest, errors = process.communicate(timeout=300)
    assert process.returncode == 0, errors
    assert errors == ""
    assert f"Recording to {tmp_path}" in printed
    assert rest.splitlines()[-1] == "Stopped."
    ((recorded, _),) = iter_recording(tmp_path)
    assert recorded["prompt"] == "hello"


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_second_signal_ends_a_server_whose_inference_hangs(number: signal.Signals, tmp_path: Path) -> None:
    async def call(url: str, process: subprocess.Popen[str]) -> None:
        port = int(url.rpartition(":")[2])
        async with connect(url) as connection:
            await connection.recv()
            await connection.send(pack(observation("hold")))
            while "turbopi_inference_in_progress 1.0" not in (await http_get(port, "/metrics"))[2]:
                await asyncio.sleep(0.01)
            process.send_signal(number)
            assert process.stdout is not None
            assert "Stopping" in await asyncio.to_thread(process.stdout.readline)
            assert process.poll() is None
            process.send_signal(number)
            with pytest.raises(ConnectionClosed):
                await connection.recv()

    with program(tmp_path) as (process, url, _):
        asyncio.run(call(url, process))
        process.communicate(timeout=300)
    assert process.returncode == -number


# --- recording --------------------------------------------------------------------------------------------------------


def test_recording_keeps_observations_as_they_were_sent(tmp_path: Path) -> None:
    async def test(server: PolicyServer, policy: FakePolicy) -> None:
        async with client(server) as connection:
            await infer(connection, observation("one"))
            await refused(connection, pack({"prompt": "not recorded"}))
            await infer(connection, observation("mutate"))

    served(test, record_dir=tmp_path)
    calls = list(iter_recording(tmp_path))
    assert [obs["prompt"] for obs, _ in calls] == ["one", "mutate"]
    for obs, actions in calls:
        np.testing.assert_array_equal(obs["observation/image"], observation()["observation/image"])
        np.testing.assert_array_equal(actions, np.stack([observation()["observation/state"]] * 2))


def test_a_folder_that_cannot_be_recorded_into_is_said_at_the_start(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with (
        pytest.raises(ConfigError, match=r"can't record into .*file"),
        running(FakePolicy(), record_dir=tmp_path / "file"),
    ):
        pass


def test_a_recording_has_its_limit_and_its_kind_of_images(tmp_path: Path) -> None:
    image = np.full((4, 4, 3), 7, np.uint8)
    keys = {"observation/state": np.linspace(-1, 1, 8), "observation/image": image}
    options: dict[str, Any] = {"record_dir": tmp_path, "record_limit": "1d", "record_images": "png"}
    with running(FakePolicy(), **options) as server, RealTimeClient("127.0.0.1", server.port) as client:
        client.infer(keys)
    (file,) = tmp_path.glob("*/000000.npz")
    np.testing.assert_array_equal(load_call(file).observation["observation/image"], image)
    with np.load(file) as members:
        assert members["observation/observation/image"].tobytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"record_limit": "1d"}, "record_limit= and record_images= are of a recording: give record_dir=, too"),
        ({"record_dir": "x", "record_limit": "much"}, "record_limit='much' should be a size, an age, or both"),
        ({"record_dir": "x", "record_images": "gif"}, "record_images='gif' should be one of exact, png, jpeg"),
    ],
)
def test_options_of_a_recording_that_cannot_be_right_are_refused(options: dict[str, Any], said: str) -> None:
    with pytest.raises(ConfigError, match=re.escape(said)):
        ServerOptions(**options)


def test_addresses_of_a_server_on_all_interfaces_can_be_opened(monkeypatch: pytest.MonkeyPatch) -> None:
    def address(family: socket.AddressFamily, text: str) -> Any:
        return SimpleNamespace(family=family, address=text)

    interfaces = {
        "lo": [address(socket.AF_INET, "127.0.0.1"), address(socket.AF_INET6, "::1")],
        "eth0": [
            address(socket.AF_INET, "192.168.1.20"),
            address(socket.AF_INET6, "fe80::1%eth0"),
            address(socket.AF_INET6, "fd00::2"),
            address(socket.AF_PACKET, "00:11:22:33:44:55"),
        ],
        "down": [address(socket.AF_INET, "10.0.0.1")],
    }
    monkeypatch.setattr("psutil.net_if_addrs", lambda: interfaces)
    monkeypatch.setattr(
        "psutil.net_if_stats", lambda: {name: SimpleNamespace(isup=name != "down") for name in interfaces}
    )
    assert addresses("0.0.0.0") == ["192.168.1.20", "localhost"]
    assert addresses("::") == ["192.168.1.20", "[fd00::2]", "localhost"]
    assert addresses("192.168.1.20") == addresses("localhost") == []
