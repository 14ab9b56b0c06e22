"""Rows of several observations together: embedding them, and attention that keeps them apart.

Twins: `kernels.plain_batch`. Logits, softmax and sums are float32; probabilities are rounded to the values' dtype for
their product, as in the twins. Where keys are split over blocks, each split's result is rounded to the queries' dtype.
"""

from functools import partial

import torch
import triton
import triton.language as tl
from torch import Tensor

from turbopi.kernels.dependent_launch import (
    dependent_launch,
    launch_dependents,
    prefetch,
    result_dtype,
    wait_for_producer,
)
from turbopi.kernels.interface import BatchOps, Segments
from turbopi.kernels.portable import batch_steps
from turbopi.kernels.portable.attention import LOG2_E
from turbopi.kernels.portable.attention_tiles import PACKED_ROWS, AttentionTile, chosen_tile
from turbopi.kernels.portable.rope import rotated
from turbopi.kernels.portable.rounding import as_stored, damaged
from turbopi.kernels.portable.shared_memory import capability_of
from turbopi.kernels.tile_table import NO_TILES, TileTable
from turbopi.quantization.fp8 import E4M3

BLOCKS_AT_ONCE = 264  # of suffix attention, two a multiprocessor of Hopper: keys are split over blocks up to so many


@triton.jit
def _embed_kernel(source, images, table, out, width, scale, BLOCK: tl.constexpr, PDL: tl.constexpr):
    row = tl.program_id(0).to(tl.int64)
    cols = tl.arange(0, BLOCK)
    wait_for_producer(PDL)
    launch_dependents(PDL)
    place = tl.load(source + row)
    if place >= 0:
        tl.store(out + row * width + cols, tl.load(images + place * width + cols, cols < width, 0.0), cols < width)
    else:
        x = tl.load(table + (-1 - place) * width + cols, cols < width, 0.0).to(tl.float32)
        tl.store(out + row * width + cols, (x * scale).to(out.dtype.element_ty), cols < width)


def embed_rows(source: Tensor, images: Tensor, table: Tensor, out: Tensor) -> None:
    """See `kernels.plain_batch.embed_rows`. All contiguous."""
    assert all(t.is_contiguous() for t in (source, images, table, out)), "rows are read as they lie in memory"
    width = table.shape[1]
    _embed_kernel[(len(source),)](
        source, images, table, out, width, width**0.5,
        BLOCK=triton.next_power_of_2(width), num_warps=4, **dependent_launch(out),
    )  # fmt: skip


@triton.jit
def _softmax_step(logits, values, acc, top, total):
    """One tile of keys' logits (base 2) and values into the running sums of a softmax."""
    new_top = tl.maximum(top, tl.max(logits, 1))
    p = tl.exp2(logits - new_top[:, None])
    shrink = tl.exp2(top - new_top)
    acc = tl.dot(p.to(values.dtype), values, acc * shrink[:, None], input_precision="ieee")
    return acc, new_top, total * shrink + tl.sum(p, 1)


