"""Noise that is chosen before the denoising loop, so that its first actions continue a running chunk: no gradient.

Algorithm 1 of PAINT (arXiv 2606.19774; its authors' page and their code for Pi0 have it, their code for other models
takes other times on the way back):

    1. the loop runs from the given noise
    2. some actions of the result become the given values
    3. as many Euler steps go back to noise, each with the velocity at the point that it leaves: t = 0, 1/N, … 1 − 1/N
    4. these actions' noise is what was found, the other actions' is the given one
    5. the loop runs again

So it costs three loops, and the actions come near the values, not to them.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor


@dataclass(frozen=True)
class NoiseChoice:
    """The actions whose noise is chosen, and the values that they should come near."""

    rows: np.ndarray  # bool[H]
    values: np.ndarray  # float32[H, A], in the model's normalised space; other rows are ignored

    def chosen(self, noise: Tensor, loop: Callable[[Tensor, bool], Tensor]) -> Tensor:
        """float32[B, H, A]: the noise to begin with. `loop` (x, whether backwards) -> x at its end."""
        rows, values = (torch.from_numpy(one).to(noise.device) for one in (self.rows[:, None], self.values))
        target = torch.where(rows, values, loop(noise, False))
        return torch.where(rows, loop(target, True), noise)
