"""The vector-Jacobian product through the action expert, the prefix's keys and values fixed: exact, as operations.

Forward as `forward.expert_output`, but each layer saves what backward needs, for one evaluation; then backward, layer
by layer. The suffix's own keys and values depend on its tokens, so gradients go through the cache's last rows, too.

Shapes: T suffix tokens, D width, K head_dim, n query heads, R cache rows.
"""

from dataclasses import dataclass
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from turbopi.config import ModelConfig
from turbopi.engine.conditioned import Conditioned
from turbopi.engine.forward import Rope, norm_weights, project
from turbopi.engine.weights import Weights
from turbopi.kernels.backward import PLAIN_BACKWARD
from turbopi.kernels.interface import BackwardOps, KeepingDenoiser, KeptStep, Ops, State
from turbopi.models import family_of


@dataclass(frozen=True)
class SavedLayer:
    """What backward through one layer needs."""

    x: Tensor  # [T, D]  the residual stream as attention's norm reads it
    attention: Any  # as `BackwardOps.attention` saves it
    middle: Tensor  # [T, D]  the residual stream as the MLP's norm reads it
    gate_up: Tensor  # [T, 2F]


@dataclass(frozen=True)
class Expert:
    """The expert on one cache with one modulation, forward and backward."""

    config: ModelConfig
    weights: Weights
    ops: Ops
    back: BackwardOps
    table: Tensor | None  # float32[2 * layers + 1, 3, D], by token [2 * layers + 1, 3, T, D]; None: Pi0
    length: Tensor
    cache_k: Tensor  # [layer, R, K]
    cache_v: Tensor
    rope: Rope
    hidden: Tensor | None = None  # bool[T, 1, R]: which rows a token doesn't see, of several observations' together
    rows: Tensor | None = None  # int32[T]: of a table [2 * layers + 1, 3, U, D], as `vjp` alone takes it

    def forward(self, tokens: Tensor) -> tuple[Tensor, list[SavedLayer], Tensor]:
        """Suffix tokens [T, D] -> (the final norm's result float32[T, D], what each layer saves, the last stream)."""
        config, ops, back, g, saved = self.config, self.ops, self.back, self.config.expert, []
        slots, heads = self._slots(tokens), self._heads(tokens)
        hidden_keys = {} if self.hidden is None else {"hidden": self.hidden}
        x: Tensor = tokens
        y: Any = None
        gate: Tensor | None = None
        for i, layer in enumerate(self.weights.expert):
            scale, shift, next_gate = norm_weights(self.table, 2 * i, layer.norm1)
            x, normed = ops.residual_rms_norm(x, y, gate, scale, shift, config.rms_norm_eps)
            start, gate = x, next_gate
            k, v = self.cache_k[i], self.cache_v[i]
            q = back.qkv(normed, layer.qkv, *self.rope, k[slots:], v[slots:])
            attended, for_vjp = back.attention(q, k, v, *heads, **hidden_keys)
            scale, shift, next_gate = norm_weights(self.table, 2 * i + 1, layer.norm2)
            y = back.out(attended, layer.out)
            x, normed = ops.residual_rms_norm(x, y, gate, scale, shift, config.rms_norm_eps)
            gate_up, hidden = back.gate_up(normed, layer.gate_up)
            y, gate = back.down(hidden, layer.down), next_gate
            saved.append(SavedLayer(start, for_vjp, x, gate_up))
        scale, shift, _ = norm_weights(self.table, 2 * g.depth, self.weights.expert_norm)
        x, normed = ops.residual_rms_norm(x, y, gate, scale, shift, config.rms_norm_eps)
        return normed.float(), saved, x

    def saved(self, step: KeptStep) -> tuple[list[SavedLayer], Tensor]:
        """What `forward` saves of each layer and the last stream, where a denoiser went forward."""
        *streams, last = step.stream
        attended = self.back.kept_attention(step.q, self.cache_k, self.cache_v, *self._heads(last))
        layers = zip(streams[::2], attended, streams[1::2], step.gate_up, strict=True)
        return [SavedLayer(*layer) for layer in layers], last

    def vjp(self, saved: list[SavedLayer], last: Tensor, d_out: Tensor) -> Tensor:
        """What comes back to the tokens, float32[T, D], of d_out float32[T, D] at the final norm's result."""
        back, eps, g, layers = self.back, self.config.rms_norm_eps, self.config.expert, self.weights.expert
        heads = self._heads(last)

        def norm(d: Tensor, x: Tensor, index: int, plain: Tensor | None, d_x: Tensor | None) -> tuple[Tensor, Any]:
            """Back through norm number `index` and the addition before it: to the stream, and to what was added."""
            scale = norm_weights(self.table, index, plain)[0]
            gate = None if index == 0 else norm_weights(self.table, index - 1, None)[2]
            rows = () if self.rows is None else (self.rows,)
            d_x, d_y = back.rms_norm_vjp(d, x, scale, eps, d_x, gate, *rows)
            if index == 0:
                return d_x, None
            return d_x, d_x.to(x.dtype) if gate is None else d_y

        d_x, d_y = norm(d_out.to(last.dtype), last, 2 * g.depth, self.weights.expert_norm, None)
        for i in reversed(range(g.depth)):
            layer, had = layers[i], saved[i]
            d_normed = back.gate_up_vjp(back.down_vjp(d_y, layer.down, had.gate_up), layer.gate_up)
            d_x, d_y = norm(d_normed, had.middle, 2 * i + 1, layer.norm2, d_x)
            d_attended = back.out_vjp(d_y, layer.out)
            gradients = back.attention_vjp(had.attention, d_attended, self.cache_k[i], self.cache_v[i], *heads)
            d_x, d_y = norm(back.qkv_vjp(gradients, *self.rope, layer.qkv), had.x, 2 * i, layer.norm1, d_x)
        return d_x

    def _slots(self, tokens: Tensor) -> int:
        return self.cache_k.shape[1] - len(tokens)

    def _heads(self, tokens: Tensor) -> tuple[Tensor, int, int, bool]:
        """What says which keys attention's queries see: length, slots, heads, whether there is a state token."""
        # beside `hidden` there is none: that says what the state's token doesn't see
        state_token = family_of(self.config).state_token and self.hidden is None
        return self.length, self._slots(tokens), self.config.expert.num_heads, state_token


