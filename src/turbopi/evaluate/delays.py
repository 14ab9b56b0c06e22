"""A policy judged under delay: the same episodes for every way to run, delay and execution horizon, in one report."""

import itertools
import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from msgspec import Struct

from turbopi.evaluate.pacing import PacedSummary, allows_for_lateness
from turbopi.evaluate.pages import render
from turbopi.evaluate.plan import Protocol
from turbopi.evaluate.results import Episode, Plain, PolicyDescription, Results, plain_object
from turbopi.evaluate.statistics import Paired, PairedDocument, Percentiles, Rate, RateDocument, percentiles
from turbopi.realtime import WAYS, way_named
from turbopi.support.errors import ConfigError
from turbopi.support.files import write_whole
from turbopi.support.plots import write_figure
from turbopi.support.reading import plain_document, read_document

FORMAT: Final = 1
FILE, PAGE, SUCCESS_PLOT, SEAM_PLOT = "delays.json", "delays.html", "delays.png", "seams.png"
COLORS = dict(
    zip(WAYS, ("#9aa0a6", "#b00020", "#e08a00", "#3b6fb6", "#7b4fb6", "#2f8f5b", "#7a5c3e", "#c2569b"), strict=True)
)


@dataclass(frozen=True)
class Cell:
    """A way to run, the delay and the execution horizon, both in control steps.

    Delay None: in real time, where it is measured.
    """

    execution: str
    delay: int | None
    horizon: int

    @property
    def folder(self) -> str:
        if self.delay is None:
            return f"{self.execution}_real_time_horizon{self.horizon}"
        return f"{self.execution}_delay{self.delay}_horizon{self.horizon}"

    def protocol(self, base: Protocol) -> Protocol:
        """`base` has the wall clock's rate, if it is in real time."""
        return replace(base, execution=self.execution, delay=self.delay or 0, replan=self.horizon)


def make_cells(executions: Sequence[str], delays: Sequence[int | None], horizons: Sequence[int]) -> list[Cell]:
    """All combinations, delays first. Raises ConfigError for a way that isn't one."""
    ways = [way_named(name).name for name in dict.fromkeys(executions)]
    ordered = sorted(set(delays), key=lambda delay: -1 if delay is None else delay)
    return [Cell(*cell) for cell in itertools.product(ways, ordered, sorted(set(horizons)))]


class CellSummary(Struct, frozen=True):
    """What a cell's episodes come to. Differences are this cell's rate less the other's, on common episodes.

    delay             simulated, in control steps. None: real time; `real_time` has what was measured
    undelayed         the other is the same way with the smallest delay; None: it is that
    against           the other is the first way in the list, with the same delay and horizon; None: it is that
    seam_jump, …      medians over episodes of `Motion`'s means
    standing          mean control steps an episode in which the robot stood still for want of an action
    """

    execution: str
    delay: int | None
    horizon: int
    success: RateDocument
    undelayed: PairedDocument | None
    against: PairedDocument | None
    steps_to_success: Percentiles | None
    seam_jump: float | None
    seam_gap: float | None
    step_jump: float | None
    jerk: float | None
    standing: float | None
    dropped: int
    crashes: int
    real_time: PacedSummary | None = None

    @property
    def steps_of_delay(self) -> float:
        """Simulated, or the median of those measured."""
        if self.delay is not None:
            return self.delay
        measured = None if self.real_time is None else self.real_time.delay_steps
        return float("nan") if measured is None else measured.p50


class DelaysDocument(Struct, frozen=True):
    """delays.json. `outcomes`: a text a cell, with a letter for each of `episodes`.

    The letters: s success, f failure, a aborted, c crash, - not run.
    """

    format: Literal[1]
    protocol: Plain
    policy: PolicyDescription
    versions: Plain
    episodes: list[tuple[int, int]]  # task and initial state
    first: str  # the way that the others are compared with
    cells: list[CellSummary]
    outcomes: list[str]


