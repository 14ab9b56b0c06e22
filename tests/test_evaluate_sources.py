"""Policies behind the websocket, policies that don't fit, and servers that go away."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
import websockets.sync.server
from evaluate_fakes import SeekingPolicy, run
from hypothesis import given, settings
from hypothesis import strategies as st
from websockets.exceptions import ConnectionClosed

from turbopi import serve
from turbopi.evaluate.checks import check_fit
from turbopi.evaluate.reading import load_results
from turbopi.evaluate.sources import Answer, LocalPolicy, PolicyLost, PolicyRefused, RemotePolicy
from turbopi.realtime.wire import MAX_BYTES, pack
from turbopi.sim import SimSettings, create
from turbopi.support.errors import ActionError, ConfigError, ObservationError

SETTINGS = SimSettings(camera_px=64)


def fit(policy: Any, replan: int = 5) -> None:
    check_fit(LocalPolicy(policy), create("reacher"), SETTINGS, 64, replan)


def test_a_server_gives_the_same_episodes_as_the_policy_in_this_process(tmp_path: Path) -> None:
    local = run(tmp_path / "local", SeekingPolicy(), states=(0, 1))
    with serve.running(SeekingPolicy()) as server:
        remote = run(tmp_path / "remote", RemotePolicy("127.0.0.1", server.port), states=(0, 1), workers=2)
    assert [(e.status, e.steps) for e in remote.in_order()] == [(e.status, e.steps) for e in local.in_order()]
    assert remote.label == f"127.0.0.1:{server.port} scripted f32"
    assert all(len(e.infer_ms) == len(e.call_ms) for e in remote.in_order())


def test_a_server_that_dies_ends_the_run_which_another_continues(tmp_path: Path) -> None:
    states = (0, 1, 2)
    with serve.running(SeekingPolicy()) as server:
        source = RemotePolicy("127.0.0.1", server.port)
        ask, calls = source.infer, [0]

        def dying(observations: Any, seeds: Any) -> Any:
            calls[0] += 1
            if calls[0] == 6:
                source._socket.socket.close()  # what a vanished machine looks like from here
            return ask(observations, seeds)

        source.infer = dying  # type: ignore[method-assign, assignment]
        with pytest.raises(PolicyLost, match=r"went away: .*start the server again and give the same command"):
            run(tmp_path, source, states=states)
        kept = load_results(tmp_path)
        assert 0 < len(kept.episodes) < 3 and not kept.complete
        assert run(tmp_path, RemotePolicy("127.0.0.1", server.port), states=states).complete


def test_no_server_is_said_with_the_way_to_start_one() -> None:
    with pytest.raises(
        PolicyLost, match=r"no policy server at ws://127\.0\.0\.1:9: .*turbopi serve CHECKPOINT --port 9"
    ):
        RemotePolicy("127.0.0.1", 9)
    with pytest.raises(PolicyLost, match=r"no policy server at wss://127\.0\.0\.1:9: "):
        RemotePolicy("wss://127.0.0.1", 9)
    with pytest.raises(ConfigError, match=r"ws://a:b:9 is no address of a server"):
        RemotePolicy("ws://a:b", 9)


def test_a_server_is_found_by_its_url_and_its_key_is_asked_for() -> None:
    with serve.running(SeekingPolicy(), api_key="secret") as server:
        RemotePolicy(server.url, api_key="secret").close()
        for key in (None, "other"):
            with pytest.raises(ConfigError, match="wants its API key: --api-key-file FILE, or TURBOPI_API_KEY"):
                RemotePolicy("127.0.0.1", server.port, key)


def test_a_server_that_refuses_the_observations_is_quoted() -> None:
    class Picky(SeekingPolicy):
        def infer(self, observation: dict[str, Any]) -> dict[str, Any]:
            raise ObservationError("the key 'observation/joint_position' is missing")

    with (
        serve.running(Picky()) as server,
        pytest.raises(
            ConfigError, match=r"doesn't take the observations of reacher: .*joint_position' is missing; use one"
        ),
    ):
        check_fit(RemotePolicy("127.0.0.1", server.port), create("reacher"), SETTINGS, 64, 5)


def test_a_policy_that_fits_passes() -> None:
    fit(SeekingPolicy())


def test_another_action_width_is_refused() -> None:
    with pytest.raises(ConfigError, match="actions have 14 numbers, but reacher needs 7; use one for the robot libero"):
        fit(SeekingPolicy(width=14))


def test_a_chunk_shorter_than_the_replan_interval_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"chunks have 4 actions.*--replan 4 or less"):
        fit(SeekingPolicy(horizon=4))
    fit(SeekingPolicy(horizon=4), replan=4)


@pytest.mark.parametrize(
    ("result", "why"),
    [
        ({"state": 1}, r"has no actions but the keys \['state'\]"),
        ([1], "has no actions but a list"),
        ({"actions": np.zeros(7)}, r"shape \[7\]; expected \[horizon, width\]"),
        ({"actions": "left"}, "aren't numbers"),
    ],
)
def test_answers_that_hold_no_chunk_are_refused(result: Any, why: str) -> None:
    class Odd(SeekingPolicy):
        def infer_batch(self, observations: Any, seed: Any) -> Any:
            return [result]

    with pytest.raises((PolicyRefused, ConfigError), match=why):
        fit(Odd())


# -- servers of any kind -----------------------------------------------------------------------------------------------


@contextmanager
def foreign(greeting: Any, *replies: Any) -> Iterator[RemotePolicy]:
    """A policy behind a server that sends these messages whatever it is asked; bytes and text as they are."""

    def handle(connection: Any) -> None:
        with suppress(ConnectionClosed):
            for number, message in enumerate((greeting, *replies)):
                if number:
                    connection.recv()
                connection.send(message if isinstance(message, bytes | str) else msgpack.packb(message))
            connection.close()

    with websockets.sync.server.serve(handle, "127.0.0.1", 0, compression=None) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        source = None
        try:
            source = RemotePolicy("127.0.0.1", server.socket.getsockname()[1])
            yield source
        finally:
            if source is not None:
                source.close()
            server.shutdown()
            thread.join()


def ask(source: RemotePolicy) -> Answer:
    return source.infer([{"prompt": "x"}], [0])[0]


@pytest.mark.parametrize(
    ("metadata", "why"),
    [
        ("hello", "sent text where a message should be: hello"),
        (b"\xc1", "doesn't speak openpi's protocol: "),
        ([1, 2], "sent a list where a map should be"),
        (None, "sent None where a map should be"),
        (
            {"config": float("inf")},
            "tells metadata.config = inf; expected text, finite numbers, lists and maps of them",
        ),
        ({"reset_pose": [0.0, float("nan")]}, "tells metadata.reset_pose = nan"),
        ({"a": {"b": b"bytes"}}, r"tells metadata\.a\.b = b'bytes'"),
        ({1: "one"}, "doesn't speak openpi's protocol: the keys of a map must be str"),
        ({b"one": 1}, "tells metadata = {b'one': 1}"),
    ],
)
def test_a_server_that_tells_nonsense_of_itself_is_refused_by_the_key(metadata: Any, why: str) -> None:
    with pytest.raises(PolicyRefused, match=why), foreign(metadata):
        pass


def test_what_a_server_tells_of_itself_fits_into_the_results(tmp_path: Path) -> None:
    pose = pack(
        {"reset_pose": np.array([0.5, 1.0]), "robot": None, "precision": np.float32(2), "config": "\x1b[2J[/red]"}
    )
    with foreign(pose) as source:
        reported: Any = source.about["metadata"]
        assert reported | {"config": 0} == {
            "reset_pose": [0.5, 1.0],
            "robot": None,
            "precision": 2.0,
            "config": 0,
        }
        assert source.label.isprintable() and source.label.endswith(" [2J[/red] 2.0")


CHUNK = {b"__ndarray__": True, b"data": b"\0" * 4, b"dtype": "<f4", b"shape": [1, 1]}


@pytest.mark.parametrize(
    ("reply", "why"),
    [
        ("Traceback\n  File\nValueError: no such camera", "sent no actions but: ValueError: no such camera"),
        ("", "sent no actions but: nothing"),
        (b"", "doesn't speak openpi's protocol"),
        (b"\xc1" * 100, "doesn't speak openpi's protocol"),
        ({}, r"has no actions but the keys \[\]"),
        ([1], "sent a list where a map should be"),
        ({"actions": None}, "actions aren't numbers but object: None"),
        ({"actions": "left"}, "actions aren't numbers but <U4: 'left'"),
        ({"actions": [["1", "2"]]}, "actions aren't numbers but <U1"),
        ({"actions": [[True]]}, "actions aren't numbers but bool"),
        ({"actions": [[1.0], [1.0, 2.0]]}, "actions aren't numbers"),
        ({"actions": [1.0]}, r"shape \[1\]; expected \[horizon, width\]"),
        ({"actions": 3}, r"shape \[\]; expected \[horizon, width\]"),
        ({"actions": [[1.0]], "policy_timing": {"infer_ms": "fast"}}, "policy_timing says infer_ms = 'fast'; expected"),
        ({"actions": [[1.0]], "policy_timing": {"infer_ms": float("nan")}}, "infer_ms = nan"),
        ({"actions": [[1.0]], "server_timing": {"infer_ms": -1}}, "infer_ms = -1"),
        ({"actions": [[1.0]], "server_timing": {"infer_ms": [1]}}, r"infer_ms = \[1\]"),
        ({"actions": {**CHUNK, b"dtype": "<c8"}}, "doesn't speak openpi's protocol"),
        ({"actions": {**CHUNK, b"shape": [9, 9]}}, "doesn't speak openpi's protocol"),
    ],
)
def test_an_answer_without_usable_actions_is_one_line(reply: Any, why: str) -> None:
    with foreign({}, reply) as source, pytest.raises(PolicyRefused, match=why) as reported:
        ask(source)
    assert "\n" not in str(reported.value) and len(str(reported.value)) < 1000


@pytest.mark.parametrize(
    "extra", [{}, {"server_timing": None}, {"policy_timing": 3}, {"server_timing": {"infer_ms": None}}]
)
def test_times_are_optional(extra: Any) -> None:
    with foreign({}, {"actions": [[1, 2.5]]} | extra) as source:
        answer = ask(source)
    assert answer.actions.tolist() == [[1.0, 2.5]] and answer.infer_ms is None


def test_the_connection_to_a_server_that_never_greets_is_closed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("turbopi.evaluate.sources.CONNECT_S", 0.2)
    left = threading.Event()

    def handle(connection: Any) -> None:
        with suppress(ConnectionClosed):
            connection.recv()
        left.set()

    with websockets.sync.server.serve(handle, "127.0.0.1", 0) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            port = server.socket.getsockname()[1]
            with pytest.raises(PolicyLost, match=rf"no policy server at ws://127\.0\.0\.1:{port}: nothing came within"):
                RemotePolicy("127.0.0.1", port)
            assert left.wait(60)
        finally:
            server.shutdown()
            thread.join()


def test_a_server_that_leaves_or_says_too_much_is_lost() -> None:
    with foreign({}) as source, pytest.raises(PolicyLost, match=r"went away: .*give the same command to continue"):
        ask(source)
    with foreign({}, b"x" * (MAX_BYTES + 1)) as source, pytest.raises(PolicyLost, match=r"went away: .*too big"):
        ask(source)


def test_actions_that_the_server_found_not_finite_are_told_as_such() -> None:
    with foreign({}, "bad actions: the model computed nan at [2, 1]") as source:
        answer = ask(source)
    assert answer.problem == "the model computed nan at [2, 1]"

    class Refusing(SeekingPolicy):
        def infer(self, observation: dict[str, Any]) -> dict[str, Any]:
            raise ActionError("the model computed inf at [0, 0]")

    with serve.running(Refusing()) as server:
        remote = RemotePolicy("127.0.0.1", server.port)
        assert ask(remote).problem == "the model computed inf at [0, 0]"
        remote.close()


VALUES = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**63), 2**64 - 1)
    | st.floats()
    | st.text(max_size=5)
    | st.binary(max_size=5),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=3), inner, max_size=3),
    max_leaves=12,
)


@settings(max_examples=300, deadline=None)
@given(st.dictionaries(st.sampled_from(["actions", "policy_timing", "server_timing", "infer_ms"]), VALUES) | VALUES)
def test_any_answer_is_actions_or_refused(result: Any) -> None:
    class Odd(SeekingPolicy):
        def infer_batch(self, observations: Any, seed: Any) -> Any:
            return [result]

    try:
        answer = LocalPolicy(Odd()).infer([{}], [0])[0]
    except PolicyRefused:
        return
    assert answer.actions.dtype == np.float64 and answer.actions.ndim == 2
    assert answer.infer_ms is None or 0 <= answer.infer_ms < float("inf")
