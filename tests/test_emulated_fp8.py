"""Backends `emulated_fp8`, `emulated_int8`: a calibration's roundings in the float32 reference."""

import json
from functools import lru_cache
from pathlib import Path
from typing import Any

import pytest
import torch
from cli_helpers import turbopi
from conftest import golden_cases, golden_folder, golden_model
from test_engine_batch import observations
from torch import Tensor

from turbopi import backends
from turbopi.config import PiKind
from turbopi.engine.emulate import RoundedWeights, input_rounding, rounded
from turbopi.evaluate.sources import LocalPolicy
from turbopi.policy.policy import UnifiedPolicy
from turbopi.quantization.calibration_file import Quantization
from turbopi.quantization.formats import FORMATS, FP8, INT8, Format, Numbers
from turbopi.quantization.plan import TIERS, Tier, format_of
from turbopi.quantization.sites import sites
from turbopi.support.errors import ConfigError
from turbopi.verify.check_golden import check_folder, golden_calibration
from turbopi.verify.golden import GoldenFolder

CPU = torch.device("cpu")
CASE = "b_third_masked"
STEPS = 2


@lru_cache
def calibrated(kind: PiKind, numbers: Numbers) -> Quantization:
    return golden_calibration(golden_folder(), kind, CPU, format=FORMATS[numbers])


@pytest.fixture
def calibration() -> Quantization:
    return calibrated("pi05", "fp8")


def emulated(quantization: Quantization, tier: Tier) -> backends.Backend:
    checkpoint = golden_folder().checkpoint("pi05")
    return backends.create(
        f"emulated_{format_of(tier).name}",
        checkpoint.config.planned_model,
        lambda to, mode: checkpoint.load(to, mode).state,
        device=CPU,
        precision=tier,
        quantization=quantization,
    )


def actions(backend: backends.Backend) -> Tensor:
    case = golden_cases()[CASE]
    return backend.sample(case.observation, case.noise, STEPS).actions


@pytest.mark.slow
@pytest.mark.parametrize("tier", TIERS)
def test_it_rounds_what_the_plan_says_and_nothing_else(tier: Tier) -> None:
    case, model = golden_cases()[CASE], golden_model("pi05")
    calibration = calibrated("pi05", format_of(tier).name)
    plan = calibration.plan(model.config, tier)
    scales = {site: plan.scales[str(site)] for site in sites(model.config) if str(site) in plan.scales}
    assert 0 < len(scales) < len(sites(model.config)) or tier != "fp8-mlp"
    weights = RoundedWeights({site: plan.directions[str(site)] for site in scales}, plan.format)
    with rounded(model, scales, weights, plan.half_sums):
        expected = model.sample(case.observation, case.noise, STEPS)[0]
    ours = actions(emulated(calibration, tier))
    assert torch.equal(ours[0], expected)
    exact = model.sample(case.observation, case.noise, STEPS)[0]
    assert 1e-3 < float((ours[0] - exact).norm() / exact.norm()) < 0.1


@pytest.mark.slow
@pytest.mark.parametrize("numbers", FORMATS)
def test_golden_cases_hold(numbers: Numbers, monkeypatch: pytest.MonkeyPatch) -> None:
    def known(folder: GoldenFolder, kind: PiKind, device: torch.device, format: Format) -> Quantization:
        return calibrated(kind, format.name)  # measured once

    monkeypatch.setattr("turbopi.verify.check_golden.golden_calibration", known)
    checked = check_folder(golden_folder(), f"emulated_{numbers}", (numbers,), CPU)
    compared = [one for many in checked for one in many]
    judged = [one for one in compared if one.ok is not None]
    assert len(judged) >= 7 and {one.tensor for one in judged} == {"actions"}
    assert all(one.ok for one in judged), [one for one in judged if not one.ok]


def test_in_int8_the_experts_activations_stay_and_products_err_less_than_in_fp8() -> None:
    entries = {numbers: calibrated("pi05", numbers).sites for numbers in FORMATS}
    experts = [entry for name, entry in entries["int8"].items() if name.startswith("expert.")]
    assert {entry.scale for entry in experts} == {1.0} and {entry.saturated for entry in experts} == {0.0}
    for name, entry in entries["int8"].items():
        assert entry.error < (0.2 if name.startswith("expert.") else 0.9) * entries["fp8"][name].error, name
    model, site = golden_model("pi05"), next(s for s in sites(golden_model("pi05").config) if s.part == "expert")
    x = torch.randn(3, site.width, generator=torch.Generator().manual_seed(0))
    assert torch.equal(input_rounding(site, 0.1, INT8)(x), x)
    assert not torch.equal(input_rounding(site, 0.1, FP8)(x), x)
    assert model.config.expert.depth * 4 == len(experts)


