"""Numbers of eight bits: whole numbers from -127 to 127, for GPUs whose tensor cores don't multiply E4M3.

As in fp8.py a matrix has one scale an output channel and an activation one a site: x ≈ int8 * scale. Products of two
such numbers are added up as int32, exactly; the sum becomes float32 once, times both scales.

Rounding is to nearest even. What lies beyond ±127, infinities too, becomes ±127. There is no NaN: of an activation it
becomes 0, of a weight the scale of its whole output channel is NaN. -128 isn't used, so that both signs reach as far.
"""

import torch
from torch import Tensor

INT8_MAX = 127.0


def to_int8(x: Tensor, inverse: float | Tensor) -> Tensor:
    """round(x * inverse) in int8, saturated; computed in float32. `inverse` is 1 / scale."""
    return (x.float() * inverse).nan_to_num(0.0).clamp(-INT8_MAX, INT8_MAX).round().to(torch.int8)
