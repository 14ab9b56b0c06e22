"""The denoising kernel's twin: the loop in plain PyTorch."""

from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor

from turbopi.config import ModelConfig
from turbopi.kernels.interface import GemmaLayer, KeptStep, State, TokenInputs
from turbopi.kernels.portable.denoise.host import affine
from turbopi.models.pi0.denoise import euler_step
from turbopi.models.pi0.layers import rope_tables
from turbopi.quantization.fp8 import to_e4m3

Operand = Callable[[Tensor, int, int], Tensor]


def denoise_plain(
    config: ModelConfig,
    layers: list[GemmaLayer],
    small: State,
    table: Tensor,
    noise: Tensor,
    cache_k: Tensor,
    cache_v: Tensor,
    length: int,
    operand: Operand = lambda x, layer, product: x,
    tokens: TokenInputs | None = None,
    kept: KeptStep | None = None,
) -> tuple[Tensor, Tensor]:
    """What the kernel computes, in PyTorch and in `noise`'s dtype throughout: (x_t [N + 1, T, A], v_t [N, T, A]).

    operand  what becomes of the activations that meet a layer's weights: (x, layer, which of `KINDS`) -> x. The
        stream comes without its 1 / rms and the norm's shift, as the kernel adds both behind the product.
    tokens  every token's time in each step; `table` [U, 2L + 1, 3, D] then has a row for each time that occurs
    kept    takes what a way back needs of the last step, and the cache's last rows the suffix's keys and values
    """
    g, dtype, suffix = config.expert, noise.dtype, noise.shape[0]
    positions = length + torch.arange(suffix, device=noise.device)
    cos, sin = (t[0].to(dtype) for t in rope_tables(positions[None], g.head_dim, config.rope_base))
    cos, sin = cos[0][:, None], sin[0][:, None]  # [T, 1, K/2]
    x_t, v_t = [noise], []
    table = table.to(dtype)
    by_step = table[:, :, :, None] if tokens is None else table[tokens.rows.long()].movedim(1, 3)
    for step, modulation in enumerate(by_step):  # [2L + 1, 3, T or 1, D]

        def normed(x: Tensor, index: int, modulation: Tensor = modulation) -> tuple[Tensor, Tensor]:
            if kept is not None:
                kept.stream[index] = x
            scale, shift, gate = modulation[index]
            inverse = torch.rsqrt(x.square().mean(-1, keepdim=True) + config.rms_norm_eps)
            scaled = x * scale if index == 2 * g.depth else operand(x * scale, *divmod(2 * index, 4))
            return scaled * inverse + shift, gate

        x = affine(small, "action_in_proj", x_t[-1])
        for i, layer in enumerate(layers):
            y, gate = normed(x, 2 * i)
            parts = (y @ layer.qkv.to(dtype).T).view(suffix, -1, g.head_dim)
            q, k, v = parts[:, :-2], parts[:, -2:-1], parts[:, -1:]
            q, k = (_rotate(part, cos, sin) for part in (q, k))
            keys = torch.cat((cache_k[i, :length].to(dtype), k[:, 0]))
            values = torch.cat((cache_v[i, :length].to(dtype), v[:, 0]))
            if kept is not None:
                kept.q[i], cache_k[i, -suffix:], cache_v[i, -suffix:] = q.flatten(0, 1), k[:, 0], v[:, 0]
            attended = (q @ keys.T * g.head_dim**-0.5).softmax(-1) @ values
            x = x + operand(attended.reshape(suffix, -1), i, 1) @ layer.out.to(dtype).T * gate
            y, gate = normed(x, 2 * i + 1)
            product = y @ layer.gate_up.to(dtype).T
            if kept is not None:
                kept.gate_up[i] = product
            up_gate, up = product.chunk(2, dim=-1)
            x = x + operand(F.gelu(up_gate, approximate="tanh") * up, i, 3) @ layer.down.to(dtype).T * gate
        v_t.append(affine(small, "action_out_proj", normed(x, 2 * g.depth)[0]))
        if tokens is None:
            x_t.append(euler_step(x_t[-1], v_t[-1], len(table)))
        else:
            v_t[-1] = guided(x_t[-1], v_t[-1], tokens, step)
            x_t.append(x_t[-1] + tokens.steps[step, :, None] * v_t[-1])
    return torch.stack(x_t), torch.stack(v_t)


def guided(x: Tensor, v: Tensor, tokens: TokenInputs, step: int) -> Tensor:
    """v [T, A] pulled so that the chunk it points to comes nearer to the target: guidance with the identity."""
    chunk = x - tokens.times[step, :, None] * v
    return v - tokens.gain[step, :, None] * (tokens.target - chunk)


def in_e4m3(inputs: Tensor) -> Operand:
    """Activations rounded to E4M3 with scales float32[L, 4], `PackedExpert.inputs`."""
    scales = inputs.tolist()
    return lambda x, layer, product: to_e4m3(x, 1 / scales[layer][product]).to(x.dtype) * scales[layer][product]


def _rotate(x: Tensor, cos: Tensor, sin: Tensor) -> Tensor:
    """RoPE in x's dtype. x [T, heads, K]"""
    first, second = x.chunk(2, dim=-1)
    return torch.cat((first * cos - second * sin, second * cos + first * sin), dim=-1)
