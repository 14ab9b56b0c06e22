"""The action chunk that a robot carries out while the policy computes the next one: what the next one must join."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

if TYPE_CHECKING:  # a robot's computer joins chunks without PyTorch
    from turbopi.model.conditioning import Schedule

JoinMode = Literal["rtc", "rtc_identity", "rtc_trained"]


@dataclass(frozen=True)
class RunningChunk:
    """What is left of the running chunk when an observation is taken, as `UnifiedPolicy.infer` is told of it.

    left_over          float32[K, action_dim], K ≤ H, in the model's normalised space, as `infer` returned it under
                       "model_actions"; row 0 is the action that the robot carries out at the observation's time
    delay              d, control steps: how many of these actions will be carried out before the new chunk arrives
    execution_horizon  s, control steps: how many actions of a chunk are carried out before the next takes over. Guided
                       modes pull towards the left-over before H − s; d ≤ H − s. None: the longest, max(H − K, d)
    mode               "rtc": guided, with the true Jacobian (arXiv 2506.07339). "rtc_identity": guided as LeRobot 0.6
                       computes it. "rtc_trained": the first d actions are held (arXiv 2512.05964), for checkpoints
                       that were trained so
    anchor             for relative actions: the "anchor" that came with the left-over, so that it can be moved to the
                       new state
    """

    left_over: np.ndarray
    delay: int
    execution_horizon: int | None = None
    mode: JoinMode = "rtc"
    anchor: np.ndarray | None = None
    schedule: "Schedule" = "exponential"
    max_guidance_weight: float = 5.0
