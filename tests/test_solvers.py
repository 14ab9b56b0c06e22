"""Solvers of the flow and their time grids: what they are, in the reference, the engine and the policy."""

import math
from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import torch
from conftest import golden_cases, golden_model
from test_begin import OnCpu, on_cpu
from test_engine import made_up
from test_fused_choice import ReferenceKernel, fused, kernels
from torch import Tensor

from turbopi.config import Kind, Solver
from turbopi.engine.loops import EulerLoop, loop_of_call
from turbopi.models.pi0.conditioning import Conditioning, Guidance, TokenTimes
from turbopi.models.pi0.denoise import time_grid
from turbopi.models.pi0.reference import Trace
from turbopi.models.pi0.solvers import GRIDS, SOLVERS, Integration, evaluations_of, grid_times, intervals
from turbopi.support.errors import ObservationError

assert kernels  # a fixture
KINDS: list[Kind] = ["pi05", "pi0"]
OTHERS: list[Solver] = [solver for solver in SOLVERS if solver != "euler"]
UNEVEN = (1.0, 0.7, 0.2, 0.0)
Velocity = Callable[[Tensor, float], Tensor]


def integrated(velocity: Velocity, x: Tensor, integration: Integration) -> Tensor:
    """The loop of any backend, without one."""
    x_t, v_t = [x], []
    for k, t in enumerate(integration.evaluated):
        v_t.append(velocity(x_t[k], t))
        x_t.append(integration.next_x(k, x_t, v_t))
    return x_t[-1]


def growing(x: Tensor, t: float) -> Tensor:
    """dx/dt = (1 + t) x, with the solution x(0) = x(1) exp(−1.5)."""
    return (1 + t) * x


# --- the solvers ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("grid", GRIDS)
@pytest.mark.parametrize("solver", SOLVERS)
def test_solvers_converge_with_the_second_order_and_euler_with_the_first(solver: Solver, grid: Any) -> None:
    start, errors = torch.ones(1, 1, 1, dtype=torch.float64), []
    for evaluations in (64, 256):
        times = grid_times(grid, intervals(solver, evaluations))
        found = integrated(growing, start, Integration(solver, times, evaluations))
        errors.append(abs(float(found) - math.exp(-1.5)))
    order = math.log(errors[0] / errors[1], 4)
    assert order == pytest.approx(1 if solver == "euler" else 2, abs=0.2)


@pytest.mark.parametrize("solver", SOLVERS)
def test_every_solver_is_as_its_formula_says(solver: Solver) -> None:
    """On three unequal intervals, written out; from noise and from a warm start."""

    def velocity(x: Tensor, t: float) -> Tensor:
        return torch.tanh(x.flip(-1)) * math.cos(3 * t) + t * x

    x = torch.linspace(-1, 1, 6, dtype=torch.float64).view(1, 2, 3)
    for times in (UNEVEN, tuple(0.6 * t for t in UNEVEN)):
        requested = Integration(solver, times)
        expected = _written_out(velocity, x, solver, requested.times)
        torch.testing.assert_close(integrated(velocity, x, requested), expected, rtol=1e-6, atol=1e-6)


def _written_out(velocity: Velocity, x: Tensor, solver: Solver, times: tuple[float, ...]) -> Tensor:
    before: tuple[float, Tensor, Tensor] | None = None  # t, v and D of the interval before
    for t, s in pairwise(times):
        v = velocity(x, t)
        data = x - t * v
        if solver == "midpoint":
            following = x + (s - t) * velocity(x + (s - t) / 2 * v, (t + s) / 2)
        elif solver == "heun" and s > 0:
            following = x + (s - t) / 2 * (v + velocity(x + (s - t) * v, s))
        elif solver == "ab2" and before is not None:
            following = x + (s - t) * (v + (s - t) / 2 * (v - before[1]) / (t - before[0]))
        elif solver == "exponential" and before is not None:
            slope = (data - before[2]) / (t - before[0])
            log = s * math.log(t / s) if s else 0.0
            following = s / t * x + (1 - s / t) * (data - t * slope) + log * slope
        else:
            following = x + (s - t) * v
        before, x = (t, v, data), following
    return x


def test_the_exponential_solver_is_exact_after_its_first_interval_for_actions_linear_in_t() -> None:
    a, b, c = 2.0, 3.0, 5.0  # D(t) = a + b t: the flow is (x − D) / t, and x(t) = c t + a − b t log t

    def velocity(x: Tensor, t: float) -> Tensor:
        return (x - (a + b * t)) / t

    x, times = torch.full((1, 1, 1), c + a, dtype=torch.float64), grid_times("uniform", 2)
    found, euler = (integrated(velocity, x, Integration(solver, times)) for solver in ("exponential", "euler"))
    assert abs(float(found) - a) < 1e-6 < abs(float(euler) - a)


