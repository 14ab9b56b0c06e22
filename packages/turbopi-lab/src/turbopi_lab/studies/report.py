"""The one form in which a study answers: question, method, controls, tables, plots, verdict, what would change it.

A study returns a `Report`. `write` makes three kinds of file of it: report.json, from which all else can be made again,
report.md, and a PNG for each plot.
"""

import json
from collections.abc import Sequence
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, NullLocator
from msgspec import Struct

from turbopi.evaluate.statistics import PairedDocument, RateDocument
from turbopi.support.files import write_whole
from turbopi.support.plots import as_text, write_figure
from turbopi.support.provenance import Provenance
from turbopi.support.reading import plain_document
from turbopi.support.text import significant

JSON, MARKDOWN = "report.json", "report.md"
PERCENT = "%, with Wilson's interval, 95 %"  # what axis of `rate_series` says
MARGIN = 0.05  # a cell is as good as the baseline if it is worse by less than this, with 95 % confidence
_DPI = 110
_MARKERS = "osD^vPX*<>"

Cell = str | float | int | None  # None: not finite, or not measured


class Control(Struct, frozen=True):
    """A claim that is false if the study's own machinery is broken."""

    claim: str
    held: bool
    evidence: str


class Grid(Struct, frozen=True):
    """A table. Every row has a cell for each column."""

    title: str
    columns: list[str]
    rows: list[list[Cell]]
    note: str = ""


class Series(Struct, frozen=True):
    """A line of a plot; low and high are the ends of its intervals, if it has any."""

    label: str
    x: list[float]
    y: list[float]
    low: list[float] | None = None
    high: list[float] | None = None


class Panel(Struct, frozen=True):
    title: str
    x_label: str
    y_label: str
    series: list[Series]
    log_x: bool = False
    log_y: bool = False
    ticks: list[float] | None = None  # of x; None: matplotlib's


class Plot(Struct, frozen=True):
    """One PNG, `name`.png: panels side by side."""

    name: str
    panels: list[Panel]


class Report(Struct, frozen=True, kw_only=True):
    """A study's answer, as result files have it."""

    study: str
    question: str
    claimed: str  # what an earlier project found, or nothing
    method: str
    controls: list[Control]
    tables: list[Grid]
    plots: list[Plot]
    verdict: str
    would_change: str  # what would change the verdict
    not_run: list[str]  # cells of the question that weren't measured, and how they could be
    small: bool  # run in the small form, which is for trying and tests: its numbers mean little
    command: str
    provenance: Provenance
    data: dict[str, object]  # raw results, by the study's own names

    @property
    def sound(self) -> bool:
        """Whether every control held; if not, the verdict means nothing."""
        return all(control.held for control in self.controls)


def rate_cells(rate: RateDocument) -> list[Cell]:
    """Solved, and the rate in percent with Wilson's interval, 95 %."""
    low, high = (100 * end for end in rate.wilson95)
    percent = "-" if rate.rate is None else f"{100 * rate.rate:.1f} [{low:.1f}, {high:.1f}]"
    return [f"{rate.successes} of {rate.trials}", percent]


def rate_series(label: str, x: Sequence[float], rates: Sequence[RateDocument]) -> Series:
    """A line of success in percent over x, with Wilson's intervals, 95 %."""
    low, high = ([100 * rate.wilson95[end] for rate in rates] for end in (0, 1))
    return Series(label, list(x), [100 * (rate.rate or 0.0) for rate in rates], low, high)


def paired_cell(paired: PairedDocument) -> Cell:
    """The difference to the baseline in percentage points, with its interval, 95 %."""
    if paired.difference is None:
        return None
    low, high = (100 * end for end in paired.difference95)
    return f"{100 * paired.difference:+.1f} [{low:+.1f}, {high:+.1f}]"


def compared(paired: PairedDocument) -> str:
    """What the interval of the difference to the baseline says: worse, as good (not worse by MARGIN), or open."""
    low, high = paired.difference95
    return "worse" if high < 0 else "as good" if low > -MARGIN else "open"


def write(report: Report, folder: Path) -> list[Path]:
    """Write the report's files into `folder`, which is made; their paths. Raises OutputError if they can't be."""
    folder.mkdir(parents=True, exist_ok=True)
    files = [folder / JSON, folder / MARKDOWN]
    write_whole(files[0], _lines(plain_document(report), depth=3) + "\n")
    write_whole(files[1], markdown(report))
    return files + [draw(plot, folder / f"{plot.name}.png") for plot in report.plots]


