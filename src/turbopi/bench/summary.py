"""What follows from a benchmark's results: the time of a call as a line over the denoising steps."""

from collections.abc import Sequence

import numpy as np

from turbopi.bench.document import Line, Result

_Key = tuple[str, str, int, int, int]


def linear_models(results: Sequence[Result]) -> list[Line]:
    """A line for all jobs that differ in steps alone."""
    groups: dict[_Key, dict[int, float]] = {}
    for result in results:
        job = result.job
        key = (result.backend, result.precision, job.cameras, job.prompt_tokens, job.horizon)
        groups.setdefault(key, {})[job.steps] = result.milliseconds["total"].p50
    return [_line(key, medians) for key, medians in groups.items() if len(medians) > 1]


def _line(key: _Key, medians: dict[int, float]) -> Line:
    steps, values = np.array(list(medians)), np.array(list(medians.values()))
    b, a = np.polyfit(steps, values, 1)
    worst = np.abs(a + b * steps - values).max()
    return Line(*key, a_ms=float(a), b_ms=float(b), worst_ms=float(worst))
