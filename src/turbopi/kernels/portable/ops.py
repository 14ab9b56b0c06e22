"""The engine's operations for any NVIDIA GPU: Triton's kernels between cuBLAS's products; FP8 and INT8
products are Triton's."""

from functools import partial
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from turbopi.kernels import plain
from turbopi.kernels.interface import Ops
from turbopi.kernels.portable import attention, batch, embedding, norms, products, resize, rope, transfer
from turbopi.kernels.portable.vjp import ops as vjp
from turbopi.kernels.tile_table import LIBRARY, NO_TILES, TileTable
from turbopi.quantization.fp8 import E4M3


def portable_ops(tiles: TileTable = NO_TILES) -> Ops:
    """With these measured tiles."""
    return Ops(
        transfer=transfer.transfer,
        embed_patches=EmbedPatches(),
        embed_prompt=embedding.embed_prompt,
        residual_rms_norm=norms.residual_rms_norm,
        residual_layer_norm=norms.residual_layer_norm,
        linear=partial(products.linear, tiles=tiles),
        residual_linear=partial(products.residual_linear, tiles=tiles),
        linear_gelu=partial(products.linear_gelu, tiles=tiles),
        linear_geglu=partial(products.linear_geglu, tiles=tiles),
        rope_split=rope.rope_split,
        vision_attention=partial(attention.vision_attention, tiles=tiles),
        attention=partial(attend, tiles=tiles),
        resize_images=resize.resize_images,
        backward=vjp.backward_form,
        batch=batch.batch_ops(tiles),
        origin={
            "matrix products": "cuBLAS, with bias and GELU in its epilogue",
            "FP8 products": "Triton, with bias, GELU, GeGLU and rounding in the epilogue, and so INT8's",
            "vision products": "cuBLAS",
            "GeGLU of the prefix": geglu_origin(tiles),
            "product behind the prefix's GeGLU": "cuBLAS",
            "vision and prefix attention": "Triton",
            "suffix attention": "cuBLAS and Triton's softmax",
            "the expert with a way back": vjp.ORIGIN,
            "LayerNorm": "Triton",
            "other norms, GeGLU of the suffix, RoPE, patches, prompt embedding, images' sizes, transfers": "Triton",
        },
    )


def geglu_origin(tiles: TileTable) -> str:
    """Where GeGLU behind bfloat16's products is."""
    measured = [key for key, knobs in tiles.tiles.items() if LIBRARY not in knobs and key.operation == "geglu"]
    rows = sorted({key.rows for key in measured if (key.kernels, key.numbers) == ("portable", "bf16")})
    if not rows:
        return "Triton behind cuBLAS"
    return f"Triton, in its product's epilogue for {', '.join(map(str, rows))} rows, else behind cuBLAS"


class EmbedPatches:
    """Pixels are whole numbers, so tensor cores can multiply them exactly: see `embedding.odd_rows`."""

    def __init__(self) -> None:
        self._split: dict[int, Tensor] = {}  # by the weight's address

    def __call__(self, images: Tensor, weight: Tensor, position: Tensor, dtype: torch.dtype) -> Tensor:
        patch = round((weight.shape[1] / 3) ** 0.5)
        if images.dtype != torch.uint8:
            return embedding.add_position(F.linear(embedding.patch_rows(images, patch), weight), position, dtype)
        if weight.data_ptr() not in self._split:
            self._split[weight.data_ptr()] = embedding.split_in_two(weight)
        product = torch.mm(
            embedding.odd_rows(images, patch), self._split[weight.data_ptr()].t(), out_dtype=torch.float32
        )
        return embedding.add_position(product, position, dtype)


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
    if k.shape[0] == slots:  # no suffix behind the prefix
        return attention.prefix_attention(q, k, v, length, heads, inverse, numbers, tiles=tiles)
    assert inverse is None, "the suffix's activations stay as they are"
    return plain.attention(q, k, v, length, slots, heads, *state_token, softmax=attention.masked_softmax)
