"""Plots of a certificate: errors by layer and by denoising step, each beside its control and what is allowed."""

from collections.abc import Sequence
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from turbopi.support.plots import BOUND, STAGES, as_text, write_figure
from turbopi.verify.document import Certificate, IntermediateDocument, Number

# tensor -> label and colour: the stage's, and a darker one
_BY_LAYER = {"kv_k": ("K", STAGES["prefix"]), "kv_v": ("V", "#8c4a1f")}
_BY_STEP = {"v_t": ("velocity v_t", STAGES["denoise"]), "x_t": ("actions so far x_t", "#2d6a3e")}
_BY_STEP["logits"] = ("logits", STAGES["denoise"])


def write_plots(document: Certificate, folder: Path) -> list[Path]:
    """layers.png and steps.png."""
    return [
        _plot(document, _BY_LAYER, "layer of the prefix", folder / "layers.png"),
        _plot(document, _BY_STEP, "denoising step", folder / "steps.png"),
    ]


def _plot(document: Certificate, names: dict[str, tuple[str, str]], axis: str, path: Path) -> Path:
    figure = Figure(figsize=(9.5, 5), layout="constrained")
    axes = figure.subplots()
    for name, (label, color) in names.items():
        rows = [row for row in document.intermediates if row.name == name]
        at = [row.index for row in rows]
        _line(axes, at, [row.relative_rms for row in rows], color, "-o", label)
        _line(axes, at, [_control(row) for row in rows], color, "--", f"{label}, control")
        erring = [row for row in rows if _control(row) or row.relative_rms]  # x_t begins as the noise itself
        allowed = [row.allowed for row in erring]
        _line(axes, [row.index for row in erring], allowed, color, ":", f"{label}, allowed (informative)")
    if names is _BY_STEP and document.decides == "actions":
        _decisive(axes, document)
    if axes.get_lines():
        axes.set_yscale("log")
        axes.legend(fontsize=8, loc="upper left", bbox_to_anchor=(1, 1), frameon=False)
    else:
        axes.text(
            0.5, 0.5, "no error to draw: all of it is equal, or not finite", ha="center", transform=axes.transAxes
        )
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.grid(alpha=0.3)
    axes.set_xlabel(axis)
    axes.set_ylabel("relative rms of the difference from float32")
    verdict = "PASS" if document.ok else "FAIL"
    title = f"{document.model}, {document.backend} {document.precision}: {verdict}"
    axes.set_title(f"{as_text(title)}\ncontrol: {document.control}", fontsize=10)
    write_figure(path, figure)
    return path


def _decisive(axes: Axes, document: Certificate) -> None:
    """The actions' error where the last step leaves them, and the bound that decides about it."""
    actions = next(row for row in document.intermediates if row.name == "actions")
    _line(axes, [document.steps], [actions.relative_rms], "black", "D", "actions (they decide)")
    if actions.allowed:
        axes.axhline(actions.allowed, color=BOUND, linewidth=1.4, label="bound on the actions")


def _control(row: IntermediateDocument) -> Number:
    return row.control.relative_rms if row.control is not None else 0.0


def _line(axes: Axes, at: Sequence[int | None], values: Sequence[Number], color: str, style: str, label: str) -> None:
    """A line through what a logarithmic axis can show."""
    shown = [(x, y) for x, y in zip(at, values, strict=True) if y is not None and y > 0]
    if shown:
        axes.plot(*zip(*shown, strict=True), style, color=color, markersize=4, label=label)