@pytest.mark.slow
@pytest.mark.parametrize("tier", ["fp8", "int8"])
def test_damage_is_refused_and_harms_no_other_observation(tier: Tier) -> None:
    """A NaN in what one prompt alone has; then one, in INT8 an infinity too, where rounding would hide it."""
    backend: Any = emulated(calibrated("pi05", format_of(tier).name), tier)
    observation, noise = observations("pi05", [1, 1], [4, 4], 5)
    token = int(observation.tokens[0, 2])
    assert token not in observation.tokens[1]

    def finite() -> Any:
        return backend.sample(observation, noise, 1).actions.isfinite().all(-1).all(-1).tolist()

    model = backend.model
    vision, prefix, last = model.vision.layers[0], model.vlm.layers[0], model.vlm.layers[-1]
    weights = [model.vlm.embed_tokens.weight[token], vision.layer_norm1.weight, vision.self_attn.q_proj.bias]
    weights += [vision.mlp.fc1.bias, prefix.self_attn.q_proj.weight[1], prefix.mlp.up_proj.weight[1]]
    weights += [last.self_attn.v_proj.weight[0], model.expert.layers[1].mlp.down_proj.weight[0]]
    for number in weights:
        before = number[0].clone()
        for damage in (torch.nan, torch.inf) if tier == "int8" else (torch.nan,):
            number[0] = damage
            assert finite() == [False, number is weights[0]]
        number[0] = before
    assert finite() == [True, True]


def test_a_calibration_for_other_numbers_is_refused() -> None:
    for numbers, tier in (("fp8", "int8"), ("int8", "fp8-mlp")):
        wanted = format_of(tier).name
        with pytest.raises(ConfigError, match=f"is for {numbers}, the precision is '{tier}'; .*--precision {wanted}`"):
            emulated(calibrated("pi05", numbers), tier)  # type: ignore[arg-type]


def test_metadata_tells_the_plan_and_that_it_is_emulated(calibration: Quantization) -> None:
    reported = emulated(calibration.only(["prefix"]), "fp8").describe()["fp8"]
    assert reported["emulated"] == "in float32" and reported["observations"] == "the golden cases themselves"
    assert reported["plan"]["vision.fc1"] == "bf16: FP8 is switched off in the vision"
    assert reported["identity"] != calibration.identity


class FewWords:
    def encode(self, text: str, add_bos: bool) -> list[int]:
        return [2, 5, 7]


def test_evaluations_know_the_calibration(calibration: Quantization) -> None:
    checkpoint = golden_folder().checkpoint("pi05")
    policy = UnifiedPolicy(
        checkpoint,
        backend="emulated_fp8",
        precision="fp8",
        quantization=calibration,
        device="cpu",
        tokenizer=FewWords(),
    )
    assert LocalPolicy(policy, calibration.fingerprint).identity["calibration"] == calibration.identity


def test_it_needs_a_calibration_and_runs_in_nothing_but_fp8(calibration: Quantization) -> None:
    with pytest.raises(
        ConfigError, match="precision 'fp8' needs a calibration; make one with `turbopi calibrate --prec"
    ):
        emulated(None, "fp8")  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="backend 'emulated_fp8' doesn't run in 'bf16': only fp8 or fp8-mlp"):
        backends.check("emulated_fp8", CPU, "bf16")
    with pytest.raises(ConfigError, match="backend 'emulated_int8' doesn't run in 'fp8': only int8"):
        backends.check("emulated_int8", CPU, "fp8")


def test_auto_never_takes_it() -> None:
    for tier in TIERS:
        assert backends.choose(CPU, tier)[0] == "fused"


@pytest.mark.slow
@pytest.mark.parametrize("numbers", FORMATS)
def test_verify_and_bench_run_it(two_layers: None, numbers: str, tmp_path: Path) -> None:
    tiny = ("--random-weights", "pi05_tiny")
    file, backend = tmp_path / "calibration.json", f"emulated_{numbers}"
    noise = ("--observations", "random-noise", "--count", 2, "--steps", 2)
    made = turbopi("calibrate", *tiny, "--precision", numbers, *noise, "--out", file)
    assert made.exit_code == 0, made.output
    options = ("--precisions", numbers, "--quantization", file, "--device", "cpu", "--json")
    few = ("--count", 1, "--noises", 1, "--steps", 2)
    verified = turbopi("verify", *tiny, "--backend", backend, "--precision", numbers, *few, *options[2:])
    document = json.loads(verified.stdout)
    assert verified.exit_code == (0 if document["ok"] else 1), verified.output
    assert (document["backend"], document["precision"]) == (backend, numbers)
    assert document["actions"]["relative_rms"] > 0, "nothing was rounded"
    quick = ("--calls", 1, "--main-calls", 1, "--steps", 1, "--no-error")
    benched = turbopi("bench", *tiny, "--backends", backend, *quick, *options)
    assert benched.exit_code == 0, benched.output
    assert json.loads(benched.stdout)["results"][0]["precision"] == numbers
