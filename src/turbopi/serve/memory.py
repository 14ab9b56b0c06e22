"""Histories of a server's robots, for a policy with memory: one for each session, or connection without one.

A history has one entry for each observation that the policy got. What came and wasn't recorded (refused, late), and
what `turbopi/step` says never came, is counted and reported in the session's next answer; an observation that is out of
order is refused, and recorded nowhere.
"""

import time
from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass, field
from typing import Any

from turbopi.realtime.messages import PREFIX, Note
from turbopi.serve.real_time import GENERATE, IDLE_SECONDS, Plan
from turbopi.support.errors import ObservationError

MOST_BYTES = 8 * 2**30  # of all histories, at least one
MOST_SUBTASKS = 4096  # robots whose subtasks are kept
OBSERVE = "observe"  # an argument of a call that records its observation alone
ALONE = {OBSERVE, GENERATE}  # calls without actions


@dataclass
class _Robot:
    """requests: of its episode, that are answered; reported: missed observations, in the last answer."""

    history: Any
    connection: Hashable
    used: float = 0.0
    requests: int = 0
    reported: int = 0
    first_step: int | None = None
    last_step: int | None = None
    running: bool = False


@dataclass
class Remembered:
    """A request's part of a session: the robot, and how many observations were recorded before it."""

    robot: _Robot
    before: int
    missed: int = 0
    key: Hashable = field(default=None)


class Histories:
    """For the event loop's thread alone; the policy records on its own thread, one observation of a robot at a time.

    make     a new, empty history: `UnifiedPolicy.new_history`
    entries  bytes of a history with all of its entries; None: it holds a subtask, and nothing is missed
    """

    def __init__(
        self,
        make: Callable[[], Any],
        entries: int | None,
        clock: Callable[[], float] = time.monotonic,
        most: int = MOST_BYTES,
    ) -> None:
        self._make, self._clock, self._counts = make, clock, entries is not None
        self.most = max(1, most // max(1, entries)) if entries is not None else MOST_SUBTASKS  # robots
        self._robots: dict[Hashable, _Robot] = {}  # by session's name, or ("connection", connection)

    def begin(self, plan: Plan, connection: Hashable) -> None:
        """Give a request's call the history of its robot. Raises ObservationError for one that is out of order."""
        requested, now = plan.requested, self._clock()
        key: Hashable = requested.session or ("connection", connection)
        robot = self._robots.get(key)
        if robot is None:
            self._make_room(now)
            robot = _Robot(self._make(), connection)
        if robot.running:
            raise ObservationError(
                f"session {requested.session!r} has a request that isn't answered yet: give each robot its own session"
            )
        if requested.reset:
            robot = _Robot(self._make(), connection)
        step, last = requested.step, robot.last_step
        if robot.requests and (step is None) != (robot.first_step is None):
            raise ObservationError(
                f"{PREFIX}step came in some requests of this episode and not in others: send it always or never "
                f"({PREFIX}reset begins a new one)"
            )
        if step is not None and last is not None and step <= last:
            raise ObservationError(
                f"{PREFIX}step is {step}, after {last} in an observation that is recorded already: this one is late or "
                f"out of order, and isn't recorded. For a new episode send {PREFIX}reset"
            )
        robot.running, robot.used, robot.connection = True, now, connection
        self._robots[key] = robot
        plan.arguments["history"] = robot.history
        if requested.observe:
            plan.arguments[OBSERVE] = True
        plan.remembered = Remembered(robot, robot.history.observations, key=key)

    def release(self, plan: Plan) -> None:
        """The request has its answer, or a refusal."""
        if (one := plan.remembered) is None:
            return
        robot, step = one.robot, plan.requested.step
        robot.running = False
        robot.requests += 1
        if robot.history.observations > one.before:
            robot.first_step = step if robot.first_step is None else robot.first_step
            robot.last_step = step
        came = robot.requests if step is None or robot.first_step is None else step - robot.first_step + 1
        one.missed = max(0, came - robot.history.observations)
        if not robot.history.observations and self._robots.get(one.key) is robot:
            del self._robots[one.key]  # refused requests, however many and of any name, take no room

    def finish(self, plan: Plan, answer: Mapping[str, Any]) -> tuple[dict[str, Any], Note | None]:
        """The answer with what was recorded, and a note if observations were missed since the last answer."""
        one = plan.remembered
        assert one is not None
        if not self._counts:
            return dict(answer), None
        robot, more = one.robot, one.missed - one.robot.reported
        robot.reported = one.missed
        seen = robot.history.observations
        found = {**answer, "memory": {"observations": seen, "missed": one.missed}}
        if more <= 0:
            return found, None
        text = (
            f"{more} observations of this episode were missed before this one ({one.missed} in all, {seen} recorded): "
        )
        text += "the frames that the policy remembers are further apart than in training"
        return found, Note("memory", (), text)

    def closed(self, connection: Hashable) -> None:
        """A connection has ended, and its own history with it."""
        self._robots.pop(("connection", connection), None)
        for robot in self._robots.values():
            if robot.connection == connection:
                robot.connection = None

    def _make_room(self, now: float) -> None:
        for key, robot in tuple(self._robots.items()):
            if robot.connection is None and not robot.running and now - robot.used > IDLE_SECONDS:
                del self._robots[key]
        if len(self._robots) >= self.most:
            raise ObservationError(
                f"this server keeps the histories of at most {self.most} robots, and has so many: end a connection, or "
                f"wait {IDLE_SECONDS:g} s after that of a session has ended"
            )
