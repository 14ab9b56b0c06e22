"""Compiling, loading and launching through NVRTC and the driver: what they answer is heeded, and what they hold is
given back. On a machine without a GPU by fakes of them.
"""

import ctypes
import enum
import gc
import itertools
import logging
import subprocess
import sys
import threading
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from turbopi.engine.graph import Graph, Mark
from turbopi.kernels import grid_barrier as barrier
from turbopi.kernels import nvrtc
from turbopi.kernels.arguments import Parameter, Parameters
from turbopi.kernels.sm90 import instructions
from turbopi.support.errors import BackendError, BackendUnavailable


class Status(enum.IntEnum):
    CUDA_SUCCESS = 0
    CUDA_ERROR_DEINITIALIZED = 4
    CUDA_ERROR_NO_BINARY_FOR_GPU = 209
    CUDA_ERROR_UNSUPPORTED_PTX_VERSION = 222
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
        "cuModuleUnload": (Status(0),),
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
    (requested,) = [args for name, args in installed.calls if name == "cuOccupancyMaxActiveClusters"]
    assert (requested[1].gridDimX, requested[1].blockDimX, requested[1].sharedMemBytes) == (2, 128, 5000)
    (allowed,) = [args for name, args in installed.calls if name == "cuFuncSetAttribute"]
    assert allowed[0] == 2 and allowed[2] == 5000, "more than 48 KB must be allowed before a launch"


@pytest.mark.parametrize("call", ["launch", "launch_cooperative"])
def test_a_launch_says_grid_block_shared_memory_stream_and_where_the_struct_is(driver: Any, call: str) -> None:
    installed, args = driver(), Args(41)
    kernel = nvrtc.Kernel(b"", "turbopi_denoise", 1234)
    getattr(kernel, call)(64, 640, args)
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


@pytest.mark.slow
def test_failed_launches_are_heeded_without_asserts_too() -> None:
    script = (
        "from turbopi.kernels.nvrtc import checked\n"
        "try:\n    checked('cuLaunchKernelEx', (700,))\n"
        "except Exception as error:\n    print(__debug__, type(error).__name__, error)"
    )
    ran = subprocess.run([sys.executable, "-O", "-c", script], capture_output=True, text=True, check=True)
    assert ran.stdout.strip() == "False BackendError cuLaunchKernelEx failed: 700"


# -- modules -----------------------------------------------------------------------------------------------------------


def count(driver: SimpleNamespace) -> tuple[int, int]:
    """Modules that were loaded and unloaded."""
    names = [name for name, _ in driver.calls]
    return names.count("cuModuleLoadData"), names.count("cuModuleUnload")


def test_kernels_of_one_code_share_a_module_that_goes_with_the_last_of_them(driver: Any) -> None:
    installed = driver()
    loop, prepare = (nvrtc.Kernel(b"loop's", name, 0) for name in ("loop", "prepare"))
    other = nvrtc.Kernel(b"another", "loop", 0)
    assert count(installed) == (2, 0)
    del loop
    assert count(installed) == (2, 0), "the other function is in the same module"
    del prepare
    assert count(installed) == (2, 1)
    again = nvrtc.Kernel(b"loop's", "loop", 0)
    assert count(installed) == (3, 1)
    del other, again
    assert count(installed) == (3, 3)


