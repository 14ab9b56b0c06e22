"""Backends by name. Each module is imported when its backend is asked for, so a missing library hurts only its user.

Nothing falls back: a backend that can't run raises BackendUnavailable with the reason. Only "auto" chooses, once, and
says what it chose and why.
"""

import importlib
from dataclasses import dataclass

import torch

from turbopi.backends.base import Backend, LoadState, Sample
from turbopi.config import ModelConfig
from turbopi.errors import BackendUnavailable, ConfigError
from turbopi.model.reference import Precision

__all__ = ["BACKENDS", "Backend", "LoadState", "Sample", "availability", "choose", "create", "resolve_device"]

PRECISIONS: tuple[Precision, ...] = ("bf16", "f32")


@dataclass(frozen=True)
class BackendSpec:
    """Where a backend lives."""

    name: str
    module: str
    cls: str
    summary: str


_SPECS = (
    BackendSpec("pytorch", "turbopi.backends.pytorch", "PyTorchBackend", "the reference, eager: any device"),
    BackendSpec(
        "pytorch_compile",
        "turbopi.backends.pytorch_compile",
        "PyTorchCompileBackend",
        "the reference through torch.compile: any device with a compiler",
    ),
)
BACKENDS: dict[str, BackendSpec] = {spec.name: spec for spec in _SPECS}


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
    return _backend_class(name).unavailable(device)


def choose(device: torch.device) -> tuple[str, str]:
    """The backend that "auto" stands for on a device, and why."""
    if device.type == "cpu":
        return "pytorch", "auto: on a CPU the eager reference starts at once and compiling gains little"
    reason = availability("pytorch_compile", device)
    if reason is None:
        return "pytorch_compile", "auto: the fastest backend available on this GPU"
    return "pytorch", f"auto: pytorch_compile can't run here ({reason})"


def create(name: str, config: ModelConfig, load: LoadState, *, device: torch.device, precision: Precision) -> Backend:
    """Build the backend called `name` around a checkpoint's tensors.

    Raises ConfigError for an unknown name or precision, BackendUnavailable where it can't run.
    """
    if precision not in PRECISIONS:
        raise ConfigError(f"unknown precision {precision!r}; choose one of {', '.join(PRECISIONS)}")
    cls = _backend_class(name)
    if precision not in cls.precisions:
        raise ConfigError(f"backend {name!r} runs in {' or '.join(cls.precisions)}, not in {precision!r}")
    reason = cls.unavailable(device)
    if reason is not None:
        raise BackendUnavailable(f"backend {name!r} can't run on {device}: {reason}")
    return cls(config, load, device=device, precision=precision)


def precisions(name: str) -> tuple[Precision, ...]:
    """The precisions a backend runs in."""
    return _backend_class(name).precisions


def _backend_class(name: str) -> type[Backend]:
    if name not in BACKENDS:
        raise ConfigError(f"unknown backend {name!r}; choose one of {', '.join(BACKENDS)}, or 'auto'")
    spec = BACKENDS[name]
    cls: type[Backend] = getattr(importlib.import_module(spec.module), spec.cls)
    return cls
