"""Back through what lies between the action expert's products. Twins: `kernels.backward`. Inside, all is float32."""

import torch
import triton
import triton.language as tl
from torch import Tensor

from turbopi.kernels.backward import BetweenProducts
from turbopi.kernels.dependent_launch import dependent_launch, launch_dependents, wait_for_producer
from turbopi.kernels.portable.activations import geglu
from turbopi.kernels.portable.attention import masked_softmax
from turbopi.kernels.portable.rope import rope_split


@triton.jit
def _rms_norm_kernel(
    d_normed, x, scale, d_x, gate, which, out, gated, rows, width, stride, eps,
    PARTS: tl.constexpr, HAS_D_X: tl.constexpr, HAS_GATE: tl.constexpr, BY_ROW: tl.constexpr, BY_TABLE: tl.constexpr,
    BLOCK: tl.constexpr, PDL: tl.constexpr,
):  # fmt: skip
    """`d_normed` alone is of the kernel in front: the rest is there when that begins, and is read before it ends."""
    row = tl.program_id(0)
    cols = tl.arange(0, BLOCK)
    mask = cols < width
    if BY_ROW:
        own = tl.load(which + row).to(tl.int64) if BY_TABLE else row
        scale += own * stride
        if HAS_GATE:
            gate += own * stride
    at = row * width + cols
    wide = tl.load(x + at, mask, 0.0).to(tl.float32)
    factor = tl.load(scale + cols, mask, 0.0)
    d_other = tl.load(d_x + at, mask, 0.0) if HAS_D_X else wide
    opened = tl.load(gate + cols, mask, 0.0).to(gated.dtype.element_ty).to(tl.float32) if HAS_GATE else wide
    r = tl.rsqrt(tl.sum(wide * wide, 0) / width + eps)
    wait_for_producer(PDL)
    launch_dependents(PDL)
    g = tl.load(d_normed + at, mask, 0.0).to(tl.float32)
    for part in tl.static_range(1, PARTS):
        g += tl.load(d_normed + part * rows * width + at, mask, 0.0)
    g *= factor
    total = r * (g - wide * (r * r * (tl.sum(wide * g, 0) / width)))
    if HAS_D_X:
        total += d_other
    tl.store(out + at, total, mask)
    if HAS_GATE:
        tl.store(gated + at, (total * opened).to(gated.dtype.element_ty), mask)


