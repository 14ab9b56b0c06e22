"""Ways to integrate the flow from noise to actions: solvers and time grids, for few evaluations of the action expert.

The flow is dx/dt = v(x, t) from t = 1 (noise) to t = 0 (actions), x_t = t ε + (1 − t) a. A grid is the times at which
an interval begins, from the first down to 0, which is left out. Solvers:

    euler        x + (s − t) v(x, t). One evaluation an interval; openpi's
    midpoint     the velocity half way, found by an Euler step there. Two evaluations
    heun         the mean of the velocities at both ends, the second found by an Euler step. Two evaluations; in the
                 last interval one, as in EDM (Karras et al. 2022): training sees no t = 0, and a policy that was
                 trained with simulated delays is told by t = 0 that an action is held
    ab2          Adams and Bashforth's second order, for unequal intervals: this velocity and the one before. One
    exponential  of the same kind for the noise-free actions D = x − t v: the flow is dx/dt = (x − D) / t, whose linear
                 part is integrated exactly with D linear in t, through this D and the one before. One evaluation. The
                 idea is DPM-Solver++'s (2M, Lu et al. 2022), which takes D as linear in log((1 − t) / t); that is
                 infinite at both ends, t isn't

Where evaluations don't suffice for two in each interval, the last intervals have one: an Euler step.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from turbopi.model.denoise import suffix_mask, suffix_rope, time_embedding
from turbopi.model.exact import exact_float32
from turbopi.model.kv_cache import KVCache
from turbopi.model.reference import Pi0Model

Velocity = Callable[[Tensor, float], Tensor]  # x [B, H, A], t -> v of the same shape
Times = Sequence[float]  # falling; where intervals begin
SOLVERS = ("euler", "midpoint", "heun", "ab2", "exponential")
TWICE = ("midpoint", "heun")  # evaluate twice an interval
SHIFTS = {"shifted to noise": 3.0, "shifted to actions": 1 / 3}
GRIDS = ("uniform", *SHIFTS, "learned")
EVALUATIONS = (1, 2, 3, 5, 10)
Learned = Mapping[tuple[str, int], Sequence[float]]  # by solver and number of evaluations


def intervals(solver: str, evaluations: int) -> int:
    """How many intervals a grid for so many evaluations has."""
    if solver == "heun":
        return evaluations // 2 + 1
    return (evaluations + 1) // 2 if solver == "midpoint" else evaluations


def uniform(count: int) -> list[float]:
    return [1 - i / count for i in range(count)]


def shifted(count: int, shift: float) -> list[float]:
    """More intervals near noise for a shift above 1, near the actions for one below: s t / (1 − t + s t)."""
    return [shift * t / (1 - t + shift * t) for t in uniform(count)]


def velocity_of(model: Pi0Model, cache: KVCache) -> Velocity:
    """The action expert's velocity for the observations of a cache, as `Pi0Model.denoise` evaluates it."""
    config = model.config
    adaptive = config.kind == "pi05"

    @torch.no_grad()
    @exact_float32()
    def velocity(x: Tensor, t: float) -> Tensor:
        embedded = time_embedding(np.array([t], np.float32), config.expert.width).to(x.device)
        time = model.time_condition(embedded) if adaptive else embedded
        length = x.shape[1] + (not adaptive)
        rope = suffix_rope(cache, length, config.expert.head_dim, config.rope_base)
        mask = suffix_mask(cache, length, not adaptive)
        return model.velocity(x, cache.state, time, cache.k, cache.v, rope, mask)[1]

    return velocity


def integrate(velocity: Velocity, x: Tensor, solver: str, times: Times, evaluations: int) -> Tensor:
    """x at t = 0 from x at times[0], in exactly so many evaluations of `velocity`."""
    assert len(times) == intervals(solver, evaluations), (solver, times, evaluations)
    ends = [*times[1:], 0.0]
    if solver in TWICE:
        return _twice(velocity, x, solver, list(zip(times, ends, strict=True)), evaluations)
    before: tuple[Tensor, float] | None = None  # what is extrapolated, at the interval before, and its time
    for t, s in zip(times, ends, strict=True):
        v = velocity(x, t)
        if solver == "exponential":
            data = x - t * v
            slope = torch.zeros_like(v) if before is None else (data - before[0]) / (t - before[1])
            x = s / t * x + (1 - s / t) * (data - t * slope) + _log_term(s, t) * slope
            before = data, t
        else:
            if solver == "ab2" and before is not None:
                following = v + (s - t) / 2 * (v - before[0]) / (t - before[1])
            else:
                following = v
            x = x + (s - t) * following
            before = v, t
    return x


def _log_term(s: float, t: float) -> float:
    return s * math.log(t / s) if s > 0 else 0.0


def _twice(
    velocity: Velocity, x: Tensor, solver: str, spans: Sequence[tuple[float, float]], evaluations: int
) -> Tensor:
    for number, (t, s) in enumerate(spans):
        v = velocity(x, t)
        if number < evaluations - len(spans):
            if solver == "midpoint":
                v = velocity(x + (s - t) / 2 * v, (t + s) / 2)
            else:
                v = (v + velocity(x + (s - t) * v, s)) / 2
        x = x + (s - t) * v
    return x


def learn_times(error: Callable[[Times], float], start: Times, *, rounds: int = 2, factor: float = 0.5) -> list[float]:
    """A grid with a smaller `error` than `start`'s, found by moving one inner time after the other.

    Each is tried between its neighbours; `factor` of the way to either at first, half of that in every round.
    """
    times, best = list(start), error(start)
    for number in range(rounds):
        reach = factor / 2**number
        for i in range(1, len(times)):
            above, below = times[i - 1], times[i + 1] if i + 1 < len(times) else 0.0
            for towards in (above, below):
                tried = [*times[:i], times[i] + reach * (towards - times[i]), *times[i + 1 :]]
                found = error(tried)
                if found < best:
                    times, best = tried, found
    return times


# --- the cells of a study --------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Way:
    """A way to integrate."""

    solver: str
    grid: str
    evaluations: int
    warm: bool = False

    def __str__(self) -> str:
        return f"{self.solver}, {self.grid}{', warm' if self.warm else ''}, {self.evaluations}"


BASELINE = Way("euler", "uniform", 10)


def ways(small: bool) -> Iterator[Way]:
    """All cells, each once: with one evaluation all solvers and grids are the same, and with two Heun's method is
    Euler's. Warm starts are on uniform grids.
    """
    for evaluations in (1, 2) if small else EVALUATIONS:
        for solver in ("euler", "exponential") if small else SOLVERS:
            if (solver, evaluations) == ("heun", 2):
                continue
            for grid in ("uniform", "learned") if small else GRIDS:
                if evaluations > 1 or (solver, grid) == ("euler", "uniform"):
                    yield Way(solver, grid, evaluations)
            if evaluations > 1 or solver == "euler":
                yield Way(solver, "uniform", evaluations, warm=True)


def grid_times(way: Way, learned: Learned) -> list[float]:
    count = intervals(way.solver, way.evaluations)
    if way.grid == "learned":
        return list(learned[way.solver, way.evaluations])
    if way.grid in SHIFTS:
        return shifted(count, SHIFTS[way.grid])
    return uniform(count)
