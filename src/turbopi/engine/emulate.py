"""The reference with its sites rounded: plain PyTorch, float32 between the roundings, exact in what is rounded.

The oracle of the engine's FP8, INT8 and NVFP4, and the instrument that says what they do to a checkpoint's actions, on
any device.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from turbopi.kernels.portable.quantize import rounded_matrix
from turbopi.models import linears
from turbopi.models.pi0.layers import AdaRMSNorm, inverse_rms
from turbopi.models.pi0.sites import norm_of
from turbopi.quantization.formats import FP8, Format, RoundedMatrix
from turbopi.quantization.fp8 import Directions, Matrix, ScaledMatrix, to_e4m3
from turbopi.quantization.sites import Site

Round = Callable[[Tensor], Tensor]
MakeMatrix = Callable[[Tensor], Matrix]


def round_activation(x: Tensor, scale: float, format: Format = FP8) -> Tensor:
    """x as numbers of the format with a scale hold it, in x's dtype."""
    return format.held(x, scale)


def round_weight(weight: Tensor, directions: Directions | None = None, format: Format = FP8) -> Tensor:
    """A matrix [out, in] as such numbers with scales from its own values hold it, in its dtype."""
    return rounded_matrix(weight, 1.0, directions, format).dequantized().to(weight.dtype)


class RoundedWeights:
    """A model's matrices in eight bits or four, each rounded when it is first needed and then cached.

    directions  of the sites that have them
    """

    def __init__(self, directions: Mapping[Site, Directions] | None = None, format: Format = FP8) -> None:
        self.format = format
        self._directions = directions or {}
        self._rounded: dict[int, tuple[Tensor, RoundedMatrix]] = {}  # with the weight: its id stays its own

    def __call__(self, site: Site, weight: Tensor) -> Tensor:
        if id(weight) not in self._rounded:
            self._rounded[id(weight)] = weight, rounded_matrix(weight, 1.0, self._directions.get(site), self.format)
        return self._rounded[id(weight)][1].dequantized().to(weight.dtype)

    def in_half_sums(self, site: Site, scale: float, weight: Tensor) -> ScaledMatrix:
        """The same, for an input's numbers with this scale."""
        self(site, weight)
        made = self._rounded[id(weight)][1]
        assert isinstance(made, ScaledMatrix), "float16 sums are FP8's"
        return made.for_input(scale).for_half_sums()


@contextmanager
def rounded(
    model: Any, scales: Mapping[Site, float], weights: RoundedWeights | None = None, half_sums: bool = False
) -> Iterator[None]:
    """For a while, matmuls of these sites are of rounded numbers, of the weights' format; with `half_sums` the expert's
    alone have float32 sums.
    """
    rounding = weights or RoundedWeights()
    changes: list[tuple[nn.Linear, Round, MakeMatrix]] = []
    norms: list[tuple[AdaRMSNorm, Round]] = []
    for site, scale in scales.items():
        inputs = input_rounding(site, scale, rounding.format)
        if (norm := norm_of(model, site)) is not None:
            norms.append((norm, inputs))
            inputs = _as_it_is
        of_site: MakeMatrix = partial(rounding, site)
        if half_sums and site.part != "expert":
            inputs, of_site = partial(to_e4m3, inverse=1 / scale), partial(rounding.in_half_sums, site, scale)
        changes += [(linear, inputs, of_site) for linear in linears(model, site)]
    with replaced(changes), replaced_in_norms(norms):
        yield


def input_rounding(site: Site, scale: float, format: Format) -> Round:
    """What becomes of a site's activation."""
    return partial(round_activation, scale=scale, format=format) if format.rounds_input(site.part) else _as_it_is


def multiplied(x: Tensor, weight: Matrix, bias: Tensor | None) -> Tensor:
    """x @ weightᵀ + bias; of a ScaledMatrix x is of its numbers, and the result float32."""
    if not isinstance(weight, ScaledMatrix):
        return F.linear(x, weight, bias)
    return weight.product(x.flatten(0, -2), bias).view(*x.shape[:-1], -1)


def put_product(linear: nn.Linear, inputs: Round, weights: MakeMatrix) -> None:
    """From now on `linear` is of what the two functions make of its input and of its weight."""
    linear.__dict__["forward"] = lambda x: multiplied(inputs(x), weights(linear.weight), linear.bias)


def _as_it_is(x: Tensor) -> Tensor:
    return x


def through_norm(norm: AdaRMSNorm, operand: Round, x: Tensor, cond: Tensor | None) -> tuple[Tensor, Tensor]:
    """The norm in the order in which the denoising kernel computes it, with what `operand` makes of x (1 + scale)."""
    scale, shift, gate = norm.modulation(cond)
    y = operand(x.float() * (1 + scale)) * inverse_rms(x, norm.eps) + shift
    return y.to(x.dtype), gate.to(x.dtype)


def put_into_norm(norm: AdaRMSNorm, operand: Round) -> None:
    """From now on `norm` is `through_norm`."""
    norm.__dict__["forward"] = partial(through_norm, norm, operand)


@contextmanager
def replaced_in_norms(changes: list[tuple[AdaRMSNorm, Round]]) -> Iterator[None]:
    """For a while, these norms are of what the function makes of x (1 + scale)."""
    try:
        for norm, operand in changes:
            put_into_norm(norm, operand)
        yield
    finally:
        for norm, _ in changes:
            norm.__dict__.pop("forward", None)


@contextmanager
def replaced(changes: Sequence[tuple[nn.Linear, Round, MakeMatrix]]) -> Iterator[None]:
    """For a while, these matmuls are of what the two functions make of their input and of their weight."""
    try:
        for change in changes:
            put_product(*change)
        yield
    finally:
        for linear, _, _ in changes:
            linear.__dict__.pop("forward", None)


# -- errors of actions -------------------------------------------------------------------------------------------------


NO_SIGNAL = (
    "the float32 reference's actions, or what denoising did (actions less noise), are zero or constant, so that any "
    "other model would agree. Weights or statistics are missing or damaged"
)


def has_signal(actions: np.ndarray, noise: np.ndarray) -> bool:
    """Whether actions and what denoising did (actions less noise) differ from row to row, both [..., H, d].

    Where they are zero or constant, or NaN, any two models agree: there is nothing to judge by. Float32 rounding alone
    moves sums of the noise's size by 1e-7 of it, so less than 1e-6 counts as constant.
    """
    return all(_spread(values) > 1e-6 * max(_rms(noise), _rms(values)) for values in (actions, actions - noise))


def _spread(values: np.ndarray) -> float:
    rows = values.reshape(-1, values.shape[-1]).astype(np.float64)
    return _rms(rows - rows.mean(axis=0 if len(rows) > 1 else None))


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values, dtype=np.float64))))


def delta_cosine(actions: Tensor, exact: Tensor, noise: Tensor) -> float:
    """Cosine of what denoising did (actions less noise) with what it should have done, over all given rows."""
    ours, theirs = (actions - noise).double().flatten(), (exact - noise).double().flatten()
    return float(torch.dot(ours, theirs) / (ours.norm() * theirs.norm()))


def relative_rms(actions: Tensor, exact: Tensor) -> float:
    """rms of the difference over rms of the exact actions; infinite if anything isn't finite."""
    if not bool(actions.isfinite().all()):
        return float("inf")
    return float((actions - exact).double().norm() / exact.double().norm())
