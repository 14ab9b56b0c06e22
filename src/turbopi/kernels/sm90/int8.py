"""The engine's operations in INT8 on Hopper: products by wgmma, whose sums of whole numbers are exact.

Norms are the portable ones, which round to int8 and mark its damage, and LayerNorms aren't in products: an E4M3 copy of
the stream may be 16 times larger than its norm was, and int8 has no room for that. Attention leaves in bfloat16 and is
rounded behind it.
"""

from dataclasses import replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from turbopi.kernels.interface import Ops, Segments
from turbopi.kernels.portable.norms import residual_layer_norm
from turbopi.kernels.portable.rounding import round_rows_to_int8
from turbopi.kernels.sm90 import ops as hopper
from turbopi.kernels.tile_table import TileTable
from turbopi.quantization.fp8 import E4M3


def with_int8(ops: Ops, tiles: TileTable) -> Ops:
    """Hopper's operations, for weights of which some are in INT8 and none in E4M3."""
    assert ops.batch is not None
    return replace(
        ops,
        residual_layer_norm=residual_layer_norm,
        vision=None,
        vision_attention=partial(vision_attention, tiles=tiles),
        attention=partial(attend, tiles=tiles),
        batch=replace(ops.batch, packed_attention=partial(packed_attention, tiles=tiles)),
        origin={
            **{name: whose for name, whose in ops.origin.items() if name != "FP8 products"},
            "INT8 products": "CUDA, with bias, GELU, GeGLU and rounding in the epilogue",
            "LayerNorm, rounding behind attention": "Triton",
        },
    )


def _rounded(attended: Tensor, inverse: float | None, numbers: torch.dtype, marked: Tensor | None) -> Tensor:
    if inverse is None:
        return attended
    assert numbers == torch.int8, "E4M3 stands beside no INT8"
    return round_rows_to_int8(attended, inverse, marked)


def vision_attention(
    qkv: Tensor,
    images: int,
    heads: int,
    inverse: float | None = None,
    numbers: torch.dtype = E4M3,
    stream: Tensor | None = None,
    *,
    tiles: TileTable,
) -> Tensor:
    return _rounded(hopper.vision_attention(qkv, images, heads, tiles=tiles), inverse, numbers, stream)


def attend(
    q: Tensor,
    k: Tensor,
    v: Tensor,
    *given: Any,
    inverse: float | None = None,
    numbers: torch.dtype = E4M3,
    tiles: TileTable,
) -> Tensor:
    return _rounded(hopper.attend(q, k, v, *given, tiles=tiles), inverse, numbers, v)


def packed_attention(
    q: Tensor,
    k: Tensor,
    v: Tensor,
    segments: Segments,
    heads: int,
    inverse: float | None = None,
    numbers: torch.dtype = E4M3,
    *,
    tiles: TileTable,
) -> Tensor:
    return _rounded(hopper.packed_attention(q, k, v, segments, heads, tiles=tiles), inverse, numbers, v)
