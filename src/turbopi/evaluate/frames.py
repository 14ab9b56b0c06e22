"""What a film of an episode is made of."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Frame:
    """One picture of a film: what the cameras see at a step, and the chunk that is being carried out.

    planned, done   how many of its actions will be carried out before the policy is asked again, and have been
    """

    step: int
    pictures: list[np.ndarray]
    chunk: np.ndarray  # [H, d]
    planned: int
    done: int
