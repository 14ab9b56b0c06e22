"""Backend `cuda_graph`: the whole call in one CUDA graph per prefix-length bucket, with stock PyTorch.

A bucket fixes the number of valid cameras and rounds the prompt's length up to a multiple of 16; inside it nothing is
captured anew when pictures, prompt, state or noise change. A bucket that warm-up didn't capture is captured when first
needed, with a log line. Batches run one observation after the other.
"""

import itertools
import logging
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from turbopi.backends.base import LoadState, Sample, Tier
from turbopi.config import ModelConfig
from turbopi.engine.call import Cache, CallShape, Denoiser, Mark, StaticCall
from turbopi.engine.ops import Ops, compiled
from turbopi.engine.weights import Weights, modulation, pack
from turbopi.errors import BackendError
from turbopi.model.kv_cache import KVCache
from turbopi.model.reference import Trace
from turbopi.observation import Observation

logger = logging.getLogger(__name__)

BUCKET = 16  # prompt tokens: at most 15 padded rows beside 256 a camera
MAX_CAMERAS = 4  # the cache is allocated for them


class Graph:
    """A sequence of kernels captured once, with timing events at its start and at every mark."""

    def __init__(self, run: Callable[[Mark], None], pool: Any, stream: torch.cuda.Stream) -> None:
        self._device = stream.device
        self._events: dict[str, torch.cuda.Event] = {}
        self._graph = torch.cuda.CUDAGraph()
        stream.wait_stream(torch.cuda.current_stream(stream.device))
        with torch.cuda.stream(stream):
            for _ in range(2):  # compiles and allocates whatever the kernels need, outside the capture
                run(lambda stage: None)
        stream.synchronize()
        with torch.cuda.graph(self._graph, pool=pool, stream=stream):
            self._mark("start")
            run(self._mark)

    def replay(self) -> None:
        """Run the kernels again on what their input buffers hold now, on the current stream, and wait for them."""
        self._graph.replay()
        torch.cuda.current_stream(self._device).synchronize()

    def stage_ms(self) -> dict[str, float]:
        """Device time of the last replay: each mark's milliseconds since the one before."""
        pairs = itertools.pairwise(self._events.items())
        return {name: start.elapsed_time(end) for (_, start), (name, end) in pairs}

    def _mark(self, stage: str) -> None:
        event = torch.cuda.Event(enable_timing=True, external=True)  # type: ignore[no-untyped-call]
        event.record(torch.cuda.current_stream())
        self._events[stage] = event


@dataclass(frozen=True)
class HostRow:
    """One row of an observation on the host, compacted: NumPy's views, since a small torch operation costs 3 us."""

    images: list[np.ndarray]  # the valid cameras' (uint8|float32)[224, 224, 3]
    tokens: np.ndarray  # int64[valid prompt tokens]
    state: np.ndarray  # float32[action_dim]

    @classmethod
    def of(cls, observation: Observation, row: int) -> "HostRow":
        def on_host(tensor: Tensor) -> np.ndarray:
            return tensor[row].cpu().numpy() if tensor.is_cuda else tensor.numpy()[row]

        images, mask = on_host(observation.images), on_host(observation.image_mask)
        tokens = on_host(observation.tokens)[on_host(observation.token_mask)]
        return cls([images[camera] for camera in np.flatnonzero(mask)], tokens, on_host(observation.state))


