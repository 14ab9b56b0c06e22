"""Backend `emulated_fp8`: a calibration's roundings in the float32 reference, behind the same doors as the engine."""

import json
from pathlib import Path

import pytest
import torch
from cli_helpers import turbopi
from conftest import golden_cases, golden_folder, golden_model
from torch import Tensor

from turbopi import backends
from turbopi.config import Kind
from turbopi.engine.emulate import RoundedWeights, rounded
from turbopi.errors import ConfigError
from turbopi.evaluate.sources import LocalPolicy
from turbopi.policy import UnifiedPolicy
from turbopi.quantization.calibration_file import Quantization
from turbopi.quantization.plan import TIERS, Fp8Tier
from turbopi.quantization.sites import sites
from turbopi.verify.check_golden import check_folder, golden_calibration
from turbopi.verify.golden import GoldenFolder

CPU = torch.device("cpu")
CASE = "b_third_masked"
STEPS = 2


@pytest.fixture(scope="module")
def calibration() -> Quantization:
    return golden_calibration(golden_folder(), "pi05", CPU)


def emulated(quantization: Quantization, tier: Fp8Tier) -> backends.Backend:
    checkpoint = golden_folder().checkpoint("pi05")
    return backends.create(
        "emulated_fp8",
        checkpoint.config.model,
        lambda to, mode: checkpoint.load(to, mode).state,
        device=CPU,
        precision=tier,
        quantization=quantization,
    )


def actions(backend: backends.Backend) -> Tensor:
    case = golden_cases()[CASE]
    return backend.sample(case.observation, case.noise, STEPS).actions


@pytest.mark.parametrize("tier", TIERS)
def test_it_rounds_what_the_plan_says_and_nothing_else(calibration: Quantization, tier: Fp8Tier) -> None:
    case, model = golden_cases()[CASE], golden_model("pi05")
    plan = calibration.plan(model.config, tier)
    scales = {site: plan.scales[str(site)] for site in sites(model.config) if str(site) in plan.scales}
    assert 0 < len(scales) < len(sites(model.config)) or tier == "fp8"
    weights = RoundedWeights({site: plan.directions[str(site)] for site in scales})
    with rounded(model, scales, weights):
        expected = model.sample(case.observation, case.noise, STEPS)[0]
    ours = actions(emulated(calibration, tier))
    assert torch.equal(ours[0], expected)
    exact = model.sample(case.observation, case.noise, STEPS)[0]
    assert 1e-3 < float((ours[0] - exact).norm() / exact.norm()) < 0.1


def test_golden_cases_hold(calibration: Quantization, monkeypatch: pytest.MonkeyPatch) -> None:
    def calibrated(folder: GoldenFolder, kind: Kind, device: torch.device) -> Quantization:
        return calibration if kind == "pi05" else golden_calibration(folder, kind, device)  # measured once

    monkeypatch.setattr("turbopi.verify.check_golden.golden_calibration", calibrated)
    compared = [one for many in check_folder(golden_folder(), "emulated_fp8", ("fp8",), CPU) for one in many]
    judged = [one for one in compared if one.ok is not None]
    assert len(judged) >= 7 and {one.tensor for one in judged} == {"actions"}
    assert all(one.ok for one in judged), [one for one in judged if not one.ok]


def test_metadata_tells_the_plan_and_that_it_is_emulated(calibration: Quantization) -> None:
    told = emulated(calibration.only(["prefix"]), "fp8").describe()["fp8"]
    assert told["emulated"] == "in float32" and told["observations"] == "the golden cases themselves"
    assert told["plan"]["vision.fc1"] == "bf16: FP8 is switched off in the vision"
    assert told["identity"] != calibration.identity


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
    with pytest.raises(ConfigError, match="precision 'fp8' needs FP8 calibration; make one with `turbopi calibrate`"):
        emulated(None, "fp8")  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="backend 'emulated_fp8' runs in fp8 or fp8-mlp, not in 'bf16'"):
        backends.check("emulated_fp8", CPU, "bf16")


def test_auto_never_takes_it() -> None:
    for tier in TIERS:
        assert backends.choose(CPU, tier)[0] == "fused"


def test_verify_and_bench_run_it(calibration: Quantization, tmp_path: Path) -> None:
    small = "src/turbopi/data/small_policy"
    file = tmp_path / "fp8.json"
    made = turbopi("calibrate", small, "--observations", "random-noise", "--count", 2, "--steps", 2, "--out", file)
    assert made.exit_code == 0, made.output
    options = ("--precisions", "fp8", "--quantization", file, "--device", "cpu", "--json")
    few = ("--count", 1, "--noises", 1, "--steps", 2)
    verified = turbopi("verify", small, "--backend", "emulated_fp8", "--precision", "fp8", *few, *options[2:])
    document = json.loads(verified.stdout)
    assert verified.exit_code == (0 if document["ok"] else 1), verified.output
    assert (document["backend"], document["precision"]) == ("emulated_fp8", "fp8")
    assert document["actions"]["relative_rms"] > 0, "nothing was rounded"
    quick = ("--calls", 1, "--main-calls", 1, "--steps", 1)
    benched = turbopi("bench", small, "--backends", "emulated_fp8", *quick, *options)
    assert benched.exit_code == 0, benched.output
    assert json.loads(benched.stdout)["results"][0]["precision"] == "fp8"
