"""`turbopi compare`."""

import re
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape
from rich.table import Table

from turbopi.cli.evaluate import EvalOptions, run_with_progress
from turbopi.cli.evaluate_options import COMMON_EVAL
from turbopi.cli.files import check_report
from turbopi.cli.framework import JsonFlag, Output, command
from turbopi.cli.options import PolicyOptions
from turbopi.support.errors import ConfigError
from turbopi.support.text import counted

if TYPE_CHECKING:
    from turbopi.checkpoint import Checkpoint
    from turbopi.evaluate.compare import Variant
    from turbopi.evaluate.results import Results
    from turbopi.evaluate.visited import ActionDifference


@command(
    "compare",
    shared=EvalOptions,
    common=("--checkpoint", "--simulator", *COMMON_EVAL),
    examples=(
        "turbopi compare turbopi-eval/run-a turbopi-eval/run-b",
        "turbopi compare pytorch:f32 pytorch:bf16:5 --checkpoint mine --trials 10",
        "turbopi compare fused:bf16 fused:fp8 --checkpoint mine --quantization fp8.json",
    ),
)
def compare_command(
    options: EvalOptions,
    runs: Annotated[
        list[str],
        typer.Argument(
            metavar="RUN",
            help="Two or more: folders of finished evaluations; or ways to run, each BACKEND[:PRECISION[:STEPS]].",
        ),
    ],
    checkpoint: Annotated[
        str | None, typer.Option("--checkpoint", metavar="DIR", help="The weights, unless the runs are folders.")
    ] = None,
    simulator: Annotated[
        str, typer.Option("--simulator", metavar="NAME", help="Where ways to run are evaluated.")
    ] = "libero",
    across_calibrations: Annotated[
        bool,
        typer.Option("--across-calibrations", help="Runs of the same weights may have different calibrations."),
    ] = False,
    as_json: JsonFlag = False,
) -> None:
    """The same episodes through several policies, in one table, paired with the first.

    Ways to run (backend, precision, denoising steps) are evaluated first, one after the other, with the same episodes
    and the same noise; their action error is measured against the float32 reference with the first one's number of
    steps, on observations that each of them met; all goes to turbopi-compare/ unless --out is given. Folders are
    compared as they are, and nothing is written without --out.
    """
    from turbopi.evaluate.compare import HEADS, LEGEND, cells, compare, document, write_comparison
    from turbopi.evaluate.reading import load_results
    from turbopi.evaluate.results import FILE

    output = Output(as_json)
    if given := options.of_delay():
        raise ConfigError(f"{', '.join(given)}: ways to join chunks are compared by `turbopi eval`, in one report")
    if len(runs) < 2:
        raise ConfigError(f"compare needs two runs or more, but got {len(runs)}: {' '.join(runs)}")
    folders = [(Path(run) / FILE).exists() for run in runs]
    if all(folders):
        out = options.out
        if out is not None:
            _check_out(out)
        loaded = [load_results(Path(run)) for run in runs]
        compared = compare(loaded, across_calibrations=across_calibrations)
    elif any(Path(run).is_dir() for run in runs):
        named = ", ".join(run for run, is_folder in zip(runs, folders, strict=True) if not is_folder)
        raise ConfigError(f"runs are all folders of evaluations, or all ways to run; not a folder with {FILE}: {named}")
    else:
        out = options.out or Path("turbopi-compare")
        _check_out(out)
        results, errors = _run_variants(options, runs, checkpoint, simulator, out, output)
        compared = compare(results, errors, across_calibrations=across_calibrations)
    table = Table(
        title=escape(f"{compared[0].results.suite}: {compared[0].rate.trials} episodes"),
        title_justify="left",
    )
    for number, name in enumerate(HEADS):
        table.add_column(name, justify="right" if number else "left", no_wrap=True)
    for run in compared:
        table.add_row(*map(escape, cells(run)))
    output.table(table)
    output.line(LEGEND)
    if out is not None:
        output.line(f"wrote {', '.join(str(path) for path in write_comparison(out, compared))}")
    output.document(document(compared))


def _check_out(out: Path) -> None:
    """Raises ConfigError now for what couldn't be written later, or would replace another command's file."""
    from turbopi.evaluate.compare import DOCUMENT

    check_report(out / DOCUMENT, "runs", "a comparison of `turbopi compare`")


