"""Engines on disk, each in a folder of its own that appears whole or not at all.

<cache>/<weights>/<engine's name>/engine.plan   the serialised engine
                                 /engine.json   everything that it depends on, its length and SHA-256

An engine is asked for by weights and name. One that was made for something else (another library or version, GPU,
precision, calibration, or an older Turbo-Pi) is stale: it is never used, and the reason is told. One whose bytes aren't
those that were written is corrupt, and is built again.
"""

import hashlib
import json
import logging
import os
import shutil
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

from turbopi.errors import BackendError
from turbopi.folders import cache_folder, new_folder
from turbopi.tensorrt.engine import Specification

logger = logging.getLogger(__name__)

FOLDER_VARIABLE = "TURBOPI_ENGINES"
Build = Callable[[Specification], bytes]
Report = Callable[[str], None]


class StaleEngine(BackendError):
    """A cached engine that was made for something else; the message says what differs."""


class CorruptEngine(BackendError):
    """A cached engine whose files aren't as they were written."""


@dataclass(frozen=True)
class Environment:
    """What every engine of a process depends on besides its own specification."""

    weights: str  # parts.fingerprint
    library: str
    library_version: str
    gpu: str
    compute_capability: str
    turbopi: str
    networks: str  # a hash of the code that writes them


def default_folder() -> Path:
    """$TURBOPI_ENGINES, else turbopi/engines in the user's cache."""
    if os.environ.get(FOLDER_VARIABLE):
        return Path(os.environ[FOLDER_VARIABLE]).expanduser()
    return cache_folder() / "engines"


def networks_hash() -> str:
    """Of the sources that decide what is in an engine."""
    here = Path(__file__).parent
    texts = b"".join((here / name).read_bytes() for name in ("networks.py", "ops.py", "parts.py", "engine.py"))
    return hashlib.sha256(texts).hexdigest()[:16]


def turbopi_version() -> str:
    try:
        return metadata.version("turbopi")
    except metadata.PackageNotFoundError:
        return "from source"


class EngineCache:
    """Cached engines of one environment."""

    def __init__(self, folder: Path, environment: Environment) -> None:
        self.root, self.environment = folder, environment
        self.folder = folder / environment.weights

    def get(self, specification: Specification) -> bytes | None:
        """The serialised engine, or None if there is none.

        Raises StaleEngine or CorruptEngine, with the reason.
        """
        folder = self.folder / specification.name
        if not folder.is_dir():
            return None
        plan, about = folder / "engine.plan", self._about(folder)
        expected = self._key(specification)
        different = [f"{name} {about['key'].get(name)!r} instead of {value!r}" for name, value in expected.items()
                     if about["key"].get(name) != value]  # fmt: skip
        if different:
            raise StaleEngine(f"{folder} was built for {_shortened('; '.join(different))}")
        if not plan.is_file() or plan.stat().st_size != about["bytes"]:
            raise CorruptEngine(f"{plan} is missing or hasn't {about['bytes']} bytes")
        content = plan.read_bytes()
        if hashlib.sha256(content).hexdigest() != about["sha256"]:
            raise CorruptEngine(f"{plan} isn't as it was written (SHA-256 differs)")
        return content

    def put(self, specification: Specification, plan: bytes, seconds: float) -> None:
        """Store an engine in place of whatever is there under its name."""
        folder = self.folder / specification.name
        key = self._key(specification)
        about = {"key": key, "bytes": len(plan), "sha256": hashlib.sha256(plan).hexdigest(), "build_seconds": seconds}
        if folder.exists():
            shutil.rmtree(folder)
        with new_folder(folder) as temporary:
            (temporary / "engine.plan").write_bytes(plan)
            (temporary / "engine.json").write_text(json.dumps(about, indent=1) + "\n")

    def get_or_build(
        self, specification: Specification, build: Build, report: Report = logger.info, *, rebuild: bool = False
    ) -> tuple[bytes, str]:
        """The engine, and "cached" or "built". A stale or corrupt one is told and replaced.

        A build that fails raises BackendError and leaves what was there.
        """
        try:
            plan = None if rebuild else self.get(specification)
        except (StaleEngine, CorruptEngine) as refused:
            report(f"refused a cached engine: {refused}; building it again")
            plan = None
        if plan is not None:
            return plan, "cached"
        started = time.perf_counter()
        plan = build(specification)
        seconds = time.perf_counter() - started
        self.put(specification, plan, round(seconds, 3))
        return plan, "built"

    def names(self) -> Iterator[str]:
        """Of the engines of these weights, stale ones too."""
        if self.folder.is_dir():
            yield from sorted(one.name for one in self.folder.iterdir() if (one / "engine.json").is_file())

    def _key(self, specification: Specification) -> dict[str, Any]:
        inputs = {name: [list(one.shape), one.dtype] for name, one in specification.inputs.items()}
        key = {**asdict(self.environment), "name": specification.name, "inputs": inputs, **specification.about}
        plain: dict[str, Any] = json.loads(json.dumps(key))  # as it is read back
        return plain

    @staticmethod
    def _about(folder: Path) -> Mapping[str, Any]:
        try:
            about = json.loads((folder / "engine.json").read_text())
            assert isinstance(about["key"], dict) and isinstance(about["bytes"], int), about
            return about
        except (OSError, ValueError, KeyError, TypeError, AssertionError) as error:
            raise CorruptEngine(f"{folder / 'engine.json'} can't be read ({error!r})") from error


def _shortened(text: str, most: int = 400) -> str:
    return text if len(text) <= most else text[:most] + " …"
