"""`turbopi eval`."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import fields
from itertools import zip_longest
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from turbopi.cli.api_key import ApiKey, ApiKeyFile, chosen_key
from turbopi.cli.capabilities import capabilities_of
from turbopi.cli.evaluate_options import COMMON_EVAL, EvalOptions
from turbopi.cli.files import check_folder, check_replaces
from turbopi.cli.framework import CHECK_FAILED, JsonFlag, Output, command, new_console
from turbopi.cli.options import CheckpointArgument, PolicyOptions
from turbopi.cli.tables import tell_apart
from turbopi.cli.typed import as_typed
from turbopi.support.errors import ConfigError
from turbopi.support.reading import plain_document
from turbopi.support.text import counted

if TYPE_CHECKING:
    from turbopi.checkpoint import Checkpoint
    from turbopi.evaluate.delays import Cell, CellSummary
    from turbopi.evaluate.plan import Job, Protocol
    from turbopi.evaluate.results import Episode, Results
    from turbopi.evaluate.run import OnEpisode
    from turbopi.evaluate.schedule import OnAnswer
    from turbopi.evaluate.sources import PolicySource
    from turbopi.sim import Simulator

DEFAULT_OUT = Path("turbopi-eval")


@command(
    "eval",
    shared=EvalOptions,
    common=("--host", "--port", *COMMON_EVAL),
    examples=(
        "turbopi eval libero checkpoints/pi05_libero --config pi05_libero",
        "turbopi eval libero checkpoints/pi05_libero --suite goal --trials 10",
        "turbopi eval libero --port 8000 --suite libero_10",
        "turbopi eval libero checkpoints/pi05_libero --trials 5 --control prompt",
        "turbopi eval libero --random-weights pi05_tiny --tasks 0,1 --max-steps 20",
        "turbopi eval reacher --random-weights pi05_tiny --trials 2 --videos none",
        "turbopi eval chase checkpoints/mine --execution async,rtc --delay-steps 0,2,4",
        "turbopi eval chase checkpoints/mine --execution async,rtc --real-time",
        "turbopi eval chase --port 8000 --execution rtc_trained --delay-steps 4",
    ),
)
def evaluate_command(
    options: EvalOptions,
    simulator: Annotated[
        str,
        typer.Argument(metavar="SIMULATOR", help="libero; chase, a task that forgives no delay; or reacher, a toy."),
    ],
    checkpoint: CheckpointArgument = None,
    host: Annotated[
        str | None, typer.Option("--host", metavar="HOST", help="Evaluate a policy server: openpi's or Turbo-Pi's.")
    ] = None,
    port: Annotated[
        int | None, typer.Option("--port", "-p", min=1, max=65535, metavar="N", help="Its port; 8000 unless given.")
    ] = None,
    api_key: ApiKey = None,
    api_key_file: ApiKeyFile = None,
    control: Annotated[
        str | None,
        typer.Option(
            "--control",
            metavar="prompt|pictures",
            help="Give the policy another task's prompt, or images: it should fail.",
        ),
    ] = None,
    as_json: JsonFlag = False,
) -> None:
    """Let a policy act in a simulator, and count its successes.

    The policy runs in this process, from a CHECKPOINT or --random-weights, or behind openpi's websocket protocol
    (--host, --port). The folder gets results.json, report.html, plots and videos; unless --out is given it is
    turbopi-eval/ and a name made of suite and policy. Giving the same command again continues an interrupted run,
    and retries episodes that crashed. With several ways to run (--execution), delays or execution horizons each has
    a folder of its own in it, and delays.html and delays.json compare them. With --real-time the world doesn't wait for
    the policy, and delays are measured. Exit code 1: some episodes crashed, so the
    result isn't complete.
    """
    output = Output(as_json)
    from turbopi.evaluate.controls import Controlled, check_control
    from turbopi.sim import SIMULATORS

    if simulator not in SIMULATORS and Path(simulator).is_dir():
        raise ConfigError(f"{simulator} is a folder, but the simulator comes first: turbopi eval SIMULATOR CHECKPOINT")
    check_control(control)
    options.check_real_time()
    remote = host is not None or port is not None
    if remote:
        if checkpoint is not None or options.random_weights is not None:
            raise ConfigError("--host and --port name a server's policy; give no weights beside them")
        _refuse_policy_options(options)
    else:
        options.check(checkpoint)
    for written in (options.out or DEFAULT_OUT, options.record):
        if written is not None:
            check_folder(written)
    chosen = options.simulator(simulator, output)
    protocol = options.protocol(chosen, simulator)
    jobs = options.jobs(chosen, protocol.suite)
    cells = options.cells()
    if options.record is not None and len(cells) > 1:
        raise ConfigError("--record keeps what one run sees: give one --execution, --delay-steps, --execution-horizon")
    from turbopi.evaluate.checks import check_way
    from turbopi.evaluate.sources import RemotePolicy

    if remote:
        source: PolicySource = RemotePolicy(host or "127.0.0.1", port, chosen_key(api_key, api_key_file))
    else:
        source = options.local_policy(
            checkpoint, output, lambda opened: _check_cells(options, opened, cells, protocol, chosen)
        )
    try:
        for cell in cells:
            check_way(source, cell.protocol(protocol))
        if control is not None:
            instructions = [job.task.instruction for job in jobs]
            source = Controlled(source, control, instructions, chosen.image_keys)  # type: ignore[arg-type]
        folder = options.out or DEFAULT_OUT / _folder_name(protocol.suite, source.label, source.about)
        if len(cells) > 1:
            complete = _run_cells(options, protocol, cells, source, chosen, jobs, folder, output)
        else:
            protocol = cells[0].protocol(protocol)
            results = run_with_progress(options, protocol, source, chosen, jobs, folder, output)
            _show(results, output)
            output.document({"folder": results.folder, **plain_document(results.summary())})
            complete = results.complete
    finally:
        source.close()
    if not complete:
        raise typer.Exit(CHECK_FAILED)


def _check_cells(
    options: EvalOptions, opened: "Checkpoint", cells: "list[Cell]", protocol: "Protocol", simulator: "Simulator"
) -> None:
    """Raise ConfigError for what the policy won't be able to do, before its weights are loaded."""
    from turbopi.evaluate.checks import check_delay, check_offered

    offered, horizon = capabilities_of(options, opened).real_time, opened.config.model.action_horizon
    for cell in cells:
        own = cell.protocol(protocol)
        check_offered(offered, None, own)
        check_delay(own, simulator, horizon)


