"""Backend `fused` for SmolVLA: its stages with kernels of our own (engine/smolvla.py), a call's steps in one launch.

Steps of a conditioned call, which that kernel doesn't take, run as in `cuda_graph`: the reference's, captured. So do
all where that kernel failed its self-test. Those of several observations are operations (engine/smolvla_batch.py).

In FP8 or INT8 matmuls of vision and of the text layers are in eight bits, as a calibration says. That kernel then has
the expert's weights in INT8 or, beside FP8, in bfloat16. All other ways to denoise are in bfloat16.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor

from turbopi.backends.base import LoadState, Precision
from turbopi.backends.captured import CapturedBackend
from turbopi.backends.captured_graphs import Answer, Graphs
from turbopi.backends.fused import FusedBackend
from turbopi.backends.qualification import DENOISE, excluded
from turbopi.backends.tuned_tiles import tiles_of
from turbopi.config import Network
from turbopi.engine import smolvla
from turbopi.engine.graph import HEAD, Graph, Mark, building, empty_cache
from turbopi.engine.smolvla_batch import ExpertByOps
from turbopi.kernels.interface import Ops
from turbopi.kernels.ops import fused_ops
from turbopi.kernels.portable.denoise.kernel import PortableDenoiser
from turbopi.models.observation import Observation
from turbopi.models.pi0.conditioning import Conditioning
from turbopi.models.pi0.kv_cache import KVCache
from turbopi.models.smolvla.config import SmolVLAConfig
from turbopi.quantization.calibration_file import Quantization
from turbopi.quantization.plan import PrecisionPlan


@dataclass(frozen=True)
class _Attended:
    """What the expert attends to: keys, values bfloat16[L, G, B * S, K], of which `lengths` int64[B] are valid."""

    keys: Tensor
    values: Tensor
    lengths: Tensor


@dataclass(frozen=True)
class _Loop:
    """A captured loop: x_t float32[N + 1, B, H, A], v_t [N, B, H, A], and what it points to."""

    x_t: Tensor
    v_t: Tensor
    by: Any
    graph: Graph


class FusedSmolVLABackend(CapturedBackend):
    """In bfloat16 or, as a calibration says, partly in FP8 or INT8: `describe()` says what runs."""

    name: ClassVar[str] = "fused"
    precisions: ClassVar[tuple[Precision, ...]] = ("bf16", "fp8", "fp8-mlp", "int8")
    # on an H200, h200_2026-11-29_smolvla_batches.json.xz: one observation has the denoising kernel, several don't
    COSTS: ClassVar[Mapping[int, float]] = {1: 1, 2: 1.99, 4: 2.58, 8: 3.77}
    _dtype: ClassVar[torch.dtype] = torch.bfloat16
    _plan: PrecisionPlan | None = None

    @classmethod
    def unavailable(cls, device: torch.device) -> str | None:
        return FusedBackend.unavailable(device)

    @classmethod
    def unavailable_in(cls, device: torch.device, precision: Precision) -> str | None:
        return FusedBackend.unavailable_in(device, precision)

    @classmethod
    def refuses_model(cls, config: Network) -> str | None:
        if not isinstance(config, SmolVLAConfig):
            return FusedBackend.refuses_model(config)
        if (refused := super().refuses_model(config)) is not None:
            return refused
        why = smolvla.refusal(config)
        return None if why is None else f"backend 'fused' can't run this SmolVLA: {why}; take backend 'auto' in 'bf16'"

    def load_weights(self, load: LoadState) -> None:
        given = self._quantization
        self._plan = None if given is None else given.plan(self.config, self.precision)
        super().load_weights(
            lambda to, precision: load(smolvla.Placement(self.config, self.device, self._dtype), "bf16")
        )
        self._tiles, self._without = tiles_of(self.device), excluded(self.device, self.precision, self.config)
        ops = self._make_ops()
        self._tower = smolvla.Vision.pack(self.model, ops, self._dtype, self._plan)
        self._prefix = smolvla.Prefix.pack(self.model, ops, self._dtype, self._plan)
        self._prefix_of = self._prefix_stage
        self._expert = smolvla.Expert.pack(self.model, self._plan)
        self._ops, self._origin = ops, ops.origin
        self._by_ops: ExpertByOps | None = None  # its matrices are made for the first batch
        empty_cache()  # of what loading and packing needed besides

    def _make_ops(self) -> Ops:
        return fused_ops(self.device, self._tiles.table, self._without, self.precision)

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
        single = [graphs for (_, batch), graphs in self._graphs.items() if batch == 1]
        loops = sorted({f"{steps} steps, H={h}" for graphs in single for h, steps in graphs.loops})
        denoising = {"one portable CUDA kernel": loops, "a captured step at a time": ["conditioned calls"]}
        if DENOISE in self._without:
            denoising = {"a captured step at a time": ["calls of one observation"]}
        if self._by_ops is not None:
            denoising["operations"] = ["calls of several observations"]
        made = {"operations": dict(self._origin), "tiles": self._tiles.about, "denoising": denoising}
        if self._plan is not None and self._quantization is not None:
            made[self._plan.format.name] = self._in_eight_bits(self._plan, self._quantization)
        return super().describe() | made | ({"excluded": dict(self._without)} if self._without else {})

    def _in_eight_bits(self, plan: PrecisionPlan, calibration: Quantization) -> dict[str, Any]:
        described = calibration.describe(plan)
        groups = described["plan"]
        if plan.expert == "bf16":
            why = next(reason for site, reason in plan.kept.items() if site.startswith("expert."))
            expert = f"bf16, all of it, as its kernel takes one precision; {why}"
        else:
            expert = "bf16, a captured step at a time" if DENOISE in self._without else plan.expert
            groups["expert of conditioned calls"] = "bf16, a captured step at a time"
            if self._by_ops is not None:
                groups["expert of batches"] = "bf16, as operations denoise"
        for name, what in groups.items():
            if name.startswith("expert.") and what == plan.format.name:
                groups[name] = expert
        groups["expert"] = expert
        return described

    def _vision(self, observation: Observation, mark: Mark) -> Tensor:
        return self._tower(observation.images.flatten(0, 1), lambda: mark(HEAD))

    def _prefix_stage(self, observation: Observation, embedded: Tensor) -> tuple[KVCache, Any, _Attended]:
        config, prefix, batch = self.config, self._prefix, observation.batch_size
        if batch == 1:
            lengths = observation.token_mask.sum(1) + (prefix.before_prompt(len(embedded)) + 1)
            x = prefix.embed(embedded, observation.tokens[0], observation.state, lengths)
        else:
            x, lengths = prefix.embed_several(embedded, observation)
        k, v = made = prefix.keys_values(x, lengths)
        keys, values = prefix.of_expert(made)
        valid = prefix.numbered(batch, len(x) // batch)[0] < lengths[:, None]

        def by_row(rows: Tensor) -> Tensor:
            """[layer, G, B * S, K] -> [layer, B, G, S, K]"""
            layers, groups, _, head_dim = rows.shape
            return rows.view(layers, groups, batch, -1, head_dim).transpose(1, 2)

        cache = KVCache(by_row(k), by_row(v), valid, lengths, x.new_zeros(batch, 0, x.shape[1], dtype=torch.float32))
        across = [
            None if config.is_self_layer(at) else pair
            for at, pair in zip(config.expert_at, zip(by_row(keys), by_row(values), strict=True), strict=True)
        ]
        return cache, across, _Attended(keys, values, lengths)

    def _denoise(
        self, graphs: Graphs, horizon: int, num_steps: int, conditioning: Conditioning | None, keep: bool
    ) -> Answer:
        if graphs.size[1] == 1 and self._by_step(conditioning):
            return super()._denoise(graphs, horizon, num_steps, conditioning, keep)
        if self.strict and (horizon, num_steps) not in graphs.loops:
            raise self._cold(graphs.size, horizon)
        loop = self._loop(graphs, horizon, num_steps)
        loop.graph.launch()
        return Answer(loop.x_t[-1], list(zip(loop.x_t[:-1].clone(), loop.v_t.clone(), strict=True)) if keep else [])

    def _prepare_loop(self, graphs: Graphs, num_steps: int, horizon: int) -> None:
        self._loop(graphs, horizon, num_steps)

    def _loop(self, graphs: Graphs, horizon: int, num_steps: int) -> _Loop:
        if (horizon, num_steps) not in graphs.loops:
            attended: _Attended = graphs.more
            noise = graphs.noise_of(horizon, self.config).tensors["noise"]
            x_t, v_t = noise.new_zeros(num_steps + 1, *noise.shape), noise.new_zeros(num_steps, *noise.shape)
            with building(self.device), torch.no_grad():
                by = self._one_denoised if len(attended.lengths) == 1 else self._several_denoised
                made, launch = by(attended, noise, x_t, v_t)

                def run(mark: Mark) -> None:
                    launch()
                    mark("denoise")

                graph = Graph(run, self._pool, self._stream)
            graphs.loops[horizon, num_steps] = _Loop(x_t, v_t, made, graph)
        return graphs.loops[horizon, num_steps]

    def _one_denoised(self, attended: _Attended, *chunks: Tensor) -> tuple[Any, Callable[[], None]]:
        """The kernel of all steps, and what launches it. chunks: noise, x_t and v_t."""
        noise, x_t, v_t = chunks[0][0], chunks[1][:, 0], chunks[2][:, 0]
        kernel = self._make_denoiser(len(v_t), cache_rows=attended.keys.shape[2], suffix=len(noise))
        return kernel, lambda: kernel.launch(noise, attended.keys, attended.values, attended.lengths, x_t, v_t)

    def _several_denoised(self, attended: _Attended, *chunks: Tensor) -> tuple[Any, Callable[[], None]]:
        """The same by operations."""
        if self._by_ops is None:
            self._by_ops = ExpertByOps.pack(self._expert, self._ops, self._dtype)
        steps, batch, horizon = chunks[2].shape[:3]
        by, (_, _, rows, _) = self._by_ops, attended.keys.shape
        fixed = by.constants(steps, batch, horizon, rows // batch)
        return (by, fixed), lambda: by.run(fixed, attended.keys, attended.values, attended.lengths, *chunks)
