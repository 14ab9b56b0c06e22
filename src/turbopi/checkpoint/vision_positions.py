"""SmolVLA's image positions as transformers takes them; 4.55 to 4.57, in float32: one row and one column too early.

A patch of row i among n has row floor(i · S / n) of a table of S rows. Those versions multiplied i / n by 1 − 1e-6
first and counted the rows that begin below: ceil(i · S / n) − 1, but 0 for the first. In bfloat16 the factor rounds to
1. LeRobot 0.4 ran with them or with earlier ones, 0.5 and later run with fixed ones (source: `SmolVLMVisionEmbeddings`
of transformers 4.53.3, 4.54.0, 4.55.4, 4.56.2, 4.57.1, 4.57.6, 5.3.0). Where n is at most S, a table with other rows
does the same.
"""

from collections.abc import Iterator
from typing import Any

import torch

from turbopi.checkpoint.source import Piece, WeightSource
from turbopi.support.errors import ConfigError

EXACT, SHIFTED = "exact", "shifted"
TABLE = "vision.position_embedding.weight"


class ShiftedPositions:
    """Weights of another source, whose table of positions [S · S, width] has the rows that n patches a side took."""

    def __init__(self, source: WeightSource, table: int, patches: int, config_source: str) -> None:
        if patches > table:
            raise ConfigError(
                f"{config_source}: vision_positions is {SHIFTED!r}, which is computed for at most as many patches a "
                f"side as the table of positions has, {table}, but an image has {patches}"
            )
        self._source, self._rows = source, shifted_rows(table, patches)
        self.variant = f"{getattr(source, 'variant', '')} {SHIFTED} positions".strip()
        source.notes.append("positions of image patches are shifted, as by transformers 4.55 to 4.57")

    def __getattr__(self, name: str) -> Any:
        return getattr(self._source, name)

    def pieces(self, device: torch.device) -> Iterator[Piece]:
        whole = torch.empty(self._source.shapes[TABLE])
        for piece in self._source.pieces(device):
            if piece.name == TABLE:
                whole[piece.start : piece.start + len(piece.values)] = piece.values.float()
            else:
                yield piece
        side = len(self._rows)
        yield Piece(TABLE, 0, whole.view(side, side, -1)[self._rows][:, self._rows].flatten(0, 1))


def shifted_rows(table: int, patches: int) -> torch.Tensor:
    """For each row of a table of `table` rows, the row that those versions took where that one is due: int64[table]."""
    rows = torch.arange(table)
    for i in range(patches):
        rows[i * table // patches] = max(-(-i * table // patches) - 1, 0)
    return rows
