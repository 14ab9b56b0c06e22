"""Time variants of the denoising kernel, and see where they wait. Run from the repository, on a Hopper GPU:

    export PYTHONPATH=src:tools
    python -m kernel_turns time here other.patch here+TP_ROUND_FRAGMENTS=4 --tokens 10,50 --marks
    ncu --clock-control none --kernel-name turbopi_denoise --launch-skip 1 --launch-count 1 \\
        --section SourceCounters --warp-sampling-interval 4 -o samples -f \\
        python -m kernel_turns launch other.patch --tokens 50
    ncu -i samples.ncu-rep --page source --csv > samples.csv
    python -m kernel_turns stalls other.patch --tokens 50 --samples samples.csv     (needs no GPU, but NVRTC and Triton)

A variant is "here", a folder as kernels/sm90 is, or a patch of this tree, and constants: +NAME=VALUE. Behind it @held,
@guided, @distinct or @same: the form in which tokens have their own times, as in `time here here@held here@guided`.
"""

import argparse
import json
import tempfile
from collections import Counter
from pathlib import Path

from rich.console import Console
from rich.table import Table

from kernel_turns.variants import Variant
from turbopi.support.errors import BackendError

MULTIPLYING, WARPS = 16, 20  # warps of a block


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python -m kernel_turns", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(dest="command", required=True)
    time = commands.add_parser("time", help="time variants in turns")
    time.add_argument("variants", nargs="+")
    time.add_argument("--tokens", default="50", help="suffix tokens, such as 10,50")
    time.add_argument("--precisions", default="bf16,fp8")
    time.add_argument("--rounds", type=int, default=8)
    time.add_argument("--marks", action="store_true", help="also cycles between the kernel's marks, by rank")
    time.add_argument("--warp", type=int, default=0, choices=range(MULTIPLYING), metavar="0..15", help="whose marks")
    time.add_argument("--json", type=Path, help="also write the rows, and marks by rank, here")
    launch = commands.add_parser("launch", help="launch one variant three times, for ncu")
    stalls = commands.add_parser("stalls", help="ncu's samples beside the source")
    stalls.add_argument("--samples", type=Path, required=True, help="what `ncu --page source --csv` printed")
    stalls.add_argument("--interval", type=int, default=4, help="the sampling interval that ncu was given")
    stalls.add_argument("--least", type=float, default=20, help="leave out what takes fewer cycles")
    stalls.add_argument("--function", help="also show this function's instructions")
    for one in (launch, stalls):
        one.add_argument("variant")
        one.add_argument("--tokens", type=int, default=50)
        one.add_argument("--precision", default="fp8", choices=("bf16", "fp8"))
    for timed in (time, launch):
        timed.add_argument("--length", type=int, default=560, help="valid prefix tokens")
    arguments = parser.parse_args()
    try:
        {"time": _time, "launch": _launch, "stalls": _stalls}[arguments.command](arguments)
    except (ValueError, BackendError) as e:
        parser.error(str(e))


def _time(arguments: argparse.Namespace) -> None:
    from kernel_turns.document import MarkedVariant, TimedVariant, TurnsDocument
    from kernel_turns.turns import GPU, MARKS, RANKS, Job, marks_by_rank, time_in_turns
    from turbopi.support.provenance import provenance
    from turbopi.support.reading import plain_document

    variants, console = [Variant(spec) for spec in arguments.variants], Console()
    rows, marks = list[TimedVariant](), list[MarkedVariant]()
    for tokens in (int(text) for text in arguments.tokens.split(",")):
        for precision in arguments.precisions.split(","):
            job = Job(tokens, precision, arguments.length)
            title = f"{tokens} tokens, {precision}, {arguments.length} prefix tokens, ten steps"
            table = Table("variant", "ms", "fastest", "error", "bits", "MHz", title=title)
            for row in time_in_turns(job, variants, arguments.rounds):
                numbers = f"{row.milliseconds:.4f}", f"{row.fastest:.4f}", f"{row.error:.5f}"
                table.add_row(row.variant, *numbers, "same" if row.same else "differ", f"{row.mhz:.0f}")
                rows.append(row)
            console.print(table)
            for variant in variants if arguments.marks else ():
                title = f"cycles a layer up to each mark, warp {arguments.warp}, {variant.spec}"
                table = Table("mark", *(f"rank {rank}" for rank in range(RANKS)), title=title)
                cycles = dict(zip(MARKS, marks_by_rank(job, variant, arguments.warp).T.tolist(), strict=True))
                for mark, about in MARKS.items():
                    name = f"{mark.removeprefix('MARK_').lower()}: {about}"
                    table.add_row(name, *(f"{count:.0f}" for count in cycles[mark]))
                console.print(table)
                marks.append(MarkedVariant(tokens, precision, variant.spec, arguments.warp, cycles))
    if arguments.json is not None:
        document = TurnsDocument(provenance(GPU), rows, marks)
        arguments.json.write_text(json.dumps(plain_document(document), indent=1))


def _launch(arguments: argparse.Namespace) -> None:
    import torch

    from kernel_turns.turns import Job

    job = Job(arguments.tokens, arguments.precision, arguments.length)
    variant, outputs = Variant(arguments.variant), job.outputs()
    p = job.of(variant)
    kernel = job.kernel(variant, p)
    for _ in range(3):
        job.launch(kernel, p, *outputs)
    torch.cuda.synchronize()


def _stalls(arguments: argparse.Namespace) -> None:
    from kernel_turns.stalls import by_function, compiled, disassembled, functions, instructions, read, waits
    from kernel_turns.turns import STEPS

    source, cubin, arrangement = compiled(Variant(arguments.variant), arguments.tokens, arguments.precision == "fp8")
    with tempfile.TemporaryDirectory() as folder:
        code = instructions(disassembled(cubin, Path(folder), "-gi"))
    found = waits(read(arguments.samples), code, 32 << arguments.interval, WARPS)
    names, lines, console = functions(source), source.splitlines(), Console()
    passes = STEPS * arrangement.config.expert.depth * arrangement.blocks  # of a block through a layer
    table = Table("function", "cycles a layer", "samples by what was waited for", title="mean of the multiplying warps")
    for name, (cycles, reasons) in by_function(found, names).items():
        if (mean := cycles / passes / MULTIPLYING) >= arguments.least:
            table.add_row(name, f"{mean:.0f}", _several(reasons))
    console.print(table)
    if arguments.function is None:
        return
    table = Table("instruction", "cycles", "warps", "samples", "source", title=f"{arguments.function}: each time")
    for wait in found:
        chain = wait.instruction.lines
        if wait.cycles >= arguments.least and arguments.function in (names[line] for line in chain):
            numbers = f"{wait.cycles:.0f}", f"{wait.executed / passes:.1f}", _several(wait.reasons)
            table.add_row(wait.instruction.text, *numbers, lines[chain[0] - 1].strip()[:60])
    console.print(table)


def _several(reasons: Counter[str]) -> str:
    return ", ".join(f"{name} {count}" for name, count in reasons.most_common(4))


if __name__ == "__main__":
    main()
