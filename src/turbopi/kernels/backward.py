"""What a vector-Jacobian product through the action expert is made of, in plain PyTorch: the twins of `BackwardOps`.

The products between them are the library's. Gradients that enter a product have the activations' dtype; the residual
stream's gradient is float32. Inside, everything is float32.

Shapes: T tokens, D width, F hidden width of an MLP, K head_dim, n query heads over one key/value head.
"""

import torch
from torch import Tensor

from turbopi.kernels.interface import BackwardOps
from turbopi.kernels.plain import geglu, masked_softmax
from turbopi.model.layers import apply_rope, inverse_rms

_TANH = 0.7978845608028654  # sqrt(2 / pi), of GELU
_CUBIC = 0.044715


def rms_norm_vjp(
    d_normed: Tensor, x: Tensor, scale: Tensor, eps: float, d_x: Tensor | None, gate: Tensor | None
) -> tuple[Tensor, Tensor | None]:
    """Back through `residual_rms_norm`: (d_x + the norm's part, float32; that times gate, in x's dtype).

    d_normed, x [T, D]; d_x float32[T, D], what reaches x by other ways; scale, gate float32[T, D] or [D]; the gate is
    that of the addition before the norm, rounded as there. None: left out.
    """
    g, wide, r = d_normed.float() * scale, x.float(), inverse_rms(x, eps)
    through = r * (g - wide * (r * r * (wide * g).mean(-1, keepdim=True)))
    total = through if d_x is None else d_x + through
    return total, None if gate is None else (total * gate.to(x.dtype).float()).to(x.dtype)


def geglu_vjp(d_hidden: Tensor, gate_up: Tensor) -> Tensor:
    """Back through `plain.geglu`: [T, F] and the product [T, 2F] -> [T, 2F], gate columns before up columns."""
    gate, up = gate_up.float().chunk(2, dim=-1)
    d = d_hidden.float()
    tanh = torch.tanh(_TANH * (gate + _CUBIC * gate * gate * gate))
    half = 0.5 * (1 + tanh)
    slope = half + 0.5 * gate * (1 - tanh * tanh) * _TANH * (1 + 3 * _CUBIC * gate * gate)
    return torch.cat((d * up * slope, d * gate * half), dim=-1).to(gate_up.dtype)


def softmax_vjp(probabilities: Tensor, d_probabilities: Tensor, scale: float) -> Tensor:
    """Back through `plain.masked_softmax`: [rows, keys], the second float32 -> of the logits, in the first's dtype."""
    p = probabilities.float()
    along = p * d_probabilities
    return ((along - p * along.sum(-1, keepdim=True)) * scale).to(probabilities.dtype)


def rope_vjp(d_q: Tensor, d_k: Tensor, d_v: Tensor, cos: Tensor, sin: Tensor) -> Tensor:
    """Back through `plain.rope_split`: [T * n, K], [T, K], [T, K] -> [T, (n + 2) * K]. cos, sin float32[T, K/2]."""
    tokens, head_dim = d_k.shape
    q = apply_rope(d_q.view(tokens, -1, head_dim), cos[:, None], -sin[:, None])
    return torch.cat((q, apply_rope(d_k, cos, -sin)[:, None], d_v[:, None]), dim=1).view(tokens, -1)


PLAIN_BACKWARD = BackwardOps(
    masked_softmax, geglu, rms_norm_vjp, geglu_vjp, softmax_vjp, rope_vjp, "PyTorch, between cuBLAS's products"
)
