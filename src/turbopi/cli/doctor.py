"""`turbopi doctor`."""

from dataclasses import asdict
from typing import Annotated, Any

import typer
from rich.markup import escape

from turbopi.cli.backends import DeviceOption, PrecisionOption, list_backends, resolve_gpu, show_backends
from turbopi.cli.framework import CHECK_FAILED, JsonFlag, Output, command
from turbopi.support.errors import BackendUnavailable, ConfigError
from turbopi.support.reading import plain_document
from turbopi.support.text import counted

STYLES = {"OK": "green", "WARN": "yellow", "FAIL": "bold red"}


@command(
    "doctor",
    examples=(
        "turbopi doctor",
        "turbopi doctor --checkpoint checkpoints/pi05_libero --config pi05_libero",
        "turbopi doctor --port 8001 --json",
        "turbopi doctor --device cpu --precision fp8",
        "turbopi doctor --qualify",
        "turbopi doctor --qualify --checkpoint checkpoints/mine --precision fp8",
    ),
)
def doctor(
    folder: Annotated[
        str | None, typer.Argument(metavar="CHECKPOINT", help="As --checkpoint.", show_default=False)
    ] = None,
    checkpoint: Annotated[
        str | None, typer.Option("--checkpoint", metavar="CHECKPOINT", help="Check this one, and its needs, too.")
    ] = None,
    config: Annotated[
        str | None, typer.Option("--config", metavar="PRESET|FILE", help="What the checkpoint doesn't record.")
    ] = None,
    tokenizer: Annotated[
        str | None, typer.Option("--tokenizer", metavar="FILE", help="Check this SentencePiece model.")
    ] = None,
    port: Annotated[
        int, typer.Option("--port", metavar="N", min=1, max=65535, help="That `turbopi serve` would take.")
    ] = 8000,
    device: DeviceOption = "auto",
    precision: PrecisionOption = None,
    qualify: Annotated[
        bool,
        typer.Option(
            "--qualify", help="Also find out whether `fused` is right and fast on this GPU, unless that is known."
        ),
    ] = False,
    force: Annotated[bool, typer.Option("--force", help="With --qualify: though it is known.")] = False,
    as_json: JsonFlag = False,
) -> None:
    """Check this machine: what Turbo-Pi needs, what is there, how to mend it, and which backends run here.

    A warning is about something you may not need; exit code 1 says that something failed. No GPU is a warning.
    --qualify takes the model of --checkpoint, else pi05_base's sizes, and up to ten minutes; `auto` does the same by
    itself, in one.
    """
    output = Output(as_json)
    from turbopi.cli.checkups import examine, open_for_check, own_precision, system

    if folder is not None:
        if checkpoint is not None:
            raise ConfigError(f"{folder} and --checkpoint {checkpoint} each name a checkpoint: give one of them")
        checkpoint = folder
    if force and not qualify:
        raise ConfigError("--force goes with --qualify")
    verdict = run_qualification(checkpoint, config, device, precision, force, output) if qualify else {}
    opened, about_it = (None, []) if checkpoint is None else open_for_check(checkpoint, config, device)
    precision = precision or own_precision(opened) or "bf16"
    rows = list(examine(opened, about_it, tokenizer=tokenizer, port=port))
    works = all(row.level != "FAIL" for row in rows if row.name == "PyTorch")
    found = list_backends(device, precision, opened) if works else {}
    width = max(len(row.name) for row in rows)
    for row in rows:  # lines and not a table, so that a command can be copied whole
        output.styled(f"[{STYLES[row.level]}]{row.level:<4}[/]  [bold]{row.name:<{width}}[/]  {escape(row.found)}")
        if row.fix:
            output.styled(f"{'':<{width + 8}}[cyan]->[/] {escape(row.fix)}")
    counts = {level: sum(row.level == level for row in rows) for level in STYLES}
    summary = f"{counts['OK']} OK, {counted(counts['WARN'], 'warning')}, {counts['FAIL']} failed"
    if found:
        show_backends(found, output)
    output.line(summary, STYLES["FAIL" if counts["FAIL"] else "OK"])
    output.document(
        {"ok": not counts["FAIL"], "checks": [asdict(row) for row in rows], **found, **verdict, "system": system()}
    )
    if counts["FAIL"]:
        raise typer.Exit(CHECK_FAILED)


def run_qualification(
    checkpoint: str | None, config: str | None, device: str, precision: str | None, force: bool, output: Output
) -> dict[str, Any]:
    """The verdict on `fused` on a GPU, and its file, said and as JSON values. Raises BackendUnavailable without one."""
    from turbopi import backends
    from turbopi.backends import qualification, qualifying
    from turbopi.checkpoint import open_checkpoint
    from turbopi.cli.checkups import own_precision
    from turbopi.config import ModelConfig, Network

    resolved = resolve_gpu(device, "--qualify tries backend fused on")
    opened = None if checkpoint is None else open_checkpoint(checkpoint, "auto" if config is None else config)
    model: Network = ModelConfig() if opened is None else opened.config.model
    tier = backends.checked_precision(precision or own_precision(opened) or "bf16")
    if (why := backends.refusal("fused", resolved, tier, model)) is not None:
        raise BackendUnavailable(f"there is nothing to qualify: {why}")
    verdict = None if force else qualification.kept(resolved, tier, model)
    if verdict is None or verdict.unfinished:
        seconds = qualifying.PATIENT_SECONDS
        with qualifying.shown(output.shows_progress, f"backend 'fused' in {tier}", seconds) as tell:
            verdict = qualifying.qualify(resolved, tier, model, seconds=seconds, tell=tell)
    file = qualification.file_of(resolved, tier, model)
    for stage in verdict.stages:
        output.line(f"{stage.name}: {stage.text} ({stage.seconds:.1f} s)")
    output.line(f"{verdict.gpu}, {tier}: {verdict.taken or 'nothing'} is taken: {verdict.summary}", "bold")
    output.line(f"written: {file} ({verdict.seconds:.0f} s)")
    if (todo := verdict.issue(file)) is not None:
        output.line(todo, "yellow")
    return {"qualification": plain_document(verdict), "file": file}
