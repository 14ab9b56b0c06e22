"""What benches of products share, portable and Hopper's: weights that take turns, their twin, the norms around them.

A norm that is a kernel of its own is timed with the product, in front or behind, so microseconds include it:
  - behind, it adds up a product's parts, so their number makes it slower or faster;
  - in front, it keeps a product from starting while the one before still runs, as two products in a row would.
"""

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from turbopi.kernels import plain
from turbopi.kernels.portable import norms
from turbopi.kernels.portable.quantize import quantize
from turbopi.kernels.tile_table import Knobs
from turbopi.quantization.fp8 import Matrix, ScaledMatrix, to_e4m3
from turbopi.tune.gpu import INVERSE, GpuBench, cold_copies
from turbopi.tune.shapes import Norm, Operation

EPS = 1e-6


@dataclass(frozen=True)
class StreamNorm:
    """The norm of stream + y by the kernel that a call runs."""

    kind: Norm
    stream: Tensor  # bfloat16[rows, width]
    scale: Tensor  # [width]
    shift: Tensor  # [width], of a LayerNorm
    inverse: float | None  # of a result in E4M3
    layer_norm: Callable[..., tuple[Tensor, Tensor]]

    def __call__(self, y: Tensor | None) -> Tensor:
        """y: [rows, width], or a product's parts of it; None: the stream has it already."""
        if self.kind == "layer":
            return self.layer_norm(self.stream, y, self.scale, self.shift, EPS, self.inverse)[1]
        return norms.residual_rms_norm(self.stream, y, None, self.scale, None, EPS, self.inverse)[1]


class ProductBench(GpuBench):
    """x @ weightᵀ with its epilogue, and the norms around it. A subclass makes `exact` and `reference_error`."""

    def __init__(self, operation: Operation, device: torch.device, input_scale: float) -> None:
        """input_scale: of E4M3 inputs."""
        super().__init__(operation, device)
        one, self.fp8 = operation, operation.numbers == "fp8"
        rows = one.columns * (2 if one.operation == "geglu" else 1)
        weight = self.random(rows, one.inner) / one.inner**0.5
        self.bias = self.random(one.columns) if one.bias else None
        self.inverse = INVERSE if one.out_fp8 else None
        first: Matrix = quantize(weight, input_scale) if self.fp8 else weight
        self.copies = cold_copies(weight.numel() * (1 if self.fp8 else 2), device)
        self.weights = [first, *(copied(first) for _ in range(self.copies - 1))]
        inverse = first.inverse if isinstance(first, ScaledMatrix) else None
        self.norm_in_front = self._norm(one.norm_in_front, one.inner, inverse)
        self.norm_behind = self._norm(one.norm_behind, one.columns, INVERSE if self.fp8 else None)
        self.raw = self.random(one.rows, one.inner)  # what the norm in front adds to its stream; without one, the input
        self.x = self.raw if inverse is None else to_e4m3(self.raw, inverse)
        self.x = self.in_front()

    @abstractmethod
    def run(self, knobs: Knobs, copy: int, out: Tensor | None = None, x: Tensor | None = None) -> Tensor:
        """x: what is multiplied, instead of the bench's own."""

    def in_call(self, knobs: Knobs, copy: int) -> object:
        return self.behind(self.run(knobs, copy, x=self.in_front()))

    def in_front(self) -> Tensor:
        """The input, made by the norm in front if there is one."""
        return self.x if self.norm_in_front is None else self.norm_in_front(self.raw)

    def behind(self, result: Tensor) -> Tensor:
        """What the norm behind makes of the result, which is the stream itself where that was added to."""
        if self.norm_behind is None or self.operation.operation == "residual":
            return result
        return self.norm_behind(None if result is self.norm_behind.stream else result)

    def reference(self, x: Tensor, weight: Matrix) -> Tensor:
        """The plain operation."""
        if self.operation.operation == "geglu":
            return plain.linear_geglu(x, weight, self.inverse)
        if self.operation.operation == "gelu" and self.bias is not None:
            return plain.linear_gelu(x, weight, self.bias, self.inverse)
        return plain.linear(x, weight, self.bias)

    def _norm(self, kind: Norm | None, width: int, inverse: float | None) -> StreamNorm | None:
        if kind is None:
            return None
        scale, shift = self.random(width), self.random(width)
        if kind == "rms":
            scale = scale.float()  # as the engine has it
        return StreamNorm(kind, self.random(self.operation.rows, width), scale, shift, inverse, self.layer_norm)

    def layer_norm(self, *given: Any) -> tuple[Tensor, Tensor]:
        """The kernel that a call runs, in place of `plain.residual_layer_norm`."""
        return norms.residual_layer_norm(*given)


def activated(operation: str, sums: Tensor) -> Tensor:
    """float32[rows, columns] of a product's sums."""
    return plain.gelu(sums) if operation == "gelu" else plain.geglu(sums) if operation == "geglu" else sums


def copied(matrix: Matrix) -> Matrix:
    return replace(matrix, data=matrix.data.clone()) if isinstance(matrix, ScaledMatrix) else matrix.clone()
