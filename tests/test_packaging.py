"""The wheel has every file (that it works: scripts/check_wheel); what importing it does; a clone's size."""

import os
import re
import subprocess
import sys
import zipfile
from email.message import Message
from email.parser import Parser
from pathlib import Path

import pytest
from packaging.requirements import Requirement

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "src" / "turbopi"
OTHER_FAMILIES = ("tests/golden_memory/", "tests/golden_pi0_fast/", "tests/golden_smolvla/", "tests/golden_text/")


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


def test_a_clone_stays_small() -> None:
    """24 MiB of tracked files, and 4 for golden cases of other families than Pi0 and Pi0.5 without memory."""
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=False)
    if listed.returncode:
        pytest.skip("not a git checkout")
    sizes = {name: (ROOT / name).stat().st_size for name in listed.stdout.split("\0") if (ROOT / name).is_file()}
    families = sum(size for name, size in sizes.items() if name.startswith(OTHER_FAMILIES))
    largest = sorted(sizes.items(), key=lambda item: -item[1])[:5]
    assert families <= 4 * 2**20 and sum(sizes.values()) - families <= 24 * 2**20, largest


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
    unpacked = {name.removesuffix(".xz") for name in written if name.endswith(".safetensors.xz")}  # scripts/setup's
    assert packed == written - unpacked


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


@pytest.mark.slow
@pytest.mark.skipif(not (ROOT / ".venv-build" / ".done").exists(), reason="needs scripts/check_wheel's .venv-build")
def test_the_same_files_give_the_same_bytes(tmp_path: Path) -> None:
    """sdists and wheels of all three packages, built at another place and time, with other permissions."""
    built: list[dict[str, bytes]] = []
    for number, mask in enumerate((0o022, 0o077)):
        out = tmp_path / str(number)
        environment = {**os.environ, "TZ": ("UTC", "Asia/Tokyo")[number]}
        command = [ROOT / "scripts" / "build_wheels", out]
        subprocess.run(command, umask=mask, env=environment, capture_output=True, check=True)
        built.append({file.name: file.read_bytes() for file in out.iterdir()})
    assert len(built[0]) == 6 and built[0] == built[1]
    for name, content in built[0].items():
        if name.endswith(".whl"):
            (tmp_path / name).write_bytes(content)
            with zipfile.ZipFile(tmp_path / name) as archive:
                assert {file.rsplit("/")[-1] for file in archive.namelist()} >= {"LICENSE", "NOTICE"}, name


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


def test_the_three_packages_have_one_version() -> None:
    files = (
        ROOT / folder / "pyproject.toml" for folder in (".", "packages/turbopi-lab", "plugins/lerobot_policy_turbopi")
    )
    versions = {re.findall(r'^version = "(.*)"$', file.read_text(encoding="utf-8"), re.MULTILINE)[0] for file in files}
    assert len(versions) == 1, versions


def test_extras_end_at_what_was_tested(reported: Message) -> None:
    seen = set()
    for requirement in map(Requirement, reported.get_all("Requires-Dist", [])):
        extra = re.search(r'extra == "(\w+)"', str(requirement.marker or ""))
        if extra is not None and extra[1] in ("cuda", "tensorrt", "onnx", "ray", "view", "replay"):
            assert {one.operator for one in requirement.specifier} & {"==", "<"}, requirement
            seen.add(extra[1])
    assert len(seen) == 6
