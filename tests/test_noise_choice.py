"""Noise chosen before the loop, mode `paint`: computed independently, an inverse of the flow, policies, refusals."""

import dataclasses
import itertools
from typing import Any

import numpy as np
import pytest
import torch
from conditioned import conditioned
from policy_helpers import policy_on
from test_begin import OnCpu
from test_conditioning import KINDS, cached, chunk
from torch import Tensor

from turbopi import UnifiedPolicy
from turbopi.backends.pytorch import PyTorchBackend
from turbopi.checkpoint import random_checkpoint
from turbopi.config import Kind
from turbopi.models.observation import Observation
from turbopi.models.pi0.conditioning import Conditioning, TokenTimes
from turbopi.models.pi0.denoise import suffix_mask, suffix_rope, time_embedding
from turbopi.models.pi0.noise_choice import NoiseChoice
from turbopi.models.pi0.solvers import Integration
from turbopi.realtime.running_chunk import RunningChunk
from turbopi.support.errors import ObservationError

pytestmark = pytest.mark.usefixtures("two_layers")
FIRST = np.arange(10) < 3


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("times", [(1.0, 0.75, 0.5, 0.25, 0.0), (1.0, 0.9, 0.4, 0.1, 0.0)])
def test_the_reference_equals_algorithm_1_written_out(kind: Kind, times: tuple[float, ...]) -> None:
    """On openpi's grid and another: every step back has the time and the x of the point that it leaves."""
    model, cache, noise = cached(kind)
    given = torch.from_numpy(chunk(1))
    rope = suffix_rope(cache, 10 + (kind == "pi0"), model.config.expert.head_dim, model.config.rope_base)
    mask = suffix_mask(cache, 10 + (kind == "pi0"), kind == "pi0")

    def velocity(x: Tensor, t: float) -> Tensor:
        embedded = time_embedding(np.array([t], np.float32), model.config.expert.width)
        time = model.time_condition(embedded) if kind == "pi05" else embedded
        return model.velocity(x, cache.state, time, cache.k, cache.v, rope, mask)[1]

    def to_actions(x: Tensor) -> Tensor:
        for start, end in itertools.pairwise(times):
            x = x + (end - start) * velocity(x, start)
        return x

    with torch.no_grad():
        x = to_actions(noise)
        x[:, :3] = given[:3]
        for start, end in zip(times[-2::-1], times[:0:-1], strict=True):  # from `end`, which is nearer to the actions
            x = x + (start - end) * velocity(x, end)
        x[:, 3:] = noise[:, 3:]
        expected = to_actions(x)
    own = None if times[1] == 0.75 else Integration("euler", times)
    requested = Conditioning(integration=own, noise=NoiseChoice(FIRST, given.numpy()))
    trace: Any = {}
    found = model.denoise(cache, noise, 4, conditioning=requested, trace=trace)
    torch.testing.assert_close(found, expected, atol=2e-6, rtol=2e-6)
    torch.testing.assert_close(trace["x_t"][0], x, atol=2e-6, rtol=2e-6)
    plain = model.denoise(cache, noise, 4, conditioning=Conditioning(integration=own))
    assert float((found - plain).abs().max()) > 1e-2


def test_the_way_back_is_the_inverse_of_the_flow() -> None:
    """From a chunk back to the noise that it was made of: twice as many steps, about half of the error."""
    model, cache, noise = cached("pi05")
    errors = []
    for steps in (10, 20, 40):
        made = model.denoise(cache, noise, steps)
        back = Conditioning(tokens=TokenTimes.plain(steps, 10).reversed())
        errors.append(float((model.denoise(cache, made, steps, conditioning=back) - noise).norm() / noise.norm()))
    assert errors[2] < 0.6 * errors[1] < 0.36 * errors[0], errors


def test_without_actions_to_come_near_the_noise_is_the_given_one() -> None:
    model, cache, noise = cached("pi05")
    nothing = Conditioning(noise=NoiseChoice(np.zeros(10, bool), chunk(0)))
    assert torch.equal(model.denoise(cache, noise, 4, conditioning=nothing), model.denoise(cache, noise, 4))


