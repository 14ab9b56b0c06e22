"""What a denoising loop may be asked for beyond "noise to actions": times by token, a solver, held actions, guidance.

Real-time execution needs nothing else of the model (docs/real_time.md), and classifier-free guidance a second prompt:
then v below is a mixture of two velocities, see `PromptGuidance`. N steps, H actions, A action_dim; t = 1 is noise and
t = 0 the action. One call of the loop, for every action i and step s:

    x̂ = x − t[s, i] · v                                       the chunk that v points to
    v ← v − strength[s, i] · (Jᵀ[(target − x̂) ⊙ weights])[i]  with guidance: J = ∂x̂/∂x, or the identity in its place
    x ← x + steps[s, i] · v

A held action has its given value in x from the start, time 0 and a step of 0: so it stays, and the others attend to it.
With a solver other than Euler's the last line is another one, and the same for all actions: models/pi0/solvers.py.
With a noise to choose the loop runs three times: models/pi0/noise_choice.py.
"""

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np
from torch import Tensor

from turbopi.config import MOST_GUIDANCE
from turbopi.config import Schedule as Schedule
from turbopi.models.pi0.denoise import time_grid
from turbopi.models.pi0.noise_choice import NoiseChoice
from turbopi.models.pi0.solvers import Integration
from turbopi.support.errors import ObservationError
from turbopi.support.reading import is_finite, shown

GuidanceMode = Literal["jacobian", "identity"]
# What a backend must be able to do: a solver or a time grid of its own; times, steps and values by token, identity
# guidance among them; the true Jacobian; a chosen noise; a second prompt, with "tokens", and with "jacobian".
Form = Literal["plain", "solver", "tokens", "jacobian", "noise", "two_prompts", "two_prompts_jacobian"]


@dataclass(frozen=True)
class TokenTimes:
    """Where each action is in time at each step, and how far the step takes it."""

    times: np.ndarray  # float32[N, H]  t at the start of a step
    steps: np.ndarray  # float32[N, H]  added to t in that step: below 0, but in `reversed`; 0: the action stays

    @classmethod
    def plain(cls, num_steps: int, horizon: int, kind: str = "accumulated") -> "TokenTimes":
        """openpi's: one time for all actions. `kind` as in `time_grid`."""
        times = np.repeat(time_grid(num_steps, kind)[:, None], horizon, axis=1)
        return cls(times, np.full(times.shape, np.float32(-1.0 / num_steps)))

    @classmethod
    def integrated(cls, integration: Integration, horizon: int) -> "TokenTimes":
        """A solver's times, the same ones for all actions; the steps are right for Euler's alone."""
        times, steps = np.array([[t, row.v] for t, row in integration.by_evaluation], np.float32).T
        return cls(*(np.repeat(column[:, None], horizon, axis=1) for column in (times, steps)))

    @classmethod
    def of(cls, t: np.ndarray) -> "TokenTimes":
        """From t[N + 1, H]: the times at which steps begin, and the one at which the last ends.

        Raises ObservationError for another shape, times outside [0, 1] and times that grow.
        """
        t = np.asarray(t)
        if t.ndim != 2 or t.shape[0] < 2 or t.shape[1] < 1 or t.dtype.kind not in "fiu":
            raise ObservationError(
                f"token times have shape {list(t.shape)} and dtype {t.dtype}; they should be numbers [steps + 1, H]"
            )
        t = t.astype(np.float32)
        if not ((t >= 0) & (t <= 1)).all():  # NaN, too
            raise ObservationError("token times should lie between 0 (action) and 1 (noise), in every step")
        if (np.diff(t, axis=0) > 0).any():
            raise ObservationError("token times should never grow from step to step: 1 is noise, 0 the action")
        return cls(t[:-1], np.diff(t, axis=0))

    def holding(self, held: np.ndarray) -> "TokenTimes":
        """The same with the actions of `held` bool[H] at time 0 in every step."""
        return TokenTimes(np.where(held, np.float32(0), self.times), np.where(held, np.float32(0), self.steps))

    def reversed(self) -> "TokenTimes":
        """From actions, at t = 0, back to the first time, by the same steps: each from the point at which it ended."""
        ends = np.concatenate((self.times[1:], np.zeros_like(self.times[:1])))
        return TokenTimes(ends[::-1].copy(), -self.steps[::-1].copy())

    def distinct(self) -> np.ndarray:
        """float32[U]: the times that occur, each once, in the order in which they first do."""
        times, first = np.unique(self.times, return_index=True)
        return times[np.argsort(first)]

    def rows(self, table: np.ndarray) -> np.ndarray:
        """int32[N, H]: where each time is in `table` float32[U], which has them all."""
        order = np.argsort(table, kind="stable")
        places = np.minimum(np.searchsorted(table[order], self.times), len(table) - 1)
        rows = order[places].astype(np.int32)
        assert (table[rows] == self.times).all(), "a time isn't in the table"
        return rows


