"""Turbo-Pi: Pi0.5 robot policies in real time, with openpi's exact semantics.

The names in `__all__` are the public interface, with those that docs/api.md lists; everything else may change.
"""

import importlib
import os
import sys
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from turbopi import errors
    from turbopi.checkpoint import open_checkpoint
    from turbopi.config import PolicyConfig
    from turbopi.errors import (
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
    from turbopi.policy import UnifiedPolicy
    from turbopi.robots import Robot, RobotInputs

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
        return importlib.import_module("turbopi.errors")
    try:
        module = importlib.import_module(f"turbopi.{_MODULES.get(name, 'errors')}")
    except ModuleNotFoundError as missing:
        if missing.name != "torch":
            raise
        raise ImportError(
            f"turbopi.{name} needs PyTorch, which isn't installed: scripts/setup of Turbo-Pi's clone does it. A "
            "robot's computer that asks a server needs turbopi.client alone, without PyTorch (docs/real_time.md)",
            name="torch",
        ) from missing
    return getattr(module, name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