@pytest.mark.parametrize("solver", SOLVERS)
def test_evaluations_are_counted_and_none_is_at_the_end(solver: Solver) -> None:
    for evaluations in range(1, 12):
        requested = Integration(solver, grid_times("uniform", intervals(solver, evaluations)), evaluations)
        assert len(requested.by_evaluation) == evaluations and min(requested.evaluated) > 0
        assert requested.is_euler == (solver == "euler" or evaluations == 1 or (solver, evaluations) == ("heun", 2))
    for count in range(1, 6):
        assert intervals(solver, evaluations_of(solver, count)) == count


def test_shifted_grids_have_their_intervals_where_their_names_say() -> None:
    uniform, noise, actions = (grid_times(name, 4) for name in GRIDS)
    assert uniform == (1, 0.75, 0.5, 0.25, 0)
    assert all(a < u < n for a, u, n in zip(actions[1:-1], uniform[1:-1], noise[1:-1], strict=True))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("euler", (1.0, 0.5, 0.6, 0.0)), r"the time grid is '\[1, 0.5, 0.6, 0\]'; .* fall strictly"),
        (("euler", (1.0, 0.5, 0.5, 0.0)), "fall strictly"),
        (("euler", (1.0, 0.5)), "to 0"),
        (("euler", (1.5, 0.5, 0.0)), "from 1"),
        (("euler", (1.0, math.nan, 0.0)), "numbers"),
        (("euler", (1.0, "a", 0.0)), "numbers"),
        (("euler", (0.0,)), "2 to 1001 times"),
        (("rk4", (1.0, 0.0)), "the solver is 'rk4'; it should be one of euler, midpoint, heun, ab2, exponential"),
        (("midpoint", (1.0, 0.5, 0.0), 2), "2 evaluations of solver 'midpoint' need a time grid of 1 intervals"),
    ],
)
def test_what_is_no_integration_is_refused(arguments: Any, message: str) -> None:
    with pytest.raises(ObservationError, match=message):
        Integration(*arguments)


# --- the reference ----------------------------------------------------------------------------------------------------


def reference(kind: Kind) -> tuple[Any, Any, Tensor]:
    case, model = golden_cases()["b_third_masked" if kind == "pi05" else "p0_pi0_state"], golden_model(kind)
    return model, model.prefix(case.observation), case.noise


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("solver", SOLVERS)
def test_the_reference_does_what_its_own_velocity_says(kind: Kind, solver: Solver) -> None:
    """Against the loop of this file around one-step calls of the reference, each of which leaves its velocity."""
    model, cache, noise = reference(kind)

    def velocity(x: Tensor, t: float) -> Tensor:
        trace: Trace = {}
        grid = np.full((1, 10), np.float32(t))
        model.denoise(cache, x, 1, conditioning=Conditioning(TokenTimes(grid, -grid)), trace=trace)
        return trace["v_t"][0]

    requested = Integration(solver, UNEVEN)
    trace: Trace = {}
    found = model.denoise(
        cache, noise, requested.evaluations, conditioning=Conditioning(integration=requested), trace=trace
    )
    torch.testing.assert_close(found, integrated(velocity, noise, requested), rtol=1e-5, atol=1e-5)
    assert trace["v_t"].shape[0] == requested.evaluations and torch.equal(trace["actions"], found)
    euler = model.denoise(cache, noise, 3, conditioning=Conditioning(integration=Integration("euler", UNEVEN)))
    assert torch.equal(found, euler) == (solver == "euler")


def test_eulers_steps_on_a_grid_are_those_of_token_times_and_on_openpis_grid_openpis() -> None:
    model, cache, noise = reference("pi05")
    as_tokens = Conditioning(TokenTimes.of(np.repeat(np.array(UNEVEN)[:, None], 10, axis=1)))
    as_grid = Conditioning(integration=Integration("euler", UNEVEN))
    found = model.denoise(cache, noise, 3, conditioning=as_grid)
    assert torch.equal(found, model.denoise(cache, noise, 3, conditioning=as_tokens))
    openpis = Conditioning(integration=Integration("euler", (*time_grid(4).tolist(), 0.0)))
    plain = model.denoise(cache, noise, 4)
    torch.testing.assert_close(model.denoise(cache, noise, 4, conditioning=openpis), plain, rtol=1e-6, atol=1e-6)


def test_eulers_steps_on_a_grid_hold_actions_and_other_solvers_refuse_to() -> None:
    model, cache, noise = reference("pi05")
    held, values = np.arange(10) < 3, np.ones((10, 32), np.float32)
    grid = np.repeat(np.array(UNEVEN, np.float32)[:, None], 10, axis=1)
    as_tokens = Conditioning(TokenTimes.of(grid), held, values)
    as_grid = Conditioning(None, held, values, integration=Integration("euler", UNEVEN))
    found = model.denoise(cache, noise, 3, conditioning=as_grid)
    assert torch.equal(found, model.denoise(cache, noise, 3, conditioning=as_tokens))
    pull = Guidance(values, np.ones(10, np.float32), np.ones((3, 10), np.float32), "identity")
    requested = Integration("ab2", UNEVEN)
    for what, one in (
        ("held actions", Conditioning(held=held, values=values, integration=requested)),
        ("guidance", Conditioning(guidance=pull, integration=requested)),
    ):
        with pytest.raises(ObservationError, match=f"{what} and solver 'ab2' were both asked for.*take .*'euler'"):
            model.denoise(cache, noise, 3, conditioning=one)
    with pytest.raises(ObservationError, match=r"token times and a time grid .* were both given"):
        model.denoise(cache, noise, 3, conditioning=Conditioning(TokenTimes.of(grid), integration=requested))
    with pytest.raises(ObservationError, match=r"a loop of 5 steps was asked for.*takes 3"):
        model.denoise(cache, noise, 5, conditioning=Conditioning(integration=requested))


