"""`turbopi bench`: the machine's floors, then the policy's calls beside them."""

import itertools
import json
import sys
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from msgspec.structs import replace
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from turbopi.cli.files import check_report
from turbopi.cli.framework import CHECK_FAILED, JsonFlag, Output, command, new_console
from turbopi.cli.options import MOST_CALLS, CheckpointArgument, RobotOptions, own_precision
from turbopi.cli.predict import show_predictions
from turbopi.cli.tables import tell_apart
from turbopi.config import CAMERAS, LIMITS, ModelConfig, typed_grid
from turbopi.support.errors import ConfigError
from turbopi.support.files import write_whole
from turbopi.support.reading import plain_document, shown

if TYPE_CHECKING:
    import torch

    from turbopi.backends import Precision
    from turbopi.bench.document import BenchDocument, Profile, Ready, Result, StageKernels
    from turbopi.bench.run import BenchPlan, BenchProgress
    from turbopi.bench.work import Join
    from turbopi.checkpoint import Checkpoint
    from turbopi.robots import Robot

RESULTS = "results.json"
_ONE = {"--cameras": "2", "--prompt-tokens": "48", "--horizons": "10", "--steps": "10", "--batch": "1"}
_TABLE = _ONE | {"--cameras": "1,2,3", "--prompt-tokens": "48,200", "--horizons": "10,50", "--steps": "1,2,3,5,10"}


CALLS, SECONDS = 100, 60.0  # unless given
MOST_PIXELS = 8192  # of a camera's width or height
_MOST = {
    "--cameras": len(CAMERAS),
    "--prompt-tokens": LIMITS["max_prompt_tokens"],
    "--horizons": LIMITS["action_horizon"],
    "--steps": LIMITS["num_denoising_steps"],
    "--batch": 1024,
}


def _numbers(option: str, text: str) -> list[int]:
    try:
        values = [int(part) for part in text.split(",")]
    except ValueError:
        raise ConfigError(
            f"{option} is {shown(text)}; expected whole numbers with commas between, such as 1,5,10"
        ) from None
    wrong = [value for value in values if not 1 <= value <= _MOST[option]]
    if wrong:
        raise ConfigError(f"{option} has {shown(wrong[0])}; expected whole numbers from 1 to {_MOST[option]}")
    return list(dict.fromkeys(values))


def _image_sizes(text: str) -> list[tuple[int, int]]:
    """Width and height of each, in order, each once."""
    sizes = []
    for part in text.split(","):
        width, _, height = part.strip().partition("x")
        if not (width.isdecimal() and height.isdecimal() and all(1 <= int(n) <= MOST_PIXELS for n in (width, height))):
            raise ConfigError(
                f"--image-size has {shown(part)}; expected width x height, each from 1 to {MOST_PIXELS}, with commas "
                "between, such as 640x480,1280x720"
            )
        sizes.append((int(width), int(height)))
    return list(dict.fromkeys(sizes))


def _axis(option: str, given: str | None, table: bool) -> list[int]:
    """What was given, else the table's numbers or the usual one."""
    return _numbers(option, (_TABLE if table else _ONE)[option] if given is None else given)


def _robots_own(
    axes: dict[str, str | None], table: bool, checkpoint: "Checkpoint", robot: "str | Robot", tokenizer: str | None
) -> dict[str, str | None]:
    """The axes of a benchmark with a robot's own observations: these have its cameras, images and prompt."""
    from turbopi.bench.measure import robots_job

    clash = [option for option in ("--cameras", "--image-size", "--prompt-tokens") if axes[option] is not None]
    clash += ["--table"] if table else []
    if clash:
        raise ConfigError(f"--robot brings its own cameras and prompt: leave out {', '.join(clash)}, or --robot")
    job = robots_job(checkpoint, robot, tokenizer)
    return {
        "--cameras": str(job.cameras),
        "--image-size": f"{job.image_width}x{job.image_height}",
        "--prompt-tokens": str(job.prompt_tokens),
        "--horizons": axes["--horizons"] or str(job.horizon),
        "--steps": axes["--steps"] or str(job.steps),
        "--batch": axes["--batch"],
    }


