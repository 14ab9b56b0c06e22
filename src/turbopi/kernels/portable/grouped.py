"""Text layers whose query heads share keys and values in groups: RoPE, attention and SwiGLU between their matmuls.

With `inverse` a result leaves as `numbers`, E4M3 or int8, for the matmul behind it; int8's damage is marked in `stream`
[tokens, D]: see `kernels.plain`.

Shapes: B observations, S places of each, n query heads, g key heads, K head_dim, F hidden units.
"""

from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor

from turbopi.kernels.dependent_launch import dependent_launch, launch_dependents, result_dtype, wait_for_producer
from turbopi.kernels.portable.rope import rotated
from turbopi.kernels.portable.rounding import as_stored, damaged, marks
from turbopi.quantization.fp8 import E4M3

LOG2_E = 1.4426950408889634
ROWS, KEYS = 32, 64  # of a program of attention: prompts are short, so there are many programs rather than large tiles


@triton.jit
def _rope_kernel(
    qkv, cos, sin, q_out, k_out, v_out, tokens, heads, kv_heads,
    HALF: tl.constexpr, BLOCK_HALF: tl.constexpr, BLOCK_HEADS: tl.constexpr, PDL: tl.constexpr,
):  # fmt: skip
    token = tl.program_id(0).to(tl.int64)
    head = tl.arange(0, BLOCK_HEADS)[:, None]
    pair = tl.arange(0, BLOCK_HALF)[None, :]
    wait_for_producer(PDL)
    launch_dependents(PDL)
    used = (head < heads + 2 * kv_heads) & (pair < HALF)
    turned = head < heads + kv_heads
    c = tl.where(turned, tl.load(cos + token * HALF + pair, pair < HALF, 0.0), 1.0)
    s = tl.where(turned, tl.load(sin + token * HALF + pair, pair < HALF, 0.0), 0.0)
    at = token * (heads + 2 * kv_heads) * 2 * HALF + head * 2 * HALF + pair
    first = tl.load(qkv + at, used, 0.0).to(tl.float32)
    second = tl.load(qkv + at + HALF, used, 0.0).to(tl.float32)
    lower, upper = rotated(first, second, c, s)
    dtype = k_out.dtype.element_ty
    group = heads // kv_heads
    is_query, is_key = used & (head < heads), used & turned & (head >= heads)
    q_row = q_out + ((head // tl.maximum(group, 1) * tokens + token) * group + head % tl.maximum(group, 1)) * 2 * HALF
    tl.store(q_row + pair, lower.to(dtype), is_query)
    tl.store(q_row + pair + HALF, upper.to(dtype), is_query)
    k_row = ((head - heads) * tokens + token) * 2 * HALF + pair
    tl.store(k_out + k_row, lower.to(dtype), is_key)
    tl.store(k_out + k_row + HALF, upper.to(dtype), is_key)
    v_row = ((head - heads - kv_heads) * tokens + token) * 2 * HALF + pair
    tl.store(v_out + v_row, lower.to(dtype), used & (head >= heads + kv_heads))
    tl.store(v_out + v_row + HALF, upper.to(dtype), used & (head >= heads + kv_heads))


def rope_grouped(qkv: Tensor, cos: Tensor, sin: Tensor, k_out: Tensor, v_out: Tensor) -> Tensor:
    """Split [S, (n + 2g) K]; write rotated keys and values [g, S, K]; return rotated queries [g, S * n/g, K].

    cos, sin float32[S, K/2]. All contiguous.
    """
    assert all(t.is_contiguous() for t in (qkv, cos, sin, k_out, v_out)), "rows are read as they lie in memory"
    kv_heads, tokens, head_dim = k_out.shape
    heads = qkv.shape[1] // head_dim - 2 * kv_heads
    q = qkv.new_empty(kv_heads, tokens * (heads // kv_heads), head_dim)
    _rope_kernel[(tokens,)](
        qkv, cos, sin, q, k_out, v_out, tokens, heads, kv_heads, HALF=head_dim // 2,
        BLOCK_HALF=triton.next_power_of_2(head_dim // 2), BLOCK_HEADS=triton.next_power_of_2(heads + 2 * kv_heads),
        num_warps=4, **dependent_launch(qkv),
    )  # fmt: skip
    return q


@triton.jit
def _add_keys(queries, k, v, first, key, keys, seen, d, DIM: tl.constexpr, scale, acc, top, total):
    """Some of `keys` keys and values into the running softmax: a row sees those before its `seen`."""
    loaded = (key < keys)[:, None] & (d < DIM)[None, :]
    at = (first + key)[:, None] * DIM + d[None, :]
    logits = tl.dot(queries, tl.load(k + at, loaded, 0.0).T, input_precision="ieee") * scale
    logits = tl.where(key[None, :] < seen[:, None], logits, -float("inf"))
    new_top = tl.maximum(top, tl.max(logits, 1))
    p = tl.exp2(logits - new_top[:, None])
    shrink = tl.exp2(top - new_top)
    values = tl.load(v + at, loaded, 0.0)
    acc = tl.dot(p.to(values.dtype), values, acc * shrink[:, None], input_precision="ieee")
    return acc, new_top, total * shrink + tl.sum(p, 1)


@triton.jit
def _attention_kernel(
    q, k, v, own_k, own_v, lengths, out, tokens, places, heads, scale, inverse, residual, stride,
    GROUP: tl.constexpr, DIM: tl.constexpr, BLOCK_D: tl.constexpr, BLOCK_M: tl.constexpr, BLOCK_N: tl.constexpr,
    SUFFIX: tl.constexpr, OWN: tl.constexpr, SCALED: tl.constexpr, MARKS: tl.constexpr, PDL: tl.constexpr,
):  # fmt: skip
    """BLOCK_M rows of the queries of one key head of one observation."""
    kv_head, observation = tl.program_id(1), tl.program_id(2)
    block = kv_head * tl.num_programs(2) + observation
    m = tl.program_id(0) * BLOCK_M + tl.arange(0, BLOCK_M)
    n = tl.arange(0, BLOCK_N)
    d = tl.arange(0, BLOCK_D)
    wait_for_producer(PDL)
    launch_dependents(PDL)
    end = tl.load(lengths + observation).to(tl.int32)
    token = m // GROUP
    seen = tl.where(token == end - 1, end, tl.maximum(end - 1, 1))
    if SUFFIX:
        seen = tl.zeros_like(token) + end
    inside = (token < tokens)[:, None] & (d < DIM)[None, :]
    queries = tl.load(q + (block * tokens * GROUP + m)[:, None] * DIM + d[None, :], inside, 0.0)
    acc = tl.zeros((BLOCK_M, BLOCK_D), tl.float32)
    top = tl.full((BLOCK_M,), -float("inf"), tl.float32)
    total = tl.zeros((BLOCK_M,), tl.float32)
    for start in range(0, end, BLOCK_N):
        acc, top, total = _add_keys(queries, k, v, block * places, start + n, end, seen, d, DIM, scale, acc, top, total)
    if OWN:
        for start in range(0, tokens, BLOCK_N):
            acc, top, total = _add_keys(
                queries, own_k, own_v, block * tokens, start + n, tokens, token + 1, d, DIM, scale, acc, top, total
            )
    to = ((observation * tokens + token) * heads + kv_head * GROUP + m % GROUP)[:, None] * DIM + d[None, :]
    if SCALED:
        total /= inverse
    tl.store(out + to, as_stored(acc / total[:, None], out), inside)
    if MARKS:
        found = (token < tokens) & damaged(acc / total[:, None], 1)
        tl.store(residual + (observation * tokens + token) * stride, float("nan"), found)


def grouped_attention(q: Tensor, k: Tensor, v: Tensor, lengths: Tensor, **rounded: Any) -> Tensor:
    """Queries [g, B * S * n/g, K] of B observations over keys and values [g, B * S, K] -> [B * S, n * K].

    lengths  int64[B], on the device, at least 1: how many of an observation's S places are valid, the first ones. The
             last of them sees all of these, the others all but that one. What lies beyond is never read
    rounded  `inverse`, `numbers` and `stream`: see above
    """
    return _attention(q, (k, v), (k, v), lengths, k.shape[1] // len(lengths), suffix=False, own=False, **rounded)


def grouped_suffix_attention(
    q: Tensor, k: Tensor, v: Tensor, lengths: Tensor, tokens: int, own: tuple[Tensor, Tensor] | None
) -> Tensor:
    """Queries [g, B * T * n/g, K] of B observations' `tokens`, T, behind their prefixes -> [B * T, n * K].

    k, v  of the prefixes [g, B * S, K]: a token sees the first `lengths` (as above) of its observation's
    own   keys and values of the tokens [g, B * T, K]: one sees those up to itself; None: none
    """
    return _attention(q, (k, v), own or (k, v), lengths, tokens, suffix=True, own=own is not None)


def _attention(
    q: Tensor,
    prefix: tuple[Tensor, Tensor],
    behind: tuple[Tensor, Tensor],
    lengths: Tensor,
    tokens: int,
    *,
    suffix: bool,
    own: bool,
    inverse: float | None = None,
    numbers: torch.dtype = E4M3,
    stream: Tensor | None = None,
) -> Tensor:
    assert all(one.is_contiguous() for one in (q, *prefix, *behind, lengths)), "rows are read as they lie in memory"
    kv_heads, rows, dim = q.shape
    batch = len(lengths)
    group = rows // (batch * tokens)
    out = q.new_empty(batch * tokens, kv_heads * group * dim, dtype=result_dtype(q, inverse, numbers))
    warps = 8 if suffix and not own else 4  # of 4, a thread spills on compute capability 11.0
    _attention_kernel[(triton.cdiv(tokens * group, ROWS), kv_heads, batch)](
        q, *prefix, *behind, lengths, out, tokens, prefix[0].shape[1] // batch, kv_heads * group, dim**-0.5 * LOG2_E,
        inverse or 1.0, GROUP=group, DIM=dim, BLOCK_D=triton.next_power_of_2(dim), BLOCK_M=ROWS, BLOCK_N=KEYS,
        SUFFIX=suffix, OWN=own, SCALED=inverse is not None, num_warps=warps, num_stages=2, **marks(stream, out),
        **dependent_launch(q),
    )  # fmt: skip
    return out


@triton.jit
def _swiglu_kernel(
    gate_up, out, hidden, inverse, residual, stride,
    SCALED: tl.constexpr, MARKS: tl.constexpr, BLOCK: tl.constexpr, PDL: tl.constexpr,
):  # fmt: skip
    wait_for_producer(PDL)
    launch_dependents(PDL)
    row = tl.program_id(1).to(tl.int64)
    cols = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mask = cols < hidden
    gate = tl.load(gate_up + row * 2 * hidden + cols, mask, 0.0).to(tl.float32)
    up = tl.load(gate_up + (row * 2 + 1) * hidden + cols, mask, 0.0).to(tl.float32)
    result = gate / (1 + tl.exp2(gate * -1.4426950408889634)) * up
    if SCALED:
        result *= inverse
    tl.store(out + row * hidden + cols, as_stored(result, out), mask)
    if MARKS:
        tl.store(residual + row * stride, float("nan"), damaged(result, 0))


def swiglu(
    gate_up: Tensor, inverse: float | None = None, numbers: torch.dtype = E4M3, stream: Tensor | None = None
) -> Tensor:
    """silu(gate) * up: [S, 2F], gate columns before up columns -> [S, F]"""
    assert gate_up.is_contiguous(), "gate_up is read as it lies in memory"
    rows, hidden = gate_up.shape[0], gate_up.shape[1] // 2
    out = gate_up.new_empty(rows, hidden, dtype=result_dtype(gate_up, inverse, numbers))
    block = min(1024, triton.next_power_of_2(hidden))
    grid = (triton.cdiv(hidden, block), rows)
    _swiglu_kernel[grid](
        gate_up, out, hidden, inverse or 1.0, SCALED=inverse is not None, BLOCK=block, num_warps=max(1, block // 256),
        **marks(stream, out), **dependent_launch(gate_up),
    )  # fmt: skip
    return out
