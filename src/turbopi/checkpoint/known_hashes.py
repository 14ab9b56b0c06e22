"""Fingerprints of weights that were hashed before, so that an FP8 policy needn't read 7 to 13 GB twice to start.

Trusted is what tells a file from another one: path, device, inode, size and the nanosecond of its last change. Whoever
changes weights in place and sets that time back, or writes through a mapping that doesn't move it, is believed. What
must not rest on that (`turbopi inspect --hash`, calibrations, certificates) hashes anew, and corrects the entry.
"""

import hashlib
import json
import time
from collections.abc import Sequence
from pathlib import Path

from turbopi.support.files import cache_folder, keep_in_cache

_SETTLED_S = 2.0  # a file that was changed since may be changed again within the clock's tick: not remembered
_VERSION = 1  # of what a fingerprint is made from


def key_of(files: Sequence[Path], variant: str) -> str | None:
    """What the files are now, as one text; None where that can't be told, or may change unseen.

    `variant` is what else the values depend on, besides the files.
    """
    reported = []
    try:
        for file in files:
            state = file.stat()
            if time.time() - state.st_mtime < _SETTLED_S:
                return None
            reported.append([str(file.resolve()), state.st_dev, state.st_ino, state.st_size, state.st_mtime_ns])
    except OSError:
        return None
    if not reported:
        return None
    return hashlib.sha256(json.dumps([_VERSION, variant, sorted(reported)]).encode()).hexdigest()


def look_up(key: str) -> str | None:
    """The fingerprint that belongs to a key, if it is known."""
    try:
        found = _file(key).read_text(encoding="ascii").strip()
    except (OSError, UnicodeDecodeError):
        return None
    return found if len(found) == 64 else None


def remember(key: str, fingerprint: str) -> None:
    """Keep it. A folder that can't be written costs nothing but the next start's time."""
    keep_in_cache(_file(key), fingerprint + "\n")


def _file(key: str) -> Path:
    return cache_folder() / "fingerprints" / key[:32]
