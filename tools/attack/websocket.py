"""A websocket client of raw frames, over loopback only: it sends what no library would, and reads with little work."""

import asyncio
import ipaddress
import os
import socket
import struct
from dataclasses import dataclass, field

from attack.judging import Reply

TEXT, BINARY, CLOSE, PING, PONG = 1, 2, 8, 9, 10
NO_MASK = b"\0\0\0\0"  # a legal masking key, under which bytes stay what they are
NO_STATUS, ABNORMAL = 1005, 1006


class HandshakeRefused(Exception):
    """The server answered with something else than 101; `status` is its HTTP status, 0 if it closed."""

    def __init__(self, status: int, head: bytes) -> None:
        super().__init__(f"HTTP {status}")
        self.status, self.head = status, head


def check_loopback(host: str) -> str:
    """`host`, if it is an address of the loopback device. Raises ValueError for all others."""
    try:
        address = ipaddress.ip_address(host)
    except ValueError:
        address = None
    if address is None or not address.is_loopback:
        raise ValueError(f"{host!r} is attacked by nobody: give a loopback address, such as 127.0.0.1")
    return host


def frame(payload: bytes, opcode: int = BINARY, *, fin: bool = True, rsv: int = 0, masked: bool = True) -> bytes:
    """One frame. `rsv` are the three reserved bits."""
    return header(len(payload), opcode, fin=fin, rsv=rsv, masked=masked) + payload


def header(length: int, opcode: int = BINARY, *, fin: bool = True, rsv: int = 0, masked: bool = True) -> bytes:
    """A frame's head, with NO_MASK behind it if it is masked."""
    first, mask = (0x80 if fin else 0) | rsv << 4 | opcode, 0x80 if masked else 0
    if length < 126:
        head = bytes([first, mask | length])
    elif length < 2**16:
        head = bytes([first, mask | 126]) + struct.pack(">H", length)
    else:
        head = bytes([first, mask | 127]) + struct.pack(">Q", length)
    return head + (NO_MASK if masked else b"")


def request(port: int, *headers: str, host: str = "127.0.0.1", path: str = "/") -> bytes:
    """The opening handshake's request."""
    lines = [
        f"GET {path} HTTP/1.1",
        f"Host: {host}:{port}",
        "Upgrade: websocket",
        "Connection: Upgrade",
        "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==",
        "Sec-WebSocket-Version: 13",
        *headers,
        "",
        "",
    ]
    return "\r\n".join(lines).encode()


def post(port: int, kind: str, body: bytes, *headers: str, path: str = "/v1/actions") -> bytes:
    """A request over HTTP alone."""
    lines = [f"POST {path} HTTP/1.1", f"Host: 127.0.0.1:{port}", f"Content-Type: {kind}", *headers]
    return "\r\n".join([*lines, f"Content-Length: {len(body)}", "", ""]).encode("latin-1") + body


