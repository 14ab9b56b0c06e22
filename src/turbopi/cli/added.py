"""Commands of other distributions: --help lists them from their metadata, and only the one that runs is imported."""

from collections.abc import Mapping
from typing import Any

import typer
from rich.markup import escape
from typer.core import TyperGroup

from turbopi.cli.framework import Described, app, describe, log_to_stderr, with_errors_reported
from turbopi.cli.help import Command
from turbopi.support import extensions
from turbopi.support.errors import ConfigError

ELSEWHERE = {  # commands of ours that are installed apart
    "study": "`turbopi study` comes with the package turbopi-lab; in Turbo-Pi's clone: "
    "pip install -e packages/turbopi-lab"
}


GROUPS = {  # of --help, in its order; what is named in none is advanced
    "Run": ("demo", "infer", "serve", "view", "replay"),
    "Checkpoint": ("inspect", "convert", "calibrate", "verify"),
    "Measure": ("bench", "eval", "compare"),
    "Advanced": (),
}


class Commands(TyperGroup):
    """Turbo-Pi's own commands by what they are for, then the others'."""

    def get_params(self, ctx: Any) -> list[Any]:
        """Flags without a type: `--version <bool>` looks as if a value had to follow."""
        params = super().get_params(ctx)
        for param in params:
            if getattr(param, "is_flag", False) and param.metavar is None:
                param.metavar = ""
        return params

    def list_commands(self, ctx: Any) -> list[str]:
        grouped = [name for names in GROUPS.values() for name in names]
        own = super().list_commands(ctx)
        return [*(name for name in grouped if name in own), *(name for name in own if name not in grouped), *added()]

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """As --help lists it; None if there is none. What runs is `resolve_command`'s."""
        own: Any = super().get_command(ctx, cmd_name)
        if own is not None:
            own.rich_help_panel = next((title for title, names in GROUPS.items() if cmd_name in names), "Advanced")
            return own
        if (other := added().get(cmd_name)) is None:
            return None
        return Command(cmd_name, help=escape(other.summary), rich_help_panel=f"Of {escape(other.distribution)}")

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        name = args[0]
        if super().get_command(ctx, name) is None:
            if (other := added().get(name)) is not None:
                return name, loaded(other), args[1:]
            if name in ELSEWHERE:
                with_errors_reported(lambda: _refuse(ELSEWHERE[name]), debug=False)
        return super().resolve_command(ctx, args)


def added() -> Mapping[str, extensions.Extension]:
    log_to_stderr()  # of what is skipped
    return extensions.found(extensions.COMMANDS, [str(one.name) for one in app.registered_commands])


def loaded(other: extensions.Extension) -> Any:
    """Import it. An error ends the process, as those of commands do."""
    alone = typer.Typer(add_completion=False, rich_markup_mode="rich", pretty_exceptions_enable=False)

    def declare() -> None:
        found = other.load()
        try:
            described = found if isinstance(found, Described) else describe(found, owner=other.distribution)
            described.declare(alone, other.name)
            typer.main.get_command(alone)
        except Exception as error:
            raise ConfigError(f"the {other} is no command: {extensions.reason(error)}") from error

    with_errors_reported(declare, debug=False)
    return typer.main.get_command(alone)


def _refuse(message: str) -> None:
    raise ConfigError(message)
