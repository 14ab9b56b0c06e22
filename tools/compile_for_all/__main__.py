"""Compile every kernel of Turbo-Pi for every GPU of compute capability 8.0 and newer, without a GPU.

    PYTHONPATH=src:tools python -m compile_for_all --json benchmarks/results/compiled_for_all.json.xz
    PYTHONPATH=src:tools python -m compile_for_all --targets 89,120 --kernels gemm
    PYTHONPATH=src:tools python -m compile_for_all --targets 90 --kernels "sm90: " --into FILE

Triton's kernels in each variant that the full model launches there, products and attention in each tile that
`turbopi tune` may choose; CUDA C++ kernels by NVRTC: those below kernels/portable for each target, Hopper's for 90a.
Triton's own ptxas doesn't know 11.0: pip install --no-deps 'nvidia-cuda-nvcc>=13,<14' brings one that is taken for it.
Exit code 1 if one doesn't compile, spills more than allowed.py says or takes more than a block may have. That it
compiles doesn't say that it was run.
"""

import argparse
import os
import sys
from collections import defaultdict
from concurrent.futures import ProcessPoolExecutor
from datetime import date
from pathlib import Path

from rich.console import Console
from rich.table import Table

WIDTH = 80


def main() -> int:
    parser = argparse.ArgumentParser(
        prog="python -m compile_for_all", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--targets", help="such as 89,120; without it all")
    parser.add_argument("--kernels", default="", help="only kernels with this in their name")
    parser.add_argument("--chosen", action="store_true", help="products only in the tiles that the cost model chooses")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--json", type=Path, help="also write the result here")
    parser.add_argument("--into", type=Path, help="a result: its rows of these targets and kernels are made anew")
    given = parser.parse_args()
    os.environ.pop("TRITON_INTERPRET", None)
    from compile_for_all.compiling import compile_target, versions
    from compile_for_all.document import CompiledForAll, read_compiled, replaced, write_compiled
    from compile_for_all.targets import TARGETS

    numbers = None if given.targets is None else given.targets.split(",")
    wanted = [target for target in TARGETS if numbers is None or str(target.number) in numbers]
    if not wanted:
        parser.error(f"--targets {given.targets}: expected some of {', '.join(str(t.number) for t in TARGETS)}")
    with ProcessPoolExecutor(given.processes) as pool:
        jobs = [pool.submit(compile_target, target, given.kernels, given.chosen) for target in wanted]
        rows = [row for job in jobs for row in job.result()]
    show(rows, Console(width=WIDTH))
    now = CompiledForAll(date.today().isoformat(), versions(), rows)
    if given.json is not None:
        write_compiled(given.json, now)
    if given.into is not None:
        write_compiled(
            given.into, replaced(read_compiled(given.into), now, {one.arch for one in wanted}, given.kernels)
        )
    return 1 if any(row.problem for row in rows) else 0


def show(rows, console: Console) -> None:  # type: ignore[no-untyped-def]
    """A line for each kernel and target, the most that a variant uses; then the problems."""
    by_kernel = defaultdict(list)
    for row in rows:
        by_kernel[row.kernel, row.target].append(row)
    table = Table("kernel", "target", "variants", "registers", "spilled", "shared", "fits", box=None)
    for (kernel, target), several in by_kernel.items():
        done = [row for row in several if row.problem is None and row.refused is None]
        most = [str(max((getattr(row, what) for row in several), default=0)) for what in ("registers", "spilled")]
        shared = max(row.shared for row in several)
        fits = "refused" if several[0].refused else "yes" if len(done) == len(several) else "NO"
        table.add_row(kernel, target, str(len(several)), *most, str(shared), fits)
    console.print(table)
    for why in dict.fromkeys(f"{row.target}: {row.refused}" for row in rows if row.refused):
        console.print(f"refused on {why}")
    for row in rows:
        if row.problem:
            console.print(f"[red]{row.kernel} on {row.target}[/] {row.variant}: {row.problem}")


if __name__ == "__main__":
    sys.exit(main())
