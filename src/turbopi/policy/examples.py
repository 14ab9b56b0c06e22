"""Observations that a policy is measured on, as its model gets them, each with noises: to calibrate and to verify."""

import hashlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np
import torch
from torch import Tensor

from turbopi.config import memory_of
from turbopi.models.observation import ModelInputs, Observation
from turbopi.policy.history import ObservationHistory
from turbopi.policy.policy import UnifiedPolicy
from turbopi.support.errors import ObservationError


@dataclass(frozen=True)
class Example:
    """One observation: where it is from, and the model's inputs."""

    source: str
    inputs: ModelInputs
    state: np.ndarray  # float64[s], what Pipeline.after needs

    def bytes(self) -> bytes:
        """All of the model's inputs, to be hashed."""
        parts: list[bytes] = []
        named = asdict(self.inputs)
        past = named.pop("past") or {}
        for name, value in [*named.items(), *((f"past {name}", one) for name, one in past.items() if one is not None)]:
            parts += (f"{name} {value.dtype} {list(value.shape)}".encode(), np.ascontiguousarray(value).tobytes())
        return b"".join(parts)

    @property
    def sha256(self) -> str:
        return hashlib.sha256(self.bytes()).hexdigest()


@dataclass(frozen=True)
class NoisyExample:
    """One observation with one noise."""

    number: int
    example: Example
    seed: int
    noise: Tensor  # float32[1, H, action_dim]
    first: bool  # of its observation

    @property
    def observation(self) -> Observation:
        return Observation.stack([self.example.inputs])


def prepared(policy: UnifiedPolicy, named: Iterable[tuple[str, Mapping[str, object]]]) -> Iterator[Example]:
    """(name, observation) as the model gets them. Raises ObservationError naming the one that can't be used.

    A policy with memory sees those before each one as its past frames, whatever its stride.
    """
    memory = memory_of(policy.config.model)
    history = None if memory is None else ObservationHistory(replace(memory, stride=1))
    for name, observation in named:
        try:
            seen = policy.pipeline.see(observation)
            inputs = policy.pipeline.complete(seen)
        except ObservationError as error:
            raise ObservationError(f"{name}: {error}") from error
        if history is not None:
            history.record(seen.cameras, inputs)
            inputs = history.with_past(seen.cameras, inputs)
        yield Example(name, inputs, seen.state)


def with_noises(examples: Sequence[Example], shape: tuple[int, int], noises: int, seed: int) -> list[NoisyExample]:
    """Every observation with several noises float32[1, *shape], shape [H, action_dim].

    Number i's noise is drawn from seed + i, as `UnifiedPolicy.infer` does.
    """
    made: list[NoisyExample] = []
    for example in examples:
        for turn in range(noises):
            number = len(made)
            noise = np.random.default_rng(seed + number).standard_normal((1, *shape), dtype=np.float32)
            made.append(NoisyExample(number, example, seed + number, torch.from_numpy(noise), first=turn == 0))
    return made
