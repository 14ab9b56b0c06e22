"""NVFP4: numbers of four bits, E2M1, for Blackwell's tensor cores.

Sixteen neighbours along a matrix's inner axis are a block. A block has a scale in E4M3, a tensor one in float32:
x ≈ e2m1 * e4m3 * scale. A weight's float32 scale comes from its own values (of matrices that the engine joins each has
its own), an activation's from calibration, so that no pass over it is needed. Products of two such numbers are exact in
float32, in which they are added up.

Rounding is to nearest even. A block's largest number becomes ±6, unless its scale saturates: infinities do, too. E2M1
has no NaN: a block that has one gets a scale of NaN, so that damage shows in the whole row of a product.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F
from torch import Tensor

from turbopi.quantization.fp8 import E4M3, E4M3_MAX, Directions, to_e4m3
from turbopi.quantization.rounding import columns_with_feedback, feedback

E2M1 = (0.0, 0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0)
BLOCK = 16
NVFP4_MAX = E2M1[-1] * E4M3_MAX  # times the tensor's scale
WHOLE = 128  # of a row in memory, which is filled up with zeros: kernels take so many numbers at once


def round_e2m1(x: Tensor) -> Tensor:
    """To the nearest of ±E2M1, halves to the one with an even mantissa, beyond 6 to 6. NaN stays NaN."""
    x = x.clamp(-E2M1[-1], E2M1[-1])
    magnitude = x.abs()
    step = torch.where(magnitude < 2, 0.5, torch.where(magnitude < 4, 1.0, 2.0))  # between E2M1's numbers
    return torch.round(x / step) * step


def tensor_scale(x: Tensor) -> Tensor:
    """float32[]: with it the block of the largest value has E4M3's largest scale; 0 where everything is 0."""
    return x.abs().amax().float() / NVFP4_MAX


def _blocks(x: Tensor) -> Tensor:
    """[..., in / 16, 16]"""
    return x.reshape(*x.shape[:-1], -1, BLOCK)


def block_scales(x: Tensor, scale: float | Tensor) -> Tensor:
    """e4m3[..., in / 16] of x [..., in] with the tensor's scale."""
    blocks = _blocks(x.float())
    return to_e4m3(blocks.abs().amax(-1) / E2M1[-1], 1 / scale)


def round_blocks(x: Tensor, scale: float | Tensor, blocks: Tensor) -> Tensor:
    """float32[..., in]: E2M1 numbers for x [..., in] with a tensor's and its blocks' scales; NaN where those are."""
    by = (blocks.float() * scale)[..., None]
    numbers = round_e2m1(_blocks(x.float()) / by.clamp(min=1e-30))
    return torch.where(by == 0, 0.0, numbers).flatten(-2)


def held(x: Tensor, scale: float | Tensor) -> Tensor:
    """x [..., in] as NVFP4 with this scale of the tensor holds it, in x's dtype."""
    blocks = block_scales(x, scale)
    by = (blocks.float() * scale)[..., None]
    return (_blocks(round_blocks(x, scale, blocks)) * by).flatten(-2).to(x.dtype)


def single_numbers(x: Tensor, inverse: float | Tensor) -> Tensor:
    """float32: x times inverse, each number as a block of its own: what blocks can't do better."""
    return to_e4m3(x / E2M1[-1], inverse).float() * E2M1[-1]


def round_nvfp4(x: Tensor, directions: Directions | None = None) -> Tensor:
    """x [rows, in] as NVFP4 holds it with scales from its own values, in x's dtype. With `directions` x is a weight,
    rounded for them.
    """
    scale = tensor_scale(x)
    if scale == 0:
        return x
    return held(x, scale) if directions is None else _for_directions(x, scale, directions).to(x.dtype)


