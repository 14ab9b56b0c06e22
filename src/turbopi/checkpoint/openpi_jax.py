"""openpi's JAX checkpoints (Orbax PyTree in OCDBT), read with tensorstore: neither JAX nor Orbax is needed.

Orbax may store a whole stacked array, 18 layers of it, as one compressed chunk of up to 4.8 GB, and a chunk can only be
decoded whole. So arrays are read largest first, while little else is in memory; a chunk is decoded once and kept while
its layers are taken from it; and files are memory-mapped, so that compressed bytes are page cache and not ours.
"""

import json
from collections.abc import Iterator
from math import ceil, prod
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from turbopi.checkpoint.jax_layout import VISION_QUERY, Rule, path_of, rules
from turbopi.checkpoint.lora import Adapter, LoraScale, find_adapters, merged
from turbopi.checkpoint.source import PIECE_BYTES, Piece, Shape, listing, row_ranges
from turbopi.errors import CheckpointError

_DTYPES = {"float32": "F32", "bfloat16": "BF16", "float16": "F16"}
_ITEMSIZE = {"F32": 4, "BF16": 2, "F16": 2}
MANIFEST = "manifest.ocdbt"


class JaxSource:
    """The tree in `folder` (the `params` folder of an openpi checkpoint)."""

    format = "openpi_jax"

    def __init__(self, folder: Path, lora: LoraScale) -> None:
        self._store = _OrbaxTree(folder)
        self._lora = lora
        arrays = self._store.shapes
        adapters = find_adapters(arrays)
        known = {rule.path: rule for rule in rules() if rule.path in arrays}
        used = {*known, *(path for adapter in adapters.values() for path in (adapter.a, adapter.b))}
        self._adapters = adapters
        self._rules: dict[str, Rule] = {}  # canonical name -> where it is read from
        self.shapes: dict[str, Shape] = {}
        self.dtypes: dict[str, str] = {}
        for rule in known.values():
            self._describe(rule)
        for path in arrays.keys() - used:  # left over: check_tensors will name it
            self.shapes[path] = arrays[path]
            self.dtypes[path] = self._store.dtypes[path]
        kernel = arrays.get(VISION_QUERY, ())
        self.vision_heads: int | None = kernel[-2] if len(kernel) == 4 else None
        self.notes = [self._adapter_note()] if adapters else []
        self.files = sorted(path for path in folder.rglob("*") if path.is_file())
        self.variant = repr(lora) if adapters else ""

    def native_name(self, name: str) -> str:
        return path_of(name) or name

    def pieces(self, device: torch.device) -> Iterator[Piece]:
        read = {rule.path: rule for rule in self._rules.values()}
        for path in sorted(read, key=lambda path: -self._store.nbytes(path)):
            rule = read[path]
            yield from self._stacked(rule) if rule.stacked else self._single(rule)

    def _describe(self, rule: Rule) -> None:
        """Record the canonical names and shapes that an array holds."""
        shape, dtype = self._store.shapes[rule.path], self._store.dtypes[rule.path]
        if rule.path.rsplit("/", 2)[-2].startswith("kv_einsum") and (len(shape) != 5 or shape[1] != 2 or shape[2] != 1):
            raise CheckpointError(
                f"{rule.path} has shape {list(shape)}; expected [layers, 2 (k, v), 1 KV head, width, head_dim]"
            )
        try:
            for layer in range(shape[0]) if rule.stacked else (0,):
                inner = torch.empty(shape[1:] if rule.stacked else shape, device="meta")
                for output in rule.outputs:
                    name = output.name.format(i=layer)
                    self.shapes[name] = tuple(output.transform(inner[output.select]).shape)
                    self.dtypes[name] = dtype
                    self._rules[name] = rule
        except (IndexError, RuntimeError) as error:
            raise CheckpointError(f"{rule.path} has shape {list(shape)}, which no Pi0 or Pi0.5 has") from error

    def _single(self, rule: Rule) -> Iterator[Piece]:
        (output,) = rule.outputs
        array = self._store.open(rule.path)
        if output.as_stored:
            for start, stop in row_ranges(self._store.shapes[rule.path], self._store.itemsize(rule.path)):
                yield Piece(output.name, start, _tensor(array[start:stop]))
            return
        yield Piece(output.name, 0, output.transform(_tensor(array[...])))

    def _stacked(self, rule: Rule) -> Iterator[Piece]:
        small = self._store.nbytes(rule.path) <= PIECE_BYTES
        array = self._store.open(rule.path)
        values = _tensor(array[...]) if small else None
        adapter = self._adapters.get(rule.path)
        a, b = (_tensor(self._store.open(path)[...]) for path in (adapter.a, adapter.b)) if adapter else (None, None)
        for layer in range(self._store.shapes[rule.path][0]):
            for output in rule.outputs:
                index = (layer, *output.select)
                part = values[index] if values is not None else _tensor(array[index])
                if adapter is not None and a is not None and b is not None:
                    part = merged(part, a[index], b[index], adapter.kind, self._factor(adapter))
                yield Piece(output.name.format(i=layer), 0, output.transform(part))

    def _factor(self, adapter: Adapter) -> float:
        if adapter.kind == "mlp":
            return 1.0
        return self._lora.factor(adapter.stack, self._store.shapes[adapter.a][-1])

    def _adapter_note(self) -> str:
        """What is merged, and by what factor; raises ConfigError now rather than in the middle of a load."""
        scales = []
        for stack in ("vlm", "expert"):
            ranks = {
                self._store.shapes[adapter.a][-1]
                for adapter in self._adapters.values()
                if adapter.stack == stack and adapter.kind != "mlp"
            }
            scales += [f"{stack} rank {rank}, factor {self._lora.factor(stack, rank):g}" for rank in sorted(ranks)]
        return f"{len(self._adapters)} LoRA adapters are merged at load (attention: {'; '.join(scales) or 'none'})"


