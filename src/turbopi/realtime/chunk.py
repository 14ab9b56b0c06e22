"""An answer of a policy, checked before a robot may get it, and the chunk in it."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from turbopi.support.errors import ActionError, ConfigError
from turbopi.support.text import kind_of

_MOST = float(np.finfo(np.float32).max)


class NotFinite(ActionError):
    """A number of an answer is NaN, infinite or beyond float32: there differences and means overflow."""


class Chunk(NamedTuple):
    number: int  # of its request
    actions: np.ndarray  # float64[H, d], in the robot's units
    model_actions: np.ndarray | None  # float32[H, A]
    anchor: np.ndarray | None  # float64, of relative actions


def checked_answer(answer: Any, *, model_actions: bool = False, batch: bool = False) -> dict[str, Any]:
    """What a policy answered, once a robot may get it: "actions" are an array [H, d] of finite numbers, H and d from 1.

    model_actions  the answer must have "model_actions" [H, A], too; "anchor" is checked if it is there
    batch          "actions" of several observations: [B, H, d], or a list of chunks

    Every answer passes here, whatever the policy is: in the server, `RealTimeClient` and the executor. What else an
    answer holds is passed on as it is. Raises ActionError that says what is wrong, NotFinite if it is a number.
    """
    if not isinstance(answer, dict | Mapping):  # a dict is found sooner
        raise ActionError(f'the policy\'s answer is {kind_of(answer)}; it should be a dict with "actions"')
    for name in ("actions", "model_actions") if model_actions else ("actions",):
        if name not in answer:
            keys = ", ".join(map(str, answer)) or "none"
            raise ActionError(f'the policy\'s answer has no "{name}"; its keys: {keys:.200}')
    if batch:
        chunks = answer["actions"]
        if not isinstance(chunks, list | np.ndarray) or not len(chunks):
            raise ActionError(f'"actions" of a batch aren\'t a chunk for each observation but {_shape(chunks)}')
        checked = [_checked_array("actions", chunk, "[H, d]") for chunk in chunks]
        return dict(answer) if isinstance(chunks, np.ndarray) else {**answer, "actions": checked}
    arrays = {"actions": _checked_array("actions", answer["actions"], "[H, d]")}
    if model_actions:
        rows = len(arrays["actions"])
        arrays["model_actions"] = _checked_array("model_actions", answer["model_actions"], f"[{rows}, A]", rows)
        if answer.get("anchor") is not None:
            arrays["anchor"] = _checked_array("anchor", answer["anchor"])
    return {**answer, **arrays}


def _checked_array(name: str, value: object, axes: str = "", rows: int | None = None) -> np.ndarray:
    """`value` as an array of finite numbers: of any shape, or with the two `axes`, and `rows` if they are known."""
    array = _array(value)
    if (
        array is None
        or array.dtype.kind not in "fiu"
        or not array.size
        or (axes and (array.ndim != 2 or rows not in (None, len(array))))
    ):
        raise ActionError(f'"{name}" isn\'t an array of numbers{" " + axes if axes else ""} but {_shape(value)}')
    # A sum of squares that is small enough has no part that isn't: one pass. Most arrays end here.
    if array.dtype.kind == "f" and not float(np.vdot(array, array)) <= _MOST:
        single = array.dtype.itemsize <= 4
        if not (np.isfinite(array).all() if single else np.abs(array).max() <= _MOST):  # the largest is NaN if one is
            places = np.argwhere(~np.isfinite(array) if single else ~(np.abs(array) <= _MOST))
            first = tuple(map(int, places[0]))
            raise NotFinite(
                f'"{name}" has {array[first]} at {list(first)} (from 0): {len(places)} of {array.size} numbers are '
                "NaN, infinite or beyond float32"
            )
    return array


def read_chunk(number: int, answer: Any, shape: tuple[int, int] | None, needed_by: str | None) -> Chunk:
    """The chunk of an answer, in arrays of its own.

    shape      of the actions of chunks before; None: there was none
    needed_by  the way to run that needs "model_actions"; None: none does, and they aren't read

    Raises as `checked_answer`, and ActionError for actions of another shape.
    """
    if needed_by is not None and isinstance(answer, Mapping) and "actions" in answer and "model_actions" not in answer:
        raise ActionError(
            f'the policy\'s answer has no "model_actions", which {needed_by} needs for the next chunk: '
            "take a policy that offers it, or execution 'sync', 'async' or 'ensemble'"
        )
    checked = checked_answer(answer, model_actions=needed_by is not None)
    actions = checked["actions"].astype(np.float64)
    if shape is not None and actions.shape != shape:
        raise ActionError(f"its actions have shape {list(actions.shape)}; those before had {list(shape)}")
    if needed_by is None:
        return Chunk(number, actions, None, None)
    anchor = None if checked.get("anchor") is None else checked["anchor"].astype(np.float64)
    return Chunk(number, actions, checked["model_actions"].astype(np.float32), anchor)


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
    return f"action {dim} moves by {moves[step, dim]:.4g} in one step, {where}; max_jump allows {limit:.4g}"


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
    array = _array(value)
    return None if array is None or array.dtype.kind not in "fiu" else array.astype(dtype)


def _array(value: object) -> np.ndarray | None:
    try:
        return np.asarray(value)
    except (ValueError, TypeError, RuntimeError, OverflowError):  # lists of different lengths, a tensor on a GPU
        return None


def _shape(value: object) -> str:
    if isinstance(value, np.ndarray):
        return f"{value.dtype}{list(value.shape)}"
    return type(value).__name__
