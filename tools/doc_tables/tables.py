"""The tables themselves: each takes what result files hold and returns Markdown lines."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from kernel_turns.document import MarkedVariant, read_turns
from msgspec.structs import replace
from packed import read_packed_benchmark

from doc_tables.fleet import sizing
from doc_tables.gpus import gpu_predictions, gpu_refusals, gpu_reports, gpus
from doc_tables.peers import peers, read_run
from doc_tables.studies import few_steps, read_report, study
from turbopi.bench.document import BenchDocument, Percentile, Result, all_steps
from turbopi.bench.work import JOINS
from turbopi.support.provenance import Gpu
from turbopi.support.text import significant

STAGES = ("vision", "prefix", "denoise")


def _table(head: Sequence[str], rows: Sequence[Sequence[str]], *, numbers_from: int = 1) -> list[str]:
    rule = "|".join("---" if column < numbers_from else "--:" for column in range(len(head)))
    return ["| " + " | ".join(head) + " |", f"|{rule}|", *("| " + " | ".join(row) + " |" for row in rows)]


def _result(document: BenchDocument, backend: str, precision: str, **job: Any) -> Result | None:
    wanted = replace(document.main_job, **job)
    for result in document.results:
        if (result.backend, result.precision, result.job) == (backend, precision, wanted):
            return result
    return None


def _ms(result: Result | None, name: str = "total", percentile: Percentile = "p50", digits: int = 2) -> str:
    if result is None or name not in result.milliseconds:
        return ""
    return result.milliseconds[name].text(percentile, digits)


def _error(result: Result | None) -> str:
    error = None if result is None else result.error_against_f32
    return significant(error.relative_rms) if error else ""


_MEASURED = (
    ("fused", "fp8"),
    ("fused", "bf16"),
    ("cuda_graph", "bf16"),
    ("pytorch_compile", "bf16"),
    ("pytorch", "bf16"),
)


def _of_main_job(document: BenchDocument) -> list[tuple[str, str, Result]]:
    found = ((backend, precision, _result(document, backend, precision)) for backend, precision in _MEASURED)
    return [(backend, precision, result) for backend, precision, result in found if result is not None]


def headline(document: BenchDocument) -> list[str]:
    """README's: whole call, a chunk of 50, what the hardware allows, error."""
    rows = []
    for backend, precision, result in _of_main_job(document):
        long = _result(document, backend, precision, horizon=50)
        rows.append(
            [
                f"`{backend}` {precision.upper() if precision == 'fp8' else precision}",
                f"**{_ms(result, digits=1)} ms**" if backend == "fused" else f"{_ms(result, digits=1)} ms",
                f"{_ms(long, digits=1)} ms" if long else "",
                f"{result.floor_ms['total']:.1f} ms",
                _error(result),
            ]
        )
    return _table(["", "H = 10", "H = 50", "the hardware's limit", "error"], rows)


def main_job(document: BenchDocument) -> list[str]:
    """Every backend on the job that counts, stage by stage, beside the floor of its precision."""
    rows = []
    floors: set[str] = set()
    for backend, precision, result in _of_main_job(document):
        if precision not in floors:
            floors.add(precision)
            floor = result.floor_ms
            rows.append(
                [f"floor, {precision}", *(f"{floor[stage]:.2f}" for stage in (*STAGES, "total")), "", "", "", "", "1"]
            )
        rows.append(
            [
                f"`{backend}` {precision}",
                *(_ms(result, name) for name in (*STAGES, "device")),
                f"**{_ms(result)}**",
                f"{_ms(result, percentile='p5')} / {_ms(result, percentile='p95')} / {_ms(result, percentile='p99')}",
                f"{result.calls:,}",
                _error(result),
                f"{result.times_floor:.1f}",
            ]
        )
    head = ["ms", *STAGES, "device", "whole call", "p5 / p95 / p99", "calls", "error", "× floor"]
    return _table(head, rows)


def whole_calls(document: BenchDocument) -> list[str]:
    """`fused`: medians of the whole call for every shape, with some numbers of steps."""
    jobs = [result.job for result in document.results if result.backend == "fused"]
    steps = sorted({job.steps for job in jobs} & {1, 3, 10})
    lines: list[str] = []
    for precision in ("bf16", "fp8"):
        rows = []
        for cameras in sorted({job.cameras for job in jobs}):
            for tokens in sorted({job.prompt_tokens for job in jobs}):
                cells = []
                for horizon in sorted({job.horizon for job in jobs}):
                    shape = {"cameras": cameras, "prompt_tokens": tokens, "horizon": horizon}
                    cells.append(
                        " / ".join(_ms(_result(document, "fused", precision, **shape, steps=n)) for n in steps)
                    )
                rows.append([f"{cameras}, {tokens}", *cells])
        some = " / ".join(map(str, steps))
        head = [f"{precision}: cameras, prompt tokens"]
        head += [f"H = {horizon}: {some} steps" for horizon in sorted({job.horizon for job in jobs})]
        lines += [*_table(head, rows), ""]
    return lines[:-1]


