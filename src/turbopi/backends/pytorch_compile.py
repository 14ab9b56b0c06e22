"""Backend `pytorch_compile`: the reference with its three stages through torch.compile.

The prefix length is a symbol in the compiled code, so prompts of other lengths compile nothing anew. Another number of
cameras, another batch size or a mask (batches with unequal prompts) do, once each.
"""

import importlib.util
import shutil
from typing import Any, ClassVar

import torch
from torch import Tensor

from turbopi.backends.pytorch import PyTorchBackend
from turbopi.config import ModelConfig
from turbopi.model.reference import Pi0Model


class CompiledModel(Pi0Model):
    """Pi0Model whose stages are compiled on first use."""

    def __init__(self, config: ModelConfig) -> None:
        super().__init__(config)
        self._embed_images = torch.compile(super().embed_images, dynamic=False)
        self._encode_prefix = torch.compile(super().encode_prefix)
        self._velocity = torch.compile(super().velocity)

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


class PyTorchCompileBackend(PyTorchBackend):
    """The first calls compile, for a minute or so at full size: `UnifiedPolicy.warmup()` before the robot moves."""

    name: ClassVar[str] = "pytorch_compile"
    model_class: ClassVar[type[Pi0Model]] = CompiledModel

    @classmethod
    def unavailable(cls, device: torch.device) -> str | None:
        if device.type == "cpu" and shutil.which("g++") is None and shutil.which("clang++") is None:
            return "torch.compile needs a C++ compiler on a CPU; install g++"
        if device.type == "cuda":
            if importlib.util.find_spec("triton") is None:
                return "torch.compile needs Triton on a GPU; `pip install triton`"
            if shutil.which("gcc") is None and shutil.which("clang") is None:
                return "Triton needs a C compiler for its launcher; install gcc"
        return None

    def describe(self) -> dict[str, Any]:
        return super().describe() | {"compiled": ["vision", "prefix", "denoising step"]}
