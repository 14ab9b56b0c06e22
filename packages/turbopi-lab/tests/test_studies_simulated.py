"""Variants of a policy in a simulator: cells that are kept, continued, compared; studies of them; padded caches."""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from cli_helpers import refusal, turbopi

from turbopi import UnifiedPolicy
from turbopi.backends.pytorch import reference_model
from turbopi.checkpoint import open_checkpoint
from turbopi.evaluate.reading import load_results
from turbopi.evaluate.results import Results
from turbopi.evaluate.statistics import Paired, Rate
from turbopi.models.observation import Observation
from turbopi.policy.shipped import CHASE_POLICY
from turbopi.sim import Task
from turbopi.support.errors import ConfigError
from turbopi.support.reading import read_document
from turbopi_lab.studies import kv_reuse, kv_reuse_libero, mask, report
from turbopi_lab.studies.kv_reuse import Reuse, Reusing
from turbopi_lab.studies.report import Report
from turbopi_lab.studies.rollouts import CHASE, open_policy, play
from turbopi_lab.studies.simulated import PLAIN, Running, SimulatorCell, Variant, _check_pair, _initial_states, finished
from turbopi_lab.studies.study import Setup

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("unseen_plots")]

IN_CHASE = (CHASE_POLICY, "--simulator", "chase", "--small", "--device", "cpu", "--workers", "1")


def test_cells_in_a_simulator_are_kept_and_continued_and_the_report_needs_nothing_else(tmp_path: Path) -> None:
    """Cells of several commands into one folder, then a report that runs nothing."""
    given = ("study", "steps_libero", *IN_CHASE, "--episodes", "2", "--out", tmp_path)
    report_only = ("study", "steps_libero", "--device", "cpu", "--report-only", "--out", tmp_path)
    assert "plain holds no finished run; run steps_libero with --way plain" in refusal(turbopi(*report_only))
    for way in ("plain", "exponential, uniform, 2"):
        result = turbopi(*given, "--episodes-only", "--way", way)
        assert result.exit_code == 0, result.output
    assert {file.parent.name for file in tmp_path.rglob("results.json")} == {"plain", "exponential_uniform_2"}
    assert not (tmp_path / "steps_libero").exists()
    assert turbopi(*report_only).exit_code == 1  # the control is missing
    (control,) = read_document(tmp_path / "steps_libero" / report.JSON, Report).controls
    assert not control.held and "`--way control`" in control.evidence
    result = turbopi(*given, "--way", "euler, uniform, 1")  # what is there isn't run again
    assert result.exit_code == 0, result.output
    assert turbopi(*report_only).exit_code == 0
    found = read_document(tmp_path / "steps_libero" / report.JSON, Report)
    names = ["plain", "euler, uniform, 1", "exponential, uniform, 2"]
    assert found.sound and [row[0] for row in found.tables[0].rows] == names
    assert len(found.not_run) == 4 and "ab2, uniform, 2" in "".join(found.not_run)
    (panel,) = found.plots[0].panels
    assert {one.label: one.x for one in panel.series} == {"euler": [1.0, 10.0], "exponential": [2.0]}
    assert "run on CPU. " in found.method
    file = tmp_path / "episodes" / "exponential_uniform_2" / "results.json"
    elsewhere = json.loads(file.read_text())
    elsewhere["policy"]["about"]["device_name"] = "another"
    file.write_text(json.dumps(elsewhere))
    result = turbopi(*report_only)
    assert "not finite" not in result.output, "the plain policy isn't compared with itself"
    found = read_document(tmp_path / "steps_libero" / report.JSON, Report)
    assert "run on CPU (plain; euler, uniform, 1), another (exponential, uniform, 2). " in found.method


