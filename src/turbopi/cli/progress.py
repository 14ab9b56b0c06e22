"""The progress bar of commands that work in stages, each with a length of its own."""

from collections.abc import Callable
from typing import TypeVar

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from turbopi.cli.framework import Output, new_console

Given = TypeVar("Given")
Result = TypeVar("Result")


def with_stages(
    work: Callable[[Given], Result],
    reported: Callable[[Callable[[str, int], None], Callable[[], None]], Given],
    output: Output,
) -> Result:
    """work(told(begin, advance)): `begin(text, total)` opens a stage, `advance()` is one step of it."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    console = new_console(stderr=True)
    with Progress(*columns, console=console, transient=True, disable=not output.shows_progress) as bar:
        task = bar.add_task("", total=None, visible=False)

        def begin(text: str, total: int) -> None:
            bar.reset(task, description=text, total=total, visible=True)

        return work(reported(begin, lambda: bar.advance(task)))
