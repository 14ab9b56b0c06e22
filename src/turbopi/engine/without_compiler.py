"""The engine in as few of PyTorch's own kernels as it can be said in: for CUDA graphs without a compiler.

A small kernel takes two microseconds there, or four if its operands differ in dtype. So matmuls keep their float32
sums, all up to the next matmul is computed in float32, and matmuls start from what is to be added to them: residual,
mask, or what the shift of an adaRMS becomes in the matmul behind it.

What is computed, and shapes: `engine.forward`, `kernels.plain`. Vision and Pi0's suffix stay `PLAIN`, but for vision's
GELU.
"""

from dataclasses import dataclass, replace
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from turbopi.config import ModelConfig
from turbopi.engine import forward
from turbopi.engine.weights import Weights
from turbopi.kernels import plain
from turbopi.kernels.interface import GemmaLayer, Ops, TokenInputs
from turbopi.kernels.plain import PLAIN

FEW = 64  # rows whose GeGLU is launches, not bytes


def matmul(a: Tensor, weight: Tensor, onto: Tensor | None = None, alpha: float = 1.0) -> Tensor:
    """a @ weightᵀ in float32, or `onto` with that times alpha added in place."""
    if onto is None:
        return plain.matmul_f32(a, weight.t())
    if a.dtype == onto.dtype:
        return onto.addmm_(a, weight.t(), alpha=alpha)
    if a.is_cuda:
        return torch.addmm(onto, a, weight.t(), out_dtype=onto.dtype, alpha=alpha, out=onto)
    return onto.add_(a.float() @ weight.t().float(), alpha=alpha)


def factors(cos: Tensor, sin: Tensor, heads: int) -> Tensor:
    """What RoPE multiplies the halves of a head by: float32[which, tokens, heads + 2, half of the result, K/2].

    Values get ones and zeros, so that one kernel serves all heads.
    """
    one, zero = torch.ones_like(cos), torch.zeros_like(cos)
    turning, still = torch.stack((cos, sin, -sin, cos))[:, :, None], torch.stack((one, zero, zero, one))[:, :, None]
    both = torch.cat((turning.expand(-1, -1, heads + 1, -1), still), 2)
    return both.view(2, 2, *both.shape[1:]).permute(0, 2, 3, 1, 4).contiguous()


