"""What one connection may cost, frame by frame: with a transport and a clock of the test's own, so nothing depends on
how fast the machine is."""

import asyncio
import contextlib
import itertools
import logging
import os
import random
import socket
import struct
import threading
from collections.abc import Awaitable, Callable, Iterator
from typing import Any

import pytest
from websockets.exceptions import ConnectionClosed
from websockets.server import ServerProtocol

from turbopi.serve.connection import GuardedConnection, Shared
from turbopi.serve.limited_log import LimitedLog
from turbopi.serve.limits import Limits
from turbopi.serve.metrics import Metrics

REQUEST = (
    b"GET / HTTP/1.1\r\nHost: x\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    b"Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\nSec-WebSocket-Version: 13\r\n\r\n"
)
BINARY, CONTINUED, PING, PONG = 2, 0, 9, 10
MIB = 2**20


def frame(payload: bytes = b"", opcode: int = BINARY, *, final: bool = True, mask: bytes = bytes(4)) -> bytes:
    """A client's frame."""
    size = len(payload)
    if size < 126:
        length = bytes([0x80 | size])
    elif size < 2**16:
        length = b"\xfe" + struct.pack(">H", size)
    else:
        length = b"\xff" + struct.pack(">Q", size)
    repeated = itertools.cycle(mask)
    masked = bytes(a ^ b for a, b in zip(payload, repeated, strict=False)) if any(mask) else payload
    return bytes([(0x80 if final else 0) | opcode]) + length + mask + masked


class Clock:
    """Stands in for the event loop's `call_later`: time passes when the test says so."""

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self.now = 0.0
        self._loop = loop
        self._calls: list[tuple[float, int, Any, asyncio.Handle]] = []
        self._numbers = itertools.count()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._loop, name)

    def call_later(self, seconds: float, call: Callable[..., Any], *args: Any) -> asyncio.Handle:
        handle = asyncio.Handle(call, args, self._loop)
        self._calls.append((self.now + seconds, next(self._numbers), call, handle))
        return handle

    async def sleep(self, seconds: float) -> None:
        """Let `seconds` pass, and all that is due meanwhile happen."""
        end = self.now + seconds
        while due := [call for call in self._calls if call[0] <= end]:
            first = min(due)
            self._calls.remove(first)
            self.now = max(self.now, first[0])
            handle = first[-1]
            if not handle.cancelled():
                handle._run()
            await asyncio.sleep(0)
        self.now = end
        await asyncio.sleep(0)


class Transport(asyncio.Transport):
    """Keeps what is written; `full` is a client that doesn't read."""

    def __init__(self) -> None:
        super().__init__()
        self.connection: GuardedConnection
        self.reading, self.closed, self.written, self.unsent = True, False, b"", 0

    def write(self, data: Any) -> None:
        if not self.closed:
            self.written += bytes(data)

    def pause_reading(self) -> None:
        self.reading = False

    def resume_reading(self) -> None:
        self.reading = True

    def abort(self) -> None:
        if not self.closed:
            self.closed = True
            asyncio.get_running_loop().call_soon(self.connection.connection_lost, None)

    close = abort

    def is_closing(self) -> bool:
        return self.closed

    def can_write_eof(self) -> bool:
        return True

    def write_eof(self) -> None:
        pass

    def get_write_buffer_size(self) -> int:
        return self.unsent

    def set_write_buffer_limits(self, high: int | None = None, low: int | None = None) -> None:
        pass

    def get_extra_info(self, name: str, default: Any = None) -> Any:
        return ("client", 1) if name == "peername" else default


