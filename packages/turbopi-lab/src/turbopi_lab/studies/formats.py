"""Formats that no kernel here computes with, emulated exactly, to know what they would cost in error."""

from collections.abc import Iterator
from contextlib import contextmanager
from types import ModuleType

import torch
from torch import Tensor

import turbopi.models.pi0.gemma
import turbopi.models.pi0.vision
from turbopi.models.pi0.layers import attention
from turbopi.quantization.fp8 import E4M3_MAX, Directions, to_e4m3
from turbopi.quantization.nvfp4 import BLOCK, block_scales, round_blocks, round_e2m1, tensor_scale
from turbopi.quantization.rounding import columns_with_feedback, feedback

MX_BLOCK = 32


def round_mxfp4(x: Tensor, directions: Directions | None = None) -> Tensor:
    """x [rows, K] as MXFP4 holds it (OCP's Microscaling Formats 1.0): E2M1 numbers in blocks of 32 whose scales are
    powers of two; K a multiple of 32. It is what tensor cores can multiply with E4M3 numbers. `directions`: as of
    `quantization.nvfp4.round_nvfp4`.
    """
    blocks = x.float().view(*x.shape[:-1], -1, MX_BLOCK)
    largest = blocks.abs().amax(-1, keepdim=True)
    exponent = torch.floor(torch.log2(largest.clamp(min=1e-38))) - 2  # of E2M1's largest power of two, 4
    return _in_blocks(x, blocks, torch.where(largest > 0, torch.exp2(exponent), 0.0), directions)


def nvfp4_without_scales(x: Tensor) -> Tensor:
    """What a product sees if NVFP4's numbers are right, and their scales are ignored where they are read."""
    scale = tensor_scale(x)
    return x if scale == 0 else round_blocks(x, scale, block_scales(x, scale)).to(x.dtype)


def nvfp4_with_swizzled_scales(x: Tensor) -> Tensor:
    """What a product sees if block scales lie in the order of rows, and are read in that of 128 × 4 tiles that tensor
    cores want: row r, block c of a tile at 16 (r mod 32) + 4 (r div 32) + c. Rows and blocks of whole tiles alone.
    """
    scale = tensor_scale(x)
    if scale == 0:
        return x
    blocks = block_scales(x, scale)
    codes, by = round_blocks(x, scale, blocks).view(*blocks.shape, BLOCK), blocks.float() * scale
    rows, columns = by.shape[0] // 128 * 128, by.shape[1] // 4 * 4
    read = by.clone()
    if rows and columns:
        tiles = by[:rows, :columns].reshape(rows // 128, 128, columns // 4, 4).transpose(1, 2).flatten(2)
        row, column = torch.arange(128)[:, None], torch.arange(4)[None]
        places = 16 * (row % 32) + 4 * (row // 32) + column
        mixed = tiles[..., places.to(x.device)]
        read[:rows, :columns] = mixed.transpose(1, 2).reshape(rows, columns)
    return (codes * read[..., None]).flatten(-2).to(x.dtype)


def _in_blocks(x: Tensor, blocks: Tensor, scale: Tensor, directions: Directions | None) -> Tensor:
    if directions is None:
        return _e2m1(blocks, scale).flatten(-2).to(x.dtype)
    size, feeding = blocks.shape[-1], feedback(directions.to(x.device))
    return columns_with_feedback(x, *feeding, lambda wanted, i: _e2m1(wanted, scale[:, i // size, 0])).to(x.dtype)


def _e2m1(x: Tensor, scale: Tensor) -> Tensor:
    return torch.where(scale > 0, round_e2m1(x / scale.clamp(min=1e-30)) * scale, 0.0)


@contextmanager
def attention_in_fp8(*stacks: str) -> Iterator[None]:
    """For a while, both matrix products of the attention in these stacks ("vision", "gemma") are of E4M3 numbers.

    Queries, keys and values with a scale for each tensor, from its own values; probabilities times 448.
    """
    modules: dict[str, ModuleType] = {"vision": turbopi.models.pi0.vision, "gemma": turbopi.models.pi0.gemma}
    chosen = [modules[stack] for stack in stacks]
    try:
        for module in chosen:
            module.attention = _attention_fp8  # type: ignore[attr-defined]
        yield
    finally:
        for module in chosen:
            module.attention = attention  # type: ignore[attr-defined]


def _attention_fp8(q: Tensor, k: Tensor, v: Tensor, mask: Tensor | None = None) -> Tensor:
    """`layers.attention` in float32 with rounded operands."""
    q, k, v = (_rounded(x, float(x.abs().amax()) / E4M3_MAX) for x in (q, k, v))
    b, h, s, dim = q.shape
    groups = k.shape[1]
    folded = q.reshape(b, groups, h // groups * s, dim)
    if mask is not None and mask.shape[-2] != 1:
        mask = mask.repeat(1, 1, h // groups, 1)
    logits = folded @ k.transpose(-1, -2) * dim**-0.5
    if mask is not None:
        logits = logits.masked_fill(~mask, torch.finfo(torch.float32).min)
    probabilities = logits.softmax(-1)
    # the sum stays exact: it is taken before rounding, as fused kernels do
    return (_rounded(probabilities, 1 / E4M3_MAX) @ v).reshape(b, h, s, dim)


def _rounded(x: Tensor, scale: float) -> Tensor:
    return to_e4m3(x, 1 / scale).float() * scale if scale > 0 else x
