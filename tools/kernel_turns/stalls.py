"""Where the kernel's warps wait: Nsight Compute's samples, instruction by instruction, beside our source.

ncu tells machine instructions, whose order and names say little. Compiled with lines, the same instructions lead back
to the functions that they were inlined from.
"""

import csv
import re
import subprocess
from collections import Counter, defaultdict
from dataclasses import dataclass
from pathlib import Path

from kernel_turns.turns import CACHE_ROWS
from kernel_turns.variants import Variant
from turbopi.config import preset
from turbopi.kernels import nvrtc
from turbopi.kernels.sm90.denoise.packing import Arrangement
from turbopi.kernels.sm90.instructions import SHARED_BYTES
from turbopi.support.errors import BackendUnavailable

KERNEL = "turbopi_denoise"
_INSTRUCTION = re.compile(r"/\*[0-9a-f]{4,5}\*/\s+(.*?);")
_LINE = re.compile(r'//## File "[^"]*", line (\d+)')
_EVERYWHERE = ("consume", KERNEL)  # what all instructions were inlined into


@dataclass
class Instruction:
    text: str
    lines: list[int]  # of the source: its own, then those that it was inlined into


@dataclass
class Waited:
    instruction: Instruction
    cycles: float  # a warp's, on average, each time that it came here
    executed: int  # by how many warps
    reasons: Counter[str]  # samples by what was waited for


def disassembled(cubin: bytes, folder: Path, *options: str) -> str:
    """What nvdisasm prints, which comes with Triton. Raises BackendUnavailable without it."""
    try:
        import triton
    except ImportError as e:
        raise BackendUnavailable(f"nvdisasm comes with Triton ({e}); pip install triton") from e
    file, tool = folder / "kernel.cubin", Path(triton.__file__).parent / "backends" / "nvidia" / "bin" / "nvdisasm"
    file.write_bytes(cubin)
    return subprocess.run([tool, "-c", *options, file], capture_output=True, text=True, check=True).stdout


def compiled(variant: Variant, tokens: int, fp8: bool) -> tuple[str, bytes, Arrangement]:
    """The full-size kernel's source, its machine code with lines, who does what."""
    arrangement = Arrangement(preset("pi05_libero").planned_model)
    sizes = variant.sizes(arrangement, cache_rows=CACHE_ROWS, suffix=tokens, shared_bytes=SHARED_BYTES, fp8=fp8)
    source: str = variant.module.source(tokens, fp8)
    return source, nvrtc.compile_cubin(source, "sm_90a", sizes, lines=True), arrangement


def instructions(text: str) -> list[Instruction]:
    """Of what nvdisasm prints with -gi, the denoising kernel's."""
    found: list[Instruction] = []
    lines: list[int] = []
    ended = False
    for row in text[text.index(f".text.{KERNEL}:") :].splitlines()[1:]:
        if row.lstrip().startswith(".section"):
            break
        if (line := _LINE.search(row)) is not None:
            lines = [] if ended else lines
            lines.append(int(line[1]))
            ended = False
        elif (instruction := _INSTRUCTION.search(row)) is not None:
            found.append(Instruction(instruction[1].strip(), lines))
            ended = True
    return found


def functions(source: str) -> dict[int, str]:
    """Which function each line of a kernel's source is in."""
    names, name = {}, "-"
    for number, line in enumerate(source.splitlines(), 1):
        if "__device__" in line or "__global__" in line or line.lstrip().startswith(KERNEL):
            head = re.sub(r"__\w+__(\([^)]*\))?", "", line.partition("//")[0])
            if (found := re.search(r"(\w+)\(", head)) is not None:
                name = found[1]
        names[number] = name
    return names


def read(file: Path) -> list[list[str]]:
    with file.open(newline="") as text:
        return list(csv.reader(text))


def waits(rows: list[list[str]], code: list[Instruction], interval: int, warps: int) -> list[Waited]:
    """ncu's "source" page as CSV rows, beside the code. interval: cycles between samples of a multiprocessor, each of
    one of its `warps`. Raises ValueError if the rows are another kernel's.
    """
    head = next((row for row in rows if row and row[0] == "Address"), None)
    if head is None:
        raise ValueError("no row begins with 'Address': expected what `ncu --page source --csv` prints")
    samples = [row for row in rows if row and row[0].startswith("0x")]
    if len(samples) != len(code):
        raise ValueError(f"{len(samples)} sampled instructions, the kernel has {len(code)}: expected its own samples")
    executed, stalls = head.index("Instructions Executed"), {}
    for i, name in enumerate(head):
        if name.startswith("stall_") and "Not Issued" not in name:
            stalls[i] = name.removeprefix("stall_")
    found = []
    for row, instruction in zip(samples, code, strict=True):
        reasons = Counter({name: int(row[i]) for i, name in stalls.items() if int(row[i])})
        times = int(row[executed])
        found.append(Waited(instruction, reasons.total() * interval * warps / max(times, 1), times, reasons))
    return found


def by_function(found: list[Waited], names: dict[int, str]) -> dict[str, tuple[float, Counter[str]]]:
    """Of each function of the loop, those that take most first: cycles of all warps, samples by what was waited for."""
    cycles: dict[str, float] = defaultdict(float)
    reasons: dict[str, Counter[str]] = defaultdict(Counter)
    for wait in found:
        outer = [names[line] for line in wait.instruction.lines if names[line] not in _EVERYWHERE]
        name = outer[-1] if outer else "-"
        cycles[name] += wait.cycles * wait.executed
        reasons[name] += wait.reasons
    return {name: (cycles[name], reasons[name]) for name in sorted(cycles, key=lambda name: -cycles[name])}
