"""The parts of the model that become engines, written in the operations of ops.py for batch 1.

vision        SigLIP's blocks, all cameras in one batch
feed_forward  one Gemma layer's MLP over the prefix, in float or E4M3
denoise_step  the action expert once, over the whole cache
prefix_layer  one whole layer of the language model, for the precision study: its weights are inputs

Norms, RoPE, softmax and adaRMS are float32 inside, as in the reference. No float32 product is in here: TensorRT-RTX
1.4 takes TF32 for them whatever is asked for, and one whose result is cast to bfloat16 (Pi0.5's action_in_proj) had a
NaN in it on an H200. The few that the model has (patch embedding, action projections) stay in PyTorch.

V cameras, S prefix rows, R cache rows, H suffix tokens, W vision width, D width, K head_dim, n query heads over one
key/value head.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from turbopi.backends.tensorrt.ops import Dtype, NetworkOps, Value, to_fp8
from turbopi.config import ModelConfig
from turbopi.engine.weights import Weights
from turbopi.kernels.interface import GemmaLayer, VisionLayer
from turbopi.models import family_of
from turbopi.quantization.fp8 import Matrix

# Added to a hidden key's logit: behind any visible key its exp() is 0. Far from float32's lowest, which openpi takes,
# so that a library may multiply by log2(e) first.
HIDDEN = -1e9


@dataclass(frozen=True)
class Fp8Scales:
    """Of one MLP, float32 scalars. A quantised value is x / scale, rounded to E4M3."""

    input: Tensor  # of the normalised tokens: gate and up share it
    hidden: Tensor  # of gelu(gate) * up: down's input
    gate: Tensor
    up: Tensor
    down: Tensor


def vision(ops: NetworkOps, config: ModelConfig, weights: Weights, x: Value, cameras: int, dtype: Dtype) -> Value:
    """Embedded patches [V * 256, W] -> SigLIP's output [V * 256, W], both in `dtype`."""
    for layer in weights.vision:
        x = _vision_block(ops, config, layer, x, cameras, dtype)
    return _layer_norm(ops, x, *weights.post_layernorm, config.vision.layer_norm_eps, dtype)


def _vision_block(
    ops: NetworkOps, config: ModelConfig, layer: VisionLayer, x: Value, cameras: int, dtype: Dtype
) -> Value:
    v = config.vision
    normed = _layer_norm(ops, x, *layer.norm1, v.layer_norm_eps, dtype)
    qkv = _affine(ops, normed, *layer.qkv, dtype)
    split = ops.reshape(qkv, (cameras, v.num_tokens, 3, v.num_heads, v.head_dim))
    split = ops.transpose(split, (2, 0, 3, 1, 4))  # [3, V, heads, 256, K]
    shape = (cameras, v.num_heads, v.num_tokens, v.head_dim)
    q, k, value = (ops.reshape(ops.slice(split, 0, i, i + 1), shape) for i in range(3))
    attended = ops.transpose(ops.attention(q, k, value), (0, 2, 1, 3))
    attended = ops.reshape(attended, (cameras * v.num_tokens, v.width))
    x = ops.add(x, _affine(ops, attended, *layer.out, dtype))
    normed = _layer_norm(ops, x, *layer.norm2, v.layer_norm_eps, dtype)
    return ops.add(x, _affine(ops, ops.gelu(_affine(ops, normed, *layer.fc1, dtype)), *layer.fc2, dtype))


def feed_forward(ops: NetworkOps, layer: GemmaLayer, x: Value, dtype: Dtype, scales: Fp8Scales | None = None) -> Value:
    """Normalised tokens [S, D] -> the MLP's output [S, D], both in `dtype`. With scales, its products are E4M3."""
    gate, up = matrix(layer.gate_up).chunk(2)
    if scales is None:
        gated = ops.gelu(_product(ops, x, gate, dtype))
        return _product(ops, ops.mul(gated, _product(ops, x, up, dtype)), layer.down, dtype)
    x = ops.quantize(x, scales.input, dtype)
    gated = ops.gelu(_fp8_product(ops, x, gate, scales.gate, dtype))
    hidden = ops.mul(gated, _fp8_product(ops, x, up, scales.up, dtype))
    return _fp8_product(ops, ops.quantize(hidden, scales.hidden, dtype), layer.down, scales.down, dtype)


