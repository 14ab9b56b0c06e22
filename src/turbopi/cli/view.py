"""`turbopi view`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from turbopi.cli.api_key import ApiKey, ApiKeyFile, chosen_key
from turbopi.cli.files import check_writable
from turbopi.cli.framework import JsonFlag, Output, command
from turbopi.support.errors import ConfigError
from turbopi.support.text import counted

if TYPE_CHECKING:
    from collections.abc import Iterator

    from turbopi.view.calls import ViewedCall, ViewedTrouble
    from turbopi.view.live import LiveServer


@command(
    "view",
    examples=(
        "turbopi view recordings/20260131T093000Z --rate 20",
        "turbopi view http://127.0.0.1:8000",
        "turbopi view http://gpu-box:8000 --save morning.rrd --seconds 600",
    ),
)
def view(
    what: Annotated[
        str,
        typer.Argument(
            metavar="RECORDING|URL",
            help="What `turbopi serve --record` wrote: its folder, one run's, or one call; or a server's address.",
            show_default=False,
        ),
    ],
    save: Annotated[
        Path | None,
        typer.Option("--save", metavar="FILE.rrd", help="Write a file for the viewer instead of opening it."),
    ] = None,
    rate: Annotated[
        float | None,
        typer.Option(
            "--rate",
            min=0.001,
            max=100_000,
            metavar="HZ",
            help="The robot's control steps a second: draws the actions that were carried out between calls.",
            show_default="these aren't drawn",
        ),
    ] = None,
    seconds: Annotated[
        float | None,
        typer.Option(
            "--seconds", min=0.1, metavar="N", help="Watch a server for so long.", show_default="until Ctrl-C"
        ),
    ] = None,
    api_key: ApiKey = None,
    api_key_file: ApiKeyFile = None,
    as_json: JsonFlag = False,
) -> None:
    """Look at a recording, or at a live server, in the rerun viewer: images, state, chunks, latency, errors.

    Needs rerun, the extra `view`. A recording is shown call for call. Of a live server, whose page must be on, the
    viewer gets what the page does: small images, and some calls a second of each robot.
    """
    output = Output(as_json)
    from turbopi.view import unavailable

    if save is not None:
        if save.suffix != ".rrd":
            raise ConfigError(f"--save {save}: give a name that ends in .rrd, by which the viewer knows its files")
        check_writable(save)
    if (reason := unavailable()) is not None:
        raise ConfigError(f"can't view anything: {reason}")
    if "://" in what:
        from turbopi.view.live import LiveServer

        server = LiveServer(what, chosen_key(api_key, api_key_file))
        try:
            _draw(_watched(server, seconds, output), what, server.hello.policy, save, rate, output)
        finally:
            server.close()
    else:
        if seconds is not None:
            raise ConfigError("--seconds is for a server's address: a recording is shown whole")
        from turbopi.view.recorded import policy_of, recorded

        recording = Path(what)
        _draw(recorded(recording), recording.name, policy_of(recording), save, rate, output)


def _watched(server: "LiveServer", seconds: float | None, output: Output) -> "Iterator[ViewedCall | ViewedTrouble]":
    """What a server tells. Ctrl-C ends it, and what was seen is kept."""
    output.line(f"watching {server.url}" + (": Ctrl-C ends it" if seconds is None else f" for {seconds:g} s"))
    try:
        yield from server.watch(seconds)
    except KeyboardInterrupt:
        return


def _draw(
    seen: "Iterator[ViewedCall | ViewedTrouble]",
    name: str,
    policy: dict[str, Any],
    save: Path | None,
    rate: float | None,
    output: Output,
) -> None:
    from turbopi.view.calls import ViewedCall
    from turbopi.view.drawing import Drawing

    calls = troubles = 0
    drawing = Drawing(save, name, policy, rate)
    try:
        for one in seen:
            if isinstance(one, ViewedCall):
                calls += 1
                drawing.call(one)
            else:
                troubles += 1
                drawing.trouble(one)
                output.line(f"{'error' if one.serious else 'note'}: {one.text}", "yellow")
    finally:
        drawing.close()
    shown = "shown in the viewer" if save is None else f"written to {save}"
    output.line(
        f"{counted(calls, 'call')}, {'1 error or gap' if troubles == 1 else f'{troubles} errors and gaps'}, {shown}"
    )
    output.document({"calls": calls, "troubles": troubles, "saved": save})
