"""NumPy's .npz and .npy, without pickles, and with every claim of theirs checked before it costs memory."""

import ast
import math
import os
import re
import struct
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import TracebackType
from typing import IO, Literal

import numpy as np

from turbopi.support.errors import ObservationError, TurboPiError
from turbopi.support.reading.fields import is_integer
from turbopi.support.reading.files import Error, one_line, open_file, shown

MAX_ARRAY_BYTES = 512 * 2**20  # of all arrays of a file together
_MAX_NPY_HEADER = 4096


class Npz(Mapping[str, np.ndarray]):
    """The arrays of an .npz by name; one is read when it is asked for, and only then. Close it, or use `with`.

    error   what is raised for a file or an array that can't be read; nothing is ever unpickled
    limit   bytes of all arrays that are read, together, as the file claims them: checked before data is read
    """

    def __init__(self, file: str | Path, error: Error = ObservationError, *, limit: int = MAX_ARRAY_BYTES) -> None:
        self._file, self._error, self._limit, self._left = file, error, limit, limit
        self._stream = open_file(file, error)
        self._members: dict[str, zipfile.ZipInfo] = {}
        try:
            begin = self._stream.read(4)
            if begin == b"\x93NUM":
                raise error(f"{file} isn't an .npz file, but an .npy")
            if begin not in (b"PK\3\4", b"PK\5\6"):
                raise error(f"{file} isn't a readable .npz file: it is no zip archive")
            self._archive = zipfile.ZipFile(self._stream)
            count = len(self._archive.infolist())
            if count != _count_at_the_end(self._stream) or (count == 0) != (begin == b"PK\5\6"):
                raise error(f"{file} isn't a readable .npz file: its list of arrays is damaged")
            for member in self._archive.infolist():
                name = member.filename.removesuffix(".npy")
                if name in self._members:
                    raise error(f"{file} isn't a readable .npz file: it holds {shown(name)} twice")
                self._members[name] = member
        except TurboPiError:
            self.close()
            raise
        except Exception as reason:  # whatever damage makes zipfile raise: a dozen classes
            self.close()
            raise error(f"{file} isn't a readable .npz file: {_reason(reason)}") from reason

    def __getitem__(self, name: str) -> np.ndarray:
        """Raises KeyError for a name that isn't there, and the file's error for an array that can't be read."""
        member = self._members[name]
        where = f"{self._file} isn't a readable .npz file: its {shown(name)}"
        try:
            with self._archive.open(member) as stream:
                array = _read_array(stream, member.file_size, self._left, where, self._error)
        except TurboPiError:
            raise
        except Exception as reason:  # as above, and what the decompressors raise
            raise self._error(f"{where} is damaged: {_reason(reason)}") from reason
        self._left -= array.nbytes
        return array

    def __iter__(self) -> Iterator[str]:
        return iter(self._members)

    def __len__(self) -> int:
        return len(self._members)

    def close(self) -> None:
        self._stream.close()

    def __enter__(self) -> "Npz":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _count_at_the_end(stream: IO[bytes]) -> int | None:
    """The number of members that a zip archive says it has in its last 22 bytes, which zipfile doesn't look at.

    None where there is no such end: behind a comment, which no .npz has. More than 65,534 are written elsewhere.
    """
    stream.seek(-22, os.SEEK_END)
    end = stream.read(22)
    return int.from_bytes(end[10:12], "little") if end[:4] == b"PK\5\6" else None


def read_npz(
    file: str | Path, error: Error = ObservationError, *, limit: int = MAX_ARRAY_BYTES
) -> dict[str, np.ndarray]:
    """All arrays of an .npz, of at most `limit` bytes together; see `Npz`."""
    with Npz(file, error, limit=limit) as archive:
        return dict(archive)


def read_npy(file: str | Path, error: Error = ObservationError, *, limit: int = MAX_ARRAY_BYTES) -> np.ndarray:
    """The array in an .npy of at most `limit` bytes. The file ends where its array does. Nothing is unpickled."""
    where = f"{file} isn't a readable .npy file: it"
    with open_file(file, error) as stream:
        try:
            return _read_array(stream, os.fstat(stream.fileno()).st_size, limit, where, error)
        except OSError as reason:
            raise error(f"{file} can't be read: {reason.strerror or reason}") from reason


def _reason(error: Exception) -> str:
    return f"{type(error).__name__} {one_line(error)}".rstrip()