class Server:
    """The listener of the connections under test, and what they share."""

    def __init__(self, limits: Limits) -> None:
        self.clock = Clock(asyncio.get_running_loop())
        self.metrics = Metrics()
        log = LimitedLog(logging.getLogger("test"))
        self.shared = Shared(limits, self.metrics, log, clock=lambda: self.clock.now)

    def is_serving(self) -> bool:
        return True

    def connected(self, connection: GuardedConnection) -> None:
        pass

    def accept(self) -> "Client":
        return Client(self)

    async def client(self) -> "Client":
        client = self.accept()
        client.send(REQUEST)
        await client.shake()
        return client

    def errors(self, kind: str) -> float:
        return self.metrics.registry.get_sample_value("turbopi_errors_total", {"kind": kind}) or 0.0


class Client:
    """One connection, seen from both ends."""

    def __init__(self, server: Server) -> None:
        protocol = ServerProtocol(max_size=server.shared.limits.message_bytes)
        self.connection = GuardedConnection(protocol, server, server.shared)
        self.connection.loop = server.clock  # type: ignore[assignment]
        self.connection.ping_interval = None
        self.transport = Transport()
        self.transport.connection = self.connection
        self.connection.connection_made(self.transport)

    def send(self, data: bytes, *, whole: bool = False) -> None:
        """As an event loop brings it: as much at once as the connection's buffer takes; or, as uvloop does, `whole`."""
        if whole:
            self.connection.data_received(data)
            return
        rest = memoryview(data)
        while rest:
            buffer = self.connection.get_buffer(-1)
            size = min(len(buffer), len(rest))
            buffer[:size] = rest[:size]
            self.connection.buffer_updated(size)
            rest = rest[size:]

    async def shake(self) -> None:
        await self.connection.handshake()
        assert self.transport.written.startswith(b"HTTP/1.1 101")
        self.transport.written = b""
        self.connection.opened()

    def waiting(self) -> int:
        """Messages that could be received at once."""
        return len([None for frame in self.connection.recv_messages.frames.queue if frame.fin])

    async def receive(self) -> bytes | str:
        return await asyncio.wait_for(self.connection.recv(), 30)

    @property
    def closed_with(self) -> tuple[int, str] | None:
        """Code and reason of the close frame that the client got."""
        sent = self.connection.protocol.close_sent
        return None if sent is None else (int(sent.code), sent.reason)


def run(test: Callable[[Server], Awaitable[None]], **limits: Any) -> None:
    async def main() -> None:
        await test(Server(Limits(**limits)))

    asyncio.run(main())


# --- frames -----------------------------------------------------------------------------------------------------------


def test_messages_arrive_whole_however_their_bytes_are_cut() -> None:
    messages = [b"", b"x", b"y" * 125, b"z" * 126, b"a" * 70_000, b"parts", bytes(range(256)) * 300, b"last"]
    parts = frame(b"pa", final=False) + frame(b"", PING) + frame(b"rt", CONTINUED, final=False) + frame(b"s", CONTINUED)
    stream = b"".join(parts if message == b"parts" else frame(message, mask=b"mask") for message in messages)
    generator = random.Random(0)

    async def test(server: Server) -> None:
        for round_ in range(30):
            client = server.accept()
            data, received = REQUEST + stream, []
            cuts = sorted(generator.choices(range(len(data)), k=30 if round_ else 0))
            shaken = False
            for begin, end in itertools.pairwise((0, *cuts, len(data))):
                client.send(data[begin:end], whole=round_ % 3 == 2)
                if not shaken and end >= len(REQUEST):
                    await client.shake()
                    shaken = True
                while client.waiting():
                    received.append(await client.receive())
                    client.connection.answered("good")
            assert received == messages
            assert client.transport.reading
            assert client.closed_with is None

    run(test)


def test_a_frame_that_is_wrong_is_refused_as_ever() -> None:
    async def test(server: Server) -> None:
        for data, code in ((b"\x82\x01x", 1002), (b"\xf2\x80" + bytes(4), 1002), (frame(b"x", CONTINUED), 1002)):
            client = await server.client()
            client.send(data)
            assert client.closed_with is not None
            assert client.closed_with[0] == code
        client = await server.client()
        client.send(frame(bytes(101))[:10])  # its header is enough
        assert client.closed_with is not None
        assert client.closed_with[0] == 1009

    run(test, message_bytes=100)


