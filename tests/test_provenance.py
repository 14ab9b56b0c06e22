"""Where a figure comes from is told as it is, wherever Turbo-Pi is installed."""

import shutil
import subprocess
from importlib.metadata import version
from pathlib import Path

import pytest
import torch

from turbopi.support import provenance as module
from turbopi.support.provenance import driver_version, provenance

pytestmark = pytest.mark.skipif(shutil.which("git") is None, reason="git isn't installed")


def git(folder: Path, *arguments: str) -> str:
    identity = ("-c", "user.name=A", "-c", "user.email=a@b", "-c", "init.defaultBranch=main")
    command = ["git", "-C", str(folder), *identity, *arguments]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()


def repository(folder: Path, *files: str) -> str:
    """A repository with these files in its one commit, which is returned."""
    folder.mkdir(parents=True, exist_ok=True)
    for name in ("README", *files):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(str(folder))
    git(folder, "init", "-q")
    git(folder, "add", "README", *files)
    git(folder, "commit", "-q", "-m", "one")
    return git(folder, "rev-parse", "--short=12", "HEAD")


def reported(monkeypatch: pytest.MonkeyPatch, file: Path) -> str:
    """The commit that is recorded if provenance.py is this file."""
    monkeypatch.setattr(module, "__file__", str(file))
    return provenance(torch.device("cpu")).commit


def test_the_version_is_always_recorded() -> None:
    assert provenance(torch.device("cpu")).turbopi == version("turbopi")


def test_a_checkout_of_ours_is_told_by_its_commit_and_by_its_changes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    name = "src/turbopi/support/provenance.py"
    commit = repository(tmp_path, name)
    assert reported(monkeypatch, tmp_path / name) == commit
    (tmp_path / "README").write_text("changed")
    assert reported(monkeypatch, tmp_path / name) == f"{commit}+"


@pytest.mark.parametrize("tracked", [False, True])
def test_a_repository_around_the_installation_isnt_taken_for_ours(
    tracked: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An environment in somebody's checkout, ignored there or not."""
    monkeypatch.delenv("TURBOPI_COMMIT", raising=False)
    installed = "venv/lib/python3.12/site-packages/turbopi/provenance.py"
    repository(tmp_path, *([installed] if tracked else []))
    (tmp_path / installed).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / installed).write_text("installed")
    assert reported(monkeypatch, tmp_path / installed) == "unknown"
    monkeypatch.setenv("TURBOPI_COMMIT", "abc")
    assert reported(monkeypatch, tmp_path / installed) == "abc"


def test_a_repository_that_the_environment_names_is_no_matter(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As within a git hook."""
    name = "src/turbopi/support/provenance.py"
    commit = repository(tmp_path / "ours", name)
    repository(tmp_path / "theirs", name)
    monkeypatch.setenv("GIT_DIR", str(tmp_path / "theirs" / ".git"))
    monkeypatch.setenv("GIT_WORK_TREE", str(tmp_path / "theirs"))
    assert reported(monkeypatch, tmp_path / "ours" / name) == commit


@pytest.mark.parametrize(
    ("text", "version"),
    [
        ("NVRM version: NVIDIA UNIX x86_64 Kernel Module  580.95.05  Tue Sep 23 10:11:16 UTC 2025\n", "580.95.05"),
        ("NVRM version: NVIDIA UNIX Open Kernel Module for aarch64  540.4  Release Build  (x@y)\n", "540.4"),
    ],
)
def test_the_driver_is_told_by_the_kernel(
    text: str, version: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "version").write_text(text)
    monkeypatch.setattr(module, "DRIVER_FILE", tmp_path / "version")
    monkeypatch.setattr(module, "_output", lambda command: "570.1\n570.1\n")
    assert driver_version() == version
    monkeypatch.setattr(module, "DRIVER_FILE", tmp_path / "none")
    assert driver_version() == "570.1"
    monkeypatch.setattr(module, "_output", lambda command: "[N/A]\n")
    monkeypatch.setattr(module, "JETSON_FILE", tmp_path / "jetson")
    (tmp_path / "jetson").write_text("# R36 (release), REVISION: 4.3, GCID: 38968081, BOARD: generic\n")
    assert driver_version() == "L4T 36.4.3"
    (tmp_path / "jetson").unlink()
    monkeypatch.setattr(torch._C, "_cuda_getDriverVersion", lambda: 12060, raising=False)
    assert driver_version() == "CUDA 12.6"
    monkeypatch.setattr(torch._C, "_cuda_getDriverVersion", lambda: 0)
    assert driver_version() == "unknown"
