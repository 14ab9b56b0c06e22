"""Calls that were measured and are checked in: what predictions and fleet plans go by.

data/measured_calls.json is written by `scripts/tables` from the result files that benchmarks/measured.json names.
"""

from functools import cache
from pathlib import Path
from typing import Literal

from msgspec import Struct

from turbopi.bench.document import Times
from turbopi.bench.work import Job
from turbopi.support.errors import ConfigError
from turbopi.support.reading import read_document

FILE = Path(__file__).parents[1] / "data" / "measured_calls.json"
Kernels = Literal["hopper", "portable", "pytorch"]
KERNELS: dict[Kernels, str] = {
    "hopper": "Hopper's own kernels",  # they run on compute capability 9.0 alone
    "portable": "kernels for all GPUs",
    "pytorch": "PyTorch's kernels",
}


class MeasuredCall(Struct, frozen=True, kw_only=True):
    """One backend in one precision on one job, on one GPU of gpus.json."""

    gpu: str  # a key of gpus.json
    backend: str
    precision: str
    kernels: Kernels
    job: Job
    milliseconds: dict[str, Times]  # "total", from host to host, "vision", "prefix" and "denoise"
    device_bytes: int | None = None  # reserved on the GPU at most
    source: str  # the file below benchmarks/results


class MeasuredCalls(Struct, frozen=True):
    calls: list[MeasuredCall]


@cache
def measured_calls() -> tuple[MeasuredCall, ...]:
    """All of them."""
    return tuple(read_document(FILE, MeasuredCalls, ConfigError).calls)