def _run_cells(
    options: EvalOptions,
    protocol: "Protocol",
    cells: "list[Cell]",
    source: "PolicySource",
    simulator: "Simulator",
    jobs: "list[Job]",
    folder: Path,
    output: Output,
) -> bool:
    """Each cell in a folder of its own, and the report of all. Returns whether every episode has a verdict."""
    from turbopi.evaluate.checks import check_delay, check_fit
    from turbopi.evaluate.delays import FILE, document, notes, write_delays

    check_replaces(folder / FILE, "cells", "a report of `turbopi eval`")
    answer = check_fit(source, simulator, protocol.sim, protocol.image_px, min(cell.horizon for cell in cells))
    for cell in cells:  # what can't be run is better known before the first one is
        if answer.problem is None:
            check_delay(cell.protocol(protocol), simulator, len(answer.actions))
    done: list[tuple[Cell, Results]] = []
    try:
        for cell in cells:
            own = cell.protocol(protocol)
            done.append((cell, run_with_progress(options, own, source, simulator, jobs, folder / cell.folder, output)))
    finally:
        page = write_delays(folder, done) if done else None
    reported = document(done)
    output.table(_delays_table(f"{protocol.suite} under delay: {source.label}", reported.cells))
    for note in notes(reported.cells, protocol.control_hz):
        output.line(note, "yellow")
    output.line(f"report: {page}")
    cells_reported = plain_document(reported)["cells"]
    output.document({"folder": folder, "file": FILE, "first": reported.first, "cells": cells_reported})
    return all(results.complete for _, results in done)