def rms_norm_vjp(
    d_normed: Tensor,
    x: Tensor,
    scale: Tensor,
    eps: float,
    d_x: Tensor | None,
    gate: Tensor | None,
    which: Tensor | None = None,
) -> tuple[Tensor, Tensor | None]:
    """See the twin. x [T, D]; scale and gate float32 [D] or [T, D], or [U, D] of which each token takes row `which`;
    both the same; rows lie in one piece.
    """
    given = (d_normed, x, d_x, which)
    assert all(one is None or one.is_contiguous() for one in given), "rows are read as they lie in memory"
    assert scale.stride(-1) == 1 and (gate is None or gate.stride() == scale.stride()), "rows of one table"
    rows, width = x.shape
    out = torch.empty_like(x, dtype=torch.float32)
    gated = None if gate is None else torch.empty_like(x)
    block = triton.next_power_of_2(width)
    _rms_norm_kernel[(rows,)](
        d_normed, x, scale, out if d_x is None else d_x, scale if gate is None else gate, x if which is None else which,
        out, out if gated is None else gated, rows, width, scale.stride(0), eps,
        PARTS=1 if d_normed.dim() == 2 else len(d_normed), HAS_D_X=d_x is not None, HAS_GATE=gate is not None,
        BY_ROW=scale.dim() == 2, BY_TABLE=which is not None, BLOCK=block, num_warps=max(1, min(8, block // 256)),
        **dependent_launch(x),
    )  # fmt: skip
    return out, gated


@triton.jit
def _geglu_kernel(d_hidden, gate_up, out, hidden, BLOCK: tl.constexpr):
    row = tl.program_id(1).to(tl.int64)
    cols = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mask = cols < hidden
    gate = tl.load(gate_up + row * 2 * hidden + cols, mask, 0.0).to(tl.float32)
    up = tl.load(gate_up + (row * 2 + 1) * hidden + cols, mask, 0.0).to(tl.float32)
    d = tl.load(d_hidden + row * hidden + cols, mask, 0.0).to(tl.float32)
    # tanh(u) = 2 sigmoid(2 u) - 1, u = √(2/π) (gate + 0.044715 gate³); half is (1 + tanh u) / 2
    half = 1 / (1 + tl.exp2(gate * (-2.302208198 - 0.1029432397 * gate * gate)))
    slope = half + gate * 2 * half * (1 - half) * 0.7978845608 * (1 + 0.134145 * gate * gate)
    dtype = out.dtype.element_ty
    tl.store(out + row * 2 * hidden + cols, (d * up * slope).to(dtype), mask)
    tl.store(out + (row * 2 + 1) * hidden + cols, (d * gate * half).to(dtype), mask)


def geglu_vjp(d_hidden: Tensor, gate_up: Tensor) -> Tensor:
    """See the twin: [T, F], [T, 2F] -> [T, 2F]."""
    assert d_hidden.is_contiguous() and gate_up.is_contiguous(), "rows are read as they lie in memory"
    rows, hidden = d_hidden.shape
    out, block = torch.empty_like(gate_up), min(1024, triton.next_power_of_2(hidden))
    grid = (triton.cdiv(hidden, block), rows)
    _geglu_kernel[grid](d_hidden, gate_up, out, hidden, BLOCK=block, num_warps=max(1, block // 256))
    return out


@triton.jit
def _softmax_kernel(probabilities, d_probabilities, out, keys, scale, BLOCK: tl.constexpr):
    row = tl.program_id(0).to(tl.int64)
    cols = tl.arange(0, BLOCK)
    mask, at = cols < keys, row * keys + cols
    p = tl.load(probabilities + at, mask, 0.0).to(tl.float32)
    along = p * tl.load(d_probabilities + at, mask, 0.0)
    tl.store(out + at, ((along - p * tl.sum(along, 0)) * scale).to(out.dtype.element_ty), mask)


def softmax_vjp(probabilities: Tensor, d_probabilities: Tensor, scale: float) -> Tensor:
    """See the twin: [rows, keys], the second float32."""
    assert probabilities.is_contiguous() and d_probabilities.is_contiguous(), "rows are read as they lie in memory"
    rows, keys = probabilities.shape
    out, block = torch.empty_like(probabilities), triton.next_power_of_2(keys)
    warps = max(1, min(8, block // 256))
    _softmax_kernel[(rows,)](probabilities, d_probabilities, out, keys, scale, BLOCK=block, num_warps=warps)
    return out


@triton.jit
def _rope_kernel(d_q, d_k, d_v, cos, sin, out, heads, HALF: tl.constexpr, BLOCK: tl.constexpr):
    token, head = tl.program_id(0).to(tl.int64), tl.program_id(1)
    pair = tl.arange(0, BLOCK)
    mask = pair < HALF
    width = 2 * HALF
    if head < heads:
        row = d_q + (token * heads + head) * width
    elif head == heads:
        row = d_k + token * width
    else:
        row = d_v + token * width
    first = tl.load(row + pair, mask, 0.0).to(tl.float32)
    second = tl.load(row + pair + HALF, mask, 0.0).to(tl.float32)
    if head <= heads:  # turned back; values never were turned
        c = tl.load(cos + token * HALF + pair, mask, 0.0)
        s = tl.load(sin + token * HALF + pair, mask, 0.0)
        turned = first * c + second * s
        second = second * c - first * s
        first = turned
    to = out + (token * (heads + 2) + head) * width + pair
    tl.store(to, first.to(out.dtype.element_ty), mask)
    tl.store(to + HALF, second.to(out.dtype.element_ty), mask)


def rope_vjp(d_q: Tensor, d_k: Tensor, d_v: Tensor, cos: Tensor, sin: Tensor) -> Tensor:
    """See the twin: [T * n, K], [T, K], [T, K] -> [T, (n + 2) * K]."""
    assert all(one.is_contiguous() for one in (d_q, d_k, d_v, cos, sin)), "rows are read as they lie in memory"
    tokens, head_dim = d_k.shape
    heads = len(d_q) // tokens
    out = d_q.new_empty(tokens, (heads + 2) * head_dim)
    half = head_dim // 2
    grid = (tokens, heads + 2)
    _rope_kernel[grid](d_q, d_k, d_v, cos, sin, out, heads, HALF=half, BLOCK=triton.next_power_of_2(half), num_warps=1)
    return out


PIECES = BetweenProducts(masked_softmax, geglu, rope_split, rms_norm_vjp, geglu_vjp, softmax_vjp, rope_vjp)
