"""The portable denoising kernel as PTX for older GPUs, which the driver of a newer one compiles."""

import math
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from kernel_turns.problems import CONFIGS, GPU, has_nvrtc
from kernel_turns.ptx import CASES, TRITON, Case, RanAsPtx, capability_of, compared, judged, read_ptx, triton_rows

from turbopi.kernels import grid_barrier as barrier
from turbopi.kernels import nvrtc
from turbopi.kernels.portable.denoise import kernel as denoise
from turbopi.kernels.portable.denoise.packing import WeightNumbers
from turbopi.support.errors import ConfigError

ROOT = Path(__file__).parents[1]
NUMBERS: dict[str, list[WeightNumbers]] = {"compute_80": ["bf16", "int8"], "compute_89": ["fp8"]}


def skip_if_older(target: str) -> None:
    if torch.cuda.get_device_capability(GPU) < capability_of(target):
        pytest.skip(f"this GPU is older than {target}")


@pytest.mark.gpu
@pytest.mark.parametrize("case", CASES, ids=lambda case: f"{case.target} {case}")
def test_ptx_for_an_older_gpu_computes_what_the_native_build_does(case: Case) -> None:
    skip_if_older(case.target)
    assert compared(case).problem is None


@pytest.mark.gpu
@pytest.mark.parametrize("capability", TRITON)
def test_tritons_kernels_for_an_older_gpu_are_right_in_every_tile(capability: tuple[int, int]) -> None:
    skip_if_older(f"compute_{capability[0]}{capability[1]}")
    rows = triton_rows(capability)
    assert len(rows) > 50 and [(row.kernel, row.variant, row.problem) for row in rows if row.problem] == []


@pytest.mark.gpu
@pytest.mark.parametrize("target", ["compute_80", "compute_89"])
def test_the_grids_barrier_as_ptx_counts_every_block(target: str) -> None:
    blocks, rounds = torch.cuda.get_device_properties(GPU).multi_processor_count, 5
    skip_if_older(target)
    counter = torch.zeros(1, dtype=torch.int32, device=GPU)  # before the kernel, which is loaded into its context
    kernel = nvrtc.Kernel(nvrtc.compile_ptx(barrier.SOURCE, target, {}), "turbopi_barriers", 0)
    kernel.launch_cooperative(blocks, barrier.THREADS, barrier._Args(counter.data_ptr(), rounds))
    torch.cuda.synchronize()
    assert int(counter) == rounds * blocks


def test_every_number_format_is_run_small_and_at_full_size() -> None:
    for target, numbers in NUMBERS.items():
        for weights in numbers:
            names = {case.name for case in CASES if (case.target, case.numbers) == (target, weights)}
            assert {"golden", "full", "shallow"} <= names


@pytest.mark.slow
@pytest.mark.skipif(not has_nvrtc(), reason="no NVRTC here")
@pytest.mark.parametrize("target", NUMBERS)
def test_ptx_is_for_its_target_and_kept_apart_from_machine_code(tmp_path: Path, target: str) -> None:
    sizes = denoise.kernel_sizes(
        CONFIGS["golden"],
        blocks=84,
        cache_rows=976,
        suffix=10,
        weights=NUMBERS[target][0],
        choice=denoise.choices(10),
    )
    number = target.removeprefix("compute_")
    ptx = denoise.compiled(target, sizes, folder=tmp_path)
    cubin = denoise.compiled(f"sm_{number}", sizes, folder=tmp_path)
    assert f"\n.target sm_{number}\n".encode() in ptx and ptx.endswith(b"\0")
    assert cubin.startswith(b"\x7fELF")
    assert sorted(file.suffix for file in tmp_path.iterdir()) == [".cubin", ".ptx"]
    assert denoise.compiled(target, sizes, folder=tmp_path) == ptx


FAKED = """
import torch, triton
from types import SimpleNamespace
from triton.backends.compiler import GPUTarget
from compile_for_all.targets import Target
from kernel_turns.triton_ptx import compiled_as
from turbopi.kernels.dependent_launch import capability
from turbopi.kernels.portable.gemm.kernel import product
from turbopi.kernels.portable.gemm.tiles import Tile
from turbopi.kernels.portable.quantize import quantize
from turbopi.quantization.formats import INT8

class Driver:
    loaded = []
    utils = SimpleNamespace(
        load_binary=lambda name, code, *rest: Driver.loaded.append(code) or (1, 2, 32, 0, 1024),
        get_device_properties=lambda device: {"max_shared_mem": 232448},
    )
    launcher_cls = staticmethod(lambda *made: lambda *args, **more: None)
    get_current_device = get_current_stream = lambda self, *device: 0
    get_current_target = lambda self: GPUTarget("cuda", 90, 32)

def run():
    weight = quantize(torch.ones(64, 128, dtype=torch.bfloat16), 0.03, format=INT8)
    product(torch.zeros(64, 128, dtype=torch.int8), weight, tile=Tile(32, 64, 4, 6))
    return Driver.loaded[-1]

triton.runtime.driver.set_active(Driver())
assert run()[:4] == b"\\x7fELF"
for older in ((8, 0), (8, 6)):
    with compiled_as(Target(older)):
        code = run()
        assert capability(torch.device("cuda", 0)) == older
    assert b".target sm_%d%d" % older in code and code.endswith(bytes(1)), code[:300]
    assert run()[:4] == b"\\x7fELF", "it is itself again"
print(len(Driver.loaded))
"""


@pytest.mark.slow
def test_triton_compiles_ptx_for_the_older_gpu_and_then_for_its_own_again() -> None:
    pytest.importorskip("triton", reason="Triton isn't installed")
    environment = {key: value for key, value in os.environ.items() if key != "TRITON_INTERPRET"}
    environment["PYTHONPATH"] = f"{ROOT / 'src'}{os.pathsep}{ROOT / 'tools'}"
    done = subprocess.run([sys.executable, "-c", FAKED], capture_output=True, text=True, env=environment, cwd=ROOT)
    assert done.stdout.split() == ["5"], done.stderr


def row(same: bool, difference: float) -> RanAsPtx:
    return RanAsPtx("denoise.kernel", "one", "compute_80", "native build", difference, 0.006, same, 0.004)


@pytest.mark.parametrize(
    ("same", "difference", "good"),
    [(True, 0.0, True), (False, 0.006, True), (False, 0.0061, False), (False, math.nan, False)],
)
def test_results_may_be_apart_by_twice_the_native_error(same: bool, difference: float, good: bool) -> None:
    found = judged(row(same, difference))
    assert (found.problem is None) == good
    if not good:
        assert "more than 2 times its error" in str(found.problem) and found.error == 0.004


def test_another_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "some.json").write_text('{"rows": []}')
    with pytest.raises(ConfigError, match="provenance"):
        read_ptx(tmp_path / "some.json")


def test_a_targets_capability_is_read_from_its_name() -> None:
    assert (capability_of("compute_89"), capability_of("compute_120")) == ((8, 9), (12, 0))
