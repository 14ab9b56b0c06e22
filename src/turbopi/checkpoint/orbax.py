"""An Orbax tree of arrays, read with tensorstore: neither JAX nor Orbax is needed.

It is an OCDBT store, or has a folder for each array: openpi-comet's training on several machines writes those.

What protects it: OCDBT keeps a CRC-32C with its manifest and with every node of its index, so damage to names, shapes
and places is found; folders have none. The chunks of numbers, nearly all of the bytes, have none in either: zstd frames
are written without their checksum. Damage there is found if the frame can't be decoded, or if a number becomes NaN or
infinite. Other damage changes some weights and can't be told from a trained value, except by a hash that was taken
before ("weights_sha256" in turbopi.json). Chunks that aren't there are an error: tensorstore would read them as zeros.

A chunk can only be decoded whole. It is decoded once and kept while consecutive indices need it, and files are
memory-mapped, so that compressed bytes are page cache and not ours.
"""

from collections import Counter
from collections.abc import Mapping
from math import ceil, prod
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from turbopi.checkpoint.source import Shape, listing
from turbopi.support.errors import CheckpointError
from turbopi.support.reading import Fields, files_below, is_integer, one_line, open_file, parse_json, read_json
from turbopi.support.reading.files import HEAD_BYTES, failed_download
from turbopi.support.text import kind_of

MANIFEST = "manifest.ocdbt"
_DTYPES = {"float32": "F32", "<f4": "F32", "bfloat16": "BF16", "float16": "F16", "<f2": "F16"}
_ITEMSIZE = {"F32": 4, "BF16": 2, "F16": 2}
_MAX_AXIS = 2**31
_MAX_BYTES = 2**40  # of one array


class OrbaxTree:
    """Paths, shapes and lazily read arrays of a tree, without the `params.` root and a trailing `value`."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.shapes: dict[str, Shape] = {}
        self.dtypes: dict[str, str] = {}
        self.notes: list[str] = []
        self._keys: dict[str, str] = {}  # path -> key prefix in the store
        self._zarr3 = False
        self._sparse: set[str] = set()  # paths whose absent chunks are zeros
        self.empty: set[str] = set()  # paths of which no chunk is stored
        self._ocdbt = (folder / MANIFEST).is_file()
        if not self._ocdbt and not any(entry.is_dir() for entry in folder.glob("params.*")):
            unfinished = sorted(entry.name for entry in folder.glob("ocdbt.process_*"))
            if unfinished:
                raise CheckpointError(
                    f"{folder} has {listing(unfinished)}, but no {MANIFEST}, which Orbax writes last: the save was "
                    "interrupted, or the copy is incomplete. Take an earlier step, or copy it anew"
                )
            raise CheckpointError(f"{folder} has no {MANIFEST} and no folder params.*: the download is incomplete")
        self._read_metadata()

    def open(self, path: str) -> "OrbaxArray":
        return OrbaxArray(self, path)

    def damaged(self, text: str) -> CheckpointError:
        """The error to raise, with the file that isn't what it should be if one tells so."""
        for file in files_below(self.folder, hidden=True):
            with open_file(file) as stream:
                found = failed_download(stream.read(HEAD_BYTES))
            if found is not None:
                return CheckpointError(f"{self.folder}: {text}: {file} {found}")
        return CheckpointError(f"{self.folder}: {text}")

    def nbytes(self, path: str) -> int:
        return prod(self.shapes[path]) * self.itemsize(path)

    def itemsize(self, path: str) -> int:
        return _ITEMSIZE[self.dtypes[path]]

    def tensorstore(self, path: str, cache_bytes: int) -> Any:
        import tensorstore as ts

        spec = {
            "driver": "zarr3" if self._zarr3 else "zarr",
            "kvstore": self._kvstore_spec(self._keys[path] + "/"),
            "fill_missing_data_reads": path in self._sparse,
        }
        try:  # file_io_mode is known since tensorstore 0.1.77
            context = ts.Context({"file_io_mode": {"mode": "memmap"}, "cache_pool": {"total_bytes_limit": cache_bytes}})
            array = ts.open(spec, open=True, read=True, context=context).result()
        except Exception as reason:  # tensorstore raises several classes for damage, none of them its own
            raise self.damaged(f"{path} can't be opened ({one_line(reason)})") from reason
        if tuple(array.shape) != self.shapes[path]:
            raise CheckpointError(
                f"{self.folder}: {path} opens with shape {list(array.shape)}, but its description says "
                f"{list(self.shapes[path])}"
            )
        return array

    def _kvstore_spec(self, below: str = "") -> dict[str, Any]:
        if self._ocdbt:
            return {"driver": "ocdbt", "base": self.folder.resolve().as_uri() + "/", "path": below}
        return {"driver": "file", "path": f"{self.folder.resolve()}/{below}"}

    def _read_metadata(self) -> None:
        try:
            import tensorstore as ts
        except ImportError as error:
            raise CheckpointError(
                f"{self.folder} is an openpi JAX checkpoint; reading it takes tensorstore: pip install tensorstore"
            ) from error
        try:
            store = ts.KvStore.open(self._kvstore_spec()).result()
            keys = [key.decode() for key in store.list().result()]
            self._zarr3 = any(key.endswith("/zarr.json") for key in keys)
            suffix = "/zarr.json" if self._zarr3 else "/.zarray"
            arrays = {key.removesuffix(suffix) for key in keys if key.endswith(suffix)}
            described = {key: store.read(key + suffix).result().value for key in sorted(arrays)}
        except Exception as reason:  # as in `tensorstore`
            kind = "an OCDBT store" if self._ocdbt else "folders of arrays"
            raise self.damaged(f"it can't be read as {kind} ({one_line(reason)})") from reason
        rootless = [key for key in described if not key.startswith("params.")]
        if rootless or not described:
            what = f"holds {listing(rootless)}" if rootless else "is empty"
            raise CheckpointError(f"{self.folder} {what}; expected arrays below the root `params`, as openpi has them")
        ends_in_value = all(key.endswith(".value") for key in described)  # nnx.State adds a level; openpi strips it too
        stored = _chunks_of(described, keys)
        for key, description in described.items():
            path = key.removeprefix("params.").removesuffix(".value" if ends_in_value else "").replace(".", "/")
            fields = _fields(description, f"{self.folder}: {path}")
            self._keys[path] = key
            self.shapes[path], chunks, self.dtypes[path] = _described(fields, self._zarr3)
            if prod(self.shapes[path]) * _ITEMSIZE[self.dtypes[path]] > _MAX_BYTES:
                raise CheckpointError(
                    f"{self.folder}: {path} has shape {list(self.shapes[path])}: more than a terabyte"
                )
            needed = prod(ceil(size / part) for size, part in zip(self.shapes[path], chunks, strict=True))
            if stored[key] < needed:
                self._incomplete(path, stored[key], needed, fields)

    def _incomplete(self, path: str, stored: int, needed: int, fields: Fields) -> None:
        """Older Orbax leaves out chunks that are all zeros, where the array has a fill value; newer never does."""
        recorded = self.folder / "_METADATA"
        writes_all = recorded.is_file() and read_json(recorded).get("store_array_data_equal_to_fill_value")
        if writes_all is True or fields.values.get("fill_value") != 0:
            raise CheckpointError(
                f"{self.folder}: {path} has {stored} of its {needed} chunks; the download is incomplete or damaged"
            )
        self._sparse.add(path)
        if not stored:
            self.empty.add(path)
        self.notes.append(f"{needed - stored} of {needed} chunks of {path} aren't stored: read as zeros, as Orbax does")


