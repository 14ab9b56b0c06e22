"""How near the portable kernels come to mma.sync's own ceiling: timed on this GPU as PTX for an older one.

    export PYTHONPATH=src:tools
    python -m kernel_turns.ptx_times --out benchmarks/results/h200_2026-11-30_ptx_times.json

The driver compiles PTX of compute capability 8.9, which has neither wgmma nor TMA, for the GPU at hand. Each product of
eight bits and attention of one observation (2 cameras, 48 tokens) is timed in every tile that such a GPU takes, its
weights from memory; so are large products, whose best tile is the ceiling. bfloat16's products are the library's and
can't be had as PTX. On Hopper mma.sync of E4M3 is emulated, so FP8's microseconds say little but beside its own
ceiling; INT8's is the hardware's. Norms are timed with FP8's products and are the same of INT8. The denoising loop's
floor is its weights at the speed of a large copy. The ratios are what a stage's operations take in the cost model's
tiles over what they would at the ceiling.
"""

import argparse
import json
import statistics
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import torch
from compile_for_all.targets import Target
from msgspec import Struct

from kernel_turns import portable as loop
from kernel_turns.problems import GPU, Problem, problem
from kernel_turns.triton_ptx import ONE, Int8Product, compiled_as, found_operations, tiles_of
from turbopi.kernels.portable.denoise.kernel import PortableDenoiser
from turbopi.kernels.portable.denoise.packing import PackedExpert, WeightNumbers
from turbopi.kernels.portable.gemm.tiles import UNPROMOTED
from turbopi.kernels.tile_table import Knobs, Numbers
from turbopi.support.errors import ConfigError
from turbopi.support.provenance import Provenance, provenance
from turbopi.support.reading import plain_document, read_document
from turbopi.tune import portable
from turbopi.tune.gpu import GpuBench
from turbopi.tune.race import Round, in_turns, wrong
from turbopi.tune.shapes import Operation

LARGE = 8192  # rows and columns of the products whose rate is the ceiling
DEPTHS = (2048, LARGE)  # of them; E4M3's sums are promoted in the second, and tiles of many sums are left out there
assert DEPTHS[0] <= UNPROMOTED < DEPTHS[1]
ROUNDS = 7
LEAST = 100.0  # microseconds of a round
WARM_SECONDS = 0.05  # of the first tile's rounds, until the clock has risen
LOOPS: dict[int, tuple[WeightNumbers, ...]] = {80: ("bf16", "int8"), 89: ("fp8",)}  # denoising, by the oldest GPU


class TimedTile(Struct, frozen=True):
    """Medians of the rounds."""

    tile: Knobs
    microseconds: float
    fastest: float  # round
    with_norms: float | None = None  # and the norms around it, where they are timed


class TimedAsPtx(Struct, frozen=True):
    """An operation of one observation's call."""

    operation: Operation
    flops: float  # of one; attention's of both products
    usual: TimedTile  # as the cost model chooses it
    best: TimedTile  # with its norms, which add up its parts
    left_out: int = 0  # tiles that are wrong or don't compile


class TimedLoop(Struct, frozen=True):
    """The denoising loop of ten steps behind 560 rows, one block for each multiprocessor of this GPU."""

    numbers: WeightNumbers
    target: str
    tokens: int
    milliseconds: float
    native: float  # its milliseconds compiled for this GPU
    floor: float  # milliseconds of its weights at the speed of a large copy


class PtxTimes(Struct, frozen=True):
    """What `python -m kernel_turns.ptx_times --out` writes. The operations named "large" are the ceiling.

    failed  operations that couldn't be timed, and why
    """

    provenance: Provenance
    target: str
    rows: list[TimedAsPtx]
    loops: list[TimedLoop]
    failed: list[str]


def read_ptx_times(file: Path) -> PtxTimes:
    """Raises ConfigError for another file."""
    return read_document(file, PtxTimes, ConfigError)


