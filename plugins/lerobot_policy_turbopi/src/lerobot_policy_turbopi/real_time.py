"""LeRobot's real-time chunking (RTC): what its engine passes to a policy, as what Turbo-Pi's next chunk joins.

LeRobot cuts or pads the left-over to `rtc_config.execution_horizon` rows before the policy gets it: with zeros up to
0.6.1, with the last action since its pull request 4454. The plugin computes with the rows that come.
Source: `lerobot/policies/rtc` and `lerobot/rollout/inference/rtc.py` of 0.6.1 and of the main branch (7427f31).
"""

import logging
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import torch
from torch import Tensor

from turbopi.checkpoint.lerobot import SCHEDULES
from turbopi.config import Schedule
from turbopi.models.pi0.conditioning import (
    Conditioning,
    Guidance,
    TokenTimes,
    guidance_strength,
    lerobot_guidance_weights,
)
from turbopi.realtime.running_chunk import JoinMode
from turbopi.support.errors import ConfigError, ObservationError

logger = logging.getLogger(__name__)

MODES: dict[str, JoinMode] = {"guided": "rtc_identity", "trained": "rtc_trained"}


@dataclass(frozen=True)
class Join:
    """What the next chunk joins.

    left_over   float32[1 or B, K, d], what LeRobot's engine has left of the policy's last answer, 1 ≤ K ≤ chunk_size
    delay       how many of these actions the robot carries out before the next chunk arrives, cut to what counts
    end         guided: actions from here on aren't pulled
    """

    mode: JoinMode
    left_over: np.ndarray
    delay: int
    end: int
    schedule: Schedule
    max_guidance_weight: float

    def conditioning(self, row: int, num_steps: int, horizon: int, width: int) -> Conditioning | None:
        """For one observation of the batch, in LeRobot's form: what the left-over lacks in width or rows is zero."""
        left_over = self.left_over[min(row, len(self.left_over) - 1)]
        target = np.zeros((horizon, width), np.float32)
        target[: len(left_over), : left_over.shape[1]] = left_over
        if self.mode == "rtc_trained":
            return None if self.delay == 0 else Conditioning(held=np.arange(horizon) < self.delay, values=target)
        times = TokenTimes.plain(num_steps, horizon, "multiplied").times
        weights = lerobot_guidance_weights(horizon, self.delay, self.end, len(left_over), self.schedule)
        strength = guidance_strength(times, self.max_guidance_weight)
        return Conditioning(guidance=Guidance(target, weights, strength, "identity"))


def enabled(rtc_config: Any) -> bool:
    """Whether LeRobot's RTCConfig, or None, switches RTC on."""
    return rtc_config is not None and bool(rtc_config.enabled)


def mode_of(config: Any) -> JoinMode:
    """How chunks join with a plugin's config. LeRobot's main branch has a mode in its RTCConfig, too.

    Raises ConfigError for "trained" with a checkpoint that wasn't trained so.
    """
    trained = "trained" in (config.rtc_mode, getattr(config.rtc_config, "mode", None))
    if trained and config.rtc_training_max_delay < 1:
        raise ConfigError(
            "rtc_mode is 'trained', but the checkpoint's config.json has no rtc_training_max_delay above 0: it wasn't "
            "trained with simulated delays. Use --policy.rtc_mode=guided"
        )
    return MODES["trained" if trained else "guided"]


def read_join(
    config: Any, rows: int, left_over: Tensor | None, delay: int | None, execution_horizon: int | None
) -> Join | None:
    """LeRobot's arguments of `predict_action_chunk` for `rows` observations, checked; None: nothing is joined.

    Raises ObservationError for what can't be, and ConfigError as `mode_of`.
    """
    rtc = config.rtc_config
    if not enabled(rtc) or left_over is None or not left_over.numel():
        return None
    mode, horizon, width = mode_of(config), config.chunk_size, config.output_features["action"].shape[0]
    array = left_over.detach().to("cpu", torch.float32).numpy()
    array = array[None] if array.ndim == 2 else array
    if array.ndim != 3 or len(array) not in (1, rows) or array.shape[1] > horizon or array.shape[2] > width:
        raise ObservationError(
            f"prev_chunk_left_over has shape {list(left_over.shape)}; it should be rows of this policy's last answer: "
            f"[K, {width}] or [{rows}, K, {width}], K up to {horizon}"
        )
    if not np.isfinite(array).all():
        raise ObservationError("prev_chunk_left_over has values that aren't finite")
    if not isinstance(delay, int) or isinstance(delay, bool) or delay < 0:
        raise ObservationError(f"inference_delay is {delay!r}; it should be a whole number of control steps from 0 on")
    end = min(rtc.execution_horizon if execution_horizon is None else execution_horizon, array.shape[1])
    most = min(config.rtc_training_max_delay, horizon - 1, array.shape[1]) if mode == "rtc_trained" else end
    if delay > most:
        _warn_once(delay, most, mode)
    return Join(
        mode,
        array,
        min(delay, most),
        end,
        SCHEDULES[rtc.prefix_attention_schedule.name],
        float(rtc.max_guidance_weight),
    )


@cache
def _warn_once(delay: int, most: int, mode: JoinMode) -> None:
    logger.warning(
        "the policy takes %d control steps, but the next chunk joins only %d of them (%s): the robot may jump where "
        "chunks meet. Take fewer denoising steps or a lower --fps",
        delay,
        most,
        "rtc_training_max_delay, and what is left over" if mode == "rtc_trained" else "the execution horizon",
    )
