"""Pi0.5 with memory: past frames within SigLIP, past states as tokens of the prefix. The rest is Pi0.5's reference.

MEM (arXiv 2603.03596), as LeRobot's main branch computes it:

    temporal layer   u = LN(x + e). Each patch attends over its frames, from the oldest to its own; what that gives
                     takes the place of v in the attention within the frame, whose q and k are u's. No new weights. e is
                     not in the residual stream
    e                sin(p ω), cos(p ω) - 1 in turn, p from 1 - F to 0: the current frame's are 0, so one frame alone is
                     an ordinary image
    behind the last temporal layer the current frame goes on alone: the prefix is as long as without memory
    states           a linear layer, unscaled, between images and prompt; one from before the episode takes no place

Layers below the first temporal one depend on their frame alone. They are 3 of 27 with LeRobot's defaults, and a frame
comes back `stride` observations later: keeping their outputs would save a ninth of vision at most.
"""

from typing import Any

import torch
from torch import Tensor, nn

from turbopi.config import ModelConfig
from turbopi.models.observation import Observation, past_of
from turbopi.models.pi0.denoise import suffix_mask, suffix_rope, time_embedding
from turbopi.models.pi0.kv_cache import EmbeddedPrefix, KVCache, PrefixLayout
from turbopi.models.pi0.layers import attention, merge_heads, split_heads
from turbopi.models.pi0.prefix import embed_prompt
from turbopi.models.pi0.reference import Pi0Model
from turbopi.models.pi0.vision import EncoderLayer, normalize_images


class MemoryModel(Pi0Model):
    """Pi0.5 for observations with a `past`."""

    def __init__(self, config: ModelConfig) -> None:
        super().__init__(config)
        assert config.memory is not None
        self.memory = config.memory
        if self.memory.proprioceptive:
            self.proprio_history_proj = nn.Linear(self.memory.state_dim, config.vlm.width)
            self.requires_grad_(False)

    def embed_cameras(self, observation: Observation, cameras: Tensor | None) -> tuple[Tensor, Tensor]:
        past, images, valid = past_of(observation), observation.images, observation.image_mask
        if past.images is None or past.image_mask is None:
            assert not self.memory.visual, "an observation without past images"
            return super().embed_cameras(observation, cameras)
        frames = torch.cat((past.images, images[:, :, None]), dim=2)  # [B, C, F, h, w, 3]
        valid = torch.cat((past.image_mask, valid[:, :, None]), dim=2)
        if cameras is not None:
            frames, valid = frames[:, cameras], valid[:, cameras]
        b, c = valid.shape[:2]
        hidden = self.encode_frames(frames.flatten(0, 1), valid.flatten(0, 1))  # [B * C, P, W]
        tokens = self.projector(hidden).reshape(b, -1, self.config.vlm.width)
        return tokens, hidden.reshape(b, c, *hidden.shape[1:]).transpose(0, 1)

    def embed_states(self, observation: Observation) -> list[Tensor]:
        if not self.memory.proprioceptive:
            return []
        states = past_of(observation).states
        assert states is not None, "an observation without past states"
        return [self.proprio_history_proj(states).to(self.compute_dtype)]

    def encode_frames(self, frames: Tensor, valid: Tensor) -> Tensor:
        """Frames [N, F, h, w, 3], oldest first, and which there are, bool[N, F] -> the last one's tokens [N, P, W]."""
        vision, (n, count), every = self.vision, valid.shape, self.memory.temporal_every
        x = vision.embed_patches(normalize_images(frames.flatten(0, 1))).to(vision.post_layernorm.weight.dtype)
        patches, width = x.shape[1:]
        place = frame_places(count, width, x.device).to(x.dtype)[:, None]  # [F, 1, W]
        mask = frame_mask(valid)
        x = x.reshape(n, count, patches, width)
        last = len(vision.layers) // every * every
        for number, layer in enumerate(vision.layers, start=1):
            assert isinstance(layer, EncoderLayer)
            if number % every or x.shape[1] == 1:
                x = layer(x.flatten(0, 1)).reshape(n, -1, patches, width)
            else:
                x = temporal_layer(layer, x, place, mask)
            if number == last:
                x = x[:, -1:]
        return vision.post_layernorm(x[:, -1])

    @property
    def stages(self) -> "Stages":
        return Stages(self)


