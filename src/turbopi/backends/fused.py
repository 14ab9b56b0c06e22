"""Backend `fused`: the call of `cuda_graph` with kernels of our own where they beat PyTorch's.

Nothing is compiled by Inductor. From compute capability 9.0 on, the feed-forward products of the prefix and the whole
denoising loop are CUDA C++ kernels; a model, horizon or GPU that they don't cover takes the engine's operations one by
one, and `describe()` says so.
"""

import importlib.util
import shutil
from typing import TYPE_CHECKING, Any, ClassVar

import torch
from torch import Tensor

from turbopi.backends.base import LoadState
from turbopi.backends.cuda_graph import MAX_CAMERAS, CudaGraphBackend, _bucket
from turbopi.config import ModelConfig
from turbopi.engine.call import CallShape, Denoiser
from turbopi.engine.ops import Ops
from turbopi.model.reference import Precision

if TYPE_CHECKING:
    from turbopi.kernels.denoise import DenoiseKernel, PackedExpert


class FusedBackend(CudaGraphBackend):
    """As `cuda_graph`, in bfloat16 only; `describe()` says whose kernel runs where."""

    name: ClassVar[str] = "fused"
    precisions: ClassVar[tuple[Precision, ...]] = ("bf16",)

    def __init__(self, config: ModelConfig, load: LoadState, *, device: torch.device, precision: Precision) -> None:
        self._packed_expert: PackedExpert | None = None
        self._denoisers: dict[tuple[int, int, int], DenoiseKernel] = {}  # by steps, horizon, cache rows
        self._denoised_by_operations: dict[str, str] = {}  # which calls, and why
        super().__init__(config, load, device=device, precision=precision)

    @classmethod
    def unavailable(cls, device: torch.device) -> str | None:
        reason = super().unavailable(device)
        if reason is not None:
            return reason
        if importlib.util.find_spec("triton") is None:
            return "its kernels are written in Triton, which isn't installed; `pip install triton`"
        if shutil.which("gcc") is None and shutil.which("clang") is None:
            return "Triton needs a C compiler for its launcher; install gcc"
        if importlib.util.find_spec("cuda") is None or importlib.util.find_spec("cuda.bindings") is None:
            return (
                "its CUDA kernels are compiled through cuda.bindings, which isn't installed; `pip install cuda-python`"
            )
        return None

    def describe(self) -> dict[str, Any]:
        described = super().describe()
        kernels = [f"H={horizon}, {steps} steps" for steps, horizon, _ in sorted(self._denoisers)]
        described["denoising"] = {"one persistent CUDA kernel": sorted(set(kernels))}
        described["denoising"] |= {f"operations, as {why}": call for call, why in self._denoised_by_operations.items()}
        return described

    def _make_ops(self) -> Ops:
        from turbopi.kernels.ops import fused_ops  # Triton isn't imported for other backends

        return fused_ops(self.device)

    def _make_denoiser(self, shape: CallShape, table: Tensor | None) -> Denoiser | None:
        from turbopi.kernels import denoise

        horizon, steps = shape.horizon, shape.num_steps
        reason = denoise.unavailable(self.device) or denoise.refusal(self.config)
        if reason is None and horizon > denoise.MAX_SUFFIX:
            reason = f"the denoising kernel takes up to {denoise.MAX_SUFFIX} actions"
        if reason is not None or table is None:
            self._denoised_by_operations[f"H={horizon}, {steps} steps"] = reason or "there is no modulation"
            return None
        if self._packed_expert is None:
            self._packed_expert = denoise.PackedExpert.pack(self.config, self._weights.expert)
        longest = _bucket(self.config.max_prompt_tokens)
        cameras = min(max(shape.cameras, 3), MAX_CAMERAS)
        key = (steps, horizon, cameras * self.config.vision.num_tokens + longest)
        if key not in self._denoisers:
            self._denoisers[key] = denoise.DenoiseKernel(
                self.config,
                self._packed_expert,
                self._weights.small,
                table,
                cache_rows=key[2],
                suffix=horizon,
                device=self.device,
            )
        return self._denoisers[key]
