"""What a backend is verified on: observations, each with several noises."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from turbopi.policy import shipped
from turbopi.policy.examples import Example, NoisyExample, prepared, with_noises
from turbopi.policy.policy import UnifiedPolicy
from turbopi.recordings import load_observation
from turbopi.recordings.sources import chosen_files

DEFAULT_OBSERVATIONS = 8


@dataclass(frozen=True)
class VerifyPlan:
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
    calibrated: frozenset[str] = frozenset()  # SHA-256 of the inputs that the calibration was made on


def check_observations(plan: VerifyPlan) -> None:
    """Refuse now what can't be read, before minutes of loading."""
    if plan.observations is None:
        return
    for _, file in chosen_files(plan.observations, plan.count)[:1]:
        load_observation(file)


def read_examples(policy: UnifiedPolicy, plan: VerifyPlan) -> Iterator[Example]:
    """The observations as the model gets them. Raises ObservationError naming the one that can't be used.

    Of those at a path, the ones that the calibration wasn't made on; others only where there are too few of them.
    """
    if plan.observations is None or not plan.calibrated:
        yield from prepared(policy, _observations(policy, plan))
        return
    files = chosen_files(plan.observations, plan.count)
    first = set(files)
    files += [one for one in chosen_files(plan.observations) if one not in first]
    count, unseen, seen = len(files) if plan.count is None else plan.count, 0, []
    for example in prepared(policy, ((name, load_observation(file)) for name, file in files)):
        if example.sha256 in plan.calibrated:
            seen.append(example)
            continue
        yield example
        unseen += 1
        if unseen == count:
            return
    yield from seen[: (0 if unseen else len(seen)) if plan.count is None else count - unseen]


def _observations(policy: UnifiedPolicy, plan: VerifyPlan) -> Iterator[tuple[str, Mapping[str, object]]]:
    if plan.observations is not None:
        for name, file in chosen_files(plan.observations, plan.count):
            yield name, load_observation(file)
        return
    wanted = DEFAULT_OBSERVATIONS if plan.count is None else plan.count
    frames = shipped.load_frames()[:wanted] if policy.metadata["robot"] == "libero" else []
    for number, observation in enumerate(shipped.observations(policy, frames)):
        yield f"LIBERO frame {number}", observation
    for seed in range(wanted - len(frames)):
        yield f"random example {seed}", policy.example_observation(seed)


def make_calls(policy: UnifiedPolicy, examples: Sequence[Example], plan: VerifyPlan) -> list[NoisyExample]:
    """Every observation with `noises` noises."""
    model = policy.config.model
    return with_noises(examples, (model.action_horizon, model.action_dim), plan.noises, plan.seed)
