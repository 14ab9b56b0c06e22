"""What a denoising loop may be asked for beyond "noise to actions": times by token, held actions, guidance.

Real-time execution needs nothing else of the model (docs/real_time.md). N steps, H actions, A action_dim; t = 1 is
noise and t = 0 the action. One call of the loop, for every action i and step s:

    x̂ = x − t[s, i] · v                                       the chunk that v points to
    v ← v − strength[s, i] · (Jᵀ[(target − x̂) ⊙ weights])[i]  with guidance: J = ∂x̂/∂x, or the identity in its place
    x ← x + steps[s, i] · v

A held action has its given value in x from the start, time 0 and a step of 0: so it stays, and the others attend to it.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from turbopi.errors import ObservationError
from turbopi.model.denoise import time_grid

GuidanceMode = Literal["jacobian", "identity"]
Schedule = Literal["exponential", "linear", "ones", "zeros"]


@dataclass(frozen=True)
class TokenTimes:
    """Where each action is in time at each step, and how far the step takes it."""

    times: np.ndarray  # float32[N, H]  t at the start of a step
    steps: np.ndarray  # float32[N, H]  added to t in that step, so never above 0; 0: the action stays as it is

    @classmethod
    def plain(cls, num_steps: int, horizon: int, kind: str = "accumulated") -> "TokenTimes":
        """openpi's: one time for all actions. `kind` as in `time_grid`."""
        times = np.repeat(time_grid(num_steps, kind)[:, None], horizon, axis=1)
        return cls(times, np.full(times.shape, np.float32(-1.0 / num_steps)))

    @classmethod
    def of(cls, t: np.ndarray) -> "TokenTimes":
        """From t[N + 1, H]: the times at which steps begin, and the one at which the last ends.

        Raises ObservationError for another shape, times outside [0, 1] and times that grow.
        """
        t = np.asarray(t)
        if t.ndim != 2 or t.shape[0] < 2 or t.shape[1] < 1 or t.dtype.kind not in "fiu":
            raise ObservationError(
                f"token times have shape {list(t.shape)} and dtype {t.dtype}; they should be numbers [steps + 1, H]"
            )
        t = t.astype(np.float32)
        if not ((t >= 0) & (t <= 1)).all():  # NaN, too
            raise ObservationError("token times should lie between 0 (action) and 1 (noise), in every step")
        if (np.diff(t, axis=0) > 0).any():
            raise ObservationError("token times should never grow from step to step: 1 is noise, 0 the action")
        return cls(t[:-1], np.diff(t, axis=0))

    def holding(self, held: np.ndarray) -> "TokenTimes":
        """The same with the actions of `held` bool[H] at time 0 in every step."""
        return TokenTimes(np.where(held, np.float32(0), self.times), np.where(held, np.float32(0), self.steps))


@dataclass(frozen=True)
class Guidance:
    """A pull of the predicted chunk x̂ towards a target, in every step.

    mode "jacobian" is the published one (arXiv 2506.07339): the error goes back through the action expert. "identity"
    leaves that out, which is what LeRobot 0.6's code computes. They differ; neither stands in for the other.
    """

    target: np.ndarray  # float32[H, A], in the model's normalised space
    weights: np.ndarray  # float32[H]
    strength: np.ndarray  # float32[N, H]
    mode: GuidanceMode = "jacobian"


@dataclass(frozen=True)
class Conditioning:
    """All of it, for one observation. What is None is as openpi has it, to the last bit.

    The `noise` that comes with it is x at `tokens.times[0]`, noise or not: a warm start passes the chunk it starts
    from, mixed with noise. Held actions' values replace its rows.
    """

    tokens: TokenTimes | None = None
    held: np.ndarray | None = None  # bool[H]; needs values
    values: np.ndarray | None = None  # float32[H, A]; rows that aren't held are ignored
    guidance: Guidance | None = None


def guidance_strength(times: np.ndarray, most: float) -> np.ndarray:
    """float32 of the shape of `times`: min(most, (t / τ) · (t² + τ²) / t²), τ = 1 − t; `most` at τ = 0 and at t = 0.

    Source: RTC (arXiv 2506.07339, equation 2 and its β), with openpi's t. LeRobot computes the same.
    """
    t = times.astype(np.float64)
    tau = 1 - t
    with np.errstate(divide="ignore", invalid="ignore"):
        strength = (t * t + tau * tau) / (tau * t)
    return np.where((tau <= 0) | (t <= 0), most, np.minimum(strength, most)).astype(np.float32)