def flops_of(one: Operation) -> float:
    """Attention's rows are of one sequence, or of `images`; `columns` are heads there."""
    if one.operation.endswith("_attention"):
        return 4.0 * one.rows * one.columns * (one.rows // max(one.images, 1)) * one.inner
    return 2.0 * one.rows * one.columns * one.inner * (2 if one.operation == "geglu" else 1)


def large(numbers: Numbers) -> list[Operation]:
    return [Operation("large", "portable", "plain", numbers, LARGE, LARGE, depth, 0) for depth in DEPTHS]


def _timer(bench: GpuBench, knobs: Knobs) -> Round:
    """The operation without the norms around it, over all copies of its weights."""
    calls = max(8, bench.copies)

    def run() -> None:
        for call in range(calls):
            bench.run(knobs, call % bench.copies)

    return bench.captured(run, calls, LEAST)


def timed(one: Operation, target: Target) -> TimedAsPtx:
    """Raises ConfigError where the cost model's tile is wrong or doesn't compile."""
    bench = Int8Product(one, GPU) if one.numbers == "int8" else portable.bench(one, GPU)
    candidates = tiles_of(one, target)
    refused = bench.prepare(candidates)
    right = [
        knobs
        for place, knobs in enumerate(candidates)
        if place not in refused and wrong(bench.error(knobs), bench.bound) is None
    ]
    if not right or right[0] != candidates[0]:
        raise ConfigError(f"the usual tile is wrong or doesn't compile: {refused.get(0)}")
    normed = one.numbers == "fp8" and bool(one.norm_in_front or one.norm_behind)
    timers = {place: _timer(bench, knobs) for place, knobs in enumerate(right)}
    around = {place: bench.timer(knobs) for place, knobs in enumerate(right) if normed}
    until = time.monotonic() + WARM_SECONDS
    while time.monotonic() < until:
        timers[0]()
    alone, with_norms = in_turns(timers, ROUNDS), in_turns(around, ROUNDS)
    each = [
        TimedTile(
            knobs,
            statistics.median(alone[place]),
            min(alone[place]),
            statistics.median(with_norms[place]) if normed else None,
        )
        for place, knobs in enumerate(right)
    ]
    return TimedAsPtx(
        operation=one,
        flops=flops_of(one),
        usual=each[0],
        best=min(each, key=lambda tile: tile.with_norms or tile.microseconds),
        left_out=len(candidates) - len(right),
    )


def times(target: Target) -> Iterator[TimedAsPtx | str]:
    """A row for each operation, or why there is none. Large products come first, and once more at the end: whether the
    clock was the same.
    """
    with compiled_as(target), torch.no_grad():
        found = [one for one in found_operations(target) if one.batch == 1 and one.images <= ONE.cameras]
        largest = [one for numbers in dict.fromkeys(one.numbers for one in found) for one in large(numbers)]
        # of bfloat16 attention alone: GeGLU's product is the library's
        own = [one for one in found if one.numbers != "bf16" or not (one.out_fp8 or one.operation == "geglu")]
        for one in (*largest, *own, *largest):
            try:
                yield timed(one, target)
            except (ConfigError, torch.cuda.OutOfMemoryError) as failure:
                yield f"{one.numbers} {one.name}, {one.size}: {failure}"


def _enter() -> None:
    """A thread that loads kernels needs the GPU's context."""
    torch.zeros(1, device=GPU)


def loops(target: Target) -> Iterator[TimedLoop]:
    """As PTX for the oldest GPU that has its numbers, up to the target."""
    speed = loop.copied_bytes_a_second()
    kinds = [(f"compute_{oldest}", one) for oldest, of in LOOPS.items() if oldest <= target.number for one in of]
    for tokens in (10, 50):
        p = problem("full", loop.STEPS, tokens, 560, loop.SEED, GPU)
        packed = [loop.packed_in(p, numbers) for _, numbers in kinds]
        jobs = [(place, arch) for place, (target_name, _) in enumerate(kinds) for arch in (target_name, None)]

        def made(job: tuple[int, str | None], p: Problem = p, packed: list[PackedExpert] = packed) -> PortableDenoiser:
            place, arch = job
            return PortableDenoiser(
                *(p.config, packed[place], p.small, p.table),
                cache_rows=loop.CACHE_ROWS,
                suffix=len(p.noise),
                device=GPU,
                arch=arch,
            )

        with ThreadPoolExecutor(len(jobs), initializer=_enter) as pool:  # most of it is compiling
            kernels = list(pool.map(made, jobs))
        took = [statistics.median(loop.timed(kernel, p, 100)[1]) for kernel in kernels]
        for place, (name, numbers) in enumerate(kinds):
            weights = packed[place].weights
            floor = weights.numel() * weights.element_size() * loop.STEPS / speed * 1e3
            yield TimedLoop(numbers, name, tokens, took[2 * place], took[2 * place + 1], floor)


def ceilings(rows: list[TimedAsPtx]) -> dict[Numbers, float]:
    """FLOPs a microsecond of the fastest round of the large products."""
    found: dict[Numbers, float] = {}
    for row in rows:
        if row.operation.name == "large":
            found[row.operation.numbers] = max(found.get(row.operation.numbers, 0.0), row.flops / row.best.fastest)
    return found


def stage_times(rows: list[TimedAsPtx], numbers: Numbers) -> dict[str, tuple[float, float]]:
    """Microseconds of vision's and prefix' operations of a call, in the cost model's tiles, and those at the ceiling.

    Attention is bfloat16's. Norms are FP8's of the same operation; without FP8 they are left out.
    """
    norms = {
        (row.operation.name, row.operation.inner): row.usual.with_norms - row.usual.microseconds
        for row in rows
        if row.usual.with_norms is not None
    }
    of, took, least = ceilings(rows), dict[str, float](), dict[str, float]()
    for row in rows:
        one = row.operation
        if one.name != "large" and (one.numbers == numbers or one.operation.endswith("_attention")):
            stage, around = one.name.split()[0], norms.get((one.name, one.inner), 0.0)
            took[stage] = took.get(stage, 0.0) + one.uses * (row.usual.microseconds + around)
            least[stage] = least.get(stage, 0.0) + one.uses * row.flops / of[one.numbers]
    return {stage: (took[stage], least[stage]) for stage in took}


def ratios(rows: list[TimedAsPtx], numbers: Numbers) -> dict[str, float]:
    return {stage: took / least for stage, (took, least) in stage_times(rows, numbers).items()}


def said(row: TimedAsPtx) -> str:
    one, rate = row.operation, row.flops / row.best.microseconds / 1e6
    norms = "" if row.usual.with_norms is None else f", {row.usual.with_norms:.1f} with norms"
    took = f"{row.usual.microseconds:.1f} us as usual{norms}, at best {row.best.microseconds:.1f}"
    return f"{one.numbers} {one.name}, {one.size}: {took}, {rate:.0f} TFLOP/s"


def main() -> int:
    parser = argparse.ArgumentParser(
        prog="python -m kernel_turns.ptx_times",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--target", type=int, default=89, help="compute capability, 89 for 8.9 (the usual)")
    parser.add_argument("--out", type=Path, required=True, help="write JSON here, after each operation")
    arguments = parser.parse_args()
    target = Target(divmod(arguments.target, 10))
    document = PtxTimes(provenance(GPU), f"compute_{target.number}", [], [], [])  # GPU's own, which `times` replaces
    for row in times(target):
        (document.failed if isinstance(row, str) else document.rows).append(row)  # type: ignore[arg-type]
        print(f"failed: {row}" if isinstance(row, str) else said(row), flush=True)
        arguments.out.write_text(json.dumps(plain_document(document), indent=1) + "\n")
    for numbers, rate in ceilings(document.rows).items():
        over = ", ".join(f"{stage} {ratio:.2f} x" for stage, ratio in ratios(document.rows, numbers).items())
        print(f"{numbers}: ceiling {rate / 1e6:.0f} TFLOP/s; {'of attention alone ' * (numbers == 'bf16')}{over}")
    for one in loops(target):
        document.loops.append(one)
        took = f"{one.milliseconds:.2f} ms as PTX, {one.native:.2f} native, floor {one.floor:.2f}"
        print(f"{one.numbers} denoising, H = {one.tokens}: {took}, {one.milliseconds / one.floor:.2f} x", flush=True)
        arguments.out.write_text(json.dumps(plain_document(document), indent=1) + "\n")
    return 1 if document.failed else 0


if __name__ == "__main__":
    sys.exit(main())
