"""Training's view of the model: prefix and suffix in one pass, with gradients, on the project's own modules.

`turbopi.models.pi0.reference` computes an observation's keys and values first and the velocity at one time after that,
without gradients. Here each row of a batch has its own time, and a layer of the language model and the layer of the
action expert beside it run together. A test holds both against each other.

Simulated delays, for real-time execution (trained RTC, arXiv 2512.05964): a row with the delay d has its first d
actions clean and at time 0, as they are when the robot carries them out while it waits for the others; the loss is on
the others. A row with delay 0 is an ordinary one.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from turbopi.config import ModelConfig
from turbopi.models.pi0.denoise import MAX_PERIOD, MIN_PERIOD
from turbopi.models.pi0.gemma import Layer
from turbopi.models.pi0.layers import gated_residual, rms_normalize, rope_tables
from turbopi.models.pi0.prefix import embed_prompt
from turbopi.models.pi0.reference import Pi0Model
from turbopi.models.pi0.vision import EncoderLayer

Rope = tuple[Tensor, Tensor]


@dataclass
class Condition:
    """What adaRMS is told of time: of each row's float32[N, E], and of time 0 [1, E] where held, bool[N, H]."""

    own: Tensor
    zero: Tensor | None = None
    held: Tensor | None = None


def modulated(norm: Any, y: Tensor, cond: Condition) -> tuple[Tensor, Tensor]:
    """An `AdaRMSNorm` of tokens y [N, H, E] under their times: normalised y, and the residual's gate."""
    modulation = norm.dense(cond.own)[:, None]
    if cond.zero is not None and cond.held is not None:
        modulation = torch.where(cond.held[..., None], norm.dense(cond.zero)[:, None], modulation)
    scale, shift, gate = modulation.chunk(3, dim=-1)
    return (rms_normalize(y, norm.eps) * (1 + scale) + shift).to(y.dtype), gate.to(y.dtype)


def vision_block(block: EncoderLayer, x: Tensor) -> Tensor:
    return block(x)


def joint_layer(
    vlm: Layer,
    expert: Layer,
    x: Tensor,
    y: Tensor,
    cond: Condition,
    ropes: tuple[Rope, Rope],
    masks: tuple[Tensor, Tensor],
) -> tuple[Tensor, Tensor]:
    """One layer: prefix x [B, S, D] attends to itself, suffixes y [B * R, H, E] to themselves and their prefix."""
    normed, gate = vlm.input_layernorm(x)
    k, v = vlm.keys_values(normed, ropes[0])
    y = _suffix_layer(expert, y, cond, k, v, ropes[1], masks[1])
    x = vlm.feed_forward(gated_residual(x, vlm.attend(normed, ropes[0], k, v, masks[0]), gate))
    return x, y


def last_layer(
    vlm: Layer,
    expert: Layer,
    x: Tensor,
    y: Tensor,
    cond: Condition,
    ropes: tuple[Rope, Rope],
    masks: tuple[Tensor, Tensor],
) -> Tensor:
    """The last layer's prefix gives keys and values only."""
    normed, _ = vlm.input_layernorm(x)
    k, v = vlm.keys_values(normed, ropes[0])
    return _suffix_layer(expert, y, cond, k, v, ropes[1], masks[1])


def _suffix_layer(expert: Layer, y: Tensor, cond: Condition, k: Tensor, v: Tensor, rope: Rope, mask: Tensor) -> Tensor:
    normed, gate = modulated(expert.input_layernorm, y, cond)
    own_k, own_v = expert.keys_values(normed, rope)
    repeats = len(y) // len(k)
    k = torch.cat((k.repeat_interleave(repeats, 0), own_k.to(k.dtype)), dim=2)
    v = torch.cat((v.repeat_interleave(repeats, 0), own_v.to(v.dtype)), dim=2)
    y = gated_residual(y, expert.attend(normed, rope, k, v, mask), gate)
    normed, gate = modulated(expert.post_attention_layernorm, y, cond)
    return gated_residual(y, expert.mlp(normed), gate)


