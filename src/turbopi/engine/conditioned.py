"""What a conditioned denoising loop is told besides noise: buffers that a captured graph reads, written for each call.

Which times may occur is fixed when the loop is captured (`Loop.times`): the modulation table has a row for each. Which
action has which of them in which step, what is held and what pulls differ from call to call.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from turbopi.config import ModelConfig
from turbopi.engine.flat import allocate
from turbopi.engine.graph_cache import Loop
from turbopi.kernels.interface import TokenInputs
from turbopi.models.pi0.conditioning import Conditioning, Form, TokenTimes
from turbopi.models.pi0.denoise import time_embedding, time_grid
from turbopi.support.errors import ObservationError

MOST_TIMES = 1024  # of a loop: 2.9 MB each, on the device
BY_ACTION = ("target", "weights")  # have no axis of steps


def conditioned_loop(
    conditioning: Conditioning | None,
    num_steps: int,
    horizon: int,
    config: ModelConfig,
    *,
    times_by_token: bool = False,
) -> Loop:
    """The loop that a call needs. Raises ObservationError for a conditioning that doesn't fit it.

    One with the config's own grid of times serves all calls that have no others, and 0, whatever they hold.

    times_by_token  whether one launch of the denoiser takes times by token: then Euler's steps on any grid are one, too
    """
    if conditioning is None:
        return Loop(num_steps, horizon)
    conditioning.check(num_steps, horizon, config.action_dim)
    form = conditioning.form
    if form == "plain":
        return Loop(num_steps, horizon)
    integration = conditioning.integration
    if form == "solver" and integration is not None:
        if not (integration.is_euler and times_by_token):
            return Loop(num_steps, horizon, form, integration.evaluated, integration)
        form = "tokens"
    own, tokens = _own_times(num_steps, config.time_grid), conditioning.own_tokens(horizon)
    if tokens is None:
        return Loop(num_steps, horizon, form, own)
    wanted = {*tokens.distinct().tolist(), 0.0}
    return Loop(num_steps, horizon, form, own if wanted <= {*own} else _checked_times(wanted))


def batch_form(conditioning: Conditioning | None) -> Form:
    """What an observation with this conditioning needs of a batched loop. "solver": it runs alone."""
    if conditioning is None:
        return "plain"
    form, integration = conditioning.form, conditioning.integration
    return "tokens" if form == "solver" and integration is not None and integration.is_euler else form


def batch_loop(conditionings: Sequence[Conditioning | None], num_steps: int, horizon: int, config: ModelConfig) -> Loop:
    """The loop of observations that run together, none of the form "solver", all checked.

    Its times are all that any of them has, and openpi's, so that plain observations are always among those it is for.
    """
    forms = {batch_form(one) for one in conditionings}
    assert "solver" not in forms, "a solver's loop has other sums"
    if forms == {"plain"}:
        return Loop(num_steps, horizon)
    own = _own_times(num_steps, config.time_grid)
    tokens = [None if one is None else one.own_tokens(horizon) for one in conditionings]
    wanted = {*own}.union(*(one.distinct().tolist() for one in tokens if one is not None))
    form: Form = "jacobian" if "jacobian" in forms else "tokens"
    times = own if len(wanted) == len(own) else _checked_times(wanted, len(conditionings))
    return Loop(num_steps, horizon, form, times)


def _checked_times(wanted: set[float], rows: int = 1) -> tuple[float, ...]:
    if len(wanted) > MOST_TIMES:
        what, besides = "", ""
        if rows > 1:
            what, besides = f"of {rows} observations together ", ", or ask for fewer observations at once"
        raise ObservationError(
            f"the token times {what}have {len(wanted)} different values; at most {MOST_TIMES} fit: let actions share "
            f"times{besides}"
        )
    return tuple(sorted(wanted, reverse=True))


@lru_cache
def _own_times(num_steps: int, time_grid: str) -> tuple[float, ...]:
    """Of openpi's loop, and 0."""
    return tuple(sorted({*_own_tokens(num_steps, time_grid).distinct().tolist(), 0.0}, reverse=True))


@lru_cache
def _own_tokens(num_steps: int, time_grid: str) -> TokenTimes:
    """Of openpi's loop, for one action: all have the same."""
    return TokenTimes.plain(num_steps, 1, time_grid)


