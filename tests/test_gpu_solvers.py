"""Solvers of the denoising loop on a real GPU, against the reference. Run by scripts/gpu_check."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from conditioned import conditioned
from conftest import golden_model
from test_engine import made_up
from test_gpu import GRAPHS, PORTABLE, backend, rms

from turbopi.config import Kind
from turbopi.models.pi0.conditioning import Conditioning, PromptGuidance
from turbopi.models.pi0.reference import FloatPrecision
from turbopi.models.pi0.solvers import SOLVERS, Integration

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="needs an NVIDIA GPU"),
    pytest.mark.filterwarnings("default"),  # Inductor warns of what it does
]
UNEVEN = (1.0, 0.7, 0.2, 0.0)
MODES = [("cuda_graph", "f32"), ("cuda_graph", "bf16"), ("fused", "bf16"), (PORTABLE, "bf16")]


@pytest.mark.parametrize(("name", "precision"), MODES)
@pytest.mark.parametrize("kind", ["pi05", "pi0"])
@pytest.mark.parametrize("solver", SOLVERS)
def test_a_solvers_loop_is_the_references(name: str, precision: FloatPrecision, kind: Kind, solver: Any) -> None:
    """With the bound of Euler's steps: twice what bfloat16 does to the reference. Plain calls keep their bits."""
    runner: Any = backend(name, kind, precision)
    observation, noise = made_up(kind, 2, 19)
    plain = runner.sample(observation, noise, 3).actions
    for times in (UNEVEN, tuple(0.6 * t for t in UNEVEN)):
        integration = Integration(solver, times)
        requested, steps = Conditioning(integration=integration), integration.evaluations
        exact = golden_model(kind).sample(observation, noise, steps, conditioning=requested)
        found = runner.sample(observation, noise, steps, conditioning=requested).actions
        if precision == "f32":
            torch.testing.assert_close(found, exact, atol=5e-5, rtol=5e-5)
        else:
            reference = golden_model(kind, "bf16").sample(observation, noise, steps, conditioning=requested)
            assert 0 < rms(found - exact) <= 2 * rms(reference - exact)
        for _ in range(3):
            assert torch.equal(runner.sample(observation, noise, steps, conditioning=requested).actions, found)
    assert torch.equal(runner.sample(observation, noise, 3).actions, plain)


@pytest.mark.parametrize(("name", "precision"), MODES)
@pytest.mark.parametrize("kind", ["pi05", "pi0"])
@pytest.mark.parametrize("which", ["plain", "held_and_identity", "ab2"])
def test_guidance_by_a_second_prompt_is_the_references(
    name: str, precision: FloatPrecision, kind: Kind, which: str
) -> None:
    """Both prompts see the images of one vision; another scale and prompt run in the same graphs."""
    runner: Any = backend(name, kind, precision)
    observation, noise = made_up(kind, 2, 19)
    plain = runner.sample(observation, noise, 3).actions
    one = conditioned(which, 3, noise.shape[1], noise.shape[2]) if which == "held_and_identity" else Conditioning()
    one = replace(one, integration=Integration("ab2", UNEVEN)) if which == "ab2" else one
    captured = None
    for scale, count in ((1.5, 22), (0.5, 25)):
        guidance = PromptGuidance(np.arange(3, 3 + count), scale)
        requested = replace(one, prompt=guidance)
        exact = golden_model(kind).sample(observation, noise, 3, conditioning=requested)
        found = runner.sample(observation, noise, 3, conditioning=requested).actions
        if precision == "f32":
            torch.testing.assert_close(found, exact, atol=5e-5, rtol=5e-5)
        else:
            reference = golden_model(kind, "bf16").sample(observation, noise, 3, conditioning=requested)
            assert 0 < rms(found - exact) <= 2 * rms(reference - exact)
        assert torch.equal(runner.sample(observation, noise, 3, conditioning=requested).actions, found)
        assert captured in (None, len(runner._graphs.entries))
        captured = len(runner._graphs.entries)
    assert torch.equal(runner.sample(observation, noise, 3).actions, plain)


@pytest.mark.parametrize("name", ["fused", PORTABLE])
def test_the_denoising_kernel_does_every_evaluation(name: str) -> None:
    runner: Any = backend(name, "pi05", "bf16")
    observation, noise = made_up("pi05", 1, 7)
    requested = Conditioning(integration=Integration("exponential", UNEVEN))
    runner.sample(observation, noise, 3, conditioning=requested)
    reported = runner.describe()["denoising"]
    loops = {how: [loop for loop in these if loop.startswith("H=7, 1 steps, ")] for how, these in reported.items()}
    assert [how for how, these in loops.items() if these] in (["one CUDA kernel"], ["one portable CUDA kernel"])


@pytest.mark.parametrize("name", [*GRAPHS, PORTABLE])
def test_intermediates_of_a_solvers_loop_are_the_references(name: str) -> None:
    runner: Any = backend(name, "pi05", "bf16")
    observation, noise = made_up("pi05", 2, 19)
    requested = Conditioning(integration=Integration("ab2", UNEVEN))
    exact: dict[str, torch.Tensor] = {}
    rounded: dict[str, torch.Tensor] = {}
    golden_model("pi05").sample(observation, noise, 3, conditioning=requested, trace=exact)
    golden_model("pi05", "bf16").sample(observation, noise, 3, conditioning=requested, trace=rounded)
    found = runner.intermediates(observation, noise, 3, conditioning=requested)
    for tensor in ("v_t", "x_t"):
        ours, theirs = (rms(one[tensor].cpu() - exact[tensor]) for one in (found, rounded))
        assert 0 < ours <= 2 * theirs, tensor
