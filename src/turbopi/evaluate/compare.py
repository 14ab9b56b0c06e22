"""Several runs of the same episodes, beside each other: paired with the first of them."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from msgspec import Struct

from turbopi.evaluate.pages import render
from turbopi.evaluate.plots import write_comparison_plot
from turbopi.evaluate.results import Plain, Results
from turbopi.evaluate.statistics import Paired, PairedDocument, Percentiles, Rate, RateDocument, percentiles
from turbopi.evaluate.visited import ActionDifference
from turbopi.quantization.calibration_file import RANDOM_NOISE
from turbopi.quantization.formats import named_by
from turbopi.quantization.plan import format_of
from turbopi.support.errors import ConfigError
from turbopi.support.files import write_whole
from turbopi.support.reading import plain_document
from turbopi.support.text import significant

DOCUMENT = "compare.json"


@dataclass(frozen=True)
class Variant:
    """One way to run the policy."""

    backend: str
    precision: str
    steps: int

    @property
    def folder(self) -> str:
        return f"{self.backend}-{self.precision}-{self.steps}steps"


class ComparedRun(Struct, frozen=True):
    """A run in compare.json. Rates, times and steps are of the episodes that all runs have a verdict for."""

    label: str
    precision: str
    calibration: str | None  # of FP8 or INT8
    folder: str
    success: RateDocument
    paired_with_first: PairedDocument | None  # None: it is the first
    call_ms: Percentiles | None
    infer_ms: Percentiles | None
    steps_to_success: Percentiles | None
    action_error: ActionDifference | None  # None: not measured
    crashes: int
    episodes: int  # that this run has, crashed ones too


class ComparisonDocument(Struct, frozen=True):
    """compare.json."""

    protocol: Plain
    episodes: int  # common ones
    runs: list[ComparedRun]


@dataclass(frozen=True)
class Compared:
    """A run among others.

    rate      on the episodes that all runs have a verdict for
    paired    with the first run's outcomes; None for the first itself
    error     of its actions against the float32 reference, if that was measured
    """

    results: Results
    label: str
    rate: Rate
    paired: Paired | None
    call_ms: Percentiles | None
    infer_ms: Percentiles | None
    steps: Percentiles | None
    error: ActionDifference | None

    @property
    def precision(self) -> str:
        """What the policy ran in, where it told; a calibration on noise says so."""
        policy = self.results.policy
        precision = str(policy.identity.get("precision") or "-")
        noisy = (named_by(policy.about.get("backend_details")) or {}).get("observations") == RANDOM_NOISE
        calibration = _calibration(self.results)
        reported = [
            precision,
            *([] if calibration is None else [calibration[:8]]),
            *(["random noise"] if noisy else []),
        ]
        return ", ".join(reported)

    @property
    def document(self) -> ComparedRun:
        return ComparedRun(
            label=self.label,
            precision=self.precision,
            calibration=_calibration(self.results),
            folder=str(self.results.folder),
            success=self.rate.document,
            paired_with_first=None if self.paired is None else self.paired.document,
            call_ms=self.call_ms,
            infer_ms=self.infer_ms,
            steps_to_success=self.steps,
            action_error=self.error,
            crashes=sum(not episode.judged for episode in self.results.episodes.values()),
            episodes=len(self.results.episodes),
        )


def compare(
    runs: Sequence[Results],
    errors: Sequence[ActionDifference | None] | None = None,
    *,
    across_calibrations: bool = False,
) -> list[Compared]:
    """Every run on the episodes that all of them have a verdict for, paired with the first.

    Raises ConfigError if the protocols differ, if there is no common episode, or if FP8 runs of the same weights come
    from different calibrations, unless those are what is compared.
    """
    check_same_protocol(runs)
    if not across_calibrations:
        check_same_calibration(runs)
    common = sorted(set.intersection(*({e.key for e in run.episodes.values() if e.judged} for run in runs)))
    if not common:
        names = ", ".join(str(run.folder) for run in runs)
        raise ConfigError(f"no episode has a verdict in every one of {names}: there is nothing to compare")
    first = runs[0]
    compared = []
    for number, run in enumerate(runs):
        own = [run.episodes[key] for key in common]
        pairs = [(first.episodes[key].success, run.episodes[key].success) for key in common]
        compared.append(
            Compared(
                run,
                run.label,
                Rate(sum(episode.success for episode in own), len(own)),
                Paired.of(pairs) if number else None,
                percentiles([ms for episode in own for ms in episode.call_ms]),
                percentiles([ms for episode in own for ms in episode.infer_ms]),
                percentiles([episode.steps for episode in own if episode.success]),
                errors[number] if errors is not None else None,
            )
        )
    return compared


def check_same_protocol(runs: Sequence[Results]) -> None:
    """Raise ConfigError, naming the first difference, unless all runs have the same protocol."""
    first = runs[0]
    for run in runs[1:]:
        names = {*first.protocol, *run.protocol}
        for name in sorted(names, key=lambda name: (name not in ("simulator", "suite"), name)):  # what says most first
            mine, theirs = first.protocol.get(name), run.protocol.get(name)
            if mine != theirs:
                raise ConfigError(
                    f"{first.folder} and {run.folder} aren't comparable: "
                    f"{name} is {mine!r} in one and {theirs!r} in the other"
                )


def check_same_calibration(runs: Sequence[Results]) -> None:
    """Raise ConfigError if two runs of one model in FP8, or in INT8, have different calibrations.

    Else a table that seems to compare backends or steps would compare calibrations, too.
    """
    first: dict[str, Results] = {}
    for run in runs:
        calibration = _calibration(run)
        if calibration is None:
            continue
        # a server doesn't tell which weights it has: its configuration's name has to do
        reported = run.policy.identity.get("weights") or _at(run.policy.identity, "server", "config")
        numbers = format_of(str(run.policy.identity.get("precision"))).label
        other = first.setdefault(f"{numbers} of {reported}", run)
        if _calibration(other) != calibration:
            raise ConfigError(
                f"{other.folder} and {run.folder} are {numbers} of one model by different calibrations "
                f"({str(_calibration(other))[:8]} and {calibration[:8]}): run one of them again with the other's "
                "--quantization, or give --across-calibrations if that is what you compare"
            )


def _calibration(run: Results) -> str | None:
    found = run.policy.identity.get("calibration")
    return None if found is None else str(found)


def _at(value: object, *keys: str) -> object:
    """What is at these keys inside each other; None if there is nothing, as in results that tell something else."""
    for key in keys:
        value = value.get(key) if isinstance(value, Mapping) else None
    return value


def document(compared: Sequence[Compared]) -> ComparisonDocument:
    return ComparisonDocument(compared[0].results.protocol, compared[0].rate.trials, [run.document for run in compared])


HEADS = (
    "run",
    "precision",
    "success [95 %]",
    "difference,\npoints [95 %]",
    "only 1st :\nonly this",
    "p",
    "call\np50 ms",
    "call\np95 ms",
    "steps",
    "action\nerror",
)


def cells(run: Compared) -> list[str]:
    """The table's row as text."""
    row = [run.label, run.precision, str(run.rate)]
    if run.paired is None:
        row += ["-", "-", "-"]
    else:
        low, high = run.paired.interval
        row += [
            f"{100 * (run.paired.difference or 0):+.1f} [{100 * low:+.1f}, {100 * high:+.1f}]",
            f"{run.paired.only_first} : {run.paired.only_second}",
            significant(run.paired.p_value),
        ]
    row += [f"{ms:.1f}" for ms in (run.call_ms.p50, run.call_ms.p95)] if run.call_ms else ["-", "-"]
    row.append(f"{run.steps.p50:.0f}" if run.steps else "-")
    row.append(significant(run.error.rms) if run.error else "-")
    return row


