"""The queue of actions: which action is next, what the policy is given of the running chunk, where the new one joins.

Everything is counted in actions that the robot carried out. Row i of a chunk is meant for the i-th action after its
observation. When the robot has carried out n actions between an observation and the chunk computed from it, the chunk
is entered at row n: no action is carried out twice, and none is left out. A robot that stood still meanwhile (it had
no actions, or its way is "sync") carried out none, and enters at row 0.
"""

import copy
import warnings
from collections import Counter, deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from turbopi.config import RealTime, Schedule
from turbopi.realtime.chunk import Chunk, NotFinite, checked_max_jump, mix, read_chunk, too_far
from turbopi.realtime.delays import DelayEstimate, number_up_to
from turbopi.realtime.running_chunk import RunningChunk, refuses_guidance
from turbopi.realtime.ways import Execution, way_named
from turbopi.support.errors import ActionError, ConfigError

OLD_WEIGHT = 0.3  # LeRobot's default
KEPT = 10_000  # seams and delays of one queue

# Why a chunk was never carried out:
#   late        "rtc_trained": more actions were carried out than it was given; it continues those that it was given
#   used_up     all of its actions belong to the past
#   not_finite  a number in it is NaN, infinite or beyond float32
#   jump        the command would move by more than `max_jump` in one step
#   malformed   it isn't what a policy answers
#   failed      the policy gave no chunk
# and what the caller of `fail` and `interrupt` names.
Reason = str


@dataclass(frozen=True)
class Request:
    """What to tell the policy with an observation: `policy.infer(observation, **request.arguments)`."""

    number: int  # of the chunk, from 0
    step: int  # when its observation was taken: control steps before it
    carried_out: int  # actions before it
    previous: RunningChunk | None  # None: nothing is known of a running chunk, or it doesn't matter
    model_actions: bool  # the result must have "model_actions" (and "anchor"), for the chunk after it

    @property
    def arguments(self) -> dict[str, Any]:
        """Empty for the ways that need nothing of the model, so that any policy takes them."""
        if not self.model_actions:
            return {}
        return {"previous": self.previous, "model_actions": True}


def of_batch(arguments: Sequence[Mapping[str, Any]]) -> dict[str, list[Any]]:
    """What `infer_batch` is told where `infer` would be told these `Request.arguments`: a value for each observation.

    Empty if none of them is told anything, so that any policy with `infer_batch` takes it.
    """
    if not any(arguments):
        return {}
    return {
        "previous": [one.get("previous") for one in arguments],
        "model_actions": [bool(one.get("model_actions")) for one in arguments],
    }


class Action(NamedTuple):
    """One action of a chunk."""

    values: np.ndarray  # float64[d], in the robot's units
    chunk: int  # the number of its request
    row: int
    takes_over: bool  # it is the first that is carried out of its chunk


@dataclass(frozen=True)
class Seam:
    """Where a chunk takes over from another; `jump` and `gap` are in the robot's units.

    The first chunk of an episode follows no command and has none: `Action.takes_over` tells of it.
    """

    step: int  # control steps before it
    chunk: int
    delay: int  # control steps from the observation to the chunk
    carried_out: int  # actions among them: the row at which the chunk is entered
    reported: int | None  # the delay that the policy was given, if it was given a running chunk
    jump: np.ndarray  # float64[d]  its first action − the last command
    gap: np.ndarray | None  # float64[d]  its first action − what the running chunk has for that step, if it has it

    def __getattr__(self, name: str) -> int | None:
        """`told`, the name that `reported` had before, for one version: with a DeprecationWarning."""
        if name != "told":
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}", name=name, obj=self)
        warnings.warn("Seam.told: the name is now Seam.reported", DeprecationWarning, stacklevel=2)
        return self.reported


@dataclass
class _Flight:
    """An observation whose chunk isn't there yet."""

    request: Request
    delay: int  # control steps since
    carried_out: int  # actions since
    refused: Reason | None = None