def test_cells_of_other_episodes_or_cut_short_are_not_compared(tmp_path: Path) -> None:
    given = ("study", "steps_libero", *IN_CHASE, "--out", tmp_path, "--episodes-only", "--way")
    assert turbopi(*given, "plain", "--episodes", "1").exit_code == 0
    assert turbopi(*given, "euler, uniform, 1", "--episodes", "2").exit_code == 0
    report_only = ("study", "steps_libero", "--device", "cpu", "--report-only", "--out", tmp_path)
    said = refusal(turbopi(*report_only))
    assert "can't be compared: the episodes differ: 2 and 1, of which task 0 from initial state 1 is in" in said
    assert "is in euler_uniform_1 alone" in said
    file = tmp_path / "episodes" / "euler_uniform_1" / "results.json"
    run = json.loads(file.read_text())
    run["episodes"].pop()
    file.write_text(json.dumps(run))
    turbopi(*report_only)
    found = read_document(tmp_path / "steps_libero" / report.JSON, Report)
    assert "euler, uniform, 1, cut short after 1 of 2 episodes: `--way 'euler, uniform, 1'`" in found.not_run


def test_cells_of_another_policy_or_protocol_are_not_compared(tmp_path: Path) -> None:
    given = ("study", "steps_libero", *IN_CHASE, "--out", tmp_path, "--episodes-only", "--episodes", "1")
    assert turbopi(*given, "--way", "plain", "--way", "euler, uniform, 1").exit_code == 0
    plain, cell = (load_results(tmp_path / "episodes" / one) for one in ("plain", "euler_uniform_1"))
    _check_pair(plain, cell)
    parts: list[tuple[Any, str, str]] = [
        (cell.policy.identity, "weights", "the policy's weights differ: 'others' and '"),
        (cell.protocol, "replan", "the protocol's replan differ: 'others' and 5"),
    ]
    for changed, name, said in parts:
        before = changed[name]
        changed[name] = "others"
        with pytest.raises(ConfigError, match=re.escape(f"can't be compared: {said}")):
            _check_pair(plain, cell)
        changed[name] = before


@pytest.mark.parametrize("name", ["kv_reuse_libero", "fp8_and_fp4_libero", "mask_libero"])
def test_a_study_in_a_simulator_runs_and_its_controls_hold(name: str, tmp_path: Path) -> None:
    result = turbopi("study", name, *IN_CHASE, "--out", tmp_path)
    assert result.exit_code == 0, result.output
    found = read_document(tmp_path / name / report.JSON, Report)
    assert found.sound and len(found.tables[0].rows) >= 2 and found.not_run


def test_what_a_study_in_a_simulator_is_refused(tmp_path: Path) -> None:
    said = refusal(turbopi("study", "steps_libero", "--way", "euler, uniform, 4", "--simulator", "chase"))
    assert "unknown way 'euler, uniform, 4' of steps_libero; choose of: plain; euler, uniform, 1" in said
    given = ("study", "steps", "--device", "cpu", "--out", tmp_path)
    assert "--report-only is for steps_libero, kv_reuse_libero" in refusal(turbopi(*given, "--report-only"))
    assert "steps keeps no episodes" in refusal(turbopi(*given, "--episodes-only"))
    on_libero = ("study", "steps_libero", "--device", "cpu")
    assert "--episodes-only needs --out" in refusal(turbopi(*on_libero, "--episodes-only"))
    said = refusal(turbopi(*on_libero, "--out", tmp_path, "--episodes-only", "--report-only"))
    assert "leave nothing to do" in said
    on_toys = ("study", "steps,mask", "--random-weights", "pi05_tiny", "--small", "--device", "cpu")
    for option, value in (("--way", "euler, uniform, 1"), ("--simulator", "chase")):
        said = refusal(turbopi(*on_toys, option, value))
        assert f"{option} is '{value}', and is for steps_libero, " in said and "steps, mask takes none" in said
    assert "--episodes is 1001; a cell on chase has 1000 at most" in refusal(
        turbopi("study", "steps_libero", "--simulator", "chase", "--episodes", "1001", "--device", "cpu")
    )


@pytest.mark.parametrize(
    ("simulator", "small", "requested", "episodes", "states"),
    [
        *(("chase", False, None, 200, 200), ("chase", True, None, 2, 2), ("chase", True, 5, 5, 5)),
        *(("reacher", False, None, 150, 50), ("reacher", False, 7, 9, 3)),  # three tasks of fifty initial states each
    ],
)
def test_a_cell_has_as_many_episodes_as_were_asked_for(
    simulator: str, small: bool, requested: int | None, episodes: int, states: int, tmp_path: Path
) -> None:
    setup = Setup(small=small, simulator=simulator, episodes=requested, folder=tmp_path)
    jobs = Running.of(setup).jobs
    assert len(jobs) == episodes and {job.initial_state for job in jobs} == set(range(states))