def _model(options: RobotOptions, checkpoint: str | None) -> ModelConfig:
    """The sizes of the weights that were named; of Pi0.5 if none were. No weight is loaded."""
    if checkpoint is None and options.random_weights is None:
        return ModelConfig()
    return options.open(checkpoint).config.planned_model


def _joins(text: str) -> "list[Join]":
    from turbopi.bench.work import JOINS

    names = _names(text)
    if not names or (wrong := [name for name in names if name not in JOINS]):
        raise ConfigError(f"--join has {shown(wrong[0] if names else text)}; expected some of {', '.join(JOINS)}")
    known: dict[str, Join] = {name: name for name in JOINS}  # msgspec leaves out a default if it is the same object
    return list(dict.fromkeys(known[name] for name in names))


def _names(text: str) -> list[str]:
    return [name for name in text.split(",") if name]


def _backends(
    names: list[str], precisions: "list[Precision]", device: "torch.device", checkpoint: "Checkpoint"
) -> list[str]:
    """The same with "auto" as what it stands for in each precision. Raises what `check_backend` raises for that."""
    from turbopi import backends
    from turbopi.policy.kept_precision import check_backend

    found = []
    for name, precision in itertools.product(names, precisions):
        if name == "auto":
            chosen = backends.choose(device, precision)[0]
            check_backend(chosen, device, precision, checkpoint)
        found.append(chosen if name == "auto" else name)
    return list(dict.fromkeys(found))


