"""`turbopi plan`: how many GPUs a fleet of robots needs."""

import math
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape

from turbopi.cli.framework import JsonFlag, Output, command
from turbopi.config import LIMITS
from turbopi.support.errors import ConfigError
from turbopi.support.reading import plain_document

if TYPE_CHECKING:
    from turbopi.bench.batch_table import BatchTable
    from turbopi.serve.fleet.sizing import Fleet, Plan

MOST_ROBOTS = 10_000
RUN = "run"  # begins the line with the command
DECODED = 1200  # observations a second, by one server (docs/fleet.md)


@command(
    "plan",
    examples=(
        "turbopi plan --robots 12 --hz 50 --horizon 50 --gpu h100",
        "turbopi plan --robots 40 --hz 30 --horizon 50 --gpu h200 --precision fp8",
        "turbopi plan --robots 8 --hz 20 --horizon 10 --gpu h200 --delay-steps 2",
        "turbopi plan --robots 8 --hz 50 --horizon 50 --times times/results.json",
    ),
)
def plan(
    robots: Annotated[int, typer.Option(metavar="N", min=1, max=MOST_ROBOTS, help="Robots, all alike.")],
    hz: Annotated[float, typer.Option("--hz", metavar="HZ", min=0.1, max=10_000, help="Control steps a second.")],
    horizon: Annotated[int, typer.Option(metavar="H", min=2, max=LIMITS["action_horizon"], help="Actions of a chunk.")],
    gpu: Annotated[
        str | None,
        typer.Option("--gpu", metavar="GPU", help="Such as h100, h200, rtx4090: as for `turbopi bench --predict`."),
    ] = None,
    times: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Instead of --gpu, what you measured: results.json of `turbopi bench --horizons H --batch 1,2,4,8 "
            "--report DIR`.",
        ),
    ] = None,
    gpus: Annotated[
        int | None, typer.Option(metavar="N", min=1, max=MOST_ROBOTS, help="Plan for so many GPUs; else the fewest.")
    ] = None,
    precision: Annotated[str, typer.Option(metavar="NAME", help="Such as bf16, fp8.")] = "bf16",
    delay_steps: Annotated[
        int | None,
        typer.Option(metavar="N", min=1, help="Control steps of delay, at most; else as many as s and H - s allow."),
    ] = None,
    execution_horizon: Annotated[
        int | None,
        typer.Option(metavar="S", min=1, help="Steps between two requests; else H / 2. H: the robot stands still."),
    ] = None,
    max_batch: Annotated[int | None, typer.Option(metavar="N", min=1, help="No larger batches.")] = None,
    overhead_ms: Annotated[
        float | None,
        typer.Option(
            metavar="MS",
            min=0,
            max=60_000,
            help="Of a request besides the policy's call: network, server. Else 2, with Ray 8.",
        ),
    ] = None,
    as_json: JsonFlag = False,
) -> None:
    """Say how many GPUs a fleet needs, in which batches they run, and the delay that each robot then has at most.

    All robots run the same policy. Each asks for a chunk every S control steps. Times of the policy are the 99th
    percentile of measured calls with 2 cameras, 48 prompt tokens and 10 steps; of a GPU that nobody measured they are
    predictions, and the output says so.
    """
    from turbopi.bench.batch_table import published_table, table_of_file
    from turbopi.serve.fleet.sizing import OVERHEAD_MS, RAY_MS, Fleet, plan_fleet

    if gpu is not None and times is not None:
        raise ConfigError(f"--gpu {gpu} and --times {times} each name the times of a policy: give one of them")
    if gpu is None and times is None:
        raise ConfigError("give --gpu GPU, or --times FILE with what was measured on yours")
    overhead = (OVERHEAD_MS, RAY_MS) if overhead_ms is None else (overhead_ms, 0.0)
    fleet = Fleet(robots, hz, horizon, execution_horizon, delay_steps, *overhead)
    if times is not None:
        table = table_of_file(times, precision, horizon)
    else:
        assert gpu is not None
        table = published_table(gpu, precision, horizon)
    planned = plan_fleet(fleet, table.seconds, max_batch, gpus)
    output = Output(as_json)
    for line in lines(fleet, table, planned):
        if line.startswith(RUN):
            output.styled(escape(line))  # to be copied whole
        else:
            output.line(line)
    output.document(
        {"fleet": asdict(fleet), "times": plain_document(table), "predicted": table.predicted, "plan": asdict(planned)}
    )


