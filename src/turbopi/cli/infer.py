"""`turbopi infer`."""

import contextlib
import secrets
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.progress import Progress
from rich.table import Table

from turbopi.cli.checkpoints import robot_pipeline
from turbopi.cli.files import check_writable, load_noise
from turbopi.cli.framework import CheckpointThen, JsonFlag, Output, command, new_console
from turbopi.cli.options import ActingOptions
from turbopi.cli.timings import STAGES, timing_columns
from turbopi.support.errors import ConfigError, ObservationError
from turbopi.support.files import write_whole

if TYPE_CHECKING:
    import numpy as np

    from turbopi.config import Network
    from turbopi.policy.policy import UnifiedPolicy
    from turbopi.policy.ranges import DrawnRange
    from turbopi.policy.watch import Reading

PLOT_SUFFIXES = (".png", ".pdf", ".svg")
MAX_ROWS = 8  # of a plot; a recording's other calls are in the .npz


class _InferCommand(CheckpointThen):
    other = "OBSERVATION"


@command(
    "infer",
    cls=_InferCommand,
    shared=ActingOptions,
    examples=(
        "turbopi infer checkpoints/pi05_libero observation.npz --config pi05_libero",
        "turbopi infer checkpoints/mine my_observation/ -o mine.npz --seed 7",
        "turbopi infer --random-weights pi05_tiny recordings/20260101T120000Z --call 0",
        "turbopi infer checkpoints/my_pi052 observation.npz --generate 'tidy the table'",
    ),
)
def infer(
    options: ActingOptions,
    paths: Annotated[
        list[str],
        typer.Argument(
            metavar="[CHECKPOINT] OBSERVATION",
            help="The checkpoint's folder (none with --random-weights), then the observation: an .npz with the robot's "
            "keys; a folder with observation.json and the images that it names; or what `turbopi serve --record` "
            "wrote, a call or a folder of them.",
            show_default=False,
        ),
    ],
    out: Annotated[Path, typer.Option("--out", "-o", metavar="FILE", help="Where the actions go, an .npz.")] = Path(
        "actions.npz"
    ),
    plot: Annotated[
        Path | None,
        typer.Option("--plot", metavar="FILE", help="Where the plot goes.", show_default="beside the actions, .png"),
    ] = None,
    no_plot: Annotated[bool, typer.Option("--no-plot", help="Draw none.")] = False,
    noise: Annotated[
        Path | None,
        typer.Option("--noise", metavar="FILE", help="The noise to start from: an .npy, or `noise` in an .npz."),
    ] = None,
    seed: Annotated[
        int | None,
        typer.Option(
            "--seed", min=0, metavar="N", help="Of the noise; call i of a recording takes N + i.", show_default="new"
        ),
    ] = None,
    call: Annotated[
        int | None, typer.Option("--call", min=0, metavar="N", help="Of a recording, only call N.", show_default="all")
    ] = None,
    generate: Annotated[
        str | None,
        typer.Option(
            "--generate",
            metavar="PROMPT",
            help="Print the text that the policy writes to PROMPT ('': the observation's own), and make no actions.",
        ),
    ] = None,
    warmup: Annotated[bool, typer.Option("--warmup/--no-warmup", help="Run once before, for true times.")] = True,
    as_json: JsonFlag = False,
) -> None:
    """Turn an observation into an action chunk.

    The .npz gets `actions`, float64[H, d] in the robot's units ([N, H, d] for a recording of N calls), and `noise`, the
    noise they started from, empty for a model that takes none.
    """
    output = Output(as_json)
    checkpoint, source = options.split("infer", paths, "observation")
    if noise is not None and seed is not None:
        raise ConfigError("--noise and --seed were both given; give one of them")
    if plot is not None and no_plot:
        raise ConfigError("--plot and --no-plot were both given; give one of them")
    if generate is not None:
        if noise is not None or seed is not None or plot is not None:
            raise ConfigError("--generate makes no actions: leave out --noise, --seed and --plot")
        _print_text(options, checkpoint, _sources(Path(source), call), generate, output)
        return
    check_writable(out)
    drawing = None if no_plot else plot or out.with_suffix(".png")
    from turbopi.models import family_of
    from turbopi.policy.call_options import checked_noise
    from turbopi.policy.known_cameras import KnownCameras
    from turbopi.policy.readings import Checks
    from turbopi.realtime.messages import keeps_episode
    from turbopi.recordings import load_observation

    _check_targets(Path(source), out, drawing)
    for file in (out, drawing):
        if file is not None and file.exists():
            output.line(f"note: {file} is there, and will be replaced; --out names another file", "yellow")
    from turbopi.robots import read_state

    sources = _sources(Path(source), call)
    first = load_observation(sources[0])
    given_noise = None if noise is None else load_noise(noise)
    opened = options.open(checkpoint)
    options.tell_if_random(opened, output)
    with _naming(sources[0]):  # what is wrong with it is better known before minutes of loading
        pipeline = robot_pipeline(opened, options.make_robot(), options.default_prompt)
        seen = pipeline.see(first, resize=False)
        read_state(seen.robot.state, "state", None)
        judges_ranges = opened.format != "random"
        known = None if options.known_cameras is None else KnownCameras.load(options.known_cameras)
        checks = Checks(pipeline, opened.norm_stats, options.out_of_range, judges_ranges, known)  # type: ignore[arg-type]
    noted, ranges = _Notes(output), checks.drawn
    noted.of(sources[0], checks.reading(seen))
    model = opened.config.model
    if (noise is not None or seed is not None) and (why := family_of(model).refuses_flow) is not None:
        raise ConfigError(f"{'--seed' if noise is None else '--noise'}: {why}")
    if given_noise is not None:  # now: it is no observation's fault
        checked_noise([given_noise], (1, model.action_horizon, model.action_dim))
    policy = options.make_policy(opened, output)
    if keeps_episode(policy.metadata):
        first_one = "the first observation of an episode" if len(sources) == 1 else "one episode, in this order"
        what = "has memory" if "memory" in policy.metadata else "holds subtasks"
        output.line(f"note: this policy {what}, and takes what it is given as {first_one}", "yellow")
    draw = _noise(model, given_noise, seed, output)
    if warmup:
        if policy.backend.name == "pytorch_compile":
            output.line("warm-up: compiling, which takes a minute or more")
        output.line("Warming up …")
        output.line(f"warm-up: {policy.warmup():.2f} s")
    answers = _run(policy, sources, draw, noted)
    _show_timings([answer.timing for answer in answers], output)
    _write(out, answers, output)
    if drawing is not None:
        _plot(drawing, policy, answers, ranges)
        output.line(f"plot written to {drawing}")
    output.document(
        {
            "actions": _joined([answer.actions for answer in answers]),
            "policy_timing": [answer.timing for answer in answers],
            "out": out,
            "plot": drawing,
            "notes": [answer.notes for answer in answers],
            "policy": policy.metadata,
        }
    )


