"""INT8 of the `fused` backend on a real GPU: what the emulated reference says, on openpi's golden cases.

On Hopper its own kernels run, with the expert in bfloat16, and the portable ones, with the expert's weights in INT8.
"""

from functools import lru_cache
from typing import Any, cast

import pytest
import torch
from conftest import golden_cases, golden_folder, golden_model
from torch import Tensor

from turbopi import backends
from turbopi.backends.fused import INT8_ON_HOPPER, FusedBackend
from turbopi.config import PiKind
from turbopi.engine.emulate import RoundedWeights, delta_cosine, relative_rms, rounded
from turbopi.kernels.ops import KERNELS_VARIABLE, forced_portable
from turbopi.kernels.portable.denoise.packing import refusal
from turbopi.models.observation import Observation
from turbopi.models.pi0.reference import Pi0Model
from turbopi.quantization.calibration_file import Quantization
from turbopi.quantization.formats import INT8
from turbopi.quantization.sites import sites
from turbopi.verify.check_golden import FP8_COSINE, FP8_TARGET, golden_calibration
from turbopi.verify.golden import Case

HERE = torch.cuda.get_device_capability() if torch.cuda.is_available() else None
pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(
        HERE is None or HERE < (8, 0) or HERE[0] in (10, 11),
        reason="needs an NVIDIA GPU of compute capability 8.x, 9.0 or 12.x",
    ),
]
CASES = ["a_three_cams", "b_third_masked", "e_horizon50", "p0_pi0_state"]
STEPS = 10
KERNELS = ["auto", "portable"] if HERE == (9, 0) else ["auto"]


