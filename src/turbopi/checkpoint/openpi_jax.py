"""openpi's JAX checkpoints: which arrays of an Orbax tree hold which parameters. The tree itself is read by orbax.py.

Orbax may store a whole stacked array, 18 layers of it, as one compressed chunk of up to 4.8 GB. So arrays are read
largest first, while little else is in memory, and all layers are taken from one before the next.
"""

from collections.abc import Iterator
from pathlib import Path

import torch

from turbopi.checkpoint.jax_layout import VISION_QUERY, Rule, path_of, rules
from turbopi.checkpoint.openpi_lora import Adapter, LoraScale, find_adapters, merged
from turbopi.checkpoint.orbax import OrbaxTree
from turbopi.checkpoint.source import PIECE_BYTES, Piece, Shape, check_zeros, row_ranges
from turbopi.config import LIMITS
from turbopi.support.errors import CheckpointError
from turbopi.support.reading import files_below


class JaxSource:
    """The tree in `folder` (the `params` folder of an openpi checkpoint)."""

    format = "openpi_jax"

    def __init__(self, folder: Path, lora: LoraScale) -> None:
        self._store = OrbaxTree(folder)
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
        self.notes = [*self._store.notes, *([self._adapter_note()] if adapters else [])]
        self.files = list(files_below(folder, hidden=True))
        self.variant = repr(lora) if adapters else ""
        empty = [name for name, rule in self._rules.items() if rule.path in self._store.empty]
        check_zeros(self, empty, folder)  # the tree's notes name each

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
        if rule.stacked and not (shape and shape[0] <= LIMITS["depth"]):
            raise CheckpointError(f"{rule.path} has shape {list(shape)}; expected at most {LIMITS['depth']} layers")
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
                yield Piece(output.name, start, array[start:stop])
            return
        yield Piece(output.name, 0, output.transform(array[...]))

    def _stacked(self, rule: Rule) -> Iterator[Piece]:
        small = self._store.nbytes(rule.path) <= PIECE_BYTES
        array = self._store.open(rule.path)
        values = array[...] if small else None
        adapter = self._adapters.get(rule.path)
        a, b = (self._store.open(path)[...] for path in (adapter.a, adapter.b)) if adapter else (None, None)
        for layer in range(self._store.shapes[rule.path][0]):
            for output in rule.outputs:
                index = (layer, *output.select)
                part = values[index] if values is not None else array[index]
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
