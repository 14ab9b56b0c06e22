"""Backend `pytorch_compile`: the reference with its three stages through torch.compile.

The prefix length is a symbol in the compiled code, so prompts of other lengths compile nothing anew. Another number of
cameras, another batch size, images of other numbers or a mask (batches with unequal prompts) do, once each.
"""

import importlib.util
import os
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor

from turbopi.backends.base import Backend, LoadState, Sample
from turbopi.backends.pytorch import PyTorchBackend
from turbopi.config import ModelConfig
from turbopi.engine.plan import cold_call
from turbopi.models.observation import Observation
from turbopi.models.pi0.conditioning import Conditionings, Form
from turbopi.models.pi0.reference import Pi0Model
from turbopi.support.errors import BackendError, BackendUnavailable, ObservationError
from turbopi.support.toolchain import make_caches_writable, missing_for_c, missing_for_cpp

# Variants of a stage that are compiled, of one model and of all models of a process. PyTorch's own limits are 8 and
# 256, beyond which it runs the stage without compiling it
MOST_VARIANTS, MOST_OF_ALL = 64, 1024
# Of PyTorch's compiler. A view of a tensor whose strides it pads may read it in another order than it was written in.
# Numbers are then wrong, in silence (2.11; 2.13 by its source; github.com/pytorch/pytorch/pull/192575). So it pads none
INDUCTOR: dict[str, Any] = {"comprehensive_padding": False}
SWITCHES = ("TORCH_COMPILE_DISABLE", "TORCHDYNAMO_DISABLE")  # 1: torch.compile does nothing


def compiled(stage: Callable[..., Any], **options: Any) -> Callable[..., Any]:
    """`stage`, compiled on first use for each variant of its arguments. It never runs without being compiled: the call
    then raises BackendError. The compiler, whose import takes seconds, is imported by the first use, too.
    """
    made: list[Callable[..., Any]] = []

    def call(*args: Any) -> Any:
        if not made:
            made.append(torch.compile(stage, fullgraph=True, options=INDUCTOR, **options))
        limits = {"recompile_limit": MOST_VARIANTS, "accumulated_recompile_limit": MOST_OF_ALL}
        with torch._dynamo.config.patch(limits):
            try:
                return made[0](*args)
            except torch._dynamo.exc.FailOnRecompileLimitHit as e:
                raise BackendError(
                    f"backend 'pytorch_compile' has compiled {stage.__name__} for {MOST_VARIANTS} batch sizes, cameras "
                    "and horizons, the most that it keeps, and this call needs another one: keep to fewer, or use "
                    "backend 'pytorch'"
                ) from e

    return call


class CompiledModel(Pi0Model):
    """Pi0Model whose stages are compiled on first use."""

    def __init__(self, config: ModelConfig) -> None:
        super().__init__(config)
        self._embed_images = compiled(super().embed_images, dynamic=False)
        self._encode_prefix = compiled(super().encode_prefix)
        self._velocity = compiled(super().velocity)

    def embed_images(self, images: Tensor) -> tuple[Tensor, Tensor]:
        return self._embed_images(images)

    def encode_prefix(self, embs: Tensor, positions: Tensor, mask: Tensor | None) -> tuple[Tensor, Tensor]:
        embs = embs.contiguous()
        positions = positions.contiguous()
        torch._dynamo.mark_dynamic(embs, 1)
        torch._dynamo.mark_dynamic(positions, 1)
        if mask is not None:
            torch._dynamo.mark_dynamic(mask, 3)
        return self._encode_prefix(embs, positions, mask)

    def velocity(self, x_t: Tensor, state: Tensor, time: Tensor, cache_k: Tensor, cache_v: Tensor, *rest: Any) -> Any:
        rope, mask = rest[:2]  # without `hidden`, which lives inside the compiled step: not recorded
        torch._dynamo.mark_dynamic(cache_k, 3)
        torch._dynamo.mark_dynamic(cache_v, 3)
        if mask is not None:
            torch._dynamo.mark_dynamic(mask, 3)
        return self._velocity(x_t, state, time, cache_k, cache_v, rope, mask)


