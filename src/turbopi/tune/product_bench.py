"""What benches of products share, portable and Hopper's: weights that take turns, their twin, the norm behind them."""

from dataclasses import replace

import torch
from torch import Tensor

from turbopi.kernels import plain
from turbopi.kernels.portable import norms
from turbopi.kernels.portable.quantize import quantize
from turbopi.quantization.fp8 import Matrix, ScaledMatrix
from turbopi.tune.gpu import INVERSE, GpuBench, cold_copies
from turbopi.tune.shapes import Operation

EPS = 1e-6


class ProductBench(GpuBench):
    """x @ weightᵀ with its epilogue, and the norm that adds parts up. A subclass makes x, `exact` and `twin_error`."""

    x: Tensor

    def __init__(self, operation: Operation, device: torch.device, input_scale: float) -> None:
        """input_scale: of E4M3 inputs."""
        super().__init__(operation, device)
        one, self.fp8 = operation, operation.numbers == "fp8"
        rows = one.columns * (2 if one.operation == "geglu" else 1)
        weight = self.random(rows, one.inner) / one.inner**0.5
        self.bias = self.random(one.columns) if one.bias else None
        self.inverse = INVERSE if one.out_fp8 else None
        self.stream = self.random(one.rows, one.columns) if one.norm_behind else None
        self.scale = torch.ones(one.columns, device=device)
        self.norm = self.random(one.columns), self.random(one.columns)
        first: Matrix = quantize(weight, input_scale) if self.fp8 else weight
        self.copies = cold_copies(weight.numel() * (1 if self.fp8 else 2), device)
        self.weights = [first, *(_clone(first) for _ in range(self.copies - 1))]

    def twin(self, x: Tensor, weight: Matrix) -> Tensor:
        """The plain operation."""
        if self.operation.operation == "geglu":
            return plain.linear_geglu(x, weight, self.inverse)
        if self.operation.operation == "gelu" and self.bias is not None:
            return plain.linear_gelu(x, weight, self.bias, self.inverse)
        return plain.linear(x, weight, self.bias)

    def behind(self, result: Tensor) -> object:
        one, inverse = self.operation, INVERSE if self.fp8 else None
        if self.stream is None or one.operation == "residual":  # which has added the stream itself
            return result
        if one.norm_behind == "layer":
            return norms.residual_layer_norm(self.stream, result, *self.norm, EPS, inverse)
        return norms.residual_rms_norm(self.stream, result, None, self.scale, None, EPS, inverse)


def activated(operation: str, sums: Tensor) -> Tensor:
    """float32[rows, columns] of a product's sums."""
    return plain.gelu(sums) if operation == "gelu" else plain.geglu(sums) if operation == "geglu" else sums


def _clone(matrix: Matrix) -> Matrix:
    return replace(matrix, data=matrix.data.clone()) if isinstance(matrix, ScaledMatrix) else matrix.clone()
