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
from turbopi.kernels.portable.ops import attend as attend_portably
from turbopi.kernels.portable.ops import portable_ops
from turbopi.kernels.sm90.attention import kernel as attention
from turbopi.kernels.sm90.gemm import products
from turbopi.kernels.sm90.gemm.bf16 import Tile
from turbopi.kernels.sm90.gemm.fp8 import GATHERING_SMS
from turbopi.kernels.sm90.gemm.tiles import PARTS_TILES, RESIDUAL_TILES, VISION_TILES
from turbopi.kernels.sm90.gemm.vision_products import VisionProducts
from turbopi.kernels.sm90.prefix_norms import PrefixNorms
from turbopi.kernels.sm90.rope_products import RopeProducts
from turbopi.kernels.sm90.transfer import transfer
from turbopi.kernels.sm90.weights_ahead import ProductsAhead
from turbopi.kernels.tile_table import NO_TILES, TileTable

WEIGHTS_AHEAD = False  # a try: see weights_ahead.py
NORMS_IN_PRODUCTS = False  # a try: see prefix_norms.py
ROPE_IN_PRODUCTS = False  # a try: see rope_products.py


def hopper_ops(device: torch.device, tiles: TileTable = NO_TILES) -> Ops:
    """With these measured tiles, and in sizes that they don't have those of gemm/tiles.py."""
    portable, vision, batch = portable_ops(tiles), VisionProducts(tiles), portable_batch.batch_ops(tiles)
    ahead = ProductsAhead(vision, tiles) if WEIGHTS_AHEAD else None
    products_of_models = ahead or vision
    origin = {
        "vision products": f"CUDA for {_rows(VISION_TILES)} rows, else cuBLAS",
        "GeGLU of the prefix": "CUDA, in its product's epilogue, or Triton behind cuBLAS",
        "product behind the prefix's GeGLU": "in parts that the norm behind it adds up: "
        f"CUDA for {_rows(PARTS_TILES, Tile)} rows, cuBLAS for {_rows(PARTS_TILES, int)}, in whole 64; else "
        "cuBLAS at once",
        "vision and prefix attention": "CUDA; Triton where head_dim isn't a multiple of 8 from 16 to 256",
    }
    if products.num_sms(device) >= GATHERING_SMS:
        origin["LayerNorm"] = f"most in the products around them for {_rows(RESIDUAL_TILES)} rows, else Triton"
    ops = replace(
        portable,
        residual_layer_norm=vision.residual_layer_norm,
        linear=products_of_models.linear,
        residual_linear=products_of_models.residual_linear,
        linear_gelu=vision.linear_gelu,
        linear_geglu=partial(products.tuned_linear_geglu, tiles=tiles),
        vision_attention=partial(vision_attention, tiles=tiles),
        attention=partial(attend, tiles=tiles),
        transfer=transfer,
        batch=replace(
            batch,
            packed_attention=partial(packed_attention, tiles=tiles),
            origin="CUDA for prefixes, Triton for suffixes",
        ),
        origin={**portable.origin, **origin},
    )
    if ROPE_IN_PRODUCTS:
        rope = RopeProducts(ops) if ahead is None else RopeProducts(ops, ahead.behind)
        ops = replace(ops, linear=rope.linear, rope_split=rope.rope_split)
    if not NORMS_IN_PRODUCTS:
        return ops
    prefix = PrefixNorms(ops, tiles) if ahead is None else PrefixNorms(ops, tiles, ahead.behind)
    return replace(
        ops,
        residual_linear=prefix.residual_linear,
        residual_rms_norm=prefix.residual_rms_norm,
        linear_geglu=prefix.linear_geglu,
    )


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
    tiles: TileTable = NO_TILES,
) -> Tensor:
    if k.shape[0] == slots and attention.takes(q.shape[1]):  # no suffix behind the prefix
        return attention.prefix_attention(q, k, v, length, heads, inverse)
    return attend_portably(q, k, v, length, slots, heads, *state_token, inverse=inverse, tiles=tiles)


def packed_attention(
    q: Tensor,
    k: Tensor,
    v: Tensor,
    segments: Segments,
    heads: int,
    inverse: float | None = None,
    tiles: TileTable = NO_TILES,
) -> Tensor:
    if attention.takes(q.shape[1]):
        return attention.packed_attention(q, k, v, segments, heads, inverse)
    return portable_batch.packed_attention(q, k, v, segments, heads, inverse, tiles=tiles)


def vision_attention(
    qkv: Tensor, images: int, heads: int, inverse: float | None = None, tiles: TileTable = NO_TILES
) -> Tensor:
    if attention.takes(qkv.shape[1] // 3 // heads):
        return attention.vision_attention(qkv, images, heads, inverse)
    return portable_attention.vision_attention(qkv, images, heads, inverse, tiles=tiles)
