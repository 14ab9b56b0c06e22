"""openpi's wire format: the same bytes, and no message that hurts."""

import base64
import json
import re
import struct
import sys
import tracemalloc
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst

from turbopi.realtime import wire
from turbopi.realtime.wire import MAX_DEPTH, MAX_STEPS, MAX_VALUES, WireError, pack, unpack
from turbopi.support.errors import ObservationError

GOLDEN = json.loads((Path(__file__).parent / "golden" / "preprocess" / "msgpack.json").read_text())
OBJECTS = {item["name"]: item for item in GOLDEN["objects"]}


def golden_value(item: dict[str, Any]) -> Any:
    if item["kind"] == "python":
        return item["value"]
    if item["kind"] == "dict":
        return {key: golden_value(value) for key, value in item["items"].items()}
    data = base64.b64decode(item["c_order_data_base64"])
    array = np.ndarray(tuple(item["shape"]), item["dtype"], data)
    return array[()] if item["kind"] == "numpy scalar" else array


def array_map(**changes: Any) -> dict[bytes, Any]:
    fields = {"__ndarray__": True, "data": bytes(24), "dtype": "<f4", "shape": [2, 3], **changes}
    return {key.encode(): value for key, value in fields.items() if value is not ...}


def scalar_map(**changes: Any) -> dict[bytes, Any]:
    fields = {"__npgeneric__": True, "data": 1.5, "dtype": "<f4", **changes}
    return {key.encode(): value for key, value in fields.items() if value is not ...}


def assert_same(actual: Any, expected: Any) -> None:
    assert type(actual) is type(expected)
    if isinstance(expected, dict):
        assert list(actual) == list(expected)
        for key in expected:
            assert_same(actual[key], expected[key])
    elif isinstance(expected, list):  # a damaged message may be one
        for one, other in zip(actual, expected, strict=True):
            assert_same(one, other)
    elif isinstance(expected, np.ndarray):
        assert (actual.dtype.str, actual.shape) == (expected.dtype.str, expected.shape)
        assert actual.tobytes() == expected.tobytes()
    else:
        assert actual == expected


@pytest.mark.parametrize("name", OBJECTS)
def test_bytes_are_those_of_openpi(name: str) -> None:
    value = golden_value(OBJECTS[name])
    if name == "fortran_order":
        value = np.asfortranarray(value)
    assert pack(value) == base64.b64decode(OBJECTS[name]["packed_base64"])


def test_arrays_are_written_as_msgpack_itself_writes_their_maps() -> None:
    image = np.arange(2**17, dtype=np.uint8).reshape(64, 2, -1)
    arrays: list[np.ndarray] = [np.zeros(size, np.uint8) for size in (0, 1, 255, 256, 2**16 - 1, 2**16)]
    arrays += [image, image[::2], image.T, np.float32(1) * image[0], np.array(2.5), np.array(["é", "ab"])]
    arrays += [np.array([True]), np.array([1], ">i2"), np.zeros((2, 0, 3)), np.array(["2026-11-29"], "M8[D]")]
    deep: dict[str, Any] = {"array": image}
    for _ in range(40):
        deep = {"deeper": deep, "array": arrays[1]}
    many = {f"{number}": arrays[number % 3] for number in range(2**16)}
    for value in (*arrays, deep, many, {1: image, b"b": [image], "t": (1, image), "s": np.float32(-0.0), "n": None}):
        assert pack(value) == msgpack.packb(value, default=wire._fields)
    endless: dict[str, Any] = {"array": image}
    endless["itself"] = endless
    with pytest.raises(WireError, match="can't send this value: "):
        pack(endless)


@pytest.mark.parametrize("name", OBJECTS)
def test_openpi_bytes_decode_to_the_value_that_was_packed(name: str) -> None:
    item = OBJECTS[name]
    actual = unpack(base64.b64decode(item["packed_base64"]))
    if item.get("unpacked_type") is not None:
        assert type(actual).__name__.strip("_") == item["unpacked_type"].rpartition(".")[2].strip("_")  # bool_ is bool
    expected = golden_value(item)
    assert_same(actual, expected.item() if isinstance(expected, np.float64 | np.str_) else expected)


