"""Calibration: what it measures, what it chooses, what it writes, and everything it refuses."""

import dataclasses
import json
from contextlib import nullcontext
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from cli_helpers import refusal, turbopi
from conftest import golden_cases, golden_folder, golden_model
from file_helpers import no_room
from shared import TWO_LAYERS
from torch import nn

from turbopi import backends
from turbopi.backends import Precision
from turbopi.calibrate import run
from turbopi.calibrate.observations import read_examples, split
from turbopi.calibrate.run import Settings, by_harm, calibrate_model
from turbopi.calibrate.statistics import Histogram, collect
from turbopi.checkpoint import random_checkpoint
from turbopi.checkpoint.calibration import BESIDE, calibration_of, for_policy
from turbopi.cli.options import PolicyOptions
from turbopi.engine.emulate import Round, RoundedWeights, relative_rms, replaced, through_norm
from turbopi.models.observation import ModelInputs
from turbopi.models.pi0.layers import AdaRMSNorm
from turbopi.models.pi0.reference import Pi0Model
from turbopi.models.pi0.sites import linears
from turbopi.policy import shipped
from turbopi.policy.examples import Example, NoisyExample, with_noises
from turbopi.policy.policy import UnifiedPolicy
from turbopi.quantization.calibration_file import VERSION, Quantization, SiteScale, shapes_of
from turbopi.quantization.formats import FP8, OF_EIGHT_BITS, Format
from turbopi.quantization.fp8 import E4M3, E4M3_MAX, Directions
from turbopi.quantization.sites import PARTS, sites
from turbopi.recordings import RecordedCall, save_call
from turbopi.support.errors import (
    BackendUnavailable,
    CalibrationError,
    CheckpointError,
    ConfigError,
    ObservationError,
    OutputError,
)
from turbopi.verify.check_golden import check_case, golden_calibration, golden_calls
from turbopi.verify.inputs import VerifyPlan
from turbopi.verify.run import verify
from turbopi.verify.verdict import ACTIONS, Compared, Repetition, Rule, judge

pytestmark = pytest.mark.usefixtures("two_layers")

TINY = TWO_LAYERS.planned_model


@lru_cache
def tiny_policy() -> UnifiedPolicy:
    return UnifiedPolicy(random_checkpoint("pi05_tiny"), backend="pytorch", device="cpu", precision="f32")


def made_up(**more: Any) -> Quantization:
    """A calibration of pi05_tiny's shapes with made-up scales."""
    entries = {str(s): SiteScale(0.01, 4.0, 0.0, 0.03) for s in sites(TINY)}
    report = {"observations": {"source": "recordings"}, "warnings": []}
    fingerprint = random_checkpoint("pi05_tiny").fingerprint()
    return dataclasses.replace(Quantization(fingerprint, shapes_of(TINY), entries, report), **more)


# Sites and statistics


def test_every_product_has_a_site_and_the_last_prefix_layer_keys_and_values_alone() -> None:
    names = [str(site) for site in sites(TINY)]
    assert len(names) == len(set(names)) == 2 * 4 + 1 * 4 + 1 + 2 * 4
    assert [name for name in names if name.startswith("prefix.1")] == ["prefix.1.qkv"]


def test_a_site_of_odd_width_says_why_it_cannot() -> None:
    odd = dataclasses.replace(TINY, vision=dataclasses.replace(TINY.vision, mlp_dim=500))
    refusals = {str(site): site.refusal for site in sites(odd)}
    assert refusals["vision.0.fc2"] == "its input is 500 wide, not a multiple of 16"
    assert refusals["vision.0.fc1"] == "its output is 500 wide, not a multiple of 16"
    assert refusals["vision.0.qkv"] is None


def histogram_of(x: torch.Tensor, format: Format = FP8) -> Histogram:
    bins = torch.bincount(x.abs().view(torch.int32) >> 16, minlength=0x8000)
    return Histogram(bins[:0x7F80].double(), float(x.abs().max()), format)


@pytest.mark.parametrize("format", OF_EIGHT_BITS.values(), ids=OF_EIGHT_BITS)
@pytest.mark.parametrize("scale", [1.0, 0.01, 0.0037, 1e-3])
def test_a_histogram_knows_the_error_of_rounding(scale: float, format: Format) -> None:
    x = torch.randn(200_000, generator=torch.Generator().manual_seed(0))
    scale *= E4M3_MAX / format.largest
    exact = format.held(x, scale)
    error, beyond = histogram_of(x, format).error(scale)
    assert error == pytest.approx(float((exact - x).norm() / x.norm()), rel=0.03)
    assert beyond == pytest.approx(float((x.abs() > format.largest * scale).float().mean()), abs=0.003)


def test_histograms_add_up() -> None:
    x, y = torch.randn(1000, generator=torch.Generator().manual_seed(0)), torch.linspace(0.1, 7, 100)
    both, whole = histogram_of(x).with_counts_of(histogram_of(y)), histogram_of(torch.cat((x, y)))
    assert both.largest == whole.largest == 7
    assert both.error(0.01) == whole.error(0.01) and both.percentile(50) == whole.percentile(50)


def test_sites_are_chosen_on_calls_that_gave_no_directions() -> None:
    case = golden_cases()["b_third_masked"]
    many = golden_calls(case) * 20
    for count, of_these in ((20, 8), (7, 3), (2, 1)):
        given = [dataclasses.replace(call, seed=i) for i, call in enumerate(many[:count])]
        others, chosen = run._apart(given)
        assert len(chosen) == of_these and {c.seed for c in others} | {c.seed for c in chosen} == set(range(count))
        assert len(others) + len(chosen) == count
    assert run._apart(many[:1]) == (many[:1], many[:1])


