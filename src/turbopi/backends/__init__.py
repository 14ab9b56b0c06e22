"""Backends by name. Each module is imported when its backend is needed, so a missing library hurts only its user. Other
distributions may add theirs: docs/extending.md.

Nothing falls back: a backend that can't run raises BackendUnavailable with the reason. Only "auto" chooses, once, and
says what it chose and why; on a GPU that Turbo-Pi's tests never ran on by the verdict of `qualification`.
"""

import importlib
import logging
from dataclasses import dataclass
from pathlib import Path
from typing import get_args

import torch

from turbopi.backends import qualifying
from turbopi.backends.base import Backend, LoadState, Precision, Sample
from turbopi.backends.qualification import (
    COMMAND,
    UNTRIED,
    Verdict,
    file_of,
    is_known,
    unqualified,
    verdict_of,
)
from turbopi.config import ModelConfig, Network
from turbopi.engine.graph import preparing
from turbopi.models import family_of
from turbopi.quantization.calibration_file import Quantization
from turbopi.quantization.plan import HALF_SUMS, ROUNDED, TIERS, WEIGHTS_ALONE, format_of
from turbopi.support import extensions
from turbopi.support.errors import BackendUnavailable, ConfigError

__all__ = [
    "BACKENDS",
    "Backend",
    "LoadState",
    "Precision",
    "Sample",
    "availability",
    "choose",
    "class_for",
    "class_of",
    "create",
    "known",
    "listed",
    "resolve_device",
]

logger = logging.getLogger(__name__)
PRECISIONS: tuple[Precision, ...] = get_args(Precision)
_CAPABILITIES: dict[Precision, str] = {  # that precisions need, where it isn't FP8's
    WEIGHTS_ALONE: "8.0 or newer",
    HALF_SUMS: "8.9 or 12.x",
    "int8": "8.x, 9.0 or 12.x",
    "nvfp4": "10.x, 11.0 or 12.x",
}


@dataclass(frozen=True)
class BackendSpec:
    """Where a backend lives.

    extension  of another distribution's
    unplanned  "module:class" that runs under this name what the engine has no plan for
    tokens     "module:class" that runs under this name models that write their actions as tokens
    text       "module:class" that runs under this name a Pi0.5 that writes the subtasks it acts on
    """

    name: str
    module: str
    cls: str
    summary: str
    extension: extensions.Extension | None = None
    unplanned: str | None = None
    tokens: str | None = None
    text: str | None = None