def _print_text(
    options: ActingOptions, checkpoint: str | None, sources: list[Path], prompt: str, output: Output
) -> None:
    from turbopi.recordings import load_observation

    opened = options.open(checkpoint)
    options.tell_if_random(opened, output)
    policy, texts = options.make_policy(opened, output), []
    for source in sources:
        with _naming(source):
            texts.append(policy.generate(load_observation(source), prompt=prompt or None))
        output.line("".join(letter if letter.isprintable() else "?" for letter in texts[-1]))
    output.document({"text": texts, "policy": policy.metadata})


@dataclass(frozen=True)
class _Answer:
    """One call. The observation is kept only while a plot may show it."""

    observation: dict[str, object] | None
    noise: "np.ndarray | None"
    actions: "np.ndarray"
    timing: dict[str, float]
    notes: list[dict[str, Any]]


def _check_targets(source: Path, out: Path, drawing: Path | None) -> None:
    if drawing is not None:
        check_writable(drawing)
    for file in (out, drawing):
        if file is not None and file.exists() and source.exists() and _is_of(file, source):
            raise ConfigError(f"{file} is the observation itself, or part of it: write to another file")
    if drawing is not None and drawing.absolute() == out.absolute():
        raise ConfigError(f"the actions and the plot would both be written to {out}: end the former's name in .npz")
    if out.is_file() and source.exists() and not _is_ours(out):
        raise ConfigError(
            f"{out} is there and isn't what `turbopi infer` wrote, so it isn't replaced; name another file"
        )
    if drawing is not None and drawing.suffix not in PLOT_SUFFIXES:
        raise ConfigError(f"the plot {drawing} should end in one of {', '.join(PLOT_SUFFIXES)}")


def _is_ours(file: Path) -> bool:
    """Whether a file holds what this command writes, or nothing."""
    if not file.stat().st_size:
        return True
    try:
        with zipfile.ZipFile(file) as archive:
            return set(archive.namelist()) == {"actions.npy", "noise.npy"}
    except (OSError, zipfile.BadZipFile):
        return False


def _is_of(file: Path, source: Path) -> bool:
    """Whether a file is the observation, or one of a recording's, or one that a folder's observation.json names."""
    if not source.is_dir():
        return file.samefile(source)
    place, folder = file.resolve(), source.resolve()
    if place.parent != folder:  # of a recording's run, or an image in a folder of its own
        return place.is_relative_to(folder)
    described = source / "observation.json"
    if described.is_file():
        return file.name == described.name or file.name in described.read_text(encoding="utf-8", errors="replace")
    return file.suffix in (".npz", ".json", ".jsonl")


def _sources(path: Path, call: int | None) -> list[Path]:
    """The observation at a path, or all those of a recording; `call` picks one of them."""
    from turbopi.recordings import recorded_files

    if not path.is_dir() or (path / "observation.json").is_file():
        if call is not None:
            raise ConfigError(f"--call picks one call of a recording's folder, but {path} is a single observation")
        return [path]
    files = recorded_files(path)
    if call is None:
        return files
    if call >= len(files):
        raise ConfigError(f"there is no call {call}: {path} holds {len(files)}, numbered from 0")
    return [files[call]]


