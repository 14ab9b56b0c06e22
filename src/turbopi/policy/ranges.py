"""Where the values of the training data lie, by the checkpoint's statistics, and which values are outside."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from turbopi.checkpoint.norm_stats import FeatureStats
from turbopi.policy.watch import FAR, NEAR, Outside, listed_values
from turbopi.robots import Robot
from turbopi.robots.labels import Label, is_built_in

DEVIATIONS = 3.0  # about the mean, where there are no quantiles and no extremes


class DrawnRange(NamedTuple):
    """For plots: NaN where a dimension has no range there."""

    labels: tuple[Label, ...]
    low: np.ndarray
    high: np.ndarray


class TrainingRange:
    """One feature's range: its 1 % and 99 % quantiles; else least and most; else mean ± DEVIATIONS · std.

    labels  of its dimensions: it judges as many values as there are labels and statistics

    A dimension that was constant in training has no range, so nothing is outside; where the statistics also have the
    extremes, nothing up to them is far.
    """

    def __init__(self, stats: FeatureStats | None, labels: Sequence[Label]) -> None:
        self.source, low, high = range_of(stats)
        self.labels = tuple(labels)[: len(low)]
        self.low, self.high = low[: len(self.labels)], high[: len(self.labels)]
        width = np.where(self.high > self.low, self.high - self.low, np.inf)
        self.widths: list[float] = width.tolist()  # infinite where there is no range
        self._near = (self.low - NEAR * width).tolist(), (self.high + NEAR * width).tolist()
        self.least, self.most = self.low - FAR * width, self.high + FAR * width  # what isn't far
        if stats is not None and stats.min is not None and stats.max is not None:
            self.least = np.minimum(self.least, stats.min[: len(low)][: len(self.labels)])
            self.most = np.maximum(self.most, stats.max[: len(low)][: len(self.labels)])

    @property
    def drawn(self) -> DrawnRange:
        return DrawnRange(self.labels, self.low, self.high)

    def drawn_of_actions(self, robot: Robot, width: int) -> DrawnRange:
        """In the units that the robot gets. Relative actions have no range there, nor do a class's of the user.

        width  of the model's actions, un-normalised
        """
        few, mask = len(self.labels), np.array(robot.delta_mask or (), np.bool_)
        nowhere = np.full(few, np.nan)
        if not is_built_in(robot) or not few:
            return DrawnRange(self.labels, nowhere, nowhere)
        ends = np.zeros((2, max(width, few)))
        ends[:, :few] = self.low, self.high
        ends = np.sort(np.array(robot.outputs(ends), np.float64)[:, :few], axis=0)  # some joints turn the other way
        ends[:, : len(mask)][:, mask[:few]] = np.nan
        return DrawnRange(self.labels, *ends)

    def outside(self, values: Sequence[float]) -> tuple[Outside, ...]:
        """Which are outside. A loop over few numbers is sooner done than NumPy begins."""
        for value, low, high in zip(values, *self._near, strict=False):
            if not low <= value <= high:
                break
        else:
            return ()
        known = enumerate(zip(values, *self._near, strict=False))
        return tuple(self._outside(i, value) for i, (value, low, high) in known if not low <= value <= high)

    def _outside(self, index: int, value: float, step: int | None = None) -> Outside:
        far = not self.least[index] <= value <= self.most[index]
        return Outside(self.labels[index].name, value, float(self.low[index]), float(self.high[index]), far, step)

    def worst(self, chunk: np.ndarray) -> tuple[Outside, ...]:
        """Of actions float[H, d], of each dimension that has far ones the farthest."""
        values = chunk[:, : len(self.labels)]
        beyond = np.maximum(self.least - values, values - self.most)  # [H, d], above 0: far
        steps = beyond.argmax(axis=0)
        found = [(int(step), index) for index, step in enumerate(steps) if beyond[step, index] > 0]
        return tuple(self._outside(index, float(values[step, index]), step) for step, index in found)


def range_of(stats: FeatureStats | None) -> tuple[str, np.ndarray, np.ndarray]:
    """What a feature's training range is made of, and its two ends float64[d]; of no dimensions without statistics."""
    if stats is not None and stats.q01 is not None and stats.q99 is not None:
        return "q01 to q99", stats.q01, stats.q99
    if stats is not None and stats.min is not None and stats.max is not None:
        return "min to max", stats.min, stats.max
    if stats is not None and stats.mean is not None and stats.std is not None:
        half = DEVIATIONS * stats.std
        return f"mean ± {DEVIATIONS:g} std", stats.mean - half, stats.mean + half
    return "none", np.empty(0), np.empty(0)


def refusal(found: Sequence[Outside], state: Sequence[Outside]) -> str:
    """Why actions that are far outside are refused; `state`: its values that are outside, which may be the reason."""
    far = [one for one in state if one.far]
    reason = f"The state is far outside, too: {listed_values(far)}. " if far else ""
    return (
        f"actions that are far from the training data aren't given to the robot (out_of_range='refuse'): "
        f"{listed_values(found, 'reaches')}. More than {FAR:g} widths of that range beyond it is far. {reason}Look at "
        "the state, the cameras and the checkpoint's statistics (`turbopi inspect`)"
    )