def test_the_ways_to_choose_a_scale() -> None:
    x = torch.randn(200_000, generator=torch.Generator().manual_seed(0))
    x[0] = 500.0
    histogram = histogram_of(x)
    assert histogram.scale("max") == pytest.approx(500 / E4M3_MAX)
    assert histogram.scale("headroom") == pytest.approx(1000 / E4M3_MAX)
    assert 3.5 < histogram.scale("percentile") * E4M3_MAX < 4.5
    least = histogram.error(histogram.scale("mse"))[0]
    assert all(least <= histogram.error(histogram.scale(m))[0] for m in ("max", "headroom", "percentile"))
    assert histogram_of(torch.zeros(10)).scale("mse") == 1


def test_statistics_see_every_step_and_the_largest_value() -> None:
    model, case = golden_model("pi05"), golden_cases()["b_third_masked"]
    seen: list[torch.Tensor] = []
    handle = model.expert.layers[1].mlp.down_proj.register_forward_pre_hook(lambda _, x: seen.append(x[0].clone()))
    found = collect(model, sites(model.config), [(case.observation, case.noise)], 3)
    handle.remove()
    assert len(seen) == 3
    assert found["expert.1.down"].largest == float(torch.cat(seen).abs().max())
    assert set(found) == {str(site) for site in sites(model.config)}


def test_the_stream_is_watched_before_its_rms_and_shift() -> None:
    model, case = golden_model("pi05"), golden_cases()["b_third_masked"]
    norm = model.expert.layers[1].post_attention_layernorm
    assert isinstance(norm, AdaRMSNorm)
    largest = 0.0

    def watch(norm: Any, given: Any) -> None:
        nonlocal largest
        scale, _, _ = norm.modulation(given[1])
        largest = max(largest, float((given[0] * (1 + scale)).abs().max()))

    handle = norm.register_forward_pre_hook(watch)
    found = collect(model, sites(model.config), [(case.observation, case.noise)], 3)
    handle.remove()
    assert found["expert.1.gate_up"].largest == largest > 0


def test_a_norm_of_rounded_numbers_divides_and_shifts_behind_the_rounding() -> None:
    norm = AdaRMSNorm(32, 1e-6)
    generator = torch.Generator().manual_seed(0)
    x, cond = torch.randn(1, 5, 32, generator=generator) * 3, torch.randn(1, 32, generator=generator)
    with torch.no_grad():
        torch.testing.assert_close(through_norm(norm, lambda x: x, x, cond), norm(x, cond))
        scale, shift, _ = norm.modulation(cond)
        rounded, _ = through_norm(norm, lambda x: x.round(), x, cond)
        expected = (x * (1 + scale)).round() / (x.square().mean(-1, keepdim=True) + 1e-6).sqrt() + shift
        torch.testing.assert_close(rounded, expected)


def test_values_that_are_not_finite_are_refused_by_site() -> None:
    model, case = golden_model("pi05"), golden_cases()["b_third_masked"]
    noise = case.noise.clone()
    noise[0, 0, 0] = torch.nan
    with pytest.raises(ObservationError, match=r"expert\.0\.qkv sees values that aren't finite"):
        collect(model, sites(model.config), [(case.observation, noise)], 1)


# What is chosen


@pytest.mark.slow
def test_sites_stay_in_bf16_until_the_target_is_met() -> None:
    model, case = golden_model("pi05"), golden_cases()["b_third_masked"]
    own = golden_calls(case)

    def measured(target: float) -> Any:
        return calibrate_model(model, own, own, 1, Settings({}, target=target, batch=1, methods=("headroom",)))

    loose, tight = measured(0.0), measured(0.9999)
    assert all(site.kept is None for site in loose.sites.values())
    kept = {name.split(".")[0] + "." + name.split(".")[2] for name, site in tight.sites.items() if site.kept}
    assert kept and kept != {f"{s.part}.{s.kind}" for s in sites(model.config)}
    assert tight.report["held_out"]["fp8"]["delta_cosine"] > loose.report["held_out"]["fp8"]["delta_cosine"]
    assert tight.report["target_reached"] == (tight.report["held_out"]["fp8"]["delta_cosine"] >= 0.9999)
    held = loose.report["held_out"]
    assert held["bf16"]["relative_rms"] < held["fp8-mlp"]["relative_rms"] < held["fp8"]["relative_rms"] < 0.3
    assert held["worst"]["observation"] == "b_third_masked 0"
    assert all(0.0005 < site.error < 0.04 for site in loose.sites.values())
    assert all((site.directions is None) == (site.kept is not None) for site in tight.sites.values())
    assert set(loose.report["groups_alone"]) == {site.group for site in sites(model.config)}


