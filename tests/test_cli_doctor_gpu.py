"""`turbopi doctor` on GPUs that aren't here: faked devices, and the backends' own answers about them."""

import json
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from cli_helpers import refusal, turbopi
from tile_helpers import tile_document, verdict

from turbopi import backends
from turbopi.backends import Precision, qualification, qualifying, tuned_tiles
from turbopi.backends.qualification import Verdict
from turbopi.bench.measured import measured_calls
from turbopi.cli import doctor, gpu_checkups
from turbopi.cli.checkup import Row
from turbopi.cli.typed import as_typed
from turbopi.support.errors import BackendUnavailable

CAPABILITIES = [(8, 0), (8, 6), (8, 7), (8, 9), (9, 0), (10, 0), (11, 0), (12, 0)]
ALL_CODE = ["sm_80", "sm_86", "sm_90", "sm_100", "sm_110", "sm_120"]
Fake = Callable[..., None]


@pytest.fixture
def cache(tmp_path: Path) -> Path:
    """In place of the user's."""
    return tmp_path / "cache"


@pytest.fixture
def fake(monkeypatch: pytest.MonkeyPatch, cache: Path) -> Fake:
    """Pretends that there is one NVIDIA GPU, and all that PyTorch and Triton need to run on it."""

    def pretend(
        capability: tuple[int, int],
        memory_gb: float = 80.0,
        *,
        integrated: bool = False,
        code: list[str] = ALL_CODE,
        cuda: str = "13.0",
        driver: str = "580.95.05",
        ptxas: str | None = "13.0",
        nvrtc: list[int] | None = None,
        bindings: str | None = "13.3.1",
        lacking: tuple[str, ...] = (),
    ) -> None:
        properties = types.SimpleNamespace(
            name="NVIDIA Fake",
            major=capability[0],
            minor=capability[1],
            total_memory=memory_gb * 1e9,
            multi_processor_count=100,
            is_integrated=integrated,
        )
        monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
        monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
        monkeypatch.setattr(torch.cuda, "get_device_properties", lambda index: properties)
        monkeypatch.setattr(torch.cuda, "get_device_capability", lambda device=None: capability)
        monkeypatch.setattr(torch.cuda, "get_arch_list", lambda: code)
        monkeypatch.setattr(qualification, "KNOWN", ("NVIDIA Fake",) if capability == (9, 0) else ())
        monkeypatch.setattr(qualification, "cache_folder", lambda: cache)
        monkeypatch.setattr(qualification, "_driver", lambda: driver)
        monkeypatch.setattr(torch.version, "cuda", cuda)
        monkeypatch.setattr(gpu_checkups, "nvidia_smi", lambda: (driver, ["NVIDIA Fake"]))
        monkeypatch.setattr(gpu_checkups, "ptxas_version", lambda arch: ptxas)
        known = [10 * capability[0] + capability[1]] if nvrtc is None else nvrtc
        monkeypatch.setattr(gpu_checkups, "nvrtc_capabilities", lambda: known)
        monkeypatch.setattr(gpu_checkups, "installed", lambda package: bindings)
        find = lambda name, *rest: None if name in lacking else object()  # noqa: E731
        monkeypatch.setattr("importlib.util.find_spec", find)
        monkeypatch.setattr("shutil.which", lambda name: f"/usr/bin/{name}")
        monkeypatch.setattr("turbopi.support.toolchain._missing_headers", lambda: None)
        monkeypatch.setattr(tuned_tiles, "driver_version", lambda: driver)
        monkeypatch.setattr(tuned_tiles, "cache_folder", lambda: cache)

    return pretend


def rows() -> dict[str, Row]:
    found = {row.name: row for row in gpu_checkups.check_gpu()}
    for row in found.values():
        assert bool(row.fix) == (row.level != "OK"), row
        assert "\n" not in row.found + row.fix
    return found