@dataclass(frozen=True)
class Guidance:
    """A pull of the predicted chunk x̂ towards a target, in every step.

    mode "jacobian" is the published one (arXiv 2506.07339): the error goes back through the action expert. "identity"
    leaves that out, which is what LeRobot 0.6's code computes. They differ; neither stands in for the other.
    """

    target: np.ndarray  # float32[H, A], in the model's normalised space
    weights: np.ndarray  # float32[H]
    strength: np.ndarray  # float32[N, H]
    mode: GuidanceMode = "jacobian"


@dataclass(frozen=True)
class PromptGuidance:
    """Classifier-free guidance (Ho and Salimans 2022) by a prompt with a tag, as RECAP's policies are trained for.

    Each v is (1 − scale) v_u + scale v_c: of the observation's own prompt, and of this one, both at the same x and t.

    tokens  int64[P]  the valid ids of the prompt with its tag
    scale   0: the observation's prompt alone; 1: this one alone; above 1: away from the first
    """

    tokens: np.ndarray
    scale: float

    @property
    def factors(self) -> tuple[float, float]:
        """Of v_u and of v_c: float32 numbers."""
        return float(np.float32(1 - self.scale)), float(np.float32(self.scale))

    def mixed(self, v_u: Tensor, v_c: Tensor) -> Tensor:
        """v, in float32."""
        of_u, of_c = self.factors
        return of_u * v_u + of_c * v_c

    def check(self) -> None:
        """Raises ObservationError for what can't be."""
        ids = self.tokens
        if not isinstance(ids, np.ndarray) or ids.dtype != np.int64 or ids.ndim != 1 or not len(ids):
            raise ObservationError(f"the second prompt is {_described(ids)}; it should be int64 ids of shape [P]")
        checked_scale(self.scale)


def checked_scale(scale: float) -> float:
    """A `PromptGuidance`'s. Raises ObservationError."""
    if not is_finite(scale) or not 0 <= scale <= MOST_GUIDANCE:
        raise ObservationError(f"the guidance is {shown(scale)}; it should be a number from 0 to {MOST_GUIDANCE:g}")
    return float(scale)


