"""Attack a policy server of its own, over loopback alone, and everything that reads files and command lines.

    export PYTHONPATH=src:tools
    python -m attack list                                        every attack, its prediction and its size
    python -m attack run slow_walk one_byte --out work/a.json    some attacks in full
    python -m attack run frames --count 100000 --seed 3 --out work/a.json
    python -m attack all --small --out work/small.json           all of them, tiny: a few minutes
    python -m attack all --minutes 9 --out work/a.json           the whole run in pieces: again until it says it is done
    python -m attack all --jobs 7 --out work/a.json              the same, untimed pieces side by side, two cores each
    python -m attack show work/a.json                            the table, and each violation with what repeats it
    python -m attack frame 3 71                                  frame 71 of seed 3: its bytes, and the answer to them

Results add up in the file: a piece is an attack with its seed, and replaces an earlier one. Exit codes: 0 every bar
held, 1 one was broken, 2 bad usage, 3 the minutes are over and there is more to do.
"""

import argparse
import asyncio
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

from rich.console import Console
from rich.markup import escape
from rich.progress import Progress
from rich.table import Table

from attack import results
from attack.attacks import ATTACKS, Attack, Size

BROKEN, BAD_USAGE, MORE = 1, 2, 3


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        prog="python -m attack", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    kinds = parser.add_subparsers(dest="command", required=True)
    kinds.add_parser("list", help="every attack")
    run = kinds.add_parser("run", help="some attacks")
    run.add_argument("names", nargs="+", choices=tuple(ATTACKS), metavar="ATTACK")
    run.add_argument("--seed", type=int, default=0)
    run.add_argument("--count", type=int, help="frames, messages, rounds, damages of a format, or commands")
    run.add_argument("--seconds", type=float, help="of a timed attack")
    whole = kinds.add_parser("all", help="every attack, each in its pieces")
    whole.add_argument("--minutes", type=float, default=float("inf"), help="begin no piece that would take longer")
    whole.add_argument("--jobs", type=int, default=1, help="pieces without a bar of time that run side by side")
    for one in (run, whole):
        one.add_argument("--out", type=Path, required=True, help="the result file")
        one.add_argument("--small", action="store_true", help="tiny counts, to try it")
    show = kinds.add_parser("show", help="the table of a result file")
    show.add_argument("file", type=Path)
    frame = kinds.add_parser("frame", help="one frame, and its answer")
    frame.add_argument("seed", type=int)
    frame.add_argument("number", type=int)
    given = parser.parse_args(arguments)
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # a shell's background job; its children would ignore it, too
        signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        return {"list": _list, "run": _run, "all": _all, "show": _show, "frame": _frame}[given.command](given)
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        return BAD_USAGE


def _list(given: argparse.Namespace) -> int:
    found = Table("attack", "what it does", "prediction", "size", "pieces")
    for attack in ATTACKS.values():
        size = attack.size
        found.add_row(
            attack.name, attack.about, attack.prediction, str(size.count or f"{size.seconds:.0f} s"), str(size.pieces)
        )
    Console().print(found)
    return 0


def _run(given: argparse.Namespace) -> int:
    pieces = []
    for name in given.names:
        size = ATTACKS[name].size.small if given.small else ATTACKS[name].size
        size = replace(size, count=size.count if given.count is None else given.count)
        size = replace(size, seconds=size.seconds if given.seconds is None else given.seconds)
        pieces.append(_one(ATTACKS[name], given.seed, size, given.out))
    return _end(given.out, pieces)


def _all(given: argparse.Namespace) -> int:
    """The pieces that the file lacks while there is time: first those that may run side by side, then the others."""
    if given.jobs < 1:
        raise ValueError(f"--jobs must be 1 or more, not {given.jobs}")
    end = time.monotonic() + given.minutes * 60
    done = {(one.attack, one.seed) for one in results.load(given.out)}
    missing = [
        (attack, seed)
        for attack in ATTACKS.values()
        for seed in range((attack.size.small if given.small else attack.size).pieces)
        if (attack.name, seed) not in done
    ]
    beside = [piece for piece in missing if given.jobs > 1 and not piece[0].timed]
    left = _side_by_side(beside, given, end)
    for attack, seed in missing:
        if (attack, seed) in beside:
            continue
        if _too_long(attack, given.small, end):
            left.append((attack, seed))
            break
        _one(attack, seed, attack.size.small if given.small else attack.size, given.out)
    if left:
        print(f"next: {left[0][0].name}, seed {left[0][1]}. Give the same command again.")
        return MORE
    return _end(given.out, results.load(given.out))


