"""Files that appear whole or not at all, and the folder for what can be made again.

    write_whole(file, text)                                     text or bytes
    write_whole(file, lambda stream: np.savez(stream, a=a))     or whatever writes to an open file
    with new_file(file) as temporary: ...                       or to a path
    with new_folder(folder) as temporary: ...
    append_line(file, line)                                     one more line of a .jsonl
    keep_in_cache(file, content)                                what can be made again: a failure is a line of the log
    with alone_in(folder, "another run"): ...                   one writer of several files

The content goes to a temporary file of a name of its own in the same folder, hidden; it is on the disk before it takes
the file's name. So a reader, a full disk or a kill at any moment finds the old file or the new one, and of several
writers at once one wins and none fails. An OSError becomes an error of the caller's class that names the file and the
reason.
"""

import errno
import json
import logging
import os
import platform
import re
import secrets
import shutil
import stat
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO

from turbopi.support.errors import OutputError, TurboPiError

Error = type[TurboPiError]
Content = str | bytes | Callable[[IO[bytes]], object]

logger = logging.getLogger(__name__)

_LOCK = ".turbopi.lock"
_UNWRITABLE: set[Path] = set()  # folders of caches of which the log says so already
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


def cache_folder() -> Path:
    """For compiled kernels, engines and fingerprints: $XDG_CACHE_HOME/turbopi or ~/.cache/turbopi.

    It may be missing or unwritable. A user without a home gets a folder that can't be made.
    """
    try:
        return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "turbopi"
    except RuntimeError:
        return Path(os.devnull) / "turbopi"


def openpi_cache() -> Path:
    """Where openpi keeps what it fetches: $OPENPI_DATA_HOME or ~/.cache/openpi."""
    return Path(os.environ.get("OPENPI_DATA_HOME") or "~/.cache/openpi").expanduser()


def write_whole(file: Path, content: Content, error: Error = OutputError, *, sync: bool = True) -> None:
    """Write a file so that it appears whole or not at all; text in UTF-8. Raises `error` if it can't be written.

    content   text, bytes, or a function that is called with the file, opened to write bytes
    sync      wait until the disk has it: without, a power cut may leave a file that isn't whole
    """
    with new_file(file, error, sync=sync) as temporary, temporary.open("wb") as stream:
        if callable(content):
            content(stream)
        else:
            stream.write(content.encode() if isinstance(content, str) else content)


def make_folder(file: Path, error: Error = OutputError) -> None:
    """The folder of a file, if it isn't there. Raises `error` if it can't be made."""
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
    except OSError as reason:
        raise error(f"can't make the folder {file.parent}: {reason.strerror or reason}") from reason


def keep_in_cache(file: Path, content: Content) -> bool:
    """Write a file that can be made again, and its folder. False if it can't be written: the first time in a folder, a
    line of the log says so.
    """
    try:
        make_folder(file)
        write_whole(file, content)
    except OutputError as error:
        if file.parent not in _UNWRITABLE:
            _UNWRITABLE.add(file.parent)
            logger.warning("going on without the cache, so the next start takes longer: %s", error)
        return False
    return True


@contextmanager
def new_file(file: Path, error: Error = OutputError, *, sync: bool = True, ending: str = "") -> Iterator[Path]:
    """An empty temporary file that becomes `file` if all goes well, and disappears otherwise.

    `ending` is the temporary name's, for what goes by it. A file that is replaced leaves its permissions to the new
    one; a link to a file stays a link. What can't be replaced, /dev/null or a pipe, is written to as it is. Raises
    `error` for an OSError about this file, also from what fills it.
    """
    with _errors_named(file, error):
        target = Path(os.path.realpath(file))
        if target.exists() and not target.is_file():
            yield target
            return
        temporary = _temporary(target, ending)
        try:
            os.close(os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666))
            if target.exists():
                temporary.chmod(stat.S_IMODE(target.stat().st_mode))
            yield temporary
            if sync:
                _sync(temporary)
            os.replace(temporary, target)
        except BaseException:
            with suppress(OSError):
                temporary.unlink(missing_ok=True)
            raise
        if sync:
            _sync_folder(target.parent)


