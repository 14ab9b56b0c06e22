"""Turbo-Pi: Pi0.5 robot policies in real time, with openpi's exact semantics."""

import os
import sys
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from turbopi.policy import UnifiedPolicy

__all__ = ["UnifiedPolicy"]

# OpenMP's threads spin while they wait for each other. On a CPU that another program uses, too, a call then takes many
# times as long. OpenMP reads this when torch is imported. A value that is set already stays.
if "torch" not in sys.modules:
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")


def __getattr__(name: str) -> Any:
    # imported when asked for: `turbopi --help` and the server's wire format need no torch
    if name == "UnifiedPolicy":
        from turbopi.policy import UnifiedPolicy

        return UnifiedPolicy
    raise AttributeError(f"module 'turbopi' has no attribute {name!r}")
