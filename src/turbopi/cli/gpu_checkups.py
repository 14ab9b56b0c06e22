"""What `turbopi doctor` says of NVIDIA GPUs: driver, PyTorch's build, compilers, and what will run on each.

Which backend runs in which precision is asked of the backends themselves.
"""

import importlib
import importlib.util
import re
import shutil
import subprocess
from collections.abc import Iterator, Mapping
from importlib import metadata
from pathlib import Path
from typing import Any

from packaging.version import Version

from turbopi.cli.checkup import FULL_SIZE_GB, Row, has_gpu, imported_torch
from turbopi.cli.typed import as_typed
from turbopi.support.errors import TurboPiError
from turbopi.support.toolchain import PTXAS_BLACKWELL_VARIABLE, PTXAS_VARIABLE, cuda_13_ptxas

MIN_CAPABILITY = (8, 0)  # the first with bfloat16 tensor cores
MIN_DRIVER = {11: 450, 12: 525, 13: 580}  # by CUDA's major version: NVIDIA's CUDA compatibility guide
CONTEXT_GB = 0.6  # what CUDA itself takes of a GPU's memory
ACTIVATIONS_GB = 1.5  # beside the weights, where nobody measured
# The first ptxas that knows a compute capability: NVIDIA's PTX documentation. 11.0 was 10.1 before CUDA 13
MIN_PTXAS = {(9, 0): "12.0", (10, 0): "12.7", (10, 3): "12.9", (11, 0): "13.0", (12, 0): "12.8", (12, 1): "12.9"}
_CUDA_12 = "pip install --force-reinstall 'torch>=2.8' --index-url https://download.pytorch.org/whl/cu128"
_CUDA_13 = "pip install --force-reinstall 'torch>=2.9' --index-url https://download.pytorch.org/whl/cu130"
_JETSON = "docker build -t turbopi:jetson -f docker/Dockerfile.jetson ."


def check_gpu() -> Iterator[Row]:
    """Driver and GPUs, and what runs on each; or why there are none."""
    torch = imported_torch()
    if torch is None:
        return
    driver, names = nvidia_smi()
    if not torch.cuda.is_available():
        yield no_gpu(torch.version.cuda, driver, names, jetson())
        return
    if driver is not None:
        yield judge_driver(driver, torch.version.cuda)
    supported = torch.cuda.get_arch_list()
    yield judge_cuda(torch.version.cuda, installed("cuda-bindings"))
    for index in range(torch.cuda.device_count()):
        properties = torch.cuda.get_device_properties(index)
        capability, memory_gb = (properties.major, properties.minor), properties.total_memory / 1e9
        shared = bool(getattr(properties, "is_integrated", False))
        row = judge_gpu(index, properties.name, capability, memory_gb, supported, shared=shared)
        yield row
        if row.level != "FAIL":
            yield from what_runs(index, capability, memory_gb)


def judge_driver(driver: str, cuda: str | None) -> Row:
    least = _least_driver(cuda)
    if _major(driver) < least:
        text = f"{driver}; this PyTorch's CUDA {cuda} needs {least} or newer"
        return Row("WARN", "NVIDIA driver", text, _older_cuda(driver, least))
    return Row("OK", "NVIDIA driver", driver)


def _least_driver(cuda: str | None) -> int:
    return MIN_DRIVER.get(_major(cuda or ""), MIN_DRIVER[12])


def _older_cuda(driver: str, least: int) -> str:
    """What to do about a driver that is older than PyTorch's CUDA wants."""
    if _major(driver) >= MIN_DRIVER[12]:
        return f"{_CUDA_12} (or update the NVIDIA driver to {least} or newer)"
    return f"update the NVIDIA driver to {least} or newer"


def _major(version: str) -> int:
    """0 for what begins with no number."""
    found = re.match(r"\d+", version)
    return int(found[0]) if found else 0


