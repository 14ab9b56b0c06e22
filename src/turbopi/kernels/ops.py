"""The engine's operations with our kernels where they win and the library's elsewhere, for NVIDIA GPUs.

Activations are bfloat16; with an `Fp8Matrix` (on Hopper only) they are E4M3 between it and the operation before it.
"""

from collections.abc import Mapping
from functools import partial
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from turbopi.kernels import attention, embedding, norms, plain, rope
from turbopi.kernels.interface import Ops
from turbopi.kernels.launch import capability
from turbopi.kernels.sm90.attention import kernel as attention_hopper
from turbopi.kernels.sm90.gemm import products
from turbopi.kernels.sm90.gemm.bf16 import Tile
from turbopi.kernels.sm90.gemm.fp8 import GATHERING_SMS
from turbopi.kernels.sm90.gemm.vision_tower import RESIDUAL_TILES, VisionTower


def fused_ops(device: torch.device) -> Ops:
    """Triton's kernels between the products; on Hopper our products where they win, elsewhere cuBLAS with epilogues."""
    hopper = capability(device) == (9, 0)
    tower = VisionTower()
    return Ops(
        embed_patches=EmbedPatches(),
        embed_prompt=embedding.embed_prompt,
        residual_rms_norm=norms.residual_rms_norm,
        residual_layer_norm=tower.residual_layer_norm if hopper else norms.residual_layer_norm,
        linear=tower.linear if hopper else products.linear,
        residual_linear=tower.residual_linear if hopper else products.linear,
        linear_gelu=tower.linear_gelu if hopper else products.linear_gelu,
        linear_geglu=products.tuned_linear_geglu if hopper else products.linear_geglu,
        rope_split=rope.rope_split,
        vision_attention=vision_attention_on_hopper if hopper else attention.vision_attention,
        attention=partial(attend, hopper=hopper),
        origin={
            "matrix products": "cuBLAS, with bias and GELU in its epilogue",
            "vision products": f"CUDA for {_rows(products.VISION_TILES)} rows, else cuBLAS" if hopper else "cuBLAS",
            "GeGLU of the prefix": "CUDA, in its product's epilogue, or Triton behind cuBLAS" if hopper else "Triton",
            "product behind the prefix's GeGLU": "in parts that the norm behind it adds up: "
            f"CUDA for {_rows(products.PARTS, Tile)} rows, cuBLAS for {_rows(products.PARTS, int)}, in whole 64; else "
            "cuBLAS at once"
            if hopper
            else "cuBLAS",
            "vision and prefix attention": "CUDA; Triton where head_dim isn't a multiple of 8 from 16 to 256"
            if hopper
            else "Triton",
            "suffix attention": "cuBLAS and Triton's softmax",
            "LayerNorm": f"most in the products around them for {_rows(RESIDUAL_TILES)} rows, else Triton"
            if hopper and products.num_sms(device) >= GATHERING_SMS
            else "Triton",
            "other norms, GeGLU of the suffix, RoPE, patches, prompt embedding": "Triton",
        },
    )


def _rows(tiles: Mapping[tuple[int, int, int], Tile | int], kind: type = Tile) -> str:
    return ", ".join(str(rows) for rows in sorted({rows for (rows, _, _), tile in tiles.items() if type(tile) is kind}))


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
    hopper: bool = False,
) -> Tensor:
    if k.shape[0] == slots:  # no suffix behind the prefix
        ours = attention_hopper if hopper and attention_hopper.takes(q.shape[1]) else attention
        return ours.prefix_attention(q, k, v, length, heads, inverse)
    assert inverse is None, "the suffix's activations stay as they are"
    return plain.attention(q, k, v, length, slots, heads, *state_token, softmax=attention.masked_softmax)


def vision_attention_on_hopper(qkv: Tensor, images: int, heads: int, inverse: float | None = None) -> Tensor:
    ours = attention_hopper if attention_hopper.takes(qkv.shape[1] // 3 // heads) else attention
    return ours.vision_attention(qkv, images, heads, inverse)