def _lines(value: object, depth: int, indent: str = "") -> str:
    """JSON with a line for each item of the outer `depth` levels, so that a raw result is one line."""
    if depth == 0 or not value or not isinstance(value, dict | list):
        return json.dumps(value, ensure_ascii=False)
    inner = indent + " "
    if isinstance(value, dict):
        items = [f"{json.dumps(key)}: {_lines(item, depth - 1, inner)}" for key, item in value.items()]
        return "{\n" + ",\n".join(inner + item for item in items) + f"\n{indent}}}"
    items = [_lines(item, depth - 1, inner) for item in value]
    return "[\n" + ",\n".join(inner + item for item in items) + f"\n{indent}]"


# --- Markdown ---------------------------------------------------------------------------------------------------------


def markdown(report: Report) -> str:
    """The report to read."""
    form = ", small form: the numbers mean little" if report.small else ""
    where = report.provenance
    parts = [
        f"# {report.question}",
        f"Study `{report.study}`{form}. `{report.command}`, {where.date}, {where.device_name}, commit {where.commit}.",
    ]
    if not report.sound:
        parts.append("**A control failed. The verdict means nothing until it holds.**")
    if report.claimed:
        parts.append(f"**Claimed before.** {report.claimed}")
    parts += [f"**Method.** {report.method}", "**Controls.**\n\n" + "\n".join(map(_control, report.controls))]
    for table in report.tables:
        parts += ["\n".join([f"**{table.title}**", "", *table_lines(table)])]
        if table.note:
            parts.append(table.note)
    parts += [f"![{panel_titles(plot)}]({plot.name}.png)" for plot in report.plots]
    parts += [f"**Verdict.** {report.verdict}", f"**What would change it.** {report.would_change}"]
    if report.not_run:
        parts.append("**Not run.**\n\n" + "\n".join(f"- {line}" for line in report.not_run))
    return "\n\n".join(parts) + "\n"


def panel_titles(plot: Plot) -> str:
    return "; ".join(panel.title for panel in plot.panels)


def _control(control: Control) -> str:
    return f"- {'held' if control.held else '**FAILED**'}: {control.claim} {control.evidence}"


def table_lines(table: Grid) -> list[str]:
    """A table in Markdown; columns whose every cell is a number, or begins as one, stand on the right."""
    right = [all(_numeric(row[i]) for row in table.rows) for i in range(len(table.columns))]
    rule = "|".join("--:" if one else "---" for one in right)
    rows = ["| " + " | ".join(cell_text(cell) for cell in row) + " |" for row in table.rows]
    return ["| " + " | ".join(table.columns) + " |", f"|{rule}|", *rows]


def _numeric(cell: Cell) -> bool:
    return not isinstance(cell, str) or cell[:1] in "0123456789+-−"


def cell_text(cell: Cell) -> str:
    """None is empty; a float has three digits."""
    if cell is None:
        return ""
    return significant(cell) if isinstance(cell, float) else str(cell)


# --- plots ------------------------------------------------------------------------------------------------------------


def draw(plot: Plot, file: Path) -> Path:
    """Write a plot as PNG. Raises OutputError if it can't be written."""
    figure = Figure(figsize=(0.6 + 4.6 * len(plot.panels), 3.9), dpi=_DPI, layout="constrained")
    for axes, panel in zip(figure.subplots(1, len(plot.panels), squeeze=False)[0], plot.panels, strict=True):
        _draw_panel(axes, panel)
    write_figure(file, figure, dpi=_DPI)
    return file


def _draw_panel(axes: Axes, panel: Panel) -> None:
    for number, one in enumerate(panel.series):
        errors = None
        if one.low is not None and one.high is not None:
            errors = [_less(one.y, one.low), _less(one.high, one.y)]
        marker, color = _MARKERS[number % len(_MARKERS)], f"C{number % 10}"
        axes.errorbar(
            one.x, one.y, yerr=errors, label=as_text(one.label), marker=marker, color=color, ms=4, lw=1.3, capsize=2
        )
    if panel.log_x:
        axes.set_xscale("log")
    if panel.log_y:
        axes.set_yscale("log")
    if panel.y_label.startswith("%"):
        axes.set_ylim(0, 103)  # a rate looks as large as it is
    if panel.ticks is not None:
        axes.xaxis.set_major_locator(FixedLocator(panel.ticks))
        axes.xaxis.set_minor_locator(NullLocator())
        axes.set_xticklabels([f"{tick:g}" for tick in panel.ticks])
    axes.set_title(as_text(panel.title), fontsize=10)
    axes.set_xlabel(panel.x_label, fontsize=9)
    axes.set_ylabel(panel.y_label, fontsize=9)
    axes.tick_params(labelsize=8)
    axes.grid(alpha=0.3)
    axes.legend(fontsize=7.5, frameon=False)


def _less(these: Sequence[float], those: Sequence[float]) -> list[float]:
    return [max(0.0, a - b) for a, b in zip(these, those, strict=True)]
