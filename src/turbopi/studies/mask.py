"""What happens to actions if a padded cache isn't masked? A compacted, a padded and masked, and a padded and not masked
cache in float32 PyTorch; no TensorRT is needed.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

from msgspec import Struct
from torch import Tensor

from turbopi.backends.pytorch import reference_model
from turbopi.model.kv_cache import KVCache
from turbopi.model.reference import Pi0Model
from turbopi.observation import Observation
from turbopi.policy import UnifiedPolicy
from turbopi.reading import plain_document
from turbopi.studies.differences import errors_of
from turbopi.studies.problems import one_problem
from turbopi.studies.report import Cell, Control, Grid, Panel, Plot, Report, Series
from turbopi.studies.study import Setup, Study
from turbopi.wording import cosine, significant

CACHES = ("compacted", "padded, masked", "padded, not masked")
STEPS = (1, 10)


class CacheOff(Struct, frozen=True):
    """The actions made from one kind of cache."""

    cache: str  # one of CACHES
    slots: int
    steps: int  # of denoising
    max: float | None
    relative: float | None
    cosine: float | None


def mask_study(model: Pi0Model, observation: Observation, noise: Tensor, steps: Sequence[int]) -> list[CacheOff]:
    """Actions from three kinds of cache against those of the compacted one, by number of steps.

    The padded cache has all slots: masked cameras and padding too. Without a mask the suffix attends to them.
    """
    compacted, padded = model.prefix(observation), model.prefix(observation, compact=False)
    caches: dict[str, KVCache] = dict(zip(CACHES, (compacted, padded, replace(padded, mask=None)), strict=True))
    results = []
    for name, cache in caches.items():
        for count in steps:
            truth = model.denoise(compacted, noise, count)
            errors = errors_of(model.denoise(cache, noise, count), truth)
            results.append(CacheOff(name, cache.k.shape[3], count, errors.max, errors.relative, errors.cosine))
    return results


def run(setup: Setup) -> Report:
    checkpoint = setup.needed_checkpoint("mask")
    policy = UnifiedPolicy(checkpoint, backend="pytorch", precision="f32", device=setup.device)
    observation, noise, source = one_problem(policy, setup)
    found = mask_study(reference_model(policy.backend), observation, noise, STEPS)
    worst = {name: max(_size(one.relative) for one in found if one.cache == name) for name in CACHES}
    rows: list[list[Cell]] = [[one.cache, one.slots, one.steps, cosine(one.cosine), one.relative] for one in found]
    series = []
    for name in CACHES[1:]:
        own = [one for one in found if one.cache == name]
        series.append(Series(name, [float(one.steps) for one in own], [_size(one.relative) for one in own]))
    return setup.report(
        STUDY,
        method=(
            f"{source}: the first, one noise, {policy.config.name}, float32 PyTorch. The suffix attends to a compacted "
            "cache, to all slots of a padded one under a mask, and to all slots without a mask; actions against the "
            "compacted cache's."
        ),
        controls=[
            Control(
                "A padded cache under its mask gives the compacted one's actions.",
                worst["padded, masked"] < 1e-4,
                f"Largest relative error {significant(worst['padded, masked'])}.",
            )
        ],
        tables=[Grid("Actions", ["cache", "slots", "steps", "cosine", "relative error"], rows)],
        plots=[Plot("mask", [Panel("Error of the actions", "denoising steps", "relative error", series, log_y=True)])],
        verdict=(
            f"Without its mask the padded cache changes the actions by {significant(worst['padded, not masked'])} of "
            f"their size; with it by {significant(worst['padded, masked'])}. The mask may be left out where there is "
            "no padding: in a compacted cache."
        ),
        would_change="An observation without padding and with all cameras: then the three caches are one.",
        not_run=["The unmasked cache in closed loop with a trained policy."],
        data={"mask": [plain_document(one) for one in found], "random_weights": checkpoint.format == "random"},
    )


def _size(error: float | None) -> float:
    return math.inf if error is None else error


STUDY = Study(
    "mask",
    "What happens to actions if a padded cache isn't masked?",
    "The suffix needs no mask: with one, ten steps had a cosine of −0.18, without it 0.995.",
    run,
)
