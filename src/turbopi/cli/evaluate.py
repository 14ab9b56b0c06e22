"""`turbopi eval`."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from turbopi.cli.api_key import ApiKey, ApiKeyFile, chosen_key
from turbopi.cli.files import check_folder, let_import_from_here
from turbopi.cli.framework import CHECK_FAILED, JsonFlag, Output, command, new_console
from turbopi.cli.options import CheckpointArgument, PolicyOptions
from turbopi.errors import ConfigError
from turbopi.reading import plain_document

if TYPE_CHECKING:
    from turbopi.evaluate.delays import Cell
    from turbopi.evaluate.plan import Job, Protocol, VideoPlan
    from turbopi.evaluate.results import Episode, Results
    from turbopi.evaluate.run import OnEpisode
    from turbopi.evaluate.schedule import OnAnswer
    from turbopi.evaluate.sources import PolicySource
    from turbopi.sim import Simulator

_EPISODES, _PROTOCOL, _RUNS, _OUTPUT = "Which episodes", "Protocol (openpi's unless given)", "How fast", "Output"
_DELAY = "Under delay"
DEFAULT_OUT = Path("turbopi-eval")


def _option(*names: str, panel: str, help: str, metavar: str | None = None, **more: Any) -> Any:
    return typer.Option(*names, metavar=metavar, help=help, rich_help_panel=panel, **more)


@dataclass(frozen=True)
class EvalOptions(PolicyOptions):
    """Which policy, which episodes, and how they are run."""

    suite: Annotated[
        str | None,
        _option("--suite", panel=_EPISODES, metavar="NAME", help="libero: spatial (default), object, goal, 10 or 90."),
    ] = None
    tasks: Annotated[
        str | None, _option("--tasks", panel=_EPISODES, metavar="N,N-N", help="Indices of tasks; all unless given.")
    ] = None
    initial_states: Annotated[
        str | None,
        _option(
            "--initial-states", panel=_EPISODES, metavar="N,N-N", help="Of each task; all unless given (LIBERO: 0-49)."
        ),
    ] = None
    trials: Annotated[
        int | None,
        _option("--trials", panel=_EPISODES, metavar="N", help="Only the first N of a task's initial states.", min=1),
    ] = None
    seed: Annotated[int, _option("--seed", panel=_PROTOCOL, metavar="N", help="Of environments and noise.", min=0)] = 7
    seeding: Annotated[
        str,
        _option(
            "--seeding",
            panel=_PROTOCOL,
            metavar="episode|task",
            help="Seed the environment before every episode, or once for each task as openpi does.",
        ),
    ] = "episode"
    replan: Annotated[
        int,
        _option("--replan", panel=_PROTOCOL, metavar="N", help="Actions carried out before the policy is asked again."),
    ] = 5
    execution: Annotated[
        str,
        _option(
            "--execution",
            panel=_DELAY,
            metavar="WAY,WAY,…",
            help="How chunks join: sync, async, ensemble, rtc, rtc_identity, rtc_trained (docs/real_time.md).",
        ),
    ] = "sync"
    delay_steps: Annotated[
        str,
        _option(
            "--delay-steps",
            panel=_DELAY,
            metavar="N,N,…",
            help="Control steps from an observation to the chunk computed from it: simulated, exact, repeatable.",
        ),
    ] = "0"
    execution_horizon: Annotated[
        str | None,
        _option("--execution-horizon", panel=_DELAY, metavar="N,N,…", help="--replan, for several at once."),
    ] = None
    max_steps: Annotated[
        int | None,
        _option("--max-steps", panel=_PROTOCOL, metavar="N", help="Limit of an episode; the suite's own unless given."),
    ] = None
    wait_steps: Annotated[
        int, _option("--wait-steps", panel=_PROTOCOL, metavar="N", help="Steps of standing still at the beginning.")
    ] = 10
    camera_px: Annotated[
        int, _option("--camera-px", panel=_PROTOCOL, metavar="N", help="Width and height that cameras are drawn at.")
    ] = 256
    image_px: Annotated[
        int, _option("--image-px", panel=_PROTOCOL, metavar="N", help="Width and height that the policy is sent.")
    ] = 224
    workers: Annotated[
        int | None,
        _option(
            "--workers", panel=_RUNS, metavar="N", help="Simulator processes; half of the CPUs unless given.", min=1
        ),
    ] = None
    max_batch: Annotated[
        int | None,
        _option(
            "--max-batch",
            panel=_RUNS,
            metavar="N",
            help="Requests that are computed together: as many as workers, and in compare 1. With 1, a run repeats "
            "bit for bit.",
            min=1,
        ),
    ] = None
    videos: Annotated[
        str,
        _option("--videos", panel=_OUTPUT, metavar="sample|all|none", help="sample: all failures and some successes."),
    ] = "sample"
    video_successes: Annotated[
        int,
        _option(
            "--video-successes", panel=_OUTPUT, metavar="N", help="Initial states of a task whose success is filmed."
        ),
    ] = 1
    smooth_videos: Annotated[
        bool,
        _option("--smooth-videos", panel=_OUTPUT, help="Draw every control step for them, which takes its time."),
    ] = False
    out: Annotated[
        Path | None, _option("--out", panel=_OUTPUT, metavar="DIR", help="Where results go, and continue; see below.")
    ] = None
    restart: Annotated[bool, _option("--restart", panel=_OUTPUT, help="Forget what the folder holds.")] = False
    record: Annotated[
        Path | None,
        _option(
            "--record",
            panel=_OUTPUT,
            metavar="DIR",
            help="Keep what the policy sees, in a new folder there: for `turbopi calibrate` and `turbopi verify`.",
        ),
    ] = None

    def simulator(self, name: str, output: Output) -> "Simulator":
        """Checked, with its warnings printed."""
        from turbopi.sim import create

        if ":" in name:
            let_import_from_here()
        simulator = create(name)
        for warning in simulator.check():
            output.line(f"warning: {warning}", "yellow")
        return simulator

    def protocol(self, simulator: "Simulator", name: str) -> "Protocol":
        from turbopi.evaluate.plan import Protocol
        from turbopi.sim import SimSettings
        from turbopi.sim.base import full_suite_name

        suite = simulator.suites[0] if self.suite is None else full_suite_name(simulator, self.suite)
        settings = SimSettings(self.seed, self.seeding, self.wait_steps, self.camera_px)  # type: ignore[arg-type]
        return Protocol(name, suite, settings, self.replan, self.image_px, self.max_steps)

    def cells(self) -> "list[Cell]":
        """The ways to run, delays and execution horizons that are asked for, in all combinations."""
        from turbopi.evaluate.delays import make_cells
        from turbopi.evaluate.plan import parse_numbers

        if self.execution_horizon is None:
            horizons = [self.replan]
        elif self.replan != type(self).replan:
            raise ConfigError("--replan and --execution-horizon say the same; give one of them")
        else:
            horizons = parse_numbers("--execution-horizon", self.execution_horizon)
        ways = [name.strip() for name in self.execution.split(",")]
        return make_cells(ways, parse_numbers("--delay-steps", self.delay_steps), horizons)

    def video_plan(self) -> "VideoPlan":
        from turbopi.evaluate.plan import VideoPlan

        return VideoPlan(self.videos, self.video_successes, self.smooth_videos)  # type: ignore[arg-type]

    def jobs(self, simulator: "Simulator", suite: str) -> "list[Job]":
        from turbopi.evaluate.plan import choose_tasks, make_jobs, parse_numbers

        wanted = None if self.tasks is None else parse_numbers("--tasks", self.tasks)
        states = None if self.initial_states is None else parse_numbers("--initial-states", self.initial_states)
        return make_jobs(choose_tasks(simulator, suite, wanted), states, self.trials, self.video_plan())

    def local_policy(self, checkpoint: str | None, output: Output) -> "PolicySource":
        """The policy in this process, warmed up."""
        from turbopi.evaluate.sources import LocalPolicy
        from turbopi.shipped import with_libero_stats

        opened = with_libero_stats(self.open(checkpoint))
        self.tell_if_random(opened, output)
        policy = self.make_policy(opened, output)
        policy.warmup()
        return LocalPolicy(policy, opened.fingerprint(trust_files=True))


@command(
    "eval",
    shared=EvalOptions,
    examples=(
        "turbopi eval libero checkpoints/pi05_libero --config pi05_libero",
        "turbopi eval libero checkpoints/pi05_libero --suite goal --trials 10",
        "turbopi eval libero --port 8000 --suite libero_10",
        "turbopi eval libero checkpoints/pi05_libero --trials 5 --control prompt",
        "turbopi eval libero --random-weights pi05_tiny --tasks 0,1 --max-steps 20",
        "turbopi eval reacher --random-weights pi05_tiny --trials 2 --videos none",
        "turbopi eval chase checkpoints/mine --execution async,rtc --delay-steps 0,2,4",
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
            help="Give the policy another task's prompt, or pictures: it should fail.",
        ),
    ] = None,
    as_json: JsonFlag = False,
) -> None:
    """Let a policy act in a simulator, and count its successes.

    The policy runs in this process, from a CHECKPOINT or --random-weights, or behind openpi's websocket protocol
    (--host, --port). The folder gets results.json, report.html, plots and videos; unless --out is given it is
    turbopi-eval/ and a name made of suite and policy. Giving the same command again continues an interrupted run,
    and retries episodes that crashed. With several ways to run (--execution), delays or execution horizons each has
    a folder of its own in it, and delays.html and delays.json compare them. Exit code 1: some episodes crashed, so the
    result isn't complete.
    """
    output = Output(as_json)
    remote = host is not None or port is not None
    if remote:
        if checkpoint is not None or options.random_weights is not None:
            raise ConfigError("--host and --port name a server's policy; give no weights beside them")
        _refuse_policy_options(options)
    else:
        options.check(checkpoint)
    if options.out is not None:
        check_folder(options.out)
    chosen = options.simulator(simulator, output)
    protocol = options.protocol(chosen, simulator)
    jobs = options.jobs(chosen, protocol.suite)
    cells = options.cells()
    _check_cells(cells, options, remote)
    if remote:
        from turbopi.evaluate.sources import RemotePolicy

        source: PolicySource = RemotePolicy(host or "127.0.0.1", port, chosen_key(api_key, api_key_file))
    else:
        source = options.local_policy(checkpoint, output)
    try:
        if control is not None:
            from turbopi.evaluate.controls import Controlled

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


def _check_cells(cells: "list[Cell]", options: EvalOptions, remote: bool) -> None:
    from turbopi.execution import way_named

    joined = sorted({cell.execution for cell in cells if way_named(cell.execution).mode is not None})
    if remote and joined:
        raise ConfigError(
            f"--execution {', '.join(joined)} tells the model of the running chunk, which isn't done over the network "
            "here: give the checkpoint instead of a server's address, or --execution sync, async or ensemble"
        )
    if options.record is not None and len(cells) > 1:
        raise ConfigError("--record keeps what one run sees: give one --execution, --delay-steps, --execution-horizon")


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
    from turbopi.evaluate.delays import FILE, HEADS, document, row, write_delays
    from turbopi.evaluate.sources import check_delay, check_fit

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
    told = document(done)
    table = Table(title=escape(f"{protocol.suite} under delay: {source.label}"), title_justify="left")
    for head in HEADS:
        table.add_column(head, justify="left" if head == "execution" else "right")
    for summary in told.cells:
        table.add_row(*row(summary))
    output.table(table)
    output.line(f"report: {page}")
    cells_told = plain_document(told)["cells"]
    output.document({"folder": folder, "file": FILE, "first": told.first, "cells": cells_told})
    return all(results.complete for _, results in done)


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
    """Check that the policy fits, then run with a bar, or a line an episode where nobody watches."""
    from turbopi.evaluate.run import default_workers, evaluate, pending, prepare
    from turbopi.evaluate.sources import check_delay, check_fit
    from turbopi.evaluate.visited import Recording

    answer = check_fit(source, simulator, protocol.sim, protocol.image_px, protocol.replan)
    if answer.problem is None:
        check_delay(protocol, simulator, len(answer.actions))
    results = prepare(folder, protocol, source, simulator, jobs, restart=options.restart)
    left = len(pending(results, jobs))
    recording = None if options.record is None or not left else Recording(options.record, source)
    hooks = [hook for hook in (on_answer, recording) if hook is not None]
    workers = min(options.workers or default_workers(), max(1, left))
    output.line(f"{protocol.suite}: {len(jobs)} episodes with {source.label} into {folder}")
    if left < len(jobs):
        output.line(f"{len(jobs) - left} of them are finished already; {left} to go")

    def answered(*request: Any) -> None:
        for hook in hooks:
            hook(*request)

    try:
        with _told(output, len(jobs), len(jobs) - left) as on_episode:
            return evaluate(
                results,
                protocol,
                source,
                simulator,
                jobs,
                num_workers=workers,
                max_batch=options.max_batch or max_batch or workers,
                videos=options.video_plan(),
                on_episode=on_episode,
                on_answer=answered if hooks else None,
            )
    finally:
        if recording is not None:
            output.line(recording.close())


@contextmanager
def _told(output: Output, total: int, done: int) -> "Iterator[OnEpisode]":
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
    why = f" ({episode.message.strip().splitlines()[-1]})" if episode.message else ""
    return (
        f"task {episode.task}, initial state {episode.initial_state}: {episode.status} after {episode.steps} steps, "
        f"{episode.seconds:.0f} s{why}"
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
