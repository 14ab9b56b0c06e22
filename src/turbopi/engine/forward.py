"""The reference's forward pass in static shapes: what a CUDA graph captures.

The prefix is compacted on the host: valid cameras, then valid prompt tokens, then padding up to the bucket. Padding
sits at the end only and `length`, in device memory, says where it begins; so nothing is captured anew when the prompt
or the state changes. The mathematics is `turbopi.models.pi0.reference`'s; only its order of work differs:

  - matrices that share an input are one matmul; adaRMS comes from a table of all steps;
  - a residual is added together with the norm behind it, or of many rows by the matmul in front of that, in place;
  - where the next matrix is a `ScaledMatrix`, an operation's result is rounded to E4M3 or int8 for it;
  - logits leave their matmul in float32 and keys beyond `length` get -inf before the softmax.

Rows of several observations may stand one behind the other: only attention knows whose they are (engine/batch.py).

Shapes: V cameras, S prefix slots of the bucket, H suffix tokens, D width, K head_dim, n query heads, A action_dim.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from turbopi.config import ModelConfig
from turbopi.engine.weights import Weights
from turbopi.kernels.interface import Affine, AffineMatrix, GemmaLayer, Ops, State, VisionLayer, VisionStream
from turbopi.models import family_of
from turbopi.models.pi0.layers import rope_tables
from turbopi.quantization.fp8 import Matrix, input_of

Rope = tuple[Tensor, Tensor]  # cos, sin float32[tokens, K/2]
Stream = tuple[Tensor, Tensor | None, Tensor | None]  # residual stream, what is to be added to it, times which gate
# a layer's number and its queries [tokens * n, K], of the expert q|k|v [T, (n + 2) * K] -> [tokens, n * K]
Attend = Callable[..., Tensor]
Places = Callable[[int], tuple[Tensor, Tensor]]  # a layer's number -> where its keys and values go, each [tokens, K]

HEAD_LAYERS = 3  # of vision: what they take is about as long as the host takes to launch the other 24
# Of the prefix, which go through the matmuls and norms between two attentions together. The activations of more don't
# stay in an H200's L2 cache from one operation to the next: in two chunks 8,960 rows take 1.4 ms less (bfloat16).
MOST_ROWS = 5120


def vision_tokens(
    config: ModelConfig,
    weights: Weights,
    ops: Ops,
    parts: Sequence[Callable[[], Tensor]],
    out: Tensor,
    head_ends: Callable[[], None] = lambda: None,
) -> None:
    """Images -> language-model tokens, into `out` [V * 256, D].

    parts      each brings some of the images, (uint8|float32)[images, 224, 224, 3], when the head of those before
               has ended. A head is patch embedding and the first layers; the others are of all images together
    head_ends  is called behind each head: see `engine.graph.HEAD`
    """
    v, several, vision = config.vision, len(parts) > 1, ops.vision or VisionByOps(ops)
    eps, following = v.layer_norm_eps, [*(layer.qkv[0] for layer in weights.vision[1:]), weights.projector[0]]
    layers = list(zip(weights.vision, following, strict=True))
    head = layers[:HEAD_LAYERS]
    rest, ends = layers[len(head) :], []
    for bring in parts:
        # [images * 256, W]
        stream = VisionStream(ops.embed_patches(bring(), weights.patch, weights.position, out.dtype))
        for layer, behind in head:
            images = len(stream.x) // v.num_tokens
            stream = vision.layer(layer, stream, images=images, heads=v.num_heads, eps=eps, following=behind)
        if several:
            ends.append(vision.finish(stream, rest[0][0].norm1 if rest else weights.post_layernorm, eps))
        if rest or several:
            head_ends()
    if several:
        stream = VisionStream(torch.cat(ends))  # [V * 256, W]
        ends.clear()
    for layer, behind in rest:
        images = len(stream.x) // v.num_tokens
        stream = vision.layer(layer, stream, images=images, heads=v.num_heads, eps=eps, following=behind)
    vision.project(stream, weights.post_layernorm, weights.projector, eps, out)


@dataclass(frozen=True)
class VisionByOps:
    """The vision tower by an operation a step: `pending` is a matmul's result, or None where it was added in place."""

    ops: Ops

    def layer(
        self, layer: VisionLayer, stream: VisionStream, *, images: int, heads: int, eps: float, following: Matrix
    ) -> VisionStream:
        ops = self.ops
        x, normed = ops.residual_layer_norm(stream.x, stream.pending, *layer.norm1, eps, **input_of(layer.qkv[0]))
        qkv = ops.linear(normed, *layer.qkv)
        attended = ops.vision_attention(qkv, images, heads, **input_of(layer.out[0], x))
        y = _added(ops, x, attended, *layer.out)
        x, normed = ops.residual_layer_norm(x, y, *layer.norm2, eps, **input_of(layer.fc1[0]))
        hidden = ops.linear_gelu(normed, *layer.fc1, **input_of(layer.fc2[0], x))
        return VisionStream(x, _added(ops, x, hidden, *layer.fc2))

    def finish(self, stream: VisionStream, norm: Affine, eps: float) -> Tensor:
        if stream.pending is None:
            return stream.x
        return self.ops.residual_layer_norm(stream.x, stream.pending, *norm, eps)[0]  # only a norm can add parts

    def project(self, stream: VisionStream, norm: Affine, projector: AffineMatrix, eps: float, out: Tensor) -> None:
        given = input_of(projector[0])
        _, normed = self.ops.residual_layer_norm(stream.x, stream.pending, *norm, eps, **given)
        self.ops.linear(normed, *projector, out)


