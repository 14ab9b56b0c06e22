"""The clients: Turbo-Pi's own, openpi's, and one that does next to nothing. Only what is asked for is imported."""

import contextlib
import os
import socket
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

from load_test.schedule import Refused

Kind = Literal["turbopi", "openpi", "bare"]
# How a server's text frames begin, docs/serving_protocol.md. Another text is a traceback.
TEXTS = (
    "bad request",
    "bad observation",
    "bad actions",
    "busy",
    "the device is lost",
    "the server is shutting down",
)
LOST, SILENT, TRACEBACK = "connection lost", "no answer in time", "traceback"


def kind_of(text: str) -> str:
    """What a server's text frame is counted as."""
    return next((known for known in TEXTS if text.startswith(known)), TRACEBACK)


class TurbopiConnection:
    """`turbopi.realtime.client.RealTimeClient`, which a robot would use."""

    def __init__(self, url: str, api_key: str | None, answer_s: float) -> None:
        from turbopi.realtime.client import RealTimeClient

        self._client = RealTimeClient(url, api_key=api_key, answer_s=answer_s)

    def infer(self, observation: Mapping[str, Any]) -> Mapping[str, Any]:
        from turbopi.realtime.client import ServerLost, ServerRefused
        from turbopi.support.errors import ActionError, ConfigError, DeviceLost, ObservationError

        try:
            return self._client.infer(observation)
        except ObservationError as error:
            raise Refused("bad observation") from error
        except ActionError as error:
            raise Refused("bad actions") from error
        except DeviceLost as error:
            raise Refused("the device is lost") from error
        except ServerRefused as error:
            raise Refused(kind_of(str(error).partition(" but: ")[2])) from error
        except ServerLost as error:
            raise Refused(SILENT if "no answer within" in str(error) else LOST) from error
        except ConfigError as error:  # it connected anew, and the server wants another key
            raise Refused(LOST) from error

    def close(self) -> None:
        self._client.close()


class OpenpiConnection:
    """openpi-client's `WebsocketClientPolicy`. It waits without end for a server that isn't there, and for answers."""

    def __init__(self, url: str, api_key: str | None) -> None:
        self._url, self._api_key = url, api_key
        self._connect()

    def _connect(self) -> None:
        from openpi_client.websocket_client_policy import WebsocketClientPolicy

        host, _, port = self._url.removeprefix("ws://").rstrip("/").rpartition(":")
        given = (self._url, None) if self._url.startswith("wss://") else (host, int(port))
        self._policy: Any = WebsocketClientPolicy(*given, api_key=self._api_key)

    def infer(self, observation: Mapping[str, Any]) -> Mapping[str, Any]:
        try:
            answer: Mapping[str, Any] = self._policy.infer(observation)
        except RuntimeError as error:
            kind = kind_of(str(error).partition("\n")[2])
            if kind == TRACEBACK:  # after which the server closes
                self._connect()
            raise Refused(kind) from error
        except Exception as error:  # whatever its websockets library raises
            self._connect()
            raise Refused(LOST) from error
        return answer

    def close(self) -> None:
        with contextlib.suppress(Exception):
            self._policy._ws.close()


class BareConnection:
    """A socket that sends what was packed and masked before, so that clients don't take the cores from the server.

    What it leaves out a robot does on its own computer: packing, masking, unpacking the actions.
    """

    def __init__(self, url: str, api_key: str | None, answer_s: float) -> None:
        host, _, port = url.removeprefix("ws://").rstrip("/").rpartition(":")
        self._socket = socket.create_connection((host.strip("[]"), int(port)), timeout=answer_s)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._received, self._frames = bytearray(), dict[int, bytes]()
        key = "" if api_key is None else f"Authorization: Api-Key {api_key}\r\n"
        upgrade = "Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
        nonce = "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n"
        self._socket.sendall(f"GET / HTTP/1.1\r\nHost: {host}:{port}\r\n{upgrade}{nonce}{key}\r\n".encode())
        while b"\r\n\r\n" not in self._received:
            self._more()
        head, _, self._received = self._received.partition(b"\r\n\r\n")
        if not head.startswith(b"HTTP/1.1 101 "):
            raise ConnectionError(head.decode("latin-1"))
        self._frame()  # the metadata

    def infer(self, observation: Mapping[str, Any]) -> Mapping[str, Any]:
        from turbopi.realtime.wire import unpack

        if id(observation) not in self._frames:
            self._frames[id(observation)] = _masked_frame(observation)
        try:
            self._socket.sendall(self._frames[id(observation)])
            opcode, payload = self._frame()
        except OSError as error:
            raise Refused(SILENT if isinstance(error, TimeoutError) else LOST) from error
        if opcode == 1:
            raise Refused(kind_of(payload.decode()))
        return dict(unpack(payload))

    def close(self) -> None:
        self._socket.close()

    def _frame(self) -> tuple[int, bytes]:
        """The next frame of a message: what is to be answered, pings, only comes after 20 idle seconds."""
        while True:
            while len(self._received) < 10:
                if len(self._received) >= 2 and self._received[1] < 126:
                    break
                self._more()
            opcode, short = self._received[0] & 0x0F, self._received[1]
            extended = {126: 2, 127: 8}.get(short, 0)
            start = 2 + extended
            end = start + (int.from_bytes(self._received[2:start], "big") if extended else short)
            while len(self._received) < end:
                self._more()
            payload = bytes(self._received[start:end])
            del self._received[:end]
            if opcode == 8:
                raise ConnectionError("the server closed")
            if opcode in (1, 2):
                return opcode, payload

    def _more(self) -> None:
        data = self._socket.recv(65536)
        if not data:
            raise ConnectionError("the server closed")
        self._received += data


def _masked_frame(observation: Mapping[str, Any]) -> bytes:
    """A binary message with an observation, as a client sends it (RFC 6455, 5.2)."""
    from websockets.frames import apply_mask

    from turbopi.realtime.wire import pack

    payload, mask = pack(dict(observation)), os.urandom(4)
    return b"\x82\xff" + len(payload).to_bytes(8, "big") + mask + apply_mask(payload, mask)


Connection = TurbopiConnection | OpenpiConnection | BareConnection


def connect(kind: Kind, url: str, api_key: str | None, answer_s: float) -> Connection:
    """A new connection. Raises what the client raises: ServerLost or ConfigError, openpi-client's, or OSError."""
    if kind == "openpi":
        return OpenpiConnection(url, api_key)
    return (TurbopiConnection if kind == "turbopi" else BareConnection)(url, api_key, answer_s)


def read_observation(kind: Kind, file: Path) -> dict[str, Any]:
    """An observation as `wire.pack` wrote it, by what the client has to read it: openpi's needs no Turbo-Pi."""
    if kind != "openpi":
        from turbopi.realtime.wire import unpack

        return dict(unpack(file.read_bytes()))
    import importlib

    return dict(importlib.import_module("openpi_client.msgpack_numpy").unpackb(file.read_bytes()))
