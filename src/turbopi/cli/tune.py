"""`turbopi tune`: the fastest tiles of this GPU, measured."""

from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.table import Table

from turbopi.cli import files
from turbopi.cli.backends import resolve_gpu
from turbopi.cli.framework import JsonFlag, Output, command
from turbopi.cli.options import CheckpointArgument, WeightOptions
from turbopi.cli.progress import with_stages
from turbopi.support.errors import BackendError, BackendUnavailable, ConfigError, OutputError

if TYPE_CHECKING:
    import torch

    from turbopi.backends.tuned_tiles import Machine, TunedTile
    from turbopi.config import Network
    from turbopi.kernels.tile_table import TileTable
    from turbopi.tune.plan import Plan
    from turbopi.tune.run import Measured, Outcome

SIZES = "pi05_libero"  # of the model where none is named
BATCHES = (1, 2, 4, 8, 16)  # a batch of another size is run as calls of these
CAMERAS = (1, 2, 3, 4)


@command(
    "tune",
    shared=WeightOptions,
    examples=(
        "turbopi tune",
        "turbopi tune checkpoints/mine --precision bf16 --batch 1",
        "turbopi tune --random-weights pi05_droid --cameras 1,2,3 --batch 1,2,4,8,16",
        "turbopi tune --only-missing --seconds 60",
        "turbopi tune --dry-run",
    ),
)
def tune(
    options: WeightOptions,
    checkpoint: CheckpointArgument = None,
    precision: Annotated[
        str | None, typer.Option(metavar="bf16,fp8", help="Unless given, all that this GPU multiplies.")
    ] = None,
    batch: Annotated[str, typer.Option(metavar="N,N", help="Observations of a call.")] = "1",
    cameras: Annotated[str, typer.Option(metavar="N,N", help="Valid cameras of an observation.")] = "2",
    prompt_tokens: Annotated[
        str | None, typer.Option(metavar="N,N", help="Of an observation. Unless given, every length of a prompt.")
    ] = None,
    kernels: Annotated[
        str, typer.Option(metavar="auto|portable|hopper|all", help="Whose tiles; auto: those that `fused` takes here.")
    ] = "auto",
    seconds: Annotated[
        float | None, typer.Option(min=0, metavar="S", help="Begin no further operation after that.")
    ] = None,
    only_missing: Annotated[
        bool, typer.Option("--only-missing", help="Leave out what the file has from an earlier run.")
    ] = False,
    out: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write here instead of the cache, where `fused` looks.")
    ] = None,
    noisy: Annotated[bool, typer.Option("--noisy", help="Measure although other programs use the GPU.")] = False,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Only say what would be measured, on the GPU that is here.")
    ] = False,
    device: Annotated[str, typer.Option("--device", metavar="DEVICE", help="auto, cuda or cuda:N.")] = "auto",
    as_json: JsonFlag = False,
) -> None:
    """Measure which tiles are the fastest on this GPU; backend `fused` uses them from then on.

    Each operation whose tile can be chosen is timed in every tile that the GPU takes, in turns, with weights that the
    cache doesn't hold, and its result is compared with plain PyTorch's; those of batches' denoising are timed within
    the action expert's layers. The file is written after each operation. Without weights, sizes are those of
    pi05_libero. TURBOPI_TUNED=off has `fused` ignore what was measured.
    """
    output = Output(as_json)
    batches, counts = numbers(batch, "--batch", BATCHES), numbers(cameras, "--cameras", CAMERAS)
    prompts = [] if prompt_tokens is None else numbers(prompt_tokens, "--prompt-tokens")
    if checkpoint is None and options.random_weights is None:
        options = WeightOptions(SIZES, options.weights_seed, options.config)
    resolved = usable_device(device)
    config = options.open(checkpoint).config.model
    from turbopi.backends.tuned_tiles import Machine, find_tiles, own_file, write_tile_file
    from turbopi.kernels.tile_table import NO_TILES, TileTable
    from turbopi.tune import plan as planning
    from turbopi.tune.run import still_good, tile_file
    from turbopi.tune.shapes import calls

    machine = Machine.of(resolved)
    file = out or own_file(machine.gpu)
    check_writable(file)
    before = still_good(file, machine, ships=out is not None)
    known = TileTable({} if before is None else {one.key: one.tile for one in before.tiles})
    shipped = find_tiles(machine, own=False).table
    plan = planning.plan(
        config,
        calls(config, counts, prompts_within(prompts, config), batches),
        planning.precisions_to_tune([] if precision is None else precision.split(","), machine.capability),
        planning.kernels_to_tune(kernels, machine.capability),
        machine,
        shipped=shipped,
        known=known if only_missing else NO_TILES,
    )
    output.line(
        f"{machine.gpu}, compute capability {machine.compute_capability}, {machine.multiprocessors} multiprocessors, "
        f"driver {machine.driver}"
    )
    if dry_run:
        show_plan(plan, output)
        return
    if not plan.planned:
        output.line(f"nothing is left to measure: {file} has all of it")
        output.document({"file": file, "measured": []})
        return
    refuse_if_busy(resolved, noisy)

    def keep(measured: "Sequence[Measured]") -> None:
        write_tile_file(tile_file(machine, measured, before), file)

    tiles = TileTable({**shipped.tiles, **known.tiles})
    outcome = measure(plan, config, resolved, tiles, keep, seconds, output)
    show(plan, outcome, tile_file(machine, outcome.measured, before).tiles, file, output)
    output.document(document(machine, outcome, file))
    if not outcome.measured:
        raise BackendError("no operation could be measured; what each one said is above")


