"""Files that commands write and read."""

import os
import sys
import tempfile
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from turbopi.support.errors import ConfigError, ObservationError

MAX_RESULTS_BYTES = 512 * 2**20

if TYPE_CHECKING:
    import numpy as np


def check_folder(folder: Path) -> None:
    """Raise ConfigError now for a folder that couldn't be made or written to later, after all the work."""
    places = (folder.absolute(), *folder.absolute().parents)
    existing = next(path for path in places if os.path.exists(path))
    if not existing.is_dir():
        raise ConfigError(f"can't write into {folder}: {existing} is a file")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        _probe(folder)
    except OSError as error:
        why = "isn't writable" if existing == places[0] else "takes no such folder"
        raise ConfigError(f"can't write into {folder}: {existing} {why} ({error.strerror})") from error
    finally:
        for made in places[: places.index(existing)]:  # by this check alone
            with suppress(OSError):
                made.rmdir()


def _probe(folder: Path) -> None:
    """Make something in a folder, and remove it. Raises OSError; `os.access` allows root what a filesystem doesn't."""
    os.rmdir(tempfile.mkdtemp(prefix=".turbopi-", dir=folder))


def check_writable(file: Path) -> None:
    """Raise ConfigError now for an output file that couldn't be written later, after all the work."""
    if file.is_dir():
        raise ConfigError(f"{file} is a folder; give a file's name")
    if not file.absolute().parent.is_dir():
        raise ConfigError(f"can't write {file}: there is no folder {file.absolute().parent}")
    if file.exists() and not os.access(file, os.W_OK):
        raise ConfigError(f"can't write {file}: it isn't writable")
    target = Path(os.path.realpath(file))
    if target.exists() and not target.is_file():
        return  # /dev/null or a pipe, which is written to as it is
    try:
        _probe(target.parent)
    except OSError as error:
        raise ConfigError(f"can't write {file}: {target.parent} isn't writable ({error.strerror})") from error


def check_replaces(file: Path, key: str, what: str) -> None:
    """Raise ConfigError if a file is there that isn't `what` a command writes, a JSON object with this key: another
    command's results would be lost.
    """
    from turbopi.support.reading import read_json

    if file.exists() and key not in read_json(file, ConfigError, limit=MAX_RESULTS_BYTES):
        raise ConfigError(f"{file} is there and isn't {what}, so it isn't replaced; name another folder")


def check_report(file: Path, key: str, what: str) -> None:
    """Raise ConfigError now for a report that couldn't be written later, or would replace another command's file.

    key, what  as for `check_replaces`
    """
    check_folder(file.parent)
    check_replaces(file, key, what)


def let_import_from_here() -> None:
    """Have "module:Class" find modules of the current folder: a console script's path lacks it, `python -m` has it."""
    if os.getcwd() not in sys.path:
        sys.path.insert(0, os.getcwd())


MAX_NOISE_BYTES = 16 * 2**20  # of float64[1000, 1024], twice


def load_noise(file: Path) -> "np.ndarray":
    """The noise in an .npy file, or under `noise` in an .npz. Raises ObservationError if there is none."""
    from turbopi.support.reading import Npz, listing, open_file, read_npy

    try:
        with open_file(file, ObservationError) as stream:
            begin = stream.read(4)
        if begin == b"\x93NUM":
            return read_npy(file, limit=MAX_NOISE_BYTES)
        with Npz(file, limit=MAX_NOISE_BYTES) as archive:
            if "noise" not in archive:
                raise ObservationError(f"{file} has no array named noise, only {listing(list(archive)) or 'nothing'}")
            return archive["noise"]
    except ObservationError as error:
        raise ObservationError(f"the noise {error}") from error