def _run_variants(
    options: EvalOptions, texts: list[str], checkpoint: str | None, simulator_name: str, out: Path, output: Output
) -> "tuple[list[Results], list[ActionDifference | None]]":
    """Evaluate each way to run into a folder of its own, then ask the reference about what they met."""
    from turbopi.evaluate.compare import Variant
    from turbopi.evaluate.visited import Visited, action_error

    parsed = [parse_variant(text, options) for text in texts]  # first: a mistyped folder is no way to run
    options.check(checkpoint)
    opened = options.open(checkpoint)
    own_steps = opened.config.num_denoising_steps
    variants = [Variant(name, tier, own_steps if steps is None else steps) for name, tier, steps in parsed]
    if len(set(variants)) < len(variants):
        raise ConfigError(f"the same way to run is named twice in {' '.join(texts)}")
    _check_variants(variants, options, opened)
    simulator = options.simulator(simulator_name, output)
    protocol = options.protocol(simulator, simulator_name)
    jobs = options.jobs(simulator, protocol.suite)
    results, samples = [], []
    for variant in variants:
        own = _options_of(variant, options)
        source = own.local_policy(checkpoint, output)
        folder = out / variant.folder
        visited = Visited(folder, restart=options.restart)
        try:
            results.append(
                run_with_progress(
                    own, protocol, source, simulator, jobs, folder, output, max_batch=1, on_answer=visited
                )
            )
        finally:
            visited.save()
            source.close()
        samples.append(visited.entries)
    output.line(
        f"float32 reference, {counted(variants[0].steps, 'step')}, on {counted(sum(map(len, samples)), 'observation')}"
    )
    exact = replace(variants[0], backend="pytorch", precision="f32")
    reference = _options_of(exact, options).local_policy(checkpoint, output)
    return results, [action_error(entries, reference) for entries in samples]


def _options_of(variant: "Variant", options: EvalOptions) -> EvalOptions:
    """The options that a way to run is run with; a calibration is for FP8 and INT8 alone."""
    from turbopi.quantization.plan import TIERS

    own = replace(options, backend=variant.backend, precision=variant.precision, steps=variant.steps)
    return own if variant.precision in TIERS else replace(own, quantization=None, fp8_parts=None)


def _check_variants(variants: "list[Variant]", options: EvalOptions, checkpoint: "Checkpoint") -> None:
    """Refuse what can't run before hours of what can."""
    from turbopi import backends
    from turbopi.checkpoint.calibration import calibration_of
    from turbopi.policy.call_options import checked_steps
    from turbopi.policy.kept_precision import check_backend
    from turbopi.quantization.plan import TIERS

    device = backends.resolve_device(options.device)
    tiers = [variant.precision for variant in variants if variant.precision in TIERS]
    for variant in variants:
        checked_steps(variant.steps, ConfigError)
        check_backend(variant.backend, device, variant.precision, checkpoint)  # type: ignore[arg-type]  # parsed
    if not tiers and (options.quantization is not None or options.fp8_parts is not None):
        raise ConfigError("--quantization and --fp8-parts are for ways to run with a calibration, and none of these is")
    for tier in tiers:
        calibration_of(options.policy_arguments()["quantization"], tier, checkpoint)


def parse_variant(text: str, options: PolicyOptions) -> tuple[str, str, int | None]:
    """ "pytorch:bf16:5"; what is left out is --precision's and --steps', steps then None for the checkpoint's.

    Raises ConfigError for anything else.
    """
    return way_to_run(text, options, "the folder of an evaluation")


def way_to_run(text: str, options: PolicyOptions, other: str) -> tuple[str, str, int | None]:
    """`parse_variant` where `other` is what the text could have been instead."""
    from turbopi import backends

    parts = text.split(":")
    backend = parts[0]
    precision = parts[1] if len(parts) > 1 else options.precision_of(backend)
    known = backend in backends.known() and precision in backends.PRECISIONS
    if not known or len(parts) > 3 or not all(re.fullmatch("[0-9]{1,9}", steps) for steps in parts[2:]):
        raise ConfigError(
            f"{text!r} is neither {other} nor a way to run: BACKEND[:PRECISION[:STEPS]], "
            f"with a backend of {', '.join(backends.known())}, and {' or '.join(backends.PRECISIONS)}"
        )
    return backend, precision, int(parts[2]) if len(parts) > 2 else options.steps
