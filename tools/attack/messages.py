"""Frames for the server: good observations, and what a broken or hostile client makes of them.

`case(seed, number)` is the same frame on every machine, so that a violation is named by two numbers.
"""

import random
import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from attack.websocket import BINARY, CLOSE, PING, PONG, TEXT, frame, header
from turbopi.realtime.wire import pack


@dataclass(frozen=True)
class Case:
    """Bytes for the wire, and what may come back.

    message     the payload that the server sees; None if the bytes complete no message
    valid       a good observation: its result must come
    may_close   the bytes break the websocket protocol: the connection may be closed instead
    answered    something must come back; else the sender leaves
    """

    kind: str
    wire: bytes
    message: bytes | None
    valid: bool = False
    may_close: bool = False
    answered: bool = True


def case(seed: int, number: int) -> Case:
    """Frame `number` of a run."""
    draw = random.Random(seed << 40 | number)
    share = draw.random()
    if share < 0.02:
        return draw.choice(_PROTOCOL)(draw)
    if share < 0.12:
        message = pack(observation(draw))
        return Case("good", frame(message), message, valid=True)
    name = draw.choice(tuple(_DAMAGES))
    message = _DAMAGES[name](draw)
    return Case(name, frame(message), message)


# --- good observations ------------------------------------------------------------------------------------------------

_DTYPES = ("|u1", "<f4", "<f8", "<i8", "<i4", "|b1", "<f2", "<u2", "<U3", "|S4", "<M8[ns]", ">f8")


def observation(draw: random.Random) -> dict[str, Any]:
    """A random good observation, small."""
    found: dict[str, Any] = {
        "observation/image": _array(draw, "|u1", (2, 2, 3)),
        "observation/state": _array(draw, "<f8", (8,)),
        "prompt": draw.choice(("pick up the bowl", "", "ramène la 🍋", "x" * 300)),
    }
    for number in range(draw.randrange(3)):
        found[f"more/{number}"] = _value(draw, 0)
    return found


def _array(draw: random.Random, dtype: str, shape: tuple[int, ...]) -> np.ndarray:
    kind = np.dtype(dtype)
    count = int(np.prod(shape))
    if kind.kind == "b":
        return np.array([draw.random() < 0.5 for _ in range(count)], bool).reshape(shape)
    if kind.kind == "f":
        return np.array([draw.uniform(-2, 2) for _ in range(count)]).astype(kind).reshape(shape)
    if kind.kind in "US":
        return np.array([draw.choice(("", "ab", "xyz")) for _ in range(count)], kind).reshape(shape)
    return np.array([draw.randrange(100) for _ in range(count)], "<i8").astype(kind).reshape(shape)


def _value(draw: random.Random, depth: int) -> Any:
    choice = draw.randrange(9 if depth < 3 else 7)
    if choice == 0:
        return draw.choice((None, True, False))
    if choice == 1:
        return draw.choice((0, -1, 2**63, -(2**63), draw.getrandbits(40)))
    if choice == 2:
        return draw.choice((0.0, -0.0, 1e308, draw.random()))
    if choice == 3:
        return draw.choice(("", "a b", "ü🍋", "\x00\x1b[31m"))
    if choice == 4:
        return draw.randbytes(draw.randrange(20))
    if choice == 5:
        return draw.choice((np.float32(draw.random()), np.int16(draw.randrange(99)), np.bool_(True)))
    if choice == 6:
        return _array(draw, draw.choice(_DTYPES), draw.choice(((), (0,), (3,), (2, 0, 2), (1, 2, 3))))
    if choice == 7:
        return [_value(draw, depth + 1) for _ in range(draw.randrange(3))]
    return {f"k{n}": _value(draw, depth + 1) for n in range(draw.randrange(3))}


# --- damaged messages -------------------------------------------------------------------------------------------------


def _flipped(draw: random.Random) -> bytes:
    data = bytearray(pack(observation(draw)))
    for _ in range(draw.randrange(1, 9)):
        data[draw.randrange(len(data))] ^= 1 << draw.randrange(8)
    return bytes(data)


def _cut(draw: random.Random) -> bytes:
    data = pack(observation(draw))
    return data[: draw.randrange(len(data))]


