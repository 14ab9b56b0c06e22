"""--help of a command: descriptions are at least 40 columns wide on any terminal of 80, and no word is broken.

Typer's own gives each option's names, short name, type and description a column, which leaves 20 for the last.
"""

import shutil
from typing import Any

import typer
from rich.console import Console
from rich.padding import Padding
from rich.table import Table
from rich.text import Text
from typer.core import TyperArgument, TyperCommand

NAMES = 28  # columns of the names; the description of a longer one begins in the next line
WIDEST = 110  # longer lines are hard to read
ALWAYS = ("--help", "--help-all")
LAST = ("--json", "--debug", *ALWAYS)


class Command(TyperCommand):
    """A command of Turbo-Pi. `common` are the options that --help shows, others come with --help-all; (): all."""

    common: tuple[str, ...] = ()

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        try:
            return super().parse_args(ctx, args)
        except typer.BadParameter as error:
            problems = getattr(error.__cause__, "errors", None)  # pydantic's, whose message leaves the value out
            if problems is not None and "input" in (first := problems()[0]):
                error.message += f", not {str(first['input'])[:80]!r}"
            raise

    def format_help(self, ctx: Any, formatter: Any) -> None:
        show_help(self, ctx, whole=not self.common)


def show_all(ctx: typer.Context, wanted: bool) -> None:
    """--help-all."""
    if wanted and not ctx.resilient_parsing:
        show_help(ctx.command, ctx, whole=True)
        raise typer.Exit


def show_help(command: Any, ctx: Any, *, whole: bool) -> None:
    """Print usage, what the command does, its options and examples."""
    console = Console(highlight=False)
    if console.is_dumb_terminal:  # for which rich takes 80
        console.size = shutil.get_terminal_size()
    console.width = min(console.width, WIDEST)
    console.print()
    console.print(Text(command.get_usage(ctx), "bold"))
    for paragraph in (command.help or "").split("\n\n"):
        console.print()
        console.print(paragraph)
    sections, left = _sections(command, ctx, whole)
    for title, params in sections.items():
        console.print()
        console.print(Text(title, "bold"))
        for param in params:
            names, text = param.get_help_record(ctx) or ("", "")
            _show(console, param.metavar or names if title == "Arguments" else names, text)
    if left:
        console.print()
        console.print(Text(f"{left} more options, by topic: {ctx.command_path} --help-all"))
    console.print()
    for line in (command.epilog or "").split("\n\n"):
        console.print(f" {line}", soft_wrap=True)  # to be copied whole


def _sections(command: Any, ctx: Any, whole: bool) -> tuple[dict[str, list[Any]], int]:
    """What to show below which heading, and how many options are left out."""
    found: dict[str, list[Any]] = {"Arguments": [], "Options": []}
    last: list[Any] = []
    left = 0
    for param in command.get_params(ctx):
        if getattr(param, "hidden", False):
            continue
        names = {*param.opts}
        if isinstance(param, TyperArgument):
            found["Arguments"].append(param)
        elif not whole and not names & {*command.common, *ALWAYS}:
            left += 1
        elif names & {*LAST}:
            last.append(param)
        else:
            panel = getattr(param, "rich_help_panel", None) if whole else None
            found.setdefault(panel or "Options", []).append(param)
    if not whole:
        found["Options"].sort(key=lambda param: min(map(command.common.index, {*param.opts} & {*command.common})))
    found.setdefault("Others" if whole and len(found) > 2 else "Options", []).extend(last)
    return {title: params for title, params in found.items() if params}, left


def _show(console: Console, names: str, text: str) -> None:
    if len(names) > NAMES:
        console.print(Padding(Text(names, "cyan"), (0, 0, 0, 2)))
        names = ""
    row = Table.grid(padding=(0, 2, 0, 0))
    row.add_column(width=NAMES, no_wrap=True)
    row.add_column()
    row.add_row(Text(names, "cyan"), Text(text))
    if names or text:
        console.print(Padding(row, (0, 0, 0, 2)))
