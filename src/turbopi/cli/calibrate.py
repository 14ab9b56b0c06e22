"""`turbopi calibrate`: FP8, INT8 or NVFP4 scales for one's own checkpoint, from one's own observations."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.table import Table

from turbopi.cli.files import check_writable
from turbopi.cli.framework import JsonFlag, Output, command
from turbopi.cli.options import MOST_NOISES, MOST_OBSERVATIONS, CheckpointArgument, RobotOptions
from turbopi.cli.progress import with_stages
from turbopi.config import LIMITS
from turbopi.support.errors import ConfigError
from turbopi.support.text import counted, significant

if TYPE_CHECKING:
    from turbopi.calibrate.report import ActionsError
    from turbopi.quantization.calibration_file import Quantization


@command(
    "calibrate",
    shared=RobotOptions,
    examples=(
        "turbopi calibrate checkpoints/mine --observations recordings",
        "turbopi calibrate checkpoints/pi05_libero --config pi05_libero --out fp8.json",
        "turbopi calibrate checkpoints/mine --precision int8 --observations recordings",
        "turbopi calibrate --random-weights pi05_tiny --out tiny_fp8.json --noises 2",
    ),
)
def calibrate(
    options: RobotOptions,
    checkpoint: CheckpointArgument = None,
    precision: Annotated[
        str,
        typer.Option(
            "--precision",
            metavar="fp8|int8|nvfp4",
            help="int8: for compute capability 8.0-8.7; also for 8.9, 9.0, 12.x. nvfp4: for 10.x, 11.0, 12.x.",
        ),
    ] = "fp8",
    observations: Annotated[
        str | None,
        typer.Option(
            "--observations",
            metavar="PATH",
            help="What `turbopi serve --record` wrote, a folder of observations, or an .npz. Unless given: LIBERO "
            "images, for that robot. random-noise: noise alone, which every output of the policy will say.",
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            "-o",
            metavar="FILE",
            help="Where the calibration is written.",
            show_default="turbopi_fp8.json, or _int8, _nvfp4, beside the weights",
        ),
    ] = None,
    count: Annotated[
        int, typer.Option("--count", min=2, max=MOST_OBSERVATIONS, metavar="N", help="At most so many observations.")
    ] = 64,
    noises: Annotated[
        int, typer.Option("--noises", min=1, max=MOST_NOISES, metavar="M", help="Noises for each of them.")
    ] = 1,
    seed: Annotated[int, typer.Option("--seed", min=0, metavar="N", help="Of the first noise.")] = 0,
    target: Annotated[
        float,
        typer.Option(
            "--target",
            min=0,
            max=1,
            metavar="X",
            help="Cosine between this precision's deltas (actions less noise) and float32's: sites stay in bf16 until "
            "it is reached.",
        ),
    ] = 0.9975,
    steps: Annotated[
        int | None,
        typer.Option(
            "--steps",
            min=1,
            max=LIMITS["num_denoising_steps"],
            metavar="N",
            help="Denoising steps; else the checkpoint's.",
        ),
    ] = None,
    batch: Annotated[
        int, typer.Option("--batch", min=1, max=1024, metavar="N", help="Observations at once; fewer take less memory.")
    ] = 8,
    device: Annotated[str, typer.Option("--device", metavar="DEVICE", help="auto, cpu, cuda or cuda:N.")] = "auto",
    tokenizer: Annotated[str | None, typer.Option("--tokenizer", metavar="FILE", help="SentencePiece model.")] = None,
    as_json: JsonFlag = False,
) -> None:
    """Prepare a checkpoint for FP8, INT8 or NVFP4: scales of activations, and which matmuls had better stay in bf16.

    Runs the float32 policy on your observations over all denoising steps, tries several ways to choose scales, and
    measures the error of the actions on observations that were held out. The file that it writes holds for these
    weights and this precision alone. No hardware with such numbers is needed.
    """
    output = Output(as_json)
    from turbopi.quantization.formats import FORMATS
    from turbopi.quantization.plan import FP8_TIERS

    format = next((one for one in FORMATS.values() if one.name == precision), None)
    if format is None:
        why = "calibrate for fp8, whose file it takes" if precision in FP8_TIERS else f"choose {' or '.join(FORMATS)}"
        raise ConfigError(f"--precision {precision!r} isn't what calibration is for; {why}")
    opened = options.open(checkpoint)
    from turbopi.calibrate.run import Progress, Settings, check_family
    from turbopi.calibrate.run import calibrate as run
    from turbopi.checkpoint.calibration import BESIDE

    check_family(opened, format)
    if out is None and (checkpoint is None or options.random_weights is not None):
        raise ConfigError("there is no checkpoint's folder to write beside: name a file with --out FILE")
    out = out or Path(str(checkpoint)) / BESIDE[format.name]
    check_writable(out)
    replaced = _replaced(out)
    options.tell_if_random(opened, output)
    arguments = {
        "num_denoising_steps": steps,
        "device": device,
        "tokenizer": tokenizer,
        "robot": options.make_robot(),
    }
    settings = Settings(arguments, observations, count, noises, seed, target, batch, format=format)
    result = with_stages(lambda progress: run(opened, settings, progress), Progress, output)
    result.save(out)
    _show(result, output)
    output.line(f"wrote {out}" + (f", in place of the calibration on {replaced} that was there" if replaced else ""))
    output.document({"out": out, **result.as_json(directions=False)})


def _replaced(out: Path) -> str | None:
    """What the calibration that stands at `out` was made on; None if nothing stands there. ConfigError for anything
    else: it would be lost.
    """
    from turbopi.quantization.calibration_file import Quantization
    from turbopi.support.errors import CalibrationError

    if not out.exists():
        return None
    try:
        return str(Quantization.load(out).report["observations"]["source"])
    except CalibrationError as error:
        raise ConfigError(
            f"{out} is there and no calibration, so it isn't replaced; give another --out: {error}"
        ) from error


def _show(result: "Quantization", output: Output) -> None:
    from turbopi.calibrate.report import read_report

    report = read_report(result.report, result.numbers)
    seen, worst = report.observations, report.held_out.worst
    output.line(
        f"{report.model}: {len(seen.calibration)} observations ({seen.source}), {len(seen.held_out)} more "
        f"held out; noises for each: {seen.noises}; {counted(report.steps, 'step')}, on {report.device}"
    )
    methods = ", ".join(f"{name} {significant(error.relative_rms)}" for name, error in report.methods.items())
    output.line(f"scales chosen by {report.method} (the actions' relative rms with each way: {methods})")
    output.table(
        _table(f"one group of sites in {result.format.label} alone, calibration observations", report.groups_alone)
    )
    title = "held-out observations, against float32; sites that are kept run in float32 here"
    output.table(_table(title, report.held_out.errors()))
    output.line(
        f"worst: {worst.observation}, noise seed {worst.seed}: relative rms {significant(worst.relative_rms)}; "
        f"largest saturation {significant(max(site.saturated for site in result.sites.values()))}"
    )
    if report.target_reached is not None:
        verdict = "met" if report.target_reached else "NOT met"
        target = f"the target for {result.numbers}, {report.target:g}, is {verdict}"
        output.line(f"cosine of the deltas (actions less noise): {target}")
    kept: dict[str, list[str]] = {}
    for name, site in result.sites.items():
        if site.kept is not None:
            kept.setdefault(site.kept, []).append(name)
    for reason, names in kept.items():
        shown = ", ".join(names[:6]) + (f" and {len(names) - 6} more" if len(names) > 6 else "")
        output.line(f"stays in bf16: {shown}: {reason}", "yellow")
    for warning in result.warnings:
        output.line(f"WARNING: {warning}", "bold yellow")
    took = ", ".join(f"{what} {seconds:.1f} s" for what, seconds in report.seconds.items())
    output.line(took, "dim")


def _table(title: str, errors: "dict[str, ActionsError]") -> Table:
    table = Table(title=title, title_justify="left")
    table.add_column("")
    for column in ("relative rms of the actions", "cosine of the deltas", "largest error"):
        table.add_column(column, justify="right")
    for name, error in errors.items():
        table.add_row(name, significant(error.relative_rms), f"{error.delta_cosine:.6f}", significant(error.max))
    return table