def judge_cuda(cuda: str | None, bindings: str | None) -> Row:
    """Whether cuda.bindings, which loads NVRTC, is for the CUDA of PyTorch. `bindings`: its version, if it is there."""
    if cuda is None or bindings is None or _major(cuda) == _major(bindings):
        return Row("OK", "CUDA", f"PyTorch {cuda}, cuda-bindings {bindings or 'not installed'}")
    found = f"PyTorch is built for CUDA {cuda}, cuda-bindings {bindings} for CUDA {_major(bindings)}"
    return Row("WARN", "CUDA", found, f"pip install 'cuda-bindings=={_major(cuda)}.*'")


def judge_gpu(
    index: int,
    name: str,
    capability: tuple[int, int],
    memory_gb: float,
    supported: list[str],
    *,
    shared: bool = False,
) -> Row:
    """One GPU: whether PyTorch has code for it, and bfloat16. `shared`: its memory is the host's, as on Jetson."""
    major, minor = capability
    found = f"{name}, compute capability {major}.{minor}, {memory_gb:.0f} GB" + (", the host's memory" * shared)
    label = f"GPU {index}"
    known = [re.sub(r"\D", "", arch) for arch in supported]
    # code for 8.0 runs on 8.6; a PTX ("compute_90") runs on anything newer
    runs = any(arch[:-1] == str(major) and int(arch[-1]) <= minor for arch in known if arch)
    ptx = [int(re.sub(r"\D", "", arch)) for arch in supported if arch.startswith("compute_")]
    if supported and not runs and not any(major * 10 + minor >= arch for arch in ptx):
        return Row("FAIL", label, f"{found}; this PyTorch has no code for it", _JETSON if shared else _CUDA_13)
    if capability < MIN_CAPABILITY:
        return Row("WARN", label, found, "bfloat16 is slow below 8.0 (Ampere): use a newer GPU")
    return Row("OK", label, found)


def what_runs(index: int, capability: tuple[int, int], memory_gb: float) -> Iterator[Row]:
    """The backend that `auto` takes on a GPU, by precision, whether its memory is enough, and what is missing."""
    torch = imported_torch()
    from turbopi import backends

    yield from judge_compilers(index, capability)
    device = torch.device("cuda", index)
    tiers = ("bf16", "fp8", "int8")
    fitting: dict[str, float] = {
        tier: need for tier in tiers if (need := needed_gb(device, tier)) is not None and need <= memory_gb
    }
    for tier in tiers:
        yield judge_precision(f"GPU {index} {tier}", device, tier, memory_gb, fitting)
    if backends.availability("fused", device) is None:
        yield judge_tiles(f"GPU {index} tiles", device)
        yield judge_qualified(f"GPU {index} known", device)


def judge_precision(name: str, device: Any, precision: Any, memory_gb: float, fitting: Mapping[str, float]) -> Row:
    """One precision on one GPU. `fitting`: the precisions that run there and fit, with the gigabytes that they need."""
    from turbopi import backends

    chosen, why = backends.choose(device, precision)
    why = as_typed(why.removeprefix("auto: "))
    try:
        backends.check(chosen, device, precision)
    except TurboPiError as error:
        fix = command_in(str(error))
        return Row("WARN" if fix else "OK", name, f"doesn't run: {as_typed(str(error))}", fix)
    need = needed_gb(device, precision)
    assert need is not None
    found = f"{chosen}: {why}; full size takes {need:.1f} GB"
    if need > memory_gb:
        fix = f"a GPU with {need:.0f} GB or more; --random-weights pi05_tiny runs here"
        if fitting:
            other, size = next(iter(fitting.items()))
            fix = f"turbopi calibrate CHECKPOINT --precision {other}, then --precision {other} ({size:.1f} GB)"
        return Row("WARN", name, f"{found}, more than there is", fix)
    faster = backends.availability("fused", device) if chosen != "fused" else None
    fix = "" if faster is None else command_in(faster)
    return Row("WARN" if fix else "OK", name, found, fix)


