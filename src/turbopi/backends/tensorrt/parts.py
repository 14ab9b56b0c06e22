"""The engines that a call needs, as specifications: what the cache looks up and the builder writes."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch

from turbopi.backends.tensorrt import networks
from turbopi.backends.tensorrt.engine import Input, Specification
from turbopi.backends.tensorrt.networks import Fp8Scales
from turbopi.backends.tensorrt.ops import Dtype
from turbopi.config import ModelConfig
from turbopi.engine.weights import Weights
from turbopi.models import family_of

SLOTS = 16  # prompt lengths that engines are built for are multiples of it
GetWeights = Callable[[], Weights]  # called only when an engine is built; raises BackendError if they are gone


@dataclass(frozen=True)
class EngineShape:
    """What a set of engines is fixed to: any prompt of up to `prompt_slots` tokens runs in it."""

    cameras: int  # valid ones
    prompt_slots: int
    horizon: int

    def prefix_slots(self, config: ModelConfig) -> int:
        return self.cameras * config.vision.num_tokens + self.prompt_slots

    def __str__(self) -> str:
        return f"{self.cameras} cameras, up to {self.prompt_slots} prompt tokens, H={self.horizon}"


def vision(config: ModelConfig, weights: GetWeights, shape: EngineShape, dtype: Dtype) -> Specification:
    """All cameras' images in one batch."""
    v = config.vision
    return Specification(
        f"vision-{shape.cameras}",
        {"x": Input((shape.cameras * v.num_tokens, v.width), dtype)},
        lambda ops, inputs: {"hidden": networks.vision(ops, config, weights(), inputs["x"], shape.cameras, dtype)},
        {"precision": dtype},
    )


def feed_forwards(
    config: ModelConfig,
    weights: GetWeights,
    shape: EngineShape,
    dtype: Dtype,
    scales: Sequence[Fp8Scales | None] | None = None,
) -> list[Specification]:
    """One engine a layer, each with its own weights and scales (None: in `dtype`).

    There is none for the last layer, of which only K and V are used.
    """
    return [
        _feed_forward(config, weights, i, shape.prefix_slots(config), dtype, None if scales is None else scales[i])
        for i in range(config.vlm.depth - 1)
    ]


def _feed_forward(
    config: ModelConfig, weights: GetWeights, i: int, rows: int, dtype: Dtype, scales: Fp8Scales | None
) -> Specification:
    return Specification(
        f"feed_forward-{i}-{rows}" + ("" if scales is None else "-fp8"),
        {"x": Input((rows, config.vlm.width), dtype)},
        lambda ops, inputs: {"y": networks.feed_forward(ops, weights().vlm[i], inputs["x"], dtype, scales)},
        {"precision": dtype if scales is None else f"fp8 in {dtype}", "scales": _plain(scales)},
    )


def denoise_step(config: ModelConfig, weights: GetWeights, shape: EngineShape, dtype: Dtype) -> Specification:
    """The action expert over the shape's whole cache; see networks.denoise_step."""
    g, adaptive = config.expert, family_of(config).modulated
    suffix, rows = shape.horizon + (not adaptive), shape.prefix_slots(config)
    cache, angles = Input((g.depth, rows, g.head_dim), dtype), Input((suffix, g.head_dim // 2), "f32")
    masks = 1 if adaptive else suffix * g.num_heads
    inputs = {
        "tokens": Input((suffix, g.width), dtype),
        "cos": angles,
        "sin": angles,
        "k": cache,
        "v": cache,
        "mask": Input((masks, rows + suffix), "f32"),
    }
    if adaptive:
        inputs["modulation"] = Input((2 * g.depth + 1, 3, g.width), "f32")
    return Specification(
        f"denoise_step-{rows}-{suffix}",
        inputs,
        lambda ops, values: {"out": networks.denoise_step(ops, config, weights(), values)},
        {"precision": dtype},
    )


def _plain(scales: Fp8Scales | None) -> dict[str, list[float]] | None:
    if scales is None:
        return None
    return {name: getattr(scales, name).double().flatten().tolist() for name in Fp8Scales.__dataclass_fields__}


def fingerprint(state: dict[str, torch.Tensor]) -> str:
    """16 hex digits of a model's weights on any device: different weights give different ones, by accident never equal.

    Not cryptographic: two sums of the elements' bits weighted by hashes of their indices, modulo 2**64. At full size on
    a GPU that takes a fraction of a second, where SHA-256 needs many.
    """
    import hashlib

    lines = []
    for name, tensor in sorted(state.items()):
        bits = tensor.detach().contiguous().view(torch.int16 if tensor.element_size() == 2 else torch.int32).flatten()
        total = torch.zeros(2, dtype=torch.int64, device=bits.device)
        for start in range(0, len(bits), 1 << 24):
            part = bits[start : start + (1 << 24)].to(torch.int64)
            index = torch.arange(start, start + len(part), device=bits.device)
            for which, multiplier in enumerate((0x9E3779B97F4A7C15 - (1 << 64), 0x2545F4914F6CDD1D)):
                weight = (index + 1) * multiplier
                total[which] += (part * (weight ^ (weight >> 29))).sum()
        lines.append(f"{name} {list(tensor.shape)} {tensor.dtype} {total.tolist()}")
    return hashlib.sha256("\n".join(lines).encode()).hexdigest()[:16]
