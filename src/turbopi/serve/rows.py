"""A batch message of vectorised environments: B observations in one map, and their B results in one.

Arrays have the axis of the rows in front, [B, …]. A text holds for all rows; a list of B texts has one for each.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from turbopi.realtime.messages import PREFIX
from turbopi.support.errors import ObservationError

TIMING = "policy_timing"


def check_rows(batch: Mapping[str, Any], rows: int, below: str = "") -> None:
    """Raise ObservationError unless each entry has `rows` rows, or one value for all."""
    for key, value in batch.items():
        name = f"{below}{key}"
        if isinstance(value, Mapping):
            check_rows(value, rows, f"{name}/")
        elif isinstance(value, np.ndarray) and value.ndim:
            if len(value) != rows:
                raise ObservationError(
                    f"{name!r} has shape {list(value.shape)}, but {PREFIX}batch is {rows}: its first axis should be "
                    f"the one of the rows, [{rows}, …]"
                )
        elif isinstance(value, list):
            if not all(isinstance(item, str) for item in value):
                raise ObservationError(
                    f"{name!r} is a list; in a batch it should be an array [{rows}, …], a text for all rows, or a "
                    f"list of {rows} texts"
                )
            if len(value) != rows:
                raise ObservationError(f"{name!r} has {len(value)} texts, but {PREFIX}batch is {rows}")


def row(batch: Mapping[str, Any], index: int) -> dict[str, Any]:
    """One row's observation, or its result. Arrays are views."""
    return {key: _row(value, index) for key, value in batch.items()}


def _row(value: Any, index: int) -> Any:
    if isinstance(value, Mapping):
        return row(value, index)
    if isinstance(value, list) or (isinstance(value, np.ndarray) and value.ndim):
        return value[index]
    return value


def stacked(results: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """The results of the rows as one: arrays of one shape as [B, …], maps by their keys, all else as lists.

    Their `policy_timing` isn't in it: rows of one run share it.
    """
    keys = [key for key in results[0] if key != TIMING and all(key in result for result in results)]
    return {key: _stacked([result[key] for result in results]) for key in keys}


def _stacked(values: list[Any]) -> Any:
    if all(isinstance(value, Mapping) for value in values):
        return stacked(values)
    if all(isinstance(value, np.ndarray) for value in values) and len({value.shape for value in values}) == 1:
        return np.stack(values)
    return values


def summed(timings: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """The times of several runs of the policy, together."""
    return {key: sum(timing.get(key, 0.0) for timing in timings) for key in (timings[0] if timings else ())}
