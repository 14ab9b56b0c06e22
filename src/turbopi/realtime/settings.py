"""The executor's settings, checked."""

import math
from typing import Literal

import numpy as np

from turbopi.realtime.messages import NOTE_KINDS
from turbopi.support.errors import ConfigError

Hold = Literal["last"] | np.ndarray | None


def above_zero(name: str, value: float, most: float = math.inf) -> float:
    """`value` as a float. Raises ConfigError, with its `name`, unless it is a finite number above 0, at most `most`."""
    number = isinstance(value, int | float | np.integer | np.floating) and not isinstance(value, bool)
    if not number or not 0 < value < math.inf or value > most:
        limit = "" if most == math.inf else f", at most {most:g}"
        raise ConfigError(f"{name} is {value!r}; it should be a number above 0{limit}")
    return float(value)


def checked_note_kinds(given: object) -> frozenset[str]:
    """Kinds of notes. Raises ConfigError for anything else."""
    if not isinstance(given, list | tuple | set | frozenset) or any(kind not in NOTE_KINDS for kind in given):
        raise ConfigError(f"hold_on has {given!r}; it should be a list of some of {', '.join(NOTE_KINDS)}")
    return frozenset(given)


def checked_hold_action(given: object, on_empty: str) -> Hold:
    """The executor's `hold_action`: "last", float64[d] or None. Raises ConfigError for anything else."""
    if given is None:
        return "last" if on_empty == "slow_down" else None  # slowing down is for absolute positions, as "last" is
    if isinstance(given, str):
        if given == "last":
            return "last"
    else:
        array = np.asarray(given)
        if array.ndim == 1 and array.size and array.dtype.kind in "fiu" and not np.isinf(array).any():
            return array.astype(np.float64)
    raise ConfigError(f"hold_action is {given!r}; it should be 'last', numbers [d], or None")


def held_values(hold: Hold, last: np.ndarray | None) -> np.ndarray | None:
    """float64[d], the action of a command that holds, after the command `last`; None: there is none."""
    if hold is None or isinstance(hold, str):
        return None if hold is None else last
    unknown = np.isnan(hold)
    if not unknown.any():
        return hold.copy()
    return None if last is None else np.where(unknown, last, hold)
