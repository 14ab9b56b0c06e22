"""The middle of a policy's call: observations to model inputs, and on to what the backend makes of them.

A backend that can starts on the images first, and prompts are tokenised meanwhile.
"""

import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
import torch

from turbopi import backends
from turbopi.backends.device_lost import Guard
from turbopi.config import memory_of
from turbopi.models.observation import ModelInputs, Observation
from turbopi.policy.chunk_conditioning import ChunkConditioning, Joins
from turbopi.policy.history import History, ObservationHistory, given_frames
from turbopi.policy.readings import Checks, Reading
from turbopi.policy.text import SubtaskHistory, TextCalls, refuse_text
from turbopi.preprocess.answers import Unjudged
from turbopi.preprocess.pipeline import Incoming, Pipeline
from turbopi.robots.base import Example
from turbopi.support.errors import ObservationError


@dataclass(frozen=True)
class Ran:
    """What became of a call, and when, in seconds of `time.perf_counter`."""

    sample: backends.Sample
    states: list[np.ndarray]  # of each observation, as the pipeline's `after` takes it
    readings: list[Reading | None]
    requested: float  # the inputs are ready, but for what is done beside the device
    infer_start: float  # other threads' calls are over
    infer_end: float
    subtasks: Sequence[str] = ()  # of each observation, of a policy that acts on them


class ModelCall:
    """Of one policy, by the backend that it holds. One call at a time: others wait for `lock`."""

    def __init__(
        self,
        pipeline: Pipeline,
        conditioning: ChunkConditioning,
        backend: backends.Backend,
        guard: Guard,
        checks: Checks,
    ) -> None:
        self._pipeline, self._conditioning, self._backend, self._guard = pipeline, conditioning, backend, guard
        self._checks = checks
        self._memory = memory_of(pipeline.config.model)
        self._text = None if pipeline.config.text is None else TextCalls(pipeline, backend)
        self.lock = threading.Lock()

    def run(
        self,
        observations: Sequence[Mapping[str, Any]],
        joins: Joins,
        noise: Callable[[], np.ndarray],  # float32[B, H, action_dim], called when all else is known to be right
        histories: Sequence[History] = (),  # one for each observation, of a policy that keeps something of an episode
        subtasks: Sequence[str | None] = (),  # one for each observation, of a policy that acts on them
    ) -> Ran:
        """Raises ObservationError for what can't be used, DeviceLost when the GPU fails for good.

        An observation is recorded in its history once all of the call is known to be right.
        """
        text = self._text if subtasks else None
        if text is not None:
            text.check(subtasks)
        if self._backend.begins and not self._memory and not (text is not None and text.writes):
            return self._begin(observations, joins, noise, subtasks)
        episodes = [self.see(obs, joins.guidance) for obs in observations]
        each = [frames[-1][0] for frames in episodes]
        states, readings = [seen.state for seen in each], [self._checks.reading(seen) for seen in each]
        conditioning = self._conditioning.conditioning(joins, states, [seen.tagged for seen in each])
        x_1 = torch.from_numpy(self._conditioning.started(joins, states, noise()))
        requested = time.perf_counter()
        with self._turn(observations):
            infer_start = time.perf_counter()
            if text is not None and text.writes:
                inputs = [frames[-1][1] for frames in episodes]
                rest = (subtasks, cast("Sequence[SubtaskHistory]", histories), x_1, joins.steps, conditioning)
                sample, said = text.sample(each, inputs, *rest)
                return Ran(sample, states, readings, requested, infer_start, time.perf_counter(), said)
            of_rows = histories if self._memory else [None] * len(each)
            inputs = [self.recorded(*one) for one in zip(episodes, cast("Sequence[Any]", of_rows), strict=True)]
            said = [seen.prompt if one is None else one for seen, one in zip(each, subtasks, strict=False)]
            if text is not None:
                inputs = [text.directed(*one) for one in zip(each, said, strict=True)]
            sample = self._backend.sample(Observation.stack(inputs), x_1, joins.steps, conditioning=conditioning)
            return Ran(sample, states, readings, requested, infer_start, time.perf_counter(), said)

    def write(self, observation: Mapping[str, Any], prompt: str | None, most: int | None) -> str:
        """What the policy says to an observation. Raises ObservationError where it writes no text."""
        if self._text is None or not self._text.writes:
            config = self._pipeline.config
            if config.text is None or not config.text.trained:
                raise ObservationError(refuse_text(config))
            raise ObservationError(f"backend {self._backend.name!r} writes no text: take {self._backend.instead}")
        ((seen, inputs),) = self.see(observation)
        with self._turn([observation]):
            return self._text.write(seen, inputs, prompt, most)

    @contextmanager
    def _turn(self, observations: Sequence[Mapping[str, Any]]) -> Iterator[None]:
        """One call at a time. Answers to made-up observations aren't judged: a model may write anything there."""
        with self.lock, self._guard:
            reader = self._backend.reader
            if reader is not None and all(isinstance(one, Example) for one in observations):
                self._backend.reader = Unjudged(reader, self._pipeline.config)
            try:
                yield
            finally:
                self._backend.reader = reader

    def see(self, observation: Mapping[str, Any], guidance: float = 0.0) -> list[tuple[Incoming, ModelInputs]]:
        """An observation, the last one, behind the frames that it brings itself. guidance: `Incoming`'s."""
        frames = given_frames(observation, self._memory) if self._memory else None
        each = [self._pipeline.see(one, guidance=guidance) for one in ([observation] if frames is None else frames)]
        inputs = [(seen, self._pipeline.complete(seen)) for seen in each]
        return inputs if frames is None else [*inputs, inputs[-1]]

    def recorded(self, frames: Sequence[tuple[Incoming, ModelInputs]], history: History | None) -> ModelInputs:
        """The model's inputs of what `see` returned, recorded in its history. One that brings its frames isn't."""
        *past, (seen, inputs) = frames
        if self._memory is None:
            return inputs
        if past:
            history = ObservationHistory(replace(self._memory, stride=1))
        assert isinstance(history, ObservationHistory)
        for one, its in past or [(seen, inputs)]:
            history.record(one.cameras, its)
        return history.with_past(seen.cameras, inputs)

    def _begin(
        self,
        observations: Sequence[Mapping[str, Any]],
        joins: Joins,
        noise: Callable[[], np.ndarray],
        subtasks: Sequence[str | None],
    ) -> Ran:
        each = [self._pipeline.see(obs, resize=False, guidance=joins.guidance) for obs in observations]
        for seen, subtask in zip(each, subtasks, strict=False):
            seen.prompt = seen.prompt if subtask is None else subtask
        said = [seen.prompt for seen in each] if subtasks else []
        requested = time.perf_counter()
        with self._turn(observations):
            infer_start = time.perf_counter()
            images, resize = [seen.camera_images for seen in each], self._pipeline.config.image_resize
            begun = self._backend.begin_batch(images, resize, joins.forms)
            for seen in each:
                self._pipeline.read(seen)  # while the device is at the first ones' images
            readings = [self._checks.reading(seen) for seen in each]
            states = [seen.state for seen in each]
            x_1 = self._conditioning.started(joins, states, noise())
            conditioning = self._conditioning.conditioning(joins, states, [seen.tagged for seen in each])
            tokens, state = [seen.tokens[seen.token_mask] for seen in each], np.stack([one.model_state for one in each])
            sample = begun.finish(tokens, state, x_1, joins.steps, conditioning)
            return Ran(sample, states, readings, requested, infer_start, time.perf_counter(), said)