@contextmanager
def new_folder(dst: Path, error: Error = OutputError) -> Iterator[Path]:
    """A temporary folder that becomes `dst` if all goes well, and disappears otherwise.

    The caller has checked that `dst` doesn't exist or is empty. If somebody has put something there meanwhile, theirs
    stays. Raises `error` for an OSError about this folder, also from what fills it.
    """
    with _errors_named(dst, error):
        target = Path(os.path.realpath(dst))
        target.parent.mkdir(parents=True, exist_ok=True)
        # a mounted folder can't be replaced, nor one in a folder of somebody else's: what it gets is moved there
        stays = target.exists() and (target.is_mount() or not os.access(target.parent, os.W_OK))
        temporary = _temporary(target / target.name if stays else target)
        try:
            temporary.mkdir()
            yield temporary
            for path in temporary.rglob("*"):
                (_sync_folder if path.is_dir() else _sync)(path)
            _sync_folder(temporary)
            if stays:
                for path in temporary.iterdir():
                    path.rename(target / path.name)
                temporary.rmdir()
            else:
                if target.exists():
                    target.rmdir()  # empty: checked before
                temporary.rename(target)
        except BaseException:
            shutil.rmtree(temporary, ignore_errors=True)
            raise
        _sync_folder(target.parent)


@contextmanager
def alone_in(folder: Path, what: str, error: Error = OutputError) -> Iterator[None]:
    """Be the only one who writes into a folder, which is made if it isn't there; `what` this is, others are told.

    Raises `error`, with the other's process and host, if somebody is in there already. The system ends a lock with its
    process, however that ends, so none is ever stale. On a disk without locks a file with the process and host stands
    for it: it is stale if that process is gone; whether one of another host is, only a person can tell.
    """
    with _errors_named(folder / _LOCK, error):
        folder.mkdir(parents=True, exist_ok=True)
        file = folder / _LOCK
        descriptor = _lock(file)
    if descriptor is None:
        raise error(
            f"{folder} is being written by {what}, {_owner(file) or 'of another process'}: wait until it is done, or "
            f"write to another folder. If that process is gone, delete {file}"
        )
    try:
        yield
    finally:
        with suppress(OSError):
            file.unlink(missing_ok=True)
        os.close(descriptor)


def append_line(file: Path, line: str, error: Error = OutputError) -> None:
    """Append a line to a .jsonl, whole or not at all. Raises `error` if it can't be written.

    A half line that a kill has left at the file's end is cut off first: a line begins where a line should. Several
    processes may append to one file. Read it with `whole_lines`.
    """
    with (
        _errors_named(file, error),
        open(os.open(file, os.O_RDWR | os.O_CREAT, 0o666), "r+b", buffering=0) as stream,
        _locked(stream),
    ):
        end, last = _end_of_lines(stream)
        data = (b"\n" if last else b"") + line.encode() + b"\n"
        end += len(last)
        try:
            stream.truncate(end)
            stream.seek(end)
            while data:
                data = data[stream.write(data) :]
        except BaseException:
            with suppress(OSError):
                stream.truncate(end)
            raise


def whole_lines(file: Path) -> list[str]:
    """The lines of a .jsonl, without a half one at its end. Raises OSError, UnicodeDecodeError."""
    with file.open("rb") as stream:
        end, last = _end_of_lines(stream)
        stream.seek(0)
        lines = stream.read(end + len(last)).decode().split("\n")
    return [line for line in lines if line.strip()]


# ----------------------------------------------------------------------------------------------------------------------


def _temporary(target: Path, ending: str = "") -> Path:
    return Path(f"{_temporary_prefix(target)}.{os.getpid()}-{secrets.token_hex(6)}.part{ending}")


def _temporary_prefix(target: Path) -> str:
    return str(target.with_name(f".{target.name[:40]}"))


