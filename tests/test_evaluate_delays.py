"""Evaluation under simulated delay: exact, the same as ever without one, and a report that counts right."""

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cli_helpers import turbopi
from evaluate_fakes import SeekingPolicy, run

from turbopi.cli.evaluate import _delays_table
from turbopi.config import RealTime
from turbopi.evaluate.checks import check_delay
from turbopi.evaluate.delays import Cell, document, make_cells, notes, write_delays
from turbopi.evaluate.episode import Execution, run_episode
from turbopi.evaluate.plan import Job, Protocol
from turbopi.evaluate.reading import load_results
from turbopi.evaluate.results import protocol_json
from turbopi.evaluate.sources import LocalPolicy
from turbopi.models.pi0.conditioning import Conditioning
from turbopi.policy.policy import UnifiedPolicy
from turbopi.realtime import WAYS
from turbopi.realtime.running_chunk import RunningChunk
from turbopi.sim import create
from turbopi.sim.base import Task
from turbopi.support.errors import ConfigError

pytestmark = pytest.mark.usefixtures("two_layers", "unseen_plots")

TASK = Task(0, "count", "count", 10, 30)


class Counter:
    """A world that counts its steps; its state is the count. Solved at no time."""

    def __init__(self) -> None:
        self.actions: list[float] = []
        self.looked = True

    def reset(self, initial_state: int) -> None:
        self.actions = []

    def observation(self) -> dict[str, Any]:
        assert self.looked
        return {"image": np.zeros((2, 2, 3), np.uint8), "count": len(self.actions)}

    def step(self, action: np.ndarray, look: bool) -> bool:
        self.actions.append(float(action[0]))
        self.looked = look
        return False

    def draw(self) -> list[np.ndarray]:
        return []

    def close(self) -> None:
        pass


def refused(command: str, *more: object) -> str:
    result = turbopi(*command.split(), *more)
    assert result.exit_code == 2, result.output
    return " ".join(result.stderr.split())


def ask(step: int, observation: dict[str, Any], arguments: Mapping[str, Any]) -> dict[str, Any]:
    """Chunks whose row i is 100 * (when it was asked) + i."""
    rows = 100.0 * observation["count"] + np.arange(12.0)
    chunk = np.stack([rows, np.zeros(12)], axis=1)
    return {"actions": chunk, "model_actions": chunk.astype(np.float32)}


def carried_out(way: str, delay: int, every: int = 4, steps: int = 20) -> list[float]:
    world = Counter()
    execution = Execution(way, every, delay, lambda last: np.full(2, -1.0))
    ending = run_episode(world, Job(TASK, 0), ask, execution, max_steps=steps, image_keys=("image",))
    assert ending.steps == steps == len(ending.commands.values)
    return world.actions


def openpis_loop(every: int, steps: int) -> list[float]:
    done: list[float] = []
    while len(done) < steps:
        done += ask(0, {"count": len(done)}, {})["actions"][:every, 0].tolist()
    return done[:steps]


@pytest.mark.parametrize("way", [way for way in WAYS if way != "ensemble"])  # which averages without a delay, too
def test_without_a_delay_every_way_is_openpis_loop_step_by_step(way: str) -> None:
    assert carried_out(way, 0) == openpis_loop(4, 20)
    assert carried_out(way, 1) != openpis_loop(4, 20)  # a delay that is ignored would be seen


@pytest.mark.parametrize("way", ["rtc", "rtc_identity", "rtc_trained", "paint"])
def test_ways_that_are_plain_without_a_delay_make_an_ordinary_call_then(way: Any) -> None:
    left_over, options = np.zeros((8, 32), np.float32), RealTime(trained_max_delay=2)
    chunk = RunningChunk(left_over, 0, 2, way).completed(10, 32, relative=False, options=options)
    is_plain = chunk.conditioning(left_over, 10, 10, "accumulated") == Conditioning()
    assert is_plain == WAYS[way].plain_without_delay


@pytest.mark.parametrize("way", ["async", "rtc", "rtc_identity", "rtc_trained"])
def test_a_chunk_takes_over_exactly_so_many_steps_after_its_observation(way: str) -> None:
    first = [0, 1, 2, 3, 4, 5]  # asked again at step 4, the answer is there at step 6 and entered at its row 2
    assert carried_out(way, 2, steps=12) == [*first, 402, 403, 404, 405, 802, 803]


