"""Run command lines and readers in forks of one process that has imported everything: fast, bounded, apart.

The fork has its own folder, limits of time and memory, and its output in files. A process that takes longer or more is
killed, which its outcome says.
"""

import contextlib
import importlib
import json
import os
import resource
import select
import shlex
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from dataclasses import asdict, dataclass, field
from types import TracebackType
from typing import Any

import psutil

from attack.judging import TRACEBACK
from attack.server import environment

MAX_OUTPUT = 20_000  # characters of stdout and stderr that are looked at, from their ends
POLL_S = 0.02
_IMPORTS = (
    "torch",
    "numpy",
    "PIL.Image",
    "turbopi.cli",
    "turbopi.policy.policy",
    "turbopi.checkpoint",
    "turbopi.serve",
)


@dataclass(frozen=True)
class Job:
    """`turbopi` with `arguments`; or, with `call` ("module:function"), that function with those strings.

    file_bytes   limit of the size of any file that it writes (RLIMIT_FSIZE)
    """

    arguments: list[str]
    folder: str
    call: str | None = None
    seconds: float = 60.0
    memory_mb: float = 4000.0
    file_bytes: int | None = None
    environment: dict[str, str] = field(default_factory=dict)

    @property
    def line(self) -> str:
        """As it can be given to a shell."""
        if self.call is not None:
            return f"{self.call} {' '.join(map(repr, self.arguments))}"[:1500]
        return ("turbopi " + " ".join(shlex.quote(argument) for argument in self.arguments))[:1500]


@dataclass(frozen=True)
class Done:
    """code: the exit code, negative for a signal. killed: "time" or "memory" if a limit was passed."""

    code: int
    stdout: str
    stderr: str
    seconds: float
    peak_mb: float
    killed: str | None = None


def fault(done: Done, *, codes: tuple[int, ...] = (0, 1, 2)) -> str | None:
    """What no command may do, whatever it is given; None if it did nothing of that."""
    if done.killed is not None:
        return f"killed: too much {done.killed} ({done.seconds:.0f} s, {done.peak_mb:.0f} MB)"
    if TRACEBACK in done.stderr or TRACEBACK in done.stdout:
        last = done.stderr.strip().splitlines() or done.stdout.strip().splitlines()
        named = [line for line in last if not line.startswith(("  ", "Traceback", "error: this is a fault"))]
        return f"a traceback: {(named or last)[-1][:300]}"
    if done.code not in codes:
        return f"exit code {done.code}: {done.stderr.strip()[-300:]}"
    if done.code == 2 and not done.stderr.strip():
        return "exit code 2 and nothing on stderr"
    return None


class Zygote:
    """The process that forks. A context manager; `run` one job at a time."""

    def __enter__(self) -> "Zygote":
        self._process = subprocess.Popen(
            [sys.executable, "-m", "attack.zygote"], stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=environment()
        )
        return self

    def run(self, job: Job) -> Done:
        assert self._process.stdin is not None and self._process.stdout is not None
        self._process.stdin.write(json.dumps(asdict(job)).encode() + b"\n")
        self._process.stdin.flush()
        answer = self._process.stdout.readline()
        if not answer:
            raise RuntimeError(f"the process that forks ended with {self._process.wait()}")
        return Done(**json.loads(answer))

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        assert self._process.stdin is not None and self._process.stdout is not None
        self._process.stdin.close()
        self._process.wait(60)
        self._process.stdout.close()


# --- in the process that forks ----------------------------------------------------------------------------------------


def _child(job: Job, output: int, errors: int) -> None:
    """Become the command. Never returns."""
    code = 3
    try:
        os.setpgid(0, 0)
        os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        os.dup2(output, 1)
        os.dup2(errors, 2)
        os.chdir(job.folder)
        os.environ.update(job.environment)
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        if job.file_bytes is not None:
            signal.signal(signal.SIGXFSZ, signal.SIG_IGN)  # the write fails with EFBIG instead
            resource.setrlimit(resource.RLIMIT_FSIZE, (job.file_bytes, job.file_bytes))
        sys.stdin = open(0, encoding="utf-8", closefd=False)  # noqa: SIM115 # for the life of the process
        sys.stdout = open(1, "w", encoding="utf-8", errors="surrogateescape", closefd=False)  # noqa: SIM115
        sys.stderr = open(2, "w", encoding="utf-8", errors="backslashreplace", closefd=False)  # noqa: SIM115
        _become(job)
        code = 0
    except SystemExit as leaving:
        code = leaving.code if isinstance(leaving.code, int) else 0 if leaving.code is None else 1
    except BaseException:
        traceback.print_exc()
    finally:
        for stream in (sys.stdout, sys.stderr):
            try:
                stream.flush()
            except (OSError, ValueError):
                code = code or 1
        os._exit(code)


def _become(job: Job) -> None:
    if job.call is None:
        from turbopi.cli import main

        sys.argv = ["turbopi", *job.arguments]
        main()
    else:
        module, _, name = job.call.partition(":")
        from typer import Exit

        try:
            getattr(importlib.import_module(module), name)(*job.arguments)
        except Exit as end:
            sys.exit(end.exit_code)


def _run(job: Job) -> Done:
    with tempfile.TemporaryFile() as output, tempfile.TemporaryFile() as errors:
        started = time.monotonic()
        child = os.fork()
        if child == 0:
            _child(job, output.fileno(), errors.fileno())
        with contextlib.suppress(OSError):  # it has done so itself, or has ended
            os.setpgid(child, child)
        status, peak, killed = _wait(child, job, started)
        return Done(
            os.waitstatus_to_exitcode(status),
            _end_of(output),
            _end_of(errors),
            round(time.monotonic() - started, 2),
            round(peak, 1),
            killed,
        )


def _wait(child: int, job: Job, started: float) -> tuple[int, float, str | None]:
    """Wait for the child and its limits: (wait status, peak MB, the limit it passed)."""
    peak, killed, family = 0.0, None, psutil.Process(child)
    while True:
        pid, status, _ = os.wait4(child, os.WNOHANG)
        if pid:
            _kill_group(child)  # what it left behind
            return status, peak, killed
        peak = max(peak, _resident(family))
        if killed is None:
            killed = "time" if time.monotonic() - started > job.seconds else "memory" if peak > job.memory_mb else None
            if killed is not None:
                _kill_group(child)
        time.sleep(POLL_S)


def _kill_group(leader: int) -> None:
    with contextlib.suppress(ProcessLookupError):
        os.killpg(leader, signal.SIGKILL)


def _resident(process: psutil.Process) -> float:
    """MB of the process and its children."""
    total = 0
    with contextlib.suppress(psutil.Error):  # one that ends meanwhile
        for one in (process, *process.children(recursive=True)):
            total += one.memory_info().rss
    return total / 2**20


def _end_of(file: Any) -> str:
    size = file.seek(0, os.SEEK_END)
    file.seek(max(0, size - MAX_OUTPUT))
    return file.read().decode("utf-8", "replace")


def main() -> None:
    for name in _IMPORTS:
        importlib.import_module(name)
    answers = os.fdopen(os.dup(1), "wb", buffering=0)
    os.dup2(2, 1)
    while select.select([sys.stdin], [], []) and (line := sys.stdin.readline()):
        done = _run(Job(**json.loads(line)))
        answers.write(json.dumps(asdict(done)).encode() + b"\n")


if __name__ == "__main__":
    main()
