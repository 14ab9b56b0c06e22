"""How long a call may take on a GPU that nobody measured: predictions, from published numbers and measured calls.

The floor is `work.py`'s counts at the published rates. A call takes longer, and by how much depends on the program. Two
ways to carry that over from a GPU on which the same backend was measured give a range:

    what was lost beyond the floor takes as long there     floor + (measured - its floor)
    the ratio to the floor is the same there               floor * (measured / its floor)

each stage on its own, a denoising step's loss for each step, and the host's part of a call as it was measured. Launches
and barriers cost about the same on every GPU, badly used bandwidth and matrix units cost in proportion; no GPU's loss
is all of one kind.

Chunks longer than a denoising kernel takes are denoised by operations, which nobody measured for one observation: at
the higher end their denoising takes longer than measured as their actions are more than the kernel takes.
"""

from collections.abc import Iterable, Sequence

from msgspec import Struct
from msgspec.structs import replace

from turbopi.bench.gpus import GpuSpec, find_gpu
from turbopi.bench.measured import Kernels, MeasuredCall, measured_calls
from turbopi.bench.work import Job, floor_ms, stage_work
from turbopi.config import ModelConfig

PRECISIONS = ("bf16", "fp8", "int8")
STAGES = ("vision", "prefix", "denoise")
MOST_TOKENS: dict[Kernels, int] = {"hopper": 56, "portable": 64}  # that the denoising kernels take: their MAX_SUFFIX
_BYTES = {"bf16": 2, "fp8": 1, "int8": 1}


class PredictedCall(Struct, frozen=True, kw_only=True):
    """Milliseconds from host to host, by a backend that was measured elsewhere."""

    backend: str
    kernels: Kernels
    low_ms: float
    high_ms: float
    measured_on: str  # a key of gpus.json
    measured_job: Job
    source: str  # the file below benchmarks/results


class Prediction(Struct, frozen=True, kw_only=True):
    """One GPU in one precision on one job. Only calls that `was_measured` names were measured on that GPU."""

    gpu: GpuSpec
    precision: str
    job: Job
    floor_ms: dict[str, float]  # by stage, and their sum as "total", at the published rates
    calls: list[PredictedCall]  # none where no backend that runs there was measured in such a batch and model

    def was_measured(self, call: PredictedCall) -> bool:
        """Whether this very job ran on this very GPU."""
        return (call.measured_on, call.measured_job) == (self.gpu.key, self.job)


def predict(gpu: GpuSpec, config: ModelConfig, job: Job) -> list[Prediction]:
    """A prediction for each precision that the GPU's tensor cores have."""
    return [
        Prediction(
            gpu=gpu,
            precision=precision,
            job=job,
            floor_ms=published_floors(gpu, config, job, precision),
            calls=list(_calls(gpu, config, job, precision)),
        )
        for precision in PRECISIONS
        if gpu.rate(precision) is not None
    ]


def published_floors(gpu: GpuSpec, config: ModelConfig, job: Job, precision: str) -> dict[str, float]:
    """Milliseconds by stage, and their sum as "total", at the published rates. The GPU has that precision."""
    rate = gpu.rate(precision)
    assert rate is not None
    work = stage_work(config, job, _BYTES[precision])
    floors = {stage: floor_ms(one, rate, gpu.gb_per_second * 1e9) for stage, one in work.items()}
    return floors | {"total": sum(floors.values())}


def predicted_call(gpu: GpuSpec, config: ModelConfig, job: Job, measured: MeasuredCall) -> PredictedCall:
    """What a call would take on the GPU, going by one that was measured, of the full-size model, elsewhere."""
    there = published_floors(gpu, config, job, measured.precision)
    here = published_floors(find_gpu(measured.gpu), ModelConfig(), measured.job, measured.precision)
    took = {name: times.p50 for name, times in measured.milliseconds.items()}
    host = took["total"] - sum(took[stage] for stage in STAGES)
    times = {"denoise": job.steps / measured.job.steps}  # a loss there is one of each step
    added = host + sum(there[stage] + (took[stage] - here[stage]) * times.get(stage, 1.0) for stage in STAGES)
    ratios = {stage: took[stage] / here[stage] for stage in STAGES}
    scaled = host + sum(there[stage] * ratios[stage] for stage in STAGES)
    most = MOST_TOKENS.get(measured.kernels, job.horizon)
    if measured.job.horizon <= most < job.horizon:
        alike = published_floors(gpu, config, replace(job, horizon=measured.job.horizon), measured.precision)["denoise"]
        scaled += max(0.0, alike * job.horizon / most - there["denoise"]) * ratios["denoise"]
    return PredictedCall(
        backend=measured.backend,
        kernels=measured.kernels,
        low_ms=min(added, scaled),
        high_ms=max(added, scaled),
        measured_on=measured.gpu,
        measured_job=measured.job,
        source=measured.source,
    )


def runs_on(kernels: Kernels, gpu: GpuSpec) -> bool:
    """Whether kernels of that kind run on a GPU of the table at all."""
    return kernels != "hopper" or gpu.capability == (9, 0)


def refused(gpu: GpuSpec, precision: str) -> str | None:
    """Why a GPU of the table doesn't run a precision, in the kernels' words; None if it does.

    Not asked of the kernels themselves: they need Triton, and predictions are for machines without it, too.
    """
    has = f"this GPU has {gpu.compute_capability}"
    if precision == "fp8" and gpu.fp8_tflops is None:
        return f"tensor cores multiply E4M3 from compute capability 8.9 on; {has}"
    if precision == "int8" and gpu.capability[0] in (10, 11):
        return (
            f"on compute capability 10.x and 11.0 Triton multiplies INT8 by mma.sync, which nobody timed there; {has}"
        )
    return None


def _full_size(config: ModelConfig) -> bool:
    """Whether the model has the sizes of those that were measured: what a smaller one loses is another matter."""
    full = ModelConfig()
    return (config.vision, config.vlm, config.expert) == (full.vision, full.vlm, full.expert)


def _calls(gpu: GpuSpec, config: ModelConfig, job: Job, precision: str) -> Iterable[PredictedCall]:
    if not _full_size(config):
        return
    by_backend: dict[tuple[str, str], list[MeasuredCall]] = {}
    for call in measured_calls():
        runs = runs_on(call.kernels, gpu) and (call.gpu == gpu.key or refused(gpu, precision) is None)
        if runs and call.precision == precision and call.job.batch == job.batch:
            by_backend.setdefault((call.backend, call.kernels), []).append(call)
    for calls in by_backend.values():
        own = [call for call in calls if call.gpu == gpu.key]
        yield predicted_call(gpu, config, job, nearest(own or calls, job))


def nearest(calls: Sequence[MeasuredCall], job: Job) -> MeasuredCall:
    """The measured call whose job is most like another: the same but for the horizon if there is one."""
    same = [call for call in calls if replace(call.job, horizon=job.horizon) == job]
    return min(same or calls, key=lambda call: abs(call.job.horizon - job.horizon))