def test_sync_stands_still_for_the_delay_and_enters_at_the_beginning() -> None:
    assert carried_out("sync", 2, steps=12) == [0, 1, 2, 3, -1, -1, 400, 401, 402, 403, -1, -1]


def test_ensemble_averages_what_both_chunks_have() -> None:
    found = carried_out("ensemble", 2, steps=8)
    assert found[6:] == pytest.approx([0.3 * 6 + 0.7 * 402, 0.3 * 7 + 0.7 * 403])


def test_seams_and_smoothness_are_measured_where_chunks_take_over() -> None:
    world, execution = Counter(), Execution("async", 4, 2)
    motion = run_episode(world, Job(TASK, 0), ask, execution, max_steps=12, image_keys=("image",)).motion
    assert motion is not None
    assert (motion.seams, motion.standing, motion.dropped) == (2, 0, 0)
    assert motion.seam_jump == pytest.approx(397)  # from 5 to 402, and from 405 to 802
    assert motion.step_jump == pytest.approx(1)
    assert motion.seam_gap == pytest.approx(396)  # where the running chunk has 6 (406), and the new one 402 (802)
    second = np.abs(np.diff(world.actions, n=2)).mean()
    assert motion.jerk == pytest.approx(second)


def test_a_run_under_delay_is_another_run_and_an_old_one_is_still_continued(tmp_path: Path) -> None:
    assert "delay" not in protocol_json(Protocol("reacher", "reacher_colors"))
    assert protocol_json(Protocol("reacher", "reacher_colors", delay=1))["delay"] == 1
    results = run(tmp_path, SeekingPolicy(), states=(0,))
    file = tmp_path / "results.json"
    content = json.loads(file.read_text())
    for episode in content["episodes"]:
        del episode["motion"]  # as 0.1 wrote it
    file.write_text(json.dumps(content))
    assert load_results(tmp_path).episodes[0, 0].motion is None
    continued = run(tmp_path, SeekingPolicy(), states=(0, 1))
    assert continued.episodes.keys() == {(0, 0), (0, 1)} and results.episodes.keys() == {(0, 0)}
    with pytest.raises(ConfigError, match=r"protocol\.delay = 0, but this one has 2: give another --out"):
        run(tmp_path, SeekingPolicy(), states=(0,), execution="async", delay=2)


@pytest.mark.slow
def test_the_report_counts_pairs_and_shows_every_cell(tmp_path: Path) -> None:
    cells = make_cells(["sync", "async"], [4, 0], [5])
    assert [cell.delay for cell in cells] == [0, 4, 0, 4]
    done = []
    for cell in cells:
        trouble = {0: "nan"} if cell == Cell("sync", 4, 5) else None
        policy = SeekingPolicy(trouble)
        results = run(
            tmp_path / cell.folder, policy, states=(0, 1, 2), replan=5, execution=cell.execution, delay=cell.delay
        )
        done.append((cell, results))
    page = write_delays(tmp_path, done)
    reported = document(done)
    assert reported.outcomes == ["sss", "ass", "sss", "sss"]
    sync, delayed, _, other = reported.cells
    assert sync.undelayed is None and sync.against is None
    assert delayed.undelayed is not None and (delayed.undelayed.only_first, delayed.undelayed.pairs) == (1, 3)
    assert other.against is not None and (other.against.only_second, other.against.both) == (1, 2)
    assert delayed.standing is not None and delayed.standing > 0
    assert json.loads((tmp_path / "delays.json").read_text())["cells"][1]["success"]["successes"] == 2
    text = page.read_text()
    assert notes(reported.cells, None) == [
        "the same with a delay of 0: sync, async; these are ordinary calls, which need nothing of the chunk before"
    ]
    assert notes(reported.cells, None)[0] in text and not notes(reported.cells[:2], None)
    assert all(cell.folder in text for cell in cells)
    table = _delays_table("chase under delay", reported.cells)  # its rows are told apart by the first column alone
    assert table.title == "chase under delay, horizon 5"
    headings = [str(column.header) for column in table.columns]
    assert not {"delay", "horizon"} & {*headings} and {"success [95 %]", "stood still"} <= {*headings}
    assert list(table.columns[0].cells) == ["sync, delay 0", "sync, delay 4", "async, delay 0", "async, delay 4"]
    assert (tmp_path / "delays.png").exists() and (tmp_path / "seams.png").exists()