def _added(ops: Ops, stream: Tensor | None, x: Tensor, *affine: Any) -> Any:
    """Add a matmul to the residual stream in place, if that may be written over (not None) and the operations say that
    it is faster. Returns what the next norm is still to add.
    """
    if stream is not None and ops.add_linear is not None and ops.add_linear(stream, x, *affine):
        return None
    return ops.residual_linear(x, *affine)


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
    slots, heads = x.shape[0], config.vlm.num_heads

    def places(i: int) -> tuple[Tensor, Tensor]:
        return cache_k[i, :slots], cache_v[i, :slots]

    def attend(i: int, q: Tensor, **input: Any) -> Tensor:
        return ops.attention(q, *places(i), length, slots, heads, **input)

    prefix_layers(config, weights, ops, x, rope, places, attend)


def prefix_layers(
    config: ModelConfig,
    weights: Weights,
    ops: Ops,
    x: Tensor,
    rope: Rope,
    places: Places,
    attend: Attend,
    *,
    in_place: bool = False,
) -> None:
    """Prefix embeddings [S, D] through the language model; nothing is left of it but keys and values.

    in_place: the embeddings may be written over.

    RoPE and attention are of all rows. What lies between two attentions, from a layer's `out` to the next one's `qkv`,
    is done for one chunk of rows after the other: see `MOST_ROWS`.
    """
    layers, eps, chunks = weights.vlm, config.rms_norm_eps, row_chunks(len(x))
    streams, attended = [x[rows] for rows in chunks], None
    for i, layer in enumerate(layers):
        last = i + 1 == len(layers)
        matrix = layer.qkv[-2 * config.vlm.head_dim :] if last else layer.qkv  # of the last, K and V alone are used
        joint = x.new_empty(len(x), matrix.shape[0]) if len(chunks) > 1 else None
        for c, rows in enumerate(chunks):
            stream, y = streams[c], None
            if attended is not None:
                stream, y = _behind_attention(ops, layers[i - 1], stream, attended[rows], eps, in_place)
            streams[c], normed = ops.residual_rms_norm(stream, y, None, layer.norm1, None, eps, **input_of(layer.qkv))
            qkv = ops.linear(normed, matrix, None, None if joint is None else joint[rows])
        q = ops.rope_split(qkv if joint is None else joint, *rope, *places(i))
        if not last:
            attended = attend(i, q, **input_of(layer.out))


def _behind_attention(
    ops: Ops, layer: GemmaLayer[Any], x: Tensor, attended: Tensor, eps: float, in_place: bool
) -> tuple[Tensor, Any]:
    """The prefix's residual stream [rows, D], and what the next layer's norm is to add to it."""
    y = _added(ops, x if in_place else None, attended, layer.out)
    x, normed = ops.residual_rms_norm(x, y, None, layer.norm2, None, eps, **input_of(layer.gate_up))
    hidden = ops.linear_geglu(normed, layer.gate_up, **input_of(layer.down, x))
    return x, _added(ops, x if in_place else None, hidden, layer.down)


