"""`turbopi inspect` and `turbopi convert`."""

import json
import shutil
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.markup import escape
from rich.table import Table

from turbopi.cli.framework import CheckpointThen, JsonFlag, Output, command
from turbopi.cli.options import CheckpointArgument, RobotOptions
from turbopi.cli.typed import as_typed
from turbopi.support.errors import ConfigError
from turbopi.support.files import write_whole
from turbopi.support.installation import install_command
from turbopi.support.text import data_size, denoising

if TYPE_CHECKING:
    from turbopi.checkpoint import Checkpoint
    from turbopi.preprocess.pipeline import Pipeline

PART_NAMES = {
    "vision": "vision tower (SigLIP)",
    "projector": "projector",
    "vlm": "language model",
    "expert": "action expert",
    "action_time": "action, state and time projections",
}
OWN_FILES = "in the checkpoint's own files"  # LeRobot's statistics


@command(
    "inspect",
    shared=RobotOptions,
    examples=(
        "turbopi inspect checkpoints/pi05_libero",
        "turbopi inspect checkpoints/pi05_droid --config pi05_droid --json",
        "turbopi inspect checkpoints/my_arm --config pi05_base --robot my_arm.json",
        "turbopi inspect --random-weights pi05_base --hash",
    ),
)
def inspect(
    options: RobotOptions,
    checkpoint: CheckpointArgument = None,
    hash: Annotated[
        bool, typer.Option("--hash", help="Also the SHA-256 of the weights, the same in any format: reads them all.")
    ] = False,
    as_json: JsonFlag = False,
) -> None:
    """Show what a checkpoint holds, without loading it: format, sizes, statistics, robot, horizon.

    With the robot come the keys that its observations have. If it can't be known without --config, the rest is shown.
    A --config or a turbopi.json that can't be right is an error, after the rest. --robot holds another robot against
    the checkpoint.
    """
    output = Output(as_json)
    options.check(checkpoint)
    from turbopi.checkpoint import inspect_checkpoint

    if checkpoint is None:
        info = options.open(None).info()
    else:
        info = inspect_checkpoint(checkpoint, "auto" if options.config is None else options.config)
    refused = info.pop("config_error") if "config_error" in info and _is_said(options, info) else None
    if "config_error" in info:
        info["config_error"] = as_typed(info["config_error"])
    if "robot" in info or options.robot is not None:
        info |= _with_robot(options, checkpoint, info["notes"])
    if hash and refused is None:
        opened = options.open(checkpoint)
        opened.check_hash()
        opened.check_files()
        info["sha256"] = opened.fingerprint()
    _show(info, output)
    if refused is not None:
        raise ConfigError(refused)
    output.document(info)


def _is_said(options: RobotOptions, info: dict[str, Any]) -> bool:
    """Whether what is wrong with the configuration was said by --config or a turbopi.json, whose name then begins the
    message; else too little was said.
    """
    from turbopi.checkpoint.settings import read_settings

    try:
        source = read_settings("auto", Path(info["path"])).source
    except ConfigError:
        return True
    return options.config is not None or info["config_error"].startswith((f"{source}:", f"{source} is for "))


def _with_robot(options: RobotOptions, checkpoint: str | None, notes: list[str]) -> dict[str, Any]:
    """What is shown of the robot: --robot's, or the configuration's.

    If it doesn't fit the checkpoint, ConfigError is raised for --robot's; of the configuration's a note says why.
    """
    from turbopi.robots.base import described
    from turbopi.robots.labels import action_labels, camera_label, state_labels

    opened = options.open(checkpoint)
    try:
        pipeline = robot_pipeline(opened, options.make_robot())
    except ConfigError as error:
        if options.robot is not None:
            raise
        return {"notes": [*notes, f"no policy can be made of this: {error}"]}
    about = pipeline.metadata
    labels = {
        "state": state_labels(pipeline.robot, pipeline.robot.state_dim or pipeline.state_scale.width or 0),
        "actions": action_labels(pipeline.robot, about["robot_action_dim"]),
    }
    return {
        **{key: about[key] for key in ("robot", "robot_state_dim", "robot_action_dim", "default_prompt")},
        "observation": described(pipeline.example()),
        "cameras": {camera_label(pipeline.robot, one): one for one in pipeline.see(pipeline.example()).cameras},
        "labels": {feature: [one._asdict() for one in some] for feature, some in labels.items()},
        "notes": [*notes, *pipeline.notes],
    }


