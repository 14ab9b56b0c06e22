"""Text layers whose query heads share keys and values in groups: RoPE, attention and SwiGLU between their matmuls.

Shapes: S places, n query heads, g key heads, K head_dim, F hidden units.
"""

import triton
import triton.language as tl
from torch import Tensor

from turbopi.kernels.dependent_launch import dependent_launch, launch_dependents, wait_for_producer
from turbopi.kernels.portable.rope import rotated

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
def _attention_kernel(
    q, k, v, length, out, tokens, heads, scale,
    GROUP: tl.constexpr, DIM: tl.constexpr, BLOCK_D: tl.constexpr, BLOCK_M: tl.constexpr, BLOCK_N: tl.constexpr,
    PDL: tl.constexpr,
):  # fmt: skip
    """BLOCK_M rows of the queries of one key head."""
    kv_head = tl.program_id(1)
    m = tl.program_id(0) * BLOCK_M + tl.arange(0, BLOCK_M)
    n = tl.arange(0, BLOCK_N)
    d = tl.arange(0, BLOCK_D)
    wait_for_producer(PDL)
    launch_dependents(PDL)
    end = tl.load(length).to(tl.int32)
    token = m // GROUP
    seen = tl.where(token == end - 1, end, tl.maximum(end - 1, 1))
    inside = (token < tokens)[:, None] & (d < DIM)[None, :]
    queries = tl.load(q + (kv_head * tokens * GROUP + m)[:, None] * DIM + d[None, :], inside, 0.0)
    acc = tl.zeros((BLOCK_M, BLOCK_D), tl.float32)
    top = tl.full((BLOCK_M,), -float("inf"), tl.float32)
    total = tl.zeros((BLOCK_M,), tl.float32)
    for start in range(0, end, BLOCK_N):
        loaded = (start + n < end)[:, None] & (d < DIM)[None, :]
        at = (kv_head * tokens + start + n)[:, None] * DIM + d[None, :]
        logits = tl.dot(queries, tl.load(k + at, loaded, 0.0).T, input_precision="ieee") * scale
        logits = tl.where((start + n)[None, :] < seen[:, None], logits, -float("inf"))
        new_top = tl.maximum(top, tl.max(logits, 1))
        p = tl.exp2(logits - new_top[:, None])
        shrink = tl.exp2(top - new_top)
        total = total * shrink + tl.sum(p, 1)
        top = new_top
        values = tl.load(v + at, loaded, 0.0)
        acc = tl.dot(p.to(values.dtype), values, acc * shrink[:, None], input_precision="ieee")
    to = (token * heads + kv_head * GROUP + m % GROUP)[:, None] * DIM + d[None, :]
    tl.store(out + to, (acc / total[:, None]).to(out.dtype.element_ty), inside)


def grouped_attention(q: Tensor, k: Tensor, v: Tensor, length: Tensor) -> Tensor:
    """Queries [g, S * n/g, K] over the first `length` (int64[1], on the device, at least 1) keys and values [g, S, K]
    -> [S, n * K]. The last valid place sees all of them, the others all but that one. What lies beyond is never read.
    """
    assert q.is_contiguous() and k.is_contiguous() and v.is_contiguous(), "rows are read as they lie in memory"
    kv_heads, tokens, dim = k.shape
    group = q.shape[1] // tokens
    out = q.new_empty(tokens, kv_heads * group * dim)
    _attention_kernel[(triton.cdiv(tokens * group, ROWS), kv_heads)](
        q, k, v, length, out, tokens, kv_heads * group, dim**-0.5 * LOG2_E, GROUP=group, DIM=dim,
        BLOCK_D=triton.next_power_of_2(dim), BLOCK_M=ROWS, BLOCK_N=KEYS, num_warps=4, num_stages=2,
        **dependent_launch(q),
    )  # fmt: skip
    return out


@triton.jit
def _swiglu_kernel(gate_up, out, hidden, BLOCK: tl.constexpr, PDL: tl.constexpr):
    wait_for_producer(PDL)
    launch_dependents(PDL)
    row = tl.program_id(1).to(tl.int64)
    cols = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mask = cols < hidden
    gate = tl.load(gate_up + row * 2 * hidden + cols, mask, 0.0).to(tl.float32)
    up = tl.load(gate_up + (row * 2 + 1) * hidden + cols, mask, 0.0).to(tl.float32)
    result = gate / (1 + tl.exp2(gate * -1.4426950408889634)) * up
    tl.store(out + row * hidden + cols, result.to(out.dtype.element_ty), mask)


def swiglu(gate_up: Tensor) -> Tensor:
    """silu(gate) * up: [S, 2F], gate columns before up columns -> [S, F]"""
    assert gate_up.is_contiguous(), "gate_up is read as it lies in memory"
    rows, hidden = gate_up.shape[0], gate_up.shape[1] // 2
    out = gate_up.new_empty(rows, hidden)
    block = min(1024, triton.next_power_of_2(hidden))
    grid = (triton.cdiv(hidden, block), rows)
    _swiglu_kernel[grid](gate_up, out, hidden, BLOCK=block, num_warps=max(1, block // 256), **dependent_launch(gate_up))
    return out