def row_chunks(rows: int) -> list[slice]:
    """Chunks of at most `MOST_ROWS`: as few and as equal as can be, whole 64 rows but for the last."""
    size = -(-rows // -(-rows // MOST_ROWS) // 64) * 64
    return [slice(first, min(first + size, rows)) for first in range(0, rows, size)]


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
    slots, heads = cache_k.shape[1] - tokens.shape[0], config.expert.num_heads
    state_token = family_of(config).state_token

    def attend(i: int, qkv: Tensor, **input: Any) -> Tensor:
        q = ops.rope_split(qkv, *rope, cache_k[i, slots:], cache_v[i, slots:])
        return ops.attention(q, cache_k[i], cache_v[i], length, slots, heads, state_token, **input)

    stream = expert_layers(config, weights.expert, ops, tokens, table, attend)
    return final_norm(config, weights, ops, table, *stream)


def expert_layers(
    config: ModelConfig,
    layers: Sequence[GemmaLayer[Any]],
    ops: Ops,
    tokens: Tensor,
    table: Tensor | None,
    attend: Attend,
) -> Stream:
    """Suffix tokens [T, D] through all layers. `attend` applies RoPE, and knows where keys and values are."""
    eps = config.rms_norm_eps
    x, y, gate = tokens, None, None
    for i, layer in enumerate(layers):
        scale, shift, next_gate = norm_weights(table, 2 * i, layer.norm1)
        x, normed = ops.residual_rms_norm(x, y, gate, scale, shift, eps, **input_of(layer.qkv))
        attended = attend(i, ops.linear(normed, layer.qkv), **input_of(layer.out))
        y, gate = ops.residual_linear(attended, layer.out), next_gate
        scale, shift, next_gate = norm_weights(table, 2 * i + 1, layer.norm2)
        x, normed = ops.residual_rms_norm(x, y, gate, scale, shift, eps, **input_of(layer.gate_up))
        hidden = ops.linear_geglu(normed, layer.gate_up, **input_of(layer.down))
        y, gate = ops.residual_linear(hidden, layer.down), next_gate
    return x, y, gate


def final_norm(
    config: ModelConfig,
    weights: Weights,
    ops: Ops,
    table: Tensor | None,
    x: Tensor,
    y: Tensor | None,
    gate: Tensor | None,
) -> Tensor:
    """float32[T, D]: the expert's last norm, of what `expert_layers` returns."""
    scale, shift, _ = norm_weights(table, 2 * config.expert.depth, weights.expert_norm)
    return ops.residual_rms_norm(x, y, gate, scale, shift, config.rms_norm_eps)[1].float()


def norm_weights(
    table: Tensor | None, index: int, plain: Tensor | None
) -> tuple[Tensor | None, Tensor | None, Tensor | None]:
    """Scale and shift of the expert's norm of that number, and the gate of the residual behind it."""
    if table is None:
        return plain, None, None
    scale, shift, gate = table[index].unbind(0)
    return scale, shift, gate


def suffix_tokens(config: ModelConfig, small: State, x_t: Tensor, time: Tensor, state: Tensor) -> Tensor:
    """The suffix [..., H, D] of actions x_t float32[..., H, A], in float32; for Pi0 the state's token before them.

    time float32[D], or [H, D] by token, and state [..., A] are Pi0's: Pi0.5 has the time in its norms.
    """
    actions = project(small, "action_in_proj", x_t)
    family = family_of(config)
    if not family.modulated:
        mixed = torch.cat((actions, time.expand_as(actions)), dim=-1)
        actions = project(small, "action_time_mlp_out", F.silu(project(small, "action_time_mlp_in", mixed)))
    if not family.state_token:
        return actions
    return torch.cat((project(small, "state_proj", state[..., None, :]), actions), dim=-2)


def project(small: State, name: str, x: Tensor) -> Tensor:
    """One of the small projections, in float32."""
    return F.linear(x, small[f"{name}.weight"], small[f"{name}.bias"])


def rope_of_all_positions(config: ModelConfig, count: int, device: torch.device) -> Rope:
    """RoPE tables of positions 0 … count - 1: the same for every call."""
    cos, sin = rope_tables(torch.arange(count, device=device)[None], config.vlm.head_dim, config.rope_base)
    return cos[0, 0], sin[0, 0]
