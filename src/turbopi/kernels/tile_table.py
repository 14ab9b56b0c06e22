"""Measured tiles as data: which tile an operation of certain sizes takes on this GPU.

A table is made once, when an engine is (backends/tuned_tiles.py), and handed to the operations. What it doesn't have,
hand-made tables or a model of the cost choose.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Final, Literal

Kernels = Literal["portable", "hopper"]
Numbers = Literal["bf16", "fp8", "int8"]  # that are multiplied
Knobs = Mapping[str, int]  # a tile's fields by name, or {LIBRARY: parts}

LIBRARY: Final = "library"  # cuBLAS multiplies: at once (1), or over so many parts of the inner axis


@dataclass(frozen=True, order=True)
class TileKey:
    """What a tile is chosen by.

    operation  a product's epilogue ("plain", "bias", "gelu", "geglu", "partial", "parts"; "residual": into the residual
               stream), or "vision_attention", "prefix_attention", "packed_attention", "suffix_attention"
    rows       of the result, in whole 64; of attention those of its tokens
    columns    of the result, of "geglu" the hidden width; of attention the heads
    inner      what is summed over; of attention a head's columns
    """

    kernels: Kernels
    operation: str
    numbers: Numbers
    rows: int
    columns: int
    inner: int


@dataclass(frozen=True)
class TileTable:
    """Tiles by key. It never changes: a captured graph and its engine keep the one they were made with."""

    tiles: Mapping[TileKey, Knobs] = field(default_factory=dict)

    def __post_init__(self) -> None:
        kept = {key: MappingProxyType(dict(knobs)) for key, knobs in self.tiles.items()}
        object.__setattr__(self, "tiles", MappingProxyType(kept))

    def find(
        self, kernels: Kernels, operation: str, numbers: Numbers, rows: int, columns: int, inner: int
    ) -> Knobs | None:
        """The tile for so many rows, which are rounded up to whole 64; None: nobody measured one."""
        return self.tiles.get(TileKey(kernels, operation, numbers, whole_64(rows), columns, inner))

    def with_tile(self, key: TileKey, knobs: Knobs) -> "TileTable":
        """The same with that tile, in place of another one or none."""
        return TileTable({**self.tiles, key: knobs})

    def __len__(self) -> int:
        return len(self.tiles)

    def __iter__(self) -> Iterator[TileKey]:
        return iter(self.tiles)


NO_TILES: Final = TileTable()


def whole_64(rows: int) -> int:
    return -(-rows // 64) * 64
