"""Batches of observations and noise to integrate, with their exact solutions: what solvers and grids are judged on."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from msgspec import Struct
from torch import Tensor

from turbopi.calibrate.observations import Batch
from turbopi.checkpoint import Checkpoint
from turbopi.config import Solver
from turbopi.models.observation import Observation
from turbopi.models.pi0.kv_cache import KVCache
from turbopi.models.pi0.reference import Pi0Model
from turbopi.models.pi0.solvers import GRIDS, intervals
from turbopi.policy import shipped
from turbopi.policy.policy import UnifiedPolicy
from turbopi.preprocess.pipeline import Pipeline
from turbopi.preprocess.tokenizer import TINY_TOKENIZER, load_tokenizer
from turbopi_lab.studies.solvers import Learned, Way, begins, grid_times, learn_times, solve, ways
from turbopi_lab.studies.study import Setup

EXACT = 100  # intervals of the midpoint method: the solution that errors are measured against
SMALL_EXACT = 10
NOISES = 2  # of each LIBERO image


class ErrorCell(Struct, frozen=True):
    """Relative rms error of the actions against the exact solution from the same noise."""

    weights: str
    solver: str
    grid: str
    evaluations: int
    relative: float
    times: list[float]


@dataclass(frozen=True)
class Problem:
    """A batch to integrate, and its exact solution, in the dimensions that move the robot."""

    model: Pi0Model
    cache: KVCache
    noise: Tensor
    dims: int
    exact: Tensor
    exact_intervals: int

    @classmethod
    def of(
        cls, model: Pi0Model, observation: Observation, noise: Tensor, dims: int, exact_intervals: int = EXACT
    ) -> "Problem":
        cache, count = model.prefix(observation), exact_intervals
        exact = solve(model, cache, noise, "midpoint", begins("uniform", count), 2 * count)
        return cls(model, cache, noise, dims, exact, count)

    @property
    def halved(self) -> float:
        """The error of half as many steps of the exact solution's solver."""
        count = self.exact_intervals // 2
        return self.error("midpoint", begins("uniform", count), 2 * count)

    def solve(self, solver: Solver, times: Sequence[float], evaluations: int) -> Tensor:
        return solve(self.model, self.cache, self.noise, solver, times, evaluations)

    def error(self, solver: Solver, times: Sequence[float], evaluations: int) -> float:
        exact, found = (x[..., : self.dims].double() for x in (self.exact, self.solve(solver, times, evaluations)))
        return float((found - exact).norm() / exact.norm())


def learned_grids(problem: Problem, small: bool) -> dict[tuple[str, int], list[float]]:
    """For each solver and number of evaluations the best grid found, from the best one of those that aren't learned."""
    grids: dict[tuple[str, int], list[float]] = {}
    for way in ways(small):
        if way.grid != "learned":
            continue

        def error(times: Sequence[float], way: Way = way) -> float:
            return problem.error(way.solver, times, way.evaluations)

        count = intervals(way.solver, way.evaluations)
        starts = [begins(name, count) for name in GRIDS]
        grids[way.solver, way.evaluations] = learn_times(error, min(starts, key=error), rounds=1 if small else 2)
    return grids


def errors(name: str, problem: Problem, learned: Learned, small: bool) -> list[ErrorCell]:
    cells = []
    for way in ways(small):
        if not way.warm:
            times = grid_times(way, learned)
            relative = problem.error(way.solver, times, way.evaluations)
            cells.append(ErrorCell(name, way.solver, way.grid, way.evaluations, relative, times))
    return cells


def libero_batches(
    checkpoint: Checkpoint, device: torch.device, small: bool, *, one_prompt: bool = False
) -> tuple[Pi0Model, Batch, Batch]:
    """The model in float32, and two batches on LIBERO images: to learn on, and others to judge on.

    `one_prompt`: all images with the first one's prompt and state, as calibration needs it of a batch.
    """
    config = checkpoint.config
    tokenizer = load_tokenizer(TINY_TOKENIZER, vocab_size=config.model.vocab_size)
    pipeline = Pipeline(config, checkpoint.norm_stats, tokenizer)
    frames = shipped.load_frames()
    model = Pi0Model.from_state(config.planned_model, checkpoint.load(device, "f32").state)
    shape = (config.model.action_horizon, config.model.action_dim)

    def batch(chosen: Sequence[shipped.Frame], seed: int) -> Batch:
        seen = [
            {
                "observation/image": frame.base,
                "observation/wrist_image": frame.wrist,
                "observation/state": (frames[0] if one_prompt else frame).state,
                "prompt": (frames[0] if one_prompt else frame).prompt,
            }
            for frame in chosen
            for _ in range(repeats)
        ]
        observation = Observation.stack([pipeline.before(one)[0] for one in seen]).to(device)
        noise = np.random.default_rng(seed).standard_normal((len(seen), *shape), dtype=np.float32)
        return observation, torch.from_numpy(noise).to(device)

    repeats = 1 if small else NOISES
    half = 1 if small else len(frames) // 2
    return model, batch(frames[:half], 0), batch(frames[half : 2 * half], 1)


def libero_problems(checkpoint: Checkpoint, device: torch.device, small: bool) -> tuple[Problem, Problem]:
    """The two batches of `libero_batches` as problems, in LIBERO's seven dimensions."""
    model, learning, judged = libero_batches(checkpoint, device, small)
    count = SMALL_EXACT if small else EXACT
    return Problem.of(model, *learning, 7, count), Problem.of(model, *judged, 7, count)


def one_problem(policy: UnifiedPolicy, setup: Setup) -> tuple[Observation, Tensor, str]:
    """The first of the observations as a batch of one, noise of the setup's seed, and where observations come from."""
    given, source = setup.observations(policy)
    one = Observation.stack([policy.prepare(given[0])]).to(policy.backend.device)
    shape = (1, policy.config.model.action_horizon, policy.config.model.action_dim)
    drawn = np.random.default_rng(setup.seed).standard_normal(shape, dtype=np.float32)
    return one, torch.from_numpy(drawn).to(policy.backend.device), source