def camera_images(seed: int, size: int = 300_000) -> bytes:
    return random.Random(seed).randbytes(size)


@pytest.mark.parametrize(
    ("size", "straight"), [(2**16 - 1, False), (2**16, True), (4 * MIB, True), (4 * MIB + 1, False)]
)
def test_pictures_are_received_past_the_library(size: int, straight: bool) -> None:
    async def test(server: Server) -> None:
        client = await server.client()
        client.send(frame(bytes(size))[:-1])
        assert len(client.connection.protocol.reader.buffer) == (0 if straight else size - 1)
        client.send(b"\0")
        assert await client.receive() == bytes(size)

    run(test)


@pytest.mark.parametrize("whole", [False, True])
def test_two_clients_pictures_that_come_at_once_stay_apart(whole: bool) -> None:
    async def test(server: Server) -> None:
        clients = [await server.client() for _ in range(3)]
        for round_ in range(3):
            messages = [camera_images(10 * round_ + i, 300_000 - 1000 * (i + round_)) for i in range(len(clients))]
            frames = [frame(message, mask=b"\x80abc") for message in messages]
            for begin in range(0, 301_000, 70_000):
                for client, data in zip(clients, frames, strict=True):
                    client.send(data[begin : begin + 70_000], whole=whole)
            for client, message in zip(clients, messages, strict=True):
                assert await client.receive() == message
                client.connection.answered("good")

    run(test)


def test_the_buffer_of_one_picture_is_the_next_ones() -> None:
    async def test(server: Server) -> None:
        buffers = set()
        for size in (300_000, 200_000, 300_000):
            client = await server.client()
            client.send(frame(bytes(size))[:-1])
            buffers.add(id(client.connection.get_buffer(-1).obj))
            client.send(b"\0")
            assert await served(client, "good") == 1
        assert len(buffers) == 1

    run(test)


LARGE_FRAME = frame(bytes(100_000))


@pytest.mark.parametrize(
    ("data", "code"),
    [
        (b"\xc2" + LARGE_FRAME[1:], 1002),  # a reserved bit
        (b"\x82\x7f" + (100_000).to_bytes(8, "big") + bytes(100_000), 1002),  # not masked
        (frame(bytes(100_000), CONTINUED), 1002),  # of no message
        (frame(b"begun", final=False) + LARGE_FRAME, 1002),  # in the middle of another message
        (frame(b"\xff" * 100_000, 1), None),  # text: whether it's UTF-8 is found out by `recv`
        (b"\x83\x80" + bytes(4) + LARGE_FRAME, 1002),  # behind a wrong one
    ],
)
def test_a_large_frame_that_is_wrong_is_refused_as_ever(data: bytes, code: int | None) -> None:
    async def test(server: Server) -> None:
        client = await server.client()
        client.send(data)
        assert (None if client.closed_with is None else client.closed_with[0]) == code
        assert client.waiting() == (code is None)

    run(test)


@pytest.mark.parametrize("whole", [False, True])
def test_pictures_that_are_half_there_when_the_server_closes_end_in_order(whole: bool) -> None:
    async def test(server: Server) -> None:
        client = await server.client()
        data = frame(camera_images(0), mask=b"\xff\xfe\xfd\xfc")
        client.send(data[:200_000], whole=whole)
        closing = asyncio.create_task(client.connection.close(1001, "the server is shutting down"))
        await asyncio.sleep(0)
        client.send(data[200_000:], whole=whole)
        client.send(frame((1001).to_bytes(2, "big"), 8), whole=whole)
        received = client.connection.protocol.close_rcvd
        assert received is not None and received.code == 1001
        assert not client.waiting()
        client.transport.abort()
        await asyncio.wait_for(closing, 30)

    run(test)


