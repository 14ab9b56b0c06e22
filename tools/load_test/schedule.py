"""When requests are due, and what is noted of each."""

import random
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, Protocol

Arrivals = Literal["closed", "fixed", "poisson"]
ERROR_PAUSE = 0.1  # seconds that a closed-loop client waits after an error: a robot would, and a flood measures nothing


class Refused(Exception):
    """No actions; the argument is the kind of the error."""


class Connection(Protocol):
    """One client of a server, which connects anew by itself."""

    def infer(self, observation: Mapping[str, Any]) -> Mapping[str, Any]:
        """The answer. Raises Refused."""
        ...


class Request(NamedTuple):
    """What became of one request; times in seconds from the beginning of the run.

    due       when it should be sent; in a closed loop when it was
    free      when the connection could have sent it: not before `due`, nor while the request before it went on
    sent      when it was
    ended     when its answer, or an error, was there; None: it wasn't sent before the end
    infer_ms  that the server says, if it does
    error     its kind
    """

    due: float
    free: float
    sent: float | None
    ended: float | None
    infer_ms: float | None
    error: str | None


@dataclass(frozen=True)
class Clock:
    """now() in seconds from the beginning of the run, and a sleep."""

    now: Callable[[], float]
    sleep: Callable[[float], None]


def due_times(arrivals: Arrivals, rate: float, seconds: float, index: int, clients: int, seed: int) -> Iterator[float]:
    """When client `index` of `clients` sends, if all of them together send `rate` requests a second.

    fixed    the clients in turn, at equal distances
    poisson  each at random, independently: then all together are a Poisson process, too
    """
    if arrivals == "fixed":
        count = 0
        while (due := (index + count * clients) / rate) < seconds:
            yield due
            count += 1
    else:
        generator = random.Random(f"{seed} {index}")
        due = generator.expovariate(rate / clients)
        while due < seconds:
            yield due
            due += generator.expovariate(rate / clients)


def closed_loop(
    connection: Connection, observations: Sequence[Mapping[str, Any]], seconds: float, clock: Clock
) -> Iterator[Request]:
    """A client that sends its next request as soon as it has the answer to the one before; one at least."""
    count = 0
    while (now := clock.now()) < seconds or not count:
        request = _send(connection, observations[count % len(observations)], now, now, clock)
        count += 1
        yield request
        if request.error is not None:
            clock.sleep(ERROR_PAUSE)


def open_loop(
    connection: Connection, observations: Sequence[Mapping[str, Any]], due: Iterator[float], end: float, clock: Clock
) -> Iterator[Request]:
    """A client that sends when requests are due, whether or not the server keeps up.

    A connection has one request at a time, so one that is due meanwhile is sent late. Its latency still begins when it
    was due: who counted from the sending would leave out the time for which a slow server kept it waiting ("coordinated
    omission"). What isn't sent at `end` is noted as such.
    """
    for count, moment in enumerate(due):
        now = clock.now()
        free = max(moment, now)
        if free >= end:
            yield Request(moment, free, None, None, None, None)
            continue
        if moment > now:
            clock.sleep(moment - now)
        yield _send(connection, observations[count % len(observations)], moment, free, clock)


def _send(connection: Connection, observation: Mapping[str, Any], due: float, free: float, clock: Clock) -> Request:
    sent = clock.now()
    infer_ms, error = None, None
    try:
        timing = connection.infer(observation).get("server_timing")
        if isinstance(timing, Mapping) and isinstance(timing.get("infer_ms"), float | int):
            infer_ms = float(timing["infer_ms"])
    except Refused as refused:
        error = str(refused)
    return Request(due, free, sent, clock.now(), infer_ms, error)
