"""The inputs of a conditioned denoising loop besides noise: buffers that a captured graph reads, written for each call.

Which times may occur is fixed when the loop is captured (`ConditionedLoop.times`): the modulation table has a row for
each. Which action has which of them in which step, which actions are held and what pulls differ from call to call.
"""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from turbopi.config import ModelConfig
from turbopi.engine.flat import allocate
from turbopi.engine.loops import ConditionedLoop, Loop, own_tokens
from turbopi.kernels.interface import TokenInputs
from turbopi.models.pi0.conditioning import Conditioning
from turbopi.models.pi0.denoise import time_embedding

BY_ACTION = ("target", "weights")  # have no axis of steps


@dataclass(frozen=True)
class Conditioned:
    """A conditioned loop's inputs, on the host and on the device. N steps, H actions, A action_dim.

    Of a batch every array has the axis of its observations before that of the actions: [N, B, H], [B, H, A].
    """

    config: ModelConfig
    loop: ConditionedLoop
    table: np.ndarray  # float32[U]: the loop's times
    host: Tensor  # uint8: all of them, pinned
    device: Tensor
    arrays: dict[str, np.ndarray]  # views into `host`
    tokens: TokenInputs  # views into `device`; gain is the strength alone where the Jacobian is true
    weights: Tensor  # float32[H, 1], of guidance

    @classmethod
    def allocate(
        cls, config: ModelConfig, loop: ConditionedLoop, device: torch.device, batch: int | None = None
    ) -> "Conditioned":
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
        table = loop.table_times(config.time_grid)
        return cls(config, loop, table, host, flat, arrays, TokenInputs(**on_device), weights)

    def write(self, conditioning: Conditioning, row: int | None = None) -> None:
        """Into the host's buffer; of a batch into a row of it."""
        arrays, loop, table = self.arrays, self.loop, self.table
        if row is not None:
            arrays = {name: array[row] if name in BY_ACTION else array[:, row] for name, array in arrays.items()}
        given = conditioning.own_tokens(loop.horizon)
        tokens = given or own_tokens(loop.steps, self.config.time_grid)
        arrays["steps"][:], arrays["times"][:] = tokens.steps, tokens.times
        if given is None:
            arrays["rows"][:] = np.searchsorted(-table, -tokens.times[:, :1])  # all actions have a step's time
        else:
            arrays["rows"][:] = tokens.rows(table)
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
    """What the expert takes of a step's time: a row for each of the R rows of the loop's table.

    table        Pi0.5's modulation, float32[R, 2 * layers + 1, 3, D]; None: Pi0's norms have none
    embeddings   Pi0's, float32[R, D]
    conditioned  which action has which row in a step; None: step i has row i
    """

    table: Tensor | None
    embeddings: Tensor
    conditioned: Conditioned | None

    @classmethod
    def of(
        cls,
        config: ModelConfig,
        loop: Loop,
        table: Tensor | None,
        conditioned: Conditioned | None,
        device: torch.device,
    ) -> "StepTimes":
        embeddings = time_embedding(loop.table_times(config.time_grid), config.expert.width)
        return cls(table, embeddings.to(device), conditioned)

    def embedding(self, step: int) -> Tensor:
        """float32[D], or by token [H, D], of a batch [B, H, D]."""
        return self.embeddings[step if self.conditioned is None else self.conditioned.tokens.rows[step]]

    def modulation(self, step: int) -> Tensor | None:
        """float32[2 * layers + 1, 3, D], or by token [2 * layers + 1, 3, H, D]; of a batch B * H in the place of H."""
        if self.table is None:
            return None
        if self.conditioned is None:
            return self.table[step]
        return self.table.permute(1, 2, 0, 3).index_select(2, self.conditioned.tokens.rows[step].flatten())
