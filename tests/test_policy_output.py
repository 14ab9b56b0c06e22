"""What leaves the policy: times that add up, and no action that isn't finite, whichever way it is called."""

import dataclasses
import math
from collections.abc import Callable
from concurrent.futures import Future
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from policy_helpers import policy_on
from torch import Tensor

from turbopi import UnifiedPolicy
from turbopi.backends import Sample
from turbopi.checkpoint import random_checkpoint
from turbopi.models.observation import Observation
from turbopi.support.errors import ActionError

pytestmark = pytest.mark.usefixtures("two_layers")

H, D = 10, 32
STAGES = {"vision": 1.0, "prefix": 2.0, "denoise": 3.0}


class Clock:
    """Stands still but for `passes`."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now

    def passes(self, seconds: float, function: Callable[..., Any] = lambda *_: None) -> Callable[..., Any]:
        def later(*arguments: Any, **named: Any) -> Any:
            self.now += seconds
            return function(*arguments, **named)

        return later


class Answering:
    """A backend that answers with `actions` after a second; `kind` says by which of its methods."""

    def __init__(self, backend: Any, kind: str, clock: Clock) -> None:
        self._backend, self._clock = backend, clock
        self.actions = torch.zeros(1, H, D)
        self.runs_batches, self.submits = kind == "begin", kind == "submit"

    def __getattr__(self, name: str) -> Any:
        return getattr(self._backend, name)

    def begin_batch(self, *_: Any) -> Any:
        return SimpleNamespace(finish=self._answer)

    def sample(self, observation: Observation, noise: Tensor, num_steps: int, *, conditioning: None) -> Sample:
        return self._answer()

    def _answer(self, *_: Any) -> Sample:
        self._clock.now += 1
        return Sample(self.actions, STAGES)

    def submit(self, *_: Any) -> "Future[Sample]":
        self._clock.now += 2  # until there is room
        future: Future[Sample] = Future()
        future.set_result(dataclasses.replace(self._answer(), queue_ms=2000.0))
        return future


@pytest.fixture(scope="module")
def whole() -> UnifiedPolicy:
    checkpoint = random_checkpoint("pi05_tiny")
    return UnifiedPolicy(checkpoint, backend="pytorch", device="cpu", precision="f32", num_denoising_steps=1)


CALLS: dict[str, Callable[[UnifiedPolicy, dict[str, Any]], dict[str, Any]]] = {
    "sample": lambda policy, obs: policy.infer(obs, seed=0),
    "begin": lambda policy, obs: policy.infer(obs, seed=0),
    "submit": lambda policy, obs: policy.submit(obs, seed=0).result(timeout=120),
}


def answering(whole: UnifiedPolicy, kind: str) -> tuple[UnifiedPolicy, Answering, Clock]:
    """A policy whose backend answers, that backend, and its clock."""
    clock = Clock()
    backend = Answering(whole.backend, kind, clock)
    made = policy_on(lambda *_, **__: backend, random_checkpoint("pi05_tiny"), num_denoising_steps=1)
    return made, backend, clock


@pytest.mark.parametrize("kind", CALLS)
def test_waiting_for_ones_turn_is_in_no_other_time(
    whole: UnifiedPolicy, kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    policy, _, clock = answering(whole, kind)
    for module in ("policy", "model_call"):
        monkeypatch.setattr(f"turbopi.policy.{module}.time", SimpleNamespace(perf_counter=clock))
    pipeline = policy.pipeline
    monkeypatch.setattr(pipeline, "see", clock.passes(0.5, pipeline.see))
    monkeypatch.setattr(pipeline, "after_all", clock.passes(0.25, pipeline.after_all))

    class Lock:
        __enter__ = clock.passes(2.0)  # until others have had their turn

        def __exit__(self, *_: object) -> None: ...

    monkeypatch.setattr(policy._call, "lock", Lock())
    timing = CALLS[kind](policy, policy.example_observation())["policy_timing"]
    stages = {f"{stage}_ms": milliseconds for stage, milliseconds in STAGES.items()}
    expected = {"preprocess_ms": 500.0, "queue_ms": 2000.0, "infer_ms": 1000.0, "postprocess_ms": 250.0}
    assert timing == pytest.approx(expected | stages | {"total_ms": sum(expected.values())})


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("kind", CALLS)
def test_actions_that_arent_finite_reach_nobody(whole: UnifiedPolicy, kind: str, value: float) -> None:
    """Also in a column that the robot doesn't have."""
    policy, backend, _ = answering(whole, kind)
    obs = policy.example_observation()
    assert np.isfinite(CALLS[kind](policy, obs)["actions"]).all()
    backend.actions = torch.zeros(1, H, D)
    backend.actions[0, 4, 20] = backend.actions[0, 6, 2] = value
    with pytest.raises(ActionError) as refused:
        CALLS[kind](policy, obs)
    message = str(refused.value)
    assert f"2 of {H * D} numbers" in message and f"the first one, {value}, in row 4, column 20" in message
    assert all(place in message for place in ("checkpoint", "calibration", "turbopi verify"))


def test_warmup_tells_of_such_actions_and_goes_on(whole: UnifiedPolicy, caplog: pytest.LogCaptureFixture) -> None:
    """Its observation is made up; `verify` reports them."""
    policy, backend, _ = answering(whole, "sample")
    backend.actions = torch.full((1, H, D), math.nan)
    assert policy.warmup() > 0
    assert f"{H * D} of {H * D} numbers aren't finite" in caplog.text


def test_an_action_error_in_a_batch_names_the_observation(whole: UnifiedPolicy) -> None:
    policy, backend, _ = answering(whole, "sample")
    backend.actions = torch.zeros(3, H, D)
    backend.actions[1, 0, 0] = math.nan
    with pytest.raises(ActionError, match=r"observation 1 of 3 \(from 0\): .* row 0, column 0"):
        policy.infer_batch([policy.example_observation()] * 3, seed=0)


@pytest.mark.parametrize("what", ["statistics", "outputs"])
def test_what_turns_finite_numbers_into_others_is_named(
    whole: UnifiedPolicy, what: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def spoil(actions: np.ndarray) -> np.ndarray:
        spoilt = np.array(actions, np.float64)
        spoilt[3, 1] = np.nan
        return spoilt

    if what == "statistics":
        monkeypatch.setattr(whole.pipeline.action_scale, "unnormalize", spoil)
    else:
        monkeypatch.setattr(
            whole.pipeline, "robot", SimpleNamespace(name="broken", delta_mask=None, outputs=lambda a: spoil(a)[:, :7])
        )
    with pytest.raises(ActionError) as refused:
        whole.pipeline.after(np.zeros((H, D), np.float32), np.zeros(D))
    message = str(refused.value)
    assert "row 3, column 1" in message and "though the model's numbers are finite" in message
    assert "statistics" in message and f"robot {whole.pipeline.robot.name}" in message


def test_numbers_that_grow_too_large_are_one_error_and_no_warning(
    whole: UnifiedPolicy, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(whole.pipeline.action_scale, "unnormalize", lambda x: x.astype(np.float32) * np.float32(1e38))
    actions = np.full((H, D), 100, np.float32)
    with pytest.raises(ActionError, match="70 of 70"):
        whole.pipeline.after(actions, np.zeros(D))
