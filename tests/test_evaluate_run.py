"""Whole runs in the built-in simulator: scheduling, batching, resuming, crashes, and what is written."""

import errno
import html
import json
import multiprocessing
import os
import threading
from pathlib import Path
from typing import Any

import evaluate_fakes
import numpy as np
import pytest
from evaluate_fakes import NO_VIDEOS, SeekingPolicy, TroubledSimulator, gathering, jobs_for, run

from turbopi.evaluate.plan import VideoPlan, make_jobs, noise_seed
from turbopi.evaluate.reading import load_results
from turbopi.evaluate.results import Results
from turbopi.evaluate.schedule import TooManyCrashes
from turbopi.evaluate.sources import PolicyRefused
from turbopi.sim import SimulatorUnavailable
from turbopi.sim.base import Task
from turbopi.support.errors import ActionError, ConfigError, OutputError, TurboPiError
from turbopi.support.files import alone_in

pytestmark = pytest.mark.usefixtures("unseen_plots")

TROUBLED = "evaluate_fakes:TroubledSimulator"


@pytest.fixture(autouse=True)
def _no_plots(monkeypatch: pytest.MonkeyPatch) -> None:
    """Drawing takes longer than a run here, and is test_evaluate_output's."""
    monkeypatch.setattr("turbopi.evaluate.report.write_plots", lambda results: [])


def outcomes(results: Results) -> dict[tuple[int, int], tuple[str, int]]:
    return {key: (episode.status, episode.steps) for key, episode in results.episodes.items()}