def robot_pipeline(checkpoint: "Checkpoint", robot: Any, default_prompt: str | None = None) -> "Pipeline":
    """A robot held against a checkpoint, without its weights and its tokenizer."""
    from turbopi.preprocess.pipeline import Pipeline

    no_tokenizer: Any = None  # nothing is tokenised
    return Pipeline(checkpoint.config, checkpoint.norm_stats, no_tokenizer, default_prompt, robot)


def _input_row(info: dict[str, Any], key: str, kind: str) -> str:
    """What is sent under a robot's key; of an image also which of the model's cameras it is."""
    if kind.startswith("float32[3, "):  # LeRobot's, which takes either
        kind += " in [0, 1], or uint8[height, width, 3]; any size"
    camera = info["cameras"].get(key, key)
    return kind if camera == key else f"{kind}, the model's {camera}"


def _show(info: dict[str, Any], output: Output) -> None:
    facts = Table(show_header=False, title=info["path"] or "random weights", title_justify="left")
    facts.add_column(style="bold")
    facts.add_column(overflow="fold")
    for name, value in _facts(info):
        facts.add_row(name, escape(value))
    output.table(facts)
    for feature in ("state", "actions") if info.get("norm_stats") else ():
        if info["norm_stats"][feature] is not None:
            output.table(_statistics_table(feature, info["norm_stats"][feature], info.get("labels", {}).get(feature)))
    parameters = Table(title="parameters", title_justify="left")
    parameters.add_column("part")
    parameters.add_column("count", justify="right")
    for part, count in info["parameters"].items():
        if part != "total" and count:
            parameters.add_row(PART_NAMES.get(part, part), f"{count:,}")
    parameters.add_section()
    parameters.add_row("total", f"{info['parameters']['total']:,}", style="bold")
    output.table(parameters)
    _show_notes(info["notes"], output)
    if "config_error" in info:
        output.line(f"not known yet: {info['config_error']}", "yellow")


def _show_notes(notes: list[str], output: Output) -> None:
    for note in notes:
        output.line(f"note: {note}", "yellow")


def _facts(info: dict[str, Any]) -> list[tuple[str, str]]:
    facts = [("format", info["format"]), ("model", info["kind"])]
    if "robot" in info:
        facts += [
            ("configuration", f"{info['name']}, from {info['config_source']}"),
            ("robot", info["robot"]),
            *((f"  its {key}", _input_row(info, key, value)) for key, value in info.get("observation", {}).items()),
            ("action horizon", f"{info['action_horizon']}, {_made_in(info)}"),
            ("prompt", f"at most {info['max_prompt_tokens']} tokens, {_state_input(info)}"),
            *([] if info["memory"] is None else [("memory", _memory(info["memory"]))]),
            *([] if info["text"] is None else [("text", _text(info["text"]))]),
            ("statistics", _statistics_source(info)),
            *_features(info),
            *((f"sizes: {name}", _sizes(sizes)) for name, sizes in info["sizes"].items() if isinstance(sizes, dict)),
            ("vocabulary", f"{info['sizes']['vocab_size']:,}"),
            ("action dimensions", str(info["sizes"]["action_dim"])),
        ]
    else:
        if "norm_stats" in info:
            facts += [("statistics", OWN_FILES), *_features(info)]
        else:
            facts.append(("statistics", ", ".join(info["assets"]) or "none"))
        facts += [(key.replace("_", " "), str(info[key])) for key in ("action_horizon", "action_dim") if key in info]
    facts += [
        ("weights", f"{info['tensors']} tensors, {data_size(info['stored_bytes'])}, {_dtypes(info)}"),
        ("tokenizer", _tokenizer(info)),
    ]
    if "sha256" in info:
        return [*facts, ("SHA-256", info["sha256"])]
    if "weights" in info:
        facts.append(("weights' hash", info["weights"] or "not made yet: --hash reads them all, once"))
    return facts


def _tokenizer(info: dict[str, Any]) -> str:
    from turbopi.models import FAMILIES
    from turbopi.preprocess.tokenizer import cached_tokenizer

    if info["format"] == "random":
        return "Turbo-Pi's own small one"
    own = not FAMILIES[info["kind"]].paligemma  # of another kind, which a library reads
    cached = cached_tokenizer()
    if info["tokenizers"]:
        found = ", ".join(info["tokenizers"])
    elif not own and cached.is_file():
        found = f"none in the folder; openpi's: {cached}"
    else:
        found = "not found: `turbopi doctor --checkpoint` says where to get it"
    if own and find_spec("tokenizers") is None:
        found += f"; it needs the library tokenizers, which isn't installed: {install_command('smolvla')}"
    return found


