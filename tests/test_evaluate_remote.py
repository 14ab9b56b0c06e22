"""Joined chunks from a policy server: the same episodes as in this process, and refusals that say what to do."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cli_helpers import turbopi
from evaluate_fakes import SeekingPolicy, run

from turbopi import UnifiedPolicy, serve
from turbopi.evaluate.checks import check_way
from turbopi.evaluate.plan import Protocol
from turbopi.evaluate.sources import Answer, LocalPolicy, PolicyRefused, RemotePolicy
from turbopi.policy.shipped import CHASE_POLICY
from turbopi.realtime.running_chunk import JoinMode
from turbopi.support.errors import ConfigError

pytestmark = pytest.mark.usefixtures("unseen_plots")

RTC = ("rtc", "rtc_identity", "rtc_trained")
STATES = (0, 1)


class Noting:
    """Hands requests on, and keeps the answers."""

    def __init__(self, source: LocalPolicy | RemotePolicy) -> None:
        self._source = source
        self.max_batch, self.label, self.real_time = source.max_batch, source.label, source.real_time
        self.identity, self.about = source.identity, source.about
        self.answers: list[Answer] = []

    def infer(
        self,
        observations: Sequence[Mapping[str, object]],
        seeds: Sequence[int],
        arguments: Sequence[Mapping[str, Any]] | None = None,
    ) -> list[Answer]:
        found = self._source.infer(observations, seeds, arguments)
        self.answers += found
        return found

    def warm_up(self, most: int, mode: JoinMode | None, tell: Callable[[str], None]) -> None:
        self._source.warm_up(most, mode, tell)

    def close(self) -> None:
        self._source.close()


@pytest.fixture(scope="module")
def policy() -> UnifiedPolicy:
    return UnifiedPolicy(CHASE_POLICY, backend="pytorch", device="cpu", precision="f32")


@pytest.fixture(scope="module")
def server(policy: UnifiedPolicy) -> Iterator[serve.PolicyServer]:
    with serve.running(policy) as running:
        yield running


@pytest.mark.slow
@pytest.mark.parametrize("way", ["async", *RTC])
def test_a_server_gives_the_same_actions_as_the_policy_in_this_process(
    way: str, policy: UnifiedPolicy, server: serve.PolicyServer, tmp_path: Path
) -> None:
    local, remote = Noting(LocalPolicy(policy)), Noting(RemotePolicy("127.0.0.1", server.port))
    found = [
        run(tmp_path / name, source, simulator="chase", states=STATES, execution=way, delay=2, max_steps=14)
        for name, source in (("local", local), ("remote", remote))
    ]
    assert len(local.answers) == len(remote.answers) == 2 * 3  # asked at the steps 0, 5 and 10
    for here, there in zip(local.answers, remote.answers, strict=True):
        assert np.array_equal(here.actions, there.actions)
        assert here.for_next.keys() == there.for_next.keys() and bool(here.for_next) == (way != "async")
        assert all(np.array_equal(here.for_next[name], there.for_next[name]) for name in here.for_next)
    at_home, abroad = ([(e.status, e.steps, e.motion) for e in one.in_order()] for one in found)
    assert at_home == abroad


def test_the_running_chunk_does_reach_the_server(
    policy: UnifiedPolicy, server: serve.PolicyServer, tmp_path: Path
) -> None:
    """With the first two actions held, a chunk that takes over at row 2 continues the running one exactly there."""
    remote = Noting(RemotePolicy("127.0.0.1", server.port))
    run(tmp_path, remote, simulator="chase", states=(0,), execution="rtc_trained", delay=2, max_steps=14)
    first, second, third = (answer.for_next["model_actions"] for answer in remote.answers)
    assert np.array_equal(second[:2], first[5:7]) and np.array_equal(third[:2], second[5:7])
    assert not np.array_equal(second[2:4], first[7:9])


def test_a_server_that_takes_no_seeds_is_sent_none(policy: UnifiedPolicy, server: serve.PolicyServer) -> None:
    remote = RemotePolicy("127.0.0.1", server.port)
    assert remote.takes_seeds
    observation = policy.example_observation()
    once, again, other = (remote.infer([observation], [seed])[0].actions for seed in (2**64 - 1, 2**64 - 1, 5))
    assert np.array_equal(once, again) and not np.array_equal(once, other)
    with serve.running(SeekingPolicy()) as plain:
        source = RemotePolicy("127.0.0.1", plain.port)
        assert not source.takes_seeds
        source.infer([{"observation/state": np.zeros(8), "observation/image": np.zeros((8, 8, 3), np.uint8)}], [3])


def test_ways_that_a_policy_does_not_offer_are_refused_by_name_with_what_to_do(policy: UnifiedPolicy) -> None:
    def source(real_time: Mapping[str, Any], server: str | None = None) -> Noting:
        made = Noting(LocalPolicy(policy))
        made.real_time, made.about = real_time, {} if server is None else {"server": server}
        return made

    protocol = Protocol("chase", "chase_post", execution="rtc_trained", delay=4)
    with pytest.raises(
        ConfigError, match=r"--execution rtc_trained .*gpu:8000 joins no chunks.*`turbopi serve`; .*sync"
    ):
        check_way(source({}, "gpu:8000"), protocol)
    with pytest.raises(ConfigError, match=r"rtc_trained tells .* this policy joins no chunks .*take a backend"):
        check_way(source({}), protocol)
    with pytest.raises(ConfigError, match=r"rtc_trained isn't offered by .*gpu:8000, which offers \['rtc'\]"):
        check_way(source({"modes": ["rtc"]}, "gpu:8000"), protocol)
    trained = source({"modes": ["rtc_trained"], "trained_max_delay": 3})
    with pytest.raises(ConfigError, match=r"a delay of 4 control steps .*trained with delays up to 3; give another"):
        check_way(trained, protocol)
    check_way(trained, replace(protocol, delay=3))
    with pytest.raises(ConfigError, match=r"gpu:8000 joins chunks itself .*--execution 'rtc'.*start it without"):
        check_way(source({"modes": ["rtc"], "execution": "rtc"}, "gpu:8000"), replace(protocol, execution="async"))


def test_the_command_refuses_a_server_without_the_feature_before_anything_runs(tmp_path: Path) -> None:
    with serve.running(SeekingPolicy()) as plain:
        command = f"eval reacher --port {plain.port} --execution async,rtc --delay-steps 2 --out {tmp_path / 'never'}"
        result = turbopi(*command.split())
    assert result.exit_code == 2 and "--execution rtc tells the policy" in " ".join(result.stderr.split())
    assert not (tmp_path / "never").exists()


def test_what_a_server_says_of_a_chunk_that_are_no_numbers_is_refused() -> None:
    class Odd(SeekingPolicy):
        def infer(self, observation: dict[str, Any], **arguments: Any) -> dict[str, Any]:
            return super().infer(observation) | {"model_actions": "left"}

    with serve.running(Odd()) as server, pytest.raises(PolicyRefused, match="model_actions aren't numbers but 'left'"):
        RemotePolicy("127.0.0.1", server.port).infer(
            [{"observation/state": np.zeros(8), "observation/image": np.zeros((8, 8, 3), np.uint8)}], [3]
        )
