"""One benchmark run: floors, then every backend on every job, then the errors, as one plain document."""

import dataclasses
import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from msgspec.structs import asdict, replace

from turbopi import backends
from turbopi.backends import PRECISIONS, Precision
from turbopi.bench.document import BenchDocument, BenchProvenance, Failed, Memory, Profile, Result
from turbopi.bench.machine_limits import Floors, measure_floors
from turbopi.bench.measure import (
    WARMING,
    Observations,
    answers,
    bench_policy,
    call,
    error_against,
    for_job,
    measure_calls,
    writes_tokens,
)
from turbopi.bench.profile import stage_kernels, start_profiler
from turbopi.bench.summary import linear_models, warnings_on
from turbopi.bench.work import MODEL_SIZE, Job, Join, Work, floor_ms, stage_work
from turbopi.checkpoint import Checkpoint
from turbopi.config import Solver, TimeGrid
from turbopi.engine.graph import collect_and_empty_cache
from turbopi.policy.kept_precision import check_backend
from turbopi.policy.policy import UnifiedPolicy
from turbopi.quantization.plan import TIERS, WEIGHTS_ALONE
from turbopi.robots import Robot
from turbopi.support.errors import ConfigError, TurboPiError
from turbopi.support.provenance import Gpu, provenance

Answered = dict[tuple[str, str, Job], np.ndarray]  # backend, precision and job -> the policy's `answers`


@dataclass(frozen=True)
class BenchPlan:
    """What to measure: all backends and precisions on all jobs."""

    backends: Sequence[str]
    precisions: Sequence[Precision]
    cameras: Sequence[int] = (2,)
    prompt_tokens: Sequence[int] = (48,)
    horizons: Sequence[int] = (10,)
    steps: Sequence[int] = (10,)
    image_sizes: Sequence[tuple[int, int]] = (MODEL_SIZE,)  # width, height
    joins: Sequence[Join] = ("none",)
    batches: Sequence[int] = (1,)
    calls: int = 100
    error: bool = True  # also against the float32 reference
    tokenizer: str | None = None
    beside: Sequence[str] = ()  # further backends, on the main job alone
    main_calls: int | None = None  # of `backends` on the main job; None: as all others
    seconds: float = 60.0  # one measurement ends after them, though not before 20 calls
    profile: bool = False
    quantization: str | None = None  # what fp8, fp8-mlp or int8 needs
    robot: str | Robot | None = None  # whose own observations are measured; None: random ones of the jobs' shapes
    solver: Solver | None = None  # None: the checkpoint's
    time_grid: TimeGrid | None = None  # None: the checkpoint's
    writes_tokens: bool = False  # what `run` sets: see Job

    @property
    def main(self) -> Job:
        """The job that counts, as far as its numbers are in the plan; elsewhere the plan's first, and most steps."""
        usual = Job()

        def pick(values: Sequence[int], preferred: int) -> int:
            return preferred if preferred in values else values[0]

        return Job(
            pick(self.cameras, usual.cameras),
            pick(self.prompt_tokens, usual.prompt_tokens),
            pick(self.horizons, usual.horizon),
            usual.steps if usual.steps in self.steps else max(self.steps),
            *(MODEL_SIZE if MODEL_SIZE in self.image_sizes else self.image_sizes[0]),
            "none" if "none" in self.joins else self.joins[0],
            pick(self.batches, usual.batch),
            self.writes_tokens,
        )

    def check(self, device: torch.device, checkpoint: Checkpoint) -> None:
        """Raise ConfigError or BackendUnavailable for a backend or precision that can't run, before anything is run."""
        if not self.backends or not self.precisions:
            raise ConfigError("there is nothing to measure: name a backend and a precision")
        if self.quantization is not None and not set(self.precisions) & set(TIERS):
            raise ConfigError(f"a calibration was given, but none of the precisions takes one: {', '.join(TIERS)}")
        if set(self.joins) != {"none"} and (self.solver, self.time_grid) != (None, None):
            raise ConfigError("chunks join by openpi's steps: --join without --solver and --time-grid")
        named = [*self.backends, *self.beside]
        for precision in self.precisions:
            if precision in PRECISIONS and not any(precision in backends.all_precisions(name) for name in named):
                raise ConfigError(f"none of {', '.join(named)} runs in {precision}")
        for precision, name in itertools.product(self.precisions, named):
            if len(self.precisions) == 1 or precision not in PRECISIONS or precision in backends.all_precisions(name):
                check_backend(name, device, precision, checkpoint)

    def jobs(self) -> Iterator[Job]:
        for horizon, cameras, size, tokens in itertools.product(
            self.horizons, self.cameras, self.image_sizes, self.prompt_tokens
        ):
            for steps, join, batch in itertools.product(self.steps, self.joins, self.batches):
                yield Job(cameras, tokens, horizon, steps, *size, join, batch, self.writes_tokens)

    def policies(self) -> Iterator[tuple[Precision, str, list[Job]]]:
        """Precision, backend, and the jobs it runs. A backend without one of several precisions is left out there."""
        for precision, name in itertools.product(self.precisions, [*self.backends, *self.beside]):
            if len(self.precisions) == 1 or precision in backends.all_precisions(name):
                yield precision, name, list(self.jobs()) if name in self.backends else [self.main]

    def calls_of(self, backend: str, job: Job) -> int:
        if self.main_calls is None or job != self.main or backend not in self.backends:
            return self.calls
        return self.main_calls

    def judges(self, job: Job) -> bool:
        """Whether the error is measured on a job: every number of steps, horizon and way to join of the main job."""
        main = self.main
        return self.error and replace(job, steps=main.steps, horizon=main.horizon, join=main.join) == main

    @property
    def total_calls(self) -> int:
        return sum(self.calls_of(name, job) + WARMING for _, name, jobs in self.policies() for job in jobs)


