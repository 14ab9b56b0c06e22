"""Images of action chunks, as PNG files, and the colours of all plots: one colour for one thing."""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from turbopi.support.action_groups import ActionGroup, action_groups
from turbopi.support.errors import ConfigError
from turbopi.support.files import write_whole

_DPI = 110
_NEAR = 0.25  # widths of a training range: beyond, a value is outside
STAGES = {"vision": "#4c72b0", "prefix": "#dd8452", "denoise": "#55a868"}
MEASURED, SOLVED, BOUND, MUTED = "#3b6fb6", "#2f8f5b", "#b00020", "#9aa0a6"
_GRIPPERS = {"gripper": "C9", "left": "C9", "right": "C8"}  # as no axis and no joint, which have C0 to C7


class Range(Protocol):
    """Where the training data lie: float64[d] each, and (name, unit) of each dimension."""

    @property
    def labels(self) -> Sequence[tuple[str, str]]: ...
    @property
    def low(self) -> np.ndarray: ...
    @property
    def high(self) -> np.ndarray: ...


@dataclass(frozen=True)
class Row:
    """One observation and its chunk [H, d]; `oracle` is drawn as dots on its lines, `expert` as broken lines.

    legend   what those two are called
    state  of the robot, float[s]
    """

    heading: str
    camera_images: dict[str, np.ndarray]  # camera -> [h, w, 3]
    actions: np.ndarray
    oracle: np.ndarray | None = None
    expert: np.ndarray | None = None
    state: np.ndarray | None = None
    legend: tuple[str, str] = ("float32 reference", "expert")


def plot_chunks(
    file: Path,
    rows: Sequence[Row],
    *,
    robot: str,
    title: str,
    random_weights: bool,
    names: Sequence[str] | None = None,
    state_range: Range | None = None,
    action_range: Range | None = None,
) -> None:
    """Write a PNG with one row an observation: its images, its state, then its action chunk by groups of one unit.

    A group's axis is the same in every row. The state is drawn where its training range is known; that of an action is
    a bar behind the last step; `names` as for `action_groups`. Raises as `write_figure` does.
    """
    if names is None and action_range is not None:
        names = [name for name, _ in action_range.labels]
    groups = action_groups(robot, rows[0].actions.shape[1], names)
    num_images = max(len(row.camera_images) for row in rows)
    limits = [_limits(group, rows, action_range) for group in groups]
    drawn_state = state_range if state_range is not None and len(state_range.low) else None
    panels = num_images + (drawn_state is not None)
    widths = [1.0] * num_images + [1.3] * (panels - num_images) + [1.45] * len(groups)
    figure = Figure(figsize=(0.8 + 2.45 * sum(widths), 0.9 + 2.75 * len(rows)), dpi=_DPI, layout="constrained")
    if random_weights:
        title += "\nrandom weights: the actions mean nothing"
    figure.suptitle(as_text(title), fontsize=14, fontweight="bold", color=BOUND if random_weights else "black")
    for row, panel in zip(rows, np.atleast_1d(np.array(figure.subfigures(len(rows), 1))), strict=True):
        panel.suptitle(as_text(row.heading), fontsize=10.5, x=0.01, ha="left")
        axes = np.atleast_1d(panel.subplots(1, panels + len(groups), width_ratios=widths))
        _draw_images(axes[:num_images], row.camera_images)
        if drawn_state is not None and row.state is not None:
            _draw_state(axes[num_images], drawn_state, row.state)
        for ax, group, span in zip(axes[panels:], groups, limits, strict=True):
            _draw_group(ax, group, row, action_range)
            ax.set_ylim(span)
    write_figure(file, figure)


def write_figure(file: Path, figure: Figure, dpi: int = _DPI, *, about: Mapping[str, str] | None = None) -> None:
    """Write a figure in the format that the file's ending names, whole or not at all. A PNG holds the texts `about`.

    Raises ConfigError for an unknown ending, OutputError if the file can't be written.
    """
    try:
        kind = file.suffix.removeprefix(".") or "png"
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "Glyph .* missing from", UserWarning)  # a prompt's: it is drawn as a box
            write_whole(file, lambda stream: figure.savefig(stream, dpi=dpi, format=kind, metadata=about))
    except ValueError as error:
        raise ConfigError(f"can't write the plot {file}: {error}") from error


def as_text(text: str) -> str:
    """`text` for a figure, where a pair of dollar signs would begin a formula: a prompt's or a label's don't."""
    return text.replace("$", r"\$")


def _limits(group: ActionGroup, rows: Sequence[Row], known: Range | None) -> tuple[float, float]:
    """What a group's axis shows: its limits, and whatever is beyond them, of all rows and of the training range.

    Not less than a fifth of the largest: noise on a constant stays small.
    """
    drawn = [chunk for row in rows for chunk in (row.actions, row.oracle, row.expert) if chunk is not None]
    values = np.concatenate([chunk[:, list(group.names)].ravel() for chunk in drawn])
    if known is not None:
        of_group = [index for index in group.names if index < len(known.low)]
        values = np.concatenate([values, known.low[of_group], known.high[of_group]])
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


def _draw_state(ax: Axes, known: Range, state: np.ndarray) -> None:
    """Each value where it lies in its training range, which reaches from 0 to 1 on this axis, and what it is."""
    few = min(len(state), len(known.low))
    low, width = known.low[:few], known.high[:few] - known.low[:few]
    place = np.divide(state[:few] - low, width, out=np.full(few, 0.5), where=width > 0)
    places = np.arange(few)
    ax.barh(places, 1.0, color="0.85", height=0.7)
    for at, where in enumerate(place):
        off = not -_NEAR <= where <= 1 + _NEAR
        ax.plot(np.clip(where, -1, 2), at, marker="o" if -1 <= where <= 2 else "X", color=BOUND if off else MEASURED)
    texts = [
        f"{name}  {value:.3g} {unit if len(unit) < 6 else ''}".rstrip()
        for (name, unit), value in zip(known.labels, state[:few], strict=False)
    ]
    ax.set_yticks(places, [as_text(text) for text in texts], fontsize=7)
    ax.set_xticks([0, 1], ["low", "high"], fontsize=8)
    ax.set_xlim(-1.15, 2.15)
    ax.invert_yaxis()
    ax.set_title("state, in the training range", fontsize=9)


def _draw_group(ax: Axes, group: ActionGroup, row: Row, known: Range | None) -> None:
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
        if known is not None and index < len(known.low):
            behind = len(steps) + 0.02 * len(steps) * (number + 1)
            ax.plot([behind] * 2, [known.low[index], known.high[index]], color=color, linewidth=3, alpha=0.5)
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
