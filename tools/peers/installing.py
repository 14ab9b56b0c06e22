"""Each program in an environment of its own: HOME/NAME/venv and HOME/NAME/src.

On a machine without a network: PIP_NO_INDEX and PIP_FIND_LINKS take wheels from a folder, sources come from a folder,
and environments may see the packages of the Python that runs the tool.
"""

import shutil
import site
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from peers.entries import Program
from turbopi.support.files import write_whole

INSTALL_S = 3600.0  # of one command
_DONE, _WHY = "installed.txt", "failed.txt"
# A venv's own --system-site-packages doesn't see the packages of a Python that is a venv itself.
_SEES = "import site, sys; open(site.getsitepackages()[0] + '/seen.pth', 'w').write(sys.argv[1])"


def folder_of(program: Program, home: Path) -> Path:
    return home.resolve() / program.name


def python_of(program: Program, home: Path) -> str:
    """The interpreter of its environment; of ours the one that runs the tool."""
    return str(folder_of(program, home) / "venv" / "bin" / "python") if program.install else sys.executable


def commands(
    program: Program, home: Path, arch: str, *, src: str | None = None, site_packages: bool = False
) -> list[list[str]]:
    """All that `install` runs, in order. src: sources that are there, which are copied instead of fetched."""
    if not program.install:
        return []
    folder = folder_of(program, home)
    values = {"python": python_of(program, home), "tool": sys.executable, "src": str(folder / "src"), "arch": arch}
    seen = [values["python"], "-c", _SEES, "\n".join(site.getsitepackages())]
    return [
        [program.python or sys.executable, "-m", "venv", "--without-pip", str(folder / "venv")],
        *([seen] if site_packages else []),
        *([["cp", "-r", src, values["src"]]] if src else program.fetching(folder / "src")),
        *([_filled(word, values) for word in command] for command in program.install),
    ]


def _filled(word: str, values: dict[str, str]) -> str:
    for name, value in values.items():
        word = word.replace("{" + name + "}", value)
    return word


def missing(program: Program, home: Path) -> str | None:
    """Why it can't run; None if it can."""
    folder = folder_of(program, home)
    if not program.install or (folder / _DONE).is_file():
        return None
    try:
        return (folder / _WHY).read_text()
    except OSError:
        return f"it isn't installed in {folder.name}: python -m peers install {program.name}"


def install(
    program: Program, home: Path, arch: str, *, src: str | None = None, site_packages: bool = False
) -> str | None:
    """Install it anew. Returns why it failed, or None; either is written down for `run`."""
    folder = folder_of(program, home)
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    for command in commands(program, home, arch, src=src, site_packages=site_packages):
        if reason := _run(command):
            write_whole(folder / _WHY, reason.encode())
            return reason
    write_whole(folder / _DONE, b"")
    return None


def _run(command: Sequence[str]) -> str | None:
    shown = " ".join(command)
    try:
        done = subprocess.run(
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            timeout=INSTALL_S,
        )
    except subprocess.TimeoutExpired:
        return f"`{shown}` took longer than {INSTALL_S:g} s"
    except OSError as error:
        return f"`{shown}`: {error}"
    if done.returncode == 0:
        return None
    text = " ".join(done.stdout.decode(errors="replace").split())
    return f"`{shown}` ended with {done.returncode}: {text[-300:]}"