def _untried(table: "BatchTable") -> str | None:
    """Why `auto` wouldn't run this there; None if it would."""
    from turbopi.backends.qualification import KNOWN
    from turbopi.bench.batch_table import how_to_measure
    from turbopi.bench.gpus import find_gpu
    from turbopi.quantization.plan import TIERS

    if not table.predicted or table.precision in TIERS:  # a calibrated precision is the user's choice
        return None

    gpu = find_gpu(table.gpu)
    if table.backend != "fused" or any(gpu.key in name.lower().split() for name in KNOWN):
        return None
    return (
        f"{table.backend} was never run on a {gpu.name}, where `auto` qualifies it first. Measure yours with "
        f"{how_to_measure(table.job.horizon, table.precision, table.backend)}"
    )


def lines(fleet: "Fleet", table: "BatchTable", planned: "Plan") -> list[str]:
    """The plan for people."""
    from turbopi.bench.batch_table import how_to_measure
    from turbopi.quantization.plan import TIERS
    from turbopi.serve.options import ServerOptions

    each = ", ".join(f"T({size}) {seconds * 1e3:.1f}" for size, seconds in table.seconds.items())
    kind = "PREDICTED, not measured there" if table.predicted else "measured"
    serve = (
        f"turbopi serve CHECKPOINT --backend {table.backend} --precision {table.precision} --max-batch {planned.batch}"
    )
    if planned.gpus > 1:
        serve += f" --ray --replicas {planned.gpus}"
    if planned.queue_limit > ServerOptions.queue_limit:
        serve += f" --queue-limit {planned.queue_limit}"
    if fleet.robots > ServerOptions.max_clients:
        serve += f" --max-clients {fleet.robots}"
    calibrate = f"turbopi calibrate CHECKPOINT --precision {table.precision} --observations RECORDING"
    a_second = fleet.robots * fleet.hz / fleet.steps
    untried = _untried(table)
    each_has = f"{planned.robots_per_gpu} robot{'s' * (planned.robots_per_gpu > 1)}"
    reported = [
        f"{fleet.robots} robots at {fleet.hz:g} Hz, chunks of {fleet.horizon}, a new one every {fleet.steps} steps:",
        f"  {a_second:.1f} observations a second",
        f"{table.gpu}, {table.backend} {table.precision}, {kind} ({table.job}):",
        f"  {each} ms",
        f"  {table.source}",
        f"GPUs         {planned.gpus}, at most {each_has} on each",
        f"batch        {planned.batch} at most",
        f"delay        {planned.delay_steps} control steps at most "
        f"({planned.worst_seconds * 1e3:.1f} ms and {fleet.overhead(planned.gpus):g} ms overhead)",
        f"utilisation  {planned.utilisation:.0%}",
        *([f"{RUN} first    {calibrate}"] if table.precision in TIERS and untried is None else []),
        f"{RUN}          {serve}" if untried is None else f"no command is recommended: {untried}",
    ]
    if fleet.steps == fleet.horizon:
        reported.append("Robots carry out whole chunks, and stand still for the delay")
    if (alone := fleet.delay(planned.worst_seconds, 1)) < planned.delay_steps:
        reported.append(f"Without Ray, a server on each GPU: {alone} control steps at most")
    if (servers := math.ceil(a_second / DECODED)) > 1:
        reported.append(f"One server decodes some {DECODED} observations a second: take {servers} servers")
    if fleet.robots > 1 and len(table.seconds) == 1:
        measure = how_to_measure(table.job.horizon, table.precision, table.backend)
        reported.append(f"Batches of such chunks weren't measured there. Measure them with {measure}")
    return reported
