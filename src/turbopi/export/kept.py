"""Exports that are kept, so that the backend `onnx` exports a checkpoint once and not at each start.

<folder>/<key>/   an export as `export_onnx` writes it; the key is a hash of all that it depends on

The folder is $TURBOPI_EXPORTS, or exports/ in the user's cache. Nothing is ever removed from it but what isn't whole:
an export may be deleted at any time, and is then made again.
"""

import hashlib
import json
import logging
import os
import shutil
from dataclasses import asdict
from pathlib import Path

from turbopi.errors import CheckpointError, OutputError
from turbopi.export.onnx import (
    FORMAT_VERSION,
    OPSET,
    Export,
    export_onnx,
    library_versions,
    open_export,
    weights_sha256,
)
from turbopi.files import cache_folder
from turbopi.model.reference import Pi0Model

logger = logging.getLogger(__name__)

FOLDER_VARIABLE = "TURBOPI_EXPORTS"
_CODE = ("export", "model")  # rooms whose code decides what a graph computes


def default_folder() -> Path:
    named = os.environ.get(FOLDER_VARIABLE)
    return Path(named).expanduser() if named else cache_folder() / "exports"


def kept_export(model: Pi0Model) -> Export:
    """The export of a float32 model on the CPU: the one that is kept, if it is there and whole, else a new one.

    Reads all weights for their hash. Raises what `export_onnx` raises, and OutputError if it can't be kept.
    """
    weights = weights_sha256(model.state_dict())
    place = default_folder() / _key(model, weights)
    found = _kept(place)
    if found is not None:
        logger.info("using the ONNX export in %s", place)
        return found
    try:
        made = export_onnx(model, place, weights=weights)
    except OutputError as error:
        raise OutputError(f"{error}; {FOLDER_VARIABLE} names another folder for ONNX exports") from error
    logger.info("the ONNX export stays in %s for the next start (%.2f GB)", place, made.bytes / 1e9)
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