def test_modules_of_two_devices_are_two(driver: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    installed, current = driver(), itertools.count()
    monkeypatch.setattr(torch.cuda, "is_initialized", lambda: True)
    monkeypatch.setattr(torch.cuda, "is_current_stream_capturing", lambda: True)  # nothing is unloaded in this test
    monkeypatch.setattr(torch.cuda, "current_device", lambda: next(current))
    kernels = [nvrtc.Kernel(b"code", "loop", 0) for _ in range(2)]
    assert count(installed) == (2, 0)
    del kernels
    nvrtc._UNUSED.clear()


@pytest.mark.slow
def test_a_kernel_without_its_function_leaves_no_module(driver: Any) -> None:
    installed = driver(cuModuleGetFunction=(Status.CUDA_ERROR_NO_BINARY_FOR_GPU, None))
    with pytest.raises(BackendError, match="cuModuleGetFunction"):
        nvrtc.Kernel(b"code", "loop", 0)
    gc.collect()
    assert count(installed) == (1, 1)


def test_what_is_captured_holds_its_kernels_and_nothing_is_unloaded_meanwhile(driver: Any) -> None:
    installed = driver()
    kernel, unused, dependent = nvrtc.Kernel(b"a", "loop", 0), nvrtc.Kernel(b"b", "loop", 0), cluster_of_two()
    with nvrtc.capturing() as held:
        kernel.launch(8, 128, NOTHING)
        kernel.launch_cooperative(8, 128, NOTHING)
        dependent.launch_dependent(8, {"count": 1})
        del unused
        assert count(installed) == (3, 0), "unloading waits for the device"
        other = threading.Thread(target=nvrtc._unload_unused)
        other.start()
        other.join()
        assert count(installed) == (3, 0), "in no thread"
    assert held == [kernel, dependent] and count(installed) == (3, 1)
    kernel.launch(8, 128, NOTHING)
    del kernel, dependent
    assert count(installed) == (3, 1), "the graph needs them"
    held.clear()
    assert count(installed) == (3, 3)


def test_a_driver_that_is_gone_unloads_nothing_and_breaks_nothing(driver: Any) -> None:
    installed = driver(cuModuleUnload=(Status.CUDA_ERROR_DEINITIALIZED,))
    kernels = [nvrtc.Kernel(code, "loop", 0) for code in (b"a", b"b")]
    del kernels
    assert count(installed) == (2, 2)


@pytest.mark.parametrize("status", [Status.CUDA_ERROR_NO_BINARY_FOR_GPU, Status.CUDA_ERROR_UNSUPPORTED_PTX_VERSION])
def test_code_that_the_driver_does_not_take_is_unavailable(driver: Any, status: Status) -> None:
    driver(cuModuleLoadData=(status, None))
    with pytest.raises(BackendUnavailable, match="update the driver"):
        nvrtc.Kernel(b"code", "loop", 0)
    driver(cuModuleLoadData=(Status.CUDA_ERROR_ILLEGAL_ADDRESS, None))
    with pytest.raises(BackendError, match="cuModuleLoadData failed: CUDA_ERROR_ILLEGAL_ADDRESS") as raised:
        nvrtc.Kernel(b"code", "loop", 0)
    assert not isinstance(raised.value, BackendUnavailable)


# -- NVRTC -------------------------------------------------------------------------------------------------------------


class Result(enum.IntEnum):
    NVRTC_SUCCESS = 0
    NVRTC_ERROR_INVALID_OPTION = 5
    NVRTC_ERROR_COMPILATION = 6


@pytest.fixture
def compiler(monkeypatch: pytest.MonkeyPatch) -> Any:
    """`compiler(…)`: an NVRTC that answers so; the list it returns has the options of each program it compiles."""

    def install(known: tuple[int, ...] = (75, 80, 120), status: int = 0, build: str = "V13.0.88") -> list[list[str]]:
        compiled: list[list[str]] = []

        def fill(program: Any, text: Any) -> tuple[int]:
            ctypes.memmove(text, b"c" * len(text), len(text))
            return (0,)

        def compile(program: Any, count: int, options: list[bytes]) -> tuple[Result]:
            compiled.append([option.decode() for option in options])
            return (Result(status),)

        fake = SimpleNamespace(
            nvrtcVersion=lambda: (0, 13, 0),
            nvrtcGetSupportedArchs=lambda: (0, list(known)),
            nvrtcCreateProgram=lambda *given: (0, object()),
            nvrtcCompileProgram=compile,
            nvrtcResult=Result,
            nvrtcDestroyProgram=lambda program: (0,),
        )
        for kind in ("CUBIN", "PTX", "ProgramLog"):
            setattr(fake, f"nvrtcGet{kind}Size", lambda program: (0, 4))
            setattr(fake, f"nvrtcGet{kind}", fill)
        monkeypatch.setattr(nvrtc, "bindings", lambda name: fake)
        monkeypatch.setattr(nvrtc, "_build", lambda: build)
        return compiled

    return install


def test_a_gpu_newer_than_nvrtc_gets_ptx_of_the_newest_that_it_knows(compiler: Any, tmp_path: Path) -> None:
    compiled = compiler()
    archs = [nvrtc.native_arch(one) for one in ((8, 0), (8, 7), (12, 0), (12, 1), (13, 0))]
    assert archs == ["sm_80", "compute_80", "sm_120", "compute_120", "compute_120"]
    for arch in ("sm_80", "compute_120"):
        assert nvrtc.compile_for("source", arch, {}, folder=tmp_path) == b"cccc"
    assert [options[0] for options in compiled] == ["-arch=sm_80", "-arch=compute_120"]
    assert sorted(file.suffix for file in tmp_path.iterdir()) == [".cubin", ".ptx"]
    with pytest.raises(BackendUnavailable, match=r"compute capability 7\.5 and newer; this GPU has 7\.0"):
        nvrtc.native_arch((7, 0))


def test_only_source_that_does_not_compile_is_an_error_of_ours(compiler: Any, tmp_path: Path) -> None:
    compiler(status=Result.NVRTC_ERROR_INVALID_OPTION)
    with pytest.raises(BackendUnavailable, match=r"NVRTC_ERROR_INVALID_OPTION.*-arch=sm_130"):
        nvrtc.compile_cubin("source", "sm_130", {}, folder=tmp_path)
    compiler(status=Result.NVRTC_ERROR_COMPILATION)
    with pytest.raises(BackendError, match="doesn't compile with -arch=sm_80") as raised:
        nvrtc.compile_cubin("source", "sm_80", {}, folder=tmp_path)
    assert not isinstance(raised.value, BackendUnavailable)


def test_without_nvrtcs_library_kernels_are_unavailable(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def missing() -> None:
        raise RuntimeError("Failed to dlopen libnvrtc.so.13")

    fake = SimpleNamespace(nvrtcVersion=missing, nvrtcGetSupportedArchs=missing)
    monkeypatch.setattr(nvrtc, "bindings", lambda name: fake)
    for call in (lambda: nvrtc.native_arch((8, 0)), lambda: nvrtc.compile_cubin("", "sm_80", {}, folder=tmp_path)):
        with pytest.raises(BackendUnavailable, match="NVRTC can't be loaded"):
            call()


def test_another_build_of_nvrtc_compiles_again(compiler: Any, tmp_path: Path) -> None:
    for build, times in (("V13.0.88", 1), ("V13.0.88", 0), ("V13.0.90", 1)):
        compiled = compiler(build=build)
        nvrtc.compile_cubin("source", "sm_80", {}, folder=tmp_path)
        assert len(compiled) == times, build


def test_nvrtcs_build_is_told_by_what_it_compiles() -> None:
    pytest.importorskip("cuda.bindings.nvrtc", reason="cuda.bindings isn't installed")
    try:
        build = nvrtc._build()
    except BackendUnavailable as e:
        pytest.skip(str(e))
    major, minor = nvrtc._nvrtc("nvrtcVersion")
    assert f"V{major}.{minor}." in build


def test_a_cache_that_cannot_be_written_or_read_costs_one_line_of_the_log(
    compiler: Any, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    compiler()
    (tmp_path / "file").write_text("")
    with caplog.at_level(logging.WARNING):
        for source in ("one", "another"):
            assert nvrtc.compile_cubin(source, "sm_80", {}, folder=tmp_path / "file" / "below") == b"cccc"
    (line,) = caplog.messages
    assert "going on without the cache" in line and str(tmp_path / "file") in line


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs an NVIDIA GPU")
def test_a_captured_graph_runs_on_when_its_kernel_is_let_go() -> None:
    """Modules are unloaded by the driver, and what a graph launches is not."""
    device = torch.device("cuda", 0)
    blocks = torch.cuda.get_device_properties(device).multi_processor_count
    code = nvrtc.compile_for(barrier.SOURCE, nvrtc.native_arch(torch.cuda.get_device_capability(device)), {})
    counter = torch.zeros(1, dtype=torch.int32, device=device)
    args = barrier._Args(counter.data_ptr(), 3)

    def run(mark: Mark) -> None:
        counter.zero_()
        kernels[-1].launch_cooperative(blocks, barrier.THREADS, args)

    kernels = [nvrtc.Kernel(code, "turbopi_barriers", 0)]
    graph = Graph(run, None, torch.cuda.Stream(device))  # type: ignore[no-untyped-call]
    kernels.clear()
    gc.collect()
    assert (code, device.index) in nvrtc._LOADED
    for _ in range(3):
        graph.replay()
        assert int(counter) == 3 * blocks
    del graph
    gc.collect()
    assert (code, device.index) not in nvrtc._LOADED and not nvrtc._UNUSED
    kernels.append(nvrtc.Kernel(code, "turbopi_barriers", 0))
    run(lambda stage: None)
    assert int(counter) == 3 * blocks


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
