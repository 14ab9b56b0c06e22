"""openpi's wire format: msgpack, with numpy arrays and scalars as small maps. Same bytes as openpi, safer to decode.

    array   {b"__ndarray__": True, b"data": C-order bytes, b"dtype": "<f4", b"shape": [2, 3]}
    scalar  {b"__npgeneric__": True, b"data": 1.25, b"dtype": "<f4"}   but float64, str and bytes as plain values

The keys are msgpack `bin`, not `str`. Real and integer dtypes, bool, fixed-width strings and datetimes pass; void,
object and complex don't. Nothing is ever pickled.

A message is not trusted: its headers are walked before msgpack builds anything (msgpack allocates what an array
header claims, so a few bytes could ask for gigabytes), and an array must bring exactly the bytes its shape needs.
Decoding therefore allocates a small multiple of the message's length, whatever the message says, and what it costs
besides copying bytes is bounded too: a few milliseconds for the worst message. Images aren't copied.
"""

import math
import re
import reprlib
import struct
import threading
from collections.abc import Callable
from functools import lru_cache
from typing import Any

import msgpack
import numpy as np

from turbopi.support.errors import ObservationError
from turbopi.support.reading.arrays import is_unicode

MAX_DEPTH = 32  # containers inside each other; an ALOHA request has 3
MAX_VALUES = 20_000  # msgpack values, keys included; a request has about 50, so this leaves room for lists of numbers
MAX_STEPS = 4_000  # maps, lists, strings and changes between kinds of numbers: each costs the walk half a microsecond
MAX_DIMS = 32  # what NumPy 1 can hold
MAX_EMPTY = 2**20  # product of an empty array's other dimensions: [0, 2**60] needs no data, but who sums it up pays
MAX_BYTES = 64 * 2**20
LARGE = 16384  # bytes of an array from which on it isn't copied, if it needn't be

_REFUSED_KINDS = "VOc"
_DTYPE = re.compile(r"[<>|=]?([a-zA-Z?])(\d{0,7})(\[\d{0,4}[a-zA-Z]{1,2}\])?")
_SCALAR_TYPES: dict[str, tuple[type, ...]] = {
    "b": (bool,),
    "i": (int,),
    "u": (int,),
    "f": (float, int),
    "S": (bytes,),
    "U": (str,),
}


class WireError(ObservationError):
    """A message that isn't in the wire format, or a value that can't be sent in it."""


# --- encoding ---------------------------------------------------------------------------------------------------------


def pack(value: object) -> bytes:
    """Encode `value`: dicts, lists, strings, bytes, numbers, None, numpy arrays and scalars.

    Raises WireError for anything else, and for void, object and complex dtypes.
    """
    return b"".join(pack_parts(value))


def pack_parts(value: object) -> list[bytes | memoryview]:
    """`pack`, as parts to write one after the other: the numbers of large arrays are views, and aren't copied."""
    parts: list[bytes | memoryview] = []
    try:
        _add_parts(value, parts, _PACKER.packer.pack, 0)
    except WireError:
        raise
    except (TypeError, ValueError, OverflowError) as error:
        raise WireError(f"can't send this value: {error}") from error
    return parts


def _add_parts(value: object, parts: list[bytes | memoryview], packed: Callable[[object], bytes], depth: int) -> None:
    """Add what `value` is in the format. Arrays elsewhere than in maps, and those far inside, are copied."""
    if isinstance(value, np.ndarray):
        _check_dtype(value.dtype)
        head, tail = _around(value.dtype, value.shape)
        parts += (head, _bytes_of(value), tail)
    elif type(value) is dict and depth < MAX_DEPTH and not _PLAIN.issuperset(map(type, value.values())):
        parts.append(_head(_MAPS, len(value)))
        for key, item in value.items():
            parts.append(packed(key))
            _add_parts(item, parts, packed, depth + 1)
    else:
        parts.append(packed(value))


@lru_cache(maxsize=256)
def _around(dtype: np.dtype[Any], shape: tuple[int, ...]) -> tuple[bytes, bytes]:
    """What is in front of an array's numbers, and what follows them."""
    pack = msgpack.Packer().pack
    front = _head(_MAPS, 4) + b"".join(map(pack, (b"__ndarray__", True, b"data")))
    after = b"".join(map(pack, (b"dtype", dtype.str, b"shape", shape)))
    return front + _head(_BINS, math.prod(shape) * dtype.itemsize), after


