"""Number formats without kernels, and kinds of weights to study."""

import pytest
import torch
from conftest import golden_cases, golden_model
from torch import Tensor

from turbopi.quantization.directions import directions
from turbopi_lab.studies import formats
from turbopi_lab.studies.weights import WEIGHTS, studied_checkpoint


def random(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed))


def test_e2m1_rounds_to_its_numbers_and_halves_to_even() -> None:
    numbers = torch.tensor(formats.E2M1)
    assert torch.equal(formats.round_e2m1(numbers), numbers)
    halves = torch.tensor([0.25, 0.75, 1.25, 1.75, 2.5, 3.5, 5.0, 7.0, -0.75])
    assert formats.round_e2m1(halves).tolist() == [0, 1, 1, 2, 2, 4, 4, 6, -1]
    x = torch.rand(1000, generator=torch.Generator().manual_seed(0)) * 6
    nearest = (x[:, None] - numbers).abs().amin(1)
    assert torch.equal((formats.round_e2m1(x) - x).abs(), nearest)


def test_nvfp4_scales_blocks_of_sixteen() -> None:
    x = torch.randn(8, 64, generator=torch.Generator().manual_seed(0))
    x[:, :16] *= 1000
    error = (formats.round_nvfp4(x) - x).view(8, 4, 16).norm(dim=-1) / x.view(8, 4, 16).norm(dim=-1)
    assert float(error.max()) < 0.2 and float(error.mean()) > 0.05
    assert torch.equal(formats.round_nvfp4(torch.zeros(2, 32)), torch.zeros(2, 32))


def test_fp8_attention_changes_a_little_and_goes_away() -> None:
    model, case = golden_model("pi05"), golden_cases()["b_third_masked"]
    exact = model.sample(case.observation, case.noise, 2)
    with formats.attention_in_fp8("vision", "gemma"):
        rounded = model.sample(case.observation, case.noise, 2)
    assert 1e-4 < float((rounded - exact).norm() / exact.norm()) < 0.2
    assert torch.equal(model.sample(case.observation, case.noise, 2), exact)


def test_errors_of_nvfp4_cancel_where_activations_lie() -> None:
    weight, common = random(20, 64) / 50, random(4, 64, seed=7)
    common[:, [5, 20, 33]] *= 20
    seen = random(200, 4, seed=1) @ common + 0.3 * random(200, 64, seed=2)
    exact = seen @ weight.T
    spared, nearest = (
        float((seen @ formats.round_nvfp4(weight, known).T - exact).norm()) for known in (directions(seen), None)
    )
    assert spared < 0.3 * nearest


def test_weights_to_study_are_what_they_are_called() -> None:
    plain, outliers = (
        studied_checkpoint(kind, "pi05_tiny", "cpu").load("cpu", "f32").state
        for kind in ("std 0.02", "std 0.02 with outliers")
    )
    for name, values in plain.items():
        if values.dim() > 1:
            assert float(values.std()) == pytest.approx(0.02, rel=0.2), name
            assert torch.equal(values, outliers[name])
    factors = torch.cat([1 + x for name, x in outliers.items() if name.startswith("vlm.") and x.dim() == 1])
    assert set(factors.tolist()) == {1.0, 20.0}
    assert 0 < float((factors == 20).float().mean()) < 0.03
    assert set(torch.cat([x for n, x in outliers.items() if "layer_norm1.weight" in n]).tolist()) == {1.0, 20.0}
    assert not any(bool(values.any()) for name, values in plain.items() if name.endswith("bias"))


def test_weights_to_study_have_fingerprints_of_their_own() -> None:
    kinds = [studied_checkpoint(kind, "pi05_tiny", "cpu", seed) for kind in WEIGHTS for seed in (0, 1)]
    assert len({checkpoint.fingerprint() for checkpoint in kinds}) == 6
