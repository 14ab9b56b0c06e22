"""What the host sides of the denoising kernels, Hopper's and the portable one, and their twins share."""

import torch
import torch.nn.functional as F
from torch import Tensor

from turbopi.config import ModelConfig
from turbopi.kernels.interface import State


def affine(small: State, name: str, x: Tensor) -> Tensor:
    return F.linear(x, small[f"{name}.weight"].to(x.dtype), small[f"{name}.bias"].to(x.dtype))


def inverse_frequencies(config: ModelConfig, device: torch.device) -> Tensor:
    """float32[K/2], as `model.layers.rope_tables` computes them."""
    exponents = torch.arange(0, config.expert.head_dim, 2, dtype=torch.float32, device=device) / config.expert.head_dim
    return 1.0 / config.rope_base**exponents


def check_launch(
    noise: Tensor,
    cache_k: Tensor,
    cache_v: Tensor,
    x_t: Tensor,
    v_t: Tensor,
    *,
    chunk: tuple[int, int, int],
    head_dim: int,
) -> None:
    """Assert that a `Denoiser`'s tensors are as its kernel reads and writes them; chunk: steps, tokens, action_dim."""
    steps, *shape = chunk
    assert noise.shape == (*shape,) and x_t.shape == (steps + 1, *shape) and v_t.shape == (steps, *shape)
    assert cache_k.stride() == cache_v.stride() and cache_k.stride()[1:] == (head_dim, 1), cache_k.stride()
    assert cache_k.dtype == cache_v.dtype == torch.bfloat16
    assert all(t.is_contiguous() and t.dtype == torch.float32 for t in (noise, x_t, v_t))
