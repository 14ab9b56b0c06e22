"""Backend `fused`: the call of `cuda_graph` with kernels of our own where they beat PyTorch's.

Nothing is compiled by Inductor. From compute capability 9.0 on, the feed-forward products of the prefix and the whole
denoising loop are CUDA C++ kernels; a model, horizon or GPU that they don't cover takes the engine's operations one by
one, and `describe()` says so.
"""

import importlib.util
import inspect
import shutil
from typing import TYPE_CHECKING, Any, ClassVar

import torch
from torch import Tensor

from turbopi.backends.base import LoadState, Tier
from turbopi.backends.cuda_graph import MAX_CAMERAS, CudaGraphBackend, _bucket
from turbopi.calibrate.artifact import TIERS, Quantization
from turbopi.config import ModelConfig
from turbopi.engine.call import CallShape, Denoiser
from turbopi.engine.fp8 import Fp8Matrix, Matrix
from turbopi.engine.ops import Ops
from turbopi.engine.weights import Weights, pack
from turbopi.errors import BackendUnavailable, ConfigError

if TYPE_CHECKING:
    from turbopi.kernels import denoise_cluster
    from turbopi.kernels.denoise import PackedExpert

# Up to how many actions the denoising kernel of clusters is chosen. For ten steps of 10 actions it needs 3.9 ms on an
# H200, the other one 5.8 ms. But `pytest -m gpu tests/test_kernels_denoise_cluster.py` hasn't run on its last form:
# 24 once it has, and more when it is timed at more.
CLUSTERS_UP_TO = 0


class FusedBackend(CudaGraphBackend):
    """As `cuda_graph`, in bfloat16 or, as a calibration says, partly in FP8; `describe()` says what runs where."""

    name: ClassVar[str] = "fused"
    precisions: ClassVar[tuple[Tier, ...]] = ("bf16", *TIERS)

    def __init__(
        self,
        config: ModelConfig,
        load: LoadState,
        *,
        device: torch.device,
        precision: Tier,
        quantization: Quantization | None = None,
    ) -> None:
        if (precision in TIERS) != (quantization is not None):
            raise ConfigError(
                f"precision {precision!r} {'needs' if precision in TIERS else 'takes no'} FP8 calibration; "
                "make one with `turbopi calibrate` and give it as `quantization`"
            )
        self._quantization = quantization
        self._plan = None if quantization is None else quantization.plan(config, precision)
        self._packed_expert: PackedExpert | None = None
        self._cluster_expert: denoise_cluster.PackedExpert | None = None
        self._clusters_refused: str | None = None
        self._denoisers: dict[tuple[int, int, int], Denoiser] = {}  # by steps, horizon, cache rows
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

    @classmethod
    def unavailable_in(cls, device: torch.device, precision: Tier) -> str | None:
        """Why this precision, besides the backend, can't run on a GPU that the backend runs on; or None."""
        if precision not in TIERS:
            return None
        major, minor = torch.cuda.get_device_capability(device)
        if (major, minor) == (9, 0):
            return None
        if (major, minor) < (8, 9):
            return f"its tensor cores have no FP8: that begins with 8.9, this GPU has {major}.{minor}; use 'bf16'"
        return f"its FP8 products are written for compute capability 9.0, this GPU has {major}.{minor}; use 'bf16'"

    def describe(self) -> dict[str, Any]:
        described = super().describe()
        if self._plan is not None and self._quantization is not None:
            described["fp8"] = {
                "plan": self._plan.describe() | {"expert": self._expert_precision()},
                "calibration": self._quantization.source or "in memory",
                "observations": self._quantization.report["observations"]["source"],
                "warnings": self._quantization.warnings,
            }
        described["denoising"] = {
            name: sorted(
                {f"H={horizon}, {steps} steps" for (steps, horizon, _), k in self._denoisers.items() if test(k)}
            )
            for name, test in (
                ("one persistent CUDA kernel", lambda k: not _of_clusters(k)),
                ("one CUDA kernel of clusters", _of_clusters),
            )
        }
        if self._clusters_refused is not None:
            described["denoising"]["no clusters, as"] = self._clusters_refused
        described["denoising"] |= {f"operations, as {why}": call for call, why in self._denoised_by_operations.items()}
        return described

    def _pack(self, load: LoadState) -> Weights:
        scales = {} if self._plan is None else self._plan.scales

        def make(place: str, matrix: Tensor) -> Matrix:
            return Fp8Matrix.quantize(matrix, scales[place]) if place in scales else matrix

        return pack(self.config, load(self.device, "bf16"), make)

    def _expert_options(self) -> dict[str, str]:
        """What `PackedExpert.pack` is told besides the layers: FP8 weights, if they are planned and it has them."""
        from turbopi.kernels.denoise import PackedExpert

        offered = "weights" in inspect.signature(PackedExpert.pack).parameters
        wanted = self._plan is not None and self._plan.expert_weights == "fp8"
        return {"weights": "fp8"} if offered and wanted else {}

    def _expert_precision(self) -> str:
        """What the expert's weights are in, openly."""
        if self._plan is None or self._plan.expert_weights == "bf16":
            return "bf16, all of it: its kernel takes one precision"
        if not self._expert_options():
            return "bf16: the denoising kernel has no FP8 weights"
        if self._denoised_by_operations:
            return "fp8 weights in the denoising kernel; bf16 where operations denoise"
        return "fp8 weights"

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
        longest = _bucket(self.config.max_prompt_tokens)
        cameras = min(max(shape.cameras, 3), MAX_CAMERAS)
        key = (steps, horizon, cameras * self.config.vision.num_tokens + longest)
        if key not in self._denoisers:
            self._denoisers[key] = self._cluster_kernel(*key, table) or self._persistent_kernel(*key, table)
        return self._denoisers[key]

    def _persistent_kernel(self, steps: int, horizon: int, rows: int, table: Tensor) -> Denoiser:
        from turbopi.kernels.denoise import DenoiseKernel, PackedExpert

        if self._packed_expert is None:
            self._packed_expert = PackedExpert.pack(self.config, self._weights.expert, **self._expert_options())
        small = self._weights.small
        return DenoiseKernel(
            self.config, self._packed_expert, small, table, cache_rows=rows, suffix=horizon, device=self.device
        )

    def _cluster_kernel(self, steps: int, horizon: int, rows: int, table: Tensor) -> Denoiser | None:
        """The kernel of clusters, where it is the faster one and this GPU holds its clusters at once."""
        from turbopi.kernels.denoise_cluster import DenoiseKernel, PackedExpert, refusal

        if horizon > CLUSTERS_UP_TO or self._clusters_refused is not None:
            return None
        self._clusters_refused = refusal(self.config)
        if self._clusters_refused is not None:
            return None
        if self._cluster_expert is None:
            self._cluster_expert = PackedExpert.pack(self.config, self._weights.expert)
        small = self._weights.small
        try:
            return DenoiseKernel(
                self.config, self._cluster_expert, small, table, cache_rows=rows, suffix=horizon, device=self.device
            )
        except BackendUnavailable as e:
            self._clusters_refused, self._cluster_expert = str(e), None
            return None


def _of_clusters(kernel: Denoiser) -> bool:
    return type(kernel).__module__.endswith("denoise_cluster")
