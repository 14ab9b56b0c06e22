"""How far two tensors are apart, as several studies report it."""

import torch.nn.functional as F
from msgspec import Struct
from torch import Tensor


class Off(Struct, frozen=True):
    """How far actions are from the exact ones; None: not finite."""

    max: float | None
    relative: float | None
    cosine: float | None


def errors_of(ours: Tensor, exact: Tensor) -> Off:
    """Largest and relative (2-norm) difference and cosine."""
    ours, exact = ours.double().flatten(), exact.double().flatten()
    if not bool(ours.isfinite().all()):
        return Off(None, None, None)
    difference = ours - exact
    relative = float(difference.norm() / exact.norm())
    return Off(float(difference.abs().max()), relative, float(F.cosine_similarity(ours, exact, dim=0)))