_SPECS = (
    BackendSpec(
        "pytorch",
        "turbopi.backends.pytorch",
        "PyTorchBackend",
        "the reference, eager: any device",
        tokens="turbopi.backends.tokens:TokensBackend",
    ),
    BackendSpec(
        "pytorch_compile",
        "turbopi.backends.pytorch_compile",
        "PyTorchCompileBackend",
        "the reference through torch.compile: any device with a compiler",
    ),
    BackendSpec(
        "cuda_graph",
        "turbopi.backends.cuda_graph",
        "CudaGraphBackend",
        "the whole call in CUDA graphs, PyTorch's kernels: NVIDIA GPUs from compute capability 8.0",
        unplanned="turbopi.backends.captured:CapturedBackend",
        tokens="turbopi.backends.tokens:CapturedTokensBackend",
        text="turbopi.backends.captured_text:CapturedTextBackend",
    ),
    BackendSpec(
        "fused",
        "turbopi.backends.fused",
        "FusedBackend",
        "cuda_graph with kernels of our own: NVIDIA GPUs from 8.0; FP8 from 8.9 on, INT8 but on 10.x and 11.0, NVFP4 "
        "on 10.x, 11.0 and 12.x",
        unplanned="turbopi.backends.fused_smolvla:FusedSmolVLABackend",
    ),
    BackendSpec(
        "emulated_fp8",
        "turbopi.backends.emulated_fp8",
        "EmulatedFp8Backend",
        "the reference with a calibration's FP8 roundings, exact and slow, to judge FP8 by: any device",
    ),
    BackendSpec(
        "emulated_int8",
        "turbopi.backends.emulated_fp8",
        "EmulatedInt8Backend",
        "the reference with a calibration's INT8 roundings, exact and slow, to judge INT8 by: any device",
    ),
    BackendSpec(
        "emulated_nvfp4",
        "turbopi.backends.emulated_fp8",
        "EmulatedNvfp4Backend",
        "the reference with a calibration's NVFP4 roundings, exact and slow, to judge NVFP4 by: any device",
    ),
    BackendSpec(
        "onnx",
        "turbopi.backends.onnx.backend",
        "OnnxBackend",
        "the exported ONNX graphs in ONNX Runtime, f32: CPUs",
    ),
    BackendSpec(
        "tensorrt",
        "turbopi.backends.tensorrt.backend",
        "TensorRTBackend",
        "TensorRT engines for vision, prefix MLPs and denoising: NVIDIA GPUs from compute capability 8.0",
    ),
    BackendSpec(
        "tensorrt_fp8",
        "turbopi.backends.tensorrt.fp8",
        "TensorRTFp8Backend",
        "tensorrt with calibrated E4M3 MLPs in the prefix: NVIDIA GPUs from compute capability 8.9",
    ),
    BackendSpec(
        "tensorrt_pipelined",
        "turbopi.backends.tensorrt.pipelined",
        "TensorRTPipelinedBackend",
        "tensorrt with two observations in flight: throughput, not latency",
    ),
)
_FASTEST_FIRST = ("fused", "cuda_graph", "pytorch_compile")
BACKENDS: dict[str, BackendSpec] = {spec.name: spec for spec in _SPECS}  # Turbo-Pi's own


def known() -> dict[str, BackendSpec]:
    """All backends by name: Turbo-Pi's own, then those of other distributions, which this doesn't import."""
    others = extensions.found(extensions.BACKENDS, [*BACKENDS, "auto"])
    found = dict(BACKENDS)
    for name, one in others.items():
        module, _, cls = one.value.partition(":")
        found[name] = BackendSpec(name, module, cls, f"{one.summary} ({one.distribution})".strip(), one)
    return found


def listed() -> dict[str, BackendSpec]:
    """`known` without backends of others that can't be loaded: each is named in a warning."""
    found = known()
    for name in sorted(found.keys() - BACKENDS.keys()):
        try:
            class_of(name)
        except BackendUnavailable as error:
            logger.warning("skipped: %s", error)
            del found[name]
    return found


def resolve_device(device: str | torch.device) -> torch.device:
    """ "auto" is the first NVIDIA GPU if there is one, else the CPU. Raises ConfigError for what isn't there."""
    if str(device) == "auto":
        return torch.device("cuda", torch.cuda.current_device()) if torch.cuda.is_available() else torch.device("cpu")
    try:
        resolved = torch.device(device)
    except RuntimeError as error:
        raise ConfigError(f"unknown device {device!r}; use 'auto', 'cpu', 'cuda' or 'cuda:N'") from error
    if resolved.type == "cpu":
        return torch.device("cpu")
    if resolved.type != "cuda":
        raise ConfigError(f"device {device!r} isn't supported; use 'auto', 'cpu', 'cuda' or 'cuda:N'")
    if not torch.cuda.is_available():
        raise ConfigError(f"device {device!r} was asked for, but PyTorch sees no NVIDIA GPU; run `turbopi doctor`")
    index = torch.cuda.current_device() if resolved.index is None else resolved.index
    if index >= torch.cuda.device_count():
        raise ConfigError(f"device {device!r} was asked for, but there are {torch.cuda.device_count()} GPUs")
    return torch.device("cuda", index)


def availability(name: str, device: torch.device) -> str | None:
    """None if the backend can run on the device, else why not and what to do."""
    return _unavailable(class_of(name), device)