@dataclass
class Raw:
    """One websocket connection. Use `await Raw.open(port)`; `greeting` is the metadata's message."""

    reader: asyncio.StreamReader
    writer: asyncio.StreamWriter
    greeting: bytes = b""
    pongs: list[bytes] = field(default_factory=list)

    @classmethod
    async def open(cls, port: int, *headers: str, host: str = "127.0.0.1", limit: int = 2**20) -> "Raw":
        """Raises OSError, TimeoutError and HandshakeRefused."""
        reader, writer = await asyncio.open_connection(check_loopback(host), port, limit=limit)
        raw = cls(reader, writer)
        try:
            writer.write(request(port, *headers, host=host))
            head = await asyncio.wait_for(reader.readuntil(b"\r\n\r\n"), 30)
            status = int(head.split(b" ", 2)[1])
            if status != 101:
                raise HandshakeRefused(status, head)
            reply = await raw.reply(30)
            if reply.kind != "binary":
                raise HandshakeRefused(status, reply.data)
            raw.greeting = reply.data
        except asyncio.IncompleteReadError as error:
            raw.abort()
            raise HandshakeRefused(0, error.partial) from error
        except BaseException:
            raw.abort()
            raise
        return raw

    def send(self, payload: bytes, opcode: int = BINARY) -> None:
        self.writer.write(frame(payload, opcode))

    async def reply(self, timeout: float) -> Reply:
        """The next message or close. Pings are answered, pongs kept. Never raises."""
        try:
            return await asyncio.wait_for(self._reply(), timeout)
        except asyncio.TimeoutError:
            return Reply("silence")
        except (OSError, asyncio.IncompleteReadError):
            return Reply("closed", code=ABNORMAL)

    async def _reply(self) -> Reply:
        while True:
            opcode, payload = await self._frame()
            if opcode == PING:
                self.writer.write(frame(payload, PONG))
            elif opcode == PONG:
                self.pongs.append(payload)
            elif opcode == CLOSE:
                return Reply("closed", payload[2:], struct.unpack(">H", payload[:2])[0] if payload else NO_STATUS)
            else:  # this server fragments nothing
                return Reply("text" if opcode == TEXT else "binary", payload)

    async def _frame(self) -> tuple[int, bytes]:
        first, second = await self.reader.readexactly(2)
        length = second & 0x7F
        if length == 126:
            (length,) = struct.unpack(">H", await self.reader.readexactly(2))
        elif length == 127:
            (length,) = struct.unpack(">Q", await self.reader.readexactly(8))
        return first & 0x0F, await self.reader.readexactly(length)

    def abort(self) -> None:
        """Cut the connection: the server sees a reset, not a close."""
        self.writer.transport.abort()

    async def close(self) -> None:
        """The close handshake, for at most five seconds."""
        self.writer.write(frame(struct.pack(">H", 1000), CLOSE))
        for _ in range(1000):
            if (await self.reply(5)).kind in ("closed", "silence"):
                break
        self.abort()


class Blocking:
    """The same with a blocking socket, for the good client: nothing else runs between its clock and the wire."""

    def __init__(self, port: int, *headers: str, host: str = "127.0.0.1", timeout: float = 60.0) -> None:
        self._socket = socket.create_connection((check_loopback(host), port), timeout)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._socket.sendall(request(port, *headers, host=host))
        self._file = self._socket.makefile("rb")
        lines = []
        while (line := self._file.readline()) not in (b"\r\n", b""):
            lines.append(line)
        status = int(lines[0].split(b" ", 2)[1]) if lines else 0
        if status != 101:
            self.close()
            raise HandshakeRefused(status, b"".join(lines))
        self.greeting = self.receive().data

    def send(self, payload: bytes) -> None:
        """Mask and send one message, as a client should."""
        key = os.urandom(4)
        head = header(len(payload))[: -len(NO_MASK)]
        repeated = int.from_bytes((key * (len(payload) // 4 + 1))[: len(payload)], "little")
        masked = (int.from_bytes(payload, "little") ^ repeated).to_bytes(len(payload), "little")
        self._socket.sendall(head + key + masked)

    def receive(self) -> Reply:
        """The next message or close. Raises OSError, TimeoutError among them."""
        while True:
            first, second = self._exactly(2)
            length = second & 0x7F
            if length >= 126:
                length = int.from_bytes(self._exactly(2 if length == 126 else 8), "big")
            opcode, payload = first & 0x0F, self._exactly(length)
            if opcode == PING:
                self._socket.sendall(frame(payload, PONG))
            elif opcode == CLOSE:
                return Reply("closed", payload[2:], int.from_bytes(payload[:2], "big") if payload else NO_STATUS)
            elif opcode in (TEXT, BINARY):
                return Reply("text" if opcode == TEXT else "binary", payload)

    def _exactly(self, count: int) -> bytes:
        data = self._file.read(count)
        if len(data) != count:
            raise ConnectionResetError("the server closed without a close frame")
        return data

    def close(self) -> None:
        self._socket.close()
