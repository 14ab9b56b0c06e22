"""Our latency beside other programs': docs/performance.md's table, README's plot, from the runs that RUNS names.

A run is a file of `python -m peers run` (tools/peers): below benchmarks/results/ under a name of RUNS' last, it counts.
A program's figures are of the newest run that has some; those of earlier runs have their date. The first runs are as
their programs wrote them: ours a benchmark (.json), the others a JSON object a line (.jsonl) or a line of text each
(.txt). What was built how: the README beside them.
"""

import hashlib
import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, NamedTuple

from matplotlib.figure import Figure
from msgspec import Meta, Struct
from msgspec.structs import replace
from peers.document import PARTS, Part, read_peers_run
from PIL import Image

from doc_tables.drawn import compacted
from doc_tables.results import RESULTS, result_files
from turbopi.bench.document import read_benchmark
from turbopi.bench.plots import DRAWN_OF
from turbopi.bench.work import Job
from turbopi.support.errors import ConfigError
from turbopi.support.plots import MEASURED, MUTED, write_figure
from turbopi.support.reading import as_document, read_json

_FIRST = "h200_2026-11-28_peers"
RUNS = (  # docs/performance.md's table names the same; older ones first
    *(f"{_FIRST}/{file}" for file in ("ours_beside_flashrt_openpi.json", "flashrt_openpi.jsonl")),
    *(f"{_FIRST}/{file}" for file in ("realtime_vla.txt", "lerobot.jsonl")),
    "h200_*_peers/peers*.json",
)
PLOT = Path("docs") / "latency.png"
TEXT = "#7d8590"  # legible on white and on black: the background is the page's

WHOLE, DEVICE = PARTS
Key = tuple[str, str, Part, int]  # program, setting, WHOLE or DEVICE, horizon
# Medians of one job: Pi0.5 of full size, 2 cameras, 48 prompt tokens, 10 steps. None: tried, and the file says why not.
Milliseconds = Mapping[Key, float | None]


class Run(NamedTuple):
    date: str  # of its folder's name, "2026-11-28"; "" if it has none
    ms: Milliseconds


# name in the documents -> (program, setting), as the outputs name them
SHOWN = {
    "Turbo-Pi, FP8": ("turbopi", "fp8"),
    "Turbo-Pi, bf16": ("turbopi", "bf16"),
    "FlashRT, FP8": ("flashrt", "fp8 nt_autotune=force"),
    "FlashRT, bf16": ("flashrt", "bf16"),
    "realtime-vla, bf16": ("realtime-vla", "triton"),
    "openpi, PyTorch compiled": ("openpi-pytorch", "bf16 reduce-overhead"),
    "LeRobot, PyTorch eager": ("lerobot", "bf16 eager"),
    "openpi, PyTorch eager": ("openpi-pytorch", "bf16 eager"),
    "SGLang, bf16": ("sglang", "bf16"),
    "vLLM-Omni, bf16": ("vllm-omni", "bf16"),
}
DRAWN = ("Turbo-Pi, FP8", "Turbo-Pi, bf16", "FlashRT, FP8", "FlashRT, bf16", "openpi, PyTorch compiled")

_KINDS: dict[str, Part] = {
    "whole call, host uint8 to host actions": WHOLE,
    "device tensors to device actions": DEVICE,
    "graph replay": DEVICE,
}
_JOB = re.compile(r"(?P<kind>.*?) views=2( of 3)? lang=48( of 200)? H=(?P<horizon>\d+) steps=10")
_LINE = re.compile(r"(?P<program>\S+) (?P<setting>\S+) views=2 lang=48 H=(?P<horizon>\d+) steps=10: (?P<ms>[\d.]+) ms")


class _Row(Struct, frozen=True):
    peer: str
    setting: str
    job: str
    p50_ms: Annotated[float, Meta(gt=0)]


def read_run(file: Path) -> Run:
    """Medians of a run's jobs that the table has. Raises ConfigError, a ValueError, for a file without any."""
    read = {".json": _json, ".jsonl": _rows, ".txt": _lines}.get(file.suffix)
    if read is None:
        raise ConfigError(f"{file}: a peer's run is a .json, .jsonl or .txt file")
    found = read(file)
    if not found:
        raise ConfigError(f"{file} has no job of 2 cameras, 48 prompt tokens and 10 steps; expected a run of a peer")
    date = re.search(r"_(\d{4}-\d\d-\d\d)_", file.parent.name)
    return Run(date[1] if date else "", found)


def newest(runs: Sequence[Run]) -> dict[tuple[str, str], Run]:
    """By program and setting its figures in the newest run that has some, of one date. runs: older ones first."""
    found: dict[tuple[str, str], Run] = {}
    for run in runs:
        for program in {key[:2] for key in run.ms}:
            own = {key: ms for key, ms in run.ms.items() if key[:2] == program}
            before = found.get(program, Run("", {}))
            if before.date == run.date:
                own = {**before.ms, **own}
            if any(own.values()) or not any(before.ms.values()):
                found[program] = Run(run.date, own)
    return found