def _made_in(info: dict[str, Any]) -> str:
    if "max_decoding_steps" not in info:
        return f"denoising in {denoising(info)}"
    found = info["action_tokenizers"]
    where = found[0] if found else "which isn't here: `turbopi doctor --checkpoint` says where to get it"
    return f"written in {denoising(info)}, read by the action tokenizer{' ' if found else ', '}{where}"


def _statistics_source(info: dict[str, Any]) -> str:
    if info["format"] == "random":
        return "made up: values of about 1"
    return f"asset {info['asset_id']}" if info["asset_id"] else OWN_FILES


def _state_input(info: dict[str, Any]) -> str:
    from turbopi.models import FAMILIES  # which imports torch

    if FAMILIES[info["kind"]].reads_state:
        return "the state is a token of its own"
    return "the state in it" if info["discrete_state_input"] else "without the state"


def _text(text: dict[str, Any]) -> str:
    writes = f"continues {text['template']!r}" if text["trained"] else "none: its language head wasn't trained"
    if (subtasks := text["subtasks"]) is None:
        return writes
    return f"{writes}; a subtask for {subtasks['chunks']} chunks{', joint' if subtasks['joint'] else ''}"


def _memory(memory: dict[str, Any]) -> str:
    parts = [name for name, there in (("images", memory["visual"]), ("states", memory["proprioceptive"])) if there]
    return f"{' and '.join(parts)} of {memory['frames']} frames, {memory['stride']} observations apart"


def _features(info: dict[str, Any]) -> list[tuple[str, str]]:
    stats, modes = info["norm_stats"], info["normalization"]
    return [(f"  of the {name}", _statistics(stats[name], modes[name])) for name in ("state", "actions")]


def _statistics(stats: dict[str, Any] | None, mode: str) -> str:
    have = "none" if stats is None else f"{stats['dim']} dimensions of {', '.join(stats['statistics'])}"
    return f"{mode}; {have}"


def _statistics_table(feature: str, stats: dict[str, Any], labels: list[dict[str, str]] | None) -> Table:
    """What the training data were, dimension by dimension, as far as the robot has them."""
    values = stats["values"]
    shown = [name for name in ("q01", "q99", "mean", "std") if name in values]
    if "q01" not in values:
        shown = [name for name in ("min", "max", "mean", "std") if name in values]
    what = "action" if feature == "actions" else "value"
    labels = labels or [{"name": f"{what} {index}", "unit": ""} for index in range(stats["dim"])]
    table = Table(title=f"{feature} in the training data", title_justify="left")
    table.add_column(feature, overflow="fold")
    if any(label["unit"] for label in labels):
        table.add_column("unit", overflow="fold")
    for name in shown:
        table.add_column(name, justify="right")
    for index, label in enumerate(labels[: stats["dim"]]):
        unit = [label["unit"]] if len(table.columns) > 1 + len(shown) else []
        table.add_row(escape(label["name"]), *unit, *(f"{values[name][index]:.4g}" for name in shown))
    return table


def _sizes(sizes: dict[str, int]) -> str:
    return ", ".join(f"{name.replace('_', ' ')} {value}" for name, value in sizes.items())


def _dtypes(info: dict[str, Any]) -> str:
    return "made as needed" if info["format"] == "random" else f"stored as {', '.join(info['stored_dtypes'])}"


class _ConvertCommand(CheckpointThen):
    other = "FOLDER"


