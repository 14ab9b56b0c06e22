"""Log lines about what clients do, which may come thousands of times a second."""

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass

from websockets.asyncio.server import ServerConnection


@dataclass
class _Kind:
    began: float
    written: int = 0
    left_out: int = 0


class LimitedLog:
    """At most `lines` of a kind in `seconds`; the first one after that says how many were left out.

    Safe on one thread. `clock` in seconds.
    """

    def __init__(
        self,
        logger: logging.Logger,
        *,
        lines: int = 5,
        seconds: float = 10.0,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._logger, self._lines, self._seconds, self._clock = logger, lines, seconds, clock
        self._kinds: dict[str, _Kind] = {}

    def warning(self, text: str, kind: str = "") -> None:
        self.log(logging.WARNING, text, kind)

    def info(self, text: str, kind: str = "") -> None:
        self.log(logging.INFO, text, kind)

    def log(self, level: int, text: str, kind: str = "") -> None:
        """Write `text` or count it. What isn't printable in it is escaped: it may quote a client."""
        now = self._clock()
        known = self._kinds.setdefault(kind, _Kind(now))
        if now - known.began >= self._seconds:
            known.began, known.written = now, 0
        if known.written == self._lines:
            known.left_out += 1
            return
        known.written += 1
        more = f" ({known.left_out} lines like this were left out)" if known.left_out else ""
        known.left_out = 0
        self._logger.log(level, "%s", "".join(c if c.isprintable() else repr(c)[1:-1] for c in text) + more)

    def flush(self) -> None:
        """Say at the end how many lines were left out and not said yet."""
        for kind, known in self._kinds.items():
            if known.left_out:
                self._logger.warning("%d lines were left out%s", known.left_out, f" ({kind})" if kind else "")
                known.left_out = 0


def peer(connection: ServerConnection) -> str:
    """The client's name, if it gave one, address and port, as the log writes them."""
    address, name = connection.remote_address, getattr(connection, "robot", "")
    place = f"{address[0]}:{address[1]}" if isinstance(address, tuple) else str(address)
    return f"{name} ({place})" if name else place
