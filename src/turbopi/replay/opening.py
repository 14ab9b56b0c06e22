"""Which kind of dataset a path is."""

from pathlib import Path

from turbopi.replay.episode_files import HDF5, Hdf5Episodes, NpzEpisodes
from turbopi.replay.episodes import Dataset
from turbopi.replay.lerobot_dataset import INFO, LeRobotDataset
from turbopi.replay.recorded_calls import RecordedCalls
from turbopi.support.errors import ConfigError
from turbopi.support.hub_cache import is_hub_name
from turbopi.support.reading import Npz

EXPECTED = (
    f"a LeRobotDataset (a folder with {INFO}), what `turbopi serve --record` wrote, or a folder of .npz or .hdf5 "
    "episodes"
)


def open_dataset(path: Path, action: str | None = None) -> Dataset:
    """The dataset at a path; `action`: its key of the recorded actions, where it isn't `action` or `actions`.

    Raises ConfigError if it is none that is known, ObservationError if it is damaged.
    """
    if not path.exists():
        fetch = f"hf download --repo-type dataset {path} --local-dir DIR"
        hint = f". If it is a name on the Hugging Face hub, fetch it first: {fetch}" if is_hub_name(str(path)) else ""
        raise ConfigError(f"there is no dataset {path}; expected {EXPECTED}{hint}")
    if above := next((folder for folder in path.absolute().parents if (folder / INFO).is_file()), None):
        raise ConfigError(f"{path} is inside a LeRobotDataset; give its folder, {above}")
    if (path / INFO).is_file():
        return LeRobotDataset(path, action)
    if path.is_dir() and (found := next((one for one in sorted(path.glob("*/")) if (one / INFO).is_file()), None)):
        raise ConfigError(f"{path} is a folder of datasets; give one of them, such as {found}")
    if looks_like_a_checkpoint(path):
        raise ConfigError(f"{path} is a checkpoint, but the dataset comes first: turbopi replay DATASET CHECKPOINT")
    npz = [path] if path.is_file() else [*sorted(path.glob("*.npz")), *sorted(path.glob("*/*.npz"))]
    if npz and npz[0].suffix == ".npz":
        with Npz(npz[0]) as members:
            recorded = "index" in members
        return RecordedCalls(path) if recorded else NpzEpisodes(path, action)
    hdf5 = [path] if path.is_file() else [file for file in sorted(path.iterdir()) if file.suffix in HDF5]
    if hdf5 and hdf5[0].suffix in HDF5:
        return Hdf5Episodes(path, action)
    raise ConfigError(f"{path} is no dataset; expected {EXPECTED}")


def looks_like_a_checkpoint(path: Path) -> bool:
    marks = ("model.safetensors", "model.safetensors.index.json", "params", "turbopi.json")
    return path.is_dir() and any((path / mark).exists() for mark in marks)
