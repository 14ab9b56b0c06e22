"""Engines that are their networks' PyTorch twins: what lets everything around TensorRT run on any CPU."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
from conftest import golden_folder
from torch import Tensor

from turbopi.backends import Precision
from turbopi.backends.base import LoadState
from turbopi.backends.tensorrt.backend import TensorRTBackend
from turbopi.backends.tensorrt.cache import EngineCache, Environment
from turbopi.backends.tensorrt.engine import Specification
from turbopi.backends.tensorrt.engines import ModelEngines
from turbopi.backends.tensorrt.ops import TORCH_DTYPES, TorchOps
from turbopi.config import PiKind
from turbopi.engine.weights import Weights
from turbopi.support.errors import BackendError

ENVIRONMENT = Environment("w" * 16, "tensorrt_rtx", "1.0", "A GPU", "9.0", "0.1.0", "code")


class Reference:
    """An engine's interface around its network in PyTorch."""

    def __init__(self, specification: Specification) -> None:
        self.calls = 0
        self._specification = specification

    def run(self, **tensors: Tensor) -> None:
        inputs = {name: tensors[name] for name in self._specification.inputs}
        for name, one in self._specification.inputs.items():
            if tuple(inputs[name].shape) != one.shape or inputs[name].dtype != TORCH_DTYPES[one.dtype]:
                raise BackendError(f"{name} is {inputs[name].dtype} {list(inputs[name].shape)}, not {one}")
        outputs: Mapping[str, Tensor] = self._specification.write(TorchOps(), inputs)  # type: ignore[arg-type]
        assert tensors.keys() == {*inputs, *outputs}
        for name, value in outputs.items():
            assert tensors[name].shape == value.shape and tensors[name].dtype == value.dtype, name
            tensors[name].copy_(value)
        self.calls += 1


class FakeGraph:
    """A CUDA graph's interface around a function that runs anew in every replay."""

    def __init__(self, run: Callable[[Any], None]) -> None:
        self._run, self._marks = run, list[str]()
        run(lambda stage: None)  # as a capture does

    def replay(self) -> None:
        self._marks.clear()
        self._run(self._marks.append)

    def stage_ms(self) -> dict[str, float]:
        return dict.fromkeys(self._marks, 1.0)


def reference_engines(
    backend: TensorRTBackend, weights: Weights, folder: Path, built: list[str], **options: Any
) -> ModelEngines:
    def build(specification: Specification) -> bytes:
        built.append(specification.name)
        return specification.name.encode()

    def load(specification: Specification, plan: bytes) -> Reference:
        assert plan == specification.name.encode()
        return Reference(specification)

    class Engines(ModelEngines):
        def release(self) -> None:
            """Twins read the weights when they run."""

    cache = EngineCache(folder, ENVIRONMENT)
    return Engines(backend.config, weights, cache, build=build, load=load, **options)


def on_references(cls: type[TensorRTBackend], folder: Path, *, half: bool = False) -> type[TensorRTBackend]:
    """A backend class on the CPU; float32 throughout unless `half`."""

    class OnReferences(cls):  # type: ignore[misc, valid-type]
        built: list[str]

        def _make_engines(self, weights: Weights) -> ModelEngines:
            self.built = []
            dtype = "f16" if half else "f32"
            return reference_engines(self, weights, folder, self.built, vision_dtype=dtype, scales=self._scales())

        def _capture(self, run: Any, part: str) -> Any:
            return FakeGraph(run)

        def _vision_dtype(self) -> torch.dtype:
            return torch.float16 if half else torch.float32

        def _launch(self, encode: Any, denoise: Any) -> Callable[[], None]:
            encode.replay()
            return denoise.replay

    return OnReferences


def golden_load(kind: PiKind) -> LoadState:
    checkpoint = golden_folder().checkpoint(kind)
    return lambda device, precision: checkpoint.load(device, precision).state


def golden_backend(cls: type[TensorRTBackend], kind: PiKind, folder: Path, *, half: bool = False) -> Any:
    config = golden_folder().checkpoint(kind).config.planned_model
    precision: Precision = "bf16" if half else "f32"
    backend = on_references(cls, folder, half=half)
    return backend(config, golden_load(kind), device=torch.device("cpu"), precision=precision)
