"""Attention of a suffix over its prefix and itself, forward and back, with the keys split over programs.

Twins: `kernels.backward.attention` and `attention_vjp`. Logits, softmax and sums are float32; what enters a product has
the queries' dtype. The way back computes the probabilities again, from the softmax's log-sum (base 2).
"""

from dataclasses import dataclass

import torch
import triton
import triton.language as tl
from torch import Tensor

from turbopi.kernels.dependent_launch import dependent_launch, launch_dependents, prefetch, wait_for_producer
from turbopi.kernels.portable.attention import LOG2_E
from turbopi.kernels.portable.shared_memory import capability_of
from turbopi.kernels.portable.vjp.products import out_of_splits
from turbopi.kernels.portable.vjp.tiles import LEAST_ROWS, attention_span, row_block


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
def _prefetch(rows, at, last, DIM: tl.constexpr, PDL: tl.constexpr):
    """The rows `at` of DIM bfloat16 numbers, of which `last` is the last there is."""
    LINES: tl.constexpr = max(1, DIM // 64)
    place = tl.minimum(at, last)[:, None] * DIM + (tl.arange(0, LINES) * 64)[None, :]
    prefetch(rows + place, PDL)


@triton.jit
def _attention_kernel(
    q, k, v, length, sums, tops, totals, rows, keys, slots, heads, scale,
    DIM: tl.constexpr, ROWS: tl.constexpr, SPAN: tl.constexpr, STATE_TOKEN: tl.constexpr, PDL: tl.constexpr,
):  # fmt: skip
    """ROWS of queries over SPAN keys."""
    m, d = tl.program_id(0) * ROWS + tl.arange(0, ROWS), tl.arange(0, DIM)
    key = tl.program_id(1) * SPAN + tl.arange(0, SPAN)
    _prefetch(k, key, keys - 1, DIM, PDL)
    _prefetch(v, key, keys - 1, DIM, PDL)
    there, loaded = (m < rows)[:, None], (key < keys)[:, None]
    at = key[:, None] * DIM + d[None, :]
    wait_for_producer(PDL)
    launch_dependents(PDL)
    queries = tl.load(q + (m[:, None] * DIM + d[None, :]), there, 0.0)
    ours = tl.load(k + at, loaded, 0.0)
    values = tl.load(v + at, loaded, 0.0)
    seen = _visible(m[:, None], key[None, :], tl.load(length).to(tl.int32), slots, keys, heads, STATE_TOKEN)
    logits = tl.where(seen, tl.dot(queries, ours.T, input_precision="ieee") * scale, -1e30)
    top = tl.max(logits, 1)  # finite, also where no key is visible
    p = tl.where(seen, tl.exp2(logits - top[:, None]), 0.0)
    place = tl.program_id(1) * rows + m
    tl.store(tops + place, top, m < rows)
    tl.store(totals + place, tl.sum(p, 1), m < rows)
    result = tl.dot(p.to(values.dtype), values, input_precision="ieee")
    tl.store(sums + (place[:, None] * DIM + d[None, :]), result, there)


def attention(
    q: Tensor, k: Tensor, v: Tensor, length: Tensor, slots: int, heads: int, state_token: bool
) -> tuple[Attended, Kept]:
    """See the twin. q [T * n, K], k and v [R, K]."""
    assert q.is_contiguous() and k.is_contiguous() and v.is_contiguous(), "rows are read as they lie in memory"
    (rows, dim), keys, span = q.shape, len(k), attention_span(capability_of(q))
    splits, block = triton.cdiv(keys, span), row_block(rows // heads)
    sums = q.new_empty(splits, rows, dim, dtype=torch.float32)
    tops, totals = (q.new_empty(splits, rows, dtype=torch.float32) for _ in range(2))
    kept = Kept(q, torch.empty_like(q), q.new_empty(rows, dtype=torch.float32))
    _attention_kernel[(triton.cdiv(rows, block), splits)](
        q, k, v, length, sums, tops, totals, rows, keys, slots, heads, dim**-0.5 * LOG2_E,
        DIM=dim, ROWS=block, SPAN=span, STATE_TOKEN=state_token, num_warps=span // 16, **dependent_launch(q),
    )  # fmt: skip
    return Attended(sums, tops, totals, kept), kept


@triton.jit
def _kept_kernel(
    q, k, v, length, attended, lse, rows, keys, slots, heads, stride, scale,
    DIM: tl.constexpr, ROWS: tl.constexpr, SPAN: tl.constexpr, STATE_TOKEN: tl.constexpr, PDL: tl.constexpr,
):  # fmt: skip
    """ROWS of queries of one layer over all keys, SPAN at a time."""
    layer = tl.program_id(1).to(tl.int64)
    m, d = tl.program_id(0) * ROWS + tl.arange(0, ROWS), tl.arange(0, DIM)
    there = (m < rows)[:, None]
    place = layer * rows * DIM + m[:, None] * DIM + d[None, :]
    wait_for_producer(PDL)
    launch_dependents(PDL)
    valid = tl.load(length).to(tl.int32)
    queries = tl.load(q + place, there, 0.0)
    acc = tl.zeros((ROWS, DIM), tl.float32)
    top = tl.full((ROWS,), -1e30, tl.float32)
    total = tl.zeros((ROWS,), tl.float32)
    for start in range(0, keys, SPAN):
        key = start + tl.arange(0, SPAN)
        at = layer * stride + key[:, None] * DIM + d[None, :]
        loaded = (key < keys)[:, None]
        seen = _visible(m[:, None], key[None, :], valid, slots, keys, heads, STATE_TOKEN)
        logits = tl.dot(queries, tl.load(k + at, loaded, 0.0).T, input_precision="ieee") * scale
        new_top = tl.maximum(top, tl.max(tl.where(seen, logits, -1e30), 1))
        p = tl.where(seen, tl.exp2(logits - new_top[:, None]), 0.0)
        shrink = tl.exp2(top - new_top)
        total = total * shrink + tl.sum(p, 1)
        top = new_top
        values = tl.load(v + at, loaded, 0.0)
        acc = tl.dot(p.to(values.dtype), values, acc * shrink[:, None], input_precision="ieee")
    tl.store(attended + place, (acc / total[:, None]).to(attended.dtype.element_ty), there)
    tl.store(lse + (layer * rows + m), top + tl.log2(total), m < rows)


def kept_attention(
    q: Tensor, k: Tensor, v: Tensor, length: Tensor, slots: int, heads: int, state_token: bool
) -> list[Kept]:
    """See the twin. q [L, T * n, K], k and v [L, R, K], each layer's rows one behind the other."""
    (layers, rows, dim), keys = q.shape, k.shape[1]
    assert q.is_contiguous() and k.stride() == v.stride() and k.stride()[1:] == (dim, 1), (q.stride(), k.stride())
    attended, lse = torch.empty_like(q), q.new_empty(layers, rows, dtype=torch.float32)
    block = row_block(rows // heads)
    _kept_kernel[(triton.cdiv(rows, block), layers)](
        q, k, v, length, attended, lse, rows, keys, slots, heads, k.stride(0), dim**-0.5 * LOG2_E,
        DIM=dim, ROWS=block, SPAN=attention_span(capability_of(q)) // 2, STATE_TOKEN=state_token,
        num_warps=block // 4, num_stages=2, **dependent_launch(q),
    )  # fmt: skip
    return [Kept(*layer) for layer in zip(q, attended, lse, strict=True)]


def out(attended: Attended, weight: Tensor) -> Tensor:
    """See the twin. weight [D, n * K] -> float32[n, T, D]; what is kept of attention is complete after it."""
    kept = attended.kept
    return out_of_splits(attended.sums, attended.tops, attended.totals, weight, kept.attended, kept.lse)


@triton.jit
def _attention_vjp_kernel(
    q, k, v, attended, lse, d_attended, length, d_q, d_kv, rows, keys, slots, heads, splits, groups, scale,
    DIM: tl.constexpr, ROWS: tl.constexpr, OWN_KEYS: tl.constexpr, SPAN: tl.constexpr, STATE_TOKEN: tl.constexpr,
    PDL: tl.constexpr,
):  # fmt: skip
    """ROWS of queries' gradient from SPAN keys; behind the splits OWN_KEYS of the suffix's, from SPAN queries.

    Only `d_attended` is of the kernel in front: probabilities are there when it ends. scale: of logits as they are;
    powers are of two.
    """
    d = tl.arange(0, DIM)
    many = tl.arange(0, SPAN)
    tokens = keys - slots
    valid = tl.load(length).to(tl.int32)
    by_two = scale * 1.4426950408889634
    if tl.program_id(1) < splits:
        m, key = tl.program_id(0) * ROWS + tl.arange(0, ROWS), tl.program_id(1) * SPAN + many
        there, loaded = (m < rows)[:, None], (key < keys)[:, None]
        place, at = m[:, None] * DIM + d[None, :], key[:, None] * DIM + d[None, :]
        queries = tl.load(q + place, there, 0.0)
        ours = tl.load(k + at, loaded, 0.0)
        values = tl.load(v + at, loaded, 0.0)
        result = tl.load(attended + place, there, 0.0)
        logits = tl.dot(queries, ours.T, input_precision="ieee") * by_two
        seen = _visible(m[:, None], key[None, :], valid, slots, keys, heads, STATE_TOKEN)
        p = tl.where(seen, tl.exp2(logits - tl.load(lse + m, m < rows, 0.0)[:, None]), 0.0)
        wait_for_producer(PDL)
        launch_dependents(PDL)
        d_out = tl.load(d_attended + place, there, 0.0)
        along = tl.sum(d_out.to(tl.float32) * result.to(tl.float32), 1)
        d_p = tl.dot(d_out, values.T, input_precision="ieee")
        d_logits = (p * (d_p - along[:, None]) * scale).to(ours.dtype)
        to = (tl.program_id(1) * rows + m)[:, None] * DIM + d[None, :]
        tl.store(d_q + to, tl.dot(d_logits, ours, input_precision="ieee"), there)
    elif tl.program_id(0) < groups * tl.cdiv(tokens, OWN_KEYS):
        which = tl.program_id(0) % groups
        t = tl.program_id(0) // groups * OWN_KEYS + tl.arange(0, OWN_KEYS)
        m = which * SPAN + many
        there, own = (m < rows)[:, None], (t < tokens)[:, None]
        place, at = m[:, None] * DIM + d[None, :], (slots + t)[:, None] * DIM + d[None, :]
        queries = tl.load(q + place, there, 0.0)
        ours = tl.load(k + at, own, 0.0)
        values = tl.load(v + at, own, 0.0)
        result = tl.load(attended + place, there, 0.0)
        logits = tl.dot(ours, queries.T, input_precision="ieee") * by_two
        seen = _visible(m[None, :], (slots + t)[:, None], valid, slots, keys, heads, STATE_TOKEN)
        p = tl.exp2(logits - tl.load(lse + m, m < rows, 0.0)[None, :])
        p = tl.where(seen & (m < rows)[None, :], p, 0.0)
        wait_for_producer(PDL)
        launch_dependents(PDL)
        d_out = tl.load(d_attended + place, there, 0.0)
        along = tl.sum(d_out.to(tl.float32) * result.to(tl.float32), 1)
        to = d_kv + (((which * tokens + t) * 2)[:, None] * DIM + d[None, :])
        tl.store(to + DIM, tl.dot(p.to(ours.dtype), d_out, input_precision="ieee"), own)
        d_p = tl.dot(values, d_out.T, input_precision="ieee")
        d_logits = (p * (d_p - along[None, :]) * scale).to(ours.dtype)
        tl.store(to, tl.dot(d_logits, queries, input_precision="ieee"), own)


def attention_vjp(
    kept: Kept, d_attended: Tensor, k: Tensor, v: Tensor, length: Tensor, slots: int, heads: int, state_token: bool
) -> tuple[Tensor, Tensor]:
    """See the twin. d_attended [T, n * K] -> parts that `qkv_vjp` adds up: of the queries float32[splits, T * n, K],
    of the suffix's keys and values float32[groups, T, 2, K].

    All but d_attended is read before the kernel in front has ended. So that must wait before it lets this one start, as
    `out_vjp` does, and not be `out`, which completes `kept`.
    """
    q = kept.q
    assert d_attended.is_contiguous() and k.is_contiguous() and v.is_contiguous(), "rows are read as they lie in memory"
    (rows, dim), keys, span = q.shape, len(k), attention_span(capability_of(q))
    tokens = rows // heads
    assert keys - slots == tokens, f"{tokens} tokens behind {slots} slots, {keys} keys"
    splits, groups, block = triton.cdiv(keys, span), triton.cdiv(rows, span), row_block(tokens)
    d_q = q.new_empty(splits, rows, dim, dtype=torch.float32)
    d_kv = q.new_empty(groups, tokens, 2, dim, dtype=torch.float32)
    across = max(triton.cdiv(rows, block), groups * triton.cdiv(tokens, LEAST_ROWS))
    _attention_vjp_kernel[(across, splits + 1)](
        q, k, v, kept.attended, kept.lse, d_attended, length, d_q, d_kv, rows, keys, slots, heads, splits, groups,
        dim**-0.5,
        DIM=dim, ROWS=block, OWN_KEYS=LEAST_ROWS, SPAN=span, STATE_TOKEN=state_token, num_warps=span // 8,
        **dependent_launch(q),
    )  # fmt: skip
    return d_q, d_kv