@command(
    "bench",
    shared=RobotOptions,
    examples=(
        "turbopi bench --random-weights pi05_tiny --calls 20",
        "turbopi bench --random-weights pi05_libero --backends cuda_graph --steps 1,10",
        "turbopi bench checkpoints/mine --table --ready --profile --report bench-report",
        "turbopi bench checkpoints/mine --backends fused --precisions bf16,fp8",
        "turbopi bench checkpoints/pi05_libero --image-size 224x224,640x480,1280x720",
        "turbopi bench checkpoints/my_arm --config pi05_base --robot my_arm.json",
        "turbopi bench checkpoints/mine --horizons 50 --batch 1,2,4,8 --report times",
        "turbopi bench --predict rtx4090,rtx5090,orin,thor",
    ),
)
def bench(
    options: RobotOptions,
    checkpoint: CheckpointArgument = None,
    backends: Annotated[str, typer.Option(metavar="NAME,NAME,…", help="From `turbopi doctor`.")] = "auto",
    beside: Annotated[
        str, typer.Option(metavar="NAME,NAME,…", help="Backends that are measured on the main job alone.")
    ] = "",
    precisions: Annotated[
        str | None,
        typer.Option(
            metavar="NAME,NAME,…", help="As for `turbopi serve`; else bf16, or what the backends have instead."
        ),
    ] = None,
    table: Annotated[
        bool, typer.Option("--table", help="All of 1, 2, 3 cameras; 48, 200 tokens; H = 10, 50; 1, 2, 3, 5, 10 steps.")
    ] = False,
    cameras: Annotated[str | None, typer.Option(metavar="N,N,…", help="Valid cameras, of three; else 2.")] = None,
    prompt_tokens: Annotated[str | None, typer.Option(metavar="N,N,…", help="Valid prompt tokens; else 48.")] = None,
    horizons: Annotated[str | None, typer.Option(metavar="N,N,…", help="Actions in a chunk; else 10.")] = None,
    steps: Annotated[str | None, typer.Option(metavar="N,N,…", help="Denoising steps; else 10.")] = None,
    solver: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="As for `turbopi serve`; --steps counts its evaluations. Not with --join."),
    ] = None,
    time_grid: Annotated[
        str | None, typer.Option("--time-grid", metavar="NAME|T,T,…", help="As for `turbopi serve`. Not with --join.")
    ] = None,
    batch: Annotated[str | None, typer.Option(metavar="N,N,…", help="Observations of one call; else 1.")] = None,
    image_size: Annotated[
        str | None, typer.Option(metavar="WxH,WxH,…", help="Of the cameras' images; else 224x224, the model's.")
    ] = None,
    join: Annotated[
        str | None,
        typer.Option(
            metavar="NAME,NAME,…",
            help="Chunks that join a running one (docs/real_time.md): none, held (a quarter of the actions), guided by "
            "identity or jacobian, or paint.",
        ),
    ] = None,
    calls: Annotated[
        int,
        typer.Option(metavar="N", min=1, max=MOST_CALLS, help="Calls of each measurement, after three for warm-up."),
    ] = CALLS,
    main_calls: Annotated[
        int | None,
        typer.Option(
            metavar="N",
            min=1,
            max=MOST_CALLS,
            help="Calls of the main job (2 cameras, 48 tokens, H = 10, 10 steps, or the nearest).",
        ),
    ] = None,
    seconds: Annotated[
        float,
        typer.Option(metavar="S", min=0, help="A measurement ends after so many seconds, though not before 20 calls."),
    ] = SECONDS,
    error: Annotated[
        bool, typer.Option(help="Also the error against the float32 reference, for the main job's cameras and prompt.")
    ] = True,
    ready: Annotated[
        bool, typer.Option("--ready", help="Also the time from a program's start to its first answer.")
    ] = False,
    profile: Annotated[bool, typer.Option("--profile", help="Name the kernels that take longest, by stage.")] = False,
    device: Annotated[str, typer.Option("--device", metavar="DEVICE", help="auto, cpu, cuda or cuda:N.")] = "auto",
    tokenizer: Annotated[str | None, typer.Option(metavar="FILE", help="SentencePiece model.")] = None,
    quantization: Annotated[str | None, typer.Option(metavar="FILE", help="What `turbopi calibrate` wrote.")] = None,
    predict: Annotated[
        str | None,
        typer.Option(
            metavar="GPU,GPU,…",
            help="Measure nothing: predict what calls take on these GPUs, from published numbers. Needs no GPU and no "
            "checkpoint.",
        ),
    ] = None,
    report: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Write results.json, report.md and plots there.")
    ] = None,
    as_json: JsonFlag = False,
) -> None:
    """Measure the policy's latency, each stage beside its floor: the least time that this machine needs for it.

    Every call gets new images, another prompt and new noise, and is timed from host to host. With --robot the
    observations are random ones of that robot, with its cameras and its prompt, and the job has the checkpoint's own
    horizon and steps unless they are given.
    """
    output = Output(as_json)
    axes = {"--cameras": cameras, "--prompt-tokens": prompt_tokens, "--horizons": horizons, "--steps": steps}
    axes |= {"--batch": batch}
    if predict is not None:
        given = {"--backends": backends != "auto", "--beside": beside, "--precisions": precisions, "--join": join}
        given |= {"--image-size": image_size, "--main-calls": main_calls, "--ready": ready, "--profile": profile}
        given |= {"--solver": solver, "--time-grid": time_grid, "--tokenizer": tokenizer, "--device": device != "auto"}
        given |= {"--calls": calls != CALLS, "--seconds": seconds != SECONDS, "--no-error": not error}
        given |= {"--quantization": quantization, "--robot": options.robot, "--report": report}
        numbers = {option: _axis(option, text, table) for option, text in axes.items()}
        ignored = [option for option, value in given.items() if value]
        show_predictions(_names(predict), _model(options, checkpoint), numbers, output, ignored=ignored)
        return
    from turbopi.bench.ready import empty_caches

    # before Triton is imported and looks for its cache: what the measured starts compile serves this process, too
    with empty_caches() if ready else nullcontext():
        from turbopi import backends as registry
        from turbopi.bench.measure import writes_tokens
        from turbopi.bench.run import BenchPlan, run
        from turbopi.checkpoint.quantized_folder import precision_kept
        from turbopi.policy.call_options import Denoising

        opened = options.open(checkpoint)
        options.tell_if_random(opened, output)
        if opened.format == "onnx":
            if error:
                output.line("the folder holds ONNX graphs and no weights: no error against the float32 reference")
            backends, device, error = backends.replace("auto", "onnx"), device.replace("auto", "cpu"), False
        if (kept := precision_kept(opened)) is not None:
            if error:
                output.line(f"the folder holds weights in {kept} alone: no error against the float32 reference")
            precisions, error = precisions or kept, False
        resolved = registry.resolve_device(device)
        chosen = _names(own_precision(_names(backends)) if precisions is None else precisions)
        tiers: list[Precision] = chosen  # type: ignore[assignment]  # checked when a backend is created
        names = _backends(_names(backends), tiers, resolved, opened)
        robot = options.make_robot()
        if writes_tokens(opened.config) and horizons is not None:
            raise ConfigError(f"--horizons: {opened.config.name} writes tokens, --steps of them, and has no horizon")
        axes["--image-size"] = image_size
        own = Denoising(1).changed(None, solver, typed_grid(time_grid), ConfigError)  # type: ignore[arg-type]
        if axes["--steps"] is None and isinstance(own.time_grid, tuple):
            axes["--steps"] = str(own.steps)  # a grid's own
        if robot is not None:
            axes = _robots_own(axes, table, opened, robot, tokenizer)
        plan = BenchPlan(
            names,
            tiers,
            cameras=_axis("--cameras", axes["--cameras"], table),
            prompt_tokens=_axis("--prompt-tokens", axes["--prompt-tokens"], table),
            horizons=_axis("--horizons", axes["--horizons"], table),
            steps=_axis("--steps", axes["--steps"], table),
            image_sizes=_image_sizes(axes["--image-size"] or "224x224"),
            joins=_joins("none" if join is None else join),
            batches=_axis("--batch", axes["--batch"], table),
            robot=robot,
            calls=calls,
            error=error,
            tokenizer=tokenizer,
            beside=[name for name in _names(beside) if name not in names],
            main_calls=main_calls,
            seconds=seconds,
            profile=profile,
            quantization=quantization,
            solver=None if solver is None else own.solver,
            time_grid=None if time_grid is None else own.time_grid,
        )
        plan.check(resolved, opened)
        if ready and (plan.solver, plan.time_grid) != (None, None):
            raise ConfigError("--ready starts programs with openpi's steps: give it without --solver and --time-grid")
        if report is not None:
            check_report(report / RESULTS, "floors", "a benchmark's results")
        starts = _starts(checkpoint, options, plan, str(resolved)) if ready else []
        document = _run_with_bar(lambda progress: run(opened, plan, resolved, progress), plan, report, output)
    reported = replace(document.provenance, command=["turbopi", *sys.argv[1:]])
    document = replace(document, provenance=reported, ready=starts if ready else None)
    _show(document, output)
    if report is not None:
        written = _write(document, report)
        output.line(f"wrote {', '.join(str(path) for path in written)}")
    output.document(document)
    if document.failed:
        raise typer.Exit(CHECK_FAILED)


