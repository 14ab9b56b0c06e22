"""What `turbopi doctor` looks at. Each check is a function that returns a row; none of them changes anything."""

import contextlib
import os
import platform
import shutil
import sys
from collections.abc import Iterator, Mapping
from importlib import metadata
from pathlib import Path
from typing import Any

from packaging.requirements import Requirement
from packaging.version import Version

from turbopi.cli.checkup import FULL_SIZE_GB, Level, Row, has_gpu, imported_torch
from turbopi.cli.gpu_checkups import check_gpu, check_triton
from turbopi.cli.ports import why_not_free
from turbopi.cli.typed import as_typed
from turbopi.support.errors import BackendUnavailable, TurboPiError
from turbopi.support.installation import install_command
from turbopi.support.processors import usable_processors
from turbopi.support.toolchain import missing_for_c, missing_for_cpp

MIN_PYTHON, MIN_TORCH = (3, 10), "2.8"
MIN_DISK_GB = 15.0


def examine(opened: Any, about_it: list[Row], *, tokenizer: str | None, port: int) -> Iterator[Row]:
    """Every check, in the order in which to mend things. `opened`, `about_it`: as `open_for_check`, or None and []."""
    yield check_python()
    yield check_packages()
    yield check_torch()
    yield from check_gpu()
    yield check_triton()
    yield check_compiler()
    yield check_cpu()
    yield check_memory(None if opened is None else weights_gb(opened))
    yield from about_it
    if opened is not None or not about_it:  # a checkpoint that can't be opened hides its tokenizer
        yield from check_tokenizer(tokenizer, opened)
    yield check_port(port)
    yield check_disk(Path.cwd())


def check_python() -> Row:
    found = f"{platform.python_version()} ({sys.executable})"
    if sys.version_info < MIN_PYTHON:
        return Row("FAIL", "Python", found, "install Python 3.10 or newer, and make the environment anew with it")
    return Row("OK", "Python", found)


def check_packages() -> Row:
    """Everything that Turbo-Pi requires is installed, and recent enough."""
    try:
        required = metadata.requires("turbopi") or []
        version = metadata.version("turbopi")
    except metadata.PackageNotFoundError:
        return Row("WARN", "packages", "turbopi itself isn't installed", install_command())
    problems = []
    for requirement in map(Requirement, required):
        if requirement.marker is not None and not requirement.marker.evaluate({"extra": ""}):
            continue
        try:
            installed = metadata.version(requirement.name)
        except metadata.PackageNotFoundError:
            problems.append(f"{requirement.name} is missing")
            continue
        if not requirement.specifier.contains(installed, prereleases=True):
            problems.append(f"{requirement.name} is {installed}, not {requirement.specifier}")
    if problems:
        return Row("FAIL", "packages", "; ".join(problems), install_command())
    return Row("OK", "packages", f"turbopi {version} and all that it requires")


def system() -> dict[str, Any]:
    """The operating system, and the versions of what Turbo-Pi requires and its extras may: for reports."""
    try:
        names = {Requirement(one).name for one in metadata.requires("turbopi") or []}
    except metadata.PackageNotFoundError:
        names = set()
    found = {}
    for name in sorted(names | {"turbopi"}):
        with contextlib.suppress(metadata.PackageNotFoundError):
            found[name] = metadata.version(name)
    return {"platform": platform.platform(), "packages": found}


def check_torch() -> Row:
    try:
        import torch
    except Exception as error:  # a broken installation raises anything
        return Row("FAIL", "PyTorch", f"can't be imported: {error}", "pip install --force-reinstall 'torch>=2.8'")
    build = f"CUDA {torch.version.cuda}" if torch.version.cuda else "ROCm" if torch.version.hip else "CPU only"
    found = f"{torch.__version__} ({build})"
    if Version(torch.__version__) < Version(MIN_TORCH):
        return Row("FAIL", "PyTorch", found, "pip install --upgrade 'torch>=2.8'")
    return Row("OK", "PyTorch", found)


