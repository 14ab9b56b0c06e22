"""Errors of a policy's chunks against what was recorded, and what else would have been wrong by.

Relative errors are in units of the model's normalised actions, those that it was trained in: half of the range that
holds 98 % of the training's actions, or one standard deviation, by how the checkpoint normalises.
"""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from turbopi.replay.document import Against, Changed, Control, Joint, PolicyDocument, Spread, State
from turbopi.replay.episodes import Episode
from turbopi.replay.run import Replayed
from turbopi.support.action_groups import action_groups

NEVER_MOVED = 2e-6  # of a unit: the epsilons of normalising, where the statistics have one value alone
OTHER_MOMENTS = 8  # draws of the control "another moment's chunk"
OUTSIDE = 2.0  # ranges of the training beside its middle, beyond which numbers are noted
OTHERS, MEAN, HELD = "another moment's chunk", "the mean action", "the action before, held"


@dataclass(frozen=True)
class Compared:
    """A policy's errors.

    error      float64[N, H, d]  absolute, in the robot's units; NaN behind an episode's end
    relative   float64[N, H, d]  the same in `units`; NaN also for actions that never moved in training
    """

    label: str
    run: Replayed
    units: np.ndarray
    error: np.ndarray
    relative: np.ndarray

    @property
    def by_moment(self) -> np.ndarray:
        """float64[N]: mean relative error of each chunk."""
        return mean(self.relative, (1, 2))


def compared(label: str, run: Replayed, units: np.ndarray | None = None) -> Compared:
    """`units`: another policy's, so that relative errors mean the same."""
    units = run.units if units is None else units
    error = np.abs(run.predicted - run.recorded)
    return Compared(label, run, units, error, relative(error, units))


def relative(error: np.ndarray, units: np.ndarray) -> np.ndarray:
    """float64[…, d] in units; NaN for those that never moved in training."""
    return np.asarray(error / np.where(units > NEVER_MOVED, units, np.nan))


def mean(values: np.ndarray, axis: int | tuple[int, ...] | None = None) -> np.ndarray:
    """Without what is NaN; NaN where all is."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        return np.asarray(np.nanmean(values, axis))


def spread(values: np.ndarray) -> Spread:
    """Of errors, without what is NaN, of which there is something else."""
    found = values[np.isfinite(values)]
    if not found.size:
        return Spread(0.0, 0.0, 0.0)
    return Spread(float(found.mean()), float(np.percentile(found, 95)), float(found.max()))


# --- controls ---------------------------------------------------------------------------------------------------------


def controls(one: Compared) -> list[Control]:
    """What a chunk for another moment, a constant, and the action before are wrong by. For relative actions the first
    two start from the moment's own state. Those that can't be had are left out: one moment has no other, a recording of
    calls has no action before.
    """
    run = one.run
    predicted, recorded = run.moved
    count = len(recorded)
    found: list[Control] = []
    if count > 1:
        draws = np.random.default_rng(0)
        pairs = [(np.arange(count) + draws.integers(1, count, count)) % count for _ in range(OTHER_MOMENTS)]
        errors = np.stack([np.abs(predicted[pair] - recorded) for pair in pairs])  # [draws, N, H, d]
        found.append(_control(OTHERS, relative(errors, one.units)))
        constant = mean(recorded, (0, 1))
        found.append(_control(MEAN, relative(np.abs(constant - recorded), one.units)))
    if np.isfinite(run.previous).any():
        found.append(_control(HELD, relative(np.abs(run.previous[:, None] - run.recorded), one.units)))
    return found


def _control(name: str, errors: np.ndarray) -> Control:
    horizon = errors.shape[-2]
    by_index = [float(mean(errors[..., index, :])) for index in range(horizon)]
    return Control(name, float(mean(errors)), [value for value in by_index if np.isfinite(value)])


def changes(one: Compared) -> list[Changed]:
    """The policy with inputs changed on purpose."""
    rows = list(one.run.changed)
    truth = one.run.recorded[rows]
    base = one.by_moment[rows]
    found = []
    for name, chunks in one.run.variations.items():
        errors = mean(relative(np.abs(chunks - truth), one.units), (1, 2))
        nearer = int((errors < base).sum())
        found.append(Changed(name, len(rows), float(mean(errors)), float(mean(base)), nearer))
    return found


# --- documents --------------------------------------------------------------------------------------------------------


def names_of(one: Compared, action_names: Sequence[str] | None) -> list[tuple[str, str]]:
    """(name, unit) of each action: the robot's own, else the dataset's."""
    dims = one.error.shape[2]
    named = dict[int, tuple[str, str]]()
    for group in action_groups(str(one.run.about["robot"]), dims, action_names):
        numbered = group.title.startswith("actions ")  # of a robot that isn't known
        for index, name in group.names.items():
            named[index] = (name if numbered or name == group.title else f"{group.title} {name}", group.unit)
    return [named[index] for index in range(dims)]


def policy_document(one: Compared, checkpoint: str, action_names: Sequence[str] | None) -> PolicyDocument:
    run = one.run
    horizon = int(np.isfinite(run.recorded).any(axis=(0, 2)).sum())  # indices that something was recorded of
    predicted, recorded = run.moved
    joints = []
    low, high = run.ends.mean(1)
    for index, (name, unit) in enumerate(names_of(one, action_names)):
        values = run.recorded[..., index]
        joints.append(
            Joint(
                name,
                unit,
                spread(one.error[..., index]),
                spread(one.relative[..., index]) if run.units[index] > NEVER_MOVED else None,
                [spread(one.error[:, k, index]) for k in range(horizon)],
                correlation(predicted[..., index], recorded[..., index]),
                quantiles(values),
                (float(low[index]), float(high[index])),
            )
        )
    return PolicyDocument(
        one.label,
        checkpoint,
        run.about,
        dict(run.keys.joined),
        spread(one.relative),
        [spread(one.relative[:, k]) for k in range(horizon)],
        joints,
        float(np.median(run.call_ms)),
        changes(one),
        list(run.broken),
    )


def correlation(predicted: np.ndarray, recorded: np.ndarray) -> float | None:
    """Pearson's, of what was recorded; None where one of them hardly moves."""
    there = np.isfinite(recorded)
    p, r = predicted[there], recorded[there]
    if p.size < 3 or min(p.std(), r.std()) <= 1e-9 * max(np.abs(r).max(), np.abs(p).max(), 1e-9):
        return None
    return float(np.corrcoef(p, r)[0, 1])


