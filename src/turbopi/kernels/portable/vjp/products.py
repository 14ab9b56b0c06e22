"""Products of few tokens that stream a matrix once, with what stands around them folded in.

Twins: `kernels.backward`. A program takes all T tokens (at most 64), some columns of the result, and the whole inner
axis or a part of it. It has its part of the matrix brought into the L2 cache before it waits for the kernel in front.
Sums are float32. A product of parts is float32[parts, T, D]; the norm behind it adds them up.

Matrices are [out, in] as `GemmaLayer` has them; the way back reads the same memory, `across`: inner axis first.
"""

import torch
import triton
import triton.language as tl
from torch import Tensor

from turbopi.kernels.dependent_launch import dependent_launch, launch_dependents, prefetch, wait_for_producer
from turbopi.kernels.portable.activations import gelu_tanh
from turbopi.kernels.portable.shared_memory import capability_of
from turbopi.kernels.portable.vjp.tiles import LINE, power_dividing, row_block, split_of, streaming


@triton.jit
def _prefetch(weight, row, length, stride, ROWS: tl.constexpr, LINES: tl.constexpr, PDL: tl.constexpr):
    """Rows from `row` on, ROWS of them, each of `length` bfloat16 numbers in LINES lines or fewer."""
    rows = row + tl.arange(0, ROWS)
    place = tl.minimum(tl.arange(0, LINES) * 64, length - 1)
    prefetch(weight + (rows[:, None] * stride + place[None, :]), PDL)


