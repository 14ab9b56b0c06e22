"""Turbo-Pi: Pi0.5 robot policies in real time, with openpi's exact semantics.

The names in `__all__` are the public interface, with those that docs/api.md lists; everything else may change.
"""

import importlib
import os
import sys
import warnings
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from turbopi.checkpoint import open_checkpoint
    from turbopi.config import PolicyConfig
    from turbopi.policy.policy import UnifiedPolicy
    from turbopi.robots import Robot, RobotInputs
    from turbopi.support import errors
    from turbopi.support.errors import (
        ActionError,
        BackendError,
        BackendUnavailable,
        CalibrationError,
        CheckpointError,
        ConfigError,
        DeviceLost,
        ObservationError,
        OutputError,
        TokenizerError,
        TurboPiError,
    )

    __version__: str

__all__ = [
    "ActionError",
    "BackendError",
    "BackendUnavailable",
    "CalibrationError",
    "CheckpointError",
    "ConfigError",
    "DeviceLost",
    "ObservationError",
    "OutputError",
    "PolicyConfig",
    "Robot",
    "RobotInputs",
    "TokenizerError",
    "TurboPiError",
    "UnifiedPolicy",
    "__version__",
    "errors",
    "open_checkpoint",
]

_MODULES = {
    "PolicyConfig": "config",
    "Robot": "robots",
    "RobotInputs": "robots",
    "UnifiedPolicy": "policy",
    "open_checkpoint": "checkpoint",
}

# OpenMP's threads spin while they wait for each other. On a CPU that another program uses, too, a call then takes many
# times as long. OpenMP reads this when torch is imported. A value that is set already stays.
if "torch" not in sys.modules:
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")


def __getattr__(name: str) -> object:
    # imported when asked for: `turbopi --help` and the server's wire format need no torch
    if name == "__version__":
        return importlib.import_module("turbopi.version").turbopi_version()
    if name not in __all__:
        raise AttributeError(f"module 'turbopi' has no attribute {name!r}")
    if name == "errors":
        return importlib.import_module("turbopi.support.errors")
    try:
        return getattr(importlib.import_module(f"turbopi.{_MODULES.get(name, 'errors')}"), name)
    except ModuleNotFoundError as missing:
        if missing.name != "torch":
            raise
        raise ImportError(
            f"turbopi.{name} needs PyTorch, which isn't installed: scripts/setup of Turbo-Pi's clone does it. A "
            "robot's computer that calls a server needs turbopi.realtime alone, without PyTorch (docs/real_time.md)",
            name="torch",
        ) from missing


# Names of 0.1's modules, found for one version more. `turbopi.errors` stays a public name.
_MOVED = {
    "arguments": "policy.call_options",
    "client": "realtime.client",
    "errors": "support.errors",
    "examples": "policy.examples",
    "execution": "realtime",
    "files": "support.files",
    "joining": "policy.chunk_conditioning",
    "model": "models.pi0",
    "model_call": "policy.model_call",
    "observation": "models.observation",
    "plots": "support.plots",
    "provenance": "support.provenance",
    "reading": "support.reading",
    "running_chunk": "realtime.running_chunk",
    "serve.schedule": "serve.scheduling.schedule",
    "shipped": "policy.shipped",
    "wire": "realtime.wire",
}


class _MovedModules:  # importlib.abc's classes take long to import, and Ctrl-C meanwhile shows a traceback
    """Finds a moved module, or one inside a moved folder, under its name of 0.1: the same module object."""

    def find_spec(self, fullname: str, path: object = None, target: object = None) -> ModuleSpec | None:
        for old, new in _MOVED.items():
            if fullname == f"turbopi.{old}" or fullname.startswith(f"turbopi.{old}."):
                moved = f"turbopi.{new}{fullname.removeprefix(f'turbopi.{old}')}"
                return ModuleSpec(fullname, self, origin=moved)  # type: ignore[arg-type]
        return None

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        if spec.name != "turbopi.errors":
            warnings.warn(f"{spec.name} is {spec.origin} now", DeprecationWarning, stacklevel=2)
        module = importlib.import_module(str(spec.origin))
        spec.loader_state = module.__spec__
        return module

    def exec_module(self, module: ModuleType) -> None:
        # it has run under its own name; what imports it has put the old name's spec there
        assert module.__spec__ is not None
        module.__spec__ = module.__spec__.loader_state


sys.meta_path.insert(0, _MovedModules())  # first: a moved folder would find its files a second time


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
