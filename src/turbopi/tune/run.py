"""Measuring all operations that were asked for, and keeping what was found as soon as it is found."""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime, timezone
from pathlib import Path

from msgspec.structs import replace

from turbopi.backends.tuned_tiles import Machine, TileFile, TunedTile, fingerprint, read_tile_file, usable
from turbopi.kernels.tile_table import NO_TILES, Kernels, Knobs, TileKey, TileTable
from turbopi.support.errors import ConfigError
from turbopi.tune.race import Bench, Raced, UsualFails, race
from turbopi.tune.shapes import Operation
from turbopi.version import turbopi_version

Seconds = Callable[[], float]


@dataclass(frozen=True)
class Planned:
    """An operation and what it may run in: the usual choice first."""

    operation: Operation
    candidates: Sequence[Knobs]


@dataclass(frozen=True)
class Measured:
    operation: Operation
    raced: Raced

    @property
    def gained(self) -> float:
        """Microseconds of one operation."""
        return self.raced.usual.microseconds - self.raced.best.microseconds


@dataclass
class Outcome:
    """failed: operations whose usual tile fails, and why. left_out: those for which time didn't suffice."""

    measured: list[Measured] = field(default_factory=list)
    failed: dict[Operation, str] = field(default_factory=dict)
    left_out: list[Operation] = field(default_factory=list)


@dataclass(frozen=True)
class Progress:
    """begin(text, total) tells what is measured next, advance() one of its candidates, done what was found."""

    begin: Callable[[str, int], None] = lambda text, total: None
    advance: Callable[[], None] = lambda: None
    done: Callable[[Measured], None] = lambda measured: None


def usual_first(candidates: Sequence[Knobs], key: TileKey, shipped: TileTable) -> list[Knobs]:
    """The same, with the shipped tile in front where there is one: it is what runs without a file of one's own."""
    first = shipped.tiles.get(key)
    if first is None:
        return list(candidates)
    return [dict(first), *(knobs for knobs in candidates if dict(knobs) != dict(first))]


def tune(
    planned: Sequence[Planned],
    make_bench: Callable[[Operation, TileTable], Bench],
    keep: Callable[[Sequence[Measured]], None],
    *,
    tiles: TileTable = NO_TILES,
    seconds: float | None = None,
    progress: Progress = Progress(),
    clock: Seconds = time.monotonic,
) -> Outcome:
    """Measure one operation after the other; after each, `keep` is given all that is measured.

    tiles    what operations run in that aren't measured yet: some are timed among others
    seconds  begin no further operation after that
    """
    end, outcome = None if seconds is None else clock() + seconds, Outcome()
    for place, one in enumerate(planned):
        if end is not None and clock() >= end:
            outcome.left_out = [left.operation for left in planned[place:]]
            break
        what = one.operation
        progress.begin(f"{place + 1}/{len(planned)} {what.name}, {what.numbers}, {what.rows} rows", len(one.candidates))
        try:
            raced = race(make_bench(what, tiles), one.candidates, advance=progress.advance)
        except UsualFails as failure:
            outcome.failed[what] = str(failure)
            continue
        outcome.measured.append(Measured(what, raced))
        tiles = tiles.with_tile(what.key, raced.best.knobs)
        keep(outcome.measured)
        progress.done(outcome.measured[-1])
    return outcome


def tile_file(machine: Machine, measured: Sequence[Measured], before: TileFile | None = None) -> TileFile:
    """What is measured, and what `before` has beside it."""
    rows = {one.key: one for one in ([] if before is None else before.tiles)}
    rows |= {one.operation.key: tuned_tile(one) for one in measured}
    kernels: dict[Kernels, str] = {one.kernels: fingerprint(one.kernels) for one in rows.values()}
    return TileFile(
        gpu=machine.gpu,
        compute_capability=machine.compute_capability,
        multiprocessors=machine.multiprocessors,
        driver=machine.driver,
        triton=machine.triton,
        turbopi=turbopi_version(),
        date=datetime.now(timezone.utc).strftime("%Y-%m-%d"),
        fingerprints=kernels,
        tiles=sorted(rows.values(), key=lambda one: one.key),
    )


def tuned_tile(one: Measured) -> TunedTile:
    what, key, raced = one.operation, one.operation.key, one.raced
    return TunedTile(
        name=what.name,
        kernels=key.kernels,
        operation=key.operation,
        numbers=key.numbers,
        rows=key.rows,
        columns=key.columns,
        inner=key.inner,
        tile=dict(raced.best.knobs),
        microseconds=round(raced.best.microseconds, 3),
        usual=None if raced.usual.knobs == raced.best.knobs else dict(raced.usual.knobs),
        usual_microseconds=round(raced.usual.microseconds, 3),
    )


def still_good(file: Path, machine: Machine, *, ships: bool = False) -> TileFile | None:
    """What a file has that holds on this GPU, for these kernels, driver and Triton (`ships`: any); None: nothing."""
    if not file.is_file():
        return None
    try:
        document = read_tile_file(file)
    except ConfigError:
        return None  # it is replaced
    found = usable(document, machine, ships=ships)[0]
    return replace(document, tiles=found) if found else None


def gained_ms(found: Mapping[TileKey, TunedTile], operations: Sequence[Operation]) -> tuple[float, float, int]:
    """Of a call with these operations: (milliseconds that they take without the file, milliseconds that its tiles gain,
    how many operations it lacks).

    A norm between two products is timed with either, so the first number may have it twice. The expert's operations
    are timed in its layers, which are counted once.
    """
    took = gained = layers = 0.0
    missing = 0
    for one in operations:
        tuned = found.get(one.key)
        if tuned is None:
            missing += 1
            continue
        milliseconds = one.uses * tuned.usual_microseconds / 1e3
        if one.in_layers:
            layers = max(layers, milliseconds)
        else:
            took += milliseconds
        gained += one.uses * (tuned.usual_microseconds - tuned.microseconds) / 1e3
    return took + layers, gained, missing
