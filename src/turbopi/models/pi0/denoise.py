"""The suffix: times, and one evaluation of the action expert. The loop around it: integrate.py.

t = 1 is noise and t = 0 the action, the opposite of the Pi0 paper. x_t, v_t and the update stay float32 in every
precision.
"""

import math

import numpy as np
import torch
from torch import Tensor

from turbopi.models.pi0.gemma import Gemma
from turbopi.models.pi0.kv_cache import KVCache
from turbopi.models.pi0.layers import gated_residual, rope_tables

MIN_PERIOD, MAX_PERIOD = 4e-3, 4.0  # of the time embedding, in units of t


def time_grid(num_steps: int, kind: str = "accumulated") -> np.ndarray:
    """float32[N]: t at the start of each step, from 1.

    openpi adds float32(-1/N) again and again in float32 and stops at -dt/2, which is N steps for every N;
    LeRobot multiplies instead (`kind="multiplied"`).
    """
    dt = np.float32(-1.0 / num_steps)
    if kind == "multiplied":
        return (1.0 + np.arange(num_steps) * (-1.0 / num_steps)).astype(np.float32)
    return np.cumsum(np.concatenate(([np.float32(1)], np.full(num_steps - 1, dt))), dtype=np.float32)


def time_embedding(
    times: np.ndarray, width: int, min_period: float = MIN_PERIOD, max_period: float = MAX_PERIOD
) -> Tensor:
    """float32[N, width]: sines, then cosines, of 2πt over periods from 4e-3 to 4, unless others are given.

    In float64, as in openpi's PyTorch: the fastest phases lose 1.6e-4 in float32.
    """
    t = torch.from_numpy(times.astype(np.float64))
    fraction = torch.linspace(0.0, 1.0, width // 2, dtype=torch.float64)
    period = min_period * (max_period / min_period) ** fraction
    angle = t[:, None] * (2 * math.pi / period)
    return torch.cat((angle.sin(), angle.cos()), dim=-1).float()


def euler_step(x_t: Tensor, v_t: Tensor, num_steps: int) -> Tensor:
    """x + dt · v in float32, dt = float32(-1/N)."""
    return x_t + step_size(num_steps) * v_t


def step_size(num_steps: int) -> float:
    """dt of N equal steps from 1 to 0, as float32 has it: negative."""
    return float(np.float32(-1.0 / num_steps))


def suffix_mask(cache: KVCache, suffix_len: int, has_state_token: bool) -> Tensor | None:
    """bool, broadcastable to [B, 1, suffix, prefix + suffix]; None: everything attends to everything.

    Pi0's state token doesn't see the actions behind it; otherwise the suffix is bidirectional.
    """
    if cache.mask is None and not has_state_token:
        return None
    b, _, s = cache.k.shape[1:4]
    mask = torch.ones(b, 1, suffix_len, s + suffix_len, dtype=torch.bool, device=cache.k.device)
    if cache.mask is not None:
        mask[..., :s] = cache.mask[:, None, None, :]
    if has_state_token:
        mask[:, :, 0, s + 1 :] = False
    return mask


def run_expert(
    expert: Gemma,
    x: Tensor,
    cond: Tensor | None,
    cache_k: Tensor,
    cache_v: Tensor,
    rope: tuple[Tensor, Tensor],
    mask: Tensor | None,
    hidden: list[Tensor] | None = None,
) -> Tensor:
    """Suffix tokens [B, S, D] through all layers and the final norm -> [B, S, D].

    `cond` float32[1, D], or [1, S, D] by token: the time condition (Pi0.5). `hidden`, if given, receives the residual
    stream after each layer.
    """
    for i, layer in enumerate(expert.layers):
        normed, gate = layer.input_layernorm(x, cond)
        k, v = layer.keys_values(normed, rope)
        k, v = torch.cat((cache_k[i], k), dim=2), torch.cat((cache_v[i], v), dim=2)
        x = gated_residual(x, layer.attend(normed, rope, k, v, mask), gate)
        x = layer.feed_forward(x, cond)
        if hidden is not None:
            hidden.append(x)
    return expert.norm(x, cond)[0]


def suffix_rope(cache: KVCache, suffix_len: int, head_dim: int, base: float) -> tuple[Tensor, Tensor]:
    """RoPE tables of the suffix, whose positions go on from the number of valid prefix tokens: P, P + 1, …"""
    offsets = torch.arange(suffix_len, device=cache.lengths.device)
    return rope_tables(cache.lengths[:, None] + offsets, head_dim, base)