# --- the engine -------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module", params=KINDS)
def engine(request: Any) -> OnCpu:
    return on_cpu(request.param)


@pytest.mark.slow
@pytest.mark.parametrize("solver", SOLVERS)
def test_the_engines_operations_equal_the_reference(engine: OnCpu, solver: Solver) -> None:
    observation, noise = made_up(engine.config.kind, 2, 19)
    plain = engine.sample(observation, noise, 3).actions
    for times in (UNEVEN, tuple(0.6 * t for t in UNEVEN)):
        integration = Integration(solver, times)
        requested, steps = Conditioning(integration=integration), integration.evaluations
        expected = golden_model(engine.config.kind).sample(observation, noise, steps, conditioning=requested)
        found = engine.sample(observation, noise, steps, conditioning=requested).actions
        torch.testing.assert_close(found, expected, atol=2e-5, rtol=2e-5)
        trace = engine.intermediates(observation, noise, steps, conditioning=requested)
        assert trace["v_t"].shape[0] == steps and torch.equal(trace["actions"], found)
    assert torch.equal(engine.sample(observation, noise, 3).actions, plain), "plain calls keep their bits"


@pytest.mark.slow
@pytest.mark.parametrize("by_token", [True, False])
@pytest.mark.parametrize("solver", SOLVERS)
def test_fuseds_kernels_evaluate_a_solvers_loop(
    kernels: type[ReferenceKernel], solver: Solver, by_token: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As on Hopper, where one kernel takes any times, and as elsewhere, where each time has a kernel."""
    backend, case = fused(), golden_cases()["b_third_masked"]
    monkeypatch.setattr(type(backend), "_times_by_token", by_token)
    integration = Integration(solver, UNEVEN)
    requested, steps = Conditioning(integration=integration), integration.evaluations
    plain = backend.sample(case.observation, case.noise, 3).actions
    expected = golden_model("pi05").sample(case.observation, case.noise, steps, conditioning=requested)
    found = backend.sample(case.observation, case.noise, steps, conditioning=requested).actions
    torch.testing.assert_close(found, expected, rtol=0, atol=3e-4)
    assert torch.equal(backend.sample(case.observation, case.noise, 3).actions, plain)
    (reported,) = backend.describe()["denoising"]
    assert reported == "one CUDA kernel"
    made = kernels.made[1:]
    assert {kernel.by_token for kernel in made} == {by_token}
    assert len(made) == (1 if by_token else len(set(integration.evaluated)))
    before = sum(kernel.launches for kernel in made)
    backend.sample(case.observation, case.noise, steps, conditioning=requested)
    launches = sum(kernel.launches for kernel in made) - before
    assert launches == (1 if by_token and integration.is_euler else steps)


def test_kernels_of_a_solvers_loop_are_forgotten_with_it_unless_another_loop_has_them(
    kernels: type[ReferenceKernel], monkeypatch: pytest.MonkeyPatch
) -> None:
    backend, case = fused(), golden_cases()["b_third_masked"]
    monkeypatch.setattr(type(backend), "_times_by_token", False)
    for solver in ("ab2", "exponential"):
        requested = Conditioning(integration=Integration(solver, UNEVEN))
        backend.sample(case.observation, case.noise, 3, conditioning=requested)
    assert len(kernels.made) == 3, "both evaluate at the same times"
    loops = list(backend._graphs.loops)
    for loop, left in zip(loops, (3, 0), strict=True):
        backend._graphs.loops._loops.pop(loop)
        backend._graphs.loops.evict(loop)
        assert len(backend._made("single")) == left


def test_a_solvers_loop_is_named_by_its_solver_and_grid() -> None:
    config = golden_model("pi05").config
    requested = Conditioning(integration=Integration("ab2", UNEVEN))
    loop = loop_of_call(requested, 3, 10, config)
    assert str(loop) == "H=10, 3 steps, ab2, t = 1, 0.7, 0.2, 0" and loop.rows == 3
    assert str(EulerLoop(1, 10, 0.5)) == "H=10, 1 steps, t = 0.5"
    euler = Conditioning(integration=Integration("euler", UNEVEN))
    assert loop_of_call(euler, 3, 10, config).form == "solver"
    assert loop_of_call(euler, 3, 10, config, times_by_token=True).form == "tokens"
