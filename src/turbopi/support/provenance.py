"""Where a figure comes from: hardware, clocks, Turbo-Pi's version and commit, versions of the rest."""

import os
import platform
import re
import subprocess
from datetime import datetime, timezone
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import torch
from msgspec import UNSET, Struct, UnsetType, field

from turbopi.version import turbopi_version

DRIVER_FILE = Path("/proc/driver/nvidia/version")
JETSON_FILE = Path("/etc/nv_tegra_release")
_GPU_FIELDS = ("name", "driver_version", "clocks.sm", "clocks.mem", "clocks_throttle_reasons.active", "temperature.gpu")


class Gpu(Struct, frozen=True, omit_defaults=True):
    """An NVIDIA GPU at one moment. What nvidia-smi tells is its own text; left out where there is no nvidia-smi."""

    compute_capability: str | None = None  # "9.0"
    multiprocessors: int | None = None
    memory_bytes: int | None = None
    cuda: str | None = None  # PyTorch's
    name: str | None = None
    driver_version: str | None = None
    clock_sm: str | None = field(default=None, name="clocks.sm")  # "345 MHz"
    clock_memory: str | None = field(default=None, name="clocks.mem")
    throttling: str | None = field(default=None, name="clocks_throttle_reasons.active")  # bits: "0x0000000000000001"
    temperature: str | None = field(default=None, name="temperature.gpu")  # degrees Celsius


class Cpu(Struct, frozen=True):
    machine: str  # "x86_64"
    name: str
    threads: int  # PyTorch's


class Provenance(Struct, frozen=True, kw_only=True):
    """What a result file says of where it comes from. UNSET: the file doesn't say, as older ones don't say all."""

    date: str  # "2026-11-24", UTC
    turbopi: str | UnsetType = UNSET
    python: str
    torch: str
    triton: str | UnsetType | None = UNSET  # None: not installed
    numpy: str | UnsetType | None = UNSET
    sentencepiece: str | UnsetType | None = UNSET
    commit: str  # "+" behind it: and changes
    device: str  # "cpu", "cuda:0"
    gpu: Gpu | UnsetType = UNSET
    cpu: Cpu | UnsetType = UNSET

    @property
    def device_name(self) -> str:
        """The GPU's name, else the CPU's."""
        if self.gpu and self.gpu.name:
            return self.gpu.name
        return self.cpu.name if self.cpu else "CPU"


def provenance(device: torch.device) -> Provenance:
    """For a result file; the clocks are those of the moment of the call."""
    return Provenance(
        date=datetime.now(timezone.utc).strftime("%Y-%m-%d"),
        turbopi=turbopi_version(),
        python=platform.python_version(),
        torch=str(torch.__version__),
        triton=_version("triton"),
        numpy=_version("numpy"),
        sentencepiece=_version("sentencepiece"),
        commit=_commit(),
        device=str(device),
        gpu=_gpu(device) if device.type == "cuda" else UNSET,
        cpu=Cpu(platform.machine(), _cpu_name(), torch.get_num_threads()) if device.type != "cuda" else UNSET,
    )


def driver_version() -> str:
    """NVIDIA's driver, such as "580.95.05": as the kernel tells it, else nvidia-smi; of a Jetson without either its
    system's release, such as "L4T 36.4.3"; else the CUDA that the driver knows, such as "CUDA 13.0". "unknown" without
    a driver.
    """
    try:
        found = re.search(r"\s(\d+\.\d+(?:\.\d+)?)\s", DRIVER_FILE.read_text())
    except OSError:
        found = None
    if found is not None:
        return found[1]
    lines = _output(["nvidia-smi", "--query-gpu=driver_version", "--format=csv,noheader"]).splitlines()
    if lines and lines[0].strip()[:1].isdigit():
        return lines[0].strip()
    try:
        release = re.match(r"# R(\d+) \(release\), REVISION: ([\d.]+)", JETSON_FILE.read_text())
    except OSError:
        release = None
    if release is not None:
        return f"L4T {release[1]}.{release[2]}"
    known = getattr(torch._C, "_cuda_getDriverVersion", lambda: 0)()  # 13000
    return f"CUDA {known // 1000}.{known % 1000 // 10}" if known else "unknown"


def _gpu(device: torch.device) -> Gpu:
    properties = torch.cuda.get_device_properties(device)
    return Gpu(
        f"{properties.major}.{properties.minor}",
        properties.multi_processor_count,
        properties.total_memory,
        torch.version.cuda,
        *_nvidia_smi(device),
    )


def _nvidia_smi(device: torch.device) -> list[str]:
    """What it says of _GPU_FIELDS, or nothing."""
    command = [
        "nvidia-smi",
        f"--query-gpu={','.join(_GPU_FIELDS)}",
        "--format=csv,noheader",
        f"--id={device.index or 0}",
    ]
    values = _output(command).split(", ")
    return values if len(values) == len(_GPU_FIELDS) else []


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def _commit() -> str:
    """This checkout's commit, with "+" behind it where files differ from it.

    Outside a checkout of Turbo-Pi's own, as in an environment that lies in somebody's repository: TURBOPI_COMMIT, which
    whoever copied the files sets, else "unknown".
    """
    here = Path(__file__)
    root = str(here.parents[3])
    if _git(root, "ls-files", "--full-name", "--error-unmatch", str(here)) != "src/turbopi/support/provenance.py":
        return os.environ.get("TURBOPI_COMMIT", "unknown")
    commit = _git(root, "rev-parse", "--short=12", "HEAD")
    return commit + ("+" if _git(root, "status", "--porcelain", "--untracked-files=no") else "")


def _git(folder: str, *arguments: str) -> str:
    """What git says of the repository that a folder is in, whichever one the environment names; "" if nothing."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith("GIT_")}
    return _output(["git", "-C", folder, *arguments], environment)


def _cpu_name() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    return next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), "")


def _output(command: list[str], environment: dict[str, str] | None = None) -> str:
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, errors="replace", timeout=10, check=True, env=environment
        )
        return done.stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return ""