LEGEND = (
    "All rates are on the episodes that every run has a verdict for. difference: this run's rate less the first one's, "
    "in percentage points, with Bonett and Price's interval; p: McNemar's exact test; call: the policy's whole answer; "
    "steps: to success, median; action error: rms against the float32 reference with the same noise, on observations "
    "that the run met, in units of each action dimension's spread."
)


def write_comparison(folder: Path, compared: Sequence[Compared]) -> list[Path]:
    """compare.json, compare.png and compare.html."""
    folder.mkdir(parents=True, exist_ok=True)
    reported = folder / DOCUMENT
    write_whole(reported, json.dumps(plain_document(document(compared)), indent=1, ensure_ascii=False) + "\n")
    plot = write_comparison_plot(folder / "compare.png", [(run.label, run.rate) for run in compared])
    shown = folder / "compare.html"
    suite = compared[0].results.suite
    page = render(
        "comparison.html",
        title=f"{suite}: comparison",
        suite=suite,
        runs=[run.label for run in compared],
        trials=compared[0].rate.trials,
        heads=HEADS,
        rows=[cells(run) for run in compared],
        legend=LEGEND,
        plot=plot.name,
        disagreements=_disagreements([run.results for run in compared]),
    )
    write_whole(shown, page)
    return [reported, plot, shown]


def _disagreements(runs: Sequence[Results]) -> list[tuple[tuple[int, int], list[str | None]]]:
    """The episodes, by task and initial state, that some runs solved and others didn't; every run's status."""
    found: list[tuple[tuple[int, int], list[str | None]]] = []
    for key in sorted(runs[0].episodes):
        episodes = [run.episodes.get(key) for run in runs]
        if len({episode.success for episode in episodes if episode is not None and episode.judged}) > 1:
            found.append((key, [episode.status if episode else None for episode in episodes]))
    return found
