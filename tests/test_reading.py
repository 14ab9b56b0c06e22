"""Reading JSON and NumPy files: each damaged one is refused in one line, before it costs memory or time."""

import io
import json
import os
import struct
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from turbopi.support.errors import CheckpointError, ConfigError, ObservationError, TurboPiError
from turbopi.support.reading import Fields, Npz, file_inside, read_json, read_npy, read_npz


def _refused(call: Any, error: type[TurboPiError] = CheckpointError) -> str:
    with pytest.raises(error) as caught:
        call()
    message = str(caught.value)
    assert "\n" not in message and len(message) < 1000
    return message


# -- JSON --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("content", "why"),
    [
        (b"", "isn't JSON: it is empty"),
        (b"  \n", "isn't JSON: it is empty"),
        (b"{", "isn't JSON"),
        (b"{} {}", "isn't JSON"),
        (b"\xff\xfe{\0}\0", "isn't JSON: 'utf-8' codec"),
        (b"[]", "is a list; expected an object"),
        (b"null", "is None; expected an object"),
        (b'{"a": NaN}', ": a is nan, which no JSON has"),
        (b'{"a": {"b c": [1, -Infinity]}}', ": a.'b c'[1] is -inf, which no JSON has"),
        (b'{"a": 1e999}', "the number 1e999 is beyond float64"),
        (b'{"a": 1' + b"0" * 20 + b"}", "a whole number of 21 digits, beyond 64 bits"),
        (b'{"a": ' + b"9" * 5000 + b"}", "a whole number of 5000 digits"),
        (b'{"a": 1, "a": 2}', "the key 'a' is given twice"),
        (b'{"a": "\\ud800"}', "isn't Unicode text"),
        (b'{"a": {"\\udfff": 1}}', "isn't Unicode text"),
        (b'{"a": ' + b"[" * 65 + b"]" * 65 + b"}", "more than 64 deep"),
        (b'{"a": ' + b"[" * 100_000 + b"]" * 100_000 + b"}", "more than 64 deep"),
        (b'{"a":' * 100_000 + b"1" + b"}" * 100_000, "more than 64 deep"),
    ],
)
def test_json_that_cannot_be_right_is_refused_by_its_files_name(tmp_path: Path, content: bytes, why: str) -> None:
    file = tmp_path / "config.json"
    file.write_bytes(content)
    message = _refused(lambda: read_json(file, ConfigError), ConfigError)
    assert message.startswith(str(file)) and why in message and message.count(str(file)) == 1


def test_json_within_the_rules_comes_back_as_it_is(tmp_path: Path) -> None:
    content = {
        "a": [1, -2.5, True, None],
        "ä": {"text": "grün \\u"},
        "seed": 2**64 - 1,
        "deep": json.loads("[" * 63 + "]" * 63),
    }
    file = tmp_path / "config.json"
    for ascii_only in (True, False):
        file.write_text(json.dumps(content, ensure_ascii=ascii_only), encoding="utf-8")
        assert read_json(file) == content


def test_json_larger_than_its_limit_is_not_read(tmp_path: Path) -> None:
    file = tmp_path / "config.json"
    with file.open("wb") as stream:
        stream.truncate(2**40)  # a hole: takes no room on the disk
    assert "has more than 1000 bytes" in _refused(lambda: read_json(file, limit=1000))


def test_what_is_no_file_is_refused_and_never_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.json")
    for name, why in (
        ("absent.json", "No such file"),
        (".", "it is a folder"),
        ("pipe.json", "it is no regular file"),
        ("nul\0.json", "embedded null"),
        ("x" * 5000, "File name too long"),
    ):
        message = _refused(lambda name=name: read_json(tmp_path / name, hint="; is the download complete?"))
        assert why in message and message.endswith("; is the download complete?")


@pytest.mark.parametrize(
    "name", ["../x", "/etc/passwd", "a/../../x", "", 7, None, ["x"], "a\0b", "a\nb", "C:x", "\\\\x"]
)
def test_a_file_named_by_another_file_stays_in_its_folder(tmp_path: Path, name: Any) -> None:
    assert "index.json names the file" in _refused(lambda: file_inside(tmp_path, name, "index.json"))
    assert file_inside(tmp_path, "a/b.safetensors", "index.json") == tmp_path / "a/b.safetensors"


# -- fields ------------------------------------------------------------------------------------------------------------

VALUES: dict[str, Any] = {
    "count": 3,
    "number": 2.5,
    "text": "x",
    "flag": True,
    "list": [1, 2.5],
    "object": {"inner": 1},
    "null": None,
    "huge": 10**5000,
    "bools": [True, 1],
    "deep": [[1.0]],
    "long": "x" * 100_000,
}


def test_fields_of_the_right_type_come_back() -> None:
    fields = Fields(VALUES, "a.json")
    assert fields.integer("count", 1, 3) == 3 and fields.integer("absent", 1, 3, default=2) == 2
    assert fields.number("number") == 2.5 and fields.number("count", 0, 5) == 3.0
    assert fields.text("text") == "x" and fields.flag("flag") is True and fields.flag("absent", default=False) is False
    assert fields.numbers("list") == fields.numbers("list", 2) == [1.0, 2.5]
    assert fields.object("object").integer("inner", 0, 1) == 1
    assert fields.choice("text", ("x", "y")) == "x" and fields.list("list") == [1, 2.5]


