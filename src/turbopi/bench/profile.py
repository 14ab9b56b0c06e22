"""Where a call's time goes, kernel by kernel and stage by stage."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch.profiler import ProfilerActivity, profile, record_function

from turbopi.bench.document import Kernel, StageKernels
from turbopi.bench.measure import WARMING, Observations
from turbopi.bench.work import Job
from turbopi.policy.policy import UnifiedPolicy

STAGES = ("vision", "prefix", "denoise")
_CALL = "turbopi call"


@dataclass(frozen=True)
class Ran:
    """One kernel (on a CPU: one operator without those inside it) as it ran."""

    name: str
    start_us: float
    busy_us: float  # without the time in which a kernel before it was still running


def in_turn(kernels: Sequence[tuple[str, float, float]]) -> list[Ran]:
    """(name, start, end) as `Ran`: time in which several run belongs to the one that ends first.

    Kernels with dependent launch start early and wait for their producer: their durations overlap and don't add up.
    """
    ran, reached = [], float("-inf")
    for name, start, end in sorted(kernels, key=lambda kernel: kernel[2]):
        ran.append(Ran(name, max(start, reached), max(0.0, end - max(start, reached))))
        reached = max(reached, end)
    return ran


def start_profiler(device: torch.device) -> None:
    """Attach the profiler to the device, which must happen before a graph is captured for its kernels to be seen."""
    if device.type == "cuda":
        with profile(activities=[ProfilerActivity.CUDA]):
            torch.zeros(1, device=device).add_(1)
            torch.cuda.synchronize(device)


def stage_kernels(policy: UnifiedPolicy, job: Job, *, calls: int = 3, count: int = 8) -> dict[str, StageKernels]:
    """Stage -> the time its kernels take, how many there are, and the `count` that take longest, all a call.

    Kernels are told apart by when they ran, since graphs have no other names for stages. Timings under a profiler are a
    little longer than without. Empty where the profiler sees no kernels.
    """
    observations = Observations(policy, job)
    for _ in range(WARMING):
        policy.infer(next(observations), num_steps=job.steps)
    kernels: dict[str, list[Ran]] = {}
    for _ in range(calls):
        ran, edges = _one_call(policy, next(observations), job)
        for stage, part in zip(STAGES, split(ran, edges), strict=True):
            kernels.setdefault(stage, []).extend(part)
    return {stage: top(ran, calls, count) for stage, ran in kernels.items() if ran}


def _one_call(policy: UnifiedPolicy, observation: dict[str, object], job: Job) -> tuple[list[Ran], list[float]]:
    """What ran, and the times on the profiler's clock [us] at which each stage began and the last one ended."""
    on_gpu = policy.backend.device.type == "cuda"
    activities = [ProfilerActivity.CUDA] if on_gpu else [ProfilerActivity.CPU]
    with profile(activities=activities, acc_events=True) as profiler, record_function(_CALL):
        timing = policy.infer(observation, num_steps=job.steps)["policy_timing"]
        if on_gpu:
            torch.cuda.synchronize(policy.backend.device)
    events = profiler.events() or []
    if on_gpu:
        cuda = torch.autograd.DeviceType.CUDA
        kernels = [e for e in events if e.device_type == cuda and not e.is_user_annotation]
        ran = in_turn([(e.name, e.time_range.start, e.time_range.end) for e in kernels])
        end = max((e.time_range.end for e in kernels), default=0.0)
    else:
        call = next(e for e in events if e.name == _CALL)
        begin = call.time_range.start + (timing["preprocess_ms"] + timing["queue_ms"]) * 1e3
        ran = [Ran(e.name, e.time_range.start, e.self_cpu_time_total) for e in events if e.name != _CALL]
        ran = [one for one in ran if one.start_us >= begin]
        end = begin + sum(timing.get(f"{stage}_ms", 0.0) for stage in STAGES) * 1e3
    return ran, stage_edges([timing.get(f"{stage}_ms", 0.0) for stage in STAGES], end)


def stage_edges(stage_ms: Sequence[float], end_us: float) -> list[float]:
    """When each stage began, and the end [us]. From the end, as under a profiler a graph's first kernel is late."""
    return [end_us - 1e3 * sum(stage_ms[i:]) for i in range(len(stage_ms) + 1)]


def split(ran: Sequence[Ran], edges: Sequence[float]) -> list[list[Ran]]:
    """What began in each interval between two edges; the last one has no end."""
    ends = [*edges[1:-1], float("inf")]
    return [
        [one for one in ran if start <= one.start_us + one.busy_us / 2 < end]
        for start, end in zip(edges, ends, strict=False)
    ]


def top(ran: Sequence[Ran], calls: int, count: int) -> StageKernels:
    """Busy milliseconds and launches a call, and the `count` names with most of them."""
    times: dict[str, list[float]] = {}
    for one in ran:
        times.setdefault(one.name, []).append(one.busy_us)
    total = sum(map(sum, times.values()))
    longest = sorted(times.items(), key=lambda item: -sum(item[1]))[:count]
    kernels = [
        Kernel(name, sum(each) / calls / 1e3, len(each) / calls, sum(each) / total if total else 0.0)
        for name, each in longest
    ]
    return StageKernels(total / calls / 1e3, len(ran) / calls, kernels)
