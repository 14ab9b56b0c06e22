"""Engines on disk, each in one file, which appears whole or not at all.

<cache>/<weights>/<engine's name>.engine   one line of JSON: everything that it depends on, its length and SHA-256;
                                           then the serialised engine

Several processes may build and store the same engine at once: the last one's stays, and whoever reads meanwhile finds
one of them, whole.

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
from pathlib import Path
from typing import IO, Any

from turbopi.backends.tensorrt.engine import Specification
from turbopi.support.errors import BackendError, OutputError
from turbopi.support.files import cache_folder, make_folder, write_whole
from turbopi.support.reading import parse_json

logger = logging.getLogger(__name__)

FOLDER_VARIABLE = "TURBOPI_ENGINES"
_ENDING = ".engine"
_LONGEST_LINE = 2**24  # of JSON: scales of every activation are part of a key
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


class EngineCache:
    """Cached engines of one environment."""

    def __init__(self, folder: Path, environment: Environment) -> None:
        self.root, self.environment = folder, environment
        self.folder = folder / environment.weights

    def get(self, specification: Specification) -> bytes | None:
        """The serialised engine, or None if there is none.

        Raises StaleEngine or CorruptEngine, with the reason.
        """
        file = self.file(specification.name)
        try:
            with file.open("rb") as stream:
                about, plan = _about(stream.readline(_LONGEST_LINE), file), stream.read()
        except FileNotFoundError:
            return None
        except OSError as error:
            raise CorruptEngine(f"{file} can't be read: {error.strerror or error}") from error
        expected = self._key(specification)
        different = [f"{name} {about['key'].get(name)!r} instead of {value!r}" for name, value in expected.items()
                     if about["key"].get(name) != value]  # fmt: skip
        if different:
            raise StaleEngine(f"{file} was built for {_shortened('; '.join(different))}")
        if len(plan) != about.get("bytes"):
            raise CorruptEngine(f"{file} holds an engine of {len(plan)} bytes instead of {about.get('bytes')}")
        if hashlib.sha256(plan).hexdigest() != about.get("sha256"):
            raise CorruptEngine(f"{file} isn't as it was written (SHA-256 differs)")
        return plan

    def put(self, specification: Specification, plan: bytes, seconds: float) -> None:
        """Store an engine in place of whatever is there under its name. Raises OutputError, and leaves that then."""
        key = self._key(specification)
        about = {"key": key, "bytes": len(plan), "sha256": hashlib.sha256(plan).hexdigest(), "build_seconds": seconds}
        file = self.file(specification.name)

        def write(stream: IO[bytes]) -> None:
            stream.write(json.dumps(about).encode() + b"\n")
            stream.write(plan)

        make_folder(file)
        write_whole(file, write)
        shutil.rmtree(self.folder / specification.name, ignore_errors=True)  # where 0.1.0 kept it

    def get_or_build(
        self,
        specification: Specification,
        build: Build,
        report: Report = logger.info,
        *,
        rebuild: bool = False,
        keep: bool = False,
    ) -> tuple[bytes, str]:
        """The engine, and "cached" or "built". A stale or corrupt one is told and replaced.

        A build that fails raises BackendError and leaves what was there. keep: an engine that can't be stored raises
        OutputError; without, that is reported.
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
        try:
            self.put(specification, plan, round(seconds, 3))
        except OutputError as error:
            if keep:
                raise
            report(f"an engine isn't kept, so the next start builds it again: {error}")
        return plan, "built"

    def names(self) -> Iterator[str]:
        """Of the engines of these weights, stale ones too."""
        if self.folder.is_dir():
            yield from sorted(file.name.removesuffix(_ENDING) for file in self.folder.glob(f"[!.]*{_ENDING}"))

    def file(self, name: str) -> Path:
        """Where the engine of that name is, or would be."""
        return self.folder / f"{name}{_ENDING}"

    def _key(self, specification: Specification) -> dict[str, Any]:
        inputs = {name: [list(one.shape), one.dtype] for name, one in specification.inputs.items()}
        key = {**asdict(self.environment), "name": specification.name, "inputs": inputs, **specification.about}
        plain: dict[str, Any] = json.loads(json.dumps(key))  # as it is read back
        return plain


def _about(line: bytes, file: Path) -> Mapping[str, Any]:
    """The first line of an engine's file."""
    about = parse_json(line, f"{file}'s first line", CorruptEngine)
    if not isinstance(about, dict) or not isinstance(about.get("key"), dict):
        raise CorruptEngine(f"{file}'s first line doesn't tell what the engine depends on")
    return about


def _shortened(text: str, most: int = 400) -> str:
    return text if len(text) <= most else text[:most] + " …"
