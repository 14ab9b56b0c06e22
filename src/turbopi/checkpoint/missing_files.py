"""What a folder without weights that Turbo-Pi reads holds instead, and what to do: the texts of errors."""

import re
from collections.abc import Iterator
from contextlib import suppress
from itertools import islice
from pathlib import Path

from turbopi.checkpoint.lerobot import is_lerobot
from turbopi.checkpoint.packed import PACKED
from turbopi.checkpoint.peft_adapter import CONFIG as ADAPTER
from turbopi.checkpoint.torch_files import INDEX, WEIGHTS
from turbopi.support.reading import files_below, listing

PRETRAINED = "pretrained_model"  # of one step of LeRobot's training
AVERAGED = "_ema"  # behind its name: LeRobot's main branch keeps the averaged weights so
_PICKLES = (".bin", ".pt", ".pth", ".ckpt", ".pkl", ".distcp")
# what training keeps beside weights, to go on with
_OF_TRAINING = re.compile(r"optim|sched|^metadata|rng_state|random_state|training_|trainer_|scaler", re.IGNORECASE)
_PARTIAL = (".incomplete", ".part", ".partial", ".crdownload", ".aria2", ".download", ".gstmp")
# tmp_1000 of openpi's PyTorch training, tmp-checkpoint-1000 of transformers', Orbax's own
_UNFINISHED = re.compile(r"tmp[-_](checkpoint-)?\d+|.*orbax-checkpoint-tmp.*")
INTERRUPTED = "what an interrupted save left: training renames such a folder once everything is written"
_MOST_FILES = 5000  # that are looked at


def unfinished_save(name: str) -> bool:
    """Whether a folder of that name is one that training renames once everything in it is written."""
    return _UNFINISHED.fullmatch(name) is not None


def holds_weights(folder: Path) -> bool:
    """Whether something of a checkpoint lies right in the folder."""
    with suppress(OSError):
        return any((folder / name).is_file() for name in (WEIGHTS, INDEX, PACKED)) or (folder / "params").is_dir()
    return False


def nothing_here(folder: Path) -> str:
    """What to do, for a folder in which `locate` finds nothing."""
    return next(_answers(folder))


def _answers(folder: Path) -> Iterator[str]:
    """The first one counts: what belongs to this folder, then checkpoints near it, then what else is there."""
    if (folder / ADAPTER).is_file():
        yield (
            f"{folder} holds adapters of the peft library without LeRobot's config.json and processors, which describe "
            "the policy. Put them there, or merge the adapters (peft's merge_and_unload), save the whole model, and "
            "give that folder"
        )
    nested = folder / "params" / "params"
    if nested.is_dir():
        yield f"{nested} lies one folder too deep: move what is in it to {nested.parent}, where openpi looks for it"
    if (folder / WEIGHTS).is_symlink():
        yield (
            f"{folder / WEIGHTS} is a link to {(folder / WEIGHTS).readlink()}, which isn't there: the folder was "
            "copied without what its links lead to (cp -L follows them), or the download isn't finished"
        )
    unready = [file.relative_to(folder) for file in _some_below(folder, hidden=True) if file.suffix in _PARTIAL]
    if partial := [str(file) for file in unready if len(file.parts) == 1 or file.parts[0].startswith(".")]:
        yield f"the download into {folder} isn't finished: there is {listing(partial)}. Run it again"
    if pickled := _pickled(file for file in folder.glob("*") if file.is_file()):
        yield f"{folder} holds {listing([file.name for file in pickled])}: {_unpickle(pickled[0])}"
    shards = sorted(file.name for file in folder.glob("model-*-of-*.safetensors"))
    if shards:
        yield f"{folder} holds {listing(shards)}, but neither {INDEX}, which lists all of them, nor {WEIGHTS}: copy it"
    yield from _near(folder)
    if pickled := _pickled(_some_below(folder)):
        names = [str(file.relative_to(folder)) for file in pickled]
        yield f"{folder} holds no checkpoint, but {listing(names)}: {_unpickle(pickled[0])}"
    if unfinished_save(folder.name):
        yield f"{folder} is {INTERRUPTED}; take an earlier step"
    if unfinished := _unfinished(folder):
        yield f"{folder} holds {listing(unfinished)}, {INTERRUPTED}; take an earlier step"
    entries = sorted(entry.name + ("/" if entry.is_dir() else "") for entry in folder.iterdir())
    yield (
        f"{folder} holds no checkpoint: expected {WEIGHTS} (openpi's PyTorch, LeRobot) or params/ (openpi's JAX), "
        f"but it has {listing(entries) if entries else 'nothing'}"
    )