@pytest.fixture(params=KERNELS, autouse=True)
def kernels(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    monkeypatch.setenv(KERNELS_VARIABLE, request.param)
    return str(request.param)


def expert_in_int8() -> bool:
    return HERE != (9, 0) or forced_portable()


@lru_cache
def on_gpu(kind: PiKind) -> Pi0Model:
    state = {name: tensor.to("cuda") for name, tensor in golden_model(kind).state_dict().items()}
    return Pi0Model.from_state(golden_model(kind).config, state)


@lru_cache
def quantization(kind: PiKind, target: float) -> Quantization:
    return golden_calibration(golden_folder(), kind, torch.device("cuda", 0), target, INT8)


def backend(kind: PiKind, target: float = 0.0) -> backends.Backend:
    return made(kind, target, forced_portable())


@lru_cache
def made(kind: PiKind, target: float, portable: bool) -> backends.Backend:
    checkpoint = golden_folder().checkpoint(kind)
    return backends.create(
        "fused",
        checkpoint.config.planned_model,
        lambda to, mode: checkpoint.load(to, mode).state,
        device=torch.device("cuda", 0),
        precision="int8",
        quantization=quantization(kind, target),
    )


def emulated(case: Case, target: float, expert: bool = True) -> tuple[Tensor, Tensor]:
    """(float32, float32 with the plan's sites rounded, the expert's among them), on the host."""
    model, chosen = on_gpu(case.kind), quantization(case.kind, target)
    plan = chosen.plan(model.config, "int8")
    in_kernel = expert and expert_in_int8() and refusal(model.config) is None and plan.expert == "int8"
    used = {
        site: plan.scales[str(site)]
        for site in sites(model.config)
        if str(site) in plan.scales and (in_kernel or site.part != "expert")
    }
    weights = RoundedWeights({site: plan.directions[str(site)] for site in used}, INT8)
    observation, noise = case.observation.to("cuda"), case.noise.to("cuda")
    exact = model.sample(observation, noise, STEPS)
    with rounded(model, used, weights):
        return exact.cpu(), model.sample(observation, noise, STEPS).cpu()


def is_as_far_off(ours: Tensor, exact: Tensor, expected: Tensor) -> bool:
    """Whether actions are as far from float32 as the emulation, and near to it; bfloat16 has a share of some 0.01."""
    error = relative_rms(expected, exact)
    return relative_rms(ours, exact) < 1.3 * error + 0.01 and relative_rms(ours, expected) < 0.75 * error + 0.02


@pytest.mark.parametrize("case", CASES)
def test_the_engine_is_as_far_from_float32_as_its_emulation(case: str) -> None:
    one = golden_cases()[case]
    exact, expected = emulated(one, 0.0)
    ours = backend(one.kind).sample(one.observation, one.noise, STEPS).actions
    print(f"{case}: {relative_rms(ours, exact):.4f} of float32, emulated {relative_rms(expected, exact):.4f}")
    assert is_as_far_off(ours, exact, expected)


def test_a_batch_is_as_far_from_float32_as_its_emulation_with_a_bf16_expert() -> None:
    one = golden_cases()["b_third_masked"]
    exact, expected = emulated(one, 0.0, expert=False)
    four = Observation(
        **{name: value.repeat(4, *[1] * (value.dim() - 1)) for name, value in vars(one.observation).items()}
    )
    runner: Any = backend("pi05")
    ours = runner.sample(four, one.noise.repeat(4, 1, 1), STEPS).actions
    assert all(is_as_far_off(row[None], exact, expected) for row in ours)
    plan = runner.describe()["int8"]["plan"]
    assert not expert_in_int8() or plan["expert of batches"] == "bf16, as operations denoise"


@pytest.mark.parametrize("case", CASES)
def test_sites_kept_in_bf16_reach_the_target(case: str) -> None:
    one = golden_cases()[case]
    exact, _ = emulated(one, FP8_TARGET)
    ours = backend(one.kind, FP8_TARGET).sample(one.observation, one.noise, STEPS).actions
    cosine = delta_cosine(ours, exact, torch.zeros_like(exact))
    print(f"{case}: cosine {cosine:.6f}, plan {backend(one.kind, FP8_TARGET).describe()['int8']['plan']}")
    assert cosine >= FP8_COSINE


@pytest.mark.parametrize("rows", [1, 4])
def test_damage_is_refused_and_harms_no_other_observation(rows: int) -> None:
    """NaN in what captured kernels round to int8, then in a token of one prompt. It goes with its call."""
    one, runner = golden_cases()["b_third_masked"], cast(FusedBackend, backend("pi05"))
    many = Observation(
        **{name: value.repeat(rows, *[1] * (value.dim() - 1)) for name, value in vars(one.observation).items()}
    )
    noise, weights = one.noise.repeat(rows, 1, 1), runner._weights
    own = int(next(token for token in range(3, 100) if token not in many.tokens))
    many.tokens[0, 1] = own  # of the first observation alone

    def finite() -> list[bool]:
        return runner.sample(many, noise, STEPS).actions.isfinite().all(-1).all(-1).tolist()

    right, layer = runner.sample(many, noise, STEPS).actions, weights.vlm[0]
    assert layer.norm2 is not None
    damaged = [weights.vision[0].fc1[1], weights.vision[0].qkv[1], weights.vision[1].norm1[0], layer.norm2]
    damaged += [layer.gate_up.scale, layer.qkv.scale]  # type: ignore[union-attr]
    for numbers in damaged:
        before = numbers[3].clone()
        numbers[3] = torch.nan
        assert finite() == [False] * rows
        numbers[3] = before
    embedding, before = weights.embed_tokens[own], weights.embed_tokens[own].clone()
    embedding.fill_(torch.nan)
    assert finite() == [False] + [True] * (rows - 1)
    embedding.copy_(before)
    assert torch.equal(runner.sample(many, noise, STEPS).actions, right)


def test_repeated_calls_are_bit_identical_and_the_denoising_kernel_runs() -> None:
    one = golden_cases()["b_third_masked"]
    runner: Any = backend("pi05")
    assert isinstance(runner, FusedBackend)
    first, again = (runner.sample(one.observation, one.noise, STEPS).actions.clone() for _ in range(2))
    assert torch.equal(first, again)
    expert = runner.describe()["int8"]["plan"]["expert"]
    assert expert == "int8" if expert_in_int8() else expert.endswith(INT8_ON_HOPPER)
    products = runner.describe()["operations"]
    assert ("INT8 products" in products) == (not expert_in_int8()), "Hopper's own"