def test_no_more_than_two_messages_of_a_client_are_read() -> None:
    async def test(server: Server) -> None:
        client = await server.client()
        client.send(frame(b"1") + frame(b"2") + frame(b"3") + frame(b"", PING) + frame(b"4"))
        assert client.waiting() == 2
        assert not client.transport.reading
        assert await client.receive() == b"1"
        client.connection.answered("good")
        assert client.waiting() == 2
        assert client.transport.written  # the ping, which came before the fourth
        for expected in (b"2", b"3"):
            assert await client.receive() == expected
            client.connection.answered("good")
        assert client.transport.reading
        assert await client.receive() == b"4"

    run(test)


def test_pings_are_answered_while_a_message_is_computed() -> None:
    async def test(server: Server) -> None:
        client = await server.client()
        client.send(frame(b"request") + frame(b"hello", PING))
        assert client.transport.written == b"\x8a\x05hello"

    run(test)


# --- work -------------------------------------------------------------------------------------------------------------


async def served(client: Client, how: Any) -> int:
    """Take and answer all messages that are there; how many."""
    count = 0
    while client.waiting():
        await client.receive()
        client.connection.answered(how)
        count += 1
    return count


@pytest.mark.parametrize(("how", "cost"), [("bad", 4), ("neither", 1)])
def test_a_flood_is_served_at_the_rate_that_is_allowed_and_the_rest_is_not_read(how: str, cost: int) -> None:
    async def test(server: Server) -> None:
        client = await server.client()
        client.send(frame(b"\xc1") * 5000)
        assert abs(await served(client, how) - 20 / cost) <= 2  # what a new connection begins with
        assert not client.transport.reading
        total = 0
        for _ in range(100):
            await server.clock.sleep(0.1)
            total += await served(client, how)
        assert abs(total - 500 / cost) <= 50 / cost

    run(test, work_burst=500, work_rate=50)


def test_what_takes_long_to_decode_is_more_work_unless_it_led_to_actions() -> None:
    async def flood(server: Server, how: Any, seconds: float) -> int:
        await server.clock.sleep(0.1)  # what the flood before wasted is forgotten
        client, count = await server.client(), 0
        client.send(frame(b"x") * 5000)
        while client.waiting():
            await client.receive()
            client.connection.took(seconds)
            client.connection.answered(how)
            count += 1
        return count

    async def test(server: Server) -> None:
        assert await flood(server, "neither", 0.0) == 20
        assert await flood(server, "neither", 0.001) == 5  # 1 each, and 4 for the millisecond of those that are decoded
        assert await flood(server, "bad", 0.25) == 2  # the second one was read ahead
        assert await flood(server, "good", 0.25) == 5000

    run(test, work_burst=500, work_rate=0.001, work_total_rate=1e9)


def test_pings_and_parts_are_work_too_and_large_messages_are_more() -> None:
    async def test(server: Server) -> None:
        pings, parts, large = [await server.client() for _ in range(3)]
        pings.send(frame(b"", PING) * 1000)
        assert pings.transport.written.count(b"\x8a\x00") == 20
        parts.send(frame(b"", final=False) + frame(b"", CONTINUED, final=False) * 1000)
        assert 100 < len(parts.connection.recv_messages.frames.queue) < 300
        for _ in range(10):
            large.send(frame(bytes(MIB)))
        assert await served(large, "bad") == 2  # 17 each
        assert not any(client.transport.reading for client in (pings, parts, large))

    run(test, work_burst=500, work_rate=1)


def test_work_that_led_to_actions_costs_nothing() -> None:
    async def test(server: Server) -> None:
        client = await server.client()
        for _ in range(1000):
            client.send(frame(b"x" * 1000))
            assert await served(client, "good") == 1
        assert client.transport.reading

    run(test, work_burst=10, work_rate=0.001)


