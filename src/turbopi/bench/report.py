"""A benchmark document as a page of Markdown tables."""

from collections.abc import Iterable, Sequence
from typing import Any

from turbopi.bench.plots import job_label, label, main_results
from turbopi.wording import significant

_STAGES = ("vision", "prefix", "denoise")


def floors_line(precision: str, floor: dict[str, Any]) -> str:
    """The machine's floors in one line."""
    parts = [
        f"copy {floor['copy_bytes_per_second'] / 1e12:.3f} TB/s",
        f"matrix product {floor['matmul_flops_per_second'] / 1e12:.3f} TFLOP/s",
    ]
    for key, what in (("launch_us", "a launch in a graph"), ("barrier_us", "a barrier of the whole grid")):
        if floor[key] is not None:
            parts.append(f"{what} {floor[key]:.2f} us")
    return f"floors, {precision}: {', '.join(parts)}"


def report(document: dict[str, Any]) -> str:
    """The whole page: where it was measured, the main job, all jobs, lines over steps, start, kernels."""
    about = document["provenance"]
    where = about.get("gpu", {}).get("name") or about.get("cpu", {}).get("name", "CPU")
    lines = [
        f"# {document['model']} on {where}",
        "",
        f"{about['date']}, commit {about['commit']}, torch {about['torch']}, Python {about['python']}; weights: "
        f"{document['weights']}. Milliseconds; every call has new pictures, prompt, state and noise.",
        "",
        *(f"- {floors_line(precision, floor)}" for precision, floor in document["floors"].items()),
        "",
        *(f"**{one['backend']} {one['precision']} failed**: {one['error']}\n" for one in document["failed"]),
        *_main(document),
        *_all(document),
    ]
    lines += _linear(document) + _ready(document) + _profile(document)
    return "\n".join(lines) + "\n"


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    body = ["| " + " | ".join(row) + " |" for row in rows]
    return ["| " + " | ".join(head) + " |", "|" + "---|" * len(head), *body, ""]


def _ms(result: dict[str, Any], name: str, percentile: str = "p50") -> str:
    times = result["milliseconds"].get(name)
    return "-" if times is None else f"{times[percentile]:.2f}"


def error_of(result: dict[str, Any]) -> str:
    """Relative rms against the float32 reference, or a dash."""
    error = result.get("error_against_f32")
    return significant(error["relative_rms"]) if error else "-"


def _main(document: dict[str, Any]) -> list[str]:
    head = ["", *_STAGES, "device", "whole call", "p5", "p95", "p99", "calls", "× floor", "error", "reserved GB"]
    rows = []
    for result in main_results(document):
        reserved = result["memory"].get("device_reserved")
        rows.append(
            [
                label(result),
                *(_ms(result, name) for name in (*_STAGES, "device", "total")),
                *(_ms(result, "total", percentile) for percentile in ("p5", "p95", "p99")),
                str(result["calls"]),
                f"{result['times_floor']:.1f}",
                error_of(result),
                f"{reserved / 1e9:.2f}" if reserved else "-",
            ]
        )
    floor = main_results(document)[0]["floor_ms"]
    rows.insert(0, ["floor", *(f"{floor[name]:.2f}" for name in (*_STAGES, "total")), *["-"] * 8])
    return [f"## {job_label(document['main_job'])}", "", *_table(head, rows), *_clocks(document)]


def _clocks(document: dict[str, Any]) -> list[str]:
    """What the multiprocessors' clock was inside the last denoising kernel of each shape, if they told."""
    told = [
        f"{label(result)} {', '.join(f'{clock} ({shape})' for shape, clock in clocks.items())}"
        for result in document["results"]
        if (clocks := result.get("backend_details", {}).get("denoising_clock_mhz"))
    ]
    said = document["provenance"].get("gpu", {}).get("clocks.sm", "nothing")
    return [f"Clock while denoising, MHz: {'; '.join(told)}. nvidia-smi said {said}.", ""] if told else []


def _all(document: dict[str, Any]) -> list[str]:
    """One table a backend: a row for each shape, a column for each number of steps."""
    steps = sorted({result["job"]["steps"] for result in document["results"]})
    tables: dict[str, dict[str, dict[int, dict[str, Any]]]] = {}
    for result in document["results"]:
        shape = job_label(result["job"]).rsplit(",", 1)[0]
        tables.setdefault(label(result), {}).setdefault(shape, {})[result["job"]["steps"]] = result
    lines = []
    for name, rows in tables.items():
        if len(rows) * len(steps) == 1:
            continue

        def cells(by_steps: dict[int, dict[str, Any]]) -> list[str]:
            return [
                f"{_ms(by_steps[n], 'total')} ({_ms(by_steps[n], 'total', 'p95')})" if n in by_steps else "-"
                for n in steps
            ]

        head = ["steps", *map(str, steps)]
        lines += [f"## {name}: whole call, median (p95)", ""]
        lines += _table(head, ([shape, *cells(by_steps)] for shape, by_steps in rows.items()))
    return lines


def _linear(document: dict[str, Any]) -> list[str]:
    rows = [
        [
            label(line),
            f"{line['cameras']} cameras, {line['prompt_tokens']} tokens, H={line['horizon']}",
            f"{line['a_ms']:.2f} + {line['b_ms']:.3f} · steps",
            f"{line['worst_ms']:.2f}",
        ]
        for line in document["linear"]
    ]
    return ["## The whole call as a line", "", *_table(["", "", "ms", "off by"], rows)] if rows else []


def _ready(document: dict[str, Any]) -> list[str]:
    rows = [
        [one["backend"], kind, *(f"{one[kind][part]:.1f}" for part in ("import", "load", "warmup", "ready"))]
        for one in document.get("ready", ())
        for kind in ("cold", "cached")
    ]
    head = ["", "kernels", "import", "load", "warm-up, every prompt length", "ready"]
    return ["## Seconds from a program's start to its first answer", "", *_table(head, rows)] if rows else []


def _profile(document: dict[str, Any]) -> list[str]:
    lines = []
    for one in document.get("profile", ()):
        for stage, part in one["stages"].items():
            title = f"{label(one)}, {stage}: {part['busy_ms']:.2f} ms in {part['launches']:.0f} launches"
            rows = [
                [
                    f"`{kernel['kernel'][:100]}`",
                    f"{kernel['ms_per_call']:.3f}",
                    f"{kernel['launches_per_call']:.0f}",
                    f"{kernel['share']:.1%}",
                ]
                for kernel in part["kernels"]
            ]
            lines += [f"### {title}", "", *_table(["kernel", "ms", "launches", "share"], rows)]
    return ["## Kernels (under the profiler)", "", *lines] if lines else []
