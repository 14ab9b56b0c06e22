"""Studies: their one form of report, and the machinery that answers: solvers, grids, closed loops, statistics."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import typer
from cli_helpers import check_help, refusal, text_of, turbopi
from matplotlib.figure import Figure
from msgspec.structs import replace
from torch import Tensor

from turbopi import UnifiedPolicy
from turbopi.evaluate.statistics import Paired, Rate
from turbopi.models.pi0.conditioning import Conditioning
from turbopi.policy.call_options import Denoising
from turbopi.policy.shipped import CHASE_POLICY
from turbopi.quantization.fp8 import Directions
from turbopi.quantization.nvfp4 import round_e2m1, round_nvfp4
from turbopi.quantization.sites import Site
from turbopi.sim.chase import SPEED as CHASE_SPEED
from turbopi.support.errors import ConfigError
from turbopi.support.reading import read_document
from turbopi_lab.command import command
from turbopi_lab.studies import (
    STUDIES,
    distillation,
    formats,
    fp4_products,
    fp8_and_fp4,
    kv_reuse,
    load,
    pipelining,
    post,
    report,
    solvers,
    steps,
)
from turbopi_lab.studies.report import Control, Grid, Report
from turbopi_lab.studies.rollouts import CHASE, Call, met, open_policy, play, sampled
from turbopi_lab.studies.spread import UNIFORM, bimodality
from turbopi_lab.studies.study import Setup

pytestmark = pytest.mark.usefixtures("unseen_plots")

BROKEN = Control("Two and two is four.", False, "It is five.")


@pytest.fixture(scope="module")
def small_steps(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the steps study in its small form."""
    folder = tmp_path_factory.mktemp("studies")
    result = turbopi("study", "steps", "--small", "--episodes", "4", "--device", "cpu", "--out", folder)
    assert result.exit_code == 0, result.output
    return folder / "steps"


# --- the command ------------------------------------------------------------------------------------------------------


def test_the_command_is_listed_and_its_help_is_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    listed = text_of(turbopi("--help").stdout)
    assert " study " in listed and "Of turbopi-lab 0.1.0" in listed
    assert text_of(turbopi("study", "--help").stdout).split("Examples ")[1].startswith("turbopi study steps --small")
    app = typer.Typer(add_completion=False)
    command.declare(app, "study")
    check_help(typer.main.get_command(app), "study")


# --- the report -------------------------------------------------------------------------------------------------------


def test_every_study_loads_under_its_name_and_asks_a_question() -> None:
    for name in STUDIES:
        study = load(name)
        assert study.name == name and study.question.endswith("?") and study.claimed


@pytest.mark.slow
def test_a_study_writes_a_report_that_reads_back_and_shows_every_part(small_steps: Path) -> None:
    found = read_document(small_steps / report.JSON, Report)
    text = (small_steps / report.MARKDOWN).read_text()
    assert found.small and found.sound and text == report.markdown(found)
    assert not any("nan" in control.evidence for control in found.controls)
    parts = [
        "**Claimed before.**",
        "**Method.**",
        "**Controls.**",
        "**Verdict.**",
        "**What would change it.**",
        "**Not run.**",
    ]
    assert [text.index(part) for part in parts] == sorted(text.index(part) for part in parts)
    assert all(
        table.title in text and all(len(row) == len(table.columns) for row in table.rows) for table in found.tables
    )
    assert all((small_steps / f"{plot.name}.png").is_file() for plot in found.plots)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["kv_reuse", "fp8_and_fp4", "pipelining", "noise_choice"])
def test_a_study_runs_in_its_small_form_and_its_controls_hold(name: str, tmp_path: Path) -> None:
    result = turbopi("study", name, "--small", "--device", "cpu", "--out", tmp_path)
    assert result.exit_code == 0, result.output
    found = read_document(tmp_path / name / report.JSON, Report)
    assert found.small and found.sound and len(found.controls) >= 2 and "small form" in report.markdown(found)


