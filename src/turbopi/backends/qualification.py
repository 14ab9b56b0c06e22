"""Whether backend `fused` is right and fast on a GPU that Turbo-Pi's tests never ran on: verdicts, and where they are.

One is found out once for each model's sizes and precision (qualifying.py), and kept in the cache, where another GPU,
driver, version or kernel doesn't find it.
"""

import hashlib
import json
import logging
import os
import re
from collections.abc import Mapping
from datetime import datetime, timezone
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any, Final, Literal

import torch
from msgspec import Struct

from turbopi.backends.tuned_tiles import PACKAGE
from turbopi.config import Network
from turbopi.quantization.plan import Precision
from turbopi.support.errors import ConfigError
from turbopi.support.files import cache_folder, keep_in_cache
from turbopi.support.provenance import driver_version
from turbopi.support.reading import plain_document, read_document
from turbopi.version import turbopi_version

logger = logging.getLogger(__name__)

KNOWN: Final = ("NVIDIA H100 80GB HBM3", "NVIDIA H200")  # whose results are checked in, by PyTorch's name
UNKNOWN_VARIABLE: Final = "TURBOPI_UNKNOWN_GPU"
COMMAND: Final = "`turbopi doctor --qualify`"
DENOISE: Final = "denoise"  # the denoising kernel, among names of `kernels.interface.Ops` and "sm90": what is excluded
_SOURCES: Final = ("kernels/**/*.py", "kernels/**/*.cu", "engine/*.py", "backends/*.py", "qualify/*.py")
_PACKAGES: Final = ("torch", "triton", "cuda-bindings", "nvidia-cuda-nvrtc", "nvidia-cuda-nvrtc-cu12")

UNTRIED: Final = ("nvfp4",)  # precisions that none of those GPUs has

under_test: dict[str, str] | None = None  # in the process that qualifies: what it excludes
Taken = Literal["fused", "cuda_graph"]


class Stage(Struct, frozen=True, kw_only=True):
    """One that was done: figures by what they are of."""

    name: str
    seconds: float
    text: str
    figures: dict[str, float] = {}


class Verdict(Struct, frozen=True, kw_only=True):
    """The file that is kept, and that a report of a GPU attaches.

    taken       what `auto` takes; None: nothing, as `fused` alone has this precision
    excluded    parts of `fused` that failed, and how: others take their place
    milliseconds  backend -> "total" of a call, host to host, and its stages; medians
    unfinished  how many starts came to the end of their time
    """

    gpu: str
    compute_capability: str
    multiprocessors: int
    memory_bytes: int
    driver: str
    versions: dict[str, str]
    kernels: str  # "hopper" or "portable"
    kernels_hash: str
    precision: Precision
    model: str  # its family's name
    sizes: str
    date: str
    seconds: float
    taken: Taken | None
    reason: str
    failed: bool = False
    excluded: dict[str, str] = {}
    stages: list[Stage] = []
    milliseconds: dict[str, dict[str, float]] = {}
    device_bytes: int = 0  # reserved by `fused` at most
    unfinished: int = 0
    log: str = ""  # the end of what a process said that died

    @property
    def summary(self) -> str:
        return "; ".join([self.reason, *(f"without {path}: {why}" for path, why in self.excluded.items())])

    def issue(self, file: Path) -> str | None:
        """What to do about what failed; None: nothing did."""
        if not (self.failed or self.excluded):
            return None
        return f'please open an issue, "fused on {self.gpu}", and attach the file that {COMMAND} wrote: {file}'


def is_known(device: torch.device) -> bool:
    """Whether Turbo-Pi's own tests ran on such a GPU. TURBOPI_UNKNOWN_GPU=1: no, whichever it is."""
    value = os.environ.get(UNKNOWN_VARIABLE, "")
    if value not in ("", "1"):
        raise ConfigError(f"{UNKNOWN_VARIABLE} is {value!r}; expected '1', or nothing")
    return not value and torch.cuda.get_device_name(device) in KNOWN


def verdict_of(device: torch.device, precision: Precision, model: Network) -> Verdict | None:
    """What is kept of this GPU as it is now; None for a known one, and where nobody has qualified it yet."""
    return None if is_known(device) else kept(device, precision, model)


