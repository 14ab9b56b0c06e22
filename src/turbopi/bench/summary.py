"""What follows from a benchmark's results: the time of a call as a line over the denoising steps."""

from collections.abc import Sequence
from typing import Any

import numpy as np


def linear_models(results: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """a + b * steps, least squares over the medians of the whole call, for all jobs that differ in steps alone.

    `a_ms` is what a call costs before the first step, `b_ms` a step, `worst_ms` the largest distance from the line.
    """
    groups: dict[tuple[Any, ...], dict[int, float]] = {}
    for result in results:
        job = result["job"]
        key = (result["backend"], result["precision"], job["cameras"], job["prompt_tokens"], job["horizon"])
        groups.setdefault(key, {})[job["steps"]] = result["milliseconds"]["total"]["p50"]
    return [_line(key, medians) for key, medians in groups.items() if len(medians) > 1]


def _line(key: tuple[Any, ...], medians: dict[int, float]) -> dict[str, Any]:
    steps, values = np.array(list(medians)), np.array(list(medians.values()))
    b, a = np.polyfit(steps, values, 1)
    named = dict(zip(("backend", "precision", "cameras", "prompt_tokens", "horizon"), key, strict=True))
    worst = np.abs(a + b * steps - values).max()
    return {**named, "a_ms": float(a), "b_ms": float(b), "worst_ms": float(worst)}