@pytest.mark.slow
def test_students_are_judged_beside_their_teacher(tmp_path: Path) -> None:
    given = ("study", "distillation", "--small", "--episodes", "4", "--device", "cpu", "--out", tmp_path)
    result = turbopi(*given, "--policy", f"chase.consistency={CHASE_POLICY}", "--policy", f"chase.mean={CHASE_POLICY}")
    assert result.exit_code == 0, result.output
    found = read_document(tmp_path / "distillation" / report.JSON, Report)
    (table,) = found.tables
    cells = [(row[0], row[1]) for row in table.rows]
    assert cells == [("teacher", 10), ("teacher", 1)] + [("consistency", n) for n in (1, 2, 10)] + [("mean", 1)]
    solved = {cell: row[2] for cell, row in zip(cells, table.rows, strict=True)}
    assert solved["consistency", 10] == solved["teacher", 10] and solved["mean", 1] == solved["teacher", 1]
    assert table.rows[3][-1] != 0 and table.rows[0][-1] == table.rows[4][-1] == 0
    assert "chase.shuffled: `python -m turbopi_lab.small_policy distill --recipe shuffled`" in found.not_run[0]
    for name in ("chase.magic", "other.mean"):
        said = refusal(turbopi(*given, "--policy", f"{name}={CHASE_POLICY}"))
        assert f"--policy {name} is no student" in said


def test_a_student_with_another_prefix_fails_the_control() -> None:
    policy = open_policy("chase")
    assert distillation.same_prefix([policy, open_policy("again")])
    other = open_policy("other")
    other.model.vlm.layers[0].self_attn.k_proj.weight.mul_(1.01)
    assert not distillation.same_prefix([policy, other])


def test_a_failed_control_voids_the_verdict_and_the_exit_code_says_so(
    small_steps: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    broken = replace(read_document(small_steps / report.JSON, Report), controls=[BROKEN])
    assert not broken.sound
    assert "A control failed. The verdict means nothing" in report.markdown(broken)
    assert "**FAILED**: Two and two is four. It is five." in report.markdown(broken)
    study = load("steps")
    monkeypatch.setattr(steps, "STUDY", type(study)(study.name, study.question, study.claimed, lambda setup: broken))
    result = turbopi("study", "steps", "--small", "--device", "cpu")
    assert result.exit_code == 1 and "control FAILED: Two and two is four." in result.stdout


def test_numbers_stand_on_the_right_and_what_is_missing_is_empty() -> None:
    table = Grid("t", ["name", "value"], [["a", 0.0012345], ["b", None], ["c", "+1.0 [-2.0, +3.0]"]])
    lines = ["| name | value |", "|---|--:|", "| a | 0.00123 |", "| b |  |", "| c | +1.0 [-2.0, +3.0] |"]
    assert report.table_lines(table) == lines


def test_cells_say_rates_and_differences_in_percent() -> None:
    assert report.rate_cells(Rate(9, 10).document) == ["9 of 10", "90.0 [59.6, 98.2]"]
    assert str(report.paired_cell(Paired(90, 6, 0, 4).document)).startswith("-6.0 [-11")


def test_plots_show_intervals(drawn: list[Figure], tmp_path: Path) -> None:
    series = report.Series("rate", [1.0, 2.0], [50.0, 60.0], [40.0, 55.0], [70.0, 65.0])
    report.draw(report.Plot("p", [report.Panel("t", "x", "y", [series])]), tmp_path / "p.png")
    (bars,) = drawn[0].axes[0].containers
    segments = np.array(bars.lines[2][0].get_segments())  # type: ignore[attr-defined]
    assert segments[:, :, 1].tolist() == [[40, 70], [55, 65]]


# --- solvers ----------------------------------------------------------------------------------------------------------


def test_no_cell_asks_for_a_velocity_at_the_end_where_none_was_trained() -> None:
    cells = [way for way in solvers.ways(small=False) if way.grid != "learned"]
    for way in cells:
        requested = solvers.integration(way.solver, solvers.grid_times(way, {}), way.evaluations)
        assert min(requested.evaluated) >= 0.03 and len(requested.evaluated) == way.evaluations, way
    assert len({*cells}) == len(cells)


def test_a_way_is_what_the_policys_options_of_the_same_names_are() -> None:
    policy, episodes = open_policy("chase"), range(3)
    product = UnifiedPolicy(CHASE_POLICY, backend="pytorch", precision="f32", device="cpu")
    for way, grid in (
        (solvers.Way("exponential", "uniform", 3), "uniform"),
        (solvers.Way("ab2", "shifted to actions", 3), "shifted_to_actions"),
    ):
        requested = Denoising(3).changed(3, way.solver, grid, ConfigError).integration  # type: ignore[arg-type]

        def by_option(call: Call, requested: Any = requested) -> Tensor:
            conditioning = Conditioning(integration=requested)
            return product.backend.sample(call.observation, call.noise, 3, conditioning=conditioning).actions

        one, other = (play(policy, episodes, actor).paths for actor in (steps.actor(policy, way, {}), by_option))
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-5)


