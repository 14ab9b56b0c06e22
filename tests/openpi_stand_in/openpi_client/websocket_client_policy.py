"""openpi's client over Turbo-Pi's own messages. The real one is tested in test_serve_openpi_client.py."""

from typing import Any

from websockets.sync.client import connect

from turbopi.realtime.wire import pack, unpack


class WebsocketClientPolicy:
    def __init__(self, host: str, port: int) -> None:
        self._connection = connect(f"ws://{host}:{port}", max_size=None, compression=None).__enter__()
        self._metadata: Any = unpack(self._connection.recv())  # type: ignore[arg-type]

    def get_server_metadata(self) -> dict[str, Any]:
        return dict(self._metadata)

    def infer(self, observation: dict[str, Any]) -> dict[str, Any]:
        self._connection.send(pack(observation))
        answer: Any = self._connection.recv()
        if isinstance(answer, str):
            raise RuntimeError(answer)
        return dict(unpack(answer))
