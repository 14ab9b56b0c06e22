"""Backends with one fault each, for the certificate to find. Registered by tests/test_verify.py under "faulty"."""

import dataclasses
from typing import Any, ClassVar

import torch
from torch import Tensor

from turbopi.backends import Sample
from turbopi.backends.pytorch import PyTorchBackend
from turbopi.models.observation import Observation
from turbopi.models.pi0.kv_cache import KVCache
from turbopi.models.pi0.reference import Pi0Model, Trace

FAULTY_LAYER = 1
FAULTY_STEP = 1


class Correct(PyTorchBackend):
    """pytorch under another name, with the least that the protocol demands of a trace."""

    name: ClassVar[str] = "faulty"

    def intermediates(self, observation: Observation, noise: Tensor, num_steps: int, **options: Any) -> Trace:
        trace = super().intermediates(observation, noise, num_steps, **options)
        return {name: trace[name] for name in ("kv_k", "kv_v", "x_t", "v_t", "actions")}


class _WrongKeys(Pi0Model):
    def encode_prefix(self, *args: Any) -> tuple[Tensor, Tensor]:
        k, v = super().encode_prefix(*args)
        k[FAULTY_LAYER] = -k[FAULTY_LAYER]
        return k, v


class WrongKeys(Correct):
    """Keys of one layer have the wrong sign."""

    model_class: ClassVar[type[Pi0Model]] = _WrongKeys


class _EarlySuffix(Pi0Model):
    def denoise(self, cache: KVCache, noise: Tensor, num_steps: int, **options: Any) -> Tensor:
        early = dataclasses.replace(cache, lengths=cache.lengths - 1)
        return super().denoise(early, noise, num_steps, **options)


class EarlySuffix(Correct):
    """The suffix's positions begin one too early."""

    model_class: ClassVar[type[Pi0Model]] = _EarlySuffix


class WrongTrace(Correct):
    """What it shows of one layer's keys is wrong, and what it does with them right."""

    def intermediates(self, observation: Observation, noise: Tensor, num_steps: int, **options: Any) -> Trace:
        trace = super().intermediates(observation, noise, num_steps, **options)
        trace["kv_k"][FAULTY_LAYER] *= 2
        return trace


class NotFinite(Correct):
    """A velocity isn't finite."""

    def intermediates(self, observation: Observation, noise: Tensor, num_steps: int, **options: Any) -> Trace:
        trace = super().intermediates(observation, noise, num_steps, **options)
        trace["v_t"][FAULTY_STEP, 0, 3, 4] = float("nan")
        trace["x_t"][FAULTY_STEP + 1, 0, 3, 4] = float("nan")
        return trace

    def sample(self, observation: Observation, noise: Tensor, num_steps: int, **options: Any) -> Sample:
        actions = super().sample(observation, noise, num_steps, **options).actions
        actions[0, 3, 4] = float("nan")
        return Sample(actions)


class Unsteady(Correct):
    """Its last bits change from call to call."""

    def sample(self, observation: Observation, noise: Tensor, num_steps: int, **options: Any) -> Sample:
        actions = super().sample(observation, noise, num_steps, **options).actions
        return Sample(actions + 1e-6 * torch.rand_like(actions))


class FastPathDiffers(Correct):
    """What a policy calls isn't what is shown when the backend is judged."""

    def sample(self, observation: Observation, noise: Tensor, num_steps: int, **options: Any) -> Sample:
        return Sample(super().sample(observation, noise, num_steps, **options).actions * 1.1)


class Secretive(Correct):
    """It doesn't show what the protocol demands."""

    def intermediates(self, observation: Observation, noise: Tensor, num_steps: int, **options: Any) -> Trace:
        trace = super().intermediates(observation, noise, num_steps, **options)
        del trace["v_t"]
        return trace
