"""Several tensors in one buffer, so that they travel between host and device in one copy."""

import math
from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

Fields = Mapping[str, tuple[tuple[int, ...], torch.dtype]]  # name -> shape and dtype


def allocate(fields: Fields, device: torch.device, *, pinned: bool) -> tuple[Tensor, dict[str, Tensor]]:
    """(uint8 buffer of zeros, {name: view into it}) for {name: (shape, dtype)}. Offsets are multiples of 16 bytes."""
    sizes = {name: math.prod(dims) * dtype.itemsize for name, (dims, dtype) in fields.items()}
    padded = {name: (count + 15) // 16 * 16 for name, count in sizes.items()}
    flat = torch.zeros(sum(padded.values()), dtype=torch.uint8, device=device, pin_memory=pinned)
    views, start = {}, 0
    for name, (dims, dtype) in fields.items():
        views[name] = flat[start : start + sizes[name]].view(dtype).view(dims)
        start += padded[name]
    return flat, views


class Staged:
    """Inputs on the device (`tensors`, zeros at first) that the host sends without waiting for what the device does.

    The host's memory is read when the device gets to it: `writable` waits until the copy before is done. Behind a call
    that was waited for it always is; one that was given up may still have it to do.
    """

    def __init__(self, fields: Fields, device: torch.device) -> None:
        on_gpu = device.type == "cuda"
        self._host, host = allocate(fields, torch.device("cpu"), pinned=on_gpu)
        self._flat, self.tensors = allocate(fields, device, pinned=False)
        self._arrays = {name: view.numpy() for name, view in host.items()}
        self._sent = torch.cuda.Event() if on_gpu else None  # type: ignore[no-untyped-call]

    def writable(self) -> dict[str, np.ndarray]:
        """The host's arrays, with what was sent last."""
        if self._sent is not None:
            self._sent.synchronize()
        return self._arrays

    def send(self) -> None:
        self._flat.copy_(self._host, non_blocking=True)
        if self._sent is not None:
            self._sent.record(torch.cuda.current_stream(self._flat.device))
