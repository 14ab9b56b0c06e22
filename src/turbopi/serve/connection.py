"""A websocket connection that costs the server no more than its share, whatever its client does.

The websockets library reads all that comes, as fast as it comes. This connection stands between the socket and the
library: it reads only the frames' headers, hands over what may be handled now, stores the rest (at most one read of
the socket, 512 KiB) and stops reading. TCP then stops the client. Messages with images bypass the library:
zero_copy.py.
"""

import asyncio
import contextlib
import os
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple, Protocol

from websockets.asyncio.server import ServerConnection
from websockets.frames import CloseCode, Frame, Opcode
from websockets.http11 import Request, Response
from websockets.protocol import Event, State
from websockets.server import ServerProtocol

from turbopi.policy.watch import Watch
from turbopi.realtime.frames import binary_head
from turbopi.realtime.shared_memory import HEADER, WANTED, SharedSlots
from turbopi.realtime.wire import Unpacker
from turbopi.serve.limited_log import LimitedLog, peer
from turbopi.serve.limits import Credit, Limits, MemoryBudget, WorkPool
from turbopi.serve.metrics import Metrics
from turbopi.serve.zero_copy import MAX_BYTES, SpareBuffer, ZeroCopyFrame, apply_mask, is_zero_copy

MAX_UNANSWERED = 2  # messages of one client: one that is computed, one that waits
READ_BYTES = 512 * 1024  # at most, in one read of a socket: two images of 224 x 224 are 300 KB
BYTES_OF_ONE_WORK = 65536
DISCARD_PAUSE_SECONDS = 0.002  # between reads of discarded bytes: 128 MB/s and more, so that a client gets to read why
WORK_OF_A_SECOND = 4000.0  # of decoding: 5 * Limits.work_total_rate, so all who are slowed get a fifth of the loop
WORK_OF_A_REFUSAL = 3.0  # to find the error, send and log it
CAN_WRITE = os.name == "posix"  # to a socket by its descriptor


@dataclass
class Shared:
    """What the connections of a server share."""

    limits: Limits
    metrics: Metrics
    log: LimitedLog
    clock: Callable[[], float] = time.monotonic
    memory: MemoryBudget = field(init=False)
    pool: WorkPool = field(init=False)
    slots: int = field(default=0, init=False)  # clients with shared memory
    in_place: bool = False  # the policy reads images where the client wrote them
    spare: SpareBuffer = field(default_factory=SpareBuffer, init=False)
    # One for all connections: what one read brought is handled before the next read.
    scratch: memoryview = field(default_factory=lambda: memoryview(bytearray(READ_BYTES)), init=False)

    def __post_init__(self) -> None:
        self.memory = MemoryBudget(max(self.limits.memory_bytes, self.limits.message_bytes))
        self.pool = WorkPool(self.limits.work_total_rate, self.clock)


class Owner(Protocol):
    """What a connection needs of its listener."""

    def is_serving(self) -> bool: ...

    def connected(self, connection: "GuardedConnection") -> None: ...


class FrameHead(NamedTuple):
    """The header of a websocket frame (RFC 6455, 5.2)."""

    size: int  # bytes of the header itself
    length: int  # bytes of the payload
    opcode: int
    final: bool
    zero_copy: bool  # its payload may bypass the library, if it begins a message


def frame_head(data: bytes | memoryview, at: int) -> FrameHead | None:
    """The header that begins at `data[at]`; None if its end hasn't come yet. Its errors aren't checked here."""
    if len(data) < at + 2:
        return None
    first, second = data[at], data[at + 1]
    short = second & 0x7F
    extended = 0 if short < 126 else 2 if short == 126 else 8
    size = 2 + extended + (4 if second & 0x80 else 0)
    if len(data) < at + size:
        return None
    length = int.from_bytes(data[at + 2 : at + 2 + extended], "big") if extended else short
    return FrameHead(size, length, first & 0x0F, bool(first & 0x80), is_zero_copy(first, second, length))


Take = Callable[["bytes | memoryview"], "asyncio.Future[Any] | None"]  # see `GuardedConnection.recv_taken`


@dataclass
class _Message:
    """What a message has cost so far."""

    size: int = 0
    work: float = 0.0
    memory: int = 0