@dataclass
class Regions:
    """The repeated parts of the network; compiled one by one, as each is compiled once for all of its layers."""

    vision_block: Callable[..., Tensor] = vision_block
    joint_layer: Callable[..., tuple[Tensor, Tensor]] = joint_layer
    last_layer: Callable[..., Tensor] = last_layer

    @classmethod
    def compiled(cls, **options: Any) -> "Regions":
        compiled: list[Any] = [torch.compile(part, **options) for part in (vision_block, joint_layer, last_layer)]
        return cls(*compiled)


def velocity(
    model: Pi0Model,
    images: Tensor,
    tokens: Tensor,
    token_mask: Tensor,
    x_t: Tensor,
    t: Tensor,
    regions: Regions | None = None,
    held: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """The predicted velocity float32[B * R, H, action_dim], and the prefix's last hidden states [B, S, D].

    A prefix is 50 times as long as a suffix, so each observation is used for R draws of noise and time at once.

    images      (uint8|float32)[B, C, 224, 224, 3]: only cameras that are there
    tokens      int64[B, P], token_mask bool[B, P]
    x_t         float32[B * R, H, action_dim]; an observation's R rows are neighbours
    t           float32[B * R] in (0, 1]
    held        bool[B * R, H]: actions that are clean, and at time 0; what is predicted of them means nothing
    """
    parts, config = regions or Regions(), model.config
    x = torch.cat((_embed_images(model, images, parts), embed_prompt(model.vlm, tokens)), dim=1)
    cameras = token_mask.new_ones(len(x), x.shape[1] - tokens.shape[1])
    valid = torch.cat((cameras, token_mask), dim=1)
    repeated = valid.repeat_interleave(len(x_t) // len(x), 0)
    ropes = _ropes(valid, repeated, x_t.shape[1], config)
    suffix = valid.new_ones(len(x_t), x_t.shape[1])
    masks = valid[:, None, None], torch.cat((repeated, suffix), dim=1)[:, None, None]
    with torch.autocast(x.device.type, enabled=False):
        cond = _condition(model, t, held)
        y = model.embed_suffix(x_t, x_t, cond.own)
    pairs = list(zip(model.vlm.layers, model.expert.layers, strict=True))
    for vlm, expert in pairs[:-1]:
        x, y = parts.joint_layer(vlm, expert, x, y, cond, ropes, masks)
    y = parts.last_layer(*pairs[-1], x, y, cond, ropes, masks)
    with torch.autocast(x.device.type, enabled=False):
        return model.action_out_proj(modulated(model.expert.norm, y.float(), cond)[0]), x


def suffix_velocity(model: Pi0Model, k: Tensor, v: Tensor, x_t: Tensor, t: Tensor) -> Tensor:
    """The predicted velocity float32[B, H, action_dim] of Pi0.5, for a prefix whose keys and values are there.

    k, v   float32[layers, B, heads, S, K], all of them valid
    x_t    float32[B, H, action_dim]
    t      float32[B] in (0, 1]
    """
    cond, config = _condition(model, t, None), model.config
    positions = torch.arange(x_t.shape[1], device=x_t.device)[None] + k.shape[3]
    rope = rope_tables(positions, config.vlm.head_dim, config.rope_base)
    mask = torch.ones(1, 1, 1, k.shape[3] + x_t.shape[1], dtype=torch.bool, device=x_t.device)
    y = model.embed_suffix(x_t, x_t, cond.own[:, None])
    for layer, keys, values in zip(model.expert.layers, k, v, strict=True):
        y = _suffix_layer(layer, y, cond, keys, values, rope, mask)
    return model.action_out_proj(modulated(model.expert.norm, y, cond)[0])


def _condition(model: Pi0Model, t: Tensor, held: Tensor | None) -> Condition:
    own = model.time_condition(time_embedding(t, model.config.expert.width))
    if held is None:
        return Condition(own)
    return Condition(own, model.time_condition(time_embedding(t.new_zeros(1), model.config.expert.width)), held)


def _embed_images(model: Pi0Model, images: Tensor, parts: Regions) -> Tensor:
    b, c = images.shape[:2]
    flat = images.flatten(0, 1)
    scaled = flat.float() / 255 * 2 - 1 if flat.dtype == torch.uint8 else flat
    x = model.vision.embed_patches(scaled)
    for block in model.vision.layers:
        x = parts.vision_block(block, x)
    return model.projector(model.vision.post_layernorm(x)).unflatten(0, (b, c)).flatten(1, 2)


def _ropes(valid: Tensor, repeated: Tensor, horizon: int, config: ModelConfig) -> tuple[Rope, Rope]:
    positions = valid.cumsum(1) - 1
    after = repeated.sum(1, keepdim=True) + torch.arange(horizon, device=valid.device)
    prefix, suffix = (rope_tables(at, config.vlm.head_dim, config.rope_base) for at in (positions, after))
    return prefix, suffix


def time_embedding(t: Tensor, width: int) -> Tensor:
    """As `turbopi.models.pi0.denoise.time_embedding`, on t's device: float32[B, width]."""
    fraction = torch.linspace(0.0, 1.0, width // 2, dtype=torch.float64, device=t.device)
    period = MIN_PERIOD * (MAX_PERIOD / MIN_PERIOD) ** fraction
    angle = t.double()[:, None] * (2 * torch.pi / period)
    return torch.cat((angle.sin(), angle.cos()), dim=-1).float()


class Guide(nn.Module):
    """What the prefix should know: where hand, bowl and plate are, and what the expert is at. Not shipped.

    Reads the prefix's last hidden states: the prompt's tokens, averaged, and the cameras' tokens, weighted by an
    attention of its own.
    """

    def __init__(self, width: int, num_values: int, num_phases: int, queries: int = 4) -> None:
        super().__init__()
        self.num_values = num_values
        self.query = nn.Linear(width, queries)
        hidden = 256
        self.body = nn.Sequential(
            nn.LayerNorm(width * (1 + queries)),
            nn.Linear(width * (1 + queries), hidden),
            nn.GELU(),
            nn.Linear(hidden, num_values + num_phases),
        )

    def forward(self, x: Tensor, token_mask: Tensor) -> tuple[Tensor, Tensor]:
        """Prefix [B, S, D] -> values float32[B, V], logits float32[B, phases]"""
        p = token_mask.shape[1]
        images, text = x[:, :-p].float(), x[:, -p:].float()
        weights = token_mask[..., None].float()
        prompt = (text * weights).sum(1) / weights.sum(1)
        seen = torch.einsum("bsq,bsd->bqd", self.query(images).float().softmax(1), images)
        out = self.body(torch.cat((prompt, seen.flatten(1)), dim=1)).float()
        return out[:, : self.num_values], out[:, self.num_values :]


def flow_loss(predicted: Tensor, target: Tensor, weights: Tensor, held: Tensor | None = None) -> Tensor:
    """Squared error of velocities [N, H, action_dim], weighted by dimension float32[action_dim] and averaged.

    held   bool[N, H]: actions that are given, not predicted; they don't count
    """
    errors = ((predicted - target).square() * weights).sum(-1) / weights.sum()
    return errors.mean() if held is None else errors[~held].mean()


def guide_loss(values: Tensor, logits: Tensor, wanted: Tensor, phases: Tensor) -> Tensor:
    return F.smooth_l1_loss(values, wanted, beta=0.1) + 0.1 * F.cross_entropy(logits, phases)


def draw_times(batch: int, device: torch.device | str, generator: torch.Generator | None = None) -> Tensor:
    """t ~ Beta(1.5, 1), scaled to [0.001, 1], as Pi0's training: float32[batch]."""
    uniform = torch.rand(batch, device=device, generator=generator)
    return uniform.pow(1 / 1.5) * 0.999 + 0.001  # the distribution function of Beta(1.5, 1) is u^1.5


def draw_delays(leads: Tensor, most: int, generator: torch.Generator | None = None) -> Tensor:
    """Of each row any delay from its lead, int64[batch], to `most`, each as often as any other: int64[batch]."""
    uniform = torch.rand(leads.shape, device=leads.device, generator=generator)
    return leads + (uniform * (most + 1 - leads)).long()


def held_actions(delays: Tensor, horizon: int) -> Tensor:
    """bool[N, H]: the actions that are carried out before the delay is over."""
    return torch.arange(horizon, device=delays.device) < delays[:, None]


def mixed(actions: Tensor, noise: Tensor, t: Tensor, held: Tensor | None = None) -> Tensor:
    """x at time t float32[N] of the way from actions to noise [N, H, action_dim]; the actions where they are held."""
    x = t[:, None, None] * noise + (1 - t[:, None, None]) * actions
    return x if held is None else torch.where(held[..., None], actions, x)