@dataclass(frozen=True)
class Conditioning:
    """All of it, for one observation. What is None is as openpi has it, to the last bit.

    The `noise` that comes with it is x at `tokens.times[0]`, noise or not: a warm start passes the chunk it starts
    from, mixed with noise. Held actions' values replace its rows. With an `integration` it is x at its first time.

    Held actions and guidance go with Euler's steps, on any grid. Other solvers take neither: what they go on with is
    made of several velocities, and an action that is held or pulled has none of them. A `noise` goes with Euler's steps
    on any grid, and with nothing else.
    """

    tokens: TokenTimes | None = None
    held: np.ndarray | None = None  # bool[H]; needs values
    values: np.ndarray | None = None  # float32[H, A]; rows that aren't held are ignored
    guidance: Guidance | None = None
    integration: Integration | None = None  # in place of `tokens`: a solver, and one grid of times for all actions
    prompt: PromptGuidance | None = None
    noise: NoiseChoice | None = None

    @property
    def one_prompt(self) -> "Conditioning":
        """All of it but the second prompt."""
        return self if self.prompt is None else replace(self, prompt=None)

    @property
    def form(self) -> Form:
        """What a backend must be able to do. "plain": nothing beside openpi's loop."""
        if self.prompt is not None:
            return "two_prompts_jacobian" if self.one_prompt.form == "jacobian" else "two_prompts"
        if self.noise is not None:
            return "noise"
        if self.guidance is not None and self.guidance.mode == "jacobian":
            return "jacobian"
        holds = self.held is not None and bool(np.any(self.held))
        if holds or self.tokens is not None or self.guidance is not None:
            return "tokens"
        return "plain" if self.integration is None else "solver"

    @property
    def brings_steps(self) -> bool:
        """Whether it says itself how many steps its loop has."""
        return self.tokens is not None or self.integration is not None

    def size(self, num_steps: int, horizon: int) -> tuple[int, int]:
        """Steps and actions of the loop that it is for; what it doesn't fix is as given."""
        grid = None if self.guidance is None else self.guidance.strength
        grid = grid if self.tokens is None else self.tokens.times
        if grid is not None:
            return int(grid.shape[0]), int(grid.shape[1])
        steps = num_steps if self.integration is None else self.integration.evaluations
        rows = self.held if self.noise is None else self.noise.rows
        return steps, horizon if rows is None else len(rows)

    def passes(self, num_steps: int, horizon: int, kind: str) -> "tuple[Conditioning, Conditioning]":
        """The loops of a `noise`: to actions, and back. `kind` as in `time_grid`."""
        there = replace(self, noise=None)
        return there, Conditioning(tokens=there.token_times(num_steps, horizon, kind).reversed())

    def own_tokens(self, horizon: int) -> TokenTimes | None:
        """Times and steps that it brings; None: openpi's."""
        return self.tokens if self.integration is None else TokenTimes.integrated(self.integration, horizon)

    def token_times(self, num_steps: int, horizon: int, kind: str = "accumulated") -> TokenTimes:
        """The loop's times and steps, held actions among them. `kind` as in `time_grid`, if it has none of its own."""
        tokens = self.own_tokens(horizon) or TokenTimes.plain(num_steps, horizon, kind)
        return tokens if self.held is None else tokens.holding(self.held)

    def started(self, noise: np.ndarray) -> np.ndarray:
        """x float32[H, A] before the first step: the noise, with the held actions' values in its place."""
        if self.held is None or self.values is None:
            return noise
        return np.where(self.held[:, None], self.values, noise).astype(np.float32)

    def check(self, num_steps: int, horizon: int, action_dim: int) -> None:
        """Raises ObservationError if any of it doesn't fit a loop of so many steps and actions."""
        grid, chunk = (num_steps, horizon), (horizon, action_dim)
        if self.prompt is not None:
            self.prompt.check()
        if self.noise is not None:
            self._check_noise(self.noise, horizon, chunk)
        if self.integration is not None:
            self._check_integration(self.integration, num_steps)
        if self.tokens is not None:
            _check("token times", self.tokens.times, grid)
            _check("token steps", self.tokens.steps, grid)
            if not ((self.tokens.times >= 0) & (self.tokens.times <= 1)).all():
                raise ObservationError("token times should lie between 0 (action) and 1 (noise), in every step")
        if self.held is not None:
            held = self.held
            _check_mask("held", held, horizon)
            if held.any() and self.values is None:
                raise ObservationError("held actions need values: float32[H, action_dim], read where held is true")
            if self.values is not None:
                _check("held actions' values", self.values, chunk, held)
        if self.guidance is not None:
            if self.guidance.mode not in get_args(GuidanceMode):
                raise ObservationError(f"guidance mode is {self.guidance.mode!r}; it should be jacobian or identity")
            _check("the guidance's target", self.guidance.target, chunk)
            _check("the guidance's weights", self.guidance.weights, (horizon,))
            _check("the guidance's strength", self.guidance.strength, grid)

    def _check_noise(self, noise: NoiseChoice, horizon: int, chunk: tuple[int, int]) -> None:
        if replace(self, noise=None).form not in ("plain", "solver"):
            raise ObservationError(
                "a chosen noise was given beside held actions, guidance or token times: give one of them"
            )
        if self.integration is not None and not self.integration.is_euler:
            raise ObservationError(
                f"a chosen noise and solver {self.integration.solver!r} were both given: noise is found by Euler's "
                "steps, so take solver 'euler'"
            )
        _check_mask("a chosen noise's rows", noise.rows, horizon)
        _check("a chosen noise's values", noise.values, chunk, noise.rows)

    def _check_integration(self, integration: Integration, num_steps: int) -> None:
        if self.tokens is not None:
            raise ObservationError(
                f"token times and a time grid ({integration}) were both given: both say when actions are where; leave "
                "out one of them"
            )
        if integration.evaluations != num_steps:
            raise ObservationError(
                f"a loop of {num_steps} steps was asked for, but {integration} takes {integration.evaluations} "
                "evaluations: say so, or take another time grid"
            )
        what = "guidance" if self.guidance is not None else "held actions" if self.one_prompt.form == "tokens" else None
        if what is not None and not integration.is_euler:
            raise ObservationError(
                f"{what} and solver {integration.solver!r} were both asked for: {what} take Euler's steps, so take "
                f"solver 'euler', whose time grid may be any, or leave out {what}"
            )


Conditionings = Conditioning | Sequence[Conditioning | None] | None  # for all rows of a batch, or one each


def has_two_prompts(conditionings: Conditionings) -> bool:
    """Whether guidance by a second prompt is among them."""
    each = conditionings if isinstance(conditionings, Sequence) else [conditionings]
    return any(one is not None and one.prompt is not None for one in each)


