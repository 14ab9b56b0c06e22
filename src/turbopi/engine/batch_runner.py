"""A runner that has several observations run together.

A batch of any number is split into calls of 1, 2, 4, 8 or 16 observations, in the way that is the soonest by the
backend's `batch_costs`; they run one after the other. One observation alone is the runner's own call, to the last bit.
Which observations may share a call: `plan.groups`. A call whose observations are all plain has the plain loop; a
conditioned loop takes each action's own time, so plain observations fit it, too.

One observation with two prompts is a batched call of two rows that see the same images (`PromptGuidance`).

A batched call is three graphs. Their rows lie in the same buffers whatever the size, as calls run one after the other.
"""

import itertools
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from turbopi.config import ImageResize, ModelConfig
from turbopi.engine import plan
from turbopi.engine.batch import BatchBuffers, BatchLoop, BatchSize, PackedPrefix, SharedRows
from turbopi.engine.call import Images
from turbopi.engine.graph_cache import Captured
from turbopi.engine.loops import ALONE, Loop, batch_form, loop_of_batch
from turbopi.engine.plan import GraphKey, split
from turbopi.engine.runner import GraphRunner, HostRow, floats
from turbopi.engine.trace import padded_trace
from turbopi.engine.weights import Weights
from turbopi.kernels.interface import Ops, PairDenoiser
from turbopi.models.observation import Observation
from turbopi.models.pi0.conditioning import Conditioning, Conditionings, Form, check_rows, has_two_prompts, of_rows
from turbopi.models.pi0.reference import Trace
from turbopi.models.pi0.sample import Sample

STAGES = ("vision", "prefix", "denoise")
Rows = Sequence[Conditioning | None]  # of each observation
Finish = Callable[[Sequence[np.ndarray], np.ndarray, np.ndarray, int, Rows], Sample]
Call = tuple[int, list[int]]  # for how many observations it is (0: one with two prompts), and which ones are in it


class BegunBatch:
    """What `BatchRunner.begin_batch` returns: several observations; the first call's images are on their way."""

    def __init__(
        self,
        begin: Callable[[int, Sequence[Sequence[np.ndarray]]], Finish],
        calls: Sequence[Call],
        images: Sequence[Sequence[np.ndarray]],
    ) -> None:
        self._begin, self._calls, self._images = begin, calls, images
        self._first = self._begun(0)

    def finish(
        self,
        tokens: Sequence[np.ndarray],
        state: np.ndarray,
        noise: np.ndarray,
        num_steps: int,
        conditioning: Conditionings = None,
    ) -> Sample:
        """See `turbopi.backends.base.BegunBatch`."""
        given, samples = of_rows(conditioning, len(tokens)), []
        check_rows(given, num_steps, *noise.shape[1:])
        if len(self._calls) == 1:  # of all, in their order
            return self._first(tokens, state, noise, num_steps, given)
        actions = np.empty(noise.shape, np.float32)
        for number, (_, rows) in enumerate(self._calls):
            finish = self._begun(number) if number else self._first
            these = [tokens[row] for row in rows], state[rows], noise[rows]
            samples.append(finish(*these, num_steps, [given[row] for row in rows]))
            actions[rows] = samples[-1].actions.numpy()
        stages = {name: sum(one.stage_ms.get(name, 0.0) for one in samples) for name in samples[0].stage_ms}
        return Sample(torch.from_numpy(actions), stages)

    def _begun(self, number: int) -> Finish:
        bucket, rows = self._calls[number]
        return self._begin(bucket, [self._images[row] for row in rows])


