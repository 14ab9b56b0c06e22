"""Policies behind the websocket, policies that don't fit, and servers that go away."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from evaluate_fakes import SeekingPolicy, run

from turbopi import serve
from turbopi.errors import ConfigError, ObservationError
from turbopi.evaluate.results import load_results
from turbopi.evaluate.sources import LocalPolicy, PolicyLost, PolicyRefused, RemotePolicy, check_fit
from turbopi.sim import SimSettings, create

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

        source.infer = dying  # type: ignore[method-assign]
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
            with pytest.raises(ConfigError, match="wants its API key: --api-key KEY, or TURBOPI_API_KEY"):
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
