"""Backend `pytorch`: the reference itself, eager, on any device."""

from typing import Any, ClassVar

import torch
from torch import Tensor

from turbopi.backends.base import Backend, LoadState, Precision, Sample
from turbopi.backends.timing import StageTimer
from turbopi.config import ModelConfig
from turbopi.models.observation import Observation
from turbopi.models.pi0.conditioning import Conditioning, Conditionings, Form
from turbopi.models.pi0.kv_cache import KVCache
from turbopi.models.pi0.reference import FloatPrecision, Pi0Model, Trace
from turbopi.support.errors import BackendError


class PyTorchBackend:
    """Runs `Pi0Model`; a batch of one is compacted exactly, larger ones as far as their masks allow."""

    name: ClassVar[str] = "pytorch"
    precisions: ClassVar[tuple[Precision, ...]] = ("bf16", "f32")
    any_horizon: ClassVar[bool] = True
    forms: ClassVar[tuple[Form, ...]] = ("solver", "tokens", "jacobian")
    model_class: ClassVar[type[Pi0Model]] = Pi0Model
    strict = False  # nothing here depends on shapes

    def __init__(
        self, config: ModelConfig, load: LoadState, *, device: torch.device, precision: FloatPrecision
    ) -> None:
        self.config = config
        self.device = device
        self.precision: Precision = precision
        self._warm = False
        self.model = self.model_class.from_state(config, load(device, precision))

    @classmethod
    def unavailable(cls, device: torch.device) -> str | None:
        return None

    def warmup(
        self,
        observation: Observation,
        num_steps: int,
        horizon: int | None = None,
        *,
        required: bool = True,
        last: bool = True,
        conditioning: Conditioning | None = None,
    ) -> None:
        """One call: it loads libraries and fills allocators; other shapes need nothing more."""
        if not self._warm:
            self._one_call(observation, num_steps, horizon)
        self._warm = True

    def _one_call(self, observation: Observation, num_steps: int, horizon: int | None) -> None:
        actions = self.config.action_horizon if horizon is None else horizon
        self.sample(observation, torch.zeros(observation.batch_size, actions, self.config.action_dim), num_steps)

    def prefix(self, observation: Observation) -> KVCache:
        return self.model.prefix(observation.to(self.device))

    def denoise(self, cache: KVCache, noise: Tensor, num_steps: int, *, conditioning: Conditionings = None) -> Tensor:
        return self.model.denoise(cache, noise.to(self.device), num_steps, conditioning=conditioning)

    def sample(
        self, observation: Observation, noise: Tensor, num_steps: int, *, conditioning: Conditionings = None
    ) -> Sample:
        timer = StageTimer(self.device)
        embedded = self.model.embed(observation.to(self.device))
        timer.mark("vision")  # with the prompt's embedding lookup
        cache = self.model.keys_values(embedded)
        timer.mark("prefix")
        actions = self.model.denoise(cache, noise.to(self.device), num_steps, conditioning=conditioning)
        timer.mark("denoise")
        return Sample(actions.cpu(), timer.milliseconds())

    def intermediates(
        self, observation: Observation, noise: Tensor, num_steps: int, *, conditioning: Conditionings = None
    ) -> Trace:
        trace: Trace = {}
        on_device = (observation.to(self.device), noise.to(self.device))
        self.model.sample(*on_device, num_steps, conditioning=conditioning, trace=trace)
        return trace

    def describe(self) -> dict[str, Any]:
        return {"attention": "explicit float32" if self.precision == "f32" else "scaled_dot_product_attention"}


def reference_model(backend: Backend) -> Pi0Model:
    """The reference that a backend runs. Raises BackendError for one that runs something else."""
    if not isinstance(backend, PyTorchBackend):
        raise BackendError(f"backend {backend.name!r} doesn't run the reference; take 'pytorch'")
    return backend.model
