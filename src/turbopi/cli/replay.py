"""`turbopi replay`."""

import gc
import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape
from rich.table import Table

from turbopi.cli.compare import way_to_run
from turbopi.cli.files import check_report
from turbopi.cli.framework import CHECK_FAILED, JsonFlag, Output, command
from turbopi.cli.options import MOST_CALLS, CheckpointArgument, PolicyOptions
from turbopi.cli.progress import with_stages
from turbopi.cli.typed import as_typed
from turbopi.support.errors import ConfigError
from turbopi.support.text import counted

if TYPE_CHECKING:
    from turbopi.checkpoint import Checkpoint
    from turbopi.policy.policy import UnifiedPolicy
    from turbopi.replay.document import ReplayDocument
    from turbopi.replay.episodes import Dataset, Episode, Selection
    from turbopi.replay.report import Second
    from turbopi.replay.run import Settings

_OPTIONS = "Which moments"


@command(
    "replay",
    shared=PolicyOptions,
    examples=(
        "turbopi replay data/my_arm checkpoints/mine",
        "turbopi replay data/my_arm checkpoints/mine --rename top=observation/image",
        "turbopi replay data/my_arm checkpoints/mine --against checkpoints/older",
        "turbopi replay recordings checkpoints/mine --against pytorch:f32 --every 5",
    ),
)
def replay_command(
    options: PolicyOptions,
    dataset: Annotated[
        Path,
        typer.Argument(
            metavar="DATASET",
            help="A LeRobotDataset's folder (v2.0, v2.1, v3.0), a recording of `turbopi serve`, or a folder of .npz or "
            ".hdf5 episodes.",
            show_default=False,
        ),
    ],
    checkpoint: CheckpointArgument = None,
    against: Annotated[
        str | None,
        typer.Option(
            "--against",
            metavar="CHECKPOINT|RUN",
            help="A second policy on the same moments with the same noise: another checkpoint, or this one run in "
            "another way, BACKEND[:PRECISION[:STEPS]].",
        ),
    ] = None,
    against_config: Annotated[
        str | None,
        typer.Option(
            "--against-config",
            metavar="PRESET|FILE",
            help="--config of that checkpoint.",
            show_default="--config's",
        ),
    ] = None,
    episodes: Annotated[
        str | None,
        typer.Option(
            "--episodes",
            metavar="N,N-N",
            help="Only these, by their number in the dataset.",
            rich_help_panel=_OPTIONS,
            show_default="all, or evenly spread ones",
        ),
    ] = None,
    every: Annotated[
        int | None,
        typer.Option(
            "--every",
            min=1,
            max=MOST_CALLS,
            metavar="N",
            help="Every N-th step of an episode.",
            rich_help_panel=_OPTIONS,
            show_default="what takes about a minute",
        ),
    ] = None,
    task: Annotated[
        str | None, typer.Option("--task", metavar="TEXT", help="The prompt, instead of the recorded one.")
    ] = None,
    rename: Annotated[
        list[str] | None,
        typer.Option(
            "--rename",
            metavar="KEY=KEY",
            help="The dataset's key and the robot's, such as top=observation/image; may be repeated. The recorded "
            "actions are called `actions`.",
        ),
    ] = None,
    changed: Annotated[
        int,
        typer.Option(
            "--changed",
            min=0,
            max=1000,
            metavar="N",
            help="Moments at which inputs are also changed on purpose (cameras exchanged, colours, turned), to find "
            "such a mistake in the data; 0: none.",
        ),
    ] = 12,
    seed: Annotated[int, typer.Option("--seed", min=0, metavar="N", help="Of the first moment's noise.")] = 0,
    report: Annotated[
        Path, typer.Option("--report", metavar="DIR", help="Where replay.html, its plots and replay.json go.")
    ] = Path("turbopi-replay"),
    as_json: JsonFlag = False,
) -> None:
    """Run a policy over recorded episodes and compare its chunks with the actions that were recorded.

    The first thing to know before a robot moves: does it do the right thing on my data? Errors are shown for each
    action and each index of the chunk, beside what a chunk for another moment would be wrong by, in the terminal and on
    a page with the worst moments. Exit code 1: the chunks don't follow what was recorded, or the numbers show
    a mistake in the data. LeRobotDatasets need the extra `replay`.
    """
    output = Output(as_json)
    from turbopi.replay.episodes import ACTIONS
    from turbopi.replay.keys import parse_renames
    from turbopi.replay.lerobot_dataset import INFO
    from turbopi.replay.opening import open_dataset
    from turbopi.replay.page import DOCUMENT
    from turbopi.replay.report import CAMERAS
    from turbopi.replay.run import Settings, chosen_episodes

    wanted = None if episodes is None else parse_numbers(episodes)
    renames = parse_renames(rename or [])
    options.check(checkpoint)
    if checkpoint is not None and (Path(checkpoint) / INFO).is_file():
        raise ConfigError(f"{checkpoint} is a dataset, but it comes first: turbopi replay DATASET CHECKPOINT")
    check_report(report / DOCUMENT, "verdict", "a report of `turbopi replay`")
    data = open_dataset(dataset, renames.get(ACTIONS))
    selected = chosen_episodes(data, wanted)
    opened = options.open(checkpoint)
    options.tell_if_random(opened, output)
    second = _second(against, against_config, options, opened)
    settings = Settings({key: name for key, name in renames.items() if key != ACTIONS}, task, seed, changed)
    document = _run(options, opened, second, data, selected, every, settings, report, output)
    _show(document, output)
    output.line(f"wrote {report}: replay.html, its plots, {DOCUMENT}")
    if (report / CAMERAS).is_file():
        output.line(
            f"next: turbopi serve … --known-cameras {report / CAMERAS} notes exchanged, BGR or turned cameras from "
            "the robot's first call on"
        )
    output.document(document)
    if not document.verdict.passed:
        raise typer.Exit(CHECK_FAILED)


