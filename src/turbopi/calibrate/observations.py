"""What a policy is calibrated on: recorded observations, and noise to begin from."""

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from turbopi import shipped
from turbopi.calibrate.artifact import RANDOM_NOISE
from turbopi.errors import ConfigError, ObservationError
from turbopi.observation import ModelInputs, Observation
from turbopi.policy import UnifiedPolicy
from turbopi.recordings import load_observation, recorded_files

LIBERO = "the LIBERO pictures that come with Turbo-Pi"
EVERY = 4  # of so many observations one is held out


@dataclass(frozen=True)
class Sample:
    """One observation as the model gets it."""

    source: str
    inputs: ModelInputs

    @property
    def sha256(self) -> str:
        return hashlib.sha256(b"".join(inputs_bytes(self.inputs))).hexdigest()


def inputs_bytes(inputs: ModelInputs) -> Iterator[bytes]:
    """All of the model's inputs, to be hashed."""
    for name, value in asdict(inputs).items():
        yield f"{name} {value.dtype} {list(value.shape)}".encode()
        yield np.ascontiguousarray(value).tobytes()


@dataclass(frozen=True)
class Call:
    """One observation with one noise."""

    sample: Sample
    seed: int
    noise: Tensor  # float32[1, H, action_dim]


Batch = tuple[Observation, Tensor]


def read_samples(policy: UnifiedPolicy, source: str | None, count: int) -> tuple[str, list[Sample]]:
    """What the observations are, in words, and up to `count` of them, evenly spread over what there is.

    source  a recording, a folder of observations, an .npz; None: LIBERO pictures, for that robot; "random-noise"

    Raises ObservationError naming the one that can't be used, and where there are fewer than two.
    """
    described, found = _observations(policy, source, count)
    samples = []
    for name, observation in found:
        try:
            samples.append(Sample(name, policy.prepare(observation)))
        except ObservationError as error:
            raise ObservationError(f"{name}: {error}") from error
    if len(samples) < 2:
        raise ObservationError(
            f"calibration needs two observations or more, as some are held out to measure with; {described} has "
            f"{len(samples)}"
        )
    return described, samples


def _observations(
    policy: UnifiedPolicy, source: str | None, count: int
) -> tuple[str, Iterator[tuple[str, Mapping[str, Any]]]]:
    if source == RANDOM_NOISE:
        return RANDOM_NOISE, ((f"random noise {seed}", policy.example_observation(seed)) for seed in range(count))
    if source is None:
        robot = policy.metadata["robot"]
        if robot != "libero":
            raise ConfigError(
                f"calibration for robot {robot!r} needs observations of it: --observations RECORDING, which "
                "`turbopi serve --record` writes"
            )
        listed = shipped.observations(policy, shipped.load_frames())
        return LIBERO, ((f"LIBERO frame {i}", listed[i]) for i in spread(len(listed), count))
    path = Path(source)
    files = observation_files(path)
    chosen = [files[i] for i in spread(len(files), count)]
    return str(path), ((_name(file, path), load_observation(file)) for file in chosen)


def observation_files(path: Path) -> list[Path]:
    """The observations of a recording, of a folder of them, or the one at `path`. Raises ObservationError for none."""
    if not path.exists():
        raise ObservationError(f"{path} doesn't exist")
    if path.is_dir():
        if (path / "observation.json").is_file():
            return [path]
        by_hand = sorted(file.parent for file in path.glob("*/observation.json"))
        return by_hand or recorded_files(path)
    return [path]


def _name(file: Path, path: Path) -> str:
    return file.name if file == path else str(file.relative_to(path))


def spread(available: int, count: int) -> list[int]:
    """`count` numbers below `available`, evenly spread; all if there are fewer."""
    return [i * available // count for i in range(count)] if available > count else list(range(available))


def split(samples: Sequence[Sample]) -> tuple[list[Sample], list[Sample]]:
    """(to choose scales on, held out): every fourth is held out, of few the last."""
    numbers = list(range(len(samples)))
    held = numbers[EVERY - 1 :: EVERY] or numbers[-1:]
    return [samples[i] for i in numbers if i not in held], [samples[i] for i in held]


def calls(samples: Sequence[Sample], shape: tuple[int, int], noises: int, seed: int) -> list[Call]:
    """Every observation with several noises float32[1, H, action_dim], of seeds in a row."""
    made: list[Call] = []
    for sample in samples:
        for _ in range(noises):
            number = seed + len(made)
            noise = np.random.default_rng(number).standard_normal((1, *shape), dtype=np.float32)
            made.append(Call(sample, number, torch.from_numpy(noise)))
    return made


def batches(made: Sequence[Call], size: int, device: torch.device) -> Iterator[tuple[list[Call], Batch]]:
    """Calls in batches that have no padding: those of the same cameras and prompt length together."""
    groups: dict[tuple[bytes, bytes], list[Call]] = {}
    for call in made:
        inputs = call.sample.inputs
        groups.setdefault((inputs.image_mask.tobytes(), inputs.token_mask.tobytes()), []).append(call)
    for group in groups.values():
        for start in range(0, len(group), size):
            part = group[start : start + size]
            observation = Observation.stack([call.sample.inputs for call in part], device)
            yield part, (observation, torch.cat([call.noise for call in part]).to(device))
