"""Solvers of the flow from noise to actions: at which times the action expert is evaluated, and what x becomes.

The flow is dx/dt = v(x, t) from t = 1 (noise) to t = 0 (actions), x_t = t ε + (1 − t) a. A grid is the times at which
intervals begin, falling, and 0. In an interval from t to s:

    euler        x + (s − t) v(x, t). One evaluation; openpi's
    midpoint     the velocity half way, found by an Euler step there. Two evaluations
    heun         the mean of the velocities at both ends, the second found by an Euler step. Two evaluations; in the
                 last interval one, as in EDM (Karras et al. 2022): training sees no t = 0, and a policy that was
                 trained with simulated delays is told by t = 0 that an action is held
    ab2          Adams and Bashforth's second order, for unequal intervals: this velocity and the one before. One
    exponential  of the same kind for the noise-free actions D = x − t v: the flow is dx/dt = (x − D) / t, whose linear
                 part is integrated exactly with D linear in t, through this D and the one before. One evaluation. The
                 idea is DPM-Solver++'s (2M, Lu et al. 2022), which takes D as linear in log((1 − t) / t); that is
                 infinite at both ends, t isn't

Where evaluations don't suffice for two in each interval, the last intervals have one: an Euler step. The first interval
of ab2 and exponential is an Euler step, too. So one evaluation is one Euler step, whatever the solver.

All of them are linear. Evaluation k gives v_k = v(x_k, t_k), and four numbers, a `Row`, say what comes next:

    x_{k+1} = row.x · x_k + row.x_before · x_{k−1} + row.v · v_k + row.v_before · v_{k−1}

so a backend needs evaluations at given times and such sums, and knows no solver by name.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from typing import NamedTuple, get_args

import numpy as np
from torch import Tensor

from turbopi.config import LIMITS, GridName, Solver, TimeGrid
from turbopi.support.errors import ObservationError
from turbopi.support.reading import is_finite, shown

SOLVERS: tuple[Solver, ...] = get_args(Solver)
GRIDS: tuple[GridName, ...] = get_args(GridName)
SHIFTS: dict[GridName, float] = {"uniform": 1, "shifted_to_noise": 3, "shifted_to_actions": 1 / 3}
_TWICE = ("midpoint", "heun")  # evaluate twice an interval


def intervals(solver: Solver, evaluations: int) -> int:
    """How many intervals a grid for so many evaluations has."""
    if solver == "heun":
        return evaluations // 2 + 1
    return (evaluations + 1) // 2 if solver == "midpoint" else evaluations


def evaluations_of(solver: Solver, count: int) -> int:
    """How many evaluations a solver takes for a grid of so many intervals, with two in each where it has two."""
    return {"midpoint": 2 * count, "heun": 2 * count - 1}.get(solver, count)


def grid_times(name: GridName, count: int) -> tuple[float, ...]:
    """A named grid of so many intervals: count + 1 times from 1 to 0.

    More intervals near noise for a shift above 1, near the actions for one below: s t / (1 − t + s t).
    """
    shift = SHIFTS[name]
    uniform = [1 - i / count for i in range(count)]
    return (*(shift * t / (1 - t + shift * t) for t in uniform), 0.0)


class Row(NamedTuple):
    """What follows an evaluation, see above."""

    x: float
    x_before: float
    v: float
    v_before: float = 0.0


@dataclass(frozen=True)
class Integration:
    """A solver on a grid, as a denoising loop carries it out. Raises ObservationError for what can't be.

    times        where intervals begin, and 0: strictly falling. From 1, or for a warm start from a lower time: then the
                 loop's `noise` is x at that time. Rounded to float32, as the model is told of time
    evaluations  of the action expert; None: as many as `evaluations_of` says
    """

    solver: Solver
    times: tuple[float, ...]
    evaluations: int = 0

    def __post_init__(self) -> None:
        checked_solver(self.solver)
        times, count = checked_times(self.times), len(self.times) - 1
        object.__setattr__(self, "times", times)
        if not self.evaluations:
            object.__setattr__(self, "evaluations", evaluations_of(self.solver, count))
        if intervals(self.solver, self.evaluations) != count:
            raise ObservationError(
                f"{self.evaluations} evaluations of solver {self.solver!r} need a time grid of "
                f"{intervals(self.solver, self.evaluations)} intervals; this one has {count}"
            )

    @property
    def by_evaluation(self) -> tuple[tuple[float, Row], ...]:
        """t and row of each evaluation: float32 numbers."""
        return _evaluations(self)

    @property
    def evaluated(self) -> tuple[float, ...]:
        """t of each evaluation."""
        return tuple(t for t, _ in _evaluations(self))

    @property
    def is_euler(self) -> bool:
        """Whether all of it is Euler steps: each x is the one before and a multiple of one velocity."""
        return all((row.x, row.x_before, row.v_before) == (1, 0, 0) for _, row in _evaluations(self))

    def next_x(self, k: int, x_t: Sequence[Tensor] | Tensor, v_t: Sequence[Tensor] | Tensor) -> Tensor:
        """x_{k+1}, in float32, of what there is up to x_k and v_k."""
        _, row = _evaluations(self)[k]
        parts = [
            tensors[at] if factor == 1 else factor * tensors[at]
            for factor, tensors, at in ((row.x, x_t, k), (row.x_before, x_t, k - 1), (row.v, v_t, k))
            if factor
        ]
        if row.v_before:
            parts.append(row.v_before * v_t[k - 1])
        total = parts[0]
        for part in parts[1:]:
            total = total + part
        return total

    def __str__(self) -> str:
        return f"{self.solver}, t = {', '.join(f'{t:.3g}' for t in self.times)}"


def checked_solver(solver: Solver) -> Solver:
    """A solver's name. Raises ObservationError."""
    if solver not in SOLVERS:
        raise ObservationError(f"the solver is {shown(solver)}; it should be one of {', '.join(SOLVERS)}")
    return solver


