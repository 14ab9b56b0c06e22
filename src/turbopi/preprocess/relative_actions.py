"""Actions relative to the state ("delta" in openpi's words) and absolute ones, by dimension.

Which dimensions: a robot's `delta_mask`. In whose units, and in float64 or float32: `Pipeline._make_absolute`. Sources:
openpi's `transforms.py`; LeRobot's relative and absolute actions processors.
"""

from collections.abc import Sequence

import numpy as np


def delta_actions(actions: np.ndarray, state: np.ndarray, mask: Sequence[bool]) -> np.ndarray:
    """Absolute actions [..., H, d] relative to `state` [..., s] where `mask` is True; the dtype is kept."""
    return _shifted(actions, state, mask, -1)


def absolute_actions(actions: np.ndarray, state: np.ndarray, mask: Sequence[bool]) -> np.ndarray:
    """The inverse of `delta_actions`: `state`, un-normalised, added where `mask` is True; the dtype is kept."""
    return _shifted(actions, state, mask, 1)


def _shifted(actions: np.ndarray, state: np.ndarray, mask: Sequence[bool], sign: int) -> np.ndarray:
    n = len(mask)
    out = actions.copy()
    out[..., :n] += sign * np.where(mask, state[..., :n], 0)[..., None, :]
    return out
