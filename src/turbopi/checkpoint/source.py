"""Where weights come from: one protocol that every checkpoint format implements, and the checks they share.

A source knows names, shapes and stored dtypes at once, and hands out values as a stream of small pieces, so that
loading, hashing and converting never hold more than a piece (and what the reader must decode) besides their result.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol
from weakref import WeakKeyDictionary

import torch
from torch import Tensor

from turbopi.support.errors import CheckpointError
from turbopi.support.reading import listing

# of stored values: small beside a model that fills a machine, large enough that reads cost little each
PIECE_BYTES = 8 * 2**20

Shape = tuple[int, ...]
_RANDOM = "random weights, "
_REPORTED: "WeakKeyDictionary[WeightSource, set[str]]" = WeakKeyDictionary()  # notes that were reported
RANDOM_KEY = "turbopi_random_weights"  # in the header of files that hold random weights: they stay marked


def random_note(random: str) -> str:
    """What every reader should know of random weights."""
    return f"{_RANDOM}{random}: actions mean nothing"


def mark_random_reported(source: "WeightSource") -> None:
    """Somebody has said in other words that these weights are random."""
    _REPORTED.setdefault(source, set()).update(note for note in source.notes if note.startswith(_RANDOM))


def unreported_notes(source: "WeightSource") -> list[str]:
    """The notes that weren't reported yet, which now count as reported: however many policies are made, once."""
    reported = _REPORTED.setdefault(source, set())
    found = [note for note in source.notes if note not in reported]
    reported.update(found)
    return found


@dataclass(frozen=True)
class Piece:
    """Rows `start : start + len(values)` of a parameter; `values` is only valid until the next piece."""

    name: str  # canonical
    start: int
    values: Tensor  # stored dtype, canonical layout, possibly a strided view


class WeightSource(Protocol):
    """A checkpoint's weights under canonical names."""

    format: str  # "openpi_torch", "openpi_jax", "lerobot", "onnx", "quantized" or "random"
    shapes: dict[str, Shape]
    dtypes: dict[str, str]  # stored: "F32", "BF16", "F16"; of exports also "F8_E4M3", "I8"
    vision_heads: int | None  # where the layout carries them
    notes: list[str]  # what a reader of `inspect` should know (merged adapters, ...)

    def native_name(self, name: str) -> str:
        """What the checkpoint itself calls a canonical parameter."""

    def pieces(self, device: torch.device) -> Iterator[Piece]:
        """Every parameter once, largest first; each one's pieces are in order and cover it."""


def row_ranges(shape: Sequence[int], itemsize: int, limit: int = PIECE_BYTES) -> Iterator[tuple[int, int]]:
    """Split axis 0 of an array into ranges of at most `limit` bytes (at least one row each)."""
    row_bytes = itemsize
    for size in shape[1:]:
        row_bytes *= size
    step = max(1, limit // max(1, row_bytes))
    for start in range(0, shape[0], step):
        yield start, min(start + step, shape[0])


def check_tensors(source: WeightSource, expected: Mapping[str, Shape], path: Path | None) -> None:
    """Every expected parameter is there in its shape and nothing else is; CheckpointError names what isn't so."""
    native = source.native_name
    missing = [native(name) for name in expected if name not in source.shapes]
    extra = [native(name) for name in source.shapes if name not in expected]
    wrong = [
        f"{native(name)} is {list(source.shapes[name])}, expected {list(shape)}"
        for name, shape in expected.items()
        if name in source.shapes and source.shapes[name] != shape
    ]
    problems = []
    if missing:
        problems.append(f"missing {listing(missing)}")
    if extra:
        problems.append(f"not a part of the model: {listing(extra)}")
    if wrong:
        problems.append(f"wrong shapes (in canonical [out, in] layout): {listing(wrong)}")
    if problems:
        raise CheckpointError(f"{path}: the weights don't fit the model: " + "; ".join(problems) + adapter_hint(extra))


def judged_for_zeros(name: str, shape: Shape) -> bool:
    """Whether training leaves no zeros here. Norms' scales are stored less 1, and adaRMS layers start as zeros."""
    return len(shape) > 1 and all(shape) and "norm" not in name


def check_zeros(source: WeightSource, empty: Sequence[str], path: Path | None) -> list[str]:
    """CheckpointError if so many matrices hold nothing but zeros that some of the file is missing; a note on a few.

    `empty`: canonical names of the tensors that are all zero, whatever their kind. One layer may be zeroed on purpose,
    a tenth of the model isn't.
    """
    judged = [name for name, shape in source.shapes.items() if judged_for_zeros(name, shape)]
    zero = [source.native_name(name) for name in judged if name in set(empty)]
    if not zero:
        return []
    text = f"{len(zero)} of the model's {len(judged)} matrices hold nothing but zeros: {listing(zero)}"
    if 10 * len(zero) >= len(judged):
        raise CheckpointError(f"{path}: {text}. The file is there in part: download or copy it again")
    return [text]


def check_finite(values: Tensor, name: str, path: Path | None) -> None:
    """CheckpointError if one of `values` is NaN or infinite. `name` is what the checkpoint calls them."""
    if values.sum().isfinite() or values.isfinite().all():  # the first takes a thirtieth of the second's time
        return
    odd = values.flatten()[~values.isfinite().flatten()]
    raise CheckpointError(
        f"{path}: {odd.numel()} of {values.numel()} values of {name} are NaN or infinite (the first is "
        f"{odd[0].item()}): no action computed from them would be one. The training diverged or the file is damaged: "
        "take an earlier checkpoint, or copy this one anew"
    )


def adapter_hint(names: Sequence[str]) -> str:
    """What to do when leftover names look like adapters that were never merged."""
    if any("lora" in name.lower() or "base_layer" in name for name in names):
        return ". These look like a training library's LoRA adapters: merge them there (merge_and_unload), save again"
    return ""
