"""Several observations' prefixes one behind the other: on the host, before a batched call.

Of each observation all its cameras' tokens come first, then its prompt's; nothing lies between two observations. What
is left up to the call's fixed number of rows is padding, which sees itself alone.

Shapes: B observations of the call, R rows, n query heads.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

TILE = 64  # query rows of a tile of packed attention; rows of all heads of a token follow each other


@dataclass(frozen=True)
class Packed:
    """Where rows come from and which of them see each other, as `engine.batch` sends it to the device."""

    source: np.ndarray  # int64[R]  an image's token, or -1 - id of a prompt's
    positions: np.ndarray  # int64[R]  in its own observation
    segments: np.ndarray  # int32[2, B + 1]  first row and number of rows of each observation; the last one is padding
    tiles: np.ndarray  # int32[most_tiles, 4]  see `kernels.interface.Segments`


def most_tiles(rows: int, batch: int, heads: int) -> int:
    """How many tiles so many rows can take, however they are shared out."""
    return 2 * (rows * heads // (2 * TILE) + batch + 1)


def pack_rows(
    cameras: Sequence[int],
    tokens: Sequence[np.ndarray],
    *,
    batch: int,
    rows: int,
    per_image: int,
    heads: int,
    same_images: bool = False,
) -> Packed:
    """Pack observations with so many images, in the order in which the images come, and prompts int64[tokens].

    Fewer observations than `batch` are followed by empty ones. same_images: all have the first one's.
    """
    source = np.full(rows, -1, np.int64)  # padding is token 0
    positions = np.zeros(rows, np.int64)
    segments = np.zeros((2, batch + 1), np.int32)
    at = image_row = 0
    for i, (count, prompt) in enumerate(zip(cameras, tokens, strict=True)):
        seen = count * per_image
        length = seen + len(prompt)
        assert at + length <= rows, f"{at + length} rows don't fit {rows}"
        source[at : at + seen] = np.arange(image_row, image_row + seen)
        source[at + seen : at + length] = -1 - prompt
        positions[at : at + length] = np.arange(length)
        segments[:, i] = at, length
        at, image_row = at + length, 0 if same_images else image_row + seen
    segments[0, len(cameras) :] = at
    segments[:, batch] = at, rows - at
    return Packed(source, positions, segments, _tiles(segments, rows, heads))


def _tiles(segments: np.ndarray, rows: int, heads: int) -> np.ndarray:
    batch = segments.shape[1] - 1
    tiles = np.zeros((most_tiles(rows, batch, heads), 4), np.int32)  # those that aren't needed end where they begin
    at = 0
    for start, length in segments.T:
        firsts = np.arange(start * heads, (start + length) * heads, TILE)
        here = tiles[at : at + len(firsts)]
        here[:, 0], here[:, 1], here[:, 2], here[:, 3] = firsts, (start + length) * heads, start, length
        at += len(firsts) + len(firsts) % 2
    return tiles
