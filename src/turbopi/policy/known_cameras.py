"""What each camera showed in episodes that are known to be right, so that a mistake is seen in a robot's first call.

`turbopi replay` writes it; no checkpoint has it. How surely mistakes are found: docs/dev/serving.md.
"""

import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from turbopi.policy.watch import GRID, Sample
from turbopi.realtime.messages import Note
from turbopi.support.errors import ConfigError
from turbopi.support.files import write_whole
from turbopi.support.reading import read_npz

MOST_IMAGES = 16  # of a camera
CLEARLY = 1.5  # times nearer to another camera's images, or with red and blue exchanged, than as they are
COLOURFUL = 6.0  # grey levels between red and blue in the known images: below, an exchange of them can't be seen
_SIZE = GRID * GRID * 3


class KnownCameras:
    """A few pixels of the images of each camera: uint8[K, 12 * 12 * 3] by the robot's own key, K at least 1 each.

    where  for messages
    """

    def __init__(self, images: Mapping[str, np.ndarray], where: str = "the known images") -> None:
        self.images, self.where = images, where
        most = max(map(len, images.values()), default=0)
        # [C, K, pixels]: some of a camera that has fewer are there twice
        every = _fewer(np.stack([np.resize(of_one, (most, _SIZE)) for of_one in images.values()]))
        colours = _red_minus_blue(every)
        self._rows = {name: row for row, name in enumerate(images)}
        self._images, self._colours = _Nearest(every), _Nearest(colours)
        self._coloured = np.sqrt(np.square(colours).mean(axis=(1, 2))) > COLOURFUL

    @classmethod
    def of_samples(cls, samples: Mapping[str, Sequence[Sample]]) -> "KnownCameras | None":
        """Evenly chosen ones of each camera. None: of no camera, or of images too small for the grid."""
        chosen = {
            name: np.stack([np.frombuffer(some[int(i)].pixels, np.uint8) for i in spread])
            for name, all_of_one in samples.items()
            if (some := [one for one in all_of_one if len(one.pixels) == _SIZE])
            for spread in [np.linspace(0, len(some) - 1, min(len(some), MOST_IMAGES)).round()]
        }
        return cls(chosen) if chosen else None

    @classmethod
    def load(cls, file: str | Path) -> "KnownCameras":
        """What `save` wrote. Raises ConfigError for anything else."""
        try:
            images = read_npz(file, ConfigError)
        except ConfigError as error:
            raise ConfigError(f"known_cameras: {file} can't be read ({error}); {_EXPECTED}") from error
        if not images:
            raise ConfigError(f"known_cameras: {file} has no camera; {_EXPECTED}")
        for name, of_one in images.items():
            if of_one.dtype != np.uint8 or of_one.ndim != 2 or of_one.shape[1] != _SIZE or not len(of_one):
                raise ConfigError(
                    f"known_cameras: {file}: {name} is {of_one.dtype}{list(of_one.shape)}, not uint8[K, {_SIZE}]; "
                    f"{_EXPECTED}"
                )
        return cls(images, str(file))

    def save(self, file: Path) -> None:
        images: dict[str, Any] = dict(self.images)
        write_whole(file, lambda stream: np.savez_compressed(stream, **images))

    def notes(self, images: Mapping[str, Sample]) -> tuple[Note, ...]:
        """What the images of one call look like, compared with the known ones; of cameras that both have."""
        there = [name for name in self._rows if name in images and len(images[name].pixels) == _SIZE]
        if not there:
            return ()
        rows = [self._rows[name] for name in there]
        pixels = np.frombuffer(b"".join([images[name].pixels for name in there]), np.uint8)
        every = pixels.reshape(len(there), _SIZE)
        now, turned = _fewer(every), _fewer(every.reshape(len(there), -1, 3)[:, ::-1].reshape(every.shape))
        away, away_turned = (self._images.distances(both)[:, rows].tolist() for both in (now, turned))
        found, shows = [], {i: i for i in range(len(there))}  # of each camera, which one it shows
        for i, j in itertools.combinations(range(len(there)), 2):
            if away[i][i] + away[j][j] > CLEARLY * (away[i][j] + away[j][i]):
                shows[i], shows[j] = j, i
                text = f"cameras {there[i]} and {there[j]} each show what the other one shows in {self.where}"
                found.append(Note("camera_exchanged", (there[i], there[j]), f"{text}: are they exchanged?"))
        colours = _red_minus_blue(now)
        as_sent, exchanged = (self._colours.distances(both)[:, rows].tolist() for both in (colours, -colours))
        for i, other in shows.items():
            name = there[i]
            if away[i][other] > CLEARLY * away_turned[i][other]:
                text = f"the image of camera {name} is turned by 180 degrees, compared with {self.where}"
                found.append(Note("camera_turned", (name,), text))
            elif self._coloured[rows[other]] and as_sent[i][other] > CLEARLY * exchanged[i][other]:
                text = f"red and blue of camera {name} are exchanged, compared with {self.where}: is it BGR?"
                found.append(Note("camera_channels", (name,), text))
        return tuple(found)


_EXPECTED = "expected the cameras.npz that `turbopi replay` writes"


class _Nearest:
    """Distances to the nearest of known vectors, float32[C, K, n]: by products, ten times as fast as differences."""

    def __init__(self, known: np.ndarray) -> None:
        self._cameras, self._each, self._size = known.shape
        self._flat = known.reshape(-1, self._size).T
        self._squares = np.square(known).sum(axis=2).reshape(-1)

    def distances(self, vectors: np.ndarray) -> np.ndarray:
        """float32[c, C] of vectors [c, n]: the root mean square, to the nearest one of each camera."""
        squares = np.square(vectors).sum(axis=1)[:, None] + self._squares - 2 * (vectors @ self._flat)
        nearest = squares.reshape(len(vectors), self._cameras, self._each).min(axis=2)
        return np.asarray(np.sqrt(np.maximum(nearest, 0) / self._size))


def _fewer(pixels: np.ndarray) -> np.ndarray:
    """float32[..., 108] of uint8[..., 432]: every second pixel in each direction, which is as sure, and faster."""
    grid = pixels.reshape(*pixels.shape[:-1], GRID, GRID, 3)[..., 1::2, 1::2, :]
    return grid.reshape(*pixels.shape[:-1], -1).astype(np.float32)


def _red_minus_blue(pixels: np.ndarray) -> np.ndarray:
    return np.asarray(pixels[..., 0::3] - pixels[..., 2::3])
