"""The portable denoising kernel as PTX for older GPUs, which the driver of a newer one compiles."""

import math
from pathlib import Path

import pytest
import torch
from kernel_turns.problems import CONFIGS, GPU, has_nvrtc
from kernel_turns.ptx import CASES, Case, RanAsPtx, capability_of, compared, judged, read_ptx

from turbopi.errors import ConfigError
from turbopi.kernels import grid_barrier as barrier
from turbopi.kernels import nvrtc
from turbopi.kernels.portable.denoise import kernel as denoise
from turbopi.kernels.portable.denoise.packing import WeightNumbers

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


def row(same: bool, difference: float) -> RanAsPtx:
    return RanAsPtx("denoise.kernel", "one", "compute_80", same, difference, 0.004, 0.003)


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
