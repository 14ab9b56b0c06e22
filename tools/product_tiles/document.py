"""What `python -m product_tiles --json` writes, and reads again."""

from pathlib import Path

from msgspec import Struct

from turbopi.errors import ConfigError
from turbopi.provenance import Provenance
from turbopi.reading import read_document


class TimedTile(Struct, frozen=True):
    """tile: rows, columns, warps, stages, splits. error: relative rms to the product in float32; None for E4M3 out."""

    tile: tuple[int, int, int, int, int]
    microseconds: float
    error: float | None


class TimedProduct(Struct, frozen=True):
    """One product. by_library: cuBLAS's or `torch._scaled_mm`'s time with what follows it, None where it has none.

    chosen: what `best_tile` takes; tiles: the fastest first.
    """

    name: str
    epilogue: str
    in_fp8: bool
    out_fp8: bool
    rows: int
    columns: int
    inner: int
    by_library: float | None
    chosen: tuple[int, int, int, int, int]
    tiles: list[TimedTile]
    failed: dict[str, str]


class TilesDocument(Struct, frozen=True):
    provenance: Provenance
    capability: tuple[int, int]
    seconds: float
    products: list[TimedProduct]
    left_out: list[str]  # products that time didn't suffice for


def read_tiles(file: Path) -> TilesDocument:
    """Raises ConfigError for another file."""
    return read_document(file, TilesDocument, ConfigError)
