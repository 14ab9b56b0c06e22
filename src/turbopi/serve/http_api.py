"""`POST /v1/actions`: a request over HTTP/1.1, carried by a websocket connection inside the process.

    client ── POST ──▶ Post (h11) ── handshake, one frame ──▶ PortConnection ──▶ what every websocket message meets
           ◀─ response ──          ◀── metadata, one frame ──

The gate, the limits, the queue, the recording, the page and the metrics see a websocket client that sends one message
and leaves; nothing of theirs is repeated here. A body is handed on as it comes, so the limits of a message hold for it.
JSON becomes msgpack once it is whole (json_messages.py). When a response is sent, the socket goes to a new
PortConnection, which waits for the next request: a socket that is kept alive is a new client that may already know a
name, and has what is left of its credit.
"""

import asyncio
import contextlib
import re
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from http import HTTPStatus
from typing import Any, Literal

import h11
import msgspec
from websockets.client import ClientProtocol
from websockets.exceptions import InvalidMessage
from websockets.frames import CloseCode, Frame, Opcode
from websockets.http11 import Request, Response
from websockets.protocol import State
from websockets.server import ServerProtocol
from websockets.uri import parse_uri

from turbopi.realtime.frames import binary_head
from turbopi.realtime.wire import Unpacker, WireError, unpack
from turbopi.serve.connection import DISCARD_PAUSE_SECONDS, GuardedConnection, Owner, Shared, Take
from turbopi.serve.json_messages import from_json, to_json
from turbopi.serve.limited_log import peer
from turbopi.serve.limits import Credit
from turbopi.support.errors import ObservationError

ACTIONS = "/v1/actions"
JSON = "application/json"
MSGPACK = ("application/msgpack", "application/x-msgpack", "application/vnd.msgpack")
# What a text frame begins with, the kind of error that it is, and its status. What begins with none of them is a
# traceback, which stays here.
REFUSED = (
    ("bad request", "malformed", HTTPStatus.BAD_REQUEST),
    ("bad observation", "observation", HTTPStatus.BAD_REQUEST),
    ("bad actions", "actions", HTTPStatus.INTERNAL_SERVER_ERROR),
    ("busy", "busy", HTTPStatus.TOO_MANY_REQUESTS),
    ("late", "late", HTTPStatus.SERVICE_UNAVAILABLE),
    ("replaced", "replaced", HTTPStatus.SERVICE_UNAVAILABLE),
    ("the device is lost", "lost", HTTPStatus.SERVICE_UNAVAILABLE),
    ("the replica is lost", "replica", HTTPStatus.SERVICE_UNAVAILABLE),
    ("the server is shutting down", "stopping", HTTPStatus.SERVICE_UNAVAILABLE),
)
FAILED = ("policy", HTTPStatus.INTERNAL_SERVER_ERROR, "the policy failed: the server's log has the traceback")
CLOSED = {  # by the code of a close without a text before it
    CloseCode.MESSAGE_TOO_BIG: ("too_large", HTTPStatus.REQUEST_ENTITY_TOO_LARGE),
    CloseCode.POLICY_VIOLATION: ("slow", HTTPStatus.REQUEST_TIMEOUT),
    CloseCode.TRY_AGAIN_LATER: ("slow", HTTPStatus.SERVICE_UNAVAILABLE),
    CloseCode.GOING_AWAY: ("stopping", HTTPStatus.SERVICE_UNAVAILABLE),
}
AT_THE_DOOR = {401: "unauthorized", 403: "origin", 503: "full"}  # kinds by the gate's status
KINDS = sorted(
    {kind for _, kind, _ in REFUSED} | {kind for kind, _ in CLOSED.values()} | {*AT_THE_DOOR.values(), "policy"}
)

