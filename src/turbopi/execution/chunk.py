"""A chunk as the policy answered it, and what can be wrong with one."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from turbopi.errors import ConfigError

_MOST = float(np.finfo(np.float32).max)


class Chunk(NamedTuple):
    number: int  # of its request
    actions: np.ndarray  # float64[H, d], in the robot's units
    model_actions: np.ndarray | None  # float32[H, A]
    anchor: np.ndarray | None  # float64, of relative actions

    @property
    def finite(self) -> bool:
        """Whether every number is one, in float32, too: beyond it differences and means overflow."""
        parts = (self.actions, self.model_actions, self.anchor)
        return all(bool((np.abs(part) <= _MOST).all()) for part in parts if part is not None)


def read_chunk(
    number: int, result: Mapping[str, Any], shape: tuple[int, int] | None, needed_by: str | None
) -> Chunk | str:
    """The chunk of a policy's result, or what is wrong with it.

    shape      of the actions of chunks before; None: there was none
    needed_by  the way to run that needs "model_actions"; None: none does, and they aren't read
    """
    actions = numbers(result.get("actions"), np.float64)
    if actions is None or actions.ndim != 2 or 0 in actions.shape:
        return f'"actions" isn\'t an array of numbers [H, d] but {_shape(result.get("actions"))}'
    if shape is not None and actions.shape != shape:
        return f"its actions have shape {list(actions.shape)}; those before had {list(shape)}"
    if needed_by is None:
        return Chunk(number, actions, None, None)
    if "model_actions" not in result:
        return (
            f'the policy\'s answer has no "model_actions", which {needed_by} needs for the next chunk: '
            "take a policy that offers it, or execution 'sync', 'async' or 'ensemble'"
        )
    model_actions = numbers(result["model_actions"], np.float32)
    if model_actions is None or model_actions.ndim != 2 or len(model_actions) != len(actions):
        return f'"model_actions" isn\'t float32 [{len(actions)}, A] but {_shape(result["model_actions"])}'
    anchor = None
    if result.get("anchor") is not None:
        anchor = numbers(result["anchor"], np.float64)
        if anchor is None:
            return f'"anchor" isn\'t an array of numbers but {_shape(result["anchor"])}'
    return Chunk(number, actions, model_actions, anchor)


def too_far(actions: np.ndarray, last: np.ndarray | None, most: np.ndarray) -> str | None:
    """Which step of the actions float64[n, d], after the command `last`, moves by more than `most`, if one does."""
    path = actions if last is None else np.concatenate((last[None], actions))
    moves = np.abs(np.diff(path, axis=0))
    beyond = np.argwhere(moves > most)
    if not len(beyond):
        return None
    step, dim = beyond[0]
    limit = np.broadcast_to(most, moves.shape[1])[dim]
    where = "from the last command to its first action" if last is not None and step == 0 else "inside it"
    return f"dimension {dim} moves by {moves[step, dim]:.4g} in one step, {where}; max_jump allows {limit:.4g}"


def mix(new: np.ndarray, old: np.ndarray, old_weight: float) -> None:
    """Replace the rows of `new` that `old` has, too, by their weighted mean."""
    n = min(len(new), len(old))
    new[:n] = old_weight * old[:n] + (1 - old_weight) * new[:n]


def checked_max_jump(given: float | np.ndarray) -> np.ndarray:
    """float64[] or float64[d]. Raises ConfigError."""
    limits = numbers(given, np.float64)
    if limits is None or limits.ndim > 1 or not (limits > 0).all():
        raise ConfigError(f"max_jump is {given!r}; it should be one number above 0, or one for each dimension")
    return limits


def numbers(value: object, dtype: type[np.floating[Any]]) -> np.ndarray | None:
    """`value` as an array of its own, if it is numbers."""
    try:
        array = np.asarray(value)
    except (ValueError, TypeError, RuntimeError, OverflowError):  # lists of different lengths, a tensor on a GPU
        return None
    with np.errstate(over="ignore"):  # an infinity is found later
        return array.astype(dtype) if array.dtype.kind in "fiu" else None


def _shape(value: object) -> str:
    if isinstance(value, np.ndarray):
        return f"{value.dtype}{list(value.shape)}"
    return type(value).__name__
