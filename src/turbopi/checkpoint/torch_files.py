"""openpi's PyTorch layout and LeRobot's: safetensors, memory-mapped, tensor by tensor.

A download that set its space aside and stopped leaves zeros, which safetensors can't tell from weights. So when a file
is opened, one row in the middle of every matrix is read: some 400 rows of a few kilobytes, which loading reads anyway.
A matrix whose row is zero is read whole. Biases aren't judged, nor are norms, whose scales (stored less 1) and adaRMS
layers start as zeros.
"""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor

from turbopi.checkpoint.names import (
    EMBEDDING,
    HEAD,
    TIED_EMBEDDING,
    TIED_HEAD,
    FastNames,
    Names,
    PiNames,
    common_prefix,
    current_name,
)
from turbopi.checkpoint.source import (
    RANDOM_KEY,
    Piece,
    Shape,
    check_zeros,
    judged_for_zeros,
    listing,
    random_note,
    row_ranges,
)
from turbopi.support.errors import CheckpointError
from turbopi.support.reading import Fields, one_line, open_file, read_json
from turbopi.support.reading.files import HEAD_BYTES, failed_download

ITEMSIZE = {"F32": 4, "BF16": 2, "F16": 2}
WEIGHTS, INDEX = "model.safetensors", "model.safetensors.index.json"


@dataclass(frozen=True)
class Stored:
    """One tensor of a file."""

    file: Path
    key: str
    shape: Shape
    dtype: str


class TorchSource:
    """`model.safetensors` (or, without it, the shards of an index) in `folder`.

    Names may carry `prefix` (LeRobot's `model.`), or all of them a wrapper's.
    """

    vision_heads: int | None = None  # no tensor of this layout tells

    def __init__(self, folder: Path, *, format: str, prefix: str = "", names: Names | None = None) -> None:
        """names: None: Pi0's"""
        self.format, self.names = format, names or PiNames()
        self.notes: list[str] = []
        stored_tensors = _read_headers(folder)
        self._prefix = common_prefix([stored.key for stored in stored_tensors]) or prefix
        if self._prefix != prefix:
            self.notes.append(f"all names in {WEIGHTS} begin with {self._prefix}: read without it")
        self._stored: dict[str, Stored] = {}
        current = self.names.current if isinstance(self.names, PiNames) else current_name
        heads: dict[str, Stored] = {}
        self.untied = False  # whether lm_head and the embedding are both stored
        self.head: Stored | None = None  # lm_head, where LeRobot has one beside the embedding
        self.variant = "head" if getattr(self.names, "trains_head", False) else ""  # `Checkpoint.fingerprint` has it
        for stored in stored_tensors:
            key = current(stored.key.removeprefix(self._prefix))
            tied = key in (TIED_HEAD, TIED_EMBEDDING)
            kind, name = (heads, key) if tied else (self._stored, self.names.canonical(key))
            if name is None:
                continue
            if name in kind:
                raise CheckpointError(f"{folder}: {kind[name].key} and {stored.key} are the same parameter")
            kind[name] = stored
        if heads:
            self._stored[EMBEDDING] = self._tied(heads, folder)
            self.untied = len(heads) == 2
        unusable = [s.key for s in self._stored.values() if s.dtype not in ITEMSIZE]
        if unusable:
            kinds = sorted({s.dtype for s in self._stored.values()} - set(ITEMSIZE))
            raise CheckpointError(
                f"{folder}: tensors stored as {', '.join(kinds)} can't be read: {listing(unusable)}. "
                "Turbo-Pi reads float32, bfloat16 and float16 weights and quantises by itself"
            )
        self.shapes = {name: stored.shape for name, stored in self._stored.items()}
        self.dtypes = {name: stored.dtype for name, stored in self._stored.items()}
        self.files = sorted({stored.file for stored in self._stored.values()})
        self.random = _random_mark(self.files[0])
        if self.random is not None:
            self.notes.append(random_note(self.random))
        empty = [name for name in _sampled_zero(self._stored) if not read_tensor(self._stored[name]).any()]
        self.notes += check_zeros(self, empty, folder)

    def native_name(self, name: str) -> str:
        return self._stored[name].key if name in self._stored else self._prefix + self.names.native(name)

    def stored(self, name: str) -> Stored:
        """Where a parameter is."""
        return self._stored[name]

    def pieces(self, device: torch.device) -> Iterator[Piece]:
        by_size = sorted(self._stored, key=lambda name: (-_nbytes(self._stored[name]), name))  # gate beside up
        for name in by_size:
            stored = self._stored[name]
            values = read_tensor(stored)
            if not stored.shape:
                yield Piece(name, 0, values)
                continue
            for start, stop in row_ranges(stored.shape, ITEMSIZE[stored.dtype]):
                yield Piece(name, start, values[start:stop])

    def untied_head(self) -> Tensor | None:
        """The language head's values, mapped, where they aren't the embedding's; None: it is tied to it."""
        if self.head is None:
            return None
        head, embedding = read_tensor(self.head), read_tensor(self._stored[EMBEDDING])
        return None if head.dtype == embedding.dtype and _equal(head, embedding) else head

    def _tied(self, heads: dict[str, Stored], folder: Path) -> Stored:
        """openpi ties the prompt embedding to the head: one of them is stored, or both with equal values.

        LeRobot (from 0.5) trains both, untied; where no token is written, it computes with the embedding alone.
        """
        if len(heads) == 1:
            return next(iter(heads.values()))
        head, embedding = heads[TIED_HEAD], heads[TIED_EMBEDDING]
        apart = getattr(self.names, "trains_head", False)
        alike = head.shape == embedding.shape and (apart or head.dtype == embedding.dtype)
        # LeRobot loads the file's tensors in its order, sorted by dtype, then name; each of the two ends up as the
        # embedding, the last one for good
        if not alike or not (self.format == "lerobot" or _equal(read_tensor(head), read_tensor(embedding))):
            raise CheckpointError(
                f"{folder}: {head.key} and {embedding.key} are tied in the model but differ in the file, so it's "
                "unclear which one the model was trained with. Remove the wrong one from the file"
            )
        if isinstance(self.names, FastNames):
            if self.names.apart or not _equal(read_tensor(head), read_tensor(embedding)):
                self._stored[HEAD] = head
            return embedding
        if self.format == "lerobot":
            self.head = head
        # a look at the first rows will do: weight decay changes all of them
        if not apart and not torch.equal(read_tensor(head)[:1024], read_tensor(embedding)[:1024]):
            self.notes.append("lm_head and embed_tokens differ: prompts are embedded by embed_tokens, as LeRobot does")
        return embedding