class ChunkQueue:
    """Joins chunks, by one of the ways to run. Deterministic; not for several threads at once.

    execution_horizon    s, actions of a chunk after which the next observation is taken; at most H. None: half of H
    delay                control steps from an observation to its chunk that the policy is given: fixed, or an estimate,
                         to which the queue adds what it measures. Only the "rtc" ways use it
    trained_max_delay    "rtc_trained": the largest delay that the checkpoint was trained with. None: not known
    max_jump             the most that a command may move in one step, in the robot's units: one number or float[d],
                         np.inf for what may jump. A chunk that moves by more in the rows not yet passed, or from the
                         last command to its first action, is refused whole
    old_weight           "ensemble": the running chunk's part of the mean; LeRobot's default
    schedule, max_guidance_weight
                         of the guided ways, as in RunningChunk; others refuse them. None: the policy's
    policys_guidance     True: the policy isn't told s, so guidance ends by its own execution horizon (LeRobot's
                         rtc_config)

    A fixed delay d and the horizons must fit: d ≤ s and d ≤ H − s for the "rtc" ways, else ConfigError, at the latest
    when the first chunk shows H. An estimate that is larger for a while is cut to what fits: `cut_delays` counts.
    When more actions were carried out than the policy was told, "rtc_trained" drops the chunk (`dropped["late"]`) and
    the guided ways enter it that much later (`late`).
    """

    def __init__(
        self,
        execution: Execution | str,
        *,
        execution_horizon: int | None = None,
        delay: int | DelayEstimate = 0,
        trained_max_delay: int | None = None,
        max_jump: float | np.ndarray | None = None,
        old_weight: float = OLD_WEIGHT,
        schedule: Schedule | None = None,
        max_guidance_weight: float | None = None,
        policys_guidance: bool = False,
    ) -> None:
        self.way = way_named(execution)
        self.dropped: Counter[Reason] = Counter()  # chunks that were never carried out
        self.late = 0  # guided chunks that were told a smaller delay than the one they had
        self.cut_delays = 0  # requests that were told a smaller delay than the estimate, as more doesn't fit
        self.chunks = 0  # that took over
        self.empty_steps = 0  # calls of next_action that found no action
        self.steps = 0  # control steps: calls of next_action and of skip_step
        self.carried_out = 0  # actions
        self.seams: deque[Seam] = deque(maxlen=KEPT)
        self.delays: deque[int] = deque(maxlen=KEPT)  # measured, of all chunks that came
        self.last_problem = ""  # about the last chunk that was dropped
        self.horizon: int | None = None  # H, once a chunk has come
        self.width: int | None = None  # d, once a chunk has come
        self._fixed = not isinstance(delay, DelayEstimate)
        self._delay = delay if isinstance(delay, DelayEstimate) else DelayEstimate(delay)
        self._s = None if execution_horizon is None else _horizon(execution_horizon)
        self._trained_max = trained_max_delay
        self._max_jump = None if max_jump is None else checked_max_jump(max_jump)
        self._old_weight = number_up_to(1, "old_weight", old_weight)
        self._guidance: dict[str, Any] = {"schedule": schedule, "max_guidance_weight": max_guidance_weight}
        RealTime(**{name: value for name, value in self._guidance.items() if value is not None})  # checks them
        if (why := refuses_guidance(self.way.name, self._guidance)) is not None:
            raise ConfigError(why)
        self._policys_guidance = policys_guidance
        self._requests = 0
        self._running: Chunk | None = None
        self._row = self._entered = 0  # of the running chunk: the next one, and the first that was carried out
        self._flight: _Flight | None = None
        self._last: np.ndarray | None = None  # the last action
        self._check_given_delay()

    # --- what is going on ---------------------------------------------------------------------------------------------

    @property
    def wants_observation(self) -> bool:
        """Whether the next chunk should be begun: s actions of the running one are carried out, or there is none."""
        if self._flight is not None:
            return False
        return self._running is None or self._row >= self.execution_horizon

    @property
    def execution_horizon(self) -> int:
        """s; 1 as long as neither it nor H is known."""
        if self._s is not None:
            return self._s
        return 1 if self.horizon is None else default_execution_horizon(self.horizon)

    @property
    def in_flight(self) -> Request | None:
        """The observation whose chunk isn't there yet."""
        return None if self._flight is None else self._flight.request

    @property
    def waited(self) -> int:
        """Control steps since the observation whose chunk isn't there yet; 0 without one."""
        return 0 if self._flight is None else self._flight.delay

    @property
    def remaining(self) -> int:
        """Actions that are left; after so many calls of `next_action` the robot has none, if no chunk comes."""
        if self._running is None or (self.way.stands_still and self._flight is not None):
            return 0
        return len(self._running.actions) - self._row

    @property
    def oldest_useful(self) -> int:
        """How many actions ago an observation may have been taken to be of use: not before the running chunk."""
        if self._running is None or self.way.stands_still:
            return 0
        return self._row - self._entered

    @property
    def expected_delay(self) -> int:
        """Control steps from an observation to its chunk, as the next request will expect them."""
        return self._delay.steps

    def check_horizon(self, horizon: int) -> None:
        """Raise ConfigError if chunks of H actions don't fit the execution horizon and the delay. `arrive` does it."""
        if self._s is not None and self._s > horizon:
            raise ConfigError(
                f"the execution horizon is {self._s}, but the policy's chunks have {horizon} actions: "
                f"choose an execution horizon from 1 to {horizon}"
            )
        half = default_execution_horizon(horizon)
        s = half if self._s is None else self._s
        d = self._delay.steps
        if self.way.mode is not None and self._fixed and d > min(s, horizon - s):
            raise ConfigError(
                f"a delay of {d} control steps doesn't fit an execution horizon of s = {s} and chunks of H = {horizon} "
                f"actions: {self.way.name} needs delay ≤ s and delay ≤ H − s, so at most {min(s, horizon - s)} here "
                f"(at most {horizon // 2} with s = {half}). Choose another execution horizon, "
                "a lower control rate, or fewer denoising steps"
            )

    # --- the policy's side --------------------------------------------------------------------------------------------

    def observe(self, ago: int = 0) -> Request:
        """An observation was taken, `ago` actions before now (at most `oldest_useful`); its chunk is in flight now."""
        if self._flight is not None:
            raise RuntimeError(f"chunk {self._flight.request.number} is in flight: arrive() or fail() first")
        if not 0 <= ago <= self.oldest_useful:
            raise ValueError(f"the observation was taken {ago} actions ago; at most {self.oldest_useful} are useful")
        previous = self._previous(ago)
        counts = (self._requests, self.steps - ago, self.carried_out - ago)
        request = Request(*counts, previous, model_actions=self.way.mode is not None)
        self._requests += 1
        self._flight = _Flight(request, ago, ago)
        return request

    def _previous(self, ago: int) -> RunningChunk | None:
        """What the policy is given of the running chunk at an observation, or None if nothing of that is left."""
        if self.way.mode is None or self._running is None:
            return None
        row, expected = self._row - ago, max(self._delay.steps, ago)
        previous = self._reported(self._running, row, expected)
        self.cut_delays += previous is not None and previous.delay < expected
        return previous

    def _reported(self, chunk: Chunk, row: int, expected: int) -> RunningChunk | None:
        """What the policy is given of a chunk whose next action is `row`; the delay is cut to what fits."""
        if self.way.mode is None or row >= len(chunk.actions):
            return None
        assert chunk.model_actions is not None
        s = max(self.execution_horizon, row)  # the new chunk's last s actions have nothing to follow
        most = len(chunk.actions) - s
        if self.way.holds and self._trained_max is not None:
            most = min(most, self._trained_max)
        left_over = chunk.model_actions[row:].copy()
        s_given = None if self._policys_guidance else s
        return RunningChunk(left_over, min(expected, most), s_given, self.way.mode, chunk.anchor, **self._guidance)

    def arrive(self, result: Any) -> Reason | None:
        """The chunk in flight is there: what `policy.infer` returned. None if it takes over, else why it is dropped.

        Raises ConfigError if chunks of its length can't be run in this way at all (`check_horizon`).
        """
        flight = self._landed()
        delay, entry = flight.delay, flight.carried_out
        self._delay_measured(delay)
        if flight.refused is not None:
            return self._drop(flight.refused, "its observation belongs to what was interrupted")
        try:
            chunk = self._read(flight.request.number, result)
        except ActionError as error:
            return self._drop("not_finite" if isinstance(error, NotFinite) else "malformed", str(error))
        horizon = len(chunk.actions)
        if self.horizon is None:
            self._learn(chunk)
        if entry >= horizon:
            return self._drop("used_up", f"{entry} actions were carried out since its observation; it has {horizon}")
        previous = flight.request.previous
        reported = None if previous is None else previous.delay
        if reported is not None and entry > reported:
            if self.way.holds:
                text = f"{entry} actions were carried out since its observation; the policy was told {reported}"
                return self._drop("late", text)
            self.late += 1
        next_of_running = self._next_of_running()
        if self.way.averages and self._running is not None:
            mix(chunk.actions[entry:], self._running.actions[self._row :], self._old_weight)
        moved = None if self._max_jump is None else too_far(chunk.actions[entry:], self._last, self._max_jump)
        if moved is not None:
            return self._drop("jump", moved)
        first = chunk.actions[entry]
        if self._last is not None:
            gap = None if next_of_running is None else first - next_of_running
            self.seams.append(Seam(self.steps, chunk.number, delay, entry, reported, first - self._last, gap))
        self._running, self._row, self._entered = chunk, entry, entry
        self.chunks += 1
        return None

    def learn(self, result: Any) -> RunningChunk | None:
        """A chunk that nobody carries out, such as a warm-up's, shows H. Raises ConfigError as `arrive` does.

        Returns what the policy would be told once s actions of it were carried out, for another call of the warm-up,
        with a delay of one step at least: with none some modes make a plain call. None if nothing would be left, or the
        policy is never told. Raises ConfigError for what is no chunk, ActionError for one with numbers that aren't
        finite: the next one's may be.
        """
        try:
            chunk = self._read(-1, result)
        except NotFinite:
            raise
        except ActionError as error:
            raise ConfigError(str(error)) from error
        self._learn(chunk)
        return self._reported(chunk, self.execution_horizon, max(1, self._delay.steps))

    def fail(self, reason: Reason = "failed", text: str = "the policy gave no chunk") -> None:
        """The chunk in flight will never be there."""
        self._drop(self._landed().refused or reason, text)

    def interrupt(self, reason: Reason) -> None:
        """What is left of the running chunk, and the chunk in flight, belong to the past: drop both."""
        if self.remaining:
            self._drop(reason, f"{self.remaining} actions of the running chunk were left")
        self._running = None
        if self._flight is not None:
            self._flight.refused = self._flight.refused or reason

    def reset(self) -> None:
        """A new episode begins: `interrupt("reset")`, and the last command is forgotten."""
        self.interrupt("reset")
        self._last = None

    # --- the robot's side ---------------------------------------------------------------------------------------------

    def next_action(self) -> Action | None:
        """The action of this control step; None if there is none. Call it once in every control step, exactly."""
        self.skip_step()
        if not self.remaining:
            self.empty_steps += 1
            return None
        assert self._running is not None
        row = self._row
        self._row += 1
        self.carried_out += 1
        if self._flight is not None:
            self._flight.carried_out += 1
        self._last = self._running.actions[row]
        return Action(self._last.copy(), self._running.number, row, row == self._entered)

    def skip_step(self) -> None:
        """Instead of `next_action`: no action is carried out in this control step, though there are some."""
        self.steps += 1
        if self._flight is not None:
            self._flight.delay += 1

    @property
    def next_values(self) -> np.ndarray | None:
        """float64[d], what `next_action` would give; None if there is none."""
        return self._running.actions[self._row].copy() if self._running is not None and self.remaining else None

    @property
    def last_values(self) -> np.ndarray | None:
        """float64[d], what `next_action` gave last; None in a new episode."""
        return None if self._last is None else self._last.copy()

    # --- what happened ------------------------------------------------------------------------------------------------

    def report(self) -> dict[str, Any]:
        """Counts, delays and seams as plain values: a JSON document."""
        jumps = [float(np.abs(seam.jump).max()) for seam in self.seams]
        gaps = [float(np.abs(seam.gap).max()) for seam in self.seams if seam.gap is not None]
        return {
            "execution": self.way.name,
            "execution_horizon": self.execution_horizon,
            "action_horizon": self.horizon,
            "steps": self.steps,
            "empty_steps": self.empty_steps,
            "chunks": self.chunks,
            "dropped": dict(sorted(self.dropped.items())),
            "late": self.late,
            "cut_delays": self.cut_delays,
            "expected_delay": self._delay.steps,
            "delays": summary([float(delay) for delay in self.delays]),
            "seam_jumps": summary(jumps),
            "seam_gaps": summary(gaps),
            "last_problem": self.last_problem,
        }

    def copy(self) -> "ChunkQueue":
        """As it is now, for a report beside a queue that goes on."""
        copied = copy.copy(self)
        copied.dropped, copied.seams, copied.delays = self.dropped.copy(), self.seams.copy(), self.delays.copy()
        return copied

    # --- inside -------------------------------------------------------------------------------------------------------

    def _check_given_delay(self) -> None:
        d = self._delay.steps
        if self.way.holds and self._fixed and self._trained_max is not None and d > self._trained_max:
            raise ConfigError(
                f"the delay is {d} control steps, but this checkpoint was trained with delays up to "
                f"{self._trained_max}: choose execution 'rtc', a lower control rate, or fewer denoising steps"
            )

    def _learn(self, chunk: Chunk) -> None:
        horizon, width = chunk.actions.shape
        if self._max_jump is not None and self._max_jump.ndim == 1 and len(self._max_jump) != width:
            raise ConfigError(f"max_jump has {len(self._max_jump)} numbers, but the policy's actions have {width}")
        self.check_horizon(horizon)
        self.horizon, self.width = horizon, width

    def _landed(self) -> _Flight:
        if self._flight is None:
            raise RuntimeError("no chunk is in flight: observe() first")
        flight, self._flight = self._flight, None
        return flight

    def _delay_measured(self, delay: int) -> None:
        self.delays.append(delay)
        if not self._fixed:
            self._delay.add(delay)

    def _drop(self, reason: Reason, text: str) -> Reason:
        self.dropped[reason] += 1
        self.last_problem = f"{reason}: {text}"
        return reason

    def _read(self, number: int, result: Any) -> Chunk:
        shape = None if self.horizon is None or self.width is None else (self.horizon, self.width)
        return read_chunk(number, result, shape, None if self.way.mode is None else self.way.name)

    def _next_of_running(self) -> np.ndarray | None:
        """What the running chunk has for the next step."""
        if self._running is None or self._row >= len(self._running.actions):
            return None
        return self._running.actions[self._row]


def default_execution_horizon(horizon: int) -> int:
    """s, control steps, of chunks of `horizon` actions: half."""
    return max(1, horizon // 2)


def longest_delay(horizon: int, s: int) -> int:
    """The most control steps d from an observation to its chunk: d ≤ H − s, and as s is d at least, d ≤ H / 2."""
    return min(horizon - s, horizon // 2)


def _horizon(s: int) -> int:
    if isinstance(s, bool) or not isinstance(s, int | np.integer) or s < 1:
        raise ConfigError(f"the execution horizon is {s!r}; it should be a whole number of actions, from 1 to H")
    return int(s)


def summary(values: list[float]) -> dict[str, float] | None:
    """Of a list of numbers, for a report; None of an empty one."""
    if not values:
        return None
    return {
        "count": len(values),
        "mean": float(np.mean(values)),
        "median": float(np.median(values)),
        "p95": float(np.percentile(values, 95)),
        "max": max(values),
    }
