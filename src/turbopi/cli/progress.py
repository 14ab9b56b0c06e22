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
    """work(reported(begin, advance)): `begin(text, total)` opens a stage, `advance()` is one step of it.

    `first` goes on before the first stage, and is a line. Where nobody watches a bar, each stage is one, too.
    """
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    console = new_console(stderr=True)
    with Progress(*columns, console=console, transient=True, disable=not output.shows_progress) as bar:
        task = bar.add_task("", total=None, visible=False)

        def say(text: str) -> None:
            console.print(escape(f"{text} …"), style="dim", highlight=False, soft_wrap=True)

        def begin(text: str, total: int) -> None:
            bar.reset(task, description=text, total=total, visible=True)
            if not output.shows_progress:
                say(text)

        say(first)
        return work(reported(begin, lambda: bar.advance(task)))
