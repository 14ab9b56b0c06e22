"""SmolVLA in FP8 and INT8: its plan equals the emulated reference, damage shows, a folder is calibrated as any other.

Without a GPU: graphs run again on a CPU in float32, kernels by Triton's interpreter.
"""

import json
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from cli_helpers import refusal, turbopi
from conftest import gpu_or_interpreter
from smolvla_golden import GoldenRuns, make_checkpoint, make_hub, relative
from test_engine_smolvla import model
from test_smolvla_batches import SIZES, STEPS, FusedOnCpu, alone, of_three
from test_smolvla_batches import on_cpu as on_cpu
from torch import Tensor

from turbopi import UnifiedPolicy
from turbopi.calibrate.statistics import collect
from turbopi.engine import smolvla
from turbopi.engine.emulate import RoundedWeights, rounded
from turbopi.kernels.plain import PLAIN, as_input
from turbopi.models.observation import Observation
from turbopi.models.smolvla.reference import SmolVLAModel
from turbopi.quantization.calibration_file import Quantization, SiteScale, shapes_of
from turbopi.quantization.formats import FP8, INT8, OF_EIGHT_BITS, Format
from turbopi.quantization.fp8 import E4M3, ScaledMatrix
from turbopi.quantization.sites import Site, sites
from turbopi.support.errors import CalibrationError, ConfigError

pytest.importorskip("triton", reason="Triton isn't installed")
pytestmark = [
    pytest.mark.skipif(torch.cuda.is_available(), reason="tests/test_gpu_smolvla.py has it there"),
    *gpu_or_interpreter(),
]


class Rounded(FusedOnCpu):
    precisions = ("fp8", "int8")  # type: ignore[assignment]

    def _make_ops(self) -> Any:
        return PLAIN


def rounded_on_cpu(made: SmolVLAModel, format: Format) -> tuple[dict[Site, float], Rounded]:
    """Calibrated on `of_three`."""
    (several, noise), every = of_three(), sites(made.config)
    rows = [(several.row(i), noise[i : i + 1]) for i in range(len(noise))]
    seen = collect(made, every, rows, STEPS, format=format)
    scales = {site: seen[str(site)].scale("max") if format.rounds_input(site.part) else 1.0 for site in every}
    entries = {str(site): SiteScale(scale, 1.0, 0.0, 0.0) for site, scale in scales.items()}
    report = {"observations": {"source": "recordings"}}
    given = Quantization("0" * 64, shapes_of(made.config), entries, report, format.name)
    state = {name: one.clone() for name, one in made.state_dict().items()}
    cpu, numbers = torch.device("cpu"), format.name
    backend = Rounded(made.config, lambda to, precision: state, device=cpu, precision=numbers, quantization=given)
    return scales, backend


