"""Time programs in turns: all of them stand ready, and each round asks each for some calls.

Each program and setting is a process of its own (drivers/rounds.py says what they say). Whatever it does, dying,
hanging, talking nonsense, answering with another shape, ends this one setting with a reason, and no other.
"""

import json
import math
import os
import queue
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import psutil

from peers.document import PARTS, NotMeasured, Part, Stage, Timed
from peers.drivers.rounds import FEWEST
from peers.entries import TOOLS, Program
from turbopi.bench.work import Job

ACTION_DIMS = range(6, 33)  # of what programs return: a robot's own, or the model's 32
LONGEST_LINE = 2**20
MOST_LINES = 64  # that wait to be read: a driver says one when it is told to
LAST_WORDS = 400  # characters of what a dead program wrote last


class Failed(Exception):
    """Why a setting has no figures."""


class Ready(msgspec.Struct, frozen=True):
    ready: bool
    note: str
    versions: dict[str, str]
    setup_s: float


class Round(msgspec.Struct, frozen=True):
    ms: list[float]
    shape: list[int]
    finite: bool


@dataclass(frozen=True)
class Limits:
    """Seconds."""

    start_s: float | None = None  # instead of each program's own
    round_s: float = 120.0
    part_s: float | None = None  # for a part's calls in a round: fewer than wanted, if they take longer, and no failure


class Running:
    """One program in one setting, getting ready for a job.

    Raises Failed, and ends the process, when it doesn't do as told.
    """

    ready: Ready

    def __init__(self, program: Program, setting: str, python: str, words: Mapping[str, Any]) -> None:
        self.program, self.setting, self._began = program, setting, time.monotonic()
        self._text, self._ended = "", False  # of its standard error, once it has ended
        self._folder = tempfile.TemporaryDirectory(prefix="peers-")  # the program's working directory
        self._log = Path(self._folder.name) / "log.txt"
        try:
            self._process = _started([python, str(program.script), json.dumps(words)], program, self._log)
        except OSError as error:
            self._folder.cleanup()
            raise Failed(f"{python}: {error.strerror}") from None
        self._lines: queue.Queue[bytes] = queue.Queue()
        self._listener = threading.Thread(target=self._listen, daemon=True)
        self._listener.start()

    def wait(self, start_s: float) -> float:
        """Until it is ready, start_s seconds after its start at the latest. Returns the seconds that it took."""
        self.ready = self._said(start_s, Ready, "got ready", self._began)
        return time.monotonic() - self._began

    def _listen(self) -> None:
        assert self._process.stdout is not None
        while line := self._process.stdout.readline(LONGEST_LINE):
            if self._lines.qsize() < MOST_LINES:
                self._lines.put(line)
        self._lines.put(b"")

    def time(self, calls: int, limits: Limits) -> dict[str, Round]:
        """Its parts, with the milliseconds of each call."""
        if not self._lines.empty():
            if line := self._lines.get():
                raise self._failed(f"it said {_start(line)} without being told to")
            self._lines.put(line)  # it has ended
        assert self._process.stdin is not None
        with suppress(OSError):  # it is gone: its end is read below
            self._process.stdin.write(json.dumps({"calls": calls, "seconds": limits.part_s}).encode() + b"\n")
            self._process.stdin.flush()
        return self._said(limits.round_s, dict[str, Round], f"answered {calls} calls")

    def _said(self, seconds: float, kind: Any, what: str, since: float | None = None) -> Any:
        begin = time.monotonic() if since is None else since
        try:
            line = self._lines.get(timeout=max(0.0, begin + seconds - time.monotonic()))
        except queue.Empty:
            raise self._failed(f"it hadn't {what} after {seconds:g} s") from None
        if not line:
            with suppress(subprocess.TimeoutExpired):
                self._process.wait(10.0)
            raise self._failed(f"it ended with {self._process.poll()} before it {what}")
        try:
            return msgspec.json.decode(line, type=kind)
        except msgspec.DecodeError as error:
            raise self._failed(f"before it {what} it said {_start(line)}, which wasn't expected: {error}") from None

    def _failed(self, reason: str) -> Failed:
        self.end()
        text = " ".join(self._text.split())
        return Failed(f"{reason}; its last words: {text[-LAST_WORDS:]}" if text else reason)

    def end(self) -> None:
        """End it, and all that it started."""
        if self._ended:
            return
        self._ended = True
        started = []  # a server's workers may be in groups of their own
        with suppress(psutil.Error):
            started = psutil.Process(self._process.pid).children(recursive=True)
        with suppress(OSError):
            os.killpg(self._process.pid, signal.SIGKILL)
        for process in started:
            with suppress(psutil.Error):
                process.kill()
        self._process.wait()
        self._listener.join(1.0)
        with suppress(OSError):
            self._text = self._log.read_text(errors="replace")
        for pipe in (self._process.stdin, None if self._listener.is_alive() else self._process.stdout):
            if pipe is not None:
                with suppress(OSError):
                    pipe.close()
        self._folder.cleanup()


def _started(command: list[str], program: Program, log: Path) -> subprocess.Popen[bytes]:
    pipe = subprocess.PIPE
    with log.open("wb") as errors:
        return subprocess.Popen(
            command,
            stdin=pipe,
            stdout=pipe,
            stderr=errors,
            cwd=log.parent,
            env=environment(program),
            start_new_session=True,
        )


