"""Several tensors in one buffer, so that they travel between host and device in one copy."""

import math
from collections.abc import Mapping

import torch
from torch import Tensor


def allocate(
    fields: Mapping[str, tuple[tuple[int, ...], torch.dtype]], device: torch.device, *, pinned: bool
) -> tuple[Tensor, dict[str, Tensor]]:
    """(uint8 buffer of zeros, {name: view into it}) for {name: (shape, dtype)}. Offsets are multiples of 16 bytes."""
    sizes = {name: math.prod(dims) * dtype.itemsize for name, (dims, dtype) in fields.items()}
    padded = {name: (count + 15) // 16 * 16 for name, count in sizes.items()}
    flat = torch.zeros(sum(padded.values()), dtype=torch.uint8, device=device, pin_memory=pinned)
    views, start = {}, 0
    for name, (dims, dtype) in fields.items():
        views[name] = flat[start : start + sizes[name]].view(dtype).view(dims)
        start += padded[name]
    return flat, views
