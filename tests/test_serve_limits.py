"""The server under clients that want to harm it, through its socket. test_serve_connection.py has the details."""

import asyncio
import contextlib
import errno
import gc
import logging
import resource
import socket
import struct
import tracemalloc
from collections.abc import AsyncIterator
from typing import Any

import pytest
from serve_fakes import FakePolicy, http_get, observation
from test_serve_connection import PING, REQUEST, frame
from test_serve_server import client, eventually, infer, metric, refused, served
from websockets.asyncio.client import connect
from websockets.exceptions import ConnectionClosedError, InvalidStatus

from turbopi.realtime.wire import pack
from turbopi.serve import PolicyServer, limits, listener
from turbopi.serve.limits import AtMost, Limits, room_for_connections
from turbopi.support.errors import ConfigError

NIL = b"\xdd\0\0\x4e\x1e" + b"\xc0" * 19_998  # 20 kB, 19 998 values


class Raw:
    """A websocket client that does what no library would."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.reader, self.writer = reader, writer

    async def ended(self) -> bytes:
        """What comes until the server ends the connection."""
        with contextlib.suppress(ConnectionError):
            return await asyncio.wait_for(self.reader.read(), 30)
        return b""


@contextlib.asynccontextmanager
async def raw(server: PolicyServer, request: bytes = REQUEST) -> AsyncIterator[Raw]:
    """A client after its handshake; one without a `request` sends nothing."""
    reader, writer = await asyncio.open_connection("127.0.0.1", server.port, limit=2**16)
    try:
        if request:
            writer.write(request)
            assert b" 101 " in await asyncio.wait_for(reader.readuntil(b"\r\n\r\n"), 30)
        yield Raw(reader, writer)
    finally:
        writer.transport.abort()


# --- floods -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("flood", "count"),
    [(frame(b"\xc1"), 20_000), (frame(NIL), 500), (frame(b"x" * 125, PING), 5_000), (frame(b"", 2, final=False), 9)],
    ids=["one byte", "20 kB of nil", "pings", "parts"],
)
def test_who_floods_the_server_is_served_no_more_than_its_share(flood: bytes, count: int) -> None:
    async def test(server: PolicyServer, policy: FakePolicy) -> None:
        async with raw(server) as bad, client(server) as good:
            bad.writer.write(flood * count)
            for step in range(5):
                assert (await infer(good, observation(str(step))))["prompt"] == str(step)
            assert metric(server, "turbopi_errors_total", kind="malformed") <= 11

    served(test, limits=Limits(work_burst=50, work_rate=0.001, close_seconds=0.3))


def test_who_sends_bad_requests_alone_is_closed_with_1008_and_nobody_else_is() -> None:
    async def test(server: PolicyServer, policy: FakePolicy) -> None:
        async with client(server) as bad, client(server) as good:
            await infer(good, observation())
            for _ in range(4):
                await refused(bad, b"\xc1")
            await infer(bad, observation("a good one forgives them"))
            for _ in range(5):
                assert (await refused(bad, pack({"prompt": "no state"}))).startswith("bad observation: ")
            with pytest.raises(ConnectionClosedError) as closed:
                await bad.recv()
            assert closed.value.rcvd is not None
            assert closed.value.rcvd.code == 1008
            assert closed.value.rcvd.reason == "5 bad requests in a row: the text frames say what is wrong"
            await infer(good, observation("after"))
            assert metric(server, "turbopi_errors_total", kind="flood") == 1

    served(test, limits=Limits(bad_messages=5))


def test_bad_requests_fill_no_log(caplog: pytest.LogCaptureFixture) -> None:
    async def test(server: PolicyServer, policy: FakePolicy) -> None:
        async with client(server) as bad:
            for _ in range(100):
                await refused(bad, b"\xc1")

    with caplog.at_level(logging.INFO):
        served(test, limits=Limits(work_rate=1e6))
    about = [record for record in caplog.records if "0xc1" in record.getMessage()]
    assert 1 <= len(about) <= 50
    reported = sum(
        int(record.getMessage().split()[0]) for record in caplog.records if "left out (m" in record.getMessage()
    )
    reported += sum(
        int(record.getMessage().rpartition("(")[2].split()[0]) for record in about if " left " in record.msg
    )
    assert len(about) + reported == 100


# --- clients that don't end what they begin, or don't read ------------------------------------------------------------


def test_half_a_message_is_not_waited_for() -> None:
    async def test(server: PolicyServer, policy: FakePolicy) -> None:
        async with raw(server) as half, client(server) as good:
            half.writer.write(frame(bytes(100_000))[:50_000])
            assert b"half a message" in await half.ended()
            await infer(good, observation())
        assert metric(server, "turbopi_errors_total", kind="slow") == 1
        await eventually(lambda: metric(server, "turbopi_clients") == 0)

    served(test, limits=Limits(message_seconds=0.2, close_seconds=0.2))


@pytest.mark.parametrize("request_", [b"", b"GET / HT", REQUEST[:-1]])
def test_half_an_http_request_is_not_waited_for(request_: bytes) -> None:
    async def test(server: PolicyServer, policy: FakePolicy) -> None:
        async with raw(server, b"") as half:
            half.writer.write(request_)
            await half.ended()

    served(test, limits=Limits(handshake_seconds=0.2))


def test_stopping_waits_for_no_client_that_does_not_read() -> None:
    async def main() -> None:
        server = PolicyServer(FakePolicy(), port=0, limits=Limits(close_seconds=0.3))
        await server.start()
        async with raw(server) as stuck, raw(server) as silent:
            silent.writer.write(frame(b"x", final=False))  # it never answers the close frame
            stuck.writer.write(frame(pack(observation("large actions"))))
            await eventually(lambda: metric(server, "turbopi_inference_seconds_count") == 1)
            await asyncio.wait_for(server.stop(), 30)

    asyncio.run(main())


def test_a_client_that_resets_while_its_answer_waits_is_no_fault_of_the_server(
    caplog: pytest.LogCaptureFixture,
) -> None:
    async def test(server: PolicyServer, policy: FakePolicy) -> None:
        async with raw(server) as bad:
            bad.reader._transport.pause_reading()  # type: ignore[attr-defined]
            linger = struct.pack("ii", 1, 0)  # closing resets
            bad.writer.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, linger)
            bad.writer.write(frame(pack(observation("large actions"))))
            await eventually(lambda: any(one.paused for one in server._listener._clients))
        await eventually(lambda: not server._listener._connected)

    served(test)
    assert "the server failed" not in caplog.text


@pytest.mark.slow
def test_a_client_that_pings_and_never_reads_is_closed() -> None:
    async def test(server: PolicyServer, policy: FakePolicy) -> None:
        async with raw(server) as bad:
            bad.writer.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            pings = asyncio.create_task(ping(bad))
            await eventually(lambda: metric(server, "turbopi_errors_total", kind="slow") == 1)
            pings.cancel()

    async def ping(bad: Raw) -> None:
        bad.reader._transport.pause_reading()  # type: ignore[attr-defined]
        while True:
            bad.writer.write(frame(bytes(125), PING) * 1000)
            await bad.writer.drain()

    served(test, limits=Limits(work_burst=1e9, work_rate=1e9, write_seconds=0.3))


# --- memory -----------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_nothing_of_large_messages_stays_when_their_clients_have_left() -> None:
    size = 30 * 2**20
    message = pack({"x": bytes(size)})

    async def test(server: PolicyServer, policy: FakePolicy) -> None:
        tracemalloc.start()
        gc.disable()  # what only the garbage collector would free may stay for minutes
        try:
            for _ in range(4):
                async with client(server) as whole, raw(server) as half:
                    await refused(whole, message)
                    half.writer.write(b"\x82\xff" + struct.pack(">Q", size) + bytes(4 + size // 2))
                    await half.writer.drain()
                    del half, whole
            await eventually(lambda: metric(server, "turbopi_clients") == 0)
            await eventually(lambda: tracemalloc.get_traced_memory()[0] < size // 2)
        finally:
            gc.enable()
            tracemalloc.stop()

    served(test)


def test_memory_goes_back_to_the_system_when_the_last_client_has_left(monkeypatch: pytest.MonkeyPatch) -> None:
    limits.trim_memory()  # whatever the C library is
    trimmed: list[int] = []
    monkeypatch.setattr(listener, "TRIM_SECONDS", 0.0)

    async def test(server: PolicyServer, policy: FakePolicy) -> None:
        monkeypatch.setattr(listener, "trim_memory", lambda: trimmed.append(len(policy.seen)))
        async with client(server) as first:
            async with client(server) as second:
                await infer(second, observation("1"))
            await eventually(lambda: metric(server, "turbopi_clients") == 1)
            await infer(first, observation("2"))
        for _ in range(3):
            await http_get(server.port, "/healthz")
        await eventually(lambda: bool(trimmed))

    served(test)
    assert trimmed == [2]


# --- how many ---------------------------------------------------------------------------------------------------------


def test_one_client_too_many_gets_503_with_the_reason_and_comes_in_once_another_left() -> None:
    async def test(server: PolicyServer, policy: FakePolicy) -> None:
        async with client(server) as first:
            async with client(server):
                with pytest.raises(InvalidStatus) as refusal:
                    await connect(server.url)
                response = refusal.value.response
                assert response.status_code == 503
                assert (response.body or b"").decode() == (
                    "The server has 2 clients, its limit (--max-clients); try again later.\n"
                )
                assert (await http_get(server.port, "/healthz"))[0] == 200
                assert metric(server, "turbopi_errors_total", kind="full") == 1
            await eventually(lambda: metric(server, "turbopi_clients") == 1)
            await infer(first, observation())
            async with client(server) as third:
                await infer(third, observation())

    served(test, max_clients=2)


def test_connections_without_a_request_make_room_for_those_with_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(listener, "SPARE_CONNECTIONS", 2)

    async def test(server: PolicyServer, policy: FakePolicy) -> None:
        async with contextlib.AsyncExitStack() as stack:
            silent = [await stack.enter_async_context(raw(server, b"")) for _ in range(8)]
            async with client(server) as good:
                await infer(good, observation())
                await silent[0].ended()

    served(test, max_clients=1)


def test_who_comes_beyond_all_room_is_told_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(listener, "SPARE_CONNECTIONS", 0)

    async def test(server: PolicyServer, policy: FakePolicy) -> None:
        async with client(server):
            status, _, body = await http_get(server.port, "/healthz")
            assert (status, body) == (503, "The server has 1 clients, its limit (--max-clients); try again later.\n")

    served(test, max_clients=1)


def test_max_clients_must_be_one_or_more() -> None:
    with pytest.raises(ConfigError, match="max_clients=0 should be 1 or more"):
        PolicyServer(FakePolicy(), max_clients=0)


def test_a_server_without_descriptors_tries_on_quietly(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(listener, "RETRY_SECONDS", 0.0)
    failures = 0

    async def test(server: PolicyServer, policy: FakePolicy) -> None:
        nonlocal failures
        loop = asyncio.get_running_loop()
        accept = loop.sock_accept

        async def sock_accept(sock: socket.socket) -> Any:
            nonlocal failures
            if failures < 1000:
                failures += 1
                raise OSError(errno.EMFILE, "Too many open files")
            return await accept(sock)

        monkeypatch.setattr(loop, "sock_accept", sock_accept)
        async with client(server), client(server) as good:
            await infer(good, observation())

    served(test)
    assert failures == 1000
    lines = [record for record in caplog.records if "Too many open files" in record.getMessage()]
    assert 1 <= len(lines) <= 100


def test_a_client_that_left_before_it_was_taken_ends_no_accepting(monkeypatch: pytest.MonkeyPatch) -> None:
    """macOS has no options for such a socket: setting TCP_NODELAY fails."""
    left: list[socket.socket] = []

    async def test(server: PolicyServer, policy: FakePolicy) -> None:
        loop = asyncio.get_running_loop()
        take = loop.connect_accepted_socket

        async def connect_accepted_socket(make: Any, sock: socket.socket) -> Any:
            if not left:
                left.append(sock)
                raise OSError(errno.EINVAL, "Invalid argument")
            return await take(make, sock)

        monkeypatch.setattr(loop, "connect_accepted_socket", connect_accepted_socket)
        async with raw(server, b"") as lost, client(server) as good:
            assert await lost.ended() == b""
            await infer(good, observation())

    served(test)
    assert left[0].fileno() == -1


def test_new_connections_come_at_a_rate_that_is_allowed() -> None:
    now = 0.0
    pace = AtMost(10, clock=lambda: now)
    assert [pace.wait() for _ in range(10)] == [0.0] * 10
    assert pace.wait() == pytest.approx(0.1)
    now = 0.1
    assert pace.wait() == pytest.approx(0.1)
    now = 100.0
    assert [pace.wait() for _ in range(10)] == [0.0] * 10
    assert pace.wait() > 0


def test_there_is_room_for_as_many_connections_as_descriptors_allow(monkeypatch: pytest.MonkeyPatch) -> None:
    set_to: list[tuple[int, int]] = []
    monkeypatch.setattr(resource, "setrlimit", lambda kind, limits: set_to.append(limits))
    monkeypatch.setattr(limits, "SPARE_DESCRIPTORS", 64)
    for soft, hard, room in ((10**6, 10**6, 300), (100, 10**6, 300), (resource.RLIM_INFINITY,) * 2 + (300,)):
        monkeypatch.setattr(resource, "getrlimit", lambda kind, found=(soft, hard): found)
        assert room_for_connections(300) == room
    ((soft, hard),) = set_to
    assert 364 < soft < 5000
    assert hard == 10**6
    monkeypatch.setattr(resource, "getrlimit", lambda kind: (100, 200))
    assert 0 <= room_for_connections(300) < 200
    monkeypatch.setattr(resource, "getrlimit", lambda kind: (10, 10))
    assert room_for_connections(300) == 0


def test_fewer_clients_are_let_in_when_descriptors_are_few(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(listener, "room_for_connections", lambda wanted: listener.SPARE_CONNECTIONS + 1)

    async def test(server: PolicyServer, policy: FakePolicy) -> None:
        async with client(server):
            with pytest.raises(InvalidStatus):
                await connect(server.url)

    served(test)
    assert "only 1 clients at once, not 256: the process may not open more files" in caplog.text
