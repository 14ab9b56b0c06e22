"""SigLIP So400m/14: images to tokens. 27 pre-LayerNorm blocks with biases everywhere; no CLS token, no pooling."""

from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from turbopi.config import VisionConfig
from turbopi.models.pi0.layers import attention, merge_heads, split_heads


class SelfAttention(nn.Module):
    def __init__(self, config: VisionConfig) -> None:
        super().__init__()
        self.attend: Callable[[Tensor, Tensor, Tensor], Tensor] = attention  # a family may take another one
        self.head_dim = config.head_dim
        self.q_proj = nn.Linear(config.width, config.width)
        self.k_proj = nn.Linear(config.width, config.width)
        self.v_proj = nn.Linear(config.width, config.width)
        self.out_proj = nn.Linear(config.width, config.width)

    def forward(self, x: Tensor) -> Tensor:
        q, k, v = (split_heads(project(x), self.head_dim) for project in (self.q_proj, self.k_proj, self.v_proj))
        return self.out_proj(merge_heads(self.attend(q, k, v)))


class MLP(nn.Module):
    def __init__(self, config: VisionConfig) -> None:
        super().__init__()
        self.fc1 = nn.Linear(config.width, config.mlp_dim)
        self.fc2 = nn.Linear(config.mlp_dim, config.width)

    def forward(self, x: Tensor) -> Tensor:
        return self.fc2(F.gelu(self.fc1(x), approximate="tanh"))


class EncoderLayer(nn.Module):
    def __init__(self, config: VisionConfig) -> None:
        super().__init__()
        # eps is 1e-6: PyTorch's default of 1e-5 moves the actions by 2e-5
        self.layer_norm1 = nn.LayerNorm(config.width, eps=config.layer_norm_eps)
        self.self_attn = SelfAttention(config)
        self.layer_norm2 = nn.LayerNorm(config.width, eps=config.layer_norm_eps)
        self.mlp = MLP(config)

    def forward(self, x: Tensor) -> Tensor:
        x = x + self.self_attn(self.layer_norm1(x))
        return x + self.mlp(self.layer_norm2(x))


class VisionTower(nn.Module):
    """Images (uint8|float32)[N, 224, 224, 3] -> tokens [N, 256, W], row-major over the patches."""

    def __init__(self, config: VisionConfig) -> None:
        super().__init__()
        self.config = config
        self.patch_embedding = nn.Conv2d(3, config.width, config.patch_size, config.patch_size)
        self.position_embedding = nn.Embedding.from_pretrained(torch.empty(config.num_tokens, config.width))  # type: ignore[no-untyped-call]
        self.layers = nn.ModuleList(EncoderLayer(config) for _ in range(config.depth))
        self.post_layernorm = nn.LayerNorm(config.width, eps=config.layer_norm_eps)

    def forward(self, images: Tensor) -> Tensor:
        x = self.embed_patches(normalize_images(images)).to(self.post_layernorm.weight.dtype)
        for layer in self.layers:
            x = layer(x)
        return self.post_layernorm(x)

    def embed_patches(self, images: Tensor) -> Tensor:
        """float32 [N, 224, 224, 3] -> float32 [N, 256, W].

        The convolution's stride is its size, so it is one matrix product; written as one because cuDNN would
        compute a float32 convolution in TF32 by default.
        """
        n, p = images.shape[0], self.config.patch_size
        side = self.config.image_size // p
        patches = images.reshape(n, side, p, side, p, 3).permute(0, 1, 3, 5, 2, 4).reshape(n, side * side, 3 * p * p)
        weight = self.patch_embedding.weight.flatten(1)
        return F.linear(patches, weight, self.patch_embedding.bias) + self.position_embedding.weight


def normalize_images(images: Tensor) -> Tensor:
    """uint8 [0, 255] -> float32 [-1, 1]; float32 is in [-1, 1] already and passes."""
    return images.float() / 255 * 2 - 1 if images.dtype == torch.uint8 else images
