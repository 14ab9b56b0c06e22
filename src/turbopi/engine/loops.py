"""Denoising loops: at which times the action expert is evaluated, and which rows the modulation table has.

    EulerLoop        openpi's: equal Euler steps. Row i of the table is for step i
    SolverLoop       another solver or time grid, the same for all actions. Row k is for evaluation k
    ConditionedLoop  Euler steps with a time, a step and a pull of each action's own. The rows are all times that an
                     action may have; which one it has in a step is an input of the call, see conditioned.py

Graphs, tables and kernels are made for a loop. Loops of a call and of a batch are made of their conditionings here.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import ClassVar

import numpy as np

from turbopi.config import ModelConfig
from turbopi.models.pi0.conditioning import Conditioning, Form, TokenTimes
from turbopi.models.pi0.denoise import time_grid
from turbopi.models.pi0.solvers import Integration
from turbopi.support.errors import ObservationError

ALONE: tuple[Form, ...] = ("solver", "noise", "two_prompts")  # an observation with such a loop shares no call
MOST_TIMES = 1024  # of a loop: 2.9 MB each, on the device
Table = int | tuple[float, ...]  # rows for so many of openpi's steps, or for these times


@dataclass(frozen=True)
class Loop(ABC):
    """What every loop has; the kinds are the classes below."""

    steps: int  # evaluations of the expert
    horizon: int

    @property
    @abstractmethod
    def form(self) -> Form:
        """What it needs of a backend."""

    @property
    @abstractmethod
    def table(self) -> Table:
        """The rows of its modulation table. Loops with the same ones share it."""

    @property
    def evaluations(self) -> "tuple[Loop, ...]":
        """The loops of one step for which a backend may make kernels in place of this one's."""
        return ()

    @property
    def rows(self) -> int:
        return self.table if isinstance(self.table, int) else len(self.table)

    def table_times(self, grid: str) -> np.ndarray:
        """float32[rows]: the time of each row of the table. `grid` as in `time_grid`."""
        return time_grid(self.table, grid) if isinstance(self.table, int) else np.array(self.table, np.float32)

    def __str__(self) -> str:
        return f"H={self.horizon}, {self.steps} steps"


@dataclass(frozen=True)
class EulerLoop(Loop):
    form: ClassVar[Form] = "plain"
    time: float | None = None  # where the one step of a solver's evaluation begins; None: the steps are openpi's

    @property
    def table(self) -> Table:
        return self.steps if self.time is None else (self.time,)

    def __str__(self) -> str:
        return super().__str__() if self.time is None else f"{super().__str__()}, t = {self.time:.3g}"


@dataclass(frozen=True)
class ConditionedLoop(Loop):
    times: tuple[float, ...]  # falling
    jacobian: bool = False  # guided by the true Jacobian

    @property
    def form(self) -> Form:
        return "jacobian" if self.jacobian else "tokens"

    @property
    def table(self) -> Table:
        return self.times

    def __str__(self) -> str:
        what = "guided by the Jacobian" if self.jacobian else "by token"
        return f"{super().__str__()}, {what}, {len(self.times)} times"


@dataclass(frozen=True)
class SolverLoop(Loop):
    form: ClassVar[Form] = "solver"
    integration: Integration

    @property
    def table(self) -> Table:
        return self.integration.evaluated

    @property
    def evaluations(self) -> tuple[Loop, ...]:
        """One for any of the times, where a launch takes times by token; then one for each evaluation."""
        times = self.integration.evaluated
        return ConditionedLoop(1, self.horizon, times), *(EulerLoop(1, self.horizon, t) for t in times)

    def __str__(self) -> str:
        return f"{super().__str__()}, {self.integration}"


def loop_of_call(
    conditioning: Conditioning | None,
    num_steps: int,
    horizon: int,
    config: ModelConfig,
    *,
    times_by_token: bool = False,
) -> Loop:
    """The loop of one observation's call, by one prompt or two. Raises ObservationError for one that doesn't fit.

    A call whose noise is chosen has several: those of its `passes`.

    A conditioned loop with the config's own grid of times, and 0, serves all calls that have no others, whichever
    actions are held.

    times_by_token  whether one launch of the denoiser takes times by token: then Euler's steps on any grid are one, too
    """
    if conditioning is None:
        return EulerLoop(num_steps, horizon)
    conditioning.check(num_steps, horizon, config.action_dim)
    form, integration = conditioning.one_prompt.form, conditioning.integration
    if form == "plain":
        return EulerLoop(num_steps, horizon)
    if form == "solver" and integration is not None and not (integration.is_euler and times_by_token):
        return SolverLoop(num_steps, horizon, integration)
    times, tokens = _own_times(num_steps, config.time_grid), conditioning.own_tokens(horizon)
    if tokens is not None and not (wanted := {*tokens.distinct().tolist(), 0.0}) <= {*times}:
        times = _checked_times(wanted)
    return ConditionedLoop(num_steps, horizon, times, form == "jacobian")


def batch_form(conditioning: Conditioning | None) -> Form:
    """What an observation with this conditioning needs of a batched loop; see ALONE."""
    if conditioning is None:
        return "plain"
    form, integration = conditioning.form, conditioning.integration
    return "tokens" if form == "solver" and integration is not None and integration.is_euler else form


def loop_of_batch(
    conditionings: Sequence[Conditioning | None], num_steps: int, horizon: int, config: ModelConfig
) -> EulerLoop | ConditionedLoop:
    """The loop of observations that run together, all checked.

    Its times are those of all observations, and openpi's, so that plain observations fit it.
    """
    forms = {batch_form(one) for one in conditionings}
    assert forms.isdisjoint(ALONE), "they run alone"
    if forms == {"plain"}:
        return EulerLoop(num_steps, horizon)
    own = _own_times(num_steps, config.time_grid)
    tokens = [None if one is None else one.own_tokens(horizon) for one in conditionings]
    wanted = {*own}.union(*(one.distinct().tolist() for one in tokens if one is not None))
    times = own if len(wanted) == len(own) else _checked_times(wanted, len(conditionings))
    return ConditionedLoop(num_steps, horizon, times, "jacobian" in forms)


def _checked_times(wanted: set[float], rows: int = 1) -> tuple[float, ...]:
    if len(wanted) > MOST_TIMES:
        what, besides = "", ""
        if rows > 1:
            what, besides = f"of {rows} observations together ", ", or send fewer observations at once"
        raise ObservationError(
            f"the token times {what}have {len(wanted)} different values; at most {MOST_TIMES} fit: let actions share "
            f"times{besides}"
        )
    return tuple(sorted(wanted, reverse=True))


@lru_cache
def _own_times(num_steps: int, grid: str) -> tuple[float, ...]:
    """Of openpi's loop, and 0."""
    return tuple(sorted({*own_tokens(num_steps, grid).distinct().tolist(), 0.0}, reverse=True))


@lru_cache
def own_tokens(num_steps: int, grid: str) -> TokenTimes:
    """Of openpi's loop, for one action: all have the same."""
    return TokenTimes.plain(num_steps, 1, grid)
