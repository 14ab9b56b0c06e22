"""Turbo-Pi: Pi0.5 robot policies in real time, with openpi's exact semantics."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from turbopi.policy import UnifiedPolicy

__all__ = ["UnifiedPolicy"]


def __getattr__(name: str) -> Any:
    # imported when asked for: `turbopi --help` and the server's wire format need no torch
    if name == "UnifiedPolicy":
        from turbopi.policy import UnifiedPolicy

        return UnifiedPolicy
    raise AttributeError(f"module 'turbopi' has no attribute {name!r}")