def test_who_comes_while_work_is_wasted_waits_in_line_and_who_is_there_does_not() -> None:
    async def test(server: Server) -> None:
        good, bad = await server.client(), await server.client()
        bad.send(frame(b"x"))
        await bad.receive()
        bad.connection.took(0.02)  # 80, and 4
        bad.connection.answered("bad")
        bad.transport.abort()
        good.send(frame(b"x"))
        assert await served(good, "good") == 1
        late, later = await server.client(), await server.client()
        later.send(frame(b"x"))
        late.send(frame(b"x"))
        for client, seconds in ((late, 0.84), (later, 0.25)):  # 84 of 100 a second; 30 for the one before
            await server.clock.sleep(seconds - 0.05)
            assert not client.waiting()
            await server.clock.sleep(0.1)
            assert await served(client, "good") == 1

    run(test, work_total_rate=100)


def test_connections_that_are_slowed_share_one_rate() -> None:
    async def test(server: Server) -> None:
        clients = [await server.client() for _ in range(10)]
        for client in clients:
            client.send(frame(b"\xc1") * 5000)
            await served(client, "neither")
        total = 0
        for _ in range(40):
            await server.clock.sleep(0.25)
            for client in clients:
                total += await served(client, "neither")
        assert 700 <= total <= 1100  # not 10 * 50 * 10
        for client in clients[1:]:
            client.transport.abort()
        await server.clock.sleep(1.0)
        assert server.shared.pool.slowed <= 1
        assert 0 < await served(clients[0], "neither") <= 80

    run(test, work_burst=100, work_rate=50, work_total_rate=100)


def test_bad_messages_in_a_row_are_counted_and_a_good_one_forgives() -> None:
    async def test(server: Server) -> None:
        client = await server.client()
        for how, expected in (("bad", 1), ("bad", 2), ("neither", 2), ("bad", 3), ("good", 0), ("bad", 1)):
            client.send(frame(b"x"))
            await served(client, how)
            assert client.connection.bad_in_a_row == expected

    run(test, work_burst=1000)


# --- deadlines --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "begun",
    [
        frame(b"x" * 1000)[:-1],
        frame(b"x" * 1000)[:3],
        b"\x82",
        frame(b"", final=False),
        frame(b"abc", PING)[:-1],
        frame(b"x", final=False) + frame(b"", PING),
    ],
)
def test_what_was_begun_must_end(begun: bytes) -> None:
    async def test(server: Server) -> None:
        client = await server.client()
        client.send(begun)
        await server.clock.sleep(9.9)
        assert client.closed_with is None
        await server.clock.sleep(0.2)
        reason = "half a message, and less than 100 kB/s for 10 s: send it whole"
        assert client.closed_with == (1008, reason)
        assert server.errors("slow") == 1
        await server.clock.sleep(5.1)  # it doesn't answer the close frame either
        assert client.transport.closed

    run(test)


def test_a_large_message_may_take_long_as_long_as_it_goes_on() -> None:
    async def test(server: Server) -> None:
        client = await server.client()
        data = frame(bytes(12_000_000))
        for begin in range(0, len(data), 200_000):
            client.send(data[begin : begin + 200_000])
            await server.clock.sleep(1.5)
        assert client.closed_with is None
        assert await served(client, "good") == 1
        await server.clock.sleep(1000)
        assert client.closed_with is None

    run(test)


def test_a_message_that_trickles_is_not_waited_for() -> None:
    async def test(server: Server) -> None:
        client = await server.client()
        client.send(frame(bytes(12_000_000))[:11_000_000])
        for _ in range(25):
            client.send(b"x")
            await server.clock.sleep(1.0)
        assert client.closed_with is not None

    run(test)


def test_parts_without_end_do_not_keep_a_message_alive() -> None:
    async def test(server: Server) -> None:
        client = await server.client()
        client.send(frame(b"", final=False))
        for _ in range(40):
            client.send(frame(b"", CONTINUED, final=False) * 10_000)
            await server.clock.sleep(0.5)
        assert client.closed_with is not None

    run(test)


