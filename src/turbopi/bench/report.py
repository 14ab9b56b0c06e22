"""A benchmark document as a page of Markdown tables."""

from collections.abc import Iterable, Mapping, Sequence

from turbopi.bench.document import BenchDocument, Percentile, Result, all_steps, label
from turbopi.bench.machine_limits import Floors
from turbopi.support.text import significant

_STAGES = ("vision", "prefix", "denoise")
PERCENTILES: tuple[Percentile, ...] = ("p5", "p95", "p99")


def floors_line(precision: str, floor: Floors) -> str:
    """The machine's floors in one line."""
    parts = [
        f"copy {_rate(floor.copy_bytes_per_second)}B/s",
        f"matmul {_rate(floor.matmul_flops_per_second)}FLOP/s",
    ]
    for took, what in ((floor.launch_us, "a launch in a graph"), (floor.barrier_us, "a barrier of the whole grid")):
        if took is not None:
            parts.append(f"{what} {took:.2f} us")
    return f"floors, {precision}: {', '.join(parts)}"


def _rate(per_second: float) -> str:
    """In tera, or of a CPU in giga: "1404 T", "15.0 G"."""
    unit, size = ("T", 1e12) if per_second >= 1e11 else ("G", 1e9)
    value = per_second / size
    return f"{significant(value) if value < 100 else format(value, '.0f')} {unit}"


def report(document: BenchDocument) -> str:
    """The whole page: where it was measured, the main job, all jobs, lines over steps, start, kernels."""
    about = document.provenance
    lines = [
        f"# {document.model} on {about.device_name}",
        "",
        f"{about.date}, commit {about.commit}, torch {about.torch}, Python {about.python}; weights: "
        f"{document.weights}. Milliseconds; every call has new images, prompt, state and noise."
        + (f" Solver {document.solver}." if document.solver else "")
        + (f" Time grid {document.time_grid}." if document.time_grid else ""),
        "",
        *(f"- {floors_line(precision, floor)}" for precision, floor in document.floors.items()),
        "",
        *(f"**{label(one)} failed**: {one.error}\n" for one in document.failed),
        *(f"**Warning:** {text}\n" for text in document.warnings or ()),
        *_main(document),
        *_all(document),
    ]
    lines += _linear(document) + _ready(document) + _profile(document)
    return "\n".join(lines) + "\n"


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    body = ["| " + " | ".join(row) + " |" for row in rows]
    return ["| " + " | ".join(head) + " |", "|" + "---|" * len(head), *body, ""]


def _ms(result: Result, name: str, percentile: Percentile = "p50") -> str:
    times = result.milliseconds.get(name)
    return "-" if times is None else times.text(percentile)


def error_of(result: Result) -> str:
    """Relative rms against the float32 reference, or a dash."""
    error = result.error_against_f32
    return significant(error.relative_rms) if error else "-"


def _main(document: BenchDocument) -> list[str]:
    head = ["", *_STAGES, "device", "whole call", "p5", "p95", "p99", "calls", "× floor", "error", "reserved GB"]
    rows = []
    for result in document.main_results:
        reserved = result.memory.device_reserved
        rows.append(
            [
                label(result),
                *(_ms(result, name) for name in (*_STAGES, "device", "total")),
                *(_ms(result, "total", percentile) for percentile in PERCENTILES),
                str(result.calls),
                f"{result.times_floor:.1f}",
                error_of(result),
                f"{reserved / 1e9:.2f}" if reserved else "-",
            ]
        )
    floor = document.main_results[0].floor_ms
    rows.insert(0, ["floor", *(f"{floor[name]:.2f}" for name in (*_STAGES, "total")), *["-"] * 8])
    return [f"## {document.main_job}", "", *_table(head, rows), *_clocks(document)]


def _clocks(document: BenchDocument) -> list[str]:
    """What the multiprocessors' clock was inside the last denoising kernel of each shape, if they told."""
    reported = [
        f"{label(result)} {', '.join(f'{clock} ({shape})' for shape, clock in clocks.items())}"
        for result in document.results
        if isinstance(clocks := (result.backend_details or {}).get("denoising_clock_mhz"), Mapping) and clocks
    ]
    gpu = document.provenance.gpu
    said = (gpu.clock_sm if gpu else None) or "nothing"
    return [f"Clock while denoising, MHz: {'; '.join(reported)}. nvidia-smi said {said}.", ""] if reported else []


def _all(document: BenchDocument) -> list[str]:
    """One table a backend: a row for each shape, a column for each number of steps."""
    steps = all_steps(document.results)
    tables: dict[str, dict[str, dict[int, Result]]] = {}
    for result in document.results:
        shape = str(result.job).rsplit(",", 1)[0]
        tables.setdefault(label(result), {}).setdefault(shape, {})[result.job.steps] = result
    lines = []
    for name, rows in tables.items():
        if len(rows) * len(steps) == 1:
            continue

        def cells(by_steps: dict[int, Result]) -> list[str]:
            return [
                f"{_ms(by_steps[n], 'total')} ({_ms(by_steps[n], 'total', 'p95')})" if n in by_steps else "-"
                for n in steps
            ]

        head = [document.main_job.unit, *map(str, steps)]
        lines += [f"## {name}: whole call, median (p95)", ""]
        lines += _table(head, ([shape, *cells(by_steps)] for shape, by_steps in rows.items()))
    return lines


def _linear(document: BenchDocument) -> list[str]:
    main = document.main_job
    rows = [
        [
            label(line),
            f"{line.cameras} cameras, {line.prompt_tokens} tokens" + (main.of_horizon and f", H={line.horizon}"),
            f"{line.a_ms:.2f} + {line.b_ms:.3f} · {main.unit}",
            f"{line.worst_ms:.2f}",
        ]
        for line in document.linear or ()
    ]
    return ["## The whole call as a line", "", *_table(["", "", "ms", "off by"], rows)] if rows else []


def _ready(document: BenchDocument) -> list[str]:
    rows = [
        [one.backend, kind, *(f"{seconds:.1f}" for seconds in (took.imports, took.load, took.warmup, took.ready))]
        for one in document.ready or ()
        for kind, took in (("cold", one.cold), ("cached", one.cached))
    ]
    head = ["", "kernels", "import", "load", "warm-up, every prompt length", "ready"]
    return ["## Seconds from a program's start to its first answer", "", *_table(head, rows)] if rows else []


def _profile(document: BenchDocument) -> list[str]:
    lines = []
    for one in document.profile or ():
        for stage, part in one.stages.items():
            title = f"{label(one)}, {stage}: {part.busy_ms:.2f} ms in {part.launches:.0f} launches"
            rows = [
                [
                    f"`{kernel.kernel[:100]}`",
                    f"{kernel.ms_per_call:.3f}",
                    f"{kernel.launches_per_call:.0f}",
                    f"{kernel.share:.1%}",
                ]
                for kernel in part.kernels
            ]
            lines += [f"### {title}", "", *_table(["kernel", "ms", "launches", "share"], rows)]
    return ["## Kernels (under the profiler)", "", *lines] if lines else []
