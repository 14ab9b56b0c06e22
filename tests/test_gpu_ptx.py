"""The portable denoising kernel as PTX for older GPUs, which the driver of a newer one compiles."""

import math
from pathlib import Path

import pytest
import torch
from kernel_turns.problems import CONFIGS, GPU, has_nvrtc
from kernel_turns.ptx import CASES, Case, RanAsPtx, compared, judged, read_ptx

from turbopi.errors import ConfigError
from turbopi.kernels.portable.denoise import kernel as denoise
from turbopi.kernels.portable.denoise.packing import WeightNumbers

NUMBERS: dict[str, list[WeightNumbers]] = {"compute_80": ["bf16", "int8"], "compute_89": ["fp8"]}


@pytest.mark.gpu
@pytest.mark.parametrize("case", CASES, ids=lambda case: f"{case.target} {case}")
def test_ptx_for_an_older_gpu_computes_what_the_native_build_does(case: Case) -> None:
    if torch.cuda.get_device_capability(GPU) < case.capability:
        pytest.skip(f"this GPU is older than {case.target}")
    assert compared(case).problem is None


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