def _noise(
    model: "Network", given: "np.ndarray | None", seed: int | None, output: Output
) -> Callable[[int], "np.ndarray | None"]:
    """Call i -> float32[H, action_dim]: the given noise for all, or what UnifiedPolicy draws for seed + i; None: the
    model takes none.
    """
    import numpy as np

    from turbopi.models import family_of

    if family_of(model).refuses_flow is not None:
        return lambda number: None
    if given is not None:
        return lambda number: given
    shape = (model.action_horizon, model.action_dim)
    first = secrets.randbelow(2**31) if seed is None else seed
    if seed is None:
        output.line(f"noise: seed {first} (--seed {first} gives these actions again)")
    return lambda number: np.random.default_rng(first + number).standard_normal(shape, dtype=np.float32)


class _Notes:
    """On each observation and its actions. None is compared with another: a recording may mix robots."""

    def __init__(self, output: Output) -> None:
        from turbopi.policy.watch import Watch

        self.output, self._watch = output, Watch(remembers=False, at_once=True)

    def of(self, source: Path, reading: "Reading | None") -> list[dict[str, Any]]:
        """The notes of a call, as --json has them. Printed is each once, of the same joints or cameras."""
        notes = [] if reading is None else self._watch.notes(reading)
        for note in self._watch.to_log(notes):
            self.output.line(f"note: {source}: {note.text}", "yellow")
        return [note.plain for note in notes]


def _run(
    policy: "UnifiedPolicy", sources: list[Path], draw: Callable[[int], "np.ndarray | None"], noted: _Notes
) -> list[_Answer]:
    """Every observation through the policy. ObservationError names the file of a recording that is wrong."""
    from turbopi.policy.watch import READING
    from turbopi.recordings import load_observation

    answers = []
    hidden = not noted.output.shows_progress or len(sources) == 1
    with Progress(console=new_console(stderr=True), disable=hidden, transient=True) as bar:
        for number, source in enumerate(bar.track(sources, description="observations")):
            observation, noise = load_observation(source), draw(number)
            with _naming(source):
                result = policy.infer(observation, noise=noise, readings=True)
            notes = noted.of(source, result.get(READING))
            if "subtask" in result:
                noted.output.line(f"subtask: {result['subtask']!r}")
            kept = observation if number < MAX_ROWS else None
            answers.append(_Answer(kept, noise, result["actions"], result["policy_timing"], notes))
    return answers


@contextlib.contextmanager
def _naming(source: Path) -> Iterator[None]:
    """ObservationError within names the file that is wrong."""
    try:
        yield
    except ObservationError as error:
        raise ObservationError(f"{source}: {error}") from error


def _joined(arrays: "list[np.ndarray]") -> "np.ndarray":
    """One array as it is, several stacked."""
    import numpy as np

    return arrays[0] if len(arrays) == 1 else np.stack(arrays)


def _write(out: Path, answers: list[_Answer], output: Output) -> None:
    import numpy as np

    actions = _joined([answer.actions for answer in answers])
    drawn = [answer.noise for answer in answers if answer.noise is not None]
    noise = _joined(drawn) if drawn else np.empty(0, np.float32)
    write_whole(out, lambda stream: np.savez(stream, actions=actions, noise=noise))
    output.line(f"actions [{' x '.join(map(str, actions.shape))}] written to {out}")


def _show_timings(timings: list[dict[str, float]], output: Output) -> None:
    import numpy as np

    columns = timing_columns(timings[0])
    table = Table(title="milliseconds", title_justify="left")
    if len(timings) > 1:
        table.add_column(f"of {len(timings)} calls")
    for name in columns:
        table.add_column(name, justify="right")
    values = np.array([[timing[key] for key in columns.values()] for timing in timings])
    rows = {"median": np.median(values, 0), "95 %": np.percentile(values, 95, 0), "max": values.max(0)}
    for name, row in rows.items() if len(timings) > 1 else [("", values[0])]:
        table.add_row(*([name] if name else []), *(f"{value:.1f}" for value in row))
    output.table(table)
    output.line(STAGES, "dim")


def _plot(file: Path, policy: "UnifiedPolicy", answers: list[_Answer], ranges: "tuple[DrawnRange, DrawnRange]") -> None:
    from turbopi.support.action_groups import images_of, prompt_of
    from turbopi.support.plots import Row, plot_chunks

    about = policy.metadata
    rows = [
        Row(
            f"“{prompt_of(answer.observation) or about['default_prompt'] or ''}”",
            images_of(answer.observation),
            answer.actions,
            state=policy.pipeline.state(answer.observation),
        )
        for answer in answers
        if answer.observation is not None
    ]
    title = f"{about['config']}, {about['backend']} {about['precision']} on {about['device_name']}"
    if len(rows) < len(answers):
        title += f": the first {len(rows)} of {len(answers)} calls"
    plot_chunks(
        file,
        rows,
        robot=about["robot"],
        title=title,
        random_weights=about["random_weights"],
        state_range=ranges[0],
        action_range=ranges[1],
    )