def _read_headers(folder: Path) -> list[Stored]:
    """All tensors: of the single file, which openpi, LeRobot and transformers prefer, else of the index's shards."""
    if (folder / WEIGHTS).is_file():
        return read_header(folder / WEIGHTS)
    index = folder / INDEX
    weight_map = read_index(index)
    absent = [name for name in sorted(set(weight_map.values())) if not (folder / name).is_file()]
    if absent:
        none = "none of its files are there" if len(absent) == len(set(weight_map.values())) else "files are missing"
        raise CheckpointError(
            f"{index} lists files that aren't there: {listing(absent)}; the download is incomplete: {none}"
        )
    found = [stored for name in sorted(set(weight_map.values())) for stored in read_header(folder / name)]
    holders = {(stored.key, stored.file.name) for stored in found}
    elsewhere = [f"{key} in {name}" for key, name in weight_map.items() if (key, name) not in holders]
    if elsewhere:
        raise CheckpointError(
            f"{index} lists {listing(elsewhere)}, but the files hold something else: they and the index belong to "
            "different checkpoints. Copy one of them anew, whole"
        )
    return found


def read_index(index: Path) -> dict[str, str]:
    """{tensor: file}. CheckpointError for anything but plain names of files beside it."""
    weight_map = Fields(read_json(index), f"{index} isn't a safetensors index").object("weight_map").values
    odd = [str(name) for name in weight_map.values() if not re.fullmatch(r"[^/\\]{1,200}\.safetensors", str(name))]
    if odd or not weight_map:
        raise CheckpointError(
            f"{index} names {listing(odd) or 'no file'}; expected plain names of .safetensors files beside it. Weights "
            "are read from that folder alone"
        )
    return {key: str(name) for key, name in weight_map.items()}


def _sampled_zero(tensors: Mapping[str, Stored]) -> list[str]:
    """The matrices whose middle row is all zero, by their parameters' names."""
    found = []
    for file in {stored.file for stored in tensors.values()}:
        with safe_open(file, "pt") as handle:
            for name, stored in tensors.items():
                if stored.file != file or not judged_for_zeros(name, stored.shape):
                    continue
                middle = stored.shape[0] // 2
                if not handle.get_slice(stored.key)[middle : middle + 1].any():
                    found.append(name)
    return found


def read_header(file: Path) -> list[Stored]:
    """The tensors of a safetensors file, without their values. CheckpointError if it can't be read."""
    try:
        with safe_open(file, "pt") as handle:
            stored = []
            for key in handle.keys():  # noqa: SIM118  (not a dict)
                tensor = handle.get_slice(key)
                stored.append(Stored(file, key, tuple(tensor.get_shape()), tensor.get_dtype()))
            return stored
    except (SafetensorError, OSError) as error:
        with open_file(file, hint="; is the download complete?") as stream:
            found = failed_download(stream.read(HEAD_BYTES))
        if found is not None:
            raise CheckpointError(f"{file} {found}") from error
        raise CheckpointError(
            f"{file} can't be read as safetensors ({one_line(error)}); is the download complete?"
        ) from error


def _random_mark(file: Path) -> str | None:
    """What the header says of random weights, whose actions mean nothing."""
    with safe_open(file, "pt") as handle:
        mark: str | None = (handle.metadata() or {}).get(RANDOM_KEY)
    return None if mark is None else one_line(mark)


def read_tensor(stored: Stored) -> Tensor:
    """A tensor's values, mapped: only what is copied from it is ever read."""
    with safe_open(stored.file, "pt") as handle:
        tensor: Tensor = handle.get_tensor(stored.key)
    return tensor


def _equal(a: Tensor, b: Tensor) -> bool:
    ranges = row_ranges(a.shape, a.element_size())
    return all(torch.equal(a[start:stop], b[start:stop]) for start, stop in ranges)


def _nbytes(stored: Stored) -> int:
    count = ITEMSIZE[stored.dtype]
    for size in stored.shape:
        count *= size
    return count