@pytest.mark.parametrize(
    "value", [np.zeros(2, np.complex64), np.array([{}]), np.zeros(2, "i4,f4"), np.complex128(1), np.void(b"x")]
)
def test_void_object_and_complex_are_not_sent(value: Any) -> None:
    with pytest.raises(ValueError, match="void, object and complex aren't part of the format"):
        pack({"x": value})


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (object(), "can't send a builtins.object"),
        ({"x": {1, 2}}, "can't send a builtins.set"),
        (np.datetime64("2026-01-01"), r"can't send a datetime64\[D\] scalar"),
        (np.longdouble(1), "scalar: send it as a 0-dimensional array"),
        (2**70, "can't send the integer 1180591620717411303424"),
        ("\ud800", "can't send this value: .*surrogates not allowed"),
    ],
)
def test_what_msgpack_cannot_hold_is_not_sent(value: Any, message: str) -> None:
    with pytest.raises(WireError, match=message):
        pack(value)


def test_decoded_arrays_are_read_only() -> None:
    array = unpack(pack({"state": np.arange(3.0)}))["state"]
    with pytest.raises(ValueError, match="read-only"):
        array[0] = 1


WIRE_DTYPES = st.one_of(
    npst.boolean_dtypes(),
    npst.integer_dtypes(endianness="?"),
    npst.unsigned_integer_dtypes(endianness="?"),
    npst.floating_dtypes(endianness="?", sizes=(16, 32, 64)),
    npst.unicode_string_dtypes(endianness="?", max_len=5),
    npst.byte_string_dtypes(max_len=5),
    npst.datetime64_dtypes(endianness="?"),
)
ARRAYS = WIRE_DTYPES.flatmap(
    lambda dtype: npst.arrays(dtype, npst.array_shapes(min_dims=0, min_side=0, max_side=4))
).filter(lambda array: array.dtype.kind != "U" or not re.search("[\ud800-\udfff]", "".join(array.flat)))
PLAIN = st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.floats(allow_nan=False) | st.text()
VALUES = st.recursive(
    PLAIN | st.binary() | ARRAYS,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=8,
)


