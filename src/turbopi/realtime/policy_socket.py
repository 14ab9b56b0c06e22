"""A websocket to a policy server, on which nothing takes longer than its deadline.

The websockets library ends waiting for an answer, but not sending: a server that has stopped reading holds `send` for
ever, and with it every other call on the connection. Nor does it end a name's resolution. So a connection is made on a
thread of its own, and at the deadline of an exchange the socket is shut down, which ends whatever waits on it.
"""

import contextlib
import socket
import threading
import time
from concurrent.futures import Future, InvalidStateError, wait
from typing import Any

from websockets.exceptions import WebSocketException
from websockets.sync.client import ClientConnection, connect

from turbopi.realtime.wire import MAX_BYTES

CLOSE_S = 1.0  # for the goodbye: a server that hangs says none


class PolicySocket:
    """A connection whose first message, the server's metadata, is in `greeting`. Not for several threads at once.

    seconds  until the greeting must be there

    It goes to the server itself, whatever proxies the environment names. Raises ValueError or InvalidURI for an address
    that can't be one, else OSError (TimeoutError is one) and WebSocketException.
    """

    def __init__(self, url: str, api_key: str | None, seconds: float) -> None:
        deadline = time.monotonic() + seconds
        self._open, self._connection = _connected(url, api_key, seconds)
        self.socket = self._connection.socket
        self._cutter = _Cutter(self.socket)
        self.greeting = self._exchange(None, deadline, seconds)

    def ask(self, message: bytes, seconds: float) -> str | bytes:
        """Send a message; the server's answer to it, within `seconds` from now.

        After anything that it raises, Ctrl-C too, the connection is lost: a late answer is never the next message's.
        """
        return self._exchange(message, time.monotonic() + seconds, seconds)

    def close(self) -> None:
        """Say goodbye, for at most CLOSE_S seconds."""
        self._cutter.set(time.monotonic() + CLOSE_S)
        with contextlib.suppress(Exception):  # it may be gone already
            self._open.close()
        self._cutter.cut()

    def _exchange(self, message: bytes | None, deadline: float, seconds: float) -> str | bytes:
        self._cutter.set(deadline)
        try:
            if message is not None:
                self._connection.send(message)
            reply = self._connection.recv(timeout=max(0.0, deadline - time.monotonic()))
        except BaseException as error:
            self._cutter.cut()  # closing would wait for the server
            self.close()
            if isinstance(error, OSError | WebSocketException) and time.monotonic() >= deadline:
                raise TimeoutError(f"nothing came within {seconds:g} s") from error
            raise
        self._cutter.set(None)
        return reply


class _Cutter:
    """Shuts a socket down when the deadline is over, on a thread of its own: then all calls on the socket end."""

    def __init__(self, sock: socket.socket) -> None:
        self._sock = sock
        self._changed = threading.Condition()
        self._deadline: float | None = None
        self._sleeps_until: float | None = None
        self._cut = False
        threading.Thread(target=self._watch, name="turbopi-deadline", daemon=True).start()

    def set(self, deadline: float | None) -> None:
        """The moment, of time.monotonic(), or None. Costs a microsecond: a later one wakes nobody."""
        with self._changed:
            self._deadline = deadline
            if deadline is not None and (self._sleeps_until is None or deadline < self._sleeps_until):
                self._changed.notify()

    def cut(self) -> None:
        """Now, and for good."""
        with self._changed:
            self._cut = True
            self._changed.notify()
            with contextlib.suppress(OSError):  # it is closed already
                socket.socket.shutdown(self._sock, socket.SHUT_RDWR)  # SSLSocket's own would forget that it has TLS

    def _watch(self) -> None:
        with self._changed:
            while not self._cut:
                left = None if self._deadline is None else self._deadline - time.monotonic()
                if left is not None and left <= 0:
                    break
                self._sleeps_until = self._deadline
                self._changed.wait(left)
        self.cut()


def _connected(url: str, api_key: str | None, seconds: float) -> tuple[contextlib.ExitStack, ClientConnection]:
    """The connection, and what closes it. One that is there too late is closed."""
    opened: Future[tuple[contextlib.ExitStack, ClientConnection]] = Future()
    options: dict[str, Any] = {
        "additional_headers": {"Authorization": f"Api-Key {api_key}"} if api_key else None,
        "compression": None,
        "max_size": MAX_BYTES,
        "open_timeout": seconds,
        "close_timeout": CLOSE_S,
        "ping_interval": None,  # openpi's server answers no ping while it computes
        "proxy": None,
    }

    def open_it() -> None:
        stack = contextlib.ExitStack()
        try:
            opened.set_result((stack, stack.enter_context(connect(url, **options))))
        except InvalidStateError:  # nobody waits for it any more
            stack.close()
        except BaseException as error:
            with contextlib.suppress(InvalidStateError):
                opened.set_exception(error)

    threading.Thread(target=open_it, name="turbopi-connecting", daemon=True).start()
    try:
        wait((opened,), seconds)
    except BaseException:  # Ctrl-C
        if not opened.cancel() and opened.exception() is None:
            opened.result()[0].close()
        raise
    if opened.cancel():
        raise TimeoutError(f"nothing came within {seconds:g} s")
    return opened.result()
