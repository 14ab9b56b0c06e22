"""Launches through the CUDA driver: what it answers is heeded, on a machine without a GPU by a fake of it."""

import ctypes
import enum
import subprocess
import sys
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from turbopi.errors import BackendError, BackendUnavailable
from turbopi.kernels import grid_barrier as barrier
from turbopi.kernels import nvrtc
from turbopi.kernels.arguments import Parameter, Parameters
from turbopi.kernels.sm90 import instructions


class Status(enum.IntEnum):
    CUDA_SUCCESS = 0
    CUDA_ERROR_ILLEGAL_ADDRESS = 700
    CUDA_ERROR_COOPERATIVE_LAUNCH_TOO_LARGE = 720


class Anything:
    """Takes any attribute: the driver's structs and enums as the launches fill them."""

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        value = Anything()
        object.__setattr__(self, name, value)
        return value


def fake_driver(**answers: tuple[Any, ...]) -> SimpleNamespace:
    """The driver's functions that launches call: each succeeds, unless `answers` has another result for it.

    `calls` has the name and the arguments of each call, in order.
    """
    calls: list[tuple[str, tuple[Any, ...]]] = []
    results: dict[str, tuple[Any, ...]] = {
        "cuModuleLoadData": (Status(0), 1),
        "cuModuleGetFunction": (Status(0), 2),
        "cuFuncSetAttribute": (Status(0),),
        "cuOccupancyMaxActiveClusters": (Status(0), 4),
        "cuLaunchKernel": (Status(0),),
        "cuLaunchKernelEx": (Status(0),),
        "cuLaunchCooperativeKernel": (Status(0),),
        "cuTensorMapEncodeTiled": (Status(0), None),
    } | answers

    def answer(name: str) -> Any:
        def function(*args: Any) -> tuple[Any, ...]:
            calls.append((name, args))
            return results[name]

        return function

    functions = {name: answer(name) for name in results}
    structs = dict.fromkeys(("CUlaunchAttribute", "CUlaunchConfig"), Anything)
    enums = (
        *("CUlaunchAttributeID", "CUfunction_attribute", "CUtensorMapDataType", "CUtensorMapInterleave"),
        *("CUtensorMapSwizzle", "CUtensorMapL2promotion", "CUtensorMapFloatOOBfill"),
    )
    numbers = {"cuuint32_t": int, "cuuint64_t": int}
    return SimpleNamespace(
        **functions, **structs, **{name: Anything() for name in enums}, **numbers, CUresult=Status, calls=calls
    )


@pytest.fixture
def driver(monkeypatch: pytest.MonkeyPatch) -> Any:
    """`driver(name=(status, value), …)`: from then on the launches meet that driver, which it returns."""
    monkeypatch.setattr(torch.cuda, "current_stream", lambda: SimpleNamespace(cuda_stream=STREAM))

    def install(**answers: tuple[Any, ...]) -> SimpleNamespace:
        driver = fake_driver(**answers)
        monkeypatch.setattr(nvrtc, "bindings", lambda name: driver)
        monkeypatch.setattr(instructions, "bindings", lambda name: driver)
        return driver

    return install


STREAM = 77
ILLEGAL = (Status.CUDA_ERROR_ILLEGAL_ADDRESS,)


class Args(ctypes.Structure):
    _fields_ = (("count", ctypes.c_int),)


NOTHING = Args(0)


def cluster_of_two(shared_bytes: int = 0) -> instructions.DependentKernel:
    takes = Parameters((Parameter("int", "count"),))
    return instructions.DependentKernel(b"", "attention", takes, shared_bytes=shared_bytes, threads=128, cluster=2)


def test_a_launch_that_fails_names_the_call_and_its_status(driver: Any) -> None:
    driver(cuLaunchKernel=ILLEGAL, cuLaunchKernelEx=ILLEGAL, cuLaunchCooperativeKernel=ILLEGAL)
    kernel = cluster_of_two()
    with pytest.raises(BackendError, match=r"cuLaunchKernelEx failed: CUDA_ERROR_ILLEGAL_ADDRESS"):
        kernel.launch_dependent(8, {"count": 1})
    with pytest.raises(BackendError, match=r"cuLaunchKernel failed: CUDA_ERROR_ILLEGAL_ADDRESS"):
        kernel.launch(8, 128, NOTHING)
    with pytest.raises(BackendError, match=r"cuLaunchCooperativeKernel failed: CUDA_ERROR_ILLEGAL_ADDRESS"):
        kernel.launch_cooperative(8, 128, NOTHING)


