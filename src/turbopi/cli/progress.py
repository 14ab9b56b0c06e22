"""The progress bar of commands that work in stages, each with a length of its own."""

from collections.abc import Callable
from typing import TypeVar

from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from turbopi.cli.framework import Output, new_console

Given = TypeVar("Given")
Result = TypeVar("Result")


def with_stages(
    work: Callable[[Given], Result],
    reported: Callable[[Callable[[str, int], None], Callable[[], None]], Given],
    output: Output,
    first: str = "loading the weights",
) -> Result:
    """work(told(begin, advance)): `begin(text, total)` opens a stage, `advance()` is one step of it.

    `first` is what goes on before the first stage. Where nobody watches a bar, each stage is a line.
    """
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    console = new_console(stderr=True)
    with Progress(*columns, console=console, transient=True, disable=not output.shows_progress) as bar:
        task = bar.add_task(first, total=None)

        def say(text: str) -> None:
            if not output.shows_progress:
                console.print(escape(f"{text} …"), style="dim", highlight=False, soft_wrap=True)

        def begin(text: str, total: int) -> None:
            bar.reset(task, description=text, total=total)
            say(text)

        say(first)

        return work(reported(begin, lambda: bar.advance(task)))