def _starts(checkpoint: str | None, options: RobotOptions, plan: "BenchPlan", device: str) -> "list[Ready]":
    """How long a program with each of the plan's main backends takes until its first answer."""
    from turbopi.bench.ready import Start, measure_ready

    seed, steps = options.weights_seed or 0, plan.main.steps
    starts = []
    for precision, name, _ in plan.policies():
        if name in plan.backends:
            weights = (checkpoint, options.random_weights, seed, options.config)
            start = Start(*weights, name, precision, device, steps, plan.tokenizer, plan.quantization, options.robot)
            starts.append(measure_ready(start))
    return starts


def _run_with_bar(
    work: "Callable[[BenchProgress], BenchDocument]", plan: "BenchPlan", folder: Path | None, output: Output
) -> "BenchDocument":
    from turbopi.bench.run import BenchProgress

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    console = new_console(stderr=True)
    with Progress(*columns, console=console, transient=True, disable=not output.shows_progress) as bar:
        task = bar.add_task("", total=plan.total_calls)

        def keep(document: "BenchDocument") -> None:
            if folder is not None:
                _write_results(document, folder)

        reported = BenchProgress(lambda text: bar.update(task, description=text), lambda: bar.advance(task), keep)
        return work(reported)


def _write(document: "BenchDocument", folder: Path) -> list[Path]:
    from turbopi.bench.plots import write_plots
    from turbopi.bench.report import report

    results, page = _write_results(document, folder), folder / "report.md"
    write_whole(page, report(document))
    return [results, page, *write_plots(document, folder)]