@triton.jit
def _two_products(
    x, weight, row, apart, tokens, inner,
    BLOCK_M: tl.constexpr, PAIRS: tl.constexpr, DEPTH: tl.constexpr, LINES: tl.constexpr, PDL: tl.constexpr,
):  # fmt: skip
    """x [tokens, inner] times PAIRS of the matrix's rows from `row` on, and times as many that are `apart` behind.

    As one product of rows in turn: in 16 columns, two would each keep half of the warps busy.
    """
    _prefetch(weight, row, inner, inner, PAIRS, LINES, PDL)
    _prefetch(weight, row + apart, inner, inner, PAIRS, LINES, PDL)
    m, n, d = tl.arange(0, BLOCK_M), tl.arange(0, 2 * PAIRS), tl.arange(0, DEPTH)
    weight_at = weight + ((row + n // 2 + n % 2 * apart)[:, None] * inner + d[None, :])
    x_at = x + (m[:, None] * inner + d[None, :])
    there = (m < tokens)[:, None]
    acc = tl.zeros((BLOCK_M, 2 * PAIRS), tl.float32)
    wait_for_producer(PDL)
    launch_dependents(PDL)
    for at in range(0, inner, DEPTH):
        a = tl.load(x_at + at, there, 0.0)
        acc = tl.dot(a, tl.load(weight_at + at).T, acc, input_precision="ieee")
    return tl.split(tl.reshape(acc, (BLOCK_M, PAIRS, 2)))


@triton.jit
def _qkv_kernel(
    x, weight, cos, sin, q, k, v, tokens, inner, heads,
    HALF: tl.constexpr, PAIRS: tl.constexpr, BLOCK_M: tl.constexpr, DEPTH: tl.constexpr, LINES: tl.constexpr,
    PDL: tl.constexpr,
):  # fmt: skip
    """PAIRS of columns of one head, each of one column of either half."""
    head, part = tl.program_id(0) // (HALF // PAIRS), tl.program_id(0) % (HALF // PAIRS)
    row = head * 2 * HALF + part * PAIRS
    first, second = _two_products(x, weight, row, HALF, tokens, inner, BLOCK_M, PAIRS, DEPTH, LINES, PDL)
    m, pair = tl.arange(0, BLOCK_M), part * PAIRS + tl.arange(0, PAIRS)
    there = (m < tokens)[:, None]
    turned = m[:, None] * HALF + pair[None, :]
    c = tl.load(cos + turned, there & (head <= heads), 1.0)  # values aren't turned
    s = tl.load(sin + turned, there & (head <= heads), 0.0)
    if head < heads:
        to = q + ((m * heads + head)[:, None] * 2 * HALF + pair[None, :])
    elif head == heads:
        to = k + (m[:, None] * 2 * HALF + pair[None, :])
    else:
        to = v + (m[:, None] * 2 * HALF + pair[None, :])
    tl.store(to, (first * c - second * s).to(q.dtype.element_ty), there)
    tl.store(to + HALF, (second * c + first * s).to(q.dtype.element_ty), there)


def qkv(x: Tensor, weight: Tensor, cos: Tensor, sin: Tensor, k_out: Tensor, v_out: Tensor) -> Tensor:
    """See the twin. x [T, D], weight [(n + 2) * K, D] -> turned queries [T * n, K]; keys and values [T, K] written."""
    _check(x, weight, cos, sin, k_out, v_out)
    (tokens, inner), dim = x.shape, k_out.shape[1]
    heads, half = weight.shape[0] // dim - 2, dim // 2
    tile = streaming(capability_of(x), tokens, half, inner, 16, matrices=2)
    q = x.new_empty(tokens * heads, dim)
    _qkv_kernel[((heads + 2) * (half // tile.columns),)](
        x, weight, cos, sin, q, k_out, v_out, tokens, inner, heads,
        HALF=half, PAIRS=tile.columns, BLOCK_M=tile.rows, DEPTH=tile.depth, LINES=_lines(inner),
        num_warps=tile.warps, num_stages=tile.stages, **dependent_launch(x),
    )  # fmt: skip
    return q


@triton.jit
def _gate_up_kernel(
    x, weight, product, out, tokens, inner, hidden,
    COLUMNS: tl.constexpr, BLOCK_M: tl.constexpr, DEPTH: tl.constexpr, LINES: tl.constexpr, PDL: tl.constexpr,
):  # fmt: skip
    row = tl.program_id(0) * COLUMNS
    gate, up = _two_products(x, weight, row, hidden, tokens, inner, BLOCK_M, COLUMNS, DEPTH, LINES, PDL)
    m, n = tl.arange(0, BLOCK_M), row + tl.arange(0, COLUMNS)
    there = (m < tokens)[:, None]
    dtype = out.dtype.element_ty
    to = product + (m[:, None] * 2 * hidden + n[None, :])
    tl.store(to, gate.to(dtype), there)
    tl.store(to + hidden, up.to(dtype), there)
    # of the rounded product, as it is kept for the way back
    result = gelu_tanh(gate.to(dtype).to(tl.float32)) * up.to(dtype).to(tl.float32)
    tl.store(out + (m[:, None] * hidden + n[None, :]), result.to(dtype), there)


def gate_up(x: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """See the twin. x [T, D], weight [2F, D] -> the product [T, 2F], GeGLU of it [T, F]."""
    _check(x, weight)
    (tokens, inner), hidden = x.shape, weight.shape[0] // 2
    tile = streaming(capability_of(x), tokens, hidden, inner, 32, matrices=2)
    product, out = x.new_empty(tokens, 2 * hidden), x.new_empty(tokens, hidden)
    _gate_up_kernel[(hidden // tile.columns,)](
        x, weight, product, out, tokens, inner, hidden,
        COLUMNS=tile.columns, BLOCK_M=tile.rows, DEPTH=tile.depth, LINES=_lines(inner),
        num_warps=tile.warps, num_stages=tile.stages, **dependent_launch(x),
    )  # fmt: skip
    return product, out


@triton.jit
def _across_kernel(
    d_out, weight, product, out, tokens, inner, columns,
    GEGLU: tl.constexpr, COLUMNS: tl.constexpr, BLOCK_M: tl.constexpr, DEPTH: tl.constexpr, ROWS: tl.constexpr,
    PDL: tl.constexpr,
):  # fmt: skip
    """d_out [T, inner] @ weight [inner, columns]; GEGLU: then back through it, at `product` [T, 2 * columns]."""
    m, d = tl.arange(0, BLOCK_M), tl.arange(0, DEPTH)
    n = tl.program_id(0) * COLUMNS + tl.arange(0, COLUMNS)
    rows = tl.minimum(tl.arange(0, ROWS), inner - 1)
    prefetch(weight + (rows * columns + tl.program_id(0) * COLUMNS), PDL)
    if GEGLU:  # kept by a kernel long ago
        place = m[:, None] * 2 * columns + n[None, :]
        gate = tl.load(product + place, (m < tokens)[:, None], 0.0)
        up = tl.load(product + place + columns, (m < tokens)[:, None], 0.0)
    x_at = d_out + (m[:, None] * inner + d[None, :])
    weight_at = weight + (d[:, None] * columns + n[None, :])
    there = (m < tokens)[:, None]
    acc = tl.zeros((BLOCK_M, COLUMNS), tl.float32)
    wait_for_producer(PDL)
    launch_dependents(PDL)
    for at in range(0, inner, DEPTH):
        a = tl.load(x_at + at, there, 0.0)
        acc = tl.dot(a, tl.load(weight_at + at * columns), acc, input_precision="ieee")
    dtype = out.dtype.element_ty
    if GEGLU:
        gate, up = gate.to(tl.float32), up.to(tl.float32)
        # as in portable/backward.py
        half = 1 / (1 + tl.exp2(gate * (-2.302208198 - 0.1029432397 * gate * gate)))
        slope = half + gate * 2 * half * (1 - half) * 0.7978845608 * (1 + 0.134145 * gate * gate)
        tl.store(out + place, (acc * up * slope).to(dtype), there)
        tl.store(out + place + columns, (acc * gate * half).to(dtype), there)
    else:
        tl.store(out + (m[:, None] * columns + n[None, :]), acc.to(dtype), there)


def down_vjp(d_y: Tensor, weight: Tensor, product: Tensor) -> Tensor:
    """See the twin. d_y [T, D], weight [D, F], the product that GeGLU was of [T, 2F] -> what comes back to it."""
    return _across(d_y, weight, product, torch.empty_like(product))


def out_vjp(d_y: Tensor, weight: Tensor) -> Tensor:
    """See the twin. d_y [T, D], weight [D, n * K] -> [T, n * K]."""
    return _across(d_y, weight, None, d_y.new_empty(len(d_y), weight.shape[1]))


def _across(d_out: Tensor, weight: Tensor, product: Tensor | None, out: Tensor) -> Tensor:
    _check(d_out, weight, out if product is None else product)
    (tokens, inner), columns = d_out.shape, weight.shape[1]
    tile = streaming(capability_of(d_out), tokens, columns, inner, 32)
    _across_kernel[(columns // tile.columns,)](
        d_out, weight, out if product is None else product, out, tokens, inner, columns,
        GEGLU=product is not None, COLUMNS=tile.columns, BLOCK_M=tile.rows, DEPTH=tile.depth,
        ROWS=triton.next_power_of_2(inner), num_warps=tile.warps, num_stages=tile.stages, **dependent_launch(d_out),
    )  # fmt: skip
    return out


@triton.jit
def _parts_kernel(
    x, weight, out, tokens, inner, columns, split,
    ACROSS: tl.constexpr, COLUMNS: tl.constexpr, BLOCK_M: tl.constexpr, DEPTH: tl.constexpr, LINES: tl.constexpr,
    PDL: tl.constexpr,
):  # fmt: skip
    """Columns of one part: `split` numbers of the inner axis. LINES: of a row; ACROSS: rows of a line each."""
    m, d = tl.arange(0, BLOCK_M), tl.arange(0, DEPTH)
    column, begin = tl.program_id(0) * COLUMNS, tl.program_id(1) * split
    n = column + tl.arange(0, COLUMNS)
    if ACROSS:
        prefetch(weight + ((begin + tl.minimum(tl.arange(0, LINES), split - 1)) * columns + column), PDL)
        weight_at = weight + ((begin + d)[:, None] * columns + n[None, :])
    else:
        _prefetch(weight + begin, column, split, inner, COLUMNS, LINES, PDL)
        weight_at = weight + (n[:, None] * inner + (begin + d)[None, :])
    x_at = x + (m[:, None] * inner + (begin + d)[None, :])
    there = (m < tokens)[:, None]
    acc = tl.zeros((BLOCK_M, COLUMNS), tl.float32)
    wait_for_producer(PDL)
    launch_dependents(PDL)
    for at in range(0, split, DEPTH):
        a = tl.load(x_at + at, there, 0.0)
        if ACROSS:
            acc = tl.dot(a, tl.load(weight_at + at * columns), acc, input_precision="ieee")
        else:
            acc = tl.dot(a, tl.load(weight_at + at).T, acc, input_precision="ieee")
    tl.store(out + ((tl.program_id(1) * tokens + m)[:, None] * columns + n[None, :]), acc, there)


def down(x: Tensor, weight: Tensor) -> Tensor:
    """See the twin. x [T, F], weight [D, F] -> float32[parts, T, D]."""
    return _parts(x, weight, weight.shape[0], across=False)


def gate_up_vjp(d_product: Tensor, weight: Tensor) -> Tensor:
    """See the twin. d_product [T, 2F], weight [2F, D] -> float32[parts, T, D]."""
    return _parts(d_product, weight, weight.shape[1], across=True)


def _parts(x: Tensor, weight: Tensor, columns: int, *, across: bool) -> Tensor:
    _check(x, weight)
    tokens, inner = x.shape
    split = split_of(inner)
    tile = streaming(capability_of(x), tokens, columns, split, 64)
    out = x.new_empty(inner // split, tokens, columns, dtype=torch.float32)
    _parts_kernel[(columns // tile.columns, inner // split)](
        x, weight, out, tokens, inner, columns, split,
        ACROSS=across, COLUMNS=tile.columns, BLOCK_M=tile.rows, DEPTH=tile.depth,
        LINES=triton.next_power_of_2(split) if across else _lines(split),
        num_warps=tile.warps, num_stages=tile.stages, **dependent_launch(x),
    )  # fmt: skip
    return out


@triton.jit
def _out_kernel(
    sums, tops, totals, weight, attended, lse, out, tokens, columns, heads,
    DIM: tl.constexpr, SPLITS: tl.constexpr, COLUMNS: tl.constexpr, BLOCK_M: tl.constexpr, PDL: tl.constexpr,
):  # fmt: skip
    """One head's part of some tokens: its attention's splits become one, which is also stored, times its columns of the
    matrix.
    """
    m, d = tl.program_id(2) * BLOCK_M + tl.arange(0, BLOCK_M), tl.arange(0, DIM)
    n = tl.program_id(0) * COLUMNS + tl.arange(0, COLUMNS)
    head = tl.program_id(1)
    matrix = tl.load(weight + (n[:, None] * heads * DIM + (head * DIM + d)[None, :]))
    there = m < tokens
    row = m * heads + head
    wait_for_producer(PDL)
    launch_dependents(PDL)
    mean = tl.zeros((BLOCK_M, DIM), weight.dtype.element_ty)
    if tokens > 0:  # always; without a branch Triton lays out every split as the product wants their sum, and spills
        top = tl.full((BLOCK_M,), -float("inf"), tl.float32)
        for split in tl.static_range(SPLITS):
            top = tl.maximum(top, tl.load(tops + split * tokens * heads + row, there, 0.0))
        total = tl.zeros((BLOCK_M,), tl.float32)
        acc = tl.zeros((BLOCK_M, DIM), tl.float32)
        for split in tl.range(SPLITS, loop_unroll_factor=5):  # more at once spill
            place = split * tokens * heads + row
            weighed = tl.exp2(tl.load(tops + place, there, 0.0) - top)
            total += weighed * tl.load(totals + place, there, 1.0)
            acc += weighed[:, None] * tl.load(sums + (place[:, None] * DIM + d[None, :]), there[:, None], 0.0)
        mean = (acc / total[:, None]).to(weight.dtype.element_ty)
        if tl.program_id(0) == 0:
            tl.store(attended + (row[:, None] * DIM + d[None, :]), mean, there[:, None])
            tl.store(lse + row, top + tl.log2(total), there)
    result = tl.dot(mean, matrix.T, input_precision="ieee")
    tl.store(out + ((head * tokens + m)[:, None] * columns + n[None, :]), result, there[:, None])


def out_of_splits(sums: Tensor, tops: Tensor, totals: Tensor, weight: Tensor, attended: Tensor, lse: Tensor) -> Tensor:
    """Attention's splits (vjp/attention.py) times weight [D, n * K] -> float32[n, T, D], a part for each head.

    Also writes what the splits are together: attended [T * n, K], and lse float32[T * n], base 2.
    """
    _check(sums, tops, totals, weight, attended, lse)
    splits, rows, dim = sums.shape
    heads, columns = weight.shape[1] // dim, weight.shape[0]
    tokens = rows // heads
    block, taken, warps = _of_splits(tokens, columns)
    out = weight.new_empty(heads, tokens, columns, dtype=torch.float32)
    _out_kernel[(columns // taken, heads, triton.cdiv(tokens, block))](
        sums, tops, totals, weight, attended, lse, out, tokens, columns, heads,
        DIM=dim, SPLITS=splits, COLUMNS=taken, BLOCK_M=block, num_warps=warps, **dependent_launch(weight),
    )  # fmt: skip
    return out


@triton.jit
def _added(at, step, there, COUNT: tl.constexpr):
    """The sum of COUNT tiles."""
    total = tl.load(at, there, 0.0)
    for i in tl.static_range(1, COUNT):
        total += tl.load(at + i * step, there, 0.0)
    return total


@triton.jit
def _qkv_vjp_kernel(
    d_q, d_kv, cos, sin, weight, out, tokens, columns, heads,
    HALF: tl.constexpr, BLOCK_HALF: tl.constexpr, SPLITS: tl.constexpr, GROUPS: tl.constexpr, COLUMNS: tl.constexpr,
    BLOCK_M: tl.constexpr, PDL: tl.constexpr,
):  # fmt: skip
    """One head's part of some tokens, queries before key and value: its gradient's splits added up and turned back,
    times its rows.
    """
    m, pair = tl.program_id(2) * BLOCK_M + tl.arange(0, BLOCK_M), tl.arange(0, BLOCK_HALF)
    n = tl.program_id(0) * COLUMNS + tl.arange(0, COLUMNS)
    head = tl.program_id(1)
    row = head * 2 * HALF + pair
    used = (pair < HALF)[:, None]
    first_rows = tl.load(weight + (row[:, None] * columns + n[None, :]), used, 0.0)
    second_rows = tl.load(weight + ((row + HALF)[:, None] * columns + n[None, :]), used, 0.0)
    there = (m < tokens)[:, None] & (pair < HALF)[None, :]
    wait_for_producer(PDL)
    launch_dependents(PDL)
    if head < heads:
        at = d_q + ((m * heads + head)[:, None] * 2 * HALF + pair[None, :])
        first = _added(at, tokens * heads * 2 * HALF, there, SPLITS)
        second = _added(at + HALF, tokens * heads * 2 * HALF, there, SPLITS)
    else:
        at = d_kv + ((m * 2 + head - heads)[:, None] * 2 * HALF + pair[None, :])
        first = _added(at, tokens * 2 * 2 * HALF, there, GROUPS)
        second = _added(at + HALF, tokens * 2 * 2 * HALF, there, GROUPS)
    turned = m[:, None] * HALF + pair[None, :]
    c = tl.load(cos + turned, there & (head <= heads), 1.0)  # values never were turned
    s = tl.load(sin + turned, there & (head <= heads), 0.0)
    dtype = weight.dtype.element_ty
    result = tl.dot((first * c + second * s).to(dtype), first_rows, input_precision="ieee")
    result = tl.dot((second * c - first * s).to(dtype), second_rows, result, input_precision="ieee")
    tl.store(out + ((head * tokens + m)[:, None] * columns + n[None, :]), result, (m < tokens)[:, None])


def qkv_vjp(gradients: tuple[Tensor, Tensor], cos: Tensor, sin: Tensor, weight: Tensor) -> Tensor:
    """What attention's way back left (vjp/attention.py) times weight [(n + 2) * K, D] -> float32[n + 2, T, D]."""
    d_q, d_kv = gradients
    _check(d_q, d_kv, cos, sin, weight)
    (tokens, half), columns = cos.shape, weight.shape[1]
    heads = d_q.shape[1] // tokens
    block, taken, warps = _of_splits(tokens, columns)
    out = weight.new_empty(heads + 2, tokens, columns, dtype=torch.float32)
    _qkv_vjp_kernel[(columns // taken, heads + 2, triton.cdiv(tokens, block))](
        d_q, d_kv, cos, sin, weight, out, tokens, columns, heads,
        HALF=half, BLOCK_HALF=max(16, half), SPLITS=len(d_q), GROUPS=len(d_kv), COLUMNS=taken, BLOCK_M=block,
        num_warps=warps, **dependent_launch(weight),
    )  # fmt: skip
    return out


def _of_splits(tokens: int, columns: int) -> tuple[int, int, int]:
    """(rows, columns, warps) of a program that adds up splits: every program of the same rows reads them all."""
    block = row_block(tokens)
    return (block, power_dividing(columns, 64), 4) if block == 16 else (block, power_dividing(columns, 128), 8)


def _lines(length: int) -> int:
    """Lines of a row of bfloat16 numbers, as a power of two."""
    return triton.next_power_of_2(-(-length * 2 // LINE))


def _check(*tensors: Tensor) -> None:
    assert all(one.is_contiguous() for one in tensors), "rows are read as they lie in memory"