def test_a_learned_grid_is_never_worse_and_stays_a_grid() -> None:
    wanted = [1.0, 0.9, 0.2]

    def error(times: solvers.Times) -> float:
        return sum((a - b) ** 2 for a, b in zip(times, wanted, strict=True))

    found = solvers.learn_times(error, solvers.begins("uniform", 3))
    assert error(found) < error(solvers.begins("uniform", 3)) / 2
    assert found[0] == 1 and found == sorted(found, reverse=True) and found[-1] > 0


# --- closed loop ------------------------------------------------------------------------------------------------------


def test_cells_are_paired_episode_by_episode() -> None:
    policy = open_policy("chase")

    def starts(episodes: range) -> tuple[np.ndarray, Tensor]:
        seen: list[Call] = []

        def still(call: Call) -> Tensor:
            seen.append(call)
            return torch.zeros_like(call.noise)

        play(policy, episodes, still)
        return np.asarray(seen[0].observation.images), seen[2].noise

    (few_images, few_noise), (camera_images, noise) = starts(range(2, 4)), starts(range(5))
    assert np.array_equal(few_images, camera_images[2:4]) and torch.equal(few_noise, noise[2:4])
    assert not torch.equal(noise[0], noise[1])


def test_decided_episodes_end_alike_whether_the_policy_is_still_asked_for_them() -> None:
    policy, episodes = open_policy("chase"), range(12)
    requested: list[int] = []

    def counting(call: Call) -> Tensor:
        requested.append(len(call.episodes))
        return sampled(policy.model, 3)(call)

    few = play(policy, episodes, counting)
    everyone = play(policy, episodes, sampled(policy.model, 3), everyone=True)
    assert np.array_equal(few.solved, everyone.solved) and np.array_equal(few.touched, everyone.touched)
    assert requested[0] == 12 and requested == sorted(requested, reverse=True) and requested[-1] < 6


def test_the_shipped_chase_policy_solves_what_chance_doesnt() -> None:
    policy, episodes = open_policy("chase"), range(16)
    assert policy.toy is CHASE
    solved = play(policy, episodes, steps.actor(policy, solvers.Way("euler", "uniform", 3), {})).rate.successes
    lost = play(policy, episodes, lambda call: call.noise).rate.successes
    assert solved >= 10 and lost <= 3


def test_the_post_is_between_the_tip_and_a_target_that_never_moves() -> None:
    world = post.start([(1, n) for n in range(50)])
    before = world.target
    cosines = (world.tip * before).sum(1) / np.linalg.norm(world.tip, axis=1) / np.linalg.norm(before, axis=1)
    assert (cosines < math.cos(math.pi - post.SPREAD / 2) + 1e-9).all()
    for _ in range(5):
        world.step(np.zeros((50, 2)))
    assert np.array_equal(world.target, before)


def test_the_controls_of_steps_fail_where_the_loop_isnt_the_models(monkeypatch: pytest.MonkeyPatch) -> None:
    policy = open_policy("chase")
    assert steps.loop_is_the_models(policy) < 1e-5
    true = solvers.solve
    monkeypatch.setattr(solvers, "solve", lambda model, cache, noise, *way: 0.99 * true(model, cache, noise, *way))
    assert steps.loop_is_the_models(policy) > 1e-3


