"""What a client may cost. The numbers are in docs/dev/serving.md; robots never come near them.

Two things are shared by all connections and so need a fair share for each: the event loop's time (`Credit`) and
memory (`MemoryBudget`). Everything else is a deadline or a count, in connection.py and listener.py.
"""

import os
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

SPARE_CONNECTIONS = (
    32  # beyond the clients: health checks, metrics, watchers, clients that are refused as the server is full
)
SPARE_DESCRIPTORS = 64  # for everything else that the process opens


@dataclass(frozen=True)
class Limits:
    """Limits of one server.

    clients            connected at once; more are refused with HTTP 503
    message_bytes      of one message
    memory_bytes       of all messages that are received, wait or are computed, without the first `free_bytes` of each
    free_bytes         of each message that need no share: robots' images don't wait for another client's large messages
    memory_seconds     to wait for a share of that memory
    handshake_seconds  from the connection to the end of its HTTP request
    message_seconds    in which a message that has begun must end, or bring `bytes_per_second` of each
    write_seconds      in which a client must take what is sent to it
    close_seconds      from the end of a conversation to the end of the connection, whatever the client does
    work_burst         work that a connection may cause at once without getting actions for it. A message is 1, and 1
                       more for each 64 KiB and each 0.25 ms of decoding, and 3 more if it is bad; a ping is 1, a
                       continued frame 0.1; a request that gets actions is free
    work_rate          such work a second that is allowed on and on
    work_total_rate    the same for all connections that are slowed, together
    bad_messages       in a row, after which a connection is closed
    connections_rate   new connections a second
    shared_memory      clients on this host that send through memory, 8 MB each; the others' messages take the socket
    watchers           of the server's page and its feed at once; they take no client's place
    """

    clients: int = 256
    message_bytes: int = 64 * 2**20
    memory_bytes: int = 256 * 2**20
    free_bytes: int = 4 * 2**20
    memory_seconds: float = 30.0
    handshake_seconds: float = 10.0
    message_seconds: float = 10.0
    bytes_per_second: float = 100e3
    write_seconds: float = 30.0
    close_seconds: float = 5.0
    work_burst: float = 250.0
    work_rate: float = 200.0
    work_total_rate: float = 800.0
    bad_messages: int = 1000
    connections_rate: float = 50.0
    shared_memory: int = 16
    watchers: int = 4


def limits_for(max_message_mb: float, max_clients: int, others: Limits | None) -> Limits:
    """The limits of a server's options; `others`, if given, has the rest."""
    size = int(max_message_mb * 2**20)
    limits = Limits(memory_bytes=max(Limits.memory_bytes, 4 * size)) if others is None else others
    return replace(limits, clients=max_clients, message_bytes=size)


class WorkPool:
    """The rate of work that slowed connections share, and how long new connections wait.

    A client that leaves when it is slowed and connects again would never be slowed. So work that led to nothing is
    counted, and leaks away at `total_rate`. A new connection waits until all has leaked; connections that are there
    already don't.

    total_rate  work a second
    """

    LONGEST_WAIT = 5.0  # seconds; not more, as who waits takes a client's place
    NEWCOMER = 30.0  # work that a newcomer is expected to waste while others do

    def __init__(self, total_rate: float, clock: Callable[[], float] = time.monotonic) -> None:
        self.total_rate, self._clock = total_rate, clock
        self.slowed = 0
        self._wasted, self._at = 0.0, clock()

    def waste(self, work: float) -> None:
        """Count work that led to no actions."""
        self._leak()
        self._wasted = min(self._wasted + work, self.LONGEST_WAIT * self.total_rate)

    def newcomers_wait(self) -> float:
        """Seconds until the first message of a connection that begins now is read. Call it once for each."""
        self._leak()
        wait = self._wasted / self.total_rate
        if wait > 0:
            self.waste(self.NEWCOMER)
        return wait

    def _leak(self) -> None:
        now = self._clock()
        self._wasted, self._at = max(0.0, self._wasted - (now - self._at) * self.total_rate), now

    def share(self) -> float:
        """Work a second that one slowed connection may cause."""
        return self.total_rate / max(self.slowed, 1)


