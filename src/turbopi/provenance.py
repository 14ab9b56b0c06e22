"""Where a figure comes from: hardware, clocks, Turbo-Pi's version and commit, versions of the rest."""

import os
import platform
import subprocess
from datetime import datetime, timezone
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import torch

from turbopi.version import turbopi_version

_GPU_FIELDS = ("name", "driver_version", "clocks.sm", "clocks.mem", "clocks_throttle_reasons.active", "temperature.gpu")


def provenance(device: torch.device) -> dict[str, Any]:
    """Plain values for a result file; the clocks are those of the moment of the call."""
    about: dict[str, Any] = {
        "date": datetime.now(timezone.utc).strftime("%Y-%m-%d"),
        "turbopi": turbopi_version(),
        "python": platform.python_version(),
        "torch": torch.__version__,
        **{name: _version(name) for name in ("triton", "numpy", "sentencepiece")},
        "commit": _commit(),
        "device": str(device),
    }
    if device.type == "cuda":
        properties = torch.cuda.get_device_properties(device)
        about["gpu"] = {
            "compute_capability": f"{properties.major}.{properties.minor}",
            "multiprocessors": properties.multi_processor_count,
            "memory_bytes": properties.total_memory,
            "cuda": torch.version.cuda,
            **_nvidia_smi(device),
        }
    else:
        about["cpu"] = {"machine": platform.machine(), "name": _cpu_name(), "threads": torch.get_num_threads()}
    return about


def _nvidia_smi(device: torch.device) -> dict[str, str]:
    command = [
        "nvidia-smi",
        f"--query-gpu={','.join(_GPU_FIELDS)}",
        "--format=csv,noheader",
        f"--id={device.index or 0}",
    ]
    values = _output(command).split(", ")
    return dict(zip(_GPU_FIELDS, values, strict=True)) if len(values) == len(_GPU_FIELDS) else {}


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
    root = str(here.parents[2])
    if _git(root, "ls-files", "--full-name", "--error-unmatch", str(here)) != "src/turbopi/provenance.py":
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