def measured_gb(backend: str, precision: str) -> float | None:
    """The most that such calls of one observation were measured to reserve on a GPU."""
    found = [
        call.device_bytes / 1e9
        for call in measured_calls()
        if (call.backend, call.precision, call.job.batch) == (backend, precision, 1) and call.device_bytes
    ]
    return max(found, default=None)


@pytest.mark.parametrize("capability", CAPABILITIES)
def test_what_runs_is_what_the_backends_say(capability: tuple[int, int], fake: Fake) -> None:
    fake(capability)
    found, device = rows(), torch.device("cuda", 0)
    assert found["GPU 0"].level == found["NVIDIA driver"].level == found["CUDA"].level == "OK"
    assert f"compute capability {capability[0]}.{capability[1]}, 80 GB" in found["GPU 0"].found
    tiers: tuple[Precision, ...] = ("bf16", "fp8")
    for precision in tiers:
        row = found[f"GPU 0 {precision}"]
        chosen = backends.choose(device, precision)[0]
        try:
            backends.check(chosen, device, precision)
        except BackendUnavailable as error:
            refused: str | None = str(error)
        else:
            refused = None
        if refused is not None:
            assert row == Row("OK", row.name, f"doesn't run: {as_typed(refused)}")
        else:
            assert row.level == "OK" and row.found.startswith(f"{chosen}: ")
            assert ("isn't qualified on this GPU" in row.found) == (capability != (9, 0))
            took = measured_gb(chosen, precision)
            assert took is None or f"takes {took + gpu_checkups.CONTEXT_GB:.1f} GB" in row.found


def test_every_tier_but_the_small_ones_has_a_row(fake: Fake) -> None:
    fake((9, 0))
    reported = {name.removeprefix("GPU 0 ") for name in rows() if name.startswith("GPU 0 ")}
    assert reported == {"tiles", "known", "bf16", "fp8", "int8"}


@pytest.mark.parametrize(
    ("lacking", "fix"), [("triton", "pip install triton"), ("cuda.bindings", "pip install cuda-python")]
)
def test_a_missing_package_comes_with_its_command(lacking: str, fix: str, fake: Fake) -> None:
    fake((9, 0), lacking=(lacking,))
    found = rows()
    assert (found["GPU 0 bf16"].level, found["GPU 0 bf16"].fix) == ("WARN", fix)
    assert (found["GPU 0 fp8"].level, found["GPU 0 fp8"].fix) == ("WARN", fix)


def test_a_missing_compiler_comes_with_its_command(fake: Fake, monkeypatch: pytest.MonkeyPatch) -> None:
    fake((9, 0))
    monkeypatch.setattr("shutil.which", lambda name: None)
    assert rows()["GPU 0 fp8"].fix == "apt-get install g++ python3-dev"


# --- a GPU that no test ran on ---


def qualify(monkeypatch: pytest.MonkeyPatch, found: Verdict, *options: str) -> tuple[int, dict[str, Any]]:
    """Exit code and JSON of `turbopi doctor --qualify` where the process finds that."""
    monkeypatch.setattr("turbopi.cli.checkups.check_gpu", list)
    monkeypatch.setattr(backends, "refusal", lambda *given: None)
    monkeypatch.setattr(backends, "resolve_device", lambda device: torch.device("cuda", 0))
    monkeypatch.setattr(doctor, "list_backends", lambda *_: {})
    monkeypatch.setattr(qualifying, "_verdict", lambda *given: found)
    monkeypatch.setattr(qualifying, "_attempt", lambda *given: qualifying._Run(finished=True))
    result = turbopi("doctor", "--qualify", "--json", *options)
    return result.exit_code, json.loads(result.stdout)


