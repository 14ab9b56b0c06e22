"""The model cut into four graphs that need nothing of PyTorch: what is exported, one module a graph.

All of them are float32 with attention written out (matrix products and a float32 softmax), as in the reference. The
host keeps what has no weights: which cameras and tokens are valid, positions, the time embedding, the Euler updates.

L layers, S prefix tokens, H horizon, A action_dim, G key/value heads, K head_dim, D language-model width,
E expert width, N images, P prompt tokens. The batch is 1.
"""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from turbopi.config import ModelConfig
from turbopi.models import family_of
from turbopi.models.pi0.prefix import embed_prompt, prefix_keys_values
from turbopi.models.pi0.reference import Pi0Model


class VisionGraph(nn.Module):
    """Images to language-model tokens: SigLIP and the projector."""

    def __init__(self, model: Pi0Model) -> None:
        super().__init__()
        self.vision, self.projector = model.vision, model.projector

    def forward(self, images: Tensor) -> Tensor:
        """float32[N, 224, 224, 3] in [-1, 1] -> float32[N, 256, D]"""
        return self.projector(self.vision(images))


class PromptGraph(nn.Module):
    """Prompt ids to language-model tokens: the embedding table."""

    def __init__(self, model: Pi0Model) -> None:
        super().__init__()
        self.vlm = nn.Module()  # the table alone, not the layers beside it
        self.vlm.embed_tokens = model.vlm.embed_tokens

    def forward(self, tokens: Tensor) -> Tensor:
        """int64[1, P] -> float32[1, P, D]"""
        return embed_prompt(self.vlm, tokens)  # type: ignore[arg-type]


class _Rotary(nn.Module):
    """RoPE's frequencies as numbers of PyTorch's: another runtime's power function would round them differently."""

    frequencies: Tensor

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        head_dim = config.vlm.head_dim
        exponents = torch.arange(0, head_dim, 2, dtype=torch.float32) / head_dim
        self.register_buffer("frequencies", 1.0 / config.rope_base**exponents)

    def forward(self, positions: Tensor) -> tuple[Tensor, Tensor]:
        """int64[1, S] -> cos and sin, float32[1, 1, S, K/2]"""
        angles = positions[:, None, :, None].float() * self.frequencies
        return angles.cos(), angles.sin()


class PrefixGraph(nn.Module):
    """The language model over the prefix, for its keys and values."""

    def __init__(self, model: Pi0Model) -> None:
        super().__init__()
        self.layers, self.rope = model.vlm.layers, _Rotary(model.config)

    def forward(self, embs: Tensor, positions: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
        """float32[1, S, D], int64[1, S], bool[1, S] (True: may be attended to) -> K, V

        Both float32[L, 1, G, S, K], K rotated.
        """
        return prefix_keys_values(self, embs, self.rope(positions), mask[:, None, None, :])  # type: ignore[arg-type]


class DenoiseStepGraph(nn.Module):
    """One evaluation of the action expert, with the time condition's MLP."""

    def __init__(self, model: Pi0Model) -> None:
        super().__init__()
        self.model, self.rope = model, _Rotary(model.config)
        self.adaptive = family_of(model.config).modulated

    def forward(
        self,
        x_t: Tensor,
        time_emb: Tensor,
        k: Tensor,
        v: Tensor,
        mask: Tensor,
        positions: Tensor,
        state: Tensor | None = None,
    ) -> Tensor:
        """x_t float32[1, H, A] -> v_t float32[1, H, A], from the prefix's K and V and its mask bool[1, S]

        `time_emb` float32[1, E] is denoise.time_embedding(t, E). `positions` int64[1, H], and `state` None; for Pi0
        int64[1, H + 1], the state's token first, and float32[1, A].
        """
        time = self.model.time_condition(time_emb) if self.adaptive else time_emb
        valid = torch.cat((mask, torch.ones_like(positions, dtype=torch.bool)), dim=1)[:, None, None, :]
        if not self.adaptive:  # the state token doesn't see the actions behind it
            is_action = positions > positions[:, :1]
            seen_by_state = torch.cat((torch.ones_like(mask), ~is_action), dim=1)
            valid = valid & (is_action[:, None, :, None] | seen_by_state[:, None, None, :])
        # Pi0.5 never reads the state
        return self.model.velocity(x_t, state, time, k, v, self.rope(positions), valid)[1]  # type: ignore[arg-type]


@dataclass(frozen=True)
class Graph:
    """A module with an example of its inputs, and which of their axes may have any length."""

    name: str  # of its file: <name>.onnx
    module: nn.Module
    inputs: dict[str, Tensor]
    outputs: tuple[str, ...]
    dynamic: dict[str, dict[int, Any]]


def graphs(model: Pi0Model) -> list[Graph]:
    """The four graphs of a float32 model, in the order they run."""
    config = model.config
    n, p, s, h = (torch.export.Dim(name) for name in ("pictures", "prompt", "prefix", "horizon"))
    some, horizon = 5, 7  # lengths of the examples: any but 0 and 1, which would be taken for constants
    side = config.vision.image_size
    cache = torch.zeros(config.vlm.depth, 1, config.vlm.num_kv_heads, some, config.vlm.head_dim)
    positions, mask = torch.arange(some)[None], torch.ones(1, some, dtype=torch.bool)
    has_state = family_of(config).state_token
    suffix: Any = h + 1 if has_state else h
    step = {
        "x_t": torch.zeros(1, horizon, config.action_dim),
        "time_emb": torch.zeros(1, config.expert.width),
        "k": cache,
        "v": cache.clone(),
        "mask": mask,
        "positions": some + torch.arange(horizon + has_state)[None],
    }
    step_axes = {"x_t": {1: h}, "time_emb": {}, "k": {3: s}, "v": {3: s}, "mask": {1: s}, "positions": {1: suffix}}
    if has_state:
        step["state"], step_axes["state"] = torch.zeros(1, config.action_dim), {}
    return [
        Graph("vision", VisionGraph(model), {"images": torch.zeros(2, side, side, 3)}, ("embs",), {"images": {0: n}}),
        Graph("prompt", PromptGraph(model), {"tokens": positions}, ("embs",), {"tokens": {1: p}}),
        Graph(
            "prefix",
            PrefixGraph(model),
            {"embs": torch.zeros(1, some, config.vlm.width), "positions": positions, "mask": mask},
            ("k", "v"),
            {"embs": {1: s}, "positions": {1: s}, "mask": {1: s}},
        ),
        Graph("denoise_step", DenoiseStepGraph(model), step, ("v_t",), step_axes),
    ]
