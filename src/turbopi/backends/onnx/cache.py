"""Exports that are kept, so that the backend `onnx` exports a checkpoint once and not at each start.

<folder>/<key>/   an export as `export_onnx` writes it; the key is a hash of all that it depends on

The folder is $TURBOPI_EXPORTS, or exports/ in the user's cache. The KEPT exports that were used last stay: a new one
removes the others. What isn't whole is made anew, and an export may be deleted at any time.
"""

import hashlib
import json
import logging
import os
import re
import shutil
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path

from turbopi.backends.onnx.export import OPSET, export_onnx, library_versions, weights_sha256
from turbopi.checkpoint.onnx_folder import FORMAT_VERSION, MANIFEST, Export, open_export
from turbopi.models.pi0.reference import Pi0Model
from turbopi.support.errors import CheckpointError, OutputError
from turbopi.support.files import cache_folder

logger = logging.getLogger(__name__)

KEPT = 3  # exports, of 13 GB each at full size
FOLDER_VARIABLE = "TURBOPI_EXPORTS"
_NAME = re.compile(r"[0-9a-f]{32}")  # of a kept export: nothing else in the folder is ours to remove
_CODE = ("export", "model")  # rooms whose code decides what a graph computes


def default_folder() -> Path:
    named = os.environ.get(FOLDER_VARIABLE)
    return Path(named).expanduser() if named else cache_folder() / "exports"


def cached_export(model: Pi0Model) -> Export:
    """The export of a float32 model on the CPU: the one that is kept, if it is there and whole, else a new one.

    Reads all weights for their hash. Raises what `export_onnx` raises, and OutputError if it can't be kept.
    """
    weights = weights_sha256(model.state_dict())
    place = default_folder() / _key(model, weights)
    found = _kept(place)
    if found is not None:
        logger.info("using the ONNX export in %s", place)
        with suppress(OSError):  # somebody else's folder
            os.utime(place)
        return found
    try:
        made = export_onnx(model, place, weights=weights)
    except OutputError as error:
        raise OutputError(f"{error}; {FOLDER_VARIABLE} names another folder for ONNX exports") from error
    logger.info("the ONNX export stays in %s for the next start (%.2f GB)", place, made.bytes / 1e9)
    _remove_old(place.parent)
    return made


def _kept(place: Path) -> Export | None:
    """The export at `place`. What isn't whole is removed; None then, and if nothing is there."""
    if not place.exists():
        return None
    try:
        return open_export(place)
    except CheckpointError as error:
        logger.warning("a kept ONNX export is made anew: %s", error)
        shutil.rmtree(place, ignore_errors=True)
        return None


def _remove_old(folder: Path) -> None:
    """Remove all but the exports that were used last. A process that has one open goes on reading it."""
    ours = [place for place in folder.iterdir() if _NAME.fullmatch(place.name) and (place / MANIFEST).is_file()]
    for place in sorted(ours, key=lambda place: -place.stat().st_mtime)[KEPT:]:
        logger.info("removing the ONNX export in %s: %d are kept, and it wasn't used for longest", place, KEPT)
        shutil.rmtree(place, ignore_errors=True)


def _key(model: Pi0Model, weights: str) -> str:
    """A hash of weights, sizes, format, libraries, and the code that makes the graphs."""
    code = hashlib.sha256()
    package = Path(__file__).parents[1]
    for file in sorted(file for room in _CODE for file in (package / room).glob("*.py")):
        code.update(file.name.encode() + file.read_bytes())
    depends_on = {
        "weights": weights,
        "sizes": asdict(model.config),
        "format_version": FORMAT_VERSION,
        "opset": OPSET,
        "versions": library_versions(),
        "code": code.hexdigest(),
    }
    return hashlib.sha256(json.dumps(depends_on, sort_keys=True).encode()).hexdigest()[:32]
