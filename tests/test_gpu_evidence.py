"""The checked-in result of the GPU tests belongs to the code as it is."""

from importlib.machinery import SourceFileLoader
from importlib.util import module_from_spec, spec_from_loader
from pathlib import Path
from types import ModuleType

import pytest
import torch

pytest.importorskip("triton", reason="Triton isn't installed")

import gpu_evidence
import machine_code

from turbopi import backends as registry
from turbopi.kernels import nvrtc

SOURCE = '''"""A module."""
# why
def scale(x: float) -> float:
    """Twice as much."""
    return 2 * x  # "twice"
'''
KERNEL = 'asm("// not a comment");  // a comment\n/* long\n   one */ int n = 2;\n'


def code(tmp_path: Path, name: str, text: str) -> str:
    (tmp_path / name).write_text(text)
    return gpu_evidence.code_of(tmp_path / name)


def test_a_checked_in_gpu_result_is_of_this_code() -> None:
    results = [gpu_evidence.read_result(file) for file in gpu_evidence.result_files()]
    whole = [one for one in results if one.ok and not one.tests.to_go]
    waiting = gpu_evidence.pending()
    recorded = [one.fingerprint for one in whole]
    if waiting is not None:  # conftest.py says so at the end of every run
        recorded.append(waiting.fingerprint)
    changed = min(map(gpu_evidence.changed_since, recorded), key=len)
    assert not changed, (
        f"{len(changed)} files differ from those that scripts/gpu_check saw: {', '.join(changed)}. Run it on a Hopper "
        "GPU and check its result in; where none can be had, scripts/gpu_check --pending REASON says so"
    )
    tested = [one for one in whole if not gpu_evidence.changed_since(one.fingerprint)]
    assert waiting is None or not tested, "nothing is pending: remove that file"


@pytest.mark.slow
def test_the_kernels_compile_to_the_machine_code_that_was_tested(cubins: Path) -> None:
    here = machine_code.machine_code(cubins)
    if here is None:
        pytest.skip("no NVRTC here: only the source's fingerprint is compared")
    known = [*map(gpu_evidence.read_result, gpu_evidence.result_files()), gpu_evidence.pending()]
    recorded = [one.machine_code for one in known if one is not None and one.machine_code]
    assert recorded, "no machine code was recorded: run scripts/gpu_check on a Hopper GPU"
    if all(one["NVRTC"] != here["NVRTC"] for one in recorded):
        versions = " and ".join(one["NVRTC"] for one in recorded)
        pytest.skip(
            f"recorded with NVRTC {versions}, here is {here['NVRTC']}: only the source's fingerprint is compared"
        )
    differing = [sorted(name for name in {*here, *one} if here.get(name) != one.get(name)) for one in recorded]
    assert [] in differing, f"machine code that no GPU has run: {differing}. Run scripts/gpu_check"


@pytest.mark.skipif(machine_code.compiler() is None, reason="no NVRTC here")
def test_a_comment_leaves_the_machine_code_as_it_is_and_another_number_does_not(cubins: Path) -> None:
    def hash_of(source: str) -> str:
        return machine_code.hash_of(nvrtc.compile_cubin(source, "sm_90a", {}, folder=cubins))

    source = 'extern "C" __global__ void f(float* x) { x[threadIdx.x] *= 3; }'
    assert hash_of(source) == hash_of(f"// why\n\n{source}")
    assert hash_of(source) != hash_of(source.replace("3", "5"))
    assert hash_of(source) != hash_of(source.replace("void f", "void __launch_bounds__(64) f"))


def test_comments_and_docstrings_do_not_count_and_all_else_does(tmp_path: Path) -> None:
    plain = "def scale(x: float) -> float:\n    return 2 * x"
    assert code(tmp_path, "a.py", SOURCE) == plain
    assert code(tmp_path, "a.py", SOURCE.replace("2 * x", "3 * x")) != plain
    assert code(tmp_path, "a.py", SOURCE.replace("why", "how").replace("Twice", "Two times")) == plain


RAISING = """def check(rows: int) -> str:
    if rows > 8:
        raise ValueError(
            f"é: {rows} rows",
            "at most 8",
            rows
        ) from None
    return "f32"
"""


def test_the_text_of_an_error_does_not_count_and_what_runs_does(tmp_path: Path) -> None:
    def running(text: str) -> str:
        (tmp_path / "a.py").write_text(text)
        return gpu_evidence.code_of(tmp_path / "a.py", errors=False)

    assert running(RAISING.replace("é: {rows} rows", "{rows} rows are too many").replace("at most", "≤")) == running(
        RAISING
    )
    for old, new in (("> 8", "> 9"), ('"f32"', '"bf16"'), ("ValueError", "TypeError"), ("rows\n", "rows + 1\n")):
        assert running(RAISING.replace(old, new)) != running(RAISING)


@pytest.mark.parametrize(
    "module",
    ["policy.policy", "policy.model_call", "cli.serve", "serve.worker", "support.errors", "checkpoint.lerobot"],
)
def test_files_of_the_host_are_not_in_the_fingerprint(module: str) -> None:
    name = f"src/turbopi/{module.replace('.', '/')}.py"
    assert (gpu_evidence.ROOT / name).is_file() and name not in gpu_evidence.fingerprint()


