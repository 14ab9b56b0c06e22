"""Conditioned calls of the engine equal the reference's, in one captured graph a form, beside plain calls as ever."""

import dataclasses
from typing import Any

import numpy as np
import pytest
import torch
from conditioned import BY_TOKEN, conditioned
from conftest import golden_cases, golden_model
from test_begin import OnCpu, Unrun, on_cpu
from test_engine import FIELDS, made_up
from torch import Tensor

from turbopi.config import Kind
from turbopi.engine.graph_cache import MOST_LOOPS
from turbopi.engine.loops import MOST_TIMES, EulerLoop, loop_of_call
from turbopi.models.observation import Observation
from turbopi.models.pi0.conditioning import Conditioning, TokenTimes
from turbopi.models.pi0.solvers import Integration
from turbopi.support.errors import ObservationError

KINDS: list[Kind] = ["pi05", "pi0"]
STEPS = 4
FORMS = [*BY_TOKEN, "jacobian", "jacobian_and_held", "chosen_noise"]


@pytest.fixture(scope="module", params=KINDS)
def engine(request: Any) -> OnCpu:
    return on_cpu(request.param)


def expected(kind: Kind, observation: Observation, noise: Tensor, requested: Any, steps: int = STEPS) -> Tensor:
    return golden_model(kind).sample(observation, noise, steps, conditioning=requested)


@pytest.mark.slow
@pytest.mark.parametrize("which", FORMS)
def test_every_form_equals_the_reference(engine: OnCpu, which: str) -> None:
    observation, noise = made_up(engine.config.kind, 2, 19)
    requested = conditioned(which, STEPS, noise.shape[1], noise.shape[2])
    found = engine.sample(observation, noise, STEPS, conditioning=requested).actions
    torch.testing.assert_close(found, expected(engine.config.kind, observation, noise, requested), atol=2e-5, rtol=2e-5)


@pytest.mark.parametrize("which", ["held", "held_and_identity", "jacobian_and_held"])
def test_held_actions_come_out_as_they_were_given(engine: OnCpu, which: str) -> None:
    observation, noise = made_up(engine.config.kind, 1, 7)
    requested = conditioned(which, STEPS, noise.shape[1], noise.shape[2])
    assert requested.held is not None and requested.values is not None
    found = engine.sample(observation, noise, STEPS, conditioning=requested).actions[0].numpy()
    np.testing.assert_array_equal(found[requested.held], requested.values[requested.held])


def test_what_is_held_and_what_pulls_changes_without_a_new_capture(engine: OnCpu) -> None:
    observation, noise = made_up(engine.config.kind, 1, 7)
    requested = [Conditioning(held=np.arange(7) < d, values=np.full((7, 32), d, np.float32)) for d in (1, 3, 6)] + [
        conditioned("identity", STEPS, 7, 32, seed) for seed in range(2)
    ]
    kept = None
    for one in requested:
        found = engine.sample(observation, noise, STEPS, conditioning=one).actions
        torch.testing.assert_close(found, expected(engine.config.kind, observation, noise, one), atol=2e-5, rtol=2e-5)
        kept = len(engine._graphs.entries) if kept is None else kept
        assert len(engine._graphs.entries) == kept


def test_guidance_ends_with_the_call_that_asked_for_it(engine: OnCpu) -> None:
    observation, noise = made_up(engine.config.kind, 1, 7)
    held = conditioned("held", STEPS, 7, 32)
    alone = engine.sample(observation, noise, STEPS, conditioning=held).actions
    engine.sample(observation, noise, STEPS, conditioning=conditioned("held_and_identity", STEPS, 7, 32))
    assert torch.equal(engine.sample(observation, noise, STEPS, conditioning=held).actions, alone)


def test_plain_calls_keep_their_bits_beside_conditioned_ones(engine: OnCpu) -> None:
    observation, noise = made_up(engine.config.kind, 1, 7)
    plain = engine.sample(observation, noise, STEPS).actions
    for which in FORMS:
        engine.sample(observation, noise, STEPS, conditioning=conditioned(which, STEPS, 7, 32))
    for nothing in (None, Conditioning(), Conditioning(held=np.zeros(7, bool))):
        assert torch.equal(engine.sample(observation, noise, STEPS, conditioning=nothing).actions, plain)


