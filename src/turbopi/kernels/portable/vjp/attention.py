"""Attention of a suffix over its prefix and itself, forward and back, with the keys split over programs.

Twins: `kernels.backward.attention` and `attention_vjp`. Logits, softmax and sums are float32; what enters a product has
the queries' dtype. The way back computes the probabilities again, from the softmax's log-sum (base 2).
"""

from dataclasses import dataclass

import torch
import triton
import triton.language as tl
from torch import Tensor

from turbopi.kernels.dependent_launch import dependent_launch, launch_dependents, wait_for_producer
from turbopi.kernels.portable.attention import LOG2_E
from turbopi.kernels.portable.shared_memory import capability_of
from turbopi.kernels.portable.vjp.products import out_of_splits
from turbopi.kernels.portable.vjp.tiles import OWN_KEYS, attention_cut


@dataclass(frozen=True)
class Kept:
    """What the way back needs; the last two are written by the product behind attention."""

    q: Tensor  # [T * n, K]
    attended: Tensor  # [T * n, K]
    lse: Tensor  # float32[T * n]


@dataclass(frozen=True)
class Attended:
    """Splits that the product behind makes one: sums [splits, T * n, K], tops and totals [splits, T * n], float32."""

    sums: Tensor
    tops: Tensor
    totals: Tensor
    kept: Kept


@triton.jit
def _visible(row, key, length, slots, keys, heads, STATE_TOKEN: tl.constexpr):
    """Which keys these rows see, of shapes that broadcast."""
    seen = ((key < length) | (key >= slots)) & (key < keys)
    if STATE_TOKEN:
        seen = seen & ((row >= heads) | (key <= slots))
    return seen


@triton.jit
def _attention_kernel(
    q, k, v, length, sums, tops, totals, rows, keys, slots, heads, split, scale,
    DIM: tl.constexpr, BLOCK_M: tl.constexpr, BLOCK_N: tl.constexpr, STATE_TOKEN: tl.constexpr, PDL: tl.constexpr,
):  # fmt: skip
    """BLOCK_M rows of queries over `split` keys."""
    m = tl.program_id(0) * BLOCK_M + tl.arange(0, BLOCK_M)
    n, d = tl.arange(0, BLOCK_N), tl.arange(0, DIM)
    begin = tl.program_id(1) * split
    wait_for_producer(PDL)
    launch_dependents(PDL)
    valid = tl.load(length).to(tl.int32)
    there = m < rows
    queries = tl.load(q + (m[:, None] * DIM + d[None, :]), there[:, None], 0.0)
    acc = tl.zeros((BLOCK_M, DIM), tl.float32)
    top = tl.full((BLOCK_M,), -1e30, tl.float32)  # finite: a split may have no visible key
    total = tl.zeros((BLOCK_M,), tl.float32)
    for start in range(begin, tl.minimum(begin + split, keys), BLOCK_N):
        key = start + n
        at = key[:, None] * DIM + d[None, :]
        loaded = (key < keys)[:, None]
        logits = tl.dot(queries, tl.load(k + at, loaded, 0.0).T, input_precision="ieee") * scale
        seen = _visible(m[:, None], key[None, :], valid, slots, keys, heads, STATE_TOKEN)
        new_top = tl.maximum(top, tl.max(tl.where(seen, logits, -1e30), 1))
        p = tl.where(seen, tl.exp2(logits - new_top[:, None]), 0.0)
        shrink = tl.exp2(top - new_top)
        total = total * shrink + tl.sum(p, 1)
        top = new_top
        values = tl.load(v + at, loaded, 0.0)
        acc = tl.dot(p.to(values.dtype), values, acc * shrink[:, None], input_precision="ieee")
    place = tl.program_id(1) * rows + m
    tl.store(sums + (place[:, None] * DIM + d[None, :]), acc, there[:, None])
    tl.store(tops + place, top, there)
    tl.store(totals + place, total, there)


