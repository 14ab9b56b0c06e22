"""Folders and files that appear whole or not at all, and the folder for what can be made again."""

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


def cache_folder() -> Path:
    """For compiled kernels, engines and fingerprints: $XDG_CACHE_HOME/turbopi or ~/.cache/turbopi."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "turbopi"


def write_whole(file: Path, text: str) -> None:
    """Write a file in UTF-8 so that a reader, or whoever ends the program, finds the old one or the new one."""
    temporary = file.with_name(f".{file.name}.part")
    temporary.write_text(text, encoding="utf-8")
    temporary.replace(file)


@contextmanager
def new_folder(dst: Path) -> Iterator[Path]:
    """A temporary folder that becomes `dst` if all goes well, and disappears otherwise.

    The caller has checked that `dst` doesn't exist or is empty.
    """
    dst.parent.mkdir(parents=True, exist_ok=True)
    temporary = Path(tempfile.mkdtemp(prefix=f".{dst.name}-", dir=dst.parent))
    try:
        yield temporary
        temporary.chmod(0o755)  # mkdtemp makes it private
        if dst.exists():
            dst.rmdir()  # empty: checked before
        temporary.rename(dst)
    except BaseException:
        shutil.rmtree(temporary, ignore_errors=True)
        raise
