"""What a call of a policy is asked for, checked: noise and seeds, steps and solver, numbers of cameras and actions."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from turbopi.config import LIMITS, GridName, PolicyConfig, Solver, TimeGrid
from turbopi.engine.graph_cache import MOST_LOOPS, MOST_STEPS, fit
from turbopi.engine.loops import EulerLoop
from turbopi.models import family_of
from turbopi.models.pi0.conditioning import Conditioning, checked_scale
from turbopi.models.pi0.solvers import (
    Integration,
    checked_grid,
    checked_solver,
    evaluations_of,
    grid_times,
    intervals,
)
from turbopi.support.errors import ConfigError, ObservationError
from turbopi.support.reading import shown

MAX_STEPS = LIMITS["num_denoising_steps"]  # far beyond any use; a larger number is a mistake, not a wish
MAX_HORIZON = LIMITS["action_horizon"]
MAX_CAMERAS = 16
MAX_BATCH = 256

Error = type[ConfigError] | type[ObservationError]
Numbers = int | Sequence[int] | None  # None: as the policy is made


def checked_steps(num_steps: int, error: Error) -> int:
    return _checked("the number of denoising steps", num_steps, MAX_STEPS, error)


def checked_horizon(horizon: int, error: Error) -> int:
    return _checked("the action horizon", horizon, MAX_HORIZON, error)


def checked_cameras(cameras: int, error: Error) -> int:
    return _checked("the number of cameras", cameras, MAX_CAMERAS, error)


def checked_batch(size: int, error: Error) -> int:
    return _checked("the size of a batch", size, MAX_BATCH, error)


def checked_tokens(tokens: int, most: int) -> int:
    return _checked("max_tokens", tokens, most, ObservationError)


def _checked(what: str, number: int, most: int, error: Error) -> int:
    whole = isinstance(number, int | np.integer) and not isinstance(number, bool)
    if not whole or not 1 <= number <= most:
        raise error(f"{what} is {number!r}; it should be a whole number from 1 to {most}")
    return int(number)


@dataclass(frozen=True)
class Denoising:
    """How noise becomes actions: evaluations of the action expert, solver, time grid. A policy's own, or a call's.

    guidance  scale of guidance by the policy's tag (`PromptGuidance`); None: the policy has no tag
    one_step  weights are distilled for one evaluation, and take no other number
    refused   why a model has nothing of the kind: then `steps` are tokens of an answer at most
    """

    steps: int
    solver: Solver = "euler"
    time_grid: GridName | tuple[float, ...] = "uniform"
    guidance: float | None = None
    one_step: bool = False
    refused: str | None = None

    @classmethod
    def of(
        cls,
        config: PolicyConfig,
        steps: int | None,
        solver: Solver | None,
        time_grid: TimeGrid | None,
        guidance: float | None = None,
        tag: str | None = None,
    ) -> "Denoising":
        """A policy's: its config's, unless it says otherwise. Raises ConfigError.

        tag  behind the prompt, for guidance by it; with it the scale is 1 unless it is given
        """
        if tag is None and guidance is None:
            return cls._of(config, steps, solver, time_grid)
        if not (family := family_of(config.model)).planned:
            raise ConfigError(f"guidance by a prompt's tag is for Pi0.5 and Pi0, not for {family.label}: leave it out")
        if config.text is not None and config.text.subtasks is not None:
            raise ConfigError("guidance by a prompt's tag isn't for policies that act on subtasks: leave it out")
        if tag is None:
            raise ConfigError(
                f"guidance={shown(guidance)} was asked for, but nothing says what the policy was trained to follow: "
                "give guidance_tag=TEXT, too, what its training put behind the prompt"
            )
        if not tag.strip():
            raise ConfigError(f"guidance_tag is {shown(tag)}; it should be what training put behind the prompt")
        own = cls._of(config, steps, solver, time_grid)
        return replace(own, guidance=1.0).changed(None, None, None, ConfigError, 1.0 if guidance is None else guidance)

    @classmethod
    def _of(
        cls, config: PolicyConfig, steps: int | None, solver: Solver | None, time_grid: TimeGrid | None
    ) -> "Denoising":
        if (why := family_of(config.model).refuses_flow) is not None:
            model: Any = config.model
            return cls(model.max_decoding_steps, refused=why).changed(steps, solver, time_grid, ConfigError)
        number = checked_steps(config.num_denoising_steps, ConfigError)
        own = cls(number, one_step=config.one_step).changed(None, config.solver, config.solver_grid, ConfigError)
        if own.steps != number and intervals(own.solver, number) == intervals(own.solver, own.steps):
            own = replace(own, steps=number)  # fits the grid's times, too
        return own.changed(steps, solver, time_grid, ConfigError)

    def changed(
        self,
        steps: int | None,
        solver: Solver | None,
        time_grid: TimeGrid | None,
        error: Error,
        guidance: float | None = None,
    ) -> "Denoising":
        """The same but for what isn't None. Times bring their number of steps, unless it is given, too."""
        if guidance is not None:
            if self.guidance is None:
                raise error("guidance was given, but this policy has no tag: give guidance_tag=TEXT where it is made")
            try:
                scale = checked_scale(guidance)
            except ObservationError as wrong:
                raise error(str(wrong)) from None
            return replace(self, guidance=scale).changed(steps, solver, time_grid, error)
        if steps is None and solver is None and time_grid is None:
            return self
        if self.refused is not None:
            if solver is None and time_grid is None and steps == self.steps:  # as the policy itself calls
                return self
            raise error(self.refused)
        try:
            chosen = self.solver if solver is None else checked_solver(solver)
            grid = self.time_grid if time_grid is None else checked_grid(time_grid)
        except ObservationError as wrong:
            raise error(str(wrong)) from None
        count = self.steps if steps is None else checked_steps(steps, error)
        if isinstance(grid, tuple):
            if steps is None:
                count = evaluations_of(chosen, len(grid) - 1)
            if intervals(chosen, count) != len(grid) - 1:
                fits = evaluations_of(chosen, len(grid) - 1)
                raise error(
                    f"{count} steps of solver {chosen!r} are {intervals(chosen, count)} intervals, but the time grid "
                    f"has {len(grid) - 1}: give {fits} steps, leave them out, or take time grid 'uniform'"
                )
        if self.one_step and count != 1:
            raise error(f"{count} denoising steps were asked for, but these weights were distilled for one alone")
        return replace(self, steps=count, solver=chosen, time_grid=grid)

    def of_call(
        self,
        steps: int | None,
        solver: Solver | None = None,
        time_grid: TimeGrid | None = None,
        conditioning: Conditioning | None = None,
        guidance: float | None = None,
    ) -> "Denoising":
        """A call's. A conditioning with times or a solver of its own brings its steps. Raises ObservationError."""
        if steps is None and conditioning is not None:
            if conditioning.integration is not None:
                steps = conditioning.integration.evaluations
            elif conditioning.tokens is not None:
                steps = len(conditioning.tokens.times)
        return self.changed(steps, solver, time_grid, ObservationError, guidance)

    @property
    def two_prompts(self) -> bool:
        """Whether both the prompt and the one with the tag are computed: at 0 and 1 one of them counts for nothing."""
        return self.guidance not in (None, 0, 1)

    @property
    def runs_together(self) -> bool:
        """Whether backends that run batches run observations of such calls together."""
        return not self.two_prompts and (self.integration is None or self.integration.is_euler)

    @cached_property
    def integration(self) -> Integration | None:
        """What backends are asked for. None: openpi's loop, as one evaluation with every solver and named grid is."""
        if isinstance(self.time_grid, tuple):
            return Integration(self.solver, self.time_grid, self.steps)
        if self.steps == 1 or (self.solver, self.time_grid) == ("euler", "uniform"):
            return None
        times = grid_times(self.time_grid, intervals(self.solver, self.steps))
        integration = Integration(self.solver, times, self.steps)
        return None if self.time_grid == "uniform" and integration.is_euler else integration

    @property
    def metadata(self) -> dict[str, Any]:
        """Plain values."""
        if self.refused is not None:
            return {"num_denoising_steps": 0, "max_decoding_steps": self.steps}
        grid = self.time_grid if isinstance(self.time_grid, str) else list(self.time_grid)
        guided = {} if self.guidance is None else {"guidance": self.guidance}
        return {"num_denoising_steps": self.steps, "solver": self.solver, "time_grid": grid, **guided}