def checked_times(times: Sequence[float]) -> tuple[float, ...]:
    """Times of a grid as float32 numbers. Raises ObservationError, see `Integration`."""
    most = LIMITS["num_denoising_steps"]
    if isinstance(times, str) or not isinstance(times, Sequence | np.ndarray) or not 2 <= len(times) <= most + 1:
        raise ObservationError(f"the time grid is {shown(times)}; it should be 2 to {most + 1} times that fall to 0")
    if not all(is_finite(t) or isinstance(t, np.floating | np.integer) for t in times):
        raise ObservationError(f"the time grid is {shown(list(times))}; it should be numbers")
    rounded = tuple(float(np.float32(t)) for t in times)
    if not 0 < rounded[0] <= 1 or rounded[-1] != 0 or not all(t > s for t, s in pairwise(rounded)):
        reported = f"[{', '.join(f'{t:g}' for t in rounded)}]"
        raise ObservationError(
            f"the time grid is {shown(reported)}; its times should fall strictly, from 1 (noise) to 0 (actions)"
        )
    return rounded


def checked_grid(grid: TimeGrid) -> GridName | tuple[float, ...]:
    """A grid as a policy takes it: a name, or times from 1 to 0. Raises ObservationError."""
    if isinstance(grid, str):
        if grid not in GRIDS:
            raise ObservationError(
                f"the time grid is {shown(grid)}; it should be one of {', '.join(GRIDS)}, or times from 1 to 0"
            )
        return grid
    times = checked_times(grid)
    if times[0] != 1:
        raise ObservationError(f"the time grid begins at {times[0]:g}; it should begin at 1, which is noise")
    return times


@lru_cache
def _evaluations(requested: Integration) -> tuple[tuple[float, Row], ...]:
    """Time and row of each evaluation, both of float32 numbers."""

    def rounded(x: float) -> float:
        return float(np.float32(x))

    return tuple((rounded(t), Row(*map(rounded, row))) for t, row in _in_float64(requested))


def _in_float64(requested: Integration) -> Iterator[tuple[float, Row]]:
    solver, spans = requested.solver, list(pairwise(requested.times))
    twice = requested.evaluations - len(spans) if solver in _TWICE else 0
    before: float | None = None
    for number, (t, s) in enumerate(spans):
        step = s - t
        if number < twice and solver == "midpoint":
            yield t, Row(1, 0, step / 2)
            yield t + step / 2, Row(0, 1, step)
        elif number < twice:
            yield t, Row(1, 0, step)
            yield s, Row(0, 1, step / 2, step / 2)
        elif before is None or solver not in ("ab2", "exponential"):
            yield t, Row(1, 0, step)
        elif solver == "ab2":
            more = step / 2 / (t - before)  # of the difference between the two velocities
            yield t, Row(1, 0, step * (1 + more), -step * more)
        else:
            slope = (_log_term(s, t) + step) / (t - before)  # what D's slope adds, for each unit of D's difference
            yield t, Row(1 + slope, -slope, step - t * slope, before * slope)
        before = t


def _log_term(s: float, t: float) -> float:
    return s * math.log(t / s) if s > 0 else 0.0
