"""A websocket to a policy server, on which nothing takes longer than its deadline.

The caller's thread itself sends and waits for the answer: a thread in between would have to wake up, too.
The websockets library gives the protocol without its sockets and threads. What it can't do is to end a call at its
deadline: a server that has stopped reading holds `send` for ever, and a name's resolution has no end. So a connection
is made on a thread of its own, and at the deadline of an exchange the socket is shut down, which ends whatever waits on
it. The thread that does so also answers the server's pings, and its goodbye, while nobody calls.

A thread that sleeps takes 50 to 100 us to wake up. So with a server on the same host the caller is awake a little
before the answer is due by the last ones, and looks for it without a pause: for AWAKE_S at most, and only where there
are processors enough.
"""

import contextlib
import select
import selectors
import socket
import threading
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, InvalidStateError, wait
from functools import partial

from websockets.client import ClientProtocol
from websockets.exceptions import WebSocketException
from websockets.frames import CloseCode, Frame, Opcode
from websockets.http11 import USER_AGENT, Response
from websockets.protocol import State
from websockets.uri import parse_uri

from turbopi.realtime.frames import binary_head, binary_message
from turbopi.realtime.shared_memory import HEADER, WANTED, Parts, SharedWriter, writer
from turbopi.realtime.wire import MAX_BYTES
from turbopi.support.processors import usable_processors

CLOSE_S = 1.0  # for the goodbye: a server that hangs says none
IDLE_S = 0.25  # after a call, from which on somebody else reads the socket
READ_BYTES = 2**16
LAST = 8  # answers, of which the soonest says when the next one is due
EARLY_S = 0.0003  # before that, the caller wakes up; the system itself may be 0.1 ms late
AWAKE_S = 0.0008  # in which it looks for the answer; then it sleeps again
PROCESSORS = 4  # with fewer, this would take the server's own


class PolicySocket:
    """A connection whose first message, the server's metadata, is in `greeting`. Not for several threads at once.

    seconds  until the greeting must be there

    It goes to the server itself, whatever proxies the environment names. Raises ValueError or InvalidURI for an address
    that can't be one, else OSError (TimeoutError is one) and WebSocketException.
    """

    def __init__(self, url: str, api_key: str | None, seconds: float) -> None:
        deadline = time.monotonic() + seconds
        self._stream = _connected(url, api_key, seconds)
        self.socket = self._stream.socket
        self._memory: SharedWriter | None = writer(self._stream.offer)
        spares = self._memory is not None and usable_processors() >= PROCESSORS
        self._awake = _Awake(self.socket) if spares else contextlib.nullcontext()
        self._cutter = _Cutter(self._stream)
        self.greeting = self._exchange(None, deadline, seconds)

    def ask(self, parts: Parts, seconds: float) -> str | bytes:
        """Send a message of these parts; the server's answer to it, within `seconds` from now.

        After anything that it raises, Ctrl-C too, the connection is lost: a late answer is never the next message's.
        """
        deadline = time.monotonic() + seconds
        bell = None if self._memory is None else self._memory.put(parts)
        send = partial(self._stream.send, b"".join(parts)) if bell is None else partial(self._stream.ring, bell)
        return self._exchange(send, deadline, seconds)

    def close(self) -> None:
        """Say goodbye, for at most CLOSE_S seconds."""
        self._cutter.set(time.monotonic() + CLOSE_S)
        with contextlib.suppress(Exception), self._stream.using:  # it may be gone already
            self._stream.say_goodbye()
        self._cutter.cut()
        if self._memory is not None:
            self._memory.close()
            self._memory = None

    def _exchange(self, send: Callable[[], None] | None, deadline: float, seconds: float) -> str | bytes:
        self._cutter.set(deadline)
        try:
            with self._stream.using:
                if send is not None:
                    self._stream.catch_up()
                    send()
                with self._awake:
                    reply = self._stream.receive()
        except BaseException as error:
            self._cutter.cut()  # closing would wait for the server
            self.close()
            if isinstance(error, OSError | WebSocketException) and time.monotonic() >= deadline:
                raise TimeoutError(f"nothing came within {seconds:g} s") from error
            raise
        self._cutter.set(None)
        return reply


