"""`turbopi export`."""

import time
from pathlib import Path
from typing import Annotated, Any

import typer

from turbopi.cli.framework import CheckpointThen, JsonFlag, Output, command
from turbopi.cli.options import WeightOptions
from turbopi.errors import BackendUnavailable, ConfigError

FORMATS = ("onnx",)


class _ExportCommand(CheckpointThen):
    def collect_usage_pieces(self, ctx: Any) -> list[str]:
        return ["[OPTIONS]", "|".join(FORMATS), "[CHECKPOINT]", "FOLDER"]


@command(
    "export",
    cls=_ExportCommand,
    shared=WeightOptions,
    examples=(
        "turbopi export onnx checkpoints/pi05_libero pi05_libero_onnx",
        "turbopi export onnx checkpoints/pi05_droid_jax droid_onnx --config pi05_droid --json",
        "turbopi export onnx --random-weights pi05_tiny tiny_onnx",
    ),
)
def export(
    options: WeightOptions,
    format: Annotated[str, typer.Argument(metavar="onnx", help="What to write.", show_default=False)],
    paths: Annotated[
        list[str],
        typer.Argument(
            metavar="[CHECKPOINT] FOLDER",
            help="The checkpoint's folder (none with --random-weights), then the new folder.",
            show_default=False,
        ),
    ],
    as_json: JsonFlag = False,
) -> None:
    """Write a model for another runtime: as float32 ONNX graphs of vision, prompt, prefix and denoising step.

    A full-size model needs 14 GB of disk and of memory.
    """
    output = Output(as_json)
    if format not in FORMATS:
        raise ConfigError(f"unknown format {format!r}; choose one of {', '.join(FORMATS)}")
    source, target = options.split("export onnx", paths, "new folder")
    from turbopi.export.onnx import EXPORT_NEEDS, check_target, export_onnx, missing_library
    from turbopi.model.reference import Pi0Model

    check_target(Path(target).expanduser())  # before minutes of loading
    missing = missing_library(EXPORT_NEEDS)
    if missing is not None:
        raise BackendUnavailable(f"can't export to ONNX: {missing}")
    checkpoint = options.open(source)
    options.tell_if_random(checkpoint, output)
    started = time.perf_counter()
    state = checkpoint.load("cpu", "f32", progress=output.shows_progress).state
    written = export_onnx(Pi0Model.from_state(checkpoint.config.model, state), target, report=output.line)
    seconds = time.perf_counter() - started
    output.line(f"{checkpoint.format} -> {written.folder}: {written.bytes / 1e9:.3f} GB in f32, {seconds:.1f} s")
    output.document({"folder": written.folder, "bytes": written.bytes, "seconds": seconds, **written.manifest})
