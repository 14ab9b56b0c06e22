"""Where a call's time goes, kernel by kernel."""

import torch
from torch.profiler import ProfilerActivity, profile

from turbopi.bench.measure import Observations
from turbopi.bench.work import Job
from turbopi.policy import UnifiedPolicy


def top_kernels(policy: UnifiedPolicy, job: Job, *, calls: int = 3, count: int = 15) -> list[dict[str, float | str]]:
    """The kernels (on a CPU: operators) that take longest: name, milliseconds a call, launches a call, share."""
    observations = Observations(policy, job)
    policy.infer(next(observations), num_steps=job.steps)
    on_gpu = policy.backend.device.type == "cuda"
    activity = ProfilerActivity.CUDA if on_gpu else ProfilerActivity.CPU
    with profile(activities=[activity], acc_events=True) as profiler:
        for _ in range(calls):
            policy.infer(next(observations), num_steps=job.steps)
        if on_gpu:
            torch.cuda.synchronize(policy.backend.device)
    times = {
        event.key: ((event.self_device_time_total if on_gpu else event.self_cpu_time_total), event.count)
        for event in profiler.key_averages()
    }
    total = sum(microseconds for microseconds, _ in times.values())
    top = sorted(times.items(), key=lambda item: -item[1][0])[:count]
    return [
        {
            "kernel": name,
            "ms_per_call": microseconds / calls / 1e3,
            "launches_per_call": launches / calls,
            "share": microseconds / total if total else 0.0,
        }
        for name, (microseconds, launches) in top
    ]
