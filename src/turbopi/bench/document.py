"""What `turbopi bench` writes: results.json, one definition for all who write and read it.

Stages are "vision", "prefix" and "denoise". A field with a default may be missing: in files of before it was measured,
or where there is nothing to tell.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Literal, Protocol

from msgspec import UNSET, Meta, Struct, UnsetType, field

from turbopi.bench.machine_limits import Floors
from turbopi.bench.work import Job, Work
from turbopi.support.errors import ConfigError
from turbopi.support.provenance import Gpu, Provenance
from turbopi.support.reading import as_document, read_json

MAX_BYTES = 64 * 2**20  # a table of six backends: about 1 MB
Milliseconds = Annotated[float, Meta(ge=0)]
Percentile = Literal["p5", "p50", "p95", "p99"]


class BenchProvenance(Provenance, frozen=True, kw_only=True):
    """Where it was measured; `gpu` has the clocks before the run."""

    clocks_at_the_end: Gpu | UnsetType = UNSET  # {} on a CPU
    command: list[str] | UnsetType = UNSET


class Times(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Milliseconds of one part of a call, over all calls of a measurement."""

    mean: Milliseconds | None = None
    p5: Milliseconds | None = None
    p50: Milliseconds
    p95: Milliseconds
    p99: Milliseconds | None = None

    def text(self, percentile: Percentile = "p50", digits: int = 2) -> str:
        """ "12.34", or a dash."""
        value: float | None = getattr(self, percentile)
        return "-" if value is None else f"{value:.{digits}f}"


class Memory(Struct, frozen=True, omit_defaults=True):
    """Bytes."""

    device_reserved: int | None = None  # what PyTorch reserved at most, less what was there before
    host_anonymous: int | None = None  # the process's, on Linux


class PolicyError(Struct, frozen=True):
    """Of a policy's actions against the float32 reference's."""

    relative_rms: float  # of the whole set
    max: float  # the worst single value
    observations: int


class Result(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """One backend in one precision on one job."""

    backend: str
    precision: str
    job: Job
    calls: Annotated[int, Meta(ge=1)]
    load_seconds: float
    first_call_seconds: float  # compiles and captures what only this job needs
    milliseconds: dict[str, Times]  # "total", "infer", the stages, "device" (their sum), ...
    floor_ms: dict[str, Milliseconds]  # by stage, and their sum as "total"
    times_floor: float
    work: dict[str, Work] | None = None  # by stage
    memory: Memory
    backend_details: Mapping[str, object] | None = None  # of a backend's last job
    error_against_f32: PolicyError | None = None


class Failed(Struct, frozen=True):
    """A backend that refused or broke."""

    backend: str
    precision: str
    error: str


class Line(Struct, frozen=True):
    """The whole call as a_ms + b_ms * steps: least squares over the medians of jobs that differ in steps alone."""

    backend: str
    precision: str
    cameras: int
    prompt_tokens: int
    horizon: int
    a_ms: float  # what a call costs before the first step
    b_ms: float  # a step
    worst_ms: float  # the largest distance from the line


class Kernel(Struct, frozen=True):
    """Kernels of one name in a stage."""

    kernel: str
    ms_per_call: float
    launches_per_call: float
    share: float  # of the stage, from 0 to 1


class StageKernels(Struct, frozen=True):
    """What ran in a stage, under the profiler, a call."""

    busy_ms: float
    launches: float
    kernels: list[Kernel]  # those that take longest


class Profile(Struct, frozen=True):
    backend: str
    precision: str
    job: Job
    stages: dict[str, StageKernels]  # empty where the profiler saw no kernels


class ReadyTimes(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Seconds from a program's start to its first answer, in parts."""

    imports: float = field(name="import")
    load: float
    warmup: float  # every length of prompt
    device_reserved: int | None = None  # bytes that PyTorch held at most, on a GPU
    ready: float  # all of it


class Ready(Struct, frozen=True):
    backend: str
    precision: str
    cold: ReadyTimes  # no kernel was ever compiled here
    cached: ReadyTimes


class BenchDocument(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """results.json of a benchmark."""

    provenance: BenchProvenance
    model: str
    weights: str
    random_weights: bool
    observations_seed: int
    robot: str | None = None  # whose own observations were measured; None: random ones of the jobs' shapes
    main_job: Job  # the one that counts
    solver: str | None = None  # of all jobs, whose steps are its evaluations; None: the checkpoint's
    time_grid: str | None = None  # of all jobs; None: the checkpoint's
    floors: dict[str, Floors]  # by precision
    results: list[Result]
    failed: list[Failed]
    warnings: list[str] | None = None  # why the numbers can't all be right
    linear: list[Line] | None = None  # None: not finished
    profile: list[Profile] | None = None  # None: not asked for
    ready: list[Ready] | None = None
    unfinished: bool = False

    @property
    def main_results(self) -> list[Result]:
        """The results of the main job."""
        return [result for result in self.results if result.job == self.main_job]


class Measured(Protocol):
    """Whatever was measured of one backend in one precision."""

    @property
    def backend(self) -> str: ...
    @property
    def precision(self) -> str: ...


def label(measured: Measured) -> str:
    return f"{measured.backend} {measured.precision}"


def all_steps(results: Sequence[Result]) -> list[int]:
    """The numbers of denoising steps that were measured."""
    return sorted({result.job.steps for result in results})


def read_benchmark(file: Path) -> BenchDocument:
    """Raises ConfigError, naming file and key, for a file that is none."""
    return as_benchmark(read_json(file, ConfigError, limit=MAX_BYTES), file)


def as_benchmark(content: Mapping[str, object], file: Path) -> BenchDocument:
    """What is in a file, as `read_benchmark`."""
    if "floors" not in content:
        raise ConfigError(f"{file} holds no benchmark; expected the results.json of `turbopi bench --report`")
    return as_document(content, BenchDocument, file, ConfigError)