def _longer(draw: random.Random) -> bytes:
    return pack(observation(draw)) + draw.choice((b"\xc0", b"\x80", draw.randbytes(draw.randrange(1, 30))))


def _spliced(draw: random.Random) -> bytes:
    one, other = pack(observation(draw)), pack(observation(draw))
    at, start = draw.randrange(len(one)), draw.randrange(len(other))
    return one[:at] + other[start : start + draw.randrange(1, 60)] + one[at:]


def _overwritten(draw: random.Random) -> bytes:
    """A head of msgpack, often of a length that isn't there, somewhere in a good message."""
    data = bytearray(pack(observation(draw)))
    heads = (b"\xdd\xff\xff\xff\xff", b"\xdf\xff\xff\xff\xff", b"\xc6\xff\xff\xff\xff", b"\xdb\x7f\xff\xff\xff")
    head = draw.choice((*heads, b"\xc1", b"\xc7\xff\x01", b"\xd4\x05", b"\xdd\0\0\x4e\x1e", b"\xde\xff\xff"))
    at = draw.randrange(len(data))
    data[at : at + len(head)] = head
    return bytes(data)


def _noise(draw: random.Random) -> bytes:
    return draw.randbytes(draw.choice((0, 1, 2, 5, 40, 400)))


def _deep(draw: random.Random) -> bytes:
    depth = draw.choice((30, 31, 32, 33, 34, 100, 2000))
    return draw.choice((b"\x91", b"\x81\xa1a")) * depth + b"\xc0"


def _many(draw: random.Random) -> bytes:
    """Long lists: more values than are allowed, or than are there."""
    count = draw.choice((100, 1999, 20000, 20001, 65535))
    there = draw.choice((count, count - 1, 3))
    return b"\x81\xa1a\xdd" + struct.pack(">I", count) + b"\xc0" * there


def _another_root(draw: random.Random) -> bytes:
    return pack(draw.choice((None, 1, "text", [1, 2], {}, {b"bytes": 1}, np.zeros(3), [], True, b"")))


def _repeated_key(draw: random.Random) -> bytes:
    pair = pack("prompt") + pack("x")
    return bytes([0x82]) + pair + pair


def _strange_key(draw: random.Random) -> bytes:
    key = draw.choice((b"\x01", b"\xc0", b"\xcb" + struct.pack(">d", draw.random()), b"\x90", b"\x80", b"\xc3"))
    return b"\x81" + key + b"\x01"


# fmt: off
_SHAPES: tuple[Any, ...] = (
    [2, 3], [0], [], [2**62, 2**62], [-1, 6], [2.0, 3], "2,3", None, [0, 2**60], [6] * 40, [1] * 33,
)
_STRANGE_DTYPES = (
    "<f4", "|V8", "|O", "<c8", "f4,f4", "<f3", "(2,)<f4", "", "<U9999999", "<M8[0s]", "<M8[xy]", "|b1", "<U1",
    None, 7, b"<f4", "<f4" * 50, "=f8", ">f4", "|S0", "<f16", "<m8[25s]",
)
# fmt: on


def _strange_array(draw: random.Random) -> bytes:
    """An array whose map lies: about its dtype, its shape, its data or its keys."""
    shape: Any = draw.choice(_SHAPES)
    dtype: Any = draw.choice(_STRANGE_DTYPES)
    data: Any = draw.choice((bytes(24), bytes(23), b"", "text", None, b"\xff" * 24, [0] * 24))
    fields = {b"__ndarray__": True, b"data": data, b"dtype": dtype, b"shape": shape}
    change = draw.randrange(6)
    if change == 0:
        del fields[draw.choice(tuple(fields))]
    elif change == 1:
        fields[b"__ndarray__"] = draw.choice((False, 1, None, "yes"))
    elif change == 2:
        fields[b"more"] = 1
    elif change == 3:
        return pack({"a": {key.decode(): value for key, value in fields.items()}})
    return pack({"observation/state": fields})


def _strange_scalar(draw: random.Random) -> bytes:
    dtype = draw.choice(("<f4", "|i1", "<i8", "<u8", "|b1", "<U3", "|S3", "<M8[s]", "<f2", "|V4", "<c16", "x", None))
    data = draw.choice((1.25, 300, -1, 2**64 - 1, "text", b"text", None, True, 1e300, float("nan"), [1]))
    return pack({"observation/step": {b"__npgeneric__": True, b"data": data, b"dtype": dtype}})


