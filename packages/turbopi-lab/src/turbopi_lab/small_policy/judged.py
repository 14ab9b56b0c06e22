"""What evaluations of the small policy came to, in one document that is small enough to be checked in."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from msgspec import Struct

from turbopi.evaluate.reading import load_results
from turbopi.evaluate.results import Episode, Results, plain_object, rate
from turbopi.evaluate.statistics import Paired, PairedDocument, RateDocument
from turbopi.support.errors import ConfigError
from turbopi.support.files import write_whole
from turbopi.support.reading import plain_document, read_document

PLAIN = {  # by name: the runs without delay, and the controls
    "float32": "`pytorch`, float32",
    "fused": "`fused`, bfloat16",
    "prompt": "control: the prompt of another task",
    "pictures": "control: the images of another task",
}
DELAYED = {  # by name: the execution mode and its delay
    "async_2": ("async", 2),
    "rtc_trained_2": ("rtc_trained", 2),
    "async_4": ("async", 4),
    "ensemble_4": ("ensemble", 4),
    "rtc_4": ("rtc", 4),
    "rtc_identity_4": ("rtc_identity", 4),
    "rtc_trained_4": ("rtc_trained", 4),
}


class Run(Struct, frozen=True):
    """One evaluation.

    against_first  on the episodes that both have
    seam_jump      median over the episodes of an episode's mean jump of the command where chunks meet; None where
                   nothing was said of the motion
    steps          by task: initial state and control steps to success, x where it failed
    """

    what: str
    protocol: dict[str, Any]
    complete: bool
    success: RateDocument
    by_task: dict[str, tuple[int, int]]
    against_first: PairedDocument | None
    seam_jump: float | None
    steps: dict[str, str]


class Judged(Struct, frozen=True):
    """weights: their fingerprint; versions: of the machine that ran the first."""

    weights: str
    device_name: str
    versions: dict[str, Any]
    runs: dict[str, Run]


def judge(folders: Mapping[str, Path]) -> Judged:
    """folders: of finished or cut short `turbopi eval`s by name, all of the same weights; the first is what others are
    paired with. Raises ValueError, naming the run."""
    found = {name: load_results(folder) for name, folder in folders.items()}
    (_, first), *_ = found.items()
    weights = first.policy.identity["weights"]
    for name, results in found.items():
        if results.policy.identity["weights"] != weights:
            raise ValueError(f"{name} has the weights {results.policy.identity['weights']}; expected {weights}")
    return Judged(
        weights=str(weights),
        device_name=str(first.policy.about["device_name"]),
        versions=plain_object(first.versions),
        runs={name: _run(results, None if results is first else first) for name, results in found.items()},
    )


def load_judged(file: Path) -> Judged:
    """Raises ConfigError, naming file and key, if it can't be read."""
    return read_document(file, Judged, ConfigError)


def write_judged(folders: Mapping[str, Path], out: Path) -> None:
    write_whole(out, json.dumps(plain_document(judge(folders)), indent=1, ensure_ascii=False) + "\n")


def _run(results: Results, first: Results | None) -> Run:
    episodes = [episode for episode in results.in_order() if episode.judged]
    tasks = {str(task): [one for one in episodes if one.task == task] for task in sorted({e.task for e in episodes})}
    jumps = [e.motion.seam_jump for e in episodes if e.motion is not None and e.motion.seam_jump is not None]
    return Run(
        what=_what(results),
        protocol=plain_object(results.protocol),
        complete=results.complete,
        success=rate(episodes).document,
        by_task={task: (sum(one.success for one in own), len(own)) for task, own in tasks.items()},
        against_first=None if first is None else _paired(first, episodes).document,
        seam_jump=round(float(np.median(jumps)), 4) if jumps else None,
        steps={task: _steps(own) for task, own in tasks.items()},
    )


def _what(results: Results) -> str:
    protocol = results.protocol
    if not protocol.get("delay") and protocol.get("execution", "sync") == "sync":
        return results.label
    return f"{results.label}, {protocol['execution']}, delay {protocol['delay']}"


def _paired(first: Results, episodes: Sequence[Episode]) -> Paired:
    common = [(first.episodes[one.key], one) for one in episodes if one.key in first.episodes]
    return Paired.of([(before.success, one.success) for before, one in common if before.judged])


def _steps(episodes: Sequence[Episode]) -> str:
    return " ".join(f"{one.initial_state}:{one.steps if one.success else 'x'}" for one in episodes)


def table(judged: Judged) -> list[str]:
    """Of the runs without delay, and the controls, in Markdown."""
    return ["| run | solved | success [95 %] | against the first |", "|---|---|---|---|"] + [
        _row(what, judged.runs[name]) for name, what in PLAIN.items()
    ]


def delayed_table(judged: Judged) -> list[str]:
    """Of the ways to run under delay, paired with the first run, in Markdown."""
    return [
        "| execution | delay | solved | success [95 %] | against float32 without delay | seam jump |",
        "|---|--:|---|---|---|--:|",
    ] + [_delayed(*way, judged.runs[name]) for name, way in DELAYED.items()]


def _row(name: str, run: Run) -> str:
    paired = run.against_first
    pairs = "" if paired is None else f"{paired.only_second} won, {paired.only_first} lost"
    return f"| {name} | {_success(run)} | {pairs} |"


def _delayed(way: str, delay: int, run: Run) -> str:
    paired = run.against_first
    assert paired is not None and paired.difference is not None and run.seam_jump is not None
    low, high = (100 * bound for bound in paired.difference95)
    difference = f"{100 * paired.difference:+.1f} [{low:+.1f}, {high:+.1f}]"
    return f"| `{way}` | {delay} | {_success(run)} | {difference} | {run.seam_jump:.2f} |"


def _success(run: Run) -> str:
    success = run.success
    assert success.rate is not None
    low, high = (100 * bound for bound in success.wilson95)
    return f"{success.successes} of {success.trials} | {100 * success.rate:.1f} % [{low:.1f}, {high:.1f}]"
