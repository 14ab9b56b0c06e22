"""FP8 of the `fused` backend on a real GPU: what the emulated reference says, on openpi's golden cases."""

from functools import lru_cache
from pathlib import Path
from typing import Any

import pytest
import torch
from conditioned import conditioned
from conftest import golden_cases, golden_folder, golden_model
from torch import Tensor

from turbopi import backends
from turbopi.backends import Precision
from turbopi.backends.fused import FusedBackend
from turbopi.checkpoint import Checkpoint, open_checkpoint
from turbopi.config import PiKind
from turbopi.engine.emulate import RoundedWeights, delta_cosine, relative_rms, rounded
from turbopi.engine.quantized_writer import write_quantized
from turbopi.kernels.sm90.denoise.kernel import MAX_SUFFIX
from turbopi.kernels.sm90.denoise.packing import refusal
from turbopi.models.observation import Observation
from turbopi.models.pi0.conditioning import Conditioning
from turbopi.models.pi0.reference import Pi0Model
from turbopi.quantization.calibration_file import Quantization
from turbopi.quantization.sites import sites
from turbopi.verify.check_golden import FP8_COSINE, FP8_TARGET, golden_calibration
from turbopi.verify.golden import Case

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(
        not torch.cuda.is_available() or torch.cuda.get_device_capability() != (9, 0),
        reason="needs an NVIDIA GPU of compute capability 9.0",
    ),
]
CASES = ["a_three_cams", "b_third_masked", "e_horizon50", "p0_pi0_state"]
STEPS = 10


@lru_cache
def on_gpu(kind: PiKind) -> Pi0Model:
    state = {name: tensor.to("cuda") for name, tensor in golden_model(kind).state_dict().items()}
    return Pi0Model.from_state(golden_model(kind).config, state)


@lru_cache
def quantization(kind: PiKind, target: float) -> Quantization:
    return golden_calibration(golden_folder(), kind, torch.device("cuda", 0), target)


@lru_cache
def backend(kind: PiKind, precision: Precision, target: float = 0.0, kernels: str = "auto") -> backends.Backend:
    return made(golden_folder().checkpoint(kind), precision, quantization(kind, target), kernels)


def made(checkpoint: Checkpoint, precision: Precision, calibration: Quantization, kernels: str) -> backends.Backend:
    with pytest.MonkeyPatch.context() as patched:
        patched.setenv("TURBOPI_KERNELS", kernels)
        return backends.create(
            "fused",
            checkpoint.config.planned_model,
            lambda to, mode: checkpoint.load(to, mode).state,
            device=torch.device("cuda", 0),
            precision=precision,
            quantization=calibration,
        )


def emulated(
    case: Case, precision: Precision, target: float, requested: Conditioning | None = None, expert: bool = True
) -> tuple[Tensor, Tensor]:
    """(float32, float32 with the plan's sites rounded, the expert's among them), on the host."""
    model, chosen = on_gpu(case.kind), quantization(case.kind, target)
    plan = chosen.plan(model.config, precision)
    in_kernel = expert and refusal(model.config) is None and plan.expert == "fp8"
    used = {
        site: plan.scales[str(site)]
        for site in sites(model.config)
        if str(site) in plan.scales and (in_kernel or site.part != "expert")
    }
    weights = RoundedWeights({site: plan.directions[str(site)] for site in used})
    observation, noise = case.observation.to("cuda"), case.noise.to("cuda")
    exact = model.sample(observation, noise, STEPS, conditioning=requested)
    with rounded(model, used, weights, plan.half_sums):
        return exact.cpu(), model.sample(observation, noise, STEPS, conditioning=requested).cpu()


@pytest.mark.parametrize(
    ("precision", "kernels"),
    [*((one, how) for one in ("fp8", "fp8-mlp") for how in ("auto", "portable")), ("fp8-f16sums", "portable")],
)
@pytest.mark.parametrize("case", CASES)
def test_the_engine_is_as_far_from_float32_as_its_emulation(case: str, precision: Precision, kernels: str) -> None:
    one = golden_cases()[case]
    exact, expected = emulated(one, precision, 0.0)
    ours = backend(one.kind, precision, kernels=kernels).sample(one.observation, one.noise, STEPS).actions
    print(
        f"{case} {precision}: {relative_rms(ours, exact):.4f} of float32, emulated {relative_rms(expected, exact):.4f}"
    )
    assert relative_rms(ours, exact) < 1.3 * relative_rms(expected, exact) + 0.01
    assert relative_rms(ours, expected) < 0.75 * relative_rms(expected, exact) + 0.02


