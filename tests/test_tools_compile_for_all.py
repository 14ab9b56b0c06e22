"""A few kernels compiled for GPUs that aren't here; the whole is `python -m compile_for_all`, whose result is kept."""

import json
import lzma
import os
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("triton", reason="Triton isn't installed")

from compile_for_all.allowed import ALLOWED, allowed
from compile_for_all.document import Compiled, CompiledForAll, read_compiled, replaced, write_compiled
from compile_for_all.targets import TARGETS, over_limit

from turbopi.support.errors import ConfigError

ROOT = Path(__file__).parents[1]
ALL = {"sm_80", "sm_86", "sm_87", "sm_89", "sm_90a", "sm_100a", "sm_103a", "sm_110a", "sm_120a", "sm_121a"}


def ours(*arguments: str) -> subprocess.CompletedProcess[str]:
    """Apart from the tests' own process, in which Triton interprets."""
    environment = {key: value for key, value in os.environ.items() if key != "TRITON_INTERPRET"}
    environment["PYTHONPATH"] = f"{ROOT / 'src'}{os.pathsep}{ROOT / 'tools'}"
    command = [sys.executable, *arguments]
    return subprocess.run(command, capture_output=True, text=True, env=environment, cwd=ROOT)


def compiled(tmp_path: Path, *arguments: str) -> CompiledForAll:
    file = tmp_path / "compiled.json"
    done = ours("-m", "compile_for_all", "--processes", "1", "--json", str(file), *arguments)
    assert file.is_file(), done.stdout + done.stderr
    assert all(len(line) <= 80 for line in done.stdout.splitlines())
    return read_compiled(file)


@pytest.mark.slow
def test_the_chosen_products_compile_and_fit(tmp_path: Path) -> None:
    result = compiled(tmp_path, "--targets", "89", "--kernels", "gemm", "--chosen")
    assert len(result.rows) > 5 and result.versions["triton"]
    assert [row for row in result.rows if row.problem or row.refused] == []
    assert all(row.registers and not row.spilled for row in result.rows)


@pytest.mark.slow
def test_fp8_is_refused_below_8_9_with_the_reason(tmp_path: Path) -> None:
    result = compiled(tmp_path, "--targets", "80", "--kernels", "gemm", "--chosen")
    refused = [row for row in result.rows if row.refused]
    assert len(refused) == 1 and "from compute capability 8.9 on" in str(refused[0].refused)
    assert not any("fp8" in row.variant for row in result.rows)
    fit = [row for row in result.rows if row.registers and not row.problem]
    assert len(fit) == len(result.rows) - 1 > 5, "INT8's, in their place"


@pytest.mark.slow
def test_every_triton_kernel_is_among_the_calls() -> None:
    done = ours(
        "-c",
        "import json; from compile_for_all import calls, compiling, launches, targets;"
        "gpus = targets.TARGETS[4], targets.TARGETS[-1];"  # Hopper, and one with NVFP4
        "found = {one.name for gpu in gpus for one in launches.launches(gpu, calls.all_calls(gpu))};"
        "print(json.dumps(sorted(compiling.triton_kernels() - found)), len(found))",
    )
    left, count = done.stdout.rsplit(" ", 1)
    assert json.loads(left) == [] and int(count) > 15, done.stderr


@pytest.mark.slow
def test_weights_are_rounded_to_every_format_on_every_gpu(tmp_path: Path) -> None:
    """Triton has no E4M3 below 8.9, and `turbopi calibrate` needs none of the hardware."""
    result = compiled(tmp_path, "--targets", "80", "--kernels", "rounding.feedback")
    assert [row for row in result.rows if row.problem or row.refused] == []
    numbers = {frozenset(row.variant.split("num_warps=1 ")[1].split()) for row in result.rows}
    assert numbers == {
        frozenset({"fp32", "i64", stored, *weights}) for weights in (["bf16"], []) for stored in ("u8", "i8")
    }


@pytest.mark.slow
def test_nvfp4_compiles_where_triton_lowers_it_as_another_gpus(tmp_path: Path) -> None:
    result = compiled(tmp_path, "--targets", "121,90", "--kernels", "nvfp4")
    assert [row for row in result.rows if row.problem or row.refused] == []
    assert {row.target for row in result.rows} == {"sm_121a"} and len(result.rows) == 6


def test_another_instruction_in_its_place_is_a_problem() -> None:
    done = ours(
        "-c",
        "from compile_for_all.compiling import INSTRUCTIONS, without_instruction;"
        "name, wanted = 'nvfp4.product', INSTRUCTIONS['nvfp4.product'];"
        "print(without_instruction(name, 'wgmma'), without_instruction(name, wanted), without_instruction('a', ''))",
    )
    assert done.stdout.strip() == "its PTX has no kind::mxf4nvf4.block_scale.scale_vec::4X None None", done.stderr


