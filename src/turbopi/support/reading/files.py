"""Opening files that may be anything, and showing values that may be anything."""

import os
import re
import reprlib
import stat
from collections.abc import Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import IO

from turbopi.support.errors import CheckpointError, TurboPiError

Error = type[TurboPiError]


class _Short(reprlib.Repr):
    """`repr` that stays on one line, stays short, and costs little, however large the value."""

    maxstring = maxother = 80
    maxlevel = 3

    def repr_dict(self, value: dict[object, object], level: int) -> str:
        """As it is ordered: `Repr` sorts the keys."""
        if level <= 0:
            return "{...}"
        pieces = [f"{self.repr1(key, level - 1)}: {self.repr1(value[key], level - 1)}" for key in islice(value, 4)]
        return "{" + ", ".join(pieces + ["..."] * (len(value) > 4)) + "}"

    def repr_bytes(self, value: bytes, level: int) -> str:
        return repr(value) if len(value) <= 40 else f"{value[:40]!r}…"

    def repr_int(self, value: int, level: int) -> str:
        return repr(value) if abs(value) < 10**40 else f"a whole number of {value.bit_length()} bits"


shown = _Short().repr


def one_line(error: Exception | str) -> str:
    """What a library says of damage, which may quote all of it."""
    return "".join(letter if letter.isprintable() else "?" for letter in " ".join(str(error)[:2000].split())[:400])


def listing(names: Sequence[str], limit: int = 5) -> str:
    """`a, b, c and 7 more (10 in all)`; a name that can't be printed on a line as it is in quotes."""
    reported = ", ".join(name if name.isprintable() and len(name) < 200 else shown(name) for name in names[:limit])
    if len(names) > limit:
        reported += f" and {len(names) - limit} more ({len(names)} in all)"
    return reported


def read_bytes(file: str | Path, error: Error = CheckpointError, *, limit: int, hint: str = "") -> bytes:
    """The content of a file of at most `limit` bytes; `hint` is put behind the reason for which it can't be read."""
    try:
        with open_file(file, error, hint=hint) as stream:
            data = stream.read(limit + 1)
    except OSError as reason:
        raise error(f"{file} can't be read: {reason.strerror or reason}{_fitting(hint, reason)}") from reason
    if len(data) > limit:
        raise error(f"{file} has more than {limit} bytes, the most that is read of a file of its kind")
    if (found := failed_download(data)) is not None:
        raise error(f"{file} {found}")
    return data


_LFS = b"version https://git-lfs.github.com/spec/"
HEAD_BYTES = 64  # that `failed_download` looks at


def failed_download(data: bytes) -> str | None:
    """What a file is instead of itself, by its first bytes, and what to do; None: nothing that is known."""
    if data.startswith(_LFS):
        return "is a Git-LFS pointer, not the file itself: `git lfs pull` in its repository, or download it"
    if data[:HEAD_BYTES].lstrip().lower().startswith((b"<!doctype html", b"<html")):
        return "is a web page, not the file itself: download it by its own link (on Hugging Face /resolve/, not /blob/)"
    if len(data) >= 8 and not any(data[:HEAD_BYTES]):
        return "begins with zeros: a download set its space aside and didn't fill it; download it again"
    return None


def files_below(folder: Path, *, hidden: bool = False, depth: int = 16) -> Iterator[Path]:
    """The regular files in a folder and below it, sorted within each. Links are followed, but never in a circle.

    Hidden files and folders (.git, .ipynb_checkpoints, .cache) are left out unless `hidden`, and what can't be read.
    """
    return _files_below(folder, hidden, depth, ())


def _files_below(folder: Path, hidden: bool, depth: int, above: tuple[tuple[int, int], ...]) -> Iterator[Path]:
    try:
        state = folder.stat()
        entries = sorted(folder.iterdir())
    except OSError:
        return
    here = (state.st_dev, state.st_ino)
    if here in above:
        return
    for entry in entries:
        if entry.name.startswith(".") and not hidden:
            continue
        if entry.is_file():
            yield entry
        elif depth and entry.is_dir():
            yield from _files_below(entry, hidden, depth - 1, (*above, here))


def open_file(file: str | Path, error: Error = CheckpointError, *, hint: str = "") -> IO[bytes]:
    """An existing regular file, opened to read bytes; nothing that could block, such as a named pipe, is opened."""
    try:
        if stat.S_ISREG(os.stat(file).st_mode):
            return open(file, "rb")
        kind = "a folder" if os.path.isdir(file) else "no regular file"
    except (OSError, ValueError) as reason:  # ValueError: a name with a NUL in it
        what = reason.strerror if isinstance(reason, OSError) else reason
        name = file if str(file).isprintable() and len(str(file)) < 500 else shown(str(file))
        raise error(f"{name} can't be read: {what}{_fitting(hint, reason)}") from reason
    raise error(f"{file} can't be read: it is {kind}{hint}")


def _fitting(hint: str, reason: Exception) -> str:
    """The hint, unless the reason says it all."""
    return "" if isinstance(reason, PermissionError) else hint


def file_inside(folder: Path, name: object, where: object, error: Error = CheckpointError) -> Path:
    """The file `name` in `folder` or below it, as a text in `where` names it; it needn't exist.

    Raises `error` for what is no name, is absolute, or leads out of the folder by "..". Links are followed: whoever
    owns the folder made them.
    """
    if not isinstance(name, str) or not 0 < len(name) < 1000 or not name.isprintable():
        raise error(f"{where} names the file {shown(name)}; expected the name of a file in {folder}")
    path = Path(name)
    if path.is_absolute() or ".." in path.parts or re.match(r"[A-Za-z]:|\\", name):
        raise error(f"{where} names the file {shown(name)}, which isn't in {folder}")
    return folder / path
