"""The process around a command: streams that can't write everything, readers that leave, Ctrl-C at any moment."""

import contextlib
import io
import os
import pty
import signal
import subprocess
import sys
import textwrap
import threading
from pathlib import Path

import cli_helpers  # noqa: F401  # it lets the processes that are started hear Ctrl-C
import pytest

from turbopi.cli.process import slow_import_reported

TURBOPI = (sys.executable, "-m", "turbopi")
CLOSED = 141

ENCODINGS = [
    {"PYTHONIOENCODING": "ascii"},
    {"PYTHONIOENCODING": "latin-1"},
    {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"},
]


def turbopi(*arguments: str, **environment: str) -> "subprocess.CompletedProcess[bytes]":
    return subprocess.run([*TURBOPI, *arguments], capture_output=True, timeout=200, env=os.environ | environment)


@pytest.mark.slow
@pytest.mark.parametrize("environment", ENCODINGS, ids=str)
@pytest.mark.parametrize("arguments", [["infer", "--help"], ["serve", "--help"], ["--help"]], ids=" ".join)
def test_help_comes_out_whatever_the_encoding(arguments: list[str], environment: dict[str, str]) -> None:
    result = turbopi(*arguments, **environment)
    assert result.returncode == 0, result.stderr
    assert b"Examples" in result.stdout or b"Exit codes" in result.stdout
    assert result.stderr == b""


@pytest.mark.parametrize("environment", ENCODINGS, ids=str)
def test_text_beyond_the_encoding_is_replaced_in_lines_and_escaped_in_json(environment: dict[str, str]) -> None:
    code = (
        "from turbopi.cli.process import run\n"
        "from turbopi.cli.framework import Output\n"
        "def work():\n"
        "    Output().line('\\u5199 \\u201cok\\u201d'); Output().styled('[bold]\\u5199[/]')\n"
        "    Output(True).document({'a': '\\u5199\\xe9'})\n"
        "run(work)"
    )
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, env=os.environ | environment, timeout=200
    )
    assert (result.returncode, result.stderr) == (0, b"")
    assert b"ok" in result.stdout
    assert b'"a": "\\u5199\\u00e9"' in result.stdout


def test_a_name_that_is_no_text_can_be_written() -> None:
    code = (
        "from turbopi.cli.process import run\n"
        "from turbopi.cli.framework import Output\n"
        "run(lambda: Output().line('written to \\udcff.npz'))"
    )
    result = subprocess.run([sys.executable, "-X", "utf8", "-c", code], capture_output=True, timeout=200)
    assert (result.returncode, result.stderr) == (0, b"")
    assert result.stdout == b"written to \\udcff.npz\n"


def until_closed(*arguments: str) -> tuple[int, bytes]:
    """Run a command whose stdout nobody reads any more: exit code and stderr."""
    read, write = os.pipe()
    os.close(read)
    with os.fdopen(write, "wb") as stream:
        result = subprocess.run([*TURBOPI, *arguments], stdout=stream, stderr=subprocess.PIPE, timeout=200)
    return result.returncode, result.stderr


@pytest.mark.slow
@pytest.mark.parametrize(
    "arguments",
    [
        ["inspect", "--random-weights", "pi05_tiny"],
        ["inspect", "--random-weights", "pi05_tiny", "--json"],
        ["--version"],
    ],
    ids=" ".join,
)
def test_a_reader_that_leaves_ends_a_command_quietly(arguments: list[str]) -> None:
    code, errors = until_closed(*arguments)
    assert code in (1, CLOSED)
    assert b"Traceback" not in errors
    assert b"Exception ignored" not in errors
    assert b"error:" not in errors


def test_a_broken_pipe_that_is_not_the_output_is_no_quiet_end() -> None:
    code = (
        "from turbopi.cli import process, framework\n"
        "def work(): raise BrokenPipeError(32, 'Broken pipe')\n"
        "process.run(lambda: framework.app())\n"
    ).replace("framework.app()", "exit_of(lambda: framework.with_errors_reported(work, debug=False))")
    helper = (
        "import sys, typer\n"
        "def exit_of(work):\n"
        "    try: work()\n"
        "    except typer.Exit as end: sys.exit(end.exit_code)\n"
    )
    result = subprocess.run([sys.executable, "-c", helper + code], capture_output=True, timeout=200)
    assert result.returncode == 3
    assert b"BrokenPipeError" in result.stderr