def _not_utf8(draw: random.Random) -> bytes:
    return b"\x81\xa6prompt\xa4" + draw.choice((b"\xff\xfe\xfd\xfc", b"\xed\xa0\x80a", b"\xf8\x88\x80\x80"))


_DAMAGES: dict[str, Callable[[random.Random], bytes]] = {
    "bits flipped": _flipped,
    "cut": _cut,
    "longer": _longer,
    "spliced": _spliced,
    "a head overwritten": _overwritten,
    "noise": _noise,
    "deep": _deep,
    "many values": _many,
    "another root": _another_root,
    "a key twice": _repeated_key,
    "a strange key": _strange_key,
    "a strange array": _strange_array,
    "a strange scalar": _strange_scalar,
    "not UTF-8": _not_utf8,
}


# --- frames that break, or bend, the websocket protocol ---------------------------------------------------------------


def _fragmented(draw: random.Random) -> Case:
    """Legal: a message in pieces, with a ping between them."""
    message = pack(observation(draw))
    cuts = sorted(draw.randrange(len(message) + 1) for _ in range(draw.randrange(1, 5)))
    pieces = [message[a:b] for a, b in zip([0, *cuts], [*cuts, len(message)], strict=True)]
    wire = frame(pieces[0], BINARY, fin=False)
    for piece in pieces[1:-1]:
        wire += frame(piece, 0, fin=False) + frame(b"between", PING)
    return Case("fragmented", wire + frame(pieces[-1], 0), message, valid=True)


def _padded_length(draw: random.Random) -> Case:
    """A length in more bytes than it needs, which RFC 6455 forbids and many accept."""
    message = pack(observation(draw))
    head = bytes([0x80 | BINARY, 0x80 | 127]) + struct.pack(">Q", len(message)) + bytes(4)
    return Case("padded length", head + message, message, may_close=True)


def _text(draw: random.Random) -> Case:
    return Case("text", frame(draw.choice((b"", b"{}", b"hello", b"x" * 5000)), TEXT), b"\xc1")


_CLOSES = (b"", b"\x03\xe8", b"\x03\xe8bye")
_STRANGE_CLOSES = (b"\x03", b"\x00\x00", b"\x03\xed", b"\x03\xe8\xff", b"\xff\xff")
_BREAKS: dict[str, Callable[[random.Random], bytes]] = {
    "text, not UTF-8": lambda draw: frame(b"\xff\xfe", TEXT),
    "unmasked": lambda draw: frame(pack(observation(draw)), masked=False),
    "reserved bits": lambda draw: frame(b"\x80", rsv=draw.randrange(1, 8)),
    "unknown opcode": lambda draw: frame(b"", draw.choice((3, 5, 7, 11, 15))),
    "long ping": lambda draw: frame(bytes(126), PING),
    "ping in pieces": lambda draw: frame(b"", PING, fin=False),
    "begins with a continuation": lambda draw: frame(b"\x80", 0),
    "two begun": lambda draw: frame(b"a", fin=False) + frame(b"b", fin=False),
    "too large": lambda draw: header(draw.choice((2**26 + 1, 2**31, 2**62))),
    "length of 64 bits": lambda draw: b"\x82\xff" + b"\xff" * 8 + bytes(4),
    "close": lambda draw: frame(draw.choice(_CLOSES), CLOSE),
    "strange close": lambda draw: frame(draw.choice(_STRANGE_CLOSES), CLOSE),
}


def _broken(draw: random.Random) -> Case:
    kind = draw.choice(tuple(_BREAKS))
    return Case(kind, _BREAKS[kind](draw), None, may_close=True)


def _with_pong(draw: random.Random) -> Case:
    message = pack(observation(draw))
    return Case("a pong nobody asked for", frame(b"pong", PONG) + frame(message), message, valid=True)


def _half(draw: random.Random) -> Case:
    whole = frame(pack(observation(draw)))
    return Case("half a frame", whole[: draw.randrange(1, len(whole))], None, answered=False)


_PROTOCOL = (_fragmented, _padded_length, _text, _with_pong, _half, _half, *(_broken,) * 12)
