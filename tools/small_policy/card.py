"""The model card: what the policy is, how it was made, what it can do, from files of its training and evaluation."""

import csv
import json
from pathlib import Path
from typing import Any

from small_policy.scenes import INSTRUCTIONS

TEMPLATE = Path(__file__).parent / "card.md"
_RUNS = ("f32", "fused", "steps1", "steps2", "steps3", "steps5", "prompt", "pictures")


def write_card(results: Path, curves: Path, out: Path) -> None:
    """`results`: a summary as in benchmarks/results; `curves`: the run's curves.csv."""
    found = json.loads(results.read_text())
    with curves.open() as file:
        last = list(csv.DictReader(file))[-1]
    runs: dict[str, Any] = found["runs"]
    rows = [_row(runs[name]) for name in _RUNS if name in runs]
    tasks = [f"| {t} | {INSTRUCTIONS[int(t)]} | {s} of {n} |" for t, (s, n) in runs["f32"]["by_task"].items()]
    text = TEMPLATE.read_text(encoding="utf-8").format(
        results=results.name,
        rows="\n".join(rows),
        tasks="\n".join(tasks),
        seconds=round(float(last["seconds"])),
        steps=int(last["step"]),
        frames=f"{int(last['frames']):,}",
        learner_frames=f"{int(last['dagger_frames']):,}",
        demonstrations=last["demonstration"],
        solved=last["demonstration solved"],
        dagger=f"{int(last['dagger']):,}",
        trials=f"{last['recent_trials_solved']} of {last['recent_trials']}",
        weights=runs["f32"]["weights"],
    )
    out.write_text(text, encoding="utf-8")


def _row(run: dict[str, Any]) -> str:
    success, paired = run["success"], run["paired_with_f32"]
    low, high = (100 * bound for bound in success["wilson95"])
    pairs = "" if paired is None else f"{paired['only_this']} won, {paired['only_f32']} lost"
    return (
        f"| {run['what']} | {success['successes']} of {success['trials']} | {100 * success['rate']:.1f} % "
        f"[{low:.1f}, {high:.1f}] | {pairs} |"
    )