def _delays_table(title: str, cells: "Sequence[CellSummary]") -> Table:
    """As on the page, but for the way, the delay and the horizon, which are in one column: where the table is cut into
    parts, each says which row is whose. Columns in which no row has a number are left out.
    """
    from turbopi.evaluate.delays import heads, row

    measured = cells[0].delay is None  # and then it is a column
    ways = [[one.execution, "" if measured else f"delay {one.delay}", f"horizon {one.horizon}"] for one in cells]
    names, shared = tell_apart(ways)
    table = Table(title=escape(f"{title}, {shared}" if shared else title), title_justify="left")
    table.add_column("execution")
    of_way = ("execution", "horizon") if measured else ("execution", "delay", "horizon")
    columns = [
        (head, texts)
        for head, *texts in zip_longest(heads(cells), *map(row, cells), fillvalue="-")
        if head not in of_way and set(texts) != {"-"}
    ]
    for head, _ in columns:
        table.add_column(escape(head), justify="right")
    for name, *texts in zip(names, *(texts for _, texts in columns), strict=True):
        table.add_row(name, *map(escape, texts))
    return table


def _refuse_policy_options(options: EvalOptions) -> None:
    """A server's policy is as the server made it. Raises ConfigError for options that would say otherwise."""
    given = [
        f"--{field.name.replace('_', '-')}"
        for field in fields(PolicyOptions)
        if getattr(options, field.name) != field.default
    ]
    if given:
        raise ConfigError(f"the server decides about {', '.join(given)}: start it with them (turbopi serve)")


def run_with_progress(
    options: EvalOptions,
    protocol: "Protocol",
    source: "PolicySource",
    simulator: "Simulator",
    jobs: "list[Job]",
    folder: Path,
    output: Output,
    *,
    max_batch: int | None = None,
    on_answer: "OnAnswer | None" = None,
) -> "Results":
    """Check that the policy fits, warm it up, then run with a bar, or a line an episode where nobody watches.

    max_batch   requests that are computed together, unless the options say; None: as many as workers
    """
    from turbopi.evaluate.checks import check_delay, check_fit
    from turbopi.evaluate.pacing import rate_given
    from turbopi.evaluate.run import default_workers, evaluate, most_at_once, pending, prepare
    from turbopi.evaluate.visited import Recording
    from turbopi.realtime import way_named

    answer = check_fit(source, simulator, protocol.sim, protocol.image_px, protocol.replan)
    if answer.problem is None:
        check_delay(protocol, simulator, len(answer.actions))
    results = prepare(folder, protocol, source, simulator, jobs, restart=options.restart)
    to_run = pending(results, jobs)
    left = len(to_run)
    workers = 1 if options.real_time else min(options.workers or default_workers(), most_at_once(protocol, to_run))
    max_batch = options.max_batch or max_batch or workers
    hz = protocol.control_hz
    paced = "" if hz is None else f" in real time ({rate_given(hz, simulator.control_hz)})"
    output.line(f"{protocol.suite}: {len(jobs)} episodes{paced} with {source.label} into {folder}")
    if left < len(jobs):
        output.line(f"{len(jobs) - left} of them are finished already; {left} to go")
    if left:  # a worker has one request at a time
        source.warm_up(min(workers, max_batch), way_named(protocol.execution).mode, output.line)
    recording = None if options.record is None or not left else Recording(options.record, source)
    hooks = [hook for hook in (on_answer, recording) if hook is not None]

    def answered(*request: Any) -> None:
        for hook in hooks:
            hook(*request)

    try:
        with _reported(output, len(jobs), len(jobs) - left) as on_episode:
            return evaluate(
                results,
                protocol,
                source,
                simulator,
                jobs,
                num_workers=workers,
                max_batch=max_batch,
                videos=options.video_plan(),
                on_episode=on_episode,
                on_answer=answered if hooks else None,
            )
    finally:
        if recording is not None:
            output.line(recording.close())