def test_a_verdict_needs_an_interval() -> None:
    def cell(first: int, second: int, episodes: int) -> str:
        paired = Paired(episodes - first - second, first, second, 0).document
        return steps.SuccessCell("p", "euler", "uniform", False, 1, Rate(1, 2).document, paired, 0).verdict

    assert cell(20, 0, 200) == "worse" and cell(0, 0, 200) == "as good" and cell(0, 0, 20) == "open"


def test_reuse_that_is_a_little_worse_for_certain_is_not_named_as_good() -> None:
    def cell(value: float, lost: int) -> kv_reuse.ReuseCell:
        paired = Paired(10_000 - lost, lost, 0, 0).document  # both solved, the plain policy alone
        return kv_reuse.ReuseCell("toy", "full", value, Rate(10_000 - lost, 10_000).document, paired, value, value, 0.0)

    said = kv_reuse.verdict([cell(0.9, 200), cell(0.1, 0)])
    assert "toy: 1 of 2 cells are worse than no reuse; the fastest that is as good is full, θ = 0.1 (100.0%" in said
    assert kv_reuse.verdict([cell(0.9, 200)]).startswith("toy: 1 of 1 cells are worse than no reuse. ")


def test_the_bimodality_of_known_distributions() -> None:
    rng = np.random.default_rng(0)
    assert bimodality(rng.normal(size=20_000)) == pytest.approx(1 / 3, abs=0.02)
    assert bimodality(rng.uniform(size=20_000)) == pytest.approx(UNIFORM, abs=0.02)
    assert bimodality(np.where(rng.uniform(size=20_000) < 0.5, -1.0, 1.0)) > 0.98


@pytest.mark.parametrize(
    ("options", "why"),
    [
        (("--policy", "mine=/nonexistent"), "--policy is 'mine=/nonexistent', but there is no folder /nonexistent"),
        (("--policy", "mine=.", "--policy", "mine=/tmp"), "--policy mine was given twice, as . and /tmp"),
        (("--out", __file__), f"can't write into {__file__}"),
        (("--out", "OUT"), "report.json is there and isn't a report of `turbopi study`, so it isn't replaced"),
    ],
)
def test_what_a_study_could_not_use_is_refused_before_it_runs(
    options: tuple[str, ...], why: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "steps").mkdir()
    (tmp_path / "steps" / "report.json").write_text('{"frames": []}')
    options = tuple(str(tmp_path) if option == "OUT" else option for option in options)
    ran: list[Setup] = []
    study = load("steps")

    def run(setup: Setup) -> Any:
        ran.append(setup)

    monkeypatch.setattr(steps, "STUDY", type(study)(study.name, study.question, study.claimed, run))
    result = turbopi("study", "steps", "--small", "--device", "cpu", *options)
    assert result.exit_code == 2 and why in " ".join(result.stderr.split())
    assert ran == []


def test_a_study_of_checkpoints_says_what_it_lacks() -> None:
    with pytest.raises(Exception, match="the mask study needs weights"):
        load("mask").run(Setup())


# --- reuse of keys and values -----------------------------------------------------------------------------------------


@pytest.mark.slow
def test_nothing_reused_is_the_plain_run_and_everything_reused_is_the_first_call() -> None:
    policy, episodes = open_policy("chase"), range(3)
    plain = play(policy, episodes, sampled(policy.model, kv_reuse.STEPS)).paths
    for what in ("full", "camera", "patch"):
        never = kv_reuse.Reusing(policy.model, kv_reuse.Reuse(what, kv_reuse.NOTHING))
        assert np.array_equal(play(policy, episodes, never).paths, plain) and sum(never.shares) == 0
        always = kv_reuse.Reusing(policy.model, kv_reuse.Reuse(what, -1.0))
        assert not np.array_equal(play(policy, episodes, always).paths, plain)
        assert always.shares[:3] == [0.0] * 3 and set(always.shares[3:]) == {1.0}
        assert always.error > 0.1


