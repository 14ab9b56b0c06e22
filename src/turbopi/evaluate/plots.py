"""Plots of a run and of a comparison, as PNG files."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from turbopi.evaluate.results import Results, rate
from turbopi.evaluate.statistics import Rate
from turbopi.support.plots import MEASURED, MUTED, SOLVED, as_text, write_figure

_DPI = 120


def write_plots(results: Results) -> list[str]:
    """success.png, and where there is something to show steps.png and latency.png; their names."""
    written = [_success(results, results.folder / "success.png")]
    episodes = results.in_order()
    if any(episode.success for episode in episodes):
        written.append(_steps(results, results.folder / "steps.png"))
    if any(episode.call_ms for episode in episodes):
        written.append(_latency(results, results.folder / "latency.png"))
    return [path.name for path in written]


def _success(results: Results, path: Path) -> Path:
    episodes = results.in_order()
    shown = [index for index in sorted(results.tasks) if any(e.task == index for e in episodes)]
    names = [f"task {index}" for index in shown]
    rates = [rate(e for e in episodes if e.task == index) for index in shown]
    rows = [("all", rate(episodes)), *zip(names, rates, strict=True)]
    figure = Figure(figsize=(6.2, 1.2 + 0.3 * len(rows)), layout="constrained")
    axes = figure.subplots()
    for place, (_, one) in enumerate(rows):
        _rate_bar(axes, place, one, SOLVED if place == 0 else MEASURED)
    axes.set_yticks(range(len(rows)), [name for name, _ in rows], fontsize=9)
    axes.invert_yaxis()
    axes.set_xlim(0, 100)
    axes.set_xlabel("success [%], with Wilson's 95 % interval")
    axes.grid(axis="x", alpha=0.3)
    write_figure(path, figure, dpi=_DPI)
    return path


def _rate_bar(axes: Axes, place: int, one: Rate, color: str) -> None:
    if one.value is None:
        axes.text(1, place, "no verdict", va="center", fontsize=8, color=MUTED)
        return
    low, high = one.interval
    axes.barh(place, 100 * one.value, color=color, alpha=0.75, height=0.65)
    # where the bar ends, which shows a rate of 0, too
    axes.plot(100 * one.value, place, "o", color=color, markersize=7, clip_on=False, zorder=3)
    axes.plot([100 * low, 100 * high], [place, place], color="0.15", linewidth=1.4)
    axes.plot([100 * low, 100 * high], [place, place], "|", color="0.15", markersize=8)
    axes.text(102.5, place, f"{one.successes}/{one.trials}", va="center", fontsize=8)


def _steps(results: Results, path: Path) -> Path:
    """How many episodes were solved by which step: where more steps would still help, and where not."""
    judged = [episode for episode in results.in_order() if episode.judged]
    allowed = results.protocol.get("max_steps")
    own = allowed if isinstance(allowed, int) else max(task.max_steps for task in results.tasks.values())
    limit = max(own, *(e.steps for e in judged))
    solved = np.sort([e.steps for e in judged if e.success])
    figure = Figure(figsize=(6.2, 3.6), layout="constrained")
    axes = figure.subplots()
    share = 100 * np.arange(1, len(solved) + 1) / len(judged)
    end = 1.04 * limit  # beyond the last step that an episode may take: a success there is seen, too
    axes.step(np.r_[0, solved, end], np.r_[0, share, share[-1]], where="post", color=SOLVED)
    axes.axvline(limit, color=MUTED, linestyle="--", linewidth=1, label=f"the limit, {limit} steps")
    axes.legend(fontsize=8, frameon=False, loc="upper left")
    axes.set_xlim(0, end)
    axes.set_ylim(0, 103)
    axes.set_xlabel("control steps")
    axes.set_ylabel("solved by then [% of episodes]")
    axes.grid(alpha=0.3)
    write_figure(path, figure, dpi=_DPI)
    return path


def _latency(results: Results, path: Path) -> Path:
    """Distribution of the policy's calls; the slowest percent is beyond the axis."""
    calls = np.array([ms for e in results.in_order() for ms in e.call_ms])
    p50, p95, p99 = np.percentile(calls, [50, 95, 99])
    edge = p99 * 1.15
    figure = Figure(figsize=(6.2, 3.6), layout="constrained")
    axes = figure.subplots()
    axes.hist(calls[calls <= edge], bins=50, color=MEASURED, alpha=0.75)
    for value, name, style in ((p50, "p50", "-"), (p95, "p95", "--"), (p99, "p99", ":")):
        axes.axvline(value, color="0.2", linestyle=style, linewidth=1.2, label=f"{name} {value:.1f} ms")
    axes.set_xlim(left=0)
    axes.set_xlabel("one call of the policy [ms]")
    axes.set_ylabel("calls")
    axes.legend(fontsize=8, frameon=False)
    write_figure(path, figure, dpi=_DPI)
    return path


def write_comparison_plot(path: Path, rows: Sequence[tuple[str, Rate]]) -> Path:
    """One success bar a run."""
    figure = Figure(figsize=(7.5, 1.2 + 0.42 * len(rows)), layout="constrained")
    axes = figure.subplots()
    for place, (_, one) in enumerate(rows):
        _rate_bar(axes, place, one, MEASURED)
    axes.set_yticks(range(len(rows)), [as_text(_short(name, 60)) for name, _ in rows], fontsize=9)
    axes.invert_yaxis()
    axes.set_xlim(0, 100)
    axes.set_xlabel("success on the common episodes [%], with Wilson's 95 % interval")
    axes.grid(axis="x", alpha=0.3)
    write_figure(path, figure, dpi=_DPI)
    return path


def _short(text: str, most: int) -> str:
    return text if len(text) <= most else text[: most - 1] + "…"
