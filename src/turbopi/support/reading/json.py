"""JSON under rules: see `read_json`."""

import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from turbopi.support.errors import CheckpointError
from turbopi.support.reading.files import Error, read_bytes, shown
from turbopi.support.text import kind_of

MAX_JSON_BYTES = 16 * 2**20  # of a description; files of data (results, calibrations) are given more
MAX_JSON_DEPTH = 64
MAX_INTEGER = 2**64 - 1  # a seed's; anything longer is no count, size or time


def read_json(
    file: str | Path,
    error: Error = CheckpointError,
    *,
    limit: int = MAX_JSON_BYTES,
    depth: int = MAX_JSON_DEPTH,
    nan: bool = False,
    hint: str = "",
) -> dict[str, Any]:
    """The object that a JSON file holds. Raises `error`, naming the file, for everything else.

    limit   bytes of the file
    depth   of objects and lists inside each other
    nan     take NaN and the infinities too, as Python writes them: of what was measured
    hint    put behind the reason for which a file can't be read: "; is the download complete?"

    Refused are: what is missing, no regular file, too large, not UTF-8, or not JSON; NaN, Infinity and numbers beyond
    float64, which no JSON has; whole numbers beyond 64 bits; a key that is given twice; text that isn't Unicode.
    """
    value = parse_json(read_bytes(file, error, limit=limit, hint=hint), file, error, depth=depth, nan=nan)
    if not isinstance(value, dict):
        raise error(f"{file} is {kind_of(value)}; expected an object")
    return value


def parse_json(
    data: bytes, where: object, error: Error = CheckpointError, *, depth: int = MAX_JSON_DEPTH, nan: bool = False
) -> Any:
    """The value of a JSON text in UTF-8, under the rules of `read_json`; `where` begins the messages."""
    try:
        value = json.loads(
            data.decode("utf-8"),
            parse_int=_whole,
            parse_float=_finite,
            object_pairs_hook=_unique,
        )
    except RecursionError as reason:
        raise error(f"{where} holds objects and lists more than {depth} deep") from reason
    except ValueError as reason:  # not UTF-8, not JSON, or refused by a hook below
        raise error(f"{where} isn't JSON: {reason if data.strip() else 'it is empty'}") from reason
    _check_depth(value, depth, where, error)
    if not nan and (b"NaN" in data or b"Infinity" in data):
        _check_constants(value, where, error)
    if rb"\u" in data:
        _check_text(value, where, error)
    return value


def _whole(digits: str) -> int:
    if len(digits) > 20 or abs(int(digits)) > MAX_INTEGER:
        raise ValueError(f"a whole number of {len(digits)} digits, beyond 64 bits")
    return int(digits)


def _finite(digits: str) -> float:
    value = float(digits)
    if math.isinf(value):
        raise ValueError(f"the number {digits[:40]} is beyond float64")
    return value


def _unique(pairs: list[tuple[str, object]]) -> dict[str, object]:
    found = dict(pairs)
    if len(found) < len(pairs):
        keys = [key for key, _ in pairs]
        raise ValueError(f"the key {shown(next(key for key in keys if keys.count(key) > 1))} is given twice")
    return found


def _levels(value: object) -> Iterator[list[object]]:
    """The values at depth 0, 1, 2, ..."""
    level = [value]
    while level:
        yield level
        level = [
            item
            for holder in level
            if isinstance(holder, dict | list)
            for item in (holder.values() if isinstance(holder, dict) else holder)
        ]


def _check_depth(value: object, depth: int, where: object, error: Error) -> None:
    for number, _ in enumerate(_levels(value)):
        if number > depth:
            raise error(f"{where} holds objects and lists more than {depth} deep")


def _check_constants(value: object, where: object, error: Error) -> None:
    """Python reads and writes NaN, Infinity and -Infinity; JSON has none of them."""
    found = next(_constants(value, ""), None)
    if found is not None:
        path, number = found
        raise error(f"{where}: {path[1:] or 'its value'} is {number}, which no JSON has; expected a finite number")


def _constants(value: object, path: str) -> Iterator[tuple[str, float]]:
    if isinstance(value, float) and not math.isfinite(value):
        yield path, value
    elif isinstance(value, dict):
        for key, item in value.items():
            yield from _constants(item, path + key_path(key))
    elif isinstance(value, list):
        for i, item in enumerate(value):
            yield from _constants(item, f"{path}[{i}]")


def key_path(key: str) -> str:
    """A step on the way to a value: `.key`, and `.'a key'` where that isn't a name."""
    return f".{key if key.isidentifier() else shown(key)}"


def _check_text(value: object, where: object, error: Error) -> None:
    """JSON can name halves of characters, which can be neither printed nor encoded."""
    for level in _levels(value):
        for item in level:
            for text in (item,) if isinstance(item, str) else item if isinstance(item, dict) else ():
                if any("\ud800" <= letter <= "\udfff" for letter in text):
                    raise error(f"{where} holds {shown(text)}, which isn't Unicode text")
