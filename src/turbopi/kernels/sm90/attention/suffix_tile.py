"""How suffix.cu is cut, and for what. Nothing here needs Triton."""

from dataclasses import dataclass

from turbopi.kernels.sm90.instructions import SHARED_BYTES

RANKS = (8, 4, 2, 1)  # of a cluster: Hopper takes eight everywhere
LEAST_QUERIES = 1280  # of a batch; Triton's kernel is sooner with fewer (docs/dev/log.md, "Attention of batches")
MOST_ROWS = 128  # of queries in a cluster: two warpgroups' products have 64 each
KEYS = (64, 80)  # of a tile: two of 80 keys and their values are what fits beside MOST_ROWS


@dataclass(frozen=True)
class SuffixTile:
    """`rows` of queries of one observation for a cluster of `ranks` CTAs, `keys` keys at a time for each."""

    dim: int  # columns of a head
    rows: int
    ranks: int
    keys: int

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


def takes(dim: int, queries: int) -> bool:
    """Whether the kernel takes heads of that many columns, and is sooner with so many queries, those of all heads."""
    return dim % 64 == 0 and 64 <= dim <= 256 and queries >= LEAST_QUERIES
