"""One call for several observations: their images, prefixes and action chunks as rows of the same matmuls.

A batched call is three graphs, one after the other: vision of so many images (`call.Images`), `PackedPrefix` of so
many rows, and `BatchLoop`, all denoising steps of so many observations. Observations of other cameras, prompts and
lengths stand side by side (packing.py); which rows are whose is said in device memory, so nothing is captured anew
when that changes.

Shapes: B observations, R packed prefix rows, T suffix tokens of one observation, H actions, A action_dim, K head_dim.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from turbopi.config import ModelConfig
from turbopi.engine import forward
from turbopi.engine.backward import Expert, backward_ops, jacobian_velocity
from turbopi.engine.call import Cache, Images
from turbopi.engine.conditioned import Conditioned, StepTimes
from turbopi.engine.flat import allocate
from turbopi.engine.loops import ConditionedLoop, EulerLoop, Loop, SolverLoop
from turbopi.engine.packing import most_tiles, pack_rows
from turbopi.engine.weights import Weights
from turbopi.kernels.interface import Ops, PairDenoiser, Segments, StepEnd
from turbopi.kernels.plain_batch import PLAIN_BATCH, visible_to_suffix
from turbopi.models import family_of
from turbopi.models.pi0.conditioning import Conditioning
from turbopi.models.pi0.denoise import euler_step, step_size

PLAIN_ROW = Conditioning()  # of an observation without a conditioning, or an empty place


@dataclass(frozen=True)
class BatchSize:
    """What buffers and graphs of a batch are fixed to, beside the prompts' bucket and the denoising loop."""

    batch: int  # observations
    images: int  # of all of them together
    float_images: bool = False  # as `CallShape`'s
    two_prompts: bool = False  # as `GraphKey`'s


class SharedRows:
    """Buffers of which calls of every size take the first rows: one call runs after the other, whatever its size.

    A call that doesn't fit gets a new one. Graphs of smaller calls go on pointing to theirs, so it is at least twice as
    large: all together are at most as large as twice the last.
    """

    def __init__(self, config: ModelConfig, dtype: torch.dtype, device: torch.device) -> None:
        self._config = config
        self._cache = Cache.allocate(config, 0, device, dtype)
        self._embs = self._images = torch.empty(0, config.vlm.width, dtype=dtype, device=device)

    def cache(self, rows: int) -> Cache:
        if rows > (has := self._cache.k.shape[1]):
            like = self._embs
            self._cache = Cache.allocate(self._config, max(rows, 2 * has), like.device, like.dtype)
        return Cache(self._cache.k[:, :rows], self._cache.v[:, :rows])

    def embs(self, rows: int) -> Tensor:
        """Packed prefixes [rows, D]."""
        self._embs = self._grown(self._embs, rows)
        return self._embs[:rows]

    def images(self, rows: int) -> Tensor:
        """What vision makes of all images [rows, D]."""
        self._images = self._grown(self._images, rows)
        return self._images[:rows]

    def _grown(self, buffer: Tensor, rows: int) -> Tensor:
        if rows <= len(buffer):
            return buffer
        return buffer.new_full((max(rows, 2 * len(buffer)), buffer.shape[1]), torch.nan)  # as in `Cache`


class BatchBuffers:
    """What the three graphs of one size share."""

    def __init__(
        self,
        config: ModelConfig,
        weights: Weights,
        ops: Ops,
        size: BatchSize,
        images: Images,
        prompt_slots: int,
        shared: SharedRows | None = None,
    ) -> None:
        """`prompt_slots`: the most of any call, of all observations together. Without `shared` rows it has its own."""
        self.config, self.weights, self.ops, self.size, self.images = config, weights, ops, size, images
        assert images.cameras == size.images
        table = weights.embed_tokens
        self.image_rows = images.rows * (size.batch if size.two_prompts else 1)
        self.device, self.rows = table.device, self.image_rows + prompt_slots
        shared = shared or SharedRows(config, table.dtype, self.device)
        self.cache, self.embs = shared.cache(self.rows), shared.embs(self.rows)
        self.segments = torch.zeros((2, size.batch + 1), dtype=torch.int32, device=self.device)
        self.rope = forward.rope_of_all_positions(config, self.rows, self.device)