class _OrbaxTree:
    """Paths, shapes and lazily read arrays of an OCDBT store, without the `params.` root and a trailing `value`."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.shapes: dict[str, Shape] = {}
        self.dtypes: dict[str, str] = {}
        self._keys: dict[str, str] = {}  # path -> key prefix in the store
        self._zarr3 = False
        if not (folder / MANIFEST).is_file():
            raise CheckpointError(
                f"{folder} has no {MANIFEST}: either the download is incomplete, or the checkpoint is in Orbax's older "
                "format of one folder an array, which Turbo-Pi doesn't read; re-save it with openpi's Orbax"
            )
        self._read_metadata()

    def open(self, path: str) -> "_Array":
        return _Array(self, path)

    def nbytes(self, path: str) -> int:
        return prod(self.shapes[path]) * self.itemsize(path)

    def itemsize(self, path: str) -> int:
        return _ITEMSIZE[self.dtypes[path]]

    def tensorstore(self, path: str, cache_bytes: int) -> Any:
        import tensorstore as ts

        driver = "zarr3" if self._zarr3 else "zarr"
        spec = {"driver": driver, "kvstore": {**self._kvstore_spec(), "path": self._keys[path] + "/"}}
        try:  # file_io_mode is known since tensorstore 0.1.77
            context = ts.Context({"file_io_mode": {"mode": "memmap"}, "cache_pool": {"total_bytes_limit": cache_bytes}})
            return ts.open(spec, open=True, read=True, context=context).result()
        except ValueError as error:
            raise CheckpointError(f"{self.folder}: {path} can't be opened ({error})") from error

    def _kvstore_spec(self) -> dict[str, Any]:
        return {"driver": "ocdbt", "base": self.folder.resolve().as_uri() + "/"}

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
            metadata = {key: json.loads(store.read(key + suffix).result().value) for key in arrays}
        except ValueError as error:
            raise CheckpointError(f"{self.folder} can't be read as an OCDBT store ({error})") from error
        rootless = [key for key in arrays if not key.startswith("params.")]
        if rootless or not arrays:
            what = f"holds {listing(sorted(rootless))}" if rootless else "is empty"
            raise CheckpointError(f"{self.folder} {what}; expected arrays below the root `params`, as openpi has them")
        ends_in_value = all(key.endswith(".value") for key in arrays)  # nnx.State adds a level; openpi strips it too
        for key in sorted(arrays):
            path = key.removeprefix("params.").removesuffix(".value" if ends_in_value else "").replace(".", "/")
            self._keys[path] = key
            self.shapes[path] = tuple(metadata[key]["shape"])
            self.dtypes[path] = self._dtype(path, metadata[key])

    def _dtype(self, path: str, metadata: dict[str, Any]) -> str:
        name = str(metadata.get("data_type", metadata.get("dtype")))
        name = {"<f4": "float32", "<f2": "float16"}.get(name, name)
        if name not in _DTYPES:
            raise CheckpointError(f"{self.folder}: {path} is stored as {name}; expected one of {', '.join(_DTYPES)}")
        return _DTYPES[name]


class _Array:
    """A stored array; indexing reads. A decoded chunk is kept while consecutive indices need it."""

    def __init__(self, tree: _OrbaxTree, path: str) -> None:
        array = tree.tensorstore(path, cache_bytes=0)
        chunk = array.chunk_layout.read_chunk.shape
        rest = prod(ceil(size / part) * part for size, part in zip(array.shape[1:], chunk[1:], strict=True))
        together = prod(chunk[:1]) * rest * tree.itemsize(path)  # bytes decoded to read one index of axis 0
        self._array = tree.tensorstore(path, cache_bytes=int(1.1 * together) + 2**20)

    def __getitem__(self, index: Any) -> Any:
        return self._array[index].read().result()


def _tensor(values: Any) -> Tensor:
    """A NumPy array as a tensor that shares its memory; NumPy's bfloat16 is foreign to torch."""
    if values.dtype.name == "bfloat16":
        return torch.from_numpy(values.view("int16")).view(torch.bfloat16)
    return torch.from_numpy(values)