def _unavailable(cls: type[Backend], device: torch.device) -> str | None:
    try:
        return cls.unavailable(device)
    except Exception as error:
        if cls.__module__.startswith("turbopi."):
            raise
        return f"its check of the device failed: {extensions.reason(error)}"


def choose(
    device: torch.device, precision: Precision = "bf16", model: Network | None = None, *, writes: bool = False
) -> tuple[str, str]:
    """The backend that "auto" stands for on a device in a precision, and why.

    model   None: one of Pi0 or Pi0.5
    writes  as `class_for`
    """
    if writes and precision not in TIERS:
        captured = availability("cuda_graph", device) is None
        return "cuda_graph" if captured else "pytorch", "auto: the fastest backend that writes subtasks"
    if precision in TIERS:
        on_gpu = device.type == "cuda"
        untried = _untried(device, precision, model) if on_gpu else None
        slow = on_gpu and precision == "int8" and torch.cuda.get_device_capability(device) == (9, 0)
        slow = slow and (model is None or family_of(model).planned)  # measured of these alone
        said = [f"the fast one of those that run in {precision}", untried, "fp8 is quicker here" * slow]
        return "fused", f"auto: {'; '.join(one for one in said if one)}"
    if device.type == "cpu":
        return "pytorch", "auto: on a CPU the eager reference starts at once and compiling gains little"
    reasons: list[str] = []
    for name in _FASTEST_FIRST:
        if precision not in all_precisions(name):
            continue
        reason, qualified = availability(name, device), ""
        if reason is None and model is not None:
            reason = _refuses(class_for(name, model), model, precision)
        if reason is None and name == "fused" and not is_known(device):
            verdict = verdict_of(device, precision, model or ModelConfig())
            if verdict is None or verdict.taken != name:
                reason = f"{_untried(device, precision, model)}; try it with backend='fused'"
            else:
                qualified = f": {verdict.summary}"
        if reason is None:
            skipped = f" ({'; '.join(reasons)})" if reasons else ""
            return name, f"auto: the fastest backend for this GPU and precision{qualified}{skipped}"
        reasons.append(f"not {name}: {reason}")
    return "pytorch", f"auto: {'; '.join(reasons)}"


def _refuses(cls: type[Backend], model: Network, precision: Precision) -> str | None:
    if (why := cls.refuses_model(model)) is not None or precision in cls.precisions:
        return why
    return f"it runs {family_of(model).label} in {' or '.join(cls.precisions)}"


def _untried(device: torch.device, precision: Precision, model: Network | None) -> str | None:
    """What is known of `fused` on a GPU that Turbo-Pi's tests never ran on; None if they did."""
    if is_known(device):
        return None
    verdict = verdict_of(device, precision, model or ModelConfig())
    if verdict is None:
        return f"it isn't qualified on this GPU yet, which {COMMAND} does"
    return f"tested on this GPU: {verdict.summary}"


def qualified(
    device: torch.device,
    precision: Precision,
    model: Network,
    *,
    bar: bool = False,
    writes: bool = False,
    kept: bool = False,
) -> None:
    """Where "auto" could take `fused` on a GPU that Turbo-Pi's tests never ran on, find out once whether it should.

    Raises BackendUnavailable where `fused` fails in a precision that no other backend has. kept: as `check`.
    """
    if (
        (writes and precision not in TIERS)
        or device.type != "cuda"
        or precision in UNTRIED  # which `create` refuses
        or is_known(device)
        or refusal("fused", device, precision, model) is not None
    ):
        return
    verdict = verdict_of(device, precision, model)
    if verdict is None or 0 < verdict.unfinished < qualifying.TURNS:
        what = f"backend 'fused' for {family_of(model).label} in {precision} on {torch.cuda.get_device_name(device)}"
        with qualifying.shown(bar, what, qualifying.SECONDS) as tell:
            verdict = qualifying.qualify(device, precision, model, tell=tell)
    check_verdict(verdict, file_of(device, precision, model), kept=kept)


