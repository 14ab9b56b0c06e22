"""The three products on the expert's way back whose operand comes from one kernel: across.cu's sizes and launch.

Twins: `kernels.backward`. Sizes and numbers of tokens that across.cu doesn't cover: Triton's kernels (portable/vjp).
"""

from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Final, Literal

import torch
from torch import Tensor

from turbopi.config import GemmaConfig
from turbopi.kernels.ahead import MadeOnce
from turbopi.kernels.arguments import Parameter, Parameters
from turbopi.kernels.interface import BackwardOps
from turbopi.kernels.nvrtc import compile_cubin
from turbopi.kernels.portable.vjp import products as portable
from turbopi.kernels.portable.vjp import tiles
from turbopi.kernels.portable.vjp.ops import FEW_TOKENS
from turbopi.kernels.portable.vjp.ops import backward_form as portable_backward
from turbopi.kernels.sm90 import instructions
from turbopi.kernels.sm90.instructions import SHARED_BYTES, DependentKernel

Mode = Literal["plain", "parts", "geglu"]
MODES: Final[dict[Mode, int]] = {"plain": 0, "parts": 1, "geglu": 2}
WARPS: Final = 16
# Blocks at most, where the columns allow it: one on a multiprocessor. Behind `out_vjp` comes attention, whose blocks
# take a whole one each, and load what they need before it ends.
BLOCKS: Final[dict[Mode, int]] = {"plain": 64, "parts": 132, "geglu": 132}
MOST_TOKENS: Final = 16  # beyond them Triton's kernels: at 50 they were faster on an H200
TAKES: Final = Parameters(
    (
        Parameter("const unsigned char*", "x", "bf16 [T][inner]"),
        Parameter("const unsigned char*", "weights", "bf16 [inner][columns]"),
        Parameter("const unsigned char*", "product", "bf16 [T][2 columns], of GEGLU"),
        Parameter("unsigned char*", "out"),
        Parameter("int", "tokens"),
        Parameter("int", "inner"),
        Parameter("int", "columns"),
    )
)


@dataclass(frozen=True)
class Cut:
    """Of the inner axis and the columns: what a block takes."""

    depth: int
    columns: int

    @property
    def shared_bytes(self) -> int:
        return max(self.depth * self.columns * 2, WARPS * 16 * (self.columns + 8) * 4) + 16  # a barrier

    def sizes(self, mode: Mode) -> dict[str, int]:
        """The kernel's compile-time constants."""
        return {
            "TP_MODE": MODES[mode],
            "TP_COLUMNS": self.columns,
            "TP_DEPTH": self.depth,
            "TP_SHARED_BYTES": self.shared_bytes,
        }


@cache
def cut(mode: Mode, tokens: int, inner: int, columns: int) -> Cut | None:
    """The narrowest blocks of which there are at most BLOCKS, else the widest; None: across.cu doesn't cover it."""
    depth = tiles.split_of(inner) if mode == "parts" else inner
    if tokens > MOST_TOKENS or depth % (32 * WARPS):
        return None
    chunks = depth // 32 // WARPS  # of a warp
    found = [
        Cut(depth, wide)
        for wide in (16, 32, 64)
        if columns % wide == 0 and chunks in (1, 2, 4, 8) and depth % (WARPS * 256 // wide) == 0
    ]
    found = [one for one in found if one.shared_bytes <= SHARED_BYTES]
    fitting = [one for one in found if columns // one.columns * (inner // depth) <= BLOCKS[mode]]
    return fitting[0] if fitting else found[-1] if found else None


def source() -> str:
    return instructions.source("vjp/across.cu", generated="")


def compiled(one: Cut, mode: Mode, folder: Path | None = None) -> bytes:
    """The kernel's machine code."""
    return compile_cubin(source(), "sm_90a", one.sizes(mode), folder=folder)


@MadeOnce
def _kernel(one: Cut, mode: Mode, device: torch.device) -> DependentKernel:
    with torch.cuda.device(device):
        cubin = compiled(one, mode)
        shared = one.shared_bytes
        return DependentKernel(cubin, "turbopi_across", TAKES, shared_bytes=shared, threads=WARPS * 32, cluster=1)


def down_vjp(d_y: Tensor, weight: Tensor, product: Tensor) -> Tensor:
    """See the twin. d_y [T, D], weight [D, F], the product that GeGLU was of [T, 2F] -> what comes back to it."""
    one = cut("geglu", *d_y.shape, weight.shape[1])
    if one is None:
        return portable.down_vjp(d_y, weight, product)
    return _across(one, "geglu", d_y, weight, product, torch.empty_like(product))


def out_vjp(d_y: Tensor, weight: Tensor) -> Tensor:
    """See the twin. d_y [T, D], weight [D, n * K] -> [T, n * K]."""
    one = cut("plain", *d_y.shape, weight.shape[1])
    if one is None:
        return portable.out_vjp(d_y, weight)
    return _across(one, "plain", d_y, weight, None, d_y.new_empty(len(d_y), weight.shape[1]))


def gate_up_vjp(d_product: Tensor, weight: Tensor) -> Tensor:
    """See the twin. d_product [T, 2F], weight [2F, D] -> float32[parts, T, D]."""
    (tokens, inner), columns = d_product.shape, weight.shape[1]
    one = cut("parts", tokens, inner, columns)
    if one is None:
        return portable.gate_up_vjp(d_product, weight)
    out = d_product.new_empty(inner // one.depth, tokens, columns, dtype=torch.float32)
    return _across(one, "parts", d_product, weight, None, out)


def _across(one: Cut, mode: Mode, x: Tensor, weight: Tensor, product: Tensor | None, out: Tensor) -> Tensor:
    given = (x, weight, x if product is None else product, out)
    assert all(t.is_contiguous() for t in given), "rows are read as they lie in memory"
    assert all(t.dtype == torch.bfloat16 for t in given[:3]), [t.dtype for t in given]
    (tokens, inner), columns = x.shape, weight.shape[1]
    addresses = dict(zip(("x", "weights", "product", "out"), (t.data_ptr() for t in given), strict=True))
    sizes = {"tokens": tokens, "inner": inner, "columns": columns}
    _kernel(one, mode, x.device).launch_dependent(columns // one.columns * (inner // one.depth), addresses | sizes)
    return out


ORIGIN: Final = (
    f"CUDA and Triton for up to {MOST_TOKENS} tokens, Triton for up to {tiles.MOST_TOKENS}, else cuBLAS and Triton; "
    "forward, of one observation in bfloat16, the denoising kernel"
)
ACROSS = replace(FEW_TOKENS, down_vjp=down_vjp, out_vjp=out_vjp, gate_up_vjp=gate_up_vjp, origin="CUDA and Triton")


def backward_form(expert: GemmaConfig, tokens: int, masked: bool = False) -> BackwardOps:
    """See `portable.vjp.ops.backward_form`."""
    found = portable_backward(expert, tokens, masked)
    return ACROSS if found is FEW_TOKENS and tokens <= MOST_TOKENS else found
