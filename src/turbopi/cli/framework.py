"""What every command shares: how it is declared, where its output goes, and how it fails.

Exit codes: 0 all is well, 1 a check failed, 2 bad usage or input, 3 a fault of Turbo-Pi's own, 4 the GPU failed for
good, 130 Ctrl-C, 141 whoever read the output has left.
Nothing here or at the top of a command's module imports torch, so that `turbopi --help` answers at once.
"""

import contextlib
import errno
import functools
import inspect
import json
import logging
import math
import os
import shutil
import sys
import traceback
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, fields
from datetime import datetime
from pathlib import Path
from typing import Annotated

import rich
import typer
from msgspec import Struct
from rich.console import Console
from rich.file_proxy import FileProxy
from rich.markup import escape
from rich.table import Table

from turbopi.cli.help import Command, show_all
from turbopi.cli.process import (
    BAD_INPUT,
    DEVICE_LOST,
    INTERRUPTED,
    OUTPUT_CLOSED,
    can_encode_all,
    forget_output,
    is_closed_pipe,
)
from turbopi.cli.tables import fitted
from turbopi.cli.typed import as_typed
from turbopi.support.errors import ConfigError, DeviceLost, TurboPiError
from turbopi.support.reading import plain_document

CHECK_FAILED, OUR_FAULT = 1, 3
MAX_MESSAGE = 2000  # characters of an error
PLAIN_WIDTH = 80  # columns of tables where there is no terminal, unless COLUMNS says otherwise

app = typer.Typer(
    name="turbopi",
    no_args_is_help=True,
    rich_markup_mode="rich",
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)

JsonFlag = Annotated[
    bool,
    typer.Option("--json", help="Print one JSON document to standard output; all else goes to standard error."),
]
_Debug = Annotated[
    bool, typer.Option("--debug", envvar="TURBOPI_DEBUG", help="Show the traceback of an error.", show_default=False)
]
_HelpAll = Annotated[
    bool,
    typer.Option("--help-all", is_eager=True, callback=show_all, help="Show every option.", show_default=False),
]


class Output:
    """Where a command writes: people's output to stdout, or, with --json, to stderr beside one document on stdout."""

    def __init__(self, as_json: bool = False) -> None:
        self.as_json = as_json
        self.console = new_console(stderr=as_json)

    def line(self, text: str = "", style: str | None = None) -> None:
        """A line, taken as it is; on a terminal it wraps between words, in a file or a pipe never."""
        self.console.print(escape(text), style=style, highlight=False, soft_wrap=not self.console.is_terminal)

    def styled(self, markup: str) -> None:
        """A line with rich's markup, never wrapped."""
        self.console.print(markup, highlight=False, soft_wrap=True)

    def table(self, table: Table) -> None:
        """A table, in parts if it is wider than the terminal."""
        for part in fitted(table, self.console):
            self.console.print(part)

    def document(self, content: Mapping[str, object] | Struct) -> None:
        """The JSON document, if one was asked for."""
        if self.as_json:
            values = plain_document(content) if isinstance(content, Struct) else content
            text = json.dumps(plain(values), indent=1, ensure_ascii=not can_encode_all(sys.stdout))
            print(text, flush=True)

    @property
    def shows_progress(self) -> bool:
        """Bars are for people who watch; they are drawn on stderr."""
        return sys.stderr.isatty()


def new_console(*, stderr: bool) -> Console:
    """A console whose width is the terminal's, and in a file or a pipe PLAIN_WIDTH, whatever terminal is near."""
    console = Console(stderr=stderr)
    if not console.is_terminal and "COLUMNS" not in os.environ:
        console.width = PLAIN_WIDTH
    elif console.is_dumb_terminal:  # for which rich takes 80
        console.size = shutil.get_terminal_size()
    return console