def _near(folder: Path) -> Iterator[str]:
    """Checkpoints below and above, whole ones alone."""
    aside = f" ({listing(names)}: {INTERRUPTED})" if (names := _unfinished(folder)) else ""
    if steps := _steps(folder):
        names = [step.name for step in steps]
        yield f"{folder} holds training steps ({', '.join(names)}); give one of them, such as {steps[-1]}{aside}"
    if below := _checkpoints(folder):
        names = [entry.name for entry in below]
        yield (
            f"{folder} holds no checkpoint, but folders that do ({listing(names)}); give one of them, such as "
            f"{below[0]}{aside}"
        )
    for entry in _folders(folder):
        if deeper := _steps(entry)[-1:] or _checkpoints(entry):
            yield f"{folder} holds no checkpoint, but there are some further below; give one, such as {deeper[0]}"
    for above in folder.resolve().parents[:2]:  # of assets/, or of an asset's folder
        if holds_weights(above):
            yield f"{folder} holds no checkpoint, but the folder above does; give {above}"


def _folders(folder: Path) -> list[Path]:
    """The folders in a folder, hidden ones and unfinished saves aside; none if it can't be read."""
    with suppress(OSError):
        folders = sorted(entry for entry in folder.iterdir() if entry.is_dir())
        return [entry for entry in folders if not entry.name.startswith(".") and not unfinished_save(entry.name)]
    return []


def _checkpoints(folder: Path) -> list[Path]:
    return [entry for entry in _folders(folder) if holds_weights(entry) or holds_weights(entry / PRETRAINED)]


def _steps(folder: Path) -> list[Path]:
    """The steps of a training run, the last one at the end; only whole ones, if some are."""
    steps = sorted((entry for entry in _folders(folder) if entry.name.isdigit()), key=lambda entry: int(entry.name))
    return [step for step in steps if step in _checkpoints(folder)] or [step for step in steps if not _unfinished(step)]


def _unfinished(folder: Path) -> list[str]:
    with suppress(OSError):
        return sorted(entry.name for entry in folder.iterdir() if entry.is_dir() and unfinished_save(entry.name))
    return []


def _some_below(folder: Path, *, hidden: bool = False) -> Iterator[Path]:
    return islice(files_below(folder, hidden=hidden, depth=4), _MOST_FILES)


def _pickled(files: Iterator[Path]) -> list[Path]:
    return sorted(file for file in files if file.suffix in _PICKLES and not _OF_TRAINING.search(file.name))


def _unpickle(file: Path) -> str:
    if file.suffix == ".distcp" and is_lerobot(file.parent.parent):
        return (
            "shards of LeRobot's distributed training, which are pickled and aren't read. In LeRobot's environment: "
            f"lerobot-convert-dcp --checkpoint_dir={file.parent.parent}"
        )
    if file.suffix == ".distcp":
        how = f"python -m torch.distributed.checkpoint.format_utils dcp_to_torch {file.parent} whole.pt, then "
        file = Path("whole.pt")
    else:
        how = ""
    return (
        "pickled weights can run code when loaded and aren't read. In the environment that wrote them: "
        f'{how}w = torch.load("{file}", weights_only=True); '
        f'safetensors.torch.save_file({{k: w[k].clone() for k in w}}, "{WEIGHTS}"), of the state dict alone if there '
        "is more in the file"
    )
