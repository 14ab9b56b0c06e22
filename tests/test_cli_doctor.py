"""`turbopi doctor`."""

import json
import socket
import types
from importlib import metadata
from pathlib import Path
from typing import Any

import pi0_fast_golden
import pytest
import torch
from cli_helpers import refusal, text_of, turbopi

from turbopi import backends
from turbopi.backends.pytorch_compile import PyTorchCompileBackend
from turbopi.checkpoint import write_random
from turbopi.cli import checkups, gpu_checkups
from turbopi.cli.checkup import Row
from turbopi.preprocess.tokenizer import TINY_TOKENIZER


def doctor(*arguments: object) -> tuple[int, dict[str, dict[str, str]]]:
    """Exit code, and the rows by name."""
    result = turbopi("doctor", "--json", *arguments)
    document = json.loads(result.stdout)
    assert document["ok"] == (result.exit_code == 0)
    assert (
        document["system"]["packages"]["numpy"] == metadata.version("numpy")
        and "Linux" in document["system"]["platform"]
    )
    return result.exit_code, {row["name"]: row for row in document["checks"]}


@pytest.fixture
def cpu_only(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """A machine without a GPU, without PaliGemma's tokenizer, and with nothing else to do."""
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(gpu_checkups, "nvidia_smi", lambda: (None, []))
    monkeypatch.setattr(gpu_checkups, "jetson", lambda: None)
    monkeypatch.setattr("psutil.getloadavg", lambda: (0.5, 0.5, 0.5))
    monkeypatch.setattr("shutil.disk_usage", lambda folder: types.SimpleNamespace(free=100e9))
    monkeypatch.setenv("OPENPI_DATA_HOME", str(tmp_path))


@pytest.mark.usefixtures("cpu_only")
def test_a_machine_without_a_gpu_is_warned_about_and_passes() -> None:
    code, rows = doctor()
    assert code == 0
    assert rows["GPU"]["level"] == "WARN"
    assert rows["GPU"]["found"] == "no NVIDIA GPU"
    assert rows["Python"]["level"] == rows["PyTorch"]["level"] == rows["disk"]["level"] == "OK"
    for row in rows.values():
        assert row["found"]
        assert bool(row["fix"]) == (row["level"] != "OK"), row
        assert "\n" not in row["fix"]


@pytest.mark.usefixtures("cpu_only")
def test_a_disk_without_room_for_a_checkpoint_is_warned_about(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("shutil.disk_usage", lambda folder: types.SimpleNamespace(free=3e9))
    code, rows = doctor()
    assert code == 0 and rows["disk"]["level"] == "WARN"
    assert "3 GB free" in rows["disk"]["found"] and "free some" in rows["disk"]["fix"]


@pytest.mark.usefixtures("cpu_only")
def test_the_report_for_people_has_a_line_each_and_a_fix_below_it() -> None:
    result = turbopi("doctor")
    assert result.exit_code == 0
    assert "WARN  GPU         no NVIDIA GPU\n" in result.stdout
    assert "-> none needed for pi05_tiny, tests and development; real time needs one\n" in result.stdout
    assert result.stdout.splitlines()[-1].endswith(" 0 failed")


@pytest.mark.usefixtures("cpu_only")
def test_a_missing_tokenizer_comes_with_the_command_that_gets_it(tmp_path: Path) -> None:
    _, rows = doctor()
    assert rows["tokenizer"]["level"] == "WARN"
    target = tmp_path / "big_vision" / "paligemma_tokenizer.model"
    assert rows["tokenizer"]["fix"].startswith(f"mkdir -p '{target.parent}' && curl -L -o '{target}' https://")


@pytest.mark.usefixtures("cpu_only")
def test_a_checkpoint_without_its_tokenizer_fails(tmp_path: Path) -> None:
    folder = write_random("pi05_tiny", tmp_path / "tiny")
    code, rows = doctor("--checkpoint", folder)
    assert code == 1
    assert rows["checkpoint"]["level"] == "OK"
    assert "openpi_torch, pi05, pi05_tiny for libero, 6 M parameters" in rows["checkpoint"]["found"]
    assert "this checkpoint takes 11 MB in bf16, 23 MB in f32" in rows["memory"]["found"]
    assert rows["tokenizer"]["level"] == "FAIL"
    assert rows["tokenizer"]["found"] == "no tokenizer found"
    code, rows = doctor("--checkpoint", folder, "--tokenizer", TINY_TOKENIZER)
    assert code == 0
    assert rows["tokenizer"]["found"] == str(TINY_TOKENIZER)


@pytest.mark.usefixtures("cpu_only")
def test_of_a_model_that_writes_tokens_the_action_tokenizer_and_its_backends_are_checked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HF_HUB_CACHE", str(tmp_path / "hub"))
    folder = pi0_fast_golden.make_folder("base", tmp_path / "fast")
    code, rows = doctor(folder, "--tokenizer", pi0_fast_golden.TOKENIZER)
    assert code == 1 and rows["action tokenizer"]["level"] == "FAIL"
    assert rows["action tokenizer"]["fix"].startswith("`hf download lerobot/fast-action-tokenizer`; or ")
    assert "62,784 parameters" in rows["checkpoint"]["found"]
    shown = text_of(turbopi("inspect", folder).stdout).replace("│", " ")
    assert "which isn't here: `turbopi doctor" in " ".join(shown.split()) and "action expert" not in shown

    pi0_fast_golden.make_hub(tmp_path / "hub")
    result = turbopi("doctor", folder, "--tokenizer", pi0_fast_golden.TOKENIZER, "--device", "cpu", "--json")
    document = json.loads(result.stdout)
    assert result.exit_code == 0
    reasons = {one["name"]: one["reason"] for one in document["backends"]}
    assert reasons["pytorch"] is None and "has no plan for Pi0-FAST" in reasons["pytorch_compile"]
    assert "precision 'fp8' isn't for Pi0-FAST" in reasons["emulated_fp8"]


def test_a_checkpoint_is_given_as_to_other_commands_or_as_an_option(tmp_path: Path) -> None:
    assert doctor(tmp_path)[1]["checkpoint"] == doctor("--checkpoint", tmp_path)[1]["checkpoint"]
    assert "each name a checkpoint" in refusal(turbopi("doctor", tmp_path, "--checkpoint", tmp_path))


def test_a_checkpoint_that_cannot_be_opened_fails(tmp_path: Path) -> None:
    code, rows = doctor("--checkpoint", tmp_path / "nothing")
    assert code == 1
    assert rows["checkpoint"]["level"] == "FAIL"
    assert rows["checkpoint"]["found"] == f"there is no folder {tmp_path / 'nothing'}"
    assert "tokenizer" not in rows


def test_a_taken_port_is_a_warning() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        row = checkups.check_port(taken.getsockname()[1])
    assert row.level == "WARN"
    assert row.fix == "turbopi serve --port N with another one"


def test_missing_and_old_packages_fail_by_name(monkeypatch: pytest.MonkeyPatch) -> None:
    required = ["torch>=2.8", "rich>=99.1", "no-such-package>=1.0", 'not-for-users>=1; extra == "dev"']
    version = metadata.version
    monkeypatch.setattr(metadata, "requires", lambda name: required)
    monkeypatch.setattr(metadata, "version", lambda name: "0.1.0" if name == "turbopi" else version(name))
    row = checkups.check_packages()
    assert row.level == "FAIL"
    assert row.found == f"rich is {version('rich')}, not >=99.1; no-such-package is missing"


@pytest.mark.parametrize(
    ("available", "parameters", "level"),
    [(64e9, None, "OK"), (10e9, None, "OK"), (4e9, None, "WARN"), (4e9, 3_617_000_000, "FAIL"), (4e9, 6_000_000, "OK")],
)
def test_memory_is_held_against_what_the_weights_take(
    available: float, parameters: int | None, level: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr("psutil.virtual_memory", lambda: types.SimpleNamespace(available=available))
    monkeypatch.setattr(checkups, "cgroup_limit_gb", lambda: None)
    weights = None if parameters is None else {"bf16": 2e-9 * parameters, "f32": 4e-9 * parameters}
    row = checkups.check_memory(weights)
    assert row.level == level
    assert ("enough for bf16 alone" in row.found) == (available == 10e9)
    monkeypatch.setattr(checkups, "cgroup_limit_gb", lambda: 0.001)
    assert checkups.check_memory(weights).level == ("WARN" if parameters is None else "FAIL")


def test_a_containers_memory_limit_is_read(tmp_path: Path) -> None:
    assert checkups.cgroup_limit_gb(tmp_path) is None
    (tmp_path / "memory.max").write_text("max\n")
    assert checkups.cgroup_limit_gb(tmp_path) is None
    (tmp_path / "memory.max").write_text("8000000000\n")
    assert checkups.cgroup_limit_gb(tmp_path) == 8.0


def test_busy_cpus_are_a_warning(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("psutil.getloadavg", lambda: (1000.0, 1.0, 1.0))
    row: Row = checkups.check_cpu()
    assert row.level == "WARN"
    assert "the load is 1000.0" in row.found


INSTALL = "on Debian and Ubuntu: apt-get install g++ python3-dev"


def test_no_compiler_is_a_warning(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("shutil.which", lambda name: None)
    assert checkups.check_compiler() == Row(
        "WARN", "C compiler", "no C++ compiler", f"{INSTALL} (for pytorch_compile and Triton kernels)"
    )


@pytest.mark.parametrize(("device", "who"), [("cpu", "torch.compile can't build its code"), ("cuda", "Triton can't")])
def test_an_environment_without_pythons_headers_is_told_before_anything_compiles(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, device: str, who: str
) -> None:
    monkeypatch.setattr("sysconfig.get_paths", lambda: {"include": str(tmp_path)})
    monkeypatch.setattr("shutil.which", lambda name: f"/usr/bin/{name}")
    monkeypatch.setattr("importlib.util.find_spec", lambda name: object())
    row = checkups.check_compiler()
    assert (row.level, row.found) == ("WARN", f"no {tmp_path}/Python.h, Python's headers")
    reason = PyTorchCompileBackend.unavailable(torch.device(device))
    assert reason is not None
    assert reason.startswith(who) and "Python.h" in reason and INSTALL in reason
    (tmp_path / "Python.h").write_text("")
    assert checkups.check_compiler().level == "OK"
    assert PyTorchCompileBackend.unavailable(torch.device(device)) is None


def test_backends_are_listed_with_reasons_and_what_auto_takes(monkeypatch: Any) -> None:
    reason = "torch.compile needs a C++ compiler on a CPU; install g++"
    monkeypatch.setattr(PyTorchCompileBackend, "unavailable", classmethod(lambda cls, device: reason))
    monkeypatch.setenv("COLUMNS", "160")
    result = turbopi("doctor", "--device", "cpu", "--json")
    document = json.loads(result.stdout)
    assert (document["device"], document["auto"]) == ("cpu", "pytorch")
    by_name = {entry["name"]: entry for entry in document["backends"]}
    assert by_name["pytorch"]["available"] is True
    assert by_name["pytorch"]["auto"] is True
    assert by_name["pytorch"]["precisions"] == ["bf16", "f32"]
    assert by_name["pytorch_compile"]["available"] is False
    assert by_name["pytorch_compile"]["reason"] == reason
    shown = turbopi("doctor", "--device", "cpu").stdout
    assert reason in shown
    assert "auto takes pytorch in bf16: on a CPU the eager reference starts at once" in shown


def test_the_old_name_of_the_list_of_backends_works_for_one_version() -> None:
    result = turbopi("backends", "--device", "cpu", "--json")
    assert [one["name"] for one in json.loads(result.stdout)["backends"]] == list(backends.known())
    assert "note: `turbopi doctor` has this list, too" in result.stderr


def test_backends_refuses_what_it_cannot_list() -> None:
    assert "unknown device 'tpu'" in refusal(turbopi("doctor", "--device", "tpu"))
    assert "unknown precision 'fp7'; choose one of bf16, f32" in refusal(turbopi("doctor", "--precision", "fp7"))