def check_verdict(verdict: Verdict, file: Path, *, kept: bool = False) -> None:
    """Raise BackendUnavailable if nothing is to run in its precision. kept: as `check`."""
    if verdict.taken is None:
        other = "take the checkpoint that the folder was made from" if kept else "take precision 'bf16'"
        raise BackendUnavailable(
            f"{verdict.precision} can't run on {verdict.gpu}: {verdict.summary}; {other}, and "
            f"{verdict.issue(file)}; backend 'fused' by name runs it all the same"
        )


def refusal(name: str, device: torch.device, precision: Precision, model: Network) -> str | None:
    """Why a backend can't run a model on a device in a precision, whatever was qualified; None if it can."""
    cls = class_for(name, model)
    if not _is_for(precision, model):
        return _not_for(precision, model)
    return _unavailable(cls, device) or cls.unavailable_in(device, precision) or _refuses(cls, model, precision)


def checked_precision(precision: str) -> Precision:
    """Raises ConfigError for one that doesn't exist."""
    for one in PRECISIONS:
        if one == precision:
            return one
    raise ConfigError(f"unknown precision {precision!r}; choose one of {', '.join(PRECISIONS)}")


def check(
    name: str, device: torch.device, precision: Precision, model: Network | None = None, *, kept: bool = False
) -> None:
    """Raise ConfigError for an unknown name or precision, or one that isn't the model's; BackendUnavailable where the
    backend can't run the model or on the device.

    model  None: one of Pi0 or Pi0.5
    kept   whether its weights are there in this precision alone
    """
    checked_precision(precision)
    cls, given, model = class_of(name), model, model or ModelConfig()
    if given is not None and not _is_for(precision, model):
        raise ConfigError(f"{_not_for(precision, model)}{_instead(device, precision, model, kept)}")
    if precision not in (own := all_precisions(name)):
        where = f"only {' or '.join(own)}"
        if precision == WEIGHTS_ALONE:
            where = "models that write their actions as tokens do, in backend 'cuda_graph' on an NVIDIA GPU"
        raise ConfigError(f"backend {name!r} doesn't run in {precision!r}: {where}")
    if given is not None and (why := class_for(name, given).refuses_model(given)) is not None:
        raise BackendUnavailable(why)
    reason, what = _unavailable(cls, device), "run"
    if precision in ROUNDED and reason is not None and device.type != "cuda":
        which = _CAPABILITIES.get(precision, "8.9 or newer")
        reason = f"{precision} needs an NVIDIA GPU of compute capability {which}"
        reason += _instead(device, precision, model, kept)
    elif precision in TIERS and (other_gpu := cls.unavailable_in(device, precision)) is not None:
        reason, what = other_gpu, f"run in {precision}"  # before what a package would mend
        reason += _instead(device, precision, model, kept)
    elif reason is None and given is not None and name == "fused":
        reason, what = unqualified(device, precision, given), f"run in {precision}"
    if reason is not None:
        raise BackendUnavailable(f"backend {name!r} can't {what} on {device}: {reason}")


def _is_for(precision: Precision, model: Network) -> bool:
    """Whether a backend runs models of this family in this precision, on some device."""
    family = family_of(model)
    if precision == WEIGHTS_ALONE:
        return family.reader is not None
    return precision in family.tiers or precision not in TIERS


def _not_for(precision: Precision, model: Network) -> str:
    return f"precision {precision!r} isn't for {family_of(model).label}"


def _instead(device: torch.device, precision: Precision, model: Network, kept: bool) -> str:
    """What to do where one of `ROUNDED` can't run: what this model can on this device. Empty if that is nothing."""
    if kept:
        return ""
    runs: list[tuple[str, Precision]] = [("cuda_graph", WEIGHTS_ALONE), ("fused", "fp8"), ("fused", "int8")]
    others = [one for name, one in runs if one != precision and refusal(name, device, one, model) is None]
    advice = "; take precision " + " or ".join(map(repr, ("bf16", *others)))
    if device.type != "cuda" and precision in TIERS and _is_for(precision, model):
        format = format_of(precision)
        advice += f", or to judge {format.label} without such a GPU backend 'emulated_{format.name}'"
    return advice