@pytest.mark.slow
def test_forms_of_reuse_agree_where_all_or_nothing_is_old() -> None:
    """With everything old, each form leaves the keys and values of the first call."""
    policy, episodes = open_policy("chase"), range(3)
    forms = ("full", "camera", "patch")
    found = [play(policy, episodes, kv_reuse.Reusing(policy.model, kv_reuse.Reuse(what, -1.0))).paths for what in forms]
    every = play(policy, episodes, kv_reuse.Reusing(policy.model, kv_reuse.Reuse("every", 1000))).paths
    assert all(np.allclose(paths, every, atol=1e-4) for paths in found)


def test_another_episodes_memory_changes_what_is_done() -> None:
    policy, episodes, reuse = open_policy("chase"), range(3), kv_reuse.Reuse("every", 2)
    own, other = (play(policy, episodes, kv_reuse.Reusing(policy.model, reuse, roll)).paths for roll in (0, 1))
    assert np.array_equal(own[:6], other[:6]) and not np.array_equal(own[:11], other[:11])  # from the second call on


def test_work_is_saved_where_it_isnt_done() -> None:
    for what in ("full", "camera", "patch"):
        assert kv_reuse.speed_ups(kv_reuse.Reuse(what, 0.9), 0.0, 0.0) == pytest.approx((1, 1, 1))
    half = kv_reuse.speed_ups(kv_reuse.Reuse("every", 2), 0.5, 0.5)
    ms = kv_reuse.CALL_MS
    assert half[1] == pytest.approx(ms["total"] / (ms["total"] - (ms["vision"] + ms["prefix"]) / 2))
    patch, full = (kv_reuse.speed_ups(kv_reuse.Reuse(what, 0.9), 0.5, 0.2) for what in ("patch", "full"))
    assert patch[1] > full[1] > 1 and full[2] > full[1]


# --- numbers of four bits ---------------------------------------------------------------------------------------------


def test_mxfp4_is_e2m1_under_powers_of_two() -> None:
    x = torch.randn(8, 64, generator=torch.Generator().manual_seed(0))
    rounded = formats.round_mxfp4(x)
    blocks, exact = rounded.view(8, 2, 32), x.view(8, 2, 32)
    scale = 2.0 ** (torch.floor(torch.log2(exact.abs().amax(-1, keepdim=True))) - 2)
    assert torch.equal(round_e2m1(blocks / scale), blocks / scale)
    within = exact.abs() <= 6 * scale  # others are cut
    assert ((blocks - exact).abs() <= scale)[within].all() and torch.equal(formats.round_mxfp4(rounded), rounded)
    assert torch.equal(formats.round_mxfp4(torch.zeros(2, 32)), torch.zeros(2, 32))


def test_a_product_without_scales_is_nothing_and_with_unread_ones_is_most_of_it() -> None:
    found = {one.how: one.median for one in fp4_products.product_cosines(fp4_products.normal_matrices(1))}
    right = found["NVFP4, right"]
    assert abs(found[fp4_products.UNSCALED]) < 0.02 and 0.9 < found[fp4_products.UNREAD] < right and right > 0.99


def test_scales_in_the_tensor_cores_order_are_the_same_scales_elsewhere() -> None:
    x = torch.randn(128, 64, generator=torch.Generator().manual_seed(0)) * torch.arange(1, 129)[:, None]
    right, mixed = round_nvfp4(x), formats.nvfp4_with_swizzled_scales(x)
    assert not torch.equal(right, mixed)
    first = slice(0, 16)  # row 0's first block stays where it is: place 0
    assert torch.equal(right[0, first], mixed[0, first])
    few = x[:64]  # no whole tile: nothing to mix
    assert torch.equal(round_nvfp4(few), formats.nvfp4_with_swizzled_scales(few))


