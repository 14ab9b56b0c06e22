"""`turbopi plan`: how many GPUs a fleet of robots needs."""

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from turbopi.cli.framework import JsonFlag, Output, command
from turbopi.config import LIMITS
from turbopi.errors import ConfigError
from turbopi.reading import plain_document

if TYPE_CHECKING:
    from turbopi.bench.batch_table import BatchTable
    from turbopi.serve.sizing import Fleet, Plan

MOST_ROBOTS = 10_000


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
        typer.Option("--gpu", metavar="GPU", help="Such as h100, h200, rtx4090: as of `turbopi bench --predict`."),
    ] = None,
    times: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Instead: T(B) of your GPU: results.json of `turbopi bench --batch 1,2,4,8 --report DIR`.",
        ),
    ] = None,
    precision: Annotated[str, typer.Option(metavar="NAME", help="Such as bf16, fp8.")] = "bf16",
    delay_steps: Annotated[
        int | None,
        typer.Option(metavar="N", min=1, help="Control steps of delay, at most; else as many as s and H - s allow."),
    ] = None,
    execution_horizon: Annotated[
        int | None,
        typer.Option(metavar="S", min=1, help="Control steps between two requests of a robot; else half a chunk."),
    ] = None,
    max_batch: Annotated[int | None, typer.Option(metavar="N", min=1, help="No larger batches.")] = None,
    overhead_ms: Annotated[
        float,
        typer.Option(metavar="MS", min=0, max=60_000, help="Of a request beyond the policy: network and server."),
    ] = 2.0,
    as_json: JsonFlag = False,
) -> None:
    """Say how many GPUs a fleet needs, in which batches they run, and the delay that each robot then has at most.

    All robots run the same policy. Each asks for a chunk every S control steps. Times of the policy are the 99th
    percentile of measured calls with 2 cameras, 48 prompt tokens and 10 steps; of a GPU that nobody measured they are
    predictions, and the output says so.
    """
    from turbopi.bench.batch_table import published_table, table_of_file
    from turbopi.serve.sizing import Fleet, plan_fleet

    if gpu is not None and times is not None:
        raise ConfigError(f"--gpu {gpu} and --times {times} each name the times of a policy: give one of them")
    if gpu is None and times is None:
        raise ConfigError("give --gpu GPU, or --times FILE with what was measured on yours")
    fleet = Fleet(robots, hz, horizon, execution_horizon, delay_steps, overhead_ms)
    if times is not None:
        table = table_of_file(times, precision, horizon)
    else:
        assert gpu is not None
        table = published_table(gpu, precision, horizon)
    planned = plan_fleet(fleet, table.seconds, max_batch)
    output = Output(as_json)
    for line in lines(fleet, table, planned):
        output.line(line)
    output.document(
        {"fleet": asdict(fleet), "times": plain_document(table), "predicted": table.predicted, "plan": asdict(planned)}
    )


def lines(fleet: "Fleet", table: "BatchTable", planned: "Plan") -> list[str]:
    """The plan for people."""
    each = ", ".join(f"T({size}) {seconds * 1e3:.1f}" for size, seconds in table.seconds.items())
    kind = "PREDICTED, not measured there" if table.predicted else "measured"
    serve = (
        f"turbopi serve CHECKPOINT --backend {table.backend} --precision {table.precision} --max-batch {planned.batch}"
    )
    a_second = fleet.robots * fleet.hz / fleet.steps
    each_has = f"{planned.robots_per_gpu} robot{'s' * (planned.robots_per_gpu > 1)}"
    return [
        f"{fleet.robots} robots at {fleet.hz:g} Hz, chunks of {fleet.horizon}, a new one every {fleet.steps} steps:",
        f"  {a_second:.1f} observations a second",
        f"{table.gpu}, {table.backend} {table.precision}, {kind} ({table.job}):",
        f"  {each} ms",
        f"  {table.source}",
        f"GPUs         {planned.gpus}, at most {each_has} on each",
        f"batch        {planned.batch} at most",
        f"delay        {planned.delay_steps} control steps at most "
        f"({planned.worst_seconds * 1e3:.1f} ms and {fleet.overhead_ms:g} ms overhead)",
        f"utilisation  {planned.utilisation:.0%}",
        f"run          {serve}" + (f" --ray --replicas {planned.gpus}" if planned.gpus > 1 else ""),
        *(
            [f"Batches of chunks of {table.job.horizon} weren't measured there: `turbopi bench --batch`, then --times"]
            if fleet.robots > 1 and len(table.seconds) == 1
            else []
        ),
        *(["With Ray a call takes longer: see docs/fleet.md, and --overhead-ms"] if planned.gpus > 1 else []),
    ]
