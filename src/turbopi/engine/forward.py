"""The reference's forward pass for batch 1 in static shapes: what a CUDA graph captures.

The prefix is compacted on the host: valid cameras, then valid prompt tokens, then padding up to the bucket. Padding
sits at the end only and `length`, in device memory, says where it begins; so nothing is captured anew when the prompt
or the state changes. The mathematics is `turbopi.model.reference`'s; only its order of work differs:

  - matrices that share an input are one product; adaRMS comes from a table of all steps;
  - a residual is added together with the norm behind it;
  - where the next matrix is an `Fp8Matrix`, an operation's result is rounded to E4M3 for it;
  - logits leave their product in float32 and keys beyond `length` get -inf before the softmax.

Shapes: V cameras, S prefix slots of the bucket, H suffix tokens, D width, K head_dim, n query heads.
"""

import torch
from torch import Tensor

from turbopi.config import ModelConfig
from turbopi.engine.weights import Weights
from turbopi.kernels.interface import Ops
from turbopi.model.layers import rope_tables
from turbopi.quantization.fp8 import input_of

Rope = tuple[Tensor, Tensor]  # cos, sin float32[tokens, K/2]
Normed = tuple[Tensor, Tensor, Tensor | None]  # residual stream, its norm, the gate of the next residual


def vision_tokens(config: ModelConfig, weights: Weights, ops: Ops, images: Tensor, out: Tensor) -> None:
    """Pictures (uint8|float32)[V, 224, 224, 3] -> language-model tokens, into `out` [V * 256, D]."""
    v, n = config.vision, images.shape[0]
    x = ops.embed_patches(images, weights.patch, weights.position, out.dtype)  # [V * 256, W]
    y = None
    for layer in weights.vision:
        x, normed = ops.residual_layer_norm(x, y, *layer.norm1, v.layer_norm_eps, **input_of(layer.qkv[0]))
        attended = ops.vision_attention(ops.linear(normed, *layer.qkv), n, v.num_heads, **input_of(layer.out[0]))
        x, normed = ops.residual_layer_norm(
            x, ops.residual_linear(attended, *layer.out), *layer.norm2, v.layer_norm_eps, **input_of(layer.fc1[0])
        )
        y = ops.residual_linear(ops.linear_gelu(normed, *layer.fc1, **input_of(layer.fc2[0])), *layer.fc2)
    _, normed = ops.residual_layer_norm(x, y, *weights.post_layernorm, v.layer_norm_eps)
    ops.linear(normed, *weights.projector, out)


def prefix_cache(
    config: ModelConfig,
    weights: Weights,
    ops: Ops,
    x: Tensor,
    length: Tensor,
    cache_k: Tensor,
    cache_v: Tensor,
    rope: Rope,
) -> None:
    """Run prefix embeddings [S, D] through the language model, writing the first S rows of [layer, S + H, K]."""
    g, eps, slots = config.vlm, config.rms_norm_eps, x.shape[0]
    y = None
    for i, layer in enumerate(weights.vlm):
        k, v = cache_k[i, :slots], cache_v[i, :slots]
        x, normed = ops.residual_rms_norm(x, y, None, layer.norm1, None, eps, **input_of(layer.qkv))
        if i + 1 == len(weights.vlm):  # nothing but K and V of the last layer is ever used
            ops.rope_split(ops.linear(normed, layer.qkv[-2 * g.head_dim :]), *rope, k, v)
            return
        q = ops.rope_split(ops.linear(normed, layer.qkv), *rope, k, v)
        attended = ops.attention(q, k, v, length, slots, g.num_heads, **input_of(layer.out))
        y = ops.residual_linear(attended, layer.out)
        x, normed = ops.residual_rms_norm(x, y, None, layer.norm2, None, eps, **input_of(layer.gate_up))
        y = ops.residual_linear(ops.linear_geglu(normed, layer.gate_up, **input_of(layer.down)), layer.down)


def expert_output(
    config: ModelConfig,
    weights: Weights,
    ops: Ops,
    tokens: Tensor,
    table: Tensor | None,
    length: Tensor,
    cache_k: Tensor,
    cache_v: Tensor,
    rope: Rope,
) -> Tensor:
    """Suffix tokens [H, D] through the action expert and its final norm, in float32.

    Its keys and values go into the last H rows of the cache [layer, S + H, K], behind the prefix's. `table`
    float32[2 * layers + 1, 3, D] is one step of the modulation (Pi0.5) or None (Pi0).
    """
    g, eps, suffix = config.expert, config.rms_norm_eps, tokens.shape[0]
    slots = cache_k.shape[1] - suffix

    def norm(x: Tensor, y: Tensor | None, gate: Tensor | None, plain: Tensor | None, index: int) -> Normed:
        scale, shift, next_gate = (plain, None, None) if table is None else table[index].unbind(0)
        return (*ops.residual_rms_norm(x, y, gate, scale, shift, eps), next_gate)

    x, y, gate = tokens, None, None
    for i, layer in enumerate(weights.expert):
        x, normed, gate = norm(x, y, gate, layer.norm1, 2 * i)
        q = ops.rope_split(ops.linear(normed, layer.qkv), *rope, cache_k[i, slots:], cache_v[i, slots:])
        attended = ops.attention(q, cache_k[i], cache_v[i], length, slots, g.num_heads, config.kind == "pi0")
        x, normed, gate = norm(x, ops.residual_linear(attended, layer.out), gate, layer.norm2, 2 * i + 1)
        y = ops.residual_linear(ops.linear_geglu(normed, layer.gate_up), layer.down)
    return norm(x, y, gate, weights.expert_norm, 2 * g.depth)[1].float()


def rope_of_all_positions(config: ModelConfig, count: int, device: torch.device) -> Rope:
    """RoPE tables of positions 0 … count - 1: the same for every call."""
    cos, sin = rope_tables(torch.arange(count, device=device)[None], config.vlm.head_dim, config.rope_base)
    return cos[0, 0], sin[0, 0]
