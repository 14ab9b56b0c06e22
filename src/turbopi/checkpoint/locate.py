"""Finding out what a path holds, and telling users what to do about what Turbo-Pi can't read."""

import re
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from turbopi.checkpoint.lerobot import is_lerobot
from turbopi.checkpoint.onnx_folder import MANIFEST as ONNX_MANIFEST
from turbopi.checkpoint.orbax import MANIFEST
from turbopi.checkpoint.peft_adapter import CONFIG as ADAPTER
from turbopi.checkpoint.peft_adapter import is_adapter
from turbopi.checkpoint.source import listing
from turbopi.checkpoint.torch_files import INDEX, WEIGHTS
from turbopi.config import LIMITS
from turbopi.errors import CheckpointError
from turbopi.files import openpi_cache
from turbopi.reading import Fields, read_json

CheckpointFormat = Literal["openpi_torch", "openpi_jax", "lerobot", "onnx", "random"]
PRECISIONS = ("bfloat16", "float32", "float16")  # of openpi's converter

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
    weights: Path  # the folder of the safetensors files, or of the Orbax tree
    adapter: bool = False  # the weights are an adapter of the peft library

    @property
    def assets(self) -> Path:
        return self.folder / "assets"


def locate(path: str | Path) -> Location:
    """The checkpoint at `path`: its folder, or one level off (openpi's params/, LeRobot's training output).

    Raises CheckpointError for addresses, hub names, folders that hold no checkpoint, and formats that aren't read.
    """
    folder = _local(path)
    if (folder / MANIFEST).is_file():  # openpi's params/ itself
        named = folder if folder.name == "params" else folder.resolve()  # "." and links have other names
        return Location("openpi_jax", named.parent if named.name == "params" else folder, folder)
    if (folder / "pretrained_model").is_dir():  # one step of LeRobot's training output
        folder = folder / "pretrained_model"
    if is_lerobot(folder) and is_adapter(folder):
        return Location("lerobot", folder, folder, adapter=True)
    if (folder / ONNX_MANIFEST).is_file():
        return Location("onnx", folder, folder)
    _refuse_other_formats(folder)
    if _has_safetensors(folder):  # before params/, as openpi does
        return Location("lerobot" if is_lerobot(folder) else "openpi_torch", folder, folder)
    if (folder / "params").is_dir():
        return Location("openpi_jax", folder, folder / "params")
    raise CheckpointError(_nothing_here(folder))


def tokenizer_candidates(folder: Path) -> list[Path]:
    """Tokenizers in or below a checkpoint's folder (params/ and hidden folders aside), nearest first."""
    patterns = ("*.model", "assets/*.model", "tokenizer/*.model", "big_vision/*.model", "tokenizer/tokenizer.json")
    return [file for pattern in patterns for file in sorted(folder.glob(pattern)) if file.is_file()]


@dataclass(frozen=True)
class Recorded:
    """What the config.json says that openpi's converter writes, where it has it."""

    numbers: dict[str, int]  # action_dim, action_horizon
    variants: dict[str, str]  # paligemma_variant, action_expert_variant: openpi's names of sizes, or a fork's


def recorded_config(location: Location) -> Recorded:
    """openpi's config.json. CheckpointError for values that no converter writes; openpi itself reads none of them."""
    file = location.folder / "config.json"
    if location.format != "openpi_torch" or not file.is_file():
        return Recorded({}, {})
    content = read_json(file)
    fields = Fields({key: value for key, value in content.items() if value is not None}, file)
    fields.choice("precision", PRECISIONS, default=PRECISIONS[0])
    sizes = [key for key in ("action_dim", "action_horizon") if key in fields.values]
    variants = [key for key in ("paligemma_variant", "action_expert_variant") if key in fields.values]
    return Recorded(
        {key: fields.integer(key, 1, LIMITS[key]) for key in sizes}, {key: fields.text(key) for key in variants}
    )


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
        return folder
    if folder.is_file():
        raise CheckpointError(f"{folder} is a file; give the checkpoint's folder, probably {folder.parent}")
    hint = ""
    if re.fullmatch(r"[\w.-]+/[\w.-]+", text):
        hint = f". If it is a name on the Hugging Face hub, fetch it first: hf download {text} --local-dir DIR"
    raise CheckpointError(f"there is no folder {folder}{hint}")


def _has_safetensors(folder: Path) -> bool:
    return (folder / WEIGHTS).is_file() or (folder / INDEX).is_file()


def _refuse_other_formats(folder: Path) -> None:
    if (folder / ADAPTER).is_file() and not _has_safetensors(folder):
        raise CheckpointError(
            f"{folder} holds adapters of the peft library without LeRobot's config.json and processors, which describe "
            "the policy. Put them there, or merge the adapters (peft's merge_and_unload), save the whole model, and "
            "give that folder"
        )
    pickled = [file.name for suffix in ("bin", "pt", "pth", "ckpt") for file in sorted(folder.glob(f"*.{suffix}"))]
    if pickled and not _has_safetensors(folder) and not (folder / "params").is_dir():
        raise CheckpointError(
            f"{folder} holds {listing(pickled)}: pickled weights can run code when loaded and aren't read. Save them "
            f"as {WEIGHTS} (safetensors.torch.save_model)"
        )


def _steps(folder: Path) -> list[Path]:
    """The steps of a training run in a folder, the last one at the end; none if it can't be read."""
    with suppress(OSError):
        return sorted((e for e in folder.iterdir() if e.name.isdigit() and e.is_dir()), key=lambda e: int(e.name))
    return []


def _checkpoints(folder: Path) -> list[Path]:
    """The checkpoints right in a folder; none if it can't be read."""
    with suppress(OSError):
        return sorted(entry for entry in folder.iterdir() if _holds_weights(entry))
    return []


def _holds_weights(folder: Path) -> bool:
    with suppress(OSError):
        return _has_safetensors(folder) or (folder / "params").is_dir()
    return False


def _nothing_here(folder: Path) -> str:
    if steps := _steps(folder):
        names = ", ".join(step.name for step in steps)
        return f"{folder} holds training steps ({names}); give one of them, such as {steps[-1]}"
    if below := _checkpoints(folder):
        names = listing([entry.name for entry in below])
        return f"{folder} holds no checkpoint, but folders that do ({names}); give one of them, such as {below[0]}"
    for entry in sorted(entry for entry in folder.iterdir() if entry.is_dir()):
        if deeper := _steps(entry)[-1:] or _checkpoints(entry):
            return f"{folder} holds no checkpoint, but there are some further below; give one, such as {deeper[0]}"
    for above in folder.resolve().parents[:2]:  # of assets/, or of an asset's folder
        if _holds_weights(above):
            return f"{folder} holds no checkpoint, but the folder above does; give {above}"
    entries = sorted(entry.name + ("/" if entry.is_dir() else "") for entry in folder.iterdir())
    return (
        f"{folder} holds no checkpoint: expected {WEIGHTS} (openpi's PyTorch, LeRobot) or params/ (openpi's JAX), "
        f"but it has {listing(entries) if entries else 'nothing'}"
    )
