"""`UnifiedPolicy`: from observations to actions, with a checkpoint, on a backend. PyTorch is imported with it."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from turbopi.policy.policy import UnifiedPolicy

__all__ = ["UnifiedPolicy"]


def __getattr__(name: str) -> object:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from turbopi.policy import policy

    return getattr(policy, name)
