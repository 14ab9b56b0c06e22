"""Running the command line inside the test's process."""

import gc
import re
import signal
from typing import Any

import typer
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


def check_help(command: Any, *words: str) -> None:
    """That `turbopi WORDS --help` cuts or breaks no word of its options and examples at the terminal's 80 columns."""
    names = {name for one in command.params for name in one.opts}
    output = turbopi(*words, "--help-all" if "--help-all" in names else "--help").stdout
    lines = re.sub(r"\x1b\[[0-9;]*m", "", output).splitlines()
    assert max(map(len, lines)) <= 80
    found = text_of(output).split()
    found += [word.rstrip(",") for word in found]
    for one in command.get_params(typer.Context(command)):
        if not getattr(one, "hidden", False):
            said = [one.metavar or "", getattr(one, "help", None) or ""]
            missing = {word for text in said for word in text.split()} - set(found)
            assert not missing, f"{one.opts}: {missing}"
        if one.opts[0].startswith("-") and not getattr(one, "hidden", False):
            assert set(one.opts + one.secondary_opts) <= set(found)
    for example in re.findall(r"\[cyan\](.*?)\[/\]", command.epilog or ""):
        shown = example.replace(r"\[", "[")
        assert f" {shown}" in (line.rstrip() for line in lines), "an example is longer than a line"
    assert "<bool>" not in found, "a flag takes no value"
