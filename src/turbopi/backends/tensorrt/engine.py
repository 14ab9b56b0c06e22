"""Building engines and running them on torch's tensors.

An engine's inputs and outputs are bound by name and checked against its shapes and dtypes in every call: a shape that
the engine wasn't built for is an error, never another code path.
"""

import hashlib
import logging
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from turbopi.backends.tensorrt import Library
from turbopi.backends.tensorrt.ops import Dtype, TensorRTOps, Value
from turbopi.support.errors import BackendError
from turbopi.support.files import write_whole

logger = logging.getLogger(__name__)

WORKSPACE = 4 << 30  # bytes that an engine may use besides its weights
Write = Callable[[TensorRTOps, Mapping[str, Value]], Mapping[str, Value]]
TORCH_TYPES = {
    "FLOAT": torch.float32,
    "HALF": torch.float16,
    "BF16": torch.bfloat16,
    "INT64": torch.int64,
    "BOOL": torch.bool,
}


@dataclass(frozen=True)
class Input:
    """One input of a network."""

    shape: tuple[int, ...]
    dtype: Dtype


@dataclass(frozen=True)
class Specification:
    """A network to build: its inputs, and the function that writes it into a NetworkOps."""

    name: str
    inputs: Mapping[str, Input]
    write: Write
    about: Mapping[str, Any] = field(default_factory=dict)  # further parts of the cache's key: precision, layer, …


def new_log(trt: Any) -> Any:
    """A TensorRT logger whose `errors` keep what went wrong, for our own messages; nothing is printed."""

    class Log(trt.ILogger):  # type: ignore[misc]
        def __init__(self) -> None:
            trt.ILogger.__init__(self)
            self.errors: list[str] = []

        def log(self, severity: Any, message: str) -> None:
            if severity in (trt.ILogger.INTERNAL_ERROR, trt.ILogger.ERROR):
                self.errors.append(message)
            elif severity == trt.ILogger.WARNING:
                logger.debug("TensorRT: %s", message)

    return Log()


def build(library: Library, specification: Specification, *, compute_capability: str | None = None) -> bytes:
    """A serialised engine. Raises BackendError with TensorRT's own words.

    TensorRT-RTX builds without a GPU when `compute_capability` (such as "SM89") says for which; None is this GPU. It
    builds FP8 that way from 1.7 on.
    """
    trt = library.module
    kept: list[TensorRTOps] = []  # the weights, until the engine is built

    def write(network: Any, config: Any, builder: Any, log: Any) -> None:
        ops = TensorRTOps(trt, network)
        kept.append(ops)
        values = {
            name: network.add_input(name, ops.dtypes[one.dtype], one.shape)
            for name, one in specification.inputs.items()
        }
        for name, value in specification.write(ops, values).items():
            value.name = name
            network.mark_output(value)

    return _build(library, specification.name, write, compute_capability)


def build_onnx(
    library: Library, file: Path, shapes: Mapping[str, Sequence[int]], *, compute_capability: str | None = None
) -> bytes:
    """A serialised engine of an ONNX file, for the given shapes of its inputs. Raises BackendError."""
    trt = library.module
    kept = []  # the parser owns the weights

    def write(network: Any, config: Any, builder: Any, log: Any) -> None:
        parser = trt.OnnxParser(network, log)
        kept.append(parser)
        if not parser.parse_from_file(str(file)):
            said = "; ".join(str(parser.get_error(i).desc()) for i in range(parser.num_errors))
            raise BackendError(f"{library.name} {library.version} can't read {file}: {said}")
        profile = builder.create_optimization_profile()
        for i in range(network.num_inputs):
            one = network.get_input(i)
            if one.name not in shapes:
                raise BackendError(
                    f"{file} has an input {one.name!r} without a shape; shapes are given for {sorted(shapes)}"
                )
            profile.set_shape(one.name, *([tuple(shapes[one.name])] * 3))
        config.add_optimization_profile(profile)

    return _build(library, str(file), write, compute_capability)


def _build(library: Library, name: str, write: Callable[..., None], compute_capability: str | None) -> bytes:
    trt = library.module
    log = new_log(trt)
    builder = trt.Builder(log)
    network = builder.create_network(1 << int(trt.NetworkDefinitionCreationFlag.STRONGLY_TYPED))
    config = builder.create_builder_config()
    config.set_memory_pool_limit(trt.MemoryPoolType.WORKSPACE, WORKSPACE)
    config.clear_flag(trt.BuilderFlag.TF32)  # float32 means float32; TensorRT-RTX 1.4 takes TF32 all the same
    if compute_capability is not None:
        if not library.is_rtx:
            raise BackendError(
                f"{library.name} builds for the GPU it sees, not for {compute_capability}: TensorRT-RTX does"
            )
        config.num_compute_capabilities = 1
        config.set_compute_capability(getattr(trt.ComputeCapability, compute_capability), 0)
    started = time.perf_counter()
    write(network, config, builder, log)
    serialised = builder.build_serialized_network(network, config)
    if serialised is None:
        said = "; ".join(log.errors[-3:]) or "it gave no reason"
        raise BackendError(
            f"{library.name} {library.version} can't build {name}: {said}. It may use {WORKSPACE >> 30} GB beside the "
            f"weights: if memory ran out, free some of it on the GPU"
        )
    logger.info("built %s in %.1f s", name, time.perf_counter() - started)
    return bytes(serialised)


