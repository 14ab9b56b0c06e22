"""The wheel has everything that the package needs, and works outside a checkout; what importing it does."""

import os
import re
import subprocess
import sys
import sysconfig
import zipfile
from email.message import Message
from email.parser import Parser
from pathlib import Path

import pytest
from packaging.requirements import Requirement

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "src" / "turbopi"


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Turbo-Pi's wheel, built of a copy of what it is built of."""
    folder = tmp_path_factory.mktemp("wheel")
    source = folder / "source"
    parts = ["src", "pyproject.toml", "README.md", "LICENSE", "NOTICE"]
    listing = ["git", "ls-files", "--cached", "--others", "--exclude-standard", *parts]
    tracked = subprocess.run(listing, cwd=ROOT, capture_output=True, text=True, check=False)
    if tracked.returncode:
        pytest.skip("not a git checkout")
    for name in filter(lambda name: (ROOT / name).is_file(), tracked.stdout.splitlines()):
        (source / name).parent.mkdir(parents=True, exist_ok=True)
        (source / name).write_bytes((ROOT / name).read_bytes())
    command = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation"]
    command += ["--disable-pip-version-check", "--wheel-dir", str(folder), str(source)]
    built = subprocess.run(command, capture_output=True, text=True, check=False)
    assert built.returncode == 0, built.stderr
    (file,) = folder.glob("*.whl")
    return file


@pytest.mark.slow
def test_the_wheel_holds_every_file_of_the_package(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
    packed = {name.removeprefix("turbopi/") for name in names if name.startswith("turbopi/")}
    rest = {name.split("/")[0] for name in names} - {"turbopi"}
    assert len(rest) == 1 and rest.pop().endswith(".dist-info"), "no tools, and nothing of turbopi-lab"
    written = {
        path.relative_to(PACKAGE).as_posix()
        for path in PACKAGE.rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    assert packed == written


@pytest.mark.slow
def test_the_wheel_works_in_an_environment_of_its_own(wheel: Path, tmp_path: Path) -> None:
    """Turbo-Pi is imported from the wheel; its dependencies are those of this environment."""
    site = tmp_path / "site"
    install = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-compile", "--no-index"]
    subprocess.run([*install, "--disable-pip-version-check", "--target", str(site), str(wheel)], check=True)
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(site), sysconfig.get_paths()["purelib"]])}

    def python(*words: str) -> str:
        ended = subprocess.run(
            [sys.executable, "-S", *words],  # without site-packages' .pth files: this checkout is installed by one
            cwd=tmp_path,
            env=environment,
            capture_output=True,
            text=True,
            check=False,
        )
        assert ended.returncode == 0, ended.stderr
        return ended.stdout

    assert str(site) in python("-c", "import turbopi; print(turbopi.__file__)")
    assert "fused" in python("-m", "turbopi", "backends", "--device", "cpu")
    text = python("-m", "turbopi", "infer", "--random-weights", "pi05_tiny", "--help")
    assert "Usage" in text


@pytest.mark.slow
@pytest.mark.parametrize(
    ("before", "given", "seen"),
    [("", None, "PASSIVE"), ("", "ACTIVE", "ACTIVE"), ("import torch; ", None, "None")],
    ids=["set", "kept", "too late"],
)
def test_importing_turbopi_keeps_threads_from_spinning(before: str, given: str | None, seen: str) -> None:
    environment = {key: value for key, value in os.environ.items() if key != "OMP_WAIT_POLICY"}
    environment |= {} if given is None else {"OMP_WAIT_POLICY": given}
    code = f"{before}import turbopi, os; print(os.environ.get('OMP_WAIT_POLICY'))"
    ended = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert ended.stdout.strip() == seen


@pytest.fixture
def reported(wheel: Path) -> Message:
    """The wheel's metadata: what an index shows."""
    with zipfile.ZipFile(wheel) as archive:
        (name,) = (name for name in archive.namelist() if name.endswith(".dist-info/METADATA"))
        return Parser().parsestr(archive.read(name).decode())


def test_the_metadata_is_complete(reported: Message) -> None:
    """`scripts/check_wheel` has twine check the rest."""
    assert reported["License-Expression"] == "Apache-2.0" and reported.get_all("License-File") == ["LICENSE", "NOTICE"]
    assert reported["Description-Content-Type"] == "text/markdown" and str(reported.get_payload()).startswith(
        "# Turbo-Pi"
    )
    assert reported["Author"] == "the Turbo-Pi authors" and "openpi" in reported["Keywords"] and reported["Summary"]
    pythons = [line.rsplit(" ", 1)[1] for line in reported.get_all("Classifier", []) if ":: Python :: 3." in line]
    versions = (ROOT / "docs" / "dev" / "versions.md").read_text()
    assert pythons and all(f"| {python} |" in versions for python in pythons), "those that tests run with"
    assert set(reported.get_all("Provides-Extra", [])) >= {"cuda", "libero", "tensorrt", "onnx", "ray", "rerun"}


def test_extras_end_at_what_was_tested(reported: Message) -> None:
    seen = set()
    for requirement in map(Requirement, reported.get_all("Requires-Dist", [])):
        extra = re.search(r'extra == "(\w+)"', str(requirement.marker or ""))
        if extra is not None and extra[1] in ("cuda", "tensorrt", "onnx", "ray", "view", "replay"):
            assert {one.operator for one in requirement.specifier} & {"==", "<"}, requirement
            seen.add(extra[1])
    assert len(seen) == 6
