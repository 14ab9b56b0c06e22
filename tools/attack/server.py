"""A server in a process of its own, and who watches it: memory, descriptors, log, health."""

import os
import re
import resource
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any

import psutil

from attack.judging import TRACEBACK

SAMPLE_S, HEALTH_S, HEALTH_TIMEOUT_S = 0.1, 0.5, 10.0
PATIENCE_S = 2.0  # a request of the good client that waits longer at the end of a run is a fault
START_S = 120.0  # a busy machine imports torch for a while

Policy = str  # "fake:MILLISECONDS", "small", or the name of a preset for --random-weights


def command(policy: Policy, options: Sequence[str] = ()) -> list[str]:
    """The command line that serves `policy` on a free port of 127.0.0.1. Raises ValueError for no policy."""
    kind, _, number = policy.partition(":")
    options = ["--host", "127.0.0.1", "--port", "0", *options]
    if kind == "fake":
        return [sys.executable, "-m", "attack.fake", "--milliseconds", str(float(number or 20)), "--", *options]
    if kind == "small":
        from turbopi.policy.shipped import SMALL_POLICY

        return [sys.executable, "-m", "turbopi", "serve", str(SMALL_POLICY), *options]
    if re.fullmatch(r"pi0\w*", kind):
        return [sys.executable, "-m", "turbopi", "serve", "--random-weights", kind, "--steps", "1", *options]
    raise ValueError(f"no policy {policy!r}: give fake:MILLISECONDS, small, or a preset such as pi05_tiny")


def environment() -> dict[str, str]:
    """This process's environment for children: quiet threads, and no settings of the user's."""
    dropped = ("TURBOPI_API_KEY", "TURBOPI_DEBUG")
    kept = {name: value for name, value in os.environ.items() if name not in dropped}
    return kept | {"OMP_NUM_THREADS": "1", "OMP_WAIT_POLICY": "PASSIVE", "PYTHONPATH": os.pathsep.join(sys.path)}


class ServerProcess:
    """`turbopi serve` as a subprocess, its output in `log`. A context manager that leaves no process behind.

    `descriptors` is the limit of open files it runs under. Raises RuntimeError if it doesn't come up.
    """

    def __init__(
        self, policy: Policy, options: Sequence[str] = (), *, folder: Path, descriptors: int | None = None
    ) -> None:
        self.command = command(policy, options)
        number = next(n for n in range(10**6) if not (folder / f"server-{n}.log").exists())
        self.log = folder / f"server-{number}.log"
        self._descriptors = descriptors
        self.port = 0

    def __enter__(self) -> "ServerProcess":
        def limit() -> None:
            if self._descriptors is not None:
                resource.setrlimit(resource.RLIMIT_NOFILE, (self._descriptors, self._descriptors))

        with self.log.open("wb") as log:
            self.process = subprocess.Popen(
                self.command,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                env=environment() | {"PYTHONUNBUFFERED": "1"},
                preexec_fn=limit,
            )
        try:
            self._wait()
        except BaseException:
            self.kill()
            raise
        return self

    def _wait(self) -> None:
        deadline = time.monotonic() + START_S
        while time.monotonic() < deadline:
            if found := re.search(r"Serving at ws://127\.0\.0\.1:(\d+)", self.text()):
                self.port = int(found[1])
                return
            if self.process.poll() is not None:
                raise RuntimeError(f"the server ended with {self.process.returncode}: {self.text()[-2000:]}")
            time.sleep(0.05)
        raise RuntimeError(f"no server after {START_S:.0f} s: {self.text()[-2000:]}")

    def text(self) -> str:
        return self.log.read_text(encoding="utf-8", errors="replace")

    def end(self, number: signal.Signals, timeout: float) -> float | None:
        """Seconds until the process has ended after signal `number`; None, and killed, if it takes longer."""
        started = time.monotonic()
        self.process.send_signal(number)
        try:
            self.process.wait(timeout)
        except subprocess.TimeoutExpired:
            self.kill()
            return None
        return time.monotonic() - started

    def kill(self) -> None:
        if self.process.poll() is None:
            self.process.kill()
        self.process.wait()

    def __exit__(self, *_: object) -> None:
        self.kill()


@dataclass
class Sample:
    at: float
    rss: int
    descriptors: int


@dataclass
class Health:
    """One question at /healthz: milliseconds, and the HTTP status (0: no answer in time)."""

    at: float
    milliseconds: float
    status: int