def attention(
    q: Tensor, k: Tensor, v: Tensor, length: Tensor, slots: int, heads: int, state_token: bool
) -> tuple[Attended, Kept]:
    """See the twin. q [T * n, K], k and v [R, K]."""
    assert q.is_contiguous() and k.is_contiguous() and v.is_contiguous(), "rows are read as they lie in memory"
    (rows, dim), keys = q.shape, len(k)
    cut = attention_cut(capability_of(q), rows // heads, keys)
    splits = cut.splits(keys)
    sums = q.new_empty(splits, rows, dim, dtype=torch.float32)
    tops, totals = (q.new_empty(splits, rows, dtype=torch.float32) for _ in range(2))
    kept = Kept(q, torch.empty_like(q), q.new_empty(rows, dtype=torch.float32))
    _attention_kernel[(triton.cdiv(rows, cut.rows), splits)](
        q, k, v, length, sums, tops, totals, rows, keys, slots, heads, cut.split, dim**-0.5 * LOG2_E,
        DIM=dim, BLOCK_M=cut.rows, BLOCK_N=cut.keys, STATE_TOKEN=state_token, num_warps=cut.warps,
        num_stages=cut.stages, **dependent_launch(q),
    )  # fmt: skip
    return Attended(sums, tops, totals, kept), kept


def out(attended: Attended, weight: Tensor) -> Tensor:
    """See the twin. weight [D, n * K] -> float32[n, T, D]; what is kept of attention is complete after it."""
    kept = attended.kept
    return out_of_splits(attended.sums, attended.tops, attended.totals, weight, kept.attended, kept.lse)


@triton.jit
def _attention_vjp_kernel(
    q, k, v, attended, lse, d_attended, length, d_q, d_kv, rows, keys, slots, heads, split, splits, groups, group,
    scale,
    DIM: tl.constexpr, BLOCK_M: tl.constexpr, BLOCK_N: tl.constexpr, OWN_ROWS: tl.constexpr, OWN_KEYS: tl.constexpr,
    STATE_TOKEN: tl.constexpr, PDL: tl.constexpr,
):  # fmt: skip
    """BLOCK_M rows' gradient from `split` keys; behind the splits OWN_KEYS of the suffix's keys', from a group of rows.

    scale: of logits as they are; powers are of two.
    """
    d = tl.arange(0, DIM)
    wait_for_producer(PDL)
    launch_dependents(PDL)
    valid = tl.load(length).to(tl.int32)
    by_two = scale * 1.4426950408889634
    if tl.program_id(1) < splits:
        m = tl.program_id(0) * BLOCK_M + tl.arange(0, BLOCK_M)
        there = m < rows
        place = m[:, None] * DIM + d[None, :]
        queries = tl.load(q + place, there[:, None], 0.0)
        d_out = tl.load(d_attended + place, there[:, None], 0.0)
        along = tl.sum(d_out.to(tl.float32) * tl.load(attended + place, there[:, None], 0.0).to(tl.float32), 1)
        log_sum = tl.load(lse + m, there, 0.0)
        acc = tl.zeros((BLOCK_M, DIM), tl.float32)
        begin = tl.program_id(1) * split
        for start in range(begin, tl.minimum(begin + split, keys), BLOCK_N):
            key = start + tl.arange(0, BLOCK_N)
            at = key[:, None] * DIM + d[None, :]
            loaded = (key < keys)[:, None]
            ours = tl.load(k + at, loaded, 0.0)
            values = tl.load(v + at, loaded, 0.0)
            logits = tl.dot(queries, ours.T, input_precision="ieee") * by_two
            seen = _visible(m[:, None], key[None, :], valid, slots, keys, heads, STATE_TOKEN)
            p = tl.where(seen, tl.exp2(logits - log_sum[:, None]), 0.0)
            d_p = tl.dot(d_out, values.T, input_precision="ieee")
            d_logits = p * (d_p - along[:, None]) * scale
            acc = tl.dot(d_logits.to(ours.dtype), ours, acc, input_precision="ieee")
        tl.store(d_q + ((tl.program_id(1) * rows + m)[:, None] * DIM + d[None, :]), acc, there[:, None])
    else:
        tokens = keys - slots
        t = tl.program_id(0) // groups * OWN_KEYS + tl.arange(0, OWN_KEYS)
        which = tl.program_id(0) % groups
        own = slots * DIM + t[:, None] * DIM + d[None, :]
        mine = tl.load(k + own, (t < tokens)[:, None], 0.0)
        my_values = tl.load(v + own, (t < tokens)[:, None], 0.0)
        d_k = tl.zeros((OWN_KEYS, DIM), tl.float32)
        d_v = tl.zeros((OWN_KEYS, DIM), tl.float32)
        for start in range(which * group, tl.minimum(which * group + group, rows), OWN_ROWS):
            r = start + tl.arange(0, OWN_ROWS)
            there = r < rows
            place = r[:, None] * DIM + d[None, :]
            queries = tl.load(q + place, there[:, None], 0.0)
            d_out = tl.load(d_attended + place, there[:, None], 0.0)
            along = tl.sum(d_out.to(tl.float32) * tl.load(attended + place, there[:, None], 0.0).to(tl.float32), 1)
            logits = tl.dot(mine, queries.T, input_precision="ieee") * by_two
            seen = _visible(r[None, :], (slots + t)[:, None], valid, slots, keys, heads, STATE_TOKEN)
            p = tl.where(seen & there[None, :], tl.exp2(logits - tl.load(lse + r, there, 0.0)[None, :]), 0.0)
            d_v = tl.dot(p.to(mine.dtype), d_out, d_v, input_precision="ieee")
            d_p = tl.dot(my_values, d_out.T, input_precision="ieee")
            d_logits = p * (d_p - along[None, :]) * scale
            d_k = tl.dot(d_logits.to(mine.dtype), queries, d_k, input_precision="ieee")
        to = d_kv + (((which * tokens + t) * 2)[:, None] * DIM + d[None, :])
        tl.store(to, d_k, (t < tokens)[:, None])
        tl.store(to + DIM, d_v, (t < tokens)[:, None])


def attention_vjp(
    kept: Kept, d_attended: Tensor, k: Tensor, v: Tensor, length: Tensor, slots: int, heads: int, state_token: bool
) -> tuple[Tensor, Tensor]:
    """See the twin. d_attended [T, n * K] -> parts that `qkv_vjp` adds up: of the queries float32[splits, T * n, K],
    of the suffix's keys and values float32[groups, T, 2, K].
    """
    q = kept.q
    assert d_attended.is_contiguous() and k.is_contiguous() and v.is_contiguous(), "rows are read as they lie in memory"
    (rows, dim), keys = q.shape, len(k)
    tokens = rows // heads
    assert keys - slots == tokens, f"{tokens} tokens behind {slots} slots, {keys} keys"
    cut = attention_cut(capability_of(q), tokens, keys)
    splits, groups = cut.splits(keys), triton.cdiv(rows, cut.group)
    d_q = q.new_empty(splits, rows, dim, dtype=torch.float32)
    d_kv = q.new_empty(groups, tokens, 2, dim, dtype=torch.float32)
    # as many blocks before the last row of the grid as in it: tokens / 16 keys' times groups is less
    across = max(triton.cdiv(rows, cut.rows), groups * triton.cdiv(tokens, OWN_KEYS))
    _attention_vjp_kernel[(across, splits + 1)](
        q, k, v, kept.attended, kept.lse, d_attended, length, d_q, d_kv, rows, keys, slots, heads, cut.split, splits,
        groups, cut.group, dim**-0.5,
        DIM=dim, BLOCK_M=cut.rows, BLOCK_N=cut.keys, OWN_ROWS=cut.own_rows, OWN_KEYS=OWN_KEYS, STATE_TOKEN=state_token,
        num_warps=cut.back_warps, num_stages=cut.stages, **dependent_launch(q),
    )  # fmt: skip
    return d_q, d_kv
