"""The times T(B) of a GPU, as fleet plans need them: measured and checked in, of a file, or predicted."""

from collections.abc import Sequence
from pathlib import Path

from msgspec import Struct
from msgspec.structs import replace

from turbopi.bench.document import Times, read_benchmark
from turbopi.bench.gpus import find_gpu
from turbopi.bench.measured import measured_calls
from turbopi.bench.predict import PRECISIONS, PredictedCall, predict, refused
from turbopi.bench.work import Job
from turbopi.config import ModelConfig
from turbopi.support.errors import ConfigError


class BatchTable(Struct, frozen=True, kw_only=True):
    """T(B) of one backend on one GPU."""

    gpu: str
    backend: str
    precision: str
    job: Job  # that was measured or predicted, of one observation
    seconds: dict[int, float]  # by observations of a batch: the 99th percentile of calls
    predicted: bool  # no chunks that long were measured on that GPU
    source: str  # the files of the measurements that it is, or the one that it goes by


class _Timed(Struct, frozen=True):
    """One measurement, wherever it comes from."""

    backend: str
    job: Job
    seconds: float
    source: str
    kernels: str = ""  # a backend with other kernels is another one


def published_table(gpu: str, precision: str, horizon: int) -> BatchTable:
    """Of a GPU of the table: measured calls if there are some with chunks that long or longer, else a prediction.

    Raises ConfigError for a GPU that isn't known, and where there is nothing to go by.
    """
    spec = find_gpu(gpu)
    measured = [
        _Timed(call.backend, call.job, slow(call.milliseconds["total"]), call.source, call.kernels)
        for call in measured_calls()
        if (call.gpu, call.precision) == (spec.key, precision)
    ]
    if any(one.job.horizon >= horizon for one in measured):
        return _table(spec.key, precision, horizon, measured)
    if precision not in PRECISIONS:
        raise ConfigError(
            f"precision {precision!r} is neither measured on {spec.name} nor predicted; plans are for "
            f"{', '.join(PRECISIONS)}"
        )
    if why := refused(spec, precision):
        raise ConfigError(f"{spec.name} doesn't run {precision}: {why}")
    config, job = ModelConfig(), Job(horizon=horizon)
    batches = sorted({call.job.batch for call in measured_calls()})
    found: dict[tuple[str, str], dict[int, PredictedCall]] = {}  # by backend and its kernels
    for batch in batches:
        for one in predict(spec, config, replace(job, batch=batch)):
            for call in one.calls if one.precision == precision else ():
                found.setdefault((call.backend, call.kernels), {})[batch] = call
    best = min((calls for calls in found.values() if 1 in calls), key=lambda calls: calls[1].high_ms, default=None)
    if best is None:
        raise ConfigError(
            f"nothing that runs in {precision} on {spec.name} was measured anywhere, so there is no prediction; "
            f"measure T(B) there with `turbopi bench --horizons {horizon} --batch 1,2,4,8 --report DIR`, and give "
            "--times DIR/results.json"
        )
    return BatchTable(
        gpu=spec.key,
        backend=best[1].backend,
        precision=precision,
        job=job,
        seconds={batch: call.high_ms / 1e3 for batch, call in best.items()},
        predicted=True,
        source=best[1].source,
    )


def table_of_file(file: Path, precision: str, horizon: int) -> BatchTable:
    """Of a benchmark's document: what `turbopi bench --batch …` writes or prints.

    Its main job's cameras, prompt and steps count. Raises ConfigError for another file, and where it hasn't that
    precision, or a call of one observation with chunks that long or longer.
    """
    document = read_benchmark(file)
    main = replace(document.main_job, batch=1)
    timed = [
        _Timed(one.backend, one.job, slow(one.milliseconds["total"]), file.name)
        for one in document.results
        if one.precision == precision and replace(one.job, batch=1, horizon=main.horizon) == main
    ]
    if not timed:
        has = ", ".join(dict.fromkeys(one.precision for one in document.results))
        raise ConfigError(f"{file}: no calls in {precision}; it has {has}")
    return _table(document.provenance.device_name, precision, horizon, timed)


def how_to_measure(horizon: int, precision: str, backend: str = "auto") -> str:
    """The command that measures what a plan needs, and what to do with its result."""
    return (
        f"`turbopi bench CHECKPOINT --backends {backend} --precisions {precision} --horizons {horizon} "
        "--batch 1,2,4,8 --report DIR`, then give --times DIR/results.json"
    )


def slow(times: Times) -> float:
    """Seconds that nearly no call exceeds: the 99th percentile, or what the file has instead."""
    return (times.p99 if times.p99 is not None else times.p95) / 1e3


def _table(gpu: str, precision: str, horizon: int, timed: Sequence[_Timed]) -> BatchTable:
    """Of the backend that is fastest for one observation, at the shortest horizon that is long enough."""
    alone = [one for one in timed if one.job.batch == 1 and one.job.horizon >= horizon]
    if not alone:
        known = ", ".join(str(one) for one in sorted({one.job.horizon for one in timed if one.job.batch == 1}))
        raise ConfigError(
            f"chunks of {horizon} actions weren't measured in {precision}, one observation at a time: only of "
            f"{known or 'none'}. Measure with {how_to_measure(horizon, precision)}"
        )
    shortest = min(one.job.horizon for one in alone)
    best = min((one for one in alone if one.job.horizon == shortest), key=lambda one: one.seconds)
    same = [
        one
        for one in timed
        if (one.backend, one.kernels) == (best.backend, best.kernels)
        and replace(one.job, batch=1, horizon=shortest) == best.job
        and one.job.horizon >= shortest
    ]
    # of several measurements the fastest, which is sorted last: a shorter chunk takes no longer than a longer one
    chosen = {one.job.batch: one for one in sorted(same, key=lambda one: (one.job.batch, -one.seconds))}
    return BatchTable(
        gpu=gpu,
        backend=best.backend,
        precision=precision,
        job=best.job,
        seconds={batch: one.seconds for batch, one in chosen.items()},
        predicted=False,
        source=", ".join(dict.fromkeys(one.source for one in chosen.values())),
    )