@pytest.mark.parametrize(
    ("read", "message"),
    [
        (lambda f: f.integer("count", 4, 9), "a.json: count is 3; expected a whole number from 4 to 9"),
        (lambda f: f.integer("flag", 0, 9), "a.json: flag is True; expected a whole number from 0 to 9"),
        (lambda f: f.integer("number", 0, 9), "a.json: number is 2.5; expected a whole number from 0 to 9"),
        (lambda f: f.integer("null", 0, 9, default=1), "a.json: null is None; expected a whole number from 0 to 9"),
        (lambda f: f.integer("absent", 0, 9), "a.json: absent is missing; expected a whole number from 0 to 9"),
        (lambda f: f.integer("huge", 0, 9), "a.json: huge is a whole number of 16610 bits; expected"),
        (lambda f: f.number("huge"), "a.json: huge is a whole number of 16610 bits; expected a finite number"),
        (lambda f: f.number("flag"), "a.json: flag is True; expected a finite number"),
        (lambda f: f.number("number", 3, 4), "a.json: number is 2.5; expected a finite number from 3 to 4"),
        (lambda f: f.text("count"), "a.json: count is 3; expected a text"),
        (lambda f: f.choice("long", ("a", "b")), "expected one of a, b"),
        (lambda f: f.flag("count"), "a.json: count is 3; expected true or false"),
        (lambda f: f.numbers("list", 3), "a.json: list is [1, 2.5]; expected a list of 3 finite numbers"),
        (lambda f: f.numbers("bools"), "a.json: bools is [True, 1]; expected a list of finite numbers"),
        (lambda f: f.numbers("deep"), "a.json: deep is [[1.0]]; expected a list of finite numbers"),
        (lambda f: f.list("object"), "a.json: object is {'inner': 1}; expected a list"),
        (lambda f: f.object("list"), "a.json: list is [1, 2.5]; expected an object"),
        (lambda f: f.object("object").text("inner"), "a.json: object: inner is 1; expected a text"),
    ],
)
def test_fields_of_another_type_are_refused_by_name_and_value(read: Any, message: str) -> None:
    assert message in _refused(lambda: read(Fields(VALUES, "a.json", ConfigError)), ConfigError)


# -- arrays ------------------------------------------------------------------------------------------------------------

ARRAYS: dict[str, np.ndarray] = {
    "image": np.arange(48, dtype=np.uint8).reshape(4, 4, 3),
    "state": np.linspace(-1, 1, 8),
    "fortran": np.asfortranarray(np.arange(6.0).reshape(2, 3)),
    "empty": np.zeros((0, 3), np.float32),
    "prompt": np.array("pick up the grün block"),
    "flags": np.array([True, False]),
    "count": np.array(7),
    "time": np.array("2026-01-01", "datetime64[s]"),
}


def _npy(descr: Any, shape: Any, data: bytes, order: Any = False) -> bytes:
    header = repr({"descr": descr, "fortran_order": order, "shape": shape}).encode("latin1")
    return b"\x93NUMPY\1\0" + struct.pack("<H", len(header)) + header + data


SAVES: tuple[Any, ...] = (np.savez, np.savez_compressed)


@pytest.mark.parametrize("save", SAVES)
def test_arrays_come_back_as_numpy_wrote_them(tmp_path: Path, save: Any) -> None:
    save(tmp_path / "a.npz", **ARRAYS)
    found = read_npz(tmp_path / "a.npz")
    assert list(found) == list(ARRAYS)
    for name, array in ARRAYS.items():
        assert np.array_equal(found[name], array) and found[name].dtype == array.dtype, name
        assert found[name].flags.writeable and found[name].shape == array.shape
        np.save(tmp_path / "a.npy", array)
        assert np.array_equal(read_npy(tmp_path / "a.npy"), array)


def test_an_array_that_nobody_asks_for_is_not_read(tmp_path: Path) -> None:
    """3 GB of zeros in a file of 3 MB: refused before anything is unpacked, or never looked at."""
    file = tmp_path / "a.npz"
    size = 3 * 10**9
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("small.npy", _npy("<f8", (1,), b"\0" * 8))
        archive.writestr("large.npy", _npy("|u1", (1000,), b"\0" * 1000))
    data = bytearray(file.read_bytes())
    # the claim is enough: nothing behind it is read
    old, new = struct.pack("<I", len(_npy("|u1", (1000,), b"")) + 1000), struct.pack("<I", size)
    assert data.count(old) == 2
    file.write_bytes(bytes(data.replace(old, new)))
    with Npz(file) as archive_of_arrays:
        assert archive_of_arrays["small"].tolist() == [0.0]
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive, archive.open("large.npy", "w") as member:
        member.write(_npy("|u1", (size,), b""))
        member.write(b"\0" * 10**6)
    assert f"an array of {size} bytes (|u1, shape [{size}]); at most" in _refused(
        lambda: read_npz(file), ObservationError
    )