def rope_split(qkv: Tensor, rope: Tensor, k_out: Tensor, v_out: Tensor) -> Tensor:
    """`k_out` and `v_out` are parts of one tensor, values behind keys."""
    heads = qkv.view(len(qkv), -1, 2, k_out.shape[1] // 2)
    first, second = rope[:, :, -heads.shape[1] :]
    turned = (heads[:, :, :1] * first).addcmul_(heads[:, :, 1:], second).flatten(2)
    distance = v_out.storage_offset() - k_out.storage_offset()
    assert distance > 0 and k_out.untyped_storage().data_ptr() == v_out.untyped_storage().data_ptr()
    k_out.as_strided((len(qkv), 2, k_out.shape[1]), (k_out.stride(0), distance, 1)).copy_(turned[:, -2:])
    return turned[:, :-2].to(k_out.dtype).reshape(-1, k_out.shape[1])


def linear_gelu(x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    if x.is_cuda and x.dtype == torch.bfloat16:
        return torch._addmm_activation(bias, x, weight.t(), use_gelu=True)  # there it is tanh's, in the epilogue
    return plain.linear_gelu(x, weight, bias)


def linear_geglu(x: Tensor, gate_up: Tensor, bias: Tensor | None) -> Tensor:
    if len(x) <= FEW:  # GELU of the other half, too: a contiguous kernel is the faster one
        both = F.linear(x, gate_up, bias)
        return plain.gelu(both).chunk(2, -1)[0] * both.chunk(2, -1)[1]
    assert bias is None
    gate, up = gate_up.chunk(2)
    return linear_gelu(x, gate, x.new_zeros(len(gate))).mul_(F.linear(x, up))


def layer_onto(
    x: Tensor,
    layer: GemmaLayer[Any],
    norms: tuple[Tensor, Tensor],
    eps: float,
    rope: Tensor,
    k: Tensor,
    v: Tensor,
    logits: Tensor,
    qkv: Tensor | None = None,
    gate_up: Tensor | None = None,
    gates: tuple[Tensor | None, Tensor | None] = (None, None),
) -> None:
    """A layer's work on the residual stream x float32[tokens, D], in place; x's rows are the last ones of k and v.

    `logits` float32[tokens * n, keys] begin as the mask, `qkv` as the shift's part, `gate_up` [2F] is the shift's part.
    """

    def add(y: Tensor, weight: Tensor, gate: Tensor | None) -> None:
        matmul(y, weight, x) if gate is None else x.addcmul_(matmul(y, weight), gate)

    n = len(x)
    normed = F.rms_norm(x, x.shape[-1:], norms[0], eps).to(k.dtype)
    q = rope_split(matmul(normed, layer.qkv, qkv), rope, k[-n:], v[-n:])
    probabilities = matmul(q, k, logits, q.shape[1] ** -0.5).softmax(-1).to(v.dtype)
    add((probabilities @ v).view(n, -1), layer.out, gates[0])
    normed = F.rms_norm(x, x.shape[-1:], norms[1], eps).to(k.dtype)
    add(linear_geglu(normed, layer.gate_up, gate_up), layer.down, gates[1])


def mask(length: Tensor, slots: int, keys: int) -> Tensor:
    """What is added to logits, float32[keys]."""
    key = torch.arange(keys, device=length.device)
    return torch.where((key < length) | (key >= slots), 0.0, -torch.inf)


def prefix_cache(
    config: ModelConfig,
    weights: Weights,
    ops: Ops,
    x: Tensor,
    length: Tensor,
    cache_k: Tensor,
    cache_v: Tensor,
    rope: forward.Rope,
) -> None:
    """`forward.prefix_cache`."""
    g, eps, slots = config.vlm, config.rms_norm_eps, len(x)
    turning, hidden = factors(*rope, g.num_heads), mask(length, slots, slots)
    k, v, x = cache_k[:, :slots], cache_v[:, :slots], x.to(torch.float32, copy=True)
    layers: list[Any] = weights.vlm  # with both norms, and none in FP8
    for i, layer in enumerate(layers[:-1]):
        logits = hidden.repeat(slots * g.num_heads, 1)
        layer_onto(x, layer, (layer.norm1, layer.norm2), eps, turning, k[i], v[i], logits)
    normed = F.rms_norm(x, x.shape[-1:], layers[-1].norm1, eps).to(k.dtype)
    rope_split(matmul(normed, layers[-1].qkv[-2 * g.head_dim :]), turning, k[-1], v[-1])


@dataclass(frozen=True)
class Denoiser:
    """A `Denoiser` for Pi0.5, any horizon, one time a step; what an adaRMS's shift becomes in a matmul is constant."""

    config: ModelConfig
    weights: Weights
    table: Tensor  # float32[N, 2 * layers + 1, 3, D]: see `weights.modulation`
    qkv: Tensor  # float32[N, layers, (n + 2) * K]
    gate_up: Tensor  # [N, layers, 2F]
    velocity: Tensor  # float32[N, A], with the bias
    slots: int = 0  # of the prefix

    @classmethod
    def prepare(cls, config: ModelConfig, weights: Weights, table: Tensor) -> "Denoiser":
        shift, small = table[:, :, 1], weights.small
        qkv = [shift[:, 2 * i] @ layer.qkv.float().t() for i, layer in enumerate(weights.expert)]
        gate_up = [shift[:, 2 * i + 1] @ layer.gate_up.float().t() for i, layer in enumerate(weights.expert)]
        velocity = F.linear(shift[:, -1], small["action_out_proj.weight"], small["action_out_proj.bias"])
        dtype = weights.embed_tokens.dtype
        return cls(config, weights, table, torch.stack(qkv, 1), torch.stack(gate_up, 1).to(dtype), velocity)

    def launch(
        self,
        noise: Tensor,
        cache_k: Tensor,
        cache_v: Tensor,
        length: Tensor,
        x_t: Tensor,
        v_t: Tensor,
        tokens: TokenInputs | None = None,
    ) -> None:
        assert tokens is None
        horizon, rows, small, g = len(noise), cache_k.shape[1], self.weights.small, self.config.expert
        for cache in (cache_k, cache_v):
            cache[:, self.slots : rows - horizon] = 0  # masked, but 0 * NaN is NaN
        cos, sin = forward.rope_of_all_positions(self.config, rows, noise.device)
        positions = length + torch.arange(horizon, device=noise.device)
        rope, hidden = factors(cos[positions], sin[positions], g.num_heads), mask(length, rows - horizon, rows)
        x_t[0] = noise
        for step, table in enumerate(self.table):
            # whole: elementwise kernels are fastest so, and matmuls start from them
            gates = table[:-1, 2, None].expand(-1, horizon, -1).contiguous()
            logits = hidden.expand(g.depth, horizon * g.num_heads, -1).contiguous()
            qkv = self.qkv[step, :, None].expand(-1, horizon, -1).contiguous()
            x = F.linear(x_t[step], small["action_in_proj.weight"], small["action_in_proj.bias"])
            for i, layer in enumerate(self.weights.expert):
                norms, both = (table[2 * i, 0], table[2 * i + 1, 0]), (gates[2 * i], gates[2 * i + 1])
                starts = (logits[i], qkv[i], self.gate_up[step, i], both)
                layer_onto(x, layer, norms, self.config.rms_norm_eps, rope, cache_k[i], cache_v[i], *starts)
            normed = F.rms_norm(x, x.shape[-1:], table[-1, 0], self.config.rms_norm_eps)
            torch.addmm(self.velocity[step], normed, small["action_out_proj.weight"].t(), out=v_t[step])
            torch.add(x_t[step], v_t[step], alpha=-1 / len(v_t), out=x_t[step + 1])


OPS = replace(
    PLAIN,
    linear_gelu=linear_gelu,
    prefix_cache=prefix_cache,
    origin={**PLAIN.origin, "matrix products": "cuBLAS, with bias, GELU, residual and mask in its epilogue"},
)