def _head(kinds: tuple[int, int, int], size: int) -> bytes:
    """msgpack's header of a map or bin of that size."""
    if kinds is _MAPS and size < 16:
        return bytes((kinds[0] + size,))
    power = 0 if kinds is _BINS and size < 2**8 else 1 if size < 2**16 else 2
    return bytes((kinds[power],)) + size.to_bytes(1 << power, "big")


_MAPS, _BINS = (0x80, 0xDE, 0xDF), (0xC4, 0xC5, 0xC6)
_PLAIN = frozenset((str, bytes, bool, int, float, type(None)))


def _fields(value: object) -> dict[bytes, object]:
    """What msgpack packs in place of what it doesn't know."""
    if isinstance(value, int):  # msgpack asks about what it can't hold
        raise WireError(f"can't send the integer {_shown(value)}: the format's integers have 64 bits")
    if not isinstance(value, np.ndarray | np.generic):
        raise WireError(
            f"can't send a {type(value).__module__}.{type(value).__qualname__}: "
            "a message holds dicts, lists, strings, bytes, numbers, None and numpy arrays. Send a tensor or an image "
            "as a numpy array"
        )
    _check_dtype(value.dtype)
    if isinstance(value, np.ndarray):
        return {b"__ndarray__": True, b"data": value.tobytes(), b"dtype": value.dtype.str, b"shape": value.shape}
    item = value.item()
    if not isinstance(item, bool | int | float) or isinstance(item, np.generic):
        raise WireError(f"can't send a {value.dtype} scalar: send it as a 0-dimensional array")
    return {b"__npgeneric__": True, b"data": item, b"dtype": value.dtype.str}


def _check_dtype(dtype: np.dtype[Any]) -> None:
    if dtype.kind in _REFUSED_KINDS:
        raise WireError(f"can't send dtype {dtype}: void, object and complex aren't part of the format")


def _bytes_of(array: np.ndarray) -> bytes | memoryview:
    """Its numbers in C order, not copied where that would cost more than it spares."""
    if array.nbytes < LARGE or not array.flags.c_contiguous:
        return array.tobytes()
    return array.reshape(-1).view(np.uint8).data


class _ThreadsPacker(threading.local):
    """msgpack's, of each thread: to make one takes longer than to use it."""

    def __init__(self) -> None:
        self.packer = msgpack.Packer(default=_fields)


_PACKER = _ThreadsPacker()


# --- decoding ---------------------------------------------------------------------------------------------------------


def unpack(data: bytes, *, max_bytes: int = MAX_BYTES) -> Any:
    """Decode one message. Its arrays are read-only.

    Large arrays of int8 and uint8 are views of `data` itself, which lives as long as they do; others are copies.
    Raises WireError, and nothing else, for whatever is wrong; the message names the place and what was expected there.
    """
    if len(data) > max_bytes:
        raise WireError(f"the message has {len(data)} bytes; the limit is {max_bytes}")
    rest, large = _set_aside(data, _check_structure(data))

    def place(kind: int, number: bytes) -> memoryview:
        return large[int.from_bytes(number, "big")]

    try:
        value = msgpack.unpackb(rest, strict_map_key=True, object_pairs_hook=_unique_keys, ext_hook=place)
    except WireError:
        raise
    except UnicodeDecodeError as error:
        raise WireError(
            f"not a msgpack message: a string isn't UTF-8 ({error.reason}). Bytes are msgpack bin (use_bin_type=True). "
            + PACK_WITH
        ) from error
    except (ValueError, TypeError, msgpack.UnpackException) as error:  # the structure is right: it's about the keys
        raise WireError(f"the keys of a map must be str or bin: {error}") from error
    return _restore(value, ())