def _too_long(attack: Attack, small: bool, end: float) -> bool:
    return attack.minutes * (0.1 if small else 1) * 60 > end - time.monotonic()


def _side_by_side(pieces: list[tuple[Attack, int]], given: argparse.Namespace, end: float) -> list[tuple[Attack, int]]:
    """Run each piece in a process of its own, so many at a time; returns those for which there was no time."""

    def run(piece: tuple[Attack, int]) -> bool:
        attack, seed = piece
        if _too_long(attack, given.small, end):
            return False
        out = folder / f"{attack.name}-{seed}.json"
        words = [sys.executable, "-m", "attack", "run", attack.name, "--seed", str(seed), "--out", str(out)]
        ended = subprocess.run(words + ["--small"] * given.small, capture_output=True, text=True, check=False)
        if ended.returncode not in (0, BROKEN) or not out.exists():
            raise RuntimeError(f"{' '.join(words)} ended with {ended.returncode}: {ended.stderr[-2000:]}")
        (made,) = results.load(out)
        with writing:
            results.add(given.out, made)
        print(ended.stdout.splitlines()[0], flush=True)
        return True

    writing = threading.Lock()
    with tempfile.TemporaryDirectory(prefix="turbopi-attack-") as name, ThreadPoolExecutor(given.jobs) as executor:
        folder = Path(name)
        return [piece for piece, ran in zip(pieces, executor.map(run, pieces), strict=True) if not ran]


def _one(attack: Attack, seed: int, size: Size, out: Path) -> results.Piece:
    """Run a piece and write it down."""
    started, console = time.monotonic(), Console(stderr=True)
    with (
        tempfile.TemporaryDirectory(prefix="turbopi-attack-") as folder,
        Progress(console=console, transient=True) as bar,
    ):
        task = bar.add_task(attack.name, total=1.0)
        found, seen = attack.run(seed, size, Path(folder), lambda share: bar.update(task, completed=share))
    written = results.piece(attack, seed, size, found, seen, started)
    results.add(out, written)
    faults = len(written.violations) + written.more_violations
    broken = ", ".join(f"{bar.name} {bar.value} > {bar.limit}" for bar in written.bars if not bar.held)
    said = f"{written.verdict}{f', {faults} faults' if faults else ''}{f', {broken}' if broken else ''}"
    print(f"{attack.name} {seed}: {found.count:,} in {written.wall_seconds:.0f} s: {said}", flush=True)
    return written


def _end(out: Path, pieces: list[results.Piece]) -> int:
    Console().print(results.table(pieces))
    print(f"in {out}; `python -m attack show {out}` says more")
    return 0 if results.held(pieces) else BROKEN


def _show(given: argparse.Namespace) -> int:
    pieces = results.load(given.file)
    console = Console()
    console.print(results.table(pieces))
    for row in results.totals(pieces):
        outcomes = ", ".join(f"{name} {count:,}" for name, count in row.outcomes.most_common())
        console.print(f"[bold]{row.attack}[/] ({', '.join(sorted(row.commits))}): {escape(outcomes)}", soft_wrap=True)
        for violation in row.said:
            console.print(f"  [red]{escape(violation.what)}[/]\n    {escape(violation.reproduce)}", soft_wrap=True)
    return 0 if results.held(pieces) else BROKEN


def _frame(given: argparse.Namespace) -> int:
    """Send one frame to a server of its own, and print what comes."""
    from attack.arena import Found
    from attack.frames import send
    from attack.messages import case
    from attack.server import ServerProcess

    one = case(given.seed, given.number)
    print(f"{one.kind}: {len(one.wire)} bytes: {one.wire[:2000].hex(' ')}")
    found = Found()
    with tempfile.TemporaryDirectory() as folder, ServerProcess("fake:0", folder=Path(folder)) as server:
        asyncio.run(send(server.port, given.seed, [given.number], found))
        print(server.text())
    print(dict(found.outcomes), *found.violations, sep="\n")
    return BROKEN if found.violations else 0


if __name__ == "__main__":
    sys.exit(main())
