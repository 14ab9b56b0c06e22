"""The executor: observations in from any thread, one command out in every control step, the policy beside it."""

import logging
import math
import threading
import time
from collections import deque
from collections.abc import Callable, Collection, Mapping
from concurrent.futures import Future
from dataclasses import asdict
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, get_args

import numpy as np

from turbopi.config import Schedule
from turbopi.realtime import ChunkQueue, DelayEstimate, Execution, Seam, way_named
from turbopi.realtime.inference import BackgroundThread, Inference
from turbopi.realtime.journal import Command, Inferred, Journal, Kind, OutOfActions
from turbopi.realtime.messages import PREFIX, notes_in
from turbopi.realtime.policies import check_policy, server_joins
from turbopi.realtime.queue import OLD_WEIGHT, summary
from turbopi.realtime.running_chunk import RunningChunk
from turbopi.realtime.settings import above_zero, checked_hold_action, checked_note_kinds, held_values
from turbopi.realtime.warm_up import expected_delay, warm_policy
from turbopi.support.errors import ConfigError

logger = logging.getLogger(__name__)

OnEmpty = Literal["hold", "slow_down", "raise"]
MAX_CONTROL_HZ = 10_000
_HELD_S = 0.5  # that the robot holds until the log says so


class RealTimeExecutor:
    """Runs a policy's chunks at a control rate, by one of the ways to run (docs/real_time.md).

    policy             a UnifiedPolicy, turbopi.realtime.RealTimeClient, openpi's WebsocketClientPolicy, or whatever has
                       `infer(observation)`. The executor alone calls it, on a thread of its own
    control_hz         how often the control loop calls `next_action`, times a second
    execution          "sync", "async", "ensemble", "rtc", "rtc_identity", "rtc_trained", "warm_start" or "paint"
    execution_horizon  actions of a chunk after which the next observation is used. None: half of a chunk
    on_empty           what happens when the policy is late and there is no action for a step
                         "hold"       `next_action` gives a command of kind "held", with `hold_action`
                         "slow_down"  once the policy is later than expected, the robot goes half as fast through the
                                      actions that are left, by commands half way between them; then "hold".
                                      For absolute positions alone: half way between two velocities is no such thing
                         "raise"      OutOfActions. Standing still is a part of "sync", and so is waiting for the
                                      first chunk: there, once it takes longer than `max_observation_age_s`, whatever
                                      the reason (the first warm-up may take longer, until it fails)
    hold_action        the action of commands that hold. None: none at all, the robot's controller keeps its place.
                       "last": the last command once more, right for absolute positions and nothing else. An array
                       [d]: this one, such as zeros for velocities; where it is NaN, as the last command (a gripper)
    max_observation_age_s
                       older observations are refused, and chunks whose observation has become older meanwhile
    max_pause_s        a longer time between two calls of `next_action`, or a clock that goes back, is a jump of the
                       clock: all actions belong to the past and are dropped. None: 0.5 s, or 10 steps if that is more
    max_jump           the most that a command may move in one step, in the robot's units (`ChunkQueue`)
    hold_on            kinds of notes (docs/safety.md), such as ["camera_black"]: a chunk with one is dropped
    delay_percentile, delay_window
                       the delay to expect is this percentile of so many last ones
    infer_arguments    what else `policy.infer` is given in every call, such as {"num_steps": 5}
    old_weight         "ensemble": the running chunk's part of the mean, 0 to 1
    schedule, max_guidance_weight
                       of "rtc" and "rtc_identity", as in `RunningChunk`. None: the policy's
    clock, inference   seconds that never go back, and the thread that calls the policy: for tests

    Raises ConfigError for what can't be right, and for a policy that doesn't offer the way to run. `observe`,
    `next_action`, `reset`, `report` may be called from different threads.
    """

    def __init__(
        self,
        policy: Any,
        *,
        control_hz: float,
        execution: Execution = "rtc",
        execution_horizon: int | None = None,
        on_empty: OnEmpty = "hold",
        hold_action: Literal["last"] | np.ndarray | None = None,
        max_observation_age_s: float = 1.0,
        max_pause_s: float | None = None,
        max_jump: float | np.ndarray | None = None,
        hold_on: Collection[str] = (),
        delay_percentile: float = 95.0,
        delay_window: int = 50,
        infer_arguments: Mapping[str, Any] | None = None,
        old_weight: float = OLD_WEIGHT,
        schedule: Schedule | None = None,
        max_guidance_weight: float | None = None,
        clock: Callable[[], float] = time.monotonic,
        inference: Inference | None = None,
    ) -> None:
        self._hz = above_zero("control_hz", control_hz, MAX_CONTROL_HZ)
        if on_empty not in get_args(OnEmpty):
            raise ConfigError(f"on_empty is {on_empty!r}; choose one of {', '.join(get_args(OnEmpty))}")
        self._on_empty = on_empty
        self._hold = checked_hold_action(hold_action, on_empty)
        self._max_age = above_zero("max_observation_age_s", max_observation_age_s)
        pause = max(0.5, 10 / self._hz) if max_pause_s is None else max_pause_s
        self._max_pause = above_zero("max_pause_s", pause)
        self._hold_on = checked_note_kinds(hold_on)
        self._way = way_named(execution)
        self._policy = policy
        self._offered = check_policy(policy, self._way)
        self._server_joins = server_joins(self._offered) and self._way.mode is None
        if infer_arguments is not None and not isinstance(infer_arguments, Mapping):
            raise ConfigError(f"infer_arguments is {infer_arguments!r}; it should be a mapping, such as num_steps to 5")
        self._arguments = dict(infer_arguments or {})
        self._clock = clock
        self._delays = DelayEstimate(percentile=delay_percentile, window=delay_window)
        self._queue = ChunkQueue(
            execution,
            execution_horizon=execution_horizon,
            delay=self._delays,
            trained_max_delay=self._offered.get("trained_max_delay"),
            max_jump=max_jump,
            old_weight=old_weight,
            schedule=schedule,
            max_guidance_weight=max_guidance_weight,
            policys_guidance=execution_horizon is None and self._offered.get("execution_horizon") is not None,
        )
        self._lock = threading.Lock()
        self._inference = BackgroundThread() if inference is None else inference
        self._journal = Journal()
        self._pending: tuple[Future[Any], float] | None = None  # the running call, and when its observation was taken
        self._warming: Future[Any] | None = None
        self._warm_seconds: float | None = None
        self._broken: ConfigError | None = None  # found by a warm-up that nobody waited for
        self._closed = False
        self._fresh_at: deque[float] = deque(maxlen=1024)  # when actions were given out
        self._anew_at = -math.inf  # when all actions were dropped last: of what was there before, nothing is known
        self._called_at: float | None = None  # the last call of next_action
        self._empty_at: float | None = None  # the first control step without an action since the last one with one
        self._held_since: float | None = None  # if the log has said that the robot holds
        self._stretched = False  # the last command was "slowed"
        self._anew = True  # a server that keeps the running chunk must forget it
        self._kept_at: int | None = None  # which one that is: actions before its observation
        self.last_error: BaseException | None = None  # what the policy raised last
        self._failing: str | None = None  # its text, until the policy answers again

    # --- the policy ---------------------------------------------------------------------------------------------------

    def warm_up(self, observation: Mapping[str, Any]) -> float:
        """Bring the policy to full speed with an observation, whose chunks nobody carries out. Returns the seconds.

        It waits, so call it before the robot moves. Without it the first observation warms up in the background, and
        commands are "waiting" until then. The time that the policy takes here is no measured delay; that of its last
        calls is the first one to expect. Raises what the policy raises, and ConfigError if the delay can't fit.
        """
        with self._lock:
            self._check_usable()
            if self._pending is not None or self._warming is not None:
                raise ConfigError("the policy is computing: warm up before the first observation")
            warming = self._warming = self._inference.begin(lambda: self._warm(observation))
        try:
            warming.result()
        finally:
            with self._lock:
                self._warming = None
        assert self._warm_seconds is not None
        return self._warm_seconds

    def _warm(self, observation: Mapping[str, Any]) -> None:
        """On the policy's thread."""
        began = self._clock()
        seconds = warm_policy(
            self._policy, self._message(observation), self._arguments, self._way, self._learn, self._clock
        )
        with self._lock:
            assert self._queue.horizon is not None
            delay = expected_delay(
                seconds,
                self._hz,
                way=self._way,
                horizon=self._queue.horizon,
                s=self._queue.execution_horizon,
                trained_max=self._trained_max,
                max_age_s=self._max_age,
            )
            self._delays.begin(delay)
            self._warm_seconds = self._clock() - began
            self._empty_at = None
            self._answers()

    def _learn(self, result: Any) -> RunningChunk | None:
        """What the first answer of a warm-up shows. Raises ConfigError."""
        with self._lock:
            previous = self._queue.learn(result)
            width = self._queue.width
        if isinstance(self._hold, np.ndarray) and len(self._hold) != width:
            raise ConfigError(f"hold_action has {len(self._hold)} numbers, but the policy's actions have {width}")
        return previous

    @property
    def _trained_max(self) -> int | None:
        most = self._offered.get("trained_max_delay")
        return None if most is None else int(most)

    def _message(self, observation: Mapping[str, Any], step: int | None = None) -> Mapping[str, Any]:
        """The observation, with what a server that keeps the running chunk itself needs to know.

        step  actions before the observation; None: of a warm-up
        """
        if not self._server_joins:
            return observation
        if step is None:
            return {**observation, f"{PREFIX}reset": True, f"{PREFIX}step": 0}
        s, delay = self._queue.execution_horizon, self._queue.expected_delay
        if self._kept_at is not None and self._queue.horizon is not None:
            delay = max(0, min(delay, self._queue.horizon - max(s, step - self._kept_at)))
        if self._offered["execution"] == "rtc_trained" and self._trained_max is not None:
            delay = min(delay, self._trained_max)
        reported = {"reset": self._anew, "step": step, "delay": delay, "execution_horizon": s}
        return {**observation, **{PREFIX + key: value for key, value in reported.items()}}

    # --- the robot ----------------------------------------------------------------------------------------------------

    def observe(self, observation: Mapping[str, Any], taken_at: float | None = None) -> bool:
        """Give an observation, from any thread, as often as there is one. Whether a chunk is computed from it.

        It is used if one is wanted just now: then the policy begins with it, so don't change it any more. `taken_at`,
        on the executor's clock (time.monotonic), is when it was taken; None: now. Observations older than
        `max_observation_age_s` are refused and counted; so are those from the future. One that was taken before the
        running chunk took over isn't used, as it shows nothing of it; nor is one from before the last `reset`, or the
        last jump of the clock.
        """
        with self._lock:
            self._check_usable()
            now = self._clock()
            self._take_answer(now)
            seen = self._journal.observations
            seen["given"] += 1
            age = 0.0 if taken_at is None else now - taken_at
            if not -1 / self._hz <= age <= self._max_age:  # NaN, too
                seen["from the future" if age < 0 else "stale"] += 1
                return False
            if self._warm_seconds is None:
                self._warm_in_background(observation)
                return False
            if not self._queue.wants_observation or self._pending is not None:
                seen["not wanted yet"] += 1
                return False
            if taken_at is not None and taken_at < self._anew_at:
                seen["before it began anew"] += 1
                return False
            ago = 0 if taken_at is None else sum(moment > taken_at for moment in self._fresh_at)
            if ago > self._queue.oldest_useful:
                seen["before the running chunk"] += 1
                return False
            seen["used"] += 1
            request = self._queue.observe(ago)
            message = self._message(observation, request.carried_out)
            self._anew, self._kept_at = False, request.carried_out
            arguments = {**self._arguments, **request.arguments}
            self._journal.inferred.append(Inferred(request.number, request.step))
            future = self._inference.begin(lambda: self._timed(message, arguments))
            self._pending = (future, now - age)
            return True

    def next_action(self) -> Command:
        """The command of this control step; call it once in each, at `control_hz`. Never waits for the policy.

        Raises OutOfActions with on_empty="raise", and ConfigError if the warm-up in the background found that this
        policy can't be run in this way.
        """
        with self._lock:
            self._check_usable()
            now = self._clock()
            self._look_at_clock(now)
            self._take_answer(now)
            step = self._queue.steps
            command = self._slowed() or self._fresh(now) or self._empty(now)
            self._journal.command(step, command)
            return command

    def reset(self) -> None:
        """A new episode: what is left of the last one is dropped, and its answer, should it still come."""
        with self._lock:
            self._queue.reset()
            self._called_at = self._empty_at = self._held_since = None
            self._stretched = False
            self._begin_anew(self._clock())

    @property
    def wants_observation(self) -> bool:
        """Whether an observation may be used at the next control step: images need be taken only then.

        Also true while a chunk is computed, as nobody knows when it comes, and whether it can be used.
        """
        with self._lock:
            return self._warm_seconds is None or self._pending is not None or self._queue.wants_observation

    @property
    def remaining(self) -> int:
        """Actions that are left. After so many control steps there is none, if the policy doesn't answer."""
        with self._lock:
            return self._queue.remaining

    # --- the end ------------------------------------------------------------------------------------------------------

    @property
    def seams(self) -> list[Seam]:
        """Where chunks took over, oldest first: the last thousands of them."""
        with self._lock:
            return list(self._queue.seams)

    @property
    def inferred(self) -> list[Inferred]:
        """What became of each observation that a chunk was asked for, oldest first: the last thousands of them."""
        with self._lock:
            return list(self._journal.copy().inferred)

    def report(self, plot: str | Path | None = None) -> dict[str, Any]:
        """What happened, as plain values (a JSON document); with `plot`, an image of it is written there, too.

        The image needs matplotlib. Raises ConfigError for an unknown ending, OutputError if it can't be written.
        """
        with self._lock:  # the control loop may wait for it: only copies are made here
            queue, journal = self._queue.copy(), self._journal.copy()
        latencies = journal.latencies_ms
        document = {
            **queue.report(),
            "control_hz": self._hz,
            "commands": dict(sorted(journal.kinds.items())),
            "observations": dict(sorted(journal.observations.items())),
            "clock_jumps": journal.clock_jumps,
            "notes": [asdict(one) for one in journal.notes.values()],
            "remaining": queue.remaining,
            "waited": queue.waited,
            "latency_ms": summary(list(latencies)),
            "warm_up_seconds": self._warm_seconds,
            "last_error": None if self.last_error is None else _named(self.last_error),
        }
        if plot is not None:
            from turbopi.realtime.plot import plot_run

            plot_run(Path(plot), journal, document)
        return document

    def close(self, timeout_s: float = 5.0) -> bool:
        """Take no more observations. Whether the running call of the policy ended within `timeout_s`.

        The policy stays open: it is its maker's. Commands after this raise ConfigError.
        """
        with self._lock:
            self._closed = True
        return self._inference.close(timeout_s)

    def __enter__(self) -> "RealTimeExecutor":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    # --- inside, under the lock ---------------------------------------------------------------------------------------

    def _check_usable(self) -> None:
        if self._closed:
            raise ConfigError("this executor is closed: make a new one")
        if self._warming is not None and self._warming.done():
            error = self._warming.exception()
            self._warming = None
            if isinstance(error, ConfigError):
                self._broken = error
            elif error is not None:
                self._failed(error)
        if self._broken is not None:
            raise self._broken

    def _warm_in_background(self, observation: Mapping[str, Any]) -> None:
        self._journal.observations["warm-up"] += 1
        if self._warming is None:
            self._warming = self._inference.begin(lambda: self._warm(observation))

    def _timed(self, message: Mapping[str, Any], arguments: dict[str, Any]) -> tuple[Any, float]:
        """On the policy's thread: its answer, and the seconds that it took."""
        began = self._clock()
        return self._policy.infer(message, **arguments), self._clock() - began

    def _look_at_clock(self, now: float) -> None:
        before, self._called_at = self._called_at, now
        if before is not None and not 0 <= now - before <= self._max_pause:
            self._journal.clock_jumps += 1
            self._queue.interrupt("clock_jump")
            self._empty_at = None
            self._begin_anew(now)
            logger.warning("%.3f s between two control steps: the actions that were left are dropped", now - before)

    def _begin_anew(self, now: float) -> None:
        """Observations from before show another episode, or a robot that has moved since: how far, nobody knows."""
        self._anew, self._anew_at = True, now
        self._fresh_at.clear()  # after a jump they are moments of the clock before

    def _take_answer(self, now: float) -> None:
        """Hand the policy's answer to the queue, if it is there."""
        if self._pending is None or not self._pending[0].done():
            return
        (future, taken_at), self._pending = self._pending, None
        entry = self._journal.inferred[-1]
        error = future.exception()
        if error is not None:
            self._failed(error)
            self._queue.fail("failed", _named(error))
            entry.outcome = "failed"
        else:
            result, seconds = future.result()
            self._answers()
            self._journal.latencies_ms.append(seconds * 1e3)
            self._journal.note(entry.chunk, result)
            if now - taken_at > self._max_age:
                self._queue.fail("stale", f"its observation is {now - taken_at:.3f} s old")
                entry.outcome = "stale"
            elif noted := [note for note in notes_in(result) if note.kind in self._hold_on]:
                self._queue.fail("noted", noted[0].text)
                entry.outcome = "noted"
            else:
                entry.outcome = self._queue.arrive(result) or "used"
        self._anew = self._anew or entry.outcome != "used"  # the server takes every chunk for carried out
        entry.ended = self._queue.steps
        if entry.outcome not in ("used", "failed"):
            logger.warning("chunk %d was dropped: %s", entry.chunk, self._queue.last_problem)

    def _failed(self, error: BaseException) -> None:
        if str(error) != self._failing:
            logger.warning("the policy failed: %s", _named(error))
        self.last_error, self._failing = error, str(error)

    def _answers(self) -> None:
        if self._failing is not None:
            logger.warning("the policy answers again")
        self._failing = None

    def _slowed(self) -> Command | None:
        """A command half way to the next action, before every action as long as the policy is late."""
        late = self._queue.waited > max(self._queue.expected_delay, 1)
        if self._on_empty != "slow_down" or self._way.stands_still or not late or self._stretched:
            return None
        following, last = self._queue.next_values, self._queue.last_values
        if following is None or last is None:
            return None
        self._stretched = True
        self._queue.skip_step()
        return Command("slowed", (last + following) / 2, self._queue.remaining)

    def _fresh(self, now: float) -> Command | None:
        self._stretched = False
        action = self._queue.next_action()
        if action is None:
            return None
        self._fresh_at.append(now)
        if self._held_since is not None:
            logger.warning("the robot moves again, after %.1f s", now - self._held_since)
        self._empty_at = self._held_since = None
        return Command("fresh", action.values, self._queue.remaining, action.chunk, action.row, action.takes_over)

    def _empty(self, now: float) -> Command:
        last = self._queue.last_values
        kind: Kind = "waiting" if last is None else "held"
        if self._empty_at is None:
            self._empty_at = now
        if self._on_empty == "raise" and not self._may_wait(now, self._empty_at):
            step = self._queue.steps - 1
            text = f"no action for control step {step}: {self._why_empty()}; the robot must stop now"
            raise OutOfActions(text) from self.last_error
        moves = kind == "held" and not self._way.stands_still
        if moves and self._held_since is None and now - self._empty_at >= _HELD_S:
            self._held_since = self._empty_at
            logger.warning("the robot holds: %s", self._why_empty())
        return Command(kind, held_values(self._hold, last), 0)

    def _may_wait(self, now: float, since: float) -> bool:
        """Whether standing still is right for now, with no action `since` then."""
        if self._queue.last_values is not None and not self._way.stands_still:
            return False
        first_warm_up = self._warm_seconds is None and self.last_error is None  # it may compile
        return first_warm_up or now - since <= self._max_age

    def _why_empty(self) -> str:
        if self._warm_seconds is None and self.last_error is not None:
            return f"the warm-up failed ({_named(self.last_error)})"
        waited, expected, problem = self._queue.waited, self._queue.expected_delay, self._queue.last_problem
        if self._pending is not None and (waited > expected or not problem):
            return f"the policy has been computing for {waited} control steps, expected were {expected}"
        if problem:
            return f"the last chunk was dropped ({problem})"
        return "no observation came in time"


def _named(error: BaseException) -> str:
    return f"{type(error).__name__}: {error}"