@dataclass
class BenchProgress:
    """How a run tells what it is doing; by default it doesn't."""

    doing: Callable[[str], None] = field(default=lambda text: None)
    advance: Callable[[], None] = field(default=lambda: None)
    keep: Callable[[BenchDocument], None] = field(default=lambda document: None)  # what is measured so far


def run(
    checkpoint: Checkpoint, plan: BenchPlan, device: torch.device, progress: BenchProgress | None = None
) -> BenchDocument:
    """Measure everything in the plan.

    A backend that refuses or breaks on its jobs is named under `failed`, and the others go on; if none is left, its
    error is raised. What can be refused beforehand is, before anything is measured (`BenchPlan.check`). `progress.keep`
    gets what there is after each job, marked as "unfinished".
    """
    progress = progress or BenchProgress()
    plan = dataclasses.replace(plan, writes_tokens=writes_tokens(checkpoint.config))
    plan.check(device, checkpoint)
    progress.doing("measuring this machine's floors")
    floors: dict[str, Floors] = {precision: measure_floors(device, precision) for precision in plan.precisions}
    collect_and_empty_cache()
    before = BenchProvenance(**asdict(provenance(device)))
    results: list[Result] = []
    answered: Answered = {}
    failed: list[Failed] = []

    def document(measured: list[Result], *, unfinished: bool) -> BenchDocument:
        return BenchDocument(
            provenance=before,
            model=checkpoint.config.name,
            robot=plan.robot if plan.robot is None or isinstance(plan.robot, str) else plan.robot.name,
            weights=_weights_name(checkpoint),
            random_weights=checkpoint.random is not None,
            observations_seed=0,
            main_job=plan.main,
            solver=plan.solver,
            time_grid=None if plan.time_grid is None else str(plan.time_grid),
            floors=floors,
            results=measured,
            failed=failed,
            unfinished=unfinished,
        )

    def keep(measured: list[Result]) -> None:
        progress.keep(document(results + measured, unfinished=True))

    for precision, backend, jobs in plan.policies():
        progress.doing(f"{backend} {precision}: loading")
        floor = floors[precision]
        try:
            results += _measure(checkpoint, plan, device, backend, precision, jobs, floor, answered, progress, keep)
        except TurboPiError as error:
            failed.append(Failed(backend, precision, str(error)))
            last = error
        collect_and_empty_cache()
    if not results:
        raise last
    if answered:
        progress.doing("the float32 reference's answers")
        results = _judged(checkpoint, plan, device, results, answered)
        keep([])
    return replace(
        document(results, unfinished=False),
        provenance=replace(before, clocks_at_the_end=provenance(device).gpu or Gpu()),
        warnings=warnings_on(results) or None,
        linear=linear_models(results),
        profile=_profiles(checkpoint, plan, device, failed, progress) if plan.profile else None,
    )


