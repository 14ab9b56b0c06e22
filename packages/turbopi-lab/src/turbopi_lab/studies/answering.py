"""A policy in whose model's place a study answers, and knows for which episodes it is asked.

An evaluation doesn't tell policies of episodes; the seeds of their noise do: there is one for each episode and step.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from torch import Tensor

from turbopi.backends.pytorch import PyTorchBackend
from turbopi.evaluate.plan import Job, Protocol, noise_seed
from turbopi.evaluate.sources import Answer, LocalPolicy
from turbopi.models.observation import Observation
from turbopi.models.pi0.conditioning import Conditionings
from turbopi.models.pi0.sample import Sample
from turbopi.policy.policy import UnifiedPolicy

Key = tuple[int, int]  # of an episode: task, initial state


@dataclass
class Requested:
    """A batch of requests, on the model's device. numbers: of each episode's call, from 0"""

    observation: Observation
    noise: Tensor
    steps: int
    episodes: Sequence[Key]
    numbers: Sequence[int]


Answering = Callable[[Requested], Tensor]  # -> chunks float32[B, H, A], normalised


class AnsweringPolicy(LocalPolicy):
    """The float32 reference's policy, whose backend samples with `answer`."""

    def __init__(
        self, policy: UnifiedPolicy, weights: str, answer: Answering, protocol: Protocol, jobs: Sequence[Job]
    ) -> None:
        super().__init__(policy, weights)
        backend = policy.backend
        assert isinstance(backend, PyTorchBackend)
        self._device, self._answer = backend.device, answer
        backend.sample = self._sample  # type: ignore[method-assign]
        self._current: list[tuple[Key, int]] = []
        self._places: dict[int, tuple[Key, int]] = {}
        for job in jobs:
            for number, step in enumerate(range(0, protocol.max_steps or job.task.max_steps, protocol.replan)):
                self._places[noise_seed(protocol.sim.seed, *job.key, step)] = job.key, number

    def infer(
        self,
        observations: Sequence[Mapping[str, object]],
        seeds: Sequence[int],
        arguments: Sequence[Mapping[str, Any]] | None = None,
    ) -> list[Answer]:
        self._current = [self._places[seed] for seed in seeds]
        return super().infer(observations, seeds, arguments)

    def _sample(
        self, observation: Observation, noise: Tensor, num_steps: int, *, conditioning: Conditionings = None
    ) -> Sample:
        assert len(self._current) == len(noise), "a call of the model for each call of the policy"
        episodes, numbers = zip(*self._current, strict=True)
        requested = Requested(observation.to(self._device), noise.to(self._device), num_steps, episodes, numbers)
        return Sample(self._answer(requested).cpu(), {})
