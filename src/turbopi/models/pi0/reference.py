"""The reference: Pi0.5 and Pi0 in plain PyTorch, exact to openpi. Every backend is judged against it.

    prefix(observation) -> KVCache      SigLIP and the language model, once an observation
    denoise(cache, noise, N) -> actions the action expert, N times
    sample(observation, noise, N)       both

`conditioning` adds what real-time execution needs (conditioning.py). Actions after every single step, for a caller
that streams them, are the trace's x_t: x_t[k] is x after k steps.

Intermediates go into a `trace` dict under the names, and in the layouts, that golden files use; see `Trace`.
Precisions: float32 (the oracle), and bfloat16 as openpi serves it, except that RoPE stays float32 (as in openpi's JAX).
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from turbopi.config import FloatPrecision as FloatPrecision
from turbopi.config import ModelConfig
from turbopi.models.observation import Observation, SeenObservation
from turbopi.models.pi0.conditioning import Conditioning, Conditionings, has_two_prompts, of_rows
from turbopi.models.pi0.denoise import run_expert, suffix_mask, suffix_rope, time_embedding
from turbopi.models.pi0.exact import exact_float32
from turbopi.models.pi0.gemma import Gemma
from turbopi.models.pi0.integrate import Velocity, integrate, integrate_rows
from turbopi.models.pi0.kv_cache import EmbeddedPrefix, KVCache, PrefixLayout
from turbopi.models.pi0.layers import rope_tables
from turbopi.models.pi0.prefix import camera_slots, embed_images, embed_prompt, prefix_keys_values
from turbopi.models.pi0.vision import VisionTower
from turbopi.support.errors import ObservationError

# Names of what a trace records. N steps, B batch, S padded prefix slots, C cameras, H horizon, L layers.
#   prefix_embs [B, S, D]   prefix_pad_mask bool[B, S]   prefix_positions int[B, S]   vision_last_hidden [C, B, 256, W]
#   kv_k, kv_v [L, B, S, G, K]   times [N]   cond [N, B, D]   x_t [N + 1, B, H, 32]   suffix_out [N, B, H, D]
#   v_t [N, B, H, 32]   expert_hidden_step0 [L, B, H (Pi0: H + 1), D]   actions [B, H, 32]
# Conditioned: times [N, B, H]   cond [N, B, H, D], and v_t is the guided one, which was integrated.
Trace = dict[str, Tensor]

_FLOAT32_ALWAYS = (
    "vision.patch_embedding.",
    "vision.position_embedding.",
    "action_",
    "time_mlp_",
    "state_proj.",
    "proprio_history_proj.",
    "vlm.norm.",
    "expert.norm.",
)


class Pi0Model(nn.Module):
    """Pi0.5 or Pi0, by `config.kind`. Build it on the meta device and load a checkpoint's tensors into it."""

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        self.config = config
        width, dim = config.expert.width, config.action_dim
        self.vision = VisionTower(config.vision)
        self.projector = nn.Linear(config.vision.width, config.vlm.width)
        eps, adaptive = config.rms_norm_eps, config.kind == "pi05"
        self.vlm = Gemma(config.vlm, eps=eps, vocab_size=config.vocab_size, adaptive=False)
        self.expert = Gemma(config.expert, eps=eps, vocab_size=None, adaptive=adaptive)
        self.action_in_proj = nn.Linear(dim, width)
        self.action_out_proj = nn.Linear(width, dim)
        if config.kind == "pi05":
            self.time_mlp_in = nn.Linear(width, width)
            self.time_mlp_out = nn.Linear(width, width)
        else:
            self.state_proj = nn.Linear(dim, width)
            self.action_time_mlp_in = nn.Linear(2 * width, width)
            self.action_time_mlp_out = nn.Linear(width, width)
        self.requires_grad_(False)

    @classmethod
    def from_state(cls, config: ModelConfig, state: dict[str, Tensor]) -> "Pi0Model":
        """The model around tensors that are already on their device, in `parameter_dtype`s; they aren't copied."""
        with torch.device("meta"):
            model = cls(config)
        model.load_state_dict(state, strict=True, assign=True)
        return model.eval().requires_grad_(False)

    @property
    def device(self) -> torch.device:
        return self.action_in_proj.weight.device

    @property
    def compute_dtype(self) -> torch.dtype:
        """What activations are made of; a few parameters stay float32 (see parameter_dtype)."""
        return self.projector.weight.dtype

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
        """Actions float32[B, H, action_dim], normalised, from noise of that shape: deterministic for given noise."""
        cache = self.prefix(observation, compact=compact, conditioning=conditioning, trace=trace)
        return self.denoise(cache, noise, num_steps, conditioning=conditioning, trace=trace)

    @torch.no_grad()
    @exact_float32()
    def prefix(
        self,
        observation: Observation,
        *,
        compact: bool = True,
        conditioning: Conditionings = None,
        trace: Trace | None = None,
    ) -> KVCache:
        """Keys and values of an observation: `embed`, then `keys_values`. Of a conditioning the second prompt counts.

        compact=True computes only the slots that some batch row needs (for B = 1: no masked camera and no padding);
        compact=False computes all S slots under a mask. Both give the same actions.

        Raises ObservationError if a row has no valid camera and no valid prompt token.
        """
        embedded = self.embed(observation, compact=compact, conditioning=conditioning, trace=trace)
        return self.keys_values(embedded, trace=trace)

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
        """Integrate from noise float32[B, H, action_dim] to actions of the same shape in `num_steps` Euler steps.

        num_steps     of a conditioning with another solver: evaluations of the action expert
        conditioning  of all rows, or a list with one, or None, for each: then rows are computed one by one. None, and
                      whatever asks for nothing beside openpi's loop, gives its results to the last bit

        Raises ObservationError for a conditioning that doesn't fit.
        """
        if isinstance(conditioning, Sequence):

            def one_row(row: int, one: Conditioning, its: Trace) -> Tensor:
                return self.denoise(cache.row(row), noise[row : row + 1], num_steps, conditioning=one, trace=its)

            return integrate_rows(one_row, conditioning, noise.shape[0], trace)
        config, horizon = self.config, noise.shape[1]
        suffix_len = horizon + (config.kind == "pi0")  # Pi0's state token comes first
        hidden: list[Tensor] = []

        def embed_times(times: np.ndarray) -> Tensor:
            embedded = time_embedding(times, config.expert.width).to(noise.device)  # [U, D]
            return self.time_condition(embedded) if config.kind == "pi05" else embedded

        def velocity_of(cache: KVCache) -> Velocity:
            rope = suffix_rope(cache, suffix_len, config.expert.head_dim, config.rope_base)
            mask = suffix_mask(cache, suffix_len, config.kind == "pi0")

            def velocity(x: Tensor, time: Tensor, first: bool) -> tuple[Tensor, Tensor]:
                record = hidden if trace is not None and first else None
                return self.velocity(x, cache.state, time, cache.k, cache.v, rope, mask, record)

            return velocity

        done = integrate(
            velocity_of(cache),
            embed_times,
            noise,
            num_steps,
            conditioning,
            grid=config.time_grid,
            keep=trace is not None,
            second=None if cache.tagged is None else velocity_of(cache.tagged),
        )
        if trace is not None:
            batch, by_row = noise.shape[0], done.rows
            if conditioning is None:
                trace["times"] = done.times[:, 0, 0].cpu()
            else:
                trace["times"] = done.times[:, None, :, 0].expand(-1, batch, -1).cpu()
            if config.kind == "pi05":
                cond = done.conds[by_row[:, 0]][:, None] if conditioning is None else done.conds[by_row][:, None]
                trace["cond"] = cond.expand(-1, batch, *cond.shape[2:])
            trace["x_t"] = torch.stack([x for x, _, _ in done.evaluations] + [done.actions])
            trace["suffix_out"] = torch.stack([out for _, out, _ in done.evaluations])
            trace["v_t"] = torch.stack([v for _, _, v in done.evaluations])
            if hidden:
                trace["expert_hidden_step0"] = torch.stack([layer.detach() for layer in hidden])
            trace["actions"] = done.actions
        return done.actions

    # -- their parts: each one is a stage that a backend may time, compile or replace ----------------------------------

    @torch.no_grad()
    @exact_float32()
    def embed(
        self,
        observation: Observation,
        *,
        compact: bool = True,
        conditioning: Conditionings = None,
        trace: Trace | None = None,
    ) -> EmbeddedPrefix:
        """Images and prompt to the embeddings that enter the language model (the vision tower is most of it).

        Of a conditioning the second prompt counts, which comes behind the same images.
        """
        per_image, layout = self.config.vision.num_tokens, self._layout(observation, compact=compact)
        cameras = camera_slots(observation, compact=compact)
        seen = observation.seen if isinstance(observation, SeenObservation) else None
        image_embs, hidden = self.embed_cameras(observation, cameras) if seen is None else seen
        if cameras is not None:  # back to their slots, from which the layout selects
            count = observation.image_mask.shape[1]
            slots = (cameras[:, None] * per_image + torch.arange(per_image, device=cameras.device)).flatten()
            image_embs = _scatter(image_embs, 1, slots, count * per_image)
            hidden = _scatter(hidden, 0, cameras, count)
        before_prompt = image_embs, *self.embed_states(observation)

        def with_prompt(tokens: Tensor, layout: PrefixLayout) -> EmbeddedPrefix:
            embs = torch.cat((*before_prompt, embed_prompt(self.vlm, tokens)), dim=1)
            embs = embs if layout.columns is None else embs[:, layout.columns]
            return EmbeddedPrefix(embs, layout, layout.pad_mask.sum(1), observation.state)

        embedded = with_prompt(observation.tokens, layout)
        if trace is not None:
            trace["vision_last_hidden"] = hidden
            trace["prefix_embs"] = layout.to_padded(embedded.embs, 1)
            trace["prefix_pad_mask"] = layout.pad_mask
            trace["prefix_positions"] = layout.positions
        if (tagged := with_second_prompt(observation, conditioning)) is None:
            return embedded
        return replace(embedded, tagged=with_prompt(tagged.tokens, self._layout(tagged, compact=compact)))

    def _layout(self, observation: Observation, *, compact: bool) -> PrefixLayout:
        layout = PrefixLayout.of(observation, self.config.vision.num_tokens, compact=compact)
        if not bool(layout.pad_mask.any(1).all()):
            raise ObservationError("an observation without any valid camera or prompt token has nothing to attend to")
        return layout

    @torch.no_grad()
    @exact_float32()
    def keys_values(self, embedded: EmbeddedPrefix, *, trace: Trace | None = None) -> KVCache:
        """Run the language model over embedded tokens and keep every layer's keys and values."""
        layout = embedded.layout
        k, v = self.encode_prefix(embedded.embs, layout.computed_positions, layout.attended)
        if trace is not None:
            trace["kv_k"] = layout.to_padded(k, 3).transpose(2, 3)
            trace["kv_v"] = layout.to_padded(v, 3).transpose(2, 3)
        tagged = None if embedded.tagged is None else self.keys_values(embedded.tagged)
        return KVCache(k, v, layout.mask, embedded.lengths, embedded.state, tagged)

    def embed_cameras(self, observation: Observation, cameras: Tensor | None) -> tuple[Tensor, Tensor]:
        """`embed_images` of an observation's, of some cameras alone, by their indices."""
        return self.embed_images(observation.images if cameras is None else observation.images[:, cameras])

    def embed_states(self, observation: Observation) -> list[Tensor]:
        """Tokens [B, F, D] between images and prompt: of a policy with proprioceptive memory (memory.py)."""
        return []

    def embed_images(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """Images [B, C, 224, 224, 3] -> (language-model tokens [B, C * 256, D], the tower's output [C, B, 256, W])"""
        return embed_images(self.vision, self.projector, images)

    def encode_prefix(self, embs: Tensor, positions: Tensor, mask: Tensor | None) -> tuple[Tensor, Tensor]:
        """Embeddings [B, S, D] at int positions [B, S] -> K (rotated), V [layer, B, G, S, K]"""
        rope = rope_tables(positions, self.config.vlm.head_dim, self.config.rope_base)
        return prefix_keys_values(self.vlm, embs, rope, mask)

    def velocity(
        self,
        x_t: Tensor,
        state: Tensor,
        time: Tensor,
        cache_k: Tensor,
        cache_v: Tensor,
        rope: tuple[Tensor, Tensor],
        mask: Tensor | None,
        hidden: list[Tensor] | None = None,
    ) -> tuple[Tensor, Tensor]:
        """One evaluation of the action expert -> (its output float32[B, H, D], v_t float32[B, H, action_dim]).

        `time` float32[1, D], or [1, H, D] by action, is the adaRMS condition (Pi0.5) or the time embedding (Pi0).
        """
        adaptive = self.config.kind == "pi05"
        tokens = self.embed_suffix(x_t, state, time)
        out = run_expert(self.expert, tokens, time if adaptive else None, cache_k, cache_v, rope, mask, hidden)
        suffix_out = out[:, -x_t.shape[1] :].float()
        return suffix_out, self.action_out_proj(suffix_out)

    def time_condition(self, time_embs: Tensor) -> Tensor:
        """Pi0.5: adaRMS conditions float32[N, D]. They depend on the step alone."""
        return F.silu(self.time_mlp_out(F.silu(self.time_mlp_in(time_embs))))

    def embed_suffix(self, x_t: Tensor, state: Tensor, time_emb: Tensor) -> Tensor:
        """Suffix tokens in the compute dtype: H actions (Pi0.5), or the state and H actions mixed with t (Pi0)."""
        actions = self.action_in_proj(x_t)
        if self.config.kind == "pi05":
            return actions.to(self.compute_dtype)
        mixed = torch.cat((actions, time_emb.expand_as(actions)), dim=-1)
        actions = self.action_time_mlp_out(F.silu(self.action_time_mlp_in(mixed)))
        return torch.cat((self.state_proj(state)[:, None], actions), dim=1).to(self.compute_dtype)


def with_second_prompt(observation: Observation, conditioning: Conditionings) -> Observation | None:
    """An observation with the prompts of `PromptGuidance`, of rows without it their own; None: no row has it."""
    if not has_two_prompts(conditioning):
        return None
    guidance = [None if one is None else one.prompt for one in of_rows(conditioning, observation.batch_size)]
    own = [ids[there].cpu() for ids, there in zip(observation.tokens, observation.token_mask, strict=True)]
    rows = [ids if one is None else torch.from_numpy(one.tokens) for ids, one in zip(own, guidance, strict=True)]
    padded = torch.nn.utils.rnn.pad_sequence(rows, batch_first=True)
    there = torch.arange(padded.shape[1])[None] < torch.tensor([len(ids) for ids in rows])[:, None]
    device = observation.tokens.device
    return replace(observation, tokens=padded.to(device), token_mask=there.to(device))


def _scatter(x: Tensor, dim: int, index: Tensor, size: int) -> Tensor:
    """Zeros of `size` along `dim`, with x at `index`."""
    out = x.new_zeros((*x.shape[:dim], size, *x.shape[dim + 1 :]))
    return out.index_copy_(dim, index, x)


def parameter_dtype(name: str, precision: FloatPrecision) -> torch.dtype:
    """The dtype of a parameter (canonical name) in a precision.

    bf16 follows openpi's PyTorch: patch and position embeddings, all Gemma norms with the adaRMS matrices, and the
    action, time and state projections stay float32. SigLIP's LayerNorms are bfloat16.
    """
    if precision == "f32":
        return torch.float32
    is_gemma_norm = not name.startswith("vision.") and (
        ".input_layernorm." in name or ".post_attention_layernorm." in name
    )
    return torch.float32 if is_gemma_norm or name.startswith(_FLOAT32_ALWAYS) else torch.bfloat16
