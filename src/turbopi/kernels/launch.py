"""Programmatic dependent launch: a kernel's blocks start while the kernel before it ends, and wait for its results.

Every kernel here that is launched so waits before it touches anything another kernel writes; so work that a kernel
may overlap with is only ever its own constants' loading. Needs compute capability 9.0.
"""

from functools import lru_cache
from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor
from triton.language.extra.cuda import gdc_launch_dependents, gdc_wait


@triton.jit
def wait_for_producer(PDL: tl.constexpr):
    if PDL:
        gdc_wait()


@triton.jit
def launch_dependents(PDL: tl.constexpr):
    if PDL:
        gdc_launch_dependents()


def dependent_launch(x: Tensor) -> dict[str, Any]:
    """Launch options: dependent launch where the GPU has it."""
    if x.is_cuda and capability(x.device)[0] >= 9:
        return {"PDL": True, "launch_pdl": True}
    return {"PDL": False}


@lru_cache
def capability(device: torch.device) -> tuple[int, int]:
    return torch.cuda.get_device_capability(device)