def test_doctor_qualifies_once_and_by_force_again(fake: Fake, monkeypatch: pytest.MonkeyPatch) -> None:
    fake((8, 9))
    assert "isn't qualified yet" in rows()["GPU 0 known"].found
    _, first = qualify(monkeypatch, verdict(reason="right; fused 20.00 ms"))
    assert first["qualification"]["reason"] == "right; fused 20.00 ms" and Path(first["file"]).is_file()
    _, second = qualify(monkeypatch, verdict(reason="other"))
    assert second["qualification"]["reason"] == "right; fused 20.00 ms"
    _, third = qualify(monkeypatch, verdict(reason="other"), "--force")
    assert third["qualification"]["reason"] == "other"
    row = rows()["GPU 0 known"]
    assert row.level == "OK" and row.found.startswith("fused for pi05_base in bf16, qualified 2026-11-29: other; ")


def test_doctor_says_what_to_do_about_a_fault(fake: Fake, monkeypatch: pytest.MonkeyPatch) -> None:
    fake((8, 9))
    _, document = qualify(monkeypatch, verdict(excluded={"denoise": "it hangs"}))
    row = rows()["GPU 0 known"]
    assert row.level == "WARN" and row.fix.endswith(
        f"attach the file that `turbopi doctor --qualify` wrote: {document['file']}"
    )
    assert refusal(turbopi("doctor", "--force")) == "--force goes with --qualify"


def test_qualifying_without_a_gpu_says_that_it_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    needs = "--qualify tries backend fused on an NVIDIA GPU, and"
    assert refusal(turbopi("doctor", "--qualify")) == f"{needs} there is none here; `turbopi doctor` says why"
    assert refusal(turbopi("doctor", "--qualify", "--device", "cpu")) == f"{needs} --device cpu isn't one"


def test_a_known_gpu_is_said_to_be_one(fake: Fake) -> None:
    fake((9, 0))
    assert rows()["GPU 0 known"].level == "OK"


# --- memory -----------------------------------------------------------------------------------------------------------


def test_a_laptop_of_8_gb_is_told_what_full_size_takes(fake: Fake) -> None:
    fake((8, 9), 8.0)
    took = measured_gb(backends.choose(torch.device("cuda", 0), "bf16")[0], "bf16")
    assert took is not None
    row = rows()["GPU 0 bf16"]
    assert (row.level == "WARN") == (took + gpu_checkups.CONTEXT_GB > 8.0)
    fake((8, 9), 6.0)
    row = rows()["GPU 0 bf16"]
    assert row.level == "WARN" and "more than there is" in row.found
    assert row.fix.endswith("GB or more; --random-weights pi05_tiny runs here") or "--precision" in row.fix


def test_where_bf16_does_not_fit_and_fp8_does_fp8_is_proposed(fake: Fake) -> None:
    bf16, fp8 = (measured_gb("fused", precision) for precision in ("bf16", "fp8"))
    assert bf16 is not None and fp8 is not None and fp8 < bf16
    fake((9, 0), (bf16 + fp8) / 2 + gpu_checkups.CONTEXT_GB)
    found = rows()
    size = f"({fp8 + gpu_checkups.CONTEXT_GB:.1f} GB)"
    assert found["GPU 0 bf16"].fix == f"turbopi calibrate CHECKPOINT --precision fp8, then --precision fp8 {size}"
    assert found["GPU 0 fp8"].level == "OK"


def test_an_orin_of_32_gb_shares_its_memory_and_has_enough(fake: Fake) -> None:
    fake((8, 7), 32.0, integrated=True, ptxas="12.8")
    found = rows()
    assert found["GPU 0"].found.endswith("32 GB, the host's memory")
    assert found["GPU 0 bf16"].level == "OK"


# --- drivers, CUDA 12 and 13, compilers -------------------------------------------------------------------------------

GPU_CASES = [
    ((9, 0), ["sm_80", "sm_90"], False, "OK", ""),
    ((8, 6), ["sm_80", "sm_90"], False, "OK", ""),
    ((12, 0), ["sm_90", "compute_90"], False, "OK", ""),
    ((12, 0), ["sm_80", "sm_90"], False, "FAIL", gpu_checkups._CUDA_13),
    ((11, 0), ["sm_80", "sm_90"], True, "FAIL", gpu_checkups._JETSON),
    ((8, 0), ["sm_86"], False, "FAIL", gpu_checkups._CUDA_13),
    ((7, 5), ["sm_75"], False, "WARN", "bfloat16 is slow below 8.0 (Ampere): use a newer GPU"),
]