@pytest.mark.slow
@pytest.mark.parametrize(("which", "format"), [("cross", FP8), ("special", INT8)])
def test_the_plan_equals_the_emulated_reference(
    which: str, format: Format, on_cpu: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("grouped_attention", "swiglu") if format is FP8 else ():  # which Triton's interpreter can't round to

        def plainly(kernel: Any, *given: Any, **to: Any) -> Tensor:
            return as_input(kernel(*given), torch.float32, **{"inverse": None, "numbers": E4M3} | to)

        monkeypatch.setattr(smolvla, name, partial(plainly, getattr(smolvla, name)))
    made, (several, noise) = model(**SIZES[which]), of_three()
    scales, backend = rounded_on_cpu(made, format)
    assert backend._plan is not None
    used = {site: scales[site] for site in scales if str(site) in backend._plan.scales and site.part != "expert"}
    assert len(used) == 4 * made.config.vision.depth + 4 * (made.config.text.depth - 1) + (format is FP8)
    exact = alone(made, several, noise)
    with rounded(made, used, RoundedWeights(format=format)):
        expected = alone(made, several, noise)
    single = [backend.sample(several.row(i), noise[i : i + 1], STEPS).actions.numpy() for i in range(len(noise))]
    for ours in (np.concatenate(single), backend.sample(several, noise, STEPS).actions.numpy()):
        # rounded numbers near an edge may fall either way where float32 sums differ in their last bit
        assert relative(ours, expected) < 0.25 * relative(expected, exact)
    *before, last = (layer.qkv for layer in backend._prefix.layers)
    assert all(isinstance(one, ScaledMatrix) and one.numbers == format.dtype for one in before[:2])
    assert isinstance(last, ScaledMatrix)
    assert backend.model.vision.layers[1].mlp.fc2.weight.numel() == 0, "a rounded matrix is there once"
    plan = backend.describe()[format.name]["plan"]
    assert plan["vision.qkv"] == plan["prefix.down"] == format.name
    if format is FP8:
        assert "takes no activations in FP8" in plan["expert"] and plan["prefix.qkv"] == "fp8"
    else:  # the expert's last layer is beside the last text layer but one
        assert backend._plan.kept.keys() == {"prefix.2.qkv"} and "INT8 has no NaN" in str(plan["prefix.qkv"])
        assert backend._expert.packed.numbers == "int8"
        assert plan["expert"] == plan["expert.down"] == "bf16, a captured step at a time"
        assert plan["expert of batches"] == "bf16, as operations denoise"


@pytest.mark.slow
def test_int8s_damage_shows_in_its_own_observation_alone(on_cpu: None) -> None:
    made, (several, noise) = model(**SIZES["special"]), of_three()
    _, backend = rounded_on_cpu(made, INT8)
    several = replace(several, image_mask=torch.ones_like(several.image_mask))

    def finite(seen: Observation) -> list[bool]:
        return backend.sample(seen, noise[: seen.batch_size], 1).actions.isfinite().flatten(1).all(1).tolist()

    assert finite(several) == [True] * 3
    for name, at in (("images", (0, 1, 9, 3, 0)), ("state", (0, 2))):
        damaged = getattr(several, name).clone()
        damaged[at] = torch.nan
        seen = replace(several, **{name: damaged})
        assert finite(seen) == [False, True, True] and finite(seen.row(0)) == [False], name
    vision, layers = backend._tower.layers, backend._prefix.layers
    numbers: list[Any] = [vision[0].qkv[1], vision[0].fc1[1], vision[1].norm1[0], layers[0].norm2]
    numbers += [layers[0].gate_up.scale, layers[0].down.scale, layers[1].qkv.scale, layers[1].out.scale]
    for one in numbers:
        before = one.clone()
        one[3] = torch.nan
        assert finite(several.row(1)) == [False]
        one.copy_(before)
    assert finite(several) == [True] * 3


@pytest.mark.parametrize("format", OF_EIGHT_BITS.values(), ids=OF_EIGHT_BITS)
def test_a_folder_is_calibrated_and_runs_by_what_lies_beside_it(
    format: Format, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("tokenizers", reason="SmolVLA's prompts need the extra `smolvla`")
    monkeypatch.setenv("HF_HUB_CACHE", str(make_hub(tmp_path / "hub")))
    folder, other = (make_checkpoint(name, tmp_path / name) for name in ("base", "special_tokens"))
    numbers, given = format.name, ("--observations", "random-noise", "--count", 8, "--target", 0, "--device", "cpu")
    with pytest.raises(ConfigError, match=f"turbopi calibrate --precision {numbers}"):
        UnifiedPolicy(folder, backend=f"emulated_{numbers}", precision=numbers, device="cpu")
    assert turbopi("calibrate", folder, "--precision", numbers, *given).exit_code == 0
    beside = folder / f"turbopi_{numbers}.json"
    held_out = Quantization.load(beside).report["held_out"]
    error = held_out[numbers]["relative_rms"]
    assert held_out["bf16"]["relative_rms"] < error < 0.2  # of matrices that are 16 wide
    policy = UnifiedPolicy(folder, backend=f"emulated_{numbers}", precision=numbers, device="cpu")
    golden = GoldenRuns("base")
    for run in range(len(golden)):
        actions = policy.infer(golden.observation(run), noise=golden.noise)["actions"]
        assert 0 < relative(actions, golden.actions(run)) <= 3 * error
    (other / beside.name).write_text(beside.read_text())
    with pytest.raises(CalibrationError, match="was made for other weights"):
        UnifiedPolicy(other, backend=f"emulated_{numbers}", precision=numbers, device="cpu")
    with pytest.raises(ConfigError, match=f"'cuda_graph' doesn't run in '{numbers}'"):
        UnifiedPolicy(folder, backend="cuda_graph", precision=numbers, device="cpu")
    refused = turbopi("convert", folder, tmp_path / "out", "--precision", numbers)
    assert "engines or conversions of a smolvla" in refusal(refused)
    refused = turbopi("calibrate", folder, "--precision", "nvfp4", *given)
    assert "SmolVLA doesn't run in NVFP4: calibrate it for fp8 or int8" in refusal(refused)
    for precision in ("nvfp4", "fp8-f16sums"):
        backend = f"emulated_{'nvfp4' if precision == 'nvfp4' else 'fp8'}"
        with pytest.raises(ConfigError, match=f"precision '{precision}' isn't for SmolVLA; take precision 'bf16'"):
            UnifiedPolicy(folder, backend=backend, precision=precision, device="cpu")
    found = json.loads(turbopi("doctor", "--checkpoint", folder, "--json").stdout)
    listed = {one["name"]: one for one in found["backends"]}
    assert listed["fused"]["precisions"] == ["bf16", "fp8", "fp8-mlp", "int8"]
    assert not listed["emulated_nvfp4"]["available"]
