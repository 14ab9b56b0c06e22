"""Options of a command in a TOML file, by their names: `max-batch = 8`. The command line and the environment win."""

import difflib
import inspect
import json
import sys
from pathlib import Path
from typing import Annotated, Any, get_args, get_origin

import typer

from turbopi.cli.framework import with_errors_reported
from turbopi.support.errors import ConfigError
from turbopi.support.reading import listing, read_bytes

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

NOT_THERE = ("settings", "print_all", "help", "help_all", "debug")
SECRET = ("api_key",)
MAX_BYTES = 2**20


def read_settings(ctx: typer.Context, file: Path | None) -> Path | None:
    """Take the file's values as the command's defaults."""
    if file is not None and not ctx.resilient_parsing:
        with_errors_reported(lambda: _use(ctx, file), debug=False)
    return file


Settings = Annotated[
    Path | None,
    typer.Option(
        "--settings",
        metavar="FILE",
        is_eager=True,
        callback=read_settings,
        rich_help_panel="Settings",
        help="Options from a TOML file, such as `port = 8001`; the command line wins.",
    ),
]
PrintSettings = Annotated[
    bool,
    typer.Option("--print-settings", rich_help_panel="Settings", help="Print all options so; start nothing."),
]


def print_settings(ctx: typer.Context) -> None:
    """The command's options as they are now, as a file for --settings; those without a value are comments."""
    for key, param in _keys(ctx.command).items():
        value = ctx.params.get(param.name)
        if param.name in SECRET:
            if value is not None:
                print(f"# {key} is given and not printed; api-key-file names a file that holds it")
        elif value is None:
            print(f"# {key} =")
        else:
            print(f"{key} = {json.dumps(str(value) if isinstance(value, Path) else value, ensure_ascii=False)}")


def _use(ctx: typer.Context, file: Path) -> None:
    try:
        values = tomllib.loads(read_bytes(file, ConfigError, limit=MAX_BYTES).decode())
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"{file} is no TOML file: {error}") from error
    keys, types = _keys(ctx.command), _types(ctx.command)
    defaults: dict[str, Any] = {}
    for key, value in values.items():
        name = key.replace("_", "-")
        if name not in keys:
            near = difflib.get_close_matches(name, keys, 1)
            known = f"is it {near[0]}?" if near else f"its keys are {listing(list(keys), len(keys))}"
            raise ConfigError(f"{file}: {key} is no option of `{ctx.command_path}`; {known}")
        param = keys[name]
        if param.name in defaults:
            raise ConfigError(f"{file}: {name} is given twice, once as {key}")
        wanted = types[str(param.name)]
        allowed = (int, float) if wanted is float else (wanted,)
        if not isinstance(value, allowed) or isinstance(value, bool) != (wanted is bool):
            described = {bool: "true or false", int: "a whole number", float: "a number"}.get(wanted, "text in quotes")
            raise ConfigError(f"{file}: {key} is {value!r:.100}; expected {described}")
        try:
            param.process_value(ctx, value)
        except Exception as error:  # typer's own click's, or click's: beyond what the option allows
            if not hasattr(error, "format_message"):
                raise
            raise ConfigError(f"{file}: {key} is {value!r:.100}: {error.format_message()}") from error
        defaults[str(param.name)] = value
    ctx.default_map = defaults


def _keys(command: Any) -> dict[str, Any]:
    """Name in a file -> parameter: the long name of an option without its dashes, and the argument's."""
    found = {}
    for param in command.params:
        if param.name not in NOT_THERE:
            longest = max(param.opts, key=len)
            found[longest.lstrip("-").replace("_", "-")] = param
    return found


def _types(command: Any) -> dict[str, type]:
    """Parameter -> bool, int, float, or str for text and paths."""
    found = {}
    for name, parameter in inspect.signature(command.callback).parameters.items():
        annotation = parameter.annotation
        if get_origin(annotation) is Annotated:
            annotation = get_args(annotation)[0]
        kinds = [kind for kind in get_args(annotation) or (annotation,) if kind is not type(None)]
        found[name] = kinds[0] if kinds[0] in (bool, int, float) else str
    return found
