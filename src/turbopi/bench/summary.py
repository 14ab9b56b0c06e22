"""What follows from a benchmark's results: a call's time as a line over the denoising steps, and what can't be true."""

from collections.abc import Sequence

import numpy as np

from turbopi.bench.document import Line, Result, label

_Key = tuple[str, str, int, int, int]


def linear_models(results: Sequence[Result]) -> list[Line]:
    """A line for all jobs that differ in steps alone, with images of the model's size, one observation a call."""
    groups: dict[_Key, dict[int, float]] = {}
    for result in results:
        job = result.job
        if job.of_size or job.joined or job.of_batch:
            continue
        key = (result.backend, result.precision, job.cameras, job.prompt_tokens, job.horizon)
        groups.setdefault(key, {})[job.steps] = result.milliseconds["total"].p50
    return [_line(key, medians) for key, medians in groups.items() if len(medians) > 1]


def warnings_on(results: Sequence[Result]) -> list[str]:
    """A line for each result with stages faster than their floor, which nothing is: the floor was measured wrong."""
    found = []
    for result in results:
        stages = [
            f"{stage} {result.milliseconds[stage].p50:,.2f} ms (floor {result.floor_ms[stage]:,.2f})"
            for stage in below_floor(result)
        ]
        if stages:
            found.append(
                f"{label(result)}, {result.job} is faster than its floor in {', '.join(stages)}: above the roofline. "
                "These floors are too high: most likely other programs used the machine while they were measured; run "
                "again when it is idle"
            )
    return found


def below_floor(result: Result) -> list[str]:
    """The stages whose median is shorter than what this machine can do at best."""
    times = result.milliseconds
    return [stage for stage, floor in result.floor_ms.items() if stage in times and times[stage].p50 < floor]


def _line(key: _Key, medians: dict[int, float]) -> Line:
    steps, values = np.array(list(medians)), np.array(list(medians.values()))
    b, a = np.polyfit(steps, values, 1)
    worst = np.abs(a + b * steps - values).max()
    return Line(*key, a_ms=float(a), b_ms=float(b), worst_ms=float(worst))
