"""The reference computes what openpi computes: every case, every stored intermediate; and the check can fail."""

import copy
import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import golden_cases, golden_folder, golden_model
from torch import Tensor

from turbopi.backends.pytorch import PyTorchBackend
from turbopi.models.pi0 import denoise, reference
from turbopi.models.pi0.reference import FloatPrecision, Pi0Model
from turbopi.support.errors import CheckpointError
from turbopi.verify.check_golden import Comparison, check_case
from turbopi.verify.golden import GoldenFolder

CASES = ["a_three_cams", "b_third_masked", "e_horizon50", "p0_pi0_state"]


def judged(case: str, precision: FloatPrecision, change: Callable[[Pi0Model], None] | None = None) -> list[Comparison]:
    """The comparisons of a golden case, with a model that `change` may have broken first."""
    one = golden_cases()[case]
    model = golden_model(one.kind, precision)
    if change is not None:
        model = copy.deepcopy(model)
        change(model)
    backend = PyTorchBackend.__new__(PyTorchBackend)
    backend.model, backend.config, backend.precision = model, model.config, precision
    backend.device = torch.device("cpu")
    return [c for c in check_case(one, backend) if c.ok is not None]


def failures(comparisons: list[Comparison]) -> list[Comparison]:
    return [c for c in comparisons if not c.ok]


@pytest.mark.parametrize("case", CASES)
def test_float32_equals_openpi_within_float32_rounding(case: str) -> None:
    comparisons = judged(case, "f32")
    assert not failures(comparisons)
    compared = {(c.against, c.tensor) for c in comparisons}
    for against in ("torch_fp32", "jax_fp32"):
        assert {(against, "actions"), (against, "v_t")} <= compared
    stored = {
        name for run in golden_cases()[case].runs for name in run.variants["torch_fp32"] if name != "actions_unrolled"
    }
    assert {name for against, name in compared if against == "torch_fp32"} == stored


@pytest.mark.parametrize("case", CASES)
def test_bfloat16_error_is_no_worse_than_openpis(case: str) -> None:
    comparisons = judged(case, "bf16")
    assert {c.num_steps for c in comparisons if c.tensor == "actions"} == {
        r.num_steps for r in golden_cases()[case].runs
    }
    assert not failures(comparisons)


def test_bfloat16_really_rounds() -> None:
    assert all(c.relative_rms > 1e-4 for c in judged("b_third_masked", "bf16") if c.tensor == "actions")


# -- faults that other implementations had: each one must be caught ---------------------------------------------------


def layer_norm_eps_1e_5(model: Pi0Model) -> None:
    for module in model.vision.modules():
        if isinstance(module, torch.nn.LayerNorm):
            module.eps = 1e-5


def shifted_adarms_gate(model: Pi0Model) -> None:
    for layer in model.expert.layers:
        bias = layer.get_parameter("input_layernorm.dense.bias")
        bias[2 * len(bias) // 3 :] += 1e-3


def swapped_gate_and_up(model: Pi0Model) -> None:
    for layer in model.vlm.layers:
        layer.mlp.gate_proj, layer.mlp.up_proj = layer.mlp.up_proj, layer.mlp.gate_proj


def no_action_bias(model: Pi0Model) -> None:
    model.action_out_proj.bias.zero_()


@pytest.mark.parametrize("fault", [layer_norm_eps_1e_5, shifted_adarms_gate, swapped_gate_and_up, no_action_bias])
def test_a_broken_model_fails_the_check(fault: Callable[[Pi0Model], None]) -> None:
    assert any(c.tensor == "actions" for c in failures(judged("b_third_masked", "f32", fault)))


def test_a_suffix_one_position_early_fails_the_check(monkeypatch: pytest.MonkeyPatch) -> None:
    exact = denoise.suffix_rope

    def early(cache: denoise.KVCache, *rest: int) -> tuple[Tensor, Tensor]:
        return exact(dataclasses.replace(cache, lengths=cache.lengths - 1), *rest)

    monkeypatch.setattr(reference, "suffix_rope", early)
    assert any(c.tensor == "actions" for c in failures(judged("b_third_masked", "f32")))


def test_attending_to_padding_fails_the_check(monkeypatch: pytest.MonkeyPatch) -> None:
    exact = PyTorchBackend.intermediates

    def padded(self: PyTorchBackend, observation: reference.Observation, noise: Tensor, steps: int) -> reference.Trace:
        everything = dataclasses.replace(observation, token_mask=torch.ones_like(observation.token_mask))
        return exact(self, everything, noise, steps)

    monkeypatch.setattr(PyTorchBackend, "intermediates", padded)
    assert any(c.tensor == "v_t" for c in failures(judged("b_third_masked", "f32")))


def test_an_unscaled_prompt_embedding_fails_the_check(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reference, "embed_prompt", lambda vlm, tokens: vlm.embed_tokens(tokens))
    assert any(c.tensor == "v_t" for c in failures(judged("p0_pi0_state", "f32")))


def test_a_float32_time_embedding_fails_the_check(monkeypatch: pytest.MonkeyPatch) -> None:
    def single(times: np.ndarray, width: int) -> Tensor:
        t = torch.from_numpy(times)
        period = 4e-3 * 1000 ** torch.linspace(0, 1, width // 2)
        angle = t[:, None] * (2 * torch.pi / period)
        return torch.cat((angle.sin(), angle.cos()), dim=-1)

    monkeypatch.setattr(reference, "time_embedding", single)
    assert any(c.tensor == "cond" for c in failures(judged("a_three_cams", "f32")))


def test_the_golden_folder_names_what_it_lacks(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match=r"isn't a golden folder: there is no checkpoints/model.json"):
        GoldenFolder(tmp_path)


def test_both_kinds_are_told_apart() -> None:
    assert {name: case.kind for name, case in golden_cases().items()} == {
        name: "pi0" if name.startswith("p0") else "pi05" for name in CASES
    }
    assert golden_folder().model_config("pi0").max_prompt_tokens == 48
