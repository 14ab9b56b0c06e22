"""The delay to expect of the next inference, of those measured."""

from collections import deque

import numpy as np

from turbopi.errors import ConfigError


class DelayEstimate:
    """A percentile of the last delays, in control steps.

    initial     the estimate until a delay was measured
    percentile  100 is the largest of the window; lower ones let single late answers pass
    window      how many of the last delays count
    """

    def __init__(self, initial: int = 0, *, percentile: float = 95.0, window: int = 50) -> None:
        if not 0 <= percentile <= 100:
            raise ConfigError(f"the delays' percentile is {percentile}; it should lie between 0 and 100")
        if window < 1:
            raise ConfigError(f"the delays' window is {window}; it should hold 1 delay or more")
        self._measured: deque[int] = deque(maxlen=window)
        self._percentile = percentile
        self._initial = _checked(initial)

    def begin(self, steps: int) -> None:
        """Another initial estimate."""
        self._initial = _checked(steps)

    def add(self, steps: int) -> None:
        self._measured.append(_checked(steps))

    @property
    def steps(self) -> int:
        """The delay to expect: one that was measured, never between two."""
        if not self._measured:
            return self._initial
        return int(np.percentile(self._measured, self._percentile, method="higher"))


def _checked(steps: int) -> int:
    if isinstance(steps, bool) or not isinstance(steps, int | np.integer) or steps < 0:
        raise ConfigError(f"a delay is {steps!r}; it should be a whole number of control steps, from 0")
    return int(steps)
