"""Policies on backends that tests make up."""

from collections.abc import Callable
from typing import Any
from unittest import mock

from turbopi import UnifiedPolicy
from turbopi.checkpoint import Checkpoint


def policy_on(backend: Callable[..., Any], checkpoint: Checkpoint, **options: Any) -> UnifiedPolicy:
    """A policy in float32 on the CPU. `backend` makes its backend, as `Backend.__init__` does."""

    def create(_: str, *arguments: Any, quantization: None, writes: bool, **more: Any) -> Any:
        return backend(*arguments, **more)

    with mock.patch("turbopi.backends.create", create):
        return UnifiedPolicy(checkpoint, **{"backend": "pytorch", "device": "cpu", "precision": "f32"} | options)