class _Stream:
    """Websocket messages over a socket: all that comes is read by who calls, under the lock `using`."""

    def __init__(self, url: str, api_key: str | None, seconds: float) -> None:
        """Connect, and do the handshake."""
        uri = parse_uri(url)
        self.using = threading.Lock()
        self._events: deque[object] = deque()
        self._readable = select.poll()
        self._begun = 0  # bytes of a frame whose end the library waits for
        self._protocol = ClientProtocol(uri, max_size=MAX_BYTES)
        self.socket = socket.create_connection((uri.host, uri.port), timeout=seconds)
        try:
            self.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            if uri.secure:
                import ssl

                self.socket = ssl.create_default_context().wrap_socket(self.socket, server_hostname=uri.host)
            request = self._protocol.connect()
            request.headers["User-Agent"] = USER_AGENT
            request.headers[HEADER] = WANTED
            if api_key:
                request.headers["Authorization"] = f"Api-Key {api_key}"
            self._protocol.send_request(request)
            self._flush()
            response = self._next()
            if self._protocol.handshake_exc is not None:
                raise self._protocol.handshake_exc
            assert isinstance(response, Response)
            self.offer = response.headers.get(HEADER)  # of shared memory
            if not uri.secure:  # where what is readable may be no message
                self._readable.register(self.socket, select.POLLIN)
            self.socket.settimeout(None)
        except BaseException:
            self.socket.close()
            raise

    def send(self, message: bytes) -> None:
        """Raises ConnectionClosed and OSError, as `receive`."""
        self._check_open()
        self._protocol.send_binary(message)
        self._flush()

    def ring(self, bell: bytes) -> None:
        """`send`, to this host, where nothing stands between that a mask would protect: it is zero."""
        self._check_open()
        self.socket.sendall(binary_head(len(bell), masked=True) + bell)

    def _check_open(self) -> None:
        if self._protocol.state is not State.OPEN:
            self._read_to_end()
            raise self._protocol.close_exc

    def receive(self) -> str | bytes:
        """The next message."""
        frames: list[Frame] = []
        while not frames or not frames[-1].fin:
            event = self._next()
            if isinstance(event, Frame) and event.opcode < Opcode.CLOSE:
                frames.append(event)
        data = b"".join([frame.data for frame in frames])
        return data.decode(errors="replace") if frames[0].opcode is Opcode.TEXT else data

    def catch_up(self) -> None:
        """Handle what has come since the last answer. Raises OSError for another answer, as `receive` would take it for
        the next message's.
        """
        while True:
            if any(isinstance(event, Frame) and event.opcode < Opcode.CLOSE for event in self._events):
                raise OSError("it sent an answer that nobody asked for")
            self._events.clear()
            if self.ended or not self._readable.poll(0):
                return
            self._read()

    def read_on(self) -> None:
        """Handle what has come, now that the socket is readable: pings are answered."""
        with contextlib.suppress(OSError, WebSocketException):  # the next call says so
            self._read()

    def say_goodbye(self) -> None:
        """Close, and wait for the server to close."""
        if self._protocol.state is State.OPEN:
            self._protocol.send_close(CloseCode.NORMAL_CLOSURE)
            self._flush()
        self._read_to_end()

    @property
    def ended(self) -> bool:
        return self._protocol.state is State.CLOSED

    def _read_to_end(self) -> None:
        while not self.ended:
            self._read()

    def _next(self) -> object:
        while not self._events:
            if self.ended:
                if self._protocol.handshake_exc is None:
                    raise self._protocol.close_exc
                return None
            self._read()
        return self._events.popleft()

    def _read(self) -> None:
        connecting = self._protocol.state is State.CONNECTING
        data = self.socket.recv(1 if connecting else READ_BYTES)  # so that frames begin with a read
        if not self._begun and self._protocol.state is State.OPEN and (answer := binary_message(data)) is not None:
            self._events.append(Frame(Opcode.BINARY, answer))  # nearly always
            return
        if data:
            self._protocol.receive_data(data)
        else:
            self._protocol.receive_eof()
        events = self._protocol.events_received()
        frames = [len(event.data) for event in events if isinstance(event, Frame)]
        whole = sum(len(binary_head(length)) + length for length in frames)
        self._begun = 0 if connecting else self._begun + len(data) - whole
        self._events.extend(events)
        self._flush()

    def _flush(self) -> None:
        for data in self._protocol.data_to_send():
            if data:
                self.socket.sendall(data)
            else:  # no more will follow
                with contextlib.suppress(OSError):
                    self.socket.shutdown(socket.SHUT_WR)