def test_a_dependent_launch_has_the_kernels_grid_block_cluster_and_shared_memory(driver: Any) -> None:
    installed = driver()
    kernel = cluster_of_two(shared_bytes=5000)
    kernel.launch_dependent(8, {"count": 12})
    (name, (config, function, parameters, _)) = installed.calls[-1]
    assert (name, function) == ("cuLaunchKernelEx", 2)
    assert (config.gridDimX, config.gridDimY, config.gridDimZ) == (8, 1, 1)
    assert (config.blockDimX, config.blockDimY, config.blockDimZ) == (128, 1, 1)
    assert (config.sharedMemBytes, config.hStream, config.numAttrs) == (5000, STREAM, 2)
    dependent, cluster = config.attrs
    assert dependent.value.programmaticStreamSerializationAllowed == 1
    dims = cluster.value.clusterDim
    assert (dims.x, dims.y, dims.z) == (2, 1, 1)
    assert parameters != 0
    (asked,) = [args for name, args in installed.calls if name == "cuOccupancyMaxActiveClusters"]
    assert (asked[1].gridDimX, asked[1].blockDimX, asked[1].sharedMemBytes) == (2, 128, 5000)
    (allowed,) = [args for name, args in installed.calls if name == "cuFuncSetAttribute"]
    assert allowed[0] == 2 and allowed[2] == 5000, "more than 48 KB must be allowed before a launch"


@pytest.mark.parametrize("call", ["launch", "launch_cooperative"])
def test_a_launch_says_grid_block_shared_memory_stream_and_where_the_struct_is(driver: Any, call: str) -> None:
    installed, args = driver(), Args(41)
    getattr(nvrtc.Kernel(b"", "turbopi_denoise", 1234), call)(64, 640, args)
    function, *sizes, stream, pointers = installed.calls[-1][1][:10]
    assert (function, sizes, stream) == (2, [64, 1, 1, 640, 1, 1, 1234], STREAM)
    assert (
        installed.calls[-1][0] == {"launch": "cuLaunchKernel", "launch_cooperative": "cuLaunchCooperativeKernel"}[call]
    )
    assert pointers != 0


def test_blocks_that_do_not_fit_together_are_refused_with_what_limits_them(driver: Any) -> None:
    driver(cuLaunchCooperativeKernel=(Status.CUDA_ERROR_COOPERATIVE_LAUNCH_TOO_LARGE,))
    kernel = nvrtc.Kernel(b"", "turbopi_denoise", 0)
    with pytest.raises(BackendUnavailable, match=r"120 blocks of 640 threads .*CUDA_MPS_ACTIVE_THREAD_PERCENTAGE"):
        kernel.launch_cooperative(120, 640, NOTHING)


def test_a_gpu_without_room_for_one_cluster_is_refused(driver: Any) -> None:
    driver(cuOccupancyMaxActiveClusters=(Status(0), 0))
    with pytest.raises(BackendUnavailable, match=r"'attention' needs a cluster of 2 blocks of 128 threads with 77 b"):
        cluster_of_two(shared_bytes=77)


def test_a_tensor_map_that_cannot_be_made_names_its_sizes(driver: Any) -> None:
    driver(cuTensorMapEncodeTiled=(*ILLEGAL, None))
    with pytest.raises(BackendError, match=r"cuTensorMapEncodeTiled for \(64, 3\) at 0xabc0 failed: CUDA"):
        instructions.tensor_map(0xABC0, (64, 3), (64,), (64, 1))


def test_failed_launches_are_heeded_without_asserts_too() -> None:
    script = (
        "from turbopi.kernels.nvrtc import checked\n"
        "try:\n    checked('cuLaunchKernelEx', (700,))\n"
        "except Exception as error:\n    print(__debug__, type(error).__name__, error)"
    )
    ran = subprocess.run([sys.executable, "-O", "-c", script], capture_output=True, text=True, check=True)
    assert ran.stdout.strip() == "False BackendError cuLaunchKernelEx failed: 700"


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs an NVIDIA GPU")
def test_more_blocks_than_the_gpu_holds_are_refused_and_cost_nothing_else() -> None:
    device = torch.device("cuda", 0)
    properties = torch.cuda.get_device_properties(device)
    cubin = nvrtc.compile_cubin(barrier.SOURCE, f"sm_{properties.major}{properties.minor}", {})
    counter = torch.zeros(1, dtype=torch.int32, device=device)  # before the kernel, which is loaded into its context
    kernel = nvrtc.Kernel(cubin, "turbopi_barriers", 0)
    args = barrier._Args(counter.data_ptr(), 3)
    with pytest.raises(BackendUnavailable, match="at once"):
        kernel.launch_cooperative(100 * properties.multi_processor_count, barrier.THREADS, args)
    kernel.launch_cooperative(properties.multi_processor_count, barrier.THREADS, args)
    torch.cuda.synchronize()
    assert int(counter) == 3 * properties.multi_processor_count
