"""Finding out what a path holds; `nothing_here` says what to do about a folder without weights to read."""

import os
import re
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from turbopi.checkpoint.lerobot import is_lerobot
from turbopi.checkpoint.missing_files import (
    AVERAGED,
    INTERRUPTED,
    PRETRAINED,
    holds_weights,
    nothing_here,
    unfinished_save,
)
from turbopi.checkpoint.onnx_folder import MANIFEST as ONNX_MANIFEST
from turbopi.checkpoint.orbax import MANIFEST
from turbopi.checkpoint.packed import PACKED, differs, unpacked
from turbopi.checkpoint.peft_adapter import CONFIG as ADAPTER
from turbopi.checkpoint.peft_adapter import is_adapter
from turbopi.checkpoint.quantized_folder import MANIFEST as QUANTIZED
from turbopi.checkpoint.quantized_folder import TENSORS
from turbopi.checkpoint.torch_files import INDEX, WEIGHTS, read_index
from turbopi.support.errors import CheckpointError
from turbopi.support.files import openpi_cache
from turbopi.support.hub_cache import is_hub_name

CheckpointFormat = Literal["openpi_torch", "openpi_jax", "lerobot", "onnx", "quantized", "random"]

_DOWNLOAD = {
    "gs": "gsutil -m cp -r {address} DIR (or openpi's own openpi.shared.download)",
    "s3": "aws s3 cp --recursive {address} DIR",
    "hf": "hf download {name} --local-dir DIR",
    "http": "a download of the whole folder",
    "https": "a download of the whole folder",
}


@dataclass(frozen=True)
class Location:
    """A checkpoint on disk."""

    format: CheckpointFormat
    folder: Path  # what holds assets/, config.json and turbopi.json
    weights: Path  # the folder of the safetensors files (the user's cache if they lay packed), or of the Orbax tree
    adapter: bool = False  # the weights are an adapter of the peft library
    notes: tuple[str, ...] = ()  # on other weights in the folder, which aren't read


def locate(path: str | Path) -> Location:
    """The checkpoint at `path`: its folder, or one level off (openpi's params/, LeRobot's training output).

    Raises CheckpointError for addresses, hub names, folders that hold no checkpoint, and formats that aren't read.
    """
    folder = _local(path)
    if (folder / MANIFEST).is_file():  # openpi's params/ itself
        named = folder if folder.name == "params" else folder.resolve()  # "." and links have other names
        return Location("openpi_jax", named.parent if named.name == "params" else folder, folder)
    if not holds_weights(folder) and (folder / PRETRAINED).is_dir():  # one step of LeRobot's training output
        folder = folder / PRETRAINED
    if (folder / ADAPTER).is_file() and is_lerobot(folder) and is_adapter(folder):
        return Location("lerobot", folder, folder, adapter=True, notes=_notes(folder, "lerobot", adapter=True))
    if (folder / ONNX_MANIFEST).is_file():
        return Location("onnx", folder, folder, notes=_notes(folder, "onnx"))
    if (folder / QUANTIZED).is_file():
        return Location("quantized", folder, folder, notes=_notes(folder, "quantized"))
    params = folder / "params"
    if (folder / WEIGHTS).is_file() or ((folder / INDEX).is_file() and not params.is_dir()):  # openpi's own order
        return _of_tensors(folder, folder)
    if params.is_dir() and ((params / MANIFEST).is_file() or not (params / "params").is_dir()):
        return Location("openpi_jax", folder, params, notes=_notes(folder, "openpi_jax"))
    if (folder / PACKED).is_file():
        return _of_tensors(folder, unpacked(folder))
    raise CheckpointError(nothing_here(folder))


def tokenizer_candidates(folder: Path) -> list[Path]:
    """Tokenizers in or below a checkpoint's folder (params/ and hidden ones aside), nearest first."""
    patterns = ("*.model", "assets/*.model", "tokenizer/*.model", "big_vision/*.model", "tokenizer/tokenizer.json")
    found = [file for pattern in patterns for file in sorted(folder.glob(pattern)) if file.is_file()]
    return [file for file in found if not file.name.startswith(".")]


def _of_tensors(folder: Path, weights: Path) -> Location:
    form: CheckpointFormat = "lerobot" if is_lerobot(folder) else "openpi_torch"
    return Location(form, folder, weights, notes=_notes(folder, form))


def _local(path: str | Path) -> Path:
    text = str(path)
    address = re.match(r"([a-z][a-z0-9+.-]*):/{1,2}(.*)", text)  # Path() turns :// into :/
    if address and address[1] in _DOWNLOAD:
        cached = openpi_cache() / address[2].rstrip("/")
        if address[1] == "gs" and cached.is_dir():
            raise CheckpointError(f"{text} is an address; openpi has fetched it already: give {cached}")
        how = _DOWNLOAD[address[1]].format(address=f"{address[1]}://{address[2]}", name=address[2])
        raise CheckpointError(f"{text} is an address; Turbo-Pi reads local folders. Fetch it first, with {how}")
    folder = Path(path).expanduser()
    if folder.is_dir():
        if not os.access(folder, os.R_OK | os.X_OK):
            raise CheckpointError(f"{folder} can't be read: you have no permission")
        return folder
    if folder.is_file():
        raise CheckpointError(f"{folder} is a file; give the checkpoint's folder, probably {folder.parent}")
    hint = ""
    if is_hub_name(text):
        hint = f". If it is a name on the Hugging Face hub, fetch it first: hf download {text} --local-dir DIR"
    shipped = Path(__file__).parents[1] / "data" / folder.name
    if (shipped / PACKED).is_file():
        hint = f"; the one that comes with Turbo-Pi is {shipped}"
    raise CheckpointError(f"there is no folder {folder}{hint}")


def _notes(folder: Path, read: CheckpointFormat, *, adapter: bool = False) -> tuple[str, ...]:
    """Notes on the folder and on other weights in it: which the format's owner doesn't read, nor do we."""
    whole, index, params = folder / WEIGHTS, folder / INDEX, folder / "params"
    others = {
        params: read != "openpi_jax" and params.is_dir(),
        whole: (read in ("onnx", "quantized") or adapter) and whole.is_file(),
        folder / PACKED: whole.is_file() and differs(folder),
        index: index.is_file() and (read == "openpi_jax" or (whole.is_file() and not _is_of(index, whole))),
    }
    used = {"onnx": "the graphs", "quantized": TENSORS, "openpi_jax": "params/"}.get(read, whole.name)
    used = "the adapter and its base" if adapter else used
    owner = {"openpi_jax": "openpi", "openpi_torch": "openpi", "lerobot": "LeRobot"}.get(read)
    as_owner = f", as by {owner}" if owner else ""
    verb = "are" if used.startswith("the ") else "is"
    averaged = folder.parent / f"{folder.name}{AVERAGED}"
    notes = [f"two sources of weights: {used} {verb} read{as_owner}, and not {file}" for file in others if others[file]]
    if holds_weights(averaged):
        notes.append(f"training also kept averaged weights (EMA): to run these, give {averaged}")
    return (*notes, *([f"{folder.name} is {INTERRUPTED}"] if unfinished_save(folder.name) else []))


def _is_of(index: Path, whole: Path) -> bool:
    """Whether an index lists that one file alone."""
    with suppress(CheckpointError):
        return set(read_index(index).values()) == {whole.name}
    return False
