"""Denoising of several observations of SmolVLA: their actions are rows of the same matmuls, an operation a launch.

Shapes: B observations, H actions, A action_dim, N steps, L layers of the expert, D its width, G key heads, S places of
a prefix, K head_dim.
"""

from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F
from torch import Tensor

from turbopi.engine.forward import Rope
from turbopi.engine.smolvla import Expert, behind_attention, joined, rope_at
from turbopi.kernels.interface import GemmaLayer, Ops
from turbopi.kernels.portable.denoise.kernel import Mixing
from turbopi.kernels.portable.grouped import grouped_suffix_attention, rope_grouped
from turbopi.models.pi0.denoise import euler_step


@dataclass(frozen=True)
class Constants:
    """Of calls of so many steps, observations, actions and places.

    mixing  its last matrix as the layers' are
    own     int64[B * H], an action's number, by which it counts in layers across; `across`, their RoPE tables
    every   RoPE's tables at all positions
    """

    mixing: Mixing
    own: Tensor
    across: Rope
    every: Rope


@dataclass(frozen=True)
class ExpertByOps:
    """The expert's weights for operations."""

    expert: Expert
    ops: Ops
    layers: list[GemmaLayer[Tensor]]
    norm: Tensor  # float32[D], the last one

    @classmethod
    def pack(cls, expert: Expert, ops: Ops, dtype: torch.dtype) -> "ExpertByOps":
        layers = [joined(layer, dtype) for layer in expert.model.expert.layers]
        return cls(expert, ops, layers, expert.model.expert.norm.weight.float())

    def constants(self, num_steps: int, batch: int, horizon: int, places: int) -> "Constants":
        """What `run` reads of such calls that is always the same."""
        config, dtype = self.expert.model.config, self.layers[0].qkv.dtype
        mixing = self.expert.mixing(num_steps)
        mixing = replace(mixing, out=mixing.out.to(dtype), out_bias=mixing.out_bias.to(dtype))
        own = torch.arange(horizon, device=self.norm.device).repeat(batch)
        every = rope_at(torch.arange(places + horizon, device=own.device), config)
        return Constants(mixing, own, rope_at(own, config), every)

    def run(
        self, fixed: "Constants", keys: Tensor, values: Tensor, lengths: Tensor, noise: Tensor, x_t: Tensor, v_t: Tensor
    ) -> None:
        """All steps. What a CUDA graph captures.

        fixed         `constants` of such calls
        keys, values  what each layer attends to [L, G, B * S, K], of which `lengths` int64[B] places are valid
        noise         float32[B, H, A]
        x_t, v_t      to be written, float32[N + 1, B, H, A] and [N, B, H, A]
        """
        batch, horizon = noise.shape[:2]
        x_t[0] = noise
        behind = (fixed.own.view(batch, horizon) + lengths[:, None]).flatten()
        ropes = [fixed.across, (fixed.every[0][behind], fixed.every[1][behind])]
        text = self.expert.model.config.text
        k = keys.new_empty(text.num_kv_heads, batch * horizon, text.head_dim)
        scratch = k, torch.empty_like(k)
        for step in range(len(v_t)):
            x = self._embed(fixed.mixing, step, x_t[step])
            v_t[step] = self._velocity(x, ropes, keys, values, lengths, scratch).view_as(v_t[step])
            x_t[step + 1] = euler_step(x_t[step], v_t[step], len(v_t))

    def _embed(self, mixing: Mixing, step: int, x_t: Tensor) -> Tensor:
        """Actions mixed with the time [B * H, D]"""
        hidden = F.silu(F.linear(x_t.flatten(0, 1), mixing.into, mixing.biases[step]))
        return self.ops.linear(hidden.to(mixing.out.dtype), mixing.out, mixing.out_bias)

    def _velocity(
        self,
        x: Tensor,
        ropes: list[Rope],
        keys: Tensor,
        values: Tensor,
        lengths: Tensor,
        scratch: tuple[Tensor, Tensor],
    ) -> Tensor:
        """float32[B * H, A] of tokens [B * H, D]. ropes: of layers across, and of self layers."""
        model, ops = self.expert.model, self.ops
        config, y = model.config, None
        eps, tokens = config.text.rms_norm_eps, len(x) // len(lengths)
        for i, (at, layer) in enumerate(zip(config.expert_at, self.layers, strict=True)):
            is_self = config.is_self_layer(at)
            x, normed = ops.residual_rms_norm(x, y, None, layer.norm1, None, eps)
            q = rope_grouped(ops.linear(normed, layer.qkv), *ropes[is_self], *scratch)
            attended = grouped_suffix_attention(q, keys[i], values[i], lengths, tokens, scratch if is_self else None)
            x, y = behind_attention(ops, layer, x, attended, eps)
        _, normed = ops.residual_rms_norm(x, y, None, self.norm, None, eps)
        out: Tensor = model.action_out_proj(normed.float())
        return out
