"""Attention without materialised logits: inside images, and of many query heads over one key/value head.

Twins: `vision_attention`, `attention`, `masked_softmax` of `kernels.plain`. Logits, softmax and sums are float32;
probabilities are rounded to the values' dtype for their product, as in the twins.
"""

import torch
import triton
import triton.language as tl
from torch import Tensor

from turbopi.kernels.dependent_launch import dependent_launch, launch_dependents, result_dtype, wait_for_producer
from turbopi.kernels.portable.attention_tiles import AttentionTile, chosen_tile
from turbopi.kernels.portable.rounding import as_stored, damaged, marks
from turbopi.kernels.portable.shared_memory import capability_of
from turbopi.kernels.tile_table import NO_TILES, TileTable
from turbopi.quantization.fp8 import E4M3

LOG2_E = 1.4426950408889634


@triton.jit
def _vision_kernel(
    qkv, out, tokens, heads, scale, inverse, residual, stride,
    DIM: tl.constexpr, BLOCK_A: tl.constexpr, BLOCK_B: tl.constexpr,
    BLOCK_M: tl.constexpr, BLOCK_N: tl.constexpr, SCALED: tl.constexpr, MARKS: tl.constexpr,
):  # fmt: skip
    """One head's BLOCK_M queries of one image. A head's columns come as BLOCK_A (a power of two) and BLOCK_B more."""
    image, head = tl.program_id(1) // heads, tl.program_id(1) % heads
    width = heads * DIM
    m = tl.program_id(0) * BLOCK_M + tl.arange(0, BLOCK_M)
    n = tl.arange(0, BLOCK_N)
    a = tl.arange(0, BLOCK_A)
    b = BLOCK_A + tl.arange(0, BLOCK_B if BLOCK_B > 0 else 16)
    base = qkv + image * tokens * 3 * width + head * DIM
    q = base + m[:, None] * 3 * width
    q_a = tl.load(q + a[None, :], (m < tokens)[:, None], 0.0)
    acc_a = tl.zeros((BLOCK_M, BLOCK_A), tl.float32)
    if BLOCK_B > 0:
        q_b = tl.load(q + b[None, :], (m < tokens)[:, None] & (b < DIM)[None, :], 0.0)
        acc_b = tl.zeros((BLOCK_M, BLOCK_B), tl.float32)
    top = tl.full((BLOCK_M,), -float("inf"), tl.float32)
    total = tl.zeros((BLOCK_M,), tl.float32)
    for start in range(0, tokens, BLOCK_N):
        valid = start + n < tokens
        k = base + width + (start + n)[:, None] * 3 * width
        logits = tl.dot(q_a, tl.load(k + a[None, :], valid[:, None], 0.0).T, input_precision="ieee")
        if BLOCK_B > 0:
            k_b = tl.load(k + b[None, :], valid[:, None] & (b < DIM)[None, :], 0.0)
            logits = tl.dot(q_b, k_b.T, logits, input_precision="ieee")
        logits = tl.where(valid[None, :], logits * scale, -float("inf"))
        new_top = tl.maximum(top, tl.max(logits, 1))
        p = tl.exp2(logits - new_top[:, None])
        shrink = tl.exp2(top - new_top)
        total = total * shrink + tl.sum(p, 1)
        top = new_top
        p = p.to(qkv.dtype.element_ty)
        v = k + width
        acc_a = tl.dot(p, tl.load(v + a[None, :], valid[:, None], 0.0), acc_a * shrink[:, None], input_precision="ieee")
        if BLOCK_B > 0:
            v_b = tl.load(v + b[None, :], valid[:, None] & (b < DIM)[None, :], 0.0)
            acc_b = tl.dot(p, v_b, acc_b * shrink[:, None], input_precision="ieee")
    if SCALED:
        total /= inverse
    to = out + (image * tokens + m)[:, None] * width + head * DIM
    tl.store(to + a[None, :], as_stored(acc_a / total[:, None], out), (m < tokens)[:, None])
    if BLOCK_B > 0:
        stored = (m < tokens)[:, None] & (b < DIM)[None, :]
        tl.store(to + b[None, :], as_stored(acc_b / total[:, None], out), stored)
    if MARKS:
        found = damaged(acc_a / total[:, None], 1)
        if BLOCK_B > 0:
            found |= damaged(acc_b / total[:, None], 1)
        tl.store(residual + (image * tokens + m) * stride, float("nan"), (m < tokens) & found)


