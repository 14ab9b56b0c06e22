"""A runner that has several observations run together.

A batch of any number is split into calls of 1, 2, 4, 8 or 16 observations, in the way that is the soonest by the
backend's `batch_costs`; they run one after the other. One observation alone is the runner's own call, to the last bit.

Observations may have conditionings. Those with times, held actions or identity guidance by token run together with
plain ones, in a loop that takes each action's own time; those with guidance by the true Jacobian together with each
other, in one with a way back; those with a solver's sums alone. A call whose observations are all plain has the plain
loop. What is captured: batches.py.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from turbopi.config import ImageResize, ModelConfig
from turbopi.engine.batches import Batches
from turbopi.engine.cold_call import not_warm
from turbopi.engine.conditioned import batch_form, batch_loop
from turbopi.engine.graph import building
from turbopi.engine.graph_cache import Loop
from turbopi.engine.packing import split
from turbopi.engine.runner import BUCKET, GraphRunner, HostRow, floats, padded_trace
from turbopi.engine.weights import Weights
from turbopi.kernels.interface import Ops, PairDenoiser
from turbopi.models.observation import Observation
from turbopi.models.pi0.conditioning import Conditioning, Conditionings, Form, check_rows, of_rows
from turbopi.models.pi0.reference import Trace
from turbopi.models.pi0.sample import Sample

Asked = Sequence[Conditioning | None]  # of each observation
Finish = Callable[[Sequence[np.ndarray], np.ndarray, np.ndarray, int, Asked], Sample]
Call = tuple[int, list[int]]  # for how many observations it is, and which ones are in it


class BegunBatch:
    """What `BatchRunner.begin_batch` returns: several observations, the first ones' pictures on their way."""

    def __init__(
        self,
        begin: Callable[[int, Sequence[Sequence[np.ndarray]]], Finish],
        calls: Sequence[Call],
        pictures: Sequence[Sequence[np.ndarray]],
    ) -> None:
        self._begin, self._calls, self._pictures = begin, calls, pictures
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
        asked, samples = of_rows(conditioning, len(tokens)), []
        check_rows(asked, num_steps, *noise.shape[1:])
        if len(self._calls) == 1:  # of all, in their order
            return self._first(tokens, state, noise, num_steps, asked)
        actions = np.empty(noise.shape, np.float32)
        for number, (_, rows) in enumerate(self._calls):
            finish = self._begun(number) if number else self._first
            these = [tokens[row] for row in rows], state[rows], noise[rows]
            samples.append(finish(*these, num_steps, [asked[row] for row in rows]))
            actions[rows] = samples[-1].actions.numpy()
        stages = {name: sum(one.stage_ms[name] for one in samples) for name in samples[0].stage_ms}
        return Sample(torch.from_numpy(actions), stages)

    def _begun(self, number: int) -> Finish:
        bucket, rows = self._calls[number]
        return self._begin(bucket, [self._pictures[row] for row in rows])