def numbers(text: str, option: str, known: Sequence[int] = ()) -> list[int]:
    """The whole numbers of "1,2,4", each once; of the known ones, if there are some. Raises ConfigError."""
    parts = [part.strip() for part in text.split(",")]
    found = [int(part) for part in parts if part.isascii() and part.isdigit() and len(part) < 10]
    if len(found) < len(parts) or not all(number >= 1 and (not known or number in known) for number in found):
        expected = f"some of {', '.join(map(str, known))}" if known else "whole numbers from 1"
        raise ConfigError(f"{option} is {text!r}; expected {expected}, with commas between them")
    return list(dict.fromkeys(found))


def prompts_within(prompts: list[int], config: "Network") -> list[int]:
    """Raises ConfigError for a prompt that is longer than the model's longest."""
    if any(tokens > config.max_prompt_tokens for tokens in prompts):
        raise ConfigError(f"--prompt-tokens is {max(prompts)}; this model takes up to {config.max_prompt_tokens}")
    return prompts


def usable_device(device: str) -> "torch.device":
    """The GPU that `fused` would run on. Raises BackendUnavailable where it can't."""
    from turbopi import backends

    resolved = resolve_gpu(device, "tiles are measured, and for --dry-run listed, on")
    if (reason := backends.availability("fused", resolved)) is not None:
        raise BackendUnavailable(f"tiles are those of backend fused, which can't run here: {reason}")
    return resolved


def check_writable(file: Path) -> None:
    """Raises OutputError or ConfigError before minutes of measuring, not after them. Makes the file's folder."""
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"can't write {file}: {error.strerror}; --out FILE writes elsewhere") from error
    files.check_writable(file)


def refuse_if_busy(device: "torch.device", noisy: bool) -> None:
    """Raises BackendError if the time of one and the same work varies, unless `noisy`."""
    from turbopi.tune.gpu import steadiness
    from turbopi.tune.race import MOST_SPREAD, spread

    times = steadiness(device)
    if spread(times) > MOST_SPREAD and not noisy:
        raise BackendError(
            f"the GPU is busy: one and the same copy takes {min(times):.0f} to {max(times):.0f} us, so times would "
            "mean little; stop what else uses it (`nvidia-smi` lists it), or measure all the same with --noisy"
        )


def measure(
    plan: "Plan",
    config: "Network",
    device: "torch.device",
    tiles: "TileTable",
    keep: "Callable[[Sequence[Measured]], None]",
    seconds: float | None,
    output: Output,
) -> "Outcome":
    """Everything that is planned. `tiles`: what runs now; `keep` is given what is measured, after each operation."""
    from turbopi.tune.plan import bench_maker
    from turbopi.tune.run import Progress
    from turbopi.tune.run import tune as run

    def done(measured: "Measured") -> None:
        if not output.shows_progress:  # a log has no bar
            output.line(line(measured))

    return with_stages(
        lambda progress: run(
            plan.planned, bench_maker(config, device), keep, tiles=tiles, seconds=seconds, progress=progress
        ),
        lambda begin, advance: Progress(begin, advance, done),
        output,
        first="preparing",
    )


