"""Products in NVFP4 for GPUs whose tensor cores multiply it: compute capability 10.x, 11.0 and 12.x.

An activation is rounded by a kernel of its own before each product: two launches. Reference: `Nvfp4Matrix.product`.
Triton makes tcgen05.mma or mma.sync of the same source, both of kind::mxf4nvf4 with a scale for 16 numbers, and brings
the scales, which lie row by row, into their order.

No such GPU was here: that it multiplies right is found out on each machine (`turbopi doctor --qualify`).
"""

from dataclasses import replace
from functools import partial
from typing import Any, Final, Literal

import torch
import triton
import triton.language as tl
from torch import Tensor

from turbopi.kernels.dependent_launch import capability, dependent_launch, launch_dependents, wait_for_producer
from turbopi.kernels.interface import Ops
from turbopi.kernels.portable.activations import gelu_tanh
from turbopi.kernels.portable.rounding import _e4m3_byte, _to_e4m3
from turbopi.quantization.fp8 import E4M3
from turbopi.quantization.nvfp4 import BLOCK, Nvfp4Matrix, whole

Epilogue = Literal["plain", "gelu", "geglu"]
ROWS, COLUMNS = 128, 128  # of a tile
BLOCKS = 128  # that a program rounds
# Triton 3.6 has these instructions for 10.0, 10.3 and 12.0 alone; the others' are the same, by the PTX ISA. `arch` is
# what it lowers for; PTX and machine code are of the GPU itself all the same
LOWERED_AS: Final = {(11, 0): "sm100", (12, 1): "sm120"}


@triton.jit
def _nearest(x):
    """To the nearest whole number, halves to even; x float32 from 0 to 6."""
    return (x + 12582912.0) - 12582912.0