def create(
    name: str,
    config: Network,
    load: LoadState,
    *,
    device: torch.device,
    precision: Precision,
    quantization: Quantization | None = None,
    writes: bool = False,
) -> Backend:
    """Build the backend called `name` around a checkpoint's tensors. Raises what `check` raises.

    quantization   for FP8 and INT8 alone: the calibration of this very checkpoint
    writes         as `class_for`
    """
    check(name, device, precision)
    cls = class_for(name, config, writes=writes)
    if (why := cls.refuses_model(config)) is not None:
        raise BackendUnavailable(why)
    if (why := _refuses(cls, config, precision)) is not None:
        raise ConfigError(f"backend {name!r} can't run in {precision!r} here: {why}")
    if name == "fused" and (why := unqualified(device, precision, config)) is not None:
        raise BackendUnavailable(f"backend {name!r} can't run in {precision} on {device}: {why}")
    with preparing(device):
        return cls(config, load, device=device, precision=precision, quantization=quantization)


def precisions(name: str, model: Network | None = None) -> tuple[Precision, ...]:
    """The precisions a backend runs a model in; None: Pi0 and Pi0.5."""
    return tuple(one for one in class_of(name).precisions if model is None or _is_for(one, model))


def all_precisions(name: str) -> tuple[Precision, ...]:
    """The same, with those of models that write their actions as tokens."""
    own, spec = precisions(name), BACKENDS.get(name)
    if spec is None or spec.tokens is None:
        return own
    return tuple(dict.fromkeys((*own, *_loaded(spec.tokens).precisions)))


def class_of(name: str) -> type[Backend]:
    """The backend's class. Raises ConfigError for an unknown name, BackendUnavailable for another's that is broken."""
    spec = BACKENDS.get(name) or known().get(name)
    if spec is None:
        raise ConfigError(f"unknown backend {name!r}; choose one of {', '.join(known())}, or 'auto'")
    if spec.extension is not None:
        return _checked(spec.extension)
    cls: type[Backend] = getattr(importlib.import_module(spec.module), spec.cls)
    return cls


def class_for(name: str, config: Network, *, writes: bool = False) -> type[Backend]:
    """`class_of`, or the one that runs under that name what the engine has no plan for, or what writes tokens.

    writes  a Pi0.5 that writes the subtasks it acts on
    """
    spec, cls = BACKENDS.get(name), class_of(name)
    if spec is None:
        return cls
    place = spec.unplanned if cls.refuses_model(config) is not None else None
    if family_of(config).reader is not None:
        place = spec.tokens
    if writes and spec.text is not None:
        place = spec.text
    if place is None:
        return cls
    return _loaded(place)


def _loaded(place: str) -> type[Backend]:
    module, _, name = place.partition(":")
    found: type[Backend] = getattr(importlib.import_module(module), name)
    return found


def _checked(extension: extensions.Extension) -> type[Backend]:
    try:
        cls: type[Backend] = extension.load()
    except ConfigError as error:
        raise BackendUnavailable(str(error)) from error
    if not (isinstance(cls, type) and issubclass(cls, Backend)):
        raise BackendUnavailable(f"the {extension} is no backend: it should derive from turbopi.backends.Backend")
    lacking = [one for one in ("name", "precisions") if not hasattr(cls, one)] + sorted(cls.__abstractmethods__)
    if lacking:
        raise BackendUnavailable(f"the {extension} is no backend: it lacks {', '.join(lacking)}")
    if cls.name != extension.name:
        raise BackendUnavailable(f"the {extension} has the name {cls.name!r}; expected {extension.name!r}")
    return cls
