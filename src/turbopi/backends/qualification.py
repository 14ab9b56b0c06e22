"""Whether backend `fused` is right and fast on a GPU that Turbo-Pi's tests never ran on.

`python -m turbopi.qualify` finds out, once for each model's sizes and precision, in a process of its own. A barrier
that never opens, a failure that sticks to a process's GPU, a compiler that crashes: each ends that process, or is ended
with it after a time limit, and the caller's GPU stays sound. The verdict is kept in the cache, where another GPU,
driver, version or kernel doesn't find it.
"""

import hashlib
import json
import logging
import os
import queue
import re
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import datetime, timezone
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import IO, Any, Final, Literal

import msgspec
import torch
from msgspec import Struct
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from turbopi.backends.tuned_tiles import PACKAGE
from turbopi.config import Kind, Network
from turbopi.quantization.plan import TIERS, Precision
from turbopi.support.errors import ConfigError, OutputError
from turbopi.support.files import alone_in, cache_folder, keep_in_cache
from turbopi.support.provenance import driver_version
from turbopi.support.reading import plain_document, read_document
from turbopi.version import turbopi_version

logger = logging.getLogger(__name__)

KNOWN: Final = ("NVIDIA H100 80GB HBM3", "NVIDIA H200")  # whose results are checked in, by PyTorch's name
UNKNOWN_VARIABLE: Final = "TURBOPI_UNKNOWN_GPU"
DOUBLE_VARIABLE: Final = "TURBOPI_QUALIFY_DOUBLE"  # a module that the process imports first: planted faults
COMMAND: Final = "`turbopi doctor --qualify`"
SECONDS, PATIENT_SECONDS = 60.0, 600.0  # at most: when a policy is made; ahead
ATTEMPTS: Final = 4  # processes at most: one that died may be followed by one without what it died of
TURNS: Final = (
    2  # starts whose time is up, before `auto` leaves it to `doctor`: compiled kernels are there the second time
)
DENOISE: Final = "denoise"  # the denoising kernel, among names of `kernels.interface.Ops` and "sm90": what is excluded
STAGES: Final = ("grid barrier", "kernels", "the model's sizes", "the shipped policy", "race")
_SOURCES: Final = ("kernels/**/*.py", "kernels/**/*.cu", "engine/*.py", "backends/*.py", "qualify/*.py")
_PACKAGES: Final = ("torch", "triton", "cuda-bindings", "nvidia-cuda-nvrtc", "nvidia-cuda-nvrtc-cu12")

under_test: dict[str, str] | None = None  # in the process that qualifies: what it excludes
Taken = Literal["fused", "cuda_graph"]
Tell = Callable[[str, int], None]  # what is done now, and how many of STAGES are


class Stage(Struct, frozen=True, kw_only=True):
    """One of STAGES that was done: figures by what they are of."""

    name: str
    seconds: float
    text: str
    figures: dict[str, float] = {}