def parse_numbers(text: str) -> list[int]:
    """ "0,3,7-9". Raises ConfigError for anything else."""
    found: list[int] = []
    for part in text.split(","):
        if not re.fullmatch(r"\d{1,9}(-\d{1,9})?", part.strip()):
            raise ConfigError(f"--episodes {text}: {part!r} is neither a number nor two such as 7-9")
        low, _, high = part.strip().partition("-")
        numbers = range(int(low), int(high or low) + 1)
        if not numbers or len(numbers) > MOST_CALLS:
            raise ConfigError(f"--episodes {text}: {part} holds {len(numbers)} episodes; expected 1 to {MOST_CALLS}")
        found += numbers
    return found


def _second(text: str | None, config: str | None, options: PolicyOptions, opened: "Checkpoint") -> "Second | None":
    """What --against names. Raises ConfigError."""
    if text is None:
        if config is not None:
            raise ConfigError("--against-config is for the checkpoint of --against, which wasn't given")
        return None
    from turbopi import backends
    from turbopi.policy.kept_precision import check_backend
    from turbopi.quantization.plan import TIERS
    from turbopi.replay.report import Second, name_of

    if Path(text).exists():
        own = replace(options, random_weights=None, weights_seed=None, config=config or options.config)
        other = own.open(text)
        return Second(own, other, name_of(other))
    if config is not None:
        raise ConfigError(f"--against-config is for a checkpoint, and --against {text} is none")
    backend, precision, steps = way_to_run(text, options, "a checkpoint's folder")
    check_backend(backend, backends.resolve_device(options.device), precision, opened)  # type: ignore[arg-type]  # parsed
    own = replace(options, backend=backend, precision=precision, steps=steps)
    if precision not in TIERS:  # a calibration is for FP8 and INT8 alone
        own = replace(own, quantization=None, fp8_parts=None)
    return Second(own, opened, f"{backend} {precision}" + ("" if steps is None else f", {steps} steps"))


def _run(
    options: PolicyOptions,
    opened: "Checkpoint",
    second: "Second | None",
    data: "Dataset",
    episodes: "Sequence[Episode]",
    every: int | None,
    settings: "Settings",
    folder: Path,
    output: Output,
) -> "ReplayDocument":
    from turbopi.replay.report import Report
    from turbopi.replay.run import Replay, Replayed, affordable, select

    def ready(policy: "UnifiedPolicy") -> Replay:
        made = Replay(policy, data, episodes, settings)
        for line in made.keys.described:
            output.line(f"key: {line}")
        return made

    def run(made: Replay, selection: "Selection") -> Replayed:
        def work(report: tuple[Callable[[str, int], None], Callable[[], None]]) -> Replayed:
            report[0]("moments", selection.count)
            return made.run(selection, report[1])

        return with_stages(work, lambda begin, advance: (begin, advance), output)

    first = ready(options.make_policy(opened, output))
    output.line("Warming up …")
    seconds = first.warm_up()
    selection = select(episodes, every, affordable(seconds, first.changes))
    rate = "" if data.fps is None else f", {data.fps:g} steps a second: a chunk covers {first.horizon / data.fps:.2g} s"
    output.line(f"{data.path}: {data.kind}{rate}")
    each = "" if selection.every == 1 else f", one in {selection.every}"
    output.line(
        f"{selection.count} of {counted(selection.of_moments, 'moment')}{each}, from {len(selection.episodes)} of "
        f"{counted(selection.of_episodes, 'episode')}, {seconds * 1e3:.0f} ms each"
    )
    report = Report(data, selection, settings, first, run(first, selection), opened)
    if second is not None:
        del first
        gc.collect()  # its weights make room for the other's
        own = second.options
        own.tell_if_random(second.checkpoint, output)
        other = ready(own.make_policy(second.checkpoint, output))
        other.warm_up()
        report.add(second, run(other, selection))
    return report.write(folder)


def _show(document: "ReplayDocument", output: Output) -> None:
    from turbopi.replay.page import (
        against_text,
        changed_row,
        columns_by_index,
        index_rows,
        joint_heads,
        joint_rows,
    )

    first = document.policies[0]
    output.table(_table("each action, in the robot's units", joint_heads(document), joint_rows(document), 2))
    heads = ["action of the chunk", *columns_by_index(document)]
    output.table(_table("relative error by index in the chunk", heads, index_rows(document)))
    if first.changed:
        rows = [changed_row(one) for one in first.changed]
        output.table(_table("with inputs changed on purpose", ["inputs", "error", "as recorded", "nearer at"], rows))
    output.line(
        "Errors are absolute differences to what was recorded. relative: in units of the model's normalised actions, "
        "half of what nearly all of the training's actions range over, or one standard deviation.",
        "dim",
    )
    for note in document.notes:
        output.line(as_typed(f"note: {note}"), "yellow")
    if document.against is not None:
        output.line(against_text(document))
    colour = {"follows": "bold green", "differs": "bold red"}.get(document.verdict.level, "bold yellow")
    output.line(document.verdict.text, colour)
    for hint in document.verdict.hints:
        output.line(as_typed(f"- {hint}"), "yellow")


def _table(title: str, heads: "Sequence[str]", rows: "Sequence[Sequence[str]]", numbers_from: int = 1) -> Table:
    table = Table(title=title, title_justify="left")
    for number, head in enumerate(heads):
        table.add_column(head, justify="right" if number >= numbers_from else "left")
    for row in rows:
        table.add_row(*map(escape, row))
    return table