def environment(program: Program) -> dict[str, str]:
    """This process's, but that another program's Python finds of this project's packages its driver alone."""
    found = {name: value for name, value in os.environ.items() if name != "PYTHONHOME"}
    paths = [str(TOOLS)] if program.install else [os.path.abspath(path) for path in sys.path if path]
    return found | {"PYTHONPATH": os.pathsep.join(paths)}


def _start(line: bytes) -> str:
    return repr(line[:80].decode(errors="replace").strip())


@dataclass
class _Taken:
    """What one setting has taken so far, by part and round."""

    running: Running
    rounds: dict[Part, list[list[float]]] = field(default_factory=dict)
    shape: list[int] = field(default_factory=list)


def time_job(
    settings: Sequence[tuple[Program, str, str, Mapping[str, Any]]],
    job: Job,
    *,
    rounds: int,
    calls: int,
    limits: Limits,
    before_round: Callable[[], None] = lambda: None,
    after_round: Callable[[list[Timed], list[NotMeasured]], None] = lambda timed, lost: None,
    say: Callable[[str], None] = lambda line: None,
) -> tuple[list[Timed], list[NotMeasured]]:
    """Figures of one job. settings: (program, setting, its Python, words of its driver beside the job's).

    Programs get ready side by side; those that tune themselves then, one by one. A setting that fails in any round has
    no figures at all. after_round: is given the figures so far.
    """
    lost: list[NotMeasured] = []
    taken: list[_Taken] = []

    def lose(program: Program, setting: str, stage: Stage, reason: object) -> None:
        lost.append(NotMeasured(program=program.name, setting=setting, job=job, stage=stage, reason=str(reason)))
        say(f"{program.name} {setting}: not measured: {reason}")

    try:
        _get_ready(settings, job, limits, taken, lose, say)
        for number in range(rounds):
            before_round()
            turn = number % max(1, len(taken))
            for one in [*taken[turn:], *taken[:turn]]:  # nobody is always first
                try:
                    _take(one, one.running.time(calls, limits), job, calls, limits.part_s is not None)
                except Failed as error:
                    one.running.end()
                    taken.remove(one)
                    lose(one.running.program, one.running.setting, "call", f"round {number + 1}: {error}")
            after_round(_all_timed(taken, job), list(lost))
    finally:
        for one in taken:
            one.running.end()
    return _all_timed(taken, job), lost


def _get_ready(
    settings: Sequence[tuple[Program, str, str, Mapping[str, Any]]],
    job: Job,
    limits: Limits,
    taken: list[_Taken],
    lose: Callable[[Program, str, Stage, object], None],
    say: Callable[[str], None],
) -> None:
    """Those that are ready are added to `taken`."""

    def start(program: Program, setting: str, python: str, words: Mapping[str, Any]) -> list[_Taken]:
        own = {"program": program.name, "setting": setting}
        try:
            running = Running(program, setting, python, {**words, **msgspec.to_builtins(job), **own})
        except Failed as error:
            lose(program, setting, "start", error)
            return []
        taken.append(_Taken(running))
        return taken[-1:]

    def wait(one: _Taken) -> None:
        program, setting = one.running.program, one.running.setting
        try:
            say(f"{program.name} {setting}: ready after {one.running.wait(limits.start_s or program.start_s):.0f} s")
        except Failed as error:
            taken.remove(one)
            lose(program, setting, "start", error)

    side_by_side = [one for setting in settings if not setting[0].tunes for one in start(*setting)]
    for one in side_by_side:
        wait(one)
    for setting in settings:
        for one in start(*setting) if setting[0].tunes else []:
            wait(one)


def _take(one: _Taken, answer: Mapping[str, Round], job: Job, calls: int, or_fewer: bool) -> None:
    """Raises Failed for an answer that isn't a policy's."""
    if not answer or not answer.keys() <= set(PARTS):
        raise Failed(f"it timed {sorted(answer)}; expected some of {', '.join(PARTS)}")
    if one.rounds and one.rounds.keys() != answer.keys():
        raise Failed(f"it timed {sorted(answer)}, and before {sorted(one.rounds)}")
    for part in PARTS:
        if part not in answer:
            continue
        found = answer[part]
        fewest = min(calls, FEWEST) if or_fewer else calls
        if not fewest <= len(found.ms) <= calls or not all(math.isfinite(ms) and ms > 0 for ms in found.ms):
            raise Failed(f"{part}: {len(found.ms)} times of {calls} calls, {found.ms[:3]} …; expected some above 0")
        if len(found.shape) != 2 or found.shape[0] != job.horizon or found.shape[1] not in ACTION_DIMS:
            raise Failed(f"{part}: its actions are {found.shape}; expected [{job.horizon}, d]")
        if not found.finite:
            raise Failed(f"{part}: its actions have NaN or infinity")
        one.rounds.setdefault(part, []).append(found.ms)
        one.shape = found.shape


def _all_timed(taken: list[_Taken], job: Job) -> list[Timed]:
    return [timed for one in taken for timed in _timed(one, job)]


def _timed(one: _Taken, job: Job) -> list[Timed]:
    ready = one.running.ready
    return [
        Timed(
            program=one.running.program.name,
            setting=one.running.setting,
            part=part,
            job=job,
            calls=sum(map(len, rounds)),
            p50_ms=round(float(np.percentile(np.concatenate(rounds), 50)), 3),
            p95_ms=round(float(np.percentile(np.concatenate(rounds), 95)), 3),
            rounds_ms=[round(float(np.median(ms)), 3) for ms in rounds],
            setup_s=ready.setup_s,
            actions=one.shape,
            versions=ready.versions,
            note=ready.note,
        )
        for part, rounds in one.rounds.items()
    ]
