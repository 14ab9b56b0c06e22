"""Backends `emulated_fp8`, `emulated_int8`, `emulated_nvfp4`: the float32 reference in which all that a calibration has
in eight bits or four is rounded, on any device.

For judging them where no GPU that has them is at hand, closed loop included. They are slower than the
reference, so `auto` never takes them. Everything that isn't rounded is float32 here, bfloat16 in `fused`.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, ClassVar

from torch import Tensor, nn

from turbopi.backends.base import LoadState, Precision
from turbopi.backends.pytorch import PyTorchBackend
from turbopi.engine.emulate import Round, input_rounding, put_into_norm, put_product, round_weight
from turbopi.kernels.portable.quantize import by_plan
from turbopi.models import linears
from turbopi.models.pi0.conditioning import Form
from turbopi.models.pi0.sites import norm_of
from turbopi.quantization.fp8 import Matrix, ScaledMatrix, to_e4m3
from turbopi.quantization.plan import FP8_TIERS
from turbopi.quantization.sites import sites


class EmulatedFp8Backend(PyTorchBackend):
    """Rounds weights once, with a scale for each output channel, and activations whenever a product reads them."""

    name: ClassVar[str] = "emulated_fp8"
    precisions: ClassVar[tuple[Precision, ...]] = FP8_TIERS
    forms: ClassVar[tuple[Form, ...]] = ("tokens",)  # rounding has no derivative
    writes: ClassVar[bool] = False
    instead: ClassVar[str] = "backend 'pytorch' with precision 'f32'"

    def load_weights(self, load: LoadState) -> None:
        super().load_weights(load)
        assert self._quantization is not None  # every precision here is a tier
        self._plan = self._quantization.plan(self.config, self.precision)
        for site in sites(self.config):
            scale = self._plan.scales.get(str(site))
            if scale is None:
                continue
            format, norm = self._plan.format, norm_of(self.model, site)
            rounding = input_rounding(site, scale, format)
            if norm is not None:
                put_into_norm(norm, rounding)
            directions = self._plan.directions.get(str(site))
            for linear in linears(self.model, site):
                if self._plan.has_half_sums(str(site)):
                    matrix = by_plan(self._plan, str(site), linear.weight.data)
                    assert isinstance(matrix, ScaledMatrix), "float16 sums are FP8's"
                    put_product(linear, partial(to_e4m3, inverse=1 / scale), partial(_given, matrix))
                    continue
                linear.weight.data = round_weight(linear.weight.data, directions, format)
                if norm is None:
                    linear.register_forward_pre_hook(_before(rounding))

    def describe(self) -> dict[str, Any]:
        assert self._quantization is not None
        return {
            "attention": "explicit float32",
            self._plan.format.name: {
                "emulated": "in float32",
                "sites in bf16": "run in float32 here",
                **self._quantization.describe(self._plan),
            },
        }


class EmulatedInt8Backend(EmulatedFp8Backend):
    """The same in INT8, in which the expert's activations stay as they are."""

    name: ClassVar[str] = "emulated_int8"
    precisions: ClassVar[tuple[Precision, ...]] = ("int8",)


class EmulatedNvfp4Backend(EmulatedFp8Backend):
    """The same in NVFP4, which vision and prefix alone have."""

    name: ClassVar[str] = "emulated_nvfp4"
    precisions: ClassVar[tuple[Precision, ...]] = ("nvfp4",)


def _given(matrix: Matrix, weight: Tensor) -> Matrix:
    return matrix


def _before(rounding: Round) -> Callable[[nn.Module, tuple[Tensor, ...]], tuple[Tensor, ...]]:
    return lambda module, inputs: (rounding(inputs[0]), *inputs[1:])