def temporal_layer(layer: EncoderLayer, x: Tensor, place: Tensor, mask: Tensor) -> Tensor:
    """A layer of SigLIP over frames x [N, F, P, W], with their places [F, 1, W] and `frame_mask`'s mask."""
    own = layer.self_attn
    n, count, patches, width = x.shape
    u = layer.layer_norm1(x + place).flatten(0, 1)  # [N * F, P, W]
    q, k, v = (split_heads(project(u), own.head_dim) for project in (own.q_proj, own.k_proj, own.v_proj))

    def by_patch(of_frames: Tensor) -> Tensor:
        """[N * F, H, P, K] -> [N * P, H, F, K]"""
        return of_frames.reshape(n, count, -1, patches, own.head_dim).permute(0, 3, 2, 1, 4).flatten(0, 1)

    mixed = attention(by_patch(q), by_patch(k), by_patch(v), mask.repeat_interleave(patches, dim=0))
    mixed = mixed.reshape(n, patches, -1, count, own.head_dim).permute(0, 3, 2, 1, 4).flatten(0, 1)  # [N * F, H, P, K]
    x = x + own.out_proj(merge_heads(attention(q, k, mixed))).reshape(n, count, patches, width)
    return x + layer.mlp(layer.layer_norm2(x))


def frame_places(count: int, width: int, device: torch.device | None = None) -> Tensor:
    """float32[F, W]: e of the frames, oldest first."""
    p = torch.arange(1 - count, 1, dtype=torch.float32, device=device)[:, None]
    angle = p * 10_000.0 ** (-torch.arange(0, width, 2, dtype=torch.float32, device=device) / width)
    return torch.stack((angle.sin(), angle.cos() - 1), dim=-1).flatten(1)


def frame_mask(valid: Tensor) -> Tensor:
    """bool[N, 1, F, F]: a frame sees valid ones up to itself, and always itself, so that every row sees one."""
    count = valid.shape[1]
    own = torch.eye(count, dtype=torch.bool, device=valid.device)
    return ((own.new_ones(count, count).tril() & valid[:, None, :]) | own)[:, None]


class Stages:
    """The stages that backends/captured.py captures, of observations without a masked camera: nothing asks the host."""

    def __init__(self, model: Pi0Model) -> None:
        self._model = model

    def embed_images(self, observation: Observation) -> Tensor:
        return self._model.embed_cameras(observation, None)[0]

    def embed_prefix(self, observation: Observation, embedded: Tensor) -> EmbeddedPrefix:
        model = self._model
        layout = PrefixLayout.of(observation, model.config.vision.num_tokens, compact=False)
        parts = embedded, *model.embed_states(observation), embed_prompt(model.vlm, observation.tokens)
        return EmbeddedPrefix(torch.cat(parts, dim=1), layout, layout.pad_mask.sum(1), observation.state)

    def encode_prefix(self, embedded: EmbeddedPrefix) -> tuple[Tensor, Tensor, Tensor]:
        layout = embedded.layout
        k, v = self._model.encode_prefix(embedded.embs, layout.positions, layout.attended)
        return k, v, layout.positions

    def cache_of(self, embedded: EmbeddedPrefix, k: Tensor, v: Tensor) -> KVCache:
        return KVCache(k, v, embedded.layout.pad_mask, embedded.lengths, embedded.state)

    def to_padded(self, part: Tensor, observation: Observation) -> Tensor:
        """Keys or values [layer, 1, G, S, K] of an observation's valid places, in all of the reference's."""
        layout = PrefixLayout.of(observation.to(part.device), self._model.config.vision.num_tokens, compact=True)
        return layout.to_padded(part, 3)

    def cross_keys_values(self, cache: KVCache) -> None:
        return None

    def velocity(self, x: Tensor, time: Tensor, cache: KVCache, behind: Any) -> tuple[Tensor, Tensor]:
        model, horizon = self._model, x.shape[1]
        rope = suffix_rope(cache, horizon, model.config.expert.head_dim, model.config.rope_base)
        mask = suffix_mask(cache, horizon, has_state_token=False)
        return model.velocity(x, cache.state, time, cache.k, cache.v, rope, mask)

    def embed_times(self, times: Any) -> Tensor:
        embedded = time_embedding(times, self._model.config.expert.width).to(self._model.device)
        return self._model.time_condition(embedded)