def denoise_step(ops: NetworkOps, config: ModelConfig, weights: Weights, inputs: Mapping[str, Value]) -> Value:
    """The action expert once, matrices in the weights' dtype -> its output after the final norm, float32[H, D].

    The float32 projections before and behind it are the caller's (see the top of this file). For Pi0 H counts the
    state's token, the first one.

    tokens       [H, D]                          the suffix
    modulation   float32[2 * layers + 1, 3, D]   Pi0.5: 1 + scale, shift and gate of this step's adaRMS norms
    cos, sin     float32[H, K/2]                 of the suffix's positions
    k, v         [layers, R, K]                  the prefix's; rows that `mask` hides must be finite
    mask         float32[1 or H * n, R + H]      added to the logits, 0 or HIDDEN; a row is (token, head), token first
    """
    g, dtype = config.expert, matrix_dtype(weights)
    adaptive = family_of(config).modulated
    suffix, rows = ops.shape(inputs["tokens"])[0], ops.shape(inputs["k"])[1]
    rope = tuple(ops.reshape(inputs[name], (suffix, 1, g.head_dim // 2)) for name in ("cos", "sin"))

    def modulation(norm: int, part: int) -> Value:
        row = ops.slice(ops.slice(inputs["modulation"], 0, norm, norm + 1), 1, part, part + 1)
        return ops.reshape(row, (1, g.width))

    def norm(x: Value, index: int, plain: Tensor | None) -> Value:
        wide = ops.cast(x, "f32")
        normed = ops.mul(wide, ops.rsqrt_mean_square(wide, config.rms_norm_eps))
        if plain is not None:
            return ops.mul(normed, ops.constant(plain.reshape(1, -1), "f32"))
        return ops.add(ops.mul(normed, modulation(index, 0)), modulation(index, 1))

    def residual(x: Value, y: Value, index: int) -> Value:
        return ops.add(x, ops.mul(y, ops.cast(modulation(index, 2), dtype)) if adaptive else y)

    x = inputs["tokens"]
    for i, layer in enumerate(weights.expert):
        normed = ops.cast(norm(x, 2 * i, layer.norm1), dtype)
        qkv = ops.constant(matrix(layer.qkv), dtype)
        q, k, v = _queries_keys_values(ops, normed, qkv, rope, g.head_dim, dtype)
        prefix_k, prefix_v = (
            ops.reshape(ops.slice(inputs[name], 0, i, i + 1), (rows, g.head_dim)) for name in ("k", "v")
        )
        keys, values = ops.concat((prefix_k, k), 0), ops.concat((prefix_v, v), 0)
        attended = explicit_attention(ops, q, keys, values, inputs["mask"], dtype)
        attended = ops.reshape(attended, (suffix, g.num_heads * g.head_dim))
        x = residual(x, _product(ops, attended, layer.out, dtype), 2 * i)
        normed = ops.cast(norm(x, 2 * i + 1, layer.norm2), dtype)
        x = residual(x, feed_forward(ops, layer, normed, dtype), 2 * i + 1)
    final = ops.cast(norm(x, 2 * g.depth, weights.expert_norm), dtype)  # rounded as in the reference
    return ops.cast(final, "f32")


@dataclass(frozen=True)
class LayerStyle:
    """How `prefix_layer` computes."""

    fused: bool  # the library's attention layer; else products and a softmax written out
    dtype: Dtype
    softmax: Dtype = "f32"  # of the written-out attention


def prefix_layer(
    ops: NetworkOps, config: ModelConfig, style: LayerStyle, inputs: Mapping[str, Value]
) -> Mapping[str, Value]:
    """One layer of the language model: x [S, D] -> x_next [S, D], k (rotated) and v [S, K], all in the style's dtype.

    cos, sin float32[S, K/2]; the weights are inputs, too: qkv, out, gate, up, down in the style's dtype; norm1, norm2
    float32[1, D] (1 + scale).
    """
    g, dtype = config.vlm, style.dtype
    rows = ops.shape(inputs["x"])[0]
    rope = tuple(ops.reshape(inputs[name], (rows, 1, g.head_dim // 2)) for name in ("cos", "sin"))

    def norm(x: Value, scale: Value) -> Value:
        wide = ops.cast(x, "f32")
        return ops.cast(ops.mul(ops.mul(wide, ops.rsqrt_mean_square(wide, config.rms_norm_eps)), scale), dtype)

    x = inputs["x"]
    q, k, v = _queries_keys_values(ops, norm(x, inputs["norm1"]), inputs["qkv"], rope, g.head_dim, dtype)
    if style.fused:
        one = (1, 1, rows * g.num_heads, g.head_dim)
        keys = (1, 1, rows, g.head_dim)
        attended = ops.attention(ops.reshape(q, one), ops.reshape(k, keys), ops.reshape(v, keys))
    else:
        attended = explicit_attention(ops, q, k, v, None, dtype, style.softmax)
    attended = ops.reshape(attended, (rows, g.num_heads * g.head_dim))
    x = ops.add(x, ops.matmul(attended, inputs["out"], transpose_b=True))
    normed = norm(x, inputs["norm2"])
    gated = ops.gelu(ops.matmul(normed, inputs["gate"], transpose_b=True))
    hidden = ops.mul(gated, ops.matmul(normed, inputs["up"], transpose_b=True))
    return {"x_next": ops.add(x, ops.matmul(hidden, inputs["down"], transpose_b=True)), "k": k, "v": v}


def explicit_attention(
    ops: NetworkOps, q: Value, k: Value, v: Value, mask: Value | None, dtype: Dtype, softmax: Dtype = "f32"
) -> Value:
    """softmax(q kᵀ / √K + mask) v -> [queries, K]: q [queries, K], k, v [keys, K], mask float32[1 or queries, keys]."""
    scale = torch.full((1, 1), ops.shape(q)[1] ** -0.5)
    logits = ops.cast(ops.matmul(q, k, transpose_b=True), softmax)
    logits = ops.mul(logits, ops.constant(scale, softmax))
    if mask is not None:
        assert softmax == "f32"
        logits = ops.add(logits, mask)
    return ops.matmul(ops.cast(ops.softmax(logits), dtype), v)


def matrix(weight: Matrix) -> Tensor:
    """A packed weight that is a plain tensor, as all of these backends' are."""
    assert isinstance(weight, Tensor)
    return weight


def matrix_dtype(weights: Weights) -> Dtype:
    return "f32" if weights.embed_tokens.dtype == torch.float32 else "bf16"


def _queries_keys_values(
    ops: NetworkOps, normed: Value, qkv: Value, rope: tuple[Value, ...], head_dim: int, dtype: Dtype
) -> tuple[Value, Value, Value]:
    """Queries [S * n, K] (token-major) and keys [S, K], both rotated, and values [S, K] of normalised tokens [S, D]."""
    rows = ops.shape(normed)[0]
    heads = ops.shape(qkv)[0] // head_dim
    parts = ops.reshape(ops.matmul(normed, qkv, transpose_b=True), (rows, heads, head_dim))
    rotated = ops.cast(ops.slice(parts, 1, 0, heads - 1), "f32")
    half = head_dim // 2
    first, second = ops.slice(rotated, 2, 0, half), ops.slice(rotated, 2, half, head_dim)
    cos, sin = rope
    turned = (
        ops.sub(ops.mul(first, cos), ops.mul(second, sin)),
        ops.add(ops.mul(second, cos), ops.mul(first, sin)),
    )
    rotated = ops.cast(ops.concat(turned, 2), dtype)
    q = ops.reshape(ops.slice(rotated, 1, 0, heads - 2), (rows * (heads - 2), head_dim))
    k = ops.reshape(ops.slice(rotated, 1, heads - 2, heads - 1), (rows, head_dim))
    return q, k, ops.reshape(ops.slice(parts, 1, heads - 1, heads), (rows, head_dim))


def _layer_norm(ops: NetworkOps, x: Value, weight: Tensor, bias: Tensor, eps: float, dtype: Dtype) -> Value:
    """LayerNorm of [tokens, W], float32 inside."""
    wide = ops.cast(x, "f32")
    centred = ops.sub(wide, ops.mean(wide))
    normed = ops.mul(centred, ops.rsqrt_mean_square(centred, eps))
    scale, shift = (ops.constant(one.reshape(1, -1), "f32") for one in (weight, bias))
    return ops.cast(ops.add(ops.mul(normed, scale), shift), dtype)


def _product(ops: NetworkOps, x: Value, weight: Matrix, dtype: Dtype) -> Value:
    return ops.matmul(x, ops.constant(matrix(weight), dtype), transpose_b=True)


def _fp8_product(ops: NetworkOps, x: Value, weight: Matrix, scale: Tensor, dtype: Dtype) -> Value:
    """x is quantised already; the weight is rounded here, once."""
    plain = matrix(weight)
    stored = to_fp8(plain, scale.to(plain.device))
    return ops.matmul(x, ops.dequantize_constant(stored, scale, dtype), transpose_b=True)


def _affine(ops: NetworkOps, x: Value, weight: Matrix, bias: Tensor, dtype: Dtype) -> Value:
    return ops.add(_product(ops, x, weight, dtype), ops.constant(bias.reshape(1, -1), dtype))