class CudaGraphBackend:
    """The engine's forward pass with PyTorch's kernels, those between the matrix products fused by Inductor."""

    name: ClassVar[str] = "cuda_graph"
    precisions: ClassVar[tuple[Tier, ...]] = ("bf16", "f32")

    def __init__(self, config: ModelConfig, load: LoadState, *, device: torch.device, precision: Tier) -> None:
        if config.vlm.num_kv_heads != 1:
            raise BackendError(f"{self.name} needs one key/value head, this model has {config.vlm.num_kv_heads}")
        self.config, self.device, self.precision = config, device, precision
        self._weights = self._pack(load)
        self._ops = self._make_ops()
        rows = MAX_CAMERAS * config.vision.num_tokens + _bucket(config.max_prompt_tokens) + config.action_horizon + 64
        self._cache = Cache.allocate(config, rows, device, self._weights.embed_tokens.dtype)
        self._tables: dict[int, Tensor | None] = {}
        self._calls: dict[CallShape, StaticCall] = {}
        self._graphs: dict[tuple[CallShape, str], Graph] = {}
        self._pool = torch.cuda.graph_pool_handle()
        self._stream = torch.cuda.Stream(device)  # type: ignore[no-untyped-call]

    @classmethod
    def unavailable(cls, device: torch.device) -> str | None:
        if device.type != "cuda":
            return "CUDA graphs need an NVIDIA GPU; use backend 'pytorch'"
        major, minor = torch.cuda.get_device_capability(device)
        if major < 8:
            return f"it needs compute capability 8.0 or newer for bfloat16, this GPU has {major}.{minor}"
        return None

    def warmup(self, observation: Observation, num_steps: int) -> None:
        """Capture the whole call for every prompt length, with this observation's number of cameras."""
        shape = self._shape(observation, HostRow.of(observation, 0), self.config.action_horizon, num_steps)
        for slots in range(BUCKET, _bucket(self.config.max_prompt_tokens) + 1, BUCKET):
            self._graph(CallShape(shape.cameras, slots, shape.horizon, num_steps, shape.float_images), "call")

    def prefix(self, observation: Observation) -> KVCache:
        if observation.batch_size != 1:
            raise BackendError(f"{self.name} holds the cache of one observation, not of {observation.batch_size}")
        row = HostRow.of(observation, 0)
        shape = self._shape(observation, row, self.config.action_horizon, 1)
        call, _ = self._run(shape, "prefix", row, np.zeros((shape.horizon, self.config.action_dim), np.float32))
        length = int(call.host.length[0])
        return KVCache(
            call.cache_k[:, None, None, :length].clone(),
            call.cache_v[:, None, None, :length].clone(),
            None,
            torch.tensor([length], device=self.device),
            observation.state.to(self.device),
        )

    def denoise(self, cache: KVCache, noise: Tensor, num_steps: int) -> Tensor:
        if cache.k.shape[1] != 1 or cache.mask is not None:
            raise BackendError(
                f"{self.name} denoises one unpadded observation's cache, not a batch of {cache.k.shape[1]}"
            )
        length, per_image = cache.k.shape[3], self.config.vision.num_tokens
        cameras = min(length // per_image, MAX_CAMERAS)
        shape = CallShape(cameras, _bucket(length - cameras * per_image), noise.shape[1], num_steps)
        graph, call = self._graph(shape, "denoise"), self._calls[shape]
        call.cache_k[:, :length], call.cache_v[:, :length] = cache.k[:, 0, 0], cache.v[:, 0, 0]
        call.inputs.length.fill_(length)
        call.inputs.noise.copy_(noise[0])
        call.inputs.state.copy_(cache.state[0])
        torch.cuda.synchronize(self.device)
        graph.replay()
        return call.x_t[-1:].clone()

    def sample(self, observation: Observation, noise: Tensor, num_steps: int) -> Sample:
        x_1 = noise.cpu().numpy()
        actions, stages = np.empty_like(x_1), []
        for i in range(observation.batch_size):
            row = HostRow.of(observation, i)
            call, graph = self._run(self._shape(observation, row, x_1.shape[1], num_steps), "call", row, x_1[i])
            actions[i] = call.actions_array
            stages.append(graph.stage_ms())
        return Sample(torch.from_numpy(actions), {name: sum(one[name] for one in stages) for name in stages[0]})

    def intermediates(self, observation: Observation, noise: Tensor, num_steps: int) -> Trace:
        rows = [self._trace_row(observation, noise, row, num_steps) for row in range(observation.batch_size)]
        return {name: torch.cat([row[name] for row in rows], dim=int(name != "actions")) for name in rows[0]}

    def describe(self) -> dict[str, Any]:
        captured = sorted({(s.cameras, s.prompt_slots, s.horizon, s.num_steps) for s in self._calls})
        return {
            "captured": [f"{c} cameras + {p} tokens, H={h}, {n} steps" for c, p, h, n in captured],
            "operations": dict(self._ops.origin),
        }

    def _pack(self, load: LoadState) -> Weights:
        return pack(self.config, load(self.device, "f32" if self.precision == "f32" else "bf16"))

    def _make_ops(self) -> Ops:
        return compiled()

    def _make_denoiser(self, shape: CallShape, table: Tensor | None) -> Denoiser | None:
        """None: the engine's operations one by one."""
        return None

    def _shape(self, observation: Observation, row: HostRow, horizon: int, num_steps: int) -> CallShape:
        cameras, tokens = len(row.images), len(row.tokens)
        if cameras > MAX_CAMERAS or tokens > self.config.max_prompt_tokens or cameras + tokens == 0:
            raise BackendError(
                f"{self.name} takes up to {MAX_CAMERAS} cameras and {self.config.max_prompt_tokens} prompt tokens, "
                f"this observation has {cameras} and {tokens}"
            )
        return CallShape(cameras, _bucket(tokens), horizon, num_steps, observation.images.dtype == torch.float32)

    def _run(self, shape: CallShape, part: str, row: HostRow, noise: np.ndarray) -> tuple[StaticCall, Graph]:
        """Replay (a part of) the call of one row's shape on its data and noise float32[H, action_dim]."""
        graph, call = self._graph(shape, part), self._calls[shape]
        call.write_inputs(row.images, noise, row.state, row.tokens)
        graph.replay()
        return call, graph

    def _graph(self, shape: CallShape, part: str) -> Graph:
        """The graph of a shape: the whole "call", or one half of it. Captured on first use."""
        if (shape, part) not in self._graphs:
            start = time.perf_counter()
            call = self._call(shape)
            runs = {"call": call.run, "prefix": _upload_and_encode(call), "denoise": call.denoise}
            self._graphs[shape, part] = Graph(runs[part], self._pool, self._stream)
            logger.info("captured %s of %s in %.2f s", part, shape, time.perf_counter() - start)
        return self._graphs[shape, part]

    def _call(self, shape: CallShape) -> StaticCall:
        if shape.num_steps not in self._tables:
            table = modulation(self.config, self._weights.conditioning, shape.num_steps)
            self._tables[shape.num_steps] = None if table is None else table.to(self.device)
        if shape not in self._calls:
            rows = shape.cache_rows(self.config)
            if rows > self._cache.k.shape[1]:
                raise BackendError(f"{self.name} has {self._cache.k.shape[1]} cache rows, {shape} needs {rows}")
            table = self._tables[shape.num_steps]
            denoiser = self._make_denoiser(shape, table)
            self._calls[shape] = StaticCall(self.config, self._weights, self._ops, shape, self._cache, table, denoiser)
        return self._calls[shape]

    def _trace_row(self, observation: Observation, noise: Tensor, row: int, num_steps: int) -> Trace:
        """One row's intermediates in golden layouts: the cache goes back to its padded slots."""
        one, x_1 = HostRow.of(observation, row), noise[row].cpu().numpy()
        call, _ = self._run(self._shape(observation, one, len(x_1), num_steps), "call", one, x_1)
        length, per_image = int(call.host.length[0]), self.config.vision.num_tokens
        cameras = observation.image_mask[row].repeat_interleave(per_image)
        valid = torch.cat((cameras, observation.token_mask[row])).cpu()
        return golden_trace(call, length, valid)


def golden_trace(call: Any, length: int, valid: Tensor) -> Trace:
    """A call's intermediates in golden layouts: its `length` cache rows go back to the slots in `valid` bool[S]."""

    def padded(x: Tensor) -> Tensor:  # [layer, rows, K] -> [layer, 1, S, 1, K]
        out = torch.zeros(x.shape[0], len(valid), x.shape[-1])
        out[:, valid] = x[:, :length].float().cpu()
        return out[:, None, :, None]

    return {
        "kv_k": padded(call.cache_k),
        "kv_v": padded(call.cache_v),
        "x_t": call.x_t[:, None].clone(),
        "v_t": call.v_t[:, None].clone(),
        "actions": call.x_t[-1:].clone(),
    }


def _upload_and_encode(call: StaticCall) -> Callable[[Mark], None]:
    def run(mark: Mark) -> None:
        call.upload()
        call.encode(mark)

    return run


def _bucket(tokens: int) -> int:
    """A prompt length rounded up to its bucket."""
    return max(BUCKET, -(-tokens // BUCKET) * BUCKET)
