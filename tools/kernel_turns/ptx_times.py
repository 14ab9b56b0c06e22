"""How near the portable kernels come to mma.sync's own ceiling: timed on this GPU as PTX for an older one.

    export PYTHONPATH=src:tools
    python -m kernel_turns.ptx_times --out benchmarks/results/h200_2026-11-30_ptx_times.json

The driver compiles PTX of compute capability 8.9, which has neither wgmma nor TMA, for the GPU at hand. Each product of
eight bits and attention of one observation (2 cameras, 48 tokens) is timed in every tile that such a GPU takes, its
weights from memory; so is one large product, whose best tile is the ceiling. bfloat16's products are the library's and
can't be had as PTX. On Hopper mma.sync of E4M3 is emulated, so FP8's microseconds say little but beside its own
ceiling; INT8's is the hardware's. Norms are timed with FP8's products and are the same of INT8.
"""

import argparse
import json
import statistics
from collections.abc import Iterator
from pathlib import Path

import torch
from compile_for_all.targets import Target
from msgspec import Struct

from kernel_turns.problems import GPU
from kernel_turns.triton_ptx import ONE, Int8Product, compiled_as, found_operations, tiles_of
from turbopi.kernels.tile_table import Knobs, Numbers
from turbopi.support.errors import ConfigError
from turbopi.support.provenance import Provenance, provenance
from turbopi.support.reading import plain_document, read_document
from turbopi.tune import portable
from turbopi.tune.gpu import GpuBench
from turbopi.tune.race import Round, wrong
from turbopi.tune.shapes import Operation

LARGE = 8192  # rows, columns and depth of the product whose rate is the ceiling
ROUNDS = 7


class TimedTile(Struct, frozen=True):
    tile: Knobs
    microseconds: float


class TimedAsPtx(Struct, frozen=True):
    """An operation of one observation's call."""

    operation: Operation
    flops: float  # of one; attention's of both products
    usual: TimedTile  # as the cost model chooses it
    best: TimedTile
    norms: float | None = None  # microseconds of those around it, where they were timed
    left_out: int = 0  # tiles that are wrong or don't compile


class PtxTimes(Struct, frozen=True):
    """What `python -m kernel_turns.ptx_times --out` writes. The operations named "large" are the ceiling."""

    provenance: Provenance
    target: str
    rows: list[TimedAsPtx]


def read_ptx_times(file: Path) -> PtxTimes:
    """Raises ConfigError for another file."""
    return read_document(file, PtxTimes, ConfigError)


def flops_of(one: Operation) -> float:
    """Attention's rows are of one sequence, or of `images`; `columns` are heads there."""
    if one.operation.endswith("_attention"):
        return 4.0 * one.rows * one.columns * (one.rows // max(one.images, 1)) * one.inner
    return 2.0 * one.rows * one.columns * one.inner * (2 if one.operation == "geglu" else 1)


def large(numbers: Numbers) -> Operation:
    """bfloat16 has no other product in Triton than GeGLU's."""
    kind = "geglu" if numbers == "bf16" else "plain"
    columns = LARGE // 2 if numbers == "bf16" else LARGE
    return Operation("large", "portable", kind, numbers, LARGE, columns, LARGE, 0)


def _median(timer: Round) -> float:
    timer()
    return statistics.median(timer() for _ in range(ROUNDS))


def _alone(bench: GpuBench, knobs: Knobs) -> float:
    calls = max(8, bench.copies)

    def run() -> None:
        for call in range(calls):
            bench.run(knobs, call % bench.copies)

    return _median(bench.captured(run, calls, 100.0))


def timed(one: Operation, target: Target) -> TimedAsPtx:
    bench = Int8Product(one, GPU) if one.numbers == "int8" else portable.bench(one, GPU)
    candidates = tiles_of(one, target)
    refused = bench.prepare(candidates)
    right = [
        knobs
        for place, knobs in enumerate(candidates)
        if place not in refused and wrong(bench.error(knobs), bench.bound) is None
    ]
    if not right or right[0] != candidates[0]:
        raise ConfigError(f"{one.name}, {one.numbers}: the usual tile is wrong or doesn't compile: {refused.get(0)}")
    each = [TimedTile(knobs, _alone(bench, knobs)) for knobs in right]
    norms = None
    if one.numbers == "fp8" and (one.norm_in_front or one.norm_behind):
        norms = _median(bench.timer(candidates[0])) - each[0].microseconds
    return TimedAsPtx(
        operation=one,
        flops=flops_of(one),
        usual=each[0],
        best=min(each, key=lambda tile: tile.microseconds),
        norms=norms,
        left_out=len(candidates) - len(right),
    )


def times(target: Target) -> Iterator[TimedAsPtx]:
    found = [one for one in found_operations(target) if one.batch == 1 and one.images <= ONE.cameras]
    numbers = dict.fromkeys(one.numbers for one in found)
    # of bfloat16 attention alone: GeGLU's product is the library's
    own = [one for one in found if one.numbers != "bf16" or not (one.out_fp8 or one.operation == "geglu")]
    with compiled_as(target), torch.no_grad():
        for one in (*map(large, numbers), *own):
            yield timed(one, target)


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python -m kernel_turns.ptx_times",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--target", type=int, default=89, help="compute capability, 89 for 8.9 (the usual)")
    parser.add_argument("--out", type=Path, required=True, help="write JSON here, after each operation")
    arguments = parser.parse_args()
    target, rows = Target(divmod(arguments.target, 10)), []
    for row in times(target):
        one, rate = row.operation, row.flops / row.best.microseconds / 1e6
        took = f"{row.usual.microseconds:.1f} us as usual, at best {row.best.microseconds:.1f}, {rate:.0f} TFLOP/s"
        print(f"{one.numbers} {one.name}, {one.size}: {took}", flush=True)
        rows.append(row)
        document = PtxTimes(provenance(GPU), f"compute_{target.number}", rows)
        arguments.out.write_text(json.dumps(plain_document(document), indent=1) + "\n")


if __name__ == "__main__":
    main()
