"""Where a checkpoint's tensors are read to, so that packing them leaves nothing behind on the device.

A tensor that is joined with others there, or moved away from there, leaves a hole between those that stay, which the
allocator keeps: 1.3 GB of full Pi0.5 in bfloat16. So the parts of a joined matrix are read to their places in it, and
what is to lie on the host goes there at once.
"""

import re
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from turbopi.config import ModelConfig
from turbopi.models import family_of, parameter_shapes

HOST = torch.device("cpu")
QKV, GATE_UP = ("q_proj", "k_proj", "v_proj"), ("gate_proj", "up_proj")  # what is joined, in this order
_PART = re.compile(rf"(.*\.)({'|'.join((*QKV, *GATE_UP))})(\.weight|\.bias)")


def is_conditioning(config: ModelConfig, name: str) -> bool:
    """Whether a tensor is of the time MLP or adaRMS, whose results are computed on the host, once."""
    return ".dense." in name or (family_of(config).modulated and name.startswith("time_mlp_"))


class WeightPlacement:
    """To be given to `Checkpoint.load` for `engine.weights.pack`.

    device   where tensors lie, and where random ones are made
    on_host  names of those that lie on the host
    """

    def __init__(self, config: ModelConfig, device: torch.device, on_host: Callable[[str], bool]) -> None:
        self.device = device
        self._on_host, self._shapes = on_host, parameter_shapes(config)
        self._parts: dict[tuple[str, ...], dict[str, Tensor]] = {}  # of what is joined, those not yet given away

    def __call__(self, name: str, shape: tuple[int, ...], dtype: torch.dtype) -> Tensor:
        """An uninitialised tensor for a parameter by its canonical name.

        Nothing here refers to a joined matrix once all its parts are given away, so packing can free it.
        """
        device, names = HOST if self._on_host(name) else self.device, joined_with(name)
        if names is None:
            return torch.empty(shape, dtype=dtype, device=device)
        if names not in self._parts:
            rows = [self._shapes[one][0] for one in names]
            whole = torch.empty(sum(rows), *shape[1:], dtype=dtype, device=device)
            self._parts[names] = dict(zip(names, torch.split(whole, rows), strict=True))
        part = self._parts[names].pop(name)
        if not self._parts[names]:
            del self._parts[names]
        return part


def joined_with(name: str) -> tuple[str, ...] | None:
    """The names of the parts of the matrix or bias that a tensor is a part of; None if it is no part of another."""
    found = _PART.fullmatch(name)
    if found is None:
        return None
    return tuple(f"{found[1]}{part}{found[3]}" for part in (QKV if found[2] in QKV else GATE_UP))


def join(parts: Sequence[Tensor], device: torch.device | None) -> Tensor:
    """The parts one below the other, on the device (None: where they are): without a copy if they lie there so."""

    def there(part: Tensor) -> Tensor:
        return part if device is None else part.to(device)

    first, storage, at = parts[0], parts[0].untyped_storage(), 0
    for part in parts:
        beside = part.untyped_storage().data_ptr() == storage.data_ptr() and part.storage_offset() == at
        if not (beside and part.is_contiguous()):
            return torch.cat([there(part) for part in parts])
        at += part.numel()
    if at * first.element_size() != storage.nbytes():  # more than the parts
        return torch.cat([there(part) for part in parts])
    return there(first.as_strided((sum(len(part) for part in parts), *first.shape[1:]), first.stride()))