def test_rows_of_a_batch_have_conditionings_of_their_own(engine: OnCpu) -> None:
    one, noise = made_up(engine.config.kind, 2, 9)
    other, _ = made_up(engine.config.kind, 2, 9, seed=1)
    both = Observation(*(torch.cat((getattr(one, f), getattr(other, f))) for f in FIELDS))
    requested = [None, conditioned("held", STEPS, 7, 32)]
    noises = noise.repeat(2, 1, 1)
    found = engine.sample(both, noises, STEPS, conditioning=requested).actions
    torch.testing.assert_close(found, expected(engine.config.kind, both, noises, requested), atol=2e-5, rtol=2e-5)
    with pytest.raises(ObservationError, match="3 conditionings were given for 2 observations"):
        engine.sample(both, noises, STEPS, conditioning=[None, None, None])


@pytest.mark.parametrize("which", ["held_and_identity", "chosen_noise"])
def test_denoise_alone_takes_a_conditioning(engine: OnCpu, which: str) -> None:
    observation, noise = made_up(engine.config.kind, 1, 7)
    requested = conditioned(which, STEPS, 7, 32)
    whole = engine.sample(observation, noise, STEPS, conditioning=requested).actions
    cache = golden_model(engine.config.kind).prefix(observation)
    alone = engine.denoise(cache, noise, STEPS, conditioning=requested)
    torch.testing.assert_close(alone, whole, atol=1e-5, rtol=1e-5)
    trace = engine.intermediates(observation, noise, STEPS, conditioning=requested)
    assert torch.equal(trace["actions"], whole) and trace["x_t"].shape == (STEPS + 1, 1, 7, 32)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("which", ["plain", "ab2", "held_and_identity", "jacobian", "chosen_noise"])
def test_a_cache_from_elsewhere_is_denoised_by_an_engine_that_encoded_nothing(kind: Kind, which: str) -> None:
    """Behind the given rows the engine's own cache is as it was allocated: NaN."""
    observation, noise = made_up(kind, 1, 5)
    requested: Any = {"plain": None, "ab2": Conditioning(integration=Integration("ab2", (1.0, 0.4, 0.2, 0.1, 0.0)))}
    reported = requested[which] if which in requested else conditioned(which, STEPS, 7, 32)
    model = golden_model(kind)
    cache, fresh = model.prefix(observation), on_cpu(kind, Unrun)
    found = fresh.denoise(cache, noise, STEPS, conditioning=reported)
    torch.testing.assert_close(found, model.denoise(cache, noise, STEPS, conditioning=reported), atol=2e-5, rtol=2e-5)
    too_many = model.config.max_prompt_tokens + 1
    long = dataclasses.replace(cache, k=cache.k.new_zeros(*cache.k.shape[:3], 4 * 256 + too_many, cache.k.shape[4]))
    with pytest.raises(ObservationError, match=f"prompt tokens, this observation has 4 and {too_many}"):
        fresh.denoise(long, noise, STEPS)


@pytest.mark.slow
@pytest.mark.parametrize("which", ["held", "identity", "staircase", "jacobian", "chosen_noise"])
def test_bfloat16_is_as_close_to_float32_as_the_reference_is(which: str) -> None:
    case = golden_cases()["b_third_masked"]
    requested = conditioned(which, 10, case.noise.shape[1], case.noise.shape[2])
    model = golden_model("pi05", "bf16")
    engine = OnCpu(
        model.config, lambda device, precision: dict(model.state_dict()), device=torch.device("cpu"), precision="bf16"
    )
    one = Observation(*(getattr(case.observation, f)[:1] for f in FIELDS))
    exact = golden_model("pi05").sample(one, case.noise[:1], 10, conditioning=requested)
    reference = model.sample(one, case.noise[:1], 10, conditioning=requested)
    found = engine.sample(one, case.noise[:1], 10, conditioning=requested).actions
    assert 0 < rms(found - exact) <= 1.5 * rms(reference - exact)


