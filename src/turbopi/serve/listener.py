"""The server's port: who is let in, how fast, and how many at once."""

import asyncio
import errno
import logging
import os
import socket
from collections.abc import Awaitable, Callable
from http import HTTPStatus

from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response
from websockets.protocol import State
from websockets.server import ServerProtocol

from turbopi.serve.connection import GuardedConnection, Shared
from turbopi.serve.http_api import PortConnection
from turbopi.serve.limited_log import peer
from turbopi.serve.limits import SPARE_CONNECTIONS, AtMost, Credit, room_for_connections, trim_memory
from turbopi.serve.page.http import is_feed, select_subprotocol

logger = logging.getLogger(__name__)
# The websockets library reports each port scan and health check as a failed handshake; what matters is logged here.
_protocol_logger = logging.getLogger(f"{__name__}.protocol")
_protocol_logger.setLevel(logging.CRITICAL)

RETRY_SECONDS = 1.0  # after a connection couldn't be taken
TRIM_SECONDS = 1.0  # after the last client has left
_BACKLOG = 256
_NO_RESOURCES = (errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM)
_FULL_LINE = b"HTTP/1.1 503 Service Unavailable\r\nContent-Length: %d\r\nConnection: close\r\n\r\n%s"

Gatekeeper = Callable[[GuardedConnection, Request], Response | None]
Handler = Callable[[GuardedConnection], Awaitable[None]]


