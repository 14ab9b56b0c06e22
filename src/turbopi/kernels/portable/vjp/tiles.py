"""How the products of few tokens are cut: whole rows of tokens, so many columns and so much of the inner axis.

A program takes all tokens and streams its part of a matrix, so parts are small enough that each multiprocessor has one.
"""

from dataclasses import dataclass

from turbopi.config import GemmaConfig
from turbopi.kernels.portable.attention_tiles import Capability
from turbopi.kernels.portable.shared_memory import BLOCK_SHARED, LEAST_SHARED

MOST_TOKENS = 64  # whose rows fit one tile
LEAST_ROWS = 16  # a tensor core's
SPLITS = 8  # of a long inner axis
LINE = 128  # bytes that memory hands over at once


@dataclass(frozen=True)
class Tile:
    """Of a product that streams a matrix."""

    rows: int  # of tokens: all of them
    columns: int  # of the result, for each of the matrices
    depth: int  # of the inner axis at a time
    warps: int
    stages: int


def takes(expert: GemmaConfig, tokens: int) -> bool:
    """Whether an expert of these sizes on so many tokens fits these kernels."""
    even = all(size % 16 == 0 for size in (expert.width, expert.mlp_dim))
    whole_heads = expert.head_dim >= 16 and expert.head_dim & (expert.head_dim - 1) == 0
    return even and whole_heads and expert.head_dim <= 256 and expert.num_kv_heads == 1 and tokens <= MOST_TOKENS


def token_rows(tokens: int) -> int:
    """Rows of a tile that holds all tokens: a power of two from 16 on."""
    return max(LEAST_ROWS, 1 << (tokens - 1).bit_length())


def power_dividing(size: int, most: int) -> int:
    """The largest power of two that divides `size`, at most `most`."""
    return min(size & -size, most)


def split_of(inner: int) -> int:
    """How much of a long inner axis a program takes."""
    return inner // SPLITS if inner % (16 * SPLITS) == 0 else inner


def streaming(
    capability: Capability, tokens: int, columns: int, inner: int, most_columns: int, matrices: int = 1
) -> Tile:
    """`matrices` are read at once, each in `columns` columns; two blocks shall fit a multiprocessor."""
    rows = token_rows(tokens)
    taken, depth = power_dividing(columns, most_columns), power_dividing(inner, 128)
    stage = (rows + matrices * taken) * depth * 2
    room = BLOCK_SHARED.get(capability, LEAST_SHARED) // 2
    return Tile(rows, taken, depth, warps=4, stages=max(2, min(4, room // stage)))


@dataclass(frozen=True)
class AttentionCut:
    """Of attention over a suffix and its prefix."""

    rows: int  # of queries, of any head
    keys: int  # at a time
    split: int  # keys of a program
    own_rows: int  # rows at a time where a suffix's own keys gather gradient
    group: int  # rows of one such program
    back_warps: int = 8
    warps: int = 4
    stages: int = 2

    def splits(self, keys: int) -> int:
        return -(-keys // self.split)


OWN_KEYS = 16  # of a program that gathers their gradient


def attention_cut(capability: Capability, tokens: int, keys: int) -> AttentionCut:
    """Few splits, as the product behind adds them up. Each is a multiple of the keys at a time."""
    at_once = 64 if BLOCK_SHARED.get(capability, LEAST_SHARED) > 128 * 1024 else 32
    least, most = (128, SPLITS) if tokens <= 16 else (256, 3)
    split = max(least, -(-keys // most))
    split = -(-split // at_once) * at_once
    return AttentionCut(16, at_once, split, own_rows=32, group=64 if tokens <= 16 else 128)
