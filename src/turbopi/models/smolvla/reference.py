"""The reference: SmolVLA in plain PyTorch, exact to LeRobot. Every backend is judged against it.

    prefix(observation) -> KVCache      SigLIP, connector and the text layers, once an observation
    denoise(cache, noise, N) -> actions the action expert, N times
    sample(observation, noise, N)       both

What differs from Pi0: each layer of the expert is a self layer (prefix and suffix, causal among the actions) or a
cross layer (the prefix alone, through matrices of its own); the state is the prefix's last token; RoPE's base is
10,000; the text layers' last one gives keys and values alone.

Shapes: B batch, C cameras, S places of the prefix, A actions of a chunk, D width, H query heads, G key heads, K
head_dim. Dtypes: each matrix casts its input to its own dtype and a residual is added in place onto the projection's
result, so after the first output projection the stream has the weights' dtype, whatever came in (as in LeRobot).
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from turbopi.config import VisionConfig
from turbopi.models.observation import Observation
from turbopi.models.pi0 import layers
from turbopi.models.pi0.conditioning import Conditioning, Conditionings
from turbopi.models.pi0.denoise import time_embedding
from turbopi.models.pi0.exact import exact_float32
from turbopi.models.pi0.integrate import integrate, integrate_rows
from turbopi.models.pi0.kv_cache import KVCache
from turbopi.models.pi0.layers import apply_rope, merge_heads, rms_normalize, rope_tables, split_heads
from turbopi.models.pi0.vision import VisionTower, normalize_images
from turbopi.models.smolvla.config import ROPE_BASE, ElementType, SmolVLAConfig
from turbopi.models.smolvla.positions import position_rows
from turbopi.support.errors import ObservationError

# Names of what a trace records, rows of one batch: image_embeddings [C * B, T, D], prefix [B, S, D], prefix_pad_mask,
# prefix_att_mask bool[B, S], positions int[B, S], kv_k, kv_v [L, B, S, G, K], suffix_first, expert_out [B, A, D],
# x_t [N + 1, B, A, action_dim], v_t [N, B, A, action_dim], actions [B, A, action_dim]
Trace = dict[str, Tensor]
Attend = Callable[[Tensor, Tensor, Tensor, Tensor], Tensor]


@dataclass(frozen=True)
class EmbeddedPrefix:
    """An observation as it enters the text layers.

    embs   [B, S, D]
    valid  bool[B, S]
    block  bool[B, S]  where a new attention block begins: a place sees its own block and those before it
    """

    embs: Tensor
    valid: Tensor
    block: Tensor


class RMSNorm(nn.Module):
    """weight * (x / rms(x)): float32 inside, x's dtype before the weight."""

    def __init__(self, width: int, eps: float) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.empty(width))
        self.eps = eps

    def forward(self, x: Tensor) -> Tensor:
        return self.weight * rms_normalize(x, self.eps).to(x.dtype)


