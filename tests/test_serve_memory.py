"""A policy with memory over the server: the history of each robot, and what became of what wasn't recorded."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from memory_golden import MemoryRuns, make_checkpoint
from serve_fakes import FakePolicy, observation
from websockets.sync.client import connect

from turbopi import UnifiedPolicy
from turbopi.realtime.client import RealTimeClient
from turbopi.realtime.wire import pack, unpack
from turbopi.serve import PolicyServer, ServerOptions, running
from turbopi.serve.calls import PolicyCalls
from turbopi.serve.memory import Histories
from turbopi.serve.real_time import Plan
from turbopi.support.errors import ConfigError, ObservationError

GOLDEN = MemoryRuns("visual")


@pytest.fixture(scope="module")
def policy(tmp_path_factory: pytest.TempPathFactory) -> UnifiedPolicy:
    checkpoint = make_checkpoint("visual", tmp_path_factory.mktemp("served") / "checkpoint")
    return UnifiedPolicy(checkpoint, backend="pytorch", precision="f32", device="cpu", num_denoising_steps=1)


@pytest.fixture(scope="module")
def server(policy: UnifiedPolicy) -> Iterator[PolicyServer]:
    with running(policy, port=0) as started:
        yield started


@pytest.fixture
def client(server: PolicyServer) -> Iterator[RealTimeClient]:
    with RealTimeClient("127.0.0.1", server.port) as connected:
        yield connected


def exact(policy: UnifiedPolicy, shown: list[int]) -> np.ndarray:
    """The answer to the last of these observations of an episode."""
    history = policy.new_history()
    for run in shown[:-1]:
        policy.observe(GOLDEN.observation(run), history=history)
    return np.asarray(policy.infer(GOLDEN.observation(shown[-1]), seed=1, history=history)["actions"])


def test_each_clients_history_is_its_own_and_ends_with_its_episode(
    policy: UnifiedPolicy, server: PolicyServer, client: RealTimeClient
) -> None:
    assert client.metadata["memory"]["frames"] == 3
    with RealTimeClient("127.0.0.1", server.port) as other:
        assert client.observe(GOLDEN.observation(0)) == {"observations": 1, "missed": 0}
        other.observe(GOLDEN.observation(3))
        client.observe(GOLDEN.observation(1))
        answer = client.infer(GOLDEN.observation(2), seed=1)
        assert np.array_equal(answer["actions"], exact(policy, [0, 1, 2]))
        assert answer["memory"] == {"observations": 3, "missed": 0} and "turbopi/notes" not in answer
        assert np.array_equal(other.infer(GOLDEN.observation(2), seed=1)["actions"], exact(policy, [3, 2]))
    client.reset()
    assert client.observe(GOLDEN.observation(3))["observations"] == 1
    assert np.array_equal(client.infer(GOLDEN.observation(2), seed=1)["actions"], exact(policy, [3, 2]))
    assert not np.array_equal(exact(policy, [3, 2]), exact(policy, [0, 1, 2]))


def replies(server: PolicyServer, messages: list[dict[str, Any]]) -> list[dict[str, Any] | str]:
    """What one connection gets, to messages one after the other."""
    answers: list[dict[str, Any] | str] = []
    with connect(f"ws://127.0.0.1:{server.port}", max_size=None, proxy=None) as connection:
        connection.recv()
        for message in messages:
            connection.send(pack(message))
            reply = connection.recv()
            answers.append(reply if isinstance(reply, str) else unpack(reply))
    return answers


def sent(run: int, **keys: object) -> dict[str, Any]:
    return GOLDEN.observation(run) | {f"turbopi/{key}": value for key, value in keys.items()}


def test_a_named_session_outlives_its_connection(policy: UnifiedPolicy, server: PolicyServer) -> None:
    replies(server, [sent(0, session="arm", observe=True)])
    replies(server, [sent(3, session="leg", observe=True)])
    (answer,) = replies(server, [sent(1, session="arm", seed=1)])
    assert isinstance(answer, dict)
    assert np.array_equal(answer["actions"], exact(policy, [0, 1]))
    (again,) = replies(server, [sent(1, session="arm", seed=1, reset=True)])
    assert isinstance(again, dict) and np.array_equal(again["actions"], exact(policy, [1]))


def test_what_is_missed_is_reported_and_what_is_out_of_order_refused(
    policy: UnifiedPolicy, server: PolicyServer
) -> None:
    first, gap, late, same, after = replies(
        server,
        [sent(0, step=5, seed=1), sent(1, step=8, seed=1), sent(2, step=7), sent(2, step=8), sent(3, step=9, seed=1)],
    )
    assert isinstance(first, dict) and first["memory"] == {"observations": 1, "missed": 0}
    assert isinstance(gap, dict) and gap["memory"] == {"observations": 2, "missed": 2}
    (note,) = gap["turbopi/notes"]
    assert note["kind"] == "memory" and "2 observations of this episode were missed" in note["text"]
    for refused in (late, same):
        assert isinstance(refused, str) and "after 8 in an observation that is recorded already" in refused
    assert isinstance(after, dict) and after["memory"] == {"observations": 3, "missed": 2}
    assert "turbopi/notes" not in after, "it was said"
    assert np.array_equal(after["actions"], exact(policy, [0, 1, 3]))
    wrong = sent(2)
    del wrong["observation.state"]
    _, refused, answer, mixed = replies(server, [sent(0), wrong, sent(1, seed=1), sent(1, step=3)])
    assert isinstance(refused, str) and refused.startswith("bad observation: ")
    assert isinstance(answer, dict) and answer["memory"] == {"observations": 2, "missed": 1}
    assert np.array_equal(answer["actions"], exact(policy, [0, 1]))
    assert isinstance(mixed, str) and "step came in some requests" in mixed


def test_what_memory_does_not_go_with_is_refused(policy: UnifiedPolicy, server: PolicyServer) -> None:
    batch = {key: np.stack([value] * 2) if isinstance(value, np.ndarray) else value for key, value in sent(0).items()}
    refused, both = replies(server, [batch | {"turbopi/batch": 2}, sent(0, observe=True, model_actions=True)])
    assert isinstance(refused, str) and "each robot's in its own session" in refused
    assert isinstance(both, str) and "computes no chunk" in both
    with pytest.raises(ConfigError, match="max_batch=4 was asked for, but this policy has memory"):
        PolicyServer(policy, ServerOptions(max_batch=4))
    with pytest.raises(ConfigError, match="replicas of a fleet keep no robot's history"):
        PolicyServer(policy, calls=lambda metrics, lose: PolicyCalls(policy, ServerOptions(), metrics, lose))
    with running(FakePolicy(), port=0) as ordinary:
        (refused,) = replies(ordinary, [observation() | {"turbopi/observe": True}])
        assert isinstance(refused, str) and "for a policy with memory" in refused
        with (
            RealTimeClient("127.0.0.1", ordinary.port) as connected,
            pytest.raises(ConfigError, match="no policy with memory"),
        ):
            connected.observe(observation())


def test_a_client_that_lost_its_history_is_warned(
    server: PolicyServer, client: RealTimeClient, caplog: pytest.LogCaptureFixture
) -> None:
    for run in (0, 1):
        client.observe(GOLDEN.observation(run))
    client.close()
    client.observe(GOLDEN.observation(2))
    assert "has forgotten this episode's 2 observations" in caplog.text


class FakeHistory:
    observations = 0


def test_there_is_room_for_so_many_robots_and_idle_ones_make_it() -> None:
    now = [0.0]
    histories = Histories(FakeHistory, entries=10, clock=lambda: now[0], most=25)
    assert histories.most == 2

    def ask(connection: str, *, recorded: bool = True) -> None:
        plan = Plan({})
        histories.begin(plan, connection)
        with pytest.raises(ObservationError, match="isn't answered yet"):
            histories.begin(Plan({}), connection)
        plan.arguments["history"].observations += recorded
        histories.release(plan)

    for one in ("refused", "other", "more"):
        ask(one, recorded=False)
    ask("a")
    ask("b")
    with pytest.raises(ObservationError, match="at most 2 robots"):
        ask("c")
    histories.closed("a")
    ask("c")
