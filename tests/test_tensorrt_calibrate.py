"""Calibration: real observations, one scale a tensor and layer, and an engine of its own for each layer's scales."""

import importlib.util
import json
import re
from pathlib import Path

import pytest
import torch
from conftest import golden_cases, golden_folder, golden_model
from tensorrt_fakes import golden_backend

from turbopi.backends.tensorrt import calibrate as calibrating
from turbopi.backends.tensorrt.calibrate import Calibration, calibrate
from turbopi.backends.tensorrt.fp8 import TensorRTFp8Backend
from turbopi.models.observation import Observation
from turbopi.models.pi0.reference import Pi0Model
from turbopi.support.errors import BackendUnavailable, ConfigError
from turbopi.support.installation import install_command

NAMES = ("input", "hidden", "gate", "up", "down")
needs_modelopt = pytest.mark.skipif(importlib.util.find_spec("modelopt") is None, reason="ModelOpt isn't installed")


def observations() -> list[Observation]:
    return [golden_cases()["a_three_cams"].observation]


def own_model() -> Pi0Model:
    checkpoint = golden_folder().checkpoint("pi05")
    return Pi0Model.from_state(checkpoint.config.planned_model, checkpoint.load("cpu", "f32").state)


def test_scales_are_the_largest_magnitudes_over_448() -> None:
    model = golden_model("pi05")
    found = calibrate(model, observations())
    assert len(found.scales) == model.config.vlm.depth - 1
    mlp, first = model.vlm.layers[0].mlp, found.scales[0]
    assert first is not None
    assert float(first.gate) == pytest.approx(float(mlp.gate_proj.weight.abs().max()) / 448)
    embedded = model.embed(observations()[0])
    seen: list[torch.Tensor] = []
    handle = mlp.down_proj.register_forward_pre_hook(lambda module, args: seen.append(args[0]))
    model.keys_values(embedded)
    handle.remove()
    assert float(first.hidden) == pytest.approx(float(seen[0].abs().max()) / 448)


def test_each_layer_has_its_own_scales() -> None:
    scales = calibrate(golden_model("pi05"), observations()).scales
    assert len({float(one.hidden) for one in scales if one is not None}) == len(scales)


def test_hooks_leave_the_model_as_it_was() -> None:
    model = golden_model("pi05")
    calibrate(model, observations())
    assert all(not part._forward_pre_hooks for part in model.modules())


@pytest.mark.slow
@needs_modelopt
def test_modelopt_measures_the_same() -> None:
    ours, theirs = (
        calibrate(golden_model("pi05"), observations()),
        calibrate(own_model(), observations(), method="modelopt"),
    )
    assert theirs.method.startswith("ModelOpt ")
    for one, other in zip(ours.scales, theirs.scales, strict=True):
        assert one is not None and other is not None
        for name in NAMES:
            assert float(getattr(one, name)) == pytest.approx(float(getattr(other, name)), rel=1e-6)


def test_the_file_holds_what_was_measured(tmp_path: Path) -> None:
    found = calibrate(golden_model("pi05"), observations(), source="golden")
    found.save(tmp_path)
    read = Calibration.find(tmp_path)
    assert read is not None and read.about() == {"method": "max", "observations": 1, "source": "golden"}
    for one, other in zip(found.scales, read.scales, strict=True):
        assert one is not None and other is not None
        assert all(float(getattr(one, name)) == pytest.approx(float(getattr(other, name))) for name in NAMES)
    assert Calibration.find(tmp_path / "elsewhere") is None


def test_a_broken_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / calibrating.FILE).write_text(json.dumps({"scales": [{}]}))
    with pytest.raises(ConfigError, match=r"isn't a calibration of .*; delete it and build again"):
        Calibration.find(tmp_path)


def test_nothing_to_calibrate_on_is_refused() -> None:
    with pytest.raises(ConfigError, match="needs at least one observation"):
        calibrate(golden_model("pi05"), [])
    with pytest.raises(ConfigError, match="unknown calibration method 'guess'; choose one of modelopt, max"):
        calibrate(golden_model("pi05"), observations(), method="guess")


def test_modelopt_that_is_missing_is_never_imitated(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("turbopi.backends.tensorrt.calibrate.importlib.util.find_spec", lambda name: None)
    with pytest.raises(BackendUnavailable, match=re.escape(f"{install_command('modelopt')}, or take --method max")):
        calibrate(golden_model("pi05"), observations(), method="modelopt")


def test_fp8_without_a_calibration_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TURBOPI_ENGINES", str(tmp_path))
    with pytest.raises(BackendUnavailable, match=r"no calibration for these weights; .*turbopi build --precision fp8"):
        golden_backend(TensorRTFp8Backend, "pi05", tmp_path)


def test_fp8_actions_stay_close_to_the_reference(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    case = golden_cases()["a_three_cams"]
    monkeypatch.setattr(TensorRTFp8Backend, "calibration", calibrate(golden_model("pi05"), observations()))
    backend = golden_backend(TensorRTFp8Backend, "pi05", tmp_path)
    ours = backend.sample(case.observation, case.noise, 10).actions
    exact = golden_model("pi05").sample(case.observation, case.noise, 10)
    assert torch.nn.functional.cosine_similarity(ours.flatten(), exact.flatten(), dim=0) > 0.999
    assert not torch.allclose(ours, exact, atol=1e-5)
    assert backend.describe()["calibration"]["observations"] == 1
    assert [name for name in backend.built if name.endswith("-fp8")]
