"""The sizing table of docs/fleet.md: what `turbopi plan` says, cell by cell."""

from turbopi.bench.batch_table import published_table
from turbopi.bench.gpus import find_gpu
from turbopi.bench.measured import measured_calls
from turbopi.serve.fleet.sizing import OVERHEAD_MS, RAY_MS, Fleet, Plan, plan_fleet
from turbopi.support.errors import ConfigError

GPUS = (("h200", "fp8"), ("h200", "bf16"), ("h100", "fp8"), ("h100", "bf16"), ("rtx4090", "bf16"))
ROBOTS = (4, 8, 16, 64)
CONTROL = ((50.0, 50), (20.0, 10))  # control rate, actions of a chunk


def plan(robots: int, hz: float, horizon: int, gpu: str, precision: str) -> Plan | None:
    """What the command plans; None where one robot alone is too many."""
    try:
        times = published_table(gpu, precision, horizon)
        return plan_fleet(Fleet(robots, hz, horizon, overhead_ms=OVERHEAD_MS, ray_ms=RAY_MS), times.seconds)
    except ConfigError:
        return None


def sizing() -> list[str]:
    """Rows of robots, columns of GPUs."""
    heads = []
    for gpu, precision in GPUS:
        predicted = any(published_table(gpu, precision, horizon).predicted for _, horizon in CONTROL)
        name = find_gpu(gpu).name.removesuffix(" SXM").removeprefix("GeForce ")
        heads.append(f"{name} {precision}" + (", predicted" if predicted else ""))
    lines = [f"| robots | {' | '.join(heads)} |", "|---|" + "--:|" * len(GPUS)]
    for hz, horizon in CONTROL:
        for robots in ROBOTS:
            plans = [plan(robots, hz, horizon, gpu, precision) for gpu, precision in GPUS]
            cells = [f"{one.gpus} ({one.delay_steps})" if one else "no" for one in plans]
            lines.append(f"| {robots}, {hz:g} Hz, H = {horizon} | {' | '.join(cells)} |")
    if max(call.job.batch for call in measured_calls()) == 1:
        lines += ["", "No batches were measured yet: each observation counts as a run of its own."]
    return lines
