"""Floods: one greedy or broken client, or thousands, while the good client goes on."""

import asyncio
import contextlib
import struct
import time
from collections.abc import Awaitable, Callable

from attack.arena import Arena
from attack.judging import TRACEBACK
from attack.messages import observation
from attack.websocket import PING, HandshakeRefused, Raw, frame, header, post, request
from turbopi.realtime.wire import pack

SLOW_WALK = b"\xdd\0\0\x4e\x1e" + b"\xc0" * 19998  # as many values as a message may have: the most work a byte
# The most headers of different kinds that a message may have, which no run of equal ones makes cheap.
WORST_WALK = b"\xdd\0\0\x0f\0" + b"\xa1a\x01" * 1920
LOST = (OSError, HandshakeRefused, asyncio.TimeoutError, asyncio.IncompleteReadError)
RECONNECT_S = 0.1


async def _attackers(arena: Arena, count: int, attack: Callable[[], Awaitable[None]]) -> None:
    """`count` clients that do `attack` again and again until time is up, whatever the server does to them."""
    end = arena.until()
    started = time.monotonic()

    async def one() -> None:
        while time.monotonic() < end:
            try:
                await asyncio.wait_for(attack(), end - time.monotonic())
            except asyncio.TimeoutError:
                return
            except LOST as error:
                status = f" {error.status}" if isinstance(error, HandshakeRefused) else ""
                arena.found.outcomes[f"lost: {type(error).__name__}{status}"] += 1
                await asyncio.sleep(RECONNECT_S)

    async def clock() -> None:
        while (now := time.monotonic()) < end:
            arena.tick((now - started) / arena.seconds)
            await asyncio.sleep(min(0.2, end - now))

    await asyncio.gather(clock(), *(one() for _ in range(count)))


async def _flood(arena: Arena, wire: bytes, frames: int, per_second: float | None, *, read: bool = True) -> None:
    """Send `wire`, which holds so many frames, over one connection: at a rate, or as fast as it is taken."""
    raw = await Raw.open(arena.port)
    reading = asyncio.ensure_future(_discard(raw, arena)) if read else None
    try:
        started, sent = time.monotonic(), 0
        while not raw.writer.transport.is_closing():
            raw.writer.write(wire)
            await raw.writer.drain()
            sent += frames
            arena.found.count += frames
            if per_second is not None:
                await asyncio.sleep(max(started + sent / per_second - time.monotonic(), 0))
    finally:
        if reading is not None:
            reading.cancel()
        raw.abort()


async def _discard(raw: Raw, arena: Arena) -> None:
    """Read answers and look only for what must never be among them."""
    while data := await raw.reader.read(2**20):
        arena.found.outcomes["bytes answered"] += len(data)
        if TRACEBACK.encode() in data:
            arena.found.violate("a traceback among the answers", arena_line(arena))


def arena_line(arena: Arena) -> str:
    return " ".join(arena.server.command)


async def slow_walk(arena: Arena) -> None:
    await _attackers(arena, 1, lambda: _flood(arena, frame(SLOW_WALK), 1, 112))


async def slow_walks(arena: Arena) -> None:
    await _attackers(arena, 8, lambda: _flood(arena, frame(SLOW_WALK) * 4, 4, None))


async def worst_walks(arena: Arena) -> None:
    await _attackers(arena, 8, lambda: _flood(arena, frame(WORST_WALK) * 4, 4, None))


async def reconnecting_walks(arena: Arena) -> None:
    """Clients that leave after a quarter of a second: whoever is limited by connection must limit those, too."""

    async def come_and_go() -> None:
        raw = await Raw.open(arena.port)
        try:
            raw.writer.write(frame(WORST_WALK) * 40)
            arena.found.count += 40
            end = time.monotonic() + 0.25
            while (left := end - time.monotonic()) > 0:
                reply = await raw.reply(left)
                arena.found.outcomes["left" if reply.kind == "silence" else reply.kind] += 1
                if reply.kind == "closed":
                    break
        finally:
            raw.abort()

    await _attackers(arena, 8, come_and_go)