def test_a_result_file_is_named_by_gpu_and_date() -> None:
    assert gpu_evidence.result_file("NVIDIA H200", "2026-11-28").name == "h200_2026-11-28_gpu_check.json"
    assert (
        gpu_evidence.result_file("NVIDIA GeForce RTX 4090", "2027-01-02").name == "rtx_4090_2027-01-02_gpu_check.json"
    )


def test_kernels_comments_do_not_count_and_their_strings_do(tmp_path: Path) -> None:
    lean = code(tmp_path, "a.cu", KERNEL)
    assert "not a comment" in lean and "long" not in lean and "a comment\n" not in lean
    assert code(tmp_path, "a.cu", KERNEL.replace("int n = 2", "int n = 3")) != lean
    assert code(tmp_path, "a.cu", KERNEL.replace("long", "longer")) == lean


@pytest.mark.parametrize(
    "file",
    [
        *("kernels/portable/norms.py", "kernels/sm90/instructions.cu", "kernels/sm90/denoise/kernel.py"),
        *("kernels/sm90/denoise/few/loop.cu", "kernels/sm90/gemm/fp8.py", "kernels/sm90/gemm/kernel.cu"),
        *("backends/fused.py", "backends/cuda_graph.py", "engine/call.py", "models/pi0/reference.py"),
        *("models/observation.py", "backends/tensorrt/backend.py", "backends/expert_store.py"),
    ],
)
def test_what_runs_on_the_gpu_is_in_the_fingerprint(file: str) -> None:
    assert f"src/turbopi/{file}" in gpu_evidence.fingerprint()


def test_a_backend_that_is_not_in_the_fingerprint_refuses_every_gpu() -> None:
    backends = {spec.module: spec.name for spec in registry.BACKENDS.values()}
    spared = [name for module, name in backends.items() if module in gpu_evidence.HOST_ONLY]
    assert spared == ["onnx"]
    for name in spared:
        assert f"src/turbopi/backends/{name}/backend.py" not in gpu_evidence.fingerprint()
        assert "use device 'cpu'" in str(registry.availability(name, torch.device("cuda")))
    recorded = gpu_evidence.fingerprint()
    assert gpu_evidence.changed_since(recorded | {"src/turbopi/backends/onnx/backend.py": "other"}) == []
    assert gpu_evidence.changed_since(recorded | {"src/turbopi/backends/fused.py": "other"}) != []


def test_whatever_those_files_import_is_in_the_fingerprint_or_runs_on_the_host_alone() -> None:
    assert gpu_evidence.uncovered_imports() == {}


def script() -> ModuleType:
    """scripts/gpu_check, whose name has no ending."""
    loader = SourceFileLoader("gpu_check_script", str(gpu_evidence.ROOT / "scripts" / "gpu_check"))
    spec = spec_from_loader(loader.name, loader)
    assert spec is not None
    module = module_from_spec(spec)
    loader.exec_module(module)
    return module


TESTS = ["a.py::one", "a.py::two[x]", "b.py::three", "b.py::four", "c.py::five"]


def test_a_second_run_repeats_what_failed_and_files_that_count_anew_and_counts_each_test_once() -> None:
    gpu_check = script()
    before = gpu_evidence.GpuTests(6, 3, 0, 1, 10.0, ["two[x]", "four", "gone"])
    left, repeated = gpu_check.left_of(TESTS, before, ["b.py"])
    assert left == ["a.py::two[x]", "b.py::three", "b.py::four"] and repeated == 1
    now = gpu_evidence.GpuTests(3, 1, 0, 0, 2.0, ["four"])
    assert gpu_check.added(before, now, repeated) == gpu_evidence.GpuTests(5, 1, 0, 1, 12.0, ["four"])
    nothing_left = gpu_check.added(before, None, 0)
    assert (nothing_left.tests, nothing_left.failures, nothing_left.failed) == (3, 0, [])


def test_a_run_that_was_cut_off_goes_on_with_what_is_left_and_what_failed() -> None:
    gpu_check = script()
    before = gpu_evidence.GpuTests(2, 1, 0, 1, 9.0, ["one"], TESTS[2:], {"a.py": 8.0})
    left, repeated = gpu_check.left_of(TESTS, before, [])
    assert (left, repeated) == ([TESTS[0], *TESTS[2:]], 0)
    cut_again = gpu_check.added(before, gpu_evidence.GpuTests(2, 0, 0, 0, 3.0, [], TESTS[4:], {"a.py": 1.0}), repeated)
    assert (cut_again.tests, cut_again.failures, cut_again.to_go) == (3, 0, TESTS[4:])
    whole = gpu_check.added(cut_again, gpu_evidence.GpuTests(2, 0, 0, 0, 1.0, [], file_seconds={"c.py": 1.0}), 0)
    assert (whole.tests, whole.to_go, whole.file_seconds) == (5, [], {"a.py": 8.0, "c.py": 1.0})


def test_a_run_begins_with_what_takes_longest_in_parts_of_a_minute_or_two() -> None:
    slow, quick = [f"slow.py::{number}" for number in range(6)], [f"quick.py::{number}" for number in range(70)]
    parts = script().in_parts([*quick, "new.py::test", *slow], {"slow.py": 240.0, "quick.py": 35.0, "gone.py": 300.0})
    assert parts == [["new.py::test"], slow[:2], slow[2:4], slow[4:], quick[:50], quick[50:]]