class SwiGLU(nn.Module):
    def __init__(self, width: int, mlp_dim: int) -> None:
        super().__init__()
        self.gate_proj = nn.Linear(width, mlp_dim, bias=False)
        self.up_proj = nn.Linear(width, mlp_dim, bias=False)
        self.down_proj = nn.Linear(mlp_dim, width, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        x = x.to(self.gate_proj.weight.dtype)
        return self.down_proj(F.silu(self.gate_proj(x)) * self.up_proj(x))


class Projections(nn.Module):
    """An attention's four matrices. key_width: of what keys and values are made of."""

    def __init__(self, width: int, key_width: int, config: SmolVLAConfig) -> None:
        super().__init__()
        text = config.text
        heads, kv_heads = text.num_heads * text.head_dim, text.num_kv_heads * text.head_dim
        self.q_proj = nn.Linear(width, heads, bias=False)
        self.k_proj = nn.Linear(key_width, kv_heads, bias=False)
        self.v_proj = nn.Linear(key_width, kv_heads, bias=False)
        self.o_proj = nn.Linear(heads, width, bias=False)


class Layer(nn.Module):
    """A layer of SmolLM2, of the VLM's width or the expert's."""

    def __init__(self, width: int, mlp_dim: int, key_width: int, config: SmolVLAConfig) -> None:
        super().__init__()
        self.head_dim = config.text.head_dim
        self.input_layernorm = RMSNorm(width, config.text.rms_norm_eps)
        self.self_attn = Projections(width, key_width, config)
        self.post_attention_layernorm = RMSNorm(width, config.text.rms_norm_eps)
        self.mlp = SwiGLU(width, mlp_dim)

    def project(self, projection: nn.Linear, x: Tensor) -> Tensor:
        """[B, S, D] -> [B, heads, S, K]"""
        return split_heads(projection(x.to(projection.weight.dtype)), self.head_dim)

    def finish(self, x: Tensor, attended: Tensor) -> Tensor:
        """The output projection, the MLP and both residuals of stream x [B, S, D] and attention's [B, H, S, K]."""
        o_proj = self.self_attn.o_proj
        out = o_proj(merge_heads(attended).to(o_proj.weight.dtype))
        out += x  # in place: the sum has the projection's dtype
        mlp = self.mlp(self.post_attention_layernorm(out))
        mlp += out
        return mlp


class Vision(VisionTower):
    """SigLIP for patch grids of any size: float32[N, h, w, 3] in [-1, 1] -> [N, patches, W], in the weights' dtype.

    element_type  LeRobot's of this tower: positions are rounded in it. Pixels beside whole patches aren't read.
    """

    def __init__(self, config: VisionConfig, element_type: ElementType = "float32") -> None:
        super().__init__(config)
        self.element_type = element_type
        for layer in self.layers:
            layer.self_attn.attend = vision_attention  # type: ignore[union-attr]

    def forward(self, images: Tensor) -> Tensor:
        x = self.embed_patches(normalize_images(images).to(self.patch_embedding.weight.dtype))
        for layer in self.layers:
            x = layer(x)
        return self.post_layernorm(x)

    def embed_patches(self, images: Tensor) -> Tensor:
        n, p = images.shape[0], self.config.patch_size
        rows, columns = images.shape[1] // p, images.shape[2] // p
        images = images[:, : rows * p, : columns * p]
        patches = images.reshape(n, rows, p, columns, p, 3).permute(0, 1, 3, 5, 2, 4).flatten(3).flatten(1, 2)
        x = F.linear(patches, self.patch_embedding.weight.flatten(1), self.patch_embedding.bias)
        return x + self.positions(rows, columns)

    def positions(self, rows: int, columns: int) -> Tensor:
        """The position table at a grid of patches, [rows * columns, W]."""
        table, device = self.config.image_size // self.config.patch_size, self.position_embedding.weight.device
        row, column = (position_rows(count, table, self.element_type, device) for count in (rows, columns))
        return self.position_embedding((row[:, None] * table + column).flatten())


class Text(nn.Module):
    """SmolLM2's embedding and the layers that SmolVLA uses; their keys and values are all that is kept."""

    layers: Sequence[Layer]

    def __init__(self, config: SmolVLAConfig) -> None:
        super().__init__()
        text = config.text
        self.embed_tokens = nn.Embedding.from_pretrained(torch.empty(text.vocab_size, text.width))  # type: ignore[no-untyped-call]
        layers = (Layer(text.width, text.mlp_dim, text.width, config) for _ in range(text.depth))
        self.layers = nn.ModuleList(layers)  # type: ignore[assignment]


class Expert(nn.Module):
    layers: Sequence[Layer]

    def __init__(self, config: SmolVLAConfig) -> None:
        super().__init__()
        text, width = config.text, config.expert_width
        kv_width = text.num_kv_heads * text.head_dim
        layers = (
            Layer(width, config.expert_mlp, width if config.is_self_layer(at) else kv_width, config)
            for at in config.expert_at
        )
        self.layers = nn.ModuleList(layers)  # type: ignore[assignment]
        self.norm = RMSNorm(width, text.rms_norm_eps)


class SmolVLAModel(nn.Module):
    """Build it on the meta device and load a checkpoint's tensors into it, in `parameter_dtype`s.

    attend  of text layers and expert, `attention`; a backend may take a faster one
    """

    def __init__(self, config: SmolVLAConfig) -> None:
        super().__init__()
        self.config = config
        self.attend: Attend = attention
        text, width = config.text, config.expert_width
        self.vision = Vision(config.vision, config.element_types.vision)
        self.projector = nn.Linear(config.vision.width * config.scale_factor**2, text.width, bias=False)
        self.vlm = Text(config)
        self.expert = Expert(config)
        self.state_proj = nn.Linear(config.state_dim, text.width)
        self.action_in_proj = nn.Linear(config.action_dim, width)
        self.action_out_proj = nn.Linear(width, config.action_dim)
        self.action_time_mlp_in = nn.Linear(2 * width, width)
        self.action_time_mlp_out = nn.Linear(width, width)

    @classmethod
    def from_state(cls, config: SmolVLAConfig, state: dict[str, Tensor]) -> "SmolVLAModel":
        """The model around tensors of canonical names (names.py) that are already on their device; none is copied."""
        with torch.device("meta"):
            model = cls(config)
        model.load_state_dict(state, strict=True, assign=True)
        return model.eval().requires_grad_(False)

    @property
    def device(self) -> torch.device:
        return self.action_in_proj.weight.device

    # -- the two halves ----------------------------------------------------------------------------------------------

    @torch.no_grad()
    @exact_float32()
    def sample(
        self,
        observation: Observation,
        noise: Tensor,
        num_steps: int,
        *,
        compact: bool = True,
        conditioning: Conditionings = None,
        trace: Trace | None = None,
    ) -> Tensor:
        """Actions float32[B, A, action_dim], normalised, from noise of that shape: deterministic for given noise."""
        cache = self.prefix(observation, compact=compact, trace=trace)
        return self.denoise(cache, noise, num_steps, conditioning=conditioning, trace=trace)

    @torch.no_grad()
    @exact_float32()
    def prefix(self, observation: Observation, *, compact: bool = True, trace: Trace | None = None) -> KVCache:
        """Keys (rotated) and values of images, prompt and state, through all text layers.

        compact=True leaves out cameras and places of the prompt that no row needs; both give the same actions.

        Raises ObservationError if a row has no camera.
        """
        return self.keys_values(self.embed(observation, compact=compact, trace=trace), trace=trace)

    @torch.no_grad()
    @exact_float32()
    def denoise(
        self,
        cache: KVCache,
        noise: Tensor,
        num_steps: int,
        *,
        conditioning: Conditionings = None,
        trace: Trace | None = None,
    ) -> Tensor:
        """Integrate from noise float32[B, A, action_dim] to actions of the same shape, as `Pi0Model.denoise`."""
        if isinstance(conditioning, Sequence):

            def one_row(row: int, one: Conditioning, its: Trace) -> Tensor:
                return self.denoise(cache.row(row), noise[row : row + 1], num_steps, conditioning=one, trace=its)

            return integrate_rows(one_row, conditioning, noise.shape[0], trace)
        crossed = self.cross_keys_values(cache)

        def velocity(x: Tensor, time: Tensor, first: bool) -> tuple[Tensor, Tensor]:
            return self.velocity(x, time, cache, crossed, trace if first else None)

        done = integrate(
            velocity,
            lambda times: self.embed_times(times).to(noise.device),
            noise,
            num_steps,
            conditioning,
            grid=self.config.time_grid,
            keep=trace is not None,
        )
        if trace is not None:
            trace["x_t"] = torch.stack([x for x, _, _ in done.evaluations] + [done.actions])
            trace["v_t"] = torch.stack([v for _, _, v in done.evaluations])
            trace["actions"] = done.actions
        return done.actions

    # -- their parts --------------------------------------------------------------------------------------------------

    @torch.no_grad()
    @exact_float32()
    def embed(self, observation: Observation, *, compact: bool = True, trace: Trace | None = None) -> EmbeddedPrefix:
        """Images, prompt and state to the embeddings that enter the text layers (the vision tower is most of it)."""
        embedded = self.embed_prefix(self.compacted(observation) if compact else observation, trace)
        if trace is not None:
            trace["prefix"], trace["prefix_pad_mask"] = embedded.embs, embedded.valid
            trace["prefix_att_mask"] = embedded.block
        return embedded

    @torch.no_grad()
    @exact_float32()
    def keys_values(self, embedded: EmbeddedPrefix, *, trace: Trace | None = None) -> KVCache:
        """Run the text layers over embedded places and keep every layer's keys and values."""
        k, v, positions = self.encode_prefix(embedded)
        if trace is not None:
            trace |= {"positions": positions, "kv_k": k.transpose(2, 3), "kv_v": v.transpose(2, 3)}
        return self.cache_of(embedded, k, v)

    @staticmethod
    def cache_of(embedded: EmbeddedPrefix, k: Tensor, v: Tensor) -> KVCache:
        return KVCache(k, v, embedded.valid, embedded.valid.sum(1), embedded.embs[:, :0].float())

    def encode_prefix(self, embedded: EmbeddedPrefix) -> tuple[Tensor, Tensor, Tensor]:
        """K (rotated), V [layer, B, G, S, K], and positions int[B, S]."""
        x, valid = embedded.embs, embedded.valid
        order = embedded.block.long().cumsum(1)
        sees = order[:, None, :] <= order[:, :, None]  # [B, query, key]
        mask = (sees & valid[:, None, :] & valid[:, :, None])[:, None]
        positions = valid.long().cumsum(1) - 1
        rope = rope_tables(positions, self.config.text.head_dim, ROPE_BASE)
        keys, values = [], []
        for number, layer in enumerate(self.vlm.layers):
            normed = layer.input_layernorm(x)
            keys.append(apply_rope(layer.project(layer.self_attn.k_proj, normed), *rope))
            values.append(layer.project(layer.self_attn.v_proj, normed))
            if number + 1 < len(self.vlm.layers):  # the last one's actual output is read by nobody
                q = apply_rope(layer.project(layer.self_attn.q_proj, normed), *rope)
                x = layer.finish(x, self.attend(q, keys[-1], values[-1], mask))
        return torch.stack(keys), torch.stack(values), positions

    def compacted(self, observation: Observation) -> Observation:
        """Without cameras and places of the prompt that no row needs; reading the masks waits for the device.

        A masked place takes no position and nothing attends to it, so leaving it out is exact.

        Raises ObservationError if a row has no camera.
        """
        if not bool(observation.image_mask.any(1).all()):
            raise ObservationError("SmolVLA needs an image of one camera at least, and an observation has none")
        cameras = self._with_tokens(observation).any(0).nonzero().squeeze(1)
        places = observation.token_mask.any(0).nonzero().squeeze(1)
        return Observation(
            observation.images[:, cameras],
            observation.image_mask[:, cameras],
            observation.tokens[:, places],
            observation.token_mask[:, places],
            observation.state,
        )

    def _with_tokens(self, observation: Observation) -> Tensor:
        """bool[B, C], cameras whose images have their tokens around them, if the model has such tokens: those that are
        there, and `empty_cameras` of the others, the last ones.
        """
        there = observation.image_mask
        others_from_here = (~there).flip(1).cumsum(1).flip(1)
        return there | (others_from_here <= self.config.empty_cameras)

    def embed_images(self, images: Tensor) -> Tensor:
        """(uint8 | float32 in [-1, 1]) [N, h, w, 3] -> [N, T, D]: SigLIP, pixel shuffle and connector, unscaled."""
        rows = images.shape[1] // self.config.vision.patch_size
        return self.projector(pixel_shuffle(self.vision(images), rows, self.config.scale_factor))

    def embed_prefix(
        self, observation: Observation, trace: Trace | None = None, *, embedded: Tensor | None = None
    ) -> EmbeddedPrefix:
        """embedded  [C * B, T, D], camera by camera: what `embed_images` made of the images, if that is done"""
        batch, cameras = observation.image_mask.shape
        parts: list[Tensor] = []
        valid: list[Tensor] = []
        everywhere, around = observation.token_mask.new_ones, self._with_tokens(observation)
        if embedded is None:
            embedded = self.embed_images(observation.images.transpose(0, 1).flatten(0, 1))
        if trace is not None:
            trace["image_embeddings"] = embedded
        for camera, its in enumerate(embedded.reshape(cameras, batch, *embedded.shape[1:])):
            scale = torch.tensor(self.config.text.width**0.5, dtype=its.dtype, device=its.device)
            for ids, images in ((self.config.image_start, its * scale), (self.config.image_end, None)):
                if ids:
                    special = torch.stack([self.vlm.embed_tokens.weight[one] for one in ids])
                    parts.append(special.expand(batch, -1, -1))
                    valid.append(around[:, camera, None].expand(-1, len(ids)))
                if images is not None:
                    parts.append(images)
                    valid.append(observation.image_mask[:, camera, None].expand(-1, images.shape[1]))
        parts.append(self.vlm.embed_tokens(observation.tokens) * math.sqrt(self.config.text.width))
        valid.append(observation.token_mask)
        parts.append(self.state_proj(observation.state)[:, None])
        valid.append(everywhere(batch, 1))
        x, mask = torch.cat(parts, dim=1), torch.cat(valid, dim=1)
        block = torch.zeros_like(mask)
        block[:, -1] = True
        if (missing := self.config.min_prefix - x.shape[1]) > 0:
            x, mask, block = F.pad(x, (0, 0, 0, missing)), F.pad(mask, (0, missing)), F.pad(block, (0, missing))
        return EmbeddedPrefix(x, mask, block)

    def cross_keys_values(self, cache: KVCache) -> list[tuple[Tensor, Tensor] | None]:
        """What each layer of the expert attends to across, the same at every step; None: a self layer.

        Its keys are made of the cached keys, which are rotated already, and aren't rotated again.
        """
        crossed: list[tuple[Tensor, Tensor] | None] = []
        for at, layer in zip(self.config.expert_at, self.expert.layers, strict=True):
            if self.config.is_self_layer(at):
                crossed.append(None)
            else:
                attention = layer.self_attn
                k = layer.project(attention.k_proj, merge_heads(cache.k[at]))
                crossed.append((k, layer.project(attention.v_proj, merge_heads(cache.v[at]))))
        return crossed

    def velocity(
        self,
        x_t: Tensor,
        time: Tensor,
        cache: KVCache,
        crossed: Sequence[tuple[Tensor, Tensor] | None],
        trace: Trace | None = None,
    ) -> tuple[Tensor, Tensor]:
        """One evaluation of the expert -> (its output float32[B, A, D], v_t float32[B, A, action_dim]).

        time  float32[1, D], or [1, A, D] by action: `embed_times`
        """
        config, horizon = self.config, x_t.shape[1]
        x = self.embed_suffix(x_t, time)
        if trace is not None:
            trace["suffix_first"] = x
        own = torch.arange(horizon, device=x.device)[None].expand(x.shape[0], -1)  # actions count from 0 across
        behind = own + cache.lengths[:, None]
        across, within = (rope_tables(positions, config.text.head_dim, ROPE_BASE) for positions in (own, behind))
        causal = own[:, None, :] <= own[:, :, None]
        assert cache.mask is not None
        prefix_mask = cache.mask[:, None, :].expand(-1, horizon, -1)
        self_mask = torch.cat((prefix_mask, causal), dim=2)[:, None]
        for at, layer, other in zip(config.expert_at, self.expert.layers, crossed, strict=True):
            normed = layer.input_layernorm(x)
            q = layer.project(layer.self_attn.q_proj, normed)
            if other is not None:
                attended = self.attend(apply_rope(q, *across), *other, prefix_mask[:, None])
            else:
                k = apply_rope(layer.project(layer.self_attn.k_proj, normed), *within)
                v = layer.project(layer.self_attn.v_proj, normed)
                k, v = torch.cat((cache.k[at], k), dim=2), torch.cat((cache.v[at], v), dim=2)
                attended = self.attend(apply_rope(q, *within), k, v, self_mask)
            x = layer.finish(x, attended)
        out = self.expert.norm(x).float()
        if trace is not None:
            trace["expert_out"] = out
        return out, self.action_out_proj(out)

    def embed_times(self, times: np.ndarray) -> Tensor:
        """float32[U] -> float32[U, D]"""
        return time_embedding(times, self.config.expert_width, self.config.min_period, self.config.max_period)

    def embed_suffix(self, x_t: Tensor, time: Tensor) -> Tensor:
        """Actions mixed with the time -> float32 [B, A, D]"""
        actions = self.action_in_proj(x_t)
        mixed = torch.cat((actions, time.to(actions).expand_as(actions)), dim=-1)
        return self.action_time_mlp_out(F.silu(self.action_time_mlp_in(mixed)))


def pixel_shuffle(x: Tensor, side: int, factor: int) -> Tensor:
    """[N, side², D] -> [N, side²/factor², factor² D]: a place holds factor x factor patches, by row, then channels."""
    n, _, width = x.shape
    small = side // factor
    x = x.reshape(n, small, factor, small, factor, width).permute(0, 1, 3, 2, 4, 5)
    return x.reshape(n, small * small, factor * factor * width)


def vision_attention(q: Tensor, k: Tensor, v: Tensor) -> Tensor:
    """On CPUs PyTorch's kernel, as in LeRobot: it knows no TF32, and 1,024 patches take a third less of the call."""
    return F.scaled_dot_product_attention(q, k, v) if q.device.type == "cpu" else layers.attention(q, k, v)


def attention(q_BHSK: Tensor, k_BGTK: Tensor, v_BGTK: Tensor, mask: Tensor) -> Tensor:
    """softmax(q kᵀ / √K) v -> [B, H, S, K]; scores in float32, probabilities in the values' dtype.

    mask  bool [B, 1, S, T], True where attended. A row that may see nothing gets the mean of all values, as in
          LeRobot; such rows are of padding, which nobody reads.
    """
    groups = q_BHSK.shape[1] // k_BGTK.shape[1]
    k, v = (x.repeat_interleave(groups, dim=1) for x in (k_BGTK, v_BGTK))
    scores = q_BHSK.float() @ k.float().transpose(-1, -2) * q_BHSK.shape[-1] ** -0.5
    probabilities = scores.masked_fill(~mask, torch.finfo(torch.float32).min).softmax(-1)
    return probabilities.to(v.dtype) @ v
