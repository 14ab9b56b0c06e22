"""The small parts that the denoising kernel's host side and its twin both need."""

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
