"""A backend against a golden folder: errors per tensor beside their bounds.

float32 is held to absolute bounds: against openpi's PyTorch, what two float32 implementations with a float64 time
embedding must reach; against its JAX, whose float32 time embedding and RoPE angles are off by more, the bounds that the
two openpi implementations fairly reach between themselves.

bfloat16 is held to openpi's own error: the relative rms against float32 may be 1.1 times the worse of openpi's PyTorch
and JAX on the same tensor, or float32's own rounding where openpi stays in float32 (cond). Tensors for which the folder
has no bfloat16 numbers of openpi are shown without a bound.

FP8 and INT8 are calibrated on the golden cases themselves, for the target that is asked of them here: a cosine of
0.9995 of the actions, which is a relative rms of 3.2 %. Other tensors are shown without a bound. The sites that stay in
bfloat16 for that are calibration's choice.
"""

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch

from turbopi import backends
from turbopi.backends import Precision
from turbopi.calibrate.run import Settings, calibrate_model
from turbopi.calibrate.statistics import Method
from turbopi.config import PiKind
from turbopi.engine.emulate import NO_SIGNAL, has_signal
from turbopi.models.observation import ModelInputs
from turbopi.models.pi0.reference import Pi0Model
from turbopi.policy.examples import Example, NoisyExample
from turbopi.quantization.calibration_file import Quantization, shapes_of
from turbopi.quantization.formats import FP8, Format, Numbers
from turbopi.quantization.plan import TIERS, format_of
from turbopi.support.errors import CheckpointError
from turbopi.verify.golden import Arrays, Case, GoldenFolder, Run

# max absolute error against torch_fp32. Masks, positions and times must be equal.
F32_AGAINST_TORCH = {
    "vision_last_hidden": 2e-5,
    "prefix_embs": 1e-5,
    "kv_k": 2e-5,
    "kv_v": 2e-5,
    "cond": 1e-5,
    "expert_hidden_step0": 5e-5,
    "suffix_out": 3e-5,
    "v_t": 3e-5,
    "x_t": 1e-5,
    "actions": 1e-5,
}
# max absolute error against jax_fp32; actions of a single step: 6e-4
F32_AGAINST_JAX = {
    "prefix_embs": 2e-5,
    "kv_k": 4e-4,
    "kv_v": 5e-5,
    "cond": 2e-4,
    "suffix_out": 1.5e-3,
    "v_t": 1.5e-3,
    "x_t": 6e-4,
    "actions": 3e-4,
}
SINGLE_STEP_ACTIONS_AGAINST_JAX = 6e-4
EXACT = ("prefix_pad_mask", "prefix_positions", "times")
BF16_FACTOR = 1.1  # times the worse of openpi's two
FLOAT32_ROUNDING = 1e-6  # relative rms
FP8_COSINE = 0.9995  # of the actions
FP8_BOUND = (1 - FP8_COSINE**2) ** 0.5  # relative rms: what that cosine allows
FP8_TARGET = 0.9997  # asked of calibration, which aims at it with emulated float32 between the roundings
GOLDEN_METHODS: dict[Numbers, tuple[Method, ...]] = {
    **dict.fromkeys(("fp8", "nvfp4"), ("headroom",)),
    "int8": ("mse",),
}  # how scales are chosen


@dataclass(frozen=True)
class Comparison:
    """One tensor of one run. `max` and `rms` are absolute; `relative_rms` is rms / rms of the golden tensor."""

    case: str
    num_steps: int
    precision: Precision
    against: str
    tensor: str
    max: float
    rms: float
    relative_rms: float
    bound: float | None  # on `max` in f32, else on `relative_rms`; None: shown, not judged
    ok: bool | None


