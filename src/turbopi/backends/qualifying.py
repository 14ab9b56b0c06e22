"""Finding out whether `fused` is right and fast on a GPU, in a process of its own: `python -m turbopi.qualify`.

A barrier that never opens, a failure that sticks to a process's GPU, a compiler that crashes: each ends that process,
or is ended with it after a time limit, and the caller's GPU stays sound.
"""

import logging
import os
import queue
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any, Final

import msgspec
import torch
from msgspec import Struct
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from turbopi.backends.qualification import COMMAND, Stage, Taken, Verdict, about, file_of, keep, kept
from turbopi.config import Kind, Network
from turbopi.quantization.plan import TIERS, Precision
from turbopi.support.errors import OutputError
from turbopi.support.files import alone_in

logger = logging.getLogger(__name__)

SECONDS, PATIENT_SECONDS = 60.0, 600.0  # at most: when a policy is made; ahead
ATTEMPTS: Final = 4  # processes at most: one that died may be followed by one without what it died of
TURNS: Final = 2  # starts whose time is up until `auto` leaves it to `doctor`: the second one finds compiled kernels
STAGES: Final = ("grid barrier", "kernels", "the model's sizes", "the shipped policy", "race")
DOUBLE_VARIABLE: Final = "TURBOPI_QUALIFY_DOUBLE"  # a module that the process imports first: planted faults
Tell = Callable[[str, int], None]  # what is done now, and how many of STAGES are