_DTYPE = re.compile(r"[<>|=]?(b1|[iu][1248]|f[248]|[US]\d{1,7}|[mM]8\[\d{0,4}[a-zA-Z]{1,2}\])")


def _read_array(stream: IO[bytes], size: int, limit: int, where: str, error: Error) -> np.ndarray:
    """An array in NumPy's format that takes all `size` bytes of a stream; its claims are checked before it is read."""
    dtype, order, shape, begin = _read_header(stream, where, error)
    needed = math.prod(shape) * dtype.itemsize
    if needed > limit:
        raise error(
            f"{where} is an array of {needed} bytes ({dtype.str}, shape {list(shape)}); at most {limit} are read"
        )
    if begin + needed != size:
        raise error(
            f"{where} is an array of {needed} bytes ({dtype.str}, shape {list(shape)}), but {size - begin} are there"
        )
    data = stream.read(needed) if needed else b""
    if len(data) != needed or stream.read(1):  # the second read also has zipfile check the CRC of an empty array
        raise error(f"{where} ends after {len(data)} of its {needed} bytes")
    if dtype.kind == "b" and data.translate(None, b"\0\1"):
        raise error(f"{where} is a bool array with bytes that are neither 0 nor 1")
    if not is_unicode(data, dtype):
        raise error(f"{where} is an array of text with a number that is no Unicode character")
    return np.ndarray(shape, dtype, bytearray(data), order=order)  # a bytearray: the array can be written to


def is_unicode(data: bytes, dtype: np.dtype) -> bool:
    """Whether an array of these bytes has Unicode characters alone, if it is one of text (kind U); halves are none."""
    if dtype.kind != "U":
        return True
    codes = np.frombuffer(data, np.dtype(np.uint32).newbyteorder(dtype.byteorder))
    return not ((codes > 0x10FFFF) | ((codes >= 0xD800) & (codes <= 0xDFFF))).any()


def _read_header(
    stream: IO[bytes], where: str, error: Error
) -> tuple[np.dtype, Literal["C", "F"], tuple[int, ...], int]:
    """dtype, order ("C" or "F"), shape, and where the data begins. NumPy's format 1.0 and 2.0; what both mean is in
    numpy/lib/format.py.
    """
    begin = stream.read(8)
    if begin[:6] != b"\x93NUMPY":
        raise error(f"{where} doesn't begin as one" if begin else f"{where} is empty")
    if begin[6:] not in (b"\1\0", b"\2\0"):
        raise error(f"{where} has version {list(begin[6:])} of NumPy's format; expected [1, 0] or [2, 0]")
    width = 2 if begin[6] == 1 else 4
    (length,) = struct.unpack("<I", stream.read(width).ljust(4, b"\0"))
    if length > _MAX_NPY_HEADER:
        raise error(f"{where} has a header of {length} bytes; at most {_MAX_NPY_HEADER} are read")
    text = stream.read(length)
    try:
        if len(text) < length:
            raise ValueError("it ends early")
        header = ast.literal_eval(text.decode("latin1").strip())
        if not isinstance(header, dict) or set(header) != {"descr", "fortran_order", "shape"}:
            raise ValueError("expected descr, fortran_order and shape")
        descr, fortran, shape = header["descr"], header["fortran_order"], header["shape"]
        if not isinstance(fortran, bool):
            raise ValueError(f"fortran_order is {shown(fortran)}")
        if not isinstance(shape, tuple) or len(shape) > 32 or not all(is_integer(n) and 0 <= n < 2**48 for n in shape):
            raise ValueError(f"shape is {shown(shape)}")
        dtype = np.dtype(descr) if isinstance(descr, str) and _DTYPE.fullmatch(descr) else None
        if dtype is not None and not dtype.itemsize and math.prod(shape) > 2**20:
            raise ValueError(f"shape is {shown(shape)} of nothing")
    except (ValueError, TypeError, SyntaxError, MemoryError, RecursionError) as reason:
        raise error(f"{where} has a damaged header: {_reason(reason)}") from reason
    if dtype is None:
        objects = ". None, or rows of different lengths, make an array of Python objects" if descr == "|O" else ""
        raise error(f"{where}: dtype {shown(descr)} isn't read, only numbers, bool and text{objects}")
    return dtype, "F" if fortran else "C", shape, 8 + width + length
