"""Backend `pytorch`: the reference itself, eager, on any device."""

from typing import Any, ClassVar

from torch import Tensor

from turbopi.backends.base import Backend, LoadState, Precision, Sample, StageTimer
from turbopi.config import FloatPrecision, Network, TextConfig
from turbopi.models import family_of
from turbopi.models.observation import Observation
from turbopi.models.pi0.conditioning import Conditionings, Form, has_two_prompts
from turbopi.models.pi0.kv_cache import KVCache
from turbopi.models.pi0.reference import Pi0Model, Trace
from turbopi.models.pi0.text import TextWriter
from turbopi.quantization.plan import WEIGHTS_ALONE
from turbopi.support.errors import BackendError


class PyTorchBackend(Backend):
    """Runs the reference of the model's family; a batch of one is compacted exactly, larger ones as far as their masks
    allow.

    model_class  in place of the family's own: a variant of Pi0's, which then is all that it runs
    """

    name: ClassVar[str] = "pytorch"
    precisions: ClassVar[tuple[Precision, ...]] = ("bf16", "f32")
    forms: ClassVar[tuple[Form, ...]] = ("solver", "tokens", "jacobian", "noise", "two_prompts", "two_prompts_jacobian")
    writes: ClassVar[bool] = True
    model_class: ClassVar[type[Pi0Model] | None] = None
    _warm = False
    model: Any  # of the family

    def load_weights(self, load: LoadState) -> None:
        exact = self.precision not in ("bf16", WEIGHTS_ALONE)  # what is emulated is float32, too
        precision: FloatPrecision = "f32" if exact else "bf16"
        model_class = self.model_class or family_of(self.config).reference
        self.model = model_class.from_state(self.config, load(self.device, precision))

    def prepare_text(self, text: TextConfig, head: Tensor | None) -> None:
        self.writer = TextWriter(self.model, text, head)

    @classmethod
    def refuses_model(cls, config: Network) -> str | None:
        return None if cls.model_class is None else super().refuses_model(config)

    def warmup(self, *arguments: Any, **options: Any) -> None:
        """One call: it loads libraries and fills allocators; other shapes need nothing more."""
        if not self._warm:
            super().warmup(*arguments, **options)
        self._warm = True

    def prefix(self, observation: Observation) -> KVCache:
        return self.model.prefix(observation.to(self.device))

    def denoise(self, cache: KVCache, noise: Tensor, num_steps: int, *, conditioning: Conditionings = None) -> Tensor:
        return self.model.denoise(cache, noise.to(self.device), num_steps, conditioning=conditioning)

    def sample(
        self, observation: Observation, noise: Tensor, num_steps: int, *, conditioning: Conditionings = None
    ) -> Sample:
        timer = StageTimer(self.device)
        two = {"conditioning": conditioning} if has_two_prompts(conditioning) else {}  # of Pi0's reference alone
        embedded = self.model.embed(observation.to(self.device), **two)
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


def reference_model(backend: Backend) -> Any:
    """The reference that a backend runs. Raises BackendError for one that runs something else."""
    if not isinstance(backend, PyTorchBackend) or backend.begins:
        raise BackendError(f"backend {backend.name!r} doesn't run the reference; take 'pytorch'")
    return backend.model
