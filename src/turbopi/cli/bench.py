"""`turbopi bench`: the machine's floors, then the policy's calls beside them."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from turbopi.cli.framework import JsonFlag, Output, command, new_console
from turbopi.cli.options import CheckpointArgument, WeightOptions
from turbopi.errors import ConfigError

if TYPE_CHECKING:
    import torch

    from turbopi.bench.run import Plan
    from turbopi.checkpoint import Checkpoint


def _numbers(option: str, text: str) -> list[int]:
    try:
        values = [int(part) for part in text.split(",")]
    except ValueError:
        raise ConfigError(f"{option} is {text!r}; expected whole numbers with commas between, such as 1,5,10") from None
    if min(values) < 1:
        raise ConfigError(f"{option} has {min(values)}; expected whole numbers from 1")
    return values


@command(
    "bench",
    shared=WeightOptions,
    examples=(
        "turbopi bench --random-weights pi05_tiny --calls 20",
        "turbopi bench --random-weights pi05_libero --backends pytorch,cuda_graph --steps 1,3,10",
        "turbopi bench checkpoints/pi05_libero --profile --report bench-report",
    ),
)
def bench(
    options: WeightOptions,
    checkpoint: CheckpointArgument = None,
    backends: Annotated[str, typer.Option(metavar="NAME,NAME,…", help="From `turbopi backends`.")] = "auto",
    precisions: Annotated[str, typer.Option(metavar="bf16,f32")] = "bf16",
    cameras: Annotated[str, typer.Option(metavar="N,N,…", help="Valid cameras, of three.")] = "2",
    prompt_tokens: Annotated[str, typer.Option(metavar="N,N,…", help="Valid prompt tokens.")] = "48",
    horizons: Annotated[str, typer.Option(metavar="N,N,…", help="Actions in a chunk.")] = "10",
    steps: Annotated[str, typer.Option(metavar="N,N,…", help="Denoising steps.")] = "10",
    calls: Annotated[int, typer.Option(min=1, help="Calls of each measurement, after three for warm-up.")] = 100,
    error: Annotated[bool, typer.Option(help="Also measure the error against the float32 reference.")] = True,
    profile: Annotated[bool, typer.Option("--profile", help="Name the kernels that take longest.")] = False,
    device: Annotated[str, typer.Option(metavar="DEVICE", help="auto, cpu, cuda or cuda:N.")] = "auto",
    tokenizer: Annotated[str | None, typer.Option(metavar="FILE", help="SentencePiece model.")] = None,
    report: Annotated[Path | None, typer.Option(metavar="DIR", help="Write results.json and plots there.")] = None,
    as_json: JsonFlag = False,
) -> None:
    """Measure the policy's latency, each stage beside the floor that this machine sets.

    Every call gets new pictures, another prompt and new noise, and is timed from host to host.
    """
    from turbopi import backends as registry
    from turbopi.bench.plots import write_plots
    from turbopi.bench.run import Plan, run

    output = Output(as_json)
    opened = options.open(checkpoint)
    options.tell_if_random(opened, output)
    resolved = registry.resolve_device(device)
    names = [registry.choose(resolved)[0] if name == "auto" else name for name in backends.split(",")]
    plan = Plan(
        names,
        precisions.split(","),  # type: ignore[arg-type]  # checked when a backend is created
        _numbers("--cameras", cameras),
        _numbers("--prompt-tokens", prompt_tokens),
        _numbers("--horizons", horizons),
        _numbers("--steps", steps),
        calls,
        error,
        tokenizer,
    )
    document = _run_with_bar(lambda progress: run(opened, plan, resolved, progress), plan, output)
    if profile:
        document["profile"] = _profiles(opened, plan, resolved)
    _show(document, output)
    if report is not None:
        report.mkdir(parents=True, exist_ok=True)
        (report / "results.json").write_text(json.dumps(document, indent=1) + "\n")
        written = [report / "results.json", *write_plots(document, report)]
        output.line(f"wrote {', '.join(str(path) for path in written)}")
    output.document(document)


def _run_with_bar(work: Any, plan: "Plan", output: Output) -> dict[str, Any]:
    from turbopi.bench.run import Progress as Told

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    console = new_console(stderr=True)
    with Progress(*columns, console=console, transient=True, disable=not output.shows_progress) as bar:
        task = bar.add_task("", total=plan.total_calls)
        told = Told(lambda text: bar.update(task, description=text), lambda: bar.advance(task))
        document: dict[str, Any] = work(told)
    return document


def _profiles(checkpoint: "Checkpoint", plan: "Plan", device: "torch.device") -> list[dict[str, Any]]:
    from turbopi.bench.measure import bench_policy
    from turbopi.bench.profile import top_kernels

    profiles = []
    for precision in plan.precisions:
        for name in plan.backends:
            job = next(plan.jobs(plan.horizons[0]))
            policy = bench_policy(checkpoint, name, precision, device, job, plan.tokenizer)
            policy.warmup(job.steps)
            profiles.append({"backend": name, "precision": precision, "kernels": top_kernels(policy, job)})
    return profiles


def _show(document: dict[str, Any], output: Output) -> None:
    for precision, floor in document["floors"].items():
        launch = "" if floor["launch_us"] is None else f", a launch in a graph {floor['launch_us']:.2f} us"
        output.line(
            f"floors, {precision}: copy {floor['copy_bytes_per_second'] / 1e12:.3f} TB/s, "
            f"matrix product {floor['matmul_flops_per_second'] / 1e12:.3f} TFLOP/s{launch}"
        )
    table = Table(title=f"{document['model']}, {document['weights']}: milliseconds, medians", title_justify="left")
    for column in ("backend", "job"):
        table.add_column(column)
    columns = ("vision", "prefix", "denoise", "device", "total", "p95", "p99", "floor", "x floor", "error")
    for column in columns:
        table.add_column(column, justify="right")
    for result in document["results"]:
        table.add_row(*_row(result))
    output.table(table)
    output.line("device: the stages' sum; total: host to host; error: relative rms of the actions against float32")
    for one in document.get("profile", ()):
        output.table(_profile_table(one))


def _row(result: dict[str, Any]) -> list[str]:
    times, job = result["milliseconds"], result["job"]

    def median(stage: str) -> str:
        return f"{times[stage]['p50']:.2f}" if stage in times else "-"

    error = result.get("error_against_f32")
    return [
        f"{result['backend']} {result['precision']}",
        f"{job['cameras']} cam, {job['prompt_tokens']} tok, H={job['horizon']}, {job['steps']} steps",
        *(median(stage) for stage in ("vision", "prefix", "denoise", "device", "total")),
        f"{times['total']['p95']:.2f}",
        f"{times['total']['p99']:.2f}",
        f"{result['floor_ms']['total']:.2f}",
        f"{result['times_floor']:.1f}",
        f"{error['relative_rms']:.4f}" if error else "-",
    ]


def _profile_table(profile: dict[str, Any]) -> Table:
    table = Table(title=f"top kernels of {profile['backend']} {profile['precision']}", title_justify="left")
    table.add_column("kernel", max_width=80)
    for column in ("ms a call", "launches a call", "share"):
        table.add_column(column, justify="right")
    for kernel in profile["kernels"]:
        numbers = (f"{kernel['ms_per_call']:.3f}", f"{kernel['launches_per_call']:.0f}", f"{kernel['share']:.1%}")
        table.add_row(kernel["kernel"], *numbers)
    return table