class Listener:
    """Accepts connections and runs `handle` for each that becomes a websocket. `gate` answers plain HTTP requests.

    The loop accepts by itself, not through asyncio's server, which tries again at once, and logs each time, when there
    are no descriptors left, and which can't wait.
    """

    def __init__(self, gate: Gatekeeper, handle: Handler, shared: Shared) -> None:
        self._gate, self._handle, self._shared = gate, handle, shared
        self._clients_limit = shared.limits.clients
        self._sockets: list[socket.socket] = []
        self._accepting: list[asyncio.Task[None]] = []
        self._tasks: set[asyncio.Task[None]] = set()
        self._opening: dict[GuardedConnection, None] = {}  # in the order in which they came
        self._clients: set[GuardedConnection] = set()
        self._watchers: set[GuardedConnection] = set()  # of the page; they are no clients
        self._connected: set[GuardedConnection] = set()
        self._trimming: asyncio.TimerHandle | None = None
        self._pace = AtMost(shared.limits.connections_rate)

    # --- lifecycle ----------------------------------------------------------------------------------------------------

    async def bind(self, host: str, port: int) -> int:
        """Take the port on all addresses of `host`, and return it. Nobody can connect yet.

        Raises OSError, and UnicodeError for a `host` that can't be a name.
        """
        loop = asyncio.get_running_loop()
        found = await loop.getaddrinfo(host or None, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
        for family, kind, protocol, _, address in dict.fromkeys(found):
            try:
                sock = socket.socket(family, kind, protocol)
            except OSError:  # a kernel without IPv6
                continue
            sock.setblocking(False)
            if os.name == "posix":  # elsewhere it lets two servers have one port
                sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            if family == socket.AF_INET6:
                sock.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 1)
            try:
                sock.bind((address[0], port, *address[2:]))
            except OSError as error:
                sock.close()
                if error.errno == errno.EADDRNOTAVAIL and len(found) > 1:  # "localhost" without IPv6
                    continue
                self.close()
                raise
            self._sockets.append(sock)
            port = port or sock.getsockname()[1]
        if not self._sockets:
            raise OSError(errno.EADDRNOTAVAIL, f"{host!r} has no address here")
        return port

    def start(self) -> None:
        """Let clients in. Raises OSError if another process listens on the port by now."""
        room = room_for_connections(self._clients_limit + SPARE_CONNECTIONS) - SPARE_CONNECTIONS
        if room < self._clients_limit:
            self._clients_limit = max(room, 1)
            logger.warning(
                "only %d clients at once, not %d: the process may not open more files (see `ulimit -n`)",
                self._clients_limit,
                self._shared.limits.clients,
            )
        for sock in self._sockets:
            sock.listen(_BACKLOG)
            self._accepting.append(asyncio.create_task(self._accept(sock)))

    def is_serving(self) -> bool:
        return bool(self._sockets)

    def close(self) -> None:
        """Let nobody in any more."""
        for task in self._accepting:
            task.cancel()
        for sock in self._sockets:
            sock.close()
        self._sockets.clear()

    async def ended(self, seconds: float) -> None:
        """Wait for all connections to end; after `seconds` cut those that are left."""
        await asyncio.gather(*self._accepting, return_exceptions=True)
        if self._tasks:
            await asyncio.wait(self._tasks, timeout=seconds)
        for connection in tuple(self._connected):
            connection.transport.abort()
        if self._tasks:
            await asyncio.wait(self._tasks)

    # --- connections --------------------------------------------------------------------------------------------------

    async def _accept(self, listening: socket.socket) -> None:
        loop = asyncio.get_running_loop()
        while True:
            try:
                sock, _ = await loop.sock_accept(listening)
            except OSError as error:
                if error.errno in _NO_RESOURCES:
                    self._shared.log.warning(f"can't take new connections: {error}; trying on", "accept")
                    await asyncio.sleep(RETRY_SECONDS)
                continue
            if self._full(sock):
                sock.close()
            else:
                try:
                    await loop.connect_accepted_socket(self._new_connection, sock)
                except OSError:  # its client has left: on macOS setting TCP_NODELAY fails then
                    sock.close()
            await asyncio.sleep(self._pace.wait())

    def _full(self, sock: socket.socket) -> bool:
        """Whether there is no room for one more: then it gets a 503. The oldest one without a request makes room."""
        if len(self._connected) < self._clients_limit + SPARE_CONNECTIONS:
            return False
        for connection in self._opening:
            connection.transport.abort()
            return False
        reason = self._refusal().encode()
        try:
            sock.setblocking(False)
            sock.send(_FULL_LINE % (len(reason), reason))
        except OSError:
            pass
        return True

    def _refusal(self) -> str:
        self._shared.metrics.error("full")
        text = f"The server has {self._clients_limit} clients, its limit (--max-clients); try again later."
        self._shared.log.warning(text, "full")
        return f"{text}\n"

    def _new_connection(self, credit: Credit | None = None) -> PortConnection:
        # No compression: images don't get smaller, only slower.
        protocol = ServerProtocol(
            max_size=self._shared.limits.message_bytes, select_subprotocol=select_subprotocol, logger=_protocol_logger
        )
        return PortConnection(protocol, self, self._shared, self._new_connection, credit)

    def connected(self, connection: GuardedConnection) -> None:
        """A TCP connection has begun."""
        self._connected.add(connection)
        self._opening[connection] = None
        task = asyncio.create_task(self._serve(connection))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _serve(self, connection: GuardedConnection) -> None:
        """One connection, from its HTTP request to its end."""
        try:
            try:
                await asyncio.wait_for(
                    connection.handshake(self._let_in, _offer_memory), self._shared.limits.handshake_seconds
                )
            except Exception:  # its request was none, it left, or it took too long
                return
            finally:
                self._opening.pop(connection, None)
            if connection.protocol.state is not State.OPEN:
                return
            connection.opened()
            await self._handle(connection)
            await connection.close()
        except Exception:
            logger.exception("%s: the server failed", peer(connection))
        finally:
            connection.transport.abort()
            await connection.wait_closed()
            self._connected.discard(connection)
            self._watchers.discard(connection)
            if connection in self._clients:
                self._clients.remove(connection)
                if not self._clients and self._trimming is None:
                    self._trimming = asyncio.get_running_loop().call_later(TRIM_SECONDS, self._trim)

    def _let_in(self, connection: ServerConnection, request: Request) -> Response | None:
        assert isinstance(connection, GuardedConnection)
        response = self._gate(connection, request)
        if response is not None:
            return response
        if is_feed(request):
            if len(self._watchers) >= self._shared.limits.watchers:
                text = f"The page is open {len(self._watchers)} times already, which is the limit: close one of them.\n"
                return connection.respond(HTTPStatus.SERVICE_UNAVAILABLE, text)
            self._watchers.add(connection)
            return None
        if len(self._clients) >= self._clients_limit:
            return connection.respond(HTTPStatus.SERVICE_UNAVAILABLE, self._refusal())
        self._clients.add(connection)
        return None

    def _trim(self) -> None:
        self._trimming = None
        if not self._clients:
            self._shared.spare.drop()
            trim_memory()


def _offer_memory(connection: ServerConnection, request: Request, response: Response) -> None:
    assert isinstance(connection, GuardedConnection)
    connection.offer_memory(request, response)