@pytest.mark.parametrize(("capability", "code", "shared", "level", "fix"), GPU_CASES)
def test_a_gpu_is_judged_by_capability_and_code(
    capability: tuple[int, int], code: list[str], shared: bool, level: str, fix: str
) -> None:
    row = gpu_checkups.judge_gpu(0, "Some GPU", capability, 24, code, shared=shared)
    assert (row.level, row.fix) == (level, fix)
    assert row.found.startswith(f"Some GPU, compute capability {capability[0]}.{capability[1]}, 24 GB")


def test_nothing_more_is_asked_of_a_gpu_without_code(fake: Fake) -> None:
    fake((12, 0), code=["sm_80", "sm_90"])
    assert [name for name in rows() if name.startswith("GPU")] == ["GPU 0"]


@pytest.mark.parametrize(
    ("cuda", "driver", "names", "board", "found", "fix"),
    [
        (
            None,
            "570.1",
            ["NVIDIA H200"],
            None,
            "this PyTorch is built without CUDA",
            "delete .venv and run scripts/setup",
        ),
        ("12.8", "570.1", ["NVIDIA H200"], None, "PyTorch (CUDA 12.8) can't use it", "see that CUDA_VISIBLE_DEVICES"),
        ("13.0", "570.1", ["NVIDIA H200"], None, "driver 570.1 is too old", f"{gpu_checkups._CUDA_12} (or update"),
        ("13.0", "470.2", ["NVIDIA A100"], None, "CUDA 13.0 needs 580 or newer", "update the NVIDIA driver to 580"),
        ("12.8", "470.2", ["NVIDIA A100"], None, "CUDA 12.8 needs 525 or newer", "update the NVIDIA driver to 525"),
        (None, None, [], "NVIDIA Jetson AGX Orin", "NVIDIA Jetson AGX Orin, but this PyTorch", "docker build "),
    ],
)
def test_a_gpu_that_pytorch_cannot_use_fails_with_one_thing_to_do(
    cuda: str | None, driver: str | None, names: list[str], board: str | None, found: str, fix: str
) -> None:
    row = gpu_checkups.no_gpu(cuda, driver, names, board)
    assert row.level == "FAIL"
    assert (board or names[0]) in row.found
    assert found in row.found
    assert row.fix.startswith(fix)


def test_a_driver_that_works_though_it_is_too_old_is_a_warning(fake: Fake) -> None:
    fake((9, 0), cuda="13.0", driver="550.54.15")
    row = rows()["NVIDIA driver"]
    assert row.level == "WARN" and "CUDA 13.0 needs 580 or newer" in row.found
    assert row.fix.startswith(gpu_checkups._CUDA_12)
    fake((9, 0), cuda="12.8", driver="550.54.15")
    assert rows()["NVIDIA driver"].level == "OK"


def test_wheels_of_cuda_12_and_13_side_by_side_are_told(fake: Fake) -> None:
    fake((9, 0), cuda="12.8", bindings="13.3.1")
    row = rows()["CUDA"]
    assert row.level == "WARN" and row.fix == "pip install 'cuda-bindings==12.*'"
    fake((9, 0), cuda="12.8", bindings="12.9.1")
    assert rows()["CUDA"].level == "OK"
    fake((9, 0), cuda="12.8", bindings=None)
    assert rows()["CUDA"].level == "OK"


