"""Each program in an environment of its own: HOME/NAME/venv and HOME/NAME/src.

pip's and git's own settings hold: PIP_NO_INDEX and PIP_FIND_LINKS for wheels from a folder, git's `insteadOf` for a
mirror, where the GPU machine has no network.
"""

import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from peers.entries import Program
from turbopi.support.files import write_whole

INSTALL_S = 3600.0  # of one command
_DONE, _WHY = "installed.txt", "failed.txt"


def folder_of(program: Program, home: Path) -> Path:
    return home.resolve() / program.name


def python_of(program: Program, home: Path) -> str:
    """The interpreter of its environment; of ours the one that runs the tool."""
    return str(folder_of(program, home) / "venv" / "bin" / "python") if program.install else sys.executable


def commands(program: Program, home: Path, arch: str, *, site_packages: bool = False) -> list[list[str]]:
    """All that `install` runs, in order."""
    if not program.install:
        return []
    folder = folder_of(program, home)
    values = {"python": python_of(program, home), "src": str(folder / "src"), "arch": arch}
    venv = [program.python or sys.executable, "-m", "venv", *["--system-site-packages"] * site_packages]
    return [
        [*venv, str(folder / "venv")],
        *program.fetching(folder / "src"),
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


def install(program: Program, home: Path, arch: str, *, site_packages: bool = False) -> str | None:
    """Install it anew. Returns why it failed, or None; either is written down for `run`."""
    folder = folder_of(program, home)
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    for command in commands(program, home, arch, site_packages=site_packages):
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
