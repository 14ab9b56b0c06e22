"""`UnifiedPolicy.submit`: futures from a pipelined backend, and no pretence from the others."""

from concurrent.futures import Future
from typing import Any

import numpy as np
import pytest
from policy_helpers import policy_on
from torch import Tensor

from turbopi import UnifiedPolicy
from turbopi.backends import Sample
from turbopi.checkpoint import random_checkpoint
from turbopi.models.observation import Observation
from turbopi.support.errors import ConfigError, ObservationError

pytestmark = pytest.mark.usefixtures("two_layers")


@pytest.fixture(scope="module")
def policy() -> UnifiedPolicy:
    return UnifiedPolicy(random_checkpoint("pi05_tiny"), backend="pytorch", device="cpu", num_denoising_steps=2)


class Submitting:
    """The policy's backend with a `submit` that answers when it is told to."""

    submits = True

    def __init__(self, backend: Any) -> None:
        self._backend = backend
        self.waiting: list[tuple[Future[Sample], Observation, Tensor, int]] = []

    def __getattr__(self, name: str) -> Any:
        return getattr(self._backend, name)

    def submit(self, observation: Observation, noise: Tensor, num_steps: int) -> "Future[Sample]":
        self.waiting.append((Future(), observation, noise, num_steps))
        return self.waiting[-1][0]

    def answer(self) -> None:
        future, *arguments = self.waiting.pop(0)
        future.set_result(self._backend.sample(*arguments))


def submitting(policy: UnifiedPolicy) -> tuple[UnifiedPolicy, Submitting]:
    backend = Submitting(policy.backend)
    return policy_on(lambda *_, **__: backend, random_checkpoint("pi05_tiny"), num_denoising_steps=2), backend


@pytest.mark.slow
def test_submitted_calls_give_what_infer_gives(policy: UnifiedPolicy) -> None:
    observations = [policy.example_observation(seed) for seed in range(3)]
    expected = [policy.infer(obs, seed=seed)["actions"] for seed, obs in enumerate(observations)]
    pipelined, backend = submitting(policy)
    futures = [pipelined.submit(obs, seed=seed) for seed, obs in enumerate(observations)]
    assert not any(future.done() for future in futures) and len(backend.waiting) == 3
    for _ in futures:
        backend.answer()
    for future, actions in zip(futures, expected, strict=True):
        result = future.result(timeout=120)
        assert np.array_equal(result["actions"], actions)
        assert {"infer_ms", "preprocess_ms", "denoise_ms", "total_ms"} <= result["policy_timing"].keys()


def test_a_backends_error_reaches_the_future(policy: UnifiedPolicy) -> None:
    pipelined, backend = submitting(policy)
    future = pipelined.submit(policy.example_observation(), seed=0)
    backend.waiting[0][0].set_exception(RuntimeError("device lost"))
    with pytest.raises(RuntimeError, match="device lost"):
        future.result(timeout=120)


def test_other_backends_say_so_or_run_at_once_if_asked(policy: UnifiedPolicy) -> None:
    obs = policy.example_observation()
    with pytest.raises(
        ConfigError, match=r"one observation at a time: submit\(…, serially=True\) runs it before submit returns$"
    ):
        policy.submit(obs, seed=0)
    future = policy.submit(obs, seed=0, serially=True)
    assert future.done() and np.array_equal(future.result()["actions"], policy.infer(obs, seed=0)["actions"])


def test_a_wrong_observation_is_refused_at_once(policy: UnifiedPolicy) -> None:
    pipelined, _ = submitting(policy)
    with pytest.raises(ObservationError):
        pipelined.submit({}, seed=0)
    with pytest.raises(ObservationError, match="noise and seed were both given"):
        pipelined.submit(policy.example_observation(), seed=0, noise=np.zeros((10, 32), np.float32))