class Unpacker:
    """`unpack` for the messages of one sender.

    Those that differ from an earlier one in their arrays' numbers and their floats alone, as a robot's observations and
    their answers do, are compared with it instead of being walked: 5 us instead of 80.
    """

    def __init__(self) -> None:
        self._size = -1
        self._like: _Alike | None = None

    def unpack(self, data: bytes | memoryview, *, max_bytes: int = MAX_BYTES) -> Any:
        """What `unpack` returns or raises.

        In a memoryview only images may change meanwhile: they are views of it, or of a copy.
        """
        if self._like is not None and (value := self._like.filled(data)) is not None:
            return value
        data = bytes(data)
        value, again = unpack(data, max_bytes=max_bytes), len(data) == self._size
        self._size, self._like = len(data), _Alike.of(data, value) if again else None  # not of what comes only once
        return value


_NUMBER, _BYTES, _ARRAY, _MAP, _EXT, _INVALID = range(6)
_RUN = 256  # numbers looked at together


def _head_table() -> tuple[tuple[int, int, int], ...]:
    """(kind, bytes of length field, fixed length) for each first byte, from the msgpack specification.

    The length is the number of bytes that follow (_NUMBER, _BYTES), of elements (_ARRAY), or of pairs (_MAP). What has
    no length field and isn't a container counts as a _NUMBER: nil, booleans and strings below 32 bytes too.
    """
    table = [(_NUMBER, 0, 0)] * 256  # integers below 128, negative fixints, nil, booleans
    for n in range(16):
        table[0x80 + n] = (_MAP, 0, n)
        table[0x90 + n] = (_ARRAY, 0, n)
    for n in range(32):
        table[0xA0 + n] = (_NUMBER, 0, n)  # str
    table[0xC1] = (_INVALID, 0, 0)
    for n in range(3):
        table[0xC4 + n] = (_BYTES, 1 << n, 0)  # bin
        table[0xD9 + n] = (_BYTES, 1 << n, 0)  # str
    for n in range(4):
        table[0xCC + n] = table[0xD0 + n] = (_NUMBER, 0, 1 << n)  # unsigned, signed
    table[0xCA], table[0xCB] = (_NUMBER, 0, 4), (_NUMBER, 0, 8)  # float32, float64
    for head in (*range(0xC7, 0xCA), *range(0xD4, 0xD9)):
        table[head] = (_EXT, 0, 0)
    table[0xDC], table[0xDD] = (_ARRAY, 2, 0), (_ARRAY, 4, 0)
    table[0xDE], table[0xDF] = (_MAP, 2, 0), (_MAP, 4, 0)
    return tuple(table)


_HEADS = _head_table()
_EXTENSION = struct.Struct(">BBI")  # head, type and four bytes of data
# First bytes by the length of what they begin: a run of those is found at once, not value by value.
_SAME_LENGTH = {
    length: bytes(head for head in range(256) if _HEADS[head] == (_NUMBER, 0, length))
    for length in {length for kind, _, length in _HEADS if kind == _NUMBER}
}


def _check_structure(data: bytes) -> list[tuple[int, int, int]]:
    """Walk the headers of `data` without building anything: complete, nothing left over, within the limits.

    Returns where bins of LARGE bytes and more are: the places of header, first byte and end.
    """
    size, position, values, steps = len(data), 0, 1, 0
    large: list[tuple[int, int, int]] = []
    pending = [1]  # values still to come, in each open container
    while pending:
        if not pending[-1]:
            pending.pop()
            continue
        steps += 1
        if steps > MAX_STEPS:
            raise WireError(
                f"more than {MAX_STEPS} maps, lists, strings and changes between kinds of numbers in one message: "
                "send numbers as numpy arrays"
            )
        if position >= size:
            raise WireError(f"not a msgpack message: it ends after {size} bytes, where another value should follow")
        kind, length_bytes, length = _HEADS[data[position]]
        if kind == _NUMBER:
            run = min(pending[-1], _RUN)
            heads = data[position : position + (length + 1) * run : length + 1]
            same = _SAME_LENGTH[length]
            run = len(heads) if not heads.translate(None, same) else len(heads) - len(heads.lstrip(same))
            pending[-1] -= run
            position += (length + 1) * run
            if position > size:
                start = position - length - 1
                raise WireError(_incomplete(start, length, size - start - 1))
            continue
        if kind == _INVALID:
            raise WireError(f"not a msgpack message: byte {position} is 0xc1, which begins no value")
        if kind == _EXT:
            raise WireError(f"a msgpack extension type at byte {position}: this protocol has none")
        pending[-1] -= 1
        start, position = position, position + 1 + length_bytes
        if length_bytes:
            length = int.from_bytes(data[start + 1 : position], "big")
        needed = length * 2 if kind == _MAP else length  # every element takes at least one byte
        if needed > size - position:
            raise WireError(_incomplete(start, needed, max(size - position, 0)))
        if kind == _BYTES:
            position += length
            if length >= LARGE and data[start] in _BINS:
                large.append((start, position - length, position))
            continue
        values += needed
        if values > MAX_VALUES:
            raise WireError(f"more than {MAX_VALUES} values in one message: send numbers as numpy arrays, not as lists")
        if len(pending) > MAX_DEPTH:
            raise WireError(f"more than {MAX_DEPTH} maps and lists inside each other")
        pending.append(needed)
    if position != size:
        raise WireError(f"not a msgpack message: {size - position} bytes follow its end at byte {position}")
    return large


