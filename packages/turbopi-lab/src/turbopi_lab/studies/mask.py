"""What happens if a padded cache isn't masked? A compacted, a padded and masked, and padded caches that aren't, or not
all, in float32 PyTorch: to actions of any checkpoint, and to successes on toy tasks. No TensorRT is needed.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import torch.nn.functional as F
from msgspec import Struct
from torch import Tensor

from turbopi.backends.pytorch import reference_model
from turbopi.evaluate.statistics import PairedDocument, RateDocument
from turbopi.models.observation import Observation
from turbopi.models.pi0.kv_cache import KVCache
from turbopi.models.pi0.reference import Pi0Model
from turbopi.policy.policy import UnifiedPolicy
from turbopi.support.reading import plain_document
from turbopi.support.text import cosine, significant
from turbopi_lab.studies.differences import errors_of
from turbopi_lab.studies.problems import one_problem
from turbopi_lab.studies.report import (
    PERCENT,
    Cell,
    Control,
    Grid,
    Panel,
    Plot,
    Report,
    Series,
    compared,
    paired_cell,
    rate_cells,
    rate_series,
)
from turbopi_lab.studies.rollouts import Call, Played, ToyPolicy, open_policy, play, sampled
from turbopi_lab.studies.study import Setup, Study, Tell

MASKED, UNMASKED = "padded, masked", "padded, not masked"
CACHES = ("compacted", MASKED, UNMASKED)
PARTS = ("prompt's padding not masked", "missing camera not masked")  # the rest is
STEPS = (1, 10)
LOOP_STEPS = 5  # in closed loop, as these policies were judged
CAMERAS = 3  # that a padded observation has slots for
_ROUNDING = 1e-4  # relative


class CacheOff(Struct, frozen=True):
    """The actions made from one kind of cache."""

    cache: str  # one of CACHES
    slots: int
    steps: int  # of denoising
    max: float | None
    relative: float | None
    cosine: float | None


class MaskCell(Struct, frozen=True):
    """A kind of cache on a policy's task."""

    policy: str
    cache: str
    rate: RateDocument
    against_compacted: PairedDocument
    action_error: float  # rms of the chunks' difference to the compacted cache's, relative to those

    @property
    def verdict(self) -> str:
        return compared(self.against_compacted)


def cache_of(model: Pi0Model, observation: Observation, name: str) -> KVCache:
    """A cache by its name. The padded ones have all slots, those of masked cameras and of padding, too."""
    if name == CACHES[0]:
        return model.prefix(observation)
    padded = model.prefix(observation, compact=False)
    if name == MASKED:
        return padded
    if name == UNMASKED:
        return replace(padded, mask=None)
    assert padded.mask is not None and name in PARTS
    images, mask = observation.image_mask.shape[1] * model.config.vision.num_tokens, padded.mask.clone()
    mask[:, slice(images, None) if name == PARTS[0] else slice(images)] = True
    return replace(padded, mask=mask)


def mask_study(model: Pi0Model, observation: Observation, noise: Tensor, steps: Sequence[int]) -> list[CacheOff]:
    """Actions from three kinds of cache against those of the compacted one, by number of steps."""
    caches = {name: cache_of(model, observation, name) for name in CACHES}
    results = []
    for name, cache in caches.items():
        for count in steps:
            truth = model.denoise(caches[CACHES[0]], noise, count)
            errors = errors_of(model.denoise(cache, noise, count), truth)
            results.append(CacheOff(name, cache.k.shape[3], count, errors.max, errors.relative, errors.cosine))
    return results


# --- closed loop ------------------------------------------------------------------------------------------------------


def padded_as_served(policy: ToyPolicy, observation: Observation) -> Observation:
    """A toy task's observation as the policy's own pipeline pads it: a camera that isn't there, and a longer prompt."""
    missing = CAMERAS - observation.images.shape[1]
    padding = policy.config.model.max_prompt_tokens - observation.tokens.shape[1]
    return replace(
        observation,
        images=F.pad(observation.images, (*(0,) * 6, 0, missing)),
        image_mask=F.pad(observation.image_mask, (0, missing)),
        tokens=F.pad(observation.tokens, (0, padding)),
        token_mask=F.pad(observation.token_mask, (0, padding)),
    )


@dataclass
class Caching:
    """Answers calls from one kind of cache of the padded observation, or of the one without `padding`, and compares."""

    policy: ToyPolicy
    cache: str
    padding: bool = True
    difference: float = 0.0  # sums of squares
    size: float = 0.0

    def __call__(self, call: Call) -> Tensor:
        model, seen = self.policy.model, call.observation
        cache = cache_of(model, padded_as_served(self.policy, seen) if self.padding else seen, self.cache)
        chunk = model.denoise(cache, call.noise, LOOP_STEPS)
        exact = sampled(model, LOOP_STEPS)(call)
        self.difference += float((chunk - exact)[..., :2].double().square().sum())
        self.size += float(exact[..., :2].double().square().sum())
        return chunk

    @property
    def error(self) -> float:
        return math.sqrt(self.difference / self.size)


