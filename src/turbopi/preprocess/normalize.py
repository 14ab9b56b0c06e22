"""Scaling of states and actions, and its exact inverse.

openpi's modes compute in float64 (its statistics are float64) and keep openpi's widths: statistics are cut to a
narrower input; dimensions past the statistics are left alone when un-normalising by quantiles, and multiplied by
1 + 1e-6 by z-score (padded with mean 0, std 1). LeRobot's modes compute in float32, as its processors do, and return
those numbers as float64. Nothing is clipped. Sources: openpi's `transforms.py`; LeRobot's `normalize_processor.py`.
"""

import numpy as np

from turbopi.checkpoint.norm_stats import NEEDS, FeatureStats
from turbopi.config import NormMode
from turbopi.support.errors import ConfigError, ObservationError

_OPENPI_EPS = 1e-6
_LEROBOT_EPS = 1e-8


class Normalizer:
    """One feature's scaling.

    mode      how; "identity" leaves values alone and needs no statistics
    stats     the feature's statistics
    feature   its name in messages: "state" or "actions"

    Raises ConfigError if the mode is unknown or its statistics are missing or don't fit each other.
    """

    def __init__(self, mode: NormMode, stats: FeatureStats | None, feature: str) -> None:
        self.mode, self.feature = mode, feature
        self.width: int | None = None  # of the statistics; None: any
        if mode not in NEEDS:
            raise ConfigError(f"unknown normalisation {mode!r}; choose one of {', '.join(NEEDS)}")
        self.is_lerobot = mode.startswith("lerobot_")  # computes in float32, as LeRobot does
        if not NEEDS[mode]:
            return
        self._a, self._b = self._statistics(stats)
        self._span = self._divisor()
        self.width = len(self._a)

    def _statistics(self, stats: FeatureStats | None) -> tuple[np.ndarray, np.ndarray]:
        names = NEEDS[self.mode]
        found = () if stats is None else stats.available
        if not set(names) <= set(found):
            raise ConfigError(
                f"{self.mode} normalisation of {self.feature} needs {' and '.join(names)}, but the checkpoint's "
                f"statistics have {', '.join(found) or 'nothing'} for {self.feature}. Use the checkpoint's own norm "
                f"stats, or a configuration whose normalisation fits them"
            )
        a, b = (np.asarray(getattr(stats, name), np.float64) for name in names)
        if a.ndim != 1 or a.shape != b.shape:
            raise ConfigError(f"{self.feature} statistics {names[0]} {a.shape} and {names[1]} {b.shape} don't match")
        return (a.astype(np.float32), b.astype(np.float32)) if self.is_lerobot else (a, b)

    def _divisor(self) -> np.ndarray:
        """What `normalize` divides by, and `unnormalize` multiplies by, but in lerobot_zscore."""
        a, b = self._a, self._b
        with np.errstate(over="ignore"):  # absurd statistics
            match self.mode:
                case "quantile":
                    return np.asarray(b - a + _OPENPI_EPS)
                case "zscore":
                    return np.asarray(b + _OPENPI_EPS)
                case "lerobot_zscore":
                    return np.asarray(b + np.float32(_LEROBOT_EPS))
                case _:  # lerobot_quantile, lerobot_quantile10, lerobot_min_max
                    span = b - a
                    return np.where(span == 0, np.float32(_LEROBOT_EPS), span)

    def normalize(self, x: np.ndarray) -> np.ndarray:
        """float[..., d] to float64[..., d]. Raises ObservationError if d is more than the statistics cover."""
        if self.width is None:
            return np.array(x, np.float64)  # a copy, as in every other mode
        d = x.shape[-1]
        if d > self.width or (self.is_lerobot and d != self.width):
            raise ObservationError(f"{self.feature} has {d} values, but the checkpoint's statistics cover {self.width}")
        a, span = self._a[:d], self._span[:d]
        with np.errstate(over="ignore"):  # absurd inputs become inf, which the pipeline refuses
            match self.mode:
                case "quantile":
                    return np.asarray((x - a) / span * 2.0 - 1.0)
                case "zscore":
                    return np.asarray((x - a) / span)
                case "lerobot_zscore":
                    return np.asarray((x.astype(np.float32) - a) / span, np.float64)
                case _:  # lerobot_quantile, lerobot_quantile10, lerobot_min_max
                    return np.asarray(2.0 * (x.astype(np.float32) - a) / span - 1.0, np.float64)

    def says_something_past(self, width: int) -> bool:
        """Whether the statistics past the first `width` values are more than padding: not all 0."""
        return self.width is not None and bool(np.any(self._a[width:]) or np.any(self._b[width:]))

    def fitted(self, x: np.ndarray) -> np.ndarray:
        """float[d] made as wide as `normalize` takes it: cut, or for LeRobot's modes repeated."""
        if self.width is None or (len(x) <= self.width and not self.is_lerobot):
            return x
        return np.resize(x, self.width)

    def unnormalize(self, x: np.ndarray) -> np.ndarray:
        """float[..., d] to float64[..., d], the inverse. Raises ConfigError if d is less than the statistics cover."""
        if self.width is None:
            return np.array(x, np.float64)  # a copy, as in every other mode
        d = x.shape[-1]
        if d < self.width:
            raise ConfigError(f"{self.feature} has {d} values, but the checkpoint's statistics cover {self.width}")
        out = x.astype(np.float64)
        out[..., : self.width] = self._unscaled(x[..., : self.width])
        if self.mode == "zscore":
            out[..., self.width :] *= 1.0 + _OPENPI_EPS  # openpi pads std with 1, mean with 0
        return out

    def _unscaled(self, x: np.ndarray) -> np.ndarray:
        a, b, span = self._a, self._b, self._span
        if self.is_lerobot:
            x = x.astype(np.float32)
        match self.mode:
            case "quantile" | "lerobot_min_max":
                return np.asarray((x + 1.0) / 2.0 * span + a)
            case "zscore":
                return np.asarray(x * span + a)
            case "lerobot_quantile" | "lerobot_quantile10":
                return np.asarray((x + 1.0) * span / 2.0 + a)
            case _:  # lerobot_zscore: the epsilon is in the forward direction only
                return np.asarray(x * b + a)


def pad_last(x: np.ndarray, width: int) -> np.ndarray:
    """[..., d] padded with zeros to [..., width]; wider stays as it is. The dtype is kept."""
    if x.shape[-1] >= width:
        return x
    out = np.zeros((*x.shape[:-1], width), x.dtype)  # as np.pad, which takes 20 us
    out[..., : x.shape[-1]] = x
    return out
