"""A million damaged frames, every answer checked."""

import asyncio
import contextlib
from collections.abc import Sequence

from attack.arena import Arena, Found
from attack.judging import Reply, judge
from attack.messages import Case, case
from attack.websocket import HandshakeRefused, Raw

CONNECTIONS = 6
AHEAD = 24  # frames that a client sends before it reads their answers
PATIENCE_S = 30.0  # for one answer: silence is what never ends, not what takes long on a busy machine
RETRIES = 50


def reproduce(seed: int, number: int) -> str:
    return f"python -m attack frame {seed} {number}"


async def frames(arena: Arena, seed: int, total: int, shape: Sequence[int] | None = None) -> None:
    """Frames 0 to `total` of a seed, dealt out to some connections; `shape` of the actions where a model answers."""
    done = 0

    async def client(first: int) -> None:
        nonlocal done
        with Sender(arena.port, seed, arena.found, shape) as sender:
            for start in range(first * AHEAD, total, CONNECTIONS * AHEAD):
                numbers = range(start, min(start + AHEAD, total))
                await sender.send(numbers)
                done += len(numbers)
                arena.tick(done / total)

    await asyncio.gather(*(client(number) for number in range(CONNECTIONS)))


async def send(port: int, seed: int, numbers: Sequence[int], found: Found) -> None:
    """Some frames of a seed, over one connection at a time."""
    with Sender(port, seed, found) as sender:
        await sender.send(numbers)


class Sender:
    """Sends cases over a connection, and opens the next one when it is closed."""

    def __init__(self, port: int, seed: int, found: Found, shape: Sequence[int] | None = None) -> None:
        self._port, self._seed, self._found, self._shape = port, seed, found, shape
        self._raw: Raw | None = None

    def __enter__(self) -> "Sender":
        return self

    def __exit__(self, *_: object) -> None:
        self._leave()

    async def send(self, numbers: Sequence[int]) -> None:
        """Frames that all get an answer go ahead together; one that may end the connection goes alone."""
        ahead: list[tuple[int, Case]] = []
        for number in numbers:
            one = case(self._seed, number)
            if one.may_close or not one.answered:
                await self._exchange(ahead)
                await self._exchange([(number, one)])
                ahead = []
            else:
                ahead.append((number, one))
        await self._exchange(ahead)

    async def _exchange(self, cases: list[tuple[int, Case]]) -> None:
        if not cases:
            return
        raw = await self._connected()
        if raw is None:
            for number, one in cases:
                self._found.violate("no connection", f"{reproduce(self._seed, number)}  # {one.kind}")
            return
        raw.writer.write(b"".join(one.wire for _, one in cases))
        with contextlib.suppress(OSError):
            await raw.writer.drain()
        if not cases[0][1].answered:
            self._found.count += 1
            self._found.outcomes["left"] += 1
            self._leave()
            return
        for number, one in cases:
            reply = await raw.reply(PATIENCE_S)
            self._judge(number, one, reply)
            if reply.kind in ("closed", "silence"):
                self._leave()
                return  # a close has been judged; what was sent behind it gets no answer

    def _judge(self, number: int, one: Case, reply: Reply) -> None:
        judged = judge(one.message, reply, valid=one.valid, may_close=one.may_close, shape=self._shape)
        self._found.count += 1
        self._found.outcomes[judged.outcome] += 1
        if judged.fault is not None:
            self._found.violate(f"{one.kind}: {judged.fault}", reproduce(self._seed, number))

    async def _connected(self) -> Raw | None:
        for attempt in range(RETRIES):
            if self._raw is not None:
                return self._raw
            try:
                self._raw = await Raw.open(self._port)
            except (OSError, HandshakeRefused, asyncio.TimeoutError):
                await asyncio.sleep(0.02 * attempt)
        return self._raw

    def _leave(self) -> None:
        if self._raw is not None:
            self._raw.abort()
            self._raw = None