def plain(value: object) -> object:
    """`value` as JSON's types: arrays as lists, paths as text, what isn't finite as null."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if hasattr(value, "tolist"):  # NumPy
        return plain(value.tolist())
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return str(value) if isinstance(value, Path) else value


class CheckpointThen(Command):
    """A command whose one argument is a list: a checkpoint, which random weights do without, and something else."""

    other = "PATH"

    def collect_usage_pieces(self, ctx: object) -> list[str]:
        return ["[OPTIONS]", "[CHECKPOINT]", self.other]


@dataclass(frozen=True)
class Described:
    """A function as a command: `run` has the options that typer reads."""

    run: Callable[..., None]
    cls: type[Command]
    help: str
    epilog: str | None

    def declare(self, to: typer.Typer, name: str, *, hidden: bool = False) -> None:
        to.command(name, cls=self.cls, help=self.help, epilog=self.epilog, hidden=hidden)(self.run)


def command(
    name: str,
    *,
    examples: Sequence[str],
    shared: type | None = None,
    cls: type[Command] = Command,
    common: Sequence[str] = (),
    hidden: bool = False,
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Declare a function as `turbopi <name>`, as `describe` has it. `hidden`: --help doesn't list it."""

    def decorate(function: Callable[..., None]) -> Callable[..., None]:
        described = describe(function, examples=examples, shared=shared, cls=cls, common=common)
        described.declare(app, name, hidden=hidden)
        return described.run

    return decorate


def describe(
    function: Callable[..., None],
    *,
    examples: Sequence[str] = (),
    shared: type | None = None,
    cls: type[Command] = Command,
    common: Sequence[str] = (),
    owner: str = "Turbo-Pi's own",
) -> Described:
    """A function with typer's annotations as a command.

    examples   command lines for the end of its --help
    shared     a dataclass whose annotated fields become options; the function gets an instance as `options`
    cls        for another usage line
    common     the options that --help shows; the others come with --help-all, by topic. (): --help shows all
    owner      whose code it is, for the message of a fault
    """
    shared_fields = fields(shared) if shared is not None else ()

    @functools.wraps(function)
    def run(*, debug: bool, help_all: bool = False, **values: object) -> None:
        given = dict(values)
        if shared is not None:
            values["options"] = shared(**{field.name: values.pop(field.name) for field in shared_fields})

        def work() -> None:
            _refuse_nan(given)
            function(**values)

        with_errors_reported(work, debug=debug, owner=owner, options=options)

    keyword = inspect.Parameter.KEYWORD_ONLY
    own = inspect.signature(function, eval_str=True).parameters.values()
    injected = [
        inspect.Parameter(field.name, keyword, default=field.default, annotation=field.type) for field in shared_fields
    ]
    parameters = [
        *(parameter.replace(kind=keyword) for parameter in own if parameter.name != "options"),
        *injected,
        inspect.Parameter("debug", keyword, default=False, annotation=_Debug),
    ]
    if common:
        parameters.append(inspect.Parameter("help_all", keyword, default=False, annotation=_HelpAll))
        cls = type(cls.__name__, (cls,), {"common": tuple(common)})
    run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    options = {f"--{parameter.name.replace('_', '-')}" for parameter in parameters}
    run.__annotations__ = {p.name: p.annotation for p in parameters}
    del run.__wrapped__  # or typer would read the undecorated signature
    return Described(run, cls, _unwrapped(function), _epilog(examples) if examples else None)


def _refuse_nan(values: Mapping[str, object]) -> None:
    """NaN passes every min and max, as it compares with nothing."""
    for name, value in values.items():
        if isinstance(value, float) and math.isnan(value):
            raise ConfigError(f"--{name.replace('_', '-')} is nan; expected a number")


def _unwrapped(function: Callable[..., None]) -> str:
    """The docstring with each paragraph on one line: the terminal's width decides where lines end."""
    paragraphs = inspect.cleandoc(function.__doc__ or "").split("\n\n")
    return "\n\n".join(escape(" ".join(paragraph.split())) for paragraph in paragraphs)


def _epilog(examples: Sequence[str]) -> str:
    lines = [f"[cyan]{escape(example)}[/]" for example in examples]
    return "\n\n".join(["[bold]Examples[/]", *lines])


