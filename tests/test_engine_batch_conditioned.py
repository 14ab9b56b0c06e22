"""Conditioned observations in batched calls of the engine: each gets what it gets alone, whatever is beside it."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
import torch
from conditioned import BY_TOKEN, conditioned
from conftest import golden_cases, golden_model
from test_begin import OnCpu, Unrun, on_cpu
from test_engine_batch import observations
from torch import Tensor

from turbopi.config import Kind, ModelConfig
from turbopi.engine.batch_runner import BatchRunner
from turbopi.engine.loops import ConditionedLoop, EulerLoop, batch_form, loop_of_batch
from turbopi.models.observation import Observation
from turbopi.models.pi0.conditioning import Conditioning, TokenTimes
from turbopi.models.pi0.reference import Trace
from turbopi.models.pi0.solvers import Integration
from turbopi.support.errors import ObservationError
from turbopi.verify.golden import Case

KINDS: list[Kind] = ["pi05", "pi0"]
STEPS, H, A = 3, 7, 32
CAMERAS, TOKENS = [2, 0, 3, 1], [7, 12, 3, 0]
FIELDS = ("images", "image_mask", "tokens", "token_mask", "state")
JACOBIAN = ["jacobian", "jacobian_and_held"]


def times_of(conditionings: Sequence[Conditioning | None], config: ModelConfig) -> tuple[float, ...]:
    loop = loop_of_batch(conditionings, STEPS, H, config)
    assert isinstance(loop, ConditionedLoop)
    return loop.times


@pytest.fixture(scope="module", params=KINDS)
def engine(request: Any) -> OnCpu:
    return on_cpu(request.param)


def requested(*which: str | None) -> list[Conditioning | None]:
    """A conditioning for each row, of its own numbers."""
    return [None if one is None else conditioned(one, STEPS, H, A, seed) for seed, one in enumerate(which)]


def rows_of(observation: Observation, rows: slice) -> Observation:
    return Observation(**{name: getattr(observation, name)[rows] for name in FIELDS})


def with_a_reference(case: Case) -> tuple[Observation, Tensor]:
    """A golden observation and one with a camera less."""
    one = rows_of(case.observation, slice(1))
    made = Observation(**{name: torch.cat((getattr(one, name), getattr(one, name))) for name in FIELDS})
    made.image_mask[1, 0] = False
    return made, case.noise[:1].repeat(2, 1, 1)


def close(ours: Tensor, exact: Tensor) -> None:
    torch.testing.assert_close(ours, exact, atol=2e-5, rtol=2e-5)


@pytest.mark.slow
@pytest.mark.parametrize("which", [BY_TOKEN[:3], BY_TOKEN[3:]], ids=" ".join)
def test_every_form_by_token_runs_in_one_call_beside_plain_observations(engine: OnCpu, which: list[str]) -> None:
    """Other cameras, prompts of other lengths, one without an image, one without a prompt."""
    kind = engine.config.kind
    made, noise = observations(kind, CAMERAS, TOKENS, H)
    reported = requested(which[0], None, *which[1:])
    engine.reported.clear()
    close(engine.sample(made, noise, STEPS, conditioning=reported).actions, golden_model(kind).sample(
        made, noise, STEPS, conditioning=reported
    ))  # fmt: skip
    assert len(engine.reported) == 3, "vision, prefix and denoising of all four"


@pytest.mark.slow
@pytest.mark.parametrize("which", JACOBIAN)
@pytest.mark.parametrize("count", [2, 3])
def test_the_true_jacobian_goes_back_through_each_observations_own_prefix(
    engine: OnCpu, which: str, count: int
) -> None:
    """Three are a call of four with an empty place."""
    kind = engine.config.kind
    made, noise = observations(kind, CAMERAS[:count], TOKENS[:count], H)
    reported = requested(*[which] * count)
    engine.reported.clear()
    ours = engine.sample(made, noise, STEPS, conditioning=reported).actions
    close(ours, golden_model(kind).sample(made, noise, STEPS, conditioning=reported))
    assert len(engine.reported) == 3


@pytest.mark.slow
def test_rows_of_all_forms_are_grouped_by_what_may_share_a_loop_and_come_back_in_their_order(engine: OnCpu) -> None:
    kind = engine.config.kind
    made, noise = observations(kind, [1, 2, 0, 1, 1, 2, 1], [3, 5, 7, 2, 4, 6, 8], H)
    reported = requested("jacobian", None, "held", "jacobian_and_held", "warm_start", None, "identity")
    reported[5] = Conditioning(integration=Integration("ab2", (1.0, 0.6, 0.3, 0.0)))
    engine.reported.clear()
    close(engine.sample(made, noise, STEPS, conditioning=reported).actions, golden_model(kind).sample(
        made, noise, STEPS, conditioning=reported
    ))  # fmt: skip
    assert engine.reported == ["run"] * 6 + ["run", "answer"], "four by token; two guided ones; the solver's alone"


@pytest.mark.slow
def test_one_loop_serves_observations_whose_times_differ(engine: OnCpu) -> None:
    kind = engine.config.kind
    made, noise = observations(kind, CAMERAS, TOKENS, H)
    reported = requested("staircase", "warm_start", "held", None)
    reported[3] = Conditioning(integration=Integration("euler", (1.0, 0.5, 0.2, 0.0)))
    close(engine.sample(made, noise, STEPS, conditioning=reported).actions, golden_model(kind).sample(
        made, noise, STEPS, conditioning=reported
    ))  # fmt: skip
    loop = loop_of_batch(reported, STEPS, H, engine.config)
    alone = {time for each in reported if each is not None for time in times_of([each], engine.config)}
    assert loop.form == "tokens" and set(times_of(reported, engine.config)) == alone
    assert any(one.endswith(str(loop)) for one in engine.describe()["batches"])


@pytest.mark.parametrize("which", ["held", "held_and_identity", "jacobian_and_held"])
def test_held_actions_come_out_as_they_were_given(engine: OnCpu, which: str) -> None:
    made, noise = observations(engine.config.kind, CAMERAS, TOKENS, H)
    reported = requested(*[which] * 4)
    found = engine.sample(made, noise, STEPS, conditioning=reported).actions.numpy()
    for actions, one in zip(found, reported, strict=True):
        assert one is not None and one.held is not None and one.values is not None
        np.testing.assert_array_equal(actions[one.held], one.values[one.held])


@pytest.mark.slow
@pytest.mark.parametrize("which", ["held_and_identity", "jacobian"])
def test_what_another_observation_asks_for_changes_nothing(engine: OnCpu, which: str) -> None:
    made, noise = observations(engine.config.kind, CAMERAS, TOKENS, H)
    reported = requested(which, which, which, which)
    before = engine.sample(made, noise, STEPS, conditioning=reported).actions
    reported[1] = conditioned(which, STEPS, H, A, seed=9)
    after = engine.sample(made, noise, STEPS, conditioning=reported).actions
    assert not torch.equal(before[1], after[1])
    for row in (0, 2, 3):
        assert torch.equal(before[row], after[row])


@pytest.mark.slow
def test_a_batch_that_asks_for_nothing_is_the_plain_one_to_the_last_bit(engine: OnCpu) -> None:
    made, noise = observations(engine.config.kind, CAMERAS, TOKENS, H)
    plain = engine.sample(made, noise, STEPS).actions
    engine.sample(made, noise, STEPS, conditioning=requested("held_and_identity", "held", None, "staircase"))
    captured = len(engine._graphs.entries)
    for nothing in ([None] * 4, [Conditioning(), None, Conditioning(held=np.zeros(H, bool)), None]):
        assert torch.equal(engine.sample(made, noise, STEPS, conditioning=nothing).actions, plain)
    assert len(engine._graphs.entries) == captured


@pytest.mark.slow
def test_what_is_held_and_what_pulls_changes_without_a_new_capture_and_ends_with_its_call(engine: OnCpu) -> None:
    kind = engine.config.kind
    made, noise = observations(kind, CAMERAS, TOKENS, H)
    first = requested("held", None, "identity", "held")
    alone = engine.sample(made, noise, STEPS, conditioning=first).actions
    captured = len(engine._graphs.entries)
    other = requested(None, "held_and_identity", "held", "identity")
    close(engine.sample(made, noise, STEPS, conditioning=other).actions, golden_model(kind).sample(
        made, noise, STEPS, conditioning=other
    ))  # fmt: skip
    engine.sample(*observations(kind, [2, 2, 2], [3, 3, 3], H), STEPS, conditioning=requested(*["identity"] * 3))
    assert torch.equal(engine.sample(made, noise, STEPS, conditioning=first).actions, alone)
    assert len([key for key in engine._graphs.entries if key.part == "denoise"]) <= captured


@pytest.mark.parametrize("which", [["held", None], ["staircase", "identity"], ["jacobian", "jacobian_and_held"]])
@pytest.mark.parametrize("name", ["b_third_masked", "p0_pi0_state"])
def test_intermediates_of_golden_cases(name: str, which: list[str | None]) -> None:
    """Two golden observations with unequal masks, through one batched call."""
    case = golden_cases()[name]
    made, noise = with_a_reference(case)
    reported = [
        None if one is None else conditioned(one, 10, noise.shape[1], A, seed) for seed, one in enumerate(which)
    ]
    backend, trace = on_cpu(case.kind), Trace()
    ours = backend.intermediates(made, noise, 10, conditioning=reported)
    exact = golden_model(case.kind).sample(made, noise, 10, conditioning=reported, compact=False, trace=trace)
    for one in ("x_t", "v_t"):
        size = float(trace[one].abs().max())  # pulled as far as 147, where the reference has this error, too
        torch.testing.assert_close(ours[one], trace[one], atol=1e-5 * size, rtol=0)
    torch.testing.assert_close(ours["actions"], exact, atol=1e-4, rtol=1e-4)
    assert len(backend.describe()["batches"]) == 1


@pytest.mark.slow
@pytest.mark.parametrize("which", ["held", "identity", "staircase", "jacobian"])
def test_bfloat16_is_as_close_to_float32_as_the_reference_is(which: str) -> None:
    case = golden_cases()["b_third_masked"]
    reported = [conditioned(which, 10, case.noise.shape[1], A, seed) for seed in range(2)]
    model = golden_model("pi05", "bf16")
    engine = OnCpu(
        model.config, lambda device, precision: dict(model.state_dict()), device=torch.device("cpu"), precision="bf16"
    )
    made, noise = with_a_reference(case)
    exact = golden_model("pi05").sample(made, noise, 10, conditioning=reported)
    reference = model.sample(made, noise, 10, conditioning=reported)
    found = engine.sample(made, noise, 10, conditioning=reported).actions
    assert len(engine.describe()["batches"]) == 1
    assert 0 < rms(found - exact) <= 1.5 * rms(reference - exact)


def rms(x: Tensor) -> float:
    return float(x.square().mean().sqrt())


def test_a_wrong_conditioning_is_named_by_its_row(engine: OnCpu) -> None:
    made, noise = observations(engine.config.kind, CAMERAS, TOKENS, H)
    reported = requested("held", "jacobian", None, "held")
    reported[3] = Conditioning(held=np.zeros(H + 1, bool))
    with pytest.raises(ObservationError, match=r"observation 3 of 4 \(from 0\): held is bool of shape \[8\]; .*\[7\]"):
        engine.sample(made, noise, STEPS, conditioning=reported)
    with pytest.raises(ObservationError, match="2 conditionings were given for 4 observations"):
        engine.sample(made, noise, STEPS, conditioning=[None, None])


class TestStrict:
    """What warm-up captures of batches, and what is refused without it."""

    def test_batches_by_token_are_captured_for_all_that_is_held_or_pulls(self) -> None:
        engine = on_cpu(cls=Unrun)
        made, noise = observations("pi05", [2] * 4, [3] * 4, H)
        engine.warmup(rows_of(made, slice(1)), STEPS, H)
        engine.warmup_batches(rows_of(made, slice(1)), STEPS, H, [4], requested("held")[0])
        engine.strict = True
        reported = len(engine.reported)
        engine.sample(made, noise, STEPS, conditioning=requested("identity", None, "held", "held_and_identity"))
        assert engine.reported[reported:] == ["run"] * 3
        with pytest.raises(ObservationError, match=r"4 observations with 8 images, H=7, 3 steps, by token, 7 times"):
            engine.sample(made, noise, STEPS, conditioning=requested("warm_start", None, None, None))
        with pytest.raises(ObservationError, match=r"warmup\(batches=4\) with their real_time modes or conditionings"):
            engine.sample(made, noise, STEPS, conditioning=requested("warm_start", None, None, None))
        five = observations("pi05", [2] * 5, [3] * 5, H)
        with pytest.raises(ObservationError, match=r"5 observations at once.*policy\.warmup\(batches=5\)"):
            engine.sample(*five, STEPS, conditioning=requested(*["held"] * 5))

    def test_a_plain_batch_that_is_not_captured_runs_one_by_one_beside_a_captured_conditioned_one(self) -> None:
        engine = on_cpu(cls=Unrun)
        made, noise = observations("pi05", [2] * 4, [3] * 4, H)
        engine.warmup(rows_of(made, slice(1)), STEPS, H)
        engine.warmup_batches(rows_of(made, slice(1)), STEPS, H, [4], requested("held")[0])
        engine.strict = True
        reported = len(engine.reported)
        engine.sample(made, noise, STEPS)
        assert engine.reported[reported:] == ["run", "answer"] * 4

    def test_guided_batches_are_captured_up_to_their_largest_and_larger_ones_put_together(self) -> None:
        engine = on_cpu(cls=Unrun)
        made, noise = observations("pi05", [1] * 16, [3] * 16, H)
        engine.warmup_batches(rows_of(made, slice(1)), STEPS, H, [16], requested("jacobian")[0])
        assert engine._graphs.batch_sizes("jacobian") == {max(BatchRunner.JACOBIAN_COSTS)} == {8}
        engine.strict = True
        reported = len(engine.reported)
        engine.sample(made, noise, STEPS, conditioning=requested(*["jacobian"] * 16))
        assert engine.reported[reported:] == ["run"] * 6

    def test_a_solvers_loop_has_no_batches_to_capture(self) -> None:
        engine = on_cpu(cls=Unrun)
        made, _ = observations("pi05", [1], [3], H)
        engine.warmup_batches(made, STEPS, H, [4], Conditioning(integration=Integration("heun", (1.0, 0.5, 0.0))))
        assert engine.describe()["batches"] == [] and engine.reported == []


def test_what_a_batch_makes_of_each_form() -> None:
    config = golden_model("pi05").config
    euler = Conditioning(integration=Integration("euler", (1.0, 0.3, 0.1, 0.0)))
    forms = [batch_form(one) for one in (*requested(None, "held", "jacobian"), euler, Conditioning())]
    assert forms == ["plain", "tokens", "jacobian", "tokens", "plain"]
    assert batch_form(Conditioning(integration=Integration("ab2", (1.0, 0.5, 0.0)))) == "solver"
    assert loop_of_batch([None, Conditioning()], STEPS, H, config) == EulerLoop(STEPS, H)
    own = loop_of_batch(requested("held"), STEPS, H, config)
    assert own == loop_of_batch([None, *requested("identity")], STEPS, H, config) and own.rows == STEPS + 1
    assert loop_of_batch(requested("held", "jacobian"), STEPS, H, config).form == "jacobian"


def test_too_many_times_of_all_rows_are_refused() -> None:
    config = golden_model("pi05").config
    rng = np.random.default_rng(0)
    many = [
        Conditioning(tokens=TokenTimes.of(np.sort(rng.random((30, 50)), axis=0)[::-1])) for _ in range(2)
    ]  # 1450 each
    with pytest.raises(
        ObservationError, match=r"of 2 observations together have 29\d\d different .*fewer observations"
    ):
        loop_of_batch(many, 29, 50, config)