def of_rows(conditionings: Conditionings, rows: int) -> Sequence[Conditioning | None]:
    """One, or None, for each row of a batch. Raises ObservationError for another number of them."""
    if not isinstance(conditionings, Sequence):
        return [conditionings] * rows
    if len(conditionings) != rows:
        raise ObservationError(f"{len(conditionings)} conditionings were given for {rows} observations")
    return conditionings


def check_rows(conditionings: Sequence[Conditioning | None], num_steps: int, horizon: int, action_dim: int) -> None:
    """`Conditioning.check` of each row of a batch; what is wrong is said with its number."""
    for row, one in enumerate(conditionings):
        if one is not None:
            with row_named(row, len(conditionings)):
                one.check(num_steps, horizon, action_dim)


@contextmanager
def row_named(row: int, rows: int) -> Iterator[None]:
    """Around what looks at one observation: its number of several goes before what is wrong with it."""
    try:
        yield
    except ObservationError as error:
        if rows == 1:
            raise
        raise ObservationError(f"observation {row} of {rows} (from 0): {error}") from None


def _check_mask(what: str, mask: np.ndarray, horizon: int) -> None:
    if not isinstance(mask, np.ndarray) or mask.dtype != np.bool_ or mask.shape != (horizon,):
        raise ObservationError(f"{what} is {_described(mask)}; it should be bool of shape {[horizon]}")


def _check(what: str, array: np.ndarray, shape: tuple[int, ...], rows: np.ndarray | None = None) -> None:
    """float32 of a shape, finite, in `rows` if they are given."""
    if not isinstance(array, np.ndarray) or array.dtype != np.float32 or array.shape != shape:
        raise ObservationError(f"{what} are {_described(array)}; they should be float32 of shape {list(shape)}")
    if not np.isfinite(array if rows is None else array[rows]).all():
        raise ObservationError(f"{what} have values that aren't finite")


def _described(array: object) -> str:
    if not isinstance(array, np.ndarray):
        return f"of type {type(array).__name__}"
    return f"{array.dtype} of shape {list(array.shape)}"


def guidance_strength(times: np.ndarray, most: float) -> np.ndarray:
    """float32 of the shape of `times`: min(most, (t / τ) · (t² + τ²) / t²), τ = 1 − t; `most` at τ = 0 and at t = 0.

    Source: RTC (arXiv 2506.07339, equation 2 and its β), with openpi's t. LeRobot computes the same.
    """
    t = times.astype(np.float64)
    tau = 1 - t
    with np.errstate(divide="ignore", invalid="ignore"):
        strength = (t * t + tau * tau) / (tau * t)
    return np.where((tau <= 0) | (t <= 0), most, np.minimum(strength, most)).astype(np.float32)


def guidance_weights(
    horizon: int, delay: int, execution_horizon: int, schedule: Schedule = "exponential"
) -> np.ndarray:
    """float32[H], as published (arXiv 2506.07339, equation 5): d delay, s execution horizon, e = H − s.

    1 before d, 0 from e on, and between them, with c = (e − i) / (e − d + 1): "exponential" c (exp(c) − 1) /
    (exp(1) − 1), "linear" c, "ones" 1, "zeros" 0. Raises ObservationError unless 0 ≤ d ≤ H − s.
    """
    end = horizon - execution_horizon
    if not 0 <= delay <= end:
        raise ObservationError(
            f"a delay of {delay} and an execution horizon of {execution_horizon} don't fit a chunk of {horizon} "
            f"actions: delay + execution horizon should be at most {horizon}"
        )
    return _weights(horizon, delay, end, schedule)


def lerobot_guidance_weights(
    horizon: int, delay: int, execution_horizon: int, left_over: int, schedule: Schedule = "linear"
) -> np.ndarray:
    """float32[H], as LeRobot 0.6's `get_prefix_weights`: its execution horizon is the end of the mask, not H − s.

    left_over  rows of the previous chunk's left-over; the mask ends there at the latest
    """
    end = min(execution_horizon, left_over)
    return _weights(horizon, min(delay, end), end, schedule)


def _weights(horizon: int, start: int, end: int, schedule: Schedule) -> np.ndarray:
    position = np.arange(horizon)
    c = (end - position) / (end - start + 1)
    between = {
        "exponential": c * np.expm1(c) / math.expm1(1),
        "linear": c,
        "ones": np.ones(horizon),
        "zeros": np.zeros(horizon),
    }
    if schedule not in between:
        raise ObservationError(f"the schedule is {schedule!r}; it should be one of {', '.join(between)}")
    return np.where(position < start, 1.0, np.where(position < end, between[schedule], 0.0)).astype(np.float32)
