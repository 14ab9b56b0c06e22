"""Running the command line inside the test's process."""

import gc
import re
import signal

from typer.testing import CliRunner, Result

from turbopi.cli import app

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # a shell's background job; what tests start inherits it
    signal.signal(signal.SIGINT, signal.default_int_handler)


def turbopi(*arguments: object) -> Result:
    gc.freeze()  # in a process of its own a command's `gc.collect` wouldn't look through all that tests have imported
    try:
        return CliRunner().invoke(app, [str(argument) for argument in arguments], env={"TURBOPI_DEBUG": None})
    finally:
        gc.unfreeze()


def text_of(output: str) -> str:
    """Without colours, and with every run of blanks as one: help is boxed and wrapped."""
    return " ".join(re.sub(r"\x1b\[[0-9;]*m|[│╭╮╰╯─]", " ", output).split())


def refusal(result: Result, *, whole: bool = True) -> str:
    """The one line of an error, which must be all there is on stderr, with nothing on stdout.

    Unless `whole`, it may come after other lines on stderr, of a command with --json.
    """
    assert result.exit_code == 2, (result.exit_code, result.output, result.exception)
    assert result.stdout == ""
    if not whole:
        assert "Traceback" not in result.stderr
        *_, last = result.stderr.splitlines()
        assert last.startswith("error: ")
        return last.removeprefix("error: ")
    assert result.stderr.startswith("error: ")
    assert "Traceback" not in result.stderr
    return result.stderr.removeprefix("error: ").rstrip("\n")
