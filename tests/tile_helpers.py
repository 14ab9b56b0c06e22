"""Measured tiles and verdicts for tests: a machine that isn't there, and files about it."""

from typing import Any

from turbopi.backends.qualification import Verdict
from turbopi.backends.tuned_tiles import Machine, TileFile, TunedTile, fingerprint
from turbopi.kernels.tile_table import TileKey

ADA = Machine("NVIDIA GeForce RTX 4090", (8, 9), 128, "580.95.05", "3.6.0")
TILE = {"rows": 64, "columns": 64, "warps": 4, "stages": 6, "splits": 1}
OTHER = {"rows": 128, "columns": 128, "warps": 8, "stages": 3, "splits": 1}
KEY = TileKey("portable", "plain", "fp8", 576, 2560, 2048)


def verdict(**changes: Any) -> Verdict:
    given: dict[str, Any] = {
        "gpu": ADA.gpu,
        "compute_capability": ADA.compute_capability,
        "multiprocessors": ADA.multiprocessors,
        "memory_bytes": 24 << 30,
        "driver": ADA.driver,
        "versions": {"turbopi": "0.2.0"},
        "kernels": "portable",
        "kernels_hash": "0",
        "precision": "bf16",
        "model": "pi05",
        "sizes": "",
        "date": "2026-11-29",
        "seconds": 30.0,
        "taken": "fused",
        "reason": "right",
    }
    return Verdict(**given | changes)


def tuned_tile(key: TileKey = KEY, **changes: Any) -> TunedTile:
    given: dict[str, Any] = {
        "name": "prefix qkv",
        "kernels": key.kernels,
        "operation": key.operation,
        "numbers": key.numbers,
        "rows": key.rows,
        "columns": key.columns,
        "inner": key.inner,
        "tile": TILE,
        "microseconds": 9.0,
        "usual": OTHER,
        "usual_microseconds": 10.0,
    }
    return TunedTile(**given | changes)


def tile_document(machine: Machine = ADA, *tiles: TunedTile, **changes: Any) -> TileFile:
    given: dict[str, Any] = {
        "gpu": machine.gpu,
        "compute_capability": machine.compute_capability,
        "multiprocessors": machine.multiprocessors,
        "driver": machine.driver,
        "triton": machine.triton,
        "turbopi": "0.1.0",
        "date": "2026-11-24",
        "fingerprints": {"portable": fingerprint("portable"), "hopper": fingerprint("hopper")},
        "tiles": list(tiles or (tuned_tile(),)),
    }
    return TileFile(**given | changes)
