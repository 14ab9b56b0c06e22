"""One call on fixed buffers: TensorRT for vision, the prefix's MLPs and the action expert, PyTorch for what is between.

What PyTorch does: the embeddings of patches (float32) and prompt; the projector (bfloat16, so vision's float16 output
is cast first); the prefix's norms, projections, RoPE and attention (scaled_dot_product_attention in bfloat16); the
float32 projections of actions and the Euler update; positions and masks. The sequence is captured in CUDA graphs;
`parts` may be engines or, in tests, their twins.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from turbopi.backends.tensorrt.networks import HIDDEN, matrix
from turbopi.backends.tensorrt.parts import EngineShape
from turbopi.config import ModelConfig
from turbopi.engine.graph import Mark
from turbopi.engine.weights import Weights
from turbopi.kernels.plain import embed_patches
from turbopi.models import family_of
from turbopi.models.pi0.denoise import euler_step, time_embedding, time_grid
from turbopi.models.pi0.layers import apply_rope, rope_tables
from turbopi.support.errors import BackendError


class Part(Protocol):
    """An engine, or its twin: reads its inputs and writes its outputs, bound by name."""

    calls: int

    def run(self, **tensors: Tensor) -> None: ...


@dataclass(frozen=True)
class Parts:
    """The engines of one shape."""

    vision: Part | None  # None: no camera
    feed_forwards: Sequence[Part]
    denoise_step: Part

    def calls(self) -> list[int]:
        """How often each has run, the denoising step last."""
        return [part.calls for part in ([] if self.vision is None else [self.vision])] + [
            part.calls for part in (*self.feed_forwards, self.denoise_step)
        ]


class EngineCall:
    """Buffers and work of one observation in flight."""

    def __init__(
        self,
        config: ModelConfig,
        weights: Weights,
        parts: Parts,
        shape: EngineShape,
        num_steps: int,
        table: Tensor | None,  # float32[N, 2 * layers + 1, 3, D], Pi0.5's modulation
        *,
        vision_dtype: torch.dtype = torch.float16,
        float_images: bool = False,
    ) -> None:
        self.config, self.weights, self.parts, self.shape, self.num_steps = config, weights, parts, shape, num_steps
        self.table = table
        device, dtype = weights.embed_tokens.device, weights.embed_tokens.dtype
        size, slots = config.vision.image_size, shape.prefix_slots(config)
        suffix = shape.horizon + family_of(config).state_token
        pixels = torch.float32 if float_images else torch.uint8

        def pair(dims: tuple[int, ...], dtype: torch.dtype) -> tuple[Tensor, Tensor]:
            return torch.zeros(dims, dtype=dtype, pin_memory=device.type == "cuda"), torch.zeros(
                dims, dtype=dtype, device=device
            )

        self.host_images, self.images = pair((shape.cameras, size, size, 3), pixels)
        self.host_noise, self.noise = pair((shape.horizon, config.action_dim), torch.float32)
        self.host_state, self.state = pair((config.action_dim,), torch.float32)
        self.host_tokens, self.tokens = pair((shape.prompt_slots,), torch.int64)
        self.host_length, self.length = pair((1,), torch.int64)
        self.host_length[0] = slots  # whatever runs before the first observation sees keys, and makes no NaN
        rows = shape.cameras * config.vision.num_tokens
        self.hidden = torch.zeros(rows, config.vision.width, device=device, dtype=vision_dtype)
        self.embs = torch.zeros(slots, config.vlm.width, device=device, dtype=dtype)
        self.mlp_in, self.mlp_out = torch.zeros_like(self.embs), torch.zeros_like(self.embs)
        cache = (config.vlm.depth, slots, config.vlm.head_dim)
        self.cache_k, self.cache_v = (torch.zeros(cache, device=device, dtype=dtype) for _ in range(2))
        every = torch.arange(slots + suffix, device=device)
        cos, sin = rope_tables(every[None], config.vlm.head_dim, config.rope_base)
        self.rope, self.key_index, self.suffix_offsets = (cos[0, 0], sin[0, 0]), every, every[:suffix]
        times = time_grid(num_steps, config.time_grid)
        self.time_embs = time_embedding(times, config.expert.width).to(device)  # Pi0's
        chunk = (shape.horizon, config.action_dim)
        self.x_t = torch.full((num_steps + 1, *chunk), torch.nan, device=device)
        self.v_t = torch.full((num_steps, *chunk), torch.nan, device=device)
        self.suffix_out = torch.full((suffix, config.expert.width), torch.nan, device=device)
        self.actions = torch.empty(chunk, pin_memory=device.type == "cuda")

    def write_inputs(self, images: np.ndarray, noise: np.ndarray, state: np.ndarray, tokens: np.ndarray) -> None:
        """Put one observation, compacted, into the host buffers. Raises BackendError if it doesn't fit the shape."""
        if len(images) != self.shape.cameras or len(tokens) > self.shape.prompt_slots:
            raise BackendError(
                f"the engines are for {self.shape}; this observation has {len(images)} cameras and {len(tokens)} tokens"
            )
        self.host_images.numpy()[:] = images
        self.host_noise.numpy()[:] = noise
        self.host_state.numpy()[:] = state
        padded = self.host_tokens.numpy()
        padded[: len(tokens)], padded[len(tokens) :] = tokens, 0
        self.host_length[0] = self.shape.cameras * self.config.vision.num_tokens + len(tokens)

    def run(self, mark: Mark = lambda stage: None) -> None:
        self.encode(mark)
        self.denoise(mark)

    def encode(self, mark: Mark = lambda stage: None) -> None:
        """Host buffers to the cache: upload, vision, prefix. Noise and state are uploaded too."""
        for name in ("images", "noise", "state", "tokens", "length"):
            getattr(self, name).copy_(getattr(self, f"host_{name}"), non_blocking=True)
        self._embed()
        mark("vision")
        self._prefix()
        mark("prefix")

    def denoise(self, mark: Mark = lambda stage: None) -> None:
        """The cache and noise to actions on the host."""
        positions = self.length + self.suffix_offsets
        slots = self.cache_k.shape[1]
        hidden = (self.key_index >= self.length) & (self.key_index < slots)
        mask = torch.where(hidden, HIDDEN, 0.0)[None]
        if family_of(self.config).state_token:  # the state token doesn't see the actions behind it
            heads = self.config.expert.num_heads
            mask = mask.repeat(len(self.suffix_offsets) * heads, 1)
            mask[:heads, slots + 1 :] = HIDDEN
        fixed = {"cos": self.rope[0][positions], "sin": self.rope[1][positions], "mask": mask}
        fixed |= {"k": self.cache_k, "v": self.cache_v}
        self.x_t[0] = self.noise
        for step in range(self.num_steps):
            self._step(step, fixed)
        self.actions.copy_(self.x_t[-1], non_blocking=True)
        mark("denoise")

    def _embed(self) -> None:
        camera_images = len(self.hidden)
        table = self.weights.embed_tokens
        self.embs[camera_images:] = F.embedding(self.tokens, table) * table.shape[1] ** 0.5
        if self.parts.vision is not None:
            weights = self.weights
            patches = embed_patches(self.images, weights.patch, weights.position, self.hidden.dtype)
            self.parts.vision.run(x=patches, hidden=self.hidden)
            self.embs[:camera_images] = F.linear(self.hidden.to(self.embs.dtype), *self.weights.projector)

    def _prefix(self) -> None:
        g, slots = self.config.vlm, len(self.embs)
        visible = (self.key_index[:slots] < self.length)[None, None, None]
        cos, sin = self.rope[0][:slots, None], self.rope[1][:slots, None]
        x = self.embs
        for i, layer in enumerate(self.weights.vlm):
            last = i + 1 == len(self.weights.vlm)
            normed = self._norm(x, layer.norm1)
            qkv = F.linear(normed, matrix(layer.qkv)[-2 * g.head_dim :] if last else matrix(layer.qkv))
            parts = qkv.view(slots, -1, g.head_dim)
            rotated = apply_rope(parts[:, :-1], cos, sin)
            self.cache_k[i], self.cache_v[i] = rotated[:, -1], parts[:, -1]
            if last:  # nothing but its K and V is ever used
                return
            q = rotated[:, :-1].reshape(1, 1, -1, g.head_dim)  # all heads' queries over the one key/value head
            keys, values = self.cache_k[i][None, None], self.cache_v[i][None, None]
            attended = F.scaled_dot_product_attention(q, keys, values, attn_mask=visible)
            x = x + F.linear(attended.reshape(slots, -1), matrix(layer.out))
            self.mlp_in.copy_(self._norm(x, layer.norm2))
            self.parts.feed_forwards[i].run(x=self.mlp_in, y=self.mlp_out)
            x = x + self.mlp_out

    def _norm(self, x: Tensor, scale: Tensor | None) -> Tensor:
        assert scale is not None
        return F.rms_norm(x.float(), (x.shape[-1],), scale, self.config.rms_norm_eps).to(x.dtype)

    def _step(self, step: int, fixed: dict[str, Tensor]) -> None:
        if self.table is not None:
            fixed["modulation"] = self.table[step]
        self.parts.denoise_step.run(tokens=self._tokens(step), out=self.suffix_out, **fixed)
        self.v_t[step] = self._project("action_out_proj", self.suffix_out[-self.shape.horizon :])
        self.x_t[step + 1] = euler_step(self.x_t[step], self.v_t[step], self.num_steps)

    def _tokens(self, step: int) -> Tensor:
        """The suffix: actions, and for Pi0 the state's token before them and the time mixed in."""
        actions = self._project("action_in_proj", self.x_t[step])
        family = family_of(self.config)
        if not family.modulated:
            mixed = torch.cat((actions, self.time_embs[step].expand_as(actions)), dim=-1)
            actions = self._project("action_time_mlp_out", F.silu(self._project("action_time_mlp_in", mixed)))
        if family.state_token:
            actions = torch.cat((self._project("state_proj", self.state[None]), actions))
        return actions.to(self.embs.dtype)

    def _project(self, name: str, x: Tensor) -> Tensor:
        return F.linear(x, self.weights.small[f"{name}.weight"], self.weights.small[f"{name}.bias"])