def summarise(cells: Sequence[tuple[Cell, Results]]) -> list[CellSummary]:
    """One summary a cell, in order. The first cell's way to run is the one that others are compared with."""
    found, first = dict(cells), cells[0][0].execution
    least = min((cell.delay for cell, _ in cells if cell.delay is not None), default=None)

    def paired(results: Results, other: Cell, own: Cell) -> PairedDocument | None:
        return None if other == own else _paired(found[other], results).document

    return [
        _summary(
            cell,
            results,
            paired(results, replace(cell, delay=least), cell),
            paired(results, replace(cell, execution=first), cell),
        )
        for cell, results in cells
    ]


def _paired(first: Results, second: Results) -> Paired:
    common = [
        key
        for key, episode in second.episodes.items()
        if episode.judged and key in first.episodes and first.episodes[key].judged
    ]
    return Paired.of([(first.episodes[key].success, second.episodes[key].success) for key in common])


def _summary(
    cell: Cell, results: Results, undelayed: PairedDocument | None, against: PairedDocument | None
) -> CellSummary:
    episodes = [episode for episode in results.in_order() if episode.judged]
    motions = [episode.motion for episode in episodes if episode.motion is not None]

    def median(name: str) -> float | None:
        values = [value for motion in motions if (value := getattr(motion, name)) is not None]
        return float(np.median(values)) if values else None

    return CellSummary(
        execution=cell.execution,
        delay=cell.delay,
        horizon=cell.horizon,
        success=Rate(sum(episode.success for episode in episodes), len(episodes)).document,
        undelayed=undelayed,
        against=against,
        steps_to_success=percentiles([episode.steps for episode in episodes if episode.success]),
        seam_jump=median("seam_jump"),
        seam_gap=median("seam_gap"),
        step_jump=median("step_jump"),
        jerk=median("jerk"),
        standing=float(np.mean([motion.standing for motion in motions])) if motions else None,
        dropped=sum(motion.dropped for motion in motions),
        crashes=len(results.episodes) - len(episodes),
        real_time=results.real_time(),
    )


def document(cells: Sequence[tuple[Cell, Results]]) -> DelaysDocument:
    results = cells[0][1]
    own = ("execution", "delay", "replan")
    keys = sorted(set.union(*(set(one.episodes) for _, one in cells)))
    return DelaysDocument(
        format=FORMAT,
        protocol={name: value for name, value in results.protocol.items() if name not in own},
        policy=PolicyDescription(
            results.policy.label, plain_object(results.policy.identity), plain_object(results.policy.about)
        ),
        versions=plain_object(results.versions),
        episodes=keys,
        first=cells[0][0].execution,
        cells=summarise(cells),
        outcomes=["".join(_letter(one.episodes.get(key)) for key in keys) for _, one in cells],
    )


def load_delays(file: Path) -> DelaysDocument:
    """A delays.json. Raises ConfigError, naming file and key, if it can't be read."""
    return read_document(file, DelaysDocument, ConfigError)


def _letter(episode: Episode | None) -> str:
    return "-" if episode is None else episode.status[0]


def write_delays(folder: Path, cells: Sequence[tuple[Cell, Results]]) -> Path:
    """delays.json, its page and plots. Raises ConfigError without a cell."""
    if not cells:
        raise ConfigError("there is nothing to report: no way to run was evaluated")
    folder.mkdir(parents=True, exist_ok=True)
    reported = document(cells)
    write_whole(folder / FILE, json.dumps(plain_document(reported), ensure_ascii=False, allow_nan=False) + "\n")
    plot_success(folder / SUCCESS_PLOT, reported.cells)
    plot_seams(folder / SEAM_PLOT, reported.cells)
    results = cells[0][1]
    is_real_time = results.control_hz is not None
    page = render(
        "delays.html",
        title=f"{results.suite} under delay: {results.label}",
        suite=results.suite,
        label=results.label,
        episodes=len(reported.episodes),
        heads=heads(reported.cells),
        notes=notes(reported.cells, results.control_hz),
        rows=[row(cell) for cell in reported.cells],
        legend=LEGEND.format(first=reported.first) + (MEASURED_LEGEND if is_real_time else ""),
        measured=is_real_time,
        rate=results.rate if is_real_time else "",
        plots=[SUCCESS_PLOT, SEAM_PLOT],
        runs=[(cell.folder, f"{cell.folder}/report.html") for cell, _ in cells],
    )
    write_whole(folder / PAGE, page)
    return folder / PAGE


