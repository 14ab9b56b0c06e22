"""The measured calls that go into the package, of the result files that benchmarks/measured.json names."""

import json
from pathlib import Path

from msgspec import Struct
from msgspec.structs import replace
from packed import read_packed_benchmark

from doc_tables.results import RESULTS
from turbopi.bench.document import Result, Times
from turbopi.bench.measured import Kernels, MeasuredCall
from turbopi.bench.predict import STAGES
from turbopi.bench.work import Job
from turbopi.support.errors import ConfigError
from turbopi.support.reading import plain_document, read_document

SOURCES = Path("benchmarks") / "measured.json"
WRITTEN = Path("src/turbopi/data/measured_calls.json")


class _File(Struct, frozen=True):
    file: str  # below benchmarks/results
    gpu: str  # a key of gpus.json
    kernels: dict[str, Kernels]  # of each backend that is to be taken


class _Sources(Struct, frozen=True):
    files: list[_File]


def _times(times: Times) -> Times:
    p50, p95, p99 = (None if value is None else round(value, 4) for value in (times.p50, times.p95, times.p99))
    assert p50 is not None and p95 is not None
    return Times(p50=p50, p95=p95, p99=p99)


def _call(result: Result, source: _File) -> MeasuredCall:
    return MeasuredCall(
        gpu=source.gpu,
        backend=result.backend,
        precision=result.precision,
        kernels=source.kernels[result.backend],
        job=result.job,
        milliseconds={name: _times(result.milliseconds[name]) for name in ("total", *STAGES)},
        device_bytes=result.memory.device_reserved,
        source=source.file,
    )


def _wanted(result: Result) -> bool:
    """The main job's, at any horizon and in any batch."""
    usual = Job()
    return replace(result.job, horizon=usual.horizon, batch=1) == usual


def _sources(root: Path) -> list[_File]:
    return read_document(root / SOURCES, _Sources, ConfigError).files


def kernels_of(root: Path) -> dict[str, dict[str, Kernels]]:
    """Result file, below benchmarks/results -> backend -> its kernels, which the file itself doesn't say."""
    return {source.file: source.kernels for source in _sources(root)}


def measured(root: Path) -> str:
    """The text of data/measured_calls.json; a later file's calls replace an earlier one's of the same kind and job."""
    calls: dict[tuple[object, ...], MeasuredCall] = {}
    for source in _sources(root):
        document = read_packed_benchmark(root / RESULTS / source.file)
        for result in document.results:
            if result.backend in source.kernels and _wanted(result):
                call = _call(result, source)
                calls[call.gpu, call.backend, call.precision, call.kernels, call.job] = call
    lines = [json.dumps(plain_document(call), separators=(",", ":")) for call in calls.values()]
    return '{"calls": [\n' + ",\n".join(lines) + "\n]}\n"


def stale_measured(root: Path) -> list[str]:
    if not (root / SOURCES).is_file() or (root / WRITTEN).read_text(encoding="utf-8") == measured(root):
        return []
    return [f"{WRITTEN} isn't what {SOURCES} names; run scripts/tables"]


def write_measured(root: Path) -> list[Path]:
    if not (root / SOURCES).is_file():
        return []
    text, file = measured(root), root / WRITTEN
    if file.is_file() and file.read_text(encoding="utf-8") == text:
        return []
    file.write_text(text, encoding="utf-8")
    return [file]
