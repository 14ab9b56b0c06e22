"""Programmatic dependent launch: a kernel's blocks start while the kernel before it ends, and wait for its results.

Every kernel here that is launched so waits before it touches anything another kernel writes; so work that a kernel
may overlap with is only ever its own constants' loading: into registers, or by `prefetch` into the L2 cache. Those
of the true Jacobian's way back (portable/backward.py, portable/vjp) also read what was complete when the kernel in
front began, which lets it start after a wait of its own. Needs compute capability 9.0.
"""

from functools import lru_cache
from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor
from triton.language.extra.cuda import gdc_launch_dependents, gdc_wait

from turbopi.quantization.fp8 import E4M3


@triton.jit
def wait_for_producer(PDL: tl.constexpr):
    if PDL:
        gdc_wait()


@triton.jit
def launch_dependents(PDL: tl.constexpr):
    if PDL:
        gdc_launch_dependents()


@triton.jit
def prefetch(at, PDL: tl.constexpr):
    """Have the lines of 128 bytes at these addresses brought into the L2 cache. Nothing waits for them."""
    if PDL:
        tl.inline_asm_elementwise(
            "prefetch.global.L2 [$1]; mov.u32 $0, 0;", "=r,l", [at.to(tl.int64)], tl.int32, is_pure=False, pack=1
        )


def dependent_launch(x: Tensor) -> dict[str, Any]:
    """Launch options: dependent launch where the GPU has it."""
    if x.is_cuda and capability(x.device)[0] >= 9:
        return {"PDL": True, "launch_pdl": True}
    return {"PDL": False}


def result_dtype(x: Tensor, inverse: float | None, numbers: torch.dtype = E4M3) -> torch.dtype:
    """x's, or `numbers` where a result is scaled for them; Triton's interpreter can't round to E4M3: then float32."""
    if inverse is None:
        return x.dtype
    return numbers if x.is_cuda or numbers != E4M3 else torch.float32


@lru_cache
def capability(device: torch.device) -> tuple[int, int]:
    return torch.cuda.get_device_capability(device)