def several(what: str, given: Numbers, default: Sequence[int], check: Callable[[int, Error], int]) -> list[int]:
    """One number or several, checked, as a list without repetitions; `default` for None. Raises ConfigError."""
    if given is None:
        given = default
    one_by_one = given if isinstance(given, Sequence) and not isinstance(given, str) else [given]
    numbers = list(dict.fromkeys(check(number, ConfigError) for number in one_by_one))
    if not numbers:
        raise ConfigError(f"{what} is an empty list; give one number or several, or leave it out")
    return numbers


def warm_loops(steps: Sequence[int], horizons: Sequence[int]) -> list[tuple[int, int]]:
    """All pairs of steps and horizon, for a warm-up. Raises ConfigError if there are more than are kept."""
    loops = [(n, horizon) for n in steps for horizon in horizons]
    if not fit(EulerLoop(*loop) for loop in loops):
        raise ConfigError(
            f"warm-up was given {len(loops)} pairs of steps and horizon, {sum(n for n, _ in loops)} steps together; "
            f"backends keep graphs of {MOST_LOOPS} pairs and {MOST_STEPS} steps, so leave some out"
        )
    return loops


def checked_noise(noise: Sequence[np.ndarray] | np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Noise as float32[B, H, action_dim], which is `shape`. Raises ObservationError."""
    try:
        array = np.asarray(noise)
    except (TypeError, ValueError, RuntimeError) as error:  # RuntimeError: a torch tensor that wants gradients
        raise ObservationError(f"noise isn't an array of numbers: {error}") from None
    if array.dtype.kind not in "fiu":
        raise ObservationError(f"noise isn't an array of numbers: its dtype is {array.dtype}")
    if array.ndim == 4 and array.shape[:2] == (1, 1):  # one row that brought its batch axis
        array = array[0]
    with np.errstate(over="ignore"):  # refused below
        array = array.astype(np.float32, copy=False)
    if array.shape != shape:
        given, expected = (array.shape[1:], shape[1:]) if array.shape[:1] == shape[:1] else (array.shape, shape)
        raise ObservationError(f"noise has shape {list(given)}, but this policy needs {list(expected)}")
    if not np.isfinite(array).all():
        raise ObservationError("noise has values that aren't finite")
    return np.ascontiguousarray(array)


def noise_for(
    shape: tuple[int, int, int],
    noise: Sequence[np.ndarray] | np.ndarray | None,
    seed: int | Sequence[int] | None,
    generator: np.random.Generator,
) -> np.ndarray:
    """float32[B, H, action_dim], given, or drawn from a seed for each row or from `generator`; or ObservationError."""
    batch = shape[0]
    if noise is not None:
        if seed is not None:
            raise ObservationError("noise and seed were both given; give one of them")
        return checked_noise(noise, shape)
    if seed is None:
        return generator.standard_normal(shape, dtype=np.float32)
    seeds = [seed + row for row in range(batch)] if isinstance(seed, int | np.integer) else seed
    whole = isinstance(seeds, Sequence) and all(isinstance(one, int | np.integer) and one >= 0 for one in seeds)
    if not whole or len(seeds) != batch:
        several = f", or {batch} of them, one for each row" if batch > 1 else ""
        raise ObservationError(f"seed {seed!r} should be a whole number from 0{several}")
    return np.stack([np.random.default_rng(one).standard_normal(shape[1:], dtype=np.float32) for one in seeds])