def check_compiler() -> Row:
    """Triton builds its launcher with a C compiler, torch.compile its CPU code with a C++ one."""
    found = [path for name in ("gcc", "g++", "clang", "clang++") if (path := shutil.which(name))]
    missing = missing_for_cpp() or missing_for_c()
    if missing is None:
        return Row("OK", "C compiler", ", ".join(found))
    what, _, mend = missing.removesuffix(")").partition(" (")
    return Row("WARN", "C compiler", what, f"{mend} (for pytorch_compile and Triton kernels)")


def check_cpu() -> Row:
    import psutil

    torch = imported_torch()
    cores = psutil.cpu_count(logical=False)
    usable = usable_processors()
    threads = None if torch is None else torch.get_num_threads()
    used = f"{threads} threads" if threads != 1 else "1 thread"
    found = f"{cores or '?'} cores, {usable} usable CPUs, PyTorch uses {used}"
    if threads is not None and threads > usable:
        return Row("WARN", "CPU", found, f"set OMP_NUM_THREADS={usable}: more threads than CPUs are slow")
    load = psutil.getloadavg()[0]
    if load > usable:
        busy = f"{found}; the load is {load:.1f}, so other programs use them, too"
        return Row("WARN", "CPU", busy, "stop other programs: they make every call on the CPU slower")
    return Row("OK", "CPU", found)


def weights_gb(opened: Any) -> dict[str, float]:
    """Gigabytes of a checkpoint's weights, by the precisions that it can be loaded in; the least first."""
    if (kept := own_precision(opened)) is not None:
        return {kept: opened.stored_bytes / 1e9}
    parameters = opened.info()["parameters"]["total"]
    return {"bf16": 2e-9 * parameters, "f32": 4e-9 * parameters}


def check_memory(weights: Mapping[str, float] | None) -> Row:
    """Host memory against the weights: a checkpoint's (`weights_gb`), or the full-size model's."""
    import psutil

    available = psutil.virtual_memory().available / 1e9
    limit = cgroup_limit_gb()
    found = f"{available:.1f} GB free" + (f", at most {limit:.1f} GB allowed here" if limit is not None else "")
    usable = min(available, limit) if limit is not None else available
    need = FULL_SIZE_GB if weights is None else weights
    what = "full size" if weights is None else "this checkpoint"
    needs = f"{what} takes {', '.join(f'{_size(size)} in {name}' for name, size in need.items())}"
    least, most = min(need.values()), max(need.values())
    if usable < least:
        level: Level = "FAIL" if weights is not None and not has_gpu() else "WARN"
        fix = f"{needs}: free memory" + (", or load it onto a GPU" if has_gpu() else ", or use a larger machine")
        return Row(level, "memory", found, fix)
    if usable < most:
        return Row("OK", "memory", f"{found}; {needs}: enough for bf16 alone")
    return Row("OK", "memory", f"{found}; {needs}")


def _size(gigabytes: float) -> str:
    if gigabytes >= 0.1:
        return f"{gigabytes:.1f} GB"
    return f"{1e3 * gigabytes:.0f} MB" if gigabytes >= 1e-3 else f"{1e6 * gigabytes:,.0f} kB"


def cgroup_limit_gb(root: Path = Path("/sys/fs/cgroup")) -> float | None:
    """A container's memory limit; None if there is none."""
    for name in ("memory.max", "memory/memory.limit_in_bytes"):
        try:
            text = (root / name).read_text().strip()
        except OSError:
            continue
        if text.isdigit() and int(text) < 2**60:
            return int(text) / 1e9
    return None


