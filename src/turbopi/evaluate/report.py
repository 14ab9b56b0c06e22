"""report.html: one page that opens from disk, beside the plots and videos it shows. It loads nothing else."""

import html
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from turbopi.evaluate.plots import write_plots
from turbopi.evaluate.results import Episode, Results, rate
from turbopi.evaluate.statistics import Rate, percentiles
from turbopi.files import write_whole

FILE = "report.html"

STYLE = """
:root { color-scheme: light; --ink: #202124; --faint: #5f6368; --line: #dadce0; --good: #188038; --bad: #b3261e; }
body { font: 15px/1.5 system-ui, sans-serif; color: var(--ink); margin: 2rem auto; max-width: 1080px; padding: 0 1rem; }
h1 { font-size: 1.5rem; margin-bottom: .2rem } h2 { font-size: 1.1rem; margin-top: 2.2rem }
.sub { color: var(--faint); margin-top: 0 }
.note { border-left: 4px solid var(--bad); padding: .4rem .8rem; background: #fdf3f2; }
.cards { display: flex; flex-wrap: wrap; gap: .8rem; margin: 1.2rem 0 }
.card { border: 1px solid var(--line); border-radius: 8px; padding: .6rem 1rem; min-width: 9rem }
.card b { display: block; font-size: 1.45rem; font-variant-numeric: tabular-nums } .card span { color: var(--faint) }
.card small { color: var(--faint) }
table { border-collapse: collapse; width: 100%; font-variant-numeric: tabular-nums }
th, td { text-align: left; padding: .28rem .6rem; border-bottom: 1px solid var(--line); vertical-align: top }
th { color: var(--faint); font-weight: 600 } td.n, th.n { text-align: right } td.n { white-space: nowrap }
.success { color: var(--good) } .failure, .aborted, .crash { color: var(--bad) }
.plots { display: flex; flex-wrap: wrap; gap: 1rem; align-items: flex-start }
img { max-width: 100% } .plots img { max-width: 520px }
.videos { display: grid; grid-template-columns: repeat(auto-fill, minmax(320px, 1fr)); gap: 1rem }
video { width: 100%; border: 1px solid var(--line); border-radius: 6px } figure { margin: 0 }
figcaption { font-size: .85rem } details { margin-top: .6rem } summary { cursor: pointer; color: var(--faint) }
pre { white-space: pre-wrap; font-size: .8rem; background: #f6f7f8; padding: .6rem; border-radius: 6px }
"""

_CSP = "default-src 'none'; style-src 'unsafe-inline'; img-src 'self' file: data:; media-src 'self' file:"


def write_report(results: Results) -> Path:
    """Plots and the page, of whatever episodes there are."""
    plots = write_plots(results)
    path = results.folder / FILE
    write_whole(path, page(f"{results.protocol['suite']}: {results.label}", _body(results, plots)))
    return path


def page(title: str, body: str) -> str:
    """A whole document. `title` is text, `body` is HTML."""
    return (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>{html.escape(title)}</title>'
        f'<meta http-equiv="Content-Security-Policy" content="{_CSP}">'
        f'<meta name="viewport" content="width=device-width, initial-scale=1"><style>{STYLE}</style></head>'
        f"<body>{body}</body></html>\n"
    )


def table(heads: Sequence[str], rows: Iterable[Sequence[str]], *, numbers_from: int = 1) -> str:
    """`heads` are text, the rows' cells are HTML; columns from `numbers_from` on are aligned to the right."""

    def cell(tag: str, index: int, content: str) -> str:
        return f"<{tag}{' class=n' if index >= numbers_from else ''}>{content}</{tag}>"

    head = "".join(cell("th", index, html.escape(text)) for index, text in enumerate(heads))
    body = "".join(f"<tr>{''.join(cell('td', i, c) for i, c in enumerate(row))}</tr>" for row in rows)
    return f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"


def _body(results: Results, plots: Sequence[str]) -> str:
    summary, episodes = results.summary(), results.in_order()
    parts = [
        f"<h1>{html.escape(str(results.protocol['suite']))}</h1>",
        f"<p class=sub>{html.escape(results.label)} · {html.escape(results.started)} · "
        f"{len(episodes)} of {len(results.planned)} episodes</p>",
        *_notes(results, summary),
        _cards(summary, episodes),
        "<h2>Tasks</h2>",
        _task_table(results, episodes),
        "<h2>Plots</h2><div class=plots>" + "".join(f'<img src="{name}" alt="{name}">' for name in plots) + "</div>",
        _videos(results, episodes),
        "<h2>Episodes</h2><details><summary>all episodes</summary>" + _episode_table(episodes) + "</details>",
        "<h2>How it was run</h2>",
        _settings(results),
    ]
    return "\n".join(parts)


