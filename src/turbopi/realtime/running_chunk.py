"""The action chunk that a robot carries out while the policy computes the next one: what the next one must join."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np

from turbopi.config import LIMITS, RealTime, Schedule
from turbopi.support.errors import ObservationError

if TYPE_CHECKING:  # a robot's computer joins chunks without PyTorch
    from turbopi.models.pi0.conditioning import Conditioning, Form

JoinMode = Literal["rtc", "rtc_identity", "rtc_trained", "warm_start", "paint"]
FORMS: "dict[JoinMode, Form]" = {
    "rtc": "jacobian",
    "rtc_identity": "tokens",
    "rtc_trained": "tokens",
    "warm_start": "solver",
    "paint": "noise",
}
GUIDED: tuple[JoinMode, ...] = ("rtc", "rtc_identity")
WARM_START = 0.6  # t at which a warm start begins: so much noise, and the rest is the running chunk


@dataclass(frozen=True)
class RunningChunk:
    """What is left of the running chunk when an observation is taken, as `UnifiedPolicy.infer` is told of it.

    left_over          float32[K, action_dim], 1 ≤ K ≤ H, in the model's normalised space, as `infer` returned it under
                       "model_actions"; row 0 is the action that the robot carries out at the observation's time.
                       LeRobot's engine pads one that is shorter than e below: with zeros up to 0.6.1, with its last
                       action since pull request 4454. For its numbers in "rtc_identity" pad it so
    delay              d, control steps: how many of these actions will be carried out before the new chunk arrives
    execution_horizon  s, control steps: how many actions of a chunk are carried out before the next takes over. Guided
                       modes pull towards the left-over before H − s; d ≤ H − s. None: the policy's, cut to H − d, or
                       where it has none the whole left-over: max(H − K, d, 1). With "rtc_identity" None is as in
                       LeRobot, whose mask ends at e = H − s of the policy's s, or at K: the delay is cut to it. There 0
                       is allowed, too: LeRobot's e of H or more
    mode               "rtc": guided, with the true Jacobian (arXiv 2506.07339). "rtc_identity": guided as LeRobot 0.6
                       computes it. "rtc_trained": the first d actions are held (arXiv 2512.05964), for checkpoints
                       that were trained so. "warm_start": denoising begins with the left-over, 60 % of it replaced by
                       noise, and its last action in place of what is missing; nothing is held or pulled.
                       "paint": the noise of the first d actions is chosen so that they come near the left-over's (arXiv
                       2606.19774); with a delay of 0 an ordinary call
    anchor             for relative actions: the "anchor" that came with the left-over, so that it can be moved to the
                       new state
    schedule, max_guidance_weight
                       of the guided modes' pull, see `conditioning.guidance_weights` and `guidance_strength`. None: the
                       policy's. Other modes take neither
    """

    left_over: np.ndarray
    delay: int
    execution_horizon: int | None = None
    mode: JoinMode = "rtc"
    anchor: np.ndarray | None = None
    schedule: Schedule | None = None
    max_guidance_weight: float | None = None

    def completed(self, horizon: int, action_dim: int, *, relative: bool, options: RealTime) -> "RunningChunk":
        """The same, checked, with the policy's `options` where it leaves something out.

        relative  whether the policy's actions are relative to the state

        Raises ObservationError for whatever can't be.
        """
        if self.mode not in get_args(JoinMode):
            raise ObservationError(f"the mode is {self.mode!r}; it should be one of {', '.join(get_args(JoinMode))}")
        guidance = {"schedule": self.schedule, "max_guidance_weight": self.max_guidance_weight}
        if (why := refuses_guidance(self.mode, guidance)) is not None:
            raise ObservationError(why)
        left_over = self._checked_left_over(horizon, action_dim)
        if relative and self.anchor is None:
            raise ObservationError(
                "this policy's actions are relative to the state: give the anchor that came with the left-over, too"
            )
        if not relative and self.anchor is not None:
            raise ObservationError("this policy's actions aren't relative to the state: leave the anchor out")
        limit = LIMITS["action_horizon"]
        delay = _whole("the delay", self.delay, 0, limit)
        given = self.execution_horizon
        least = 0 if self.mode == "rtc_identity" else 1
        s = None if given is None else _whole("the execution horizon", given, least, limit)
        rows = len(left_over)
        if delay > rows:
            raise ObservationError(
                f"the delay is {delay} control steps, but {rows} actions are left over: the robot would run out of "
                "actions before the new chunk arrives. Ask earlier, or carry out fewer actions of a chunk"
            )
        if self.mode == "rtc_trained":
            self._check_trained(delay, options.trained_max_delay)
        if self.mode == "rtc_trained":
            s = 1 if s is None else s
        elif self.mode == "rtc_identity" and s is None:
            s = horizon - rows if options.execution_horizon is None else min(options.execution_horizon, horizon)
        elif s is None and options.execution_horizon is not None:
            s = max(1, min(options.execution_horizon, horizon - delay))
        elif s is None:
            s = max(horizon - rows, delay, 1)
        if delay > horizon - s and not (self.mode == "rtc_identity" and given is None):
            raise ObservationError(
                f"a delay of {delay} and an execution horizon of {s} don't fit a chunk of {horizon} actions: together "
                f"they should be at most {horizon}. Carry out fewer actions of a chunk, or take a larger horizon"
            )
        most = options.max_guidance_weight if self.max_guidance_weight is None else self.max_guidance_weight
        if isinstance(most, bool) or not isinstance(most, int | float | np.number) or not 0 <= most <= 1e6:
            raise ObservationError(f"max_guidance_weight is {most!r}; it should be a number from 0 to 1e6")
        schedule = self.schedule or options.schedule
        if schedule not in get_args(Schedule):
            raise ObservationError(f"the schedule is {schedule!r}; it should be one of {', '.join(get_args(Schedule))}")
        return replace(
            self,
            left_over=left_over,
            delay=delay,
            execution_horizon=s,
            schedule=schedule,
            max_guidance_weight=float(most),
        )

    def conditioning(self, left_over: np.ndarray, num_steps: int, horizon: int, time_grid: str) -> "Conditioning":
        """What the denoising loop is asked for: of a chunk that is `completed`.

        left_over  the chunk's, for relative actions moved to the new state
        time_grid  as `ModelConfig`'s
        """
        from turbopi.models.pi0.conditioning import (
            Conditioning,
            Guidance,
            guidance_strength,
            guidance_weights,
            lerobot_guidance_weights,
        )
        from turbopi.models.pi0.noise_choice import NoiseChoice

        assert self.execution_horizon is not None and self.schedule is not None and self.max_guidance_weight is not None
        target = np.zeros((horizon, left_over.shape[1]), np.float32)
        target[: len(left_over)] = left_over
        due = np.arange(horizon) < self.delay
        if self.mode == "paint":
            return Conditioning(noise=NoiseChoice(due, target)) if self.delay else Conditioning()
        if self.mode == "rtc_trained":
            return Conditioning(held=due, values=target) if self.delay else Conditioning()
        times = Conditioning().token_times(num_steps, horizon, time_grid).times
        rows, s = len(left_over), self.execution_horizon
        if self.mode == "rtc":  # nothing pulls towards what isn't there
            weights = guidance_weights(horizon, self.delay, max(s, horizon - rows), self.schedule)
        else:
            weights = lerobot_guidance_weights(horizon, self.delay, horizon - s, rows, self.schedule)
        strength = guidance_strength(times, self.max_guidance_weight)
        return Conditioning(
            guidance=Guidance(target, weights, strength, "jacobian" if self.mode == "rtc" else "identity")
        )

    def begun(self, left_over: np.ndarray, noise: np.ndarray) -> np.ndarray:
        """x float32[H, action_dim] at t = WARM_START, of a warm start. `left_over` as `conditioning`'s."""
        missing = len(noise) - len(left_over)
        chunk = np.concatenate((left_over, left_over[-1:].repeat(missing, axis=0)))
        return (WARM_START * noise + (1 - WARM_START) * chunk).astype(np.float32)

    def _checked_left_over(self, horizon: int, action_dim: int) -> np.ndarray:
        try:
            array = np.asarray(self.left_over)
        except (TypeError, ValueError, RuntimeError) as error:
            raise ObservationError(f"the left-over isn't an array of numbers: {error}") from None
        if array.dtype.kind not in "fiu" or array.ndim != 2:
            raise ObservationError(
                f"the left-over has shape {list(array.shape)} and dtype {array.dtype}; it should be numbers [K, "
                f"{action_dim}], as the policy returned them under model_actions"
            )
        if array.shape[1] != action_dim:
            raise ObservationError(
                f"the left-over's actions have {array.shape[1]} values, but this model's have {action_dim}: give what "
                "the policy returned under model_actions, not the robot's actions"
            )
        if not 1 <= len(array) <= horizon:
            raise ObservationError(
                f"the left-over has {len(array)} actions; it should be 1 to the chunk's {horizon}. Without a running "
                "chunk leave `previous` out"
            )
        with np.errstate(over="ignore"):  # refused below
            array = array.astype(np.float32)
        if not np.isfinite(array).all():
            raise ObservationError("the left-over has values that aren't finite")
        return array

    def _check_trained(self, delay: int, trained: int) -> None:
        if trained < 1:
            raise ObservationError(
                "mode rtc_trained needs a checkpoint that was trained with simulated delays, and this one doesn't say "
                'that it was: use mode "rtc", or if it was, put {"real_time": {"trained_max_delay": …}} into a '
                "turbopi.json"
            )
        if delay > trained:
            raise ObservationError(
                f"the delay is {delay} control steps, but this checkpoint was trained with delays up to {trained}: use "
                'mode "rtc", or make the delay shorter (fewer denoising steps, a lower control rate)'
            )


def refuses_guidance(mode: str, given: Mapping[str, object]) -> str | None:
    """Why a mode, or way to run, takes none of these options of guidance, by name; None if it takes them, or none is
    given.
    """
    names = [name for name, value in given.items() if value is not None]
    if not names or mode in GUIDED:
        return None
    return f"{' and '.join(names)} say how {' and '.join(GUIDED)} guide; {mode} doesn't guide: leave them out"


def _whole(what: str, number: object, low: int, high: int) -> int:
    if not isinstance(number, int | np.integer) or isinstance(number, bool) or not low <= number <= high:
        raise ObservationError(f"{what} is {number!r}; it should be a whole number of control steps from {low} on")
    return int(number)
