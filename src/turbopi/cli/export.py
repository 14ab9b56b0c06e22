"""`turbopi export`."""

import time
from pathlib import Path
from typing import Annotated

import typer

from turbopi.cli.checkpoints import complete_random
from turbopi.cli.framework import CheckpointThen, JsonFlag, Output, command
from turbopi.cli.options import EngineCalibration, ScaleMethod, WeightOptions
from turbopi.support.errors import BackendUnavailable, ConfigError
from turbopi.support.text import data_size

FORMATS = ("onnx",)
PRECISIONS = ("f32", "fp8")


class _ExportCommand(CheckpointThen):
    def collect_usage_pieces(self, ctx: object) -> list[str]:
        return ["[OPTIONS]", "|".join(FORMATS), "[CHECKPOINT]", "FOLDER"]


@command(
    "export",
    cls=_ExportCommand,
    shared=WeightOptions,
    examples=(
        "turbopi export onnx checkpoints/pi05_libero pi05_libero_onnx",
        "turbopi export onnx checkpoints/jax droid_onnx --config pi05_droid --json",
        "turbopi export onnx --random-weights pi05_tiny tiny_onnx",
        "turbopi export onnx checkpoints/mine fp8_onnx --precision fp8",
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
    precision: Annotated[
        str, typer.Option(metavar="f32|fp8", help="fp8: quantise/dequantise nodes around the prefix's MLPs.")
    ] = "f32",
    calibration: EngineCalibration = None,
    method: ScaleMethod = "max",
    as_json: JsonFlag = False,
) -> None:
    """Write a model for another runtime: as float32 ONNX graphs of vision, prompt, prefix and denoising step.

    The folder is a checkpoint, too, for the backend onnx. A full-size model needs 14 GB of disk and of memory. With
    --precision fp8 the prefix's MLPs are FP8 (E4M3), with scales that are measured on observations.
    """
    output = Output(as_json)
    if precision not in PRECISIONS:
        raise ConfigError(f"unknown precision {precision!r} for an export; choose one of {', '.join(PRECISIONS)}")
    if precision == "f32" and calibration is not None:
        raise ConfigError("--calibration is for --precision fp8")
    if precision == "f32" and method != "max":
        raise ConfigError("--method is for --precision fp8")
    if format not in FORMATS:
        raise ConfigError(f"unknown format {format!r}; choose one of {', '.join(FORMATS)}")
    source, target = options.split("export onnx", paths, "new folder")
    import torch

    from turbopi.backends import resolve_device
    from turbopi.backends.onnx.export import EXPORT_NEEDS, check_target, export_onnx, missing_library
    from turbopi.models.pi0.reference import Pi0Model

    check_target(Path(target).expanduser())  # before minutes of loading
    checkpoint = options.open(source)
    _ = checkpoint.config.planned_model  # which other families don't have: better known before a library is installed
    from turbopi.backends.tensorrt.calibrate import unavailable

    missing = missing_library(EXPORT_NEEDS) or (unavailable(method) if precision == "fp8" else None)
    if missing is not None:
        raise BackendUnavailable(f"can't export to ONNX: {missing}")
    options.tell_if_random(checkpoint, output)
    started = time.perf_counter()
    found = None
    if precision == "fp8":
        from turbopi.cli.build import measure_scales
        from turbopi.policy.policy import UnifiedPolicy

        policy = UnifiedPolicy(checkpoint, backend="pytorch", precision="f32", device="cpu")
        found = measure_scales(policy, calibration, method, output)
        del policy  # ModelOpt changes its model
    # random weights are the same wherever they are made: on a GPU, much faster, if they fit there
    maker = torch.device("cpu")
    room = torch.cuda.mem_get_info()[0] if torch.cuda.is_available() else 0
    if checkpoint.format == "random" and room > 1.2 * checkpoint.stored_bytes:
        maker = resolve_device("auto")
    loaded = checkpoint.load(maker, "f32", progress=output.shows_progress).state
    state = {name: loaded.pop(name).cpu() for name in list(loaded)}
    model = Pi0Model.from_state(checkpoint.config.planned_model, state)
    written = export_onnx(model, target, checkpoint=checkpoint, calibration=found, report=output.line)
    if checkpoint.format == "random":
        complete_random(written.folder, options.weights_seed or 0)
    seconds = time.perf_counter() - started
    output.line(f"{checkpoint.format} -> {written.folder}: {data_size(written.bytes)}, {precision}, {seconds:.1f} s")
    output.line(f"Try it with `turbopi infer {written.folder} OBSERVATION`.")
    output.document({"folder": written.folder, "bytes": written.bytes, "seconds": seconds, **written.manifest})