def _notes(results: Results, summary: dict[str, Any]) -> list[str]:
    notes = []
    if results.policy.get("about", {}).get("random_weights"):
        notes.append("Random weights: the actions mean nothing.")
    if not results.complete:
        notes.append("The run isn't complete. The same command continues it.")
    if summary["crashes"]:
        notes.append(f"Crashed episodes: {summary['crashes']}. They count neither as success nor as failure.")
    if summary["aborted"]:
        notes.append(f"Aborted, as actions weren't finite: {summary['aborted']} episodes. They count as failures.")
    return [f"<p class=note>{html.escape(note)}</p>" for note in notes]


def _cards(summary: dict[str, Any], episodes: Sequence[Episode]) -> str:
    overall = rate(episodes)
    low, high = overall.interval
    value = "-" if overall.value is None else f"{100 * overall.value:.1f} %"
    cards = [("success", value, f"{overall.successes}/{overall.trials}, 95 %: {100 * low:.1f} to {100 * high:.1f} %")]
    if summary["call_ms"]:
        call = summary["call_ms"]
        batch = summary["mean_batch"]
        batched = f", {batch:.1f} requests at once" if batch > 1.0001 else ""
        cards.append(
            ("a call, median", f"{call['p50']:.1f} ms", f"p95 {call['p95']:.1f}, p99 {call['p99']:.1f}{batched}")
        )
    if summary["infer_ms"]:
        model = summary["infer_ms"]
        cards.append(("the model, median", f"{model['p50']:.1f} ms", f"p95 {model['p95']:.1f}, p99 {model['p99']:.1f}"))
    if summary["steps_to_success"]:
        steps = summary["steps_to_success"]
        cards.append(
            ("steps to success", f"{steps['p50']:.0f}", f"median; mean {steps['mean']:.0f}, most {steps['max']:.0f}")
        )
    inner = "".join(
        f"<div class=card><span>{name}</span><b>{value}</b><small>{more}</small></div>" for name, value, more in cards
    )
    return f"<div class=cards>{inner}</div>"


def _task_table(results: Results, episodes: Sequence[Episode]) -> str:
    rows = []
    for index, task in sorted(results.tasks.items()):
        own = [e for e in episodes if e.task == index]
        if own:
            rows.append([str(index), html.escape(task.instruction), *_rate_cells(own)])
    rows.append(["", "<b>all</b>", *_rate_cells(episodes)])
    heads = ("task", "instruction", "solved", "success", "95 % interval", "steps", "crashed")
    return table(heads, rows, numbers_from=2)


def _rate_cells(episodes: Sequence[Episode]) -> list[str]:
    own: Rate = rate(episodes)
    low, high = own.interval
    steps = percentiles([e.steps for e in episodes if e.success])
    return [
        f"{own.successes}/{own.trials}",
        "-" if own.value is None else f"{100 * own.value:.1f} %",
        f"{100 * low:.1f} to {100 * high:.1f} %" if own.trials else "-",
        f"{steps['p50']:.0f}" if steps else "-",
        str(sum(not e.judged for e in episodes)),
    ]


def _videos(results: Results, episodes: Sequence[Episode]) -> str:
    filmed = [e for e in episodes if e.video]
    if not filmed:
        return ""
    figures = "".join(
        f'<figure><video src="{html.escape(str(e.video))}" controls preload="metadata" muted></video>'
        f"<figcaption><b class={e.status}>{e.status}</b> after {e.steps} steps, task {e.task}, initial state "
        f"{e.initial_state}: {html.escape(results.tasks[e.task].instruction)}</figcaption></figure>"
        for e in sorted(filmed, key=lambda e: (e.success, e.key))
    )
    return f"<h2>Videos</h2><p class=sub>Failures first, then some successes.</p><div class=videos>{figures}</div>"


def _episode_table(episodes: Sequence[Episode]) -> str:
    rows = []
    for e in episodes:
        calls = percentiles(e.call_ms)
        message = f"<pre>{html.escape(e.message)}</pre>" if e.message else ""
        rows.append(
            [
                f"{e.task}",
                f"{e.initial_state}",
                f"<span class={e.status}>{e.status}</span>{message}",
                str(e.steps),
                f"{calls['p50']:.1f}" if calls else "-",
                f"{e.seconds:.1f}",
                str(e.seed),
            ]
        )
    heads = ("task", "initial state", "outcome", "steps", "call, median [ms]", "seconds", "seed")
    return table(heads, rows, numbers_from=3)


def _settings(results: Results) -> str:
    sections = {
        "protocol": results.protocol,
        "policy": results.policy.get("about", {}),
        "options": results.options,
        "versions": results.versions,
    }
    return "".join(
        f"<details{' open' if name == 'protocol' else ''}><summary>{name}</summary>"
        f"{table(('', ''), _rows(value), numbers_from=2)}</details>"
        for name, value in sections.items()
    )


def _rows(value: Any, name: str = "") -> list[list[str]]:
    if isinstance(value, dict):
        return [row for key, item in value.items() for row in _rows(item, f"{name}.{key}" if name else str(key))]
    return [[html.escape(name), html.escape(str(value))]]
