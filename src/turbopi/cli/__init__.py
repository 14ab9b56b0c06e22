"""The command line.

Run: demo, infer, serve, view, replay. Checkpoint: inspect, convert, calibrate, verify. Measure: bench, eval, compare.
Advanced: plan, export, build, tune, doctor. Old names, hidden for one version: backends (doctor).
"""

from importlib import metadata
from typing import Annotated

import typer

# Importing a module declares its commands, in the order of --help
# isort: off
from turbopi.cli import (  # noqa: F401
    demo,
    infer,
    serve,
    view,
    replay,
    bench,
    plan,
    calibrate,
    verify,
    evaluate,
    compare,
    checkpoints,
    export,
    build,
    tune,
    backends,
    doctor,
)
from turbopi.cli import process
from turbopi.cli.added import Commands
from turbopi.cli.framework import app
# isort: on

__all__ = ["app", "main"]


def _show_version(wanted: bool) -> None:
    if wanted:
        try:
            print(f"turbopi {metadata.version('turbopi')}")
        except metadata.PackageNotFoundError:
            print("turbopi, not installed: run from its source folder")
        raise typer.Exit


@app.callback(
    cls=Commands,
    epilog="[bold]Exit codes[/]: 0 all is well, 1 a check failed, 2 bad usage or input, 3 a fault of Turbo-Pi's own, "
    "4 the GPU failed for good, 130 Ctrl-C, 141 the output's reader has left.",
)
def _root(
    version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Pi0.5, Pi0, Pi0-FAST and SmolVLA robot policies in real time, with their owners' exact semantics.

    Start with `turbopi demo`: it needs no checkpoint and no GPU.
    """


def main() -> None:
    process.run(lambda: app(prog_name="turbopi"))
