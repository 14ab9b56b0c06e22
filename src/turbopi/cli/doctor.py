"""`turbopi doctor`."""

from dataclasses import asdict
from typing import Annotated

import typer
from rich.markup import escape

from turbopi.cli.backends import DeviceOption, PrecisionOption, list_backends, show_backends
from turbopi.cli.framework import CHECK_FAILED, JsonFlag, Output, command

STYLES = {"OK": "green", "WARN": "yellow", "FAIL": "bold red"}


@command(
    "doctor",
    examples=(
        "turbopi doctor",
        "turbopi doctor --checkpoint checkpoints/pi05_libero --config pi05_libero",
        "turbopi doctor --port 8001 --json",
        "turbopi doctor --device cpu --precision fp8",
    ),
)
def doctor(
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
    precision: PrecisionOption = "bf16",
    as_json: JsonFlag = False,
) -> None:
    """Check this machine: what Turbo-Pi needs, what is there, how to mend it, and which backends run here.

    A warning is about something you may not need; exit code 1 says that something failed. No GPU is a warning.
    """
    output = Output(as_json)
    from turbopi.cli.checkups import examine

    rows = list(examine(checkpoint=checkpoint, config=config, tokenizer=tokenizer, port=port))
    works = all(row.level != "FAIL" for row in rows if row.name == "PyTorch")
    found = list_backends(device, precision) if works else {}
    width = max(len(row.name) for row in rows)
    for row in rows:  # lines and not a table, so that a command can be copied whole
        output.styled(f"[{STYLES[row.level]}]{row.level:<4}[/]  [bold]{row.name:<{width}}[/]  {escape(row.found)}")
        if row.fix:
            output.styled(f"{'':<{width + 8}}[cyan]->[/] {escape(row.fix)}")
    counts = {level: sum(row.level == level for row in rows) for level in STYLES}
    summary = f"{counts['OK']} OK, {counts['WARN']} warnings, {counts['FAIL']} failed"
    if found:
        show_backends(found, output)
    output.line(summary, STYLES["FAIL" if counts["FAIL"] else "OK"])
    output.document({"ok": not counts["FAIL"], "checks": [asdict(row) for row in rows], **found})
    if counts["FAIL"]:
        raise typer.Exit(CHECK_FAILED)