@dataclass
class Watch:
    """Samples of a server process, from two threads, until `with` ends."""

    server: ServerProcess
    samples: list[Sample] = field(default_factory=list)
    healths: list[Health] = field(default_factory=list)

    def __enter__(self) -> "Watch":
        self._stop = threading.Event()
        self._process = psutil.Process(self.server.process.pid)
        self._threads = [
            threading.Thread(target=self._every, args=(SAMPLE_S, self._sample), daemon=True),
            threading.Thread(target=self._every, args=(HEALTH_S, self._ask), daemon=True),
        ]
        self._sample()
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stop.set()
        for thread in self._threads:
            thread.join(HEALTH_TIMEOUT_S + 1)

    def _every(self, seconds: float, work: Callable[[], None]) -> None:
        while not self._stop.wait(seconds):
            work()

    def _sample(self) -> None:
        try:
            with self._process.oneshot():
                rss, descriptors = self._process.memory_info().rss, self._process.num_fds()
        except psutil.Error:  # it has ended
            return
        self.samples.append(Sample(time.monotonic(), rss, descriptors))

    def _ask(self) -> None:
        started = time.monotonic()
        status = http_status(self.server.port, "/healthz", HEALTH_TIMEOUT_S)
        self.healths.append(Health(started, (time.monotonic() - started) * 1e3, status))

    def report(self, start: float, end: float, log_before: int) -> dict[str, Any]:
        """What happened from `start` to `end` (monotonic seconds), and since then."""
        before = [sample for sample in self.samples if sample.at <= start] or self.samples[:1]
        during = [sample for sample in self.samples if sample.at >= start] or self.samples[-1:]
        requested = [health for health in self.healths if start <= health.at <= end]
        text = self.server.text()
        return {
            "rss_mb": _three([s.rss / 2**20 for s in before], [s.rss / 2**20 for s in during]),
            "descriptors": _three([s.descriptors for s in before], [s.descriptors for s in during]),
            "log_bytes": len(text.encode()) - log_before,
            "log_tracebacks": text.count(TRACEBACK),
            "health": {
                "asked": len(requested),
                "failed": sum(health.status != 200 for health in requested),
                "worst_ms": round(max((health.milliseconds for health in requested), default=0.0), 1),
            },
        }


def _three(before: list[float], during: list[float]) -> dict[str, float]:
    return {"before": round(before[-1], 1), "peak": round(max(during), 1), "after": round(during[-1], 1)}


def http_status(port: int, path: str, timeout: float) -> int:
    """The status of a GET over 127.0.0.1; 0 if there is none in time."""
    import http.client

    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=timeout)
    try:
        connection.request("GET", path)
        return connection.getresponse().status
    except (OSError, http.client.HTTPException):
        return 0
    finally:
        connection.close()


class GoodClient:
    """The good client's process (good.py), and what it has measured so far."""

    def __init__(self, port: int, folder: Path, pixels: int = 224) -> None:
        with tempfile.NamedTemporaryFile("w", dir=folder, suffix=".latencies", delete=False) as file:
            self._out = Path(file.name)
        self._command = [sys.executable, "-m", "attack.good", str(port), "--out", str(self._out)]
        self._command += ["--pixels", str(pixels)]

    def __enter__(self) -> "GoodClient":
        self._process = subprocess.Popen(self._command, stdin=subprocess.DEVNULL, env=environment())
        deadline = time.monotonic() + START_S
        while not self.requested(0.0, float("inf")):
            if self._process.poll() is not None or time.monotonic() > deadline:
                self.__exit__()
                raise RuntimeError("the good client doesn't come up")
            time.sleep(0.05)
        return self

    def __exit__(self, *_: object) -> None:
        if self._process.poll() is None:
            self._process.kill()
        self._process.wait()

    def requested(self, start: float, end: float) -> list[tuple[float, str]]:
        """(milliseconds, "ok" or the fault) of each request that was asked from `start` to `end`."""
        return answers(self._out.read_text(encoding="utf-8"), start, end, time.monotonic())


def answers(lines: str, start: float, end: float, now: float) -> list[tuple[float, str]]:
    """What good.py wrote, of the requests asked from `start` to `end`. One that still waits counts as a fault."""
    found: dict[str, tuple[float, str]] = {}
    for line in lines.splitlines(keepends=True):
        if line.endswith("\n"):
            at, milliseconds, said = line[:-1].split("\t")
            found[at] = (float(milliseconds), said)
    requested = [(float(at), *answer) for at, answer in found.items() if start <= float(at) <= end]
    waits = PATIENCE_S * 1e3
    answered = [(ms, said) for _, ms, said in requested if said != "?"]
    late = [(now - at) * 1e3 for at, _, said in requested if said == "?"]
    return answered + [(ms, "no answer yet") for ms in late if ms > waits]
