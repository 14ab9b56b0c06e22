"""What `python -m peers run` writes: one file for each run, which docs/performance.md's table is made of."""

from pathlib import Path
from typing import Annotated, Literal

from msgspec import Meta, Struct

from peers.entries import Model
from turbopi.bench.work import Job
from turbopi.support.errors import ConfigError
from turbopi.support.provenance import Gpu, Provenance
from turbopi.support.reading import read_document

Part = Literal["whole call", "on the GPU"]  # host to host; from inputs on the GPU to actions on the GPU
PARTS: tuple[Part, Part] = ("whole call", "on the GPU")
Stage = Literal["install", "start", "call"]


class Timed(Struct, frozen=True, kw_only=True):
    """One part of a program's call, over all rounds; milliseconds."""

    program: str
    setting: str
    part: Part
    job: Job
    calls: Annotated[int, Meta(ge=1)]
    p50_ms: Annotated[float, Meta(gt=0)]
    p95_ms: Annotated[float, Meta(gt=0)]
    rounds_ms: list[Annotated[float, Meta(gt=0)]]  # the median of each
    setup_s: Annotated[float, Meta(ge=0)]  # from the process's start to its readiness
    actions: list[int]  # shape of a chunk: [H, d]
    versions: dict[str, str]
    note: str  # what a call has and leaves out


class NotMeasured(Struct, frozen=True, kw_only=True):
    """A setting without figures, and why. job: None if it fails for every job."""

    program: str
    setting: str
    job: Job | None
    stage: Stage
    reason: str


class PeersRun(Struct, frozen=True, kw_only=True):
    kind: Literal["turbopi-peers"]
    provenance: Provenance
    clocks: list[Gpu]  # before each round, and at the end; none on a CPU
    command: list[str]
    small: bool  # small models, to try the tool: no figure
    model: Model = "pi05"  # not in older files
    timed: list[Timed]
    not_measured: list[NotMeasured]


def read_peers_run(file: Path) -> PeersRun:
    """Raises ConfigError, a ValueError, for a file that isn't one, and for one of small models."""
    run = read_document(file, PeersRun, ConfigError)
    if run.small:
        raise ConfigError(f"{file} is of small models, which tell nothing of speed: expected a run without --small")
    return run
