"""Run the portable kernels as PTX for older GPUs on this one: are results right?

    export PYTHONPATH=src:tools
    python -m kernel_turns.ptx --out benchmarks/results/h200_2026-11-26_ptx.json

The driver compiles PTX for the GPU that loads it, so instructions are those of the older GPU, and speed isn't. The
denoising kernel is compared with its native build; some cases take as many blocks as another GPU has multiprocessors,
as products and attention are cut by that number. Triton's products and attention, in every tile that the older GPU may
take, are compared with float32 (triton_ptx.py). Exit code 1 if one has a problem.
"""

import argparse
import json
import math
import sys
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Literal

import torch
from msgspec import Struct

from kernel_turns.portable import packed_in
from kernel_turns.problems import GPU, plain, portable_outputs, problem, relative, standing_for
from turbopi.backends.tuned_tiles import knobs_text
from turbopi.kernels.portable.denoise.kernel import unavailable
from turbopi.kernels.portable.denoise.packing import WeightNumbers
from turbopi.support.errors import ConfigError
from turbopi.support.provenance import Provenance, provenance
from turbopi.support.reading import plain_document, read_document

KERNEL, SEED = "denoise.kernel", 11
TRITON = ((8, 0), (8, 6), (8, 9))  # what Triton's kernels are compiled for
APART = 2  # times the error of the native build


@dataclass(frozen=True)
class Case:
    """One problem of `problems.problem`. blocks: those of another GPU; None: one for each multiprocessor here."""

    target: str  # "compute_80"
    numbers: WeightNumbers
    name: str
    steps: int
    suffix: int
    length: int
    blocks: int | None = None

    def __str__(self) -> str:
        blocks = "" if self.blocks is None else f", {self.blocks} blocks"
        return f"{self.name}, {self.numbers}, H={self.suffix}, {self.steps} steps, {self.length} rows{blocks}"


def capability_of(target: str) -> tuple[int, int]:
    """(8, 0) of "compute_80"."""
    number = int(target.removeprefix("compute_"))
    return number // 10, number % 10


_KINDS: tuple[tuple[str, WeightNumbers], ...] = (("compute_80", "bf16"), ("compute_80", "int8"), ("compute_89", "fp8"))
_SIZES = (("golden", 3, 10, 37), ("odd", 3, 17, 101), ("full", 10, 10, 560), ("full", 3, 50, 560))
_OTHER_GPUS: tuple[tuple[str, WeightNumbers, int], ...] = (  # A100, RTX 3090, Orin twice, RTX 4090, Thor
    *(("compute_80", "bf16", 108), ("compute_80", "bf16", 82), ("compute_80", "bf16", 16)),
    *(("compute_80", "int8", 16), ("compute_89", "fp8", 128), ("compute_89", "fp8", 20)),
)
CASES = (
    *(
        Case(target, numbers, name, steps, suffix, length)
        for target, numbers in _KINDS
        for name, steps, suffix, length in _SIZES
    ),
    *(
        Case(target, numbers, "shallow", 2, suffix, 571, blocks)
        for target, numbers, blocks in _OTHER_GPUS
        for suffix in (10, 50)
    ),
)


class RanAsPtx(Struct, frozen=True, omit_defaults=True):
    """One case. Numbers are relative rms."""

    kernel: str
    variant: str
    target: str  # what the PTX was compiled for: "compute_80"
    against: Literal["native build", "float32"]
    difference: float | None  # to that; None: it didn't run
    most: float  # what it may be
    same: bool = False  # to the last bit
    error: float | None = None  # of actions, to float64
    problem: str | None = None


class PtxDocument(Struct, frozen=True):
    """What `python -m kernel_turns.ptx --out` writes."""

    provenance: Provenance
    rows: list[RanAsPtx]


def read_ptx(file: Path) -> PtxDocument:
    """Raises ConfigError for another file."""
    return read_document(file, PtxDocument, ConfigError)


def compared(case: Case) -> RanAsPtx:
    """The case as PTX and as machine code, on this GPU."""
    p = problem(case.name, case.steps, case.suffix, case.length, SEED, GPU)
    packed = packed_in(p, case.numbers)
    ptx, _ = portable_outputs(p, packed, blocks=case.blocks, arch=case.target)
    native, _ = portable_outputs(p, packed, blocks=case.blocks)
    if packed.scaled:
        p.layers = standing_for(packed, p)
    exact = plain(p, torch.float64)[0][-1]
    row = RanAsPtx(
        kernel=KERNEL,
        variant=str(case),
        target=case.target,
        against="native build",
        difference=relative(ptx[-1], native[-1]),
        most=APART * relative(native[-1], exact),
        same=torch.equal(ptx, native),
        error=relative(ptx[-1], exact),
    )
    return judged(row)


def judged(row: RanAsPtx) -> RanAsPtx:
    """With its problem, if it has one.

    The two compilers may fuse another product with a sum, or not. Then single activations round to their other
    neighbour, and results are two samples of the same rounding error: at most twice that apart.
    """
    if row.same or (row.difference is not None and row.difference <= row.most):  # not a number is neither
        return row
    why = f"differs from the native build by {row.difference:.5f}, more than {APART} times its error"
    return RanAsPtx(**{name: getattr(row, name) for name in row.__struct_fields__} | {"problem": why})


def triton_rows(capability: tuple[int, int]) -> list[RanAsPtx]:
    """Triton's kernels for a GPU of this compute capability."""
    from compile_for_all.targets import Target

    from kernel_turns.triton_ptx import results

    target = Target(capability)
    return [
        RanAsPtx(
            kernel=f"Triton: {one.operation}",
            variant=f"{one.name}, {one.numbers}{', out in eight bits' * one.out_fp8}, {knobs_text(knobs)}",
            target=f"compute_{target.number}",
            against="float32",
            difference=error if error is not None and math.isfinite(error) else None,
            most=most,
            problem=why,
        )
        for one, knobs, error, most, why in results(target)
    ]


def main() -> int:
    parser = argparse.ArgumentParser(
        prog="python -m kernel_turns.ptx", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--jobs", type=int, default=8, help="processes at a time, as most of it is compiling")
    parser.add_argument("--out", type=Path, required=True, help="write JSON here")
    arguments = parser.parse_args()
    if (reason := unavailable(GPU)) is not None:
        parser.error(reason)
    here = torch.cuda.get_device_capability(GPU)
    cases = [case for case in CASES if capability_of(case.target) <= here]
    older = [capability for capability in TRITON if capability <= here]
    with ProcessPoolExecutor(arguments.jobs, mp_context=get_context("spawn")) as pool:
        of_triton = [pool.submit(triton_rows, capability) for capability in older]
        rows = list(pool.map(compared, cases))
        rows += [row for job in of_triton for row in job.result()]
    for row in rows:
        if row.kernel == KERNEL:
            found = "same bits" if row.same else f"{row.difference:.5f} apart"
            print(f"{row.target} {row.variant}: {found}, at most {row.most:.5f}; error {row.error:.5f}")
    for row in rows:
        if row.problem is not None:
            print(f"{row.target} {row.kernel} {row.variant}: {row.problem}")
    print(f"{len(rows)} cases, {sum(row.problem is not None for row in rows)} with a problem")
    document = PtxDocument(provenance(GPU), rows)
    arguments.out.write_text(json.dumps(plain_document(document), indent=1) + "\n")
    return 1 if any(row.problem for row in rows) else 0


if __name__ == "__main__":
    sys.exit(main())