def test_an_idle_client_and_one_whose_request_takes_long_have_no_deadline() -> None:
    async def test(server: Server) -> None:
        idle, busy = await server.client(), await server.client()
        busy.send(frame(b"1") + frame(b"2") + frame(b"3" * 1000)[:-1])
        await server.clock.sleep(10_000)
        assert idle.closed_with is None
        assert busy.closed_with is None
        await busy.receive()
        busy.connection.answered("good")  # from here on the third is read, and is only half there
        await server.clock.sleep(10.1)
        assert busy.closed_with is not None

    run(test)


def test_a_client_that_does_not_read_is_cut_and_its_pings_are_not_piled_up() -> None:
    async def test(server: Server) -> None:
        client = await server.client()
        client.connection.pause_writing()
        client.send(frame(bytes(125), PING) * 1000)
        assert not client.transport.reading
        assert client.transport.written == b""
        await server.clock.sleep(29.9)
        assert not client.transport.closed
        await server.clock.sleep(0.2)
        assert client.transport.closed
        assert server.errors("slow") == 1

    run(test)


def test_a_client_that_reads_late_is_served_on() -> None:
    async def test(server: Server) -> None:
        client = await server.client()
        client.connection.pause_writing()
        client.send(frame(b"late", PING))
        await server.clock.sleep(20)
        client.connection.resume_writing()
        assert client.transport.written == b"\x8a\x04late"
        assert client.transport.reading
        await server.clock.sleep(100)
        assert not client.transport.closed

    run(test)


def test_a_connection_that_is_being_closed_ends_whatever_the_client_does() -> None:
    async def test(server: Server) -> None:
        client = await server.client()
        client.connection.pause_writing()  # the close frame can't leave
        closing = asyncio.create_task(client.connection.close(1001, "the server is shutting down"))
        await asyncio.sleep(0)
        await server.clock.sleep(5.1)
        assert client.transport.closed
        await asyncio.wait_for(closing, 30)
        half_closed = await server.client()
        half_closed.connection.eof_received()
        await server.clock.sleep(5.1)
        assert half_closed.transport.closed

    run(test)


@pytest.mark.parametrize("state", ["closing", "its HTTP request has no end"])
def test_what_has_no_use_is_read_slowly(state: str) -> None:
    async def test(server: Server) -> None:
        client = await server.client() if state == "closing" else server.accept()
        if state == "closing":
            client.send(b"\x82\x00")  # not masked: the server closes
        for _ in range(10):
            client.send(b"x" * 100_000)
            assert not client.transport.reading
            await server.clock.sleep(0.021)
            assert client.transport.reading

    run(test)


# --- memory -----------------------------------------------------------------------------------------------------------

MEMORY = {"work_burst": 10_000, "message_bytes": 8 * MIB, "memory_bytes": 10 * MIB, "free_bytes": MIB}


def test_large_messages_wait_for_memory_and_small_ones_do_not() -> None:
    async def test(server: Server) -> None:
        first, second, small = [await server.client() for _ in range(3)]
        first.send(frame(bytes(8 * MIB)))
        second.send(frame(bytes(8 * MIB))[: 256 * 1024])
        assert server.shared.memory.used == 7 * MIB
        assert not second.transport.reading
        small.send(frame(bytes(MIB)))
        assert await served(small, "good") == 1
        assert await served(first, "good") == 1
        assert second.transport.reading  # there is room now
        second.send(frame(bytes(8 * MIB))[256 * 1024 :])
        assert await served(second, "good") == 1
        assert server.shared.memory.used == 0
        await server.clock.sleep(100)
        assert second.closed_with is None

    run(test, **MEMORY)


def test_a_message_in_parts_counts_with_all_of_them() -> None:
    async def test(server: Server) -> None:
        client = await server.client()
        client.send(frame(bytes(MIB), final=False))
        assert server.shared.memory.used == 0
        client.send(frame(bytes(MIB), CONTINUED, final=False) + frame(bytes(MIB), CONTINUED))
        assert server.shared.memory.used == 2 * MIB
        assert await served(client, "bad") == 1
        assert server.shared.memory.used == 0

    run(test, **MEMORY)


