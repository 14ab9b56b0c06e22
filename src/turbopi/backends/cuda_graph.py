"""Backend `cuda_graph`: a call is a `Graph` for images and one for all the rest, with stock PyTorch.

Which graphs there are: engine/plan.py; capture and replay: engine/runner.py; of batches: engine/batch_runner.py.
"""

import dataclasses
from functools import partial
from typing import Any, ClassVar

import torch
from torch import Tensor

from turbopi.backends.base import Backend, LoadState, Precision
from turbopi.backends.pytorch_compile import PyTorchCompileBackend
from turbopi.config import ModelConfig
from turbopi.engine import without_compiler
from turbopi.engine.batch_runner import BatchRunner
from turbopi.engine.call import CallShape
from turbopi.engine.compiled import compiled
from turbopi.engine.loops import Loop, Table
from turbopi.engine.weight_placement import WeightPlacement, is_conditioning
from turbopi.engine.weights import Weights, pack
from turbopi.kernels.interface import Denoiser, Ops
from turbopi.support.errors import BackendError
from turbopi.support.toolchain import make_caches_writable


class CudaGraphBackend(BatchRunner, Backend):
    """The engine's forward pass with PyTorch's kernels, those between products fused by Inductor if it is there."""

    name: ClassVar[str] = "cuda_graph"
    precisions: ClassVar[tuple[Precision, ...]] = ("bf16", "f32")
    begins: ClassVar[bool] = True
    runs_batches: ClassVar[bool] = True

    def __init__(self, config: ModelConfig, load: LoadState, **options: Any) -> None:
        Backend.__init__(self, config, load, **options)

    def load_weights(self, load: LoadState) -> None:
        if (heads := self.config.vlm.num_kv_heads) != 1:
            raise BackendError(f"{self.name} needs one key/value head, this model has {heads}")
        make_caches_writable()
        weights, ops = self._pack(load), self._make_ops()
        BatchRunner.__init__(self, self.config, weights, ops, self.device, joint=ops is without_compiler.OPS)
        self._loops: dict[Table, without_compiler.Denoiser] = {}  # by `Loop.table`

    @classmethod
    def unavailable(cls, device: torch.device) -> str | None:
        if device.type != "cuda":
            return "CUDA graphs need an NVIDIA GPU; use backend 'pytorch'"
        major, minor = torch.cuda.get_device_capability(device)
        if major < 8:
            return f"it needs compute capability 8.0 or newer for bfloat16, this GPU has {major}.{minor}"
        return None

    def _pack(self, load: LoadState) -> Weights:
        placement = WeightPlacement(self.config, self.device, partial(is_conditioning, self.config))
        return pack(self.config, load(placement, "f32" if self.precision == "f32" else "bf16"))

    def _make_ops(self) -> Ops:
        if PyTorchCompileBackend.unavailable(self.device) is not None:
            return without_compiler.OPS
        ops = compiled()
        if self.precision == "f32":  # the kernels' tiles of float32 don't fit shared memory at full size
            return dataclasses.replace(ops, batch=None)
        return ops

    def _make_denoiser(self, shape: CallShape, table: Tensor | None) -> Denoiser | None:
        """None: the engine's operations one by one."""
        if self._ops is not without_compiler.OPS or table is None or shape.loop.form != "plain":
            return None
        key = shape.loop.table
        if key not in self._loops:
            self._loops[key] = without_compiler.Denoiser.prepare(self.config, self._weights, table)
        return dataclasses.replace(self._loops[key], slots=shape.prefix_slots(self.config))

    def _forget(self, loop: Loop) -> None:
        super()._forget(loop)
        if loop.table not in {other.table for other in self._graphs.loops if other.form == "plain"}:
            self._loops.pop(loop.table, None)
