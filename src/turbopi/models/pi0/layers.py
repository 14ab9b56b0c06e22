"""The blocks that SigLIP and Gemma are made of, in plain PyTorch.

Shapes: B batch, S tokens, D width, H query heads, G key/value heads, K head_dim.
Dtypes: activations have the weights' compute dtype (float32 or bfloat16); norms, RoPE and softmax are float32 inside.
"""

import torch
import torch.nn.functional as F
from torch import Tensor, nn


class RMSNorm(nn.Module):
    """Gemma's RMSNorm: x / rms(x) * (1 + weight), in float32; the stored weight is the raw scale."""

    def __init__(self, width: int, eps: float) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.empty(width))
        self.eps = eps

    def forward(self, x: Tensor, cond: Tensor | None = None) -> tuple[Tensor, None]:
        """Normalise x [..., D]; the second result, the residual's gate, is AdaRMSNorm's alone."""
        return (rms_normalize(x, self.eps) * (1 + self.weight.float())).to(x.dtype), None


class AdaRMSNorm(nn.Module):
    """RMSNorm whose scale and shift, and the gate of the residual that follows, come from the time condition."""

    def __init__(self, width: int, eps: float) -> None:
        super().__init__()
        self.dense = nn.Linear(width, 3 * width)
        self.eps = eps

    def forward(self, x: Tensor, cond: Tensor | None) -> tuple[Tensor, Tensor]:
        """x [B, S, D], cond float32 [B or 1, D] -> (normalised x, gate [B or 1, 1, D]).

        A cond by token is [B or 1, S, D], and so is its gate.
        """
        scale, shift, gate = self.modulation(cond)
        return (rms_normalize(x, self.eps) * (1 + scale) + shift).to(x.dtype), gate.to(x.dtype)

    def modulation(self, cond: Tensor | None) -> tuple[Tensor, ...]:
        """Scale, shift and gate, float32 [B or 1, 1 or S, D]."""
        assert cond is not None
        rows = self.dense(cond)
        return (rows if rows.dim() == 3 else rows[:, None]).chunk(3, dim=-1)


def rms_normalize(x: Tensor, eps: float) -> Tensor:
    """x / sqrt(mean(x²) + eps) over the last axis, in float32 whatever x is."""
    x = x.float()
    return x * inverse_rms(x, eps)


def inverse_rms(x: Tensor, eps: float) -> Tensor:
    """1 / sqrt(mean(x²) + eps) over the last axis [..., 1], in float32 whatever x is."""
    return torch.rsqrt(x.float().square().mean(-1, keepdim=True) + eps)


def gated_residual(x: Tensor, y: Tensor, gate: Tensor | None) -> Tensor:
    """x + y, or x + y * gate behind an AdaRMSNorm."""
    return x + y if gate is None else x + y * gate


class GeGLU(nn.Module):
    """Gemma's MLP: down(gelu_tanh(gate x) * up x)."""

    def __init__(self, width: int, mlp_dim: int) -> None:
        super().__init__()
        self.gate_proj = nn.Linear(width, mlp_dim, bias=False)
        self.up_proj = nn.Linear(width, mlp_dim, bias=False)
        self.down_proj = nn.Linear(mlp_dim, width, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        return self.down_proj(F.gelu(self.gate_proj(x), approximate="tanh") * self.up_proj(x))


def rope_tables(positions: Tensor, head_dim: int, base: float) -> tuple[Tensor, Tensor]:
    """cos and sin, float32 [B, 1, S, K/2], for int positions [B, S].

    Always float32: openpi's PyTorch rounds the frequencies to bfloat16 and keys move by up to 0.5;
    its JAX implementation doesn't.
    """
    exponents = torch.arange(0, head_dim, 2, dtype=torch.float32, device=positions.device) / head_dim
    angles = positions[:, None, :, None].float() * (1.0 / base**exponents)
    return angles.cos(), angles.sin()


def apply_rope(x: Tensor, cos: Tensor, sin: Tensor) -> Tensor:
    """Rotate the two halves of x [B, H, S, K] against each other (split-half RoPE), in float32."""
    x1, x2 = x.float().chunk(2, dim=-1)
    return torch.cat((x1 * cos - x2 * sin, x2 * cos + x1 * sin), dim=-1).to(x.dtype)


def attention(q_BHSK: Tensor, k_BGTK: Tensor, v_BGTK: Tensor, mask: Tensor | None = None) -> Tensor:
    """softmax(q kᵀ / √K) v -> [B, H, S, K]; `mask` bool, broadcastable to [B, 1, S, T], True where attended.

    The H/G query heads of a key/value head are folded into its query axis, so keys are read once. float32 is written
    out, as the oracle must not depend on a fused kernel's choices (TF32 among them); bfloat16 takes PyTorch's kernel,
    whose logits and softmax are float32.
    """
    b, h, s, k = q_BHSK.shape
    groups = k_BGTK.shape[1]
    q = q_BHSK.reshape(b, groups, h // groups * s, k)  # a head's queries stay together: row = head * S + token
    if mask is not None and mask.shape[-2] != 1:
        mask = mask.repeat(1, 1, h // groups, 1)
    if q.dtype == torch.float32:
        logits = q @ k_BGTK.transpose(-1, -2) * k**-0.5
        if mask is not None:
            logits = logits.masked_fill(~mask, torch.finfo(torch.float32).min)
        out = logits.softmax(-1) @ v_BGTK
    else:
        out = F.scaled_dot_product_attention(q, k_BGTK, v_BGTK, attn_mask=mask)
    return out.reshape(b, h, s, k)


def split_heads(x: Tensor, head_dim: int) -> Tensor:
    """[B, S, heads * K] -> [B, heads, S, K]"""
    return x.view(*x.shape[:2], x.shape[-1] // head_dim, head_dim).transpose(1, 2)


def merge_heads(x: Tensor) -> Tensor:
    """[B, heads, S, K] -> [B, S, heads * K]"""
    return x.transpose(1, 2).flatten(2)