def _for_directions(weight: Tensor, scale: Tensor, directions: Directions) -> Tensor:
    """float32[out, in]: what the numbers stand for, in the blocks' scales of the weight itself."""
    by = block_scales(weight, scale).float() * scale

    def rounded(wanted: Tensor, column: int) -> Tensor:
        own = by[:, column // BLOCK]
        return torch.where(own == 0, 0.0, round_e2m1(wanted / own.clamp(min=1e-30)) * own)

    return columns_with_feedback(weight, *feedback(directions.to(weight.device)), rounded)


def pack(numbers: Tensor) -> Tensor:
    """uint8[..., in / 2] of E2M1 numbers float32[..., in]: two a byte, the first in the low bits. NaN becomes 0."""
    numbers = numbers.nan_to_num(0.0)
    size = numbers.abs()
    # codes 0 to 3 are halves; 2, 3, 4 and 6 are 4 to 7
    codes = torch.where(size < 2, size * 2, torch.where(size < 6, size + 2, 7.0)).to(torch.uint8)
    codes |= numbers.signbit().to(torch.uint8) << 3
    return codes[..., ::2] | codes[..., 1::2] << 4


def unpack(codes: Tensor) -> Tensor:
    """float32[..., in] of uint8[..., in / 2]."""
    every = torch.stack((codes & 15, codes >> 4), -1).flatten(-2).long()
    return torch.tensor((*E2M1, *(-one for one in E2M1)), device=codes.device)[every]


def whole(inner: int) -> int:
    """How many numbers a row of so many has in memory."""
    return -(-inner // WHOLE) * WHOLE


@dataclass(frozen=True)
class Nvfp4Matrix:
    """A weight [out, in] in NVFP4, whose input is rounded in front of the product. Takes a matrix's place in
    `engine.weights`.
    """

    codes: Tensor  # uint8[out, whole(in) / 2], see `pack`
    blocks: Tensor  # e4m3[out, whole(in) / 16]
    scale: Tensor  # float32[out]: of the tensor that the row is of
    input_scale: float  # of the input
    inner: int  # in
    dtype: torch.dtype  # of results

    @classmethod
    def of(
        cls, weight: Tensor, input_scale: float, directions: Directions | None = None, parts: Sequence[int] = ()
    ) -> "Nvfp4Matrix":
        """Round a weight [out, in]: to nearest, or for the directions of what it is multiplied by.

        parts  the rows of each tensor that it was joined of, if of several
        """
        split = torch.split(weight, list(parts)) if parts else (weight,)
        scale = torch.cat([tensor_scale(one).expand(len(one)) for one in split])[:, None]
        scale = torch.where(scale == 0, 1.0, scale)
        blocks = block_scales(weight, scale)
        values = weight if directions is None else _for_directions(weight, scale, directions)
        numbers, more = round_blocks(values, scale, blocks), whole(weight.shape[1]) - weight.shape[1]
        filled = F.pad(blocks.view(torch.uint8), (0, more // BLOCK)).view(E4M3)
        codes, inner = pack(F.pad(numbers, (0, more))), weight.shape[1]
        return cls(codes, filled, scale[:, 0].contiguous(), input_scale, inner, weight.dtype)

    @property
    def shape(self) -> torch.Size:
        return torch.Size((len(self.codes), self.inner))

    def __getitem__(self, rows: slice) -> "Nvfp4Matrix":
        return replace(self, codes=self.codes[rows], blocks=self.blocks[rows], scale=self.scale[rows])

    def to(self, device: torch.device) -> "Nvfp4Matrix":
        moved = {name: getattr(self, name).to(device) for name in ("codes", "blocks", "scale")}
        return replace(self, **moved)

    def product(self, x: Tensor, bias: Tensor | None = None) -> Tensor:
        """float32[tokens, out]: x [tokens, in] times this, as it is meant, whole sums exact; slow."""
        blocks = block_scales(x, self.input_scale)
        rows = _times(round_blocks(x, self.input_scale, blocks), blocks)
        ours = _times(unpack(self.codes), self.blocks)[:, : self.inner]
        sums = (rows.double() @ ours.double().T).float() * (self.scale * self.input_scale)
        return sums if bias is None else sums + bias.float()

    def dequantized(self) -> Tensor:
        """float32[out, in]: what the numbers stand for."""
        by = self.blocks.float() * self.scale[:, None]
        return _times(unpack(self.codes), by)[:, : self.inner]


def _times(numbers: Tensor, blocks: Tensor) -> Tensor:
    return (_blocks(numbers) * blocks.float()[..., None]).flatten(-2)
