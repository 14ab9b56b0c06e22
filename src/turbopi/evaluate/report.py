"""report.html: one page that opens from disk, beside the plots and videos it shows. It loads nothing else."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from turbopi.evaluate.pacing import allows_for_lateness
from turbopi.evaluate.pages import render
from turbopi.evaluate.plots import write_plots
from turbopi.evaluate.results import Episode, Results, Summary, rate
from turbopi.evaluate.statistics import Rate, percentiles
from turbopi.support.files import write_whole

FILE = "report.html"


def write_report(results: Results) -> Path:
    """Plots and the page, of whatever episodes there are."""
    plots = write_plots(results)
    path = results.folder / FILE
    write_whole(path, _page(results, plots))
    return path


def _page(results: Results, plots: Sequence[str]) -> str:
    summary, episodes = results.summary(), results.in_order()
    return render(
        "report.html",
        title=f"{results.suite}: {results.label}",
        suite=results.suite,
        label=results.label,
        started=results.started,
        planned=len(results.planned),
        notes=_notes(results, summary),
        cards=_cards(summary, episodes),
        tasks=_task_rows(results, episodes),
        plots=plots,
        filmed=sorted((e for e in episodes if e.video), key=lambda e: (e.success, e.key)),
        instructions={index: task.instruction for index, task in results.tasks.items()},
        episodes=[(e, _median(e.call_ms)) for e in episodes],
        settings=_settings(results),
    )


def _notes(results: Results, summary: Summary) -> list[str]:
    notes = []
    if results.policy.about.get("random_weights"):
        notes.append("Random weights: the actions mean nothing.")
    if summary.real_time is not None and results.control_hz is not None:
        late = allows_for_lateness(summary.real_time, results.control_hz)
        notes.append(f"In real time, {results.rate}: delays are measured by the wall clock.")
        notes += [] if late is None else [late]
    if not results.complete:
        notes.append("The run isn't complete. The same command continues it.")
    if summary.crashes:
        notes.append(f"Crashed episodes: {summary.crashes}. They count neither as success nor as failure.")
    if summary.aborted:
        notes.append(f"Aborted, as actions weren't finite: {summary.aborted} episodes. They count as failures.")
    return notes


def _cards(summary: Summary, episodes: Sequence[Episode]) -> list[tuple[str, str, str]]:
    """What is read first: name, value, more."""
    overall = rate(episodes)
    low, high = overall.interval
    value = "-" if overall.value is None else f"{100 * overall.value:.1f} %"
    cards = [("success", value, f"{overall.successes}/{overall.trials}, 95 %: {100 * low:.1f} to {100 * high:.1f} %")]
    if (call := summary.call_ms) is not None:
        batch = summary.mean_batch or 1.0
        batched = f", {batch:.1f} requests at once" if batch > 1.0001 else ""
        cards.append(("a call, median", f"{call.p50:.1f} ms", f"p95 {call.p95:.1f}, p99 {call.p99:.1f}{batched}"))
    if (model := summary.infer_ms) is not None:
        cards.append(("the model, median", f"{model.p50:.1f} ms", f"p95 {model.p95:.1f}, p99 {model.p99:.1f}"))
    if (paced := summary.real_time) is not None and (delay := paced.delay_steps) is not None:
        more = f"measured by the wall clock; p95 {delay.p95:.0f}, most {delay.max:.0f}"
        cards.append(("delay, median", f"{delay.p50:.0f} control steps", more))
        dropped = ", ".join(f"{count} {reason}" for reason, count in paced.dropped.items()) or "none"
        cards.append(("chunks dropped", str(sum(paced.dropped.values())), f"{dropped}, of {delay.count} that came"))
    if (steps := summary.steps_to_success) is not None:
        cards.append(("steps to success", f"{steps.p50:.0f}", f"median; mean {steps.mean:.0f}, most {steps.max:.0f}"))
    return cards


def _task_rows(results: Results, episodes: Sequence[Episode]) -> list[list[str]]:
    rows = []
    for index, task in sorted(results.tasks.items()):
        own = [e for e in episodes if e.task == index]
        if own:
            rows.append([str(index), task.instruction, *_rate_cells(own)])
    return [*rows, ["", "all", *_rate_cells(episodes)]]


def _rate_cells(episodes: Sequence[Episode]) -> list[str]:
    own: Rate = rate(episodes)
    low, high = own.interval
    steps = percentiles([e.steps for e in episodes if e.success])
    return [
        f"{own.successes}/{own.trials}",
        "-" if own.value is None else f"{100 * own.value:.1f} %",
        f"{100 * low:.1f} to {100 * high:.1f} %" if own.trials else "-",
        f"{steps.p50:.0f}" if steps else "-",
        str(sum(not e.judged for e in episodes)),
    ]


def _median(values: Sequence[float]) -> str:
    found = percentiles(values)
    return f"{found.p50:.1f}" if found else "-"


def _settings(results: Results) -> list[tuple[str, list[list[str]]]]:
    """Everything that results.json says about how it was run, by section."""
    sections = {
        "protocol": results.protocol,
        "policy": results.policy.about,
        "options": results.options,
        "versions": results.versions,
    }
    return [(name, _rows(value)) for name, value in sections.items()]


def _rows(value: object, name: str = "") -> list[list[str]]:
    if isinstance(value, Mapping):
        return [row for key, item in value.items() for row in _rows(item, f"{name}.{key}" if name else str(key))]
    return [[name, str(value)]]