@pytest.mark.parametrize("kernels", ["auto", "portable"])
def test_a_folder_that_keeps_fp8_has_the_same_actions_to_the_last_bit(kernels: str, tmp_path: Path) -> None:
    """Of the denoising kernel, of operations in FP8 (a batch) and of those in bfloat16 (more actions)."""
    calibration, one = quantization("pi05", 0.0), golden_cases()["b_third_masked"]
    source = golden_folder().checkpoint("pi05")
    folder = write_quantized(source, tmp_path / "fp8", calibration, "fp8", torch.device("cuda", 0))
    kept, own = made(open_checkpoint(folder), "fp8", calibration, kernels), backend("pi05", "fp8", kernels=kernels)
    four = Observation(
        **{name: value.repeat(4, *[1] * (value.dim() - 1)) for name, value in vars(one.observation).items()}
    )
    for observation, noise in (
        (one.observation, one.noise),
        (four, one.noise.repeat(4, 1, 1)),
        (one.observation, torch.randn(1, 80, one.noise.shape[2], generator=torch.Generator().manual_seed(0))),
    ):
        actions = [each.sample(observation, noise, STEPS).actions for each in (kept, own)]
        assert bool(actions[0].isfinite().all()) and torch.equal(*actions)


@pytest.mark.parametrize("kernels", ["auto", "portable"])
def test_a_batch_is_as_far_from_float32_as_its_emulation(kernels: str) -> None:
    one = golden_cases()["b_third_masked"]
    exact, expected = emulated(one, "fp8", 0.0)
    four = Observation(
        **{name: value.repeat(4, *[1] * (value.dim() - 1)) for name, value in vars(one.observation).items()}
    )
    runner: Any = backend("pi05", "fp8", kernels=kernels)
    ours = runner.sample(four, one.noise.repeat(4, 1, 1), STEPS).actions
    assert any("4 observations" in batch for batch in runner.describe()["batches"])
    for row in ours:
        assert relative_rms(row[None], exact) < 1.3 * relative_rms(expected, exact) + 0.01
        assert relative_rms(row[None], expected) < 0.75 * relative_rms(expected, exact) + 0.02


@pytest.mark.parametrize("which", ["held", "identity", "staircase"])
@pytest.mark.parametrize("case", ["b_third_masked", "e_horizon50"])
def test_conditioned_calls_are_as_far_from_float32_as_their_emulation(case: str, which: str) -> None:
    one = golden_cases()[case]
    requested = conditioned(which, STEPS, *one.noise.shape[1:])
    exact, expected = emulated(one, "fp8", 0.0, requested)
    runner: Any = backend(one.kind, "fp8")
    ours = runner.sample(one.observation, one.noise, STEPS, conditioning=requested).actions
    free = torch.ones(ours.shape[1], dtype=torch.bool) if requested.held is None else ~torch.from_numpy(requested.held)
    ours, exact, expected = ours[:, free], exact[:, free], expected[:, free]
    assert relative_rms(ours, exact) < 1.3 * relative_rms(expected, exact) + 0.01
    assert relative_rms(ours, expected) < 0.75 * relative_rms(expected, exact) + 0.02


@pytest.mark.parametrize("kernels", ["auto", "portable"])
@pytest.mark.parametrize("which", ["held", "identity", "staircase"])
def test_a_conditioned_batch_is_as_far_from_float32_as_its_emulation(which: str, kernels: str) -> None:
    """Beside a plain row, which is as far as without them."""
    one = golden_cases()["b_third_masked"]
    requested = conditioned(which, STEPS, *one.noise.shape[1:])
    four = Observation(
        **{name: value.repeat(4, *[1] * (value.dim() - 1)) for name, value in vars(one.observation).items()}
    )
    runner: Any = backend("pi05", "fp8", kernels=kernels)
    reported = [requested, None, requested, requested]
    ours = runner.sample(four, one.noise.repeat(4, 1, 1), STEPS, conditioning=reported).actions
    assert any("4 observations" in batch and "by token" in batch for batch in runner.describe()["batches"])
    for row, how in zip(ours, reported, strict=True):
        exact, expected = emulated(one, "fp8", 0.0, how)
        free = torch.ones(len(row), dtype=torch.bool)
        if how is not None and how.held is not None:
            free = ~torch.from_numpy(how.held)
        found, exact, expected = row[None, free], exact[:, free], expected[:, free]
        assert relative_rms(found, exact) < 1.3 * relative_rms(expected, exact) + 0.01
        assert relative_rms(found, expected) < 0.75 * relative_rms(expected, exact) + 0.02