def vision_attention(
    qkv: Tensor,
    images: int,
    heads: int,
    inverse: float | None = None,
    numbers: torch.dtype = E4M3,
    stream: Tensor | None = None,
    *,
    tile: AttentionTile | None = None,
    tiles: TileTable = NO_TILES,
) -> Tensor:
    """Self-attention inside each image: [V * tokens, 3W], q before k before v, heads inside -> [V * tokens, W].

    With `inverse` the result leaves as `numbers`, E4M3 or int8: see `quantization.fp8`, and for `stream`
    [V * tokens, W] `kernels.plain`. Without a `tile`, that of `tiles`, else the usual one.
    """
    assert qkv.is_contiguous(), "qkv is read as it lies in memory"
    rows, width = qkv.shape[0], qkv.shape[1] // 3
    tokens, dim = rows // images, width // heads
    block_a = 1 << (dim.bit_length() - 1)
    assert block_a >= 16, f"heads of {dim} columns are narrower than a tensor core's 16"
    block_b = 0 if block_a == dim else max(16, triton.next_power_of_2(dim - block_a))
    out = qkv.new_empty(rows, width, dtype=result_dtype(qkv, inverse, numbers))
    tile = tile or chosen_tile(tiles, "vision_attention", capability_of(qkv), rows, heads, dim)
    # launched early, several blocks would crowd onto each of the few SMs that the product before leaves idle
    _vision_kernel[(triton.cdiv(tokens, tile.rows), images * heads)](
        qkv, out, tokens, heads, dim**-0.5 * LOG2_E, inverse or 1.0, DIM=dim, BLOCK_A=block_a, BLOCK_B=block_b,
        BLOCK_M=tile.rows, BLOCK_N=tile.keys, SCALED=inverse is not None, num_warps=tile.warps, num_stages=tile.stages,
        **marks(stream, out),
    )  # fmt: skip
    return out


