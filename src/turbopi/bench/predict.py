"""How long a call may take on a GPU that nobody measured: predictions, from published numbers and measured calls.

The floor is `work.py`'s counts at the published rates. Of a measured call each stage's time is taken apart:

    took = delays + ratio * floor        elsewhere: delays * CLOCKS + ratio * its floor

    delays  launches, barriers, waiting: as many clock cycles elsewhere, each step's again, the host's part as measured
    ratio   of vision and prefix what three more observations take in a batch, over their floor: launches stay as many.
            At the lower end a large matmul reaches the published rate, at the higher end REACHED of it as on Hopper.
            In 8 bits batches of the portable kernels weren't measured: at the higher end their delays are bf16's
            and all else is ratio, as on Hopper; at the lower end the ratio is bf16's.
            Of denoising, which reads weights: 1, or as a large copy reaches on Hopper

In 8 bits on GPUs whose products are mma.sync's (MMA_SYNC) vision and prefix go by the same operations timed as PTX for
mma.sync on the H200 (AS_PTX), whose floor is at the rate of a large product of that PTX. The ratio is that of a call's
largest product and all else is delay; at the higher end all of it may be ratio, too. Hopper emulates mma.sync of E4M3:
FP8's delays are at the lower end no more than INT8's.

docs/dev/performance.md works through an RTX 4090. What chunks longer than the measured call's add is what it was with
the same kernels in other precisions.

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
# Of the published rates, by a large bf16 matmul and a large copy on the H200: h200_2026-11-27_in_layers/batches.json.xz
REACHED = {"matmul": 0.78, "copy": 0.88}
MMA_SYNC = (8, 12)  # compute capabilities' first numbers
CLOCKS = (0.75, 1.5)  # of a cycle of Hopper's 1.98 GHz: published clocks are 1.3 GHz (Jetson AGX Orin) to 2.6 (GeForce)


class AsPtx(Struct, frozen=True):
    """The portable kernels' operations of the main job, as PTX for compute capability 8.9, on the H200."""

    tflops: float  # of a large product
    large: float  # times its floor that a call's largest product takes
    milliseconds: dict[str, float]  # of vision's and prefix' operations; RoPE, patches and the projector aren't in them

    def floor(self, stage: str) -> float:
        """Milliseconds at the rate of a large product."""
        work = stage_work(ModelConfig(), Job(), 1)[stage]
        return floor_ms(work, self.tflops * 1e12, find_gpu("h200").gb_per_second * 1e9)

    def delays(self, stage: str) -> float:
        """Milliseconds that aren't in proportion to the floor."""
        return self.milliseconds[stage] - self.large * self.floor(stage)


PTX_SOURCE = "h200_2026-11-30_ptx_times_89.json.xz"
AS_PTX = {
    "fp8": AsPtx(351.4, 1.147, {"vision": 2.910, "prefix": 9.679}),
    "int8": AsPtx(778.3, 1.260, {"vision": 1.790, "prefix": 4.953}),
}


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
    here, took = _floors_and_times(measured)
    low = high = took["total"] - sum(took[stage] for stage in STAGES)
    clocks = (1.0,) if gpu.key == measured.gpu else CLOCKS
    for stage, ratios in _ratios(measured).items():
        denoises = stage == "denoise"
        if not denoises and by_ptx(measured.kernels, measured.precision, gpu):
            least, most = _as_ptx(measured.precision, stage, there[stage])
            low, high = low + least, high + most
            continue
        again = job.steps / measured.job.steps if denoises else 1.0
        ends = [
            (took[stage] + more - ratio * here[stage]) * again * clock + ratio * there[stage]
            for more in (_grown(measured, job) if denoises else [0.0])
            for ratio in (min(one, took[stage] / here[stage]) for one in ratios)
            for clock in clocks
        ]
        low, high = low + min(ends), high + max(ends)
    most = MOST_TOKENS.get(measured.kernels, job.horizon)
    if measured.job.horizon <= most < job.horizon:
        alike = published_floors(gpu, config, replace(job, horizon=measured.job.horizon), measured.precision)["denoise"]
        high += max(0.0, alike * job.horizon / most - there["denoise"]) * took["denoise"] / here["denoise"]
    return PredictedCall(
        backend=measured.backend,
        kernels=measured.kernels,
        low_ms=low,
        high_ms=high,
        measured_on=measured.gpu,
        measured_job=measured.job,
        source=measured.source,
    )


