"""Plots of a benchmark document: stages beside their floors, and latency by the number of steps."""

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

STAGES = {"vision": "#4c72b0", "prefix": "#dd8452", "denoise": "#55a868"}


def label(result: dict[str, Any]) -> str:
    return f"{result['backend']} {result['precision']}"


def job_label(job: dict[str, int]) -> str:
    return f"{job['cameras']} cameras, {job['prompt_tokens']} tokens, H={job['horizon']}, {job['steps']} steps"


def write_plots(document: dict[str, Any], folder: Path) -> list[Path]:
    """stages.png for the job with the most steps, steps.png where several numbers of steps were measured."""
    written = [_stages(document, folder / "stages.png")]
    if len({result["job"]["steps"] for result in document["results"]}) > 1:
        written.append(_steps(document, folder / "steps.png"))
    return written


def _stages(document: dict[str, Any], path: Path) -> Path:
    """One bar a backend, stacked by stage; the floor as a bar of its own."""
    job = max((result["job"] for result in document["results"]), key=lambda job: job["steps"])
    results = [result for result in document["results"] if result["job"] == job]
    figure = Figure(figsize=(9, 1.6 + 0.5 * 2 * len(results)), layout="constrained")
    axes = figure.subplots()
    names: list[str] = []
    for result in results:
        rows = ((label(result), _medians(result)), (f"floor, {result['precision']}", result["floor_ms"]))
        for name, milliseconds in rows:
            if name in names:
                continue
            left = 0.0
            for stage, color in STAGES.items():
                width = milliseconds.get(stage, 0.0)
                axes.barh(name, width, left=left, color=color, label=stage if not names else None)
                left += width
            axes.text(left, len(names), f" {milliseconds['total']:.1f}", va="center")
            names.append(name)
    axes.invert_yaxis()
    axes.set_xlabel("milliseconds on the device, median; the number is the whole call")
    axes.set_title(f"{document['model']}: {job_label(job)}", fontsize=10)
    axes.legend(loc="lower right")
    axes.margins(x=0.12)
    figure.savefig(path, dpi=110)
    return path


def _medians(result: dict[str, Any]) -> dict[str, float]:
    return {stage: values["p50"] for stage, values in result["milliseconds"].items()}


def _steps(document: dict[str, Any], path: Path) -> Path:
    """Median of the whole call by steps, with the line a + b * steps through it."""
    figure = Figure(figsize=(8, 5), layout="constrained")
    axes = figure.subplots()
    series: dict[str, dict[int, float]] = {}
    first = {key: value for key, value in document["results"][0]["job"].items() if key != "steps"}
    for result in document["results"]:
        if {key: value for key, value in result["job"].items() if key != "steps"} == first:
            series.setdefault(label(result), {})[result["job"]["steps"]] = _medians(result)["total"]
    for index, (name, points) in enumerate(series.items()):
        steps, values = np.array(sorted(points)), np.array([points[step] for step in sorted(points)])
        slope, start = np.polyfit(steps, values, 1)
        axes.plot(steps, values, "o", color=f"C{index}", label=f"{name}: {start:.1f} + {slope:.2f} · steps")
        axes.plot([0, steps[-1]], [start, start + slope * steps[-1]], color=f"C{index}", linewidth=1)
    axes.set_xlabel("denoising steps")
    axes.set_ylabel("whole call, median [ms]")
    axes.set_ylim(bottom=0)
    axes.set_title(f"{document['model']}: {job_label({**first, 'steps': 0}).rsplit(',', 1)[0]}", fontsize=10)
    axes.legend()
    figure.savefig(path, dpi=110)
    return path
