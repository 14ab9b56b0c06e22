"""Backend `emulated_fp8`: the float32 reference in which all that a calibration has in E4M3 is rounded, on any device.

For judging FP8 where no GPU with FP8 is at hand, closed loop included. It is slower than the reference, so `auto` never
takes it. Everything that isn't rounded to E4M3 is float32 here, bfloat16 in `fused`.
"""

from functools import partial
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from turbopi.backends.base import LoadState, Precision
from turbopi.backends.pytorch import PyTorchBackend
from turbopi.config import ModelConfig
from turbopi.engine.emulate import put_into_norm, round_activation, round_weight
from turbopi.model.conditioning import Form
from turbopi.model.sites import linears, norm_of
from turbopi.quantization.calibration_file import Quantization, check_given
from turbopi.quantization.plan import TIERS
from turbopi.quantization.sites import sites


class EmulatedFp8Backend(PyTorchBackend):
    """Rounds weights once, with a scale for each output channel, and activations whenever a product reads them."""

    name: ClassVar[str] = "emulated_fp8"
    precisions: ClassVar[tuple[Precision, ...]] = TIERS
    forms: ClassVar[tuple[Form, ...]] = ("tokens",)  # E4M3's rounding has no derivative

    def __init__(
        self,
        config: ModelConfig,
        load: LoadState,
        *,
        device: torch.device,
        precision: Precision,
        quantization: Quantization | None = None,
    ) -> None:
        check_given(precision, quantization)
        assert quantization is not None  # every precision here is a tier
        super().__init__(config, load, device=device, precision="f32")
        self.precision = precision
        self._quantization, self._plan = quantization, quantization.plan(config, precision)
        for site in sites(config):
            scale = self._plan.scales.get(str(site))
            if scale is None:
                continue
            norm = norm_of(self.model, site)
            if norm is not None:
                put_into_norm(norm, partial(round_activation, scale=scale))
            for linear in linears(self.model, site):
                linear.weight.data = round_weight(linear.weight.data, self._plan.directions.get(str(site)))
                if norm is None:
                    linear.register_forward_pre_hook(partial(_round_input, scale=scale))

    @classmethod
    def unavailable_in(cls, device: torch.device, precision: Precision) -> str | None:
        return None

    def describe(self) -> dict[str, Any]:
        return {
            "attention": "explicit float32",
            "fp8": {
                "emulated": "in float32",
                "sites in bf16": "run in float32 here",
                **self._quantization.describe(self._plan),
            },
        }


def _round_input(module: nn.Module, inputs: tuple[Tensor, ...], *, scale: float) -> tuple[Tensor, ...]:
    return round_activation(inputs[0], scale), *inputs[1:]
