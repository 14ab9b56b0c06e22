"""Writing a safetensors file in any order, without holding what is in it."""

import json
import struct
from collections.abc import Mapping
from math import prod
from typing import BinaryIO

import torch
from torch import Tensor

from turbopi.checkpoint.source import Shape

DTYPES = {  # by what safetensors calls them
    "F32": torch.float32,
    "BF16": torch.bfloat16,
    "F16": torch.float16,
    "F8_E4M3": torch.float8_e4m3fn,
    "I8": torch.int8,
}


class TensorFile:
    """The header is written at once, and then each tensor's rows at their place. What isn't written is zero.

    out      a new file, open to be written
    tensors  dtype (of DTYPES) and shape of each, by name
    about    what the header says besides
    """

    def __init__(self, out: BinaryIO, tensors: Mapping[str, tuple[str, Shape]], about: Mapping[str, str]) -> None:
        self._out, self._tensors = out, tensors
        entries: dict[str, object] = {"__metadata__": dict(about)}
        starts, end = dict[str, int](), 0
        for name in sorted(tensors, key=lambda name: (-DTYPES[tensors[name][0]].itemsize, name)):  # so all are aligned
            stored, shape = tensors[name]
            starts[name], end = end, end + prod(shape) * DTYPES[stored].itemsize
            entries[name] = {"dtype": stored, "shape": list(shape), "data_offsets": [starts[name], end]}
        text = json.dumps(entries, separators=(",", ":")).encode()
        text += b" " * (-len(text) % 8)
        header = struct.pack("<Q", len(text)) + text
        out.write(header)
        out.truncate(len(header) + end)
        self._starts = {name: len(header) + start for name, start in starts.items()}

    def write(self, name: str, values: Tensor, first_row: int = 0) -> None:
        """Rows of a tensor, from `first_row` on, in its dtype."""
        stored, shape = self._tensors[name]
        assert values.dtype == DTYPES[stored] and values.shape[1:] == shape[1:], (name, values.dtype, values.shape)
        self._out.seek(self._starts[name] + first_row * prod(shape[1:]) * values.element_size())
        self._out.write(values.cpu().contiguous().reshape(-1).view(torch.uint8).numpy().data)
