"""The formats that a model's numbers may be rounded to, by the name that precisions have of them."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from turbopi.quantization.fp8 import E4M3, E4M3_MAX, ScaledMatrix, to_e4m3
from turbopi.quantization.int8 import INT8_MAX, to_int8
from turbopi.quantization.nvfp4 import NVFP4_MAX, Nvfp4Matrix, held, single_numbers

Numbers = Literal["fp8", "int8", "nvfp4"]
RoundedMatrix = ScaledMatrix | Nvfp4Matrix


@dataclass(frozen=True)
class Format:
    """Numbers of eight bits, or of four.

    rounded        (x, 1 / scale) -> x in these numbers, to nearest, saturated
    holds_nan      whether a NaN that is rounded stays one; else damage shows beside the numbers: see int8.py
    expert_inputs  whether the expert's activations are rounded, too, or its weights alone: denoising is bound by
                   reading weights, so activations of bfloat16 cost nothing there
    parts          of the model that may have them
    in_blocks      (x [..., in], scale) -> x as these numbers hold it, where blocks have scales, too
    """

    name: Numbers
    dtype: torch.dtype
    largest: float
    rounded: Callable[[Tensor, float | Tensor], Tensor]
    holds_nan: bool
    expert_inputs: bool
    parts: tuple[str, ...] = ("vision", "prefix", "expert")
    in_blocks: Callable[[Tensor, float | Tensor], Tensor] | None = None

    @property
    def label(self) -> str:
        """As it is written in sentences."""
        return self.name.upper()

    def held(self, x: Tensor, scale: float) -> Tensor:
        """x as these numbers hold it with a scale, in x's dtype. Damage that they can't hold is NaN."""
        if self.in_blocks is not None:
            return self.in_blocks(x, scale)
        held = (self.rounded(x, 1 / scale).float() * scale).to(x.dtype)
        return held if self.holds_nan else held.masked_fill_(~x.isfinite(), torch.nan)

    def rounds_input(self, part: str) -> bool:
        """Whether activations of a part of the model are rounded, beside its weights."""
        return self.expert_inputs or part != "expert"


FP8 = Format("fp8", E4M3, E4M3_MAX, to_e4m3, holds_nan=True, expert_inputs=True)
INT8 = Format("int8", torch.int8, INT8_MAX, to_int8, holds_nan=False, expert_inputs=False)
NVFP4 = Format(
    *("nvfp4", torch.uint8, NVFP4_MAX, single_numbers),
    holds_nan=True,
    expert_inputs=False,
    parts=("vision", "prefix"),
    in_blocks=held,
)
OF_EIGHT_BITS: Mapping[Numbers, Format] = {"fp8": FP8, "int8": INT8}
FORMATS: Mapping[Numbers, Format] = {**OF_EIGHT_BITS, "nvfp4": NVFP4}


def named_by(details: object) -> Mapping[str, object] | None:
    """What a backend's `describe` tells of its calibration (`Quantization.describe`), under the name of the format;
    None: it has none.
    """
    found = [details.get(name) for name in FORMATS] if isinstance(details, Mapping) else []
    return next((one for one in found if isinstance(one, Mapping)), None)