@contextmanager
def large_from(size: int) -> Iterator[None]:
    """With arrays of so many bytes and more taken for large ones."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(wire, "LARGE", size)
        yield


KEYS_END = len(b"__npgeneric__") + 1  # no key of the format is set aside


@pytest.mark.slow
@pytest.mark.parametrize("large", [wire.LARGE, KEYS_END])
@given(value=VALUES.filter(lambda value: "__ndarray__" not in str(value) and "__npgeneric__" not in str(value)))
@settings(deadline=None, max_examples=200)
def test_whatever_can_be_sent_arrives_unchanged(large: int, value: Any) -> None:
    def compare(actual: Any, expected: Any) -> None:
        if isinstance(expected, list):
            assert len(actual) == len(expected)
            for a, e in zip(actual, expected, strict=True):
                compare(a, e)
        elif isinstance(expected, dict):
            assert list(actual) == list(expected)
            for key in expected:
                compare(actual[key], expected[key])
        else:
            assert_same(actual, expected)

    plain = pack(value)
    with large_from(large):
        assert pack(value) == plain
        compare(unpack(plain), value)


@pytest.mark.parametrize("dtype", ["|u1", "|i1", "|b1", "<f4", ">f8", "<i8", "<U4", "|S16", "<M8[s]"])
@pytest.mark.parametrize("more", [-16, 0])
def test_large_arrays_of_bytes_are_views_of_the_message_and_others_are_aligned_copies(dtype: str, more: int) -> None:
    generator = np.random.default_rng(0)
    numbers = generator.integers(0, 2, (wire.LARGE + more) // np.dtype(dtype).itemsize)
    sent = {
        "a": numbers.astype(dtype),
        "odd": "x" * 7,
        "nested": [{"b": numbers.astype(dtype)[::-1]}],
        "raw": b"\1" * 40_000,
    }
    message = pack(sent)
    received = unpack(message)
    for got, expected in ((received["a"], sent["a"]), (received["nested"][0]["b"], sent["nested"][0]["b"])):  # type: ignore[index]
        assert_same(got, expected)
        shares = np.shares_memory(got, np.frombuffer(message, np.uint8))
        assert shares == (dtype in ("|u1", "|i1") and more == 0)
        assert got.flags.aligned and not got.flags.writeable
    assert_same({key: received[key] for key in ("odd", "raw")}, {key: sent[key] for key in ("odd", "raw")})


@pytest.mark.parametrize(
    "array", [np.arange(60_000, dtype=np.uint8).reshape(200, 300)[:, ::2], np.ones((200, 300), order="F")]
)
def test_large_arrays_are_sent_in_c_order_however_they_lie_in_memory(array: np.ndarray) -> None:
    assert_same(unpack(pack(array)), np.ascontiguousarray(array))


def test_large_bytes_are_no_array_where_they_stand_alone_and_no_key() -> None:
    large = b"x" * wire.LARGE
    for value in (large, [large], {"a": large}):
        assert unpack(msgpack.packb(value)) == value
    with pytest.raises(WireError, match="the keys of a map must be str or bin"):
        unpack(msgpack.packb({large: 1}))
    with pytest.raises(WireError, match="msgpack extension type at byte 1"):
        unpack(msgpack.packb([msgpack.ExtType(0, bytes(4)), large]))
    with pytest.raises(WireError, match="a <f4 scalar can't be made from b'xxx"):
        unpack(msgpack.packb(scalar_map(data=large)))


def test_a_large_array_of_the_wrong_size_is_refused_by_name() -> None:
    fields = array_map(dtype="|u1", shape=[wire.LARGE + 1], data=bytes(wire.LARGE))
    with pytest.raises(WireError, match=r"shape \[16385\] of \|u1 needs 16385 bytes of data, but 16384 came"):
        unpack(msgpack.packb(fields))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"data": bytes(23)}, r"shape \[2, 3\] of <f4 needs 24 bytes of data, but 23 came"),
        ({"data": bytes(25)}, "but 25 came"),
        ({"data": "x" * 24}, "data must be msgpack bin, not str"),
        ({"data": [0] * 24}, "data must be msgpack bin, not list"),
        ({"data": ...}, "must have the keys"),
        ({"strides": [4, 8]}, "must have the keys"),
        ({"__ndarray__": False}, "must be true, not False"),
        ({"dtype": "O"}, "dtype 'O' is refused: void, object and complex"),
        ({"dtype": "|O8"}, "is refused"),
        ({"dtype": "<c8", "shape": [3]}, "is refused"),
        ({"dtype": "|V4"}, "is refused"),
        ({"dtype": "f4,f4"}, "dtype must be a string like '<f4'"),
        ({"dtype": "float32"}, "dtype must be a string like '<f4'"),
        ({"dtype": "<f3"}, "NumPy knows no dtype '<f3'"),
        ({"dtype": "<f4[s]"}, "dtype must be a string like '<f4'"),
        ({"dtype": "<U999999999"}, "<U999999999"),
        ({"dtype": "<U0", "data": b"", "shape": [10**9]}, "has no bytes"),
        ({"dtype": 4}, "dtype must be a string like '<f4', not 4"),
        ({"dtype": [["a", "<f4"]]}, "dtype must be a string like '<f4'"),
        ({"shape": [-2, -3]}, "shape must be a list of integers from 0 up"),
        ({"shape": [2.0, 3]}, "shape must be a list of integers from 0 up"),
        ({"shape": [True, 6]}, "shape must be a list of integers from 0 up"),
        ({"shape": 6}, "shape must be a list of integers from 0 up, not 6"),
        ({"shape": [2**32, 2**32], "data": b""}, f"needs {2**66} bytes of data, but 0 came"),  # in 64 bits: 0
        ({"shape": [0, 2**62], "data": b""}, "is too large"),
        ({"shape": [1] * 33, "data": bytes(4)}, "is too large"),
        ({"shape": [2**20, 2**10]}, "needs 4294967296 bytes of data, but 24 came"),
        ({"dtype": "|b1", "shape": [24], "data": b"\x02" * 24}, "bytes must be 0 or 1"),
        ({"dtype": "<U1", "shape": [6], "data": b"\xff" * 24}, "no Unicode character"),
        ({"dtype": ">U1", "shape": [1], "data": b"\x00\x00\xd8\x00"}, "no Unicode character"),
    ],
)
def test_a_wrong_array_is_refused_by_name(changes: dict[str, Any], message: str) -> None:
    data = msgpack.packb({"images": {"cam_high": array_map(**changes)}})
    with pytest.raises(WireError, match=f"^'images'/'cam_high': .*{message}"):
        unpack(data)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"data": "1.5"}, "a <f4 scalar can't be made from '1.5'"),
        ({"data": 1e300}, "1e\\+300 doesn't fit into <f4"),
        ({"data": 300, "dtype": "|u1"}, "300 doesn't fit into |u1"),
        ({"data": True, "dtype": "<i8"}, "a <i8 scalar can't be made from True"),
        ({"data": 1, "dtype": "|b1"}, "can't be made from 1"),
        ({"data": [1.5]}, "can't be made from"),
        ({"data": 5, "dtype": "<M8[s]"}, "can't be made from 5"),
        ({"dtype": "<c8"}, "is refused"),
        ({"shape": []}, "must have the keys"),
    ],
)
def test_a_wrong_scalar_is_refused_by_name(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(WireError, match=f"^'state'/\\[1\\]: .*{message}|^'state'/1: .*{message}"):
        unpack(msgpack.packb({"state": [0, scalar_map(**changes)]}))


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "ends after 0 bytes"),
        (b"hello", "4 bytes follow its end"),
        (b'{"prompt": "json"}', "bytes follow its end"),
        (b"\xc1", "0xc1, which begins no value"),
        (b"\x81\xa1x", "needs 2 more bytes, of which 1 are there|ends after"),
        (b"\x82\xa1x\x01\xa1x\x02", "holds the key 'x' more than once"),
        (b"\x81\x01\x02", "the keys of a map must be str or bin: int is not allowed"),
        (b"\x81\x90\x02", "the keys of a map must be str or bin"),
        (b"\xa2\xff\xfe", "isn't UTF-8"),
        (b"\xd4\x01x", "extension type at byte 0"),
        (b"\xd6\xff" + bytes(4), "extension type"),
        (b"\xc6\xff\xff\xff\xff" + bytes(10), "needs 4294967295 more bytes, of which 10 are there"),
        (b"\xdd\xff\xff\xff\xff" + bytes(10), "needs 4294967295 more bytes"),
        (b"\xdf\x00\x00\x00\x08" + bytes(10), "needs 16 more bytes, of which 10"),
        (b"\xda\x00", "needs"),
        (b"\x91" * (MAX_DEPTH + 1) + b"\x00", f"more than {MAX_DEPTH} maps and lists inside each other"),
        (b"\xdc\x60\x00" + bytes(0x6000), f"more than {MAX_VALUES} values"),
        (b"\xdc\x17\x70" + b"\xc0\xcc\x00" * 3000, f"more than {MAX_STEPS} maps, lists, strings and changes"),
        (b"\x93\x01\x02\xcd\x00", "the value at byte 3 needs 2 more bytes, of which 1 are there"),
        (b"\xdc\x00\x03" + b"\xcb" + bytes(8) + b"\xcb" + bytes(7), "byte 12 needs 8 more bytes, of which 7 are there"),
        (b"\xdc\x00\x03\xcd\x00\x01\x01", "ends after 7 bytes"),
        (b"\x81\xab__ndarray__\xc3", "the keys of a packed array are msgpack bin, not str"),
    ],
)
def test_a_wrong_message_is_refused_with_its_reason(data: bytes, message: str) -> None:
    with pytest.raises(WireError, match=message):
        unpack(data)


def as_msgpack_numpy(value: Any) -> Any:
    """What PyPI's msgpack-numpy has msgpack pack instead of it."""
    if isinstance(value, np.ndarray):
        kind = value.dtype.kind.encode() if value.dtype.kind in "VO" else b""
        dtype = value.dtype.descr if kind else value.dtype.str
        return {b"nd": True, b"type": dtype, b"kind": kind, b"shape": value.shape, b"data": value.tobytes()}
    if isinstance(value, np.generic):
        return {b"nd": False, b"type": value.dtype.str, b"data": value.tobytes()}
    return {b"complex": True, b"data": repr(value)}


