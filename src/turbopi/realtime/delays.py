"""The delay to expect of the next inference, of those measured."""

from collections import deque

import numpy as np

from turbopi.support.errors import ConfigError


class DelayEstimate:
    """A percentile of the last delays, in control steps.

    initial     the estimate until a delay was measured
    percentile  100 is the largest of the window; lower ones let single late answers pass
    window      how many of the last delays count
    """

    def __init__(self, initial: int = 0, *, percentile: float = 95.0, window: int = 50) -> None:
        if isinstance(window, bool) or not isinstance(window, int | np.integer) or window < 1:
            raise ConfigError(f"the delays' window is {window!r}; it should be a whole number of delays, from 1")
        self._measured: deque[int] = deque(maxlen=int(window))
        self._percentile = number_up_to(100, "the delays' percentile", percentile)
        self._initial = _checked(initial)

    def begin(self, steps: int) -> None:
        """Another initial estimate."""
        self._initial = _checked(steps)

    def add(self, steps: int) -> None:
        """A delay was measured, in control steps. Raises ConfigError for what is none, as `begin` does."""
        self._measured.append(_checked(steps))

    @property
    def steps(self) -> int:
        """The delay to expect: one that was measured, never between two."""
        if not self._measured:
            return self._initial
        return int(np.percentile(self._measured, self._percentile, method="higher"))


def number_up_to(most: float, name: str, value: object) -> float:
    """Raises ConfigError for what is no number from 0 to `most`."""
    number = isinstance(value, int | float | np.integer | np.floating) and not isinstance(value, bool)
    if not number or not 0 <= value <= most:  # type: ignore[operator]
        raise ConfigError(f"{name} is {value!r}; it should be a number from 0 to {most:g}")
    return float(value)  # type: ignore[arg-type]


def _checked(steps: int) -> int:
    if isinstance(steps, bool) or not isinstance(steps, int | np.integer) or steps < 0:
        raise ConfigError(f"a delay is {steps!r}; it should be a whole number of control steps, from 0")
    return int(steps)
