"""What the engine and kernels agree on: each folder of kernels gives one `Ops` and one `Denoiser`.

Shapes: D, W widths, F hidden width of an MLP, K head_dim, A action_dim.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Generic, Protocol, TypeVar

from torch import Tensor

from turbopi.quantization.fp8 import Matrix

State = dict[str, Tensor]
Affine = tuple[Tensor, Tensor]  # weight [out, in], bias [out]; of a LayerNorm: weight, bias [W]
AffineMatrix = tuple[Matrix, Tensor]
AnyMatrix = TypeVar("AnyMatrix", bound=Matrix)


@dataclass(frozen=True)
class VisionLayer:
    norm1: Affine
    qkv: AffineMatrix  # [3W, W], [3W]
    out: AffineMatrix
    norm2: Affine
    fc1: AffineMatrix
    fc2: AffineMatrix


@dataclass(frozen=True)
class GemmaLayer(Generic[AnyMatrix]):
    """One layer of either stack. The norms are float32[D], 1 + scale; None where adaRMS replaces them."""

    qkv: AnyMatrix  # [(heads + 2) * K, D]
    out: AnyMatrix  # [D, heads * K]
    gate_up: AnyMatrix  # [2F, D]: gate rows, then up rows
    down: AnyMatrix  # [D, F]
    norm1: Tensor | None
    norm2: Tensor | None


@dataclass(frozen=True)
class Ops:
    """Any of them may be exchanged for another implementation; `origin` says whose they are, for metadata.

    `residual_linear` is a product that only the `y` of a residual norm reads, and such a norm's result only products
    read; what they hand over is a matter between them.
    """

    embed_patches: Callable[..., Tensor]
    embed_prompt: Callable[..., None]
    residual_rms_norm: Callable[..., tuple[Tensor, Tensor]]
    residual_layer_norm: Callable[..., tuple[Tensor, Any]]
    linear: Callable[..., Tensor]
    residual_linear: Callable[..., Any]
    linear_gelu: Callable[..., Tensor]
    linear_geglu: Callable[..., Tensor]
    rope_split: Callable[..., Tensor]
    vision_attention: Callable[..., Tensor]
    attention: Callable[..., Tensor]
    prefix_cache: Callable[..., None] | None = None  # in place of `forward.prefix_cache`
    origin: Mapping[str, str] = field(default_factory=dict)


class Denoiser(Protocol):
    """All denoising steps in one launch, for one number of steps and one horizon."""

    def launch(self, noise: Tensor, cache_k: Tensor, cache_v: Tensor, length: Tensor, x_t: Tensor, v_t: Tensor) -> None:
        """From noise float32[H, A] and the cache's first `length` rows: x_t float32[N + 1, H, A], v_t [N, H, A]."""