class Kernels:
    """TensorRT-RTX's compiled kernels, shared by engines: the layers' MLPs have the same ones. Empty for TensorRT.

    Compiling takes seconds an engine, so they are kept in `file`: its SHA-256, then what the library serialises. It
    says itself whether such bytes suit it and this GPU; ones that don't are compiled again.
    """

    def __init__(self, library: Library, file: Path | None = None) -> None:
        self._library, self._file = library, file
        self._cache: Any = None
        self._owner: Any = None  # the library's cache crashes once the engine that it was made with is gone
        self._stored = b""
        self.found = False  # whether they were read, and not all compiled here

    def context(self, engine: Any, runtime: Any) -> Any:
        """An execution context of an engine whose kernels are taken from here, and added if they are new."""
        if not self._library.is_rtx:
            return engine.create_execution_context()
        config = engine.create_runtime_config()
        if self._cache is None:
            self._cache, self._owner = config.create_runtime_cache(), (config, engine, runtime)
            self._read()
        config.set_runtime_cache(self._cache)
        return engine.create_execution_context(config)

    def keep(self) -> None:
        """Write the file if there are other kernels than it has. One that can't be written costs time, no answer."""
        if self._file is None or self._cache is None:
            return
        content = bytes(self._cache.serialize())
        if content == self._stored:
            return
        try:
            self._file.parent.mkdir(parents=True, exist_ok=True)
            write_whole(self._file, hashlib.sha256(content).digest() + content)
        except OSError as error:
            logger.warning("compiled kernels aren't kept: %s", error)
            return
        self._stored = content

    def _read(self) -> None:
        if self._file is None or not self._file.is_file():
            return
        whole = self._file.read_bytes()
        digest, content = whole[:32], whole[32:]
        if hashlib.sha256(content).digest() != digest:
            logger.warning("%s isn't as it was written; kernels are compiled again", self._file)
        elif not self._cache.deserialize(content):
            logger.warning("%s is of another %s or GPU; kernels are compiled again", self._file, self._library.name)
        else:
            self._stored, self.found = content, True


class Engine:
    """A loaded engine with one execution context. Calls on one stream run one after the other."""

    def __init__(self, library: Library, name: str, plan: bytes, *, kernels: Kernels | None = None) -> None:
        trt = library.module
        self.name, self.calls = name, 0
        self._log = new_log(trt)
        self._runtime = trt.Runtime(self._log)
        engine = self._runtime.deserialize_cuda_engine(plan)
        if engine is None:
            raise BackendError(f"{library.name} can't load the engine {name}: {'; '.join(self._log.errors[-3:])}")
        self._engine = engine
        self._kernels = kernels or Kernels(library)  # must outlive the context
        self._context = self._kernels.context(engine, self._runtime)
        if self._context is None:
            raise BackendError(f"{library.name} can't run the engine {name}: {'; '.join(self._log.errors[-3:])}")
        names = [engine.get_tensor_name(i) for i in range(engine.num_io_tensors)]
        self._dtypes = {n: TORCH_TYPES[engine.get_tensor_dtype(n).name] for n in names}
        self._shapes = {n: tuple(engine.get_tensor_shape(n)) for n in names}

    def run(self, **tensors: Tensor) -> None:
        """On PyTorch's current stream: read the inputs, write the outputs, contiguous tensors on the GPU by name.

        Raises BackendError for a missing tensor, a shape or dtype that the engine wasn't built for, and its failures.
        """
        if tensors.keys() != self._shapes.keys():
            raise BackendError(f"engine {self.name} has tensors {sorted(self._shapes)}, was given {sorted(tensors)}")
        for name, tensor in tensors.items():
            self._bind(name, tensor)
        if not self._context.execute_async_v3(torch.cuda.current_stream().cuda_stream):
            raise BackendError(f"engine {self.name} failed: {'; '.join(self._log.errors[-3:]) or 'no reason given'}")
        self.calls += 1

    def _bind(self, name: str, tensor: Tensor) -> None:
        shape, expected = tuple(tensor.shape), self._shapes[name]
        if shape != expected or tensor.dtype != self._dtypes[name]:
            raise BackendError(
                f"engine {self.name} was built for {name} {self._dtypes[name]} {list(expected)}, not for "
                f"{tensor.dtype} {list(shape)}; build one for this shape with `turbopi build`"
            )
        if not tensor.is_contiguous() or not tensor.is_cuda:
            raise BackendError(f"engine {self.name}: {name} isn't a contiguous tensor on a GPU")
        self._context.set_tensor_address(name, tensor.data_ptr())
