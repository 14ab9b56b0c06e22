"""The two clients: Turbo-Pi's own, and openpi's. Only the one that is asked for is imported."""

import contextlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

from load_test.schedule import Refused

Kind = Literal["turbopi", "openpi"]
# How a server's text frames begin, docs/serving.md. Another text is a traceback.
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
    """`turbopi.client.RealTimeClient`, which a robot would use."""

    def __init__(self, url: str, api_key: str | None, answer_s: float) -> None:
        from turbopi.client import RealTimeClient

        self._client = RealTimeClient(url, api_key=api_key, answer_s=answer_s)

    def infer(self, observation: Mapping[str, Any]) -> Mapping[str, Any]:
        from turbopi.client import ServerLost, ServerRefused
        from turbopi.errors import ActionError, ConfigError, DeviceLost, ObservationError

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


def connect(kind: Kind, url: str, api_key: str | None, answer_s: float) -> TurbopiConnection | OpenpiConnection:
    """A new connection. Raises what the client raises: ServerLost or ConfigError, or openpi-client's."""
    return TurbopiConnection(url, api_key, answer_s) if kind == "turbopi" else OpenpiConnection(url, api_key)


def read_observation(kind: Kind, file: Path) -> dict[str, Any]:
    """An observation as `turbopi.wire.pack` wrote it, by what the client has to read it: openpi's needs no Turbo-Pi."""
    if kind == "turbopi":
        from turbopi.wire import unpack

        return dict(unpack(file.read_bytes()))
    import importlib

    return dict(importlib.import_module("openpi_client.msgpack_numpy").unpackb(file.read_bytes()))