def quantiles(values: np.ndarray) -> tuple[float, float]:
    """1 % and 99 %, without what is NaN."""
    low, high = np.nanpercentile(values, [1, 99])
    return float(low), float(high)


def state_documents(run: Replayed, names: Sequence[str] | None) -> list[State]:
    """Each number of the state beside its statistics."""
    found = []
    ranges = [(float(low), float(high)) for low, high in zip(*run.state_range, strict=True)]
    width = run.states.shape[1]
    for index in range(width):
        name = names[index] if names is not None and len(names) == width else f"value {index}"
        recorded = quantiles(run.states[:, index])
        trained = ranges[index] if index < len(ranges) else None
        outside = False
        if trained is not None:
            middle, half = (trained[0] + trained[1]) / 2, (trained[1] - trained[0]) / 2
            outside = half > NEVER_MOVED and max(abs(recorded[0] - middle), abs(recorded[1] - middle)) > OUTSIDE * half
        found.append(State(name, recorded, trained, outside))
    return found


# --- two policies -----------------------------------------------------------------------------------------------------


def against(first: Compared, second: Compared) -> Against:
    """Both have the same moments, and `second` the first one's units."""
    horizon = min(first.relative.shape[1], second.relative.shape[1])
    own, other = (mean(one.relative[:, :horizon], (1, 2)) for one in (first, second))
    difference = other - own
    between = np.abs(second.run.predicted[:, :horizon] - first.run.predicted[:, :horizon])
    return Against(
        float(difference.mean()),
        _interval(difference, [episode for episode, _ in first.run.moments]),
        int((difference < 0).sum()),
        len(difference),
        spread(relative(between, first.units)),
    )


def _interval(values: np.ndarray, episodes: Sequence[Episode]) -> tuple[float, float] | None:
    """95 % of the mean, by resampling episodes: moments of one are alike."""
    numbers = np.array([episode.number for episode in episodes])
    groups = [values[numbers == number] for number in np.unique(numbers)]
    if len(groups) < 3:
        return None
    sums, counts = np.array([group.sum() for group in groups]), np.array([len(group) for group in groups])
    drawn = np.random.default_rng(0).integers(0, len(groups), (2000, len(groups)))
    low, high = np.percentile(sums[drawn].sum(1) / counts[drawn].sum(1), [2.5, 97.5])
    return float(low), float(high)


def worst_moments(one: Compared, count: int) -> list[int]:
    """Indices of the moments with the largest error, none within a chunk of another."""
    horizon, found = one.error.shape[1], list[int]()
    for index in map(int, np.argsort(-np.nan_to_num(one.by_moment, nan=-1.0))):
        episode, step = one.run.moments[index]
        near = [
            at for at in found if one.run.moments[at][0] == episode and abs(one.run.moments[at][1] - step) < horizon
        ]
        if not near:
            found.append(index)
        if len(found) == count:
            break
    return found