class Credit:
    """The work that a connection may still cause: what it does is spent at once, and comes back at `rate` a second.

    Spending may lead below zero: then it is `spent`, and `wait` says for how long nothing more should be read.
    """

    FIRST = 1 / 25  # of the burst: who reconnects again and again gains nothing. Enough to take a robot's first request
    BATCH = 4.0  # work to wait for at least, so that a slowed connection doesn't wake the loop for each frame

    def __init__(self, limits: Limits, pool: WorkPool, clock: Callable[[], float] = time.monotonic) -> None:
        self._burst, self._rate, self._pool, self._clock = limits.work_burst, limits.work_rate, pool, clock
        self._level, self._at = limits.work_burst * self.FIRST, clock()
        self._opens = self._at + pool.newcomers_wait()
        self._slowed = False

    @property
    def slowed(self) -> bool:
        """Whether it caused more work without getting actions than is allowed on and on."""
        return self._slowed

    @property
    def spent(self) -> bool:
        """Whether nothing more should be read now."""
        return self._level <= 0 or self._clock() < self._opens

    def spend(self, work: float) -> None:
        self._level -= work

    def give_back(self, work: float) -> None:
        self._level = min(self._burst, self._level + work)

    def refill(self) -> None:
        """Count what has come back meanwhile."""
        now = self._clock()
        rate = self._current_rate() if self._slowed else self._rate
        self._level = min(self._burst, self._level + (now - self._at) * rate)
        self._at = now
        if self._slowed and self._level >= self._burst / 5:  # not at once: it would never share
            self._set_slowed(False)

    def wait(self) -> float:
        """Seconds until there is credit again, if it is all spent."""
        if (opens_in := self._opens - self._clock()) > 0:
            return opens_in
        self._set_slowed(True)
        return (self.BATCH - self._level) / self._current_rate()

    def close(self) -> None:
        """The connection has ended, and shares the pool's rate no more."""
        self._set_slowed(False)

    def _current_rate(self) -> float:
        return min(self._rate, self._pool.share()) if self._slowed else self._rate

    def _set_slowed(self, slowed: bool) -> None:
        self._pool.slowed += int(slowed) - int(self._slowed)
        self._slowed = slowed


class MemoryBudget:
    """Bytes that all connections share. A connection that doesn't get its part is called once some are free."""

    def __init__(self, total: int) -> None:
        self.total = total
        self.used = 0
        self._waiting: deque[Callable[[], None]] = deque()

    def take(self, size: int, when_free: Callable[[], None]) -> bool:
        """Take `size` bytes, or have `when_free` called later and return False. One part may be all of it, not more."""
        if self.used + size <= self.total or not self.used:
            self.used += size
            return True
        self._waiting.append(when_free)
        return False

    def give_back(self, size: int) -> None:
        if not size:
            return
        self.used -= size
        waiting, self._waiting = self._waiting, deque()
        for when_free in waiting:
            when_free()

    def forget(self, when_free: Callable[[], None]) -> None:
        """Don't call `when_free` any more."""
        self._waiting = deque(waiting for waiting in self._waiting if waiting != when_free)


class AtMost:
    """At most `rate` events a second, and `rate` of them at once."""

    def __init__(self, rate: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._rate, self._clock = rate, clock
        self._level, self._at = rate, clock()

    def wait(self) -> float:
        """Count an event; the seconds to wait before the next one."""
        now = self._clock()
        self._level, self._at = min(self._rate, self._level + (now - self._at) * self._rate) - 1, now
        return max(0.0, -self._level / self._rate)


def room_for_connections(wanted: int) -> int:
    """How many of `wanted` connections the process may open at once, with descriptors left for everything else.

    Raises the soft limit of open files as far as is needed and allowed.
    """
    try:
        import resource
    except ImportError:  # not on Windows, where sockets aren't counted
        return wanted
    try:
        used = len(list(Path("/proc/self/fd").iterdir()))
    except OSError:
        used = SPARE_DESCRIPTORS
    needed = used + wanted + SPARE_DESCRIPTORS
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft != resource.RLIM_INFINITY and soft < needed:
        soft = needed if hard == resource.RLIM_INFINITY else min(needed, hard)
        try:
            resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
        except (OSError, ValueError):
            soft, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    return wanted if soft == resource.RLIM_INFINITY else max(0, min(wanted, soft - used - SPARE_DESCRIPTORS))


def trim_memory() -> None:
    """Give memory that the C library has cached back to the system, where it can (glibc)."""
    if os.name != "posix":
        return
    import ctypes

    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)
