"""The process around a command: its output streams, Ctrl-C, and how it ends.

A process that Ctrl-C ends leaves by `os._exit`. Interpreters that shut down in the ordinary way are not safe here: a
daemon thread may be inside a write to the terminal (progress bars) or inside a library's C code, and Python then aborts
with "Fatal Python error"; and a KeyboardInterrupt that went through an `exec` while a module was imported changes the
exit code. Nothing is lost: the command has cleaned up by then, and files are written whole or not at all. The same
holds when the GPU has failed for good: libraries that free its memory at the end abort, or wait for it.
"""

import contextlib
import errno
import os
import select
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from typing import IO, Any

BAD_INPUT, DEVICE_LOST = 2, 4
INTERRUPTED, OUTPUT_CLOSED = 130, 141  # 128 + the signal's number, as shells say it
_SHOW_CURSOR = b"\x1b[?25h"  # progress bars hide it

_ours = False  # whether this process runs one command and nothing else
_interrupted = False


def run(work: Callable[[], None]) -> None:
    """Run a command line to its SystemExit, as the whole of this process."""
    global _ours
    _ours = True
    for stream in (sys.stdout, sys.stderr):
        write_anything(stream)
    _on_interrupt(_interrupt_once)
    try:
        work()
        code: Any = 0
    except SystemExit as end:
        code = INTERRUPTED if _interrupted and end.code == 1 else end.code  # 1: click's "Aborted"
    except KeyboardInterrupt:
        code = INTERRUPTED
    except OSError as error:  # of --version and --help; commands tell their own
        code = _unwritable(error)
    code = _flush(code)
    if code in (INTERRUPTED, DEVICE_LOST):
        os._exit(code)
    sys.exit(code)


def write_anything(stream: IO[str] | None) -> None:
    """From now on, characters that the stream's encoding lacks are written as \\u2026 instead of raising."""
    if getattr(stream, "errors", None) in ("strict", "surrogateescape"):
        stream.reconfigure(errors="backslashreplace")  # type: ignore[union-attr]


def can_encode_all(stream: IO[str]) -> bool:
    """Whether the stream's encoding has every character."""
    return (getattr(stream, "encoding", None) or "utf-8").lower().replace("_", "-").startswith(("utf-8", "utf8"))


def is_closed_pipe(stream: IO[str] | None) -> bool:
    """Whether whoever read the stream has left, as `head` does."""
    try:
        descriptor = stream.fileno()  # type: ignore[union-attr]
        poll = select.poll()
    except (AttributeError, OSError, ValueError):
        return False
    poll.register(descriptor, 0)
    return any(event & select.POLLERR for _, event in poll.poll(0))


def forget_output() -> None:
    """Send what is still to be written to stdout nowhere, so that the exit doesn't fail over it."""
    with contextlib.suppress(OSError, ValueError, AttributeError):
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, sys.stdout.fileno())
        os.close(nowhere)


@contextlib.contextmanager
def interrupts_end_at_once() -> Iterator[None]:
    """Ctrl-C in this block ends the process there and then.

    For imports and for loading weights, which leave nothing behind that has to be cleaned up: libraries swallow a
    KeyboardInterrupt now and then (a bare `except:` around an import), and the command would go on.
    """
    if not _ours or threading.current_thread() is not threading.main_thread():
        yield
        return
    before = _on_interrupt(_leave_at_once)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


@contextlib.contextmanager
def slow_import_reported(seconds: float = 2.0) -> Iterator[None]:
    """On a terminal, a line if PyTorch isn't imported yet and this block takes longer than `seconds`."""
    timer = threading.Timer(seconds, print, ("importing PyTorch …",), {"file": sys.stderr, "flush": True})
    timer.daemon = True
    if "torch" not in sys.modules and sys.stderr.isatty():
        timer.start()
    try:
        yield
    finally:
        timer.cancel()


def _on_interrupt(handler: Callable[..., None]) -> Any:
    """Install a handler of SIGINT, unless the process was started with SIGINT ignored; returns the one before."""
    before = signal.getsignal(signal.SIGINT)
    if before != signal.SIG_IGN:
        signal.signal(signal.SIGINT, handler)
    return before


def _interrupt_once(*_: object) -> None:
    """KeyboardInterrupt, so that the command cleans up; the next Ctrl-C doesn't wait for that."""
    global _interrupted
    _interrupted = True
    signal.signal(signal.SIGINT, _leave_at_once)
    raise KeyboardInterrupt


def _leave_at_once(*_: object) -> None:
    with contextlib.suppress(OSError):
        if os.isatty(2):
            os.write(2, _SHOW_CURSOR + b"\n")
    os._exit(INTERRUPTED)


def _flush(code: object) -> object:
    """Write what is left in stdout; the exit code, which says so if that fails."""
    try:
        if sys.stdout is not None:
            sys.stdout.flush()
    except OSError as error:
        failed = _unwritable(error)
        return failed if code == 0 else code
    return code


def _unwritable(error: OSError) -> int:
    """The exit code of a command whose stdout can't be written."""
    forget_output()
    if error.errno == errno.EPIPE:
        return OUTPUT_CLOSED
    print(f"error: can't write to the standard output: {error.strerror}", file=sys.stderr)
    return BAD_INPUT