@dataclass(frozen=True)
class Compiled:
    """What the compiled code depends on."""

    batch: int
    cameras: int  # that some row needs
    masked: bool  # whether the rows' valid slots differ
    horizon: int
    pixels: torch.dtype  # uint8 or float32

    @classmethod
    def of(cls, observation: Observation, horizon: int) -> "Compiled":
        cameras, tokens = observation.image_mask, observation.token_mask
        masked = bool((cameras != cameras[:1]).any()) or bool((tokens != tokens[:1]).any())
        return cls(observation.batch_size, int(cameras.any(0).sum()), masked, horizon, pixels=observation.images.dtype)

    def __str__(self) -> str:
        rows = "" if self.batch == 1 else f"batch {self.batch}{' of unequal lengths' if self.masked else ''}, "
        pixels = " of float32 pixels" if self.pixels == torch.float32 else ""
        return f"{rows}{self.cameras} cameras{pixels}, H={self.horizon}"


class PyTorchCompileBackend(PyTorchBackend):
    """The first calls compile, for a minute or so at full size: `UnifiedPolicy.warmup()` before the robot moves.

    What is compiled is kept by PyTorch, up to MOST_VARIANTS of each stage; it doesn't depend on the number of steps.
    """

    name: ClassVar[str] = "pytorch_compile"
    forms: ClassVar[tuple[Form, ...]] = ()  # each would be compiled anew, for a minute
    writes: ClassVar[bool] = False
    model_class: ClassVar[type[Pi0Model]] = CompiledModel

    def load_weights(self, load: LoadState) -> None:
        if torch._dynamo.config.disable:
            raise BackendUnavailable("torch.compile is switched off by torch._dynamo.config.disable")
        make_caches_writable()
        super().load_weights(load)
        self._compiled: set[Compiled] = set()
        self._warming = False

    def warmup(self, *arguments: Any, **options: Any) -> None:
        """One call with as many cameras, which compiles for them."""
        self._warming = True
        try:
            Backend.warmup(self, *arguments, **options)
        finally:
            self._warming = False

    def sample(
        self, observation: Observation, noise: Tensor, num_steps: int, *, conditioning: Conditionings = None
    ) -> Sample:
        self.check_conditioning(conditioning)
        shape = Compiled.of(observation, noise.shape[1])
        if self.strict and not self._warming and shape not in self._compiled:
            warm = map(str, self._compiled)
            if shape.batch > 1:
                raise ObservationError(
                    f"strict: this call needs {shape}, which backend {self.name!r} would have to compile within the "
                    "call, and warm-up covers one observation at a time: ask for them one by one"
                )
            raise cold_call(self.name, str(shape), warm, cameras=shape.cameras, horizons=shape.horizon)
        sample = super().sample(observation, noise, num_steps)
        self._compiled.add(shape)
        return sample

    @classmethod
    def unavailable(cls, device: torch.device) -> str | None:
        if any(os.environ.get(variable) == "1" for variable in SWITCHES):
            return f"torch.compile is switched off; unset {' and '.join(SWITCHES)}"
        if device.type == "cpu" and (missing := missing_for_cpp()) is not None:
            return f"torch.compile can't build its code here: {missing}"
        if device.type == "cuda":
            if importlib.util.find_spec("triton") is None:
                return "torch.compile needs Triton on a GPU; `pip install triton`"
            if (missing := missing_for_c()) is not None:
                return f"Triton can't build its launcher here: {missing}"
        return None

    def describe(self) -> dict[str, Any]:
        return super().describe() | {
            "compiled": ["vision", "prefix", "denoising step"],
            "compiled_for": sorted(map(str, list(self._compiled))),
        }
