"""Matrix products, each by the kernel that is fastest for it: ours for what was measured so, cuBLAS's else."""

from functools import lru_cache

import torch
from torch import Tensor

from turbopi.kernels.portable.products import linear, linear_geglu, linear_gelu
from turbopi.kernels.sm90.gemm.bf16 import DEPTH, SPLIT, Epilogue, Tile, matmul
from turbopi.kernels.sm90.gemm.fp8 import best_tile, matmul_fp8
from turbopi.kernels.sm90.gemm.tiles import FEW_GEGLU_TILES, FEW_TILES, GEGLU_TILES, PARTS_TILES, VISION_TILES
from turbopi.quantization.fp8 import Matrix, ScaledMatrix, to_e4m3

GEGLU_FILL = 0.885  # where less of our tiles' area is used, the library's choice of tiles is better


def vision_tile(x: Tensor, weight: Tensor) -> Tile | None:
    return VISION_TILES.get((x.shape[0], weight.shape[0], weight.shape[1]))


def tuned_linear(x: Tensor, weight: Matrix, bias: Tensor | None = None, out: Tensor | None = None) -> Tensor:
    if isinstance(weight, ScaledMatrix):
        return _fp8(x, weight, "plain" if bias is None else "bias", bias, out)
    if bias is None and (few := FEW_TILES.get(_in_whole_64(x, weight))) is not None:
        return matmul(x, weight, few, "plain", out=out)
    tile = vision_tile(x, weight)
    if tile is None or bias is None:
        return linear(x, weight, bias, out)
    return matmul(x, weight, tile, "bias", bias, out)


def _in_whole_64(x: Tensor, weight: Tensor) -> tuple[int, int, int]:
    return -(-x.shape[0] // 64) * 64, weight.shape[0], weight.shape[1]


def tuned_residual_linear(x: Tensor, weight: Matrix, bias: Tensor | None = None, ahead: Tensor | None = None) -> Tensor:
    """The product, or parts of it that the norms add up."""
    if isinstance(weight, ScaledMatrix):
        return _fp8(x, weight, "parts" if bias is None else "partial", bias, ahead=ahead)
    if bias is None:
        cut = PARTS_TILES.get(_in_whole_64(x, weight))
        if isinstance(cut, Tile):
            return matmul(x, weight, cut, "parts", ahead=ahead)
        return linear(x, weight) if cut is None else parts_at_once(x, weight, cut)
    tile = vision_tile(x, weight)
    if tile is None:
        return linear(x, weight, bias)
    return matmul(x, weight, tile, "partial" if tile.splits > 1 else "bias", bias, ahead=ahead)


def parts_at_once(x: Tensor, weight: Tensor, count: int) -> Tensor:
    """[count, tokens, out]: products over `count` parts of the inner axis, as one batch of the library's."""
    rows, inner = x.shape[0], x.shape[1] // count
    a = x.view(rows, count, inner).transpose(0, 1)
    return torch.bmm(a, weight.view(-1, count, inner).permute(1, 2, 0))


def tuned_linear_gelu(
    x: Tensor, weight: Matrix, bias: Tensor, inverse: float | None = None, ahead: Tensor | None = None
) -> Tensor:
    if isinstance(weight, ScaledMatrix):
        return _fp8(x, weight, "gelu", bias, inverse=inverse, ahead=ahead)
    tile = vision_tile(x, weight)
    result = linear_gelu(x, weight, bias) if tile is None else matmul(x, weight, tile, "gelu", bias, ahead=ahead)
    return as_input(result, inverse)


def tuned_linear_geglu(x: Tensor, gate_up: Matrix, inverse: float | None = None) -> Tensor:
    if isinstance(gate_up, ScaledMatrix):
        return _fp8(x, gate_up, "geglu", inverse=inverse)
    tile = _geglu_tile(x.shape[0], gate_up.shape[0] // 2, x.shape[1], x.device)
    return as_input(linear_geglu(x, gate_up) if tile is None else matmul(x, gate_up, tile, "geglu"), inverse)


def as_input(x: Tensor, inverse: float | None) -> Tensor:
    """x, rounded to E4M3 in a pass of its own where only the product behind this one is in E4M3."""
    return x if inverse is None else to_e4m3(x, inverse)


def _fp8(
    x: Tensor,
    weight: ScaledMatrix,
    epilogue: Epilogue,
    bias: Tensor | None = None,
    out: Tensor | None = None,
    inverse: float | None = None,
    ahead: Tensor | None = None,
) -> Tensor:
    n = weight.shape[0] // 2 if epilogue == "geglu" else weight.shape[0]
    tile = best_tile(x.shape[0], n, weight.shape[1], epilogue, num_sms(x.device))
    if epilogue in SPLIT and (tile.splits == 1 or tile.gather):
        epilogue = "bias"
    return matmul_fp8(x, weight, tile, epilogue, bias, out, inverse, ahead=ahead)


@lru_cache
def num_sms(device: torch.device) -> int:
    return torch.cuda.get_device_properties(device).multi_processor_count


@lru_cache
def _geglu_tile(rows: int, hidden: int, inner: int, device: torch.device) -> Tile | None:
    """The first tile to waste least on the matrix's ragged edges and on the last wave of tiles, if that is little."""
    if (few := FEW_GEGLU_TILES.get((-(-rows // 64) * 64, hidden, inner))) is not None:
        return few
    sms = num_sms(device)

    def fill(tile: Tile) -> float:
        tiles = -(-rows // tile.rows) * -(-2 * hidden // tile.columns)
        return rows * 2 * hidden / (-(-tiles // sms) * sms * tile.rows * tile.columns)

    best = max((tile for tile in GEGLU_TILES if tile.takes("geglu", -(-inner // DEPTH))), key=fill)
    return best if fill(best) > GEGLU_FILL else None