@pytest.mark.parametrize(("requested", "states"), [(None, 20), (200, 20), (50, 5), (41, 5)])
def test_liberos_cells_are_of_states_that_training_never_saw(requested: int | None, states: int) -> None:
    tasks = [Task(i, "task", "do it", 50, 220) for i in range(10)]
    assert _initial_states(Setup(episodes=requested), tasks) == range(30, 30 + states)
    with pytest.raises(ConfigError, match="--episodes is 201; a cell on libero has 200 at most"):
        _initial_states(Setup(episodes=201), tasks)


def ended(variant: Variant, folder: Path) -> Results:
    """A variant's first two episodes of the chase, one request at a time."""
    setup = Setup(small=True, simulator="chase", folder=folder, workers=1, checkpoint=open_checkpoint(CHASE_POLICY))
    running = Running.of(setup)
    running.run(variant, folder, running.jobs, max_batch=1)
    found = finished(folder)
    assert found is not None
    return found


def test_reuse_is_counted_by_episode_and_a_variant_that_isnt_neutral_fails_the_control(tmp_path: Path) -> None:
    study = kv_reuse_libero.VARIANTS
    control, plain = (tmp_path / f"kv_reuse_libero_control{end}" for end in ("", "_plain"))
    ends = ended(next(cell for cell in study.cells if cell.name == "every 2"), control)
    lines = [json.loads(line) for line in (control / kv_reuse_libero.FILE).read_text().splitlines()]
    assert all(share == number % 2 for _, _, number, share in lines)
    for (task, state), episode in ends.episodes.items():
        assert [line[2] for line in lines if line[:2] == [task, state]] == list(range(len(episode.call_ms)))
    share = float(np.mean([share for *_, share in lines]))
    assert kv_reuse_libero.reused(control) == (share, share)
    ended(study.plain, plain)
    (found,) = study.controls(tmp_path, [], small=True)
    assert not found.held


@pytest.mark.parametrize(("lost", "held"), [(None, False), (10, False), (40, True)])
def test_a_full_report_is_sound_only_with_a_broken_cell_that_fails(
    lost: int | None, held: bool, tmp_path: Path
) -> None:
    study, cells = kv_reuse_libero.VARIANTS, []
    if lost is not None:
        paired = Paired(200 - lost, lost, 0, 0).document  # both solved, the plain policy alone
        cells = [SimulatorCell(kv_reuse_libero.ANOTHERS, Rate(200 - lost, 200).document, paired, {})]
    _, broken = study.controls(tmp_path, cells, small=False)
    assert broken.held is held and broken.claim.startswith("every 2, of another episode isn't as good")
    assert (broken.evidence == "Not run: `--way 'every 2, of another episode'`.") is (lost is None)


def test_a_cell_that_does_not_tell_what_it_reused_has_no_place_in_the_plot() -> None:
    study, paired = kv_reuse_libero.VARIANTS, Paired(180, 0, 20, 0).document
    shares = {PLAIN: {}, "full 0.9": {"tokens reused, %": 40.0}, "full 0.87": {}, "patch 0.9": {}}
    cells = [SimulatorCell(way, Rate(180, 200).document, paired, reported) for way, reported in shares.items()]
    (panel,) = study._plot(cells).panels
    assert {series.label: series.x for series in panel.series} == {PLAIN: [0], "full": [40.0]}