class _Awake:
    """On entering it waits until something came, but not longer than AWAKE_S after that is due."""

    def __init__(self, sock: socket.socket) -> None:
        self._poll = select.poll()
        self._poll.register(sock, select.POLLIN)
        self._took: deque[float] = deque(maxlen=LAST)  # seconds from the last questions to their answers
        self._began = 0.0

    def __enter__(self) -> None:
        self._began = now = time.monotonic()
        due = now + min(self._took, default=0.0) - EARLY_S
        ready = due > now and self._poll.poll(int(1e3 * (due - now)))
        if not ready and (left := due - time.monotonic()) > 0:  # less than `poll` can wait for
            time.sleep(left)
        while not ready and time.monotonic() < due + AWAKE_S:
            ready = self._poll.poll(0)

    def __exit__(self, *_: object) -> None:
        self._took.append(time.monotonic() - self._began)


class _Cutter:
    """Shuts the socket down when the deadline is over, on a thread of its own: then all calls on the socket end.

    IDLE_S after a call, that thread reads what the server sends without having been called.
    """

    def __init__(self, stream: _Stream) -> None:
        self._stream, self._changing = stream, threading.Lock()
        self._deadline: float | None = None
        self._wakes_at: float | None = None  # None: when it is woken, or the server sends something
        self._used = time.monotonic()
        self._cut = False
        self._wake, self._woken = socket.socketpair()
        self._wake.setblocking(False)
        threading.Thread(target=self._watch, name="turbopi-deadline", daemon=True).start()

    def set(self, deadline: float | None) -> None:
        """The moment, of time.monotonic(), or None. Costs a microsecond: within IDLE_S, a later one wakes nobody."""
        with self._changing:
            self._deadline = deadline
            if deadline is None:
                self._used = time.monotonic()
            elif self._wakes_at is None or deadline < self._wakes_at:
                self._wake_up()

    def cut(self) -> None:
        """Now, and for good."""
        with self._changing:
            self._cut = True
            self._wake_up()
            with contextlib.suppress(OSError):  # it is closed already
                socket.socket.shutdown(self._stream.socket, socket.SHUT_RDWR)  # SSLSocket's own forgets that it has TLS

    def _wake_up(self) -> None:
        with contextlib.suppress(OSError):  # it has been woken often enough, or has ended
            self._wake.send(b"x")

    def _watch(self) -> None:
        sock = self._stream.socket
        with selectors.DefaultSelector() as called, selectors.DefaultSelector() as idle, self._woken, self._wake:
            called.register(self._woken, selectors.EVENT_READ)
            idle.register(self._woken, selectors.EVENT_READ)
            idle.register(sock, selectors.EVENT_READ)
            while not self._cut:
                with self._changing:
                    now = time.monotonic()
                    busy = self._deadline is not None or now < self._used + IDLE_S
                    if self._deadline is not None and self._deadline <= now:
                        break
                    if not busy and self._stream.ended:  # the next call says so
                        break
                    self._wakes_at = min(self._deadline or now + IDLE_S, now + IDLE_S) if busy else None
                ready = (called if busy else idle).select(self._wakes_at and self._wakes_at - now)
                for key, _ in ready:
                    if key.fileobj is self._woken:
                        self._woken.recv(READ_BYTES)
                    elif self._stream.using.acquire(blocking=False):
                        try:
                            self._stream.read_on()
                        finally:
                            self._stream.using.release()
        self.cut()
        sock.close()


def _connected(url: str, api_key: str | None, seconds: float) -> _Stream:
    """The connection. One that is there too late is closed."""
    opened: Future[_Stream] = Future()

    def open_it() -> None:
        try:
            stream = _Stream(url, api_key, seconds)
        except BaseException as error:
            with contextlib.suppress(InvalidStateError):
                opened.set_exception(error)
            return
        try:
            opened.set_result(stream)
        except InvalidStateError:  # nobody waits for it any more
            stream.socket.close()

    threading.Thread(target=open_it, name="turbopi-connecting", daemon=True).start()
    try:
        wait((opened,), seconds)
    except BaseException:  # Ctrl-C
        if not opened.cancel() and opened.exception() is None:
            opened.result().socket.close()
        raise
    if opened.cancel():
        raise TimeoutError(f"nothing came within {seconds:g} s")
    return opened.result()
