"""The tool that times variants of the denoising kernel: what a variant is, and samples beside the source."""

import lzma
import subprocess
from pathlib import Path
from typing import Any

import pytest
from conftest import on_hopper
from kernel_turns.problems import CONFIGS, has_nvrtc
from kernel_turns.stalls import Instruction, by_function, compiled, disassembled, functions, instructions, waits
from kernel_turns.turns import Job, marks_by_rank, time_in_turns
from kernel_turns.variants import Variant

from turbopi.kernels.sm90.denoise import kernel as denoise
from turbopi.kernels.sm90.denoise.packing import Arrangement

SIZES: dict[str, Any] = {"cache_rows": 976, "suffix": 50, "shared_bytes": 232448}


@pytest.fixture
def patch(tmp_path: Path) -> Path:
    """Of this tree's kernels: five staged streams, not four."""
    text = (denoise.FOLDER / "denoise/many/memory.cu").read_text()
    assert text.count("STAGED = 4;") == 1
    for name, version in (("a", text), ("b", text.replace("STAGED = 4;", "STAGED = 5;"))):
        (tmp_path / name / "src/turbopi/kernels/sm90/denoise/many").mkdir(parents=True)
        (tmp_path / name / "src/turbopi/kernels/sm90/denoise/many/memory.cu").write_text(version)
    command = ["git", "diff", "--no-index", "--no-prefix", "a", "b"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, check=False)
    file = tmp_path / "five.patch"
    file.write_bytes(done.stdout)
    return file


def test_a_patch_changes_its_variants_source_alone(patch: Path) -> None:
    packed = patch.with_name("five.patch.xz")
    packed.write_bytes(lzma.compress(patch.read_bytes()))
    for variant in (Variant(str(patch)), Variant(str(packed))):
        assert "STAGED = 5;" in variant.module.source(50, False)
    assert "STAGED = 4;" in Variant("here").module.source(50, False)


def test_constants_replace_or_join_the_kernels_own() -> None:
    arrangement = Arrangement(CONFIGS["full"])
    own = denoise.kernel_sizes(arrangement, **SIZES)
    sizes = Variant("here+TP_ROUND_FRAGMENTS=4+MORE=-1").sizes(arrangement, trace=12, **SIZES)
    assert sizes == {**own, "TP_ROUND_FRAGMENTS": 4, "MORE": -1, "TP_TRACED_WARP": 13} != own


def test_a_way_comes_behind_the_constants() -> None:
    variant = Variant("here+MORE=2@held")
    assert (variant.way, variant.constants) == ("held", {"MORE": 2}) and Variant("here").way is None


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        ("nowhere", "'nowhere': expected 'here', a folder"),
        ("here+TP_ROUND_FRAGMENTS=few", r"\+TP_ROUND_FRAGMENTS=few: expected \+NAME=VALUE"),
        ("here@times", "@times: expected @ and one of same, held, guided, distinct"),
    ],
)
def test_what_is_no_variant_is_refused_by_name(spec: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Variant(spec)


@pytest.mark.parametrize(("precision", "length"), [("fp7", 300), ("bf16", 977), ("bf16", 0)])
def test_what_is_no_job_is_refused_by_name(precision: str, length: int) -> None:
    with pytest.raises(ValueError, match=f"'{precision}', {length}: expected bf16 or fp8, 1 to 976"):
        Job(10, precision, length)


def test_a_folder_that_would_read_this_trees_sources_is_refused(tmp_path: Path) -> None:
    text = (denoise.FOLDER / "denoise/kernel.py").read_text()
    (tmp_path / "denoise").mkdir()
    (tmp_path / "denoise/kernel.py").write_text(text.replace("FOLDER", "ELSEWHERE"))
    with pytest.raises(ValueError, match="would read this tree's sources"):
        Variant(str(tmp_path))


def test_a_patch_of_other_sources_is_refused(patch: Path) -> None:
    patch.write_text(patch.read_text().replace("STAGED = 4;", "STAGED = 3;"))
    with pytest.raises(ValueError, match=r"five\.patch doesn't fit these kernels: .*denoise/many/memory\.cu"):
        Variant(str(patch))


SOURCE = """__device__ __forceinline__ float twice(float x) {
  return x + x;
}
extern "C" __global__ void __launch_bounds__(128, 1)
    turbopi_denoise(float* p) {
  *p = twice(*p);
}"""
LISTING = """.text.turbopi_denoise_prepare:
        /*0000*/                   EXIT ;
.text.turbopi_denoise:
\t//## File "kernel.cu", line 6
        /*0000*/                   LDG.E R0, [R2] ;
\t//## File "kernel.cu", line 2 inlined at "kernel.cu", line 6
\t//## File "kernel.cu", line 6
        /*0010*/                   FADD R0, R0, R0 ;
.section .other
        /*0000*/                   NOP ;
"""


def test_samples_lead_back_to_functions() -> None:
    code = instructions(LISTING)
    assert code == [Instruction("LDG.E R0, [R2]", [6]), Instruction("FADD R0, R0, R0", [2, 6])]
    rows = [
        ["Kernel Name", "turbopi_denoise"],
        ["Address", "Source", "Instructions Executed", "stall_long_sb", "stall_wait", "stall_wait (Not Issued)"],
        ["0x00", "LDG.E R0, [R2]", "40", "0", "1", "1"],
        ["0x10", "FADD R0, R0, R0", "80", "6", "2", "0"],
    ]
    found = waits(rows, code, interval=512, warps=20)
    assert [wait.cycles for wait in found] == [1 * 512 * 20 / 40, 8 * 512 * 20 / 80]
    names = functions(SOURCE)
    assert [names[line] for line in (2, 6)] == ["twice", "turbopi_denoise"]
    by_name = by_function(found, names)
    assert list(by_name) == ["twice", "-"] and by_name["twice"] == (8 * 512 * 20, {"long_sb": 6, "wait": 2})
    with pytest.raises(ValueError, match="1 sampled instructions, the kernel has 2"):
        waits(rows[:-1], code, 512, 20)
    with pytest.raises(ValueError, match="no row begins with 'Address'"):
        waits(rows[:1], code, 512, 20)


@pytest.mark.slow
@pytest.mark.skipif(not has_nvrtc(), reason="no NVRTC here")
def test_every_instruction_of_the_kernel_has_lines(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("triton")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    source, cubin, _ = compiled(Variant("here"), 10, fp8=False)
    code, names = instructions(disassembled(cubin, tmp_path, "-gi")), functions(source)
    assert len(code) > 1000 and all(instruction.lines for instruction in code)
    assert {"gate_up", "project", "attend", "gather"} <= {names[line] for one in code for line in one.lines}


@on_hopper
def test_a_variant_that_changes_nothing_computes_the_same() -> None:
    job, variants = Job(10, "bf16", 300), [Variant("here"), Variant("here+NOTHING=1")]
    rows = time_in_turns(job, variants, rounds=1, calls=2)
    assert all(row.same and row.error < 0.01 and row.milliseconds >= row.fastest > 0 for row in rows)
    assert (marks_by_rank(job, variants[0])[:, 0] > 0).all()