@contextmanager
def _reported(output: Output, total: int, done: int) -> "Iterator[OnEpisode]":
    """Progress: a bar with the running success on a terminal, else a line an episode."""
    if not output.shows_progress:
        yield lambda episode, results: output.line(f"{_line(episode)}; {_running(results)}")
        return
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=new_console(stderr=True)) as bar:
        task = bar.add_task("starting simulators", total=total, completed=done)

        def ended(episode: "Episode", results: "Results") -> None:
            if episode.message:
                bar.console.print(_line(episode), markup=False, highlight=False)
            bar.update(task, advance=1, description=_running(results))

        yield ended


def _line(episode: "Episode") -> str:
    why = f" ({as_typed(episode.message.strip().splitlines()[-1])})" if episode.message else ""
    return (
        f"task {episode.task}, initial state {episode.initial_state}: {episode.status} after "
        f"{counted(episode.steps, 'step')}, {episode.seconds:.0f} s{why}"
    )


def _running(results: "Results") -> str:
    from turbopi.evaluate.results import rate

    episodes = results.episodes.values()
    crashes = sum(not episode.judged for episode in episodes)
    return f"success {rate(episodes)}" + (f", {crashes} crashed" if crashes else "")


def _show(results: "Results", output: Output) -> None:
    from turbopi.evaluate.results import rate

    episodes = results.in_order()
    table = Table(title=escape(f"{results.suite}: {results.label}"), title_justify="left")
    table.add_column("task", justify="right")
    table.add_column("instruction", overflow="fold")
    for name in ("solved", "success [95 % interval]", "steps", "crashed"):
        table.add_column(name, justify="right")
    rows = [
        (str(index), task.instruction, [e for e in episodes if e.task == index])
        for index, task in results.tasks.items()
    ]
    for index, instruction, own in [*rows, ("", "all", episodes)]:
        solved, found = [e.steps for e in own if e.success], rate(own)
        steps = f"{sum(solved) / len(solved):.0f}" if solved else "-"
        crashes = sum(not e.judged for e in own)
        if own:
            table.add_row(
                index, escape(instruction), f"{found.successes}/{found.trials}", str(found), steps, str(crashes or "-")
            )
    output.table(table)
    summary = results.summary()
    for ms, what in ((summary.call_ms, "the policy's whole call"), (summary.infer_ms, "the model alone")):
        if ms is not None:
            output.line(f"{what}: p50 {ms.p50:.1f}, p95 {ms.p95:.1f}, p99 {ms.p99:.1f} ms")
    if summary.real_time is not None and results.control_hz is not None:
        from turbopi.evaluate.pacing import allows_for_lateness, knows_pace

        output.line(knows_pace(summary.real_time, results.control_hz))
        if (late := allows_for_lateness(summary.real_time, results.control_hz)) is not None:
            output.line(late, "yellow" if summary.real_time.is_real_time else "red")
    if summary.aborted:
        output.line(
            f"{summary.aborted} episodes were aborted, as actions weren't finite; they count as failures", "red"
        )
    if summary.crashes:
        output.line(
            f"{summary.crashes} episodes crashed and count as nothing; the same command tries them again", "red"
        )
    output.line(f"report: {results.folder / 'report.html'}")


def _folder_name(suite: str, label: str, about: dict[str, Any]) -> str:
    text = "-".join(str(part) for part in (suite, about.get("config"), label) if part)
    return "".join(letter if letter.isalnum() or letter in "-_." else "-" for letter in text)[:80]
