"""Backend `fused` for SmolVLA: its stages with kernels of our own (engine/smolvla.py), a call's steps in one launch.

Steps of a conditioned call, which that kernel doesn't take, run as in `cuda_graph`: the reference's, captured. So do
all where that kernel failed its self-test.
"""

from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor

from turbopi.backends.base import LoadState, Precision
from turbopi.backends.captured import Answer, CapturedBackend, Graphs
from turbopi.backends.fused import FusedBackend
from turbopi.backends.qualification import DENOISE, excluded
from turbopi.backends.tuned_tiles import tiles_of
from turbopi.config import Network
from turbopi.engine import smolvla
from turbopi.engine.graph import HEAD, Graph, Mark, building
from turbopi.kernels.interface import Ops
from turbopi.kernels.ops import fused_ops
from turbopi.kernels.portable.denoise.kernel import PortableDenoiser
from turbopi.models.observation import Observation
from turbopi.models.pi0.conditioning import Conditioning
from turbopi.models.pi0.kv_cache import KVCache
from turbopi.models.smolvla.config import SmolVLAConfig


@dataclass(frozen=True)
class _Attended:
    """What the expert attends to: keys, values bfloat16[L, G, S, K], of which `length` int64[1] places are valid."""

    keys: Tensor
    values: Tensor
    length: Tensor


@dataclass(frozen=True)
class _Loop:
    """A captured loop: noise float32[H, A], x_t [N + 1, H, A], v_t [N, H, A]."""

    noise: Tensor
    x_t: Tensor
    v_t: Tensor
    kernel: PortableDenoiser
    graph: Graph


class FusedSmolVLABackend(CapturedBackend):
    """In bfloat16. A batch's observations run one by one."""

    name: ClassVar[str] = "fused"
    precisions: ClassVar[tuple[Precision, ...]] = ("bf16",)

    @classmethod
    def unavailable(cls, device: torch.device) -> str | None:
        return FusedBackend.unavailable(device)

    @classmethod
    def refuses_model(cls, config: Network) -> str | None:
        if not isinstance(config, SmolVLAConfig):
            return FusedBackend.refuses_model(config)
        if (refused := super().refuses_model(config)) is not None:
            return refused
        why = smolvla.refusal(config)
        return None if why is None else f"backend 'fused' can't run this SmolVLA: {why}; take backend 'cuda_graph'"

    def load_weights(self, load: LoadState) -> None:
        super().load_weights(load)
        self._tiles, self._without = tiles_of(self.device), excluded(self.device, self.precision, self.config)
        ops = self._make_ops()
        self._tower = smolvla.Vision.pack(self.model, ops, torch.bfloat16)
        self._prefix = smolvla.Prefix.pack(self.model, ops, torch.bfloat16)
        self._prefix_of = self._prefix_stage
        self._expert = smolvla.Expert.pack(self.model)
        self._origin = ops.origin

    def _make_ops(self) -> Ops:
        return fused_ops(self.device, self._tiles.table, self._without)

    def _make_denoiser(self, num_steps: int, **sizes: Any) -> PortableDenoiser:
        return self._expert.denoiser(num_steps, device=self.device, **sizes)

    def _by_step(self, conditioning: Conditioning | None) -> bool:
        return DENOISE in self._without or (conditioning is not None and conditioning.form != "plain")

    def warmup(
        self,
        observation: Observation,
        num_steps: int,
        horizon: int | None = None,
        *,
        required: bool = True,
        last: bool = True,
        conditioning: Conditioning | None = None,
    ) -> None:
        graphs, actions = self._captured(int(observation.image_mask[0].sum())), horizon or self.config.action_horizon
        if DENOISE not in self._without:
            self._loop(graphs, actions, num_steps)
        if self._by_step(conditioning):
            self._step(graphs, actions, by_action=conditioning is not None and conditioning.form == "tokens")

    def describe(self) -> dict[str, Any]:
        loops = sorted({f"{steps} steps, H={h}" for graphs in self._graphs.values() for h, steps in graphs.loops})
        denoising = {"one portable CUDA kernel": loops, "a captured step at a time": ["conditioned calls"]}
        if DENOISE in self._without:
            denoising = {"a captured step at a time": ["all calls"]}
        made = {"operations": dict(self._origin), "tiles": self._tiles.about, "denoising": denoising}
        return super().describe() | made | ({"excluded": dict(self._without)} if self._without else {})

    def _vision(self, observation: Observation, mark: Mark) -> Tensor:
        return self._tower(observation.images[0], lambda: mark(HEAD))

    def _prefix_stage(self, observation: Observation, embedded: Tensor) -> tuple[KVCache, Any, _Attended]:
        config, prefix, cameras = self.config, self._prefix, embedded.shape[0]
        length = observation.token_mask.sum(1) + prefix.before_prompt(cameras) + 1
        x = prefix.embed(embedded, observation.tokens[0], observation.state, length)
        k, v = prefix.keys_values(x, length)
        valid = torch.arange(len(x), device=self.device)[None] < length
        cache = KVCache(k[:, None], v[:, None], valid, length, x[None, :0].float())
        keys, values = (one.contiguous() for one in prefix.of_expert(k, v))
        across = [
            None if config.is_self_layer(at) else (keys[i, None], values[i, None])
            for i, at in enumerate(config.expert_at)
        ]
        return cache, across, _Attended(keys, values, length)

    def _denoise(
        self,
        graphs: Graphs,
        cameras: int,
        x_1: Tensor,
        num_steps: int,
        conditioning: Conditioning | None,
        keep: bool,
    ) -> Answer:
        if self._by_step(conditioning):
            return super()._denoise(graphs, cameras, x_1, num_steps, conditioning, keep)
        horizon = x_1.shape[1]
        if self.strict and (horizon, num_steps) not in graphs.loops:
            raise self._cold(cameras, horizon)
        loop = self._loop(graphs, horizon, num_steps)
        loop.noise.copy_(x_1[0])
        loop.graph.launch()
        x_t, v_t = loop.x_t[:, None], loop.v_t[:, None]
        return Answer(x_t[-1], list(zip(x_t[:-1].clone(), v_t.clone(), strict=True)) if keep else [])

    def _loop(self, graphs: Graphs, horizon: int, num_steps: int) -> _Loop:
        if (horizon, num_steps) not in graphs.loops:
            attended: _Attended = graphs.more
            noise = torch.zeros(horizon, self.config.action_dim, device=self.device)
            x_t, v_t = noise.new_zeros(num_steps + 1, *noise.shape), noise.new_zeros(num_steps, *noise.shape)
            rows = attended.keys.shape[2]
            with building(self.device), torch.no_grad():
                kernel = self._make_denoiser(num_steps, cache_rows=rows, suffix=horizon)

                def run(mark: Mark) -> None:
                    kernel.launch(noise, attended.keys, attended.values, attended.length, x_t, v_t)
                    mark("denoise")

                graph = Graph(run, self._pool, self._stream)
            graphs.loops[horizon, num_steps] = _Loop(noise, x_t, v_t, kernel, graph)
        return graphs.loops[horizon, num_steps]