@dataclass(frozen=True)
class Conditioned:
    """A conditioned loop's inputs, on the host and on the device. N steps, H actions, A action_dim.

    Of a batch every array has the axis of its observations before that of the actions: [N, B, H], [B, H, A].
    """

    loop: Loop
    config: ModelConfig
    host: Tensor  # uint8: all of them, pinned
    device: Tensor
    arrays: dict[str, np.ndarray]  # views into `host`
    tokens: TokenInputs  # views into `device`; gain is the strength alone where the Jacobian is true
    weights: Tensor  # float32[H, 1], of guidance

    @classmethod
    def allocate(cls, config: ModelConfig, loop: Loop, device: torch.device, batch: int | None = None) -> "Conditioned":
        """`batch`: of so many observations; None: of one, without their axis."""
        actions = (loop.horizon,) if batch is None else (batch, loop.horizon)
        grid, chunk = (loop.steps, *actions), (*actions, config.action_dim)
        fields = {
            "rows": (grid, torch.int32),
            "steps": (grid, torch.float32),
            "times": (grid, torch.float32),
            "target": (chunk, torch.float32),
            "gain": (grid, torch.float32),
            "weights": ((*actions, 1), torch.float32),
        }
        host, views = allocate(fields, torch.device("cpu"), pinned=device.type == "cuda")
        flat, on_device = allocate(fields, device, pinned=False)
        weights = on_device.pop("weights")
        arrays = {name: view.numpy() for name, view in views.items()}
        return cls(loop, config, host, flat, arrays, TokenInputs(**on_device), weights)

    def write(self, conditioning: Conditioning, row: int | None = None) -> None:
        """Into the host's buffer; of a batch into a row of it."""
        arrays, loop, table = self.arrays, self.loop, np.array(self.loop.times, np.float32)
        if row is not None:
            arrays = {name: array[row] if name in BY_ACTION else array[:, row] for name, array in arrays.items()}
        own = conditioning.own_tokens(loop.horizon)
        asked = own or _own_tokens(loop.steps, self.config.time_grid)
        arrays["steps"][:], arrays["times"][:] = asked.steps, asked.times
        if own is None:
            arrays["rows"][:] = np.searchsorted(-table, -asked.times[:, :1])  # all actions have a step's time
        else:
            arrays["rows"][:] = asked.rows(table)
        if conditioning.held is not None:
            arrays["steps"][:, conditioning.held] = arrays["times"][:, conditioning.held] = 0
            arrays["rows"][:, conditioning.held] = len(table) - 1  # time 0
        guidance = conditioning.guidance
        if guidance is None:
            for name in ("target", "gain", "weights"):
                arrays[name][:] = 0
            return
        arrays["target"][:] = guidance.target
        arrays["weights"][:, 0] = guidance.weights
        through = guidance.mode == "jacobian"
        arrays["gain"][:] = guidance.strength if through else guidance.strength * guidance.weights

    def upload(self) -> None:
        self.device.copy_(self.host, non_blocking=True)

    def error(self, step: int, x_t: Tensor, v_t: Tensor) -> Tensor:
        """target − x̂, x̂ = x − t v: float32[H, A]."""
        return self.tokens.target - (x_t - self.tokens.times[step, ..., None] * v_t)

    def pulled(self, step: int, x_t: Tensor, v_t: Tensor) -> Tensor:
        """v_t with identity guidance; without guidance as it is."""
        return v_t - self.tokens.gain[step, ..., None] * self.error(step, x_t, v_t)

    def next_x(self, step: int, x_t: Tensor, v_t: Tensor) -> Tensor:
        return x_t + self.tokens.steps[step, ..., None] * v_t


@dataclass(frozen=True)
class StepTimes:
    """What the expert takes of a step's time, for all N steps of a loop; of a conditioned one for its U distinct times.

    table       Pi0.5's modulation, float32[N or U, 2 * layers + 1, 3, D]; None: Pi0's norms have none
    embeddings  Pi0's, float32[N or U, D]
    asked       which action has which of the U times in a step; None: step i has row i
    """

    table: Tensor | None
    embeddings: Tensor
    asked: Conditioned | None

    @classmethod
    def of(
        cls, config: ModelConfig, loop: Loop, table: Tensor | None, asked: Conditioned | None, device: torch.device
    ) -> "StepTimes":
        plain = loop.form == "plain"
        times = time_grid(loop.steps, config.time_grid) if plain else np.array(loop.times, np.float32)
        return cls(table, time_embedding(times, config.expert.width).to(device), asked)

    def embedding(self, step: int) -> Tensor:
        """float32[D], or by token [H, D], of a batch [B, H, D]."""
        return self.embeddings[step if self.asked is None else self.asked.tokens.rows[step]]

    def modulation(self, step: int) -> Tensor | None:
        """float32[2 * layers + 1, 3, D], or by token [2 * layers + 1, 3, H, D]; of a batch B * H in the place of H."""
        if self.table is None:
            return None
        if self.asked is None:
            return self.table[step]
        return self.table.permute(1, 2, 0, 3).index_select(2, self.asked.tokens.rows[step].flatten())
