"""The q|k|v product of vision and its self-attention in one kernel, for compute capability 9.0: see kernel.cu.

Twin: `linear`, then `vision_attention` of `kernels.plain`, behind a LayerNorm.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import torch
from torch import Tensor

from turbopi.kernels.arguments import TENSOR_MAP, Parameter, Parameters
from turbopi.kernels.nvrtc import compile_cubin
from turbopi.kernels.portable.attention import LOG2_E
from turbopi.kernels.sm90 import instructions
from turbopi.kernels.sm90.gemm.bf16 import DEPTH, STEP_BYTES, Folded, Sums, matrix_map, norm_arguments
from turbopi.kernels.sm90.gemm.fp8 import DEPTH as DEPTH_FP8
from turbopi.kernels.sm90.gemm.fp8 import NO_EPS, UNPROMOTED_STEPS, FoldedFp8
from turbopi.kernels.sm90.instructions import SHARED_BYTES, DependentKernel
from turbopi.quantization.fp8 import E4M3

TOKENS, CTAS = 256, 4  # of a picture; for a head of it
LEAST_STAGES = 3
FILES = ("vision_attention/base.cu", "vision_attention/kernel.cu")
PACE = 250  # cycles between the first loads of weights: see gemm/base.cu


@dataclass(frozen=True)
class Cut:
    """How the work is cut: 64 tokens of a head a CTA."""

    dim: int  # columns of a head
    ranks: int = 2  # CTAs in a cluster: two, or the four of a head
    ring: int = 16  # most steps on their way
    pace: int = PACE

    def stages(self, fp8: bool) -> int:
        """Steps of the product in flight, beside keys, values, queries, factors, 1 KB of alignment and the barriers."""
        taken = 4 * self.dim * TOKENS + -(-self.dim // 16) * 2048 + (1 + fp8) * 3 * self.dim * 8 + 1024 + 32
        return min(self.ring, (SHARED_BYTES - taken) // ((64 + 3 * self.dim) * STEP_BYTES + 16))


@dataclass(frozen=True)
class Exchange:
    """Where pairs of CTAs leave keys and values for each other: of one launch at a time, with zeros in `flags`."""

    data: Tensor  # bfloat16[pictures * heads, 2 pairs, 2, dim / 8, 128 tokens, 8]
    flags: Tensor  # int32[pictures * heads, 2, 2]

    @classmethod
    def allocate(cls, pictures: int, heads: int, dim: int, device: torch.device) -> "Exchange":
        units = pictures * heads
        data = torch.empty(units, 2, 2, dim // 8, TOKENS // 2, 8, dtype=torch.bfloat16, device=device)
        return cls(data, torch.zeros(units, 2, 2, dtype=torch.int32, device=device))


def parameters(*, fp8: bool) -> Parameters:
    """What kernel.cu's kernel takes."""
    return Parameters(
        (
            Parameter(TENSOR_MAP, "map_a"),
            Parameter(TENSOR_MAP, "map_w"),
            Parameter("Element*", "out", "bfloat16 or E4M3"),
            Parameter("const float2*", "sums_in", "[parts][M]: the sum and the sum of squares of a row"),
            Parameter("float", "inverse_width"),
            Parameter("float", "eps"),
            Parameter("const float*", "sums_of_w"),
            Parameter("const float*", "offset"),
            *((Parameter("const float*", "scale"), Parameter("const u16*", "bias")) if fp8 else ()),
            Parameter("float", "inverse"),
            Parameter("float", "logit_scale"),
            *(Parameter("int", name) for name in ("M", "heads", "k_blocks")),
            Parameter("char*", "exchange"),
            Parameter("u32*", "flags"),
            Parameter("const char*", "ahead"),
            Parameter("u32", "ahead_bytes"),
        )
    )