def joins(document: BenchDocument) -> list[str]:
    """`fused`: calls of conditioned chunks (`turbopi bench --join`), and in brackets how many times a plain call."""
    kinds = list(dict.fromkeys((one.precision, one.job.horizon) for one in document.results))
    rows, measured = [], {one.job.join for one in document.results}
    for join, name in JOINS.items():
        if join not in measured:
            continue
        row = [name or "plain"]
        for precision, horizon in kinds:
            calls = [_result(document, "fused", precision, horizon=horizon, join=one) for one in (join, "none")]
            ms, plain = (call.milliseconds["total"].p50 for call in calls if call is not None)
            row.append(f"{ms:.2f} ({ms / plain:.2f})")
        rows.append(row)
    return _table(["a chunk is", *(f"{precision}, H = {horizon}" for precision, horizon in kinds)], rows)


def batches(document: BenchDocument) -> list[str]:
    """`fused`: several observations in one call (`turbopi bench --batch`), by horizon."""
    rows = []
    for horizon in sorted({one.job.horizon for one in document.results}):
        for size in sorted({one.job.batch for one in document.results}):
            row = [str(horizon), str(size)]
            for precision in ("bf16", "fp8"):
                found = _result(document, "fused", precision, horizon=horizon, batch=size)
                if found is None:
                    row += ["", "", ""]
                    continue
                rate = 1000 * size / found.milliseconds["total"].p50
                row += [_ms(found), f"{rate:.0f}", f"{found.times_floor:.1f}"]
            rows.append(row)
    head = ["H", "observations", "bf16: ms", "a second", "× floor", "FP8: ms", "a second", "× floor"]
    return _table(head, rows, numbers_from=0)


def errors(document: BenchDocument) -> list[str]:
    """Relative rms of the actions against the float32 reference, by horizon and steps."""
    steps = all_steps(document.results)
    horizons = sorted({result.job.horizon for result in document.results})
    rows = []
    for backend, precision, _ in _of_main_job(document):
        for horizon in horizons:
            cells = [_error(_result(document, backend, precision, horizon=horizon, steps=n)) for n in steps]
            if sum(map(bool, cells)) > 1:  # the main job's own table has the rest
                rows.append([f"`{backend}` {precision}, H = {horizon}", *cells])
    return _table(["", *(f"{n} step{'s' * (n > 1)}" for n in steps)], rows)


def ready(document: BenchDocument) -> list[str]:
    """Seconds from a program's start to its first answer, and the GPU memory that it then holds."""
    rows = []
    for one in document.ready or ():
        for times, said in ((one.cold, "nothing cached"), (one.cached, "kernels cached")):
            rows.append(
                [
                    f"`{one.backend}` {one.precision}, {said}",
                    *(f"{part:.1f}" for part in (times.imports, times.load, times.warmup, times.ready)),
                    f"{(times.device_reserved or 0) / 1e9:.2f} GB",
                ]
            )
    return _table(["seconds", "imports", "weights", "warm-up", "ready", "GPU memory"], rows)


def kernels(document: BenchDocument) -> list[str]:
    """Where the GPU's time goes: the main job under the profiler, kernels of 0.02 ms and more."""
    rows = []
    for one in document.profile or ():
        for stage, part in one.stages.items():
            for kernel in part.kernels:
                if kernel.ms_per_call >= 0.02:
                    name = kernel.kernel.replace("|", "\\|")[:60]
                    rows.append(
                        [
                            f"{one.precision}, {stage}: `{name}`",
                            f"{kernel.launches_per_call:.0f}",
                            f"{kernel.ms_per_call:.2f}",
                            f"{kernel.share:.0%}",
                        ]
                    )
    return _table(["", "launches", "ms", "of the stage"], rows)


def machine(document: BenchDocument) -> list[str]:
    """Where it was measured, in one line."""
    about = document.provenance
    gpu = about.gpu or Gpu()
    floors = "; ".join(
        f"{precision}: {floor.matmul_flops_per_second / 1e12:.0f} TFLOP/s, "
        f"{floor.copy_bytes_per_second / 1e12:.2f} TB/s"
        for precision, floor in document.floors.items()
    )
    return [
        f"{gpu.name}, driver {gpu.driver_version}, torch {about.torch}, {about.date}. "
        f"Measured on the same GPU: {floors}."
    ]


