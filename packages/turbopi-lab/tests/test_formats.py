"""Number formats without kernels, and kinds of weights to study."""

import pytest
import torch
from conftest import golden_cases, golden_model

from turbopi_lab.studies import formats
from turbopi_lab.studies.weights import WEIGHTS, studied_checkpoint


def test_fp8_attention_changes_a_little_and_goes_away() -> None:
    model, case = golden_model("pi05"), golden_cases()["b_third_masked"]
    exact = model.sample(case.observation, case.noise, 2)
    with formats.attention_in_fp8("vision", "gemma"):
        rounded = model.sample(case.observation, case.noise, 2)
    assert 1e-4 < float((rounded - exact).norm() / exact.norm()) < 0.2
    assert torch.equal(model.sample(case.observation, case.noise, 2), exact)


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
