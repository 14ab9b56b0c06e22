"""Actions relative to the state ("delta" in openpi's words) and absolute ones, by dimension.

Which dimensions: a robot's `delta_mask`. In whose units, and in float64 or float32: `Pipeline._make_absolute`. Sources:
openpi's `transforms.py`; LeRobot's relative and absolute actions processors.
"""

from collections.abc import Sequence
from typing import TypeAlias

import numpy as np

from turbopi.preprocess.normalize import Normalizer

Mask: TypeAlias = "Sequence[bool] | np.ndarray"


def delta_actions(actions: np.ndarray, state: np.ndarray, mask: Mask) -> np.ndarray:
    """Absolute actions [..., H, d] relative to `state` [..., s] where `mask` is True; the dtype is kept."""
    return _shifted(actions, state, mask, -1)


def absolute_actions(actions: np.ndarray, state: np.ndarray, mask: Mask) -> np.ndarray:
    """The inverse of `delta_actions`: `state`, un-normalised, added where `mask` is True; the dtype is kept."""
    return _shifted(actions, state, mask, 1)


def add_state(actions: np.ndarray, state: np.ndarray, mask: Mask, sign: int = 1) -> None:
    """`absolute_actions` in place; with `sign` -1 `delta_actions`."""
    n = len(mask)
    actions[..., :n] += sign * np.where(mask, state[..., :n], 0)[..., None, :]


def reanchored(actions: np.ndarray, old: np.ndarray, new: np.ndarray, mask: Mask, scale: Normalizer) -> np.ndarray:
    """Normalised actions float32[K, A] relative to the state `old` float[s], relative to `new` instead.

    Where `mask` is True: un-normalised, + old − new, normalised again. The others keep their bits.
    """
    moved = delta_actions(absolute_actions(scale.unnormalize(actions), old, mask), new, mask)
    width = moved.shape[1] if scale.width is None else scale.width
    moved[:, :width] = scale.normalize(moved[:, :width])
    out = actions.copy()
    columns = np.flatnonzero(mask)
    out[:, columns] = moved[:, columns]
    return out


def _shifted(actions: np.ndarray, state: np.ndarray, mask: Mask, sign: int) -> np.ndarray:
    out = actions.copy()
    add_state(out, state, mask, sign)
    return out
