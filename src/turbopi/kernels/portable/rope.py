"""RoPE on queries and keys, split off a joint projection, and the cache. Twin: `kernels.plain.rope_split`."""

import triton
import triton.language as tl
from torch import Tensor

from turbopi.kernels.dependent_launch import dependent_launch, launch_dependents, wait_for_producer


@triton.jit
def rotated(first, second, c, s):
    """Both halves of heads after RoPE by an angle's cosine and sine, in float32."""
    return first * c - second * s, second * c + first * s


@triton.jit
def _rope_kernel(
    qkv, cos, sin, q_out, k_out, v_out, heads,
    HALF: tl.constexpr, BLOCK_HALF: tl.constexpr, BLOCK_HEADS: tl.constexpr, PDL: tl.constexpr,
):  # fmt: skip
    token = tl.program_id(0).to(tl.int64)
    head = tl.arange(0, BLOCK_HEADS)[:, None]
    pair = tl.arange(0, BLOCK_HALF)[None, :]
    used = (head <= heads) & (pair < HALF)  # the key is behind the queries
    wait_for_producer(PDL)
    launch_dependents(PDL)
    c = tl.load(cos + token * HALF + pair, pair < HALF, 0.0)
    s = tl.load(sin + token * HALF + pair, pair < HALF, 0.0)
    row = qkv + token * (heads + 2) * 2 * HALF
    at = head * 2 * HALF + pair
    first = tl.load(row + at, used, 0.0).to(tl.float32)
    second = tl.load(row + at + HALF, used, 0.0).to(tl.float32)
    lower, upper = rotated(first, second, c, s)
    dtype = k_out.dtype.element_ty
    is_query, is_key = used & (head < heads), used & (head == heads)
    q_row = q_out + token * heads * 2 * HALF + at
    tl.store(q_row, lower.to(dtype), is_query)
    tl.store(q_row + HALF, upper.to(dtype), is_query)
    k_row = k_out + token * 2 * HALF + pair + head * 0
    tl.store(k_row, lower.to(dtype), is_key)
    tl.store(k_row + HALF, upper.to(dtype), is_key)
    wide = tl.arange(0, 2 * BLOCK_HALF)
    value = tl.load(row + (heads + 1) * 2 * HALF + wide, wide < 2 * HALF, 0.0)
    tl.store(v_out + token * 2 * HALF + wide, value, wide < 2 * HALF)


def rope_split(qkv: Tensor, cos: Tensor, sin: Tensor, k_out: Tensor, v_out: Tensor) -> Tensor:
    """Split [tokens, (n + 2) * K]; write rotated keys and values [tokens, K]; return rotated queries [tokens * n, K].

    cos, sin float32[tokens, K/2]. All contiguous.
    """
    assert all(t.is_contiguous() for t in (qkv, cos, sin, k_out, v_out)), "rows are read as they lie in memory"
    tokens, head_dim = k_out.shape
    heads = qkv.shape[1] // head_dim - 2
    q = qkv.new_empty(tokens * heads, head_dim)
    _rope_kernel[(tokens,)](
        qkv, cos, sin, q, k_out, v_out, heads,
        HALF=head_dim // 2, BLOCK_HALF=triton.next_power_of_2(head_dim // 2),
        BLOCK_HEADS=triton.next_power_of_2(heads + 1), num_warps=4, **dependent_launch(qkv),
    )  # fmt: skip
    return q
