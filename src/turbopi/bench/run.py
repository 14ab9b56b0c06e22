"""One benchmark run: floors, then every backend on every job, as one plain document."""

import gc
import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch

from turbopi import backends
from turbopi.bench.floors import Floors, measure_floors
from turbopi.bench.measure import bench_policy, error_against, measure_calls
from turbopi.bench.provenance import provenance
from turbopi.bench.work import Job, floor_ms, stage_work
from turbopi.checkpoint import Checkpoint
from turbopi.model.reference import Precision
from turbopi.policy import UnifiedPolicy


@dataclass(frozen=True)
class Plan:
    """What to measure: all backends and precisions on all jobs."""

    backends: Sequence[str]
    precisions: Sequence[Precision]
    cameras: Sequence[int] = (2,)
    prompt_tokens: Sequence[int] = (48,)
    horizons: Sequence[int] = (10,)
    steps: Sequence[int] = (10,)
    calls: int = 100
    error: bool = True  # also against the float32 reference, which must fit beside the policy
    tokenizer: str | None = None

    def jobs(self, horizon: int) -> Iterator[Job]:
        for cameras, tokens, steps in itertools.product(self.cameras, self.prompt_tokens, self.steps):
            yield Job(cameras, tokens, horizon, steps)

    @property
    def total_calls(self) -> int:
        sizes = (self.backends, self.precisions, self.cameras, self.prompt_tokens, self.horizons, self.steps)
        count = self.calls + 3
        for size in sizes:
            count *= len(size)
        return count


@dataclass
class Progress:
    """How a run tells what it is doing; by default it doesn't."""

    doing: Callable[[str], None] = field(default=lambda text: None)
    advance: Callable[[], None] = field(default=lambda: None)


def run(checkpoint: Checkpoint, plan: Plan, device: torch.device, progress: Progress | None = None) -> dict[str, Any]:
    """Measure everything in the plan. Raises what UnifiedPolicy raises, for a backend before anything is measured."""
    progress = progress or Progress()
    for precision, backend in itertools.product(plan.precisions, plan.backends):
        backends.check(backend, device, precision)
    progress.doing("measuring this machine's floors")
    dtypes: dict[Precision, torch.dtype] = {"bf16": torch.bfloat16, "f32": torch.float32}
    floors = {precision: measure_floors(device, dtypes[precision]) for precision in plan.precisions}
    results = []
    for horizon in plan.horizons:
        oracle = (
            bench_policy(checkpoint, "pytorch", "f32", device, Job(horizon=horizon), plan.tokenizer)
            if plan.error
            else None
        )
        for precision, backend in itertools.product(plan.precisions, plan.backends):
            progress.doing(f"{backend} {precision}, H={horizon}: loading")
            results += _measure(
                checkpoint, plan, device, backend, precision, horizon, floors[precision], oracle, progress
            )
        del oracle
        _free(device)
    weights = (
        checkpoint.info()["config_source"] if checkpoint.format == "random" else str(Path(str(checkpoint.path)).name)
    )
    return {
        "provenance": provenance(device),
        "model": checkpoint.config.name,
        "weights": weights,
        "random_weights": checkpoint.format == "random",
        "floors": {precision: asdict(floor) for precision, floor in floors.items()},
        "results": results,
    }


def _measure(
    checkpoint: Checkpoint,
    plan: Plan,
    device: torch.device,
    backend: str,
    precision: Precision,
    horizon: int,
    floors: Floors,
    oracle: UnifiedPolicy | None,
    progress: Progress,
) -> list[dict[str, Any]]:
    """All jobs of one horizon with one backend in one precision."""
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
    before = torch.cuda.memory_allocated(device) if device.type == "cuda" else 0
    policy = bench_policy(checkpoint, backend, precision, device, Job(horizon=horizon), plan.tokenizer)
    results = []
    for job in plan.jobs(horizon):
        progress.doing(f"{backend} {precision}: {job}")
        warmup = policy.warmup(job.steps)
        latency = measure_calls(policy, job, plan.calls, advance=progress.advance)
        floor = stage_floors(policy, job, floors)
        result: dict[str, Any] = {
            "backend": policy.backend.name,
            "precision": precision,
            "job": asdict(job),
            "calls": latency["total"].calls,
            "load_seconds": policy.metadata["load_seconds"],
            "warmup_seconds": round(warmup, 2),
            "milliseconds": {name: values.as_dict() for name, values in latency.items()},
            "floor_ms": floor,
            "times_floor": latency["total"].median / floor["total"],
            "memory": _memory(device, before),
        }
        if oracle is not None and (policy.backend.name, precision) != ("pytorch", "f32"):
            result["error_against_f32"] = error_against(policy, oracle, job)
        results.append(result)
    del policy
    _free(device)
    return results


def stage_floors(policy: UnifiedPolicy, job: Job, floors: Floors) -> dict[str, float]:
    """Milliseconds under which no implementation gets, by stage and in all."""
    size = 2 if policy.backend.precision == "bf16" else 4
    work = stage_work(policy.config.model, job, size)
    stages = {
        stage: floor_ms(one, floors.matmul_flops_per_second, floors.copy_bytes_per_second)
        for stage, one in work.items()
    }
    return {**stages, "total": sum(stages.values())}


def _memory(device: torch.device, before: int) -> dict[str, int]:
    """Bytes: on a GPU what PyTorch reserved at most less what was there before; on the host the resident set."""
    status = Path("/proc/self/status")
    host = {}
    if status.exists():
        lines = dict(line.split(":", 1) for line in status.read_text().splitlines() if ":" in line)
        host = {"host_anonymous": int(lines["RssAnon"].split()[0]) * 1024}
    if device.type != "cuda":
        return host
    return {"device_reserved": torch.cuda.max_memory_reserved(device) - before, **host}


def _free(device: torch.device) -> None:
    gc.collect()
    if device.type == "cuda":
        torch.cuda.empty_cache()
