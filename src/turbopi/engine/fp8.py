"""Numbers of eight bits: E4M3, four bits of exponent and three of mantissa, and matrices made of them.

A matrix has one scale an output channel, an activation one scale a site, fixed by calibration: x ≈ e4m3 * scale. Sums
are float32; the product of both scales is applied to them once, before bias and nonlinearity.

Rounding is to nearest even. What lies beyond ±448, infinities too, becomes ±448; NaN stays NaN, so that damage shows.
"""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

E4M3 = torch.float8_e4m3fn
E4M3_MAX = 448.0
ALIGNMENT = 16  # inner sizes and widths must be multiples of it: tensor cores and their loads take 16 bytes at once


def to_e4m3(x: Tensor, inverse: float | Tensor) -> Tensor:
    """round(x * inverse) in E4M3, saturated; computed in float32. `inverse` is 1 / scale."""
    return (x.float() * inverse).clamp(-E4M3_MAX, E4M3_MAX).to(E4M3)  # clamp passes NaN on


@dataclass(frozen=True)
class Fp8Matrix:
    """A weight [out, in] in E4M3 whose input comes in E4M3, too. Takes a matrix's place in `engine.weights`."""

    data: Tensor  # e4m3[out, in]
    scale: Tensor  # float32[out]: the channel's scale times the input's
    inverse: float  # 1 / scale of the input
    dtype: torch.dtype  # of results that aren't E4M3

    @classmethod
    def quantize(cls, weight: Tensor, input_scale: float) -> "Fp8Matrix":
        """weight [out, in] in its channels' own scales: the largest value of each becomes 448."""
        largest = weight.abs().amax(dim=1).float()
        scale = torch.where(largest > 0, largest / E4M3_MAX, torch.ones_like(largest))
        return cls(to_e4m3(weight, 1 / scale[:, None]), scale * input_scale, 1 / input_scale, weight.dtype)

    @property
    def shape(self) -> torch.Size:
        return self.data.shape

    def __getitem__(self, rows: slice) -> "Fp8Matrix":
        return Fp8Matrix(self.data[rows], self.scale[rows], self.inverse, self.dtype)

    def product(self, x: Tensor, bias: Tensor | None = None) -> Tensor:
        """float32[tokens, out]: x e4m3[tokens, in] times this, as it is meant; slow."""
        sums = (x.float() @ self.data.float().T) * self.scale
        return sums if bias is None else sums + bias.float()

    def dequantized(self) -> Tensor:
        """float32[out, in]: what the numbers stand for."""
        return self.data.float() * (self.scale * self.inverse)[:, None]


Matrix = Tensor | Fp8Matrix


def input_of(matrix: Matrix) -> dict[str, Any]:
    """What the operation in front of a matrix must know: nothing, or that its result is to be E4M3, and its scale."""
    return {"inverse": matrix.inverse} if isinstance(matrix, Fp8Matrix) else {}
