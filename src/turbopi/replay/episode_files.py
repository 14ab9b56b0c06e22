"""A folder of episodes, a file each: .npz, or HDF5 as ALOHA's recorder writes it.

    .npz     arrays whose first axis is time, under the robot's own keys: "observation/image" [T, h, w, 3],
             "observation/state" [T, s], … ; "actions" (or "action") [T, d]; "prompt", one text or T of them
    .hdf5    observations/qpos [T, s]          becomes `state`
             observations/images/NAME          becomes `images/NAME`: uint8 [T, h, w, 3], or JPEG or PNG files
                                               [T, bytes] with zeros behind them; names with "depth" in them aren't read
             action [T, d]                     becomes `actions`
             any other array of T              under its own path; the attribute `prompt` or `task`, if there is one

Source of the HDF5 layout: openpi's `examples/aloha_real/convert_aloha_data_to_lerobot.py`.
"""

import io
from abc import abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from functools import cached_property
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from turbopi.replay.episodes import ACTIONS, PROMPT, ActionByStep, Episode
from turbopi.support.errors import ConfigError, ObservationError
from turbopi.support.reading import Npz, listing, one_line
from turbopi.support.reading.images import decode_image

HDF5 = (".hdf5", ".h5")
_MAX_BYTES = 8 * 2**30  # of an episode's arrays
_STATE = "observations/qpos"
_IMAGES = "observations/images/"


class _EpisodeFiles(ActionByStep):
    """An episode a file, each opened as {key: array of time}."""

    endings: tuple[str, ...]
    leaves_others = False  # whether arrays of another length than the episode's aren't read, or are an error

    def __init__(self, path: Path, action: str | None = None) -> None:
        super().__init__(path)
        self.action = action or "action"
        found = [path] if path.is_file() else [file for file in sorted(path.iterdir()) if file.suffix in self.endings]
        if not found:
            raise ObservationError(f"{path} holds no {' or '.join(self.endings)}, a file an episode")
        self._files = found

    @abstractmethod
    def opened(self, file: Path) -> AbstractContextManager[Mapping[str, Any]]:
        """The arrays of an episode by key; each can be cut along time without reading all of it, if that's possible."""
        ...

    @cached_property
    def episodes(self) -> Sequence[Episode]:
        return tuple(Episode(n, self._length(file), file.stem) for n, file in enumerate(self._files))

    def _length(self, file: Path) -> int:
        with self.opened(file) as arrays:
            if ACTIONS not in arrays:
                raise ObservationError(
                    f"{file} has no {self.action}, the recorded actions [T, d]; it has "
                    f"{listing(list(arrays)) or 'nothing'}. Say which they are: --rename KEY=actions"
                )
            shape = np.shape(arrays[ACTIONS])
        if not shape or not shape[0]:
            raise ObservationError(f"{file}: its {ACTIONS} have shape {list(shape)}; expected [T, d]")
        return int(shape[0])

    def read_actions(self, episode: Episode) -> np.ndarray:
        with self.opened(self._files[episode.number]) as arrays:
            return np.asarray(arrays[ACTIONS][:])

    def observations(self, episode: Episode, steps: Sequence[int]) -> Iterator[dict[str, Any]]:
        file = self._files[episode.number]
        with self.opened(file) as arrays:
            others = [
                key for key, array in arrays.items() if key != PROMPT and np.shape(array)[:1] != (episode.length,)
            ]
            if others and not self.leaves_others:
                raise ObservationError(
                    f"{file}: {others[0]} has shape {list(np.shape(arrays[others[0]]))}, but the episode has "
                    f"{episode.length} steps; expected time as its first axis"
                )
            read = {key: array for key, array in arrays.items() if key not in (ACTIONS, *others)}
            for step in steps:
                yield {key: self._at(array, key, step, file) for key, array in read.items()}

    def _at(self, array: Any, key: str, step: int, file: Path) -> Any:
        if key == PROMPT:
            return str(array) if not np.ndim(array) else _text(array[step])
        value = np.asarray(array[step])
        if key.startswith("images/") and value.ndim == 1 and value.dtype == np.uint8:
            return decode_image(io.BytesIO(value.tobytes()), f"{file}: {key} of step {step}")
        return value


def _text(value: Any) -> str:
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value)


class NpzEpisodes(_EpisodeFiles):
    """.npz episodes. Nothing is unpickled."""

    kind, endings = "npz episodes", (".npz",)

    @contextmanager
    def opened(self, file: Path) -> Iterator[Mapping[str, Any]]:
        with Npz(file, limit=_MAX_BYTES) as arrays:
            yield _Renamed(arrays, self.action)


class _Renamed(Mapping[str, Any]):
    """An .npz's arrays, the actions under the name `actions`; one is read when it is used first."""

    def __init__(self, arrays: Npz, action: str) -> None:
        self._arrays, self._read = arrays, dict[str, np.ndarray]()
        self._names = {ACTIONS if name == action else name: name for name in arrays}

    def __getitem__(self, key: str) -> np.ndarray:
        if key not in self._read:
            self._read[key] = self._arrays[self._names[key]]
        return self._read[key]

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)


class Hdf5Episodes(_EpisodeFiles):
    """HDF5 episodes. Raises ConfigError without h5py."""

    kind, endings, leaves_others = "HDF5 episodes", HDF5, True

    def __init__(self, path: Path, action: str | None = None) -> None:
        if find_spec("h5py") is None:
            raise ConfigError(f"{path} holds HDF5 files, and h5py isn't installed; install it with: pip install h5py")
        super().__init__(path, action)

    @contextmanager
    def opened(self, file: Path) -> Iterator[Mapping[str, Any]]:
        import h5py

        try:
            with h5py.File(file, "r") as stored:
                arrays: dict[str, Any] = {}
                renamed = {_STATE: "state", self.action: ACTIONS}

                def visit(name: str, item: Any) -> None:
                    if isinstance(item, h5py.Dataset) and not ("depth" in name and name.startswith(_IMAGES)):
                        key = f"images/{name.removeprefix(_IMAGES)}" if name.startswith(_IMAGES) else name
                        arrays[renamed.get(key, key)] = item

                stored.visititems(visit)
                task = next((stored.attrs[name] for name in ("prompt", "task") if name in stored.attrs), None)
                yield arrays if task is None else {**arrays, PROMPT: _text(task)}
        except (OSError, KeyError, RuntimeError) as error:
            raise ObservationError(f"{file} isn't a readable HDF5 file: {one_line(error)}") from error