HEADS = (
    "execution",
    "delay",
    "horizon",
    "success [95 %]",
    "against least delay",
    "against the first way",
    "steps",
    "seam jump",
    "other steps",
    "jerk",
    "stood still",
)
LEGEND = (
    "Success with Wilson's interval. Differences are paired, on the same episodes, with Bonett and Price's interval: "
    "against the same way with the smallest delay, and against {first} at the same delay and horizon. steps: to "
    "success, median. seam jump: how far the command moves where a chunk takes over; other steps: where none does; "
    "jerk: the command's second difference (medians over episodes, in the command's unit). stood still: steps an "
    "episode without an action."
)


MEASURED_HEADS = ("latency [ms] p50 / p95", "dropped", "late steps")
MEASURED_LEGEND = (
    " Measured by the wall clock: delay: median and 95th percentile of the control steps from an observation to its "
    "chunk; latency: from an observation to the policy's answer; dropped: chunks that were never carried out; late "
    "steps: those that began more than a tenth of a control step late."
)


def heads(cells: Sequence[CellSummary]) -> tuple[str, ...]:
    """The table's; more of them where delays were measured."""
    return HEADS + (MEASURED_HEADS if any(cell.real_time is not None for cell in cells) else ())


def notes(cells: Sequence[CellSummary], control_hz: float | None) -> list[str]:
    """What a reader must know before the numbers: where ways are the same, or the simulator was behind the clock."""
    undelayed = [way for cell in cells if cell.delay == 0 and (way := way_named(cell.execution)).plain_without_delay]
    same = list(dict.fromkeys(way.name for way in undelayed))
    plain = "these are ordinary calls, which need nothing of the chunk before"
    found = [
        (cell.execution, allows_for_lateness(cell.real_time, control_hz))
        for cell in cells
        if cell.real_time is not None and control_hz is not None
    ]
    late = [f"{execution}: {reported}" for execution, reported in found if reported is not None]
    return [f"the same with a delay of 0: {', '.join(same)}; {plain}", *late] if len(same) > 1 else late


def row(cell: CellSummary) -> list[str]:
    """A table's row as text."""
    rate = Rate(cell.success.successes, cell.success.trials)
    steps = "-" if cell.steps_to_success is None else f"{cell.steps_to_success.p50:.0f}"
    lengths = ["-" if value is None else f"{value:.2f}" for value in (cell.seam_jump, cell.step_jump, cell.jerk)]
    standing = "-" if cell.standing is None else f"{cell.standing:.1f}"
    differences = [_difference(cell.undelayed), _difference(cell.against)]
    delay, measured = str(cell.delay), []
    if cell.real_time is not None:
        delay, *measured = _measured(cell.real_time)
    return [
        cell.execution, delay, str(cell.horizon), str(rate), *differences, steps, *lengths, standing, *measured
    ]  # fmt: skip


def _measured(paced: PacedSummary) -> list[str]:
    """The delay's text, and the columns of MEASURED_HEADS."""
    delay, latency = paced.delay_steps, paced.latency_ms
    return [
        "-" if delay is None else f"measured: {delay.p50:.0f} (p95 {delay.p95:.0f})",
        "-" if latency is None else f"{latency.p50:.1f} / {latency.p95:.1f}",
        ", ".join(f"{count} {reason}" for reason, count in paced.dropped.items()) or "0",
        f"{paced.late_steps} of {paced.steps}" + ("" if paced.is_real_time else ": not real time"),
    ]