class BatchRunner(GraphRunner):
    """`GraphRunner` whose batches are batched calls."""

    # of `cuda_graph`, measured on an H200, two cameras, bfloat16: without the denoising kernel sharing pays sooner
    COSTS: ClassVar[Mapping[int, float]] = {1: 1, 2: 1.25, 4: 1.85, 8: 3.1, 16: 5.6}
    # of guided ones, measured with `fused`'s operations, but for 2. Larger ones would save gigabytes for backward
    JACOBIAN_COSTS: ClassVar[Mapping[int, float]] = {1: 1, 2: 1.5, 4: 2.2, 8: 3.5}

    def __init__(
        self, config: ModelConfig, weights: Weights, ops: Ops, device: torch.device, *, joint: bool = False
    ) -> None:
        super().__init__(config, weights, ops, device, joint=joint)
        self._shared = SharedRows(config, weights.embed_tokens.dtype, device)
        self._buffers: dict[BatchSize, BatchBuffers] = {}
        self._marks = [torch.cuda.Event(enable_timing=True) for _ in range(4)] if device.type == "cuda" else []  # type: ignore[no-untyped-call]

    @property
    def batch_costs(self) -> Mapping[int, float]:
        """See `turbopi.backends.base.Backend`."""
        return self.COSTS

    @property
    def jacobian_costs(self) -> Mapping[int, float]:
        """As `batch_costs`, of observations guided by the true Jacobian, in single calls of that kind."""
        return self.JACOBIAN_COSTS

    def warmup_batches(
        self,
        observation: Observation,
        num_steps: int,
        horizon: int | None,
        batches: Sequence[int],
        conditioning: Conditioning | None = None,
    ) -> None:
        """See `turbopi.backends.base.Backend`."""
        cameras, float_images = int(observation.image_mask[0].sum()), observation.images.dtype == torch.float32
        form, actions = batch_form(conditioning), self.config.action_horizon if horizon is None else horizon
        if form in ALONE:
            return
        loop = loop_of_batch([conditioning], num_steps, actions, self.config)
        self._check_cameras(cameras)
        sizes = {size for count in batches for size in split(count, self._costs_of(form))} - {1}
        for batch in sorted(sizes, reverse=True):  # the largest first: the others' rows are parts of its rows
            self._warm(batch, batch * cameras, float_images, loop)

    def _make(self, key: GraphKey) -> Captured:
        if key.batch == 1 or key.part in ("vision", "resized"):
            return super()._make(key)
        buffers = self._buffers_of(BatchSize(key.batch, key.images, key.float_images, key.two_prompts))
        if key.part == "prefix":
            prefix = PackedPrefix(buffers, key.slots)
            prefix.write([0] * key.batch, [np.zeros(1, np.int64)] * key.batch)
            return Captured(self._capture(prefix.run, None), prefix)
        loop = key.loop
        assert loop is not None, key
        by = self._batch_weights if key.two_prompts else self._batch_denoises_by
        run = BatchLoop(buffers, loop, by(loop, key.batch, buffers.rows), self._table(loop))
        return Captured(self._capture(run.run, None), run)

    def _images(self, key: GraphKey) -> Images:
        if key.batch == 1:
            return super()._images(key)
        embs = self._shared.images(key.images * self.config.vision.num_tokens)
        return Images(self.config, self._weights, self._ops, key.images, key.float_images, 0, embs)

    def _buffers_of(self, size: BatchSize) -> BatchBuffers:
        if size not in self._buffers:
            images = self._graph(GraphKey("vision", size.batch, size.images, size.float_images)).buffers
            most = plan.batch_slots(size.batch, [self.config.max_prompt_tokens] * size.batch)
            own = self.config, self._weights, self._ops
            self._buffers[size] = BatchBuffers(*own, size, images, most, self._shared)
        return self._buffers[size]

    def _batch_weights(self, loop: Loop, batch: int, rows: int) -> Weights:
        """What operations denoise a batch with up to so many prefix rows with. Its graph goes on pointing to it."""
        return self._weights

    def _batch_denoises_by(self, loop: Loop, batch: int, rows: int) -> Weights | PairDenoiser:
        """The same, or a kernel for two observations of a plain loop."""
        return self._batch_weights(loop, batch, rows)

    def begin_batch(
        self,
        images: Sequence[Sequence[np.ndarray]],
        resize: ImageResize | None = None,
        forms: Sequence[Form] | None = None,
    ) -> BegunBatch:
        """See `turbopi.backends.base.Backend`."""
        for one in images:
            self._check_cameras(len(one))
        float_images = floats([image for one in images for image in one], resize)

        def begin(size: int, these: Sequence[Sequence[np.ndarray]]) -> Finish:
            if size == 1:
                return self._begin_one(these[0], resize)
            return self._begin_call(size or 2, these, resize, float_images, two_prompts=size == 0)

        return BegunBatch(begin, self._calls_of(forms or ["plain"] * len(images)), images)

    def _begin_one(self, images: Sequence[np.ndarray], resize: ImageResize | None) -> Finish:
        begun = self.begin(images, resize)

        def finish(
            tokens: Sequence[np.ndarray], state: np.ndarray, noise: np.ndarray, num_steps: int, conditionings: Rows
        ) -> Sample:
            return begun.finish(tokens[0], state[0], noise[0], num_steps, conditionings[0])

        return finish

    def _begin_call(
        self,
        batch: int,
        images: Sequence[Sequence[np.ndarray]],
        resize: ImageResize | None,
        float_images: bool,
        *,
        two_prompts: bool = False,
    ) -> Finish:
        """Start on the images of up to `batch` observations; returns what ends their call, as `Begun.finish`.

        two_prompts: of one observation, whose conditioning has the second prompt; then `batch` is 2.
        A wrong image of a later part raises when the earlier ones have been launched. Nothing comes of these.
        """
        cameras, turn = [len(one) for one in images], object()
        sizes = (batch, cameras[0] if two_prompts else plan.batch_images(batch, cameras), float_images)

        def finish(
            tokens: Sequence[np.ndarray], state: np.ndarray, noise: np.ndarray, num_steps: int, conditionings: Rows
        ) -> Sample:
            self._check_turn(turn)
            seen, count = cameras, len(noise)
            if two_prompts:
                (one,) = conditionings
                assert one is not None and one.prompt is not None
                tokens, conditionings = [*tokens, one.prompt.tokens], [one, one]
                noise, state, seen = noise.repeat(2, axis=0), state.repeat(2, axis=0), cameras * 2
                loop = self._loop(conditionings[0], num_steps, noise.shape[1])
            else:
                loop = loop_of_batch(conditionings, num_steps, noise.shape[1], self.config)
            for each, prompt in zip(seen, tokens, strict=True):
                self._check_tokens(each, len(prompt))
            with self._explaining():
                slots = plan.batch_slots(batch, [len(prompt) for prompt in tokens])
                prefix = self._graph(GraphKey("prefix", *sizes, slots, two_prompts=two_prompts))
                denoise = self._graph(GraphKey("denoise", *sizes, loop=loop, two_prompts=two_prompts))
                prefix.buffers.write(seen, tokens)
                denoise.buffers.write(noise, state, conditionings)
                prefix.graph.launch()
                self._mark(2)
                denoise.graph.launch()
                self._mark(3)
                if self._marks:
                    self._marks[-1].synchronize()
                times = [start.elapsed_time(end) for start, end in itertools.pairwise(self._marks)]
                actions = torch.from_numpy(denoise.buffers.actions_array[:count].copy())
            self._begun = None
            return Sample(actions, dict(zip(STAGES, times, strict=False)))

        every = [image for one in images for image in one]
        if (missing := sizes[1] - len(every)) > 0:
            side = self.config.vision.image_size
            every += [np.zeros((side, side, 3), np.float32 if float_images else np.uint8)] * missing
        self._begun = None  # as in `begin`
        with self._explaining():
            graph, uploads = self._vision(GraphKey("vision", *sizes), every, resize)
            self._mark(0)
            graph.launch(*uploads)
            self._mark(1)
        self._begun = turn
        return finish

    def _mark(self, place: int) -> None:
        if self._marks:
            self._marks[place].record(torch.cuda.current_stream(self.device))

    def sample(
        self, observation: Observation, noise: Tensor, num_steps: int, *, conditioning: Conditionings = None
    ) -> Sample:
        if observation.batch_size == 1 and not has_two_prompts(conditioning):
            return super().sample(observation, noise, num_steps, conditioning=conditioning)
        conditionings = of_rows(conditioning, observation.batch_size)
        rows = [HostRow.of(observation, row) for row in range(observation.batch_size)]
        begun = self.begin_batch([row.images for row in rows], forms=[batch_form(one) for one in conditionings])
        state = np.stack([row.state for row in rows])
        return begun.finish([row.tokens for row in rows], state, noise.cpu().numpy(), num_steps, conditionings)

    def _costs_of(self, form: Form) -> Mapping[int, float]:
        """As `batch_costs`, in single calls of this form, which may run together."""
        if form == "plain":
            return self.batch_costs
        return self.jacobian_costs if form == "jacobian" else self.COSTS

    def _calls_of(self, forms: Sequence[Form]) -> list[Call]:
        """The calls that a batch of observations of these forms is split into; strict: of those that are captured."""
        if forms == ["two_prompts"]:
            return [(0, [0])]
        if len(forms) == 1:
            return [(1, [0])]
        calls: list[Call] = []
        for form, rows in plan.groups(forms):
            if form in ALONE:
                calls += [(0 if form == "two_prompts" else 1, [row]) for row in rows]
                continue
            for size in self._split(len(rows), form):
                calls.append((size, rows[:size]))
                rows = rows[size:]
        assert sum(len(rows) for _, rows in calls) == len(forms), forms
        return calls

    def _split(self, count: int, form: Form) -> list[int]:
        costs = self._costs_of(form)
        if not self.strict:
            return split(count, costs)
        warm = {1, *self._graphs.batch_sizes(form)}
        if count > max(warm) > 1 and max(warm) < max(costs):
            needs, captured, conditioned = f"{count} observations at once", self._graphs.entries, form != "plain"
            raise plan.cold_call(self.name, needs, plan.batches(captured), conditioned=conditioned, batches=count)
        return split(count, {size: cost for size, cost in costs.items() if size in warm})

    def intermediates(
        self, observation: Observation, noise: Tensor, num_steps: int, *, conditioning: Conditionings = None
    ) -> Trace:
        """Of a batched call where the observations are one; else one by one."""
        count = observation.batch_size
        given = of_rows(conditioning, count)
        if count == 1 or self._calls_of([batch_form(one) for one in given]) != [(count, list(range(count)))]:
            return super().intermediates(observation, noise, num_steps, conditioning=conditioning)
        self.sample(observation, noise, num_steps, conditioning=given)
        images = plan.batch_images(count, observation.image_mask.sum(1).tolist())
        sizes = (count, images, observation.images.dtype == torch.float32)
        loop = loop_of_batch(given, num_steps, noise.shape[1], self.config)
        run = self._graph(GraphKey("denoise", *sizes, loop=loop)).buffers
        traces = []
        for row in range(count):
            k, v, x_t, v_t = run.trace(row)
            traces.append(padded_trace(k, v, x_t, v_t, self._valid(observation, row)))
        return {name: torch.cat([one[name] for one in traces], dim=int(name != "actions")) for name in traces[0]}

    def describe(self) -> dict[str, Any]:
        return super().describe() | {"batches": plan.batches(list(self._graphs.entries))}