@pytest.mark.parametrize("what", ["full", "camera", "patch", "every"])
def test_episodes_at_other_calls_and_with_other_prompts_are_reused_together_as_alone(what: str) -> None:
    """Padding differs from batch to batch, so memory is kept by the padded prefix's slots."""
    policy = UnifiedPolicy(CHASE_POLICY, backend="pytorch", precision="f32", device="cpu")
    model, rng = reference_model(policy.backend), np.random.default_rng(0)
    value = {"full": 0.5, "camera": 0.5, "patch": 0.9, "every": 2}[what]

    def seen(prompt: str, seed: int) -> Observation:
        return Observation.stack([policy.prepare(policy.example_observation(seed) | {"prompt": prompt})])

    calls = [("a", 0, seen("go", 0)), ("a", 1, seen("go", 1)), ("b", 0, seen("go on", 2)), ("a", 2, seen("go", 3))]
    calls += [("b", 1, seen("go on", 4))]
    noise = torch.from_numpy(rng.standard_normal((5, 1, 16, model.config.action_dim), dtype=np.float32))
    alone, together = (Reusing(model, Reuse(what, value), compare=False) for _ in range(2))
    one_by_one = [
        alone.answer(observation, noise[i], 2, [episode], [number])
        for i, (episode, number, observation) in enumerate(calls)
    ]
    batches = []
    for rows in ([0], [1, 2], [3, 4]):
        joined = Observation.joined([calls[i][2] for i in rows])
        episodes, numbers = [calls[i][0] for i in rows], [calls[i][1] for i in rows]
        batches += list(together.answer(joined, noise[rows].flatten(0, 1), 2, episodes, numbers))
    assert 0 < sum(alone.shares) < 5 and alone.shares == together.shares
    for one, other in zip(one_by_one, batches, strict=True):
        torch.testing.assert_close(one[0], other, rtol=0, atol=1e-4)


def test_memory_of_episodes_that_ended_is_let_go(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nobody says which have ended: those that asked last are kept, all of the last batch. None keeps another's."""
    monkeypatch.setattr(kv_reuse, "MOST_REMEMBERED", 2)
    policy = UnifiedPolicy(CHASE_POLICY, backend="pytorch", precision="f32", device="cpu")
    reusing = Reusing(reference_model(policy.backend), Reuse("every", 2), compare=False)

    def ask(episodes: str, number: int) -> None:
        seen = Observation.stack([policy.prepare(policy.example_observation(0)) for _ in episodes])
        noise = torch.zeros(len(episodes), 16, policy.config.model.action_dim)
        reusing.answer(seen, noise, 1, list(episodes), [number] * len(episodes))

    ask("abc", 0)
    assert list(reusing.memory) == ["a", "b", "c"]
    ask("b", 1)
    assert list(reusing.memory) == ["c", "b"]
    ask("d", 0)
    assert list(reusing.memory) == ["b", "d"] and reusing.shares[-2:] == [1.0, 0.0]
    for tensor in vars(reusing.memory["b"]).values():
        assert tensor.untyped_storage().nbytes() == tensor.nbytes


def test_slots_that_are_masked_alone_make_the_unmasked_cache_another() -> None:
    """Each part of the padding counts, and under the mask none does."""
    policy, chunks = open_policy("chase"), {}
    for name in (*mask.CACHES, *mask.PARTS):
        caching = mask.Caching(policy, name)
        play(policy, range(2), caching)
        chunks[name] = caching.error
    assert chunks["compacted"] == 0 and chunks[mask.MASKED] < 1e-5
    assert min(chunks[name] for name in (mask.UNMASKED, *mask.PARTS)) > 0.01
    nothing_padded = mask.Caching(policy, mask.UNMASKED, padding=False)
    play(policy, range(2), nothing_padded)
    assert nothing_padded.error < 1e-5


def test_padding_is_what_the_policys_own_pipeline_adds() -> None:
    policy, world = open_policy("chase"), CHASE.start([(7, 0)])
    camera_images = world.draw(policy.config.planned_model.vision.image_size)[0]
    keys = ("observation/image", "observation/wrist_image")
    product = UnifiedPolicy(CHASE_POLICY, backend="pytorch", precision="f32", device="cpu")
    given = dict(zip(keys, camera_images, strict=True)) | {
        "observation/state": np.zeros(8),
        "prompt": CHASE.instruction,
    }
    served, ours = Observation.stack([product.prepare(given)]), mask.padded_as_served(policy, policy.observe(world))
    for name in ("images", "image_mask", "tokens", "token_mask"):
        assert torch.equal(getattr(served, name), getattr(ours, name)), name
