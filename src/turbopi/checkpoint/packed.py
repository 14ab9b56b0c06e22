"""Weights that lie packed in their folder, as those of the policies that ship do.

    model.safetensors.xz       xz --lzma2=preset=9e,lc=3,lp=1,pb=1 model.safetensors
    model.safetensors.sha256   of what is in it: sha256sum model.safetensors > model.safetensors.sha256

They are unpacked once into the user's cache (11 MB: 0.7 s), and checked by their hash at every start.
"""

import atexit
import hashlib
import lzma
import re
import shutil
import tempfile
from pathlib import Path

from turbopi.checkpoint.torch_files import WEIGHTS
from turbopi.support.errors import CheckpointError
from turbopi.support.files import cache_folder, keep_in_cache
from turbopi.support.reading import one_line, read_bytes

PACKED, CHECKSUM = f"{WEIGHTS}.xz", f"{WEIGHTS}.sha256"
_MOST_BYTES = 128 * 2**20  # unpacked, and of the unpacker's memory: all of it is held at once

_temporary: dict[str, Path] = {}  # SHA-256 to where this process has unpacked what no cache could keep


def unpacked(folder: Path) -> Path:
    """A folder with the weights of `folder`, which lie packed there, as `model.safetensors`.

    It is $XDG_CACHE_HOME/turbopi/weights/HASH (~/.cache/turbopi/weights/HASH); where that can't be written, a temporary
    folder of this process. A file there that isn't what the checksum says is replaced.

    Raises CheckpointError if a file is damaged or missing, or is larger unpacked than 128 MiB.
    """
    expected = _checksum(folder / CHECKSUM)
    cached = cache_folder() / "weights" / expected[:32] / WEIGHTS
    for file in (cached, _temporary.get(expected, cached)):
        if _is(file, expected):
            return file.parent
    content = _unpack(folder / PACKED)
    if hashlib.sha256(content).hexdigest() != expected:
        raise CheckpointError(
            f"{folder / PACKED} doesn't hold what {CHECKSUM} beside it says: one of them is damaged, or they are of "
            "different checkpoints. Copy both anew"
        )
    return (cached if keep_in_cache(cached, content) else _write_temporary(content, expected, cached)).parent


def differs(folder: Path) -> bool:
    """Whether a folder has packed weights beside `model.safetensors`, and they are others."""
    return (folder / PACKED).is_file() and not _is(folder / WEIGHTS, _checksum(folder / CHECKSUM))


def _checksum(file: Path) -> str:
    """The SHA-256 in a file of `sha256sum`: 64 hexadecimal digits, then a name."""
    text = read_bytes(file, limit=4096, hint=f"; it belongs to {PACKED}").decode("ascii", "replace")
    if (found := re.match(r"[0-9a-f]{64}(?=\s|$)", text)) is None:
        raise CheckpointError(f"{file} begins with {text[:80]!r}; expected a line of sha256sum. Copy it anew")
    return found[0]


def _is(file: Path, expected: str) -> bool:
    """Whether a file can be read and has that SHA-256."""
    try:
        return hashlib.sha256(file.read_bytes()).hexdigest() == expected
    except OSError:
        return False


def _unpack(file: Path) -> bytes:
    data = read_bytes(file, limit=_MOST_BYTES)
    unpacker = lzma.LZMADecompressor(lzma.FORMAT_XZ, memlimit=_MOST_BYTES)
    try:
        content = unpacker.decompress(data, _MOST_BYTES)
    except lzma.LZMAError as error:
        raise CheckpointError(f"{file} can't be unpacked ({one_line(error)}): it is damaged. Copy it anew") from error
    if unpacker.eof:
        return content
    if len(content) == _MOST_BYTES:
        raise CheckpointError(
            f"{file} holds more than {_MOST_BYTES // 2**20} MiB: unpack it beside itself (xz --decompress {file})"
        )
    raise CheckpointError(f"{file} ends early: the download or copy is incomplete. Copy it anew")


def _write_temporary(content: bytes, expected: str, cached: Path) -> Path:
    try:
        folder = Path(tempfile.mkdtemp(prefix="turbopi-weights-"))
        atexit.register(shutil.rmtree, folder, ignore_errors=True)
        (folder / WEIGHTS).write_bytes(content)
    except OSError as error:
        raise CheckpointError(
            f"packed weights can be unpacked neither to {cached} nor to a temporary folder ({error}): name folders "
            "that can be written by XDG_CACHE_HOME or TMPDIR"
        ) from error
    _temporary[expected] = folder / WEIGHTS
    return _temporary[expected]
