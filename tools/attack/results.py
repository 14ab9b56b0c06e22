"""The result file: pieces, each an attack with its seed, and the table that adds them up."""

import json
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from dataclasses import field as dataclass_field
from pathlib import Path
from typing import Any, Literal

import torch
from msgspec import Struct
from rich.table import Table

from attack.arena import MAX_VIOLATIONS, Found
from attack.attacks import ATTACKS, Attack, Size
from turbopi.support.errors import ConfigError
from turbopi.support.provenance import Provenance, provenance
from turbopi.support.reading import plain_document, read_document

MAX_BYTES = 1 << 28
COLUMNS = 80  # that the table fits into


class PieceSize(Struct, frozen=True):
    count: int
    seconds: float | int


class Violation(Struct, frozen=True):
    """What is wrong, and a line that makes it happen again."""

    what: str
    reproduce: str


class JudgedBar(Struct, frozen=True):
    """value: None if nothing could be measured."""

    name: str
    value: float | int | None
    limit: float | int
    held: bool


class Piece(Struct, frozen=True):
    """One attack with a seed. `server`: what was seen of it meanwhile, None where there was none."""

    attack: str
    about: str
    prediction: str
    seed: int
    size: PieceSize
    wall_seconds: float
    count: int
    outcomes: dict[str, int]
    violations: list[Violation]
    more_violations: int
    bars: list[JudgedBar]
    server: dict[str, Any] | None
    notes: dict[str, Any]
    verdict: Literal["held", "broken"]
    provenance: Provenance


class AttackDocument(Struct, frozen=True):
    format: Literal["turbopi-attack"]
    version: Literal[1]
    pieces: list[Piece]


@dataclass
class Total:
    """An attack's pieces added up: the worst of its bars by name, the names of those that broke, some violations."""

    attack: str
    pieces: int = 0
    count: int = 0
    violations: int = 0
    outcomes: Counter[str] = dataclass_field(default_factory=Counter)
    bars: dict[str, JudgedBar] = dataclass_field(default_factory=dict)
    broken: list[str] = dataclass_field(default_factory=list)
    said: list[Violation] = dataclass_field(default_factory=list)
    commits: set[str] = dataclass_field(default_factory=set)

    @property
    def faults(self) -> list[str]:
        """In words; none: it held."""
        return [f"{self.violations} faults"] * bool(self.violations) + self.broken


def piece(attack: Attack, seed: int, size: Size, found: Found, seen: dict[str, Any], started: float) -> Piece:
    """One attack as it is written."""
    held = not found.violations and not found.more_violations and all(bar.held for bar in found.bars)
    return Piece(
        attack=attack.name,
        about=attack.about,
        prediction=attack.prediction,
        seed=seed,
        size=PieceSize(size.count, size.seconds),
        wall_seconds=round(time.monotonic() - started, 1),
        count=found.count,
        outcomes=dict(found.outcomes.most_common()),
        violations=[Violation(**one) for one in found.violations],
        more_violations=found.more_violations,
        bars=[JudgedBar(bar.name, bar.value, bar.limit, bar.held) for bar in found.bars],
        server=seen or None,
        notes=found.notes,
        verdict="held" if held else "broken",
        provenance=provenance(torch.device("cpu")),
    )


def load(file: Path) -> list[Piece]:
    """The pieces in a file; none if it doesn't exist yet. Raises ConfigError for a file of another kind."""
    if not file.exists():
        return []
    return read_document(file, AttackDocument, ConfigError, limit=MAX_BYTES, hint=" (no result of this tool)").pieces


def add(file: Path, new: Piece) -> list[Piece]:
    """Write `new` into the file, in place of an earlier piece of the same attack and seed. Returns all pieces."""
    pieces = [old for old in load(file) if (old.attack, old.seed) != (new.attack, new.seed)] + [new]
    order = list(ATTACKS)
    pieces.sort(key=lambda one: (order.index(one.attack) if one.attack in order else len(order), one.seed))
    part = file.with_name(f".{file.name}.part")
    document = AttackDocument("turbopi-attack", 1, pieces)
    part.write_text(json.dumps(plain_document(document), indent=1, ensure_ascii=False))
    part.replace(file)
    return pieces


def totals(pieces: Sequence[Piece]) -> list[Total]:
    """One for each attack."""
    rows: dict[str, Total] = {}
    for one in pieces:
        row = rows.setdefault(one.attack, Total(one.attack))
        row.pieces += 1
        row.count += one.count
        row.violations += len(one.violations) + one.more_violations
        row.outcomes.update(one.outcomes)
        row.said += one.violations[: MAX_VIOLATIONS - len(row.said)]
        row.commits.add(one.provenance.commit)
        for bar in one.bars:
            worst = row.bars.get(bar.name)
            if worst is None or _worse(bar.value, worst.value):
                row.bars[bar.name] = bar
        row.broken += [bar.name for bar in one.bars if not bar.held and bar.name not in row.broken]
    return list(rows.values())


def _worse(value: float | None, than: float | None) -> bool:
    return value is None or (than is not None and value > than)


def table(pieces: Sequence[Piece]) -> Table:
    """The table that fits COLUMNS columns."""
    found = Table(title="attacks", title_justify="left", width=COLUMNS, pad_edge=False)
    found.add_column("attack", no_wrap=True)
    for name in ("count", "faults", "ratio", "RSS +MB", "log kB/s"):
        found.add_column(name, justify="right", no_wrap=True)
    found.add_column("verdict")
    for row in totals(pieces):
        bars, broken = row.bars, row.faults
        found.add_row(
            row.attack,
            f"{row.count:,}",
            str(row.violations),
            *(_shown(bars.get(name)) for name in ("ratio", "growth MB", "log kB/s")),
            f"[red]broken: {', '.join(broken)}[/]" if broken else "[green]held[/]",
        )
    return found


def _shown(bar: JudgedBar | None) -> str:
    if bar is None:
        return "–"
    if bar.value is None:
        return "none"
    return f"{bar.value:.2f}" if bar.name == "ratio" else f"{bar.value:.0f}"


def held(pieces: Sequence[Piece]) -> bool:
    return all(one.verdict == "held" for one in pieces)