def layer_in_cycles(marks: list[MarkedVariant]) -> list[str]:
    """Where a warp's cycles of a layer go: means over ranks, and a bar a phase for each form's first run in FP8.

    Marks that this warp never passes are left out.
    """
    from turbopi.kernels.sm90.denoise.kernel import FEW, MARKS

    in_fp8 = [one for one in marks if one.precision == "fp8"]
    drawn = [next(one for one in in_fp8 if (one.tokens > FEW) == many) for many in (False, True)]
    rows = []
    for mark, about in MARKS.items():
        means = [sum(one.cycles[mark]) / len(one.cycles[mark]) for one in marks]
        if any(means):
            bars = ["█" * round(means[marks.index(one)] / 150) for one in drawn]
            rows.append([about.replace("|", "\\|"), *(f"{mean:,.0f}" for mean in means), *bars])
    total = [sum(sum(cycles) / len(cycles) for cycles in one.cycles.values()) for one in marks]
    whole = "all of a layer, and 1/18 of what lies between steps"
    rows.append([whole, *(f"{cycles:,.0f}" for cycles in total), "", ""])
    head = [f"{one.tokens} {one.precision}" for one in marks]
    lines = _table(["up to where", *head, *(f"{one.tokens} {one.precision}, drawn" for one in drawn)], rows)
    return [lines[0], lines[1].removesuffix("--:|--:|") + "---|---|", *lines[2:]]


@dataclass(frozen=True)
class Table:
    """A table of one or several result files."""

    read: Callable[[Path], Any]  # a file; raises ValueError for one of another kind
    lines: Callable[..., list[str]]  # of what was read of each file


def _read_nothing(file: Path) -> Any:
    raise ValueError(f"the table takes no result file, but {file.name} is named")


def _read_delays(file: Path) -> Any:
    from turbopi.evaluate.delays import load_delays

    return load_delays(file)


def delays(document: Any) -> list[str]:
    """A policy under delay (`turbopi eval … --delay-steps`): success by delay, and seam jumps with the longest."""
    from turbopi.evaluate.delays import HEADS, row

    cells = [dict(zip(HEADS, row(cell), strict=True)) for cell in document.cells]
    waits = sorted({cell["delay"] for cell in cells}, key=int)
    rows = []
    for execution in dict.fromkeys(cell["execution"] for cell in cells):
        own = {cell["delay"]: cell for cell in cells if cell["execution"] == execution}
        rows.append([execution, *(own[wait]["success [95 %]"] for wait in waits), own[waits[-1]]["seam jump"]])
    head = ["execution", *(f"delay {wait}: success [95 %]" for wait in waits), f"delay {waits[-1]}: seam jump"]
    return _table(head, rows)


def _read_judged(file: Path) -> Any:
    from turbopi_lab.small_policy.judged import load_judged

    return load_judged(file)


def small_policy(document: Any) -> list[str]:
    """The small policy's runs without delay."""
    from turbopi_lab.small_policy.judged import table

    return table(document)


def small_policy_delays(document: Any) -> list[str]:
    """The small policy under delay, by way to run."""
    from turbopi_lab.small_policy.judged import delayed_table

    return delayed_table(document)


def _read_marks(file: Path) -> list[MarkedVariant]:
    """What `python -m kernel_turns time --marks --json` wrote."""
    marks = read_turns(file).marks
    if not marks:
        raise ValueError(f"{file} has no marks: expected what kernel_turns wrote with --marks")
    return marks


_OF_BENCHMARKS = (
    *(headline, main_job, whole_calls, joins, batches),
    *(errors, ready, kernels, machine),
)
TABLES = {
    **{lines.__name__: Table(read_packed_benchmark, lines) for lines in _OF_BENCHMARKS},
    "delays": Table(_read_delays, delays),
    "small_policy": Table(_read_judged, small_policy),
    "small_policy_delays": Table(_read_judged, small_policy_delays),
    "layer_in_cycles": Table(_read_marks, layer_in_cycles),
    **{
        lines.__name__: Table(_read_nothing, lines)
        for lines in (sizing, gpus, gpu_refusals, gpu_reports, gpu_predictions)
    },
    "study": Table(read_report, study),
    "few_steps": Table(read_report, few_steps),
    "peers": Table(read_run, peers),
}
