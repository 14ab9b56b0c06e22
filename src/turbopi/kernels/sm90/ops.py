"""The engine's operations on Hopper: our products and attention where they win, the portable ones elsewhere."""

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from turbopi.kernels.interface import Ops, Segments
from turbopi.kernels.portable import attention as portable_attention
from turbopi.kernels.portable import batch as portable_batch
from turbopi.kernels.portable import norms
from turbopi.kernels.portable.ops import attend as attend_portably
from turbopi.kernels.portable.ops import portable_ops
from turbopi.kernels.sm90 import instructions
from turbopi.kernels.sm90.attention import kernel as attention
from turbopi.kernels.sm90.attention import suffix, suffix_tile
from turbopi.kernels.sm90.gemm import products
from turbopi.kernels.sm90.gemm.bf16 import Tile
from turbopi.kernels.sm90.gemm.fp8 import GATHERING_SMS
from turbopi.kernels.sm90.gemm.tiles import PARTS_TILES, RESIDUAL_TILES, VISION_TILES
from turbopi.kernels.sm90.norms import layer_norm
from turbopi.kernels.sm90.vision import FusedVision
from turbopi.kernels.sm90.vjp import products as vjp
from turbopi.kernels.tile_table import NO_TILES, TileTable
from turbopi.quantization.fp8 import E4M3


def hopper_ops(device: torch.device, tiles: TileTable = NO_TILES) -> Ops:
    """With these measured tiles, and in sizes that they don't have those of gemm/tiles.py."""
    portable, batch = portable_ops(tiles), portable_batch.batch_ops(tiles)
    attention_of_images = partial(vision_attention, tiles=tiles)
    origin = {
        "vision products": f"CUDA for {_rows(VISION_TILES)} rows, else cuBLAS",
        "GeGLU of the prefix": "CUDA, in its product's epilogue, or Triton behind cuBLAS",
        "residual stream": f"products of {products.ADDING_ROWS} rows and more in our tiles are added to it in place",
        "product behind the prefix's GeGLU": "in parts that the norm behind it adds up: "
        f"CUDA for {_rows(PARTS_TILES, Tile)} rows, cuBLAS for {_rows(PARTS_TILES, int)}, in whole 64; else "
        "cuBLAS at once",
        "the expert with a way back": vjp.ORIGIN,
        "vision and prefix attention": "CUDA; Triton where head_dim isn't a multiple of 8 from 16 to 256",
    }
    whose = f"CUDA from {layer_norm.ROWS} rows on, else Triton"
    if instructions.multiprocessors(device) >= GATHERING_SMS:
        whose = f"most in the products around them for {_rows(RESIDUAL_TILES)} rows, {whose}"
    origin["LayerNorm"] = whose
    return replace(
        portable,
        residual_layer_norm=layer_norm.residual_layer_norm,
        linear=partial(products.tuned_linear, tiles=tiles),
        residual_linear=partial(products.tuned_residual_linear, tiles=tiles),
        add_linear=partial(products.added, tiles=tiles),
        linear_gelu=partial(products.tuned_linear_gelu, tiles=tiles),
        linear_geglu=partial(products.tuned_linear_geglu, tiles=tiles),
        vision_attention=attention_of_images,
        vision=FusedVision(attention_of_images, tiles),
        attention=partial(attend, tiles=tiles),
        backward=vjp.backward_form,
        batch=replace(
            batch,
            packed_attention=partial(packed_attention, tiles=tiles),
            suffix_attention=partial(suffix_attention, tiles=tiles),
            origin="CUDA; Triton for suffixes where head_dim isn't 64, 128, 192 or 256",
        ),
        origin={**portable.origin, **origin},
    )


def in_int8(ops: Ops) -> Ops:
    """These operations for weights of which some are in INT8 and none in E4M3.

    LayerNorms aren't in products: an E4M3 copy of the stream may be 16 times larger than calibration saw it, and int8
    has no room for that.
    """
    origin = {name: whose for name, whose in ops.origin.items() if name != "FP8 products"}
    origin |= {"INT8 products": "CUDA, with bias, GELU, GeGLU and rounding in the epilogue", "LayerNorm": "Triton"}
    return replace(ops, residual_layer_norm=norms.residual_layer_norm, vision=None, origin=origin)


def _rows(tiles: Mapping[tuple[int, int, int], Tile | int], kind: type = Tile) -> str:
    return ", ".join(str(rows) for rows in sorted({rows for (rows, _, _), tile in tiles.items() if type(tile) is kind}))


def attend(
    q: Tensor,
    k: Tensor,
    v: Tensor,
    length: Tensor,
    slots: int,
    heads: int,
    *state_token: Any,
    inverse: float | None = None,
    numbers: torch.dtype = E4M3,
    tiles: TileTable = NO_TILES,
) -> Tensor:
    if k.shape[0] == slots and attention.takes(q.shape[1]):  # no suffix behind the prefix
        return attention.prefix_attention(q, k, v, length, heads, inverse, numbers=numbers)
    return attend_portably(
        *(q, k, v, length, slots, heads), *state_token, inverse=inverse, numbers=numbers, tiles=tiles
    )


def packed_attention(
    q: Tensor,
    k: Tensor,
    v: Tensor,
    segments: Segments,
    heads: int,
    inverse: float | None = None,
    numbers: torch.dtype = E4M3,
    tiles: TileTable = NO_TILES,
) -> Tensor:
    if attention.takes(q.shape[1]):
        return attention.packed_attention(q, k, v, segments, heads, inverse, numbers=numbers)
    return portable_batch.packed_attention(q, k, v, segments, heads, inverse, numbers=numbers, tiles=tiles)


def vision_attention(
    qkv: Tensor,
    images: int,
    heads: int,
    inverse: float | None = None,
    numbers: torch.dtype = E4M3,
    stream: Tensor | None = None,
    tiles: TileTable = NO_TILES,
) -> Tensor:
    given: dict[str, Any] = {"numbers": numbers, "stream": stream}
    if attention.takes(qkv.shape[1] // 3 // heads):
        return attention.vision_attention(qkv, images, heads, inverse, **given)
    return portable_attention.vision_attention(qkv, images, heads, inverse, **given, tiles=tiles)


def suffix_attention(
    qkv: Tensor,
    cos: Tensor,
    sin: Tensor,
    prefix_k: Tensor,
    prefix_v: Tensor,
    starts: Tensor,
    lengths: Tensor,
    heads: int,
    state_token: bool = False,
    inverse: float | None = None,
    tiles: TileTable = NO_TILES,
) -> Tensor:
    given = (qkv, cos, sin, prefix_k, prefix_v, starts, lengths, heads, state_token, inverse)
    if suffix_tile.takes(prefix_k.shape[1]):
        return suffix.suffix_attention(*given)
    return portable_batch.suffix_attention(*given, tiles=tiles)
