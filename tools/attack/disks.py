"""Full disks: the earlier output survives, and one line names the file."""

import contextlib
import os
import random
import shutil
import subprocess
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from attack.arena import Found, Tick
from attack.endings import check_recording
from attack.server import GoodClient, ServerProcess
from attack.specimens import write_observation
from attack.zygote import Job, Zygote, fault

DISK_KB = 2048
_TINY = ("--random-weights", "pi05_tiny")


@dataclass(frozen=True)
class Writer:
    """A command and what it writes. {disk} stands for the full disk, {here} for one with room."""

    name: str
    arguments: tuple[str, ...]
    output: str


_FEW = ("--steps", "1", "--trials", "1", "--tasks", "0", "--max-steps", "5", "--workers", "1")
_ONE_CALL = (
    "--steps",
    "1",
    "--calls",
    "1",
    "--main-calls",
    "1",
    "--seconds",
    "0",
    "--backends",
    "pytorch",
    "--no-error",
)
_INFER = ("infer", *_TINY, "--steps", "1", "--no-warmup", "{here}/o.npz")
WRITERS = (
    Writer("infer", (*_INFER, "--no-plot", "-o", "{disk}/out/a.npz"), "out"),
    Writer("infer, plot", (*_INFER, "-o", "{here}/b.npz", "--plot", "{disk}/out/a.png"), "out"),
    Writer("calibrate", ("calibrate", *_TINY, "--count", "2", "--steps", "1", "-o", "{disk}/out/fp8.json"), "out"),
    Writer("eval", ("eval", "reacher", *_TINY, *_FEW, "--out", "{disk}/out"), "out"),
    Writer("convert", ("convert", *_TINY, "{disk}/converted"), "converted"),
    Writer("bench", ("bench", *_TINY, *_ONE_CALL, "--report", "{disk}/out"), "out"),
    Writer(
        "demo", ("demo", *_TINY, "--steps", "1", "--frames", "1", "--episodes", "0", "--report", "{disk}/out"), "out"
    ),
)


@contextlib.contextmanager
def small_disk(place: Path) -> Iterator[Path | None]:
    """A file system of DISK_KB below `place`; None where this user may not mount one."""
    place.mkdir(parents=True)
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", f"size={DISK_KB}k,nodev,nosuid", "tmpfs", str(place)],
        capture_output=True,
        check=False,
    )
    try:
        yield place if mounted.returncode == 0 else None
    finally:
        if mounted.returncode == 0:
            subprocess.run(["umount", str(place)], check=True)
        place.rmdir() if not any(place.iterdir()) else shutil.rmtree(place)


def disks(seed: int, count: int, folder: Path, found: Found, tick: Tick) -> None:
    """Each writer `count` times onto a disk with some room: none, a little, almost enough."""
    draw = random.Random(seed)
    here = folder / f"disks-{seed}"
    here.mkdir()
    write_observation(here / "o.npz")
    with Zygote() as zygote:
        for index, writer in enumerate(WRITERS):
            for number in range(count):
                _fill(zygote, writer, here, 0 if number == 0 else draw.randrange(1, 200_000), found)
                tick((index + (number + 1) / count) / (len(WRITERS) + 1))
    _recordings(here, found)
    tick(1.0)
    shutil.rmtree(here)


def _fill(zygote: Zygote, writer: Writer, here: Path, room: int, found: Found) -> None:
    with small_disk(here / "disk") as disk:
        limit = None if disk is not None else room
        disk = disk or here / "disk"
        earlier = _earlier(disk / writer.output, writer)
        if limit is None:
            _leave(disk, room)
        arguments = [text.format(disk=disk, here=here) for text in writer.arguments]
        job = Job(arguments, str(here), seconds=120, file_bytes=limit)
        done = zygote.run(job)
        wrong = fault(done, codes=(0, 2))
        now = {
            name: (disk / writer.output / name).read_bytes()
            for name in earlier
            if (disk / writer.output / name).exists()
        }
        left = [path.name for path in disk.rglob("*") if path.suffix in (".part", ".tmp") or path.name.startswith(".")]
    found.count += 1
    found.outcomes[f"exit {done.code}"] += 1
    line = f"{job.line.replace(str(here), 'HERE')}  # with room for {room} bytes"
    if wrong is None and done.code == 2:
        if any(now.get(name) != content for name, content in earlier.items()):
            wrong = "the earlier output is gone, although the command failed"
        elif str(here) not in done.stderr:
            wrong = f"the message names no file: {done.stderr.strip()[-200:]}"
        elif left:
            wrong = f"left behind: {left[:3]}"
    if wrong is not None:
        found.violate(f"{writer.name}: {wrong}", line)


def _earlier(output: Path, writer: Writer) -> dict[str, bytes]:
    """An earlier output, where the command may replace one: {name: content}."""
    if writer.name == "convert":  # which only writes into a new folder
        return {}
    output.mkdir()
    if writer.name not in ("infer", "infer, plot"):  # the others take only what they know
        return {}
    name = Path(writer.arguments[-1]).name
    (output / name).write_bytes(b"earlier" * 100)
    return {name: b"earlier" * 100}


def _leave(disk: Path, room: int) -> None:
    """Fill the disk but for about `room` bytes."""
    free = os.statvfs(disk)
    (disk / "filling").write_bytes(bytes(max(free.f_bavail * free.f_frsize - room, 0)))


def _recordings(here: Path, found: Found) -> None:
    """A server whose recording fills the disk: clients notice nothing, and what is there reads back whole."""
    with small_disk(here / "disk") as disk:
        if disk is None:
            found.outcomes["recording: no disk to fill"] += 1
            return
        with ServerProcess("fake:2", ["--record", str(disk)], folder=here) as server:
            line = " ".join(server.command)
            with GoodClient(server.port, here, pixels=128) as good:
                import time

                time.sleep(4)
                answers = good.requested(0, float("inf"))
            import signal

            if server.end(signal.SIGTERM, 60) is None or server.process.returncode != 0:
                found.violate(f"the server with a full disk ended with {server.process.returncode}", line)
            reported = "couldn't be recorded" in server.text()
        found.count += 1
        found.outcomes["recording: answers"] += len(answers)
        for _, said in answers:
            if said != "ok":
                found.violate(f"recording to a full disk: {said}", line)
        calls = check_recording(disk, killed=False, fault=lambda what: found.violate(f"on a full disk: {what}", line))
        found.outcomes["recording: calls read back"] += calls
        if calls < len(answers) and not reported:
            found.violate("calls were lost to a full disk, and the log doesn't say so", line)