def test_four_bits_are_gone_after_the_block_and_activations_are_rounded_where_that_is_asked_for() -> None:
    policy = open_policy("chase")
    made = [met(policy, range(2), sampled(policy.model, 2), calls=1)]
    exact = policy.model.sample(*made[0], 2)
    chosen = fp8_and_fp4.cases(policy.model, made, made, 2)
    found = {}
    for name in ("NVFP4, weights alone", "W4A8", "NVFP4", fp8_and_fp4.WRONG):
        with chosen[name]():
            found[name] = float((policy.model.sample(*made[0], 2) - exact).norm())
    assert torch.equal(policy.model.sample(*made[0], 2), exact)
    assert 0 < found["NVFP4, weights alone"] != found["W4A8"] < found["NVFP4"] < found[fp8_and_fp4.WRONG]


def test_weights_are_rounded_once_for_all_formats_that_share_the_rounding_and_only_those_are_held() -> None:
    held = fp8_and_fp4.HeldWeights()
    requested: list[Directions | None] = []
    weight, site = torch.nn.Parameter(torch.ones(2, 32)), Site("expert", 0, "qkv", 32, 2)

    def rounding(weight: Tensor, directions: Directions | None) -> Tensor:
        requested.append(directions)
        return weight.detach() * 2

    first = held.rounded(weight, site, rounding, None)
    assert held.rounded(weight, site, rounding, None) is first and len(requested) == 1
    directions = Directions(torch.ones(32, 1), torch.ones(1), 0.1)
    common = {site: directions}
    assert held.rounded(weight, site, rounding, common) is not first and requested[-1] is directions
    assert held.rounded(weight, site, rounding, None) is not first and len(requested) == 3


def test_fewer_bits_are_read_sooner() -> None:
    for row in fp4_products.savings().rows:
        times = [float(cell) for cell in row[2:6] if isinstance(cell, float)]
        assert len(times) == 4 and times == sorted(times, reverse=True)


# --- pipelining -------------------------------------------------------------------------------------------------------


def test_overlapping_raises_the_rate_and_never_lowers_the_latency() -> None:
    for stage in (1, 2, 3):
        serial, ideal, slower = pipelining.timings(stage, stage)
        assert ideal.period < serial.period and ideal.latency == serial.latency <= slower.latency
        assert ideal.age < serial.age


def test_ages_are_counted_from_the_observation_behind_an_action() -> None:
    policy = open_policy("chase")
    _, ages = pipelining.play_late(
        policy, range(2), lambda call: torch.zeros_like(call.noise), pipelining.Timing("", latency=3, period=2)
    )
    assert ages[:9] == [0, 1, 2, 3, 4, 3, 4, 3, 4]
    assert ages[:5] == [0, 1, 2, 3, 4]  # the clock starts with a chunk; the next one comes 3 steps after step 2
    assert np.mean(ages[5:59]) == pipelining.Timing("", 3, 2).age


def test_a_late_chunk_goes_on_from_the_action_that_is_due() -> None:
    policy = open_policy("chase")

    def numbered(call: Call) -> Tensor:
        """A chunk whose i-th action is as long as 0.001 (100 call + i)."""
        chunk = torch.zeros_like(call.noise)
        chunk[..., 0] = 0.001 * (100 * call.number + torch.arange(chunk.shape[1]))
        return chunk

    played, _ = pipelining.play_late(policy, range(1), numbered, pipelining.Timing("", latency=2, period=4))
    moved = np.diff(played.paths[:, 0, 0]) / CHASE_SPEED
    due = [round(float(value * 1000)) for value in moved[:11]]
    assert due == [0, 1, 2, 3, 4, 5, 102, 103, 104, 105, 202]


def test_overlap_finds_actions_that_change_beside_others() -> None:
    class Policy:
        def __init__(self, off: float) -> None:
            self.off = off

        def infer(self, observation: object, *, seed: int) -> dict[str, np.ndarray]:
            return {"actions": np.full(3, seed + self.off)}

    assert pipelining.overlap([Policy(0.0), Policy(0.0)], None, 3).actions_equal_bit_for_bit
    assert not pipelining.overlap([Policy(0.0), Policy(1e-9)], None, 3).actions_equal_bit_for_bit
