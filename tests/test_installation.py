"""The command that adds an extra works for the way in which Turbo-Pi was installed."""

import json
import subprocess
import sys
from email.message import Message
from importlib import metadata
from pathlib import Path
from typing import Any

import pytest

from turbopi.support import installation
from turbopi.support.installation import install_command, manual

ROOT = Path(__file__).parents[1]


@pytest.fixture
def without_a_clone(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(installation, "__file__", str(tmp_path / "site-packages/turbopi/installation.py"))


class Noted:
    """A distribution with what pip noted of its origin."""

    def __init__(self, origin: dict[str, Any] | None) -> None:
        self.origin = origin

    def read_text(self, name: str) -> str | None:
        assert name == "direct_url.json"
        return None if self.origin is None else json.dumps(self.origin)


def test_from_a_clone_the_clone_is_named() -> None:
    assert install_command("onnx").endswith(f" install -e '{ROOT}[onnx]'")
    assert install_command().endswith(f" install -e '{ROOT}'")


def test_the_clones_command_is_one_that_pip_understands() -> None:
    """Asked of pip itself, which reads the clone's extras and installs nothing."""
    command = install_command("onnx").replace("'", "").split(" install ")[1].split()
    dry = [sys.executable, "-m", "pip", "install", "--dry-run", "--no-deps", "--no-index", "--no-build-isolation"]
    reported = subprocess.run([*dry, *command], capture_output=True, text=True, check=False)
    assert reported.returncode == 0, reported.stderr
    assert "does not provide the extra" not in reported.stderr


@pytest.mark.parametrize(
    ("origin", "command"),
    [
        (None, "'turbopi[onnx]'"),
        (
            {"url": "file:///dl/my%20wheels/turbopi-0.1.0-py3-none-any.whl", "archive_info": {}},
            "'/dl/my wheels/turbopi-0.1.0-py3-none-any.whl[onnx]'",
        ),
        ({"url": "file:///home/me/turbopi", "dir_info": {}}, "'/home/me/turbopi[onnx]'"),
        (
            {"url": "https://here.example/turbopi-0.1.0-py3-none-any.whl", "archive_info": {}},
            "'turbopi[onnx] @ https://here.example/turbopi-0.1.0-py3-none-any.whl'",
        ),
        (
            {"url": "https://git.example/turbopi", "vcs_info": {"vcs": "git", "commit_id": "abc"}},
            "'turbopi[onnx] @ git+https://git.example/turbopi@abc'",
        ),
    ],
)
@pytest.mark.usefixtures("without_a_clone")
def test_elsewhere_what_pip_noted_is_named(
    origin: dict[str, Any] | None, command: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(metadata, "distribution", lambda name: Noted(origin))
    assert install_command("onnx").endswith(f" install {command}")


def test_pip_is_the_one_of_this_python(monkeypatch: pytest.MonkeyPatch) -> None:
    """A pip of another environment would install there."""
    monkeypatch.setattr(installation.shutil, "which", lambda name: "/usr/bin/pip")
    assert install_command("onnx").startswith(f"{sys.executable} -m pip install ")
    monkeypatch.setattr(installation.shutil, "which", lambda name: str(Path(sys.executable).parent / "pip"))
    assert install_command("onnx").startswith("pip install ")


def test_no_document_names_a_package_that_no_index_has() -> None:
    for page in [ROOT / "README.md", *(ROOT / "docs").glob("*.md")]:
        assert "pip install turbopi" not in page.read_text() and "'turbopi[" not in page.read_text(), page


def test_a_page_of_the_documentation_is_named_where_it_is(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    assert manual("tutorial") == "docs/tutorial.md"
    monkeypatch.setattr(installation, "__file__", str(tmp_path / "site-packages/turbopi/support/installation.py"))
    about = Message()
    about["Version"] = "0.1.0"
    monkeypatch.setattr(metadata, "metadata", lambda name: about)
    assert manual("tutorial") == "docs/tutorial.md of Turbo-Pi's documentation"
    about["Project-URL"] = "Repository, https://here.example/turbopi"
    assert manual("tutorial") == "https://here.example/turbopi/blob/v0.1.0/docs/tutorial.md"
