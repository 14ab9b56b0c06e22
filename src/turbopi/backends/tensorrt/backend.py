"""Backend `tensorrt`: TensorRT engines for vision, the prefix's MLPs and the denoising step, in one CUDA graph a call.

Vision is one float16 engine over all cameras. Each layer of the prefix has an MLP engine of its own, bfloat16 here and
E4M3 in `tensorrt_fp8`; norms, projections and attention beside it are PyTorch's in bfloat16. The action expert is one
bfloat16 engine a step; all steps are in the graph.

Engines are for a number of cameras, a longest prompt and a horizon, and come from the cache that `turbopi build` fills.
What isn't there is built by warm-up for the longest prompt of the model, or by the first call where nothing was warmed
up. After warm-up an observation that no engine was built for is an error, never another way to compute.
"""

import logging
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from turbopi.backends.base import Backend, LoadState, Sample
from turbopi.backends.tensorrt import library, missing
from turbopi.backends.tensorrt.call import EngineCall
from turbopi.backends.tensorrt.engines import ModelEngines, for_this_gpu, without_engine_weights
from turbopi.backends.tensorrt.networks import Fp8Scales
from turbopi.backends.tensorrt.parts import SLOTS, EngineShape, fingerprint
from turbopi.engine.graph import Graph, Mark, building
from turbopi.engine.graph_cache import LoopCache
from turbopi.engine.loops import EulerLoop, Loop
from turbopi.engine.plan import cold_call
from turbopi.engine.trace import golden_trace
from turbopi.engine.weights import Weights, modulation, pack
from turbopi.models.observation import Observation
from turbopi.models.pi0.conditioning import Conditioning, Conditionings
from turbopi.models.pi0.kv_cache import KVCache
from turbopi.models.pi0.reference import FloatPrecision, Trace
from turbopi.support.errors import BackendError, ObservationError

logger = logging.getLogger(__name__)

MAX_CAMERAS = 4


@dataclass(frozen=True)
class Row:
    """One observation on the host, compacted."""

    images: np.ndarray  # (uint8|float32)[V, 224, 224, 3], valid cameras
    tokens: np.ndarray  # int64[valid prompt tokens]
    state: np.ndarray
    valid: np.ndarray  # bool[S_padded]: which slots of the padded prefix these are

    @classmethod
    def of(cls, observation: Observation, row: int, per_image: int) -> "Row":
        images, cameras, tokens, mask, state = (
            getattr(observation, name)[row].cpu().numpy()
            for name in ("images", "image_mask", "tokens", "token_mask", "state")
        )
        return cls(images[cameras], tokens[mask], state, np.concatenate((cameras.repeat(per_image), mask)))


@dataclass(frozen=True)
class CallKey:
    shape: EngineShape
    num_steps: int
    float_images: bool
    buffers: int = 0  # which of several sets of buffers


