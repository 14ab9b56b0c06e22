"""What a dataset gives, whatever its format: episodes, and moments of them, each with what was recorded next."""

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from turbopi.support.errors import ObservationError

ACTIONS, PROMPT = "actions", "prompt"  # what `--rename` calls the recorded actions and the task


@dataclass(frozen=True)
class Episode:
    """number: as the dataset counts it; length: its moments; name: for people."""

    number: int
    length: int
    name: str


@dataclass(frozen=True)
class Moment:
    """One time step of an episode.

    observation   under the dataset's keys: images uint8[h, w, 3], numbers, "prompt" if there is one
    recorded      float64[n, d]  the actions from this step on: n is the horizon, or less at the episode's end
    previous      float64[d]     the action before; None at the beginning
    """

    episode: Episode
    step: int
    observation: dict[str, Any]
    recorded: np.ndarray
    previous: np.ndarray | None


class Dataset(ABC):
    """Recorded episodes.

    path, kind     where, and what it is, for people
    fps            steps a second; None: not known
    action_names   of each action; None: not known
    notes          what the user had better look at
    caveat         what its recorded actions are, if they aren't what a person or an expert did
    wanted         keys of images that are read, if that takes long; None: all
    """

    path: Path
    kind: str
    fps: float | None = None
    action_names: tuple[str, ...] | None = None
    caveat: str | None = None
    wanted: frozenset[str] | None = None

    def __init__(self, path: Path) -> None:
        self.path = path
        self.notes: list[str] = []

    @property
    @abstractmethod
    def episodes(self) -> Sequence[Episode]: ...

    @abstractmethod
    def moments(self, episode: Episode, steps: Sequence[int], horizon: int) -> Iterator[Moment]:
        """The moments at some steps, which rise. Raises ObservationError, naming the file, for what can't be read."""
        ...

    def names_of(self, key: str) -> tuple[str, ...] | None:
        """The name of each number of an observation's key; None: not known."""
        return None


class ActionByStep(Dataset):
    """Episodes with one action recorded at each step: a moment's chunk is made of those from it on."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._actions = lru_cache(maxsize=4)(self._checked_actions)

    @abstractmethod
    def read_actions(self, episode: Episode) -> np.ndarray:
        """The actions of a whole episode, float[length, d]."""
        ...

    @abstractmethod
    def observations(self, episode: Episode, steps: Sequence[int]) -> Iterator[dict[str, Any]]:
        """The observations at some steps, which rise. Raises ObservationError."""
        ...

    def moments(self, episode: Episode, steps: Sequence[int], horizon: int) -> Iterator[Moment]:
        actions = self._actions(episode)
        for step, observation in zip(steps, self.observations(episode, steps), strict=True):
            previous = actions[step - 1] if step else None
            yield Moment(episode, step, observation, actions[step : step + horizon], previous)

    def _checked_actions(self, episode: Episode) -> np.ndarray:
        actions = self.read_actions(episode)
        return checked_actions(actions, episode.length, f"{self.path}: episode {episode.name}")


def checked_actions(actions: np.ndarray, length: int | None, where: str) -> np.ndarray:
    """float64[length, d], all finite. Raises ObservationError; `length` None: any."""
    if actions.ndim == 1 and actions.dtype.kind in "fiu":  # one action a step
        actions = actions[:, None]
    if actions.ndim != 2 or actions.dtype.kind not in "fiu" or not actions.size:
        raise ObservationError(
            f"{where}: its actions are {actions.dtype} of shape {list(actions.shape)}; expected numbers [steps, d]"
        )
    if length is not None and len(actions) != length:
        raise ObservationError(f"{where} has {len(actions)} actions, but {length} steps")
    if not np.isfinite(actions).all():
        step, column = map(int, np.argwhere(~np.isfinite(actions))[0])
        raise ObservationError(f"{where}: action {column} of step {step} is {actions[step, column]}")
    return actions.astype(np.float64)


@dataclass(frozen=True)
class Selection:
    """Which moments are taken: every `every`-th of each chosen episode, from its first."""

    episodes: tuple[Episode, ...]
    every: int
    of_episodes: int  # that there are
    of_moments: int

    @property
    def count(self) -> int:
        return sum(len(self.steps(episode)) for episode in self.episodes)

    def steps(self, episode: Episode) -> range:
        return range(0, episode.length, self.every)