class Event(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """A line of what the process says.

    at, quiet, path  what it does now; for how many seconds it may say nothing; what to exclude if that fails
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
    failed: str = ""
    transient: bool = False


class Request(Struct, frozen=True, kw_only=True):
    """What the process is to do. model: the network's fields, as JSON."""

    device: int
    precision: Precision
    kind: Kind
    model: dict[str, Any]
    excluded: dict[str, str]


class Verdict(Struct, frozen=True, kw_only=True):
    """The file that is kept, and that a report of a GPU attaches.

    taken       what `auto` takes; None: nothing, as `fused` alone has this precision
    excluded    parts of `fused` that failed, and how: others take their place
    milliseconds  backend -> "total" of a call, host to host, and its stages; medians
    unfinished  how many starts came to the end of their time
    """

    gpu: str
    compute_capability: str
    multiprocessors: int
    memory_bytes: int
    driver: str
    versions: dict[str, str]
    kernels: str  # "hopper" or "portable"
    kernels_hash: str
    precision: Precision
    model: str  # its family's name
    sizes: str
    date: str
    seconds: float
    taken: Taken | None
    reason: str
    failed: bool = False
    excluded: dict[str, str] = {}
    stages: list[Stage] = []
    milliseconds: dict[str, dict[str, float]] = {}
    device_bytes: int = 0  # reserved by `fused` at most
    unfinished: int = 0
    log: str = ""  # the end of what a process said that died

    @property
    def summary(self) -> str:
        return "; ".join([self.reason, *(f"without {path}: {why}" for path, why in self.excluded.items())])

    def issue(self, file: Path) -> str | None:
        """What to do about what failed; None: nothing did."""
        if not (self.failed or self.excluded):
            return None
        return f'please open an issue, "fused on {self.gpu}", and attach the file that {COMMAND} wrote: {file}'


def is_known(device: torch.device) -> bool:
    """Whether Turbo-Pi's own tests ran on such a GPU. TURBOPI_UNKNOWN_GPU=1: no, whichever it is."""
    value = os.environ.get(UNKNOWN_VARIABLE, "")
    if value not in ("", "1"):
        raise ConfigError(f"{UNKNOWN_VARIABLE} is {value!r}; expected '1', or nothing")
    return not value and torch.cuda.get_device_name(device) in KNOWN


def verdict_of(device: torch.device, precision: Precision, model: Network) -> Verdict | None:
    """What is kept of this GPU as it is now; None for a known one, and where nobody has qualified it yet."""
    return None if is_known(device) else kept(device, precision, model)


def excluded(device: torch.device, precision: Precision, model: Network) -> Mapping[str, str]:
    """What of `fused` failed its self-test here, and how."""
    if under_test is not None:
        return dict(under_test)
    if device.type != "cuda" or (verdict := verdict_of(device, precision, model)) is None:
        return {}
    return verdict.excluded


def kept(device: torch.device, precision: Precision, model: Network) -> Verdict | None:
    file = file_of(device, precision, model)
    if file in _UNKEPT:
        return _UNKEPT[file]
    if not file.is_file():
        return None
    try:
        return read_document(file, Verdict, ConfigError)
    except ConfigError as error:
        logger.warning("a GPU's verdict isn't used: %s; %s makes it again", error, COMMAND)
        return None


_UNKEPT: dict[Path, Verdict] = {}  # which hold in this process alone: no cache, or a reason that may be gone


def file_of(device: torch.device, precision: Precision, model: Network) -> Path:
    """Of a GPU with its driver, versions and kernels, of a model's sizes and a precision."""
    about = _about(device, precision, model)
    decisive = json.dumps({name: one for name, one in about.items() if name != "date"}, sort_keys=True)
    slug = re.sub(r"[^a-z0-9]+", "-", f"{about['gpu']} {about['model']} {precision}".lower()).strip("-")
    return cache_folder() / "qualified" / f"{slug}-{hashlib.sha256(decisive.encode()).hexdigest()[:12]}.json"


def _about(device: torch.device, precision: Precision, model: Network) -> dict[str, Any]:
    gpu = torch.cuda.get_device_properties(device)
    on_hopper = (gpu.major, gpu.minor) == (9, 0) and os.environ.get("TURBOPI_KERNELS") != "portable"
    return {
        "gpu": gpu.name,
        "compute_capability": f"{gpu.major}.{gpu.minor}",
        "multiprocessors": gpu.multi_processor_count,
        "memory_bytes": gpu.total_memory,
        "driver": _driver(),
        "versions": dict(_versions()),
        "kernels": "hopper" if on_hopper else "portable",
        "kernels_hash": _kernels_hash(),
        "precision": precision,
        "model": model.kind,
        "sizes": repr(model),
        "date": datetime.now(timezone.utc).strftime("%Y-%m-%d"),
    }


_driver = cache(driver_version)


@cache
def _versions() -> tuple[tuple[str, str], ...]:
    found = [("turbopi", turbopi_version()), ("cuda", str(torch.version.cuda))]
    for package in _PACKAGES:
        try:
            found.append((package, metadata.version(package)))
        except metadata.PackageNotFoundError:
            continue
    return tuple(found)


@cache
def _kernels_hash() -> str:
    digest = hashlib.sha256()
    for file in sorted(file for glob in _SOURCES for file in PACKAGE.glob(glob)):
        digest.update(file.relative_to(PACKAGE).as_posix().encode() + b"\0" + file.read_bytes() + b"\0")
    return digest.hexdigest()[:16]


# -- qualifying --------------------------------------------------------------------------------------------------------


def qualify(
    device: torch.device,
    precision: Precision,
    model: Network,
    *,
    seconds: float | None = None,
    tell: Tell | None = None,
) -> Verdict:
    """Find out, in at most so many seconds (None: SECONDS), and keep the verdict. Processes that want the same take
    turns.
    """
    file = file_of(device, precision, model)
    end = time.monotonic() + (SECONDS if seconds is None else seconds)
    before = kept(device, precision, model)
    tell = tell or (lambda text, done: None)
    while True:
        try:
            with alone_in(file.parent, "a process that qualifies a GPU"):
                return _qualified(device, precision, model, file, before, end, tell)
        except OutputError:
            if not os.access(file.parent, os.W_OK):  # nobody can keep anything: each process for itself
                return _qualified(device, precision, model, file, before, end, tell)
        tell("another process qualifies this GPU", 0)
        time.sleep(0.5)
        if (theirs := kept(device, precision, model)) is not None and theirs != before:
            return theirs
        if time.monotonic() >= end:
            run = _Run(why="another process is qualifying this GPU", soon=True)
            return _verdict(device, precision, model, run, 0.0)


def _qualified(
    device: torch.device,
    precision: Precision,
    model: Network,
    file: Path,
    before: Verdict | None,
    end: float,
    tell: Tell,
) -> Verdict:
    if (theirs := kept(device, precision, model)) is not None and theirs != before:
        return theirs  # of the process that had the turn before
    began, run = time.monotonic(), _Run()
    for _ in range(ATTEMPTS):
        request = Request(
            device=device.index or 0,
            precision=precision,
            kind=model.kind,
            model=msgspec.to_builtins(model),
            excluded=run.excluded,
        )
        run = _attempt(request, end, tell)
        if not run.path or run.path in run.excluded:
            break
        run.excluded[run.path] = run.why
    unfinished = 0 if before is None else before.unfinished
    verdict = _verdict(device, precision, model, run, time.monotonic() - began, unfinished)
    _UNKEPT.pop(file, None)
    if run.soon or not keep_in_cache(file, json.dumps(plain_document(verdict), indent=1) + "\n"):
        _UNKEPT[file] = verdict
    if (todo := verdict.issue(file)) is not None:
        logger.warning("backend 'fused' failed its self-test on %s: %s; %s", verdict.gpu, verdict.summary, todo)
    return verdict


@dataclass
class _Run:
    """What processes said. why, path: why the last one ended, and what may be excluded for it; soon: to be tried again
    by the next start; time_up: it was ended at its time's end.
    """

    excluded: dict[str, str] = field(default_factory=dict)
    stages: dict[str, Stage] = field(default_factory=dict)
    milliseconds: dict[str, dict[str, float]] = field(default_factory=dict)
    memory: int = 0
    taken: Taken | None = None
    finished: bool = False
    why: str = ""
    path: str = ""
    soon: bool = False
    time_up: bool = False
    log: str = ""


def _verdict(
    device: torch.device, precision: Precision, model: Network, run: _Run, seconds: float, unfinished: int = 0
) -> Verdict:
    alone = precision in TIERS  # `fused` alone runs in it
    failed = not (run.finished or run.time_up or run.soon)
    taken, reason = run.taken, run.why
    if failed:
        taken, reason = (None if alone else "cuda_graph"), f"its self-test failed: {run.why}"
    elif not run.finished:
        taken = "fused" if alone else "cuda_graph"
    return Verdict(
        **_about(device, precision, model),
        seconds=round(seconds, 1),
        taken=taken,
        reason=reason,
        failed=failed,
        excluded=run.excluded,
        stages=list(run.stages.values()),
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
    at, path, quiet, failed = "", "", PATIENT_SECONDS, Event()
    with tempfile.TemporaryFile() as log:
        try:
            process = subprocess.Popen(_command(), stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=log)
        except OSError as error:
            run.why, run.soon = f"no process could be started: {error}", True
            return run
        assert process.stdin is not None and process.stdout is not None
        lines: queue.SimpleQueue[bytes | None] = queue.SimpleQueue()
        threading.Thread(target=_read, args=(process.stdout, lines), daemon=True).start()
        try:
            with process.stdin as stdin:
                stdin.write(msgspec.json.encode(request))
        except BrokenPipeError:
            pass  # it says why
        try:
            while True:
                left = end - time.monotonic()
                try:
                    line = lines.get(timeout=max(0.0, min(quiet, left)))
                except queue.Empty:
                    run.time_up = quiet >= left
                    run.why = (
                        f"time was up at {at or 'its start'}; {COMMAND} takes up to {PATIENT_SECONDS:.0f} s"
                        if run.time_up
                        else f"{at} said nothing for {quiet:.0f} s, as if it waited for ever"
                    )
                    break
                if line is None:
                    if not run.finished:
                        code = process.wait()
                        run.why = f"{at or 'its start'}: {failed.failed or f'the process ended with code {code}'}"
                        run.soon = run.soon or not at  # of kernels that says nothing
                    break
                one = msgspec.json.decode(line, type=Event)
                if one.at:
                    at, path, quiet = one.at, one.path, one.quiet
                    tell(at, len(run.stages))
                if one.stage is not None:
                    run.stages[one.stage.name] = one.stage
                    tell(at, len(run.stages))
                run.excluded |= one.excluded
                run.milliseconds |= one.milliseconds
                run.memory = max(run.memory, one.memory)
                if one.failed:
                    failed, run.soon = one, one.transient
                if one.reason:
                    run.taken, run.why, run.finished = one.taken, one.reason, True
        finally:
            _end(process)
        if not (run.finished or run.time_up or run.soon):
            run.path, run.log = path, _end_of(log)
    return run


def _read(stream: IO[bytes], lines: "queue.SimpleQueue[bytes | None]") -> None:
    with stream:
        for line in stream:
            lines.put(line)
    lines.put(None)


def _end(process: "subprocess.Popen[bytes]") -> None:
    process.kill()
    try:
        process.wait(10)
    except subprocess.TimeoutExpired:  # it waits for its GPU in the driver: the system ends it when that lets go
        logger.warning("process %d, which qualified a GPU, doesn't end", process.pid)


def _end_of(log: IO[bytes], characters: int = 3000) -> str:
    """Without the user's name."""
    log.seek(0)
    text = log.read().decode(errors="replace")[-characters:]
    return text.replace(str(Path.home()), "~")


@contextmanager
def shown(bar: bool, what: str, seconds: float = SECONDS) -> Iterator[Tell]:
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
