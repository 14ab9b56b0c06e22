"""Matrix products, each by the kernel that is fastest for it: ours for what was measured so, cuBLAS's else.

`tiles` are those that `turbopi tune` measured on this GPU; gemm/tiles.py and best_tile choose what they don't have.
"""

from dataclasses import asdict
from functools import lru_cache
from typing import Any, Literal

import torch
from torch import Tensor

from turbopi.kernels.plain import as_input
from turbopi.kernels.portable.products import linear, linear_geglu, linear_gelu
from turbopi.kernels.sm90.gemm.bf16 import DEPTH, SPLIT, Epilogue, Tile, matmul
from turbopi.kernels.sm90.gemm.fp8 import best_tile, matmul_fp8
from turbopi.kernels.sm90.gemm.tiles import (
    FEW_GEGLU_TILES,
    FEW_TILES,
    GEGLU_TILES,
    PARTS_TILES,
    RESIDUAL_TILES,
    RESIDUAL_TILES_FP8,
    VISION_TILES,
)
from turbopi.kernels.sm90.instructions import multiprocessors
from turbopi.kernels.tile_table import LIBRARY, NO_TILES, Knobs, TileTable
from turbopi.quantization.fp8 import E4M3, Matrix, ScaledMatrix

# Of fewer rows it wasn't measured; there the norm behind is bound by its launch.
ADDING_ROWS = 1024
GEGLU_FILL = 0.885  # where less of our tiles' area is used, the library's choice of tiles is better


Operation = Epilogue | Literal["residual"]
Chosen = Tile | int | None  # the library: over so many parts of the inner axis at once, or None


