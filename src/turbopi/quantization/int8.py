"""Numbers of eight bits: whole numbers from -127 to 127, for GPUs whose tensor cores multiply them fastest.

As in fp8.py a matrix has one scale an output channel and an activation one a site: x ≈ int8 * scale. Products of two
such numbers are added up as int32, exactly; the sum becomes float32 once, times both scales.

Rounding is to nearest even. What lies beyond ±127 becomes ±127. -128 isn't used, so that both signs reach as far.

There is no NaN. Of a weight it becomes the scale of its whole output channel. An activation that isn't finite is
damage, which would be lost: so the operation that rounds one also writes NaN into that token's row of a tensor that is
not rounded (`mark_damage`): the residual stream, or in the prefix's attention the token's values. A NaN of the stream
stays in it until the keys and values of the prefix's last layer, whose product `plan.py` keeps in bfloat16; from there
it gets into the actions of that observation, and of no other.
"""

import torch
from torch import Tensor

INT8_MAX = 127.0


def to_int8(x: Tensor, inverse: float | Tensor) -> Tensor:
    """round(x * inverse) in int8, saturated; computed in float32. `inverse` is 1 / scale."""
    return (x.float() * inverse).nan_to_num(0.0).clamp(-INT8_MAX, INT8_MAX).round().to(torch.int8)


def mark_damage(x: Tensor, rows: Tensor) -> None:
    """Write NaN into the first number of each of `rows` [tokens, width] where x [tokens, ...] isn't finite."""
    rows[:, 0].masked_fill_(~x.isfinite().flatten(1).all(1), torch.nan)
