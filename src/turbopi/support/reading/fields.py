"""The values of an object that was read, checked one by one."""

import math
from collections.abc import Mapping
from typing import Any, NoReturn, TypeGuard, cast

from turbopi.support.errors import CheckpointError
from turbopi.support.reading.files import Error, shown


class Fields:
    """The values of an object that was read, each of the type and in the range that its reader needs.

    values   the object
    where    what messages begin with: the file, and the way to this object in it
    error    what is raised

    Every method takes a key and returns its value; `default` is returned if the key isn't there, and without one it
    must be. null is never the same as not there. A bool is never a number.
    """

    def __init__(self, values: Mapping[str, Any], where: object, error: Error = CheckpointError) -> None:
        self.values, self.where, self.error = values, where, error

    def refuse(self, key: str, expected: str) -> NoReturn:
        """Raise the error about a key's value."""
        if key not in self.values:
            raise self.error(f"{self.where}: {key} is missing; expected {expected}")
        raise self.error(f"{self.where}: {key} is {shown(self.values[key])}; expected {expected}")

    def integer(self, key: str, low: int, high: int, default: int | None = None) -> int:
        """A whole number in [low, high]."""
        value = self.values.get(key, default)
        if not is_integer(value) or not low <= value <= high:
            self.refuse(key, f"a whole number from {low} to {high}")
        return int(value)

    def number(self, key: str, low: float = -math.inf, high: float = math.inf, default: float | None = None) -> float:
        """A finite number in [low, high]."""
        value = self.values.get(key, default)
        if not is_finite(value) or not low <= value <= high:
            limits = "" if math.isinf(low) and math.isinf(high) else f" from {low:g} to {high:g}"
            self.refuse(key, f"a finite number{limits}")
        return float(value)

    def numbers(self, key: str, length: int | None = None) -> list[float]:
        """A list of finite numbers, of a length if one is given."""
        value = self.values.get(key)
        right = isinstance(value, list) and all(map(is_finite, value)) and length in (None, len(value))
        if not right:
            self.refuse(key, f"a list of {'' if length is None else f'{length} '}finite numbers")
        return [float(item) for item in cast(list[float], value)]

    def text(self, key: str, default: str | None = None) -> str:
        """A text that isn't blank."""
        value = self.values.get(key, default)
        if not isinstance(value, str) or not value.strip():
            self.refuse(key, "a text")
        return value

    def flag(self, key: str, default: bool | None = None) -> bool:
        """true or false."""
        value = self.values.get(key, default)
        if not isinstance(value, bool):
            self.refuse(key, "true or false")
        return value

    def choice(self, key: str, choices: tuple[str, ...], default: str | None = None) -> str:
        """One of some texts."""
        value = self.values.get(key, default)
        if not isinstance(value, str) or value not in choices:
            self.refuse(key, f"one of {', '.join(choices)}")
        return value

    def list(self, key: str, default: "list[Any] | None" = None) -> "list[Any]":
        """A list of anything."""
        value = self.values.get(key, default)
        if not isinstance(value, list):
            self.refuse(key, "a list")
        return value

    def object(self, key: str, default: Mapping[str, object] | None = None) -> "Fields":
        """An object, to be read in the same way."""
        value = self.values.get(key, default)
        if not isinstance(value, Mapping):
            self.refuse(key, "an object")
        return Fields(value, f"{self.where}: {key}", self.error)


def is_integer(value: object) -> TypeGuard[int]:
    """Whether a value of JSON is a whole number: 1 is, 1.0 and true aren't."""
    return isinstance(value, int) and not isinstance(value, bool)


def is_finite(value: object) -> TypeGuard[float]:
    """Whether a value of JSON is a number that float64 holds: true isn't."""
    try:
        return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
    except OverflowError:  # a whole number beyond float64
        return False