@triton.jit
def _packed_kernel(
    q, k, v, tiles, out, heads, scale, inverse,
    DIM: tl.constexpr, BLOCK_D: tl.constexpr, BLOCK_M: tl.constexpr, BLOCK_N: tl.constexpr, SCALED: tl.constexpr,
    PDL: tl.constexpr,
):  # fmt: skip
    """A tile's rows of queries (of any head: they share the keys) over the keys of their segment."""
    tile = tiles + tl.program_id(0) * 4
    n = tl.arange(0, BLOCK_N)
    d = tl.arange(0, BLOCK_D)
    wait_for_producer(PDL)
    launch_dependents(PDL)
    first, end, key, count = tl.load(tile), tl.load(tile + 1), tl.load(tile + 2), tl.load(tile + 3)
    if first < end:
        m = (first + tl.arange(0, BLOCK_M)).to(tl.int64)
        inside = (m < end)[:, None] & (d < DIM)[None, :]
        queries = tl.load(q + m[:, None] * DIM + d[None, :], inside, 0.0)
        acc = tl.zeros((BLOCK_M, BLOCK_D), tl.float32)
        top = tl.full((BLOCK_M,), -float("inf"), tl.float32)
        total = tl.zeros((BLOCK_M,), tl.float32)
        for start in range(0, count, BLOCK_N):
            valid = start + n < count
            loaded = valid[:, None] & (d < DIM)[None, :]
            at = (key + start + n)[:, None] * DIM + d[None, :]
            logits = tl.dot(queries, tl.load(k + at, loaded, 0.0).T, input_precision="ieee") * scale
            logits = tl.where(valid[None, :], logits, -float("inf"))
            acc, top, total = _softmax_step(logits, tl.load(v + at, loaded, 0.0), acc, top, total)
        if SCALED:
            total /= inverse
        tl.store(out + m[:, None] * DIM + d[None, :], as_stored(acc / total[:, None], out), inside)
        if out.dtype.element_ty == tl.int8:
            tl.store(v + m // heads * DIM, float("nan"), (m < end) & damaged(acc / total[:, None], 1))


def packed_attention(
    q: Tensor,
    k: Tensor,
    v: Tensor,
    segments: Segments,
    heads: int,
    inverse: float | None = None,
    numbers: torch.dtype = E4M3,
    *,
    tile: AttentionTile | None = None,
    tiles: TileTable = NO_TILES,
) -> Tensor:
    """See `kernels.plain_batch.packed_attention`. With `inverse` the result leaves as `numbers`, E4M3 or int8."""
    assert q.is_contiguous() and k.is_contiguous() and v.is_contiguous(), "rows are read as they lie in memory"
    rows, dim = q.shape
    assert dim >= 16, f"heads of {dim} columns are narrower than a tensor core's 16"
    out = q.new_empty(rows // heads, heads * dim, dtype=result_dtype(q, inverse, numbers))
    assert out.dtype != torch.int8 or len(v) == len(out), "each token has a value to mark its damage in"
    tile = tile or chosen_tile(tiles, "packed_attention", capability_of(q), rows // heads, heads, dim)
    assert tile.rows == PACKED_ROWS, f"{tile}: `segments.tiles` have {PACKED_ROWS} rows"
    _packed_kernel[(len(segments.tiles),)](
        q, k, v, segments.tiles, out, heads, dim**-0.5 * LOG2_E, inverse or 1.0, DIM=dim,
        BLOCK_D=triton.next_power_of_2(dim), BLOCK_M=tile.rows, BLOCK_N=tile.keys, SCALED=inverse is not None,
        num_warps=tile.warps, num_stages=tile.stages, **dependent_launch(q),
    )  # fmt: skip
    return out


@triton.jit
def _turned(at, cos, sin, turn, there, HALF: tl.constexpr):
    """Both halves of heads after RoPE, in their dtype: HALF columns at `at` and HALF more. turn: where the angle is."""
    first = tl.load(at, there, 0.0).to(tl.float32)
    second = tl.load(at + HALF, there, 0.0).to(tl.float32)
    c, s = tl.load(cos + turn, there, 0.0), tl.load(sin + turn, there, 0.0)
    dtype = at.dtype.element_ty
    lower, upper = rotated(first, second, c, s)
    return lower.to(dtype), upper.to(dtype)


@triton.jit
def _logits(lower, upper, k_lower, k_upper, visible, scale):
    """Of queries and keys in two halves."""
    logits = tl.dot(lower, k_lower.T, input_precision="ieee")
    logits = tl.dot(upper, k_upper.T, logits, input_precision="ieee") * scale
    return tl.where(visible, logits, -float("inf"))


@triton.jit
def _suffix_kernel(
    qkv, cos, sin, prefix_k, prefix_v, starts, lengths, out, parts, weights, rows, tokens, heads, scale, inverse,
    HALF: tl.constexpr, BLOCK_HALF: tl.constexpr, BLOCK_D: tl.constexpr, BLOCK_M: tl.constexpr, BLOCK_N: tl.constexpr,
    BLOCK_T: tl.constexpr, LINES: tl.constexpr, SPLITS: tl.constexpr, STATE_TOKEN: tl.constexpr, SCALED: tl.constexpr,
    PDL: tl.constexpr,
):  # fmt: skip
    """BLOCK_M rows of one observation's queries over every SPLITS-th tile of its prefix; the last split has its suffix.

    A row is a head of a token. RoPE comes to queries and to the suffix's keys as they are loaded. With one split the
    result goes to `out`, else the split's own result to `parts` and the logarithm (base 2) of its weight to `weights`,
    by split and row.
    """
    DIM: tl.constexpr = 2 * HALF
    batch, split = tl.program_id(1), tl.program_id(2)
    own = tl.program_id(0) * BLOCK_M + tl.arange(0, BLOCK_M)
    n = tl.arange(0, BLOCK_N)
    pair = tl.arange(0, BLOCK_HALF)
    d = tl.arange(0, BLOCK_D)
    begin, end = tl.load(starts + batch), tl.load(lengths + batch)
    if PDL and tl.program_id(0) == 0:  # the prefix was there long before
        line = tl.arange(0, LINES) * 64
        for start in range(split * BLOCK_N, end, SPLITS * BLOCK_N):
            row = (begin + tl.minimum(start + n, end - 1)).to(tl.int64)
            prefetch(prefix_k + (row[:, None] * DIM + line[None, :]), PDL)
            prefetch(prefix_v + (row[:, None] * DIM + line[None, :]), PDL)
    launch_dependents(PDL)
    wait_for_producer(PDL)
    width = (heads + 2) * DIM
    token = batch * tokens + own // heads
    there = (own < rows)[:, None] & (pair < HALF)[None, :]
    q_at = qkv + (token.to(tl.int64)[:, None] * width + (own % heads)[:, None] * DIM + pair[None, :])
    lower, upper = _turned(q_at, cos, sin, token[:, None] * HALF + pair[None, :], there, HALF)
    acc = tl.zeros((BLOCK_M, BLOCK_D), tl.float32)
    top = tl.full((BLOCK_M,), -float("inf"), tl.float32)
    total = tl.zeros((BLOCK_M,), tl.float32)
    for start in range(split * BLOCK_N, end, SPLITS * BLOCK_N):
        valid = start + n < end
        halves = valid[:, None] & (pair < HALF)[None, :]
        row = (begin + start + n).to(tl.int64)[:, None] * DIM
        k_at = prefix_k + (row + pair[None, :])
        k_lower, k_upper = tl.load(k_at, halves, 0.0), tl.load(k_at + HALF, halves, 0.0)
        values = tl.load(prefix_v + (row + d[None, :]), valid[:, None] & (d < DIM)[None, :], 0.0)
        logits = _logits(lower, upper, k_lower, k_upper, valid[None, :], scale)
        acc, top, total = _softmax_step(logits, values, acc, top, total)
    if split == SPLITS - 1:
        t = tl.arange(0, BLOCK_T)
        for start in tl.range(0, tokens, BLOCK_T, num_stages=1):  # RoPE's float32 would fill shared memory
            valid = start + t < tokens
            halves = valid[:, None] & (pair < HALF)[None, :]
            beside = batch * tokens + start + t
            k_at = qkv + (beside.to(tl.int64)[:, None] * width + heads * DIM)
            turn = beside[:, None] * HALF + pair[None, :]
            k_lower, k_upper = _turned(k_at + pair[None, :], cos, sin, turn, halves, HALF)
            values = tl.load(k_at + DIM + d[None, :], valid[:, None] & (d < DIM)[None, :], 0.0)
            visible = valid[None, :]
            if STATE_TOKEN:
                visible = visible & ((own >= heads)[:, None] | (start + t == 0)[None, :])
            logits = _logits(lower, upper, k_lower, k_upper, visible, scale)
            acc, top, total = _softmax_step(logits, values, acc, top, total)
    m = batch * rows + own
    inside = (own < rows)[:, None] & (d < DIM)[None, :]
    if SPLITS == 1:
        if SCALED:
            total /= inverse
        tl.store(out + m[:, None] * DIM + d[None, :], (acc / total[:, None]).to(out.dtype.element_ty), inside)
    else:
        place = split.to(tl.int64) * tl.num_programs(1) * rows + m
        some = total > 0  # else the split had no keys: its sums are 0, and its weight is 2^-inf
        result = acc / tl.where(some, total, 1.0)[:, None]
        tl.store(parts + place[:, None] * DIM + d[None, :], result.to(parts.dtype.element_ty), inside)
        tl.store(weights + place, tl.where(some, top + tl.log2(total), -float("inf")), own < rows)


@triton.jit
def _combine_kernel(
    parts, weights, out, count, inverse,
    DIM: tl.constexpr, BLOCK_D: tl.constexpr, SPLITS: tl.constexpr, BLOCK_S: tl.constexpr, SCALED: tl.constexpr,
    PDL: tl.constexpr,
):  # fmt: skip
    row = tl.program_id(0)
    d = tl.arange(0, BLOCK_D)
    split = tl.arange(0, BLOCK_S)
    place = split * count + row
    launch_dependents(PDL)
    wait_for_producer(PDL)
    weight = tl.load(weights + place, split < SPLITS, -float("inf"))
    results = tl.load(
        parts + place.to(tl.int64)[:, None] * DIM + d[None, :], (split < SPLITS)[:, None] & (d < DIM)[None, :], 0.0
    )
    share = tl.exp2(weight - tl.max(weight, 0))  # 2^-inf is 0: who had no keys counts for nothing
    whole = tl.sum(share, 0)
    if SCALED:
        whole /= inverse
    result = tl.sum(results.to(tl.float32) * share[:, None], 0) / whole
    tl.store(out + row * DIM + d, result.to(out.dtype.element_ty), d < DIM)


def suffix_attention(
    qkv: Tensor,
    cos: Tensor,
    sin: Tensor,
    prefix_k: Tensor,
    prefix_v: Tensor,
    starts: Tensor,
    lengths: Tensor,
    heads: int,
    state_token: bool = False,
    inverse: float | None = None,
    *,
    tile: AttentionTile | None = None,
    tiles: TileTable = NO_TILES,
) -> Tensor:
    """See `kernels.plain_batch.suffix_attention`. All contiguous. With `inverse` the result leaves as E4M3.

    The prefix's keys and values and the segments must have been written before the kernel in front of this one began.
    """
    given = (qkv, cos, sin, prefix_k, prefix_v, starts, lengths)
    assert all(one.is_contiguous() for one in given), "rows are read as they lie in memory"
    batch, count, dim = len(starts) - 1, len(qkv), prefix_k.shape[1]
    assert dim >= 16 and dim % 2 == 0, f"heads of {dim} columns: RoPE turns pairs, a tensor core takes 16"
    assert qkv.shape[1] == (heads + 2) * dim and cos.shape == sin.shape == (count, dim // 2)
    rows = count // batch * heads  # of queries of an observation
    tile = tile or chosen_tile(tiles, "suffix_attention", capability_of(qkv), count, heads, dim)
    along = triton.cdiv(rows, tile.rows)
    splits = suffix_splits(along * batch, len(prefix_k) // batch, tile.keys)
    out = qkv.new_empty(count, heads * dim, dtype=result_dtype(qkv, inverse))
    parts = qkv.new_empty(splits, batch * rows, dim) if splits > 1 else out
    weights = torch.empty(splits, batch * rows, device=qkv.device) if splits > 1 else out
    sizes = {"BLOCK_D": triton.next_power_of_2(dim), "SPLITS": splits, "SCALED": inverse is not None}
    _suffix_kernel[(along, batch, splits)](
        *given, out, parts, weights, rows, count // batch, heads, dim**-0.5 * LOG2_E, inverse or 1.0,
        HALF=dim // 2, BLOCK_HALF=max(16, triton.next_power_of_2(dim // 2)), BLOCK_M=tile.rows, BLOCK_N=tile.keys,
        BLOCK_T=16 if count // batch <= 16 else 32, LINES=triton.cdiv(triton.next_power_of_2(dim), 64),
        STATE_TOKEN=state_token, num_warps=tile.warps, num_stages=tile.stages, **sizes, **dependent_launch(qkv),
    )  # fmt: skip
    if splits > 1:
        _combine_kernel[(batch * rows,)](
            parts, weights, out, batch * rows, inverse or 1.0, DIM=dim, BLOCK_S=triton.next_power_of_2(splits),
            num_warps=1, **sizes, **dependent_launch(qkv),
        )  # fmt: skip
    return out


def suffix_splits(blocks: int, keys: int, block_n: int) -> int:
    """Over how many blocks the keys of an observation's prefix are split, if each of `blocks` has all of them."""
    return max(1, min(BLOCKS_AT_ONCE // blocks, triton.cdiv(keys, 2 * block_n)))


def batch_ops(tiles: TileTable = NO_TILES) -> BatchOps:
    """With attention in these tiles."""
    return BatchOps(
        embed_rows=embed_rows,
        packed_attention=partial(packed_attention, tiles=tiles),
        suffix_attention=partial(suffix_attention, tiles=tiles),
        end_step=batch_steps.end_step,
        expert=batch_steps.expert,
        origin="Triton",
    )


BATCH = batch_ops()
