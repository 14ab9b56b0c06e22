"""Which tile attention in Triton is computed with: one that was measured, else the usual one for the GPU."""

from dataclasses import dataclass
from typing import Literal

from turbopi.kernels.portable.shared_memory import BLOCK_SHARED, LEAST_SHARED
from turbopi.kernels.tile_table import TileTable

Attention = Literal["vision_attention", "prefix_attention", "packed_attention", "suffix_attention"]
Capability = tuple[int, int]


@dataclass(frozen=True)
class AttentionTile:
    """How attention is cut: query rows a program, keys at a time."""

    rows: int
    keys: int
    warps: int
    stages: int

    def takes(self, capability: Capability, columns: int) -> bool:
        """Whether queries, keys and values of so many columns fit shared memory, and the sums registers."""
        shared = (self.rows + 2 * self.stages * self.keys) * columns * 2
        sums = self.rows * (columns + self.keys) // (32 * self.warps)
        return shared <= BLOCK_SHARED.get(capability, LEAST_SHARED) and sums <= (MOST if roomy(capability) else FEWER)


def roomy(capability: Capability) -> bool:
    """Whether registers and shared memory are enough for the larger of two usual tiles. On 11.0 it spills."""
    return capability in ((9, 0), (10, 0), (10, 3))


MOST, FEWER = 160, 100  # sums a thread: with more it spills
PACKED_ROWS = 64  # as `Segments.tiles` says
USUAL: dict[Attention, tuple[AttentionTile, AttentionTile]] = {  # the second where there is less room
    "vision_attention": (AttentionTile(64, 64, 4, 3), AttentionTile(64, 64, 4, 3)),
    "prefix_attention": (AttentionTile(64, 64, 4, 2), AttentionTile(32, 32, 4, 2)),
    "packed_attention": (AttentionTile(PACKED_ROWS, 64, 8, 2), AttentionTile(PACKED_ROWS, 32, 8, 2)),
    "suffix_attention": (AttentionTile(16, 64, 4, 2), AttentionTile(16, 32, 4, 2)),
}
OTHERS: dict[Attention, tuple[AttentionTile, ...]] = {
    "vision_attention": (
        *(AttentionTile(64, 64, 4, 2), AttentionTile(64, 32, 4, 3), AttentionTile(64, 128, 4, 2)),
        *(AttentionTile(128, 64, 8, 2), AttentionTile(128, 64, 8, 3), AttentionTile(32, 64, 4, 3)),
    ),
    "prefix_attention": (
        *(AttentionTile(64, 64, 8, 2), AttentionTile(64, 32, 4, 2), AttentionTile(64, 32, 4, 3)),
        *(AttentionTile(128, 64, 8, 2), AttentionTile(128, 32, 8, 2), AttentionTile(64, 32, 8, 2)),
    ),
    "packed_attention": (AttentionTile(PACKED_ROWS, 32, 4, 2), AttentionTile(PACKED_ROWS, 32, 8, 3)),
    "suffix_attention": (
        *(AttentionTile(16, 32, 4, 3), AttentionTile(16, 128, 4, 2)),
        *(AttentionTile(32, 64, 8, 2), AttentionTile(64, 64, 8, 2), AttentionTile(128, 64, 8, 2)),
    ),
}


def usual_tile(attention: Attention, capability: Capability) -> AttentionTile:
    """What is taken where nobody measured."""
    large, small = USUAL[attention]
    return large if roomy(capability) else small


def candidates(attention: Attention, capability: Capability, dim: int) -> list[AttentionTile]:
    """All tiles that this GPU takes for heads of so many columns; the usual one is the first."""
    usual = usual_tile(attention, capability)
    whole = 1 << (dim.bit_length() - 1)  # tensor cores take powers of two, and vision's kernel the rest apart
    rest = 0 if whole == dim else max(16, 1 << (dim - whole - 1).bit_length())
    columns = whole + rest if attention == "vision_attention" else whole * (1 + (rest > 0))
    known = dict.fromkeys((*USUAL[attention], *OTHERS[attention]))
    return [usual, *(tile for tile in known if tile != usual and tile.takes(capability, columns))]


def chosen_tile(
    table: TileTable, attention: Attention, capability: Capability, rows: int, heads: int, dim: int
) -> AttentionTile:
    """The measured tile, else the usual one."""
    knobs = table.find("portable", attention, "bf16", rows, heads, dim)
    return usual_tile(attention, capability) if knobs is None else AttentionTile(**knobs)