_POST = b"POST "
_NO_REQUEST = (
    f"no request that this server reads: it answers GET of HTTP/1.1 without a body, websockets, and POST {ACTIONS}\n"
).encode()
_SHUT = "the client's side of the connection was closed before the answer: keep it open until that has come"
_CONTROL = re.compile(rb"[\x00-\x08\x0a-\x1f\x7f]")
_OWN_HEADERS = (b"connection", b"upgrade", b"expect", b"te", b"trailer", b"keep-alive", b"proxy-connection")
_reader = ThreadPoolExecutor(1, thread_name_prefix="turbopi-json")  # one body at a time, beside the event loops


class PortConnection(GuardedConnection):
    """A client of the port: its first bytes decide whether it is a POST or the websockets library's.

    again  makes the next one on the same socket, with this one's credit
    """

    def __init__(
        self,
        protocol: ServerProtocol,
        owner: Owner,
        shared: Shared,
        again: "Callable[[Credit], PortConnection]",
        credit: Credit | None = None,
    ) -> None:
        super().__init__(protocol, owner, shared, credit)
        self._again = again
        self._post: Post | None = None
        self._first: bytes | None = b""
        self._refused = False  # with a 400, once

    def next_one(self) -> "PortConnection":
        """The socket's next one, which this client goes on with."""
        after = self._again(self._credit)
        after.id, after.bad_in_a_row = self.id, self.bad_in_a_row
        return after

    def _http(self, data: bytes) -> bytes:
        if self._first is not None:
            data = self._first + data
            if not _POST.startswith(data[: len(_POST)]):
                self._first = None
            elif len(data) < len(_POST):
                self._first = data
                return b""
            else:
                self._first = None
                self._post = Post(self, self._shared)
                self._post.data_received(data)
                return b""
        return super()._http(data)

    def send_data(self) -> None:
        fault = self.protocol.handshake_exc
        if isinstance(fault, InvalidMessage) and self._post is None and not self._refused:
            self._refused = True  # the library ends the connection without a word
            if not isinstance(fault.__cause__, EOFError):  # who has left reads nothing
                self._shared.metrics.error("malformed")
                head = b"HTTP/1.1 400 Bad Request\r\nContent-Type: text/plain\r\nContent-Length: %d\r\n"
                self.transport.write(head % len(_NO_REQUEST) + b"Connection: close\r\n\r\n" + _NO_REQUEST)
        super().send_data()

    async def recv(self, decode: bool | None = None) -> Any:
        message = await super().recv(decode)
        return message if self._post is None else await self._post.read(message)

    # What a websocket's client gets the shorter way goes the whole way here: body and response are another format's.

    def offer_memory(self, request: Request, response: Response) -> None:
        if self._post is None:
            super().offer_memory(request, response)

    async def recv_taken(self, take: Take) -> str | bytes | memoryview:
        received: str | bytes | memoryview = await (super().recv_taken(take) if self._post is None else self.recv())
        return received

    def send_at_once(self, message: bytes) -> bool:
        return self._post is None and super().send_at_once(message)

    def answered(self, how: Literal["good", "bad", "neither"]) -> None:
        super().answered(how)
        if self._post is not None:
            self._post.end()


class _Link(asyncio.Transport):
    """What a PortConnection takes for its socket while a Post has that."""

    def __init__(self, post: "Post", socket: asyncio.Transport) -> None:
        super().__init__()
        self._post, self._socket = post, socket

    def write(self, data: Any) -> None:
        self._post.sent(bytes(data))

    def can_write_eof(self) -> bool:
        return True

    def write_eof(self) -> None:
        pass  # a close frame or a refusal came before it

    def pause_reading(self) -> None:
        self._post.read_on(False)

    def resume_reading(self) -> None:
        self._post.read_on(True)

    def abort(self) -> None:
        self._post.abort()

    close = abort

    def is_closing(self) -> bool:
        return self._socket.is_closing()

    def get_extra_info(self, name: str, default: Any = None) -> Any:
        return self._socket.get_extra_info(name, default)


