"""One attack on one server: start, quiet time, attack, quiet time, figures and bars."""

import asyncio
import contextlib
import os
import random
import threading
import time
from collections import Counter
from collections.abc import Callable, Coroutine
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from attack.judging import Bar, mean, percentile, ratio
from attack.server import GoodClient, Policy, ServerProcess, Watch

NICENESS = 10  # of the thread that attacks
MAX_VIOLATIONS = 50  # that are kept in a result; the rest are counted
Tick = Callable[[float], None]  # the share of an attack that is done, for a progress bar


@dataclass
class Found:
    """What an attack counted."""

    count: int = 0
    outcomes: Counter[str] = field(default_factory=Counter)
    violations: list[dict[str, str]] = field(default_factory=list)
    more_violations: int = 0
    bars: list[Bar] = field(default_factory=list)
    notes: dict[str, Any] = field(default_factory=dict)

    def violate(self, what: str, reproduce: str) -> None:
        """Keep a violation: `what` is wrong, and a line that makes it happen again."""
        if len(self.violations) < MAX_VIOLATIONS:
            self.violations.append({"what": what[:500], "reproduce": reproduce[:2000]})
        else:
            self.more_violations += 1


@dataclass(frozen=True)
class Limits:
    """The bars of an attack on a server. None: not one of its bars.

    ratio         the good client's median under attack by its undisturbed one
    mean_ratio    the same of the mean: one answer in ten seconds is a good median, too
    growth_mb     of resident memory, at its peak
    kept_mb       of resident memory, at the end
    log_kb_s      of log, a second of attack
    descriptors   more at the end than at the start
    """

    ratio: float | None = 1.5
    mean_ratio: float | None = 2.5
    growth_mb: float | None = 150
    kept_mb: float | None = 100
    log_kb_s: float | None = 20
    descriptors: float | None = 10


@dataclass
class Arena:
    """Where an attack works: a server under watch, and how long or how often to attack it."""

    port: int
    server: ServerProcess
    random: random.Random
    seconds: float
    count: int
    folder: Path
    found: Found
    tick: Tick

    def until(self) -> float:
        """The moment of the monotonic clock at which a timed attack ends."""
        return time.monotonic() + self.seconds


Assault = Callable[[Arena], Coroutine[Any, Any, None]]


@dataclass(frozen=True)
class Siege:
    """How an attack on a server is run.

    quiet_seconds    before the attack, in which the good client is measured undisturbed
    settle_seconds   after it, before memory and descriptors are looked at: the server's own deadlines for what the
                     attackers left behind must fit in
    """

    policy: Policy = "fake:20"
    options: tuple[str, ...] = ()
    descriptors: int | None = None
    limits: Limits = Limits()
    quiet_seconds: float = 4.0
    settle_seconds: float = 4.0
    good_client: bool = True


def besiege(
    siege: Siege, assault: Assault, *, seed: int, seconds: float, count: int, folder: Path, tick: Tick
) -> tuple[Found, dict[str, Any]]:
    """Run one assault; returns what it found and what the watchers saw."""
    found = Found()
    with contextlib.ExitStack() as stack:
        server = stack.enter_context(
            ServerProcess(siege.policy, siege.options, folder=folder, descriptors=siege.descriptors)
        )
        good = stack.enter_context(GoodClient(server.port, folder)) if siege.good_client else None
        watch = stack.enter_context(Watch(server))
        arena = Arena(server.port, server, random.Random(seed), seconds, count, folder, found, tick)
        first = time.monotonic()
        time.sleep(siege.quiet_seconds)
        log_before = len(server.text().encode())
        start = time.monotonic()
        _in_the_background(lambda: asyncio.run(assault(arena)))
        end = time.monotonic()
        time.sleep(siege.settle_seconds)
        last = time.monotonic()
        seen = watch.report(start, end, log_before)
        seen["seconds"] = round(end - start, 1)
        if server.process.poll() is not None:
            found.violate(f"the server ended with {server.process.returncode}", " ".join(server.command))
        if good is not None:
            windows = ((first, start), (start, end), (end + 1.0, last))
            seen["good"] = _good(found, *(good.requested(*window) for window in windows))
    found.bars += server_bars(siege.limits, seen)
    return found, seen


def _in_the_background(work: Callable[[], None]) -> None:
    """On a thread that yields the CPU to all others: attackers would sit on other machines than the server."""

    def run() -> None:
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), NICENESS)
        work()

    with ThreadPoolExecutor(1) as executor:
        executor.submit(run).result()


def _good(
    found: Found, before: list[tuple[float, str]], under: list[tuple[float, str]], after: list[tuple[float, str]]
) -> dict[str, Any]:
    """The good client's figures; whatever it was told but its result is a violation."""
    for milliseconds, said in (*before, *under, *after):
        if said != "ok":
            found.violate(
                f"the good client after {milliseconds:.0f} ms: {said}", "python -m attack.good PORT --out FILE"
            )
    quiet = _summary([milliseconds for milliseconds, said in (*before, *after) if said == "ok"])
    attacked = _summary([milliseconds for milliseconds, said in under if said == "ok"])
    return {
        "undisturbed_ms": quiet,
        "attacked_ms": attacked,
        "ratio": ratio(quiet["p50"], attacked["p50"]),
        "mean_ratio": ratio(quiet["mean"], attacked["mean"]),
    }


def _summary(values: list[float]) -> dict[str, float | int | None]:
    figures = {"p50": percentile(values, 0.5), "p99": percentile(values, 0.99), "mean": mean(values)}
    return {"n": len(values), **{name: None if value is None else round(value, 2) for name, value in figures.items()}}


def server_bars(limits: Limits, seen: dict[str, Any]) -> list[Bar]:
    """The bars of `limits` for what a watch has `seen`. Always among them: /healthz answers, no traceback is logged."""
    rss, descriptors, good = seen["rss_mb"], seen["descriptors"], seen.get("good", {})
    values: dict[str, tuple[float | None, float | None]] = {
        "ratio": (limits.ratio, good.get("ratio")),
        "mean ratio": (limits.mean_ratio, good.get("mean_ratio")),
        "growth MB": (limits.growth_mb, rss["peak"] - rss["before"]),
        "kept MB": (limits.kept_mb, rss["after"] - rss["before"]),
        "log kB/s": (limits.log_kb_s, seen["log_bytes"] / 1e3 / max(seen["seconds"], 1.0)),
        "descriptors": (limits.descriptors, descriptors["after"] - descriptors["before"]),
        "healthz failed": (0, seen["health"]["failed"]),
        "tracebacks logged": (0, seen["log_tracebacks"]),
    }
    return [
        Bar(name, None if value is None else round(value, 3), limit)
        for name, (limit, value) in values.items()
        if limit is not None and (good or "ratio" not in name)
    ]
