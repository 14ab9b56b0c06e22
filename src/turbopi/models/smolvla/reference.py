"""The reference: SmolVLA in plain PyTorch, exact to LeRobot. Every backend is judged against it.

    prefix(inputs) -> PrefixCache              SigLIP, connector and the text layers, once an observation
    denoise(cache, noise, N) -> actions        the action expert, N times
    sample(inputs, noise, N)                   both

What differs from Pi0: each layer of the expert is a self layer (prefix and suffix, causal among the actions) or a
cross layer (the prefix alone, through matrices of its own); the state is the prefix's last token; RoPE's base is
10,000; the text layers' last one gives keys and values alone.

Shapes: B batch, C cameras, S places of the prefix, A actions of a chunk, D width, H query heads, G key heads, K
head_dim. Dtypes: each matrix casts its input to its own dtype and a residual is added in place onto the projection's
result, so after the first output projection the stream has the weights' dtype, whatever came in (as in LeRobot).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from turbopi.models.pi0.conditioning import Conditioning
from turbopi.models.pi0.exact import exact_float32
from turbopi.models.pi0.layers import apply_rope, merge_heads, rms_normalize, rope_tables, split_heads
from turbopi.models.pi0.vision import EncoderLayer
from turbopi.models.smolvla.config import ROPE_BASE, SmolVLAConfig
from turbopi.support.errors import ObservationError

# Names of what a trace records, rows of one batch: image_embeddings [C * B, T, D], prefix [B, S, D], prefix_pad_mask,
# prefix_att_mask bool[B, S], positions int[B, S], keys_i, values_i [B, S, G, K], suffix_first, expert_out [B, A, D],
# v_first, v_last [B, A, action_dim]
Trace = dict[str, Tensor]


@dataclass(frozen=True)
class SmolVLAInputs:
    """What the network takes of B observations.

    images      float32[B, C, 3, size, size], [-1, 1]
    image_mask  bool[B, C]
    tokens      int64[B, T], token_mask bool[B, T]
    state       float32[B, state_dim], normalised, zeros past the robot's width
    """

    images: Tensor
    image_mask: Tensor
    tokens: Tensor
    token_mask: Tensor
    state: Tensor


@dataclass(frozen=True)
class PrefixCache:
    """Keys (rotated) and values [B, G, S, K] of each text layer, and which places are valid, bool[B, S]."""

    keys: Sequence[Tensor]
    values: Sequence[Tensor]
    valid: Tensor


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


class SmolVLAModel(nn.Module):
    """Build it on the meta device and load a checkpoint's tensors into it, in `parameter_dtype`s."""

    layers: Sequence[Layer]
    expert_layers: Sequence[Layer]

    def __init__(self, config: SmolVLAConfig) -> None:
        super().__init__()
        self.config = config
        text, vision, width = config.text, config.vision, config.expert_width
        self.patch_embedding = nn.Conv2d(3, vision.width, vision.patch_size, vision.patch_size)
        self.position_embedding = nn.Embedding(vision.num_tokens, vision.width)
        self.vision_layers = nn.ModuleList(EncoderLayer(vision) for _ in range(vision.depth))
        self.post_layernorm = nn.LayerNorm(vision.width, eps=vision.layer_norm_eps)
        self.connector = nn.Linear(vision.width * config.scale_factor**2, text.width, bias=False)
        self.embed_tokens = nn.Embedding(text.vocab_size, text.width)
        layers = (Layer(text.width, text.mlp_dim, text.width, config) for _ in range(text.depth))
        self.layers = nn.ModuleList(layers)  # type: ignore[assignment]
        kv_width = text.num_kv_heads * text.head_dim
        experts = (
            Layer(width, config.expert_mlp, width if config.is_self_layer(at) else kv_width, config)
            for at in config.expert_at
        )
        self.expert_layers = nn.ModuleList(experts)  # type: ignore[assignment]
        self.expert_norm = RMSNorm(width, text.rms_norm_eps)
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

    # -- the two halves ----------------------------------------------------------------------------------------------

    @torch.no_grad()
    @exact_float32()
    def sample(
        self,
        inputs: SmolVLAInputs,
        noise: Tensor,
        num_steps: int | None = None,
        *,
        conditioning: Conditioning | None = None,
        trace: Trace | None = None,
    ) -> Tensor:
        """Actions float32[B, A, action_dim], normalised, from noise of that shape: deterministic for given noise."""
        return self.denoise(self.prefix(inputs, trace=trace), noise, num_steps, conditioning=conditioning, trace=trace)

    @torch.no_grad()
    @exact_float32()
    def prefix(self, inputs: SmolVLAInputs, *, trace: Trace | None = None) -> PrefixCache:
        """Keys and values of images, prompt and state, through all text layers."""
        x, valid, block = self.embed_prefix(inputs, trace)
        order = block.long().cumsum(1)
        sees = order[:, None, :] <= order[:, :, None]  # [B, query, key]
        mask = (sees & valid[:, None, :] & valid[:, :, None])[:, None]
        positions = valid.long().cumsum(1) - 1
        rope = rope_tables(positions, self.config.text.head_dim, ROPE_BASE)
        if trace is not None:
            trace |= {"prefix": x, "prefix_pad_mask": valid, "prefix_att_mask": block, "positions": positions}
        keys, values = [], []
        for number, layer in enumerate(self.layers):
            normed = layer.input_layernorm(x)
            keys.append(apply_rope(layer.project(layer.self_attn.k_proj, normed), *rope))
            values.append(layer.project(layer.self_attn.v_proj, normed))
            if trace is not None:
                trace[f"keys_{number}"] = keys[-1].transpose(1, 2)
                trace[f"values_{number}"] = values[-1].transpose(1, 2)
            if number + 1 < len(self.layers):  # the last one's actual output is read by nobody
                q = apply_rope(layer.project(layer.self_attn.q_proj, normed), *rope)
                x = layer.finish(x, attention(q, keys[-1], values[-1], mask))
        return PrefixCache(keys, values, valid)

    @torch.no_grad()
    @exact_float32()
    def denoise(
        self,
        cache: PrefixCache,
        noise: Tensor,
        num_steps: int | None = None,
        *,
        conditioning: Conditioning | None = None,
        trace: Trace | None = None,
    ) -> Tensor:
        """Euler steps from noise float32[B, A, action_dim] at t = 1 to actions at t = 0.

        conditioning  guidance of mode "identity" alone, which is LeRobot's real-time chunking: its pull takes no
                      gradient through the expert. Raises ObservationError for another.
        """
        steps = num_steps or self.config.num_steps
        pull = _identity_pull(conditioning, steps, noise)
        crossed = self.cross_keys_values(cache)
        x, dt = noise, -1.0 / steps
        for step in range(steps):
            t = 1.0 + step * dt
            record = trace if step == 0 else None
            v = self.velocity(x, t, cache, crossed, record)
            if trace is not None:
                trace |= {"v_last": v} | ({"v_first": v} if step == 0 else {})
            if pull is not None:
                target, weights, strength = pull
                v = v - strength[step][:, None] * weights[:, None] * (target - (x - t * v))
            x = x + dt * v
        return x

    # -- their parts --------------------------------------------------------------------------------------------------

    def embed_images(self, images: Tensor) -> Tensor:
        """float32 [N, 3, size, size], [-1, 1] -> [N, T, D]: SigLIP, pixel shuffle and connector, unscaled."""
        config = self.config.vision
        n, p = images.shape[0], config.patch_size
        rows, columns = images.shape[2] // p, images.shape[3] // p
        dtype = self.patch_embedding.weight.dtype
        patches = images.to(dtype).reshape(n, 3, rows, p, columns, p).permute(0, 2, 4, 1, 3, 5).flatten(3).flatten(1, 2)
        x = F.linear(patches, self.patch_embedding.weight.flatten(1), self.patch_embedding.bias)
        table = config.image_size // p
        row = torch.arange(rows, device=x.device) * table // rows
        column = torch.arange(columns, device=x.device) * table // columns
        x = x + self.position_embedding((row[:, None] * table + column).flatten())
        for layer in self.vision_layers:
            x = layer(x)
        return self.connector(pixel_shuffle(self.post_layernorm(x), rows, self.config.scale_factor))

    def embed_prefix(self, inputs: SmolVLAInputs, trace: Trace | None = None) -> tuple[Tensor, Tensor, Tensor]:
        """(embeddings [B, S, D], valid bool[B, S], block bool[B, S]: where a new attention block begins)"""
        batch, cameras = inputs.images.shape[:2]
        parts: list[Tensor] = []
        valid: list[Tensor] = []
        everywhere = inputs.token_mask.new_ones
        for camera in range(cameras):
            embedded = self.embed_images(inputs.images[:, camera])
            if trace is not None:
                before = trace.get("image_embeddings")
                trace["image_embeddings"] = embedded if before is None else torch.cat((before, embedded))
            scale = torch.tensor(self.config.text.width**0.5, dtype=embedded.dtype, device=embedded.device)
            tokens = embedded.shape[1]
            for ids, images in ((self.config.image_start, embedded * scale), (self.config.image_end, None)):
                if ids:
                    special = torch.tensor(ids, device=inputs.tokens.device)
                    parts.append(self.embed_tokens(special).expand(batch, -1, -1))
                    valid.append(everywhere(batch, len(ids)))
                if images is not None:
                    parts.append(images)
                    valid.append(inputs.image_mask[:, camera, None].expand(-1, tokens))
        parts.append(self.embed_tokens(inputs.tokens) * math.sqrt(self.config.text.width))
        valid.append(inputs.token_mask)
        parts.append(self.state_proj(inputs.state)[:, None])
        valid.append(everywhere(batch, 1))
        x, mask = torch.cat(parts, dim=1), torch.cat(valid, dim=1)
        block = torch.zeros_like(mask)
        block[:, -1] = True
        if (missing := self.config.min_prefix - x.shape[1]) > 0:
            x, mask, block = F.pad(x, (0, 0, 0, missing)), F.pad(mask, (0, missing)), F.pad(block, (0, missing))
        return x, mask, block

    def cross_keys_values(self, cache: PrefixCache) -> list[tuple[Tensor, Tensor] | None]:
        """What each layer of the expert attends to across, the same at every step; None: a self layer.

        Its keys are made of the cached keys, which are rotated already, and aren't rotated again.
        """
        crossed: list[tuple[Tensor, Tensor] | None] = []
        for at, layer in zip(self.config.expert_at, self.expert_layers, strict=True):
            if self.config.is_self_layer(at):
                crossed.append(None)
            else:
                attention = layer.self_attn
                k = layer.project(attention.k_proj, merge_heads(cache.keys[at]))
                crossed.append((k, layer.project(attention.v_proj, merge_heads(cache.values[at]))))
        return crossed

    def velocity(
        self,
        x_t: Tensor,
        t: float,
        cache: PrefixCache,
        crossed: Sequence[tuple[Tensor, Tensor] | None],
        trace: Trace | None = None,
    ) -> Tensor:
        """One evaluation of the expert -> v float32[B, A, action_dim] at x_t float32[B, A, action_dim]."""
        config, horizon = self.config, x_t.shape[1]
        x = self.embed_suffix(x_t, t)
        if trace is not None:
            trace["suffix_first"] = x
        own = torch.arange(horizon, device=x.device)[None].expand(x.shape[0], -1)  # actions count from 0 across
        behind = own + cache.valid.sum(1, keepdim=True)
        across, within = (rope_tables(positions, config.text.head_dim, ROPE_BASE) for positions in (own, behind))
        causal = own[:, None, :] <= own[:, :, None]
        prefix_mask = cache.valid[:, None, :].expand(-1, horizon, -1)
        self_mask = torch.cat((prefix_mask, causal), dim=2)[:, None]
        for at, layer, other in zip(config.expert_at, self.expert_layers, crossed, strict=True):
            normed = layer.input_layernorm(x)
            q = layer.project(layer.self_attn.q_proj, normed)
            if other is not None:
                attended = attention(apply_rope(q, *across), *other, prefix_mask[:, None])
            else:
                k = apply_rope(layer.project(layer.self_attn.k_proj, normed), *within)
                v = layer.project(layer.self_attn.v_proj, normed)
                k, v = torch.cat((cache.keys[at], k), dim=2), torch.cat((cache.values[at], v), dim=2)
                attended = attention(apply_rope(q, *within), k, v, self_mask)
            x = layer.finish(x, attended)
        out = self.expert_norm(x).float()
        if trace is not None:
            trace["expert_out"] = out
        return self.action_out_proj(out)

    def embed_suffix(self, x_t: Tensor, t: float) -> Tensor:
        """Actions mixed with the time -> float32 [B, A, D]"""
        actions = self.action_in_proj(x_t)
        time = time_embedding(t, self.config).to(actions)
        mixed = torch.cat((actions, time.expand_as(actions)), dim=-1)
        return self.action_time_mlp_out(F.silu(self.action_time_mlp_in(mixed)))


