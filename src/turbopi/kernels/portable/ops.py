"""The engine's operations for any NVIDIA GPU: Triton's kernels between cuBLAS's products; FP8 and INT8
products are Triton's."""

from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from turbopi.kernels import plain
from turbopi.kernels.interface import Ops
from turbopi.kernels.portable import attention, backward, batch, embedding, norms, products, resize, rope
from turbopi.quantization.fp8 import E4M3

GEGLU_ORIGIN = "Triton, in its product's epilogue" if products.BF16_GEGLU_IN_EPILOGUE else "Triton behind cuBLAS"


def portable_ops() -> Ops:
    return Ops(
        embed_patches=EmbedPatches(),
        embed_prompt=embedding.embed_prompt,
        residual_rms_norm=norms.residual_rms_norm,
        residual_layer_norm=norms.residual_layer_norm,
        linear=products.linear,
        residual_linear=products.residual_linear,
        linear_gelu=products.linear_gelu,
        linear_geglu=products.linear_geglu,
        rope_split=rope.rope_split,
        vision_attention=attention.vision_attention,
        attention=attend,
        resize_pictures=resize.resize_pictures,
        backward=backward.BACKWARD,
        batch=batch.BATCH,
        origin={
            "matrix products": "cuBLAS, with bias and GELU in its epilogue",
            "FP8 products": "Triton, with bias, GELU, GeGLU and rounding in the epilogue, and so INT8's",
            "vision products": "cuBLAS",
            "GeGLU of the prefix": GEGLU_ORIGIN,
            "product behind the prefix's GeGLU": "cuBLAS",
            "vision and prefix attention": "Triton",
            "suffix attention": "cuBLAS and Triton's softmax",
            "LayerNorm": "Triton",
            "other norms, GeGLU of the suffix, RoPE, patches, prompt embedding, pictures' sizes": "Triton",
        },
    )


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
) -> Tensor:
    if k.shape[0] == slots:  # no suffix behind the prefix
        return attention.prefix_attention(q, k, v, length, heads, inverse, numbers)
    assert inverse is None, "the suffix's activations stay as they are"
    return plain.attention(q, k, v, length, slots, heads, *state_token, softmax=attention.masked_softmax)
