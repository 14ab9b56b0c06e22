"""Whether a checked-in result of scripts/gpu_check belongs to the code as it is.

CI has no GPU, so all that it knows of the GPU tests is result files, one a GPU and date. Each carries a hash of each
source file that runs on the GPU, decides what is launched there, or judges it. A CPU test compares them with the tree.
Comments, docstrings, blank lines and the texts of errors don't count.
"""

import ast
import hashlib
import re
from functools import lru_cache
from pathlib import Path

from msgspec import UNSET, Struct, UnsetType

from turbopi.support.errors import ConfigError
from turbopi.support.provenance import Provenance
from turbopi.support.reading import read_document
from turbopi.support.source_code import code_of

ROOT = Path(__file__).resolve().parent.parent
RESULTS = ROOT / "benchmarks/results"
PENDING = RESULTS / "gpu_check_pending.json"
NAME = "gpu_check.json"  # of h200_2026-11-27_gpu_check.json

# Files whose code runs on the GPU, or decides what does.
PRODUCT = tuple(
    f"src/turbopi/{glob}"
    for glob in (
        *(
            "kernels/**/*",
            "engine/*",
            "models/*",
            "models/pi0/*",
            "models/pi0_fast/*",
            "models/smolvla/*",
            "backends/*",
        ),
        *(f"backends/tensorrt/{name}.py" for name in ("backend", "fp8", "pipelined")),
        *("quantization/*", "calibrate/*", "config.py", "verify/check_golden.py"),
    )
)
# Modules that only read files, format text or hand tensors on: CPU tests see all of what they do.
HOST_ONLY = (
    *("turbopi", "turbopi.checkpoint", "turbopi.preprocess", "turbopi.robots", "turbopi.policy", "turbopi.support"),
    *("turbopi.recordings", "turbopi.verify.golden", "turbopi.realtime.running_chunk"),
    *("turbopi.backends.qualification", "turbopi.backends.qualifying"),  # files, and a process that is watched
    "turbopi.backends.tensorrt",  # engines: TensorRT's own code
    *("turbopi.backends.onnx", "turbopi.backends.onnx.backend"),  # refuses every device but the CPU
)
MARKED = re.compile(r"mark\.gpu|\bon_hopper\b|gpu_or_interpreter")


class GpuTests(Struct, frozen=True, omit_defaults=True):
    """Of the tests marked gpu; `failed` by name, `to_go`: not run yet, `file_seconds`: how long each file's took."""

    tests: int
    failures: int
    errors: int
    skipped: int
    seconds: float
    failed: list[str]
    to_go: list[str] = []
    file_seconds: dict[str, float] = {}


class GoldenCheck(Struct, frozen=True):
    """A backend's verdict by scripts/check_golden: what was compared by precision, or the `error` that ended it."""

    ok: bool
    error: str | UnsetType = UNSET
    judged: int | UnsetType = UNSET
    failed: int | UnsetType = UNSET
    compared: dict[str, list[str]] | UnsetType = UNSET
    actions_f32_max: float | UnsetType | None = UNSET  # None: wasn't compared
    actions_bf16_relative_rms: float | UnsetType | None = UNSET


class GpuCheck(Struct, frozen=True):
    """The result file of scripts/gpu_check. Hashes: by file, by shape; machine_code None without NVRTC."""

    ok: bool
    provenance: Provenance
    tests: GpuTests
    golden: dict[str, GoldenCheck]
    fingerprint: dict[str, str]
    machine_code: dict[str, str] | None


class GpuCheckPending(Struct, frozen=True):
    """Code that waits for a GPU, and why."""

    reason: str
    date: str
    fingerprint: dict[str, str]
    machine_code: dict[str, str] | None


def gpu_test_files() -> list[Path]:
    """The test files with tests that need a GPU."""
    return [path for path in sorted((ROOT / "tests").glob("test_*.py")) if MARKED.search(path.read_text())]


def product_files() -> list[Path]:
    found = {path for glob in PRODUCT for path in ROOT.glob(glob) if path.suffix in (".py", ".cu")}
    return sorted(found - {_file_of(module) for module in HOST_ONLY})


def fingerprint() -> dict[str, str]:
    """{file, relative to the repository: hash of its code} for the product's files and the GPU tests."""
    judging = [ROOT / "tools/kernel_turns" / name for name in ("problems.py", "portable.py", "ptx.py", "triton_ptx.py")]
    files = [*product_files(), *gpu_test_files(), *judging]
    return {str(path.relative_to(ROOT)): _hash_of(path, path.stat().st_mtime_ns) for path in files}


@lru_cache(1024)
def _hash_of(path: Path, changed: int) -> str:
    return hashlib.sha256(code_of(path, errors=False).encode()).hexdigest()[:16]


def imported_by(path: Path) -> set[str]:
    """The modules of ours that a file imports, also inside functions, or names in a string, as lazy imports do."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            found.add(node.value)
    return {name for name in found if re.fullmatch(r"turbopi(\.\w+)*", name) and _file_of(name) is not None}


def _file_of(module: str) -> Path | None:
    place = ROOT / "src" / module.replace(".", "/")
    return next((file for file in (place.with_suffix(".py"), place / "__init__.py") if file.is_file()), None)


def uncovered_imports() -> dict[str, list[str]]:
    """{module: the product's files that import it} for modules that are neither in the fingerprint nor HOST_ONLY."""
    covered = {*product_files()}
    missing: dict[str, list[str]] = {}
    for path in sorted(covered):
        for module in imported_by(path) if path.suffix == ".py" else ():
            if _file_of(module) not in covered and not any(f"{module}.".startswith(f"{one}.") for one in HOST_ONLY[1:]):
                missing.setdefault(module, []).append(str(path.relative_to(ROOT)))
    missing.pop("turbopi", None)
    return missing


def changed_since(recorded: dict[str, str]) -> list[str]:
    """The files whose code isn't what `recorded` (a fingerprint) says, new and removed ones too.

    A file that was recorded, and by today's rules runs on the host alone, doesn't count.
    """
    now = fingerprint()
    host_only = {str(file.relative_to(ROOT)) for file in map(_file_of, HOST_ONLY) if file is not None}
    return sorted(name for name in {*now, *recorded} - host_only if now.get(name) != recorded.get(name))


def result_file(gpu: str, date: str) -> Path:
    """Where a result of that GPU, such as "NVIDIA H200", and date is checked in."""
    name = "_".join(re.findall(r"\w+", gpu.lower().replace("nvidia", "").replace("geforce", "")))
    return RESULTS / f"{name}_{date}_{NAME}"


def result_files() -> list[Path]:
    """The checked-in results, oldest first."""
    return sorted(RESULTS.glob(f"*_{NAME}"), key=lambda path: path.name.removesuffix(f"_{NAME}").split("_")[-1])


def read_result(file: Path) -> GpuCheck:
    """Raises ConfigError for a file of another kind, as `pending` does."""
    return read_document(file, GpuCheck, ConfigError)


def pending() -> GpuCheckPending | None:
    """What `scripts/gpu_check --pending` wrote, if anything."""
    return read_document(PENDING, GpuCheckPending, ConfigError) if PENDING.is_file() else None