class PackedPrefix:
    """Prefix of all observations of a batch: tokens of images, which are there, and prompts to keys and values."""

    def __init__(self, buffers: BatchBuffers, prompt_slots: int) -> None:
        self._buffers, config, device = buffers, buffers.config, buffers.device
        self.rows = buffers.image_rows + prompt_slots
        assert 0 < self.rows <= buffers.rows
        batch, heads = buffers.size.batch, config.vlm.num_heads
        fields = {
            "source": ((self.rows,), torch.int64),
            "positions": ((self.rows,), torch.int64),
            "segments": ((2, batch + 1), torch.int32),
            "tiles": ((most_tiles(self.rows, batch, heads), 4), torch.int32),
        }
        self._host, host = allocate(fields, torch.device("cpu"), pinned=device.type == "cuda")
        self._arrays = {name: view.numpy() for name, view in host.items()}
        self._flat, self._inputs = allocate(fields, device, pinned=False)
        self._embs = buffers.embs[: self.rows]

    def write(self, cameras: Sequence[int], tokens: Sequence[np.ndarray]) -> np.ndarray:
        """Put what a call needs beside its images into the host's buffer. Returns the segments int32[2, B + 1].

        cameras  of each observation, how many images it has
        tokens   of each, int64[valid prompt tokens]
        """
        config = self._buffers.config
        packed = pack_rows(
            cameras,
            tokens,
            batch=self._buffers.size.batch,
            rows=self.rows,
            per_image=config.vision.num_tokens,
            heads=config.vlm.num_heads,
            same_images=self._buffers.size.two_prompts,
        )
        for name, array in self._arrays.items():
            array[:] = getattr(packed, name)
        return packed.segments

    def run(self, *_: Any) -> None:
        buffers, inputs = self._buffers, self._inputs
        config, weights, ops = buffers.config, buffers.weights, buffers.ops
        batched = ops.batch or PLAIN_BATCH
        ops.transfer(self._host, self._flat)
        buffers.segments.copy_(inputs["segments"])
        batched.embed_rows(inputs["source"], buffers.images.embs, weights.embed_tokens, self._embs)
        rope = (buffers.rope[0][inputs["positions"]], buffers.rope[1][inputs["positions"]])
        segments, heads = Segments(inputs["segments"][0], inputs["segments"][1], inputs["tiles"]), config.vlm.num_heads

        def places(i: int) -> tuple[Tensor, Tensor]:
            return buffers.cache.k[i, : self.rows], buffers.cache.v[i, : self.rows]

        def attend(i: int, q: Tensor, **input: Any) -> Tensor:
            return batched.packed_attention(q, *places(i), segments, heads, **input)

        forward.prefix_layers(config, weights, ops, self._embs, rope, places, attend, in_place=True)


