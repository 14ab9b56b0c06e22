"""Images of action chunks, as PNG files, and the colours of all plots: one colour for one thing."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from turbopi.support.action_groups import ActionGroup, action_groups
from turbopi.support.errors import ConfigError
from turbopi.support.files import write_whole

_DPI = 110
STAGES = {"vision": "#4c72b0", "prefix": "#dd8452", "denoise": "#55a868"}
MEASURED, SOLVED, BOUND, MUTED = "#3b6fb6", "#2f8f5b", "#b00020", "#9aa0a6"
_GRIPPERS = {"gripper": "C9", "left": "C9", "right": "C8"}  # as no axis and no joint, which have C0 to C7


@dataclass(frozen=True)
class Row:
    """One observation and its chunk [H, d]; `oracle` is drawn as dots on its lines, `expert` as broken lines.

    legend   what those two are called
    """

    heading: str
    camera_images: dict[str, np.ndarray]  # camera -> [h, w, 3]
    actions: np.ndarray
    oracle: np.ndarray | None = None
    expert: np.ndarray | None = None
    legend: tuple[str, str] = ("float32 reference", "expert")


def plot_chunks(
    file: Path,
    rows: Sequence[Row],
    *,
    robot: str,
    title: str,
    random_weights: bool,
    names: Sequence[str] | None = None,
) -> None:
    """Write a PNG with one row an observation: its images, then its action chunk by groups of one unit.

    A group's axis is the same in every row; `names` as for `action_groups`. Raises as `write_figure` does.
    """
    groups = action_groups(robot, rows[0].actions.shape[1], names)
    num_images = max(len(row.camera_images) for row in rows)
    limits = [_limits(group, rows) for group in groups]
    widths = [1.0] * num_images + [1.45] * len(groups)
    figure = Figure(figsize=(0.8 + 2.45 * sum(widths), 0.9 + 2.75 * len(rows)), dpi=_DPI, layout="constrained")
    if random_weights:
        title += "\nrandom weights: the actions mean nothing"
    figure.suptitle(as_text(title), fontsize=14, fontweight="bold", color=BOUND if random_weights else "black")
    for row, panel in zip(rows, np.atleast_1d(np.array(figure.subfigures(len(rows), 1))), strict=True):
        panel.suptitle(as_text(row.heading), fontsize=10.5, x=0.01, ha="left")
        axes = np.atleast_1d(panel.subplots(1, num_images + len(groups), width_ratios=widths))
        _draw_images(axes[:num_images], row.camera_images)
        for ax, group, span in zip(axes[num_images:], groups, limits, strict=True):
            _draw_group(ax, group, row)
            ax.set_ylim(span)
    write_figure(file, figure)


def write_figure(file: Path, figure: Figure, dpi: int = _DPI, *, about: Mapping[str, str] | None = None) -> None:
    """Write a figure in the format that the file's ending names, whole or not at all. A PNG holds the texts `about`.

    Raises ConfigError for an unknown ending, OutputError if the file can't be written.
    """
    try:
        kind = file.suffix.removeprefix(".") or "png"
        write_whole(file, lambda stream: figure.savefig(stream, dpi=dpi, format=kind, metadata=about))
    except ValueError as error:
        raise ConfigError(f"can't write the plot {file}: {error}") from error


def as_text(text: str) -> str:
    """`text` for a figure, where a pair of dollar signs would begin a formula: a prompt's or a label's don't."""
    return text.replace("$", r"\$")


def _limits(group: ActionGroup, rows: Sequence[Row]) -> tuple[float, float]:
    """What a group's axis shows: its limits, and whatever is beyond them.

    Without limits the values of all rows, but not less than a fifth of the largest: noise on a constant stays small.
    """
    drawn = [chunk for row in rows for chunk in (row.actions, row.oracle, row.expert) if chunk is not None]
    values = np.concatenate([chunk[:, list(group.names)].ravel() for chunk in drawn])
    values = values[np.isfinite(values)]
    low, high = group.limits or (np.inf, -np.inf)
    low, high = min(low, values.min(initial=np.inf)), max(high, values.max(initial=-np.inf))
    if low > high:
        return -1.0, 1.0  # nothing to draw
    missing = max(0.2 * max(abs(low), abs(high)) - (high - low), 0) or (0.0 if high > low else 1.0)
    margin = 0.05 * (high - low + missing) + missing / 2
    return float(low - margin), float(high + margin)


def _draw_images(axes: Any, camera_images: dict[str, np.ndarray]) -> None:
    for ax in axes:
        ax.set_axis_off()
    for ax, (camera, camera_image) in zip(axes, camera_images.items(), strict=False):
        ax.imshow(camera_image)
        ax.set_title(as_text(camera), fontsize=9)


def _draw_group(ax: Axes, group: ActionGroup, row: Row) -> None:
    steps = np.arange(len(row.actions))
    dot: dict[str, Any] = {
        "marker": "o",
        "markersize": 4.5 if len(steps) <= 20 else 3,
        "markerfacecolor": "none",
        "linestyle": "",
    }
    broken: dict[str, Any] = {"linestyle": "--", "linewidth": 1.0, "alpha": 0.8}
    handles = []
    for number, (index, name) in enumerate(group.names.items()):
        color = _GRIPPERS.get(name, f"C{number}")
        handles += ax.plot(steps, row.actions[:, index], color=color, linewidth=1.6, label=name)
        if row.oracle is not None:
            ax.plot(steps[: len(row.oracle)], row.oracle[: len(steps), index], color=color, **dot)
        if row.expert is not None:
            ax.plot(steps[: len(row.expert)], row.expert[: len(steps), index], color=color, **broken)
    if row.oracle is not None:
        handles.append(
            Line2D([], [], marker="o", color="0.3", linestyle="", markerfacecolor="none", label=row.legend[0])
        )
    if row.expert is not None:
        handles.append(Line2D([], [], color="0.3", label=row.legend[1], **broken))
    ax.set_title(group.title, fontsize=9)
    ax.set_xlabel("step of the chunk", fontsize=8)
    ax.set_ylabel(group.unit, fontsize=8)
    ax.tick_params(labelsize=8)
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    ax.grid(alpha=0.3)
    ax.legend(handles=handles, fontsize=7, loc="upper left", bbox_to_anchor=(1.0, 1.02), frameon=False)
