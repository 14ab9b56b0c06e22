"""Plots of a certificate: errors by layer and by denoising step, each beside its control."""

from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from turbopi.plots import as_text, write_figure

_BY_LAYER = {"kv_k": "K", "kv_v": "V"}
_BY_STEP = {"v_t": "velocity v_t", "x_t": "actions so far x_t"}


def write_plots(document: dict[str, Any], folder: Path) -> list[Path]:
    """layers.png and steps.png."""
    return [
        _plot(document, _BY_LAYER, "layer of the prefix", folder / "layers.png"),
        _plot(document, _BY_STEP, "denoising step", folder / "steps.png"),
    ]


def _plot(document: dict[str, Any], names: dict[str, str], axis: str, path: Path) -> Path:
    figure = Figure(figsize=(8, 5), layout="constrained")
    axes = figure.subplots()
    for index, (name, label) in enumerate(names.items()):
        rows = [row for row in document["intermediates"] if row["name"] == name]
        at = [row["index"] for row in rows]
        _line(axes, at, [row["relative_rms"] for row in rows], f"C{index}", "-o", label)
        _line(axes, at, [_control(row) for row in rows], f"C{index}", "--", f"{label}, control")
    if axes.get_lines():
        axes.set_yscale("log")
        axes.legend()
    else:
        axes.text(
            0.5, 0.5, "no error to draw: all of it is equal, or not finite", ha="center", transform=axes.transAxes
        )
    axes.set_xlabel(axis)
    axes.set_ylabel("relative rms of the difference from float32")
    verdict = "PASS" if document["ok"] else "FAIL"
    title = f"{document['model']}, {document['backend']} {document['precision']}: {verdict}"
    axes.set_title(f"{as_text(title)}\ncontrol: {document['control']}", fontsize=10)
    write_figure(path, figure)
    return path


def _control(row: dict[str, Any]) -> float:
    return row["control"]["relative_rms"] if row["control"] is not None else 0.0


def _line(axes: Axes, at: list[int], values: list[float], color: str, style: str, label: str) -> None:
    """A line through what a logarithmic axis can show."""
    shown = [(x, y) for x, y in zip(at, values, strict=True) if 0 < y < float("inf")]
    if shown:
        axes.plot(*zip(*shown, strict=True), style, color=color, markersize=4, label=label)
