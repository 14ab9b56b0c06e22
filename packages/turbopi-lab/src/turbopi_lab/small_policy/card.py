"""The model card: what the policy is, how it was made, what it can do, from files of its training and evaluation."""

import csv
from pathlib import Path

from turbopi_lab.small_policy.judged import delayed_table, load_judged, table
from turbopi_lab.small_policy.scenes import INSTRUCTIONS

TEMPLATE = Path(__file__).parent / "card.md"


def write_card(results: Path, curves: Path, out: Path) -> None:
    """`results`: what `judged` wrote; `curves`: the run's curves.csv."""
    found = load_judged(results)
    with curves.open() as file:
        last = list(csv.DictReader(file))[-1]
    by_task = found.runs["float32"].by_task
    tasks = [f"| {t} | {INSTRUCTIONS[int(t)]} | {s} of {n} |" for t, (s, n) in by_task.items()]
    text = TEMPLATE.read_text(encoding="utf-8").format(
        results=results.name,
        rows="\n".join(table(found)),
        delayed="\n".join(delayed_table(found)),
        tasks="\n".join(tasks),
        seconds=round(float(last["seconds"])),
        steps=int(last["step"]),
        frames=f"{int(last['frames']):,}",
        learner_frames=f"{int(last['dagger_frames']):,}",
        demonstrations=f"{int(last['demonstration']):,}",
        solved=last["demonstration solved"],
        dagger=f"{int(last['dagger']):,}",
        trials=f"{last['recent_trials_solved']} of {last['recent_trials']}",
        weights=found.weights,
    )
    out.write_text(text, encoding="utf-8")