def backward_ops(ops: Ops, config: ModelConfig, tokens: int, *, masked: bool = False) -> BackwardOps:
    """The operations that `Expert` takes for so many tokens. masked: with `Expert.hidden`."""
    return PLAIN_BACKWARD if ops.backward is None else ops.backward(config.expert, tokens, masked)


def jacobian_velocity(
    expert: Expert, conditioned: Conditioned, step: int, x_t: Tensor, tokens: Tensor, time: Tensor
) -> Tensor:
    """v_t float32[..., H, A] of x_t, pulled through the expert as `model.conditioning` says.

    tokens  the suffix [T, D] of x_t; of several observations theirs one behind the other
    time    as `suffix_vjp`'s
    """
    small, horizon = expert.weights.small, x_t.shape[-2]

    def of_actions(rows: Tensor) -> Tensor:
        return rows.view(*x_t.shape[:-2], -1, rows.shape[-1])[..., -horizon:, :]

    out, saved, last = expert.forward(tokens)
    v_t = project(small, "action_out_proj", of_actions(out))
    error = conditioned.error(step, x_t, v_t) * conditioned.weights
    d_out = (conditioned.tokens.times[step, ..., None] * error) @ small["action_out_proj.weight"]
    if d_out.numel() == out.numel():
        d_out = d_out.view(out.shape)
    else:  # Pi0's state token has no velocity
        of_actions(every := torch.zeros_like(out)).copy_(d_out)
        d_out = every
    d_tokens = of_actions(expert.vjp(saved, last, d_out))
    through = suffix_vjp(expert.config, small, x_t, time, d_tokens)
    return v_t - conditioned.tokens.gain[step, ..., None] * (error - through)


def jacobian_step(
    expert: Expert,
    conditioned: Conditioned,
    step: int,
    forward: KeepingDenoiser,
    x_t: Tensor,
    v_t: Tensor,
    next_x: Tensor,
) -> None:
    """`jacobian_velocity` and Euler's step behind it, of one observation of Pi0.5, where a denoiser goes forward.

    x_t float32[H, A]; v_t and next_x, the same, are written.
    """
    caches, small, tokens, back = (
        (expert.cache_k, expert.cache_v),
        expert.weights.small,
        conditioned.tokens,
        expert.back,
    )
    saved, last = expert.saved(forward.launch_step(step, x_t, *caches, expert.length, v_t, tokens))
    out, into = small["action_out_proj.weight"], small["action_in_proj.weight"]
    error, d_out = back.pull(x_t, v_t, tokens.times[step], tokens.target, conditioned.weights, out, last.dtype)
    d_tokens = expert.vjp(saved, last, d_out)
    back.move(d_tokens, into, x_t, v_t, error, tokens.gain[step], tokens.steps[step], next_x)


def suffix_vjp(config: ModelConfig, small: State, x_t: Tensor, time: Tensor, d_tokens: Tensor) -> Tensor:
    """Back from the actions' tokens float32[..., H, D] to x_t [..., H, A]. `time` float32[D] or [..., H, D]: Pi0's."""
    d = d_tokens.float()
    if not family_of(config).modulated:
        actions = F.linear(x_t, small["action_in_proj.weight"], small["action_in_proj.bias"])
        mixed = torch.cat((actions, time.expand_as(actions)), dim=-1)
        inner = F.linear(mixed, small["action_time_mlp_in.weight"], small["action_time_mlp_in.bias"])
        sigmoid = inner.sigmoid()
        slope = sigmoid * (1 + inner * (1 - sigmoid))
        d = (d @ small["action_time_mlp_out.weight"] * slope) @ small["action_time_mlp_in.weight"]
        d = d[..., : actions.shape[-1]]
    return d @ small["action_in_proj.weight"]
