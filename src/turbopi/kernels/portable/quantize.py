"""Weights to eight bits, by a kernel where there is a GPU with Triton. The plain way: `quantization.rounding`."""

import importlib.util
from collections.abc import Sequence

from torch import Tensor

from turbopi.quantization.formats import FP8, NVFP4, Format, RoundedMatrix
from turbopi.quantization.fp8 import Directions, Matrix, ScaledMatrix, channel_scales
from turbopi.quantization.nvfp4 import Nvfp4Matrix
from turbopi.quantization.plan import PrecisionPlan
from turbopi.quantization.rounding import feedback, round_with_feedback_plain
from turbopi.support.toolchain import make_caches_writable


def rounded_matrix(
    weight: Matrix,
    input_scale: float,
    directions: Directions | None = None,
    format: Format = FP8,
    parts: Sequence[int] = (),
) -> RoundedMatrix:
    """weight [out, in] in any format, rounded for its input's directions. parts: see `Nvfp4Matrix.of`."""
    if format is not NVFP4:
        return quantize(weight, input_scale, directions, format)
    assert isinstance(weight, Tensor), "no folder keeps four bits"
    return Nvfp4Matrix.of(weight, input_scale, directions, parts)


def quantize(
    weight: Matrix, input_scale: float, directions: Directions | None = None, format: Format = FP8
) -> ScaledMatrix:
    """weight [out, in] in its channels' own scales, rounded for its input's directions."""
    return round_channels(weight, directions, format).for_input(input_scale)


def by_plan(
    plan: PrecisionPlan | None, place: str, matrix: Matrix, parts: Sequence[int] = ()
) -> Matrix | RoundedMatrix:
    """The matrix at this place as the plan has it. parts: see `Nvfp4Matrix.of`."""
    if plan is None or place not in plan.scales:
        return matrix
    made = rounded_matrix(matrix, plan.scales[place], plan.directions.get(place), plan.format, parts)
    return made.for_half_sums() if isinstance(made, ScaledMatrix) and plan.has_half_sums(place) else made


def round_channels(weight: Matrix, directions: Directions | None = None, format: Format = FP8) -> ScaledMatrix:
    """The same with the channels' scales alone. A matrix that was rounded so before stays as it is."""
    if isinstance(weight, ScaledMatrix):
        return weight
    scale = channel_scales(weight, format.largest)
    return ScaledMatrix(round_rows(weight, 1 / scale, directions, format), scale, 1.0, weight.dtype)


def round_rows(weight: Tensor, inverse: Tensor, directions: Directions | None = None, format: Format = FP8) -> Tensor:
    """e4m3 or int8[out, in]: weight * inverse, rounded to nearest, or for the directions of what it is multiplied by.

    inverse float32[out], 1 / scale. On a GPU with Triton by a kernel, which may round other weights up or down than a
    CPU: a sum's last bit decides what all later weights of its row make up for.
    """
    if directions is None:
        return format.rounded(weight, inverse[:, None])
    feeding = feedback(directions.to(weight.device))
    if weight.is_cuda and importlib.util.find_spec("triton") is not None:
        make_caches_writable()
        from turbopi.kernels.portable.rounding import round_with_feedback  # Triton isn't imported elsewhere

        return round_with_feedback(weight, inverse, *feeding, format.dtype)
    return round_with_feedback_plain(weight, inverse, *feeding, format.rounded)