@triton.jit
def _prefix_kernel(
    q, k, v, length, out, rows, heads, scale, inverse,
    DIM: tl.constexpr, BLOCK_D: tl.constexpr, BLOCK_M: tl.constexpr, BLOCK_N: tl.constexpr, SCALED: tl.constexpr,
    PDL: tl.constexpr,
):  # fmt: skip
    """BLOCK_M rows of queries (of any head: they share the keys) over the first `length` keys."""
    m = tl.program_id(0) * BLOCK_M + tl.arange(0, BLOCK_M)
    n = tl.arange(0, BLOCK_N)
    d = tl.arange(0, BLOCK_D)
    wait_for_producer(PDL)
    launch_dependents(PDL)
    end = tl.load(length).to(tl.int32)
    inside = (m < rows)[:, None] & (d < DIM)[None, :]
    queries = tl.load(q + m[:, None] * DIM + d[None, :], inside, 0.0)
    acc = tl.zeros((BLOCK_M, BLOCK_D), tl.float32)
    top = tl.full((BLOCK_M,), -float("inf"), tl.float32)
    total = tl.zeros((BLOCK_M,), tl.float32)
    for start in range(0, end, BLOCK_N):
        valid = start + n < end
        loaded = valid[:, None] & (d < DIM)[None, :]
        at = (start + n)[:, None] * DIM + d[None, :]
        logits = tl.dot(queries, tl.load(k + at, loaded, 0.0).T, input_precision="ieee") * scale
        logits = tl.where(valid[None, :], logits, -float("inf"))
        new_top = tl.maximum(top, tl.max(logits, 1))
        p = tl.exp2(logits - new_top[:, None])
        shrink = tl.exp2(top - new_top)
        total = total * shrink + tl.sum(p, 1)
        top = new_top
        values = tl.load(v + at, loaded, 0.0)
        acc = tl.dot(p.to(values.dtype), values, acc * shrink[:, None], input_precision="ieee")
    if SCALED:
        total /= inverse
    tl.store(out + m[:, None] * DIM + d[None, :], as_stored(acc / total[:, None], out), inside)
    if out.dtype.element_ty == tl.int8:
        tl.store(v + m // heads * DIM, float("nan"), (m < rows) & damaged(acc / total[:, None], 1))


def prefix_attention(
    q: Tensor,
    k: Tensor,
    v: Tensor,
    length: Tensor,
    heads: int,
    inverse: float | None = None,
    numbers: torch.dtype = E4M3,
    *,
    tile: AttentionTile | None = None,
    tiles: TileTable = NO_TILES,
) -> Tensor:
    """Rows q [tokens * n, K] over the first `length` (int64[1], on the device, at least 1) keys -> [tokens, n * K].

    k, v [keys, K]; what lies beyond `length` is never read. With `inverse` the result leaves as `numbers`, and
    int8's damage is marked in `v`. The tile is chosen as in `vision_attention`.
    """
    assert q.is_contiguous() and k.is_contiguous() and v.is_contiguous(), "rows are read as they lie in memory"
    rows, dim = q.shape
    assert dim >= 16, f"heads of {dim} columns are narrower than a tensor core's 16"
    out = q.new_empty(rows // heads, heads * dim, dtype=result_dtype(q, inverse, numbers))
    assert out.dtype != torch.int8 or len(v) == len(out), "each token has a value to mark its damage in"
    tile = tile or chosen_tile(tiles, "prefix_attention", capability_of(q), rows // heads, heads, dim)
    _prefix_kernel[(triton.cdiv(rows, tile.rows),)](
        q, k, v, length, out, rows, heads, dim**-0.5 * LOG2_E, inverse or 1.0, DIM=dim,
        BLOCK_D=triton.next_power_of_2(dim), BLOCK_M=tile.rows, BLOCK_N=tile.keys, SCALED=inverse is not None,
        num_warps=tile.warps, num_stages=tile.stages, **dependent_launch(q),
    )  # fmt: skip
    return out


@triton.jit
def _softmax_kernel(
    logits, length, out, keys, slots, heads, scale, STATE_TOKEN: tl.constexpr, BLOCK: tl.constexpr, PDL: tl.constexpr
):  # fmt: skip
    row = tl.program_id(0)
    key = tl.arange(0, BLOCK)
    wait_for_producer(PDL)
    launch_dependents(PDL)
    visible = (key < tl.load(length)) | ((key >= slots) & (key < keys))
    if STATE_TOKEN:
        visible = visible & ((row >= heads) | (key <= slots))
    x = tl.load(logits + row * keys + key, visible, -float("inf")) * scale
    p = tl.exp2(x - tl.max(x, 0))
    tl.store(out + row * keys + key, (p / tl.sum(p, 0)).to(out.dtype.element_ty), key < keys)


def masked_softmax(
    logits: Tensor, length: Tensor, slots: int, heads: int, state_token: bool, scale: float, dtype: torch.dtype
) -> Tensor:
    """softmax(logits * scale) over the visible keys, in `dtype`; logits float32[tokens * n, keys]"""
    assert logits.is_contiguous(), "logits are read as they lie in memory"
    rows, keys = logits.shape
    out = torch.empty(rows, keys, dtype=dtype, device=logits.device)
    _softmax_kernel[(rows,)](
        logits, length, out, keys, slots, heads, scale * LOG2_E,
        STATE_TOKEN=state_token, BLOCK=triton.next_power_of_2(keys), num_warps=4, **dependent_launch(logits),
    )  # fmt: skip
    return out
