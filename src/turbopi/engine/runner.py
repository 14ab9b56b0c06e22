"""Calls as CUDA graphs: which are captured, kept, replayed and refused.

A call is two sequences of kernels, each a `Graph`. The first, vision, is for a number of valid cameras; it can start
before the prompt is known. The second, prefix and all denoising steps, is for a bucket, which rounds the prompt's
length up to a multiple of 16, too; inside it nothing is captured anew when pictures, prompt, state or noise change.
That of a conditioned call is for its form and the times that its actions may have, whatever is held or pulls; that of a
solver for its grid. A bucket that warm-up didn't capture is captured when first needed, with a log line, or refused if
the runner is `strict`. Graphs of the denoising loops used last are kept, see recent_loops.py. Observations run one
after the other here; batch_runner.py has them run together.
"""

import logging
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from turbopi.config import LIMITS, ImageResize, ModelConfig
from turbopi.engine.call import Cache, CallShape, Pictures, StaticCall
from turbopi.engine.cold_call import not_warm
from turbopi.engine.conditioned import conditioned_loop
from turbopi.engine.graph import Graph, Mark, building
from turbopi.engine.graph_cache import Loop, RecentLoops
from turbopi.engine.solving import evaluation_loops, solving
from turbopi.engine.weights import Weights, modulation, modulation_at
from turbopi.kernels.interface import Denoiser, KeepingDenoiser, Ops
from turbopi.models.observation import Observation
from turbopi.models.pi0.conditioning import Conditioning, Conditionings, Form, of_rows
from turbopi.models.pi0.kv_cache import KVCache
from turbopi.models.pi0.reference import Trace
from turbopi.models.pi0.sample import Sample
from turbopi.support.errors import BackendError, ObservationError

logger = logging.getLogger(__name__)

BUCKET = 16  # prompt tokens: at most 15 padded rows beside 256 a camera
MAX_CAMERAS = 4  # the cache is allocated for them
RESIZED = "vision of other sizes"  # the graph that begins with pictures of any size


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


class Begun:
    """What `GraphRunner.begin` returns: the pictures of one observation on their way through vision."""

    def __init__(self, runner: "GraphRunner", cameras: int, float_images: bool) -> None:
        self._runner, self.cameras, self.float_images = runner, cameras, float_images

    def finish(
        self,
        tokens: np.ndarray,
        state: np.ndarray,
        noise: np.ndarray,
        num_steps: int,
        conditioning: Conditioning | None = None,
    ) -> Sample:
        """Its actions: `turbopi.backends.base.BegunBatch` of one observation, given without the axis of the batch."""
        call, graph = self._runner._continue(self, "answer", tokens, state, noise, num_steps, conditioning)
        return Sample(torch.from_numpy(call.actions_array[None].copy()), graph.stage_ms())


