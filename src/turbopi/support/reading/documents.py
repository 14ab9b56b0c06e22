"""Documents: JSON of which each kind is defined once, as a frozen `msgspec.Struct` in the room that writes it.

    class Line(Struct, frozen=True): ...             fields with their types and ranges
    text = json.dumps(plain_document(line))          written through it
    line = read_document(file, Line, ConfigError)    and read back through it

msgspec checks types and ranges. Its own message names neither the file nor the value, so the place that doesn't fit is
looked for once more: `FILE: results[3].calls is 'x'; expected a whole number from 1`.
"""

import types
from collections.abc import Iterator, Mapping
from pathlib import Path, PurePath
from typing import Annotated, Final, Literal, TypeVar, Union, get_args, get_origin

import msgspec

from turbopi.support.errors import CheckpointError
from turbopi.support.reading.files import Error, shown
from turbopi.support.reading.json import MAX_JSON_BYTES, key_path, read_json

D = TypeVar("D", bound=msgspec.Struct)
_MISSING: Final = object()


def read_document(
    file: str | Path,
    kind: type[D],
    error: Error = CheckpointError,
    *,
    limit: int = MAX_JSON_BYTES,
    hint: str = "",
) -> D:
    """The document of a kind that a JSON file holds, under the rules of `read_json`.

    Keys that the kind hasn't are ignored. Raises `error`, naming the file, the way to the value, the value and what was
    expected, then `hint`.
    """
    return as_document(read_json(file, error, limit=limit, hint=hint), kind, file, error, hint=hint)


def as_document(
    value: Mapping[str, object], kind: type[D], where: object, error: Error = CheckpointError, *, hint: str = ""
) -> D:
    """The document that an object of JSON is; `where` begins the messages. Raises `error` as `read_document` does."""
    try:
        return msgspec.convert(value, kind)
    except msgspec.ValidationError as reason:
        path, found, expected = _misfit(value, kind, "")
        path = path.removeprefix(".") or "its value"
        reported = "missing" if found is _MISSING else shown(found)
        raise error(f"{where}: {path} is {reported}; expected {said(expected)}{hint}") from reason


def plain_document(document: msgspec.Struct) -> dict[str, object]:
    """A document as `json.dumps` takes it: objects, lists and plain values; NumPy's and paths are made such."""
    value: dict[str, object] = msgspec.to_builtins(document, str_keys=True, enc_hook=_plain)
    return value


def _plain(value: object) -> object:
    if isinstance(value, str | PurePath):  # a str: of a class of its own, as torch.__version__ is
        return str(value)
    if hasattr(value, "tolist"):  # NumPy
        return value.tolist()
    raise TypeError(f"a document holds {shown(value)}, which isn't JSON's")


def _fits(value: object, kind: object) -> bool:
    if value is _MISSING:
        return False
    try:
        msgspec.convert(value, kind)
    except msgspec.ValidationError:
        return False
    return True


def _misfit(value: object, kind: object, path: str) -> tuple[str, object, object]:
    """(the way there, the value, its type) of the innermost value that doesn't fit, for a value that doesn't."""
    for step, item, inner in _inside(value, _arm(value, kind)):
        if not _fits(item, inner):
            return _misfit(item, inner, path + step)
    return path, value, kind


def _arm(value: object, kind: object) -> object:
    """The one type of a union that a value is to be, without its `Annotated`."""
    if get_origin(kind) is Annotated:
        return _arm(value, get_args(kind)[0])
    if get_origin(kind) in (Union, types.UnionType):
        arms = [arm for arm in get_args(kind) if arm not in (type(None), msgspec.UnsetType)]
        return _arm(value, arms[0]) if len(arms) == 1 and value is not None else kind
    return kind


def _inside(value: object, kind: object) -> Iterator[tuple[str, object, object]]:
    """(step, value, type) for each value inside this one, as its type has them; the value _MISSING for one it lacks."""
    origin, given = get_origin(kind), get_args(kind)
    if isinstance(value, Mapping):
        if isinstance(kind, type) and issubclass(kind, msgspec.Struct):
            for field in msgspec.structs.fields(kind):
                if field.required or field.encode_name in value:
                    yield key_path(field.encode_name), value.get(field.encode_name, _MISSING), field.type
        elif origin in (dict, Mapping):
            yield from ((key_path(key), item, given[1]) for key, item in value.items())
    elif isinstance(value, list) and origin is list:
        yield from ((f"[{i}]", item, given[0]) for i, item in enumerate(value))
    elif isinstance(value, list) and origin is tuple and len(given) == len(value):
        yield from ((f"[{i}]", item, inner) for i, (item, inner) in enumerate(zip(value, given, strict=True)))


_NAMES: Final[dict[object, str]] = {
    int: "a whole number",
    float: "a finite number",
    str: "a text",
    bool: "true or false",
    type(None): "null",
}


def said(kind: object) -> str:
    """What a type stands for, in words: `Annotated[int, Meta(ge=1)]` is "a whole number from 1"."""
    origin, given = get_origin(kind), get_args(kind)
    if origin is Annotated:
        return _said_with(given[0], [meta for meta in given[1:] if isinstance(meta, msgspec.Meta)])
    if origin is Literal:
        return f"{'one of ' * (len(given) > 1)}{', '.join(map(str, given))}"
    if origin in (Union, types.UnionType):
        unsaid = (msgspec.UnsetType, int if float in given else None)
        return " or ".join(said(arm) for arm in given if arm not in unsaid)
    if origin is tuple:
        return f"a list of {len(given)}"
    if kind in _NAMES:
        return _NAMES[kind]
    return "a list" if origin is list else "an object"


def _said_with(kind: object, limits: list[msgspec.Meta]) -> str:
    """With its limits, or as its `description` has it."""
    text = said(kind)
    for meta in limits:
        if meta.description is not None:
            return meta.description
        if meta.pattern is not None or meta.min_length is not None:
            text = f"{text} that isn't {'blank' if kind is str else 'empty'}"
        low, above, high = meta.ge, meta.gt, meta.le
        text += f" above {_bound(above)}" if above is not None else f" from {_bound(low)}" if low is not None else ""
        text += f" to {_bound(high)}" if high is not None else ""
    return text


def _bound(value: float) -> str:
    return str(value) if isinstance(value, int) else f"{value:g}"
