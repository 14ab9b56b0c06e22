"""Which denoising loops a backend keeps graphs, tables and kernels of: those used last."""

import logging
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

from turbopi.models.pi0.conditioning import Form
from turbopi.models.pi0.solvers import Integration

logger = logging.getLogger(__name__)


class Loop(NamedTuple):
    """What a denoising loop is captured for."""

    steps: int
    horizon: int
    form: Form = "plain"
    # Of a conditioned loop: all that an action's t may be, so many rows has its table. Of a solver's loop: that of each
    # evaluation. Of a plain one: where steps begin, if not where openpi's do (solving.py)
    times: tuple[float, ...] = ()
    integration: Integration | None = None  # of a solver's loop

    def __str__(self) -> str:
        said = f"H={self.horizon}, {self.steps} steps"
        if self.integration is not None:
            return f"{said}, {self.integration}"
        if self.form == "plain":
            return f"{said}, t = {', '.join(f'{t:.3g}' for t in self.times)}" if self.times else said
        return f"{said}, {FORMS[self.form]}, {len(self.times)} times"

    @property
    def rows(self) -> int:
        """Of its modulation table."""
        return len(self.times) or self.steps

    @property
    def table(self) -> tuple[int, tuple[float, ...]]:
        """Loops with the same one share a modulation table."""
        return (0, self.times) if self.times else (self.steps, ())


FORMS: dict[Form, str] = {"tokens": "by token", "jacobian": "guided by the Jacobian"}

# A policy has one loop, a study a handful. What is kept of each step is up to 1.27 MB: Pi0.5's modulation (0.45 MB) and
# what the denoising kernel makes of it. So all loops together keep 1.3 GB at most, and eight of ten steps 0.1 GB. Of a
# conditioned loop it is kept of each time that an action may have.
MOST_LOOPS = 8
MOST_STEPS = 1024  # of all loops together; one loop may always have as many as the policy takes


class RecentLoops:
    """The loops in use, least recently used first; `forget` is told of each that must make room for another.

    It is told within `use`, and must wait for what may still run.
    """

    def __init__(self, forget: Callable[[Loop], None]) -> None:
        self._forget = forget
        self._loops: dict[Loop, None] = {}
        self._last: Loop | None = None
        self.forgotten = 0

    def __iter__(self) -> Any:
        return iter(self._loops)

    def use(self, loop: Loop) -> None:
        """This loop is about to be used: make it the most recent one, and room for it if it is new."""
        if loop == self._last:
            return
        self._loops.pop(loop, None)
        while self._loops and not fit((*self._loops, loop)):
            oldest = next(iter(self._loops))
            del self._loops[oldest]
            self.forgotten += 1
            logger.info("denoising in %s, makes room for other loops: its graphs are forgotten", oldest)
            self._forget(oldest)
        self._loops[loop] = None
        self._last = loop

    def describe(self) -> dict[str, Any]:
        return {
            "denoising_loops": [str(loop) for loop in list(self._loops)],
            "most_loops": MOST_LOOPS,
            "most_steps_together": MOST_STEPS,
            "forgotten": self.forgotten,
        }


def fit(loops: Iterable[Loop]) -> bool:
    """Whether so many loops are kept at once."""
    loops = list(loops)
    return len(loops) <= MOST_LOOPS and sum(loop.rows for loop in loops) <= MOST_STEPS
