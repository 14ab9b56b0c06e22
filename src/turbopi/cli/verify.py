"""`turbopi verify`: a certificate for a backend on one's own weights."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.table import Table

from turbopi.cli.files import check_report
from turbopi.cli.framework import CHECK_FAILED, JsonFlag, Output, command, plain
from turbopi.cli.options import MOST_NOISES, CheckpointArgument, PolicyOptions
from turbopi.cli.progress import with_stages
from turbopi.support.files import write_whole
from turbopi.support.reading import as_document, plain_document
from turbopi.support.text import cosine, counted, denoising, significant

if TYPE_CHECKING:
    from turbopi.verify.document import CalibrationDetails, Certificate, Dimension, IntermediateDocument

FILE = "verify.json"


@command(
    "verify",
    shared=PolicyOptions,
    examples=(
        "turbopi verify --random-weights pi05_tiny --backend pytorch --precision bf16",
        "turbopi verify checkpoints/mine --backend fused --report certificate",
        "turbopi verify checkpoints/mine --observations recordings --count 32",
        "turbopi verify checkpoints/pi05_libero --precision f32 --bound 2e-6 --json",
        "turbopi verify checkpoints/mine --precision fp8 --observations recordings/new",
        "turbopi verify checkpoints/mine --backend emulated_int8 --precision int8",
    ),
)
def verify(
    options: PolicyOptions,
    checkpoint: CheckpointArgument = None,
    observations: Annotated[
        Path | None,
        typer.Option(
            "--observations",
            metavar="PATH",
            help="What `turbopi serve --record` wrote, an .npz, or a folder with observation.json. Unless given: "
            "LIBERO images for that robot, then random examples.",
        ),
    ] = None,
    count: Annotated[
        int | None,
        typer.Option(
            "--count",
            min=1,
            metavar="N",
            help="Observations, evenly spread over PATH; first those that the calibration wasn't made on.",
            show_default="8, or all",
        ),
    ] = None,
    noises: Annotated[
        int, typer.Option("--noises", min=1, max=MOST_NOISES, metavar="M", help="Noises for each observation.")
    ] = 2,
    seed: Annotated[int, typer.Option("--seed", min=0, metavar="N", help="Of the first noise.")] = 0,
    bound: Annotated[
        float | None,
        typer.Option("--bound", metavar="X", help="Hold the actions' relative rms to X instead of the stated bound."),
    ] = None,
    factor: Annotated[
        float | None,
        typer.Option("--factor", metavar="X", help="Hold the actions' relative rms to X times the control's instead."),
    ] = None,
    no_hash: Annotated[
        bool, typer.Option("--no-hash", help="Leave out the weights' fingerprint, which reads all of them once more.")
    ] = False,
    report: Annotated[
        Path | None, typer.Option("--report", metavar="DIR", help="Write verify.json and plots there.")
    ] = None,
    as_json: JsonFlag = False,
) -> None:
    """Certify a backend on your own weights and observations.

    Every named intermediate and the actions are compared with the float32 reference, beside a control: what plain
    bfloat16 does to the same inputs. Exit code 0: PASS; 1: FAIL, and the first intermediate that is off is named.
    """
    if report is not None:
        check_report(report / FILE, "intermediates", "a certificate of `turbopi verify`")
    output = Output(as_json)
    opened = options.open(checkpoint)
    from turbopi.calibrate.run import Progress
    from turbopi.verify.inputs import VerifyPlan
    from turbopi.verify.run import verify as run

    options.tell_if_random(opened, output)
    plan = VerifyPlan(
        options.policy_arguments(),
        observations,
        count,
        noises,
        seed,
        bound=bound,
        factor=factor,
        fingerprint=not no_hash,
    )
    document = with_stages(lambda progress: run(opened, plan, progress), Progress, output)
    _show(document, output)
    if report is not None:
        _write(document, report, output)
    output.line(
        "This judges the backend, not the robot's set-up: units, cameras and statistics are `turbopi replay`'s.", "dim"
    )
    output.line(document.verdict, "bold green" if document.ok else "bold red")
    output.document(document)
    if not document.ok:
        raise typer.Exit(CHECK_FAILED)


def _write(document: "Certificate", folder: Path, output: Output) -> None:
    from turbopi.verify.plots import write_plots

    folder.mkdir(parents=True, exist_ok=True)
    file = folder / FILE
    write_whole(file, json.dumps(plain(plain_document(document)), indent=1, ensure_ascii=False) + "\n")
    written = [file, *write_plots(document, folder)]
    output.line(f"wrote {', '.join(str(path) for path in written)}")


def _show(document: "Certificate", output: Output) -> None:
    from turbopi.verify.document import CalibrationDetails

    observed = document.observations
    subject = f"{document.backend} {document.precision}"
    output.line(
        f"{document.model}, {subject} on {document.policy['device_name']}, {denoising(document.policy)}; "
        f"{observed.count} observations x {observed.noises} noises"
    )
    output.line(f"weights {document.weights.fingerprint or 'not hashed'}")
    output.line(f"observations {observed.sha256}")
    if document.calibrated is not None:
        reported = as_document(document.calibrated, CalibrationDetails, "the policy's calibration")
        output.line(_calibration(reported, document.precision))
        seen = observed.calibrated_on
        said = "; record others, as on these the error looks too small" if seen else ""
        output.line(f"{seen} of {observed.count} observations were calibrated on{said}", "yellow" if seen else None)
    output.table(_intermediates(document))
    output.line(
        f"Where a name has layers or steps, the worst, with its number. Control: {document.control}. The error of "
        f"the {document.decides} decides, by their bound. Of all else `allowed` is informative: an error above it "
        "hints at where a fault may be, and fails nothing by itself.",
        "dim",
    )
    output.table(_dimensions(document.actions.dimensions))
    worst = document.actions.worst
    output.line(
        f"worst: {worst.observation}, noise seed {worst.seed}: "
        f"relative rms {significant(worst.relative_rms)}, cosine {cosine(worst.cosine)}"
    )
    for title, time in ((subject, document.latency_ms.backend), (document.oracle, document.latency_ms.oracle)):
        output.line(
            f"latency of {title}: median {time.p50:.2f} ms, p95 {time.p95:.2f} ms, {counted(time.calls, 'call')}"
        )
    if document.gpu_bytes is not None:
        output.line(f"GPU memory of {subject}, weights and all that stays: {document.gpu_bytes / 1e9:.2f} GB")
    gpu = document.provenance.gpu
    if gpu and gpu.clock_sm is not None:
        output.line(
            f"GPU {gpu.name}, driver {gpu.driver_version}, SM {gpu.clock_sm}, memory {gpu.clock_memory}, "
            f"throttling {gpu.throttling}"
        )
    if document.first_off is not None:
        informs = f" (informative: the {document.decides} decide, and they pass)" if document.ok else ""
        output.line(f"first off: {document.first_off.text}{informs}", "yellow")
    bounds = document.bounds
    own = " (overridden)" if bounds.overridden else ""
    output.line(
        f"bound{own}: {document.decides}' relative rms {significant(bounds.actions_relative_rms)}: {bounds.reason}"
    )
    for check in document.checks:
        output.line(f"{'ok  ' if check.ok else 'FAIL'} {check.text}", None if check.ok else "red")


def _calibration(reported: "CalibrationDetails", precision: str) -> str:
    """Which products run in eight bits, by what."""
    numbers = precision.split("-")[0]
    groups = {name: state if isinstance(state, str) else "in part" for name, state in reported.plan.items()}
    others = sorted(name for name, state in groups.items() if not state.startswith(numbers))
    kept = f"all but {', '.join(others)}" if others else "every site"
    of_file = f"calibration {reported.calibration} ({reported.identity[:16]}…), on {reported.observations}"
    return f"{numbers.upper()} in {kept}; {of_file}"


def _intermediates(document: "Certificate") -> Table:
    """One row a name: its worst layer or step, in proportion to what is allowed there."""
    table = Table(title="against the float32 reference, without padding", title_justify="left")
    table.add_column("intermediate")
    for column in ("relative rms", "control's", "allowed"):
        table.add_column(column, justify="right")
    table.add_column("verdict")
    for column in ("cosine", "max"):
        table.add_column(column, justify="right")
    worst: dict[str, IntermediateDocument] = {}
    for row in document.intermediates:
        if row.name not in worst or row.badness > worst[row.name].badness:
            worst[row.name] = row
    for name, row in worst.items():
        control, decides, above = row.control, name == document.decides == "actions", row.above
        if decides:
            table.add_section()
        table.add_row(
            name if row.index is None else f"{name}, {row.index}",
            significant(row.relative_rms),
            "-" if control is None else significant(control.relative_rms),
            "-" if name == "actions" and not decides else significant(row.allowed),
            ("FAIL, decides" if above else "ok, decides") if decides else ("above, informs" if above else ""),
            cosine(row.cosine),
            significant(row.max),
            style=("red" if decides else "yellow") if above else None,
        )
    return table


def _dimensions(dimensions: "list[Dimension]") -> Table:
    table = Table(title="actions in the robot's units", title_justify="left")
    table.add_column("action")
    table.add_column("unit")
    for column in ("rms", "control's rms", "max", "control's max"):
        table.add_column(column, justify="right")
    for row in dimensions:
        values = (row.rms, row.control_rms, row.max, row.control_max)
        table.add_row(row.name, row.unit, *map(significant, values))
    return table
