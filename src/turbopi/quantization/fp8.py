"""Numbers of eight bits: E4M3, four bits of exponent and three of mantissa, and matrices of such numbers.

A matrix has one scale an output channel, an activation one scale a site, fixed by calibration: x ≈ e4m3 * scale. Sums
are float32; the product of both scales is applied to them once, before bias and nonlinearity.

With float16 sums, of HALF_BLOCK products each, GeForce GPUs multiply twice as fast. None can overflow: a channel's
numbers are divided by the least power of two for which that many, times 448, add up to less (`for_half_sums`). That is
exact but for the least ones, which lose at most 2^-10.

Rounding is to nearest even. What lies beyond ±448, infinities too, becomes ±448; NaN stays NaN, so that damage shows.
Weights whose activations' `Directions` are known are rounded with error feedback, see rounding.py.
"""

from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

E4M3 = torch.float8_e4m3fn
E4M3_MAX = 448.0
ALIGNMENT = 16  # inner sizes and widths must be multiples of it: tensor cores and their loads take 16 bytes at once
HALF_BLOCK = 128
HALF_MAX = 65000.0  # below 65504 by more than rounding the least numbers adds, 128 * 448 * 2^-10
LINE = 128  # bytes of a line of a GPU's memory: where a row begins inside one, loading 128 of its bytes takes two lines


def to_e4m3(x: Tensor, inverse: float | Tensor) -> Tensor:
    """round(x * inverse) in E4M3, saturated; computed in float32. `inverse` is 1 / scale."""
    return (x.float() * inverse).clamp(-E4M3_MAX, E4M3_MAX).to(E4M3)  # clamp passes NaN on


@dataclass(frozen=True)
class Directions:
    """What a site's activations x have in common: E[x xᵀ] ≈ main mainᵀ + rest I.

    `main` is itself kept in E4M3, with a scale a direction: 16 of the full model's take 10 MB so, and serve as well as
    in float32 (relative rms of the actions 0.0267 either way).
    """

    codes: Tensor  # e4m3[in, R]
    scale: Tensor  # float32[R]
    rest: float

    @property
    def main(self) -> Tensor:
        """float32[in, R]"""
        return self.codes.float() * self.scale

    def to(self, device: torch.device) -> "Directions":
        return Directions(self.codes.to(device), self.scale.to(device), self.rest)


def channel_scales(weight: Tensor, largest: float = E4M3_MAX) -> Tensor:
    """float32[out]: with it the largest value of each output channel becomes `largest`. NaN where a channel has NaN."""
    values = weight.abs().amax(dim=1).float()
    return torch.where(values == 0, torch.ones_like(values), values / largest)


@dataclass(frozen=True)
class ScaledMatrix:
    """A weight [out, in] in numbers of eight bits, E4M3 or int8, whose input comes in the same. Takes a matrix's place
    in `engine.weights`.
    """

    data: Tensor  # e4m3 or int8[out, in]
    scale: Tensor  # float32[out]: the channel's scale times the input's
    inverse: float  # 1 / scale of the input
    dtype: torch.dtype  # of results that aren't rounded for the next matrix
    half_sums: bool = False  # made by `for_half_sums`

    @property
    def shape(self) -> torch.Size:
        return self.data.shape

    @property
    def numbers(self) -> torch.dtype:
        """torch.float8_e4m3fn or torch.int8"""
        return self.data.dtype

    def __getitem__(self, rows: slice) -> "ScaledMatrix":
        return replace(self, data=self.data[rows], scale=self.scale[rows])

    def to(self, device: torch.device) -> "ScaledMatrix":
        return replace(self, data=self.data.to(device), scale=self.scale.to(device))

    def for_input(self, scale: float) -> "ScaledMatrix":
        """This matrix, of channels' scales alone, for an input with a scale."""
        return replace(self, scale=self.scale * scale, inverse=1 / scale)

    def for_half_sums(self) -> "ScaledMatrix":
        """The same in E4M3 numbers that no float16 sum overflows with: see above."""
        assert self.numbers == E4M3 and not self.half_sums
        sizes = self.data.float().abs()
        most = torch.stack([block.sum(1) for block in torch.split(sizes, HALF_BLOCK, 1)]).amax(0) * E4M3_MAX
        divisor = (most / HALF_MAX).log2().ceil().clamp(min=0).exp2()  # NaN of a channel that has NaN
        data = (self.data.float() / divisor[:, None]).to(E4M3)
        return replace(self, data=data, scale=self.scale * divisor, half_sums=True)

    def padded(self, rows: int, columns: int) -> "ScaledMatrix":
        """Padded with zeros to [rows, columns]; the scales of new rows are 1."""
        data, scale = self.data.new_zeros(rows, columns), self.scale.new_ones(rows)
        data[: self.shape[0], : self.shape[1]] = self.data
        scale[: self.shape[0]] = self.scale
        return replace(self, data=data, scale=scale)

    def product(self, x: Tensor, bias: Tensor | None = None) -> Tensor:
        """float32[tokens, out]: x [tokens, in] of the same numbers times this, as it is meant; slow.

        A float16 sum is rounded once here, by tensor cores after every 32 products, in an order of their own.
        """
        exact = torch.float64 if self.numbers == torch.int8 else torch.float32  # int32 is exact, too
        if self.half_sums:
            sums = torch.zeros(len(x), len(self.data), device=x.device)
            for a, b in zip(*(torch.split(one, HALF_BLOCK, 1) for one in (x, self.data)), strict=True):
                sums += (a.float() @ b.float().T).half()
        else:
            sums = (x.to(exact) @ self.data.to(exact).T).float()
        sums = sums * self.scale
        return sums if bias is None else sums + bias.float()

    def dequantized(self) -> Tensor:
        """float32[out, in]: what the numbers stand for."""
        return self.data.float() * (self.scale * self.inverse)[:, None]


Matrix = Tensor | ScaledMatrix


def whole_lines(columns: int) -> int:
    """`columns` of eight bits, rounded up to whole lines of memory."""
    return -(-columns // LINE) * LINE


def input_of(matrix: Matrix, stream: Tensor | None = None) -> dict[str, Any]:
    """What the operation in front of a matrix must know: nothing, or that its result is to be of eight bits, with which
    scale, and of which numbers, if not E4M3.

    stream  the residual stream [tokens, width] of the same tokens, in which int8's damage is marked: see int8.py. None:
            the operation has a place for it among its other arguments
    """
    if not isinstance(matrix, ScaledMatrix):
        return {}
    if matrix.numbers == E4M3:
        return {"inverse": matrix.inverse}
    return {"inverse": matrix.inverse, "numbers": matrix.numbers} | ({} if stream is None else {"stream": stream})
