"""Workers that die, and simulators that give what no policy takes: each costs its own episode alone."""

import multiprocessing
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cli_helpers import refusal, turbopi
from evaluate_fakes import NO_VIDEOS, SeekingPolicy, gathering, jobs_for, run

from turbopi.evaluate.checks import check_fit
from turbopi.evaluate.plan import Protocol, choose_tasks
from turbopi.evaluate.results import Episode, Results
from turbopi.evaluate.run import evaluate, prepare
from turbopi.evaluate.sources import LocalPolicy
from turbopi.sim import SimSettings, create
from turbopi.sim.base import observation_problem
from turbopi.sim.reacher import ReacherSimulator
from turbopi.support.errors import ConfigError

pytestmark = pytest.mark.usefixtures("unseen_plots")


@pytest.fixture(autouse=True)
def _no_plots(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("turbopi.evaluate.report.write_plots", lambda results: [])


def kill_workers() -> None:
    for worker in multiprocessing.active_children():
        worker.kill()
        worker.join()


def statuses(results: Results) -> list[str]:
    return [episode.status for episode in results.in_order()]


@pytest.mark.slow
def test_a_worker_that_is_killed_while_its_request_waits_costs_its_episode(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    requested = gathering(monkeypatch, tmp_path / "gather", 3)

    class Killing(SeekingPolicy):
        """Its first call takes until the other two workers have asked, so that one of these waits in the second."""

        def infer_batch(self, observations: Sequence[dict[str, Any]], seed: Sequence[int]) -> list[dict[str, Any]]:
            if len(self.batches) == 0:
                while requested() < 3:
                    pass
            if len(self.batches) == 1:
                kill_workers()
            return super().infer_batch(observations, seed)

    results = run(
        tmp_path / "run",
        Killing(),
        simulator="evaluate_fakes:GatheringSimulator",
        tasks=(0, 1, 2),
        states=(0, 1),
        workers=3,
    )
    assert sorted(statuses(results)) == ["crash"] * 3 + ["success"] * 3
    assert all("exit code -9" in (e.message or "") for e in results.in_order() if e.status == "crash")
    assert not results.complete


def test_a_worker_that_dies_between_two_episodes_costs_the_next_one(tmp_path: Path) -> None:
    source, made = LocalPolicy(SeekingPolicy()), create("reacher")
    protocol = Protocol("reacher", made.suites[0], SimSettings(camera_px=64, wait_steps=2), image_px=64)
    jobs = jobs_for(states=(0, 1, 2))
    results = prepare(tmp_path, protocol, source, made, jobs, restart=False)

    def kill_after_the_first(episode: Episode, results: Results) -> None:
        if len(results.episodes) == 1:
            kill_workers()

    evaluate(
        *(results, protocol, source, made, jobs),
        num_workers=1,
        max_batch=1,
        videos=NO_VIDEOS,
        on_episode=kill_after_the_first,
    )
    assert statuses(results) == ["success", "crash", "success"]
    assert "exit code -9" in (results.in_order()[1].message or "")


@pytest.mark.slow
@pytest.mark.parametrize("execution", ["sync", "real time"])
def test_a_state_that_is_nan_is_its_episodes_crash_and_the_others_go_on(execution: str, tmp_path: Path) -> None:
    own: dict[str, Any] = {} if execution == "sync" else {"execution": "async", "control_hz": 200.0}
    results = run(tmp_path, SeekingPolicy(), simulator="evaluate_fakes:ExplodingSimulator", states=(2, 3, 4), **own)
    broken = results.episodes[0, 3]
    assert [episode.status == "crash" for episode in results.in_order()] == [False, True, False]
    assert (
        (broken.message or "")
        .strip()
        .endswith("'observation/state' isn't finite: nan at [1]: the simulator has gone wrong")
    )


IMAGE = np.zeros((4, 4, 3), np.uint8)


@pytest.mark.parametrize(
    ("observation", "why"),
    [
        (None, "is None; it should be a dict"),
        ({}, "no 'image'; it has nothing"),
        ({"image": None}, "'image' is NoneType; an image should be uint8"),
        ({"image": IMAGE / 255}, "'image' is float64"),
        ({"image": IMAGE[:0]}, r"'image' is uint8\[0, 4, 3\]"),
        ({"image": IMAGE[..., :1]}, r"'image' is uint8\[4, 4, 1\]"),
        ({"image": IMAGE[None]}, r"'image' is uint8\[1, 4, 4, 3\]"),
        ({"image": IMAGE, "state": np.array([[0, np.inf]])}, r"'state' isn't finite: inf at \[0, 1\]"),
        ({"image": IMAGE, "gripper": float("nan")}, "'gripper' isn't finite: nan"),
    ],
)
def test_what_no_policy_can_be_sent_is_named(observation: Any, why: str) -> None:
    assert re.search(why, observation_problem(observation, ("image",)) or "")


def test_what_a_policy_can_be_sent_is_no_problem() -> None:
    example = ReacherSimulator().example(SimSettings())
    more = {"count": np.arange(3), "text": np.array(["a"])}
    assert observation_problem({**example, **more}, ReacherSimulator.image_keys) is None


class Faulty(ReacherSimulator):
    name = "faulty"

    def check(self) -> list[str]:
        return None  # type: ignore[return-value]

    def tasks(self, suite: str) -> Any:
        raise OSError("no such scene")

    def versions(self) -> dict[str, str]:
        raise RuntimeError("no version")

    def example(self, settings: SimSettings) -> dict[str, Any]:
        raise KeyError("camera")


class Suiteless(ReacherSimulator):
    suites = ()  # type: ignore[assignment]


def test_what_a_simulator_of_ones_own_raises_is_no_fault_of_turbopi(tmp_path: Path) -> None:
    faulty: Any = Faulty()
    source = LocalPolicy(SeekingPolicy())
    protocol = Protocol("faulty", "reacher_colors", SimSettings())
    reported = turbopi(
        "eval", "test_evaluate_workers:Faulty", "--random-weights", "pi05_tiny", "--out", tmp_path / "never"
    )
    assert "check() of the simulator faulty failed: TypeError" in refusal(reported)
    with pytest.raises(ConfigError, match=r"tasks\(\) of the simulator faulty failed: OSError: no such scene; --debug"):
        choose_tasks(faulty, "reacher_colors", None)
    with pytest.raises(ConfigError, match=r"versions\(\) of the simulator faulty failed: RuntimeError: no version"):
        prepare(tmp_path / "never", protocol, source, faulty, [], restart=False)
    with pytest.raises(ConfigError, match=r"example\(\) of the simulator faulty failed: KeyError: 'camera'"):
        check_fit(source, faulty, protocol.sim, 64, 5)
    with pytest.raises(ConfigError, match="'test_evaluate_workers:Suiteless' has no suites"):
        create("test_evaluate_workers:Suiteless")


def test_a_fault_of_a_built_in_simulator_stays_one(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(self: ReacherSimulator, suite: str) -> Any:
        raise KeyError("ours")

    monkeypatch.setattr(ReacherSimulator, "tasks", broken)
    with pytest.raises(KeyError, match="ours"):
        choose_tasks(create("reacher"), "reacher_colors", None)