def unqualified(device: torch.device, precision: Precision, model: Network) -> str | None:
    """Why one of `UNTRIED` doesn't run here before the machine is qualified for it; None: it does."""
    if precision not in UNTRIED or under_test is not None or device.type != "cuda":
        return None
    verdict = kept(device, precision, model)
    if verdict is not None and verdict.taken == "fused" and not (verdict.unfinished or verdict.failed):
        return None
    tried = "" if verdict is None else f"; here: {verdict.summary}"
    return (
        f"none of Turbo-Pi's own tests ran on a GPU that has {precision}, so it is refused until "
        f"`turbopi doctor --qualify --checkpoint CKPT --precision {precision}` has found it right{tried}"
    )


def excluded(device: torch.device, precision: Precision, model: Network) -> Mapping[str, str]:
    """What of `fused` failed its self-test here, and how."""
    if under_test is not None:
        return dict(under_test)
    if device.type != "cuda" or (verdict := verdict_of(device, precision, model)) is None:
        return {}
    return verdict.excluded


def kept(device: torch.device, precision: Precision, model: Network) -> Verdict | None:
    file = file_of(device, precision, model)
    if file in _UNKEPT:
        return _UNKEPT[file]
    if not file.is_file():
        return None
    try:
        return read_document(file, Verdict, ConfigError)
    except ConfigError as error:
        logger.warning("a GPU's verdict isn't used: %s; %s makes it again", error, COMMAND)
        return None


_UNKEPT: dict[Path, Verdict] = {}  # which hold in this process alone: no cache, or a reason that may be gone


def keep(verdict: Verdict, file: Path, *, soon: bool) -> None:
    """soon: for this process alone, as the next one shall try again."""
    _UNKEPT.pop(file, None)
    if soon or not keep_in_cache(file, json.dumps(plain_document(verdict), indent=1) + "\n"):
        _UNKEPT[file] = verdict


def file_of(device: torch.device, precision: Precision, model: Network) -> Path:
    """Of a GPU with its driver, versions and kernels, of a model's sizes and a precision."""
    found = about(device, precision, model)
    decisive = json.dumps({name: one for name, one in found.items() if name != "date"}, sort_keys=True)
    slug = re.sub(r"[^a-z0-9]+", "-", f"{found['gpu']} {found['model']} {precision}".lower()).strip("-")
    return cache_folder() / "qualified" / f"{slug}-{hashlib.sha256(decisive.encode()).hexdigest()[:12]}.json"


def about(device: torch.device, precision: Precision, model: Network) -> dict[str, Any]:
    gpu = torch.cuda.get_device_properties(device)
    forced = os.environ.get("TURBOPI_KERNELS") == "portable"
    on_hopper = (gpu.major, gpu.minor) == (9, 0) and not forced
    return {
        "gpu": gpu.name,
        "compute_capability": f"{gpu.major}.{gpu.minor}",
        "multiprocessors": gpu.multi_processor_count,
        "memory_bytes": gpu.total_memory,
        "driver": _driver(),
        "versions": dict(_versions()),
        "kernels": "hopper" if on_hopper else "portable",
        "kernels_hash": _kernels_hash(),
        "precision": precision,
        "model": model.kind,
        "sizes": repr(model),
        "date": datetime.now(timezone.utc).strftime("%Y-%m-%d"),
    }


_driver = cache(driver_version)


@cache
def _versions() -> tuple[tuple[str, str], ...]:
    found = [("turbopi", turbopi_version()), ("cuda", str(torch.version.cuda))]
    for package in _PACKAGES:
        try:
            found.append((package, metadata.version(package)))
        except metadata.PackageNotFoundError:
            continue
    return tuple(found)


@cache
def _kernels_hash() -> str:
    digest = hashlib.sha256()
    for file in sorted(file for glob in _SOURCES for file in PACKAGE.glob(glob)):
        digest.update(file.relative_to(PACKAGE).as_posix().encode() + b"\0" + file.read_bytes() + b"\0")
    return digest.hexdigest()[:16]
