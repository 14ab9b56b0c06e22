"""What does a backend do to actions? Those of pytorch in bfloat16, tensorrt and tensorrt_fp8 against float32's."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from msgspec import Struct

from turbopi.models.observation import Observation
from turbopi.policy.policy import UnifiedPolicy
from turbopi.support.reading import plain_document
from turbopi.support.text import cosine, significant
from turbopi_lab.studies.differences import errors_of
from turbopi_lab.studies.report import Cell, Control, Grid, Panel, Plot, Report, Series
from turbopi_lab.studies.study import Setup, Study

BACKENDS = ("pytorch", "tensorrt", "tensorrt_fp8")  # in bfloat16, but for the last
RANDOM_OBSERVATIONS = 8


class BackendOff(Struct, frozen=True):
    """A backend's actions on a group of observations."""

    backend: str
    observations: str
    count: int
    worst_cosine: float | None  # None: not finite
    worst_relative: float | None


def actions_study(
    exact: UnifiedPolicy, judged: UnifiedPolicy, observations: Mapping[str, Sequence[Any]], num_steps: int
) -> list[BackendOff]:
    """The model's actions (all of its dimensions, before the robot's units) through one policy against another's.

    One result for each group of observations, with the worst observation's cosine and relative error; the i-th one of
    a group gets the noise of seed i.
    """
    results = []
    for group, given in observations.items():
        errors = []
        for seed, obs in enumerate(given):
            one = Observation.stack([exact.prepare(obs)])
            shape = (1, exact.config.model.action_horizon, exact.config.model.action_dim)
            noise = torch.from_numpy(np.random.default_rng(seed).standard_normal(shape, dtype=np.float32))
            ours, truth = (policy.backend.sample(one, noise, num_steps).actions for policy in (judged, exact))
            errors.append(errors_of(ours.cpu(), truth.cpu()))
        cosines = [one.cosine for one in errors if one.cosine is not None]
        relative = [one.relative for one in errors if one.relative is not None]
        finite = len(cosines) == len(relative) == len(errors)
        worst = (min(cosines), max(relative)) if finite else (None, None)
        results.append(BackendOff(judged.backend.name, group, len(errors), *worst))
    return results


def run(setup: Setup) -> Report:
    checkpoint = setup.needed_checkpoint("actions")
    exact = UnifiedPolicy(checkpoint, backend="pytorch", precision="f32", device=setup.device)
    given, source = setup.observations(exact)
    groups = {source: given, "random": [exact.example_observation(seed) for seed in range(RANDOM_OBSERVATIONS)]}
    itself = actions_study(exact, exact, {source: given[:1]}, setup.steps)[0]
    found = []
    for name in BACKENDS:
        found += actions_study(exact, UnifiedPolicy(checkpoint, backend=name, device=setup.device), groups, setup.steps)
    rows: list[list[Cell]] = [
        [one.backend, one.observations, one.count, cosine(one.worst_cosine), one.worst_relative] for one in found
    ]
    by_backend = [[one.worst_relative or 0.0 for one in found if one.observations == group] for group in groups]
    places = [float(number) for number in range(len(BACKENDS))]
    series = [Series(group, places, errors) for group, errors in zip(groups, by_backend, strict=True)]
    reported = ", ".join(f"{number} {name}" for number, name in enumerate(BACKENDS))
    return setup.report(
        STUDY,
        method=f"{exact.config.name}, {setup.steps} steps. The worst observation of each group, noise by its number.",
        controls=[Control("The reference has no error.", itself.worst_relative == 0, f"{itself.worst_relative}.")],
        tables=[Grid("Errors", ["backend", "observations", "count", "worst cosine", "worst relative error"], rows)],
        plots=[Plot("actions", [Panel("Worst error", reported, "relative error", series, log_y=True)])],
        verdict="; ".join(f"{o.backend} on {o.observations}: {significant(o.worst_relative)}" for o in found) + ".",
        would_change="A checkpoint with larger outliers.",
        not_run=["In closed loop: `turbopi compare` does that."],
        data={"actions": [plain_document(one) for one in found], "random_weights": checkpoint.random is not None},
    )


STUDY = Study(
    "actions",
    "What do backends do to actions?",
    "FP8 through Torch-TensorRT has a cosine of 0.9996, NVFP4 of 0.0004.",
    run,
    needs_tensorrt=True,
)
