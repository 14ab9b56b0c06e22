"""Tiles of Hopper's products that are worth measuring: `turbopi tune` takes the cheapest by the cost model, and kin."""

from collections.abc import Iterator
from dataclasses import replace

from turbopi.kernels.sm90.gemm import bf16, fp8
from turbopi.kernels.sm90.gemm.bf16 import SPLIT, Epilogue, Tile
from turbopi.kernels.sm90.gemm.products import Chosen, Operation

CHEAPEST, WITH_KIN = 10, 5  # tiles by the cost model; of so many also clusters and shorter rings
OVERLAPPED = 8  # tiles, the cheapest, whose epilogue overlaps; GeGLU's come with the kin
HALVED = 4  # tiles, the cheapest, of which two fit a multiprocessor
MOST_SUMS, MOST_OVERLAPPED = 192 * 192, 192 * 128  # numbers of a tile, and of one whose epilogue overlaps
MOST_CLUSTER = 8
LEAST_STAGES = 3
SHORT_RING = 5
LIBRARY_PARTS = (2, 4)  # parts of the inner axis that cuBLAS multiplies at once


def epilogue_of(operation: Operation) -> Epilogue:
    """What the cost model knows an operation by."""
    return "bias" if operation == "residual" else operation


def epilogue_with(operation: str, tile: Tile, in_fp8: bool, adds: bool = False) -> Epilogue:
    """What the kernel is compiled with: where nothing stays split, "partial" and E4M3's "parts" are "bias", or, where
    the result `adds` to the residual stream in place, "added".
    """
    epilogue = epilogue_of(operation)  # type: ignore[arg-type]
    whole = tile.splits == 1 or tile.gather
    if adds and epilogue in SPLIT and tile.splits == 1:
        return "added"
    return "bias" if whole and epilogue in SPLIT and (in_fp8 or epilogue == "partial") else epilogue


def possible(tile: Tile, operation: Operation, in_fp8: bool, k: int, adds: bool = False) -> bool:
    """Whether the kernel takes this tile: shares of a cluster in whole groups, registers, shared memory, splits."""
    geglu, steps = operation == "geglu", -(-k // (fp8.DEPTH if in_fp8 else bf16.DEPTH))
    share = 8 * tile.cluster_m * (2 if geglu else 1)
    if tile.warpgroups not in (1, 2, 3) or not 16 <= tile.columns <= 256 or tile.columns % share:
        return False
    if not 1 <= tile.cluster <= MOST_CLUSTER or tile.rows % (8 * tile.cluster_n) or not 1 <= tile.splits <= steps:
        return False
    whole = tile.splits == 1 or tile.gather
    if (tile.gather and (operation not in ("residual", "partial") or tile.splits == 1)) or (
        not whole and operation not in SPLIT
    ):
        return False
    if tile.rows * tile.columns > (MOST_OVERLAPPED if tile.overlap else MOST_SUMS):
        return False
    promoted = fp8.promotion(tile, k) if in_fp8 else 0
    if in_fp8 and steps > fp8.UNPROMOTED_STEPS * tile.splits and not promoted:
        return False
    if tile.overlap and (operation == "residual" or promoted or tile.splits > 1):
        return False
    epilogue = epilogue_with(operation, tile, in_fp8, adds)
    stages = tile.stages(factors=2 if in_fp8 else 1, lines=bf16.leaves_in_lines(tile, epilogue))
    return tile.takes(epilogue, steps) and stages >= LEAST_STAGES


def candidates(
    operation: Operation, in_fp8: bool, m: int, n: int, k: int, sms: int, usual: Chosen, adds: bool = False
) -> list[Chosen]:
    """The usual choice, the library's in bfloat16, and tiles: the first is the usual one.

    adds: as of `epilogue_with`
    """
    found: list[Chosen] = [usual]
    if not in_fp8 and operation != "residual":
        found += [None, *(LIBRARY_PARTS if operation == "parts" else ())]
    found += _tiles(operation, in_fp8, m, n, k, sms, adds)
    return list(dict.fromkeys(found))


def _tiles(operation: Operation, in_fp8: bool, m: int, n: int, k: int, sms: int, adds: bool) -> list[Tile]:
    epilogue, wide = epilogue_of(operation), k if in_fp8 else 2 * k  # the cost model counts bytes along the inner axis
    plain = [tile for tile in _plain(operation, m) if possible(tile, operation, in_fp8, k, adds)]

    def price(tile: Tile) -> float:
        return fp8.cost(tile, m, n, wide, epilogue, sms)

    cheapest = sorted(plain, key=price)[:CHEAPEST]
    kin = [other for tile in cheapest[:WITH_KIN] for other in _kin(tile, operation, m, n)]
    overlapped = [] if operation == "geglu" else _overlapped(plain, m, n, sms)
    overlapped = [tile for tile in overlapped if possible(tile, operation, in_fp8, k, adds)]
    overlapped = sorted(overlapped, key=price)[:OVERLAPPED]
    halved = [_halved(tile, operation, in_fp8, adds) for tile in sorted(plain, key=price) if tile.leaves_room]
    in_pairs = [replace(tile, cluster_m=2) for tile in overlapped[: OVERLAPPED // 2]]
    more = (*kin, *overlapped, *in_pairs, *halved[:HALVED])
    return cheapest + [tile for tile in more if possible(tile, operation, in_fp8, k, adds)]


def _halved(tile: Tile, operation: Operation, in_fp8: bool, adds: bool) -> Tile:
    lines = bf16.leaves_in_lines(tile, epilogue_with(operation, tile, in_fp8, adds))
    return tile.halved(factors=2 if in_fp8 else 1, lines=lines)


def _overlapped(plain: list[Tile], m: int, n: int, sms: int) -> list[Tile]:
    """Those of which a CTA has several."""
    return [replace(tile, overlap=True) for tile in plain if -(-m // tile.rows) * -(-n // tile.columns) > sms]


def _plain(operation: Operation, m: int) -> list[Tile]:
    found = fp8.candidates(epilogue_of(operation), m)
    if operation not in ("residual", "partial"):
        return found
    whole = [tile for tile in found if tile.splits == 1]
    gathered = [replace(tile, splits=splits, gather=True) for tile in whole for splits in (2, 3, 4)]
    return [*found, *gathered]


def _kin(tile: Tile, operation: Operation, m: int, n: int) -> Iterator[Tile]:
    """Clusters that share rows, where there are tiles enough for them, and a ring of fewer steps."""
    columns = tile.columns // 2 if operation == "geglu" else tile.columns
    pairs_m, pairs_n = m > tile.rows, n > columns
    if pairs_m:
        yield replace(tile, cluster_m=2)
    if pairs_n:
        yield replace(tile, cluster_n=2)
    if pairs_m and pairs_n and operation != "geglu":
        yield replace(tile, cluster_m=2, cluster_n=2)
    if operation == "geglu":
        yield replace(tile, overlap=True)
        yield replace(tile, cluster_n=2, overlap=True)
    yield replace(tile, ring=SHORT_RING)
