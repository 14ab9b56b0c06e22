"""The control: what rounding the weights alone does to a model's actions, measured on the model itself."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import torch

from turbopi.backends import Precision
from turbopi.models import family_of
from turbopi.quantization.plan import ROUNDED
from turbopi.verify.bounds import STEPS

CONTROL_SEEDS = (1, 2)
# how much coarser than bfloat16's a precision's rounding is
ROUNDING: dict[Precision, float] = {"bf16": 1.0, "f32": 2.0**-16, **{one: STEPS[one] for one in ROUNDED}}
_HALF_BF16_STEP = 2.0**-9


@contextmanager
def jittered(model: Any, seed: int) -> Iterator[None]:
    """For a while, each weight that is bfloat16 in the bf16 mode is moved by up to half a bfloat16 step."""
    try:
        _scale_weights(model, seed, torch.Tensor.mul_)
        yield
    finally:
        _scale_weights(model, seed, torch.Tensor.div_)


def _scale_weights(model: Any, seed: int, apply: Callable[[torch.Tensor, torch.Tensor], torch.Tensor]) -> None:
    generator, dtype_of = torch.Generator(model.device).manual_seed(seed), family_of(model.config).parameter_dtype
    for name, parameter in model.named_parameters():
        if dtype_of(name, "bf16", model.config) == torch.bfloat16:
            uniform = torch.rand(parameter.shape, generator=generator, device=parameter.device)
            apply(parameter.data, uniform.mul_(2).sub_(1).mul_(_HALF_BF16_STEP).add_(1))
