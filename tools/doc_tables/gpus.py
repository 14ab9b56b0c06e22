"""The tables of docs/gpus.md: what was done for each GPU, what runs there, what it may take.

Numbers of GPUs are data/gpus.json's. What was run is told by the checked-in results' own provenance, what was compiled
or run as PTX by the files named below, as soon as they are there. What runs where is asked of the backends, which look
at a device of that compute capability that isn't there.
"""

import json
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from unittest.mock import patch

import torch
from compile_for_all.document import read_compiled
from msgspec import structs
from packed import content_of

from turbopi import backends
from turbopi.backends import Precision, qualification
from turbopi.backends.qualification import Verdict
from turbopi.bench.gpus import GpuSpec, published_gpus
from turbopi.bench.measured import measured_calls
from turbopi.bench.predict import Prediction, predict
from turbopi.bench.work import Job
from turbopi.cli.predict import call_text
from turbopi.config import ModelConfig
from turbopi.support.errors import ConfigError, TurboPiError
from turbopi.support.reading import read_document

RESULTS = Path(__file__).parents[2] / "benchmarks" / "results"
TESTED = "*_gpu_check.json"
COMPILED, AS_PTX = "compiled_for_all.json.xz", "h?00_*_ptx.json*"  # the second of an H100 or H200; its newest counts
DEVICE = torch.device("cuda", 0)
RACED = ("fused", "cuda_graph")
QUALIFIED = " *"  # behind what `auto` takes where it isn't qualified: then it may be `fused`
REPORTS = "qualified/*.json"  # as users' machines wrote them
TIERS: tuple[Precision, ...] = ("bf16", "fp8", "int8")


@contextmanager
def pretended(gpu: GpuSpec) -> Iterator[None]:
    """One such GPU, with every package and compiler there: hardware alone decides."""
    found = lambda name, *rest: object()  # noqa: E731
    with (
        patch.object(torch.cuda, "is_available", lambda: True),
        patch.object(torch.cuda, "get_device_capability", lambda device=None: gpu.capability),
        patch.object(qualification, "is_known", lambda device: is_known(gpu)),
        patch.object(backends, "is_known", lambda device: is_known(gpu)),
        patch.object(qualification, "kept", lambda device, precision, model: None),
        patch("importlib.util.find_spec", found),
        patch.object(shutil, "which", lambda name, *rest: f"/usr/bin/{name}"),
        patch("turbopi.support.toolchain._missing_headers", lambda: None),
    ):
        yield


def is_known(gpu: GpuSpec) -> bool:
    """Whether Turbo-Pi's own tests ran on it, so that `auto` takes `fused` without qualifying it."""
    return any(gpu.key in name.lower().split() for name in qualification.KNOWN)


def runs(gpu: GpuSpec) -> dict[str, str]:
    """Precision -> the backend that `auto` takes on it, before anybody qualifies it; "no" where none runs."""
    found: dict[str, str] = {}
    with pretended(gpu):
        for precision in TIERS:
            name = backends.choose(DEVICE, precision)[0]
            try:
                backends.check(name, DEVICE, precision)
            except TurboPiError:
                name = "no"
            found[precision] = name if name == "no" else f"`{name}`"
    return found


def refusals(gpu: GpuSpec) -> dict[str, str]:
    """What is refused on a GPU -> why, in the backends' words."""
    found = {}
    with pretended(gpu):
        for precision in TIERS:
            name = backends.choose(DEVICE, precision)[0]
            try:
                backends.check(name, DEVICE, precision)
            except TurboPiError as error:
                found[f"{precision}: refused"] = str(error).partition(f" on {DEVICE}: ")[2] or str(error)
    return found


def rows_of(file: Path) -> list[dict[str, object]]:
    """The `rows` of a result file, each of a kernel for a `target`; none where the file isn't there yet."""
    if not file.is_file():
        return []
    document = json.loads(content_of(file))
    rows = document.get("rows", []) if isinstance(document, dict) else []
    return [row for row in rows if isinstance(row, dict) and "target" in row]


def ran_as_ptx(gpu: GpuSpec, results: Path) -> str:
    """How many cases of kernels as PTX for this GPU, or an older one, a newer GPU computed right."""
    files = sorted(results.glob(AS_PTX), key=lambda file: file.name.split("_")[1:])
    number = gpu.capability[0] * 10 + gpu.capability[1]
    rows = [row for row in rows_of(files[-1]) if target_number(row) <= number] if files else []
    return counted(rows) or "not run yet"


def compiled_for(gpu: GpuSpec, results: Path) -> str:
    """How many kernels are fit for a GPU, of those that are meant for it."""
    number = gpu.capability[0] * 10 + gpu.capability[1]
    if not (results / COMPILED).is_file():
        return "no"
    rows = (structs.asdict(row) for row in read_compiled(results / COMPILED).rows if not row.refused)
    return counted([row for row in rows if target_number(row) == number]) or "no"