def test_who_waits_for_memory_for_long_is_sent_away() -> None:
    async def test(server: Server) -> None:
        holding, waiting = await server.client(), await server.client()
        holding.send(frame(bytes(8 * MIB)))
        waiting.send(frame(bytes(8 * MIB))[: 256 * 1024])
        await server.clock.sleep(30.1)
        assert waiting.closed_with is not None
        assert waiting.closed_with[0] == 1013
        assert "too many large messages" in waiting.closed_with[1]

    run(test, **MEMORY)


def test_a_connection_that_is_lost_holds_nothing() -> None:
    async def test(server: Server) -> None:
        clients = [await server.client() for _ in range(2)]
        clients[0].send(frame(bytes(8 * MIB)) + frame(b"x"))
        clients[1].send(frame(bytes(8 * MIB))[: 256 * 1024])
        half = await server.client()
        half.send(frame(bytes(2 * MIB))[:MIB])
        for client in (*clients, half):
            client.transport.abort()
            await asyncio.sleep(0)  # the connection learns of it: before that a whole message may still be received
            with pytest.raises(ConnectionClosed):
                await client.receive()
            assert not client.connection.recv_messages.frames.queue
            assert len(client.connection.protocol.reader.buffer) == 0
        assert server.shared.memory.used == 0

    run(test, **MEMORY)


def test_a_message_that_comes_with_the_connections_end_is_still_received() -> None:
    async def test(server: Server) -> None:
        client = await server.client()
        receiving = asyncio.ensure_future(client.receive())
        await asyncio.sleep(0)
        await asyncio.sleep(0)  # `recv` waits now
        client.send(frame(b"first") + frame(b"second"))
        client.connection.connection_lost(None)  # before `recv` could go on
        assert await receiving == b"first"
        assert not client.connection.recv_messages.frames.queue
        with pytest.raises(ConnectionClosed):
            await client.receive()

    run(test)


def test_a_client_that_is_held_back_is_not_cut_for_its_silence_and_a_dead_one_is() -> None:
    async def test(server: Server) -> None:
        client = await server.client()
        client.connection.ping_interval = client.connection.ping_timeout = 0.001
        client.connection.loop = asyncio.get_running_loop()
        client.send(frame(b"request"))
        client.connection.start_keepalive()
        while b"\x89" not in client.transport.written:  # a ping
            await asyncio.sleep(0.001)
        await asyncio.sleep(0.05)  # its pong stands behind what isn't read yet
        assert client.closed_with is None
        client.connection.answered("good")
        while client.closed_with is None:
            await asyncio.sleep(0.001)
        assert client.closed_with == (1011, "keepalive ping timeout")

    run(test)


# --- at once, and from other threads ----------------------------------------------------------------------------------


class SlotsOfOne:
    """Shared memory that holds one message, whatever is asked for."""

    def __init__(self, message: bytes) -> None:
        self._message = message

    def message(self, received: bytes) -> bytes | None:
        return self._message if received == b"\xc1slot!" else None

    def close(self) -> None:
        pass


def test_a_message_in_shared_memory_costs_what_it_costs_in_the_socket() -> None:
    async def test(server: Server) -> None:
        message, levels = camera_images(0), []
        for sent in (frame(message), frame(b"\xc1slot!")):
            client = await server.client()
            client.connection._slots = SlotsOfOne(message)  # type: ignore[assignment]
            client.send(sent)
            levels.append((client.connection._credit._level, client.connection._unanswered[0].work))
            assert await client.receive() == message
        assert levels[0] == pytest.approx(levels[1], abs=0.01)  # but for the few bytes that say where it is

    run(test)