def with_errors_reported(
    work: Callable[[], None], *, debug: bool, owner: str = "Turbo-Pi's own", options: Collection[str] = ()
) -> None:
    """Run a command with these options; an error becomes one red line on stderr and an exit code, and a fault of
    `owner` a traceback.
    """
    rich.reconfigure(stderr=True)  # progress bars of the library use rich's own console
    log_to_stderr()
    try:
        work()
    except (typer.Exit, typer.Abort):
        raise
    except KeyboardInterrupt:
        raise typer.Exit(INTERRUPTED) from None
    except Exception as error:
        if isinstance(error, BrokenPipeError) and (is_closed_pipe(sys.stdout) or is_closed_pipe(sys.stderr)):
            forget_output()
            raise typer.Exit(OUTPUT_CLOSED) from None
        message = _users_message(error, options)
        if debug or message is None:
            traceback.print_exc()
        if message is None:
            message = f"this is a fault of {owner} ({type(error).__name__}); please report it with the traceback "
            message += "and what `turbopi doctor --json` prints"
        console = new_console(stderr=True)
        said = f"[bold red]error:[/] {escape(_shortened(message))}"
        console.print(said, highlight=False, soft_wrap=not console.is_terminal)
        raise typer.Exit(_exit_code(error)) from None


def _shortened(message: str) -> str:
    """A message that quotes a very long argument, without its middle."""
    return message if len(message) <= MAX_MESSAGE else f"{message[: MAX_MESSAGE // 2]} … {message[-MAX_MESSAGE // 2 :]}"


def _exit_code(error: Exception) -> int:
    if isinstance(error, DeviceLost):
        return DEVICE_LOST
    return OUR_FAULT if _users_message(error) is None else BAD_INPUT


def _users_message(error: Exception, options: Collection[str] = ()) -> str | None:
    """What to tell of an error that isn't a fault in the program; None if it is one."""
    if isinstance(error, TurboPiError):
        return as_typed(str(error), options)
    if isinstance(error, OSError) and error.filename is not None:  # a file of the user's: unwritable, vanished, …
        return f"{os.fsdecode(error.filename)}: {error.strerror}"
    if isinstance(error, OSError) and error.errno in _NO_ROOM:  # of writes, which know no name
        return f"can't write: {error.strerror}"
    if isinstance(error, MemoryError) or type(error).__name__ == "OutOfMemoryError":  # torch's, unimported
        return (
            f"out of memory: {error}. Full-size models need 7.2 GB in bf16 and 14.5 GB in f32; "
            "`turbopi doctor` shows what there is"
        )
    return None


_NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EIO)


class _StderrHandler(logging.Handler):
    """Log records as short lines on whatever sys.stderr is when they come; `stamped`: each begins with its time."""

    stamped = False

    def emit(self, record: logging.LogRecord) -> None:
        time = f"{_iso(record.created)} " if self.stamped else ""
        level = "" if record.levelno == logging.INFO else f"{record.levelname.lower()}: "
        with contextlib.suppress(OSError, ValueError):  # whoever read the log has left: no reason to stop working
            text = f"{time}{level}{as_typed(record.getMessage())}"
            if sys.stderr.isatty() and not self.stamped and not isinstance(sys.stderr, FileProxy):  # a bar's: above it
                new_console(stderr=True).print(escape(text), highlight=False)
            else:
                print(text, file=sys.stderr, flush=True)
            if record.exc_info:
                traceback.print_exception(*record.exc_info, file=sys.stderr)


def _iso(seconds: float) -> str:
    """2026-01-31T09:30:00.123+01:00"""
    return datetime.fromtimestamp(seconds).astimezone().isoformat(timespec="milliseconds")


def log_to_stderr(*, stamped: bool = False) -> None:
    """Show the library's log on stderr. `stamped`: with the time, for commands that run for days."""
    logger = logging.getLogger("turbopi")
    found = [handler for handler in logger.handlers if isinstance(handler, _StderrHandler)]
    if not found:
        found = [_StderrHandler()]
        logger.addHandler(found[0])
    found[0].stamped = stamped