def test_the_checked_in_result_has_nvfp4_on_blackwell_alone_without_spills() -> None:
    every = read_compiled(ROOT / "benchmarks/results/compiled_for_all.json.xz").rows
    rows = [row for row in every if "nvfp4" in row.kernel]
    assert {row.target for row in rows} == {"sm_100a", "sm_103a", "sm_110a", "sm_120a", "sm_121a"}
    assert {row.kernel for row in rows} == {"nvfp4.round", "nvfp4.product"} and not any(row.spilled for row in rows)


def test_the_checked_in_result_has_e4m3_only_where_triton_has_it() -> None:
    rows = read_compiled(ROOT / "benchmarks/results/compiled_for_all.json.xz").rows
    assert {row.target for row in rows if "fp8e4nv" in row.variant} == ALL - {"sm_80", "sm_86", "sm_87"}
    int8 = {row.target for row in rows if row.kernel == "gemm.kernel.product" and row.variant.endswith(" i8")}
    assert int8 == ALL - {"sm_100a", "sm_103a", "sm_110a"}, "as `int8_refusal` has it"
    rounded = {row.target for row in rows if row.kernel == "rounding.feedback" and " u8" in row.variant}
    assert rounded == ALL


@pytest.mark.slow
def test_the_checked_in_result_has_every_cuda_kernel() -> None:
    done = ours(
        "-c",
        "import json; from compile_for_all import compiling, targets;"
        "print(json.dumps([[one.arch, name] for one in targets.TARGETS for name, _ in compiling.cuda_kernels(one)]))",
    )
    assert done.returncode == 0, done.stderr
    rows = read_compiled(ROOT / "benchmarks/results/compiled_for_all.json.xz").rows
    found = {(row.target, row.kernel) for row in rows}
    assert [one for one in map(tuple, json.loads(done.stdout)) if one not in found] == []


def test_what_is_over_a_limit_is_named() -> None:
    ada = next(target for target in TARGETS if target.number == 89)
    assert over_limit(ada, 255, 99 * 1024, 256) is None
    assert "bytes of shared memory; sm_89 gives a block 101376" in str(over_limit(ada, 32, 99 * 1024 + 1, 256))
    assert "registers in 512 threads" in str(over_limit(ada, 255, 0, 512))


def test_all_targets_are_there() -> None:
    assert {target.arch for target in TARGETS} == ALL


def test_the_checked_in_result_has_every_target_and_no_problem() -> None:
    result = read_compiled(ROOT / "benchmarks/results/compiled_for_all.json.xz")
    assert {row.target for row in result.rows} == ALL
    assert [row for row in result.rows if row.problem] == []
    assert {row.kernel for row in result.rows if row.refused} == {"gemm.kernel.product, FP8"}


def test_the_checked_in_result_is_as_it_was_written(tmp_path: Path) -> None:
    file = ROOT / "benchmarks/results/compiled_for_all.json.xz"
    again = tmp_path / file.name
    write_compiled(again, read_compiled(file))
    assert lzma.decompress(again.read_bytes()) == lzma.decompress(file.read_bytes())


@pytest.mark.parametrize(("kernel", "number"), [(kernel, number) for kernel in ALLOWED for number in ALLOWED[kernel]])
def test_what_may_spill_is_what_does(kernel: str, number: int) -> None:
    """A bound that nothing needs any more is taken down."""
    rows = read_compiled(ROOT / "benchmarks/results/compiled_for_all.json.xz").rows
    (arch,) = (target.arch for target in TARGETS if target.number == number)
    most = max(row.spilled for row in rows if row.kernel.startswith(kernel) and row.target == arch)
    assert most == ALLOWED[kernel][number] == allowed(f"{kernel}, H=10", number)


def test_what_is_not_named_may_not_spill() -> None:
    assert allowed("attention.vision", 90) == allowed("batch.packed", 80) == 0


def test_rows_of_some_kernels_are_replaced_and_the_others_stay() -> None:
    def row(kernel: str, target: str, registers: int) -> Compiled:
        return Compiled(kernel, "", target, registers)

    versions = {"nvrtc": "13", "ptxas of 11.0": "13.5"}
    before = CompiledForAll(
        "then", versions, [row("a", "sm_80", 1), row("sm90: b", "sm_90a", 2), row("c", "sm_90a", 3)]
    )
    now = CompiledForAll("now", versions | {"ptxas of 11.0": "12.9"}, [row("sm90: d", "sm_90a", 4)])
    found = replaced(before, now, {"sm_90a"}, "sm90: ")
    assert found.date == "now" and found.versions == versions
    assert found.rows == [row("a", "sm_80", 1), row("c", "sm_90a", 3), row("sm90: d", "sm_90a", 4)]
    other = CompiledForAll("now", versions | {"nvrtc": "14"}, [])
    with pytest.raises(ConfigError, match="nvrtc 13, here 14"):
        replaced(before, other, {"sm_90a"}, "")
