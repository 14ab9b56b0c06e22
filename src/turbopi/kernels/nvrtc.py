"""Compile CUDA C++ at run time, keep the result on disk, load it, launch it on PyTorch's current stream.

NVRTC and the driver are called through `cuda.bindings`, which comes with PyTorch's CUDA builds.

Kernels of the same code on the same device share one loaded module, which is unloaded when the last of them is gone.
A CUDA graph needs the modules of what was captured: its owner holds the kernels that `capturing` lists.
"""

import ctypes
import hashlib
import importlib
import logging
import threading
import weakref
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, suppress
from functools import cache
from pathlib import Path
from typing import Any, Final

import torch

from turbopi.kernels.ahead import noting
from turbopi.support.errors import BackendError, BackendUnavailable
from turbopi.support.files import cache_folder, keep_in_cache

logger = logging.getLogger(__name__)

# What the driver answers to code that isn't for this GPU, or PTX newer than it
_NOT_FOR_THIS_GPU: Final = {
    209: "NO_BINARY_FOR_GPU",
    218: "INVALID_PTX",
    221: "JIT_COMPILER_NOT_FOUND",
    222: "UNSUPPORTED_PTX_VERSION",
    223: "JIT_COMPILATION_DISABLED",
}


def bindings(name: str) -> Any:
    """`cuda.bindings.driver` or `cuda.bindings.nvrtc`. Raises BackendUnavailable if the package isn't there."""
    try:
        return importlib.import_module(f"cuda.bindings.{name}")
    except ImportError as e:
        raise BackendUnavailable(f"our CUDA kernels need cuda.bindings ({e}); pip install cuda-python") from e


def native_arch(capability: tuple[int, int]) -> str:
    """What NVRTC compiles for on a GPU of this compute capability: its machine code ("sm_89") or, of a GPU newer than
    NVRTC, the newest PTX that it knows ("compute_121"), which the driver compiles for that GPU.

    Raises BackendUnavailable for a GPU older than all that NVRTC knows, and without NVRTC.
    """
    number, known = capability[0] * 10 + capability[1], supported()
    if number in known:
        return f"sm_{number}"
    if older := [one for one in known if one < number]:
        return f"compute_{max(older)}"
    raise BackendUnavailable(
        f"NVRTC compiles for compute capability {min(known) // 10}.{min(known) % 10} and newer; this GPU has "
        f"{capability[0]}.{capability[1]}"
    )


def supported() -> list[int]:
    """The compute capabilities that NVRTC compiles for: 120 is 12.0."""
    return [int(one) for one in _nvrtc("nvrtcGetSupportedArchs")]


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


def compile_for(source: str, arch: str, defines: dict[str, int], *, folder: Path | None = None) -> bytes:
    """Machine code or PTX, as `native_arch` names it."""
    compile_as = compile_ptx if arch.startswith("compute_") else compile_cubin
    return compile_as(source, arch, defines, folder=folder)


def _cached(kind: str, source: str, arch: str, defines: dict[str, int], folder: Path | None, more: list[str]) -> bytes:
    options = [f"-arch={arch}", "-std=c++17", *(f"-D{name}={value}" for name, value in sorted(defines.items())), *more]
    major, minor = _nvrtc("nvrtcVersion")
    key = hashlib.sha256("\0".join((source, *options, f"{major}.{minor}", _build())).encode()).hexdigest()[:32]
    file = (folder or cache_folder()) / f"{key}.{kind.lower()}"
    with suppress(OSError):
        return file.read_bytes()
    code = _compile(bindings("nvrtc"), kind, source, options)
    keep_in_cache(file, code)
    logger.info("compiled a kernel for %s: %s", arch, file)
    return code


def _nvrtc(call: str) -> Any:
    """What a function of NVRTC without arguments returns. Raises BackendUnavailable if its library can't be loaded."""
    nvrtc = bindings("nvrtc")
    try:
        return checked(call, getattr(nvrtc, call)())
    except (RuntimeError, OSError) as e:
        if isinstance(e, BackendError):
            raise
        raise BackendUnavailable(f"NVRTC can't be loaded ({e}); pip install nvidia-cuda-nvrtc") from e


@cache
def _build() -> str:
    """PTX of an empty program, whose head names NVRTC's build: `nvrtcVersion` leaves the patch version out."""
    return _compile(bindings("nvrtc"), "PTX", "", []).decode(errors="replace")


