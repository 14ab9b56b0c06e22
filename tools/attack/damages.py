"""Damage to files: what disks, copies, editors and hostile senders do to them."""

import json
import random
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from attack.mutators import NASTY, changed, places, said, value_at

Damage = Callable[[random.Random, Path], str]  # damages the file, says how


@dataclass(frozen=True)
class Done:
    """What was done to which file. `noticeable`: whatever reads it can tell, so that other numbers are a fault."""

    file: Path
    how: str
    noticeable: bool


def damage(draw: random.Random, folder: Path) -> Done:
    """Damage one file below `folder`."""
    file = draw.choice(sorted(path for path in folder.rglob("*") if path.is_file()))
    choices = _JSON if file.suffix in (".json", ".jsonl") and draw.random() < 0.7 else _BYTES
    name = draw.choice(tuple(choices))
    how = choices[name](draw, file)
    checked = file.suffix in _CHECKED and name in ("flip", "flip at an end", "zeros")
    return Done(file, how, noticeable=name in _NOTICEABLE or checked)


# --- bytes ------------------------------------------------------------------------------------------------------------


def _flip(draw: random.Random, file: Path) -> str:
    data = bytearray(file.read_bytes())
    if not data:
        return _append(draw, file)
    places = sorted(draw.randrange(len(data)) for _ in range(draw.choice((1, 1, 4, 30))))
    for place in places:
        data[place] ^= 1 << draw.randrange(8)
    file.write_bytes(data)
    return f"bits flipped in bytes {places[:4]}"


def _flip_at_an_end(draw: random.Random, file: Path) -> str:
    """In the first or last hundred bytes, where formats keep what they are."""
    data = bytearray(file.read_bytes())
    if not data:
        return _append(draw, file)
    place = draw.randrange(min(100, len(data)))
    place = place if draw.random() < 0.6 else len(data) - 1 - place
    data[place] ^= 1 << draw.randrange(8)
    file.write_bytes(data)
    return f"a bit flipped in byte {place}"


def _cut(draw: random.Random, file: Path) -> str:
    data = file.read_bytes()
    length = draw.choice((0, len(data) // 2, max(len(data) - 1, 0), draw.randrange(len(data) + 1)))
    file.write_bytes(data[:length])
    return f"cut to {length} of {len(data)} bytes"


def _zeros(draw: random.Random, file: Path) -> str:
    """A page of zeros, as a machine leaves that lost power."""
    data = bytearray(file.read_bytes())
    start = draw.randrange(len(data) + 1)
    data[start : start + 4096] = bytes(len(data[start : start + 4096]))
    file.write_bytes(data)
    return f"4096 zeros from byte {start}"


def _append(draw: random.Random, file: Path) -> str:
    more = draw.choice((b"\0", b"}", b"\n{}", draw.randbytes(100)))
    with file.open("ab") as stream:
        stream.write(more)
    return f"{more[:10]!r} appended"


def _replaced(draw: random.Random, file: Path) -> str:
    content = draw.choice(
        (b"", b"{}", b"[]", b"null", b"\x89PNG\r\n\x1a\n", b"PK\x03\x04", b"\xff" * 3000, b"\x93NUMPY")
    )
    file.write_bytes(content)
    return f"replaced by {content[:10]!r}"


def _removed(draw: random.Random, file: Path) -> str:
    file.unlink()
    return "removed"


def _a_folder(draw: random.Random, file: Path) -> str:
    file.unlink()
    file.mkdir()
    return "replaced by a folder"


def _swapped(draw: random.Random, file: Path) -> str:
    """With another file beside it."""
    others = sorted(path for path in file.parent.iterdir() if path.is_file() and path != file)
    if not others:
        return _cut(draw, file)
    other = draw.choice(others)
    one, two = file.read_bytes(), other.read_bytes()
    file.write_bytes(two)
    other.write_bytes(one)
    return f"swapped with {other.name}"


_BYTES: dict[str, Damage] = {
    "flip": _flip,
    "flip at an end": _flip_at_an_end,
    "cut": _cut,
    "zeros": _zeros,
    "append": _append,
    "replaced": _replaced,
    "removed": _removed,
    "a folder": _a_folder,
    "swapped": _swapped,
}


# --- JSON -------------------------------------------------------------------------------------------------------------


def _another_value(draw: random.Random, file: Path) -> str:
    content = _parsed(file)
    place = draw.choice(places(content))
    value = draw.choice(NASTY)
    return _write(file, changed(content, place, lambda _: value), f"{said(place)} = {str(value)[:30]}")


def _without(draw: random.Random, file: Path) -> str:
    content = _parsed(file)
    place = draw.choice(places(content))
    return _write(file, changed(content, place, None), f"{said(place)} taken out")


def _negated(draw: random.Random, file: Path) -> str:
    content = _parsed(file)
    numbers = [place for place in places(content) if type(value_at(content, place)) in (int, float)]
    if not numbers:
        return _another_value(draw, file)
    place = draw.choice(numbers)
    change = draw.choice((lambda number: -number, lambda number: number * 10**6, str))
    return _write(file, changed(content, place, change), f"{said(place)} changed")


def _deep(draw: random.Random, file: Path) -> str:
    depth = draw.choice((50, 5_000, 100_000))
    file.write_text('{"a":' * depth + "1" + "}" * depth)
    return f"nested {depth} deep"


def _key_twice(draw: random.Random, file: Path) -> str:
    text = file.read_text(encoding="utf-8")
    at = text.find("{") + 1
    end = text.find(",", at)
    if at == 0 or end < 0:
        return _cut(draw, file)
    file.write_text(text[:at] + text[at:end] + "," + text[at:], encoding="utf-8")
    return "a key twice"


def _utf16(draw: random.Random, file: Path) -> str:
    file.write_bytes(file.read_text(encoding="utf-8").encode("utf-16"))
    return "in UTF-16"


_JSON: dict[str, Damage] = {
    "another value": _another_value,
    "another value, again": _another_value,
    "without": _without,
    "negated": _negated,
    "deep": _deep,
    "a key twice": _key_twice,
    "UTF-16": _utf16,
}
# Formats with checksums: zip, PNG, OCDBT's manifest. Its other files, which have no suffix, hold the index, which has
# them, and chunks of weights without (src/turbopi/checkpoint/orbax.py): what a flipped bit met isn't known.
_CHECKED = (".npz", ".png", ".ocdbt")
_NOTICEABLE = ("cut", "replaced", "a folder", "deep")


def _parsed(file: Path) -> Any:
    text = file.read_text(encoding="utf-8")
    return [json.loads(line) for line in text.splitlines()] if file.suffix == ".jsonl" else json.loads(text)


def _write(file: Path, content: Any, how: str) -> str:
    lines = (
        [json.dumps(item) for item in content]
        if file.suffix == ".jsonl" and isinstance(content, list)
        else [json.dumps(content)]
    )
    file.write_text("\n".join(lines), encoding="utf-8")
    return how