class Post(asyncio.Protocol):
    """One POST. It has the socket from the request's first bytes until the response is sent."""

    def __init__(self, connection: PortConnection, shared: Shared) -> None:
        self._connection, self._shared = connection, shared
        self._socket = connection.transport
        self._loop = asyncio.get_running_loop()
        self._http = h11.Connection(h11.SERVER)
        # The other end of the connection's websocket.
        self._client = ClientProtocol(parse_uri(f"ws://localhost{ACTIONS}"), max_size=None, logger=connection.logger)
        self._type, self._length = JSON, 0
        self._requested = self._greeted = self._responded = self._ended = self._passed_on = False
        self._holds, self._wanted = False, True  # reading: by this class, by the connection
        self._timer: asyncio.TimerHandle | None = None
        connection.transport = _Link(self, self._socket)
        self._socket.set_protocol(self)

    @property
    def _serving(self) -> bool:
        return self._connection.server.is_serving()

    # --- from the socket ----------------------------------------------------------------------------------------------

    def data_received(self, data: bytes) -> None:
        if self._ended:  # thrown away, no faster than a client needs to see that it is refused
            self._socket.pause_reading()
            self._loop.call_later(DISCARD_PAUSE_SECONDS, self._socket.resume_reading)
            return
        self._http.receive_data(data)
        self._advance()

    def eof_received(self) -> None:
        """The client sends no more: it has left, as far as anybody can tell, so its request ends, with a word to one
        that only shut its sending side.
        """
        if not self._ended:
            self._error(HTTPStatus.BAD_REQUEST, "malformed", f"bad request: {_SHUT}")

    def pause_writing(self) -> None:
        self._connection.pause_writing()

    def resume_writing(self) -> None:
        self._connection.resume_writing()

    def connection_lost(self, exc: Exception | None) -> None:
        self._ended = self._passed_on = True
        if self._timer is not None:
            self._timer.cancel()
        self._connection.connection_lost(exc)

    def _advance(self) -> None:
        """Hand on what has come of the request."""
        while not self._ended:
            if self._requested and self._client.state is State.CONNECTING:  # the gate hasn't decided yet
                return self._hold(True)
            try:
                event = self._http.next_event()
            except h11.RemoteProtocolError as error:
                return self._refuse(HTTPStatus(error.error_status_hint), f"no HTTP request: {error}")
            if event is h11.NEED_DATA:
                return self._hold(False)
            if event is h11.PAUSED:  # the next request has begun: it waits, and what follows it isn't read
                return self._hold(True)
            if isinstance(event, h11.Request):
                self._begin(event)
            elif isinstance(event, h11.Data):
                self._connection.data_received(bytes(event.data))
        return None

    def _begin(self, request: h11.Request) -> None:
        """The request's head has come: knock, if it may be a request for actions."""
        found = dict(request.headers)
        kind = found.get(b"content-type", b"").partition(b";")[0].strip().lower().decode("latin-1")
        if request.http_version != b"1.1":
            return self._refuse(HTTPStatus.HTTP_VERSION_NOT_SUPPORTED, "this server speaks HTTP/1.1 alone")
        if request.target.partition(b"?")[0] != ACTIONS.encode():
            return self._refuse(HTTPStatus.NOT_FOUND, f"POST goes to {ACTIONS} alone")
        if b"content-length" not in found or b"transfer-encoding" in found:
            return self._refuse(HTTPStatus.LENGTH_REQUIRED, "the body needs a Content-Length; chunks aren't read")
        if kind not in (JSON, *MSGPACK) or b"content-encoding" in found:
            text = f"the Content-Type is {kind[:80]!r}; it should be {JSON} or {MSGPACK[0]}, without a Content-Encoding"
            return self._refuse(HTTPStatus.UNSUPPORTED_MEDIA_TYPE, text)
        self._type, self._requested = kind, True
        # A frame beyond the limit is refused by its header, whatever it says.
        self._length = min(int(found[b"content-length"]), self._shared.limits.message_bytes + 1)
        host = self._socket.get_extra_info("peername")
        self._connection.posted = f"HTTP {host[0] if isinstance(host, tuple) else host}"
        knock = self._client.connect()
        del knock.headers["Host"]
        for name, value in request.headers:
            if name in _OWN_HEADERS or name.startswith((b"content-", b"sec-websocket-")):
                continue
            scheme, _, key = value.partition(b" ")
            if name == b"authorization" and scheme.lower() == b"bearer":
                value = b"Api-Key " + key
            if _CONTROL.search(value):  # which h11 lets pass
                return self._refuse(HTTPStatus.BAD_REQUEST, f"a control character in the header {name[:80]!r}")
            knock.headers[name.decode("latin-1")] = value.decode("latin-1")
        self._client.send_request(knock)
        return self._connection.data_received(b"".join(self._client.data_to_send()))

    # --- from the connection ------------------------------------------------------------------------------------------

    def sent(self, data: bytes) -> None:
        """The connection sends `data` to the client."""
        self._client.receive_data(data)
        for event in self._client.events_received():
            if isinstance(event, Response) and self._client.state is State.OPEN:
                if self._http.they_are_waiting_for_100_continue:
                    self._write(h11.InformationalResponse(status_code=100, headers=[]))
                self._connection.data_received(binary_head(self._length, masked=True))
                self._loop.call_soon(self._advance)
            elif isinstance(event, Response):
                status = HTTPStatus(event.status_code)
                text = bytes(event.body).decode(errors="replace").strip()
                kind = "lost" if text.startswith("the device is lost") else AT_THE_DOOR.get(status, "malformed")
                self._error(status, kind if self._serving else "stopping", text)
                self.end()
            elif isinstance(event, Frame):
                self._frame(event)

    def _frame(self, frame: Frame) -> None:
        if frame.opcode is Opcode.CLOSE:
            close = self._client.close_rcvd
            kind, status = CLOSED.get(0 if close is None else close.code, FAILED[:2])  # type: ignore[call-overload]
            self._error(status, kind, "" if close is None else close.reason)
            self.end()
        elif frame.opcode is Opcode.TEXT:
            text = bytes(frame.data).decode(errors="replace")
            known = (one for one in REFUSED if text.startswith(one[0]))
            _, kind, status = next(known, ("", *FAILED[:2]))
            self._error(status, kind, FAILED[2] if kind == FAILED[0] else text)
        elif frame.opcode is Opcode.BINARY and self._greeted:
            self._answer(bytes(frame.data))
        elif frame.opcode is Opcode.BINARY:  # the metadata, which has its own address
            self._greeted = True

    async def read(self, message: str | bytes) -> str | bytes:
        """The connection's message as msgpack. What is wrong with it is raised where msgpack's faults are."""
        if self._type != JSON or isinstance(message, str):
            return message
        started, limits = time.perf_counter(), self._shared.limits
        # A few kB of PNG may be gigabytes: images take no more than the memory that the message has already.
        most = min(limits.message_bytes, max(limits.free_bytes, len(message)))
        try:
            return await self._loop.run_in_executor(_reader, from_json, message, most)
        except ObservationError as error:
            self._connection.unpacker = _Unreadable(error)
            return b""
        finally:
            self._connection.took(time.perf_counter() - started)

    def read_on(self, wanted: bool) -> None:
        """Whether the connection takes more."""
        self._wanted = wanted
        self._hold(self._holds)

    def abort(self) -> None:
        """The connection is through with its client."""
        if self._passed_on:
            return
        if self._ended:  # the client takes too long to read why
            self._socket.abort()
            return
        if not self._requested:
            self._error(HTTPStatus.REQUEST_TIMEOUT, "slow", "the request's head took too long")
        elif self._client.state is State.CONNECTING:
            status = HTTPStatus.REQUEST_HEADER_FIELDS_TOO_LARGE  # websockets before 17 doesn't say so
            self._error(status, "malformed", "bad request: the headers are too many or too long")
        self._error(FAILED[1], FAILED[0], FAILED[2])
        self.end()

    def end(self) -> None:
        """The response is sent: give the socket on, or end it."""
        if self._ended:
            return
        self._ended = True
        flood = self._connection.bad_in_a_row >= self._shared.limits.bad_messages
        if self._http.our_state is h11.DONE and self._serving and not (flood or self._connection.paused):
            self._pass_on()
        elif self._http.their_state is h11.DONE:
            self._timer = self._loop.call_later(self._shared.limits.write_seconds, self._socket.abort)
            self._socket.close()
        else:  # a socket that is closed before all of it is read may lose the response
            self._timer = self._loop.call_later(self._shared.limits.close_seconds, self._socket.abort)
            with contextlib.suppress(OSError, RuntimeError):  # the client has left
                self._socket.write_eof()
            self._socket.resume_reading()

    def _pass_on(self) -> None:
        self._passed_on = True
        before, rest = self._connection, bytes(self._http.trailing_data[0])
        before.connection_lost(None)
        after = before.next_one()
        self._socket.set_protocol(after)
        after.connection_made(self._socket)
        self._socket.resume_reading()
        if rest:
            after.data_received(rest)

    # --- to both ------------------------------------------------------------------------------------------------------

    def _hold(self, holds: bool) -> None:
        self._holds = holds
        if self._ended:
            return
        if holds or not self._wanted:
            self._socket.pause_reading()
        else:
            self._socket.resume_reading()

    def _write(self, *events: h11.InformationalResponse | h11.Response | h11.Data | h11.EndOfMessage) -> None:
        data = b"".join(self._http.send(event) or b"" for event in events)
        if not self._socket.is_closing():
            self._socket.write(data)

    def _answer(self, message: bytes) -> None:
        if self._type != JSON:
            return self._respond(HTTPStatus.OK, self._type, message)
        try:
            body = to_json(unpack(message, max_bytes=len(message)))
        except (WireError, TypeError, ValueError) as error:
            return self._error(FAILED[1], FAILED[0], f"the policy's answer can't be sent as JSON: {error}")
        return self._respond(HTTPStatus.OK, JSON, body)

    def _refuse(self, status: HTTPStatus, text: str) -> None:
        """Refuse what isn't a request for actions at all."""
        text = f"bad request: {text}"
        self._shared.metrics.error("malformed")
        self._shared.log.warning(f"{peer(self._connection)}: {text}", "malformed")
        self._error(status, "malformed", text)
        self.end()

    def _error(self, status: HTTPStatus, kind: str, text: str) -> None:
        self._respond(status, JSON, msgspec.json.encode({"error": {"kind": kind, "text": text}}))

    def _respond(self, status: HTTPStatus, kind: str, body: bytes) -> None:
        if self._responded:
            return
        self._responded = True
        headers = [("Content-Type", kind), ("Content-Length", str(len(body))), ("Cache-Control", "no-store")]
        headers.append(("X-Content-Type-Options", "nosniff"))
        if status == HTTPStatus.UNAUTHORIZED:
            headers.append(("WWW-Authenticate", "Bearer"))
        if self._client.state is not State.OPEN or self._http.their_state is not h11.DONE or not self._serving:
            headers.append(("Connection", "close"))
        response = h11.Response(status_code=status, headers=headers, reason=status.phrase.encode())
        self._write(response, h11.Data(data=body), h11.EndOfMessage())


class _Unreadable(Unpacker):
    """Raises why a body couldn't be read."""

    def __init__(self, error: ObservationError) -> None:
        super().__init__()
        self._error = error

    def unpack(self, data: bytes | memoryview, *, max_bytes: int = 0) -> Any:
        raise self._error