def _json(file: Path) -> Milliseconds:
    job = Job()
    if read_json(file, ConfigError).get("kind") == "turbopi-peers":
        run = read_peers_run(file)
        if run.model != "pi05":
            raise ConfigError(f"{file} is of {run.model}, and this table of pi05: give it a name that no run here has")
        found: dict[Key, float | None] = {
            (one.program, one.setting, part, (one.job or job).horizon): None
            for one in run.not_measured
            for part in PARTS
        }
        for one in run.timed:
            if replace(one.job, horizon=job.horizon) == job:
                found[one.program, one.setting, one.part, one.job.horizon] = one.p50_ms
        return found
    document = read_benchmark(file)
    return {
        ("turbopi", result.precision, kind, result.job.horizon): result.milliseconds[name].p50
        for result in document.results
        if result.backend == "fused" and replace(result.job, horizon=job.horizon) == job
        for kind, name in ((WHOLE, "total"), (DEVICE, "device"))
    }


def _rows(file: Path) -> Milliseconds:
    found = {}
    for number, line in enumerate(file.read_text(encoding="utf-8").splitlines(), 1):
        if line:
            row = as_document(json.loads(line), _Row, f"{file}: line {number}", ConfigError)
            job = _JOB.fullmatch(row.job)
            if job and (kind := _KINDS.get(job["kind"])):
                found[row.peer, row.setting, kind, int(job["horizon"])] = row.p50_ms
    return found


def _lines(file: Path) -> Milliseconds:
    lines = (_LINE.fullmatch(line) for line in file.read_text(encoding="utf-8").splitlines())
    return {(of["program"], of["setting"], DEVICE, int(of["horizon"])): float(of["ms"]) for of in lines if of}


def peers(*runs: Run) -> list[str]:
    """Each program: medians of whole calls and of the GPU's part alone, with chunks of 10 and of 50."""
    every = newest(runs)
    lines = [f"| ms | {WHOLE}, H = 10 | H = 50 | {DEVICE}, H = 10 | H = 50 |", "|---|--:|--:|--:|--:|"]
    for name, program in SHOWN.items():
        if program not in every:
            continue
        date, figures = every[program]
        cells = [figures.get((*program, kind, horizon)) for kind in (WHOLE, DEVICE) for horizon in (10, 50)]
        if any(cells):
            name += _dated(date, runs)
            lines.append("| " + " | ".join([name, *("" if ms is None else _shown(ms) for ms in cells)]) + " |")
        else:
            lines.append(f"| {name} | not measured | | | |")
    return lines


def _dated(date: str, runs: Sequence[Run]) -> str:
    """What says that figures aren't the newest run's."""
    return "" if date == max(run.date for run in runs) else f" ({date})"


def _shown(ms: float) -> str:
    return f"{ms:.2f}" if ms < 100 else f"{ms:.0f}"


# --- the plot ---------------------------------------------------------------------------------------------------------


def bars(root: Path) -> list[tuple[str, float]]:
    """(name, milliseconds) of the plot's programs with chunks of 10: a whole call, or else the GPU's part; if any."""
    runs = [read_run(root / RESULTS / file) for file in result_files(root, RUNS)]
    every = newest(runs)
    found = []
    for name in DRAWN:
        date, figures = every.get(SHOWN[name], Run("", {}))
        whole, device = (figures.get((*SHOWN[name], kind, 10)) for kind in (WHOLE, DEVICE))
        if ms := whole or device:
            found.append(((name if whole else f"{name} ({DEVICE} alone)") + _dated(date, runs), ms))
    return found


def draw_peers(root: Path) -> list[Path]:
    """Draw the plot if it wasn't drawn of these figures; returns what was written."""
    if not stale_peers(root):
        return []
    drawn = bars(root)
    figure = Figure(figsize=(7.6, 0.36 * len(drawn) + 0.75), layout="constrained")
    figure.patch.set_alpha(0)
    ax = figure.add_subplot()
    ax.patch.set_alpha(0)
    ours = [name.startswith("Turbo-Pi") for name, _ in drawn]
    found = ax.barh(
        [name for name, _ in drawn],
        [ms for _, ms in drawn],
        color=[MEASURED if mine else MUTED for mine in ours],
        height=0.68,
    )
    ax.bar_label(found, [f"{_shown(ms)} ms" for _, ms in drawn], padding=4, color=TEXT, fontsize=10.5, weight="bold")
    ax.invert_yaxis()
    ax.margins(x=0.13, y=0.02)
    ax.set_xlabel("milliseconds a call, H = 10: less is better", color=TEXT, fontsize=10)
    ax.tick_params(colors=TEXT, labelsize=10.5, length=0)
    for label, mine in zip(ax.get_yticklabels(), ours, strict=True):
        label.set_fontweight("bold" if mine else "normal")
    for side in ax.spines.values():
        side.set_visible(False)
    write_figure(root / PLOT, figure, 150, about={DRAWN_OF: _fingerprint(root)})
    return compacted([root / PLOT])


def stale_peers(root: Path) -> list[str]:
    """One line if the plot is missing, or was drawn of other figures."""
    if not (root / RESULTS / RUNS[0]).is_file():
        return []
    if not (root / PLOT).is_file():
        return [f"{PLOT.as_posix()}: there is no such plot; run scripts/tables"]
    with Image.open(root / PLOT) as image:
        drawn_of = image.info.get(DRAWN_OF)
    if drawn_of != _fingerprint(root):
        return [f"{PLOT.as_posix()}: drawn of other figures than the runs have; run scripts/tables"]
    return []


def _fingerprint(root: Path) -> str:
    return hashlib.sha256(json.dumps(bars(root)).encode()).hexdigest()
