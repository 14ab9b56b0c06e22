"""The result file: pieces, each an attack with its seed, and the table that adds them up."""

import json
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rich.table import Table

from attack.arena import MAX_VIOLATIONS, Found
from attack.attacks import ATTACKS, Attack, Size

FORMAT, VERSION = "turbopi-attack", 1
COLUMNS = 80  # that the table fits into


def piece(attack: Attack, seed: int, size: Size, found: Found, seen: dict[str, Any], started: float) -> dict[str, Any]:
    """One attack as it is written: plain values."""
    import torch

    from turbopi.provenance import provenance
    from turbopi.reading import plain_document

    held = not found.violations and not found.more_violations and all(bar.held for bar in found.bars)
    return {
        "attack": attack.name,
        "about": attack.about,
        "prediction": attack.prediction,
        "seed": seed,
        "size": {"count": size.count, "seconds": size.seconds},
        "wall_seconds": round(time.monotonic() - started, 1),
        "count": found.count,
        "outcomes": dict(found.outcomes.most_common()),
        "violations": found.violations,
        "more_violations": found.more_violations,
        "bars": [{**asdict(bar), "held": bar.held} for bar in found.bars],
        "server": seen or None,
        "notes": found.notes,
        "verdict": "held" if held else "broken",
        "provenance": plain_document(provenance(torch.device("cpu"))),
    }


def load(file: Path) -> list[dict[str, Any]]:
    """The pieces in a file; none if it doesn't exist yet. Raises ValueError for a file of another kind."""
    if not file.exists():
        return []
    content = json.loads(file.read_text(encoding="utf-8"))
    if not isinstance(content, dict) or (content.get("format"), content.get("version")) != (FORMAT, VERSION):
        raise ValueError(f"{file} is no result of this tool (format {FORMAT}, version {VERSION})")
    return list(content["pieces"])


def add(file: Path, new: dict[str, Any]) -> list[dict[str, Any]]:
    """Write `new` into the file, in place of an earlier piece of the same attack and seed. Returns all pieces."""
    same = (new["attack"], new["seed"])
    pieces = [old for old in load(file) if (old["attack"], old["seed"]) != same] + [new]
    order = list(ATTACKS)
    pieces.sort(key=lambda one: (order.index(one["attack"]) if one["attack"] in order else len(order), one["seed"]))
    part = file.with_name(f".{file.name}.part")
    part.write_text(json.dumps({"format": FORMAT, "version": VERSION, "pieces": pieces}, indent=1, ensure_ascii=False))
    part.replace(file)
    return pieces


def totals(pieces: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """One row for each attack: its pieces added up, the worst of their bars, and their violations."""
    rows: dict[str, dict[str, Any]] = {}
    for one in pieces:
        row = rows.setdefault(
            one["attack"],
            {"attack": one["attack"], "pieces": 0, "count": 0, "violations": 0, "outcomes": Counter(), "bars": {}}
            | {"broken": [], "said": [], "commits": set()},
        )
        row["pieces"] += 1
        row["count"] += one["count"]
        row["violations"] += len(one["violations"]) + one["more_violations"]
        row["outcomes"].update(one["outcomes"])
        row["said"] += one["violations"][: MAX_VIOLATIONS - len(row["said"])]
        row["commits"].add(one["provenance"]["commit"])
        for bar in one["bars"]:
            worst = row["bars"].get(bar["name"])
            if worst is None or _worse(bar["value"], worst["value"]):
                row["bars"][bar["name"]] = bar
        row["broken"] += [name for bar in one["bars"] if not bar["held"] and (name := bar["name"]) not in row["broken"]]
    return list(rows.values())


def _worse(value: float | None, than: float | None) -> bool:
    return value is None or (than is not None and value > than)


def table(pieces: Sequence[dict[str, Any]]) -> Table:
    """The table that fits COLUMNS columns."""
    found = Table(title="attacks", title_justify="left", width=COLUMNS, pad_edge=False)
    found.add_column("attack", no_wrap=True)
    for name in ("count", "faults", "ratio", "RSS +MB", "log kB/s"):
        found.add_column(name, justify="right", no_wrap=True)
    found.add_column("verdict")
    for row in totals(pieces):
        bars = row["bars"]
        broken = [f"{row['violations']} faults"] * bool(row["violations"]) + row["broken"]
        found.add_row(
            row["attack"],
            f"{row['count']:,}",
            str(row["violations"]),
            *(_shown(bars.get(name)) for name in ("ratio", "growth MB", "log kB/s")),
            f"[red]broken: {', '.join(broken)}[/]" if broken else "[green]held[/]",
        )
    return found


def markdown(pieces: Sequence[dict[str, Any]]) -> str:
    """The table of docs/dev/attack.md: every row with the good client's medians and what was counted."""
    lines = [
        "| attack | what | count | good client, ms | ratio | RSS, MB more | verdict |",
        "|---|---|--:|---|--:|--:|---|",
    ]
    servers: dict[str, list[dict[str, Any]]] = {}
    for one in pieces:
        servers.setdefault(one["attack"], []).append(one["server"] or {})
    for row in totals(pieces):
        bars, good = row["bars"], [seen["good"] for seen in servers[row["attack"]] if "good" in seen]
        medians = [(_number(one["undisturbed_ms"]["p50"]), _number(one["attacked_ms"]["p50"])) for one in good[:1]]
        broken = [f"{row['violations']} faults"] * bool(row["violations"]) + row["broken"]
        about = ATTACKS[row["attack"]].about if row["attack"] in ATTACKS else ""
        cells = [
            f"`{row['attack']}`",
            about,
            f"{row['count']:,}",
            "".join(f"{quiet} → {attacked}" for quiet, attacked in medians) if "ratio" in bars else "",
            _shown(bars.get("ratio")),
            _shown(bars.get("growth MB")),
            f"**broken**: {', '.join(broken)}" if broken else "held",
        ]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def _number(value: float | None) -> str:
    return "none" if value is None else f"{value:.1f}"


def _shown(bar: dict[str, Any] | None) -> str:
    if bar is None:
        return "–"
    return (
        "none" if bar["value"] is None else f"{bar['value']:.2f}" if bar["name"] == "ratio" else f"{bar['value']:.0f}"
    )


def held(pieces: Sequence[dict[str, Any]]) -> bool:
    return all(one["verdict"] == "held" for one in pieces)