@pytest.mark.parametrize("kind", ["one frame", "two frames", "text", "a ping before"])
def test_a_message_is_taken_in_the_callback_that_brings_it_if_it_is_one_frame(kind: str) -> None:
    data = {
        "one frame": frame(b"one"),
        "two frames": frame(b"o", final=False) + frame(b"ne", CONTINUED),
        "text": frame(b"one", 1),
        "a ping before": frame(b"", PING) + frame(b"one"),
    }[kind]

    async def test(server: Server) -> None:
        client, taken, done = await server.client(), list[bytes](), asyncio.get_running_loop().create_future()

        def take(message: bytes | memoryview) -> asyncio.Future[Any]:
            taken.append(bytes(message))
            return done

        receiving = asyncio.ensure_future(client.connection.recv_taken(take))
        await asyncio.sleep(0)
        client.send(data + frame(b"two"))
        at_once = kind in ("one frame", "a ping before")
        assert taken == ([b"one"] if at_once else [])  # once: the next message waits for its turn
        for _ in range(5):
            await asyncio.sleep(0)
        assert receiving.done() is not at_once
        done.set_result(None)
        assert await receiving == ("one" if kind == "text" else b"one")
        assert await client.connection.recv_taken(take) == b"two"
        assert len(taken) == at_once

    run(test)


def test_who_waits_for_a_taken_message_hears_of_the_connections_end() -> None:
    async def test(server: Server) -> None:
        for sends in (True, False):
            client = await server.client()
            never: asyncio.Future[None] = asyncio.get_running_loop().create_future()

            def take(message: bytes | memoryview, never: asyncio.Future[None] = never) -> asyncio.Future[None]:
                return never

            receiving = asyncio.ensure_future(client.connection.recv_taken(take))
            await asyncio.sleep(0)
            if sends:
                client.send(frame(b"one"))
            client.transport.abort()
            with pytest.raises(ConnectionClosed):
                await asyncio.wait_for(receiving, 30)
            never.cancel()

    run(test)


@contextlib.contextmanager
def written_to(client: Client, *, takes: int | None = None) -> Iterator[socket.socket]:
    """The other end of a socket that a connection may write to, of which so many bytes are taken at once."""
    near, far = socket.socketpair()
    client.connection._descriptor = near.fileno()
    near.setblocking(False)
    if takes is not None:
        near.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, takes)
    with near, far:
        yield far


def test_an_answer_sent_at_once_is_a_frame_like_any_other() -> None:
    async def test(server: Server) -> None:
        client = await server.client()
        with written_to(client) as far:
            thread = threading.Thread(target=lambda: client.connection.send_at_once(b"x" * 300))
            thread.start()
            thread.join()
            assert far.recv(1000) == b"\x82\x7e\x01\x2c" + b"x" * 300
        assert not client.transport.written

    run(test)


def test_what_the_socket_does_not_take_follows_before_anything_else() -> None:
    async def test(server: Server) -> None:
        client, message = await server.client(), camera_images(0, 2_000_000)
        with written_to(client, takes=10_000) as far:
            assert client.connection.send_at_once(message)
            assert not client.connection.send_at_once(b"second")  # behind it
            first = far.recv(2_000_000)
            await client.connection.ping(b"later")
        written = client.transport.written
        assert first + written == b"\x82\x7f" + len(message).to_bytes(8, "big") + message + b"\x89\x05later"

    run(test)


@pytest.mark.parametrize("why", ["closing", "lost", "writes are pending", "the socket is full", "the client has left"])
def test_what_cannot_be_sent_at_once_is_left_to_the_event_loop(why: str) -> None:
    async def test(server: Server) -> None:
        client = await server.client()
        with written_to(client) as far:
            if why == "closing":
                client.connection.protocol.send_close(1001)
            elif why == "lost":
                client.connection.connection_lost(None)
            elif why == "writes are pending":
                client.transport.unsent = 1
            elif why == "the client has left":
                far.close()
            else:
                with contextlib.suppress(BlockingIOError):
                    while True:
                        os.write(client.connection._descriptor or 0, bytes(65536))
            assert not client.connection.send_at_once(b"x")

    run(test)