@pytest.mark.parametrize("bin_type", [True, False])
@pytest.mark.parametrize("str_keys", [True, False])
@pytest.mark.parametrize(
    "value",
    [
        *(np.zeros((2, 3)), np.full(3, 200, np.uint8), np.arange(3, dtype=">i4"), np.zeros((200, 200), np.uint8)),
        *(np.zeros(2, "i4,f4"), np.array([None]), np.float32(1.5), np.bool_(True), np.complex64(1j), 1j),
    ],
    ids=["floats", "bytes", "big-endian", "large", "void", "object", "number", "bool", "complex number", "complex"],
)
def test_arrays_of_another_packer_are_named_with_the_one_that_is_spoken(
    value: Any, str_keys: bool, bin_type: bool
) -> None:
    def packer(value: Any) -> Any:
        fields = as_msgpack_numpy(value)
        return {key.decode(): field for key, field in fields.items()} if str_keys else fields

    packed = msgpack.packb({"cameras": [{"wrist": value}]}, default=packer, use_bin_type=bin_type)
    with pytest.raises(
        WireError, match=r"openpi's arrays, .*__ndarray__.*openpi_client\.msgpack_numpy or turbopi\.realtime\.wire"
    ) as no:
        unpack(packed)
    assert str(no.value).startswith(("'cameras'/0/'wrist': ", "'cameras'/[0]/'wrist': ", "not a msgpack message: "))


