"""turbopi.client after interruptions: no answer is ever taken for another call's."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest
from websockets.sync.client import ClientConnection

from turbopi.client import RealTimeClient, ServerRefused
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
