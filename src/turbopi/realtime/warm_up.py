"""Bringing a policy to full speed, and whether that is fast enough."""

import logging
import math
from collections.abc import Callable, Mapping
from typing import Any

from turbopi.realtime import Way
from turbopi.realtime.queue import longest_delay
from turbopi.realtime.running_chunk import RunningChunk
from turbopi.support.errors import ConfigError

TIMED_CALLS = 2

logger = logging.getLogger(__name__)


def warm_policy(
    policy: Any,
    observation: Mapping[str, Any],
    arguments: Mapping[str, Any],
    way: Way,
    learn: Callable[[Any], RunningChunk | None],
    clock: Callable[[], float],
) -> float:
    """Call a policy until it is warm, with and without a running chunk. The seconds of the slower of its last calls.

    arguments  of every `infer`
    learn      is given the first answer; returns the running chunk that later calls may have
    """
    warmup = getattr(policy, "warmup", None)
    if callable(warmup):
        warmup(**({"real_time": way.mode} if way.mode is not None else {}))
    requested: dict[str, Any] = {"previous": None, "model_actions": True} if way.mode is not None else {}
    previous = learn(policy.infer(observation, **arguments, **requested))
    if previous is not None:
        requested["previous"] = previous
        policy.infer(observation, **arguments, **requested)
    seconds = 0.0
    for _ in range(TIMED_CALLS):
        before = clock()
        policy.infer(observation, **arguments, **requested)
        seconds = max(seconds, clock() - before)
    return seconds


def expected_delay(
    seconds: float, hz: float, *, way: Way, horizon: int, s: int, trained_max: int | None, max_age_s: float
) -> int:
    """Control steps that a call of so many seconds takes. Raises ConfigError if the way can't be run with it at all.

    Warns, in the log, if the robot will run out of actions in each chunk.
    """
    delay = math.ceil(round(seconds * hz, 6))
    slow = f"one call takes {seconds * 1e3:.0f} ms, {delay} control steps at {hz:g} Hz"
    quicker = "fewer denoising steps or a faster backend"
    faster = f"a lower control_hz, {quicker}"
    if seconds > max_age_s:
        raise ConfigError(
            f"{slow}: every chunk would be refused, as max_observation_age_s is {max_age_s:g}. Raise it, or choose "
            f"{quicker}"
        )
    if way.holds and trained_max is not None and delay > trained_max:
        raise ConfigError(
            f"{slow}, but this checkpoint was trained with delays up to {trained_max}: choose {faster}, or execution "
            "'rtc'"
        )
    if way.mode is not None and delay > longest_delay(horizon, s):
        raise ConfigError(
            f"{slow}: with chunks of {horizon} actions and an execution horizon of {s}, {way.name} joins chunks up to "
            f"a delay of {longest_delay(horizon, s)}: choose {faster}"
        )
    if way.mode is None and not way.stands_still and delay > horizon - s:
        fits = f"an execution horizon of at most {horizon - delay}, or " if delay < horizon else ""
        logger.warning(
            "%s, but chunks of %d actions have only %d left after an execution horizon of %d: the robot will have no "
            "action at the end of each chunk. Choose %s%s",
            *(slow, horizon, horizon - s, s, fits, faster),
        )
    return delay