def check_folder(
    folder: GoldenFolder, backend: str, precisions: tuple[Precision, ...], device: torch.device
) -> Iterator[list[Comparison]]:
    """Compare every run of every case: yields one list a case and precision."""
    loaded: dict[tuple[str, Precision], backends.Backend] = {}
    for case in folder.cases():
        for precision in precisions:
            if (case.kind, precision) not in loaded:
                checkpoint = folder.checkpoint(case.kind)
                loaded[case.kind, precision] = backends.create(
                    backend,
                    checkpoint.config.planned_model,
                    lambda to, mode, checkpoint=checkpoint: checkpoint.load(to, mode).state,  # type: ignore[misc]
                    device=device,
                    precision=precision,
                    quantization=golden_calibration(folder, case.kind, device, format=format_of(precision))
                    if precision in TIERS
                    else None,
                )
            yield check_case(case, loaded[case.kind, precision])


def golden_calls(case: Case) -> list[NoisyExample]:
    """A case's rows as calibration takes them."""
    observation = case.observation
    fields = [getattr(observation, name).numpy() for name in ("images", "image_mask", "tokens", "token_mask", "state")]
    examples = [
        Example(f"{case.name} {row}", ModelInputs(*(field[row] for field in fields)), fields[-1][row])
        for row in range(observation.batch_size)
    ]
    return [
        NoisyExample(row, example, row, case.noise[row : row + 1], first=True) for row, example in enumerate(examples)
    ]


def golden_calibration(
    folder: GoldenFolder, kind: PiKind, device: torch.device, target: float = FP8_TARGET, format: Format = FP8
) -> Quantization:
    """A calibration on the golden cases of a kind that have the first's horizon; what it reports is on them, too."""
    checkpoint = folder.checkpoint(kind)
    model = Pi0Model.from_state(checkpoint.config.planned_model, checkpoint.load(device, "f32").state)
    calls = [call for case in folder.cases() if case.kind == kind for call in golden_calls(case)]
    calls = [call for call in calls if call.noise.shape == calls[0].noise.shape]
    twice = sorted(calls * 2, key=lambda call: call.example.source)  # one gives directions, the other chooses sites
    settings = Settings({}, target=target, batch=1, methods=GOLDEN_METHODS[format.name], format=format)
    measured = calibrate_model(model, twice, calls, 3, settings)
    report = {**measured.report, "observations": {"source": "the golden cases themselves"}}
    return Quantization(checkpoint.fingerprint(), shapes_of(model.config), measured.sites, report, format.name)


def check_case(case: Case, backend: backends.Backend) -> list[Comparison]:
    """Compare a backend, at its precision, with every run of a case.

    Actions come from `sample`, the call a policy makes; intermediates from `intermediates`.
    """
    comparisons = []
    for run in case.runs:
        _check_signal(case, run)
        ours = _as_arrays(backend.intermediates(case.observation, case.noise, run.num_steps))
        ours["actions"] = backend.sample(case.observation, case.noise, run.num_steps).actions.numpy()
        if backend.precision == "f32":
            comparisons += _compare_f32(case, run, ours)
        else:
            comparisons += _compare_rounded(case, run, ours, backend.precision)
    return comparisons


def _compare_f32(case: Case, run: Run, ours: Arrays) -> list[Comparison]:
    comparisons = []
    for against, bounds in (("torch_fp32", F32_AGAINST_TORCH), ("jax_fp32", F32_AGAINST_JAX)):
        for name, golden in run.variants.get(against, {}).items():
            bound = 0.0 if name in EXACT else bounds.get(name)
            if (against, name, run.num_steps) == ("jax_fp32", "actions", 1):
                bound = SINGLE_STEP_ACTIONS_AGAINST_JAX
            if name in ours and bound is not None:
                max_, rms, relative = _errors(*_attended(name, ours[name], golden, case))
                comparisons.append(
                    Comparison(
                        case.name, run.num_steps, "f32", against, name, max_, rms, relative, bound, max_ <= bound
                    )
                )
    return comparisons