def judge(tell: Tell, name: str, folder: Path, *, count: int, small: bool) -> tuple[list[MaskCell], list[Control]]:
    """A policy with every kind of cache, and what has to hold of it."""
    policy, episodes = open_policy(name, folder), range(count)
    plain = play(policy, episodes, sampled(policy.model, LOOP_STEPS))
    played: dict[str, Played] = {}
    cells = []
    for cache in (*CACHES, *(() if small else PARTS)):
        caching = Caching(policy, cache)
        played[cache] = play(policy, episodes, caching)
        rates = played[cache].rate.document, played[cache].against(plain).document
        cells.append(MaskCell(name, cache, *rates, caching.error))
        tell(f"{name}: {cache}: {played[cache].rate}, error {caching.error:.2g}, {cells[-1].verdict}")
    few = range(min(16, count))
    unpadded = Caching(policy, UNMASKED, padding=False)
    same = bool(np.array_equal(play(policy, few, unpadded).solved, plain.solved[: len(few)]))
    masked = bool(np.array_equal(played[MASKED].solved, plain.solved))
    worst = max(cell.action_error for cell in cells if cell.cache != UNMASKED and cell.cache not in PARTS)
    return cells, [
        Control(
            f"{name}: compacted, and padded under its mask, the same episodes are solved, and actions differ by "
            "rounding.",
            masked and bool(np.array_equal(played[CACHES[0]].solved, plain.solved)) and worst < _ROUNDING,
            f"Relative error of all calls at most {significant(worst)}.",
        ),
        Control(
            f"{name}: where nothing is padded, a cache without a mask changes nothing.",
            same and unpadded.error < _ROUNDING,
            f"{len(few)} episodes, relative error {significant(unpadded.error)}.",
        ),
    ]


# --- the study --------------------------------------------------------------------------------------------------------


def run(setup: Setup) -> Report:
    checkpoint = setup.needed_checkpoint("mask")
    policy = UnifiedPolicy(checkpoint, backend="pytorch", precision="f32", device=setup.device)
    observation, noise, source = one_problem(policy, setup)
    found = mask_study(reference_model(policy.backend), observation, noise, STEPS)
    worst = {name: max(_size(one.relative) for one in found if one.cache == name) for name in CACHES}
    rows: list[list[Cell]] = [[one.cache, one.slots, one.steps, cosine(one.cosine), one.relative] for one in found]
    judged = setup.each(partial(judge, count=setup.cell_episodes, small=setup.small), setup.toy_policies)
    cells = [cell for own, _ in judged for cell in own]
    return setup.report(
        STUDY,
        method=(
            f"{source}: the first, one noise, {policy.config.name}, float32 PyTorch. The suffix attends to a compacted "
            "cache, to all slots of a padded one under a mask, and to all slots without a mask; actions against the "
            f"compacted cache's. Closed loop on toy tasks, {LOOP_STEPS} steps, the same episodes and noise in every "
            f"cell; the padding is what the policy's own pipeline adds: a third camera that isn't there, and a prompt "
            "of the policy's largest length."
        ),
        controls=[
            Control(
                "A padded cache under its mask gives the compacted one's actions.",
                worst[MASKED] < _ROUNDING,
                f"Largest relative error {significant(worst[MASKED])}.",
            ),
            *(control for _, controls in judged for control in controls),
        ],
        tables=[
            Grid("Actions", ["cache", "slots", "steps", "cosine", "relative error"], rows),
            *(_table(name, cells) for name in setup.toy_policies),
        ],
        plots=[Plot("mask", [_errors(found), _success(cells)])],
        verdict=(
            f"Without its mask the padded cache changes the actions by {significant(worst[UNMASKED])} of "
            f"their size; with it by {significant(worst[MASKED])}. Closed loop, not masked: {_said(cells)}. The mask "
            "may be left out where there is no padding: in a compacted cache."
        ),
        would_change="An observation without padding and with all cameras: then the three caches are one.",
        not_run=["LIBERO: `turbopi study mask_libero`."],
        data={
            "mask": [plain_document(one) for one in found],
            "closed_loop": [plain_document(cell) for cell in cells],
            "random_weights": checkpoint.random is not None,
        },
    )


def _size(error: float | None) -> float:
    return math.inf if error is None else error


def _said(cells: Sequence[MaskCell]) -> str:
    own = [cell for cell in cells if cell.cache == UNMASKED]
    return "; ".join(f"{one.policy} {paired_cell(one.against_compacted)} points, {one.verdict}" for one in own)


def _table(policy: str, cells: Sequence[MaskCell]) -> Grid:
    columns = ["cache", "action error", "solved", "success, % [95 %]", "against compacted, points"]
    rows: list[list[Cell]] = [
        [cell.cache, cell.action_error, *rate_cells(cell.rate), paired_cell(cell.against_compacted)]
        for cell in cells
        if cell.policy == policy
    ]
    return Grid(f"Closed loop: {policy}", columns, rows)


def _errors(found: Sequence[CacheOff]) -> Panel:
    series = []
    for name in CACHES[1:]:
        own = [one for one in found if one.cache == name]
        series.append(Series(name, [float(one.steps) for one in own], [_size(one.relative) for one in own]))
    return Panel("Error of the actions", "denoising steps", "relative error", series, log_y=True)


def _success(cells: Sequence[MaskCell]) -> Panel:
    series = []
    for policy in dict.fromkeys(cell.policy for cell in cells):
        rates = [cell.rate for cell in cells if cell.policy == policy]
        series.append(rate_series(policy, [float(i + 1) for i in range(len(rates))], rates))
    ticks = series[0].x
    return Panel("Success", "cache, in the table's order", PERCENT, series, ticks=ticks)


CLAIMED = "The suffix needs no mask: with one, ten steps had a cosine of −0.18, without it 0.995."

STUDY = Study("mask", "What happens to actions and successes if a padded cache isn't masked?", CLAIMED, run)