class Event(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """A line of what the process says.

    at, quiet, path  what it does now; for how many seconds it may say nothing; what to exclude if that fails
    reason           why that is taken, of what was tried so far
    failed           why it ends; transient: for a reason that may be gone next time
    """

    at: str = ""
    quiet: float = 0.0
    path: str = ""
    stage: Stage | None = None
    excluded: dict[str, str] = {}
    milliseconds: dict[str, dict[str, float]] = {}
    memory: int = 0
    taken: Taken | None = None
    reason: str = ""
    done: bool = False
    failed: str = ""
    transient: bool = False


class Request(Struct, frozen=True, kw_only=True):
    """What the process is to do. model: the network's fields, as JSON."""

    device: int
    precision: Precision
    kind: Kind
    model: dict[str, Any]
    excluded: dict[str, str]


def qualify(
    device: torch.device,
    precision: Precision,
    model: Network,
    *,
    seconds: float | None = None,
    tell: Tell = lambda text, done: None,
) -> Verdict:
    """Find out, in at most so many seconds (None: SECONDS), and keep the verdict. Processes take turns."""
    file = file_of(device, precision, model)
    end = time.monotonic() + (SECONDS if seconds is None else seconds)
    before = kept(device, precision, model)

    def found() -> Verdict:
        theirs = kept(device, precision, model)
        if theirs is not None and theirs != before:  # of the process that had the turn before
            return theirs
        return _qualified(device, precision, model, before, end, tell)

    while time.monotonic() < end:
        try:
            with alone_in(file.parent, "a process that qualifies a GPU"):
                return found()
        except OutputError:
            if not os.access(file.parent, os.W_OK):  # nobody can keep anything: each process for itself
                return found()
        tell("another process qualifies this GPU", 0)
        time.sleep(0.5)
    run = _Run(why="another process was qualifying this GPU", soon=True)
    return _verdict(device, precision, model, run)


def _qualified(
    device: torch.device, precision: Precision, model: Network, before: Verdict | None, end: float, tell: Tell
) -> Verdict:
    began, unfinished = time.monotonic(), 0 if before is None else before.unfinished
    run = _Run(excluded=dict(before.excluded) if before is not None and unfinished else {})
    for _ in range(ATTEMPTS):
        fields = msgspec.to_builtins(model)
        request = Request(
            device=device.index or 0, precision=precision, kind=model.kind, model=fields, excluded=run.excluded
        )
        run = _attempt(request, end, tell)
        if not run.path or run.path in run.excluded:
            break
        run.excluded[run.path] = run.why
    verdict = _verdict(device, precision, model, run, time.monotonic() - began, unfinished)
    file = file_of(device, precision, model)
    keep(verdict, file, soon=run.soon)
    if (todo := verdict.issue(file)) is not None:
        logger.warning("backend 'fused' failed its self-test on %s: %s; %s", verdict.gpu, verdict.summary, todo)
    return verdict


@dataclass
class _Run:
    """What processes said. why, path: why the last one ended, and what may be excluded for it; soon: to be tried again
    by the next start; time_up: it was ended at its time's end.
    """

    excluded: dict[str, str] = field(default_factory=dict)
    stages: list[Stage] = field(default_factory=list)
    milliseconds: dict[str, dict[str, float]] = field(default_factory=dict)
    memory: int = 0
    taken: Taken | None = None
    reason: str = ""  # of what is taken
    finished: bool = False
    why: str = ""
    path: str = ""
    soon: bool = False
    time_up: bool = False
    log: str = ""


def _verdict(
    device: torch.device,
    precision: Precision,
    model: Network,
    run: _Run,
    seconds: float = 0.0,
    unfinished: int = 0,
) -> Verdict:
    alone = precision in TIERS  # `fused` alone runs in it
    failed = not (run.finished or run.time_up or run.soon)
    taken, reason = run.taken, run.why
    if failed:
        taken, reason = (None if alone else "cuda_graph"), f"its self-test failed: {run.why}"
    elif not run.finished:
        taken = "fused" if alone else "cuda_graph"
    return Verdict(
        **about(device, precision, model),
        seconds=round(seconds, 1),
        taken=taken,
        reason=reason,
        failed=failed,
        excluded=run.excluded,
        stages=run.stages,
        milliseconds=run.milliseconds,
        device_bytes=run.memory,
        unfinished=unfinished + run.time_up,
        log=run.log,
    )


def _command() -> list[str]:
    return [sys.executable, "-m", "turbopi.qualify"]


def _attempt(request: Request, end: float, tell: Tell) -> _Run:
    """One process from its start to its end."""
    run = _Run(excluded=dict(request.excluded))
    with tempfile.TemporaryFile() as log:
        pipe = subprocess.PIPE
        try:
            process = subprocess.Popen(_command(), stdin=pipe, stdout=pipe, stderr=log, start_new_session=True)
        except OSError as error:
            run.why, run.soon = f"no process could be started: {error}", True
            return run
        assert process.stdin is not None
        try:
            with suppress(BrokenPipeError), process.stdin as stdin:  # then it says why
                stdin.write(msgspec.json.encode(request))
            _listen(process, run, end, tell)
        finally:
            _end(process)
        if not (run.finished or run.time_up or run.soon):
            run.log = _end_of(log)
        else:
            run.path = ""
    return run


def _listen(process: "subprocess.Popen[bytes]", run: _Run, end: float, tell: Tell) -> None:
    """Until it has said what it found, or has ended, or has to be ended."""
    assert process.stdout is not None
    lines: queue.SimpleQueue[bytes | None] = queue.SimpleQueue()
    threading.Thread(target=_read, args=(process.stdout, lines), daemon=True).start()
    at, quiet = "its start", PATIENT_SECONDS
    while not run.finished:
        left = end - time.monotonic()
        try:
            line = lines.get(timeout=max(0.0, min(quiet, left)))
        except queue.Empty:
            run.time_up, run.why = quiet >= left, f"{at} said nothing for {quiet:.0f} s, as if it waited for ever"
            if run.time_up:
                run.why = f"time was up at {at}; {COMMAND} takes up to {PATIENT_SECONDS:.0f} s"
            if run.time_up and run.reason:
                run.why, run.finished, run.time_up = f"{run.reason}; time was up at {at}", True, False
            return
        if line is None:
            run.why, run.soon = f"{at}: the process ended with code {process.wait()}", at == "its start"
            return
        one = msgspec.json.decode(line, type=Event)
        if one.failed:
            run.why, run.soon = f"{at}: {one.failed}", one.transient
            with suppress(subprocess.TimeoutExpired):
                process.wait(5)  # so that all of its log is there
            return
        if one.at:
            at, run.path, quiet = one.at, one.path, one.quiet
        run.stages += [] if one.stage is None else [one.stage]
        tell(at, len(run.stages))
        run.excluded |= one.excluded
        if one.reason:
            run.taken, run.reason = one.taken, one.reason
            run.milliseconds, run.memory = one.milliseconds, one.memory
        if one.done:
            run.why, run.finished = run.reason, True


def _read(stream: IO[bytes], lines: "queue.SimpleQueue[bytes | None]") -> None:
    with stream:
        for line in stream:
            lines.put(line)
    lines.put(None)


def _end(process: "subprocess.Popen[bytes]") -> None:
    """With the compilers that it started."""
    with suppress(ProcessLookupError, PermissionError):
        os.killpg(process.pid, signal.SIGKILL)
    try:
        process.wait(10)
    except subprocess.TimeoutExpired:  # it waits for its GPU in the driver: the system ends it when that lets go
        logger.warning("process %d, which qualified a GPU, doesn't end", process.pid)


def _end_of(log: IO[bytes], characters: int = 3000) -> str:
    """Without the user's name."""
    log.seek(0)
    return log.read().decode(errors="replace")[-characters:].replace(str(Path.home()), "~")


@contextmanager
def shown(bar: bool, what: str, seconds: float) -> Iterator[Tell]:
    """What tells a person: a bar, or a line of the log at the beginning."""
    text = f"qualifying {what}, once, in at most {seconds:.0f} s"
    if not bar:
        logger.warning("%s", text)
        yield lambda text, done: None
        return
    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task(text, total=len(STAGES))
        yield lambda at, done: progress.update(task, description=f"{text}: {at}", completed=done)
