"""The loop from noise to actions, of every family: times, held actions, guidance, solvers, chosen noise."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from turbopi.config import TimeRounding
from turbopi.models.pi0.conditioning import Conditioning, PromptGuidance, of_rows
from turbopi.support.errors import ObservationError

Velocity = Callable[[Tensor, Tensor, bool], tuple[Tensor, Tensor]]  # see `integrate`


@dataclass(frozen=True)
class Pull:
    """Guidance of one denoising step (`conditioning.Guidance`), as tensors that broadcast to x_t [B, H, A]."""

    target: Tensor  # float32[H, A]
    weights: Tensor  # float32[H, 1]
    strength: Tensor  # float32[H, 1]
    times: Tensor  # float32[H, 1]
    through_expert: bool  # the true Jacobian; False: the identity in its place

    def error(self, x_t: Tensor, v_t: Tensor) -> Tensor:
        """(target − x̂) ⊙ weights, x̂ = x − t v."""
        return (self.target - (x_t - self.times * v_t)) * self.weights


def guided_velocity(
    velocity: Callable[[Tensor], tuple[Tensor, Tensor]], x_t: Tensor, pull: Pull
) -> tuple[Tensor, Tensor]:
    """`velocity`(x_t), which is (the expert's output, v_t), with v_t pulled: v − strength ⊙ Jᵀ error.

    J = ∂x̂/∂x = 1 − t ∂v/∂x, so Jᵀ error = error − (∂v/∂x)ᵀ (t error): one backward pass through `velocity`.
    """
    if not pull.through_expert:
        out, v_t = velocity(x_t)
        return out, v_t - pull.strength * pull.error(x_t, v_t)
    # in this thread: PyTorch's own for backward passes has no CUDA context at first, and warns of it
    with torch.enable_grad(), torch.autograd.set_multithreading_enabled(False):
        x = x_t.detach().requires_grad_()
        out, v = velocity(x)
        v_t = v.detach()
        error = pull.error(x_t, v_t)
        (through,) = torch.autograd.grad(v, x, pull.times * error)
    return out.detach(), v_t - pull.strength * (error - through)


def mixed_velocity(velocity: Velocity, second: Velocity, guidance: PromptGuidance) -> Velocity:
    """Of two prompts, mixed as `PromptGuidance` says."""

    def mixed(x: Tensor, time: Tensor, first: bool) -> tuple[Tensor, Tensor]:
        out, v_u = velocity(x, time, first)
        return out, guidance.mixed(v_u, second(x, time, False)[1])

    return mixed


@dataclass(frozen=True)
class Integrated:
    """Actions float32[B, H, A], and how they came about.

    evaluations  of the expert: x_t, its output, v_t as it was integrated; empty unless somebody needs them
    times        float32[N, H, 1]
    conds        [U, D] of the distinct times, `rows` int[N, H] says which is whose
    """

    actions: Tensor
    evaluations: list[tuple[Tensor, Tensor, Tensor]]
    times: Tensor
    conds: Tensor
    rows: Tensor


def integrate(
    velocity: Velocity,
    embed_times: Callable[[np.ndarray], Tensor],
    noise: Tensor,
    num_steps: int,
    requested: Conditioning | None,
    *,
    grid: TimeRounding,
    keep: bool = False,
    second: Velocity | None = None,
) -> Integrated:
    """The loop from noise float32[B, H, A] to actions: steps, times, held actions, guidance and solvers.

    velocity     (x_t, time embedding [1, D] or [1, H, D], whether it is the first step) -> (the expert's output, v_t)
    embed_times  float32[U] -> [U, D]
    grid         how uniform times are rounded, see `time_grid`
    keep         all evaluations, for a trace
    second       as `velocity`, of the prompt with a tag, for guidance by it; the expert's output is the first prompt's

    Raises ObservationError for a conditioning that doesn't fit.
    """
    horizon, wanted = noise.shape[1], requested or Conditioning()
    wanted.check(num_steps, horizon, noise.shape[2])
    if wanted.prompt is not None:
        if second is None:
            raise ObservationError("guidance by a second prompt was asked for, but nothing was computed of that prompt")
        velocity = mixed_velocity(velocity, second, wanted.prompt)
    if wanted.noise is not None:
        ahead, back = wanted.passes(num_steps, horizon, grid)

        def unnoted(x: Tensor, time: Tensor, first: bool) -> tuple[Tensor, Tensor]:
            return velocity(x, time, False)  # a trace is of the last loop

        def loop(x: Tensor, backwards: bool) -> Tensor:
            return integrate(unnoted, embed_times, x, num_steps, back if backwards else ahead, grid=grid).actions

        noise = wanted.noise.chosen(noise, loop)
    tokens, guidance = wanted.token_times(num_steps, horizon, grid), wanted.guidance
    distinct = tokens.distinct()
    rows = tokens.rows(distinct)
    conds = embed_times(distinct)

    def on_device(array: np.ndarray) -> Tensor:
        host = torch.from_numpy(array)
        if noise.is_cuda:  # the host needn't wait for the device: PyTorch uses pinned memory again when it was read
            host = host.contiguous().pin_memory()
        return host.to(noise.device, non_blocking=True)

    solver = None if wanted.integration is None or wanted.integration.is_euler else wanted.integration
    x_t, evaluations = noise, []
    if wanted.held is not None and wanted.values is not None:
        x_t = torch.where(on_device(wanted.held)[:, None], on_device(wanted.values), noise)
    by_row = on_device(rows)
    times, dt = on_device(tokens.times)[..., None], on_device(tokens.steps)[..., None]  # [N, H, 1]
    for i in range(num_steps):
        one_time = bool((rows[i] == rows[i, 0]).all())
        time = conds[rows[i, 0]][None] if one_time else conds[by_row[i]][None]  # [1, D] or [1, H, D]

        def at_this_time(x: Tensor, time: Tensor = time, first: bool = i == 0) -> tuple[Tensor, Tensor]:
            return velocity(x, time, first)

        if guidance is None:
            out, v_t = at_this_time(x_t)
        else:
            pull = Pull(
                on_device(guidance.target),
                on_device(guidance.weights)[:, None],
                on_device(guidance.strength[i])[:, None],
                times[i],
                guidance.mode == "jacobian",
            )
            out, v_t = guided_velocity(at_this_time, x_t, pull)
        if keep or solver is not None:
            evaluations.append((x_t, out, v_t))
        if solver is None:
            x_t = x_t + dt[i] * v_t
        else:
            x_t = solver.next_x(i, [x for x, _, _ in evaluations], [v for _, _, v in evaluations])
    return Integrated(x_t, evaluations, times, conds, by_row)


def integrate_rows(
    one: Callable[[int, Conditioning, dict[str, Tensor]], Tensor],
    conditionings: Sequence[Conditioning | None],
    rows: int,
    trace: dict[str, Tensor] | None,
) -> Tensor:
    """Each row of a batch with a conditioning of its own: `one`(row, conditioning, its trace) computes one."""
    traces: list[dict[str, Tensor]] = []
    for row, requested in enumerate(of_rows(conditionings, rows)):
        traces.append({})
        # never None, so that all rows' traces have the same shapes
        traces[-1]["actions"] = one(row, Conditioning() if requested is None else requested, traces[-1])
    joined = {
        name: torch.cat([each[name] for each in traces], dim=int(name != "actions"))
        for name in (traces[0] if trace is not None else ["actions"])
    }
    if trace is not None:
        trace.update(joined)
    return joined["actions"]
