"""How soon a request wants its answer, and for whom: optional keys of a message, which the policy never sees.

docs/serving_sessions.md has them as a table.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from turbopi.realtime.messages import MAX_STEP, PREFIX, SCHEDULING_KEYS, as_number
from turbopi.serve.options import MAX_CONTROL_HZ, MAX_DEADLINE_MS
from turbopi.serve.scheduling.schedule import PRIORITIES, Priority
from turbopi.support.errors import ObservationError

MAX_ROWS = 1024


@dataclass(frozen=True)
class Urgency:
    """What a message says of it.

    within    seconds from its arrival to its answer
    firm      the client gave this deadline: a request that can't meet it is refused. False: it is the server's default,
              for which nothing is refused
    priority  robots come before simulators
    rows      B of a batch message; None: one observation, without a batch axis
    """

    within: float
    firm: bool = False
    priority: Priority = "robot"
    rows: int | None = None


def read_urgency(received: Mapping[str, Any], default_ms: float, control_hz: float | None = None) -> Urgency:
    """What a message says, or doesn't. Raises ObservationError for what can't be meant.

    default_ms  the deadline of a message that says none
    control_hz  of robots that don't say it; None: unknown
    """
    given = {key: received[PREFIX + key] for key in SCHEDULING_KEYS if PREFIX + key in received}
    if not given:
        return Urgency(default_ms / 1e3)
    rows = _whole(given, "batch", 1, MAX_ROWS)
    priority = given.get("priority", "robot" if rows is None else "simulator")
    if not isinstance(priority, str) or priority not in PRIORITIES:
        raise ObservationError(f"{PREFIX}priority is {priority!r:.100}; it should be one of {', '.join(PRIORITIES)}")
    within = _deadline(given, control_hz)
    return Urgency(default_ms / 1e3 if within is None else within, within is not None, priority, rows)


def check_batch(received: Mapping[str, Any], joins: bool) -> None:
    """Raise ObservationError for a batch message that asks for what a batch can't have.

    joins  the server joins the chunks of plain requests
    """
    others = [key for key in received if key.startswith(PREFIX) and key.removeprefix(PREFIX) not in SCHEDULING_KEYS]
    if others:
        raise ObservationError(
            f"{PREFIX}batch and {others[0]} were both given: a batch of observations joins no chunks and has no "
            "session. Send such observations one by one"
        )
    if joins:
        raise ObservationError(
            f"{PREFIX}batch came to a server that joins each client's chunks (--execution): a batch joins none. Send "
            "the observations one by one, or to a server without --execution"
        )


def _deadline(given: Mapping[str, Any], control_hz: float | None) -> float | None:
    """Seconds; None if the message says nothing of it."""
    if "deadline_ms" in given:
        for other in ("left", "control_hz"):
            if other in given:
                raise ObservationError(f"{PREFIX}deadline_ms and {PREFIX}{other} were both given: one deadline will do")
        milliseconds = _number(given, "deadline_ms", MAX_DEADLINE_MS)
        if milliseconds <= 0:
            raise ObservationError(
                f"{PREFIX}deadline_ms is {milliseconds:g}: that has passed when the request comes. It should be the "
                f"milliseconds from its arrival to its answer, more than 0 and at most {MAX_DEADLINE_MS:g}"
            )
        return milliseconds / 1e3
    hz = _number(given, "control_hz", MAX_CONTROL_HZ) if "control_hz" in given else control_hz
    if "control_hz" in given and (hz is None or hz <= 0):
        raise ObservationError(f"{PREFIX}control_hz is {hz:g}; it should be more than 0")
    if "left" not in given:
        if "control_hz" in given:
            raise ObservationError(
                f"{PREFIX}control_hz came without {PREFIX}left, the actions that the robot has left to carry out"
            )
        return None
    left = _whole(given, "left", 0, MAX_STEP)
    assert left is not None
    if hz is None:
        raise ObservationError(
            f"{PREFIX}left came without {PREFIX}control_hz, the actions that the robot carries out in a second"
        )
    if left == 0:
        raise ObservationError(
            f"{PREFIX}left is 0, so the deadline has passed when the request comes: a robot that has nothing left to "
            "carry out leaves the key out"
        )
    return min(left / hz, MAX_DEADLINE_MS / 1e3)


def _number(given: Mapping[str, Any], key: str, most: float) -> float:
    value = as_number(given[key])
    if value is None or not -MAX_STEP <= value <= most:  # NaN isn't, nor a whole number too large for a float
        shown = f"{PREFIX}{key} is {given[key]!r:.100}"
        raise ObservationError(f"{shown}; it should be a number, more than 0 and at most {most:g}")
    return float(value)


def _whole(given: Mapping[str, Any], key: str, least: int, most: int) -> int | None:
    if key not in given:
        return None
    value = as_number(given[key])
    if not isinstance(value, int) or not least <= value <= most:
        shown = f"{PREFIX}{key} is {given[key]!r:.100}"
        raise ObservationError(f"{shown}; it should be a whole number from {least} to {most}")
    return value