def _compile(nvrtc: Any, kind: str, source: str, options: list[str]) -> bytes:
    program = checked("nvrtcCreateProgram", nvrtc.nvrtcCreateProgram(source.encode(), b"kernel.cu", 0, [], []))
    (status,) = nvrtc.nvrtcCompileProgram(program, len(options), [option.encode() for option in options])
    if status != nvrtc.nvrtcResult.NVRTC_SUCCESS:
        log = b" " * checked("nvrtcGetProgramLogSize", nvrtc.nvrtcGetProgramLogSize(program))
        nvrtc.nvrtcGetProgramLog(program, log)
        nvrtc.nvrtcDestroyProgram(program)
        said = f"a kernel doesn't compile with {' '.join(options)}:\n{log.decode().rstrip(chr(0))}"
        if status == nvrtc.nvrtcResult.NVRTC_ERROR_COMPILATION:
            raise BackendError(said)
        raise BackendUnavailable(f"NVRTC can't compile here ({status.name}; pip install -U nvidia-cuda-nvrtc): {said}")
    size, get = f"nvrtcGet{kind}Size", f"nvrtcGet{kind}"
    code = b" " * checked(size, getattr(nvrtc, size)(program))
    checked(get, getattr(nvrtc, get)(program, code))
    nvrtc.nvrtcDestroyProgram(program)
    return code


_LOADED: "weakref.WeakValueDictionary[tuple[bytes, int | None], _Module]" = weakref.WeakValueDictionary()
_UNUSED: "list[tuple[Any, Any, int | None]]" = []  # driver, module, device: to be unloaded
_UNLOADING: Final = threading.Lock()  # held while modules are unloaded, and by a thread that captures a graph
_LAUNCHED: Final = threading.local()  # `kernels`: what this thread launched while it captured


class _Module:
    """A cubin or PTX on a device, as all kernels of it share it; unloaded when the last one is gone."""

    def __init__(self, driver: Any, code: bytes, device: int | None) -> None:
        result = driver.cuModuleLoadData(code)
        if (why := _NOT_FOR_THIS_GPU.get(int(result[0]))) is not None:
            raise BackendUnavailable(
                f"the driver doesn't take a kernel's code ({why}): it is older than NVRTC, or the GPU is newer than "
                "both; update the driver"
            )
        self.handle = checked("cuModuleLoadData", result)
        weakref.finalize(self, _unload, driver, self.handle, device).atexit = False  # then the driver is going, too


def _loaded(driver: Any, code: bytes) -> _Module:
    """The module of `code` on the current device."""
    key = code, torch.cuda.current_device() if _initialized() else None
    module = _LOADED.get(key)
    if module is None:
        module = _LOADED[key] = _Module(driver, *key)
    return module


def _initialized() -> bool:
    return bool(torch.cuda.is_initialized())  # type: ignore[no-untyped-call]


def _unload(driver: Any, module: Any, device: int | None) -> None:
    _UNUSED.append((driver, module, device))
    _unload_unused()


def _unload_unused() -> None:
    """Unload what no kernel has any more; while a graph is captured, later.

    The garbage collector may call this in any thread, at any line: it doesn't wait for a lock. A device that failed, or
    is gone, has lost its modules already.
    """
    if _initialized() and torch.cuda.is_current_stream_capturing():
        return
    if not _UNLOADING.acquire(blocking=False):
        return
    try:
        while _UNUSED:
            driver, module, device = _UNUSED.pop()
            try:
                with nullcontext() if device is None else torch.cuda.device(device):
                    if device is not None:
                        torch.cuda.synchronize()  # no launch is left; the device's context is the thread's
                    checked("cuModuleUnload", driver.cuModuleUnload(module))
            except RuntimeError as e:
                logger.debug("a kernel's code isn't unloaded: %s", e)
    finally:
        _UNLOADING.release()


@contextmanager
def capturing() -> Iterator[list["Kernel"]]:
    """Around the capture of a CUDA graph: the kernels that it launches, which must live as long as the graph.

    Meanwhile no module is unloaded, which would wait for the device and so break the capture. In one thread at a time.
    """
    kernels: list[Kernel] = []
    with _UNLOADING:
        _LAUNCHED.kernels = kernels
        try:
            yield kernels
        finally:
            del _LAUNCHED.kernels
    _unload_unused()


class Kernel:
    """One function of a cubin or of PTX, loaded on the current CUDA device."""

    def __init__(self, code: bytes, name: str, shared_bytes: int) -> None:
        self._driver = bindings("driver")
        d = self._driver
        self._module = _loaded(d, code)
        self._loaded = checked("cuModuleGetFunction", d.cuModuleGetFunction(self._module.handle, name.encode()))
        self._shared = shared_bytes
        attribute = d.CUfunction_attribute.CU_FUNC_ATTRIBUTE_MAX_DYNAMIC_SHARED_SIZE_BYTES
        checked("cuFuncSetAttribute", d.cuFuncSetAttribute(self._loaded, attribute, shared_bytes))

    @property
    def _function(self) -> Any:
        """What the driver launches, which `capturing` notes."""
        if (kernels := getattr(_LAUNCHED, "kernels", None)) is not None and self not in kernels:
            kernels.append(self)
        return self._loaded

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
        if noting():
            return
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
        if noting():
            return
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