def _set_aside(data: bytes, places: list[tuple[int, int, int]]) -> tuple[bytes, list[memoryview]]:
    """`data` with a number in place of each bin at `places`, and the bins as views: msgpack would copy them.

    The number is an extension value. A message has none of its own: `_check_structure` refuses them.
    """
    if not places:
        return data, []
    whole, parts, at = memoryview(data).toreadonly(), list[bytes | memoryview](), 0
    for number, (start, _, end) in enumerate(places):
        parts += (whole[at:start], _EXTENSION.pack(0xD6, 0, number))
        at = end
    return b"".join((*parts, whole[at:])), [whole[begin:end] for _, begin, end in places]


def _incomplete(start: int, needed: int, there: int) -> str:
    return f"not a msgpack message: the value at byte {start} needs {needed} more bytes, of which {there} are there"


def _unique_keys(pairs: list[tuple[object, object]]) -> dict[object, object]:
    value = dict(pairs)
    if len(value) != len(pairs):
        seen: set[object] = set()
        repeated = next(key for key, _ in pairs if key in seen or seen.add(key))  # type: ignore[func-returns-value]
        raise WireError(f"a map holds the key {_shown(repeated)} more than once")
    return value


_OPEN = frozenset((dict, list, memoryview))
_OTHER_MARKS = frozenset((b"nd", b"complex", "nd", "complex"))  # PyPI's msgpack-numpy, with bin keys and with str keys
PACK_WITH = (
    "This protocol has openpi's arrays, {b'__ndarray__': True, b'data': …, b'dtype': …, b'shape': …}: pack and unpack "
    "with openpi_client.msgpack_numpy or turbopi.realtime.wire"
)


def _restore(value: Any, path: tuple[Any, ...]) -> Any:
    """Turn maps that stand for arrays and scalars into these, and bins that were set aside alone into bytes.

    path  of `value` in the message, for errors
    """
    if isinstance(value, memoryview):
        return bytes(value)
    if isinstance(value, dict):
        if b"__ndarray__" in value:
            return _array(value, path)
        if b"__npgeneric__" in value:
            return _scalar(value, path)
        if "__ndarray__" in value or "__npgeneric__" in value:
            raise WireError(f"{_at(path)}: the keys of a packed array are msgpack bin, not str")
        if any(type(value[mark]) is bool for mark in _OTHER_MARKS & value.keys()) and {b"data", "data"} & value.keys():
            raise WireError(f"{_at(path)}: an array or number as msgpack-numpy packs it. {PACK_WITH}")
        return {key: _restore(item, (*path, key)) if type(item) in _OPEN else item for key, item in value.items()}
    if isinstance(value, list) and not _OPEN.isdisjoint(map(type, value)):
        return [_restore(item, (*path, i)) if type(item) in _OPEN else item for i, item in enumerate(value)]
    return value