def open_for_check(path: str, config: str | None, device: str) -> tuple[Any, list[Row]]:
    """The opened checkpoint (None if it can't be), and its rows."""
    from turbopi import backends
    from turbopi.checkpoint import open_checkpoint
    from turbopi.policy.kept_precision import check_backend

    try:
        opened = open_checkpoint(path, "auto" if config is None else config)
    except TurboPiError as error:
        return None, [Row("FAIL", "checkpoint", as_typed(str(error)), "see the message")]
    info = opened.info()
    found = (
        f"{info['path']}: {info['format']}, {info['kind']}, {info['name']} for {info['robot']}, "
        f"{_millions(info['parameters']['total'])} parameters"
    )
    rows = [Row("OK", "checkpoint", found)]
    if (kept := own_precision(opened)) is not None:
        try:
            check_backend("fused", backends.resolve_device(device), kept, opened)
        except BackendUnavailable as error:
            rows.append(Row("FAIL", "precision", as_typed(str(error)), "see the message"))
        else:
            rows.append(Row("OK", "precision", f"{kept}, which the folder's weights are in"))
    return opened, rows


def _millions(count: int) -> str:
    return f"{count / 1e6:,.0f} M" if count >= 1e6 else f"{count:,}"


def own_precision(opened: Any) -> Any:
    """What an opened checkpoint's weights run in alone; None where there is a choice, or no checkpoint."""
    if opened is None:  # nor, maybe, a PyTorch that can be imported
        return None
    from turbopi.checkpoint.quantized_folder import precision_kept

    return precision_kept(opened)


def check_tokenizer(given: str | None, checkpoint: Any) -> list[Row]:
    """Where UnifiedPolicy would find its tokenizer. Without a checkpoint, its absence is only a warning.

    Of a checkpoint whose model writes its actions as tokens also the action tokenizer.
    """
    from turbopi.config import ModelConfig
    from turbopi.preprocess.tokenizer import load_tokenizer, tokenizer_of

    try:
        if checkpoint is None:
            loaded = load_tokenizer(given, vocab_size=ModelConfig().vocab_size)
        else:
            loaded = tokenizer_of(checkpoint, given)
    except TurboPiError as error:
        first, *rest = as_typed(str(error)).splitlines()
        fix = " && ".join(line.strip() for line in rest if "curl" in line or "mkdir" in line) or "see the message"
        if checkpoint is None and given is None:
            return [Row("WARN", "tokenizer", "PaliGemma's isn't here; a real checkpoint needs it", fix)]
        rows = [Row("FAIL", "tokenizer", first.removesuffix(". Looked for:"), fix)]
    else:
        rows = [Row("OK", "tokenizer", loaded.source)]
    return rows if checkpoint is None else [*rows, *_action_tokenizer(checkpoint)]


def _action_tokenizer(checkpoint: Any) -> list[Row]:
    from turbopi.preprocess.answers import action_tokenizers_of

    try:
        found = action_tokenizers_of(checkpoint)
    except TurboPiError as error:
        text, _, fix = as_typed(str(error)).partition(". Fetch it: ")
        return [Row("FAIL", "action tokenizer", text, fix or "see the message")]
    return [Row("OK", "action tokenizer", str(one)) for one in found[:1]]


def check_port(port: int) -> Row:
    reason = why_not_free("127.0.0.1", port)
    if reason is not None:
        return Row("WARN", f"port {port}", f"can't be listened on: {reason}", "turbopi serve --port N with another one")
    return Row("OK", f"port {port}", "free")


def check_disk(folder: Path) -> Row:
    free = shutil.disk_usage(folder).free / 1e9
    found = f"{free:.0f} GB free in {folder}"
    if free < MIN_DISK_GB:
        need = f"a full-size checkpoint takes {FULL_SIZE_GB['bf16']} GB in bf16, {FULL_SIZE_GB['f32']} GB in f32"
        return Row("WARN", "disk", found, f"{need}: free some, or convert into another folder")
    if not os.access(folder, os.W_OK):
        return Row("WARN", "disk", f"{folder} isn't writable", "work in a folder of yours: reports are written to it")
    return Row("OK", "disk", found)
