"""turbopi.client after interruptions: no answer is ever taken for another call's."""

import socket
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest
from websockets.sync.client import ClientConnection

from turbopi.client import RealTimeClient, ServerLost, ServerRefused
from turbopi.errors import ConfigError, ObservationError
from turbopi.serve import running
from turbopi.wire import pack


class Echo:
    """Answers with what it was sent."""

    def __init__(self) -> None:
        self.metadata: dict[str, Any] = {}

    def infer(self, obs: dict[str, Any]) -> dict[str, Any]:
        return {"actions": np.full((1, 1), float(obs["place"]))}


@contextmanager
def _instead_of_receiving(monkeypatch: pytest.MonkeyPatch, what: Any) -> Iterator[None]:
    with monkeypatch.context() as patch:
        patch.setattr(ClientConnection, "recv", what)
        yield


def _interrupted(*_: Any, **__: Any) -> Any:
    raise KeyboardInterrupt


def test_after_ctrl_c_the_next_call_gets_its_own_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    with running(Echo()) as server, RealTimeClient("127.0.0.1", server.port) as client:
        with _instead_of_receiving(monkeypatch, _interrupted), pytest.raises(KeyboardInterrupt):
            client.infer({"place": 1})
        assert client.infer({"place": 2})["actions"] == 2
        assert client.infer({"place": 3})["actions"] == 3


def test_ctrl_c_while_it_connects_anew_leaves_no_greeting_behind(monkeypatch: pytest.MonkeyPatch) -> None:
    with running(Echo()) as server, RealTimeClient("127.0.0.1", server.port) as client:
        client.close()
        with _instead_of_receiving(monkeypatch, _interrupted), pytest.raises(KeyboardInterrupt):
            client.infer({"place": 1})
        assert client.infer({"place": 2})["actions"] == 2


@pytest.mark.parametrize("greeting", ["traceback", b"\xc1", pack([1])])
def test_a_server_that_greets_with_nonsense_is_not_kept(greeting: str | bytes, monkeypatch: pytest.MonkeyPatch) -> None:
    with running(Echo()) as server, RealTimeClient("127.0.0.1", server.port) as client:
        client.close()
        with (
            _instead_of_receiving(monkeypatch, lambda *_, **__: greeting),
            pytest.raises(ServerRefused, match="doesn't speak openpi's protocol"),
        ):
            client.infer({"place": 1})
        assert client.infer({"place": 2})["actions"] == 2


@pytest.mark.parametrize(
    ("host", "text"),
    [
        ("http://localhost:8000", "the host is 'http://localhost:8000'; give a name, or a URL that begins with ws://"),
        ("localhost:8000", "the host is 'localhost:8000'; give its name, and the port beside it"),
    ],
)
def test_a_host_that_is_no_name_is_refused_in_words(host: str, text: str) -> None:
    with pytest.raises(ConfigError, match=text):
        RealTimeClient(host)


@pytest.mark.parametrize("host", ["::1", "ws://[::1]"])
def test_without_a_server_the_error_says_where_and_that_it_may_not_be_warm(host: str) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]  # free when it is closed
    with pytest.raises(ServerLost, match=rf"no policy server at ws://127\.0\.0\.1:{port}: .*once it is warm"):
        RealTimeClient("127.0.0.1", port)
    with pytest.raises(ServerLost, match=rf"no policy server at ws://\[::1\]:{port}: "):
        RealTimeClient(host, port)


def test_a_port_beside_a_url_is_the_urls() -> None:
    with running(Echo()) as server:
        for host in ("ws://127.0.0.1", "ws://127.0.0.1/"):
            with RealTimeClient(host, server.port) as client:
                assert client.infer({"place": 2})["actions"] == 2
    with pytest.raises(ConfigError, match=r"'ws://gpu/robot', a URL with a path: give the port in it"):
        RealTimeClient("ws://gpu/robot", 8000)


def test_a_server_that_lets_nobody_in_says_why() -> None:
    with (
        running(Echo(), max_clients=1) as server,
        RealTimeClient("127.0.0.1", server.port),
        pytest.raises(ServerLost, match=r"HTTP 503 .*1 clients, its limit \(--max-clients\); try again later"),
    ):
        RealTimeClient("127.0.0.1", server.port)


@pytest.mark.parametrize("value", [object(), np.array([None]), 2**70])
def test_what_cannot_be_sent_is_named_by_its_key_and_the_connection_stays(value: object) -> None:
    with running(Echo()) as server, RealTimeClient("127.0.0.1", server.port) as client:
        with pytest.raises(ObservationError, match="wrist: can't send "):
            client.infer({"place": 1, "wrist": value})
        with pytest.raises(ObservationError, match="wrist: can't send "):
            client.infer({"place": 1, "wrist": [{"inner": value}]})
        assert client.infer({"place": 2})["actions"] == 2


def test_a_request_that_came_too_late_costs_no_connection() -> None:
    """With the connection its session would end, and so the running chunk that the server keeps."""
    with running(Echo()) as server, RealTimeClient("127.0.0.1", server.port) as client:
        socket = client._socket
        with pytest.raises(ServerRefused, match="sent no actions but: late: "):
            client.infer({"place": 1, "turbopi/deadline_ms": 1e-6})
        assert client.infer({"place": 2})["actions"] == 2
        assert client._socket is socket


def test_a_running_chunk_of_another_kind_is_refused() -> None:
    with running(Echo()) as server, RealTimeClient("127.0.0.1", server.port) as client:
        left_over: Any = np.zeros((3, 32), np.float32)
        with pytest.raises(ObservationError, match=r"previous is a ndarray; .* turbopi\.running_chunk\.RunningChunk"):
            client.infer({"place": 1}, previous=left_over)