def _array(fields: dict[object, object], path: tuple[object, ...]) -> np.ndarray:
    _check_fields(fields, (b"__ndarray__", b"data", b"dtype", b"shape"), path)
    dtype = _dtype(fields[b"dtype"], path)
    data, shape = fields[b"data"], fields[b"shape"]
    if not isinstance(data, bytes | memoryview):
        raise WireError(f"{_at(path)}: an array's data must be msgpack bin, not {type(data).__name__}")
    if not isinstance(shape, list) or not all(type(n) is int and n >= 0 for n in shape):
        raise WireError(f"{_at(path)}: shape must be a list of integers from 0 up, not {_shown(shape)}")
    if len(shape) > MAX_DIMS or (0 in shape and math.prod(n for n in shape if n) > MAX_EMPTY):
        raise WireError(f"{_at(path)}: shape {_shown(shape)} is too large")
    expected = math.prod(shape) * dtype.itemsize
    if len(data) != expected:
        raise WireError(
            f"{_at(path)}: shape {_shown(shape)} of {dtype.str} needs {expected} bytes of data, but {len(data)} came"
        )
    if isinstance(data, memoryview):
        if dtype.str[1:] in ("u1", "i1"):
            return np.ndarray(tuple(shape), dtype, data)
        data = bytes(data)  # where wider numbers are aligned
    if dtype.kind == "b" and data.translate(None, b"\x00\x01"):
        raise WireError(f"{_at(path)}: a bool array's bytes must be 0 or 1")
    if not is_unicode(data, dtype):
        raise WireError(f"{_at(path)}: a string array holds a number that is no Unicode character")
    return np.ndarray(tuple(shape), dtype, data)


def _scalar(fields: dict[Any, Any], path: tuple[Any, ...]) -> Any:
    _check_fields(fields, (b"__npgeneric__", b"data", b"dtype"), path)
    dtype, data = _dtype(fields[b"dtype"], path), fields[b"data"]
    if isinstance(data, memoryview):
        data = bytes(data)
    if type(data) not in _SCALAR_TYPES.get(dtype.kind, ()):
        raise WireError(f"{_at(path)}: a {dtype.str} scalar can't be made from {_shown(data)}")
    if dtype.kind in "iu" and not np.iinfo(dtype).min <= data <= np.iinfo(dtype).max:
        raise WireError(f"{_at(path)}: {data} doesn't fit into {dtype.str}")
    with np.errstate(over="ignore"):
        value = dtype.type(data)
    if dtype.kind == "f" and np.isinf(value) and not math.isinf(data):
        raise WireError(f"{_at(path)}: {data} doesn't fit into {dtype.str}")
    return value


def _check_fields(fields: dict[object, object], expected: tuple[bytes, ...], path: tuple[object, ...]) -> None:
    if set(fields) != set(expected):
        keys = _shown(list(fields))
        raise WireError(f"{_at(path)}: a map with {expected[0]!r} must have the keys {expected}, not {keys}")
    if fields[expected[0]] is not True:
        raise WireError(f"{_at(path)}: {expected[0]!r} must be true, not {_shown(fields[expected[0]])}")


def _dtype(text: Any, path: tuple[Any, ...]) -> np.dtype[Any]:
    """`text` as a dtype. Only what `dtype.str` produces is read: NumPy's own parser takes whole structures."""
    match = _DTYPE.fullmatch(text) if isinstance(text, str) else None
    if match is None:
        raise WireError(f"{_at(path)}: dtype must be a string like '<f4', not {_shown(text)}")
    if match[1] in _REFUSED_KINDS:
        raise WireError(f"{_at(path)}: dtype {text!r} is refused: void, object and complex aren't part of the format")
    if match[1] not in "biufSUmM" or not match[2] or (match[3] and match[1] not in "mM"):
        raise WireError(f"{_at(path)}: dtype must be a string like '<f4', not {_shown(text)}")
    try:
        dtype = np.dtype(text)
    except (TypeError, ValueError, OverflowError) as error:
        raise WireError(f"{_at(path)}: NumPy knows no dtype {text!r}") from error
    if dtype.itemsize <= 0:
        raise WireError(f"{_at(path)}: dtype {text!r} has no bytes")
    return dtype


def _at(path: tuple[object, ...]) -> str:
    return "/".join(_shown(key) for key in path) if path else "the message"


class _Short(reprlib.Repr):
    """`repr` that stays short, and costs little, however large the value."""

    maxstring = 80

    def repr_bytes(self, value: bytes, level: int) -> str:
        return repr(value) if len(value) <= 40 else f"{value[:40]!r}…"