def _identity_pull(
    conditioning: Conditioning | None, steps: int, noise: Tensor
) -> tuple[Tensor, Tensor, Tensor] | None:
    """Target [A, action_dim], weights [A] and strength [N, A] on the noise's device; None: a plain loop."""
    if conditioning is None or conditioning.form == "plain":
        return None
    guidance = conditioning.guidance
    plain = conditioning.tokens is None and conditioning.held is None and conditioning.integration is None
    if guidance is None or guidance.mode != "identity" or not plain:
        raise ObservationError(
            'SmolVLA joins chunks by guidance of mode "identity" alone, as LeRobot does: not by held actions, times of '
            "single actions, the guidance with a gradient, or other solvers"
        )
    conditioning.check(steps, noise.shape[1], noise.shape[2])
    arrays = (guidance.target, guidance.weights, guidance.strength)
    target, weights, strength = (torch.from_numpy(array).to(noise.device) for array in arrays)
    return target, weights, strength


def time_embedding(t: float, config: SmolVLAConfig) -> Tensor:
    """[sin, cos] of 2 pi t / period, float32 [expert_width]; periods spread by powers, in float64."""
    fraction = torch.linspace(0.0, 1.0, config.expert_width // 2, dtype=torch.float64)
    period = config.min_period * (config.max_period / config.min_period) ** fraction
    angle = torch.tensor(t, dtype=torch.float32).double() * (2 * math.pi / period)
    return torch.cat((angle.sin(), angle.cos())).float()


def pixel_shuffle(x: Tensor, side: int, factor: int) -> Tensor:
    """[N, side², D] -> [N, side²/factor², factor² D]: a place holds factor x factor patches, by row, then channels."""
    n, _, width = x.shape
    small = side // factor
    x = x.reshape(n, small, factor, small, factor, width).permute(0, 1, 3, 2, 4, 5)
    return x.reshape(n, small * small, factor * factor * width)


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