def _difference(paired: PairedDocument | None) -> str:
    if paired is None or paired.difference is None:
        return "-"
    low, high = paired.difference95
    return f"{100 * paired.difference:+.1f} [{100 * low:+.1f}, {100 * high:+.1f}]"


def plot_success(path: Path, cells: Sequence[CellSummary]) -> Path:
    """Success over delay, one line a way to run, one image an execution horizon; with Wilson's intervals."""
    horizons = sorted({cell.horizon for cell in cells})
    figure = Figure(figsize=(4.8 * len(horizons) + 0.6, 3.8), layout="constrained")
    camera_images = figure.subplots(1, len(horizons), squeeze=False, sharey=True)[0]
    ways = list(dict.fromkeys(cell.execution for cell in cells))
    for axes, horizon in zip(camera_images, horizons, strict=True):
        for number, way in enumerate(ways):
            own = [cell for cell in cells if (cell.execution, cell.horizon) == (way, horizon) and cell.success.trials]
            shift = 0.06 * (number - (len(ways) - 1) / 2)  # so that intervals don't hide each other
            x = [cell.steps_of_delay + shift for cell in own]
            y = [100 * (cell.success.rate or 0) for cell in own]
            ends = np.array([[100 * end for end in cell.success.wilson95] for cell in own]).reshape(-1, 2)
            axes.errorbar(
                x, y, np.maximum(np.abs(ends.T - np.array(y)), 0), label=way, color=COLORS[way], marker="o",
                markersize=5, capsize=2, linewidth=1.4,
            )  # fmt: skip
        axes.set_title(f"execution horizon {horizon}", fontsize=10)
        _label_delays(axes, cells)
        axes.set_ylim(-2, 103)
        axes.grid(alpha=0.3)
    camera_images[0].set_ylabel("success [%], Wilson's 95 % interval")
    camera_images[-1].legend(fontsize=8, frameon=False)
    write_figure(path, figure, dpi=120)
    return path


def plot_seams(path: Path, cells: Sequence[CellSummary]) -> Path:
    """How far the command moves at seams, over delay, one line a way to run and horizon."""
    figure = Figure(figsize=(5.4, 3.8), layout="constrained")
    axes = figure.subplots()
    horizons = sorted({cell.horizon for cell in cells})
    for way in dict.fromkeys(cell.execution for cell in cells):
        for style, horizon in zip(itertools.cycle(("-", "--", ":")), horizons, strict=False):
            own = [
                (cell.steps_of_delay, cell.seam_jump)
                for cell in cells
                if (cell.execution, cell.horizon) == (way, horizon) and cell.seam_jump is not None
            ]
            if own:
                label = way if len(horizons) == 1 else f"{way}, horizon {horizon}"
                axes.plot(*zip(*own, strict=True), style, label=label, color=COLORS[way], marker="o", markersize=5)
    _label_delays(axes, cells)
    axes.set_ylabel("jump of the command at seams, median")
    axes.set_ylim(bottom=0)
    axes.grid(alpha=0.3)
    if axes.has_data():  # else no chunk took over from another
        axes.legend(fontsize=8, frameon=False)
    write_figure(path, figure, dpi=120)
    return path


def _label_delays(axes: Axes, cells: Sequence[CellSummary]) -> None:
    delays = sorted({cell.steps_of_delay for cell in cells if np.isfinite(cell.steps_of_delay)})
    measured = any(cell.delay is None for cell in cells)
    axes.set_xticks(delays)
    axes.set_xlabel("delay [control steps]" + (", median of those measured" if measured else ""))
    if measured and delays:
        axes.set_xlim(delays[0] - 0.5, delays[-1] + 0.5)
