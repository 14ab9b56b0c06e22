"""Gemma, used twice: PaliGemma's language model over the prefix, and the action expert over the suffix.

Both have 18 layers and the same heads, because a suffix layer attends to the keys and values of the prefix layer
beside it.
"""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from turbopi.config import GemmaConfig
from turbopi.models.pi0.layers import (
    AdaRMSNorm,
    GeGLU,
    RMSNorm,
    apply_rope,
    attention,
    gated_residual,
    merge_heads,
    split_heads,
)

Rope = tuple[Tensor, Tensor]


class Projections(nn.Module):
    """An attention's four matrices; the attention itself is `Layer.attend`."""

    def __init__(self, config: GemmaConfig) -> None:
        super().__init__()
        heads, kv_heads = config.num_heads * config.head_dim, config.num_kv_heads * config.head_dim
        self.q_proj = nn.Linear(config.width, heads, bias=False)
        self.k_proj = nn.Linear(config.width, kv_heads, bias=False)
        self.v_proj = nn.Linear(config.width, kv_heads, bias=False)
        self.o_proj = nn.Linear(heads, config.width, bias=False)


class Layer(nn.Module):
    def __init__(self, config: GemmaConfig, eps: float, adaptive: bool) -> None:
        super().__init__()
        norm = AdaRMSNorm if adaptive else RMSNorm
        self.head_dim = config.head_dim
        self.input_layernorm = norm(config.width, eps)
        self.self_attn = Projections(config)
        self.post_attention_layernorm = norm(config.width, eps)
        self.mlp = GeGLU(config.width, config.mlp_dim)

    def keys_values(self, normed: Tensor, rope: Rope) -> tuple[Tensor, Tensor]:
        """Keys, rotated, and values [B, G, S, K] of normalised tokens [B, S, D]."""
        k = split_heads(self.self_attn.k_proj(normed), self.head_dim)
        v = split_heads(self.self_attn.v_proj(normed), self.head_dim)
        return apply_rope(k, *rope), v

    def attend(self, normed: Tensor, rope: Rope, k: Tensor, v: Tensor, mask: Tensor | None) -> Tensor:
        """Attention of normalised tokens [B, S, D] over keys and values [B, G, T, K], projected back to D."""
        q = apply_rope(split_heads(self.self_attn.q_proj(normed), self.head_dim), *rope)
        return self.self_attn.o_proj(merge_heads(attention(q, k, v, mask)))

    def feed_forward(self, x: Tensor, cond: Tensor | None = None) -> Tensor:
        normed, gate = self.post_attention_layernorm(x, cond)
        return gated_residual(x, self.mlp(normed), gate)


class Gemma(nn.Module):
    """A stack of layers and its final norm. What runs over it is in prefix.py and denoise.py."""

    layers: Sequence[Layer]

    def __init__(self, config: GemmaConfig, *, eps: float, vocab_size: int | None, adaptive: bool) -> None:
        super().__init__()
        if vocab_size is not None:
            self.embed_tokens = nn.Embedding.from_pretrained(torch.empty(vocab_size, config.width))  # type: ignore[no-untyped-call]
        layers = (Layer(config, eps, adaptive) for _ in range(config.depth))
        self.layers = nn.ModuleList(layers)  # type: ignore[assignment]
        self.norm = (AdaRMSNorm if adaptive else RMSNorm)(config.width, eps)