_shown = _Short().repr


# --- messages that look alike -----------------------------------------------------------------------------------------

# An array's numbers: first byte and end, dtype, shape. Or a float's eight bytes: no dtype.
_Hole = tuple[int, int, np.dtype | None, tuple[int, ...]]
_DOUBLE = struct.Struct(">d")
_DOUBLE_HEAD = 0xCB


class _Alike:
    """A message, and where the numbers of its arrays and its floats are. All else is compared byte by byte."""

    def __init__(self, data: bytes, value: dict[str, Any], holes: list[_Hole]) -> None:
        self._size, self._value, self._holes = len(data), value, holes
        begins, ends = [0, *(hole[1] for hole in holes)], [*(hole[0] for hole in holes), len(data)]
        self._same = [(begin, end, data[begin:end]) for begin, end in zip(begins, ends, strict=True)]

    @classmethod
    def of(cls, data: bytes, value: Any) -> "_Alike | None":
        """None: it holds lists, of which each message needs its own, or too much to keep besides the arrays."""
        holes: list[_Hole] = []
        if not isinstance(value, dict):
            return None
        try:
            skeleton, end = _skeleton(data, 0, value, holes)
        except _NotAlike:
            return None
        assert end == len(data)
        return cls(data, skeleton, holes) if len(data) - sum(end - begin for begin, end, *_ in holes) < LARGE else None

    def filled(self, data: bytes | memoryview) -> dict[str, Any] | None:
        """The value of `data`; None if it doesn't look like this message."""
        if len(data) != self._size:
            return None
        for begin, end, same in self._same:
            if data[begin:end] != same:
                return None
        whole = memoryview(data)
        values = [
            _DOUBLE.unpack_from(data, begin)[0]
            if dtype is None
            else np.ndarray(shape, dtype, whole[begin:end] if dtype.itemsize == 1 else bytes(data[begin:end]))
            for begin, end, dtype, shape in self._holes
        ]
        return _filled(self._value, values)


class _NotAlike(Exception):
    pass


class _Place(int):
    """Stands for an array or a float: its place among the holes."""


def _skeleton(data: bytes, at: int, value: Any, holes: list[_Hole]) -> tuple[Any, int]:
    """`value`, which begins at `data[at]`, with a `_Place` for each array of numbers and float; and where it ends."""
    if isinstance(value, list):
        raise _NotAlike
    if isinstance(value, dict):
        made, at = {}, _content(data, at)[0]
        for key, item in value.items():
            made[key], at = _skeleton(data, _end(data, at), item, holes)
        return made, at
    end = _end(data, at)
    if type(value) is float and data[at] == _DOUBLE_HEAD:
        holes.append((at + 1, end, None, ()))
        return _Place(len(holes) - 1), end
    if not isinstance(value, np.ndarray) or value.dtype.kind not in "iuf":
        return value, end  # it can't be changed
    at = _content(data, at)[0]
    while at < end:
        key, key_end = _content(data, at)
        begin, at = _content(data, key_end)[0], _end(data, key_end)
        if data[key:key_end] == b"data":
            holes.append((begin, at, value.dtype, value.shape))
    return _Place(len(holes) - 1), end


def _content(data: bytes, at: int) -> tuple[int, int]:
    """Of the value at `data[at]`: where its content begins, and where that ends if it is no container."""
    _, length_bytes, length = _HEADS[data[at]]
    begin = at + 1 + length_bytes
    return begin, begin + (int.from_bytes(data[at + 1 : begin], "big") if length_bytes else length)


def _end(data: bytes, at: int) -> int:
    """Where the value at `data[at]` ends."""
    left = 1
    while left:
        kind, (begin, end) = _HEADS[data[at]][0], _content(data, at)
        left += (end - begin) * (kind == _MAP) * 2 + (end - begin) * (kind == _ARRAY) - 1
        at = begin if kind in (_MAP, _ARRAY) else end
    return at


def _filled(skeleton: dict[str, Any], values: list[Any]) -> dict[str, Any]:
    made = {}
    for key, item in skeleton.items():
        kind = type(item)
        made[key] = values[item] if kind is _Place else _filled(item, values) if kind is dict else item
    return made