def _compare_rounded(case: Case, run: Run, ours: Arrays, precision: Precision) -> list[Comparison]:
    oracle = run.variants.get("torch_fp32") or run.variants.get("jax_fp32") or {}
    against = "torch_fp32" if "torch_fp32" in run.variants else "jax_fp32"
    comparisons = []
    for name, golden in oracle.items():
        if name not in ours or name in EXACT:
            continue
        max_, rms, relative = _errors(*_attended(name, ours[name], golden, case))
        if precision in TIERS:
            bound = FP8_BOUND if name == "actions" else None
        else:
            worst = _openpi_bf16_error(name, run, case)
            bound = None if worst is None else max(BF16_FACTOR * worst, FLOAT32_ROUNDING)
        ok = None if bound is None else relative <= bound < float("inf")  # inf: openpi's own bf16 isn't finite
        comparisons.append(
            Comparison(case.name, run.num_steps, precision, against, name, max_, rms, relative, bound, ok)
        )
    return comparisons


def _check_signal(case: Case, run: Run) -> None:
    """CheckpointError if openpi's actions are such that any backend would agree."""
    for variant, arrays in run.variants.items():
        if "actions" in arrays and not has_signal(arrays["actions"], case.noise.numpy()):
            raise CheckpointError(f"{case.name}, {variant}, {run.num_steps} steps: nothing to judge: {NO_SIGNAL}")


def _openpi_bf16_error(name: str, run: Run, case: Case) -> float | None:
    """The worse relative rms of openpi's two bfloat16 implementations, each against float32 of its own kind."""
    errors = []
    for bf16, f32 in (("torch_bf16", "torch_fp32"), ("jax_bf16", "jax_fp32")):
        rounded, exact = run.variants.get(bf16, {}).get(name), run.variants.get(f32, {}).get(name)
        if rounded is not None and exact is not None:
            errors.append(_errors(*_attended(name, rounded, exact, case))[2])
    return max(errors, default=None)


def _attended(name: str, ours: np.ndarray, golden: np.ndarray, case: Case) -> tuple[np.ndarray, np.ndarray]:
    """Both tensors without the slots that nothing ever attends to, which need not match."""
    if ours.shape != golden.shape:
        raise AssertionError(f"{case.name}: {name} has shape {ours.shape}, the golden one {golden.shape}")
    cameras = case.observation.image_mask.numpy()
    valid = np.concatenate((cameras.repeat(256, axis=1), case.observation.token_mask.numpy()), axis=1)
    if name == "prefix_embs":
        return ours[valid], golden[valid]
    if name in ("kv_k", "kv_v"):
        return ours[:, valid], golden[:, valid]
    if name == "vision_last_hidden":
        return ours[cameras.T], golden[cameras.T]
    return ours, golden


def _errors(ours: np.ndarray, golden: np.ndarray) -> tuple[float, float, float]:
    """Max, rms and relative rms of the difference; infinite if anything isn't finite."""
    if not np.isfinite(ours).all():
        return float("inf"), float("inf"), float("inf")
    difference = ours.astype(np.float64) - golden.astype(np.float64)
    rms = float(np.sqrt(np.mean(difference**2)))
    scale = float(np.sqrt(np.mean(golden.astype(np.float64) ** 2)))
    return float(np.abs(difference).max()), rms, rms / scale if scale else rms


def _as_arrays(trace: dict[str, torch.Tensor]) -> Arrays:
    return {
        name: (tensor.float() if tensor.is_floating_point() else tensor).cpu().numpy() for name, tensor in trace.items()
    }


def as_json(folder: GoldenFolder, backend: str, comparisons: list[Comparison]) -> dict[str, Any]:
    """The whole verdict as one plain document."""
    judged = [c for c in comparisons if c.ok is not None]
    return {
        "folder": str(folder.path),
        "backend": backend,
        "ok": bool(judged) and all(c.ok for c in judged),
        "judged": len(judged),
        "failed": sum(not c.ok for c in judged),
        "compared": compared_tensors(comparisons),
        "comparisons": [asdict(c) for c in comparisons],
    }


def compared_tensors(comparisons: list[Comparison]) -> dict[str, list[str]]:
    """Precision -> the names of the tensors that were compared."""
    names: dict[str, list[str]] = {}
    for c in comparisons:
        if c.tensor not in names.setdefault(c.precision, []):
            names[c.precision].append(c.tensor)
    return names
