"""Weights that a folder keeps in eight bits run in that precision alone, in one backend: said where they can't."""

from pathlib import Path

import torch

from turbopi import backends
from turbopi.backends import Precision
from turbopi.checkpoint import Checkpoint
from turbopi.checkpoint.quantized_folder import precision_kept
from turbopi.support.errors import BackendUnavailable


def check_backend(name: str, device: torch.device, precision: Precision, checkpoint: str | Path | Checkpoint) -> None:
    """`backends.check`, whose error also says so where the precision is what the folder keeps its weights in."""
    try:
        backends.check(name, device, precision)
    except BackendUnavailable as error:
        if precision != precision_kept(checkpoint):
            raise
        raise BackendUnavailable(
            f"{error}. {getattr(checkpoint, 'path', checkpoint)} keeps its weights in {precision} alone: for another "
            "precision or backend take the checkpoint that it was made from"
        ) from error