def takes(rows: int, images: int, width: int, heads: int, inner: int, fp8: bool) -> bool:
    """Whether there is a kernel for pictures of so many tokens, and heads of so many columns."""
    dim = width // heads
    steps = -(-inner // (DEPTH_FP8 if fp8 else DEPTH))
    return (
        rows == images * TOKENS
        and dim % 8 == 0
        and 16 <= dim <= 80
        and steps >= 2
        and (not fp8 or steps <= UNPROMOTED_STEPS)
        and Cut(dim).stages(fp8) >= LEAST_STAGES
    )


def projected_attention(
    a: Tensor,
    weight: Folded | FoldedFp8,
    sums: Sums,
    images: int,
    heads: int,
    exchange: Exchange,
    *,
    bias: Tensor | None = None,
    eps: float = 0.0,
    inverse: float | None = None,
    ahead: Tensor | None = None,
    cut: Cut | None = None,
) -> Tensor:
    """Self-attention inside each picture of LayerNorm(a) @ weightᵀ + bias: a [V * 256, K], weight [3W, K], q before k
    before v, heads inside -> bfloat16[V * 256, W], or with `inverse` E4M3.

    a is bfloat16 with a `Folded` weight, which has the bias, or an E4M3 `Copy` with a `FoldedFp8` and a bfloat16 bias;
    `sums` are those of its rows. `ahead` is fetched into L2 in the end.
    """
    fp8 = isinstance(weight, FoldedFp8)
    matrix = weight.matrix.data if isinstance(weight, FoldedFp8) else weight.data
    (rows, inner), width = a.shape, matrix.shape[0] // 3
    cut = cut or Cut(width // heads)
    assert takes(rows, images, width, heads, inner, fp8), f"{a.shape}, {images} pictures, {heads} heads"
    assert a.dtype == matrix.dtype == (E4M3 if fp8 else torch.bfloat16) and a.is_contiguous() and matrix.is_contiguous()
    assert (bias is not None) == fp8 and (bias is None or bias.dtype == torch.bfloat16)
    assert exchange.flags.shape[0] >= images * heads
    out = torch.empty(rows, width, dtype=torch.bfloat16 if inverse is None else E4M3, device=a.device)
    kernel = _kernel(cut, fp8, inverse is not None, sums.count, a.device)
    blocks = CTAS * images * heads
    share = 0 if ahead is None else ahead.numel() * ahead.element_size() // blocks // 16 * 16
    given: dict[str, Any] = {
        "map_a": matrix_map(a.data_ptr(), rows, inner, 64, fp8=fp8),
        "map_w": matrix_map(matrix.data_ptr(), 3 * width, inner, cut.dim, fp8=fp8),
        "out": out.data_ptr(),
        "inverse": 1.0 if inverse is None else inverse,
        "logit_scale": cut.dim**-0.5 * LOG2_E,
        "M": rows,
        "heads": heads,
        "k_blocks": -(-inner // (DEPTH_FP8 if fp8 else DEPTH)),
        "exchange": exchange.data.data_ptr(),
        "flags": exchange.flags.data_ptr(),
        "ahead": ahead.data_ptr() if ahead is not None and share else None,
        "ahead_bytes": share,
    }
    if isinstance(weight, FoldedFp8):
        assert bias is not None
        given |= norm_arguments(sums, inner, NO_EPS, weight.of_scale, weight.of_shift)
        given |= {"scale": weight.scale.data_ptr(), "bias": bias.data_ptr()}
    else:
        given |= norm_arguments(sums, inner, eps, weight.sums, weight.offset)
    kernel.launch_dependent(blocks, given)
    return out


def constants(cut: Cut, fp8: bool, out_fp8: bool, normed: int) -> dict[str, int]:
    """What kernel.cu is compiled with; `normed`: parts of a row's sums."""
    return {
        "TP_DIM": cut.dim,
        "TP_STAGES": cut.stages(fp8),
        "TP_RANKS": cut.ranks,
        "TP_PACE": cut.pace,
        "TP_NORMED": normed,
        "TP_FP8": int(fp8),
        "TP_OUT_FP8": int(out_fp8),
    }


def source(cut: Cut, fp8: bool) -> str:
    """kernel.cu with the instructions for a cut."""
    blocks = 3 * cut.dim // 8
    widths = sorted({8 * (blocks // 2), 8 * -(-blocks // 2)})  # of the product, a warpgroup each
    generated = [instructions.wgmma("mma", columns, numbers="e4m3" if fp8 else "bf16") for columns in widths]
    generated += [
        instructions.wgmma("mma_logits", TOKENS // 2),
        instructions.wgmma("mma_values", cut.dim, from_registers=True, across=True),
        f"#define ATTENTION_PARAMETERS {parameters(fp8=fp8).declarations}\n",
    ]
    return instructions.source("attention/rows.cu", *FILES, generated="\n".join(generated))


@cache
def _kernel(cut: Cut, fp8: bool, out_fp8: bool, normed: int, device: torch.device) -> DependentKernel:
    with torch.cuda.device(device):
        cubin = compile_cubin(source(cut, fp8), "sm_90a", constants(cut, fp8, out_fp8, normed))
        return DependentKernel(
            cubin,
            "vision_attention",
            parameters(fp8=fp8),
            shared_bytes=SHARED_BYTES,
            threads=128 * 3,
            cluster=cut.ranks,
        )
