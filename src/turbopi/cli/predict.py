"""`turbopi bench --predict`: what a call may take on GPUs that aren't here."""

import itertools
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from rich.table import Table

from turbopi.cli.framework import Output
from turbopi.support.errors import ConfigError
from turbopi.support.reading import plain_document

if TYPE_CHECKING:
    from turbopi.bench.gpus import GpuSpec
    from turbopi.bench.predict import PredictedCall, Prediction
    from turbopi.bench.work import Job
    from turbopi.config import ModelConfig

Axes = Mapping[str, Sequence[int]]
MEASURED = "*"  # behind a number that isn't a prediction


def show_predictions(
    names: Sequence[str], config: "ModelConfig", axes: Axes, output: Output, *, ignored: Sequence[str]
) -> None:
    """Print a table for each job of the axes, with all GPUs, and the JSON document.

    ignored   options that were given and mean nothing here: refused
    """
    from turbopi.bench.gpus import find_gpu
    from turbopi.bench.predict import predict
    from turbopi.bench.work import Job

    if ignored:
        raise ConfigError(f"--predict runs nothing: leave out {', '.join(ignored)}")
    gpus = [find_gpu(name) for name in names]
    if not gpus:
        raise ConfigError("--predict names no GPU; such as --predict rtx4090,h100")
    predictions: list[Prediction] = []
    for cameras, tokens, horizon, batch, steps in itertools.product(
        axes["--cameras"], axes["--prompt-tokens"], axes["--horizons"], axes["--batch"], axes["--steps"]
    ):
        job = Job(cameras, tokens, horizon, steps, batch=batch)
        here = [prediction for gpu in gpus for prediction in predict(gpu, config, job)]
        output.table(_table(job, here))
        predictions += here
    for line in _notes(predictions):
        output.line(line)
    output.document({"predictions": [plain_document(prediction) for prediction in predictions]})


def _table(job: "Job", predictions: "Sequence[Prediction]") -> Table:
    from turbopi.bench.predict import STAGES

    table = Table(title=f"PREDICTIONS, ms: {job}", title_justify="left")
    table.add_column("GPU, precision")
    for column in (*STAGES, "floor", "call"):
        table.add_column(column, justify="right")
    table.add_column("backend")
    for one in predictions:
        floors = [f"{one.floor_ms[name]:.2f}" for name in (*STAGES, "total")]
        name = f"{one.gpu.key} {one.precision}"
        for call in one.calls:
            reported = call_text(call) + (MEASURED if one.was_measured(call) else "")
            table.add_row(name, *floors, reported, "portable" if _not_its_own(one.gpu, call) else call.backend)
        if not one.calls:
            table.add_row(name, *floors, "-", "")
    return table


def _not_its_own(gpu: "GpuSpec", call: "PredictedCall") -> bool:
    """Whether these are kernels for all GPUs where `fused` takes Hopper's."""
    return call.kernels == "portable" and gpu.capability == (9, 0)


def call_text(call: "PredictedCall") -> str:
    """ "33-78": milliseconds, without a false last digit."""
    low, high = (f"{value:.1f}" if value < 10 else f"{value:.0f}" for value in (call.low_ms, call.high_ms))
    return low if low == high else f"{low}-{high}"


def _notes(predictions: "Sequence[Prediction]") -> list[str]:
    """What the tables mean, where their numbers come from, and what can't run."""
    from turbopi.backends import PRECISIONS
    from turbopi.bench.measured import KERNELS
    from turbopi.bench.predict import PTX_SOURCE, by_ptx, refused

    measured = any(one.was_measured(call) for one in predictions for call in one.calls)
    lines = [
        f"These are predictions: nothing was run for them{', but for those with a star' if measured else ''}.",
        *([f"{MEASURED} this call was measured on that GPU"] if measured else []),
        "floor: the counted work at NVIDIA's published rates",
        "call: as on the GPU where the backend was measured: its delays by the clock, its",
        "      matmuls by the published rates, or by the share of them that Hopper reaches",
    ]
    calls = {(call.backend, call.kernels, call.measured_on, call.source) for one in predictions for call in one.calls}
    lines += [f"{name}, {KERNELS[kernels]}, as on {gpu}: {source}" for name, kernels, gpu, source in sorted(calls)]
    if any(by_ptx(call.kernels, one.precision, one.gpu) for one in predictions for call in one.calls):
        lines.append(f"in 8 bits on 8.x and 12.x vision and prefix as PTX for 8.9 on h200: {PTX_SOURCE}")
    if any(_not_its_own(one.gpu, call) for one in predictions for call in one.calls):
        lines.append("portable: fused with TURBOPI_KERNELS=portable")
    without = [one for one in predictions if not one.calls]
    for precision in dict.fromkeys(one.precision for one in without):
        gpus = {one.gpu.key: one.gpu for one in without if one.precision == precision}
        if precision not in PRECISIONS:
            lines.append(f"{precision}: no backend runs in it")
            continue
        refusing = [key for key, gpu in gpus.items() if refused(gpu, precision)]
        if refusing:
            lines.append(f"{precision}: refused on {', '.join(refusing)}, see docs/gpus.md")
        if others := [key for key in gpus if key not in refusing]:
            lines.append(f"{precision} on {', '.join(others)}: nothing that runs there was measured on such a job")
    for gpu in {one.gpu.key: one.gpu for one in predictions}.values():
        rates = f"bf16 {gpu.bf16_tflops:g} TFLOP/s" + (f", FP8 {gpu.fp8_tflops:g}" if gpu.fp8_tflops else "")
        lines += [f"{gpu.key}: {gpu.gb_per_second:g} GB/s, {rates}, INT8 {gpu.int8_tops:g} TOP/s, {gpu.memory_gb:g} GB"]
        lines += [f"  {gpu.name}: {gpu.source}"]
    return lines
