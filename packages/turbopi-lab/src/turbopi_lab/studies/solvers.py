"""The cells of studies of few evaluations: solvers (models/pi0/solvers.py), time grids, grids learned for a policy."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

from torch import Tensor

from turbopi.config import GridName, Solver
from turbopi.models.pi0.conditioning import Conditioning
from turbopi.models.pi0.kv_cache import KVCache
from turbopi.models.pi0.reference import Pi0Model
from turbopi.models.pi0.solvers import GRIDS as NAMED
from turbopi.models.pi0.solvers import SOLVERS, Integration, intervals
from turbopi.models.pi0.solvers import grid_times as named_times

Times = Sequence[float]  # falling; where intervals begin
GRIDS: dict[str, GridName | None] = {name.replace("_", " "): name for name in NAMED} | {"learned": None}
EVALUATIONS = (1, 2, 3, 5, 10)
Learned = Mapping[tuple[str, int], Sequence[float]]  # by solver and number of evaluations


def integration(solver: Solver, times: Times, evaluations: int) -> Integration:
    return Integration(solver, (*times, 0.0), evaluations)


def solve(model: Pi0Model, cache: KVCache, noise: Tensor, solver: Solver, times: Times, evaluations: int) -> Tensor:
    """Actions float32[B, H, action_dim] from noise, which is x at times[0]."""
    requested = Conditioning(integration=integration(solver, times, evaluations))
    return model.denoise(cache, noise, evaluations, conditioning=requested)


def begins(grid: GridName, count: int) -> list[float]:
    """Where the intervals of a named grid begin."""
    return list(named_times(grid, count)[:-1])


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


@dataclass(frozen=True)
class Way:
    """A way to integrate."""

    solver: Solver
    grid: str  # of GRIDS
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
        few: tuple[Solver, ...] = ("euler", "exponential")
        for solver in few if small else SOLVERS:
            if (solver, evaluations) == ("heun", 2):
                continue
            for grid in ("uniform", "learned") if small else GRIDS:
                if evaluations > 1 or (solver, grid) == ("euler", "uniform"):
                    yield Way(solver, grid, evaluations)
            if evaluations > 1 or solver == "euler":
                yield Way(solver, "uniform", evaluations, warm=True)


def grid_times(way: Way, learned: Learned) -> list[float]:
    name = GRIDS[way.grid]
    if name is None:
        return list(learned[way.solver, way.evaluations])
    return begins(name, intervals(way.solver, way.evaluations))
