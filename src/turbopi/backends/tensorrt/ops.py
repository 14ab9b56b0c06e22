"""The operations that networks are written in, with two implementations of the same interface.

TensorRTOps   records them into a strongly typed TensorRT network: every tensor has the dtype that is written down
TorchOps      computes them at once in PyTorch: the networks' twin, which runs on any CPU

A "value" is whatever the implementation hands out: an ITensor or a torch tensor. Shapes are static, apart from a first
axis of -1 that only element-wise operations and products see.
"""

from collections.abc import Sequence
from typing import Any, Literal, Protocol

import torch
import torch.nn.functional as F
from torch import Tensor

from turbopi.support.errors import BackendUnavailable

Dtype = Literal["f32", "f16", "bf16", "fp8"]
Value = Any
TORCH_DTYPES: dict[str, torch.dtype] = {
    "f32": torch.float32,
    "f16": torch.float16,
    "bf16": torch.bfloat16,
    "fp8": torch.float8_e4m3fn,
}
FP8_MAX = 448.0  # of E4M3


class NetworkOps(Protocol):
    """What a network may be made of."""

    def constant(self, tensor: Tensor, dtype: Dtype) -> Value:
        """A weight."""

    def cast(self, x: Value, dtype: Dtype) -> Value: ...
    def matmul(self, a: Value, b: Value, *, transpose_b: bool = False) -> Value:
        """Over the last two axes; both values have the same dtype, sums are float32 inside."""

    def add(self, a: Value, b: Value) -> Value: ...
    def sub(self, a: Value, b: Value) -> Value: ...
    def mul(self, a: Value, b: Value) -> Value: ...
    def gelu(self, x: Value) -> Value:
        """The tanh form."""

    def rsqrt_mean_square(self, x: Value, eps: float) -> Value:
        """1 / sqrt(mean(x²) + eps) over the last axis, which stays as 1."""

    def mean(self, x: Value) -> Value:
        """Over the last axis, which stays as 1."""

    def softmax(self, x: Value) -> Value:
        """Over the last axis."""

    def attention(self, q: Value, k: Value, v: Value) -> Value:
        """softmax(q kᵀ / √K) v as one fused operation; [B, heads, S, K]."""

    def reshape(self, x: Value, shape: Sequence[int]) -> Value: ...
    def transpose(self, x: Value, order: Sequence[int]) -> Value: ...
    def slice(self, x: Value, axis: int, start: int, stop: int) -> Value: ...
    def concat(self, values: Sequence[Value], axis: int) -> Value: ...
    def quantize(self, x: Value, scale: Tensor, dtype: Dtype) -> Value:
        """x / scale rounded to E4M3 and saturated, then times scale again in `dtype` (one quantise/dequantise pair)."""

    def dequantize_constant(self, tensor: Tensor, scale: Tensor, dtype: Dtype) -> Value:
        """A weight stored as E4M3 with a scalar scale, as a value in `dtype`."""

    def shape(self, x: Value) -> tuple[int, ...]: ...


def to_fp8(x: Tensor, scale: Tensor) -> Tensor:
    """x / scale as E4M3, saturated: PyTorch's own conversion turns what is too large into NaN."""
    return (x.float() / scale).clamp(-FP8_MAX, FP8_MAX).to(torch.float8_e4m3fn)


class TorchOps:
    """Values are torch tensors."""

    def __init__(self, device: torch.device | str = "cpu") -> None:
        self.device = device

    def constant(self, tensor: Tensor, dtype: Dtype) -> Tensor:
        return tensor.to(self.device, TORCH_DTYPES[dtype])

    def cast(self, x: Tensor, dtype: Dtype) -> Tensor:
        return x.to(TORCH_DTYPES[dtype])

    def matmul(self, a: Tensor, b: Tensor, *, transpose_b: bool = False) -> Tensor:
        return a @ (b.transpose(-1, -2) if transpose_b else b)

    def add(self, a: Tensor, b: Tensor) -> Tensor:
        return a + b

    def sub(self, a: Tensor, b: Tensor) -> Tensor:
        return a - b

    def mul(self, a: Tensor, b: Tensor) -> Tensor:
        return a * b

    def gelu(self, x: Tensor) -> Tensor:
        return F.gelu(x, approximate="tanh")

    def rsqrt_mean_square(self, x: Tensor, eps: float) -> Tensor:
        return torch.rsqrt(x.square().mean(-1, keepdim=True) + eps)

    def mean(self, x: Tensor) -> Tensor:
        return x.mean(-1, keepdim=True)

    def softmax(self, x: Tensor) -> Tensor:
        return x.softmax(-1)

    def attention(self, q: Tensor, k: Tensor, v: Tensor) -> Tensor:
        return F.scaled_dot_product_attention(q, k, v)

    def reshape(self, x: Tensor, shape: Sequence[int]) -> Tensor:
        return x.reshape(*shape)

    def transpose(self, x: Tensor, order: Sequence[int]) -> Tensor:
        return x.permute(*order)

    def slice(self, x: Tensor, axis: int, start: int, stop: int) -> Tensor:
        return x.narrow(axis, start, stop - start)

    def concat(self, values: Sequence[Tensor], axis: int) -> Tensor:
        return torch.cat(list(values), dim=axis)

    def quantize(self, x: Tensor, scale: Tensor, dtype: Dtype) -> Tensor:
        scale = scale.to(x.device)
        return (to_fp8(x, scale).float() * scale).to(TORCH_DTYPES[dtype])

    def dequantize_constant(self, tensor: Tensor, scale: Tensor, dtype: Dtype) -> Tensor:
        return (tensor.to(self.device).float() * scale.to(self.device)).to(TORCH_DTYPES[dtype])

    def shape(self, x: Tensor) -> tuple[int, ...]:
        return tuple(x.shape)


