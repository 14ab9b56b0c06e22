"""What a backend is verified on: observations, each with several noises."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from turbopi import shipped
from turbopi.calibrate.observations import observation_files, spread
from turbopi.errors import ObservationError
from turbopi.observation import ModelInputs, Observation
from turbopi.policy import UnifiedPolicy
from turbopi.recordings import load_observation

DEFAULT_OBSERVATIONS = 8


@dataclass(frozen=True)
class Plan:
    """What to verify and on what. `arguments` are UnifiedPolicy's besides the checkpoint; `observations` a path or None
    for Turbo-Pi's own; `count` at most so many of them, evenly spread."""

    arguments: Mapping[str, Any]
    observations: Path | None = None
    count: int | None = None
    noises: int = 2
    seed: int = 0
    bound: float | None = None
    factor: float | None = None
    fingerprint: bool = True


@dataclass(frozen=True)
class Sample:
    """One observation as it is verified: where it is from, and the model's inputs."""

    source: str
    inputs: ModelInputs
    state: np.ndarray  # float64[action_dim], what Pipeline.after needs


@dataclass(frozen=True)
class Call:
    """One observation with one noise."""

    number: int
    sample: Sample
    seed: int
    noise: torch.Tensor  # float32[1, H, action_dim]
    first: bool  # of its observation: the prefix is compared

    @property
    def observation(self) -> Observation:
        return Observation.stack([self.sample.inputs])


def check_observations(plan: Plan) -> None:
    """Refuse now what can't be read, before minutes of loading."""
    if plan.observations is None:
        return
    for file in _chosen(plan.observations, plan.count)[:1]:
        load_observation(file)


def _chosen(path: Path, count: int | None) -> list[Path]:
    """All observations there, or so many, evenly spread over them."""
    files = observation_files(path)
    return files if count is None else [files[i] for i in spread(len(files), count)]


def read_samples(policy: UnifiedPolicy, plan: Plan) -> Iterator[Sample]:
    """The observations as the model gets them. Raises ObservationError naming the one that can't be used."""
    for source, observation in _observations(policy, plan):
        try:
            inputs, state = policy.pipeline.before(observation)
        except ObservationError as error:
            raise ObservationError(f"{source}: {error}") from error
        yield Sample(source, inputs, state)


def _observations(policy: UnifiedPolicy, plan: Plan) -> Iterator[tuple[str, Mapping[str, Any]]]:
    if plan.observations is not None:
        for file in _chosen(plan.observations, plan.count):
            name = file.name if file == plan.observations else str(file.relative_to(plan.observations))
            yield name, load_observation(file)
        return
    wanted = DEFAULT_OBSERVATIONS if plan.count is None else plan.count
    frames = shipped.load_frames()[:wanted] if policy.metadata["robot"] == "libero" else []
    for number, observation in enumerate(shipped.observations(policy, frames)):
        yield f"LIBERO frame {number}", observation
    for seed in range(wanted - len(frames)):
        yield f"random example {seed}", policy.example_observation(seed)


def make_calls(policy: UnifiedPolicy, samples: Sequence[Sample], plan: Plan) -> list[Call]:
    """Every observation with `noises` noises; call i draws its noise from seed + i, as `infer` does."""
    shape = (1, policy.config.model.action_horizon, policy.config.model.action_dim)
    calls: list[Call] = []
    for sample in samples:
        for turn in range(plan.noises):
            seed = plan.seed + len(calls)
            noise = torch.from_numpy(np.random.default_rng(seed).standard_normal(shape, dtype=np.float32))
            calls.append(Call(len(calls), sample, seed, noise, first=turn == 0))
    return calls