def chosen(tiles: TileTable, operation: Operation, m: int, n: int, k: int) -> Chosen:
    """How a bfloat16 product [m, k] x [n, k] is made, but for "geglu". "residual" by the library: not that way."""
    knobs = tiles.find("hopper", operation, "bf16", m, n, k)
    if knobs is not None:
        return from_knobs(knobs)
    if operation in ("plain", "parts"):
        return (FEW_TILES if operation == "plain" else PARTS_TILES).get((-(-m // 64) * 64, n, k))
    return (RESIDUAL_TILES if operation == "residual" else VISION_TILES).get((m, n, k))


def chosen_fp8(
    tiles: TileTable, operation: Operation, m: int, n: int, k: int, sms: int, whole: bool = False
) -> Tile | None:
    """The tile of a product of E4M3 numbers; None: "residual" isn't made that way. `whole`: of int8, which no tiles are
    measured for.
    """
    knobs = None if whole else tiles.find("hopper", operation, "fp8", m, n, k)
    if knobs is not None:
        tile = from_knobs(knobs)
        return tile if isinstance(tile, Tile) else None
    if operation == "residual":
        return None if whole else RESIDUAL_TILES_FP8.get((m, n, k))
    return best_tile(m, n, k, operation, sms, whole)


def from_knobs(knobs: Knobs) -> Chosen:
    if LIBRARY in knobs:
        return knobs[LIBRARY] if knobs[LIBRARY] > 1 else None
    fields: dict[str, Any] = dict(knobs)
    return Tile(**fields | {name: bool(knobs[name]) for name in ("overlap", "gather") if name in knobs})


def to_knobs(chosen: Chosen) -> dict[str, int]:
    """What `from_knobs` reads."""
    if not isinstance(chosen, Tile):
        return {LIBRARY: chosen or 1}
    return {name: int(value) for name, value in asdict(chosen).items()}


def bf16_tile(tiles: TileTable, operation: Operation, x: Tensor, weight: Tensor) -> Tile | None:
    tile = chosen(tiles, operation, x.shape[0], *weight.shape)
    return tile if isinstance(tile, Tile) else None


def tuned_linear(
    x: Tensor,
    weight: Matrix,
    bias: Tensor | None = None,
    out: Tensor | None = None,
    ahead: Tensor | None = None,
    *,
    tiles: TileTable = NO_TILES,
) -> Tensor:
    epilogue: Epilogue = "plain" if bias is None else "bias"
    if isinstance(weight, ScaledMatrix):
        return _fp8(x, weight, epilogue, bias, out, ahead=ahead, tiles=tiles)
    tile = bf16_tile(tiles, epilogue, x, weight)
    if tile is None:
        return linear(x, weight, bias, out)
    return matmul(x, weight, tile, epilogue, bias, out, ahead=ahead)


def tuned_residual_linear(
    x: Tensor,
    weight: Matrix,
    bias: Tensor | None = None,
    ahead: Tensor | None = None,
    *,
    tiles: TileTable = NO_TILES,
) -> Tensor:
    """The product, or parts of it that the norms add up."""
    if isinstance(weight, ScaledMatrix):
        return _fp8(x, weight, "parts" if bias is None else "partial", bias, ahead=ahead, tiles=tiles)
    if bias is None:
        cut = chosen(tiles, "parts", x.shape[0], *weight.shape)
        if isinstance(cut, Tile):
            # a tile that was measured where its result is added may overlap, as that of "plain" may
            return matmul(x, weight, cut, "plain" if cut.overlap else "parts", ahead=ahead)
        return linear(x, weight) if cut is None else parts_at_once(x, weight, cut)
    tile = bf16_tile(tiles, "partial", x, weight)
    if tile is None:
        return linear(x, weight, bias)
    return matmul(x, weight, tile, "partial" if tile.splits > 1 and not tile.gather else "bias", bias, ahead=ahead)


def added(
    stream: Tensor,
    x: Tensor,
    weight: Matrix,
    bias: Tensor | None = None,
    ahead: Tensor | None = None,
    *,
    tiles: TileTable = NO_TILES,
) -> bool:
    """Add the matmul to the stream in place, if that is the faster way. Returns whether it did."""
    if len(x) < ADDING_ROWS:
        return False
    (rows, inner), columns = x.shape, weight.shape[0]
    operation: Operation = "parts" if bias is None else "partial"
    if isinstance(weight, ScaledMatrix):
        cut: Chosen = chosen_fp8(
            tiles, operation, rows, columns, inner, multiprocessors(x.device), weight.numbers == torch.int8
        )
    else:
        cut = chosen(tiles, operation, rows, columns, inner)
    if isinstance(cut, Tile) and cut.splits == 1:
        if isinstance(weight, ScaledMatrix):
            matmul_fp8(x, weight, cut, "added", bias, stream, ahead=ahead)
        else:
            matmul(x, weight, cut, "added", bias, stream, ahead=ahead)
        return True
    return False  # parts are added in the norm; the library loses more by the stream than the norm gains


def parts_at_once(x: Tensor, weight: Tensor, count: int) -> Tensor:
    """[count, tokens, out]: products over `count` parts of the inner axis, as one batch of the library's."""
    rows, inner = x.shape[0], x.shape[1] // count
    a = x.view(rows, count, inner).transpose(0, 1)
    return torch.bmm(a, weight.view(-1, count, inner).permute(1, 2, 0))


def tuned_linear_gelu(
    x: Tensor,
    weight: Matrix,
    bias: Tensor,
    inverse: float | None = None,
    ahead: Tensor | None = None,
    *,
    numbers: torch.dtype = E4M3,
    stream: Tensor | None = None,
    tiles: TileTable = NO_TILES,
) -> Tensor:
    if isinstance(weight, ScaledMatrix):
        return _fp8(x, weight, "gelu", bias, inverse=inverse, stream=stream, ahead=ahead, tiles=tiles)
    tile = bf16_tile(tiles, "gelu", x, weight)
    result = linear_gelu(x, weight, bias) if tile is None else matmul(x, weight, tile, "gelu", bias, ahead=ahead)
    return as_input(result, x.dtype, inverse, numbers, stream)


def tuned_linear_geglu(
    x: Tensor,
    gate_up: Matrix,
    inverse: float | None = None,
    *,
    numbers: torch.dtype = E4M3,
    stream: Tensor | None = None,
    tiles: TileTable = NO_TILES,
) -> Tensor:
    if isinstance(gate_up, ScaledMatrix):
        return _fp8(x, gate_up, "geglu", inverse=inverse, stream=stream, tiles=tiles)
    tile = chosen_geglu(tiles, x.shape[0], gate_up.shape[0] // 2, x.shape[1], multiprocessors(x.device))
    result = linear_geglu(x, gate_up) if tile is None else matmul(x, gate_up, tile, "geglu")
    return as_input(result, x.dtype, inverse, numbers, stream)


def _fp8(
    x: Tensor,
    weight: ScaledMatrix,
    epilogue: Epilogue,
    bias: Tensor | None = None,
    out: Tensor | None = None,
    inverse: float | None = None,
    stream: Tensor | None = None,
    ahead: Tensor | None = None,
    *,
    tiles: TileTable,
) -> Tensor:
    whole = weight.numbers == torch.int8
    n = weight.shape[0] // 2 if epilogue == "geglu" else weight.shape[0]
    tile = chosen_fp8(tiles, epilogue, x.shape[0], n, weight.shape[1], multiprocessors(x.device), whole)
    assert tile is not None, "the library has no such product"
    if epilogue in SPLIT and (tile.splits == 1 or tile.gather):
        epilogue = "bias"
    return matmul_fp8(x, weight, tile, epilogue, bias, out, inverse, stream=stream, ahead=ahead)


def chosen_geglu(tiles: TileTable, rows: int, hidden: int, inner: int, sms: int) -> Tile | None:
    """As `chosen`, of "geglu"; None: the library, and GeGLU behind it."""
    knobs = tiles.find("hopper", "geglu", "bf16", rows, hidden, inner)
    if knobs is not None:
        tile = from_knobs(knobs)
        return tile if isinstance(tile, Tile) else None
    return _geglu_tile(rows, hidden, inner, sms)


@lru_cache
def _geglu_tile(rows: int, hidden: int, inner: int, sms: int) -> Tile | None:
    """The first tile to waste least on the matrix's ragged edges and on the last wave of tiles, if that is little."""
    if (few := FEW_GEGLU_TILES.get((-(-rows // 64) * 64, hidden, inner))) is not None:
        return few

    def fill(tile: Tile) -> float:
        tiles = -(-rows // tile.rows) * -(-2 * hidden // tile.columns)
        return rows * 2 * hidden / (-(-tiles // sms) * sms * tile.rows * tile.columns)

    best = max((tile for tile in GEGLU_TILES if tile.takes("geglu", -(-inner // DEPTH))), key=fill)
    return best if fill(best) > GEGLU_FILL else None