def judge_tiles(name: str, device: Any) -> Row:
    """Which tiles the kernels of `fused` take: measured ones, and from when, or those of their cost model."""
    from turbopi.backends.tuned_tiles import Machine, find_tiles, tuned_off

    try:
        off = tuned_off()
    except TurboPiError as error:
        return Row("WARN", name, as_typed(str(error)), "unset TURBOPI_TUNED")
    tiles = find_tiles(Machine.of(device))
    if tiles.unused:
        return Row("WARN", name, as_typed("; ".join(tiles.unused)), "turbopi tune")
    found = f"{tiles.about}, but TURBOPI_TUNED=off has them ignored" if off and len(tiles.table) else tiles.about
    return Row("OK", name, found if len(tiles.table) else f"{found}; `turbopi tune` measures")


def judge_qualified(name: str, device: Any) -> Row:
    """Whether Turbo-Pi's tests ran on such a GPU, or what qualifying it said, of the full-size model."""
    from turbopi.backends import qualification
    from turbopi.config import ModelConfig

    if qualification.is_known(device):
        return Row("OK", name, "Turbo-Pi's own tests ran on such a GPU")
    verdict = qualification.kept(device, "bf16", ModelConfig())
    if verdict is None:
        fix = "turbopi doctor --qualify (the first policy does it, too, in a minute)"
        return Row("WARN", name, "Turbo-Pi's tests never ran on such a GPU, and it isn't qualified yet", fix)
    file = qualification.file_of(device, "bf16", ModelConfig())
    found = f"{verdict.taken} for pi05_base in bf16, qualified {verdict.date}: {verdict.summary}; {file}"
    fix = verdict.issue(file) or ("turbopi doctor --qualify" if verdict.unfinished else "")
    return Row("WARN" if fix else "OK", name, as_typed(found), fix)


def needed_gb(device: Any, precision: Any) -> float | None:
    """What a full-size policy takes of the GPU, CUDA's own part included: as measured, else counted.

    None if the precision doesn't run there.
    """
    from turbopi import backends
    from turbopi.bench.measured import measured_calls

    chosen = backends.choose(device, precision)[0]
    alike = "fp8" if precision == "int8" else precision  # a byte a weight, either way
    try:
        backends.check(chosen, device, precision)
    except TurboPiError:
        return None
    measured = [
        call.device_bytes / 1e9
        for call in measured_calls()
        if (call.backend, call.precision, call.job.batch) == (chosen, alike, 1) and call.device_bytes is not None
    ]
    return max(measured, default=FULL_SIZE_GB["bf16"] + ACTIVATIONS_GB) + CONTEXT_GB


def command_in(reason: str) -> str:
    """The command that a backend's reason names; nothing if mending isn't a command."""
    for pattern in (r"`((?:pip|apt-get) [^`]+)`", r"((?:pip|apt-get) install [\w+ .-]*\w)"):
        if found := re.search(pattern, reason):
            return found[1]
    return ""


def judge_compilers(index: int, capability: tuple[int, int]) -> Iterator[Row]:
    """A row for each compiler that is there and doesn't know the GPU: Triton's ptxas, and NVRTC."""
    name = f"GPU {index} code"
    arch = f"{capability[0]}.{capability[1]}"
    least, ptxas = MIN_PTXAS.get(capability), ptxas_version(10 * capability[0] + capability[1])
    if importlib.util.find_spec("triton") is not None and (
        ptxas is None or (least is not None and Version(ptxas) < Version(least))
    ):
        found = "has no ptxas" if ptxas is None else f"has ptxas {ptxas}"
        needs = f"; compute capability {arch} needs " + ("one" if least is None else f"{least} or newer")
        yield Row("WARN", name, f"Triton {found}{needs}", newer_ptxas(capability))
    known = nvrtc_capabilities()
    if known and 10 * capability[0] + capability[1] not in known:
        fix = "pip install --upgrade nvidia-cuda-nvrtc"
        yield Row("WARN", name, f"NVRTC knows no compute capability {arch}", fix)