def target_number(row: dict[str, object]) -> int:
    """80 of "sm_80" and "compute_80", 120 of "sm_120a"."""
    return int(re.sub(r"\D", "", str(row["target"])))


def counted(rows: list[dict[str, object]]) -> str:
    """How many rows have no problem, and of how many if some have one; nothing for none."""
    fit = sum(not row.get("problem") for row in rows)
    return "" if not rows else f"{fit}" if fit == len(rows) else f"{fit} of {len(rows)}"


def was_run(gpu: GpuSpec, results: Path) -> str:
    """What of checked-in results was run on it: by the GPU's name that is in them."""
    found = []
    for file in results.glob(TESTED):
        document = json.loads(file.read_text(encoding="utf-8"))
        name = str(document["provenance"].get("gpu", {}).get("name", ""))
        if document["ok"] and re.search(rf"\b{gpu.key}\b", name.lower()):
            found = ["GPU tests"]
    if any(call.gpu == gpu.key for call in measured_calls()):
        found.append("speed")
    return ", ".join(found) or "no"


def gpus(results: Path = RESULTS) -> list[str]:
    """Each GPU: what `auto` takes by precision, and what was run, run as PTX, compiled."""
    heads = ["GPU", "compute capability", *TIERS, "run", "run as PTX on Hopper", "kernels compiled"]
    lines = [f"| {' | '.join(heads)} |", "|" + "---|" * len(heads)]
    for gpu in published_gpus().values():
        taken, known = runs(gpu), is_known(gpu)
        cells = [gpu.name, gpu.compute_capability]
        cells += [f"{taken[one]}{'' if known or taken[one] == 'no' else QUALIFIED}" for one in TIERS]
        cells += [was_run(gpu, results), ran_as_ptx(gpu, results), compiled_for(gpu, results)]
        lines.append(f"| {' | '.join(cells)} |")
    return lines


def gpu_reports(results: Path = RESULTS) -> list[str]:
    """What users' machines found out by qualifying themselves, a line a report."""
    found = [read_document(file, Verdict, ConfigError) for file in results.glob(REPORTS)]
    if not found:
        return ["No report is here yet."]
    heads = (
        "| GPU | driver | model | precision | `fused` ms | `cuda_graph` ms | taken | excluded or failed | Turbo-Pi |"
    )
    lines = [heads, "|---|---|---|---|--:|--:|---|---|---|"]
    for one in sorted(found, key=lambda one: (one.gpu, one.model, one.precision, one.date)):
        times = [f"{one.milliseconds[name]['total']:.2f}" if name in one.milliseconds else "" for name in RACED]
        wrong = "; ".join([*([one.reason] if one.failed else []), *one.excluded]).replace("|", "/")
        about = [one.gpu, one.driver, one.model, one.precision, *times, one.taken or "nothing", wrong or "nothing"]
        lines.append(f"| {' | '.join([*about, one.versions.get('turbopi', '')])} |")
    return lines


def gpu_refusals() -> list[str]:
    """Why something doesn't run, and on which compute capabilities."""
    by_reason: dict[tuple[str, str], list[str]] = {}
    for gpu in sorted(published_gpus().values(), key=lambda gpu: gpu.capability):
        for what, why in refusals(gpu).items():
            said = re.sub(r"\b(this GPU has|compute capability) " + re.escape(gpu.compute_capability), r"\1 …", why)
            where = by_reason.setdefault((what, said), [])
            if gpu.compute_capability not in where:
                where.append(gpu.compute_capability)
    lines = ["| | compute capability | why |", "|---|---|---|"]
    return [*lines, *(f"| {what} | {', '.join(where)} | {why} |" for (what, why), where in by_reason.items())]


def gpu_predictions() -> list[str]:
    """Milliseconds of the main job: floors, and calls of each backend."""
    shown = {"bf16": ("cuda_graph", "fused"), "fp8": ("fused",), "int8": ("fused",)}
    heads = ["ms"]
    for precision, names in shown.items():
        label = precision if precision == "bf16" else precision.upper()
        heads += [f"{label} floor", *(f"{label} `{name}`" for name in names)]
    lines = [f"| {' | '.join(heads)} |", "|---|" + "--:|" * (len(heads) - 1)]
    for gpu in published_gpus().values():
        taken = runs(gpu)
        by_precision = {one.precision: one for one in predict(gpu, ModelConfig(), Job())}
        cells = [gpu.name]
        for precision, names in shown.items():
            one = by_precision.get(precision)
            if one is None or taken[precision] == "no":
                cells += [""] * (1 + len(names))
            else:
                cells += [f"{one.floor_ms['total']:.1f}", *(_call(one, name) for name in names)]
        lines.append(f"| {' | '.join(cells)} |")
    return lines


def _call(prediction: Prediction, backend: str) -> str:
    """The first call of a backend; nothing if none is predicted."""
    for call in prediction.calls:
        if call.backend == backend:
            return call_text(call) + (" (measured)" if prediction.was_measured(call) else "")
    return ""