class TensorRTBackend(Backend):
    """See the top of this file. Batches run one observation after the other."""

    name: ClassVar[str] = "tensorrt"
    precisions: ClassVar[tuple[FloatPrecision, ...]] = ("bf16",)
    any_horizon: ClassVar[bool] = False  # engines are built for one
    instead: ClassVar[str] = "backend 'fused', 'cuda_graph' or 'pytorch'"

    def load_weights(self, load: LoadState) -> None:
        if (heads := self.config.vlm.num_kv_heads) != 1:
            raise BackendError(f"{self.name} needs one key/value head, this model has {heads}")
        state = load(self.device, "f32" if self.precision == "f32" else "bf16")
        self._weights_hash = fingerprint(state)
        self._weights = pack(self.config, state)
        self._engines = self._make_engines(self._weights)
        self._sealed, self._missed = False, 0
        self._shapes: list[EngineShape] = []  # whose engines are loaded
        self._recent, self._warming = LoopCache(self._forget), False
        self._tables: dict[int, Tensor | None] = {}
        self._calls: dict[CallKey, EngineCall] = {}
        self._graphs: dict[tuple[CallKey, str], Graph] = {}
        self._pools: dict[str, tuple[Any, torch.cuda.Stream]] = {}

    @classmethod
    def unavailable(cls, device: torch.device) -> str | None:
        reason = missing()
        if reason is not None:
            return reason
        if device.type != "cuda":
            return "TensorRT's engines run on NVIDIA GPUs; use backend 'pytorch'"
        major, minor = torch.cuda.get_device_capability(device)
        if major < 8:
            return f"it needs compute capability 8.0 or newer for bfloat16, this GPU has {major}.{minor}"
        return None

    # -- the base class's methods --------------------------------------------------------------------------------------

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
        """Load every cached set of engines for this observation's cameras, and capture; allow no other shape after the
        last one.

        Builds a set for the model's longest prompt where none is cached that holds this observation's prompt, unless it
        isn't required.
        """
        self.check_conditioning(conditioning)
        row, actions = self._row(observation, 0), self.config.action_horizon if horizon is None else horizon
        cameras = len(row.images)
        self._warming = True
        try:
            if required or self._engines.cached_shapes(cameras, actions):
                self._warm(cameras, len(row.tokens), actions, num_steps, row.images.dtype == np.float32)
            else:
                logger.info("there are no engines for %d cameras: `turbopi build --cameras %d`", cameras, cameras)
        finally:
            self._warming = False
        if last:
            self._sealed = True
            self._engines.release()
            self._weights = without_engine_weights(self._weights)

    def _warm(self, cameras: int, tokens: int, horizon: int, num_steps: int, float_images: bool) -> None:
        self._shape(cameras, tokens, horizon)
        cached = self._engines.cached_shapes(cameras, horizon)
        self._shapes += [shape for shape in cached if shape not in self._shapes]
        for shape in self._shapes:
            if (shape.cameras, shape.horizon) == (cameras, horizon):
                self._prepare(CallKey(shape, num_steps, float_images))

    def prefix(self, observation: Observation) -> KVCache:
        if observation.batch_size != 1:
            raise BackendError(f"{self.name} holds the cache of one observation, not of {observation.batch_size}")
        noise = np.zeros((self.config.action_horizon, self.config.action_dim), np.float32)
        call, _ = self._run("encode", self._row(observation, 0), noise, 1)
        length = int(call.host_length[0])
        k, v = (cache[:, None, None, :length].clone() for cache in (call.cache_k, call.cache_v))
        lengths = torch.tensor([length], device=self.device)
        return KVCache(k, v, None, lengths, observation.state.to(self.device))

    def denoise(self, cache: KVCache, noise: Tensor, num_steps: int, *, conditioning: Conditionings = None) -> Tensor:
        self.check_conditioning(conditioning)
        if cache.k.shape[1] != 1 or cache.mask is not None:
            raise BackendError(f"{self.name} denoises one unpadded observation's cache, not {cache.k.shape[1]}")
        length, per_image = cache.k.shape[3], self.config.vision.num_tokens
        cameras = min(length // per_image, MAX_CAMERAS)
        shape = self._shape(cameras, length - cameras * per_image, noise.shape[1])
        key = CallKey(shape, num_steps, False)
        graph, call = self._graph(key, "denoise"), self._calls[key]
        for ours, given in ((call.cache_k, cache.k), (call.cache_v, cache.v)):
            ours[:, :length], ours[:, length:] = given[:, 0, 0], 0  # rows that are masked must be finite
        call.length.fill_(length)
        call.noise.copy_(noise[0])
        call.state.copy_(cache.state[0])
        self._synchronize()
        graph.replay()
        return call.x_t[-1:].clone()

    def sample(
        self, observation: Observation, noise: Tensor, num_steps: int, *, conditioning: Conditionings = None
    ) -> Sample:
        self.check_conditioning(conditioning)
        actions, stages = [], []
        for b in range(observation.batch_size):
            call, graph = self._run("call", self._row(observation, b), noise[b].cpu().numpy(), num_steps)
            actions.append(call.actions.clone())
            stages.append(graph.stage_ms())
        return Sample(torch.stack(actions), {name: sum(one[name] for one in stages) for name in stages[0]})

    def intermediates(
        self, observation: Observation, noise: Tensor, num_steps: int, *, conditioning: Conditionings = None
    ) -> Trace:
        self.check_conditioning(conditioning)
        traces = []
        for b in range(observation.batch_size):
            row = self._row(observation, b)
            call, _ = self._run("call", row, noise[b].cpu().numpy(), num_steps)
            traces.append(golden_trace(call, int(call.host_length[0]), torch.from_numpy(row.valid)))
        return {name: torch.cat([one[name] for one in traces], dim=int(name != "actions")) for name in traces[0]}

    def describe(self) -> dict[str, Any]:
        environment = self._engines.cache.environment
        return {
            "library": f"{environment.library} {environment.library_version}",
            "precision": self._precisions(),
            "engines_for": [str(shape) for shape in self._shapes],
            "engines": dict(self._engines.origin),
            "engine_runs_while_capturing": self._engines.calls(),
            "observations_without_engine": self._missed,
            "engine_cache": str(self._engines.cache.folder),
            "graphs": {"kept": len(self._graphs), **self._recent.describe()},
        }

    # -- shapes and graphs ---------------------------------------------------------------------------------------------

    def _precisions(self) -> dict[str, str]:
        return {"vision": "fp16", "prefix MLPs": "bf16", "denoise": "bf16", "attention": "bf16, PyTorch"}

    def _scales(self) -> Sequence[Fp8Scales | None] | None:
        return None

    def _make_engines(self, weights: Weights) -> ModelEngines:
        return for_this_gpu(library(), self.config, weights, self._weights_hash, self.device, scales=self._scales())

    def _row(self, observation: Observation, b: int) -> Row:
        return Row.of(observation, b, self.config.vision.num_tokens)

    def _shape(self, cameras: int, tokens: int, horizon: int) -> EngineShape:
        """The smallest engines that an observation fits: loaded ones, else cached ones, else, before warm-up, new ones.

        Raises BackendError, naming both shapes, if there are none; ObservationError for what no engines are built for.
        """
        empty = cameras + tokens == 0 and not self._warming
        if cameras > MAX_CAMERAS or tokens > self.config.max_prompt_tokens or empty:
            raise ObservationError(
                f"{self.name} takes up to {MAX_CAMERAS} cameras and {self.config.max_prompt_tokens} prompt tokens, "
                f"this observation has {cameras} and {tokens}"
            )
        fits = [s for s in self._shapes if (s.cameras, s.horizon) == (cameras, horizon) and s.prompt_slots >= tokens]
        if fits:
            return min(fits, key=lambda shape: shape.prompt_slots)
        if self._sealed and not self._warming:
            self._missed += 1
            loaded = "; ".join(str(shape) for shape in self._shapes)
            raise BackendError(
                f"{self.name} has engines for {loaded}, and none for {cameras} cameras, {tokens} prompt tokens, "
                f"H={horizon}. Build them (`turbopi build --cameras {cameras} --prompt-tokens {tokens}`) and start anew"
            )
        if self.strict and not self._warming:
            raise cold_call(self.name, f"engines for {cameras} cameras", map(str, self._shapes), cameras=cameras)
        cached = [s for s in self._engines.cached_shapes(cameras, horizon) if s.prompt_slots >= tokens]
        longest = -(-self.config.max_prompt_tokens // SLOTS) * SLOTS
        shape = cached[0] if cached else EngineShape(cameras, longest, horizon)
        self._shapes.append(shape)
        return shape

    def _run(self, part: str, row: Row, noise: np.ndarray, num_steps: int) -> tuple[EngineCall, Graph]:
        shape = self._shape(len(row.images), len(row.tokens), noise.shape[0])
        key = CallKey(shape, num_steps, row.images.dtype == np.float32)
        graph, call = self._graph(key, part), self._calls[key]
        call.write_inputs(row.images, noise, row.state, row.tokens)
        graph.replay()
        return call, graph

    def _graph(self, key: CallKey, part: str) -> Graph:
        """The graph of a call or of one of its halves, "encode" and "denoise"; captured when first needed."""
        if (key, part) not in self._graphs:
            if self.strict and not self._warming:
                warm = (f"{k.shape}, {k.num_steps} steps" for k, _ in self._graphs)
                raise cold_call(self.name, f"{key.shape}, {key.num_steps} steps", warm, steps=key.num_steps)
            start = time.perf_counter()
            with building(self.device):
                self._recent.use(EulerLoop(key.num_steps, key.shape.horizon))
                call = self._call(key)
                run = {"call": call.run, "encode": call.encode, "denoise": call.denoise}[part]
                before = call.parts.calls()
                self._graphs[key, part] = self._capture(run, part)
            self._check_coverage(call, part, before)
            logger.info("captured %s of %s in %.2f s", part, key, time.perf_counter() - start)
        else:
            self._recent.use(EulerLoop(key.num_steps, key.shape.horizon))
        return self._graphs[key, part]

    def _forget(self, loop: Loop) -> None:
        """Let go of all that is a denoising loop's alone."""
        self._synchronize()  # one may still run whose call was interrupted
        lost = {key for key in self._calls if EulerLoop(key.num_steps, key.shape.horizon) == loop}
        for kept in [key for key in self._graphs if key[0] in lost]:
            del self._graphs[kept]
        for key in lost:
            del self._calls[key]
        if loop.steps not in {other.steps for other in self._recent}:
            self._tables.pop(loop.steps, None)

    def _check_coverage(self, call: EngineCall, part: str, before: list[int]) -> None:
        """Every engine of a part ran while it was captured, as often as it should: nothing was computed elsewhere."""
        *encoders, steps = (now - then for now, then in zip(call.parts.calls(), before, strict=True))
        times = steps // call.num_steps if part == "denoise" else max(encoders, default=0)
        should = [0 if part == "denoise" else times] * len(encoders), 0 if part == "encode" else times * call.num_steps
        if (encoders, steps) != should or not times:
            raise BackendError(
                f"{self.name}: in {part}, vision and MLPs ran {encoders} times and the step {steps} times instead of "
                f"{should[0]} and {should[1]}: something was computed elsewhere"
            )

    def _capture(self, run: Callable[[Mark], None], part: str) -> Graph:
        """Graphs of one part share memory, as they run one after the other; those of two may run at once."""
        if part not in self._pools:
            stream = torch.cuda.Stream(self.device)  # type: ignore[no-untyped-call]
            self._pools[part] = (torch.cuda.graph_pool_handle(), stream)
        return Graph(run, *self._pools[part])

    def _call(self, key: CallKey) -> EngineCall:
        if key not in self._calls:
            if key.num_steps not in self._tables:
                table = modulation(self.config, self._weights.conditioning, key.num_steps)
                self._tables[key.num_steps] = None if table is None else table.to(self.device)
            self._calls[key] = EngineCall(
                self.config,
                without_engine_weights(self._weights),
                self._engines.parts(key.shape),
                key.shape,
                key.num_steps,
                self._tables[key.num_steps],
                vision_dtype=self._vision_dtype(),
                float_images=key.float_images,
            )
        return self._calls[key]

    def _vision_dtype(self) -> torch.dtype:
        return torch.float16

    def _prepare(self, key: CallKey) -> None:
        """Capture what later calls of this key replay."""
        self._graph(key, "call")

    def _synchronize(self) -> None:
        if self.device.type == "cuda":
            torch.cuda.current_stream(self.device).synchronize()
