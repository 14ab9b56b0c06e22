"""How suffix.cu and suffix_few.cu are cut, and for what. Nothing here needs Triton."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar

from turbopi.kernels.sm90.instructions import SHARED_BYTES


@dataclass(frozen=True)
class SuffixTile:
    """Of suffix.cu: `rows` of queries of one observation for a cluster of `ranks` CTAs, each `keys` keys at a time."""

    dim: int  # columns of a head
    rows: int
    ranks: int
    keys: int

    source: ClassVar = "suffix"
    shared_bytes: ClassVar = SHARED_BYTES

    @property
    def warpgroups(self) -> int:
        return -(-self.rows // 64)

    @property
    def threads(self) -> int:
        """Of a CTA: the consumers' and the producer's."""
        return 128 * (self.warpgroups + 1)

    @property
    def stages(self) -> int:
        """Tiles of keys or values in flight: as many as fit beside queries, what ranks send, alignment and barriers."""
        beside = 2 * self.rows * self.dim * 2 + self.ranks * self.rows * 8
        return min(8, (SHARED_BYTES - 2048 - beside) // (self.keys * self.dim * 2))


@dataclass(frozen=True)
class FewTile:
    """The same of suffix_few.cu, whose `warpgroups` share the rows' keys and columns."""

    dim: int
    rows: int
    ranks: int
    keys: int
    warpgroups: int

    source: ClassVar = "suffix_few"
    stages: ClassVar = 2  # a tile of keys and one of values

    @property
    def threads(self) -> int:
        return 128 * self.warpgroups

    @property
    def members(self) -> int:
        """Warpgroups that share 64 rows."""
        return self.warpgroups * 64 // self._whole_rows

    @property
    def part(self) -> int:
        """Keys of a tile for one of them."""
        return -(-self.keys // self.members // 8) * 8

    @property
    def columns(self) -> int:
        """Columns of the values for one of them."""
        return -(-self.dim // self.members // 64) * 64

    @property
    def sent_rows(self) -> int:
        """What a CTA has room for of what all ranks send."""
        return self.ranks * -(-self.rows // self.ranks)

    @property
    def shared_bytes(self) -> int:
        """Keys, values, queries, weights, barriers, rows' tops and totals, and those of what is sent.

        Or more: the last warpgroup's product reads columns behind the values' last one, which nobody uses.
        """
        operands = (2 * self.keys + self.rows) * self.dim * 2
        weights = -(-self.keys // 64) * self.rows * 128 + (self._whole_rows - self.rows) * 128
        ends = 2 * self.members * self._whole_rows * 4 + self.sent_rows * 8
        read = self.keys * (self.dim + -(-self.dim // self.columns) * self.columns) * 2
        return 1024 + max(operands + weights + 16 + ends, read)

    @property
    def _whole_rows(self) -> int:
        return -(-self.rows // 64) * 64


Tile = SuffixTile | FewTile

# Of suffix.cu
RANKS = (8, 4, 2, 1)  # of a cluster: Hopper takes eight everywhere
MOST_ROWS = 128  # of queries in a cluster: two warpgroups' products have 64 each
KEYS = (64, 80)  # of a tile: two of 80 keys and their values are what fits beside MOST_ROWS
# Of suffix_few.cu
FEW_RANKS = (8, 6)
FEW_KEYS = 144  # most of a tile: with more, several tiles are loaded one after the other
# (most rows of a cluster, warpgroups). Two leave room on a multiprocessor for the next kernel's CTAs.
FEW_FORMS = ((64, 2), (112, 4))
FEW_CLUSTERS = 16  # of six CTAs, one a multiprocessor: an H100 or H200 has room for so many at once, an H20 hasn't


def takes(dim: int) -> bool:
    """Whether the kernels take heads of that many columns."""
    return dim % 64 == 0 and 64 <= dim <= 256


def tiles(dim: int, rows: int, batch: int, keys: int) -> Iterator[tuple[Tile, int]]:
    """Those to try, the best first, and how many of its clusters the GPU should hold at once.

    rows   of queries of an observation, those of all heads
    keys   of one observation, about
    """
    assert takes(dim), f"no heads of {dim} columns"
    fewest = FEW_CLUSTERS + 1
    for most, warpgroups in FEW_FORMS:
        clusters = batch * -(-rows // most)
        if clusters < fewest:  # where a form has no room, one of more warpgroups and as many clusters has none
            fewest = clusters
            yield from ((_few(dim, _rows(rows, most), ranks, keys, warpgroups), clusters) for ranks in FEW_RANKS)
    clusters = batch * -(-rows // MOST_ROWS)
    for ranks in RANKS:
        share = -(-keys // ranks)
        size = min(KEYS, key=lambda one: -(-share // one) * one)
        yield SuffixTile(dim, _rows(rows, MOST_ROWS), ranks, size), clusters


def _rows(rows: int, most: int) -> int:
    """Of each of as few tiles as there may be."""
    return -(-rows // -(-rows // most) // 8) * 8


def _few(dim: int, rows: int, ranks: int, keys: int, warpgroups: int) -> FewTile:
    """With all of a CTA's keys in as few tiles as fit; what is sent lies where keys were, so there is room for it."""
    share, least = -(-keys // ranks), -(-rows // ranks) * ranks
    sizes = (-(-max(-(-share // count), least) // 16) * 16 for count in range(1, share + 1))
    few = (FewTile(dim, rows, ranks, size, warpgroups) for size in sizes)
    return next(tile for tile in few if tile.keys <= FEW_KEYS and tile.shared_bytes <= SHARED_BYTES)
