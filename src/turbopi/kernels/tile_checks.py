"""Whether a tile that a file holds is one of these kernels', and fits the GPU."""

from dataclasses import replace

from turbopi.kernels.portable import attention_tiles
from turbopi.kernels.portable.gemm import tiles as portable
from turbopi.kernels.sm90.gemm.bf16 import Tile
from turbopi.kernels.sm90.gemm.candidates import possible
from turbopi.kernels.sm90.gemm.products import Operation, from_knobs
from turbopi.kernels.tile_table import LIBRARY, Knobs, TileKey

Capability = tuple[int, int]
HOPPER: Capability = (9, 0)


def why_not(key: TileKey, knobs: Knobs, capability: Capability) -> str | None:
    """Why this can't be the tile of `key` on a GPU of that compute capability; None if it can."""
    if LIBRARY in knobs:
        return None if len(knobs) == 1 and 1 <= knobs[LIBRARY] <= 64 else "the library is given no tile"
    try:
        if key.kernels == "hopper":
            fits = capability == HOPPER and _fits_hopper(key, knobs)
        elif key.operation.endswith("_attention"):
            fits = _fits_attention(key, attention_tiles.AttentionTile(**knobs), capability)
        else:
            fits = _fits_portable(key, portable.Tile(**knobs), capability)
    except (TypeError, ValueError, KeyError, ZeroDivisionError):
        return "these aren't the fields of such a tile"
    return None if fits else f"these kernels have no such tile for compute capability {capability[0]}.{capability[1]}"


def _fits_attention(key: TileKey, tile: attention_tiles.AttentionTile, capability: Capability) -> bool:
    return tile in attention_tiles.candidates(key.operation, capability, key.inner)  # type: ignore[arg-type]


def _fits_portable(key: TileKey, tile: portable.Tile, capability: Capability) -> bool:
    known = portable.candidates(capability, key.numbers == "fp8", key.operation, key.inner)  # type: ignore[arg-type]
    return replace(tile, splits=1) in known and (tile.splits == 1 or tile in known)


def _fits_hopper(key: TileKey, knobs: Knobs) -> bool:
    tile = from_knobs(knobs)
    operation: Operation = key.operation  # type: ignore[assignment]
    return isinstance(tile, Tile) and any(
        possible(tile, operation, key.numbers == "fp8", key.inner, adds) for adds in (False, True)
    )
