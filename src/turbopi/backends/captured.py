"""Backend `cuda_graph` for families that the engine has no plan for: their reference, compiled and captured.

A reference whose own methods are other ones gives the captured ones by its `stages`.

An observation is three kinds of graph for so many cameras: "vision", "prefix", for a prompt of any length, and "step",
one evaluation of the expert. The loop around the steps is the reference's own (`integrate`), so it takes whatever that
does but gradients. Images are resized on the device.

Several observations are the same graphs with a row for each: cameras that an observation hasn't are masked. Those that
aren't plain (`Conditioning.form`) run alone.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from turbopi.backends.base import BegunBatch, LoadState, Precision, Sample, StageTimer, Trace
from turbopi.backends.captured_graphs import Answer, Graphs, Seen, Size, Step, fill, inputs_of, write_prompts
from turbopi.backends.captured_rows import BegunRows, Images, Turn, on_host
from turbopi.backends.cuda_graph import CudaGraphBackend
from turbopi.backends.pytorch import PyTorchBackend
from turbopi.backends.pytorch_compile import PyTorchCompileBackend
from turbopi.backends.pytorch_compile import compiled as compile_stage
from turbopi.config import ImageResize, Network, empty_cameras, memory_of
from turbopi.engine.flat import Staged
from turbopi.engine.graph import Graph, Mark, building
from turbopi.engine.loops import batch_form
from turbopi.engine.plan import cold_call, split
from turbopi.engine.resize import Resizer
from turbopi.models.observation import Observation, Past, PastObservation, past_of, remembering
from turbopi.models.pi0.conditioning import Conditioning, Conditionings, Form, of_rows
from turbopi.models.pi0.integrate import integrate
from turbopi.models.pi0.kv_cache import KVCache
from turbopi.preprocess.images import fit_unit
from turbopi.support.errors import BackendError
from turbopi.support.toolchain import make_caches_writable


class CapturedBackend(PyTorchBackend):
    """The reference of a family, its stages through torch.compile where there is a compiler, in CUDA graphs."""

    name: ClassVar[str] = "cuda_graph"
    precisions: ClassVar[tuple[Precision, ...]] = ("bf16", "f32")
    forms: ClassVar[tuple[Form, ...]] = ("solver", "tokens")
    writes: ClassVar[bool] = False
    begins: ClassVar[bool] = True
    runs_batches: ClassVar[bool] = True
    batch_forms: ClassVar[tuple[Form, ...]] = ()
    # predicted for SmolVLA on an H200 (docs/dev/log/batches.md); a server measures its own
    COSTS: ClassVar[Mapping[int, float]] = {1: 1, 2: 1.15, 4: 1.4, 8: 2}

    @classmethod
    def unavailable(cls, device: torch.device) -> str | None:
        return CudaGraphBackend.unavailable(device)

    @classmethod
    def refuses_model(cls, config: Network) -> str | None:
        if empty_cameras(config):
            return (
                f"backend {cls.name!r} runs the cameras that are there, and this model reads tokens around images that "
                "aren't (add_image_special_tokens with empty_cameras); take backend 'pytorch'"
            )
        return super().refuses_model(config)

    def load_weights(self, load: LoadState) -> None:
        make_caches_writable()
        super().load_weights(load)
        self._stages = self._make_stages()
        if self.precision != "f32" and hasattr(self.model, "attend"):
            self.model.attend = _attend
        self._graphs: dict[Size, Graphs] = {}
        self._pool = torch.cuda.graph_pool_handle()
        self._stream: torch.cuda.Stream = torch.cuda.Stream(self.device)  # type: ignore[no-untyped-call]
        self._times: dict[bytes, Tensor] = {}
        self._turn: Turn | None = None  # of the observations whose images are in the inputs
        self._causal: Tensor | None = None  # of the prompt that comes next, as `SeenObservation`'s
        self._compiles = PyTorchCompileBackend.unavailable(self.device) is None
        self._embed_images, self._prefix_of, self._velocity = map(self._stage, self._to_compile)

    def _make_stages(self) -> Any:
        return getattr(self.model, "stages", self.model)

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
        graphs = self._captured(int(observation.image_mask[0].sum()))
        self._step(graphs, horizon or self.config.action_horizon, by_action=False)
        if conditioning is not None and conditioning.form == "tokens":
            self._step(graphs, horizon or self.config.action_horizon, by_action=True)

    @property
    def batch_costs(self) -> Mapping[int, float]:
        return self.COSTS if self.runs_batches else {1: 1}

    def warmup_batches(
        self,
        observation: Observation,
        num_steps: int,
        horizon: int | None,
        batches: Sequence[int],
        conditioning: Conditioning | None = None,
    ) -> None:
        if conditioning is not None and conditioning.form != "plain":
            return
        for size in sorted({size for count in batches for size in split(count, self.batch_costs)} - {1}):
            graphs = self._captured(int(observation.image_mask[0].sum()), size)
            self._prepare_loop(graphs, num_steps, horizon or self.config.action_horizon)

    def begin_batch(
        self,
        images: Sequence[Images],
        resize: ImageResize | None = None,
        forms: Sequence[Form] | None = None,
    ) -> BegunBatch:
        return BegunRows(self, images, resize or "lerobot", [Past()] * len(images), forms or ["plain"] * len(images))

    def sample(
        self, observation: Observation, noise: Tensor, num_steps: int, *, conditioning: Conditionings = None
    ) -> Sample:
        images, pasts, tokens, state = on_host(observation)
        forms = [batch_form(one) for one in of_rows(conditioning, len(images))]
        begun = BegunRows(self, images, "lerobot", pasts, forms)
        return begun.finish(tokens, state, noise.cpu().numpy(), num_steps, conditioning)

    def prefix(self, observation: Observation) -> KVCache:
        raise self._lacks("halves of a call", "call `sample`")

    def denoise(self, cache: KVCache, noise: Tensor, num_steps: int, *, conditioning: Conditionings = None) -> Tensor:
        raise self._lacks("halves of a call", "call `sample`")

    def intermediates(
        self, observation: Observation, noise: Tensor, num_steps: int, *, conditioning: Conditionings = None
    ) -> Trace:
        """Of the captured graphs, one observation after the other: places of the prefix that none has are 0."""
        self.check_conditioning(conditioning)
        images, pasts, tokens, state = on_host(observation)
        traces = []
        for row, one in enumerate(of_rows(conditioning, len(tokens))):
            its = slice(row, row + 1)
            turn = self.see(images[its], "lerobot", pasts[its])
            inputs = tokens[its], state[its], noise[its].cpu().numpy()
            done = self.answer(turn, *inputs, num_steps, one, StageTimer(self.device), keep=True)
            cache = turn.graphs.cache
            assert cache.mask is not None
            parts = {name: part[:, :, :, cache.mask[0]] for name, part in _parts(cache)}
            if isinstance(observation, PastObservation):
                parts = {name: self._stages.to_padded(part, observation.row(row)) for name, part in parts.items()}
            trace = {name: part.transpose(2, 3) for name, part in parts.items()}
            trace["x_t"] = torch.stack([x for x, _ in done.evaluations] + [done.actions])
            trace["v_t"] = torch.stack([v for _, v in done.evaluations])
            traces.append(trace | {"actions": done.actions})
        return {name: _joined([one[name] for one in traces], int(name != "actions")) for name in traces[0]}

    def describe(self) -> dict[str, Any]:
        sizes = sorted(self._graphs)
        described = {"compiled": self._compiles, "cameras": [cameras for cameras, batch in sizes if batch == 1]}
        batches = [f"{batch} observations with up to {cameras} cameras" for cameras, batch in sizes if batch > 1]
        return described | ({"batches": batches} if batches else {})

    # -- one observation, or several -----------------------------------------------------------------------------------

    def see(
        self, images: Sequence[Images], resize: ImageResize, pasts: Sequence[Past], size: Size | None = None
    ) -> Turn:
        """Start on the images of observations, and those before; what `answer` needs of it.

        size  of the graphs, for at least so many; None: of one observation's
        """
        cameras, batch = size or (len(images[0]), 1)
        if self.strict and (cameras, batch) not in self._graphs:
            raise self._cold((cameras, batch), self.config.action_horizon)
        graphs = self._captured(cameras, batch)
        given = [
            images[row][camera] if row < len(images) and camera < len(images[row]) else None
            for row in range(batch)
            for camera in range(cameras)
        ]
        for image, place in zip(given, graphs.inputs.images.flatten(0, 1), strict=True):
            if image is None:
                place.zero_()  # what was there before may be NaN, which no mask takes away
            elif image.dtype == np.float32:  # as the model reads it
                place.copy_(torch.from_numpy(image))
            elif graphs.resizer is None:
                on_device = torch.from_numpy(np.ascontiguousarray(image)).to(self.device)
                place.copy_(fit_unit(on_device[None].float() / 255, tuple(place.shape[:2]), resize)[0])
        if graphs.resizer is not None:
            graphs.resizer.upload([None if one is None or one.dtype == np.float32 else one for one in given], resize)
        if batch > 1:
            there = np.array([one is not None for one in given]).reshape(batch, cameras)
            graphs.staged.writable()["image_mask"][:] = there
            graphs.staged.send()
        for row, past in enumerate(pasts):
            for name, part in past.parts.items():
                past_of(graphs.inputs).parts[name][row : row + 1, : part.shape[1]].copy_(part)
        graphs.vision.launch()
        self._turn = Turn(graphs)
        return self._turn

    def answer(
        self,
        turn: Turn,
        tokens: Sequence[np.ndarray],
        state: np.ndarray,
        noise: np.ndarray,
        num_steps: int,
        conditioning: Conditioning | None,
        timer: StageTimer,
        *,
        keep: bool = False,
    ) -> Answer:
        """Actions of the observations, the first of so many rows as the graphs have; keep: and all that led to them."""
        graphs: Graphs = turn.graphs
        self._give_prompts(turn, tokens, state)
        graphs.prefix.launch()
        timer.mark("prefix")
        staged = graphs.noise_of(noise.shape[1], self.config)
        fill(staged.writable()["noise"], noise)
        staged.send()
        answer = self._denoise(graphs, noise.shape[1], num_steps, conditioning, keep)
        timer.mark("denoise")
        return answer

    def _give_prompts(self, turn: Turn, tokens: Sequence[np.ndarray], state: np.ndarray | None = None) -> None:
        """Put them behind the images that `see` has begun on."""
        if turn is not self._turn:
            raise BackendError("another observation was begun before this one was finished")
        staged: Staged = turn.graphs.staged
        write_prompts(staged.writable(), tokens, state, self._causal)
        staged.send()
        self._causal = None

    def _denoise(
        self, graphs: Graphs, horizon: int, num_steps: int, conditioning: Conditioning | None, keep: bool
    ) -> Answer:
        """From the `noise` of the graphs."""

        def velocity(x: Tensor, time: Tensor, first: bool) -> tuple[Tensor, Tensor]:
            if self.strict and (x.shape[1], time.ndim == 3) not in graphs.steps:
                raise self._cold(graphs.size, x.shape[1], conditioned=time.ndim == 3)
            step = self._step(graphs, x.shape[1], by_action=time.ndim == 3)
            step.x.copy_(x)
            step.time.copy_(time)
            step.graph.launch()
            return step.v, step.v.clone()

        grid, x_1 = self.config.time_grid, graphs.noise_of(horizon, self.config).tensors["noise"]
        with torch.no_grad():
            done = integrate(velocity, self._embed_times, x_1, num_steps, conditioning, grid=grid, keep=keep)
        return Answer(done.actions, [(x, v) for x, _, v in done.evaluations])

    # -- graphs --------------------------------------------------------------------------------------------------------

    def _stage(self, stage: Callable[..., Any]) -> Callable[..., Any]:
        return compile_stage(stage, dynamic=False) if self._compiles else stage

    @property
    def _to_compile(self) -> tuple[Callable[..., Any], ...]:
        return self._stages.embed_images, self._prefix_stage, self._stages.velocity

    def _vision(self, observation: Observation, mark: Mark) -> Tensor:
        if isinstance(observation, PastObservation):
            return self._embed_images(observation)
        return self._embed_images(observation.images.transpose(0, 1).flatten(0, 1))

    def _prefix_stage(self, observation: Observation, embedded: Tensor) -> tuple[KVCache, Any, Any]:
        prefix = self._stages.embed_prefix(observation, embedded=embedded)
        k, v, _ = self._stages.encode_prefix(prefix)
        cache = self._stages.cache_of(prefix, k, v)
        return cache, self._stages.cross_keys_values(cache), None

    def is_warm(self, *size: int) -> bool:
        return size in self._graphs

    def _captured(self, cameras: int, batch: int = 1) -> Graphs:
        if (cameras, batch) not in self._graphs:
            with building(self.device), torch.no_grad():
                self._graphs[cameras, batch] = self._capture(cameras, batch)
        return self._graphs[cameras, batch]

    def _prepare_loop(self, graphs: Graphs, num_steps: int, horizon: int) -> None:
        """Of several plain observations."""
        self._step(graphs, horizon, by_action=False)

    def _inputs(self, cameras: int, batch: int) -> tuple[Observation, Staged]:
        return inputs_of(self.config, cameras, batch, self.device)

    def _capture(self, cameras: int, batch: int) -> Graphs:
        inputs, staged = self._inputs(cameras, batch)
        if (memory := memory_of(self.config)) is not None:
            inputs = remembering(inputs, memory)
        seen = self._seen(inputs)
        left: list[tuple[KVCache, Any, Any]] = []

        def prefix(mark: Mark) -> None:
            left[:] = [self._prefix_of(inputs, seen.embedded)]
            mark("prefix")

        second = Graph(prefix, self._pool, self._stream)
        seen.graph.launch()
        second.launch()  # what is captured behind it runs once, and shall find a prefix
        return Graphs(inputs, staged, seen.resizer, seen.graph, second, *left[0])

    def _seen(self, inputs: Observation) -> Seen:
        """The captured vision of observations that lie in `inputs`."""
        places = inputs.images.flatten(0, 1)
        resizer = Resizer(places) if self._compiles else None  # Triton's kernel needs a compiler, too
        images: list[Tensor] = []

        def vision(mark: Mark) -> None:
            if resizer is not None:
                from turbopi.kernels.portable.resize import resize_images

                resize_images(resizer.table, places)
            images[:] = [self._vision(inputs, mark)]
            mark("vision")

        graph = Graph(vision, self._pool, self._stream)
        return Seen(resizer, graph, images[0])

    def _step(self, graphs: Graphs, horizon: int, *, by_action: bool) -> Step:
        if (horizon, by_action) not in graphs.steps:
            x = torch.zeros_like(graphs.noise_of(horizon, self.config).tensors["noise"])
            time = self._embed_times(np.ones(1, np.float32))
            time = time[:, None].repeat(1, horizon, 1) if by_action else time.clone()
            made: list[Tensor] = []

            def step(mark: Mark) -> None:
                made[:] = self._velocity(x, time, graphs.cache, graphs.behind)
                mark("denoise")

            with building(self.device), torch.no_grad():
                graph = Graph(step, self._pool, self._stream)
            graphs.steps[horizon, by_action] = Step(x, time, made[1], graph)
        return graphs.steps[horizon, by_action]

    def _cold(self, size: Size, horizon: int, *, conditioned: bool = False) -> Exception:
        def named(size: Size, horizon: int) -> str:
            cameras, batch = size
            return ("" if batch == 1 else f"{batch} observations, ") + f"{cameras} cameras, H={horizon}"

        warm = [named(of, h) for of, one in self._graphs.items() for h in {h for h, _ in (*one.steps, *one.loops)}]
        cameras, batch = size
        needs = {"cameras": cameras, "horizons": horizon, **({} if batch == 1 else {"batches": batch})}
        return cold_call(self.name, named(size, horizon), warm, conditioned=conditioned, **needs)

    def _embed_times(self, times: np.ndarray) -> Tensor:
        key = times.tobytes()
        if key not in self._times:
            if len(self._times) >= 64:
                self._times.clear()
            self._times[key] = self._stages.embed_times(times).to(self.device)
        return self._times[key]


def _parts(cache: KVCache) -> tuple[tuple[str, Tensor], tuple[str, Tensor]]:
    return ("kv_k", cache.k), ("kv_v", cache.v)


def _joined(parts: list[Tensor], axis: int) -> Tensor:
    """Rows of a batch; those of fewer places are filled up with zeros."""
    if len({part.shape for part in parts}) > 1:
        places = max(part.shape[2] for part in parts)
        parts = [F.pad(part, (0, 0, 0, 0, 0, places - part.shape[2])) for part in parts]
    return torch.cat(parts, dim=axis)


def _attend(q_BHSK: Tensor, k_BGTK: Tensor, v_BGTK: Tensor, mask: Tensor) -> Tensor:
    """As the reference's `attention`, in one kernel: products of the values' dtype, sums in float32."""
    groups = q_BHSK.shape[1] // k_BGTK.shape[1]
    k, v = (x.to(v_BGTK.dtype).repeat_interleave(groups, dim=1) for x in (k_BGTK, v_BGTK))
    return F.scaled_dot_product_attention(q_BHSK.to(v.dtype), k, v, attn_mask=mask)
