"""One token behind a prefix: products of one row, attention of one query, and the choice of the next id.

What a GPU does here is read the weights, each once. So a product's programs ask for theirs before they wait for the row
that they multiply, and norms, GeGLU and residuals are computed beside. Rows and sums are float32, whatever the weights
and the cache are. The reference of all together, as engine/token.py launches them: `Pi0FastModel.step`.

Shapes: D width, H query heads, K head_dim, S places of keys and values, C shares of them.
"""

import math
from dataclasses import dataclass

import torch
import triton
import triton.language as tl
from torch import Tensor, nn

from turbopi.kernels.dependent_launch import dependent_launch, launch_dependents, wait_for_producer
from turbopi.kernels.portable.activations import gelu_tanh
from turbopi.kernels.portable.quantize import quantize
from turbopi.kernels.portable.rope import rotated
from turbopi.quantization.formats import INT8

PLACES = 32  # of keys and values, a program's
LOGITS = 2048  # among which a program finds the best
ROWS, BLOCK = 4, 2048  # of a weight, a program's at a time: 16 KB in flight are the fastest, whatever the weight's size
INT8_ROWS = 8  # as many bytes in flight
_pow2 = triton.next_power_of_2


@dataclass(frozen=True)
class Int8Rows:
    """A weight [N, D] in INT8, symmetric, with a scale for each row. A word has a number of each quarter of its row, so
    that neighbours multiply neighbours.

    words  int32[N, D / 4]: bytes 0 to 3 are 128 + the numbers at q, q + D / 4, q + D / 2 and q + 3 D / 4
    scale  float32[N]
    """

    words: Tensor
    scale: Tensor

    @classmethod
    def of(cls, weight: Tensor) -> "Int8Rows":
        """Rounded to nearest. D is a multiple of 4."""
        rounded = quantize(weight, 1.0, format=INT8)
        rows, width = weight.shape
        turned = rounded.data.view(torch.uint8) ^ 0x80
        words = turned.view(rows, 4, width // 4).transpose(1, 2).contiguous().view(torch.int32)
        return cls(words.view(rows, width // 4), rounded.scale)

    def meant(self) -> Tensor:
        """float32[N, D]: what the numbers stand for."""
        numbers = (self.words.view(torch.uint8).view(*self.words.shape, 4) ^ 0x80).view(torch.int8)
        return numbers.transpose(1, 2).flatten(1).float() * self.scale[:, None]


Weight = Tensor | Int8Rows


@triton.jit
def _row_product_kernel(
    row, norm, weight, beside, out, rows, width, eps,
    NORM: tl.constexpr, GATED: tl.constexpr, ADD: tl.constexpr,
    ROWS: tl.constexpr, BLOCK: tl.constexpr, PDL: tl.constexpr,
):  # fmt: skip
    """out [rows] = weight [rows, width] · row [width]; GATED: gelu(that) times `beside` · row; ADD: `out` plus that.

    NORM: the row is first divided by its rms and scaled; it needs BLOCK >= width, and so does GATED.
    """
    n = tl.program_id(0).to(tl.int64) * ROWS + tl.arange(0, ROWS)
    k = tl.arange(0, BLOCK)
    at = n[:, None] * width + k[None, :]
    there = (n < rows)[:, None] & (k < width)[None, :]
    part = tl.load(weight + at, there, 0.0)
    if GATED:
        other = tl.load(beside + at, there, 0.0)
    if NORM:
        scale = tl.load(norm + k, k < width, 0.0).to(tl.float32)
    wait_for_producer(PDL)
    launch_dependents(PDL)
    x = tl.load(row + k, k < width, 0.0)
    if NORM:
        x *= tl.rsqrt(tl.sum(x * x, 0) / width + eps) * (1 + scale)
    total = tl.sum(part.to(tl.float32) * x[None, :], 1)
    if GATED:
        total = gelu_tanh(total) * tl.sum(other.to(tl.float32) * x[None, :], 1)
    else:
        for start in range(BLOCK, width, BLOCK):
            there = (n < rows)[:, None] & (k + start < width)[None, :]
            part = tl.load(weight + at + start, there, 0.0)
            x = tl.load(row + k + start, k + start < width, 0.0)
            total += tl.sum(part.to(tl.float32) * x[None, :], 1)
    if ADD:
        total += tl.load(out + n, n < rows, 0.0)
    tl.store(out + n, total, n < rows)


@triton.jit
def _number(words, byte: tl.constexpr):
    """A byte of `Int8Rows` as float32: the bits of 2^23 + that byte, less 2^23 + 128. The GPU's own conversion of int8
    takes longer than reading the weights (docs/dev/log/portable.md).
    """
    return (((words >> (8 * byte)) & 0xFF) | 0x4B000000).to(tl.float32, bitcast=True) - 8388736.0


@triton.jit
def _sums(words, x0, x1, x2, x3):
    low = _number(words, 0) * x0[None, :] + _number(words, 1) * x1[None, :]
    return tl.sum(low + (_number(words, 2) * x2[None, :] + _number(words, 3) * x3[None, :]), 1)


@triton.jit
def _quarters(row, q, quarter, there):
    x0, x1 = tl.load(row + q, there, 0.0), tl.load(row + quarter + q, there, 0.0)
    x2, x3 = tl.load(row + 2 * quarter + q, there, 0.0), tl.load(row + 3 * quarter + q, there, 0.0)
    return x0, x1, x2, x3


@triton.jit
def _int8_row_product_kernel(
    row, norm, weight, scales, beside, beside_scales, out, rows, quarter, eps,
    NORM: tl.constexpr, GATED: tl.constexpr, ADD: tl.constexpr,
    ROWS: tl.constexpr, WORDS: tl.constexpr, PDL: tl.constexpr,
):  # fmt: skip
    """`_row_product_kernel` of `Int8Rows`, whose width is 4 * quarter; NORM and GATED need WORDS >= quarter."""
    n = tl.program_id(0).to(tl.int64) * ROWS + tl.arange(0, ROWS)
    q = tl.arange(0, WORDS)
    at = n[:, None] * quarter + q[None, :]
    there = (n < rows)[:, None] & (q < quarter)[None, :]
    part, scale = tl.load(weight + at, there, 0), tl.load(scales + n, n < rows, 0.0)
    if GATED:
        other, other_scale = tl.load(beside + at, there, 0), tl.load(beside_scales + n, n < rows, 0.0)
    if NORM:
        s0, s1, s2, s3 = _quarters(norm, q, quarter, q < quarter)
    wait_for_producer(PDL)
    launch_dependents(PDL)
    x0, x1, x2, x3 = _quarters(row, q, quarter, q < quarter)
    if NORM:
        squares = tl.sum(x0 * x0 + x1 * x1 + x2 * x2 + x3 * x3, 0)
        inverse = tl.rsqrt(squares / (4 * quarter) + eps)
        x0, x1 = x0 * inverse * (1 + s0.to(tl.float32)), x1 * inverse * (1 + s1.to(tl.float32))
        x2, x3 = x2 * inverse * (1 + s2.to(tl.float32)), x3 * inverse * (1 + s3.to(tl.float32))
    total = _sums(part, x0, x1, x2, x3)
    if GATED:
        total = gelu_tanh(total * scale) * (_sums(other, x0, x1, x2, x3) * other_scale)
    else:
        for start in range(WORDS, quarter, WORDS):
            further = start + q < quarter
            part = tl.load(weight + at + start, (n < rows)[:, None] & further[None, :], 0)
            x0, x1, x2, x3 = _quarters(row, start + q, quarter, further)
            total += _sums(part, x0, x1, x2, x3)
        total *= scale
    if ADD:
        total += tl.load(out + n, n < rows, 0.0)
    tl.store(out + n, total, n < rows)


@triton.jit
def _attend_places_kernel(
    qkv, cos, sin, keys, values, valid, place, position, partial, most, total, scale,
    HEADS: tl.constexpr, HALF: tl.constexpr, PLACES: tl.constexpr, PDL: tl.constexpr,
):  # fmt: skip
    """Of one head, and a share of the places, the largest score, the sum of the exponentials and the values they weigh.

    qkv [(HEADS + 2) * 2 * HALF]: the queries, and the key and value of this token, which go to `place`, and are seen.
    partial [shares, HEADS, 2 * HALF], most and total [shares, HEADS]. Of the kernels behind the last id only the one in
    front may still run, which writes `qkv` alone: so all else is read before the wait.
    """
    share, head = tl.program_id(0), tl.program_id(1)
    t = share * PLACES + tl.arange(0, PLACES)
    half, both = tl.arange(0, HALF), tl.arange(0, 2 * HALF)
    own = tl.load(place)
    at = tl.load(position) * HALF + half
    c, s = tl.load(cos + at), tl.load(sin + at)
    before = (t < own)[:, None]
    first = tl.load(keys + t[:, None] * 2 * HALF + half[None, :], before, 0.0)
    second = tl.load(keys + t[:, None] * 2 * HALF + HALF + half[None, :], before, 0.0)
    seen = tl.load(values + t[:, None] * 2 * HALF + both[None, :], before, 0.0)
    visible = (t == own) | ((t < own) & (tl.load(valid + t, t < own, 0) != 0))
    wait_for_producer(PDL)
    launch_dependents(PDL)
    query, key = qkv + head * 2 * HALF, qkv + HEADS * 2 * HALF
    low, up = rotated(tl.load(query + half), tl.load(query + HALF + half), c, s)
    lower, upper = rotated(tl.load(key + half), tl.load(key + HALF + half), c, s)
    value = tl.load(key + 2 * HALF + both)
    dtype = keys.dtype.element_ty
    lower, upper, value = lower.to(dtype), upper.to(dtype), value.to(dtype)
    if (own >= share * PLACES) & (own < (share + 1) * PLACES) & (head == 0):
        tl.store(keys + own * 2 * HALF + half, lower)
        tl.store(keys + own * 2 * HALF + HALF + half, upper)
        tl.store(values + own * 2 * HALF + both, value)
        tl.store(valid + own, 1)
    new = (t == own)[:, None]
    low_keys = tl.where(new, lower[None, :], first).to(tl.float32)
    up_keys = tl.where(new, upper[None, :], second).to(tl.float32)
    score = (tl.sum(low_keys * low[None, :], 1) + tl.sum(up_keys * up[None, :], 1)) * scale
    score = tl.where(visible, score, float("-inf"))
    largest = tl.max(score, 0)
    weight = tl.where(visible, tl.exp(score - largest), 0.0)
    weighed = tl.where(new, value[None, :], seen).to(tl.float32)
    to = share * HEADS + head
    tl.store(most + to, largest)
    tl.store(total + to, tl.sum(weight, 0))
    tl.store(partial + to * 2 * HALF + both, tl.sum(weight[:, None] * weighed, 0))


@triton.jit
def _join_shares_kernel(
    partial, most, total, out, shares,
    HEADS: tl.constexpr, WIDTH: tl.constexpr, SHARES: tl.constexpr, PDL: tl.constexpr,
):  # fmt: skip
    """The softmax over all places, of one head: out [HEADS * WIDTH]."""
    head = tl.program_id(0)
    share, column = tl.arange(0, SHARES), tl.arange(0, WIDTH)
    wait_for_producer(PDL)
    launch_dependents(PDL)
    there = share < shares
    at = share * HEADS + head
    largest = tl.load(most + at, there, float("-inf"))
    factor = tl.where(largest == float("-inf"), 0.0, tl.exp(largest - tl.max(largest, 0)))
    sums = tl.sum(factor * tl.load(total + at, there, 0.0), 0)
    of_share = tl.load(partial + at[:, None] * WIDTH + column[None, :], there[:, None], 0.0)
    tl.store(out + head * WIDTH + column, tl.sum(factor[:, None] * of_share, 0) / sums)


@triton.jit
def _best_of_share_kernel(logits, best, where, count, BLOCK: tl.constexpr, PDL: tl.constexpr):
    """The largest of BLOCK logits, and the first id that has it; NaN is the largest, as in PyTorch."""
    share = tl.program_id(0)
    at = share * BLOCK + tl.arange(0, BLOCK)
    wait_for_producer(PDL)
    launch_dependents(PDL)
    logit = tl.load(logits + at, at < count, float("-inf"))
    logit = tl.where(logit == logit, logit, float("inf"))
    largest = tl.max(logit, 0)
    tl.store(best + share, largest)
    tl.store(where + share, tl.min(tl.where((logit == largest) & (at < count), at, count), 0))


@triton.jit
def _choose_kernel(
    best, where, chosen, ids, written, place, position, ends, ended, shares, num_ends,
    SHARES: tl.constexpr, ENDS: tl.constexpr, PDL: tl.constexpr,
):  # fmt: skip
    """Write the best id down, and be ready for the next token."""
    share, end = tl.arange(0, SHARES), tl.arange(0, ENDS)
    wait_for_producer(PDL)
    launch_dependents(PDL)
    largest = tl.load(best + share, share < shares, float("-inf"))
    candidates = tl.load(where + share, share < shares, 2**31 - 1)
    one = tl.min(tl.where(largest == tl.max(largest, 0), candidates, 2**31 - 1), 0).to(tl.int64)
    at = tl.load(written)
    tl.store(chosen, one)
    tl.store(ids + at, one)
    tl.store(written, at + 1)
    tl.store(place, tl.load(place) + 1)
    tl.store(position, tl.load(position) + 1)
    over = tl.max(((tl.load(ends + end, end < num_ends, -1) == one) & (end < num_ends)).to(tl.int32), 0)
    tl.store(ended, ((tl.load(ended) != 0) | (over != 0)).to(tl.int8))


@triton.jit
def _embed_id_kernel(chosen, table, out, width, scale, BLOCK: tl.constexpr, PDL: tl.constexpr):
    """The id's row of the table times `scale`, rounded as the table is."""
    k = tl.arange(0, BLOCK)
    wait_for_producer(PDL)
    launch_dependents(PDL)
    number = tl.load(table + tl.load(chosen) * width + k, k < width, 0.0)
    scaled = (number.to(tl.float32) * scale).to(table.dtype.element_ty)
    tl.store(out + k, scaled.to(tl.float32), k < width)


def row_product(
    row: Tensor, weight: Weight, out: Tensor, *, norm: nn.Module | None = None, eps: float = 0.0,
    beside: Weight | None = None, add: bool = False,
) -> None:  # fmt: skip
    """weight [N, D] times row float32[D] -> out float32[N]; `norm`'s weight: of the RMSNorm that comes first.

    beside  [N, D], in the weight's numbers: out is gelu(weight · row) times (beside · row)
    add     to what `out` holds
    """
    other, scale = weight if beside is None else beside, row if norm is None else norm.get_parameter("weight")
    if isinstance(weight, Int8Rows):
        assert isinstance(other, Int8Rows)
        rows, quarter = weight.words.shape
        whole = _pow2(quarter)
        _int8_row_product_kernel[(triton.cdiv(rows, INT8_ROWS),)](
            row, scale, weight.words, weight.scale, other.words, other.scale, out, rows, quarter, eps,
            NORM=norm is not None, GATED=beside is not None, ADD=add,
            ROWS=INT8_ROWS, WORDS=whole if norm is not None else min(BLOCK // 4, whole), num_warps=4,
            **dependent_launch(row),
        )  # fmt: skip
        return
    assert isinstance(other, Tensor)
    rows, width = weight.shape
    whole = _pow2(width)
    _row_product_kernel[(triton.cdiv(rows, ROWS),)](
        row, scale, weight, other, out, rows, width, eps,
        NORM=norm is not None, GATED=beside is not None, ADD=add,
        ROWS=ROWS, BLOCK=whole if norm is not None else min(BLOCK, whole), num_warps=4, **dependent_launch(row),
    )  # fmt: skip


def attend_places(
    qkv: Tensor, rope: tuple[Tensor, Tensor], keys: Tensor, values: Tensor, valid: Tensor, place: Tensor,
    position: Tensor, shares: tuple[Tensor, Tensor, Tensor],
) -> None:  # fmt: skip
    """Put this token's key and value at `place`, and attend to it and to the valid places before, by shares.

    qkv       float32[(H + 2) * K], not rotated
    rope      cos and sin, float32[positions, K/2]
    keys, values  [1, 1, S, K]; valid uint8[1, S]; place, position int64[1]
    shares    what `join_shares` reads: float32 [C, H, K], [C, H], [C, H]
    """
    partial, most, total = shares
    count, heads, dim = partial.shape
    _attend_places_kernel[count, heads](
        qkv, *rope, keys, values, valid, place, position, partial, most, total, dim**-0.5,
        HEADS=heads, HALF=dim // 2, PLACES=PLACES, **dependent_launch(qkv),
    )  # fmt: skip


def join_shares(shares: tuple[Tensor, Tensor, Tensor], out: Tensor) -> None:
    """What `attend_places` left, to out float32[H * K]."""
    partial, most, total = shares
    count, heads, dim = partial.shape
    _join_shares_kernel[(heads,)](
        partial, most, total, out, count,
        HEADS=heads, WIDTH=dim, SHARES=_pow2(count), num_warps=8, **dependent_launch(out),
    )  # fmt: skip


def choose(
    logits: Tensor, best: Tensor, where: Tensor, chosen: Tensor, ids: Tensor, count: Tensor, place: Tensor,
    position: Tensor, ends: Tensor, ended: Tensor,
) -> None:  # fmt: skip
    """The first of the largest logits float32[1, V], written down as `Decoding` says, and the counters moved on.

    best, where  float32 and int32, of one in LOGITS logits each: room
    ended        uint8[1]
    """
    shares, of_all = len(best), logits.shape[1]
    _best_of_share_kernel[(shares,)](logits, best, where, of_all, BLOCK=LOGITS, **dependent_launch(logits))
    _choose_kernel[(1,)](
        best, where, chosen, ids, count, place, position, ends, ended, shares, len(ends),
        SHARES=_pow2(shares), ENDS=_pow2(max(1, len(ends))), **dependent_launch(logits),
    )  # fmt: skip


def embed_id(chosen: Tensor, table: Tensor, out: Tensor) -> None:
    """The row int64[1] of table [V, D] times √D, rounded as the table is, to out float32[D]."""
    width = table.shape[1]
    _embed_id_kernel[(1,)](chosen, table, out, width, math.sqrt(width), BLOCK=_pow2(width), **dependent_launch(out))
