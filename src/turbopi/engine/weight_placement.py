"""Where a checkpoint's tensors are read to, so that packing them leaves nothing behind on the device.

A tensor that is joined with others there, or moved away from there, leaves a hole between those that stay, which the
allocator keeps: 1.3 GB of full Pi0.5 in bfloat16. So the parts of a joined matrix are read to their places in it, and
what is to lie on the host goes there at once.

A matrix that is to be rounded is read to the host, and rounded on the device as soon as all of it is read. So neither
ever holds more than a few of them in bfloat16.
"""

import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from itertools import product
from typing import Any

import torch
from torch import Tensor

from turbopi.checkpoint.matrices import GATE_UP, QKV, is_used, matrix_names, names_at
from turbopi.config import ModelConfig
from turbopi.engine.graph import empty_cache
from turbopi.models import family_of, parameter_shapes
from turbopi.quantization.formats import RoundedMatrix
from turbopi.quantization.fp8 import ScaledMatrix, whole_lines
from turbopi.quantization.sites import KINDS, Part

AnyMatrix = Tensor | RoundedMatrix
MakeMatrix = Callable[[str, Tensor], AnyMatrix]  # by its place, such as "vision.3.fc1" or "prefix.0.qkv"
HOST = torch.device("cpu")
_PART = re.compile(rf"(.*\.)({'|'.join((*QKV, *GATE_UP))})(\.weight|\.bias)")


def is_conditioning(config: ModelConfig, name: str) -> bool:
    """Whether a tensor is of the time MLP or adaRMS, whose results are computed on the host, once."""
    return ".dense." in name or (family_of(config).modulated and name.startswith("time_mlp_"))


class WeightPlacement:
    """To be given to `Checkpoint.load` for `engine.weights.pack`.

    device   where tensors lie, and where random ones are made
    on_host  names of those that lie on the host
    make     what makes matrices, on the device, into others. They aren't in the state that is loaded, but in `made`, by
             their places
    parts    of the model, whose matrices these are
    precision  of matrices that a checkpoint may keep in eight bits: they come to `kept`
    """

    def __init__(
        self,
        config: ModelConfig,
        device: torch.device,
        on_host: Callable[[str], bool],
        make: MakeMatrix | None = None,
        *,
        parts: Sequence[Part] = ("vision", "prefix"),
        precision: str | None = None,
    ) -> None:
        self.device, self.precision = device, precision
        self.made, self.kept = dict[str, AnyMatrix](), dict[str, ScaledMatrix]()
        self._config, self._on_host, self._make, self._shapes = config, on_host, make, parameter_shapes(config)
        self._parts: dict[tuple[str, ...], dict[str, Tensor]] = {}  # of what is joined, those not yet given away
        self._places: dict[str, str] = {}  # of what is made, by the names of its parameters
        self._read: dict[str, dict[str, Tensor]] = {}  # of what isn't made yet, by place
        for part in parts if make is not None else ():
            depth = config.vision.depth if part == "vision" else config.vlm.depth  # the expert's is the prefix's
            for layer, kind in product(range(depth), KINDS[part]):
                self._places |= dict.fromkeys(matrix_names(part, layer, kind), f"{part}.{layer}.{kind}")

    def __call__(self, name: str, shape: tuple[int, ...], dtype: torch.dtype) -> Tensor:
        """An uninitialised tensor for a parameter by its canonical name.

        Nothing here refers to a joined matrix once all its parts are given away, so packing can free it.
        """
        on_host = name in self._places or self._on_host(name)
        device, names = HOST if on_host else self.device, joined_with(name)
        if names is None:
            return torch.empty(shape, dtype=dtype, device=device)
        if len({self._alike(one) for one in names}) > 1:  # SmolVLA's, of a layer across: they aren't joined
            return torch.empty(shape, dtype=dtype, device=device)
        if names not in self._parts:
            rows = [self._shapes[one][0] for one in names]
            whole = torch.empty(sum(rows), *shape[1:], dtype=dtype, device=device)
            self._parts[names] = dict(zip(names, torch.split(whole, rows), strict=True))
        part = self._parts[names].pop(name)
        if not self._parts[names]:
            del self._parts[names]
        return part

    def _alike(self, name: str) -> tuple[tuple[int, ...], torch.dtype]:
        """What parts of one matrix have in common."""
        return self._shapes[name][1:], family_of(self._config).parameter_dtype(name, "bf16", self._config)

    def takes(self, name: str) -> bool:
        return name in self._places

    def take(self, name: str, tensor: Tensor) -> None:
        """Of a matrix that is to be made into another: makes it when all its parts are there."""
        assert self._make is not None
        place = self._places[name]
        read = self._read.setdefault(place, {})
        read[name] = tensor if is_used(self._config, place) else tensor[:0].clone()
        if len(read) == len(names := names_at(place)):
            del self._read[place]
            self.made[place] = self._make(place, join([read[one] for one in names], self.device))
            del tensor, read
            pair = [f"{place.rsplit('.', 1)[0]}.{kind}" for kind in ("fc1", "fc2")]
            if place in pair and all(one in self.made for one in pair):
                self.made |= zip(pair, in_whole_lines(*(self.made.pop(one) for one in pair)), strict=True)
            empty_cache()  # of what making it left

    def give(self, place: str, matrix: ScaledMatrix) -> None:
        """The expert's are copied: they stay on the host, and a file that is overwritten would end the process."""
        if place.startswith("expert."):
            matrix = replace(matrix, data=matrix.data.clone(), scale=matrix.scale.clone())
        self.kept[place] = matrix


def in_whole_lines(fc1: AnyMatrix, fc2: AnyMatrix) -> tuple[Any, Any]:
    """Both as they are; if both are in eight bits, with hidden columns of zeros up to whole lines of memory.

    With SigLIP's 4,304 hidden columns seven rows of fc2 in eight begin inside a line, and fc2 takes 1.05 to 1.4 times
    as long. GELU of 0 is 0, and 0 adds nothing.
    """
    hidden, inner = fc1.shape
    wide = whole_lines(hidden)
    if not (isinstance(fc1, ScaledMatrix) and isinstance(fc2, ScaledMatrix)) or wide == hidden:
        return fc1, fc2
    return fc1.padded(wide, inner), fc2.padded(fc2.shape[0], wide)


def rows_of_parts(config: ModelConfig, place: str) -> list[int]:
    """Of the matrix at a place, such as "prefix.0.qkv": the rows of each tensor that it is joined of."""
    shapes = _shapes(config)
    return [shapes[name][0] for name in names_at(place)]


_shapes = cache(parameter_shapes)


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