def _measure(
    checkpoint: Checkpoint,
    plan: BenchPlan,
    device: torch.device,
    backend: str,
    precision: Precision,
    jobs: list[Job],
    floors: Floors,
    answered: Answered,
    progress: BenchProgress,
    keep: Callable[[list[Result]], None],
) -> list[Result]:
    """One backend in one precision on its jobs. What it answers where errors are wanted goes to `answered`."""
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
    before = torch.cuda.memory_allocated(device) if device.type == "cuda" else 0
    policy = _policy(checkpoint, plan, backend, precision, device)
    results = []
    for job in jobs:
        progress.doing(f"{backend} {precision}: {job}")
        shaped = for_job(policy, job)
        first = call(shaped, job, Observations(shaped, job, seed=2))["total_ms"]
        latency = measure_calls(
            shaped, job, plan.calls_of(backend, job), seconds=plan.seconds, advance=progress.advance
        )
        floor = stage_floors(shaped, job, floors)
        result = Result(
            backend=policy.backend.name,
            precision=precision,
            job=job,
            calls=latency["total"].calls,
            load_seconds=(policy.metadata["backend_details"] | policy.metadata).get("load_seconds", 0.0),
            first_call_seconds=round(first / 1e3, 3),
            milliseconds={name: values.times for name, values in latency.items()},
            floor_ms=floor,
            times_floor=latency["total"].median / floor["total"],
            work=_work(shaped, job),
            memory=_memory(device, before),
        )
        if plan.judges(job) and (policy.backend.name, precision) != ("pytorch", "f32"):
            answered[result.backend, precision, job] = answers(shaped, job)
        results.append(result)
        keep(results)
    results[-1] = replace(results[-1], backend_details=policy.metadata["backend_details"])
    del policy, shaped
    collect_and_empty_cache()
    return results


def _judged(
    checkpoint: Checkpoint, plan: BenchPlan, device: torch.device, results: list[Result], answered: Answered
) -> list[Result]:
    """The results with their errors against the float32 reference, where it was asked. It answers each job once."""
    oracle = _policy(checkpoint, plan, "pytorch", "f32", device)
    exact = {job: answers(for_job(oracle, job), job) for job in dict.fromkeys(key[2] for key in answered)}
    del oracle
    collect_and_empty_cache()

    def judged(result: Result) -> Result:
        actions = answered.get((result.backend, result.precision, result.job))
        if actions is None:
            return result
        return replace(result, error_against_f32=error_against(actions, exact[result.job]))

    return [judged(result) for result in results]


def _profiles(
    checkpoint: Checkpoint, plan: BenchPlan, device: torch.device, failed: list[Failed], progress: BenchProgress
) -> list[Profile]:
    """Of every backend that didn't fail, but for those beside."""
    broken = {(one.backend, one.precision) for one in failed}
    return [
        _profile(checkpoint, plan, device, backend, precision, progress)
        for precision, backend, _ in plan.policies()
        if backend in plan.backends and (backend, precision) not in broken
    ]


def _profile(
    checkpoint: Checkpoint,
    plan: BenchPlan,
    device: torch.device,
    backend: str,
    precision: Precision,
    progress: BenchProgress,
) -> Profile:
    """The main job's kernels, with a policy of its own: graphs captured before the profiler runs may be dark to it."""
    progress.doing(f"{backend} {precision}: profile")
    start_profiler(device)
    policy = _policy(checkpoint, plan, backend, precision, device)
    stages = stage_kernels(for_job(policy, plan.main), plan.main)
    del policy
    collect_and_empty_cache()
    return Profile(backend, precision, plan.main, stages)


def stage_floors(policy: UnifiedPolicy, job: Job, floors: Floors) -> dict[str, float]:
    """Milliseconds under which no implementation gets, by stage and in all."""
    stages = {
        stage: floor_ms(one, floors.matmul_flops_per_second, floors.copy_bytes_per_second)
        for stage, one in _work(policy, job).items()
    }
    return {**stages, "total": sum(stages.values())}


def _work(policy: UnifiedPolicy, job: Job) -> dict[str, Work]:
    model, precision = policy.config.model, policy.backend.precision
    if precision == WEIGHTS_ALONE:  # of what is written behind the prefix
        return {**stage_work(model, job, 2), "denoise": stage_work(model, job, 1)["denoise"]}
    return stage_work(model, job, {"f32": 4, "bf16": 2}.get(precision, 1))


def _policy(
    checkpoint: Checkpoint, plan: BenchPlan, backend: str, precision: Precision, device: torch.device
) -> UnifiedPolicy:
    """A policy that runs any job of the plan with `for_job`."""
    return bench_policy(
        checkpoint,
        backend,
        precision,
        device,
        plan.main,
        tokenizer=plan.tokenizer,
        quantization=plan.quantization,
        robot=plan.robot,
        solver=plan.solver,
        time_grid=plan.time_grid,
        most_steps=max(plan.steps),
    )


def _weights_name(checkpoint: Checkpoint) -> str:
    if checkpoint.format == "random":
        return str(checkpoint.info()["config_source"])
    return Path(str(checkpoint.path)).name


def _memory(device: torch.device, before: int) -> Memory:
    status, host = Path("/proc/self/status"), None
    if status.exists():
        lines = dict(line.split(":", 1) for line in status.read_text().splitlines() if ":" in line)
        host = int(lines["RssAnon"].split()[0]) * 1024
    reserved = torch.cuda.max_memory_reserved(device) - before if device.type == "cuda" else None
    return Memory(reserved, host)