@pytest.mark.parametrize(
    ("way", "delay", "every"), [("async", 6, 5), ("rtc", 6, 5), ("rtc_trained", 4, 3), ("ensemble", 3, 8)]
)
def test_a_delay_that_does_not_fit_is_refused_with_what_would(way: str, delay: int, every: int) -> None:
    protocol = Protocol("chase", "chase_post", execution=way, delay=delay, replan=every)
    most = min(every, 10 - every)
    with pytest.raises(ConfigError, match=rf"a delay of {delay} control steps doesn't fit .* at most {most} does"):
        check_delay(protocol, create("chase"), 10)
    check_delay(Protocol("chase", "chase_post", execution="sync", delay=delay, replan=every), create("chase"), 10)


@pytest.mark.parametrize(("way", "most"), [("async", 45), ("ensemble", 45), ("rtc", 5)])
def test_the_longest_delay_that_a_refusal_names_does_fit_and_one_more_does_not(way: str, most: int) -> None:
    """The execution horizon limits the delay only where the policy is told of the running chunk."""
    longest = Protocol("chase", "chase_post", execution=way, delay=most, replan=5)
    check_delay(longest, create("chase"), 50)
    with pytest.raises(ConfigError, match=f"at most {most} does"):
        check_delay(replace(longest, delay=most + 1), create("chase"), 50)


@pytest.mark.parametrize("way", ["sync", "async", "rtc"])
def test_chunks_that_end_before_the_execution_horizon_are_refused_whatever_the_delay(way: str) -> None:
    protocol = Protocol("chase", "chase_post", execution=way, replan=60)
    with pytest.raises(ConfigError, match=r"chunks have 50 actions, so it can't act 60 steps .*give --replan 50"):
        check_delay(protocol, create("chase"), 50)


def test_ways_that_tell_the_model_ask_the_policy_for_it() -> None:
    requested: list[dict[str, Any]] = []

    class Policy:
        def __init__(self) -> None:
            self.metadata: dict[str, Any] = {}

        def infer_batch(self, observations: Any, seed: Any, **arguments: Any) -> list[dict[str, Any]]:
            requested.append(arguments)
            return [{"actions": np.zeros((10, 7)), "model_actions": np.ones((10, 32), np.float32)}]

    (answer,) = LocalPolicy(Policy()).infer([{}], [3], [{"previous": None, "model_actions": True}])
    assert requested == [{"previous": [None], "model_actions": [True]}]
    assert answer.for_next["model_actions"].shape == (10, 32)


@pytest.mark.parametrize(
    ("options", "why"),
    [
        ("--execution never", "--execution never is no way to run; choose one of sync, async"),
        ("--delay-steps x", "--delay-steps is 'x'"),
        ("--delay-steps=", "--delay-steps is ''"),
        ("--execution-horizon 4 --replan 6", "say the same; give one of them"),
    ],
)
def test_bad_ways_are_refused(options: str, why: str, tmp_path: Path) -> None:
    assert why in refused(f"eval reacher --random-weights pi05_tiny {options}", "--out", tmp_path / "never")


@pytest.mark.parametrize(
    ("options", "why"),
    [
        ("--execution async,rtc_trained", "--execution rtc_trained isn't offered by this policy, which offers"),
        ("--execution async --delay-steps 0,9", "a delay of 9 control steps doesn't fit --execution async"),
        ("--replan 11", "the policy's chunks have 10 actions, so it can't act 11 steps before it is asked again"),
    ],
)
def test_what_the_policy_cannot_do_is_refused_before_its_weights_are_loaded(
    options: str, why: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delattr(UnifiedPolicy, "__init__")
    assert why in refused(f"eval chase --random-weights pi05_tiny {options}", "--out", tmp_path / "never")


@pytest.mark.slow
def test_the_command_runs_every_cell_and_compares_them(tmp_path: Path) -> None:
    from turbopi.policy.shipped import CHASE_POLICY

    result = turbopi(
        "eval", "chase", CHASE_POLICY, "--trials", 1, "--max-steps", 8, "--videos", "none", "--camera-px", 48,
        "--execution", "async,rtc,rtc_identity,rtc_trained", "--delay-steps", "0,2", "--out", tmp_path, "--json",
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    cells = json.loads(result.stdout)["cells"]
    assert len(cells) == 8 and {cell["execution"] for cell in cells} == {"async", "rtc", "rtc_identity", "rtc_trained"}
    held = load_results(tmp_path / "rtc_trained_delay2_horizon5").episodes[0, 0].motion
    assert held is not None and held.dropped == 0 and held.seam_gap is not None