async def one_byte(arena: Arena) -> None:
    await _attackers(arena, 1, lambda: _flood(arena, frame(b"\xc0") * 140, 140, 14_000))


async def one_byte_many(arena: Arena) -> None:
    """The same from many connections, so that a limit of each connection isn't all that helps."""
    await _attackers(arena, 50, lambda: _flood(arena, frame(b"\xc0") * 70, 70, 280))


async def refusals(arena: Arena) -> None:
    """Observations that no decoder takes, small and different: each might become a line of the log."""
    wire = b"".join(frame(pack(observation(arena.random)) + b"\xc0") for _ in range(50))
    await _attackers(arena, 4, lambda: _flood(arena, wire, 50, 1000))


async def posts(arena: Arena) -> None:
    """POSTs that are much work and come to nothing: many numbers, images that grow a thousandfold, then a fault."""
    import base64
    import io

    from PIL import Image

    stream = io.BytesIO()
    Image.new("RGB", (1100, 1100)).save(stream, "png")
    image = b'{"a": "data:image/png;base64,' + base64.b64encode(stream.getvalue()) + b'", "b": [{}]}'
    bodies = (b'{"a": [' + b"0.1," * 19_000 + b"1]", image, b"{", b"")
    wires = [post(arena.port, "application/json", body) for body in bodies]

    async def one() -> None:
        reader, writer = await asyncio.open_connection("127.0.0.1", arena.port)
        try:
            while True:
                writer.write(arena.random.choice(wires))
                arena.found.count += 1
                head = await reader.readuntil(b"\r\n\r\n")
                length = int(head.lower().partition(b"content-length: ")[2].partition(b"\r\n")[0])
                if TRACEBACK.encode() in await reader.readexactly(length):
                    arena.found.violate("a traceback in a response", arena_line(arena))
                arena.found.outcomes[f"HTTP {head[9:12].decode()}"] += 1
        finally:
            writer.transport.abort()

    await _attackers(arena, 8, one)


async def pings_unread(arena: Arena) -> None:
    """Pings whose pongs nobody reads: they must not pile up in the server."""
    await _attackers(arena, 4, lambda: _flood(arena, frame(bytes(125), PING) * 200, 200, None, read=False))


async def answers_unread(arena: Arena) -> None:
    """Good requests with big answers that nobody reads."""
    wire = frame(pack({**observation(arena.random), "attack_reply_bytes": 2**20}))
    await _attackers(arena, 4, lambda: _flood(arena, wire, 1, None, read=False))


async def big_messages(arena: Arena) -> None:
    """Sixty observations of 60 MB, one after the other, over one connection, and the answer awaited."""
    import numpy as np

    wire = frame(pack({"observation/state": np.zeros(8), "more": np.zeros(60_000_000, np.uint8)}))
    raw = await Raw.open(arena.port)
    for number in range(arena.count):
        raw.writer.write(wire)
        reply = await raw.reply(60)
        arena.found.count += 1
        arena.found.outcomes[reply.kind if reply.kind != "closed" else f"closed {reply.code}"] += 1
        arena.tick((number + 1) / arena.count)
        if reply.kind in ("closed", "silence"):
            raw.abort()
            raw = await Raw.open(arena.port)
    raw.abort()


async def half_messages(arena: Arena) -> None:
    """Thirty clients that send half of a message of 40 MB, and then nothing."""

    async def half() -> None:
        raw = await Raw.open(arena.port)
        raw.writer.write(header(40_000_000) + bytes(20_000_000))
        await raw.writer.drain()
        arena.found.count += 1
        reply = await raw.reply(600)
        arena.found.outcomes[f"closed {reply.code}"] += 1
        raw.abort()

    await _attackers(arena, 30, half)


