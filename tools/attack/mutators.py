"""Damage to bytes and to JSON values, without files: for tests that try every place, and for damages.py that picks."""

import json
import random
from collections.abc import Callable, Iterator
from typing import Any

Place = tuple[Any, ...]  # the keys and indices on the way to a value of JSON

# fmt: off
NASTY: tuple[Any, ...] = (
    None, True, -1, 0, 0.5, 10**18, 10**400, 1.7e308, -1.7e308, 1e-320, float("nan"), float("inf"), "", "text",
    "1.5", "\0", "x" * 5000, "\ud800", "../other", [], {}, [None], [[]], {"a": 1}, [0] * 5000,
)
# fmt: on


def places(content: Any, of_lists: int = 3) -> list[Place]:
    """The way to every value, the whole among them; of long lists only the first ones."""
    found: list[Place] = [()]
    if isinstance(content, dict):
        for key, value in content.items():
            found += [(key, *rest) for rest in places(value, of_lists)]
    elif isinstance(content, list):
        for index, value in enumerate(content[:of_lists]):
            found += [(index, *rest) for rest in places(value, of_lists)]
    return found


def value_at(content: Any, place: Place) -> Any:
    """The value at a place."""
    for key in place:
        content = content[key]
    return content


def changed(content: Any, place: Place, change: Callable[[Any], Any] | None) -> Any:
    """A copy with one value changed; `change` None takes the value out."""
    if not place:
        return None if change is None else change(content)
    copy = dict(content) if isinstance(content, dict) else list(content)
    if change is None and len(place) == 1:
        del copy[place[0]]
    else:
        copy[place[0]] = changed(content[place[0]], place[1:], change)
    return copy


def said(place: Place) -> str:
    return "/".join(map(str, place))[:80] or "the whole"


def swaps(content: Any, draw: random.Random, most: int) -> Iterator[tuple[str, Any]]:
    """(what was done, the changed content): up to `most` of all places times all nasty values, negation and absence."""
    ways: list[tuple[str, Callable[[Any], Any] | None]] = [("taken out", None), ("negated", _negated), ("as text", str)]
    ways += [(f"= {str(value)[:30]!r}", _always(value)) for value in NASTY]
    cases = [(place, how) for place in places(content) for how in range(len(ways)) if place or ways[how][1]]
    for place, how in draw.sample(cases, min(most, len(cases))):
        name, change = ways[how]
        yield f"{said(place)} {name}", changed(content, place, change)


def _always(value: Any) -> Callable[[Any], Any]:
    return lambda _: value


def _negated(value: Any) -> Any:
    if isinstance(value, list):
        return [_negated(item) for item in value]
    return -value if isinstance(value, int | float) else [value]


def json_texts(content: Any, draw: random.Random, most: int) -> Iterator[tuple[str, bytes]]:
    """`swaps` as JSON texts, and texts that are none."""
    good = json.dumps(content)
    yield "empty", b""
    yield "cut", good[: len(good) // 2].encode()
    yield "UTF-16", good.encode("utf-16")
    yield "nested 100,000 deep", b'{"a":' * 100_000 + b"1" + b"}" * 100_000
    yield "a key twice", good.replace("{", '{"a": 1, "a": 2, ', 1).encode()
    yield "5,000 digits", b'{"a": ' + b"9" * 5000 + b"}"
    for how, content_changed in swaps(content, draw, most):
        yield how, json.dumps(content_changed).encode()


def damaged(data: bytes, draw: random.Random, count: int, *, until: int | None = None) -> Iterator[tuple[str, bytes]]:
    """(what was done, the damaged bytes) for `count` damages, all in the first `until` bytes."""
    end = len(data) if until is None else min(until, len(data))
    for number in range(count):
        copy, place = bytearray(data), draw.randrange(end)
        match number % 8:
            case 0:
                yield f"cut to {place} bytes", data[:place]
            case 1:
                start = max(place - 16, 0)
                yield f"{start}: 16 bytes taken out", data[:start] + data[start + 16 :]
            case 2:
                yield f"{place}: 8 bytes put in", data[:place] + draw.randbytes(8) + data[place:]
            case 3:
                copy[place : place + 64] = bytes(len(copy[place : place + 64]))
                yield f"{place}: 64 zeros", bytes(copy)
            case 4:
                copy[place] = 0xFF
                yield f"{place}: 255", bytes(copy)
            case _:
                copy[place] ^= 1 << draw.randrange(8)
                yield f"{place}: one bit", bytes(copy)
