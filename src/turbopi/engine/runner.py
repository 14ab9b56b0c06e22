"""One observation's call as CUDA graphs: load, allocate, warm up, capture, replay.

Which graphs there are: plan.py; which stay captured: graph_cache.py. A graph that warm-up didn't capture is captured
when first needed, with a log line, or refused if the runner is `strict`. Observations run one after the other here;
batch_runner.py has them run together.
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
from turbopi.engine import plan
from turbopi.engine.call import Cache, CallShape, Images, StaticCall
from turbopi.engine.graph import Graph, Mark, building
from turbopi.engine.graph_cache import Captured, GraphCache
from turbopi.engine.loops import EulerLoop, Loop, Table, loop_of_call
from turbopi.engine.plan import MAX_CAMERAS, GraphKey, bucket
from turbopi.engine.solving import solving
from turbopi.engine.trace import golden_trace
from turbopi.engine.weights import Weights, modulation_at
from turbopi.kernels.interface import Denoiser, KeepingDenoiser, Ops
from turbopi.models.observation import Observation
from turbopi.models.pi0.conditioning import Conditioning, Conditionings, Form, of_rows
from turbopi.models.pi0.kv_cache import KVCache
from turbopi.models.pi0.reference import Trace
from turbopi.models.pi0.sample import Sample
from turbopi.support.errors import BackendError, ObservationError

logger = logging.getLogger(__name__)


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
    """What `GraphRunner.begin` returns: one observation whose images are on their way through vision."""

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
        call, stages = self._runner._answer(self, tokens, state, noise, num_steps, conditioning)
        return Sample(torch.from_numpy(call.actions_array[None].copy()), stages)


class GraphRunner:
    """The backends that capture: a subclass says what is packed, with which operations and which denoiser.

    joint   whether the cache's keys and values are parts of one tensor
    """

    name: ClassVar[str]
    forms: ClassVar[tuple[Form, ...]] = ("solver", "tokens", "jacobian", "noise", "two_prompts")
    strict = False

    def __init__(
        self, config: ModelConfig, weights: Weights, ops: Ops, device: torch.device, *, joint: bool = False
    ) -> None:
        self.config, self.device = config, device
        self._weights, self._ops = weights, ops
        # of any horizon: 18 kB an action, and nothing depends on how long the prompt is
        longest = CallShape(MAX_CAMERAS, bucket(config.max_prompt_tokens), EulerLoop(1, LIMITS["action_horizon"]))
        self._cache = Cache.allocate(config, longest.cache_rows(config), device, weights.embed_tokens.dtype, joint)
        self._graphs = GraphCache(self._forget)
        self._tables: dict[Table, Tensor | None] = {}  # modulation
        self._begun: object = None  # what may be finished
        self._pool: Any = None
        self._stream: torch.cuda.Stream | None = None  # that graphs are captured on
        self._warming = False

    # -- warm up -------------------------------------------------------------------------------------------------------

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
        cameras, float_images = int(observation.image_mask[0].sum()), observation.images.dtype == torch.float32
        if not required and cameras > MAX_CAMERAS:
            return
        self._check_cameras(cameras)
        actions = self.config.action_horizon if horizon is None else horizon
        two = conditioning is not None and conditioning.prompt is not None
        ahead, back = self._passes(conditioning, num_steps, actions)
        loop, *others = (self._loop(one, num_steps, actions) for one in ([ahead] if back is None else [ahead, back]))
        again = (loop, *others) if others else ()
        self._warm(2 if two else 1, cameras, float_images, loop, two_prompts=two, again=again)

    def _warm(self, batch: int, images: int, float_images: bool, loop: Loop, **options: Any) -> None:
        resizes, most = self._ops.resize_images is not None, self.config.max_prompt_tokens
        self._warming = True
        try:
            sizes = batch, images, float_images, loop, most
            for key in plan.warm_graphs(*sizes, resizes=resizes, **options):
                self._graph(key)
        finally:
            self._warming = False

    # -- capture -------------------------------------------------------------------------------------------------------

    def _graph(self, key: GraphKey) -> Captured:
        """A graph and its buffers, captured when first needed; ObservationError if that isn't allowed now."""
        found = self._graphs.get(key)
        if found is not None:
            return found
        if self.strict and not self._warming:
            raise plan.cold_graph(self.name, key, self._graphs.entries)
        start = time.perf_counter()
        with building(self.device):
            found = self._graphs.capture(key, self._make)
        logger.info("captured %s of %s in %.2f s", key.part, key, time.perf_counter() - start)
        return found

    def _make(self, key: GraphKey) -> Captured:
        """The buffers of a graph, and the graph."""
        if key.part == "vision":
            images = self._images(key)
            return Captured(self._capture(images.run, None), images)
        vision = self._graph(key.vision)
        if key.part == "resized":
            return Captured(self._capture(vision.buffers.run_resized, None, like=vision.graph), vision.buffers)
        assert key.loop is not None, key
        shape, table = CallShape(key.images, key.slots, key.loop, key.float_images), self._table(key.loop)
        call = StaticCall(self.config, self._weights, self._ops, shape, vision.buffers, self._cache, table)
        if key.part != "prefix":
            call.denoiser = self._denoiser_of(shape, table)
            if key.loop.form == "jacobian":
                call.keeper = self._make_keeper(shape, table)
        run = {"answer": call.answer, "prefix": call.encode, "denoise": call.denoise}[key.part]
        return Captured(self._capture(run, None if key.part == "denoise" else vision.graph), call)

    def _images(self, key: GraphKey) -> Images:
        """Vision's buffers."""
        slots = bucket(self.config.max_prompt_tokens)
        return Images(self.config, self._weights, self._ops, key.images, key.float_images, slots)

    def _capture(self, run: Callable[[Mark], None], after: Graph | None, like: Graph | None = None) -> Graph:
        """All graphs share memory, as they run one after the other."""
        if self._stream is None:
            self._pool = torch.cuda.graph_pool_handle()
            self._stream = torch.cuda.Stream(self.device)  # type: ignore[no-untyped-call]
        return Graph(run, self._pool, self._stream, after, like)

    def _table(self, loop: Loop) -> Tensor | None:
        """Its modulation, on the device."""
        if loop.table not in self._tables:
            times = loop.table_times(self.config.time_grid)
            table = modulation_at(self.config, self._weights.conditioning, times)
            self._tables[loop.table] = None if table is None else table.to(self.device)
        return self._tables[loop.table]

    def _denoiser_of(self, shape: CallShape, table: Tensor | None) -> Denoiser | None:
        """`_make_denoiser`'s, or of a solver's loop one that launches it for each evaluation."""
        if shape.loop.form != "solver":
            return self._make_denoiser(shape, table)
        return solving(self._make_denoiser, shape, table, self.config, self.device, by_token=self._times_by_token)

    @property
    def _times_by_token(self) -> bool:
        """Whether one launch of what `_make_denoiser` makes takes times by token."""
        return False

    def _make_denoiser(self, shape: CallShape, table: Tensor | None) -> Denoiser | None:
        """All denoising steps at once; None: the engine's operations one by one."""
        return None

    def _make_keeper(self, shape: CallShape, table: Tensor | None) -> KeepingDenoiser | None:
        """Forward through the expert where guidance by the Jacobian goes backward; None: operations."""
        return None

    def _forget(self, loop: Loop) -> None:
        """Let go of what is a denoising loop's alone, beside its graphs."""
        if self.device.type == "cuda":  # one may still run whose call was interrupted
            torch.cuda.current_stream(self.device).synchronize()
        if loop.table not in {other.table for other in self._graphs.loops}:
            self._tables.pop(loop.table, None)

    # -- replay --------------------------------------------------------------------------------------------------------

    def begin(self, images: Sequence[np.ndarray], resize: ImageResize | None = None) -> Begun:
        """`BatchRunner.begin_batch` of one observation. One at a time: this ends the turn of the one before."""
        self._check_cameras(len(images))
        begun = Begun(self, len(images), floats(images, resize))
        self._begun = None  # an earlier one may still be read from the buffers, but nobody gets its actions
        with self._explaining():
            key = GraphKey("vision", 1, begun.cameras, begun.float_images)
            graph, uploads = self._vision(key, images, resize)
            graph.launch(*uploads)
        self._begun = begun
        return begun

    def _vision(
        self, key: GraphKey, images: Sequence[np.ndarray], resize: ImageResize | None
    ) -> tuple[Graph, list[Callable[[], None]]]:
        """The graph for these images, and what sends them, part by part: see `Graph.launch`."""
        graph, buffers = self._graph(key)
        if resized := buffers.resizes(images, resize):
            graph = self._graph(key._replace(part="resized")).graph
        return graph, buffers.uploads(images, resize, resized)

    def _replay(
        self,
        begun: Begun,
        part: plan.Part,
        tokens: np.ndarray,
        state: np.ndarray,
        noise: np.ndarray,
        num_steps: int,
        conditioning: Conditioning | None = None,
    ) -> tuple[Graph, StaticCall]:
        """Replay a part behind vision, "prefix" or the whole "answer", on one row and noise float32[H, action_dim]."""
        self._check_turn(begun)
        self._check_one_prompt(conditioning)
        self._check_tokens(begun.cameras, len(tokens))
        loop = self._loop(conditioning, num_steps, len(noise))
        with self._explaining():
            key = GraphKey(part, 1, begun.cameras, begun.float_images, bucket(len(tokens)), loop)
            graph, call = self._graph(key)
            call.write_inputs(noise, state, tokens, conditioning)
            graph.replay()
        self._begun = None
        return graph, call

    def _answer(
        self,
        begun: Begun,
        tokens: np.ndarray,
        state: np.ndarray,
        noise: np.ndarray,
        num_steps: int,
        conditioning: Conditioning | None,
    ) -> tuple[StaticCall, dict[str, float]]:
        """Run one row's whole call: the buffers that have its actions, and its stages' times."""
        ahead, back = self._passes(conditioning, num_steps, len(noise))
        graph, first = self._replay(begun, "answer", tokens, state, noise, num_steps, ahead)
        stages = graph.stage_ms()
        if conditioning is None or conditioning.noise is None:
            return first, stages
        shape = first.shape

        def denoised(x: Tensor, one: Conditioning | None) -> StaticCall:
            """From the prefix that is in the cache."""
            loop = self._loop(one, num_steps, len(noise))
            graph, call = self._graph(
                GraphKey("denoise", 1, shape.cameras, shape.float_images, shape.prompt_slots, loop)
            )
            call.host.length.copy_(first.host.length)
            call.inputs.length.copy_(first.inputs.length)
            call.inputs.state.copy_(first.inputs.state)
            call.inputs.noise.copy_(torch.from_numpy(call.started(x.numpy(), one)))
            graph.replay()
            stages["denoise"] += graph.stage_ms()["denoise"]
            return call

        def loop(x: Tensor, backwards: bool) -> Tensor:
            return torch.from_numpy((denoised(x, back) if backwards else first).actions_array.copy())

        with self._explaining():
            return denoised(conditioning.noise.chosen(torch.from_numpy(noise), loop), ahead), stages

    def _passes(
        self, conditioning: Conditioning | None, num_steps: int, horizon: int
    ) -> tuple[Conditioning | None, Conditioning | None]:
        """The loop's conditioning and, where noise is chosen, that of the loop back. Raises ObservationError."""
        if conditioning is None or conditioning.noise is None:
            return conditioning, None
        conditioning.check(num_steps, horizon, self.config.action_dim)
        return conditioning.passes(num_steps, horizon, self.config.time_grid)

    def sample(
        self, observation: Observation, noise: Tensor, num_steps: int, *, conditioning: Conditionings = None
    ) -> Sample:
        x_1, rows = noise.cpu().numpy(), [HostRow.of(observation, row) for row in range(observation.batch_size)]
        ran = [
            self.begin(row.images).finish(row.tokens, row.state, x_1[i], num_steps, one)
            for i, (row, one) in enumerate(zip(rows, of_rows(conditioning, len(rows)), strict=True))
        ]
        stages = {name: sum(one.stage_ms[name] for one in ran) for name in ran[0].stage_ms}
        return Sample(torch.cat([one.actions for one in ran]), stages)

    def _loop(self, conditioning: Conditioning | None, num_steps: int, horizon: int) -> Loop:
        """Raises ObservationError for a horizon that no call may have, whatever its prompt and cameras."""
        if horizon > (most := LIMITS["action_horizon"]):
            raise ObservationError(f"the action horizon is {horizon}; it should be a whole number from 1 to {most}")
        return loop_of_call(conditioning, num_steps, horizon, self.config, times_by_token=self._times_by_token)

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

    def _check_one_prompt(self, conditioning: Conditioning | None) -> None:
        if conditioning is not None and conditioning.prompt is not None:
            raise BackendError(f"{self.name} computes two prompts in `sample` and in batches begun as such alone")

    def _check_turn(self, begun: object) -> None:
        """Raise BackendError for what was finished, or whose images were overwritten by a later observation's."""
        if self._begun is not begun:
            raise BackendError(f"{self.name} has finished this observation, or begun another one since")

    @contextmanager
    def _explaining(self) -> Iterator[None]:
        """Around all that runs on the GPU: see `_explain`."""
        try:
            yield
        except RuntimeError as error:
            self._explain(error)
            raise

    def _explain(self, error: RuntimeError) -> None:
        """A subclass that knows why the GPU failed for good raises a DeviceLost that says so."""

    # -- parts of a call, and what is reported -------------------------------------------------------------------------

    def prefix(self, observation: Observation) -> KVCache:
        if observation.batch_size != 1:
            raise BackendError(f"{self.name} holds the cache of one observation, not of {observation.batch_size}")
        row = HostRow.of(observation, 0)
        noise = np.zeros((self.config.action_horizon, self.config.action_dim), np.float32)
        _, call = self._replay(self.begin(row.images), "prefix", row.tokens, row.state, noise, 1)
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
        one = of_rows(conditioning, 1)[0]
        self._check_one_prompt(one)
        ahead, back = self._passes(one, num_steps, noise.shape[1])
        if one is not None and one.noise is not None:

            def run(x: Tensor, backwards: bool) -> Tensor:
                return self.denoise(cache, x, num_steps, conditioning=back if backwards else ahead)

            noise = one.noise.chosen(noise.to(self.device), run)
        one = ahead
        loop = self._loop(one, num_steps, noise.shape[1])
        graph, call = self._graph(GraphKey("denoise", 1, cameras, False, bucket(length - cameras * per_image), loop))
        for ours, given in ((call.cache_k, cache.k), (call.cache_v, cache.v)):
            ours[:, :length], ours[:, length:] = given[:, 0, 0], 0  # rows that are masked must be finite
        call.inputs.length.fill_(length)
        call.inputs.noise.copy_(torch.from_numpy(call.started(noise[0].cpu().numpy(), one)))
        call.inputs.state.copy_(cache.state[0])
        graph.replay()
        return call.x_t[-1:].clone()

    def intermediates(
        self, observation: Observation, noise: Tensor, num_steps: int, *, conditioning: Conditionings = None
    ) -> Trace:
        traces = []
        for b, one in enumerate(of_rows(conditioning, observation.batch_size)):
            row, x_1 = HostRow.of(observation, b), noise[b].cpu().numpy()
            call, _ = self._answer(self.begin(row.images), row.tokens, row.state, x_1, num_steps, one)
            traces.append(golden_trace(call, int(call.host.length[0]), self._valid(observation, b)))
        return {name: torch.cat([one[name] for one in traces], dim=int(name != "actions")) for name in traces[0]}

    def _valid(self, observation: Observation, row: int) -> Tensor:
        """bool[S]: the slots of the reference's padded prefix that a row has."""
        cameras = observation.image_mask[row].repeat_interleave(self.config.vision.num_tokens)
        return torch.cat((cameras, observation.token_mask[row])).cpu()

    def describe(self) -> dict[str, Any]:
        return {
            "captured": plan.singles(list(self._graphs.entries)),  # a call of another thread may add some
            "graphs": self._graphs.describe(),
            "operations": dict(self._ops.origin),
        }


def floats(images: Sequence[np.ndarray], resize: ImageResize | None) -> bool:
    """Whether vision is given float32 images."""
    if not images:
        return False
    return bool(images[0].dtype == np.float32) if resize is None else resize != "openpi"