def test_the_limit_counts_all_arrays_of_a_file_together(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", a=np.zeros(600, np.uint8), b=np.zeros(600, np.uint8))
    assert len(read_npz(tmp_path / "a.npz", limit=1200)) == 2
    assert "'b' is an array of 600 bytes" in _refused(
        lambda: read_npz(tmp_path / "a.npz", limit=1000), ObservationError
    )


@pytest.mark.parametrize(
    ("content", "why"),
    [
        (b"", "is empty"),
        (b"hello", "doesn't begin as one"),
        (b"\x93NUMPY\3\0", "has version [3, 0]"),
        (b"\x93NUMPY\1\0\xff\xff", "a header of 65535 bytes"),
        (b"\x93NUMPY\1\0\x20\0{}", "it ends early"),
        (_npy("<f8", (2,), b"\0" * 15), "but 15 are there"),
        (_npy("<f8", (2,), b"\0" * 17), "but 17 are there"),
        (_npy("<f8", (10**14,), b""), "an array of 800000000000000 bytes"),
        (_npy("<f8", (2**48,), b""), "shape is (281474976710656,)"),
        (_npy("<f8", (-1,), b""), "shape is (-1,)"),
        (_npy("<f8", (True,), b"\0" * 8), "shape is (True,)"),
        (_npy("<f8", [1], b"\0" * 8), "shape is [1]"),
        (_npy("<f8", (1,) * 33, b"\0" * 8), "shape is"),
        (_npy("<f8", (1,), b"\0" * 8, order=1), "fortran_order is 1"),
        (_npy("|O", (1,), b"\0" * 8), "dtype '|O' isn't read, only numbers, bool and text. None, or rows"),
        (_npy("|V8", (1,), b"\0" * 8), "dtype '|V8' isn't read"),
        (_npy([("a", "<f8")], (1,), b"\0" * 8), "isn't read, only numbers"),
        (_npy("<c8", (1,), b"\0" * 8), "dtype '<c8' isn't read"),
        (_npy("<f9", (1,), b"\0" * 8), "dtype '<f9' isn't read"),
        (_npy("<m8[xx]", (1,), b"\0" * 8), "damaged header"),
        (_npy("<U0", (2**40,), b""), "of nothing"),
        (_npy("|b1", (2,), b"\1\2"), "neither 0 nor 1"),
        (_npy("<U1", (1,), b"\xff\xff\xff\xff"), "no Unicode character"),
        (b"\x93NUMPY\1\0\x07\0[" + b"(" * 6, "damaged header"),
        (b"\x93NUMPY\1\0\xa0\x0f" + b"(" * 4000, "damaged header"),
    ],
)
def test_a_damaged_npy_is_refused_and_its_claims_are_not_believed(tmp_path: Path, content: bytes, why: str) -> None:
    file = tmp_path / "a.npy"
    file.write_bytes(content)
    message = _refused(lambda: read_npy(file), ObservationError)
    assert str(file) in message and why in message


def test_pickles_are_never_opened(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", np.array([{"a": 1}], object), allow_pickle=True)
    assert "'|O' isn't read" in _refused(lambda: read_npy(tmp_path / "a.npy"), ObservationError)


def test_an_npz_whose_list_of_arrays_is_damaged_is_refused(tmp_path: Path) -> None:
    """zipfile believes in fewer members, or none."""
    file = tmp_path / "a.npz"
    np.savez(file)
    assert read_npz(file) == {}
    np.savez(file, a=np.zeros(1), b=np.zeros(1))
    good = file.read_bytes()
    second = good.rindex(b"PK\1\2")
    first = good.rindex(b"PK\1\2", 0, second)
    comment = first + 32  # of the first entry: made as long as the second entry
    swallowed = good[:comment] + struct.pack("<H", len(good) - 22 - second) + good[comment + 2 :]
    for damaged in (good[:-17] + bytes(17), swallowed, good + b"\0"):
        file.write_bytes(damaged)
        assert "its list of arrays is damaged" in _refused(lambda: read_npz(file), ObservationError)


def test_every_single_byte_of_an_npz_is_checked(tmp_path: Path) -> None:
    """Each byte damaged in turn: the arrays come back unchanged, or one line says that they can't."""
    for save in SAVES:
        stream = io.BytesIO()
        save(stream, **{name: ARRAYS[name] for name in ("image", "prompt")})
        good, file = stream.getvalue(), tmp_path / "a.npz"
        refused = 0
        for place in range(len(good)):
            file.write_bytes(good[:place] + bytes([good[place] ^ 0xFF]) + good[place + 1 :])
            try:
                found = read_npz(file)
            except ObservationError:
                refused += 1
                continue
            for name, array in found.items():
                assert name not in ARRAYS or np.array_equal(array, ARRAYS[name]), place
        for length in range(len(good)):
            file.write_bytes(good[:length])
            _refused(lambda file=file: read_npz(file), ObservationError)
        assert refused > len(good) // 2
