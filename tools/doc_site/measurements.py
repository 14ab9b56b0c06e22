"""The page of all measured calls: a row for each, with a filter, each with a link to its raw file."""

from collections.abc import Iterator
from pathlib import Path

from doc_tables import peers
from doc_tables.measured import kernels_of
from doc_tables.results import RESULTS, result_files
from packed import read_packed_benchmark

from turbopi.bench.document import BenchDocument
from turbopi.support.errors import ConfigError
from turbopi.support.text import significant

DOCUMENT = "docs/measurements.md"
FILTERS = ("GPU", "model", "program", "precision", "H", "batch")
_COLUMNS = (
    *("GPU", "model", "program", "precision", "cameras", "prompt tokens", "H", "steps", "batch", "a chunk is"),
    *("whole call, ms", "95th percentile", "on the GPU, ms", "× floor", "error", "raw file"),
)
_INTRODUCTION = """---
hide: [navigation, toc]
---

# Every measured call

Each row is a measurement that is checked in; the last column is its raw file, as the program wrote it. Times are
medians. How they are measured, and what the columns mean: [Performance](performance.md). Which command wrote which
file: [Results](../benchmarks/results/README.md). Tables that `turbopi bench` printed for other model families:
[h200_2026-11-29_families](../benchmarks/results/h200_2026-11-29_families). "On the GPU" of other programs: from
inputs on the GPU to actions on the GPU.
"""
_STYLE = "<style>.md-grid {max-width: none} #measurements :is(td, th) {padding: 0.2em 0.7em; min-width: 0}</style>"


def measurements(root: Path) -> str:
    """The page's text. A result file that holds no benchmark isn't in it."""
    rows = [*_ours(root), *_others(root)]
    table = [f"| {' | '.join(_COLUMNS)} |", f"|{'---|' * len(_COLUMNS)}", *(f"| {' | '.join(row)} |" for row in rows)]
    script = (Path(__file__).parent / "filter.js").read_text(encoding="utf-8")
    wanted = " ".join(str(_COLUMNS.index(name)) for name in FILTERS)
    return (
        f'{_INTRODUCTION}\n{_STYLE}\n\n<div id="measurements" data-filters="{wanted}" markdown>\n\n'
        + "\n".join(table)
        + f"\n\n</div>\n\n<script>\n{script}</script>\n"
    )


def _link(root: Path, file: Path) -> str:
    return f"[{file.relative_to(root / RESULTS)}](../{file.relative_to(root).as_posix()})"


def _ours(root: Path) -> Iterator[list[str]]:
    kernels = kernels_of(root)
    for file in sorted(file for end in ("json", "json.xz") for file in (root / RESULTS).rglob(f"*.{end}")):
        try:
            document = read_packed_benchmark(file)
        except ConfigError:
            continue  # another kind of result
        portable = "portable" in kernels.get(file.relative_to(root / RESULTS).as_posix(), {}).values()
        yield from _of_document(document, ", portable kernels" * portable, _link(root, file))


def _of_document(document: BenchDocument, kernels: str, link: str) -> Iterator[list[str]]:
    gpu = document.provenance.device_name
    model = document.model if document.random_weights else f"{document.weights} ({document.model})"
    for result in document.results:
        job, total, device = result.job, result.milliseconds["total"], result.milliseconds.get("device")
        error = result.error_against_f32
        yield [
            *(gpu, model, f"Turbo-Pi `{result.backend}`{kernels}", result.precision),
            *(f"{job.cameras}{job.of_size}", str(job.prompt_tokens), str(job.horizon), str(job.steps)),
            *(str(job.batch), job.joined.removeprefix(", ") or "plain", total.text(), total.text("p95")),
            *(device.text() if device else "", f"{result.times_floor:.1f}"),
            *(significant(error.relative_rms) if error else "", link),
        ]


def _others(root: Path) -> Iterator[list[str]]:
    """Other programs' medians, of the job that README compares: Pi0.5, 2 cameras, 48 prompt tokens, 10 steps."""
    shown = {program: name for name, program in peers.SHOWN.items()}
    for file in (root / RESULTS / run for run in result_files(root, peers.RUNS)):
        measured = peers.read_run(file).ms
        of_others = {(key[0], key[1], key[3]) for key in measured if measured[key] and key[0] != "turbopi"}
        for program, setting, horizon in sorted(of_others):
            name, _, precision = shown.get((program, setting), f"{program}, {setting}").partition(", ")
            whole, device = (measured.get((program, setting, kind, horizon)) for kind in (peers.WHOLE, peers.DEVICE))
            times = ["" if whole is None else f"{whole:.2f}", "", "" if device is None else f"{device:.2f}", "", ""]
            job = ["2", "48", str(horizon), "10", "1", "plain"]
            yield ["NVIDIA H200", "pi05", name, precision, *job, *times, _link(root, file)]