@command(
    "convert",
    cls=_ConvertCommand,
    shared=RobotOptions,
    examples=(
        "turbopi convert checkpoints/jax checkpoints/pi05_droid --config pi05_droid",
        "turbopi convert my_lerobot_policy converted --precision f32",
        "turbopi convert checkpoints/jax my_arm --config pi05_base --robot my_arm.json",
        "turbopi convert checkpoints/mine mine_fp8 --config pi05_droid --precision fp8",
        "turbopi convert --random-weights pi05_tiny tiny_checkpoint",
    ),
)
def convert(
    options: RobotOptions,
    paths: Annotated[
        list[str],
        typer.Argument(
            metavar="[CHECKPOINT] FOLDER",
            help="The checkpoint's folder (none with --random-weights), then the new folder.",
            show_default=False,
        ),
    ],
    precision: Annotated[
        str,
        typer.Option(
            "--precision",
            metavar="bf16|f32|fp8|fp8-mlp|fp8-f16sums|int8",
            help="In which the weights are written. In eight bits: for backend fused in this precision alone.",
        ),
    ] = "bf16",
    quantization: Annotated[
        Path | None,
        typer.Option(
            "--quantization",
            metavar="FILE",
            help="Calibration of weights in eight bits. Unless given, the one beside the checkpoint.",
        ),
    ] = None,
    device: Annotated[
        str | None,
        typer.Option(
            "--device", metavar="DEVICE", help="Where weights are rounded to eight bits: auto, cpu, cuda or cuda:N."
        ),
    ] = None,
    as_json: JsonFlag = False,
) -> None:
    """Write a checkpoint in openpi's PyTorch layout, or calibrated, its weights in eight bits.

    Its statistics and a turbopi.json that describes it are there, too. Any format that Turbo-Pi reads goes in;
    --random-weights makes a checkpoint to try things with. --robot is recorded in the turbopi.json, a description
    beside it. In eight bits the folder has the calibration and loads without the checkpoint.
    """
    output = Output(as_json)
    write = _writer(precision, quantization, device)
    source, target = options.split("convert", paths, "new folder")
    opened = options.open(source)
    if options.robot is not None:
        opened = _for_robot(opened, options.robot)
    options.tell_if_random(opened, output)
    if opened.format != "random":
        _show_notes(opened.source.notes, output)
    started = time.perf_counter()
    folder = write(opened, Path(target), progress=output.shows_progress)
    seconds = time.perf_counter() - started
    tokenizer = complete_random(folder, options.weights_seed or 0) if opened.format == "random" else None
    size = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
    output.line(f"{opened.format} -> {folder}: {data_size(size)} in {precision}, {seconds:.1f} s")
    output.line(f"Look at it with `turbopi inspect {folder}`.")
    output.document(
        {
            "folder": folder,
            "precision": precision,
            "bytes": size,
            "seconds": seconds,
            "tokenizer": tokenizer,
            "checkpoint_path": opened.path,
            "weights": opened.short_hash,
            "random_weights": opened.random is not None,
        }
    )


def _writer(precision: str, quantization: Path | None, device: str | None) -> Callable[..., Path]:
    """What writes an opened checkpoint to a folder. Raises ConfigError for options of another precision."""
    from turbopi.checkpoint.convert import DTYPES, convert
    from turbopi.quantization.plan import KEPT_TIERS

    if precision not in (*DTYPES, *KEPT_TIERS):
        raise ConfigError(f"--precision is {precision!r}; expected one of {', '.join((*DTYPES, *KEPT_TIERS))}")
    if precision not in KEPT_TIERS:
        given = {"--quantization": quantization, "--device": device}
        if extra := [name for name, value in given.items() if value is not None]:
            raise ConfigError(f"{' and '.join(extra)} only applies to --precision {', '.join(KEPT_TIERS)}")
        return partial(convert, precision=precision)  # type: ignore[arg-type]
    from turbopi.backends import resolve_device
    from turbopi.checkpoint.calibration import for_policy
    from turbopi.engine.quantized_writer import write_quantized

    def write(checkpoint: "Checkpoint", folder: Path, *, progress: bool) -> Path:
        _ = checkpoint.config.planned_model  # other families are refused before a calibration is looked for
        calibration = for_policy(quantization, precision, checkpoint)
        assert calibration is not None, "which every tier has"
        on = resolve_device(device or "auto")
        return write_quantized(checkpoint, folder, calibration, precision, on, progress=progress)

    return write


def _for_robot(checkpoint: "Checkpoint", robot: str) -> "Checkpoint":
    """The checkpoint with another robot in its configuration. Raises ConfigError for one that no file can record."""
    if ":" in robot:
        raise ConfigError(
            f"--robot {robot} is a class, and no turbopi.json can name one: its code would run for whoever opens the "
            "folder. Convert without it and give --robot to the commands that run the policy"
        )
    path = str(Path(robot).resolve()) if robot.endswith(".json") else robot
    if path != checkpoint.config.robot:  # the options were the other robot's
        checkpoint = replace(checkpoint, config=replace(checkpoint.config, robot=path, robot_options={}))
    robot_pipeline(checkpoint, None)
    return checkpoint


def complete_random(folder: Path, seed: int) -> Path:
    """Make random weights' folder complete with the project's small tokenizer, and have it say what it is, always."""
    from turbopi.checkpoint.settings import FILE_NAME
    from turbopi.preprocess.tokenizer import FILE_NAMES, TINY_TOKENIZER

    settings = json.loads((folder / FILE_NAME).read_text())
    settings["name"] += f" with random weights, seed {seed}"
    write_whole(folder / FILE_NAME, json.dumps(settings, indent=2) + "\n")
    return Path(shutil.copyfile(TINY_TOKENIZER, folder / FILE_NAMES[0]))
