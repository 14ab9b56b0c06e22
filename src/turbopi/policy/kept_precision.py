"""Whether a backend runs a checkpoint in a precision; weights kept in eight bits run in that one alone."""

from pathlib import Path

import torch

from turbopi import backends
from turbopi.backends import Precision
from turbopi.checkpoint import Checkpoint
from turbopi.checkpoint.quantized_folder import QuantizedOnly, precision_kept
from turbopi.support.errors import BackendUnavailable


def check_backend(name: str, device: torch.device, precision: Precision, checkpoint: Checkpoint) -> None:
    """`backends.check` for this checkpoint: what the error advises, it can do.

    Raises QuantizedOnly too, where the folder keeps its weights for another backend or precision.
    """
    kept = precision_kept(checkpoint)
    where = Path(str(checkpoint.path))
    if kept is not None and name in backends.BACKENDS and (name, precision) != ("fused", kept):
        raise QuantizedOnly(where, kept)
    try:
        backends.check(name, device, precision, checkpoint.config.model, kept=kept is not None)
    except BackendUnavailable as error:
        if kept is None:
            raise
        raise BackendUnavailable(
            f"{error}. {where} keeps its weights in {precision} alone: for another precision or backend take the "
            "checkpoint that it was made from"
        ) from error
