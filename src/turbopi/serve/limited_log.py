"""Log lines about what clients do, which may come thousands of times a second."""

import logging
import time
from collections.abc import Callable


class LimitedLog:
    """At most `lines` warnings in `seconds`; the first one after that says how many were left out.

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
        self._began = clock()
        self._written = self._left_out = 0

    def warning(self, text: str) -> None:
        now = self._clock()
        if now - self._began >= self._seconds:
            self._began, self._written = now, 0
        if self._written == self._lines:
            self._left_out += 1
            return
        self._written += 1
        more = f" ({self._left_out} lines like this were left out)" if self._left_out else ""
        self._left_out = 0
        self._logger.warning("%s", "".join(c if c.isprintable() else repr(c)[1:-1] for c in text) + more)
