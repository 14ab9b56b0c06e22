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
    """`matrices` are read at once, each in at most `most_columns` columns; two blocks shall fit a multiprocessor.

    Up to 16 tokens a product has 32 columns at most, 8 a warp: what bounds it is a warp's chain of instructions, which
    more programs hide.
    """
    rows = token_rows(tokens)
    most_columns = min(most_columns, 32 // matrices) if rows == LEAST_ROWS else most_columns
    taken, depth = power_dividing(columns, most_columns), power_dividing(inner, 128)
    stage = (rows + matrices * taken) * depth * 2
    room = BLOCK_SHARED.get(capability, LEAST_SHARED) // 2
    return Tile(rows, taken, depth, warps=4, stages=max(2, min(4, room // stage)))


def row_block(tokens: int) -> int:
    """Rows of a tile where attention's splits are made or added up: of tokens, or of queries."""
    return min(32, token_rows(tokens))


def attention_span(capability: Capability) -> int:
    """Keys of one program, or rows of queries where a suffix's own keys gather gradient. Two such tiles, and one of
    them in another order, are in shared memory at a time. With 128 the compiler spills registers but for Hopper.
    """
    if capability == (9, 0):
        return 128
    return 64 if BLOCK_SHARED.get(capability, LEAST_SHARED) >= 163 * 1024 else 32
