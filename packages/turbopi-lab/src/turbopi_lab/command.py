"""`turbopi study`: the entry point of the core's command line."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.table import Table

from turbopi.cli.files import check_folder, check_report
from turbopi.cli.framework import CHECK_FAILED, JsonFlag, Output, describe
from turbopi.cli.options import MOST_CALLS, CheckpointArgument, WeightOptions
from turbopi.config import LIMITS
from turbopi.support.errors import ConfigError
from turbopi_lab.studies import OF_CHECKPOINTS, STUDIES, check_names, load

if TYPE_CHECKING:
    from turbopi_lab.studies.report import Grid, Report
    from turbopi_lab.studies.study import Study

MOST_EPISODES = 100_000
LIBERO = "libero"


def study(
    options: WeightOptions,
    which: Annotated[
        str,
        typer.Argument(
            metavar="STUDY,STUDY,…",
            help="; ".join(f"{name}: {requested}" for name, requested in STUDIES.items()) + ".",
            show_default=False,
        ),
    ],
    checkpoint: CheckpointArgument = None,
    small: Annotated[
        bool, typer.Option("--small", help="In seconds, to see that it runs: the numbers mean little.")
    ] = False,
    policy: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=FOLDER",
            help="A policy of a toy task beside those that ship: `one_way` and `two_ways` of `python -m "
            "turbopi_lab.small_policy post`. May be given again.",
            show_default=False,
        ),
    ] = None,
    episodes: Annotated[
        int | None,
        typer.Option(
            metavar="N",
            min=1,
            max=MOST_EPISODES,
            help="Of each cell in closed loop: 200, or 8 in the small form; on LIBERO as many of every task, rounded "
            "up, and 2 in the small form.",
        ),
    ] = None,
    simulator: Annotated[
        str, typer.Option(metavar="NAME", help="Of studies on LIBERO: another simulator of `turbopi eval`.")
    ] = LIBERO,
    way: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME",
            help="Of studies on LIBERO: one cell, such as 'euler, uniform, 1', beside the plain policy and the "
            "control. May be given again; all unless given.",
            show_default=False,
        ),
    ] = None,
    episodes_only: Annotated[
        bool,
        typer.Option(
            "--episodes-only",
            help="Of studies on LIBERO: run the cells of --way alone, and report nothing. Several such commands may "
            "run at once with one --out.",
        ),
    ] = False,
    report_only: Annotated[
        bool,
        typer.Option(
            "--report-only",
            help="Of studies on LIBERO: report on the finished cells in --out, with neither GPU nor simulator.",
        ),
    ] = False,
    workers: Annotated[
        int | None,
        typer.Option(metavar="N", min=1, help="Processes at a time: a policy each, or on LIBERO a simulator."),
    ] = None,
    observation: Annotated[
        Path | None,
        typer.Option(
            metavar="PATH",
            help="For studies of any checkpoint: as for `turbopi infer`; else Turbo-Pi's LIBERO images.",
        ),
    ] = None,
    steps: Annotated[
        int,
        typer.Option(
            metavar="N",
            min=1,
            max=LIMITS["num_denoising_steps"],
            help="Denoising steps of precision, actions and throughput.",
        ),
    ] = 10,
    calls: Annotated[
        int, typer.Option(metavar="N", min=1, max=MOST_CALLS, help="Calls of each measurement of the throughput study.")
    ] = 100,
    seed: Annotated[int, typer.Option(metavar="N", min=0, help="Of the precision and mask studies' noise.")] = 0,
    device: Annotated[str, typer.Option("--device", metavar="DEVICE", help="auto, cpu, cuda or cuda:N.")] = "auto",
    out: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Write each study's report there: STUDY/report.json, report.md, plots."),
    ] = None,
    as_json: JsonFlag = False,
) -> None:
    """Answer research questions with controls, in one form of report.

    Ends with exit code 1 if a control failed: then the verdict means nothing.
    """
    output = Output(as_json)
    chosen = list(dict.fromkeys(which.split(",")))
    check_names(chosen)
    if out is not None:
        check_folder(out)
    studies = [load(name) for name in chosen]
    if out is not None and not episodes_only:
        _check_reports(studies, out)
    if not any(one.episodes for one in studies):
        _check_for_none(chosen, way, simulator)
    if episodes_only or report_only:
        _check_parts(studies, episodes_only, report_only, out)
    policies = _policies(policy or [])
    from turbopi import backends
    from turbopi.cli.build import given_observations
    from turbopi.support.reading import plain_document
    from turbopi_lab.studies.report import write
    from turbopi_lab.studies.study import Setup

    on = backends.resolve_device(device)
    for one in studies:
        one.check(on)
    opened = None
    if set(chosen) & set(OF_CHECKPOINTS) or checkpoint is not None or options.random_weights is not None:
        opened = options.open(checkpoint)
        options.tell_if_random(opened, output)
    setup = Setup(
        small=small,
        command=" ".join(["turbopi", *sys.argv[1:]]),
        device=on,
        checkpoint=opened,
        observations=lambda judged: given_observations(judged, observation),
        policies=policies,
        simulator=simulator,
        ways=way or (),
        folder=None if out is None else out / "episodes",
        report_only=report_only,
        workers=workers,
        episodes=episodes,
        steps=steps,
        calls=calls,
        seed=seed,
        tell=output.line,
    )
    reports: dict[str, Report] = {}
    for one in studies:
        if episodes_only:
            assert one.episodes is not None
            one.episodes(setup)
            continue
        reports[one.name] = report = one.run(setup)
        _show(report, output)
        if out is not None:
            write(report, out / one.name)
            output.line(f"wrote {out / one.name}")
    output.document({name: plain_document(report) for name, report in reports.items()})
    if not all(report.sound for report in reports.values()):
        raise typer.Exit(CHECK_FAILED)


command = describe(
    study,
    shared=WeightOptions,
    examples=(
        "turbopi study steps --small",
        "turbopi study steps --policy two_ways=work/two_ways/checkpoint --out studies",
        "turbopi study mask --random-weights pi05_tiny --device cpu",
        "turbopi study precision,mask checkpoints/pi05_libero --out studies",
        "turbopi study throughput checkpoints/pi05_libero --calls 200",
    ),
)


def _check_for_none(chosen: list[str], way: list[str] | None, simulator: str) -> None:
    """Raises ConfigError for options of studies in a simulator, where none of the chosen ones is one."""
    for option, given in (("--way", way), ("--simulator", None if simulator == LIBERO else simulator)):
        if given:
            reported = ", ".join(given) if isinstance(given, list) else given
            raise ConfigError(
                f"{option} is {reported!r}, and is for {_in_simulators()}; {', '.join(chosen)} takes none"
            )


def _in_simulators() -> str:
    return ", ".join(name for name in STUDIES if name.endswith("_libero"))


def _check_parts(studies: "list[Study]", episodes_only: bool, report_only: bool, out: Path | None) -> None:
    """Raises ConfigError where episodes can't be run apart from the report."""
    option = "--episodes-only" if episodes_only else "--report-only"
    if episodes_only and report_only:
        raise ConfigError("--episodes-only and --report-only leave nothing to do: give one of them")
    if out is None:
        raise ConfigError(f"{option} needs --out: the folder whose episodes/ has a folder for each cell")
    for one in studies:
        if one.episodes is None:
            raise ConfigError(f"{option} is for {_in_simulators()}; {one.name} keeps no episodes")