def line(measured: "Measured") -> str:
    from turbopi.backends.tuned_tiles import knobs_text

    raced, what = measured.raced, measured.operation
    times = f"{raced.usual.microseconds:.1f} -> {raced.best.microseconds:.1f} us"
    return f"{what.name}, {what.numbers}, {what.size}: {times} ({knobs_text(raced.best.knobs)})"


def show_plan(plan: "Plan", output: Output) -> None:
    table = Table("operation", "rows x out x in", "kernels", "tiles")
    for one in plan.planned:
        what = one.operation
        table.add_row(f"{what.name}, {what.numbers}", what.size, what.kernels, str(len(one.candidates)))
    output.table(table)
    output.line(f"{len(plan.planned)} operations, {sum(len(one.candidates) for one in plan.planned)} tiles")
    output.document(
        {"planned": [asdict(one.operation) | {"tiles": list(map(dict, one.candidates))} for one in plan.planned]}
    )


def show(plan: "Plan", outcome: "Outcome", kept: "Sequence[TunedTile]", file: Path, output: Output) -> None:
    """What was found, by operation; what all that the file has now gains, by call."""
    from turbopi.backends.tuned_tiles import knobs_text
    from turbopi.tune.race import busy
    from turbopi.tune.run import gained_ms

    table = Table("operation, rows x out x in", "now", "best", "gain")
    for one in outcome.measured:
        what, raced = one.operation, one.raced
        changed = raced.best.knobs != raced.usual.knobs
        table.add_row(
            f"{what.name}, {what.numbers}\n{what.size}",
            f"{raced.usual.microseconds:.1f} us\n{knobs_text(raced.usual.knobs)}",
            f"{raced.best.microseconds:.1f} us\n{knobs_text(raced.best.knobs)}" if changed else "the same",
            f"{one.gained / raced.usual.microseconds:.1%}" if changed else "",
        )
    output.table(table)
    for what, why in outcome.failed.items():
        output.line(f"{what.name}, {what.numbers}, {what.rows} rows: not measured, {why}")
    for one in outcome.measured:
        wrong = sorted({why for why in one.raced.refused.values() if why.startswith("its ")})
        if wrong:
            output.line(f"{one.operation.name}, {one.operation.numbers}: a tile was refused: {wrong[0]}", "yellow")
    if outcome.left_out:
        output.line(f"time was up: {len(outcome.left_out)} operations are left; --only-missing measures them")
    if busy(raced.spread for one in outcome.measured for raced in (one.raced.usual, one.raced.best)):
        output.line(
            "times varied by more than 15 %: is the GPU used by others? Measure again when it is idle", "yellow"
        )
    found = {one.key: one for one in kept}
    for (call, precision, kernels), several in plan.calls.items():
        took, gained, missing = gained_ms(found, several)
        if took:
            rest = f"; {missing} operations aren't measured yet" if missing else ""
            output.line(
                f"{call}, {precision}, {kernels} kernels: {gained:.2f} ms of {took:.2f} ms gained (predicted){rest}"
            )
    if outcome.measured:
        output.line(f"kept for backend fused: {file}")


def document(machine: "Machine", outcome: "Outcome", file: Path) -> dict[str, object]:
    return {
        "machine": asdict(machine),
        "file": file,
        "measured": [
            asdict(one.operation)
            | {
                "usual": asdict_of(one.raced.usual),
                "best": asdict_of(one.raced.best),
                "timed": one.raced.timed,
                "refused": list(one.raced.refused.values()),
            }
            for one in outcome.measured
        ],
        "failed": {f"{what.name}, {what.numbers}, {what.rows} rows": why for what, why in outcome.failed.items()},
        "left_out": [asdict(one) for one in outcome.left_out],
    }


def asdict_of(timed: object) -> dict[str, object]:
    from turbopi.tune.race import Timed

    assert isinstance(timed, Timed)
    return {"tile": dict(timed.knobs), "microseconds": timed.microseconds, "spread": timed.spread}
