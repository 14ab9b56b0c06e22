"""Plots of a replay: errors by index, errors of each joint, one episode, and the worst moments."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from turbopi.replay.compare import Compared
from turbopi.replay.document import Control, PolicyDocument, Worst
from turbopi.support.action_groups import images_of
from turbopi.support.plots import BOUND, MEASURED, MUTED, SOLVED, Row, as_text, plot_chunks, write_figure

COLOURS = (MEASURED, SOLVED)  # the first policy's, the second's
STYLES = ("-", "--", ":")  # of controls
MOST_CHUNKS = 40  # of an episode that is drawn
_SMALL: dict[str, Any] = {"fontsize": 8}


def plot_by_index(file: Path, policies: Sequence[PolicyDocument], controls: Sequence[Control]) -> None:
    """Mean relative error of a chunk's first action, its second, …, beside the controls."""
    figure = Figure(figsize=(7, 4), layout="constrained")
    ax = figure.subplots()
    for policy, colour in zip(policies, COLOURS, strict=False):
        steps = np.arange(len(policy.by_index))
        means = [one.mean for one in policy.by_index]
        ax.plot(steps, means, color=colour, linewidth=2, marker="o", markersize=3, label=as_text(policy.label))
        if policy is policies[0]:
            upper = [one.p95 for one in policy.by_index]
            ax.fill_between(steps, means, upper, color=colour, alpha=0.12, label="to its 95 %")
    for control, style in zip(controls, STYLES, strict=False):
        ax.plot(control.by_index, color=BOUND, linestyle=style, linewidth=1.3, label=control.name)
    ax.set_xlabel("index in the chunk")
    ax.set_ylabel("error, in units of the normalised actions")
    ax.set_ylim(bottom=0)
    _finish(ax)
    ax.legend(frameon=False, **_SMALL)
    write_figure(file, figure)


def plot_joints(file: Path, policies: Sequence[PolicyDocument]) -> None:
    """Each joint's error by index, in its own unit: mean, and to its 95 %."""
    joints = policies[0].joints
    figure, axes = _grid(len(joints))
    for number, (ax, joint) in enumerate(zip(axes, joints, strict=False)):
        for policy, colour in zip(policies, COLOURS, strict=False):
            by_index = policy.joints[number].by_index
            steps, means = np.arange(len(by_index)), [one.mean for one in by_index]
            ax.plot(steps, means, color=colour, linewidth=1.5, label=as_text(policy.label))
            if policy is policies[0]:
                ax.fill_between(steps, means, [one.p95 for one in by_index], color=colour, alpha=0.12)
        ax.set_title(as_text(f"{joint.name} [{joint.unit}]"), **_SMALL)
        ax.set_ylim(bottom=0)
        _finish(ax)
    if len(policies) > 1:
        axes[0].legend(frameon=False, fontsize=7)
    write_figure(file, figure)


def plot_episode(file: Path, compared: Sequence[Compared], joints: Sequence[tuple[str, str]]) -> str:
    """What was recorded in the episode with most moments, and what was predicted there. Returns its name."""
    moments = compared[0].run.moments
    numbers = [episode.number for episode, _ in moments]
    chosen = max(dict.fromkeys(numbers), key=numbers.count)
    rows = [row for row, number in enumerate(numbers) if number == chosen][:MOST_CHUNKS]
    figure, axes = _grid(len(joints))
    for index, (ax, (name, unit)) in enumerate(zip(axes, joints, strict=False)):
        for row in rows:
            step = moments[row][1]
            recorded = compared[0].run.recorded[row, :, index]
            ax.plot(step + np.arange(len(recorded)), recorded, color="0.2", linewidth=2.2, alpha=0.5)
            for one, colour in zip(compared, COLOURS, strict=False):
                chunk = one.run.predicted[row, :, index]
                ax.plot(step + np.arange(len(chunk)), chunk, color=colour, linewidth=1.0)
        ax.set_title(as_text(f"{name} [{unit}]"), **_SMALL)
        _finish(ax)
    axes[0].plot([], [], color="0.2", linewidth=2.2, alpha=0.5, label="recorded")
    for one, colour in zip(compared, COLOURS, strict=False):
        axes[0].plot([], [], color=colour, label=as_text(one.label))
    axes[0].legend(frameon=False, fontsize=7)
    write_figure(file, figure)
    return moments[rows[0]][0].name


def plot_worst(
    file: Path,
    compared: Sequence[Compared],
    rows: Sequence[int],
    worst: Sequence[Worst],
    observations: Sequence[Mapping[str, Any]],
    names: Sequence[str],
) -> None:
    """The moments with the largest errors: images, chunks, and as broken lines what was recorded."""
    first = compared[0]
    second = compared[1] if len(compared) > 1 else None
    drawn = []
    for row, one, observation in zip(rows, worst, observations, strict=True):
        recorded = first.run.recorded[row]
        drawn.append(
            Row(
                f"episode {one.episode}, step {one.step}: error {one.relative:.3g}    “{one.prompt}”",
                images_of(observation),
                first.run.predicted[row],
                oracle=None if second is None else second.run.predicted[row],
                expert=recorded[np.isfinite(recorded).all(1)],
                legend=("" if second is None else second.label, "recorded"),
            )
        )
    about = first.run.about
    plot_chunks(
        file,
        drawn,
        robot=str(about["robot"]),
        title="where predicted and recorded actions differ most",
        random_weights=bool(about["random_weights"]),
        names=names,
    )


def _grid(count: int) -> tuple[Figure, list[Any]]:
    """A figure with one plot a joint."""
    columns = min(4, count)
    rows = -(-count // columns)
    figure = Figure(figsize=(2.9 * columns, 2.1 * rows), layout="constrained")
    axes = list(np.atleast_1d(figure.subplots(rows, columns)).ravel())
    for ax in axes[count:]:
        ax.set_axis_off()
    return figure, axes[:count]


def _finish(ax: Any) -> None:
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    ax.grid(alpha=0.3, color=MUTED)
    ax.tick_params(labelsize=8)