class BatchRunner(GraphRunner):
    """`GraphRunner` whose batches are batched calls."""

    # of `cuda_graph`, measured on an H200, two cameras, bfloat16: without the denoising kernel sharing pays sooner
    COSTS: ClassVar[Mapping[int, float]] = {1: 1, 2: 1.25, 4: 1.85, 8: 3.1, 16: 5.6}
    # of guided ones, measured with `fused`'s operations, but for 2. Larger ones would keep gigabytes for the way back
    JACOBIAN_COSTS: ClassVar[Mapping[int, float]] = {1: 1, 2: 1.5, 4: 2.2, 8: 3.5}

    def __init__(
        self, config: ModelConfig, weights: Weights, ops: Ops, device: torch.device, *, joint: bool = False
    ) -> None:
        super().__init__(config, weights, ops, device, joint=joint)
        self._batches = Batches(
            *(config, weights, ops, device),
            bucket=BUCKET,
            capture=lambda run, like: self._capture(run, None, like),
            table=self._table,
            denoises_by=self._batch_denoises_by,
            refuse=self._refuse_batch_if_cold,
        )

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
        if form == "solver":  # they run alone
            return
        loop = batch_loop([conditioning], num_steps, actions, self.config)
        self._check_cameras(cameras)
        self._warming = True
        try:
            sizes = {bucket for count in batches for bucket in split(count, self._costs_of(form))} - {1}
            for batch in sorted(sizes, reverse=True):  # the largest first: the others' rows are parts of its rows
                with building(self.device):
                    self._recent.use(loop)
                    size = self._batches.size(batch, [cameras] * batch, float_images)
                    self._batches.warm(size, loop, resized=self._ops.resize_pictures is not None)
        finally:
            self._warming = False

    def begin_batch(
        self,
        pictures: Sequence[Sequence[np.ndarray]],
        resize: ImageResize | None = None,
        forms: Sequence[Form] | None = None,
    ) -> BegunBatch:
        """See `turbopi.backends.base.Backend`."""
        for one in pictures:
            self._check_cameras(len(one))
        float_images = floats([picture for one in pictures for picture in one], resize)

        def begin(bucket: int, these: Sequence[Sequence[np.ndarray]]) -> Finish:
            return (
                self._begin_one(these[0], resize)
                if bucket == 1
                else self._begin_call(bucket, these, resize, float_images)
            )

        return BegunBatch(begin, self._calls_of(forms or ["plain"] * len(pictures)), pictures)

    def sample(
        self, observation: Observation, noise: Tensor, num_steps: int, *, conditioning: Conditionings = None
    ) -> Sample:
        if observation.batch_size == 1:
            return super().sample(observation, noise, num_steps, conditioning=conditioning)
        asked = of_rows(conditioning, observation.batch_size)
        rows = [HostRow.of(observation, row) for row in range(observation.batch_size)]
        begun = self.begin_batch([row.images for row in rows], forms=[batch_form(one) for one in asked])
        state = np.stack([row.state for row in rows])
        return begun.finish([row.tokens for row in rows], state, noise.cpu().numpy(), num_steps, asked)

    def intermediates(
        self, observation: Observation, noise: Tensor, num_steps: int, *, conditioning: Conditionings = None
    ) -> Trace:
        """Of a batched call where the observations are one; else one by one."""
        count = observation.batch_size
        asked = of_rows(conditioning, count)
        if count == 1 or self._calls_of([batch_form(one) for one in asked]) != [(count, list(range(count)))]:
            return super().intermediates(observation, noise, num_steps, conditioning=conditioning)
        self.sample(observation, noise, num_steps, conditioning=asked)
        loop = batch_loop(asked, num_steps, noise.shape[1], self.config)
        size = self._batches.size(
            count, observation.image_mask.sum(1).tolist(), observation.images.dtype == torch.float32
        )
        per_image, traces = self.config.vision.num_tokens, []
        for row in range(count):
            cameras = observation.image_mask[row].repeat_interleave(per_image)
            valid = torch.cat((cameras, observation.token_mask[row])).cpu()
            left = self._batches.trace(size, loop, row)
            traces.append(padded_trace(*left, valid))
        return {name: torch.cat([one[name] for one in traces], dim=int(name != "actions")) for name in traces[0]}

    def describe(self) -> dict[str, Any]:
        return super().describe() | {"batches": self._batches.describe()}

    def _costs_of(self, form: Form) -> Mapping[int, float]:
        """As `batch_costs`, in single calls of this form, which may run together."""
        if form == "plain":
            return self.batch_costs
        return self.jacobian_costs if form == "jacobian" else self.COSTS

    def _calls_of(self, forms: Sequence[Form]) -> list[Call]:
        """The calls that a batch of observations of these forms is split into; strict: of those that are captured."""
        if len(forms) == 1:
            return [(1, [0])]
        calls: list[Call] = []
        for form, rows in _groups(forms):
            for bucket in [1] * len(rows) if form == "solver" else self._split(len(rows), form):
                calls.append((bucket, rows[:bucket]))
                rows = rows[bucket:]
        return calls

    def _split(self, count: int, form: Form) -> list[int]:
        costs = self._costs_of(form)
        if not self.strict:
            return split(count, costs)
        warm = {1, *self._batches.warm_sizes(form)}
        if count > max(warm) > 1 and max(warm) < max(costs):
            needs, conditioned = f"{count} observations at once", form != "plain"
            raise not_warm(self.name, needs, self._batches.describe(), conditioned=conditioned, batches=count)
        return split(count, {size: cost for size, cost in costs.items() if size in warm})

    def _batch_denoises_by(self, loop: Loop, batch: int, rows: int) -> Weights | PairDenoiser:
        """What a batch with up to so many prefix rows is denoised by: operations with weights, or a kernel for two
        observations of a plain loop. Its graph goes on pointing to it.
        """
        return self._weights

    def _begin_one(self, pictures: Sequence[np.ndarray], resize: ImageResize | None) -> Finish:
        begun = self.begin(pictures, resize)

        def finish(
            tokens: Sequence[np.ndarray], state: np.ndarray, noise: np.ndarray, num_steps: int, asked: Asked
        ) -> Sample:
            return begun.finish(tokens[0], state[0], noise[0], num_steps, asked[0])

        return finish

    def _begin_call(
        self, bucket: int, pictures: Sequence[Sequence[np.ndarray]], resize: ImageResize | None, float_images: bool
    ) -> Finish:
        """Start on the pictures of up to `bucket` observations; what is returned ends their call, as `Begun.finish`."""
        cameras = [len(one) for one in pictures]
        size = self._batches.size(bucket, cameras, float_images)

        def finish(
            tokens: Sequence[np.ndarray], state: np.ndarray, noise: np.ndarray, num_steps: int, asked: Asked
        ) -> Sample:
            self._check_turn(turn)
            loop = batch_loop(asked, num_steps, noise.shape[1], self.config)
            for count, prompt in zip(cameras, tokens, strict=True):
                self._check_tokens(count, len(prompt))
            self._recent.use(loop)
            with self._explaining():
                sample = self._batches.finish(size, loop, cameras, tokens, state, noise, asked)
            self._begun = None
            return sample

        turn, self._begun = object(), None  # as in `begin`
        with self._explaining():
            self._batches.launch_vision(size, [picture for one in pictures for picture in one], resize)
        self._begun = turn
        return finish

    def _forget(self, loop: Loop) -> None:
        super()._forget(loop)
        self._batches.forget(loop)

    def _refuse_batch_if_cold(self, needs: str, batch: int, loop: Loop | None) -> None:
        if self.strict and not self._warming:
            what, conditioned = needs if loop is None else f"{needs}, {loop}", loop is not None and loop.form != "plain"
            raise not_warm(self.name, what, self._batches.describe(), conditioned=conditioned, batches=batch)


def _groups(forms: Sequence[Form]) -> Iterator[tuple[Form, list[int]]]:
    """Which observations may share calls, and the form of their loop."""
    by_token = [row for row, form in enumerate(forms) if form in ("plain", "tokens")]
    if by_token:
        yield "tokens" if "tokens" in forms else "plain", by_token
    for form in ("jacobian", "solver"):
        if rows := [row for row, one in enumerate(forms) if one == form]:
            yield form, rows