class GuardedConnection(ServerConnection, asyncio.BufferedProtocol):
    """One client. `answered` must be called for each message that `recv` gave, once it is dealt with."""

    posted = ""  # "HTTP" and the host, if it carries one POST and ends with it (http_api.py)

    def __init__(self, protocol: ServerProtocol, owner: Owner, shared: Shared, credit: Credit | None = None) -> None:
        limits = shared.limits
        super().__init__(protocol, owner, close_timeout=limits.close_seconds, max_queue=None)  # type: ignore[arg-type]
        self.bad_in_a_row = 0
        self.robot = ""  # the name that its client gave; its session's, if it gave none
        self.cycle_s: float | None = None  # from waiting for the last request to having sent its actions
        self.unpacker = Unpacker()  # of its messages
        self.watch, self.batch_watch = Watch(), Watch(remembers=False)  # of its robot; of the rows of batch messages
        self._owner, self._shared, self._limits = owner, shared, limits
        self._credit = Credit(limits, shared.pool, shared.clock) if credit is None else credit
        self._head: bytes | None = b""  # the last bytes of the HTTP request as long as that goes on
        self._backlog: bytes | memoryview = b""  # received and not handed over yet
        self._payload_left = 0  # bytes of the current frame's payload that are still to come
        self._ends_message = False  # the current frame is the last one of a message
        self._message: _Message | None = None  # begun and not complete
        self._zero_copy: ZeroCopyFrame | None = None  # the current frame, if it isn't the library's
        self._unanswered: deque[_Message] = deque()
        self._handed_over = 0  # bytes of messages
        self._timers: dict[str, asyncio.TimerHandle] = {}
        self._writing = threading.RLock()  # for the socket; other threads write to it in `send_at_once` alone
        self._take: Take | None = None
        self._waiter: asyncio.Future[bytes | memoryview | None] | None = None
        self._slots: SharedSlots | None = None
        self._unsent: bytes | memoryview = b""  # what the socket didn't take there
        self._descriptor: int | None = None

    # --- what the server calls ----------------------------------------------------------------------------------------

    @property
    def slowed(self) -> bool:
        """Whether it is read more slowly than its client sends: then its pauses aren't the client's."""
        return self._credit.slowed

    def opened(self) -> None:
        """The handshake is done."""
        self.start_keepalive()
        self._feed()

    def took(self, seconds: float) -> None:
        """Decoding the oldest message took so long: a few bytes can be much work. Call it before `answered`."""
        work = seconds * WORK_OF_A_SECOND
        self._credit.spend(work)
        if self._unanswered:  # not after the connection was lost
            self._unanswered[0].work += work

    def answered(self, how: Literal["good", "bad", "neither"]) -> None:
        """The oldest message is done with: it got actions, it was bad, or it got none and wasn't bad."""
        if self._unanswered:  # not after the connection was lost
            message = self._unanswered.popleft()
            self._shared.memory.give_back(message.memory)
            if how == "good":
                self._credit.give_back(message.work)
            else:
                self._shared.pool.waste(message.work)
        if how == "bad":
            self._credit.spend(WORK_OF_A_REFUSAL)
            self._shared.pool.waste(WORK_OF_A_REFUSAL)
        if how != "neither":
            self.bad_in_a_row = self.bad_in_a_row + 1 if how == "bad" else 0
        self._feed()

    def offer_memory(self, request: Request, response: Response) -> None:
        """Say in the response where a client on this host that asks for shared memory finds it."""
        if request.headers.get(HEADER) != WANTED or response.status_code != 101 or not self._is_near():
            return
        if self._shared.slots >= self._limits.shared_memory:
            return
        with contextlib.suppress(OSError):  # the socket will do
            self._slots = SharedSlots(min(MAX_BYTES, self._limits.free_bytes, self._limits.message_bytes))
            self._shared.slots += 1
            response.headers[HEADER] = self._slots.offer

    def _is_near(self) -> bool:
        """Whether its client is on this host, or behind a proxy on this host."""
        near, far = (self.transport.get_extra_info(name) for name in ("sockname", "peername"))
        return bool(near and far) and near[0] == far[0]

    async def recv_taken(self, take: "Take") -> str | bytes | memoryview:
        """`recv`, but `take` has the message at once, in the callback that received it, if it comes in one frame.

        If it returns a Future, this returns the message when that is done: nothing is done for it before. It may not
        raise. When the connection is lost meanwhile, this raises as `recv` does.
        """
        if not self.recv_messages.frames and self.protocol.state is State.OPEN:
            self._waiter = waiter = self.loop.create_future()
            self._take = take
            try:
                message = await waiter
            finally:
                self._take = self._waiter = None
            if message is not None:
                return message
        return await self.recv()

    def _wake(self, message: bytes | memoryview | None) -> None:
        if self._waiter is not None and not self._waiter.done():
            self._waiter.set_result(message)

    def send_at_once(self, message: bytes) -> bool:
        """Send a binary message from any thread, if that can be done now; False: it is to be sent by `send`.

        The caller sees to it that nothing else is sent on this connection meanwhile, but for what the library sends.
        """
        frame = binary_head(len(message)) + message
        with self._writing:  # without the lock the descriptor might be another connection's by now
            if self._descriptor is None or self.protocol.state is not State.OPEN or self.transport.is_closing():
                return False
            if self._unsent or self.transport.get_write_buffer_size():
                return False
            try:
                sent = os.write(self._descriptor, frame)
            except OSError:  # it takes nothing now, or is at its end, which the event loop sees, too
                return False
            if sent < len(frame):
                self._unsent = memoryview(frame)[sent:]
                self.loop.call_soon_threadsafe(self.send_data)
            return True

    async def keepalive(self) -> None:
        """The library's, which cuts a client that doesn't answer a ping in time, but for those that are held back here:
        their pong may stand behind requests that wait for their turn, and aren't read yet.
        """
        assert self.ping_interval is not None
        while True:
            await asyncio.sleep(self.ping_interval)
            pong = asyncio.ensure_future(await self.ping())
            while self.ping_timeout is not None and not pong.done():
                await asyncio.wait([pong], timeout=self.ping_timeout)
                if not (pong.done() or self._unanswered or self._backlog):
                    async with self.send_context():
                        self.protocol.fail(CloseCode.INTERNAL_ERROR, "keepalive ping timeout")

    # --- what asyncio calls -------------------------------------------------------------------------------------------

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        super(ServerConnection, self).connection_made(transport)  # its own would start the library's server's handler
        sock = transport.get_extra_info("socket")
        self._descriptor = sock.fileno() if CAN_WRITE and sock is not None else None
        self._owner.connected(self)

    def get_buffer(self, sizehint: int) -> memoryview:
        return self._shared.scratch if self._zero_copy is None else self._zero_copy.free

    def buffer_updated(self, nbytes: int) -> None:
        if self._zero_copy is None:
            self.data_received(self._shared.scratch[:nbytes])
        else:
            self._zero_copy.received(nbytes)
            self._count_payload(nbytes)
            self._process(b"")

    def data_received(self, data: bytes | memoryview) -> None:
        """Bytes that weren't read into the buffer of `get_buffer`: uvloop, for one, never uses that."""
        if self._head is not None:
            data = self._http(bytes(data))
            if not data:
                return
        if self._zero_copy is not None:
            part = data[: self._payload_left]
            self._zero_copy.add(part)
            self._count_payload(len(part))
            data = data[len(part) :]
        self._process(data)

    def _process(self, data: bytes | memoryview) -> None:
        if self.protocol.close_expected():
            self._hand_over(data)  # which throws it away
            self._pause_reading_briefly()
        else:
            self._backlog = bytes(self._backlog) + data if self._backlog else data
            self._feed()
            self._backlog = bytes(self._backlog)  # the next read of any connection writes over the scratch

    def eof_received(self) -> None:
        super().eof_received()
        self._once("close", self._limits.close_seconds, self.transport.abort)

    def pause_writing(self) -> None:
        super().pause_writing()
        self._once("write", self._limits.write_seconds, self._abort_unread)

    def resume_writing(self) -> None:
        super().resume_writing()
        self._cancel("write")
        self._feed()

    def send_data(self) -> None:
        with self._writing:
            if self._unsent:
                unsent, self._unsent = self._unsent, b""
                self.transport.write(unsent)
            super().send_data()
        if self.protocol.close_expected():
            self._once("close", self._limits.close_seconds, self.transport.abort)
            if self._backlog and self.protocol.state is State.CONNECTING:
                # Refused. A socket that isn't read to its end may lose the refusal, and doesn't see its client leave.
                self._backlog = b""
                self._set_reading(True)

    def connection_lost(self, exc: Exception | None) -> None:
        with self._writing:  # asyncio closes the socket after this
            super().connection_lost(exc)
        for timer in self._timers.values():
            timer.cancel()
        self._timers.clear()
        self._wake(None)
        if self._slots is not None:
            self._slots.close()
            self._slots = None
            self._shared.slots -= 1
        self._credit.close()
        self._shared.memory.forget(self._feed)
        for message in (*self._unanswered, *([self._message] if self._message else ())):
            self._shared.memory.give_back(message.memory)
            self._shared.pool.waste(message.work)
        self._unanswered.clear()
        self._message, self._zero_copy, self._backlog = None, None, b""
        # This object is part of reference cycles, which may live long: what is large in it must not.
        self.protocol.reader.buffer.clear()
        frames = self.recv_messages.frames
        if frames.get_waiter is None:
            frames.queue.clear()
        else:  # a message that came a moment ago has woken `recv`, which counts on it
            self.loop.call_soon(frames.queue.clear)

    def process_event(self, event: Event) -> None:
        if self._slots is not None and isinstance(event, Frame) and event.opcode is Opcode.BINARY and event.fin:
            event = self._from_slot(event, self._slots)
        if self._take is not None and isinstance(event, Frame) and event.opcode < Opcode.CLOSE:
            take, self._take = self._take, None
            if event.opcode is Opcode.BINARY and event.fin and len(event.data) < MAX_BYTES:
                message = event.data if type(event.data) is memoryview else bytes(event.data)
                if (until := take(message)) is None:
                    self._wake(message)
                else:
                    until.add_done_callback(lambda _: self._wake(message))
                return
            self._wake(None)
        if isinstance(event, Frame) and type(event.data) is memoryview:
            event = Frame(Opcode.BINARY, bytes(event.data))
        super().process_event(event)

    def _from_slot(self, frame: Frame, slots: SharedSlots) -> Frame:
        """The frame, or the message that it says is in a slot, paid for as if it had come through the socket."""
        message = slots.message(bytes(frame.data))
        if message is None:
            return frame
        work = len(message) / BYTES_OF_ONE_WORK
        self._credit.spend(work)
        self._unanswered[-1].work += work
        return Frame(Opcode.BINARY, message if self._shared.in_place else bytes(message))

    # --- what comes in ------------------------------------------------------------------------------------------------

    def _http(self, data: bytes) -> bytes:
        """Hand the HTTP request over, at whose end frames begin; those are returned."""
        assert self._head is not None
        joined = self._head + data
        end = joined.find(b"\r\n\r\n")
        if end < 0:
            self._head = joined[-3:]
            super().data_received(data)
            self._pause_reading_briefly()
            return b""
        end += 4 - len(self._head)
        self._head = None
        super().data_received(data[:end])
        return data[end:]

    def _feed(self) -> None:
        """Hand over what may be handled now, and read on if nothing is left."""
        if self.protocol.state is not State.OPEN or not self._backlog:
            blocked = self.protocol.state is State.CONNECTING and bool(self._backlog)
        elif self.paused:
            blocked = True  # it doesn't read what it is sent: what it sends would only lead to more
        else:
            if self._timers:
                self._cancel("retry")
            self._credit.refill()
            blocked = self._scan()
        self._set_reading(not blocked)
        self._watch_progress(blocked)

    def _scan(self) -> bool:
        """Hand over as much of the backlog as may be handled now. Returns whether the rest must wait.

        A rest that needn't wait is half a header. The library gets all in one piece, except zero-copy frames.
        """
        data, at, begun, waits = self._backlog, 0, 0, False  # the library's next piece begins at `begun`
        while at < len(data):
            if not self._payload_left:
                head = frame_head(data, at)
                if head is None:
                    break
                begins = self._message is None
                if not self._admit(head):
                    waits = True
                    break
                self._payload_left = head.length
                if begins and head.zero_copy and head.length <= self._limits.message_bytes:
                    if at > begun:
                        self._hand_over(data[begun:at])
                    begun = at + head.size
                    mask, end = bytes(data[begun - 4 : begun]), begun + head.length
                    if end <= len(data):  # it is here as a whole
                        self._count_payload(head.length, apply_mask(data[begun:end], mask))
                        at = begun = end
                        continue
                    self._zero_copy = ZeroCopyFrame(self._shared.spare, head.length, mask)
                at += head.size
            part = min(self._payload_left, len(data) - at)
            if self._zero_copy is not None:
                self._zero_copy.add(data[at : at + part])
                begun = at + part
            at += part
            self._count_payload(part)
        self._backlog = data[at:]
        self._hand_over(data[begun:at])
        return waits

    def _count_payload(self, size: int, message: bytes | None = None) -> None:
        """Count bytes of the current frame's payload. `message`: all of it, if it bypasses the library."""
        self._payload_left -= size
        if self._message is None:
            return
        self._handed_over += size
        if self._payload_left:
            return
        if self._ends_message:
            self._unanswered.append(self._message)
            self._message = None
        if self._zero_copy is not None:
            message, self._zero_copy = self._zero_copy.message(), None
        if message is not None and self.protocol.state is State.OPEN:  # not after a bad frame or a close
            self.process_event(Frame(Opcode.BINARY, message))

    def _hand_over(self, data: bytes | memoryview) -> None:
        """Give the library what it is to see. It copies that."""
        if data:
            super().data_received(data)  # type: ignore[arg-type]  # any object that holds bytes will do

    def _admit(self, head: FrameHead) -> bool:
        """Whether the frame may be handled now; if so, it is paid for."""
        if self._credit.spent:
            self._once("retry", self._credit.wait(), self._feed)
            return False
        if head.opcode >= 8:  # close, ping, pong
            self._credit.spend(1.0)
            return True
        message = self._message
        if message is None:
            if len(self._unanswered) >= MAX_UNANSWERED:
                return False
            message = _Message()
        size = message.size + head.length
        if size <= self._limits.message_bytes:  # if not, the library refuses it by its header
            needed = max(0, size - self._limits.free_bytes) - message.memory
            if needed > 0 and not self._reserve_memory(needed):
                return False
            message.memory += max(0, needed)
        work = (0.1 if self._message else 1.0) + head.length / BYTES_OF_ONE_WORK
        self._credit.spend(work)
        message.size, message.work = size, message.work + work
        self._message, self._ends_message = message, head.final
        return True

    def _reserve_memory(self, size: int) -> bool:
        """Take memory for a large message, or be called again when some is free, and give up at last."""
        self._shared.memory.forget(self._feed)
        if self._shared.memory.take(size, self._feed):
            self._cancel("memory")
            return True
        reason = "the server holds too many large messages already: send smaller ones, or try again later"
        self._once("memory", self._limits.memory_seconds, lambda: self._fail(CloseCode.TRY_AGAIN_LATER, reason))
        return False

    def _pause_reading_briefly(self) -> None:
        """Read on in a moment: what has no use may come without end until its deadline."""
        self._set_reading(False)
        self._once("discard", DISCARD_PAUSE_SECONDS, lambda: self._set_reading(True))

    def _set_reading(self, on: bool) -> None:
        if on:
            self.transport.resume_reading()
        else:
            self.transport.pause_reading()

    # --- deadlines ----------------------------------------------------------------------------------------------------

    def _once(self, name: str, seconds: float, call: Callable[[], object]) -> None:
        """Call after `seconds`, unless a timer of that name runs already or it is cancelled."""

        def due() -> None:
            del self._timers[name]
            call()

        if name not in self._timers:
            self._timers[name] = self.loop.call_later(seconds, due)

    def _cancel(self, name: str) -> None:
        if timer := self._timers.pop(name, None):
            timer.cancel()

    def _watch_progress(self, blocked: bool) -> None:
        """Half a message or frame must go on, unless it is this server that doesn't read on."""
        half = bool(self._payload_left or self._message or self._backlog) and self.protocol.state is State.OPEN
        if not half or (blocked and "retry" not in self._timers):  # a slowed client must still end what it began
            self._cancel("progress")
        elif "progress" not in self._timers:
            begun = self._handed_over
            self._once("progress", self._limits.message_seconds, lambda: self._check_progress(begun))

    def _check_progress(self, before: int) -> None:
        seconds, rate = self._limits.message_seconds, self._limits.bytes_per_second
        if self._handed_over - before < rate * seconds:
            reason = f"half a message, and less than {rate / 1e3:g} kB/s for {seconds:g} s: send it whole"
            self._fail(CloseCode.POLICY_VIOLATION, reason)
        else:
            self._watch_progress(blocked=False)

    def _abort_unread(self) -> None:
        self._log_slow(f"took nothing of what it was sent for {self._limits.write_seconds:g} s: the connection is cut")
        self.transport.abort()

    def _fail(self, code: CloseCode, reason: str) -> None:
        """Close without waiting for anything."""
        self._log_slow(f"{reason}: the connection is closed")
        if self.protocol.state is State.OPEN:
            self.protocol.fail(code, reason)
            self.send_data()
        self._backlog = b""
        self._set_reading(True)  # to see the client leave

    def _log_slow(self, text: str) -> None:
        self._shared.metrics.error("slow")
        self._shared.log.warning(f"{peer(self)}: {text}", "slow")