def rms(x: Tensor) -> float:
    return float(x.square().mean().sqrt())


def test_a_strict_backend_refuses_a_form_that_is_not_warm_and_warm_up_prepares_it() -> None:
    engine = on_cpu(cls=Unrun)
    observation, noise = made_up("pi05", 2, 5)
    engine.warmup(observation, STEPS, 7)
    engine.strict = True
    with pytest.raises(ObservationError, match=r"needs 2 cameras, H=7, 4 steps, by token, 5 times.*Warm is"):
        engine.sample(observation, noise, STEPS, conditioning=conditioned("held", STEPS, 7, 32))
    engine.warmup(observation, STEPS, 7, conditioning=conditioned("identity", STEPS, 7, 32))
    engine.sample(observation, noise, STEPS, conditioning=conditioned("held", STEPS, 7, 32))
    with pytest.raises(ObservationError, match="by token"):
        engine.sample(observation, noise, STEPS, conditioning=conditioned("staircase", STEPS, 7, 32))


def test_warm_up_prepares_every_loop_of_a_chosen_noise_for_every_prompt() -> None:
    engine = on_cpu(cls=Unrun)
    for tokens in (5, 19):
        observation, noise = made_up("pi05", 2, tokens)
        if tokens == 5:
            engine.warmup(observation, STEPS, 7)
            engine.strict = True
            with pytest.raises(ObservationError, match="strict: this call needs 2 cameras, H=7, 4 steps, by token"):
                engine.sample(observation, noise, STEPS, conditioning=conditioned("chosen_noise", STEPS, 7, 32))
            engine.warmup(observation, STEPS, 7, conditioning=conditioned("chosen_noise", STEPS, 7, 32, seed=1))
        engine.reported.clear()
        engine.sample(observation, noise, STEPS, conditioning=conditioned("chosen_noise", STEPS, 7, 32))
        assert engine.reported == ["run", "answer", "denoise", "denoise"]


def test_few_conditioned_loops_are_kept() -> None:
    engine = on_cpu(cls=Unrun)
    observation, noise = made_up("pi05", 2, 5)
    for first in np.linspace(0.1, 0.9, 2 * MOST_LOOPS):
        times = TokenTimes.of(np.linspace(first, 0, STEPS + 1)[:, None].repeat(7, 1))
        engine.sample(observation, noise, STEPS, conditioning=Conditioning(tokens=times))
    assert len(engine._tables) == MOST_LOOPS and len(engine._graphs.entries) == MOST_LOOPS + 1


def test_a_loop_is_named_by_what_its_graph_is_for() -> None:
    config = golden_model("pi05").config
    held, staircase = conditioned("held", STEPS, 7, 32), conditioned("staircase", STEPS, 7, 32)
    assert loop_of_call(None, STEPS, 7, config) == loop_of_call(Conditioning(), STEPS, 7, config) == EulerLoop(4, 7)
    assert loop_of_call(held, STEPS, 7, config) == loop_of_call(conditioned("identity", STEPS, 7, 32), STEPS, 7, config)
    assert str(loop_of_call(held, STEPS, 7, config)) == "H=7, 4 steps, by token, 5 times"
    assert loop_of_call(staircase, STEPS, 7, config).table != loop_of_call(held, STEPS, 7, config).table


def test_too_many_times_are_refused() -> None:
    config = golden_model("pi05").config
    times = np.linspace(1, 0, 30 * 50).reshape(30, 50)
    requested = Conditioning(tokens=TokenTimes.of(np.sort(times, axis=0)[::-1]))
    with pytest.raises(ObservationError, match=f"1451 different values; at most {MOST_TIMES} fit"):
        loop_of_call(requested, 29, 50, config)


def test_backends_say_which_forms_they_have() -> None:
    assert set(on_cpu().forms) == {"solver", "tokens", "jacobian", "noise", "two_prompts"}
