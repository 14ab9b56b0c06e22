"""Compile CUDA C++ at run time, keep the result on disk, launch it on PyTorch's current stream.

NVRTC and the driver are called through `cuda.bindings`, which comes with PyTorch's CUDA builds.
"""

import ctypes
import hashlib
import importlib
import logging
from pathlib import Path
from typing import Any

import torch

from turbopi.errors import BackendError, BackendUnavailable
from turbopi.files import cache_folder, write_whole

logger = logging.getLogger(__name__)


def bindings(name: str) -> Any:
    """`cuda.bindings.driver` or `cuda.bindings.nvrtc`. Raises BackendUnavailable if the package isn't there."""
    try:
        return importlib.import_module(f"cuda.bindings.{name}")
    except ImportError as e:
        raise BackendUnavailable(f"our CUDA kernels need cuda.bindings ({e}); pip install cuda-python") from e


def compile_cubin(
    source: str, arch: str, defines: dict[str, int], *, folder: Path | None = None, lines: bool = False
) -> bytes:
    """Machine code of `source` for `arch` ("sm_90a"), from the cache if it was compiled before.

    lines  also the source line of each instruction, as profilers and disassemblers take it

    Raises BackendError with the compiler's log.
    """
    return _cached("CUBIN", source, arch, defines, folder, ["-lineinfo"] if lines else [])


def compile_ptx(source: str, arch: str, defines: dict[str, int], *, folder: Path | None = None) -> bytes:
    """The same as PTX for `arch` ("compute_80"): any GPU of that compute capability or a newer one runs it, as the
    driver compiles it when it is loaded.
    """
    return _cached("PTX", source, arch, defines, folder, [])


def _cached(kind: str, source: str, arch: str, defines: dict[str, int], folder: Path | None, more: list[str]) -> bytes:
    nvrtc = bindings("nvrtc")
    major, minor = checked("nvrtcVersion", nvrtc.nvrtcVersion())
    options = [f"-arch={arch}", "-std=c++17", *(f"-D{name}={value}" for name, value in sorted(defines.items())), *more]
    key = hashlib.sha256("\0".join((source, *options, f"{major}.{minor}")).encode()).hexdigest()[:32]
    path = (folder or cache_folder()) / f"{key}.{kind.lower()}"
    if path.is_file():
        return path.read_bytes()
    code = _compile(nvrtc, kind, source, options)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, code)
    logger.info("compiled a kernel for %s: %s", arch, path)
    return code


def _compile(nvrtc: Any, kind: str, source: str, options: list[str]) -> bytes:
    program = checked("nvrtcCreateProgram", nvrtc.nvrtcCreateProgram(source.encode(), b"kernel.cu", 0, [], []))
    (status,) = nvrtc.nvrtcCompileProgram(program, len(options), [option.encode() for option in options])
    if status != nvrtc.nvrtcResult.NVRTC_SUCCESS:
        log = b" " * checked("nvrtcGetProgramLogSize", nvrtc.nvrtcGetProgramLogSize(program))
        nvrtc.nvrtcGetProgramLog(program, log)
        raise BackendError(f"a kernel doesn't compile with {' '.join(options)}:\n{log.decode().rstrip(chr(0))}")
    size, get = f"nvrtcGet{kind}Size", f"nvrtcGet{kind}"
    code = b" " * checked(size, getattr(nvrtc, size)(program))
    checked(get, getattr(nvrtc, get)(program, code))
    nvrtc.nvrtcDestroyProgram(program)
    return code


class Kernel:
    """One function of a cubin or of PTX, loaded on the current CUDA device."""

    def __init__(self, code: bytes, name: str, shared_bytes: int) -> None:
        self._driver = bindings("driver")
        d = self._driver
        self._module = checked("cuModuleLoadData", d.cuModuleLoadData(code))
        self._function = checked("cuModuleGetFunction", d.cuModuleGetFunction(self._module, name.encode()))
        self._shared = shared_bytes
        attribute = d.CUfunction_attribute.CU_FUNC_ATTRIBUTE_MAX_DYNAMIC_SHARED_SIZE_BYTES
        checked("cuFuncSetAttribute", d.cuFuncSetAttribute(self._function, attribute, shared_bytes))

    def max_active_clusters(self, ranks: int, threads: int) -> int:
        """How many clusters of `ranks` blocks the device holds at once."""
        d = self._driver
        attribute = d.CUlaunchAttribute()
        attribute.id = d.CUlaunchAttributeID.CU_LAUNCH_ATTRIBUTE_CLUSTER_DIMENSION
        attribute.value.clusterDim.x, attribute.value.clusterDim.y, attribute.value.clusterDim.z = ranks, 1, 1
        config = d.CUlaunchConfig()
        config.gridDimX, config.gridDimY, config.gridDimZ = ranks, 1, 1
        config.blockDimX, config.blockDimY, config.blockDimZ = threads, 1, 1
        config.sharedMemBytes = self._shared
        config.attrs, config.numAttrs = [attribute], 1
        return int(checked("cuOccupancyMaxActiveClusters", d.cuOccupancyMaxActiveClusters(self._function, config)))

    def launch(self, blocks: int, threads: int, args: ctypes.Structure) -> None:
        """Launch on PyTorch's current stream; `args` is the kernel's one parameter."""
        d, pointers = self._driver, (ctypes.c_void_p * 1)(ctypes.addressof(args))
        stream = torch.cuda.current_stream().cuda_stream
        result = d.cuLaunchKernel(
            self._function, blocks, 1, 1, threads, 1, 1, self._shared, stream, ctypes.addressof(pointers), 0
        )
        checked("cuLaunchKernel", result)

    def launch_cooperative(self, blocks: int, threads: int, args: ctypes.Structure) -> None:
        """Launch on PyTorch's current stream, all blocks resident at once; `args` is the kernel's one parameter.

        The driver starts all blocks together or none: a kernel whose blocks wait for one another can't hang half
        started. Raises BackendUnavailable if they don't fit on what this process may use of the GPU.
        """
        d, pointers = self._driver, (ctypes.c_void_p * 1)(ctypes.addressof(args))
        stream = torch.cuda.current_stream().cuda_stream
        result = d.cuLaunchCooperativeKernel(
            self._function, blocks, 1, 1, threads, 1, 1, self._shared, stream, ctypes.addressof(pointers)
        )
        if result[0] == d.CUresult.CUDA_ERROR_COOPERATIVE_LAUNCH_TOO_LARGE:
            raise BackendUnavailable(
                f"a kernel needs {blocks} blocks of {threads} threads on the GPU at once, and they don't fit; if MPS "
                "limits this process to a part of the GPU, give it more (CUDA_MPS_ACTIVE_THREAD_PERCENTAGE)"
            )
        checked("cuLaunchCooperativeKernel", result)


def checked(call: str, result: tuple[Any, ...]) -> Any:
    """The value(s) behind the status that `call`, of the driver or NVRTC, returned. BackendError unless that is 0."""
    status, *values = result
    if int(status) != 0:
        raise BackendError(f"{call} failed: {getattr(status, 'name', status)}")
    return values[0] if len(values) == 1 else tuple(values)