@pytest.mark.parametrize(
    ("requested", "message"),
    [
        (Conditioning(noise=NoiseChoice(FIRST[:9], chunk(0))), r"a chosen noise's rows is bool of shape \[9\]"),
        (Conditioning(noise=NoiseChoice(FIRST, chunk(0)[:9])), r"values are float32 of shape \[9, 32\]"),
        (Conditioning(noise=NoiseChoice(FIRST, chunk(0) * np.nan)), "values that aren't finite"),
        (
            dataclasses.replace(conditioned("held", 4, 10, 32), noise=NoiseChoice(FIRST, chunk(0))),
            "beside held actions, guidance or token times",
        ),
        (
            Conditioning(integration=Integration("ab2", (1.0, 0.7, 0.5, 0.2, 0.0)), noise=NoiseChoice(FIRST, chunk(0))),
            "a chosen noise and solver 'ab2'",
        ),
    ],
)
def test_what_does_not_fit_is_refused(requested: Conditioning, message: str) -> None:
    model, cache, noise = cached("pi05")
    with pytest.raises(ObservationError, match=message):
        model.denoise(cache, noise, 4, conditioning=requested)


# -- policies ----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module", params=[PyTorchBackend, OnCpu], ids=["pytorch", "engine"])
def policy(request: Any) -> UnifiedPolicy:
    return policy_on(request.param, random_checkpoint("pi05_tiny"), num_denoising_steps=2)


def test_mode_paint_chooses_the_noise_of_what_will_be_carried_out(policy: UnifiedPolicy) -> None:
    observation, left_over = policy.example_observation(), chunk(2)[:8]
    joined = RunningChunk(left_over, 3, 2, "paint")
    found = policy.infer(observation, seed=4, previous=joined, model_actions=True)["model_actions"]
    noise = torch.from_numpy(np.random.default_rng(4).standard_normal((1, 10, 32), dtype=np.float32))
    target = np.concatenate((left_over, np.zeros((2, 32), np.float32)))
    inputs = Observation.stack([policy.prepare(observation)])
    exact = policy.backend.sample(inputs, noise, 2, conditioning=Conditioning(noise=NoiseChoice(FIRST, target)))
    np.testing.assert_allclose(found, exact.actions[0].numpy(), rtol=0, atol=1e-5)
    plain = policy.infer(observation, seed=4, model_actions=True)["model_actions"]
    assert np.abs(found - plain).max() > 1e-2
    at_once = policy.infer(observation, seed=4, previous=dataclasses.replace(joined, delay=0), model_actions=True)
    np.testing.assert_array_equal(at_once["model_actions"], plain)
    both = policy.infer_batch([observation] * 3, seed=[4, 4, 4], previous=[joined, None, joined], model_actions=True)
    for one, expected in zip(both, (found, plain, found), strict=True):
        np.testing.assert_allclose(one["model_actions"], expected, rtol=0, atol=1e-4)


def test_policies_offer_paint_and_say_what_it_does_not_go_with(policy: UnifiedPolicy) -> None:
    assert "paint" in policy.metadata["real_time"]["modes"] and "paint" not in policy.batch_modes
    joined = RunningChunk(chunk(2)[:8], 3, 2, "paint")
    with pytest.raises(ObservationError, match="a running chunk and solver 'ab2' were both given"):
        policy.infer(policy.example_observation(), previous=joined, solver="ab2")
    with pytest.raises(ObservationError, match="together they should be at most 10"):
        policy.infer(policy.example_observation(), previous=RunningChunk(chunk(2)[:8], 5, 6, "paint"))
    guided = policy_on(
        type(policy.backend), random_checkpoint("pi05_tiny"), guidance=1.5, guidance_tag="Advantage: good"
    )
    assert "paint" not in guided.metadata["real_time"]["modes"]
    with pytest.raises(ObservationError, match="mode paint chooses noise for one prompt, but guidance takes two"):
        guided.infer(guided.example_observation(), previous=joined)
    assert np.isfinite(guided.infer(guided.example_observation(), previous=joined, guidance=1)["actions"]).all()


def test_backends_without_it_say_what_to_take(policy: UnifiedPolicy, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(type(policy.backend), "forms", ("tokens",))
    with pytest.raises(ObservationError, match=r"has no chosen noise \(paint\); leave .* or take backend 'pytorch'"):
        policy.infer(policy.example_observation(), previous=RunningChunk(chunk(2)[:8], 3, 2, "paint"))