def newer_ptxas(capability: tuple[int, int]) -> str:
    """CUDA 13's ptxas, of NVIDIA's wheel, for Triton."""
    variable = PTXAS_BLACKWELL_VARIABLE if capability >= (10, 0) else PTXAS_VARIABLE
    return f"pip install --no-deps 'nvidia-cuda-nvcc>=13,<14' && export {variable}='{cuda_13_ptxas()}'"


def ptxas_version(arch: int) -> str | None:
    """Of the ptxas that Triton would take for an architecture (120); None where it has none."""
    try:
        compiler = importlib.import_module("triton.backends.nvidia.compiler")
        return str(compiler.get_ptxas(arch).version)
    except Exception:  # not there, not executable, or asked for in another way by another Triton
        return None


def nvrtc_capabilities() -> list[int]:
    """Those that NVRTC compiles for (120); none where it isn't there."""
    try:
        nvrtc = importlib.import_module("cuda.bindings.nvrtc")
        return [int(arch) for arch in nvrtc.nvrtcGetSupportedArchs()[1]]
    except Exception:
        return []


def no_gpu(cuda: str | None, driver: str | None, names: list[str], board: str | None) -> Row:
    """Why PyTorch sees no GPU. `cuda`: of its build; `names`: what nvidia-smi lists; `board`: a Jetson's name."""
    if board is not None:
        built = "is built without CUDA" if cuda is None else f"(CUDA {cuda}) can't use it"
        return Row("FAIL", "GPU", f"{board}, but this PyTorch {built}", _JETSON)
    if not names:
        instead = "none needed for pi05_tiny, tests and development; real time needs one"
        return Row("WARN", "GPU", "no NVIDIA GPU", instead)
    there = ", ".join(names)
    if cuda is None:
        fix = (
            "delete .venv and run scripts/setup again; in an environment of your own: pip install --force-reinstall "
            "torch (on Linux PyPI's wheels have CUDA)"
        )
        return Row("FAIL", "GPU", f"{there}, but this PyTorch is built without CUDA", fix)
    least = _least_driver(cuda)
    if driver is not None and 0 < _major(driver) < least:
        found = f"{there}, but driver {driver} is too old for this PyTorch: CUDA {cuda} needs {least} or newer"
        return Row("FAIL", "GPU", found, _older_cuda(driver, least))
    return Row(
        "FAIL",
        "GPU",
        f"{there} (driver {driver}), but PyTorch (CUDA {cuda}) can't use it",
        "see that CUDA_VISIBLE_DEVICES and the container (docker run --gpus all) let the GPU through",
    )


def jetson(tree: Path = Path("/proc/device-tree/model")) -> str | None:
    """The name of the Jetson that this is; None elsewhere."""
    try:
        name = tree.read_bytes().rstrip(b"\0").decode(errors="replace")
    except OSError:
        return None
    return name if "jetson" in name.lower() else None


def nvidia_smi() -> tuple[str | None, list[str]]:
    """Driver version and GPU names as nvidia-smi tells them; nothing if it isn't there or fails."""
    program = shutil.which("nvidia-smi")
    if program is None:
        return None, []
    query = [program, "--query-gpu=driver_version,name", "--format=csv,noheader"]
    try:
        lines = subprocess.run(query, capture_output=True, text=True, timeout=20, check=True).stdout.splitlines()
    except (OSError, subprocess.SubprocessError):
        return None, []
    pairs = [line.split(",", 1) for line in lines if "," in line]
    return (pairs[0][0].strip() if pairs else None), [name.strip() for _, name in pairs]


def installed(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def check_triton() -> Row:
    if importlib.util.find_spec("triton") is None:
        if has_gpu():
            return Row("FAIL", "Triton", "missing", "pip install triton")
        return Row("OK", "Triton", "not installed; only GPUs need it")
    try:
        return Row("OK", "Triton", str(importlib.import_module("triton").__version__))
    except Exception as error:
        return Row("FAIL", "Triton", f"can't be imported: {error}", "pip install --force-reinstall triton")
