"""Plots of a benchmark document: stages beside their floors, latency by the number of steps, the roofline."""

import hashlib
import json
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from turbopi.bench.document import BenchDocument, Line, Result, Times, all_steps, label
from turbopi.bench.summary import below_floor
from turbopi.support.plots import BOUND, STAGES, as_text, write_figure
from turbopi.support.reading import as_document, plain_document

DRAWN_OF = "Drawn of"  # the PNG text in which a plot names its document


def fingerprint(document: BenchDocument) -> str:
    """What tells this document from another one: a SHA-256 of its values, whatever their order in the file."""
    read_again = plain_document(as_document(plain_document(document), BenchDocument, "a benchmark"))
    return hashlib.sha256(json.dumps(read_again, sort_keys=True).encode()).hexdigest()


def write_plots(document: BenchDocument, folder: Path) -> list[Path]:
    """stages.png and roofline.png of the main job, steps.png where several numbers of steps were measured."""
    plots = {"stages.png": _stages, "roofline.png": _roofline}
    if len(all_steps(document.results)) > 1:
        plots["steps.png"] = _steps
    for name, draw in plots.items():
        write_figure(folder / name, draw(document), about={DRAWN_OF: fingerprint(document)})
    return [folder / name for name in plots]


def _stages(document: BenchDocument) -> Figure:
    """One bar a backend, stacked by stage; the floor as a bar of its own."""
    job, results = document.main_job, document.main_results
    figure = Figure(figsize=(9, 1.6 + 0.5 * 2 * len(results)), layout="constrained")
    axes = figure.subplots()
    names: list[str] = []
    cut = _axis_end([result.milliseconds["total"] for result in results])
    for result in results:
        rows = ((label(result), _medians(result)), (f"floor, {result.precision}", result.floor_ms))
        for name, milliseconds in rows:
            if name in names:
                continue
            left = 0.0
            for stage, color in STAGES.items():
                width = milliseconds.get(stage, 0.0)
                axes.barh(name, width, left=left, color=color, label=stage if not names else None)
                left += width
            end = max(left, milliseconds["total"])
            if name == label(result):  # the whole call, and its 5th and 95th percentile
                total = result.milliseconds["total"]
                sides = [[max(end - _low(total), 0)], [max(total.p95 - end, 0)]]
                axes.errorbar(end, len(names), xerr=sides, fmt="|", color="black", capsize=3)
                end = max(end, total.p95)
            if end < cut:
                axes.text(end, len(names), f"  {milliseconds['total']:.1f}", va="center")
            else:
                axes.text(cut, len(names), f"{milliseconds['total']:.1f} →  ", va="center", ha="right", color="white")
            names.append(name)
    axes.invert_yaxis()
    axes.set_xlim(0, cut)
    axes.set_xlabel("milliseconds on the device, medians; number and whiskers: the whole call, p5 to p95")
    axes.set_title(f"{as_text(document.model)}: {job}", fontsize=10)
    axes.legend(loc="upper left", bbox_to_anchor=(1, 1))
    return figure


def _low(times: Times) -> float:
    return times.p50 if times.p5 is None else times.p5


def _axis_end(totals: list[Times]) -> float:
    """Where the axis ends: behind all bars, or, if one is many times as long as all others, behind those."""
    by_median = sorted(totals, key=lambda total: total.p50)
    longest = by_median[-1]
    if len(by_median) > 1 and longest.p50 > 4 * by_median[-2].p50:
        longest = by_median[-2]
    return 1.12 * max(longest.p50, longest.p95)


def _medians(result: Result) -> dict[str, float]:
    return {stage: values.p50 for stage, values in result.milliseconds.items()}


def _steps(document: BenchDocument) -> Figure:
    """Median of the whole call by steps (bars: 5th to 95th percentile), with the line a + b * steps through it."""
    figure = Figure(figsize=(8, 5), layout="constrained")
    axes = figure.subplots()
    main = document.main_job
    shape = (main.cameras, main.prompt_tokens)
    lines = [line for line in document.linear or () if (line.cameras, line.prompt_tokens) == shape]
    for index, line in enumerate(lines):
        results = [result for result in document.results if _is_of(result, line)]
        steps = np.array([result.job.steps for result in results])
        total = [result.milliseconds["total"] for result in results]
        median = np.array([one.p50 for one in total])
        spread = [median - [_low(one) for one in total], np.array([one.p95 for one in total]) - median]
        shaped = main.of_horizon and f", H={line.horizon}"
        text = f"{label(line)}{shaped}: {line.a_ms:.2f} + {line.b_ms:.3f} · {main.unit}"
        axes.errorbar(steps, median, np.maximum(spread, 0), fmt="o", color=f"C{index}", capsize=3, label=text)
        ends = np.array([0, steps.max()])
        axes.plot(ends, line.a_ms + line.b_ms * ends, color=f"C{index}", linewidth=1)
    axes.set_xlabel(main.unit if main.writes_tokens else "denoising steps")
    axes.set_ylabel("whole call, median [ms]")
    axes.set_ylim(bottom=0)
    axes.set_title(f"{as_text(document.model)}: {main.cameras} cameras, {main.prompt_tokens} tokens", fontsize=10)
    axes.legend()
    return figure


def _is_of(result: Result, line: Line) -> bool:
    job = result.job
    shape = (job.cameras, job.prompt_tokens, job.horizon) == (line.cameras, line.prompt_tokens, line.horizon)
    return shape and (result.backend, result.precision) == (line.backend, line.precision)


def _roofline(document: BenchDocument) -> Figure:
    """Each stage's rate over its operations a byte, below what bandwidth and matrix rate allow."""
    figure = Figure(figsize=(8, 5), layout="constrained")
    axes = figure.subplots()
    intensities = np.logspace(0, 4, 200)
    for index, (precision, floor) in enumerate(document.floors.items()):
        rate, bandwidth = floor.matmul_flops_per_second, floor.copy_bytes_per_second
        roof = np.minimum(intensities * bandwidth, rate) / 1e12
        text = f"{precision}: {rate / 1e12:.3g} TFLOP/s, {bandwidth / 1e12:.3g} TB/s"
        axes.loglog(intensities, roof, color="0.3", linestyle=("-", "--", ":")[index % 3], label=text)
    for marker, result in zip("osD^vP*X", document.main_results, strict=False):
        for stage, color in STAGES.items():
            if stage not in result.milliseconds or result.work is None:
                continue
            work, seconds = result.work[stage], result.milliseconds[stage].p50 / 1e3
            x, y = work.flops / work.bytes, work.flops / seconds / 1e12
            axes.loglog(x, y, marker, color=color, markersize=8)
            if stage in below_floor(result):
                axes.loglog(x, y, "o", color=BOUND, markersize=16, markerfacecolor="none", markeredgewidth=1.6)
        axes.loglog([], [], marker, color="0.6", label=label(result))
    for stage, color in STAGES.items():
        axes.loglog([], [], "s", color=color, label=stage)
    if any(map(below_floor, document.main_results)):
        text = "above the roof: the machine was busy\nwhile the floors were measured"
        axes.loglog([], [], "o", color=BOUND, markersize=12, markerfacecolor="none", label=text)
    axes.set_xlabel("least operations / least bytes [FLOP/byte]")
    axes.set_ylabel("least operations / median time [TFLOP/s]")
    axes.set_title(f"{as_text(document.model)}: {document.main_job}", fontsize=10)
    axes.legend(fontsize=8)
    return figure