@pytest.mark.slow
@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
@pytest.mark.parametrize("arguments", [["--version"], ["inspect", "--random-weights", "pi05_tiny"]], ids=" ".join)
def test_a_full_disk_behind_the_output_is_one_line(arguments: list[str]) -> None:
    with open("/dev/full", "wb") as full:
        result = subprocess.run([*TURBOPI, *arguments], stdout=full, stderr=subprocess.PIPE, timeout=200)
    assert result.returncode == 2
    assert result.stderr.startswith(b"error: can't write")
    assert result.stderr.count(b"\n") == 1


# --- Ctrl-C -----------------------------------------------------------------------------------------------------------

# What a command does once `READY` is printed, in the process of a command; {} is a moment
MOMENTS = {
    "while a module is imported": "exec('tell(); time.sleep(60)')",
    "in a library that swallows it": """
        with interrupts_end_at_once():
            try: tell(); time.sleep(60)
            except: pass
            time.sleep(60)
    """,
    "while a thread writes to the terminal": """
        def write():
            while True: sys.stderr.write('x' * 4096)
        threading.Thread(target=write, daemon=True).start(); tell(); time.sleep(60)
    """,
    "while a thread hangs": """
        threading.Thread(target=time.sleep, args=(600,)).start(); tell(); time.sleep(60)
    """,
    "while it cleans up": """
        try: tell(); time.sleep(60)
        finally: os.kill(os.getpid(), signal.SIGINT); time.sleep(60)
    """,
}


def test_a_slow_import_is_reported_on_a_terminal_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    def reported(terminal: bool, seconds: float) -> bool:
        said = threading.Event()

        class Stream(io.StringIO):
            def isatty(self) -> bool:
                return terminal

            def write(self, text: str) -> int:
                said.set()
                return super().write(text)

        with monkeypatch.context() as patched:
            patched.setattr(sys, "stderr", stream := Stream())
            patched.delitem(sys.modules, "torch", raising=False)
            with slow_import_reported(seconds):
                if terminal and not seconds:
                    said.wait(60)
        return stream.getvalue().startswith("importing PyTorch")

    assert reported(True, 0) and not reported(True, 1000) and not reported(False, 0)


@pytest.mark.parametrize("moment", MOMENTS)
def test_ctrl_c_ends_the_process_with_130(moment: str) -> None:
    body = textwrap.indent(textwrap.dedent(MOMENTS[moment]).strip(), "    ")
    code = (
        "import os, signal, sys, threading, time, typer\n"
        "from turbopi.cli.framework import with_errors_reported\n"
        "from turbopi.cli.process import interrupts_end_at_once, run\n"
        "def tell(): print('READY', flush=True)\n"
        f"def work():\n{body}\n"
        "def main():\n"
        "    try: with_errors_reported(work, debug=False)\n"
        "    except typer.Exit as end: sys.exit(end.exit_code)\n"
        "run(main)"
    )
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
    with subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, env=environment
    ) as process:
        try:
            assert process.stdout is not None
            assert process.stdout.readline() == b"READY\n"
            process.send_signal(signal.SIGINT)
            _, errors = process.communicate(timeout=200)
        finally:
            process.kill()
    assert process.returncode == 130
    assert b"Traceback" not in errors
    assert b"Fatal" not in errors


@pytest.mark.slow
@pytest.mark.parametrize("after", [b"", b"RANDOM WEIGHTS", b"GB of weights", b"loading random"], ids=repr)
def test_ctrl_c_while_a_full_size_model_is_loaded_is_130(after: bytes) -> None:
    """In a terminal, with a progress bar, after what the command has printed."""
    terminal, command_side = pty.openpty()
    with subprocess.Popen(
        [*TURBOPI, "serve", "--random-weights", "pi05_libero", "--port", "0", "--device", "cpu"],
        stdin=command_side,
        stdout=command_side,
        stderr=command_side,
    ) as process:
        os.close(command_side)
        try:
            printed = b""
            while after not in printed:
                printed += os.read(terminal, 4096)
            if not after:
                printed += os.read(terminal, 1)  # it has begun to print: Python itself has started
            process.send_signal(signal.SIGINT)
            with contextlib.suppress(OSError):  # raised once the other end is closed
                while True:
                    printed += os.read(terminal, 4096)
            process.wait(timeout=200)
        finally:
            process.kill()
            os.close(terminal)
    assert process.returncode == 130, printed
    assert b"Traceback" not in printed
    assert b"Fatal" not in printed
    assert printed.count(b"\x1b[?25l") <= printed.count(b"\x1b[?25h")  # the cursor is seen again
