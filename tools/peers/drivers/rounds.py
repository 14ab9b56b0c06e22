"""What every driver does around its program. A driver is a script:

    python run_PROGRAM.py JOB    JOB: {"setting", "model", "cameras", "prompt_tokens", "horizon", "steps", "device", …}

It builds the program once and says so; then, for each line {"calls": n, "seconds": s} of its input, it times n calls of
each part, or fewer where they take longer than s, and answers with a line. Its output is for these lines alone:
whatever the program prints goes to the standard error.
Runs in the program's own environment: NumPy is all that it takes for granted.
"""

import json
import os
import sys
import time
from collections.abc import Callable, Mapping
from importlib.metadata import PackageNotFoundError, version
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

WARM_UP = 5  # calls of each part, before it is ready
FEWEST = 3  # of a part in a round, however slow they are
Part = Callable[[], tuple[float, Any]]  # one call: milliseconds, actions [..., H, d] on the host


class Built(NamedTuple):
    parts: dict[str, Part]
    note: str  # what a call has and leaves out
    packages: tuple[str, ...]  # whose versions count
    sources: Mapping[str, str] = MappingProxyType({})  # commits of what isn't a package


def clocked(call: Callable[[], Any], after: Callable[[Any], Any] = lambda actions: actions) -> Part:
    """The host's clock around a call, which must have ended when it returns. `after` isn't counted."""

    def part() -> tuple[float, Any]:
        begin = time.perf_counter()
        actions = call()
        return 1e3 * (time.perf_counter() - begin), after(actions)

    return part


def random_images(job: dict[str, Any]) -> Callable[[], list[np.ndarray]]:
    """Each time other images, uint8[height, width, 3], one for each camera."""
    rng, shape = np.random.default_rng(0), (job.get("image_height", 224), job.get("image_width", 224), 3)
    return lambda: [rng.integers(0, 256, shape, dtype=np.uint8) for _ in range(job["cameras"])]


def serve(build: Callable[[dict[str, Any]], Built]) -> None:
    """Build for the job in the command line, then time what is asked for until the input ends."""
    begin = time.perf_counter()
    said = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)

    def say(line: dict[str, Any]) -> None:
        said.write(json.dumps(line) + "\n")
        said.flush()

    built = build(json.loads(sys.argv[1]))
    for part in built.parts.values():
        for _ in range(WARM_UP):
            part()
    found = {name: installed for name in built.packages if (installed := _version(name))} | dict(built.sources)
    say({"ready": True, "note": built.note, "versions": found, "setup_s": round(time.perf_counter() - begin, 1)})
    for line in sys.stdin:
        request = json.loads(line)
        say({name: _times(part, request["calls"], request["seconds"]) for name, part in built.parts.items()})


def _times(part: Part, calls: int, seconds: float | None) -> dict[str, Any]:
    taken, actions = [], np.zeros(())
    finite, begin = True, time.perf_counter()
    for number in range(calls):
        if seconds is not None and number >= FEWEST and time.perf_counter() - begin >= seconds:
            break
        milliseconds, found = part()
        actions = np.asarray(found, np.float64)
        finite = finite and bool(np.isfinite(actions).all())
        taken.append(milliseconds)
    shape: list[int] = list(actions.shape)
    while len(shape) > 2 and shape[0] == 1:
        shape.pop(0)
    return {"ms": taken, "shape": shape, "finite": finite}


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None
