"""A solver's denoising loop by the kernels that do a whole Euler loop: one launch for each evaluation.

A launch of one step begins at x_k, and what counts of it is the velocity that it leaves; `Integration.next_x`, a few
small operations between the launches, makes x_{k+1} of these. All of it is captured in one graph. Where a kernel takes
times by token, one kernel does all evaluations, and each takes its row of the table; else each time has a kernel of its
own, which shares the matrices with the others.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from turbopi.config import ModelConfig
from turbopi.engine.call import CallShape
from turbopi.engine.loops import SolverLoop
from turbopi.kernels.interface import Denoiser, TokenInputs
from turbopi.models.pi0.solvers import Integration

MakeDenoiser = Callable[[CallShape, Tensor | None], Denoiser | None]


@dataclass(frozen=True)
class Solving:
    """A `Denoiser` of a solver's loop; `launches` has one-step kernels, and their inputs by token."""

    integration: Integration
    launches: Sequence[tuple[Denoiser, tuple[TokenInputs, ...]]]
    unused: Tensor  # float32[2, H, A]: a launch's own x

    def launch(
        self,
        noise: Tensor,
        cache_k: Tensor,
        cache_v: Tensor,
        length: Tensor,
        x_t: Tensor,
        v_t: Tensor,
        tokens: TokenInputs | None = None,
    ) -> None:
        assert tokens is None, "a solver's loop has one time for all actions"
        x_t[0] = noise
        for k, (kernel, by_token) in enumerate(self.launches):
            kernel.launch(x_t[k], cache_k, cache_v, length, self.unused, v_t[k : k + 1], *by_token)
            x_t[k + 1] = self.integration.next_x(k, x_t, v_t)


def solving(
    make: MakeDenoiser,
    shape: CallShape,
    table: Tensor | None,
    config: ModelConfig,
    device: torch.device,
    *,
    by_token: bool,
) -> Denoiser | None:
    """The denoiser of a solver's loop; None where `make` makes none: then operations do it.

    table  float32[N, …]: the modulation at each evaluation's time; None: there is none
    """
    loop = shape.loop
    launches: list[tuple[Denoiser, tuple[TokenInputs, ...]]] = []
    assert isinstance(loop, SolverLoop), loop
    at_any_time, *one_by_one = loop.evaluations
    if by_token:
        kernel = make(replace(shape, loop=at_any_time), table)
        if kernel is None:
            return None
        launches = [(kernel, (_token_inputs(loop, k, config, device),)) for k in range(loop.steps)]
    else:
        for k, one in enumerate(one_by_one):
            kernel = make(replace(shape, loop=one), None if table is None else table[k : k + 1])
            if kernel is None:
                return None
            launches.append((kernel, ()))
    return Solving(loop.integration, launches, torch.empty(2, loop.horizon, config.action_dim, device=device))


def _token_inputs(loop: SolverLoop, k: int, config: ModelConfig, device: torch.device) -> TokenInputs:
    """All actions at the time of evaluation k, which is row k of the table; nothing is moved, held or pulled."""
    grid = (1, loop.horizon)
    nothing = torch.zeros(grid, device=device)
    return TokenInputs(
        rows=torch.full(grid, k, dtype=torch.int32, device=device),
        steps=nothing,
        times=torch.full(grid, loop.integration.evaluated[k], device=device),
        target=torch.zeros(loop.horizon, config.action_dim, device=device),
        gain=nothing,
    )