def test_a_policy_that_sees_solves_every_episode(tmp_path: Path) -> None:
    policy = SeekingPolicy()
    results = run(tmp_path, policy, tasks=(0, 1, 2), states=(0, 5))
    assert [episode.status for episode in results.in_order()] == ["success"] * 6
    for episode in results.in_order():
        assert len(episode.call_ms) == len(episode.infer_ms) == -(-episode.steps // 5)  # asked every five steps
    assert results.complete and load_results(tmp_path).summary() == results.summary()


@pytest.mark.slow
def test_workers_requests_are_batched_which_changes_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    requested = gathering(monkeypatch, tmp_path / "gather", 3)

    class Slow(SeekingPolicy):
        """While it is at the first request, if that came alone, those of the other two workers come in."""

        def infer_batch(self, observations: Any, seed: Any) -> Any:
            while not self.batches and len(observations) == 1 and requested() < 3:
                pass
            return super().infer_batch(observations, seed)

    alone, batched = SeekingPolicy(), Slow()
    first = run(tmp_path / "one", alone, tasks=(0, 1, 2), states=(0, 1))
    assert set(alone.batches) == {1}
    simulator = "evaluate_fakes:GatheringSimulator"
    second = run(tmp_path / "two", batched, simulator=simulator, tasks=(0, 1, 2), states=(0, 1), workers=3, max_batch=2)
    assert max(batched.batches[:2]) == max(batched.batches) == 2
    assert outcomes(second) == outcomes(first)
    assert sorted(batched.seeds) == sorted(alone.seeds)
    assert (second.summary().mean_batch or 0) > 1


def test_the_noise_depends_on_the_episode_and_the_step_alone(tmp_path: Path) -> None:
    policy = SeekingPolicy()
    results = run(tmp_path, policy, states=(2, 4))
    steps = {state: range(0, results.episodes[0, state].steps, 5) for state in (2, 4)}
    assert policy.seeds == [noise_seed(7, 0, state, step) for state in (2, 4) for step in steps[state]]
    assert len(set(policy.seeds)) == len(policy.seeds)


def test_the_order_of_episodes_changes_none_of_them(tmp_path: Path) -> None:
    forwards = run(tmp_path / "a", SeekingPolicy(), states=(0, 1, 2))
    alone = run(tmp_path / "b", SeekingPolicy(), states=(2,))
    assert outcomes(alone)[0, 2] == outcomes(forwards)[0, 2]
    assert alone.episodes[0, 2].seed == forwards.episodes[0, 2].seed != forwards.episodes[0, 1].seed


def test_the_step_limit_ends_an_episode_as_a_failure(tmp_path: Path) -> None:
    results = run(tmp_path, SeekingPolicy(), max_steps=7)
    assert outcomes(results) == {(0, 0): ("failure", 7), (0, 1): ("failure", 7)}
    assert results.summary().success.wilson95[1] == pytest.approx(0.6576, abs=1e-4)


@pytest.mark.slow
def test_a_crash_is_no_failure_and_is_tried_again(tmp_path: Path) -> None:
    states = (0, TroubledSimulator.RAISES, TroubledSimulator.DIES, 5)
    results = run(tmp_path, SeekingPolicy(), simulator=TROUBLED, states=states)
    found = {state: results.episodes[0, state] for state in states}
    assert [found[state].status for state in states] == ["success", "crash", "crash", "success"]
    assert "the physics exploded" in str(found[TroubledSimulator.RAISES].message)
    assert "exit code 11" in str(found[TroubledSimulator.DIES].message)
    summary = results.summary()
    assert summary.crashes == 2 and summary.success.trials == 2 and summary.success.rate == 1
    assert not results.complete
    policy = SeekingPolicy()
    again = run(tmp_path, policy, simulator=TROUBLED, states=(0, TroubledSimulator.RAISES))
    assert again.episodes[0, 3].status == "crash" and not policy.batches  # only the crashed one was run


@pytest.mark.slow
def test_a_simulator_that_always_crashes_ends_the_run(tmp_path: Path) -> None:
    with pytest.raises(TooManyCrashes, match="crashed 5 times in a row; the last time: RuntimeError: no such scene"):
        run(tmp_path, SeekingPolicy(), simulator="evaluate_fakes:BrokenSimulator", states=range(9))
    assert load_results(tmp_path).summary().crashes == 5


@pytest.mark.slow
def test_a_simulator_that_cannot_draw_ends_the_run_at_once(tmp_path: Path) -> None:
    with pytest.raises(SimulatorUnavailable, match="can't draw with egl here"):
        run(tmp_path, SeekingPolicy(), simulator="evaluate_fakes:BlindSimulator")
    assert not load_results(tmp_path).episodes


def test_actions_that_are_not_finite_abort_the_episode(tmp_path: Path) -> None:
    results = run(tmp_path, SeekingPolicy({1: "nan"}))
    first, second = results.in_order()
    assert (first.status, first.steps, second.status) == ("aborted", 5, "success")
    assert first.message == "step 5: the policy's actions aren't finite (nan at [2, 1]); the episode was aborted"
    assert results.summary().success.trials == 2 and results.summary().aborted == 1  # it counts, as a failure


def test_a_policy_that_breaks_leaves_valid_results_and_the_run_continues(tmp_path: Path) -> None:
    calls = len(run(tmp_path / "whole", SeekingPolicy(), states=(0,)).episodes[0, 0].call_ms)
    with pytest.raises(TurboPiError, match="gone"):
        run(tmp_path / "cut", SeekingPolicy({calls + 1: TurboPiError("gone")}), states=(0, 1, 2))
    kept = load_results(tmp_path / "cut")
    assert list(kept.episodes) == [(0, 0)] and not kept.complete
    assert "The run isn't complete." in html.unescape((tmp_path / "cut" / "report.html").read_text())
    policy = SeekingPolicy()
    continued = run(tmp_path / "cut", policy, states=(0, 1, 2))
    assert continued.complete and noise_seed(7, 0, 0, 0) not in policy.seeds  # the finished one wasn't run again
    assert outcomes(continued) == outcomes(run(tmp_path / "all", SeekingPolicy(), states=(0, 1, 2)))


def test_ctrl_c_leaves_valid_results_and_no_process(tmp_path: Path) -> None:
    import multiprocessing

    with pytest.raises(KeyboardInterrupt):
        run(tmp_path, SeekingPolicy({4: KeyboardInterrupt()}), states=(0, 1, 2), workers=2)
    assert load_results(tmp_path).planned == {(0, 0), (0, 1), (0, 2)}
    assert not multiprocessing.active_children()


def test_a_run_is_not_continued_in_another_way(tmp_path: Path) -> None:
    run(tmp_path, SeekingPolicy(), states=(0,))
    with pytest.raises(
        ConfigError, match=r"protocol\.replan = 5, but this one has 3: give another --out, or begin again"
    ):
        run(tmp_path, SeekingPolicy(), states=(0,), replan=3)
    other = SeekingPolicy()
    other.metadata["precision"] = "bf16"
    with pytest.raises(ConfigError, match=r"policy\.precision = 'f32', but this one has 'bf16'"):
        run(tmp_path, other, states=(0,))
    assert run(tmp_path, other, states=(1,), restart=True).planned == {(0, 1)}


def test_a_restart_that_cannot_begin_leaves_the_earlier_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse() -> None:
        raise ConfigError("no ffmpeg")

    run(tmp_path, SeekingPolicy(), states=(0,))
    monkeypatch.setattr("turbopi.evaluate.run.check_can_write", refuse)
    with pytest.raises(ConfigError, match="no ffmpeg"):
        run(tmp_path, SeekingPolicy(), states=(1,), restart=True, videos=VideoPlan("all"))
    assert load_results(tmp_path).planned == {(0, 0)}


def test_a_restart_replaces_damaged_results_but_no_other_commands(tmp_path: Path) -> None:
    file = tmp_path / "results.json"
    file.write_text('{"floors": {}, "results": []}')
    with pytest.raises(ConfigError, match="isn't the result of an evaluation, so it isn't replaced"):
        run(tmp_path, SeekingPolicy(), states=(0,), restart=True)
    assert file.read_text() == '{"floors": {}, "results": []}'
    file.write_text('{"format": 1, "epis')
    assert run(tmp_path, SeekingPolicy(), states=(0,), restart=True).complete


def test_more_episodes_can_be_added_to_a_run(tmp_path: Path) -> None:
    run(tmp_path, SeekingPolicy(), tasks=(0,), states=(0,))
    results = run(tmp_path, SeekingPolicy(), tasks=(1,), states=(0,))
    assert set(results.episodes) == results.planned == {(0, 0), (1, 0)}


def test_seeding_by_task_gives_the_same_whatever_is_skipped(tmp_path: Path) -> None:
    whole = run(tmp_path / "a", SeekingPolicy(), states=(0, 1, 2), seeding="task", workers=2)
    part = run(tmp_path / "b", SeekingPolicy(), states=(2,), seeding="task")
    assert outcomes(part)[0, 2] == outcomes(whole)[0, 2]
    assert {episode.seed for episode in whole.episodes.values()} == {7}


def test_results_are_replaced_as_a_whole(tmp_path: Path) -> None:
    results = run(tmp_path, SeekingPolicy(), states=(0,))
    stop, broken = threading.Event(), []

    def read() -> None:
        while not stop.is_set():
            try:
                json.loads((tmp_path / "results.json").read_text())
            except ValueError as error:
                broken.append(error)

    reader = threading.Thread(target=read)
    reader.start()
    for _ in range(50):
        results.save()
    stop.set()
    reader.join()
    assert not broken and not (tmp_path / "results.json.tmp").exists()


def hold(folder: Path, ready: Any, done: Any) -> None:
    """What another `turbopi eval` does as long as it runs."""
    with alone_in(folder, "another evaluation"):
        ready.set()
        done.wait(120)


@pytest.mark.slow
def test_two_runs_in_one_folder_dont_lose_each_others_results(tmp_path: Path) -> None:
    run(tmp_path, SeekingPolicy(), states=(0,))
    before = (tmp_path / "results.json").read_bytes()
    spawn = multiprocessing.get_context("spawn")
    ready, done = spawn.Event(), spawn.Event()
    other = spawn.Process(target=hold, args=(tmp_path, ready, done))
    other.start()
    assert ready.wait(120)
    for restart in (False, True):
        with pytest.raises(
            ConfigError, match=f"{tmp_path} is being written by another evaluation, process {other.pid}"
        ):
            run(tmp_path, SeekingPolicy(), states=(0, 1), restart=restart)
    assert (tmp_path / "results.json").read_bytes() == before
    done.set()
    other.join(120)
    assert run(tmp_path, SeekingPolicy(), states=(0, 1)).complete
    assert not list(tmp_path.glob(".*"))


def test_what_another_run_finished_meanwhile_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Between the reading of the folder and the first episode."""
    real, others = evaluate_fakes.prepare, []

    def prepare_and_be_overtaken(*args: Any, **options: Any) -> Results:
        prepared = real(*args, **options)
        monkeypatch.setattr(evaluate_fakes, "prepare", real)
        others.append(run(tmp_path, SeekingPolicy(), states=(1,)))
        return prepared

    monkeypatch.setattr(evaluate_fakes, "prepare", prepare_and_be_overtaken)
    results = run(tmp_path, SeekingPolicy(), states=(0,))
    assert len(others) == 1 and set(results.episodes) == set(load_results(tmp_path).episodes) == {(0, 0), (0, 1)}


def test_a_full_disk_leaves_the_earlier_results_and_names_the_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run(tmp_path, SeekingPolicy(), states=(0, 1))
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir() if path.name != "workers.log"}

    def full(descriptor: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patched:
        patched.setattr(os, "fsync", full)
        with pytest.raises(
            OutputError, match=rf"can't write {tmp_path}/results\.json: No space left on device; make room"
        ):
            run(tmp_path, SeekingPolicy(), states=(0, 1, 2))
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir() if path.name != "workers.log"} == before
    assert run(tmp_path, SeekingPolicy(), states=(0, 1, 2)).complete


def test_a_policy_that_refuses_its_own_actions_aborts_that_episode_alone(tmp_path: Path) -> None:
    """As Turbo-Pi's policies do with actions that aren't finite; the batch's other observations are asked again."""

    class Finding(SeekingPolicy):
        def infer_batch(self, observations: Any, seed: Any) -> Any:
            if any(self.is_bad(one) for one in seed):
                raise ActionError("the model computed nan at [2, 1]")
            return super().infer_batch(observations, seed)

        def is_bad(self, seed: int) -> bool:
            return seed == noise_seed(7, 0, 1, 0)

    results = run(tmp_path, Finding(), states=(0, 1, 2), workers=3, max_batch=3, videos=VideoPlan("sample"))
    assert [episode.status for episode in results.in_order()] == ["success", "aborted", "success"]
    message = str(results.episodes[0, 1].message)
    assert message == "step 0: the model computed nan at [2, 1]; the episode was aborted"


@pytest.mark.parametrize("shape", [(0, 7), (4, 7), (10, 6), (10, 8)])
def test_a_policy_whose_later_chunks_dont_fit_ends_the_run_with_the_shape(tmp_path: Path, shape: Any) -> None:
    class Changing(SeekingPolicy):
        def infer_batch(self, observations: Any, seed: Any) -> Any:
            results = super().infer_batch(observations, seed)
            return [{"actions": np.zeros(shape)}] if len(self.batches) > 1 else results

    expected = "at least 5 actions of 7 numbers" if shape[0] else r"\[horizon, width\]"
    with pytest.raises(PolicyRefused, match=rf"shape \[{shape[0]}, {shape[1]}\]; expected {expected}"):
        run(tmp_path, Changing(), states=(0,))
    assert load_results(tmp_path).episodes == {}


def test_a_folder_without_results_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"holds no results\.json: it isn't the folder of an evaluation"):
        load_results(tmp_path)


def test_initial_states_that_do_not_exist_are_refused() -> None:
    with pytest.raises(ConfigError, match="task 0 has the initial states 0 to 49; it has no 50"):
        jobs_for(states=(3, 50))
    with pytest.raises(ConfigError, match="reacher_colors has no task 3, 9; its tasks are\n  0: reach the red dot"):
        jobs_for(tasks=(3, 0, 9))
    with pytest.raises(ConfigError, match="task 4 has no initial states"):
        make_jobs([Task(4, "empty", "reach", 0, 10)], None, None, NO_VIDEOS)


def test_requests_carry_the_resized_pictures(tmp_path: Path) -> None:
    class Watching(SeekingPolicy):
        shapes: set[Any] = set()  # noqa: RUF012

        def infer_batch(self, observations: Any, seed: Any) -> Any:
            self.shapes |= {observations[0][key].shape for key in ("observation/image", "observation/wrist_image")}
            assert observations[0]["observation/image"].dtype == np.uint8
            assert observations[0]["prompt"] == "reach the red dot"
            return super().infer_batch(observations, seed)

    run(tmp_path, Watching(), states=(0,), videos=NO_VIDEOS)
    assert Watching.shapes == {(64, 64, 3)}
