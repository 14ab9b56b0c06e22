"""What a policy is calibrated on: recorded observations, and noise to begin from."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from turbopi.models.observation import Observation
from turbopi.policy import shipped
from turbopi.policy.examples import Example, NoisyExample, prepared
from turbopi.policy.policy import UnifiedPolicy
from turbopi.quantization.calibration_file import RANDOM_NOISE
from turbopi.recordings import load_observation
from turbopi.recordings.sources import chosen_files, spread
from turbopi.support.errors import ConfigError, ObservationError

LIBERO = "the LIBERO images that come with Turbo-Pi"
EVERY = 4  # of so many observations one is held out

Batch = tuple[Observation, Tensor]


def read_examples(policy: UnifiedPolicy, source: str | None, count: int) -> tuple[str, list[Example]]:
    """What the observations are, in words, and up to `count` of them, evenly spread over what there is.

    source  a recording, a folder of observations, an .npz; None: LIBERO images, for that robot; "random-noise"

    Raises ObservationError naming the one that can't be used, and where there are fewer than two.
    """
    described, found = _observations(policy, source, count)
    examples = list(prepared(policy, found))
    if len(examples) < 2:
        raise ObservationError(
            f"calibration needs two observations or more, as some are held out to measure with; {described} has "
            f"{len(examples)}"
        )
    return described, examples


def _observations(
    policy: UnifiedPolicy, source: str | None, count: int
) -> tuple[str, Iterable[tuple[str, Mapping[str, Any]]]]:
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
    chosen = chosen_files(Path(source), count)
    return str(Path(source)), ((name, load_observation(file)) for name, file in chosen)


def split(examples: Sequence[Example]) -> tuple[list[Example], list[Example]]:
    """(to choose scales on, held out): every fourth is held out, of few the last."""
    numbers = list(range(len(examples)))
    held = numbers[EVERY - 1 :: EVERY] or numbers[-1:]
    return [examples[i] for i in numbers if i not in held], [examples[i] for i in held]


def batches(
    made: Sequence[NoisyExample], size: int, device: torch.device
) -> Iterator[tuple[list[NoisyExample], Batch]]:
    """In batches that have no padding: those of the same cameras and prompt length together."""
    groups: dict[tuple[bytes, bytes], list[NoisyExample]] = {}
    for one in made:
        inputs = one.example.inputs
        groups.setdefault((inputs.image_mask.tobytes(), inputs.token_mask.tobytes()), []).append(one)
    for group in groups.values():
        for start in range(0, len(group), size):
            part = group[start : start + size]
            observation = Observation.stack([one.example.inputs for one in part], device)
            yield part, (observation, torch.cat([one.noise for one in part]).to(device))