def test_beside_fp8_batches_guided_by_the_jacobian_go_through_the_bf16_expert_and_say_so() -> None:
    one = golden_cases()["b_third_masked"]
    requested = conditioned("jacobian", STEPS, *one.noise.shape[1:])
    two = Observation(
        **{name: value.repeat(2, *[1] * (value.dim() - 1)) for name, value in vars(one.observation).items()}
    )
    runner: Any = backend("pi05", "fp8")
    ours = runner.sample(two, one.noise.repeat(2, 1, 1), STEPS, conditioning=requested).actions
    exact, expected = emulated(one, "fp8", 0.0, requested, expert=False)
    for row in ours:
        assert relative_rms(row[None], exact) < 1.3 * relative_rms(expected, exact) + 0.01
    assert "expert of batches guided by the Jacobian" in runner.describe()["fp8"]["plan"]


def test_beside_fp8_the_true_jacobian_goes_through_the_bf16_expert_and_says_so() -> None:
    one = golden_cases()["b_third_masked"]
    requested = conditioned("jacobian", STEPS, *one.noise.shape[1:])
    runner: Any = backend("pi05", "fp8")
    ours = runner.sample(one.observation, one.noise, STEPS, conditioning=requested).actions
    exact, expected = emulated(one, "fp8", 0.0, requested, expert=False)
    # the way back multiplies each rounding five times, so that two ways to round don't come near each other
    assert relative_rms(ours, exact) < 1.3 * relative_rms(expected, exact) + 0.01
    assert any("no way back" in why for why in runner.describe()["denoising"])


@pytest.mark.parametrize("case", CASES)
def test_sites_kept_in_bf16_reach_the_target(case: str) -> None:
    one = golden_cases()[case]
    exact, _ = emulated(one, "fp8", FP8_TARGET)
    runner = backend(one.kind, "fp8", FP8_TARGET)
    ours = runner.sample(one.observation, one.noise, STEPS).actions
    cosine, difference = delta_cosine(ours, exact, torch.zeros_like(exact)), ours - exact
    print(
        f"{case}: cosine {cosine:.6f}, max {float(difference.abs().max()):.4f}, "
        f"rms {float(difference.square().mean().sqrt()):.5f}, plan {runner.describe()['fp8']['plan']}"
    )
    assert cosine >= FP8_COSINE


def test_operations_have_the_expert_again_when_they_need_it() -> None:
    """The denoising kernel has a copy; the first one waits on the host until a horizon comes that it doesn't cover."""
    case = golden_cases()["b_third_masked"]
    long = torch.randn(1, MAX_SUFFIX + 4, case.noise.shape[-1], generator=torch.Generator().manual_seed(0))

    def fresh() -> Any:
        checkpoint = golden_folder().checkpoint("pi05")
        return FusedBackend(
            checkpoint.config.planned_model,
            lambda to, mode: checkpoint.load(to, mode).state,
            device=torch.device("cuda", 0),
            precision="bf16",
        )

    kernel_first, operations_first = fresh(), fresh()
    by_kernel = kernel_first.sample(case.observation, case.noise, STEPS).actions
    assert {layer.qkv.device.type for layer in kernel_first._weights.expert} == {"cpu"}
    by_operations = operations_first.sample(case.observation, long, STEPS).actions
    assert torch.equal(kernel_first.sample(case.observation, long, STEPS).actions, by_operations)
    assert torch.equal(operations_first.sample(case.observation, case.noise, STEPS).actions, by_kernel)
    assert torch.equal(operations_first.sample(case.observation, long, STEPS).actions, by_operations)
    assert {layer.qkv.device.type for layer in kernel_first._weights.expert} == {"cuda"}


@pytest.mark.parametrize("precision", ["fp8", "fp8-mlp"])
def test_repetition_is_bit_identical(precision: Precision) -> None:
    case = golden_cases()["b_third_masked"]
    runner = backend("pi05", precision)
    first = runner.sample(case.observation, case.noise, STEPS).actions
    for _ in range(5):
        assert torch.equal(runner.sample(case.observation, case.noise, STEPS).actions, first)