def by_ptx(kernels: Kernels, precision: str, gpu: GpuSpec) -> bool:
    """Whether vision and prefix go by AS_PTX there."""
    return kernels == "portable" and precision in AS_PTX and gpu.capability[0] in MMA_SYNC


def _as_ptx(precision: str, stage: str, floor: float) -> tuple[float, float]:
    """Milliseconds, at least and at most, of a stage with that published floor."""
    one = AS_PTX[precision]
    delays, reached = one.delays(stage), floor / REACHED["matmul"]
    least = min(delays, AS_PTX["int8"].delays(stage)) * CLOCKS[0] + one.large * floor
    most = max(delays * CLOCKS[1] + one.large * reached, one.milliseconds[stage] / one.floor(stage) * reached)
    return least, most


def _floors_and_times(call: MeasuredCall) -> tuple[dict[str, float], dict[str, float]]:
    floors = published_floors(find_gpu(call.gpu), ModelConfig(), call.job, call.precision)
    return floors, {name: times.p50 for name, times in call.milliseconds.items()}


def _grown(measured: MeasuredCall, job: Job) -> list[float]:
    """Milliseconds that longer chunks than the measured call's add to denoising: with its kernels in each precision."""
    same, short = (measured.gpu, measured.kernels, measured.job.batch), measured.job.horizon
    calls = [one for one in measured_calls() if (one.gpu, one.kernels, one.job.batch) == same]
    took = {(one.precision, one.job.horizon): one.milliseconds["denoise"].p50 for one in calls}
    longer = min((horizon for _, horizon in took if horizon > short), default=short)
    found = [
        took[name, longer] - took[name, short] for name, horizon in took if horizon == longer and (name, short) in took
    ]
    if job.horizon <= short or not found:
        return [0.0]
    return found if job.horizon >= longer else [0.0, *found]


def _ratios(measured: MeasuredCall) -> dict[str, tuple[float, float]]:
    """Stage -> what a millisecond of its floor takes, delays apart, at least and at most."""
    found = {"denoise": (1.0, 1 / REACHED["copy"])}
    here, took = _floors_and_times(measured)
    for stage in ("vision", "prefix"):
        ratio = _ratio(stage, measured.kernels, measured.precision)
        if ratio is not None:
            found[stage] = (ratio * REACHED["matmul"], ratio)
            continue
        library = _ratio(stage, "pytorch", "bf16")  # whose matmuls portable bf16 has, too
        assert library is not None
        kind = replace(measured, precision="bf16")
        alike = nearest([one for one in measured_calls() if _kind(one) == _kind(kind)], measured.job)
        floors, times = _floors_and_times(alike)
        most = (took[stage] - times[stage] + library * floors[stage]) / here[stage]  # bf16: that is `library`
        found[stage] = (library * REACHED["matmul"], most)
    return {stage: found[stage] for stage in STAGES}


def _ratio(stage: str, kernels: str, precision: str) -> float | None:
    """Of vision or prefix by batches of one and four observations; None where none were measured."""
    calls = {one.job: one for one in measured_calls() if _kind(one)[:3] == ("h200", kernels, precision)}
    one, four = calls.get(Job()), calls.get(Job(batch=4))
    if one is None or four is None:
        return None
    (floor, took), (floor_of_four, took_of_four) = _floors_and_times(one), _floors_and_times(four)
    return (took_of_four[stage] - took[stage]) / (floor_of_four[stage] - floor[stage])


def _kind(call: MeasuredCall) -> tuple[str, str, str, int]:
    return call.gpu, call.kernels, call.precision, call.job.batch


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
