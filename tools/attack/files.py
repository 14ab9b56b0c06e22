"""Damaged files: one clear line, or the numbers that were there."""

import random
import shutil
from collections.abc import Sequence
from pathlib import Path

from attack.arena import Found, Tick
from attack.damages import Done as Damaged
from attack.damages import damage
from attack.specimens import SPECIMENS, Specimen
from attack.zygote import Done, Job, Zygote, fault

SECONDS, MEMORY_MB = 60.0, 3000.0
MAX_LINE = 2000  # characters of a refusal


def files(
    seed: int, count: int, folder: Path, found: Found, tick: Tick, specimens: Sequence[Specimen] = SPECIMENS
) -> None:
    """`count` damages of each format, each read once, in a fork."""
    with Zygote() as zygote:
        for index, specimen in enumerate(specimens):
            whole, place = folder / f"whole-{seed}-{index}", folder / f"read-{seed}-{index}"
            specimen.make(whole)
            shutil.copytree(whole, place)  # all are read at one place: what is read may hold its path
            expected = _read(zygote, specimen, place)
            shutil.rmtree(place)
            if expected.code != 0:
                said = f"the undamaged file is refused: {expected.stderr[-300:]}"
                found.violate(f"{specimen.name}: {said}", specimen.read)
            for number in range(count):
                draw = random.Random(f"{seed} {specimen.name} {number}")
                shutil.copytree(whole, place)
                done = damage(draw, place)
                read = _read(zygote, specimen, place)
                shutil.rmtree(place)
                outcome, wrong = judge_read(read, expected.stdout, done)
                found.count += 1
                found.outcomes[outcome] += 1
                if wrong is not None:
                    found.violate(f"{specimen.name}: {wrong}", f"{done.file.relative_to(place)}: {done.how}")
                tick((index + (number + 1) / count) / len(specimens))
            shutil.rmtree(whole)


def judge_read(read: Done, expected: str, done: Damaged) -> tuple[str, str | None]:
    """(outcome, what is wrong with it or None) of a damaged file's reading; `expected` is the whole one's digest."""
    wrong = fault(read, codes=(0, 2))
    if wrong is not None:
        return "fault", wrong
    if read.code == 2:
        return "refused", _unclear(read.stderr)
    if read.stdout == expected:
        return "read, the same", None
    return "read, other numbers", "other numbers, in silence" if done.noticeable else None


def _unclear(stderr: str) -> str | None:
    lines = stderr.strip().splitlines()
    if not lines or not lines[-1].startswith("error: "):
        return f"no line that begins with 'error: ': {stderr[-200:]}"
    if len(lines[-1]) > MAX_LINE:
        return f"a line of {len(lines[-1])} characters"
    return None


def _read(zygote: Zygote, specimen: Specimen, folder: Path) -> Done:
    job = Job([str(folder)], str(folder.parent), f"attack.specimens:{specimen.read}", SECONDS, MEMORY_MB)
    return zygote.run(job)
