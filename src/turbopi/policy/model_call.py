"""The middle of a policy's call: observations to model inputs, and on to what the backend makes of them.

A backend that can starts on the pictures first, and prompts are tokenised beside it.
"""

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from turbopi import backends
from turbopi.backends.abilities import Abilities
from turbopi.backends.device_lost import Guard
from turbopi.models.observation import Observation
from turbopi.policy.chunk_conditioning import Joining, Joins
from turbopi.preprocess.pipeline import Pipeline


@dataclass(frozen=True)
class Ran:
    """What became of a call, and when, in seconds of `time.perf_counter`."""

    sample: backends.Sample
    states: list[np.ndarray]  # of each observation, as the pipeline's `after` takes it
    asked: float  # the inputs are ready, but for what is done beside the device
    infer_start: float  # other threads' calls are over
    infer_end: float


class ModelCall:
    """Of one policy, by the backend that it holds. One call at a time: others wait for `lock`."""

    def __init__(self, pipeline: Pipeline, joining: Joining, able: Abilities, guard: Guard) -> None:
        self._pipeline, self._joining, self._able, self._guard = pipeline, joining, able, guard
        self.lock = threading.Lock()

    def run(
        self,
        observations: Sequence[Mapping[str, Any]],
        joins: Joins,
        noise: Callable[[], np.ndarray],  # float32[B, H, action_dim], called when all else is known to be right
    ) -> Ran:
        """Raises ObservationError for what can't be used, DeviceLost when the GPU fails for good."""
        able = self._able
        if len(observations) == 1 and able.begins is not None:
            return self._begin(able.begins, observations[0], joins, noise)
        if able.runs_batches is not None:
            return self._begin_batch(able.runs_batches, observations, joins, noise)
        prepared = [self._pipeline.before(obs) for obs in observations]
        inputs, states = Observation.stack([one for one, _ in prepared]), [state for _, state in prepared]
        x_1, arguments = torch.from_numpy(noise()), self._joining.arguments(joins, states)
        asked = time.perf_counter()
        with self.lock, self._guard:
            infer_start = time.perf_counter()
            sample = able.backend.sample(inputs, x_1, joins.steps, **arguments)
            return Ran(sample, states, asked, infer_start, time.perf_counter())

    def _begin(
        self, backend: backends.Begins, observation: Mapping[str, Any], joins: Joins, noise: Callable[[], np.ndarray]
    ) -> Ran:
        seen = self._pipeline.see(observation, resize=False)
        asked = time.perf_counter()
        with self.lock, self._guard:
            infer_start = time.perf_counter()
            begun = backend.begin(seen.pictures, self._pipeline.config.image_resize)
            self._pipeline.read(seen)  # while the device is at the pictures
            x_1, arguments = noise()[0], self._joining.arguments(joins, [seen.state])
            sample = begun.finish(seen.tokens[seen.token_mask], seen.model_state, x_1, joins.steps, **arguments)
            return Ran(sample, [seen.state], asked, infer_start, time.perf_counter())

    def _begin_batch(
        self,
        backend: backends.RunsBatches,
        observations: Sequence[Mapping[str, Any]],
        joins: Joins,
        noise: Callable[[], np.ndarray],
    ) -> Ran:
        each = [self._pipeline.see(obs, resize=False) for obs in observations]
        asked = time.perf_counter()
        with self.lock, self._guard:
            infer_start = time.perf_counter()
            pictures, resize = [seen.pictures for seen in each], self._pipeline.config.image_resize
            batch = backend.begin_batch(pictures, resize, joins.forms)
            for seen in each:
                self._pipeline.read(seen)  # while the device is at the first ones' pictures
            x_1, states = noise(), [seen.state for seen in each]
            arguments = self._joining.arguments(joins, states)
            tokens, state = [seen.tokens[seen.token_mask] for seen in each], [seen.model_state for seen in each]
            sample = batch.finish(tokens, np.stack(state), x_1, joins.steps, **arguments)
            return Ran(sample, states, asked, infer_start, time.perf_counter())