@contextmanager
def _errors_named(file: Path, error: Error) -> Iterator[None]:
    """An OSError about `file` becomes an `error` that names it, not the temporary one. One about another file stays."""
    try:
        yield
    except (BrokenPipeError, TurboPiError):
        raise
    except OSError as reason:
        if reason.filename is not None and not _is_about(reason.filename, file):
            raise
        raise error(f"can't write {file}: {_what(reason, file)}") from reason


def _is_about(name: object, file: Path) -> bool:
    """Whether the file that an OSError tells is this one, or its folder, or the temporary one."""
    target = os.path.realpath(file)
    path = os.path.realpath(os.fsdecode(name)) if isinstance(name, str | bytes) else ""
    return path in (target, os.path.dirname(target)) or path.startswith(_temporary_prefix(Path(target)))


def _what(reason: OSError, file: Path) -> str:
    if reason.errno in _FULL:
        return f"{reason.strerror}; make room, or write to another place"
    if isinstance(reason, FileNotFoundError | NotADirectoryError) and not file.absolute().parent.is_dir():
        return f"there is no folder {file.absolute().parent}"
    return reason.strerror or str(reason)


def _sync(file: Path) -> None:
    """Wait until the disk has a file. Only then is it known that there was room for it."""
    descriptor = os.open(file, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    except OSError as reason:
        if reason.errno not in (errno.EINVAL, errno.ENOTSUP):  # a file system that can't
            raise
    finally:
        os.close(descriptor)


def _sync_folder(folder: Path) -> None:
    """The same for names in a folder, where the system can; the file is whole either way."""
    with suppress(OSError):
        _sync(folder)


def _end_of_lines(stream: IO[bytes]) -> tuple[int, bytes]:
    """How long the lines of a .jsonl are that end in a line break, and an object behind them that lacks only that."""
    end = stream.seek(0, os.SEEK_END)
    tail = b""
    while end:
        begin = max(0, end - 2**16)
        stream.seek(begin)
        block = stream.read(end - begin)
        found = block.rfind(b"\n") + 1
        tail, end = block[found:] + tail, begin + found
        if found:
            break
    try:
        whole = isinstance(json.loads(tail), dict)
    except (ValueError, RecursionError):
        whole = False
    return end, tail if whole else b""


def _lock(file: Path) -> int | None:
    """A descriptor that holds the lock of a file, which names this process; None if another one has it."""
    while True:
        descriptor = os.open(file, os.O_RDWR | os.O_CREAT, 0o666)
        try:
            if not _try_lock(descriptor, file):
                os.close(descriptor)
                return None
            if _is_the_same(descriptor, file):  # the one before may have removed it between our opening and locking
                try:
                    os.ftruncate(descriptor, 0)
                    os.write(descriptor, f"process {os.getpid()} on {platform.node()}\n".encode())
                except OSError:  # a full disk: leave nothing behind
                    file.unlink(missing_ok=True)
                    raise
                return descriptor
        except BaseException:
            os.close(descriptor)
            raise
        os.close(descriptor)


def _try_lock(descriptor: int, file: Path) -> bool:
    try:
        import fcntl

        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except (ImportError, OSError):  # no locks on this system or disk
        return not _is_running(_owner(file))
    return True


def _is_the_same(descriptor: int, file: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(descriptor), os.stat(file))
    except FileNotFoundError:
        return False


def _owner(file: Path) -> str:
    """ "process 123 on host", as a lock's file tells it, or nothing."""
    try:
        text = file.read_text(encoding="utf-8", errors="replace").strip()
    except OSError:
        return ""
    return text if re.fullmatch(r"process \d{1,19} on [\w.-]{0,255}", text) else ""


def _is_running(owner: str) -> bool:
    if not owner:
        return False
    process, host = int(owner.split()[1]), owner.split(" on ")[1]
    if host != platform.node():
        return True
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except OSError:  # somebody else's
        return True
    return True


@contextmanager
def _locked(stream: IO[bytes]) -> Iterator[None]:
    """Alone with a file among the processes that ask; on systems and disks without locks, not."""
    with suppress(ImportError, OSError):
        import fcntl

        fcntl.flock(stream, fcntl.LOCK_EX)
    yield  # closing the file unlocks it