def _write_results(document: "BenchDocument", folder: Path) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    results = folder / RESULTS
    write_whole(results, json.dumps(plain_document(document), indent=1) + "\n")
    return results


def _show(document: "BenchDocument", output: Output) -> None:
    from turbopi.bench.document import label
    from turbopi.bench.report import floors_line

    for precision, floor in document.floors.items():
        output.line(floors_line(precision, floor))
    # in one column: where the table is cut into parts, each says which row is whose
    names, job = tell_apart([[label(one), *_job(one)] for one in document.results])
    title = f"{document.model}, {document.weights}: milliseconds, medians"
    table = Table(title=f"{title}\n{job}" if job else title, title_justify="left")
    table.add_column("backend and job" if any(", " in name for name in names) else "backend")
    columns = ("vision", "prefix", "denoise", "device", "total", "p5", "p95", "p99", "floor", "x floor", "error")
    for column in columns:
        table.add_column(column, justify="right")
    for name, result in zip(names, document.results, strict=True):
        table.add_row(name, *_row(result))
    output.table(table)
    for broken in document.failed:
        output.line(f"{label(broken)} failed: {broken.error}", "red")
    units = "" if document.robot is None else ", in the robot's units"
    output.line(
        f"device: the stages' sum; total: host to host; error: relative rms of the actions against float32{units}"
    )
    for text in document.warnings or ():
        output.line(f"WARNING: {text}", "bold yellow")
    for line in document.linear or ():
        shaped = document.main_job.of_horizon and f", H={line.horizon}"
        output.line(
            f"{label(line)}, {line.cameras} cameras, {line.prompt_tokens} tokens{shaped}: {line.a_ms:.2f} + "
            f"{line.b_ms:.3f} x {document.main_job.unit} ms, off by {line.worst_ms:.2f}"
        )
    for start in document.ready or ():
        for kind, took in (("cold", start.cold), ("cached", start.cached)):
            parts = f"import {took.imports:.1f}, load {took.load:.1f}, warmup {took.warmup:.1f}"
            output.line(f"{label(start)}, kernels {kind}: ready in {took.ready:.1f} s ({parts})")
    for one in document.profile or ():
        if not one.stages:
            output.line(f"{label(one)}: the profiler saw no kernels", "yellow")
        for stage, part in one.stages.items():
            output.table(_profile_table(one, stage, part))


def _job(result: "Result") -> list[str]:
    job = result.job
    cameras, batch, joined = f"{job.cameras} cam{job.of_size}", job.of_batch.strip(", "), job.joined.strip(", ")
    return [cameras, f"{job.prompt_tokens} tok", job.of_horizon.strip(", "), batch, job.of_steps, joined]


def _row(result: "Result") -> list[str]:
    from turbopi.bench.report import PERCENTILES, error_of

    times = result.milliseconds

    def median(stage: str) -> str:
        return times[stage].text() if stage in times else "-"

    return [
        *(median(stage) for stage in ("vision", "prefix", "denoise", "device", "total")),
        *(times["total"].text(percentile) for percentile in PERCENTILES),
        f"{result.floor_ms['total']:.2f}",
        f"{result.times_floor:.1f}",
        error_of(result),
    ]


def _profile_table(profile: "Profile", stage: str, part: "StageKernels") -> Table:
    from turbopi.bench.document import label

    title = f"{label(profile)}, {stage}: kernels {part.busy_ms:.2f} ms"
    table = Table(title=f"{title} in {part.launches:.0f} launches", title_justify="left")
    table.add_column("kernel", max_width=80)
    for column in ("ms a call", "launches a call", "share"):
        table.add_column(column, justify="right")
    for kernel in part.kernels:
        numbers = (f"{kernel.ms_per_call:.3f}", f"{kernel.launches_per_call:.0f}", f"{kernel.share:.1%}")
        table.add_row(kernel.kernel, *numbers)
    return table