async def trickles(arena: Arena) -> None:
    """A hundred clients that send a message a byte at a time."""
    wire = header(1_000_000) + b"\x81"

    async def trickle() -> None:
        raw = await Raw.open(arena.port)
        raw.writer.write(wire)
        try:
            while not raw.writer.transport.is_closing():
                raw.writer.write(b"\0")
                await raw.writer.drain()
                arena.found.count += 1
                await asyncio.sleep(0.2)
            arena.found.outcomes["closed"] += 1
        finally:
            raw.abort()

    await _attackers(arena, 100, trickle)


async def slow_handshakes(arena: Arena) -> None:
    """Three hundred clients whose opening request comes a byte at a time."""

    async def slow() -> None:
        reader, writer = await asyncio.open_connection("127.0.0.1", arena.port)
        try:
            for byte in request(arena.port, "X-Slow: " + "x" * 4000):
                writer.write(bytes([byte]))
                await writer.drain()
                await asyncio.sleep(0.5)
                if reader.at_eof():
                    arena.found.outcomes["closed"] += 1
                    return
        finally:
            arena.found.count += 1
            writer.transport.abort()

    await _attackers(arena, 300, slow)


async def idle(arena: Arena) -> None:
    """Thousands of connections that do nothing: half of them after the handshake, half without one."""
    held: list[Raw | asyncio.StreamWriter] = []
    started = time.monotonic()

    async def websockets(count: int) -> None:
        for _ in range(count):
            try:
                held.append(await Raw.open(arena.port, limit=2**12))
                arena.found.outcomes["let in"] += 1
            except LOST as error:
                status = error.status if isinstance(error, HandshakeRefused) else type(error).__name__
                arena.found.outcomes[f"turned away: {status}"] += 1
            arena.found.count += 1
            arena.tick(arena.found.count / arena.count / 2)

    async def sockets(count: int) -> None:
        for _ in range(count):
            with contextlib.suppress(OSError):
                held.append((await asyncio.open_connection("127.0.0.1", arena.port, limit=2**12))[1])
                arena.found.outcomes["sockets"] += 1
            arena.found.count += 1

    share = arena.count // 16
    try:
        await asyncio.gather(*(websockets(share) for _ in range(8)), *(sockets(share) for _ in range(8)))
        arena.found.notes["seconds to connect"] = round(time.monotonic() - started, 1)
        end = time.monotonic() + arena.seconds
        while (now := time.monotonic()) < end:
            arena.tick(1 - (end - now) / arena.seconds / 2)
            await asyncio.sleep(0.2)
    finally:
        for one in held:
            (one.writer if isinstance(one, Raw) else one).transport.abort()


async def no_descriptors(arena: Arena) -> None:
    """Twice as many connections as the server may have files open; every second of the time some more."""
    held: list[asyncio.StreamWriter] = []

    async def connect() -> None:
        with contextlib.suppress(*LOST):
            reader, writer = await asyncio.wait_for(asyncio.open_connection("127.0.0.1", arena.port), 5)
            held.append(writer)
            writer.write(request(arena.port))
            arena.found.count += 1
            await reader.read()
            arena.found.outcomes["closed"] += 1
        await asyncio.sleep(RECONNECT_S)

    try:
        await _attackers(arena, 200, connect)
    finally:
        for writer in held:
            writer.transport.abort()


async def churn(arena: Arena) -> None:
    """Connections that are opened and dropped, before, during and after the handshake."""

    async def come_and_go() -> None:
        reader, writer = await asyncio.open_connection("127.0.0.1", arena.port)
        depth = arena.random.randrange(4)
        if depth >= 1:
            writer.write(request(arena.port)[: 40 if depth == 1 else None])
        if depth >= 3:
            await reader.readuntil(b"\r\n\r\n")
            writer.write(frame(pack(observation(arena.random))))
        if arena.random.random() < 0.5:
            writer.transport.abort()
        else:
            writer.write(frame(struct.pack(">H", 1000), 8))
            writer.close()
        arena.found.count += 1
        await asyncio.sleep(0)

    await _attackers(arena, 4, come_and_go)