class GraphRunner:
    """The backends that capture: a subclass says what is packed, with which operations and which denoiser.

    joint   whether the cache's keys and values are parts of one tensor
    """

    name: ClassVar[str]
    forms: ClassVar[tuple[Form, ...]] = ("solver", "tokens", "jacobian")
    strict = False

    def __init__(
        self, config: ModelConfig, weights: Weights, ops: Ops, device: torch.device, *, joint: bool = False
    ) -> None:
        self.config, self.device = config, device
        self._weights, self._ops = weights, ops
        # of any horizon: 18 kB an action, and nothing depends on how long the prompt is
        longest = CallShape(MAX_CAMERAS, bucket(config.max_prompt_tokens), Loop(1, LIMITS["action_horizon"]))
        self._cache = Cache.allocate(config, longest.cache_rows(config), device, weights.embed_tokens.dtype, joint)
        self._recent = RecentLoops(self._forget_all)
        self._tables: dict[tuple[int, tuple[float, ...]], Tensor | None] = {}  # by `Loop.table`
        self._calls: dict[CallShape, StaticCall] = {}
        self._pictures: dict[tuple[int, bool], Pictures] = {}  # by cameras, and whether they are float
        self._graphs: dict[tuple[CallShape | Pictures | None, str], Graph] = {}
        self._begun: object = None  # what may be finished
        self._pool: Any = None
        self._stream: torch.cuda.Stream | None = None  # that graphs are captured on
        self._warming = False

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
        """Capture the whole call for every prompt length, with this observation's number of cameras."""
        cameras, floats = int(observation.image_mask[0].sum()), observation.images.dtype == torch.float32
        actions = self.config.action_horizon if horizon is None else horizon
        if not required and cameras > MAX_CAMERAS:
            return
        self._warming = True
        try:
            self._check_cameras(cameras)
            loop = self._loop(conditioning, num_steps, actions)
            for slots in range(BUCKET, bucket(self.config.max_prompt_tokens) + 1, BUCKET):
                self._graph(CallShape(cameras, slots, loop, floats), "answer")
            if self._ops.resize_pictures is not None:
                self._graph(self._pictures_of(cameras, floats), RESIZED)
        finally:
            self._warming = False

    def prefix(self, observation: Observation) -> KVCache:
        if observation.batch_size != 1:
            raise BackendError(f"{self.name} holds the cache of one observation, not of {observation.batch_size}")
        noise = np.zeros((self.config.action_horizon, self.config.action_dim), np.float32)
        call, _ = self._run("prefix", HostRow.of(observation, 0), noise, 1)
        length = int(call.host.length[0])
        return KVCache(
            call.cache_k[:, None, None, :length].clone(),
            call.cache_v[:, None, None, :length].clone(),
            None,
            torch.tensor([length], device=self.device),
            observation.state.to(self.device),
        )

    def denoise(self, cache: KVCache, noise: Tensor, num_steps: int, *, conditioning: Conditionings = None) -> Tensor:
        if cache.k.shape[1] != 1 or cache.mask is not None:
            raise BackendError(
                f"{self.name} denoises one unpadded observation's cache, not a batch of {cache.k.shape[1]}"
            )
        length, per_image = cache.k.shape[3], self.config.vision.num_tokens
        cameras = min(length // per_image, MAX_CAMERAS)
        self._check_tokens(cameras, length - cameras * per_image)
        asked = of_rows(conditioning, 1)[0]
        loop = self._loop(asked, num_steps, noise.shape[1])
        shape = CallShape(cameras, bucket(length - cameras * per_image), loop)
        graph, call = self._graph(shape, "denoise"), self._calls[shape]
        for ours, given in ((call.cache_k, cache.k), (call.cache_v, cache.v)):
            ours[:, :length], ours[:, length:] = given[:, 0, 0], 0  # rows that are masked must be finite
        call.inputs.length.fill_(length)
        call.inputs.noise.copy_(torch.from_numpy(call.started(noise[0].cpu().numpy(), asked)))
        call.inputs.state.copy_(cache.state[0])
        graph.replay()
        return call.x_t[-1:].clone()

    def begin(self, pictures: Sequence[np.ndarray], resize: ImageResize | None = None) -> Begun:
        """`BatchRunner.begin_batch` of one observation. One at a time: this ends the turn of the one before."""
        self._check_cameras(len(pictures))
        begun = Begun(self, len(pictures), floats(pictures, resize))
        buffers = self._pictures_of(begun.cameras, begun.float_images)
        self._begun = None  # one given up may still be read from the buffers, but nobody gets what becomes of it
        with self._explaining():
            resized = buffers.resizes(pictures, resize)
            vision = self._graph(buffers, RESIZED if resized else "vision")
            vision.launch(*buffers.uploads(pictures, resize, resized))
        self._begun = begun
        return begun

    def sample(
        self, observation: Observation, noise: Tensor, num_steps: int, *, conditioning: Conditionings = None
    ) -> Sample:
        x_1, rows = noise.cpu().numpy(), [HostRow.of(observation, row) for row in range(observation.batch_size)]
        ran = [
            self.begin(row.images).finish(row.tokens, row.state, x_1[i], num_steps, asked)
            for i, (row, asked) in enumerate(zip(rows, of_rows(conditioning, len(rows)), strict=True))
        ]
        stages = {name: sum(one.stage_ms[name] for one in ran) for name in ran[0].stage_ms}
        return Sample(torch.cat([one.actions for one in ran]), stages)

    def intermediates(
        self, observation: Observation, noise: Tensor, num_steps: int, *, conditioning: Conditionings = None
    ) -> Trace:
        rows = [
            self._trace_row(observation, noise, row, num_steps, asked)
            for row, asked in enumerate(of_rows(conditioning, observation.batch_size))
        ]
        return {name: torch.cat([row[name] for row in rows], dim=int(name != "actions")) for name in rows[0]}

    def describe(self) -> dict[str, Any]:
        captured = sorted(
            # a call of another thread may add some
            {(s.cameras, s.prompt_slots, s.loop) for s, _ in list(self._graphs) if isinstance(s, CallShape)},
            key=lambda one: (*one[:2], *one[2][:2], str(one[2])),
        )
        return {
            "captured": [f"{cameras} cameras + {tokens} tokens, {loop}" for cameras, tokens, loop in captured],
            "graphs": {"kept": len(self._graphs), **self._recent.describe()},
            "operations": dict(self._ops.origin),
        }

    def _check_cameras(self, count: int) -> None:
        if count > MAX_CAMERAS:
            raise ObservationError(f"{self.name} takes up to {MAX_CAMERAS} cameras, this observation has {count}")

    def _check_tokens(self, cameras: int, tokens: int) -> None:
        most = self.config.max_prompt_tokens
        if tokens > most or cameras + tokens == 0:
            raise ObservationError(
                f"{self.name} takes up to {MAX_CAMERAS} cameras and {most} prompt tokens, this observation has "
                f"{cameras} and {tokens}"
            )

    @property
    def _times_by_token(self) -> bool:
        """Whether one launch of what `_make_denoiser` makes takes times by token."""
        return False

    def _loop(self, conditioning: Conditioning | None, num_steps: int, horizon: int) -> Loop:
        """Raises ObservationError for a horizon that no call may have, whatever its prompt and cameras."""
        if horizon > (most := LIMITS["action_horizon"]):
            raise ObservationError(f"the action horizon is {horizon}; it should be a whole number from 1 to {most}")
        by_token = self._times_by_token
        return conditioned_loop(conditioning, num_steps, horizon, self.config, times_by_token=by_token)

    def _make_denoiser(self, shape: CallShape, table: Tensor | None) -> Denoiser | None:
        """All denoising steps at once; None: the engine's operations one by one."""
        return None

    def _make_keeper(self, shape: CallShape, table: Tensor | None) -> KeepingDenoiser | None:
        """What goes forward through the expert where guidance by the Jacobian goes back; None: operations."""
        return None

    def _denoiser_of(self, shape: CallShape, table: Tensor | None) -> Denoiser | None:
        """`_make_denoiser`'s, or of a solver's loop one that launches it for each evaluation."""
        if shape.loop.integration is None:
            return self._make_denoiser(shape, table)
        return solving(self._make_denoiser, shape, table, self.config, self.device, by_token=self._times_by_token)

    def _run(
        self, part: str, row: HostRow, noise: np.ndarray, num_steps: int, conditioning: Conditioning | None = None
    ) -> tuple[StaticCall, Graph]:
        """Replay the call up to a part's end on one row and noise float32[H, action_dim]."""
        return self._continue(self.begin(row.images), part, row.tokens, row.state, noise, num_steps, conditioning)

    def _continue(
        self,
        begun: Begun,
        part: str,
        tokens: np.ndarray,
        state: np.ndarray,
        noise: np.ndarray,
        num_steps: int,
        conditioning: Conditioning | None = None,
    ) -> tuple[StaticCall, Graph]:
        """Replay a part behind vision, "prefix" or the whole "answer"."""
        self._check_turn(begun)
        cameras = begun.cameras
        self._check_tokens(cameras, len(tokens))
        loop = self._loop(conditioning, num_steps, len(noise))
        shape = CallShape(cameras, bucket(len(tokens)), loop, begun.float_images)
        with self._explaining():
            graph, call = self._graph(shape, part), self._calls[shape]
            call.write_inputs(noise, state, tokens, conditioning)
            graph.replay()
        self._begun = None
        return call, graph

    def _check_turn(self, begun: object) -> None:
        """Raise BackendError for what was finished, or whose pictures others have taken the place of."""
        if self._begun is not begun:
            raise BackendError(f"{self.name} has finished this observation, or begun another one since")

    @contextmanager
    def _explaining(self) -> Iterator[None]:
        """Around whatever runs on the GPU: see `_explain`."""
        try:
            yield
        except RuntimeError as error:
            self._explain(error)
            raise

    def _explain(self, error: RuntimeError) -> None:
        """A subclass that knows why the GPU failed for good raises a DeviceLost that says so."""

    def _graph(self, of: CallShape | Pictures, part: str) -> Graph:
        """Of pictures "vision" or `RESIZED`; of a shape the "answer" behind it, or its "prefix" or "denoise" alone.

        Captured on first use; ObservationError if that isn't allowed.
        """
        graph = self._graphs.get((of, part))
        if isinstance(of, CallShape):
            if graph is None and part == "answer":
                self._refuse_if_cold(of)
            self._recent.use(of.loop)
        if graph is None:
            start = time.perf_counter()
            with building(self.device):
                graph = self._graphs[of, part] = self._captured(of, part)
            what = f"{of.cameras} cameras" if isinstance(of, Pictures) else of
            logger.info("captured %s of %s in %.2f s", part, what, time.perf_counter() - start)
        return graph

    def _captured(self, of: CallShape | Pictures, part: str) -> Graph:
        if isinstance(of, Pictures):
            if part == RESIZED:
                return self._capture(of.run_resized, None, like=self._graph(of, "vision"))
            return self._capture(of.run, None)
        call = self._call(of)
        if part != "prefix" and call.denoiser is None:
            call.denoiser = self._denoiser_of(of, call.times.table)
        if part != "prefix" and of.loop.form == "jacobian" and call.keeper is None:
            call.keeper = self._make_keeper(of, call.times.table)
        run = {"answer": call.answer, "prefix": call.encode, "denoise": call.denoise}[part]
        return self._capture(run, None if part == "denoise" else self._graph(call.pictures, "vision"))

    def _refuse_if_cold(self, shape: CallShape) -> None:
        """Raise ObservationError for a shape that isn't captured, if that isn't allowed now."""
        if self.strict and not self._warming:
            warm = [s for s, part in self._graphs if isinstance(s, CallShape) and part == "answer"]
            raise not_warm(
                self.name,
                f"{shape.cameras} cameras, {shape.loop}",
                (f"{s.cameras} cameras, {s.loop}" for s in warm),
                conditioned=shape.loop.form != "plain",
                cameras=shape.cameras,
                horizons=shape.horizon,
                steps=shape.num_steps,
            )

    def _forget_all(self, loop: Loop) -> None:
        """Let go of a loop, and of its evaluations' that no other loop has or is."""
        self._forget(loop)
        kept = {*self._recent, *(one for other in self._recent for one in evaluation_loops(other))}
        for one in evaluation_loops(loop):
            if one not in kept:
                self._forget(one)

    def _forget(self, loop: Loop) -> None:
        """Let go of all that is a denoising loop's alone. Vision's graphs are every loop's."""
        if self.device.type == "cuda":  # one may still run whose call was interrupted
            torch.cuda.current_stream(self.device).synchronize()
        gone = {shape for shape in self._calls if shape.loop == loop}
        for kept in [key for key in self._graphs if key[0] in gone]:
            del self._graphs[kept]
        for shape in gone:
            del self._calls[shape]
        if loop.table not in {other.table for other in self._recent}:
            self._tables.pop(loop.table, None)

    def _capture(self, run: Callable[[Mark], None], after: Graph | None, like: Graph | None = None) -> Graph:
        """All graphs share memory, as they run one after the other."""
        if self._stream is None:
            self._pool = torch.cuda.graph_pool_handle()
            self._stream = torch.cuda.Stream(self.device)  # type: ignore[no-untyped-call]
        return Graph(run, self._pool, self._stream, after, like)

    def _pictures_of(self, cameras: int, float_images: bool) -> Pictures:
        key, slots = (cameras, float_images), bucket(self.config.max_prompt_tokens)
        if self.strict and not self._warming and (self._pictures.get(key), "vision") not in self._graphs:
            warm = (f"{of.cameras} cameras" for of, _ in self._graphs if isinstance(of, Pictures))
            raise not_warm(self.name, f"{cameras} cameras", warm, cameras=cameras)
        if key not in self._pictures:
            self._pictures[key] = Pictures(self.config, self._weights, self._ops, cameras, float_images, slots)
        return self._pictures[key]

    def _table(self, loop: Loop) -> Tensor | None:
        """Its modulation, on the device."""
        if loop.table not in self._tables:
            table = (
                modulation_at(self.config, self._weights.conditioning, np.array(loop.times, np.float32))
                if loop.times
                else modulation(self.config, self._weights.conditioning, loop.steps)
            )
            self._tables[loop.table] = None if table is None else table.to(self.device)
        return self._tables[loop.table]

    def _call(self, shape: CallShape) -> StaticCall:
        if shape not in self._calls:
            pictures, table = self._pictures_of(shape.cameras, shape.float_images), self._table(shape.loop)
            self._calls[shape] = StaticCall(self.config, self._weights, self._ops, shape, pictures, self._cache, table)
        return self._calls[shape]

    def _trace_row(
        self, observation: Observation, noise: Tensor, row: int, num_steps: int, conditioning: Conditioning | None
    ) -> Trace:
        """One row's intermediates in golden layouts: the cache goes back to its padded slots."""
        one, x_1 = HostRow.of(observation, row), noise[row].cpu().numpy()
        call, _ = self._run("answer", one, x_1, num_steps, conditioning)
        length, per_image = int(call.host.length[0]), self.config.vision.num_tokens
        cameras = observation.image_mask[row].repeat_interleave(per_image)
        valid = torch.cat((cameras, observation.token_mask[row])).cpu()
        return golden_trace(call, length, valid)


def floats(pictures: Sequence[np.ndarray], resize: ImageResize | None) -> bool:
    """Whether vision is given float32 pictures."""
    if not pictures:
        return False
    return bool(pictures[0].dtype == np.float32) if resize is None else resize != "openpi"


def golden_trace(call: Any, length: int, valid: Tensor) -> Trace:
    """A call's intermediates in golden layouts: its `length` cache rows go back to the slots in `valid` bool[S]."""
    return padded_trace(call.cache_k[:, :length], call.cache_v[:, :length], call.x_t, call.v_t, valid)


def padded_trace(k: Tensor, v: Tensor, x_t: Tensor, v_t: Tensor, valid: Tensor) -> Trace:
    """One observation's intermediates in golden layouts: k, v [layer, length, K], x_t [N + 1, H, A], v_t [N, H, A]."""

    def padded(x: Tensor) -> Tensor:  # -> [layer, 1, S, 1, K]
        out = torch.zeros(x.shape[0], len(valid), x.shape[-1])
        out[:, valid] = x.float().cpu()
        return out[:, None, :, None]

    return {
        "kv_k": padded(k),
        "kv_v": padded(v),
        "x_t": x_t[:, None].clone(),
        "v_t": v_t[:, None].clone(),
        "actions": x_t[-1:].clone(),
    }


def bucket(tokens: int) -> int:
    """A prompt length rounded up to its bucket."""
    return max(BUCKET, -(-tokens // BUCKET) * BUCKET)