class BatchLoop:
    """All denoising steps of a batch, from the keys and values that `PackedPrefix` left.

    In a conditioned loop each action has its own time, step and pull; of an observation without a conditioning they are
    openpi's. An Euler loop has none of that. With two prompts both rows go on with the mixture of their velocities, so
    they stay the same; a solver's loop is one of those alone.
    """

    def __init__(
        self,
        buffers: BatchBuffers,
        loop: Loop,
        by: Weights
        | PairDenoiser,  # operations with these, perhaps others than those of `buffers`; or, of two, a kernel
        table: Tensor | None,  # float32[N, 2 * layers + 1, 3, D], Pi0.5's modulation; a conditioned loop's: [U, …]
    ) -> None:
        by_token = loop if isinstance(loop, ConditionedLoop) else None
        plain = isinstance(loop, EulerLoop) and not buffers.size.two_prompts
        assert plain or isinstance(by, Weights), loop
        assert loop.form != ("jacobian" if buffers.size.two_prompts else "solver"), loop
        self._buffers, self._by = buffers, by
        config, device, batch = buffers.config, buffers.device, buffers.size.batch
        on_gpu = device.type == "cuda"
        self._steps, self._horizon = loop.steps, loop.horizon
        self._integration = loop.integration if isinstance(loop, SolverLoop) else None
        self._tokens = loop.horizon + family_of(config).state_token
        self._conditioned = None if by_token is None else Conditioned.allocate(config, by_token, device, batch)
        self._times = StepTimes.of(config, loop, table, self._conditioned, device)
        chunk = (batch, loop.horizon, config.action_dim)
        fields = {
            "noise": (chunk, torch.float32),
            "state": ((batch, config.action_dim), torch.float32),
            "factors": ((2, 1, 1), torch.float32),  # of the velocities of two prompts
        }
        self._host, host = allocate(fields, torch.device("cpu"), pinned=on_gpu)
        self._arrays = {name: view.numpy() for name, view in host.items()}
        self._flat, inputs = allocate(fields, device, pinned=False)
        self._noise, self._state, self._factors = inputs["noise"], inputs["state"], inputs["factors"]
        self._offsets = torch.arange(self._tokens, device=device)
        self._rope = forward.rope_of_all_positions(config, buffers.rows + self._tokens, device)
        self.x_t = torch.empty(loop.steps + 1, *chunk, device=device)
        self.v_t = torch.empty(loop.steps, *chunk, device=device)
        self._suffix_rows = batch * self._tokens
        self._whole_rows = -(-(buffers.rows + self._suffix_rows) // 16) * 16  # of `_whole_cache`; as `cache_rows`
        self._seen = torch.tensor([self._whole_rows - self._suffix_rows], device=device)  # all: `hidden` has what isn't
        self.actions = torch.empty(chunk, pin_memory=on_gpu)
        self.actions_array = self.actions.numpy()

    def write(
        self, noise: np.ndarray, state: np.ndarray, conditionings: Sequence[Conditioning | None] | None = None
    ) -> None:
        """noise float32[b, H, A] and state float32[b, A] of b <= B observations; the others are zeros.

        conditionings  of each, of a conditioned loop alone, which is for all of them
        """
        for name, given in (("noise", noise), ("state", state)):
            array = self._arrays[name]
            array[: len(given)] = given
            array[len(given) :] = 0
        if self._buffers.size.two_prompts:
            assert conditionings is not None and conditionings[0] is not None
            guidance = conditionings[0].prompt
            assert guidance is not None
            self._arrays["factors"][:, 0, 0] = guidance.factors
        if self._conditioned is None:
            return
        for row in range(self._buffers.size.batch):
            one = conditionings[row] if conditionings is not None and row < len(conditionings) else None
            self._conditioned.write(one or PLAIN_ROW, row)
            if one is not None:
                self._arrays["noise"][row] = one.started(noise[row])

    def trace(self, row: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """What the last call left of one observation: keys and values [layer, length, K], x_t and v_t [N.., H, A]."""
        cache, (start, length) = self._buffers.cache, (int(one) for one in self._buffers.segments[:, row])
        rows = slice(start, start + length)
        return cache.k[:, rows], cache.v[:, rows], self.x_t[:, row], self.v_t[:, row]

    def run(self, *_: Any) -> None:
        buffers, transfer = self._buffers, self._buffers.ops.transfer
        transfer(self._host, self._flat)
        if self._conditioned is not None:
            self._conditioned.upload()
        if isinstance(self._by, Weights):
            self._run_operations(self._by)
        else:
            cache, starts = buffers.cache, buffers.segments[0]
            self._by.launch_pair(self._noise, cache.k, cache.v, starts, self.x_t, self.v_t)
        transfer(self.x_t[-1], self.actions)

    def _run_operations(self, weights: Weights) -> None:
        lengths = self._buffers.segments[1, :-1].long()
        positions = (lengths[:, None] + self._offsets).flatten()
        rope = (self._rope[0][positions], self._rope[1][positions])
        self.x_t[0] = self._noise
        conditioned, two = self._conditioned, self._buffers.size.two_prompts
        if conditioned is None and not two and family_of(self._buffers.config).modulated:
            self._run_plain_steps(weights, rope)
            return
        whole = self._whole_cache() if conditioned is not None and conditioned.loop.jacobian else None
        for step in range(self._steps):
            x_t = self.x_t[step]
            if conditioned is not None and whole is not None:
                expert = self._expert(weights, step, rope, *whole)
                tokens, time = self._suffix(weights, step), self._times.embedding(step)
                v_t = jacobian_velocity(expert, conditioned, step, x_t, tokens, time)
            else:
                v_t = self._velocity(weights, step, rope)
                if two:
                    v_t = (self._factors * v_t).sum(0).expand_as(v_t)
                if conditioned is not None:
                    v_t = conditioned.pulled(step, x_t, v_t)
            self.v_t[step] = v_t
            if self._integration is not None:
                self.x_t[step + 1] = self._integration.next_x(step, self.x_t, self.v_t)
            elif conditioned is not None:
                self.x_t[step + 1] = conditioned.next_x(step, x_t, v_t)
            else:
                self.x_t[step + 1] = euler_step(x_t, v_t, self._steps)

    def _run_plain_steps(self, weights: Weights, rope: forward.Rope) -> None:
        """Pi0.5's, where one operation leads from a step's last layer to the next one's tokens."""
        config, small = self._buffers.config, weights.small
        batched, table = self._buffers.ops.batch or PLAIN_BATCH, self._times.table
        assert table is not None, "Pi0.5's norms are modulated"
        out, into = ((small[f"{name}.weight"], small[f"{name}.bias"]) for name in ("action_out_proj", "action_in_proj"))
        tokens = self._suffix(weights, 0)
        for step in range(self._steps):
            x, y, gate = self._layers(weights, step, rope, tokens)
            scale, shift, _ = table[step, -1].unbind(0)
            end = StepEnd(scale, shift, config.rms_norm_eps, out, step_size(self._steps), into)
            chunks = (one.flatten(0, 1) for one in (self.x_t[step], self.x_t[step + 1], self.v_t[step]))
            tokens = batched.end_step(x, y, gate, end, *chunks)

    def _layers(self, weights: Weights, step: int, rope: forward.Rope, tokens: Tensor) -> forward.Stream:
        """Suffix tokens [B * T, D] of a step through all layers of the expert."""
        buffers, config = self._buffers, self._buffers.config
        batched, heads = buffers.ops.batch or PLAIN_BATCH, config.expert.num_heads
        state_token = family_of(config).state_token

        def attend(i: int, qkv: Tensor, **input: Any) -> Tensor:
            prefix = buffers.cache.k[i], buffers.cache.v[i]
            return batched.suffix_attention(qkv, *rope, *prefix, *buffers.segments, heads, state_token, **input)

        ops = batched.expert(buffers.ops)
        return forward.expert_layers(config, weights.expert, ops, tokens, self._times.modulation(step), attend)

    def _velocity(self, weights: Weights, step: int, rope: forward.Rope) -> Tensor:
        """v_t float32[B, H, A]"""
        config, ops = self._buffers.config, self._buffers.ops
        stream = self._layers(weights, step, rope, self._suffix(weights, step))
        out = forward.final_norm(config, weights, ops, self._times.modulation(step), *stream)
        out = out.view(-1, self._tokens, out.shape[-1])[:, -self._horizon :]
        return forward.project(weights.small, "action_out_proj", out)

    def _suffix(self, weights: Weights, step: int) -> Tensor:
        """Tokens [B * T, D]"""
        config = self._buffers.config
        time = self._times.embedding(step)
        tokens = forward.suffix_tokens(config, weights.small, self.x_t[step], time, self._state)
        return tokens.flatten(0, 1).to(weights.embed_tokens.dtype)

    def _whole_cache(self) -> tuple[Tensor, Tensor, Tensor]:
        """Keys and values of all prefixes with space for the suffixes' behind them, and what is hidden from `Expert`.

        One matmul over the rows of all observations, most of them hidden: backward has no attention of its own.
        Rows that nothing was written to are 0, as 0 * NaN is NaN.
        """
        buffers, count, end = self._buffers, self._suffix_rows, self._whole_rows
        starts, lengths = buffers.segments
        unwritten = torch.arange(buffers.rows, device=buffers.device)[:, None] >= starts[-1]
        k, v = (
            F.pad(one.masked_fill(unwritten, 0), (0, 0, 0, end - buffers.rows))
            for one in (buffers.cache.k, buffers.cache.v)
        )
        state_token = family_of(buffers.config).state_token
        return k, v, ~visible_to_suffix(starts, lengths, end - count, count, state_token)[:, None]

    def _expert(self, weights: Weights, step: int, rope: forward.Rope, k: Tensor, v: Tensor, hidden: Tensor) -> Expert:
        buffers, table = self._buffers, self._times.modulation(step)
        back = backward_ops(buffers.ops, buffers.config, self._suffix_rows, masked=True)
        return Expert(buffers.config, weights, buffers.ops, back, table, self._seen, k, v, rope, hidden)