def test_actions_without_a_signal_are_not_calibrated_on(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where nothing varies every cosine is right, or NaN, which is below no target."""
    monkeypatch.setattr(Pi0Model, "sample", lambda model, observation, noise, *args, **options: noise.clone())
    model, own = golden_model("pi05"), golden_calls(golden_cases()["b_third_masked"])
    with pytest.raises(CheckpointError, match="nothing to judge: the float32 reference's actions"):
        run._Trials(model, own, 1, 1, run.Progress(), RoundedWeights())


@pytest.mark.slow
def test_directions_more_than_halve_the_error(monkeypatch: pytest.MonkeyPatch) -> None:
    model, case = golden_model("pi05"), golden_cases()["b_third_masked"]
    settings, errors = Settings({}, target=0.0, batch=1, methods=("headroom",)), []
    for find in (run.directions, lambda rows: None):
        monkeypatch.setattr(run, "directions", find)
        found = calibrate_model(model, golden_calls(case), golden_calls(case), 1, settings)
        errors.append(found.report["held_out"])
    for name in ("fp8-mlp", "fp8 in the prefix alone"):
        assert errors[0][name]["relative_rms"] < 0.5 * errors[1][name]["relative_rms"], name
    for name in ("fp8", "fp8 in the expert alone"):  # there what activations lose is as much as what weights lost
        assert errors[0][name]["relative_rms"] < 0.8 * errors[1][name]["relative_rms"], name


@pytest.mark.slow
@pytest.mark.parametrize("parts", [("expert",), PARTS])
def test_directions_more_than_halve_what_weights_alone_lose(parts: tuple[str, ...]) -> None:
    model, case = golden_model("pi05"), golden_cases()["b_third_masked"]
    settings = Settings({}, target=0.0, batch=1, methods=("headroom",))
    entries = calibrate_model(model, golden_calls(case), golden_calls(case), 1, settings).sites
    rounded = [site for site in sites(model.config) if site.part in parts]
    exact, errors = model.sample(case.observation, case.noise, 1), []
    for common in ({site: one for site in rounded if (one := entries[str(site)].directions) is not None}, {}):
        weights = RoundedWeights(common)
        changes: list[tuple[nn.Linear, Round, Round]] = [
            (linear, lambda x: x, partial(weights, site)) for site in rounded for linear in linears(model, site)
        ]
        with replaced(changes):
            errors.append(relative_rms(model.sample(case.observation, case.noise, 1), exact))
    assert errors[0] < 0.5 * errors[1]


def test_the_expert_is_weighed_as_the_whole_that_it_goes_as() -> None:
    # its out alone hurts more for its work than vision's fc2; all of it less
    rms = {"vision.out": 0.04, "vision.fc2": 0.024, "expert.out": 0.018, "expert.gate_up": 0.013, "prefix.down": 0.008}
    work = {"vision.out": 36, "vision.fc2": 134, "expert.out": 38, "expert.gate_up": 273, "prefix.down": 570}
    expert = ("expert.out", "expert.gate_up")
    assert by_harm(rms, work) == [("vision.out",), ("vision.fc2",), expert, ("prefix.down",)]


@pytest.mark.slow
def test_saturation_is_told_and_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("turbopi.calibrate.statistics.PERCENTILE", 90.0)  # a tenth of the values is beyond
    model, own = golden_model("pi05"), golden_calls(golden_cases()["b_third_masked"])
    settings = Settings({}, target=0.0, batch=1, methods=("percentile",))
    found = calibrate_model(model, own, own, 1, settings)
    reported = [warning for warning in found.report["warnings"] if "of vision.0.qkv saturate" in warning]
    assert len(reported) == 1 and 0.05 < found.sites["vision.0.qkv"].saturated < 0.15
    assert any("of expert.0.down saturate" in warning for warning in found.report["warnings"])
    settings = dataclasses.replace(settings, methods=("headroom",))
    assert not [w for w in calibrate_model(model, own, own, 1, settings).report["warnings"] if "saturate" in w]


# Observations


def test_random_noise_has_to_be_asked_for_and_is_told() -> None:
    described, samples = read_examples(tiny_policy(), "random-noise", 3)
    assert described == "random-noise" and len(samples) == 3
    noisy = made_up(report={"observations": {"source": described}, "warnings": []})
    assert "random noise" in noisy.warnings[0]
    assert made_up().warnings == []


def test_every_fourth_observation_is_held_out() -> None:
    _, samples = read_examples(tiny_policy(), None, 6)
    chosen, held = split(samples)
    assert [sample.source for sample in held] == ["LIBERO frame 3"]
    assert len(chosen) == 5
    assert [sample.source for sample in split(samples[:2])[1]] == ["LIBERO frame 1"]
    made = with_noises(samples, (10, 32), 2, 5)
    assert [call.seed for call in made] == list(range(5, 17))
    expected = np.random.default_rng(7).standard_normal((1, 10, 32), dtype=np.float32)
    np.testing.assert_array_equal(made[2].noise.numpy(), expected)


def test_a_recording_is_read_and_what_cannot_be_used_is_named(tmp_path: Path) -> None:
    for number in range(3):
        observation = tiny_policy().example_observation(number)
        save_call(tmp_path / f"{number:06d}.npz", RecordedCall(observation, {"actions": np.zeros((10, 7))}, 0.0))
    _, samples = read_examples(tiny_policy(), str(tmp_path), 64)
    assert [sample.source for sample in samples] == ["000000.npz", "000001.npz", "000002.npz"]
    assert len({sample.sha256 for sample in samples}) == 3
    observation["observation/state"] = np.full(8, np.nan)
    save_call(tmp_path / "000002.npz", RecordedCall(observation, {"actions": np.zeros((10, 7))}, 0.0))
    with pytest.raises(ObservationError, match=r"^000002\.npz: .*finite"):
        read_examples(tiny_policy(), str(tmp_path), 64)
    with pytest.raises(ObservationError, match="needs two observations or more"):
        read_examples(tiny_policy(), str(tmp_path / "000000.npz"), 64)
    (tmp_path / "empty").mkdir()
    with pytest.raises(ObservationError, match="holds no recording"):
        read_examples(tiny_policy(), str(tmp_path / "empty"), 64)
    with pytest.raises(ObservationError, match="doesn't exist"):
        read_examples(tiny_policy(), str(tmp_path / "nowhere"), 64)


# The file


def test_a_full_disk_keeps_the_earlier_calibration(tmp_path: Path) -> None:
    file = tmp_path / "q.json"
    made_up().save(file)
    before = file.read_bytes()
    with no_room(100), pytest.raises(OutputError, match=f"can't write {file}: File too large; make room"):
        made_up().save(file)
    assert file.read_bytes() == before and list(tmp_path.iterdir()) == [file]


def test_a_file_comes_back_as_it_was(tmp_path: Path) -> None:
    made_up().save(tmp_path / "q.json")
    back = Quantization.load(tmp_path / "q.json")
    assert back == made_up()
    back.check(TINY, random_checkpoint("pi05_tiny").fingerprint())


WRONG_SITES: tuple[tuple[dict[str, Any], str], ...] = (
    ({"scale": 1e300}, "the scale 1e[+]300 should be a number from"),
    ({"scale": True}, "the scale True should be"),
    ({"scale": 10**400}, "isn't a calibration that"),
    ({"kept": False}, "the reason kept False should be"),
    ({"largest": None}, "largest None should be a number"),
    ({"directions": {"e4m3": "AAAA", "scale": [], "rest": 1.0}}, "isn't a calibration that"),
    ({"directions": {"e4m3": "AAAA", "scale": [1.0, 1.0], "rest": 1.0}}, "isn't a calibration that"),
)


def test_other_weights_shapes_and_versions_are_refused(tmp_path: Path) -> None:
    file = tmp_path / "q.json"
    made_up().save(file)
    calibration = Quantization.load(file)
    with pytest.raises(CalibrationError, match=r"q\.json was made for other weights: their hash is .*calibrate"):
        calibration.check(TINY, random_checkpoint("pi05_tiny", 1).fingerprint())
    wider = dataclasses.replace(TINY, expert=dataclasses.replace(TINY.expert, mlp_dim=512))
    with pytest.raises(CalibrationError, match=r"other shapes: expert\.mlp_dim is 256 there and 512 here\. Run"):
        calibration.check(wider, calibration.fingerprint)
    content = json.loads(file.read_text())
    site = content["sites"]["vision.0.qkv"]
    for change, message in (
        ({"version": VERSION + 1}, "this Turbo-Pi reads version"),
        ({"format": "something"}, "is 'something', not turbopi-quantization"),
        ({"sites": {"vision.0.qkv": {"scale": -1, "largest": 1, "saturated": 0, "error": 0}}}, "the scale -1"),
        ({"sites": {"vision.0.qkv": {"size": 1}}}, "isn't a calibration that"),
        ({"sites": []}, "sites .* should be an object"),
        ({"sites": {"vision.0.qkv": None}}, "the site None should be an object"),
        ({"shapes": [1]}, "shapes .* should be an object"),
        ({"report": {}}, "KeyError"),
        ({"report": None}, "report None should be an object"),
        (
            {"report": {"observations": {"source": "x"}, "warnings": "hello"}},
            "warnings 'hello' should be a list of texts",
        ),
        ({"weights_sha256": 5}, "weights_sha256 5 should be text"),
        *(({"sites": {"vision.0.qkv": site | change}}, message) for change, message in WRONG_SITES),
    ):
        file.write_text(json.dumps(content | change))
        with pytest.raises(CalibrationError, match=message):
            Quantization.load(file)
    file.write_text("[" * 100_000)
    with pytest.raises(CalibrationError, match="isn't a calibration that"):
        Quantization.load(file)
    file.write_text("{")
    with pytest.raises(CalibrationError, match="isn't a calibration that"):
        Quantization.load(file)
    with pytest.raises(CalibrationError, match="there is no file"):
        Quantization.load(tmp_path / "nothing.json")


def test_a_calibration_that_leaves_nothing_in_fp8_is_refused(tmp_path: Path) -> None:
    checkpoint, calibration = random_checkpoint("pi05_tiny"), made_up()
    kept = {name: dataclasses.replace(site, kept="it hurts") for name, site in calibration.sites.items()}
    with pytest.raises(ConfigError, match=r"leaves nothing in fp8 \(\d+ sites: it hurts\); take 'bf16'"):
        calibration_of(dataclasses.replace(calibration, sites=kept), "fp8", checkpoint)
    with pytest.raises(ConfigError, match=r"leaves nothing in fp8-mlp \(.*sites: fp8-mlp takes the feed-forward"):
        calibration_of(calibration.only(["expert"]), "fp8-mlp", checkpoint)


def test_a_policy_finds_the_file_beside_its_weights(tmp_path: Path) -> None:
    checkpoint = dataclasses.replace(random_checkpoint("pi05_tiny"), path=tmp_path)
    assert for_policy(None, "bf16", checkpoint) is None
    with pytest.raises(ConfigError, match="needs a calibration: run `turbopi calibrate --precision fp8`"):
        for_policy(None, "fp8", checkpoint)
    made_up().save(tmp_path / BESIDE["fp8"])
    found = for_policy(None, "fp8", checkpoint)
    assert found is not None and found.source == str(tmp_path / BESIDE["fp8"])
    with pytest.raises(CalibrationError, match="other weights"):
        for_policy(made_up(fingerprint="0" * 64), "fp8", checkpoint)


def test_warnings_are_logged_wherever_a_policy_is_made(caplog: pytest.LogCaptureFixture) -> None:
    noisy = made_up(report={"observations": {"source": "random-noise"}, "warnings": ["2 % of x saturate"]})
    for_policy(noisy, "fp8", random_checkpoint("pi05_tiny"))
    assert "calibrated on random noise" in caplog.text and "2 % of x saturate" in caplog.text


def common(width: int) -> Directions:
    return Directions(torch.arange(2 * width).view(width, 2).fmod(100).to(E4M3), torch.tensor([0.5, 0.001]), 0.25)


def test_directions_are_read_as_they_were_written(tmp_path: Path) -> None:
    plain, file = made_up(), tmp_path / "fp8.json"
    width = {str(s): s.width for s in sites(TINY)}
    entries = {n: dataclasses.replace(e, directions=common(width[n])) for n, e in plain.sites.items()}
    whole = made_up(sites=entries)
    whole.save(file)
    read = Quantization.load(file)
    assert read.identity == whole.identity != plain.identity
    plan = read.plan(TINY, "fp8")
    assert set(plan.directions) == set(plan.scales)
    assert read.describe(plan)["weights"].startswith(f"{len(plan.scales)} of {len(plan.scales)} sites' rounded")
    ours, theirs = plan.directions["expert.0.down"], entries["expert.0.down"].directions
    assert theirs is not None and torch.equal(ours.main, theirs.main) and ours.rest == theirs.rest
    assert not read.only(["prefix"]).plan(TINY, "fp8").directions.keys() & {"vision.0.qkv", "expert.0.qkv"}
    assert "e4m3" not in json.dumps(whole.as_json(directions=False))

    content = json.loads(file.read_text())
    content["sites"]["vision.0.qkv"]["directions"]["rest"] = float("nan")
    file.write_text(json.dumps(content))
    with pytest.raises(CalibrationError, match="directions that aren't finite"):
        Quantization.load(file)
    entries["vision.0.fc1"] = dataclasses.replace(entries["vision.0.fc1"], directions=common(7))
    with pytest.raises(CalibrationError, match=r"directions of 7 numbers for vision\.0\.fc1, which is \d+ wide"):
        made_up(sites=entries).check(TINY, plain.fingerprint)


def test_files_of_versions_1_and_2_round_to_nearest_and_leave_the_expert_in_bf16(tmp_path: Path) -> None:
    for version in (1, 2):
        content = made_up().as_json() | {"version": version}
        for name, entry in content["sites"].items():
            if version == 1:
                del entry["directions"]
            if name.startswith("expert."):
                entry["scale"] = None
        (tmp_path / "old.json").write_text(json.dumps(content))
        old = Quantization.load(tmp_path / "old.json")
        plan = old.plan(TINY, "fp8")
        assert ["expert stays in bf16: run it again" in warning for warning in old.warnings] == [True]
        assert not plan.directions and plan.expert == "bf16"
        assert {name.split(".")[0] for name in plan.scales} == {"vision", "prefix"}
        assert "run `turbopi calibrate` again" in plan.kept["expert.0.qkv"]


# The plan


def test_a_file_for_int8_says_so_and_one_for_fp8_is_read_by_older_turbo_pis(tmp_path: Path) -> None:
    fp8, int8 = made_up(), made_up(numbers="int8")
    assert fp8.as_json()["version"] == 3 and "numbers" not in fp8.as_json()
    int8.save(tmp_path / "q.json")
    read = Quantization.load(tmp_path / "q.json")
    assert read == int8 and read.identity == int8.identity != fp8.identity
    plan = read.plan(TINY, "int8")
    assert plan.expert == "int8" and plan.kept.keys() == {"prefix.1.qkv"} and "no NaN" in plan.kept["prefix.1.qkv"]
    assert not fp8.plan(TINY, "fp8").kept, "whose NaN stays one"
    vision = read.only(["vision"]).plan(TINY, "int8")
    assert vision.kept["prefix.0.qkv"] == "INT8 is switched off in the prefix" and vision.expert == "bf16"
    without = plan.without_expert("as I say")
    assert plan.expert == "int8" and without.expert == "bf16" and without.kept["expert.0.qkv"] == "as I say"
    assert without.scales.keys() == {site for site in plan.scales if not site.startswith("expert.")}
    for numbers in ("int4", 8):
        (tmp_path / "q.json").write_text(json.dumps(int8.as_json() | {"numbers": numbers}))
        with pytest.raises(CalibrationError, match=r"numbers .* should be one of fp8, int8"):
            Quantization.load(tmp_path / "q.json")


def test_each_precision_finds_its_own_file_beside_the_weights(tmp_path: Path) -> None:
    checkpoint = dataclasses.replace(random_checkpoint("pi05_tiny"), path=tmp_path)
    made_up().save(tmp_path / BESIDE["fp8"])
    with pytest.raises(ConfigError, match=r"run `turbopi calibrate --precision int8` .* as turbopi_int8\.json beside"):
        for_policy(None, "int8", checkpoint)
    made_up(numbers="int8").save(tmp_path / BESIDE["int8"])
    found = for_policy(None, "int8", checkpoint)
    assert found is not None and found.numbers == "int8"


def test_float16_sums_need_a_calibration_that_measured_and_allows_them() -> None:
    with pytest.raises(ConfigError, match="is older than fp8-f16sums; run `turbopi calibrate` again or take 'fp8'"):
        made_up().plan(TINY, "fp8-f16sums")
    for rms, cosine, allowed in ((0.14, 0.99, True), (0.2, 0.998, True), (0.2, 0.99, False)):
        held = {"fp8": {"relative_rms": 0.1}, "fp8-f16sums": {"relative_rms": rms, "delta_cosine": cosine}}
        found = made_up(report={"held_out": held, "target": 0.9975})
        with nullcontext() if allowed else pytest.raises(ConfigError, match="is beyond 0"):
            assert found.plan(TINY, "fp8-f16sums").scales == found.plan(TINY, "fp8").scales
    right = {"relative_rms": 0.1, "delta_cosine": 0.999}
    given: Any = {"held_out": {"fp8": right, "fp8-f16sums": right}, "target": 0.9975}
    with pytest.raises(ConfigError, match="nothing of vision and prefix is left in fp8-f16sums: take 'fp8'"):
        made_up(report=given).only(["expert"]).plan(TINY, "fp8-f16sums")
    damaged: list[tuple[Any, Any]] = [("x", 0.9975), ({"fp8-f16sums": right}, 0.9975), (given["held_out"], None)]
    halves: list[Any] = [[], {}, "x", None, {**right, "delta_cosine": "x"}]
    damaged += [({"fp8": right, "fp8-f16sums": half}, 0.9975) for half in halves]
    for report, target in damaged:
        with pytest.raises(CalibrationError, match="doesn't say what fp8-f16sums costs: its report is damaged"):
            made_up(report={"held_out": report, "target": target}).plan(TINY, "fp8-f16sums")


def test_tiers_and_parts_choose_sites_and_say_why_not() -> None:
    whole = made_up().plan(TINY, "fp8")
    assert len(whole.scales) == len(sites(TINY)) and not whole.kept
    assert whole.expert == "fp8"
    mlp = made_up().plan(TINY, "fp8-mlp")
    assert {name.split(".")[2] for name in mlp.scales} == {"fc1", "fc2", "gate_up", "down"}
    assert mlp.expert == "bf16"
    assert "feed-forward" in mlp.kept["vision.0.qkv"]
    one_kept = dict(made_up().sites)
    one_kept["expert.1.out"] = dataclasses.replace(one_kept["expert.1.out"], kept="it hurts")
    assert made_up(sites=one_kept).plan(TINY, "fp8").expert == "bf16"  # the kernel takes all of them or none
    vision = made_up().only(["vision"]).plan(TINY, "fp8")
    assert {name.split(".")[0] for name in vision.scales} == {"vision"}
    assert vision.kept["prefix.0.qkv"] == "FP8 is switched off in the prefix"
    with pytest.raises(ConfigError, match="unknown part 'head'"):
        made_up().only(["head"])
    with pytest.raises(ConfigError, match="is no calibrated precision"):
        made_up().plan(TINY, "bf16")


def test_a_kept_site_is_described_with_its_reason() -> None:
    entries = dict(made_up().sites)
    entries["vision.1.fc1"] = dataclasses.replace(entries["vision.1.fc1"], kept="it hurts")
    described = made_up(sites=entries).plan(TINY, "fp8").describe()
    assert described["vision.fc1"] == {"fp8": "layers 0", "bf16: it hurts": "layers 1"}
    assert described["vision.fc2"] == "fp8"


# Backends and verdicts


@pytest.mark.parametrize(
    ("precision", "capability", "reason"),
    [
        *(("fp8", (8, 0), "from compute capability 8.9 on; this GPU has 8.0"), ("fp8", (8, 7), "8.7")),
        *(("fp8", (8, 9), ""), ("fp8", (12, 0), ""), ("fp8-f16sums", (8, 9), ""), ("fp8-f16sums", (12, 0), "")),
        *(
            ("fp8-f16sums", (8, 6), "8.6; take precision 'bf16' or 'int8'"),
            ("fp8-f16sums", (10, 0), "10.0; take .*'fp8'"),
        ),
        ("fp8-f16sums", (9, 0), "TURBOPI_KERNELS=portable .*; take precision 'bf16' or 'fp8' or 'int8'"),
    ],
)
def test_gpus_whose_tensor_cores_have_no_fp8_or_gain_nothing_are_refused(
    precision: Precision, capability: tuple[int, int], reason: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    from turbopi.backends.fused import FusedBackend

    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda device: capability)
    monkeypatch.setattr(FusedBackend, "unavailable", classmethod(lambda cls, device: None))
    refused = pytest.raises(BackendUnavailable, match=rf"can't run in {precision} on cuda:0: .*{reason}")
    with refused if reason else nullcontext():
        backends.check("fused", torch.device("cuda", 0), precision)
    backends.check("fused", torch.device("cuda", 0), "bf16")


def test_fp8_without_a_calibration_and_the_reverse_are_refused() -> None:
    from turbopi.backends.fused import FusedBackend

    def load(to: Any, precision: str) -> dict[str, torch.Tensor]:
        raise AssertionError("nothing should be loaded")

    device = torch.device("cpu")
    with pytest.raises(ConfigError, match="precision 'fp8' needs a calibration"):
        FusedBackend(TINY, load, device=device, precision="fp8")
    with pytest.raises(ConfigError, match="precision 'bf16' takes no calibration"):
        FusedBackend(TINY, load, device=device, precision="bf16", quantization=made_up())


def test_other_backends_have_no_fp8() -> None:
    with pytest.raises(ConfigError, match="backend 'pytorch' doesn't run in 'fp8': only bf16 or f32"):
        backends.check("pytorch", torch.device("cpu"), "fp8")
    assert backends.choose(torch.device("cpu"), "fp8")[0] == "fused"


def test_fp8_is_held_to_the_cosine_that_calibration_aims_at() -> None:
    rule = Rule.of("fused", "fp8")
    assert rule.limit(control=0.004) == pytest.approx(0.0707)
    assert rule.allowed("fp8", control=0.002) == pytest.approx(0.064)
    assert Rule.of("fused", "fp8-mlp", bound=0.02).limit(control=1.0) == 0.02
    assert rule.cosine == 0.9975
    assert Rule.of("fused", "fp8", bound=0.02).cosine is None and Rule.of("fused", "bf16").cosine is None


@pytest.mark.parametrize(("off", "passes"), [(0.06, True), (0.08, False)])
def test_fp8_is_held_to_what_denoising_did_where_the_noise_hides_it(off: float, passes: bool) -> None:
    """Actions that are nearly the noise they began from: their own error says little."""
    rng = np.random.default_rng(0)
    noise = rng.standard_normal((1, 10, 32)).astype(np.float32)
    did, wrong = (0.1 * rng.standard_normal((2, 10, 32))).astype(np.float32)
    inputs = ModelInputs(np.zeros(1), np.ones(1, bool), np.zeros(1), np.ones(1, bool), np.zeros(1))
    call = NoisyExample(0, Example("one", inputs, np.zeros(8)), 0, torch.from_numpy(noise), first=True)
    compared = Compared()
    exact, ours = {ACTIONS: noise[0] + did}, {ACTIONS: noise[0] + did + off * wrong}
    compared.add(call, ours, exact, ours[ACTIONS], exact[ACTIONS])
    checks = judge(Rule.of("fused", "fp8"), "fp8", "plain", compared, compared, Repetition()).checks
    assert [check.ok for check in checks if check.name == "actions"] == [True]
    assert [check.ok for check in checks if check.name == "deltas"] == [passes]


# Identity


def test_a_calibration_is_told_by_what_it_decides_alone() -> None:
    one = made_up()
    name = "prefix.0.down"
    assert made_up(source="elsewhere", report={**one.report, "warnings": ["w"]}).identity == one.identity
    others = [
        dataclasses.replace(one, sites={**one.sites, name: dataclasses.replace(one.sites[name], scale=0.02)}),
        dataclasses.replace(one, sites={**one.sites, name: dataclasses.replace(one.sites[name], kept="hurts")}),
        one.only(["prefix"]),
        dataclasses.replace(one, fingerprint="0" * 64),
    ]
    assert len({other.identity for other in (one, *others)}) == 5


def test_a_file_keeps_its_identity(tmp_path: Path) -> None:
    made_up().save(tmp_path / "fp8.json")
    assert Quantization.load(tmp_path / "fp8.json").identity == made_up().identity


# Formats without kernels


@pytest.mark.slow
def test_golden_cases_calibrate_themselves_and_hold_fp8_to_its_cosine() -> None:
    calibration = golden_calibration(golden_folder(), "pi0", torch.device("cpu"), 0.0)
    assert calibration.report["observations"]["source"] == "the golden cases themselves"
    calibration.check(
        golden_folder().checkpoint("pi0").config.planned_model, golden_folder().checkpoint("pi0").fingerprint()
    )
    case = golden_cases()["p0_pi0_state"]
    checkpoint = golden_folder().checkpoint("pi0")
    runner = backends.create(
        "pytorch",
        checkpoint.config.planned_model,
        lambda to, mode: checkpoint.load(to, mode).state,
        device=torch.device("cpu"),
        precision="bf16",
    )
    runner.precision = "fp8"  # what is judged is another backend's; its rule is what is tested
    judged = [one for one in check_case(case, runner) if one.ok is not None]
    assert [(one.tensor, one.precision, one.ok) for one in judged] == [("actions", "fp8", True)]
    assert judged[0].bound == pytest.approx(0.0316, abs=1e-4)


# The command


@pytest.mark.slow
def test_the_command_writes_a_file_that_this_checkpoint_alone_takes(tmp_path: Path) -> None:
    out = tmp_path / "tiny_fp8.json"
    quick = ("--count", 2, "--steps", 1, "--device", "cpu", "--target", 0, "--json")
    result = turbopi("calibrate", "--random-weights", "pi05_tiny", "--out", out, *quick)
    assert result.exit_code == 0, (result.output, result.exception)
    document = json.loads(result.stdout)
    report = document["report"]
    assert len(report["observations"]["calibration"]) == len(report["observations"]["held_out"]) == 1
    assert report["random_weights"] is True and report["target_reached"] is True
    assert set(report["methods"]) == {"max", "headroom", "percentile", "mse"}
    assert set(report["held_out"]) >= {"fp8", "fp8-mlp", "fp8-f16sums", "bf16", "fp8 against bf16", "worst"}
    calibration = Quantization.load(out)
    calibration.check(TINY, random_checkpoint("pi05_tiny").fingerprint())
    assert not calibration.plan(TINY, "fp8-f16sums").kept
    arguments = {"precision": "fp8", "quantization": out, "device": "cpu"}
    with pytest.raises(BackendUnavailable, match=r"backend 'fused' can't run on cpu: .*NVIDIA GPU"):
        UnifiedPolicy(random_checkpoint("pi05_tiny"), **arguments)  # type: ignore[arg-type]
    with pytest.raises(CalibrationError, match="made for other weights"):
        UnifiedPolicy(random_checkpoint("pi05_tiny", 1), backend="emulated_fp8", **arguments)  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="precision 'bf16' takes no calibration; with one take fp8 or fp8-mlp or"):
        UnifiedPolicy(random_checkpoint("pi05_tiny"), **arguments | {"precision": "bf16"})  # type: ignore[arg-type]


@pytest.mark.slow
def test_the_command_calibrates_for_int8(tmp_path: Path) -> None:
    out = tmp_path / "int8.json"
    quick = ("--count", 2, "--steps", 1, "--device", "cpu", "--target", 0, "--json")
    result = turbopi("calibrate", "--random-weights", "pi05_tiny", "--precision", "int8", "--out", out, *quick)
    assert result.exit_code == 0, (result.output, result.exception)
    held_out = json.loads(result.stdout)["report"]["held_out"]
    assert set(held_out) == {
        "int8",
        *(f"int8 in the {part} alone" for part in PARTS),
        "bf16",
        "int8 against bf16",
        "worst",
    }
    calibration = Quantization.load(out)
    assert calibration.numbers == "int8" and calibration.plan(TINY, "int8").kept.keys() == {"prefix.1.qkv"}
    assert str(calibration.sites["prefix.1.qkv"].kept).startswith("not possible: INT8 has no NaN")
    said = refusal(turbopi("calibrate", "--random-weights", "pi05_tiny", "--precision", "bf16", "--out", out, *quick))
    assert "--precision 'bf16' isn't what calibration is for; choose fp8 or int8" in said


@pytest.mark.slow
def test_the_command_replaces_nothing_but_a_calibration(tmp_path: Path) -> None:
    weights = tmp_path / "model.safetensors"
    weights.write_bytes(b"weights")
    quick = ("--count", 2, "--steps", 1, "--device", "cpu", "--target", 0)
    refused = refusal(turbopi("calibrate", "--random-weights", "pi05_tiny", "--out", weights, *quick))
    assert "is there and no calibration, so it isn't replaced" in refused
    assert weights.read_bytes() == b"weights"
    made_up().save(tmp_path / "q.json")
    result = turbopi("calibrate", "--random-weights", "pi05_tiny", "--out", tmp_path / "q.json", *quick)
    assert result.exit_code == 0, result.output
    assert "in place of the calibration on" in " ".join(result.output.split())
    assert "there is no folder nowhere" in refusal(turbopi("calibrate", "nowhere", *quick))


@pytest.mark.slow
def test_a_certificate_is_made_on_what_was_not_calibrated_on_and_says_so(tmp_path: Path) -> None:
    checkpoint = random_checkpoint("pi05_tiny")
    policy = UnifiedPolicy(shipped.with_libero_stats(checkpoint), backend="pytorch", device="cpu")
    for number in range(2):
        call = RecordedCall(policy.example_observation(number), {"actions": np.zeros((10, 7))}, 0.0)
        save_call(tmp_path / f"{number}.npz", call)
    seen = [sample.sha256 for sample in read_examples(policy, str(tmp_path), 2)[1]]
    report = {"observations": {"source": "x", "calibration": {"1": seen[1], "other": "0" * 64}}, "warnings": []}
    arguments = {"backend": "emulated_fp8", "precision": "fp8", "device": "cpu", "num_denoising_steps": 1}
    arguments |= {"quantization": made_up(report=report)}
    for count in (None, 1):
        document = verify(checkpoint, VerifyPlan(arguments, tmp_path, count, noises=1))
        assert (document.observations.calibrated_on, document.observations.names) == (0, ["0.npz"])
    document = verify(checkpoint, VerifyPlan(arguments, tmp_path, 2, noises=1))
    assert (document.observations.calibrated_on, document.observations.names) == (1, ["0.npz", "1.npz"])
    assert document.calibrated is not None and document.calibrated["observations"] == "x"


@pytest.mark.slow
def test_held_out_observations_that_are_none_are_warned_of(tmp_path: Path) -> None:
    policy = UnifiedPolicy(random_checkpoint("pi05_tiny"), backend="pytorch", device="cpu")
    call = RecordedCall(policy.example_observation(0), {"actions": np.zeros((10, 7))}, 0.0)
    for number in range(2):
        save_call(tmp_path / f"{number}.npz", call)
    arguments = {"device": "cpu", "num_denoising_steps": 1}
    made = run.calibrate(random_checkpoint("pi05_tiny"), Settings(arguments, str(tmp_path), 2, target=1.0, noises=1))
    assert "1 of 1 held-out observations were calibrated on, too: the same inputs" in made.warnings
    assert any(warning.startswith("no site is left in FP8") for warning in made.warnings)


def test_the_command_needs_a_place_to_write() -> None:
    assert "name a file with --out FILE" in refusal(turbopi("calibrate", "--random-weights", "pi05_tiny"))
    assert "no weights" in refusal(turbopi("calibrate", "--out", "x.json"))


def test_a_family_without_calibrations_is_refused_before_anything_is_asked_for() -> None:
    said = refusal(turbopi("calibrate", "--random-weights", "pi0_fast_base"))
    assert "calibrations are for Pi0.5, Pi0, SmolVLA alone, and pi0_fast_base is Pi0-FAST" in said
    assert said.endswith("or on an NVIDIA GPU in 'int8-weights', which needs none")
    with pytest.raises(ConfigError, match="calibrations are for Pi0"):
        run.calibrate(random_checkpoint("pi0_fast_base"), Settings({"robot": "droid"}))


def test_parts_narrow_a_named_calibration_alone(tmp_path: Path) -> None:
    made_up().save(tmp_path / "q.json")
    narrowed = PolicyOptions(quantization=str(tmp_path / "q.json"), fp8_parts="vision,prefix").policy_arguments()
    assert narrowed["quantization"].parts == ("vision", "prefix")
    with pytest.raises(ConfigError, match="name it with --quantization"):
        PolicyOptions(fp8_parts="vision").policy_arguments()