class TensorRTOps:
    """Values are ITensors of `network`. Weights are kept alive in `kept` until the engine is built."""

    def __init__(self, trt: Any, network: Any) -> None:
        self.trt, self.network = trt, network
        self.kept: list[Tensor] = []
        self.dtypes = {"f32": trt.float32, "f16": trt.float16, "bf16": trt.bfloat16, "fp8": trt.fp8}

    def constant(self, tensor: Tensor, dtype: Dtype) -> Value:
        host = tensor.detach().to("cpu", TORCH_DTYPES[dtype]).contiguous()
        self.kept.append(host)
        weights = self.trt.Weights(self.dtypes[dtype], host.data_ptr(), host.numel())
        return self._output(self.network.add_constant(tuple(host.shape), weights), "constant")

    def cast(self, x: Value, dtype: Dtype) -> Value:
        return (
            x if x.dtype == self.dtypes[dtype] else self._output(self.network.add_cast(x, self.dtypes[dtype]), "cast")
        )

    def matmul(self, a: Value, b: Value, *, transpose_b: bool = False) -> Value:
        none, transposed = self.trt.MatrixOperation.NONE, self.trt.MatrixOperation.TRANSPOSE
        layer = self.network.add_matrix_multiply(a, none, b, transposed if transpose_b else none)
        return self._output(layer, "matmul")

    def add(self, a: Value, b: Value) -> Value:
        return self._elementwise(a, b, self.trt.ElementWiseOperation.SUM)

    def sub(self, a: Value, b: Value) -> Value:
        return self._elementwise(a, b, self.trt.ElementWiseOperation.SUB)

    def mul(self, a: Value, b: Value) -> Value:
        return self._elementwise(a, b, self.trt.ElementWiseOperation.PROD)

    def gelu(self, x: Value) -> Value:
        return self._output(self.network.add_activation(x, self.trt.ActivationType.GELU_TANH), "gelu")

    def rsqrt_mean_square(self, x: Value, eps: float) -> Value:
        mean = self.mean(self.mul(x, x))
        shifted = self.add(mean, self.constant(torch.full([1] * len(x.shape), eps), "f32"))
        root = self._output(self.network.add_unary(shifted, self.trt.UnaryOperation.SQRT), "sqrt")
        return self._output(self.network.add_unary(root, self.trt.UnaryOperation.RECIP), "reciprocal")

    def mean(self, x: Value) -> Value:
        axes = 1 << (len(x.shape) - 1)
        return self._output(self.network.add_reduce(x, self.trt.ReduceOperation.AVG, axes, True), "mean")

    def softmax(self, x: Value) -> Value:
        layer = self.network.add_softmax(x)
        layer.axes = 1 << (len(x.shape) - 1)
        return self._output(layer, "softmax")

    def attention(self, q: Value, k: Value, v: Value) -> Value:
        if not hasattr(self.network, "add_attention"):
            raise BackendUnavailable(
                "this TensorRT has no attention layer; it needs TensorRT 10.14 or TensorRT-RTX 1.2"
            )
        dtype = next(name for name, value in self.dtypes.items() if value == q.dtype)
        scale = torch.full((1, 1, 1, 1), q.shape[-1] ** -0.5)  # the layer doesn't scale
        q = self.mul(q, self.constant(scale, dtype))  # type: ignore[arg-type]
        layer = self.network.add_attention(q, k, v, self.trt.AttentionNormalizationOp.SOFTMAX, False)
        layer.decomposable = True  # where there is no fused kernel; otherwise the build fails
        return self._output(layer, "attention")

    def reshape(self, x: Value, shape: Sequence[int]) -> Value:
        layer = self.network.add_shuffle(x)
        layer.reshape_dims = tuple(shape)
        return self._output(layer, "reshape")

    def transpose(self, x: Value, order: Sequence[int]) -> Value:
        layer = self.network.add_shuffle(x)
        layer.first_transpose = tuple(order)
        return self._output(layer, "transpose")

    def slice(self, x: Value, axis: int, start: int, stop: int) -> Value:
        begin, size = [0] * len(x.shape), list(x.shape)
        begin[axis], size[axis] = start, stop - start
        return self._output(self.network.add_slice(x, begin, size, [1] * len(size)), "slice")

    def concat(self, values: Sequence[Value], axis: int) -> Value:
        layer = self.network.add_concatenation(list(values))
        layer.axis = axis
        return self._output(layer, "concatenation")

    def quantize(self, x: Value, scale: Tensor, dtype: Dtype) -> Value:
        given = next(name for name, value in self.dtypes.items() if value == x.dtype)
        layer = self.network.add_quantize(x, self.constant(scale, given), self.trt.fp8)  # type: ignore[arg-type]
        return self._dequantized(self._output(layer, "quantise"), scale, dtype)

    def dequantize_constant(self, tensor: Tensor, scale: Tensor, dtype: Dtype) -> Value:
        return self._dequantized(self.constant(tensor, "fp8"), scale, dtype)

    def shape(self, x: Value) -> tuple[int, ...]:
        return tuple(x.shape)

    def _dequantized(self, x: Value, scale: Tensor, dtype: Dtype) -> Value:
        layer = self.network.add_dequantize(x, self.constant(scale, dtype), self.dtypes[dtype])
        return self._output(layer, "dequantise")

    def _elementwise(self, a: Value, b: Value, operation: Any) -> Value:
        return self._output(self.network.add_elementwise(a, b, operation), "element-wise operation")

    @staticmethod
    def _output(layer: Any, what: str) -> Value:
        assert layer is not None, f"TensorRT refused a {what}; its log says why"
        return layer.get_output(0)