@triton.jit
def _round_kernel(
    x, codes, blocks, inner, count, inverse, scale, BLOCKS: tl.constexpr, BLOCK: tl.constexpr, PDL: tl.constexpr
):  # fmt: skip
    """BLOCKS blocks of a row, of which `count` are there, those past `inner` zeros."""
    wait_for_producer(PDL)
    launch_dependents(PDL)
    row, first = tl.program_id(0).to(tl.int64), tl.program_id(1) * BLOCKS
    block = first + tl.arange(0, BLOCKS)
    at = block[:, None] * BLOCK + tl.arange(0, BLOCK)[None, :]
    value = tl.load(x + row * inner + at, at < inner, 0.0).to(tl.float32)
    damaged = tl.max((value != value).to(tl.int32), 1) != 0
    value = tl.where(value == value, value, 0.0)
    wanted = tl.div_rn(tl.max(tl.abs(value), 1), 6.0) * inverse
    rounded = _to_e4m3(wanted)
    tl.store(blocks + row * count + block, tl.where(damaged, 0x7F, _e4m3_byte(wanted, rounded)), block < count)
    by = tl.where(damaged, 0.0, rounded * scale)[:, None]
    size = tl.minimum(tl.abs(tl.div_rn(value, tl.maximum(by, 1e-30))), 6.0)
    code = tl.where(size < 2, _nearest(2 * size), tl.where(size < 4, _nearest(size) + 2, _nearest(size / 2) + 4))
    sign = (value.to(tl.int32, bitcast=True) >> 28) & 8
    code = tl.where(by == 0, 0, code.to(tl.int32) | sign)
    low, high = tl.split(tl.reshape(code, (BLOCKS, BLOCK // 2, 2)))
    byte = block[:, None] * (BLOCK // 2) + tl.arange(0, BLOCK // 2)[None, :]
    tl.store(codes + row * count * (BLOCK // 2) + byte, (low | high << 4).to(tl.uint8), block[:, None] < count)


def round_activation(x: Tensor, scale: float) -> tuple[Tensor, Tensor]:
    """x [tokens, in] -> (codes uint8[tokens, whole(in) / 2], blocks e4m3[tokens, whole(in) / 16]) with this scale of
    the tensor. `in` is a multiple of 16. References: `quantization.nvfp4.block_scales`, `round_blocks`, `pack`.
    """
    rows, inner = x.shape
    assert x.is_contiguous() and inner % BLOCK == 0, "rows are read as they lie in memory, block by block"
    wide = whole(inner)
    codes = torch.empty(rows, wide // 2, dtype=torch.uint8, device=x.device)
    blocks = torch.empty(rows, wide // BLOCK, dtype=torch.uint8, device=x.device)
    _round_kernel[(rows, triton.cdiv(wide // BLOCK, BLOCKS))](
        x, codes, blocks, inner, wide // BLOCK, 1 / scale, scale, BLOCKS=BLOCKS, BLOCK=BLOCK, num_warps=4,
        **dependent_launch(x),
    )  # fmt: skip
    return codes, blocks.view(E4M3)


@triton.jit
def _decoded(codes, blocks, ROWS: tl.constexpr, DEPTH: tl.constexpr):
    """float32[ROWS, DEPTH] of codes and blocks as the tensor cores read them, both bytes."""
    code = tl.reshape(tl.join(codes & 15, codes >> 4), (ROWS, DEPTH)).to(tl.int32)
    size = (code & 7).to(tl.float32)
    number = tl.where(size < 4, size * 0.5, tl.where(size < 7, size - 2, 6.0))
    by = blocks.to(tl.int32)
    scale = tl.where(by < 8, by * 0.001953125, ((by << 20) + (120 << 23)).to(tl.float32, bitcast=True))
    scale = tl.where(by == 0x7F, float("nan"), scale)
    scale = tl.broadcast_to(scale[:, :, None], (ROWS, DEPTH // 16, 16))
    return tl.where(code < 8, number, -number) * tl.reshape(scale, (ROWS, DEPTH))


@triton.jit
def _sum(a, a_blocks, b, b_blocks, acc, DECODED: tl.constexpr):
    """acc + a bᵀ. DECODED: without the instruction, as Triton's interpreter hasn't it."""
    if DECODED:
        a = _decoded(a, a_blocks, a.shape[0], 2 * a.shape[1])
        b = _decoded(b, b_blocks, b.shape[0], 2 * b.shape[1])
        return tl.dot(a, b.T, acc, input_precision="ieee")
    a_blocks = a_blocks.to(tl.float8e4nv, bitcast=True)
    b_blocks = b_blocks.to(tl.float8e4nv, bitcast=True)
    return tl.dot_scaled(a, a_blocks, "e2m1", b.T, b_blocks, "e2m1", acc)


@triton.jit
def _product_kernel(
    x, x_blocks, weight, blocks, scale, bias, out, rows, columns, inner, x_scale,
    GELU: tl.constexpr, GEGLU: tl.constexpr, HAS_BIAS: tl.constexpr, DECODED: tl.constexpr,
    BLOCK_M: tl.constexpr, BLOCK_N: tl.constexpr, DEPTH: tl.constexpr, PDL: tl.constexpr,
):  # fmt: skip
    """Tile [BLOCK_M, BLOCK_N] of the product. `inner` is a multiple of DEPTH. GEGLU: weight has 2 * columns rows, and
    each gate's column stands beside its up's, as 10.x takes x's scales for one product alone.
    """
    m = tl.program_id(0) * BLOCK_M + tl.arange(0, BLOCK_M)
    n = tl.program_id(1) * BLOCK_N + tl.arange(0, BLOCK_N)
    d, s = tl.arange(0, DEPTH // 2), tl.arange(0, DEPTH // 16)
    # rows past the end are computed from others, and not stored
    a_at, a_scale_at = x + (m % rows)[:, None] * (inner // 2) + d, x_blocks + (m % rows)[:, None] * (inner // 16) + s
    row = n // 2 % columns + n % 2 * columns if GEGLU else n % columns
    b_at, b_scale_at = weight + row[:, None] * (inner // 2) + d, blocks + row[:, None] * (inner // 16) + s
    acc = tl.zeros((BLOCK_M, BLOCK_N), tl.float32)
    wait_for_producer(PDL)
    for step in range(inner // DEPTH):
        at, scale_at = step * (DEPTH // 2), step * (DEPTH // 16)
        a, a_scale = tl.load(a_at + at), tl.load(a_scale_at + scale_at)
        acc = _sum(a, a_scale, tl.load(b_at + at), tl.load(b_scale_at + scale_at), acc, DECODED)
    launch_dependents(PDL)
    if not GEGLU:
        acc *= (tl.load(scale + n, n < columns, 0.0) * x_scale)[None, :]
    if HAS_BIAS:
        acc += tl.load(bias + n, n < columns, 0.0).to(tl.float32)[None, :]
    if GELU:
        acc = gelu_tanh(acc)
    if GEGLU:
        gate, up = tl.split(tl.reshape(acc, (BLOCK_M, BLOCK_N // 2, 2)))
        n = tl.program_id(1) * (BLOCK_N // 2) + tl.arange(0, BLOCK_N // 2)
        gate *= (tl.load(scale + n, n < columns, 0.0) * x_scale)[None, :]
        up *= (tl.load(scale + columns + n, n < columns, 0.0) * x_scale)[None, :]
        acc = gelu_tanh(gate) * up
    to = out + m[:, None] * columns + n[None, :]
    tl.store(to, acc.to(out.dtype.element_ty), (m < rows)[:, None] & (n < columns)[None, :])


def product(
    x: Tensor,
    weight: Nvfp4Matrix,
    epilogue: Epilogue = "plain",
    bias: Tensor | None = None,
    out: Tensor | None = None,
) -> Tensor:
    """x [tokens, in] @ weightᵀ + bias, then the epilogue -> [tokens, out] in the weight's dtype.

    x isn't rounded yet. weight [out, in], of "geglu" [2 * out, in], gate rows before up rows; bias [out].
    """
    codes, blocks = round_activation(x, weight.input_scale)
    rows, wide = len(x), whole(weight.inner)
    columns = weight.shape[0] // 2 if epilogue == "geglu" else weight.shape[0]
    assert x.shape[1] == weight.inner and codes.shape[1] == weight.codes.shape[1], f"{tuple(x.shape)}, {weight.shape}"
    assert weight.codes.is_contiguous() and weight.blocks.is_contiguous(), "rows are read as they lie in memory"
    assert bias is None or (epilogue != "geglu" and bias.shape == (columns,))
    assert max(codes.numel(), weight.codes.numel(), rows * columns) < 1 << 31, "places are counted in 32 bits"
    if out is None:
        out = torch.empty(rows, columns, dtype=weight.dtype, device=x.device)
    assert out.is_contiguous() and out.shape == (rows, columns), "the result is written as it lies in memory"
    _product_kernel[(triton.cdiv(rows, ROWS), triton.cdiv(weight.shape[0], COLUMNS))](
        codes, blocks.view(torch.uint8), weight.codes, weight.blocks.view(torch.uint8), weight.scale,
        x if bias is None else bias, out, rows, columns, wide, weight.input_scale,
        GELU=epilogue == "gelu", GEGLU=epilogue == "geglu", HAS_BIAS=bias is not None,
        DECODED=not x.is_cuda, BLOCK_M=ROWS, BLOCK_N=COLUMNS,
        **_options(x, wide), **dependent_launch(x),
    )  # fmt: skip
    return out


def _options(x: Tensor, wide: int) -> dict[str, Any]:
    """Numbers of a step (12.x has registers for 128), and for the compiler: warps, stages, what it lowers for."""
    on = capability(x.device) if x.is_cuda else (12, 0)
    arch = {"arch": LOWERED_AS[on]} if on in LOWERED_AS else {}
    return {"DEPTH": 256 if wide % 256 == 0 and on[0] != 12 else 128, "num_warps": 8, "num_stages": 4, **arch}


def in_nvfp4(ops: Ops) -> Ops:
    """These operations, with products of an `Nvfp4Matrix` by the kernels here. No result is rounded for another one."""

    def either(usual: Any, epilogue: Epilogue, x: Tensor, weight: Any, *given: Any, **named: Any) -> Any:
        if not isinstance(weight, Nvfp4Matrix):
            return usual(x, weight, *given, **named)
        return product(x, weight, epilogue, *given, **named)

    return replace(
        ops,
        linear=partial(either, ops.linear, "plain"),
        residual_linear=partial(either, ops.residual_linear, "plain"),
        linear_gelu=partial(either, ops.linear_gelu, "gelu"),
        linear_geglu=partial(either, ops.linear_geglu, "geglu"),
        origin={**ops.origin, "NVFP4 products": "Triton: rounding, then the product with bias, GELU or GeGLU"},
    )