class OrbaxArray:
    """A stored array; indexing reads a tensor."""

    def __init__(self, tree: OrbaxTree, path: str) -> None:
        self._tree, self._path = tree, path
        array = tree.tensorstore(path, cache_bytes=0)
        chunk = array.chunk_layout.read_chunk.shape
        rest = prod(ceil(size / part) * part for size, part in zip(array.shape[1:], chunk[1:], strict=True))
        together = prod(chunk[:1]) * rest * tree.itemsize(path)  # bytes decoded to read one index of axis 0
        self._array = tree.tensorstore(path, cache_bytes=int(1.1 * together) + 2**20)

    def __getitem__(self, index: Any) -> Tensor:
        try:
            values = self._array[index].read().result()
        except Exception as reason:  # as in `OrbaxTree.tensorstore`
            raise self._tree.damaged(
                f"{self._path} can't be read ({one_line(reason)}); the file is damaged or incomplete: copy it anew"
            ) from reason
        if values.dtype.name == "bfloat16":  # NumPy's is foreign to torch
            return torch.from_numpy(values.view("int16")).view(torch.bfloat16)
        return torch.from_numpy(values)


def _chunks_of(arrays: Mapping[str, Any], keys: list[str]) -> Counter[str]:
    """How many keys besides its description each array has. A chunk's key is the array's, a "/", and its place."""
    found: Counter[str] = Counter()
    for key in keys:
        owner = key
        while "/" in owner:
            owner = owner.rpartition("/")[0]
            if owner in arrays:
                found[owner] += not key.endswith(("/zarr.json", "/.zarray", "/.zattrs"))
                break
    return found


def _fields(description: bytes, where: str) -> Fields:
    content = parse_json(description, f"{where}: its description")
    if not isinstance(content, dict):
        raise CheckpointError(f"{where}: its description is {kind_of(content)}; expected an object")
    return Fields(content, where)


def _described(fields: Fields, zarr3: bool) -> tuple[Shape, Shape, str]:
    """(shape, shape of a chunk, dtype)"""
    shape = _axes(fields, "shape")
    key = "data_type" if zarr3 else "dtype"
    name = fields.values.get(key)
    if not isinstance(name, str) or name not in _DTYPES:
        raise CheckpointError(f"{fields.where} is stored as {name}; expected one of float32, bfloat16, float16")
    grid = fields.object("chunk_grid").object("configuration") if zarr3 else fields
    chunks = _axes(grid, "chunk_shape" if zarr3 else "chunks")
    if len(chunks) != len(shape) or any(part > size for part, size in zip(chunks, shape, strict=False)):
        raise CheckpointError(f"{fields.where} has shape {list(shape)}, but chunks of {list(chunks)}")
    return shape, chunks, _DTYPES[name]


def _axes(fields: Fields, key: str) -> Shape:
    sizes = fields.list(key)
    if len(sizes) > 8 or not all(is_integer(size) and 1 <= size <= _MAX_AXIS for size in sizes):
        fields.refuse(key, f"at most 8 sizes from 1 to {_MAX_AXIS}")
    return tuple(sizes)
