"""An image of a run: what was commanded, where chunks took over, how long the policy took."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from turbopi.realtime.journal import Inferred, Journal
from turbopi.support.plots import write_figure

SHOWN = 600  # control steps; of a longer run, the last ones
MOST_DIMS = 16
_BORDER, _DELAY, _DROPPED, _EMPTY = "0.45", "#4c78a8", "#d62728", "#f2b701"


def plot_run(file: Path, journal: Journal, report: dict[str, Any]) -> None:
    """Write an image: a row for each dimension of the action, and one for the policy's delays. Raises as
    `write_figure` does.
    """
    commands = list(journal.commands)[-SHOWN:]
    steps = np.array([step for step, _ in commands], dtype=float)
    width = max((len(c.action) for _, c in commands if c.action is not None), default=1)
    values = np.full((len(commands), width), np.nan)
    for row, (_, command) in enumerate(commands):
        if command.action is not None:
            values[row] = command.action
    dims = min(width, MOST_DIMS)
    heights = [1.0] * dims + [0.55]
    figure = Figure(figsize=(12, 1.2 + 1.1 * sum(heights)), dpi=110, layout="constrained")
    axes = list(figure.subplots(dims + 1, 1, sharex=True, squeeze=False, height_ratios=heights)[:, 0])
    empty = [step for step, command in commands if command.kind in ("held", "waiting")]
    borders = [step for step, command in commands if command.takes_over]
    slowed = np.array([command.kind == "slowed" for _, command in commands], dtype=bool)
    for dim, ax in enumerate(axes[:-1]):
        ax.plot(steps, values[:, dim], color="C0", linewidth=1.2)
        ax.plot(steps[slowed], values[slowed, dim], "x", color=_EMPTY, markersize=4)
        for step in empty:
            ax.axvspan(step - 0.5, step + 0.5, color=_EMPTY, alpha=0.25, linewidth=0)
        for step in borders:
            ax.axvline(step, color=_BORDER, linewidth=0.7, linestyle=":")
        ax.set_ylabel(f"action {dim}", fontsize=8)
        ax.tick_params(labelsize=7)
    _draw_delays(axes[-1], journal.inferred, steps, report)
    more = f", the first {dims} of {width} dimensions" if width > dims else ""
    figure.suptitle(
        f"{report['execution']} at {report['control_hz']:g} Hz, {report['chunks']} chunks, "
        f"{sum(report['dropped'].values())} dropped, {report['empty_steps']} steps without an action{more}",
        fontsize=11,
    )
    figure.legend(
        handles=[
            Line2D([], [], color="C0", label="command"),
            Line2D([], [], color=_BORDER, linestyle=":", label="a chunk takes over"),
            Patch(color=_EMPTY, alpha=0.25, label="no action"),
            Line2D([], [], color=_EMPTY, marker="x", linestyle="", label="slowed"),
            Patch(color=_DELAY, label="observation to chunk"),
            Patch(color=_DROPPED, label="chunk dropped"),
        ],
        loc="outside lower center",
        ncols=6,
        fontsize=8,
    )
    write_figure(file, figure)


def _draw_delays(ax: Axes, inferred: Iterable[Inferred], steps: np.ndarray, report: dict[str, Any]) -> None:
    first = steps[0] if len(steps) else 0
    for one in inferred:
        ended = report["steps"] if one.ended is None else one.ended
        if ended < first:
            continue
        color = _DELAY if one.outcome in ("used", "in flight") else _DROPPED
        ax.broken_barh([(one.begun - 0.5, max(ended - one.begun, 0.2))], (one.chunk % 2, 0.8), color=color)
    if len(steps):
        ax.set_xlim(steps[0] - 0.5, steps[-1] + 0.5)
    ax.set_yticks([])
    ax.set_ylabel("delay", fontsize=8)
    ax.set_xlabel("control step", fontsize=8)
    ax.tick_params(labelsize=7)