def test_the_keys_of_another_packer_are_anyones_where_they_are_no_array() -> None:
    for value in ({"nd": 3, "data": 1}, {"complex": True}, {"nd": "x"}, {"nd": True, "kind": "robot"}):
        assert unpack(pack({"a": value})) == {"a": value}


def test_the_deepest_allowed_message_is_read() -> None:
    assert unpack(b"\x91" * (MAX_DEPTH - 1) + b"\x90") is not None


def test_the_size_limit_is_exact() -> None:
    data = pack({"x": np.zeros(100)})
    assert unpack(data, max_bytes=len(data)) is not None
    with pytest.raises(WireError, match=f"has {len(data)} bytes; the limit is {len(data) - 1}"):
        unpack(data, max_bytes=len(data) - 1)


def test_a_wire_error_is_an_observation_error() -> None:
    with pytest.raises(ObservationError):
        unpack(b"\xc1")


@pytest.mark.parametrize(
    "data",
    [
        b"".join(b"\xdd" + struct.pack(">I", 900_000) for _ in range(30)) + bytes(1_000_000),
        b"\xdd" + struct.pack(">I", 1_000_000) + b"\x80" * 1_000_000,
        msgpack.packb(array_map(shape=[0, 2**30], data=b"")),
        msgpack.packb(array_map(shape=[2**30], data=b"")),
        msgpack.packb(array_map(dtype="<U250000000", shape=[1])),
        b"\x91" * 1_000_000,
        b"\xdf" + struct.pack(">I", 400_000) + b"\xa1x\x00" * 330_000,
        b"\xde"
        + struct.pack(">H", 9_990)
        + b"".join(b"\xcd" + struct.pack(">H", 1000 + i // 2) + b"\0" for i in range(9_990)),
        b"\xde" + struct.pack(">H", 9_990) + b"".join(b"\xa4%04d\0" % (i // 2) for i in range(9_990)),
        msgpack.packb(array_map(shape=[b"x" * 100_000] * 20)),
        msgpack.packb(scalar_map(data={"x" * 1000: ["y" * 1000] * 1000})),
    ],
    ids=[
        "nested claims",
        "many maps",
        "empty giant",
        "giant",
        "giant string",
        "deep",
        "wide map",
        "int keys",
        "repeated keys",
        "long",
        "large",
    ],
)
def test_no_message_allocates_more_than_it_weighs(data: bytes) -> None:
    tracemalloc.start()
    with pytest.raises(WireError) as refusal:
        unpack(data)
    assert len(str(refusal.value)) < 1000
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 4 * len(data) + 4_000_000


def lines_run(data: bytes) -> int:
    """How many lines of wire.py it takes to decode `data`, or to refuse it."""
    lines = 0

    def trace(frame: FrameType, event: str, _: Any) -> Any:
        nonlocal lines
        if frame.f_code.co_filename != wire.__file__:
            return None
        lines += event == "line"
        return trace

    sys.settrace(trace)
    try:
        unpack(data)
    except WireError:
        pass
    finally:
        sys.settrace(None)
    return lines


@pytest.mark.parametrize(
    "data",
    [
        b"\xdd\0\0\x4e\x1e" + b"\xc0" * 19_998,
        b"\xdd\0\0\x4e\x1e" + (b"\xcb" + bytes(8)) * 19_998,
        b"\xdd\0\0\x4e\x1e" + b"\xc0\xcc\x00" * 9_999,
        b"\xdd\0\0\x4e\x1e" + b"\xa1a" * 19_998,
        b"\xde\x23\x28" + b"".join(b"\xa4%04d\x01" % n for n in range(9_000)),
        b"\xdc\x4e\x1e" + b"\x90" * 19_998,
        msgpack.packb({"a": [[{}, []]] * 900}),
        msgpack.packb([array_map()] * 300),
        msgpack.packb({"x": {f"{n:04d}": 1.5 for n in range(1_900)}}),
    ],
    ids=["nil", "numbers", "kinds", "strings", "keys", "lists", "containers", "arrays", "map"],
)
def test_the_work_for_a_message_is_bounded_whatever_it_holds(data: bytes) -> None:
    assert lines_run(data) < 25 * MAX_STEPS


def test_a_list_of_numbers_is_read_in_runs() -> None:
    assert lines_run(msgpack.packb({"state": [0.5] * 19_000})) < 3000
    assert unpack(msgpack.packb({"state": [0.5] * 19_000 + [1]})) == {"state": [0.5] * 19_000 + [1]}


# --- fuzzing: any bytes either decode or raise WireError --------------------------------------------------------------

REQUEST = base64.b64decode(OBJECTS["request"]["packed_base64"])
ODD_KEYS = st.sampled_from([b"__ndarray__", b"__npgeneric__", b"data", b"dtype", b"shape", "__ndarray__", "state", b""])
ODD_LEAVES = st.one_of(
    PLAIN,
    st.binary(max_size=20),
    st.sampled_from(["<f4", "|u1", "<U3", "|b1", "O", "<M8[s]", "<M8[25s]", "<m8", "=i2", ">f8", "<f16", "?", "|S0"]),
    st.lists(st.integers(-1, 2**40), max_size=4),
)
ODD_VALUES = st.recursive(
    ODD_LEAVES,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(ODD_KEYS, inner, max_size=4),
    max_leaves=20,
)
ARRAY_LIKE = st.fixed_dictionaries(
    {
        b"__ndarray__": st.just(True),
        b"data": st.binary(max_size=32),
        b"dtype": st.from_regex(r"[<>|=]?[biufSUmMcOV?][0-9]{0,3}(\[[0-9]{0,3}[a-zA-Z]{1,2}\])?", fullmatch=True),
        b"shape": st.lists(st.integers(0, 8), max_size=3),
    }
)
SCALAR_LIKE = st.fixed_dictionaries(
    {
        b"__npgeneric__": st.just(True),
        b"data": PLAIN | st.binary(max_size=8),
        b"dtype": st.from_regex(r"[<>|=]?[biufSUmM][0-9]{0,2}", fullmatch=True),
    }
)


def decodes_or_refuses(data: bytes) -> None:
    for large in (wire.LARGE, KEYS_END):
        try:
            with large_from(large):
                value = unpack(data)
        except WireError as error:
            assert str(error)  # noqa: PT017
            assert len(str(error)) < 1000  # noqa: PT017
        else:
            repr(value)  # nothing in it is broken


@given(st.binary(max_size=200))
@settings(deadline=None, max_examples=500)
def test_random_bytes_never_crash_the_decoder(data: bytes) -> None:
    decodes_or_refuses(data)


@given(st.lists(st.tuples(st.integers(0, len(REQUEST) - 1), st.integers(0, 255)), min_size=1, max_size=4), st.data())
@settings(deadline=None, max_examples=500)
def test_a_damaged_request_never_crashes_the_decoder(changes: list[tuple[int, int]], data: st.DataObject) -> None:
    damaged = bytearray(REQUEST)
    for position, byte in changes:
        damaged[position] = byte
    cut = data.draw(st.integers(0, len(damaged)) | st.just(len(damaged)))
    decodes_or_refuses(bytes(damaged[:cut]))


@pytest.mark.slow
@given(ODD_VALUES | ARRAY_LIKE | SCALAR_LIKE)
@settings(deadline=None, max_examples=500)
def test_odd_structures_never_crash_the_decoder(value: Any) -> None:
    decodes_or_refuses(msgpack.packb(value))


# --- messages that look alike -----------------------------------------------------------------------------------------


def outcome_of(read: Any, data: bytes) -> tuple[str, Any]:
    try:
        return "value", read(data)
    except WireError as error:
        return "refused", str(error)


def request_of(prompt: str, number: int, **more: Any) -> bytes:
    camera_images = np.random.default_rng(number).integers(0, 256, (2, 90, 90, 3), np.uint8)
    state = {"joints": np.linspace(number, 1, 7), "gripper": np.float32(number), "closed": np.array([True, False])}
    return pack({"images": dict(zip("ab", camera_images, strict=True)), "state": state, "prompt": prompt, **more})


def test_messages_that_differ_in_numbers_alone_are_read_without_a_walk(monkeypatch: pytest.MonkeyPatch) -> None:
    unpacker = wire.Unpacker()
    for number in (1, 1):
        unpacker.unpack(request_of("stack", number))
    expected = unpack(again := request_of("stack", 1))
    timing = [pack({"actions": np.zeros(2), "timing": {"infer_ms": ms}}) for ms in (1.5, 2.5, 3.5)]
    timed = [wire.Unpacker() for _ in timing]
    for one in timed:
        one.unpack(timing[0])
        one.unpack(timing[1])
    monkeypatch.setattr(wire, "unpack", lambda *_, **__: pytest.fail("walked"))
    assert [one.unpack(data)["timing"]["infer_ms"] for one, data in zip(timed, timing, strict=True)] == [1.5, 2.5, 3.5]
    first, second = unpacker.unpack(again), unpacker.unpack(again)
    assert_same(first, expected)
    first["state"]["joints"] = first["more"] = None
    assert_same(second, expected)
    assert not second["images"]["a"].flags.writeable and second["state"]["joints"].flags.aligned


def test_a_message_that_looks_different_is_read_as_ever() -> None:
    unpacker = wire.Unpacker()
    for data in (
        *(request_of("stack", 1) for _ in range(3)),
        request_of("stick", 1),  # as long
        request_of("stack", 2),  # the gripper is a scalar
        request_of("unstack", 2),
        request_of("unstack", 2, steps=[1, 2]),
        *(request_of("unstack", 2, steps=[1, [2, 3]]) for _ in range(3)),
        *(pack([1, 2]) for _ in range(3)),
        *(pack({"actions": np.ones(2), "timing": {"ms": ms}}) for ms in (1.5, 2.5, -0.0, float("inf"))),
        *(msgpack.packb({"single": single}, use_single_float=True) for single in (1.5, 1.5, 2.5)),
    ):
        assert_same(unpacker.unpack(data), unpack(data))
    (own,) = {id(unpacker.unpack(request_of("a", 1, steps=[1]))["steps"]) for _ in range(1)}
    assert own != id(unpacker.unpack(request_of("a", 1, steps=[1]))["steps"]), "lists can be changed"


def test_large_bytes_that_are_no_array_are_not_kept() -> None:
    unpacker, data = wire.Unpacker(), pack({"jpeg": bytes(wire.LARGE), "state": np.zeros(3)})
    for _ in range(3):
        assert_same(unpacker.unpack(data), unpack(data))
    assert unpacker._like is None


@settings(max_examples=200, deadline=None)
@example([(0, 150)])
@given(st.lists(st.tuples(st.integers(0, 2**20), st.integers(0, 255)), max_size=3))
def test_a_damaged_message_is_read_or_refused_as_if_it_came_first(changes: list[tuple[int, int]]) -> None:
    small = pack({"image": np.arange(48, dtype=np.uint8).reshape(4, 4, 3), "s": {"x": np.ones(2), "n": 3}, "p": "data"})
    unpacker, damaged = wire.Unpacker(), bytearray(small)
    for _ in range(2):
        unpacker.unpack(small)
    for place, value in changes:
        damaged[place % len(damaged)] = value
    (how, found), (expected_how, expected) = (outcome_of(read, bytes(damaged)) for read in (unpacker.unpack, unpack))
    assert how == expected_how
    assert_same(found, expected)