@pytest.mark.parametrize(
    ("capability", "ptxas", "good"),
    [
        ((12, 0), "12.8", True),
        ((12, 0), "12.6", False),
        ((12, 0), None, False),
        ((11, 0), "12.9", False),
        ((11, 0), "13.0", True),
        ((10, 0), "12.9", True),
        ((8, 9), "12.8", True),
        ((8, 9), None, False),
    ],
)
def test_a_ptxas_that_does_not_know_the_gpu_is_told(
    capability: tuple[int, int], ptxas: str | None, good: bool, fake: Fake
) -> None:
    fake(capability, ptxas=ptxas)
    row = rows().get("GPU 0 code")
    assert (row is None) == good
    if row is not None:
        variable = "TRITON_PTXAS_BLACKWELL_PATH" if capability >= (10, 0) else "TRITON_PTXAS_PATH"
        assert row.fix.startswith("pip install --no-deps 'nvidia-cuda-nvcc>=13,<14' && export " + variable)
        assert row.fix.endswith("nvidia/cu13/bin/ptxas'")


def test_an_nvrtc_that_does_not_know_the_gpu_is_told(fake: Fake) -> None:
    fake((12, 0), nvrtc=[80, 90])
    row = rows()["GPU 0 code"]
    assert row == Row("WARN", "GPU 0 code", "NVRTC knows no compute capability 12.0", row.fix)
    fake((12, 0), nvrtc=[])
    assert "GPU 0 code" not in rows(), "it isn't there: fused says so"


def test_the_compilers_that_are_here_say_what_they_know() -> None:
    pytest.importorskip("triton")
    version = gpu_checkups.ptxas_version(80)
    assert version is None or version[0].isdigit()
    assert 80 in gpu_checkups.nvrtc_capabilities() or not gpu_checkups.nvrtc_capabilities()


def test_a_jetson_is_known_by_its_device_tree(tmp_path: Any) -> None:
    model = tmp_path / "model"
    assert gpu_checkups.jetson(model) is None
    model.write_bytes(b"NVIDIA Jetson AGX Orin Developer Kit\0")
    assert gpu_checkups.jetson(model) == "NVIDIA Jetson AGX Orin Developer Kit"
    model.write_bytes(b"Raspberry Pi 5\0")
    assert gpu_checkups.jetson(model) is None


@pytest.mark.parametrize(
    ("reason", "command"),
    [
        ("its kernels are written in Triton, which isn't installed; `pip install triton`", "pip install triton"),
        ("no C compiler (on Debian and Ubuntu: apt-get install g++ python3-dev)", "apt-get install g++ python3-dev"),
        ("its tensor cores have no FP8: that begins with 8.9, this GPU has 8.0; use 'bf16'", ""),
    ],
)
def test_the_command_of_a_reason_is_found(reason: str, command: str) -> None:
    assert gpu_checkups.command_in(reason) == command


# --- tiles ------------------------------------------------------------------------------------------------------------


def test_doctor_says_whose_tiles_are_in_use_and_from_when(
    fake: Fake, cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fake((8, 9))
    assert "the kernels' own tables and cost model choose; `turbopi tune` measures" in rows()["GPU 0 tiles"].found
    machine = tuned_tiles.Machine("NVIDIA Fake", (8, 9), 100, "580.95.05", "3.6.0")
    file = tuned_tiles.own_file(machine.gpu)
    document = tile_document(machine)
    tuned_tiles.write_tile_file(document, file)
    found = rows()["GPU 0 tiles"]
    assert found.level == "OK" and found.found == f"1 tile of {document.date} (measured here, {file})"
    monkeypatch.setenv("TURBOPI_TUNED", "off")
    assert rows()["GPU 0 tiles"].found.endswith("but TURBOPI_TUNED=off has them ignored")


def test_doctor_names_a_file_of_another_driver_and_the_command(fake: Fake) -> None:
    fake((8, 9), driver="580.95.05")
    before = tuned_tiles.Machine("NVIDIA Fake", (8, 9), 100, "570.1", "3.6.0")
    tuned_tiles.write_tile_file(tile_document(before), tuned_tiles.own_file(before.gpu))
    found = rows()["GPU 0 tiles"]
    assert (found.level, found.fix) == ("WARN", "turbopi tune")
    assert "measured with driver 570.1, and here it is 580.95.05" in found.found
