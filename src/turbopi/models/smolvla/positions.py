"""Which row of the position table each row of an image's patches takes."""

import torch
from torch import Tensor

from turbopi.models.smolvla.config import ElementType


def position_rows(patches: int, table: int, element_type: ElementType, device: torch.device | None = None) -> Tensor:
    """For each of an image's rows of patches, the row of the position table that transformers' rounding takes.

    int64[patches], by transformers' own operations on the same device, as theirs may round otherwise on another.
    floor(i * table / patches), but where that is whole and a quotient isn't: one row before or behind it.
    """
    step = 1.0 / torch.full((), patches, device=device)
    at = (torch.arange(patches, dtype=torch.float32, device=device) * step).clamp(max=1 - 1e-6)
    begins = torch.arange(1 / table, 1.0, 1 / table, device=device)
    return torch.bucketize(at.to(getattr(torch, element_type)), begins, right=True)