def _check_reports(studies: "list[Study]", out: Path) -> None:
    """Raises ConfigError now for a report that couldn't be written later, or that would replace another command's."""
    from turbopi_lab.studies.report import JSON

    for one in studies:
        check_report(out / one.name / JSON, "study", "a report of `turbopi study`")


def _policies(given: list[str]) -> dict[str, Path]:
    """Each NAME=FOLDER. Raises ConfigError now, not when a study comes to it."""
    policies: dict[str, Path] = {}
    for one in given:
        name, _, folder = one.partition("=")
        if not name or not folder:
            raise ConfigError(f"--policy is {one!r}; expected NAME=FOLDER, such as two_ways=work/two_ways/checkpoint")
        if name in policies:
            raise ConfigError(f"--policy {name} was given twice, as {policies[name]} and {folder}: give it once")
        if not Path(folder).is_dir():
            raise ConfigError(f"--policy is {one!r}, but there is no folder {folder}")
        policies[name] = Path(folder)
    return policies


def _show(report: "Report", output: Output) -> None:
    output.line(report.question, style="bold")
    for table in report.tables:
        output.table(_table(table))
    for control in report.controls:
        output.line(f"control {'held' if control.held else 'FAILED'}: {control.claim} {control.evidence}")
    output.line(f"verdict: {report.verdict}")


def _table(grid: "Grid") -> Table:
    from turbopi_lab.studies.report import cell_text

    table = Table(title=grid.title, title_justify="left", caption=grid.note or None)
    for column in grid.columns:
        table.add_column(column)
    for row in grid.rows:
        table.add_row(*("not finite" if cell is None else cell_text(cell) for cell in row))
    return table
