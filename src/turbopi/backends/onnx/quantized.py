"""FP8 in an exported prefix: standard QuantizeLinear and DequantizeLinear nodes around the MLPs' products.

Weights are stored as E4M3 and dequantised by a scale; activations are quantised and dequantised by theirs. A runtime
without FP8 products computes the same numbers in float32, one with them fuses each pair into its product.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from turbopi.backends.tensorrt.networks import Fp8Scales
from turbopi.backends.tensorrt.ops import to_fp8
from turbopi.support.errors import ConfigError


def quantize_mlps(graph: Any, scales: Sequence[Fp8Scales | None]) -> int:
    """Insert the nodes into an onnx_ir graph of the prefix; returns how many products are FP8 now.

    Scales by layer; None leaves a layer as it is. Raises ConfigError if the graph has another number of MLPs.
    """
    gelus = [node for node in graph.all_nodes() if node.op_type == "Gelu"]
    if len(gelus) != len(scales):
        raise ConfigError(f"the graph has {len(gelus)} MLPs, but there are scales for {len(scales)}")
    for i, (gelu, one) in enumerate(zip(gelus, scales, strict=True)):
        if one is not None:
            _quantize_mlp(graph, gelu, one, f"layers.{i}.mlp")
    return 3 * sum(one is not None for one in scales)


def _quantize_mlp(graph: Any, gelu: Any, scales: Fp8Scales, name: str) -> None:
    gate = gelu.inputs[0].producer()
    product = _only_user(gelu.outputs[0])
    up = next(value for value in product.inputs if value is not gelu.outputs[0]).producer()
    down = _only_user(product.outputs[0])
    assert [node.op_type for node in (gate, up, product, down)] == ["MatMul", "MatMul", "Mul", "MatMul"], name
    assert gate.inputs[0] is up.inputs[0], name
    x = _pair(graph, gate, gate.inputs[0], scales.input, f"{name}.input")
    gate.replace_input_with(0, x)
    up.replace_input_with(0, x)
    down.replace_input_with(0, _pair(graph, down, down.inputs[0], scales.hidden, f"{name}.hidden"))
    for node, scale, part in ((gate, scales.gate, "gate"), (up, scales.up, "up"), (down, scales.down, "down")):
        node.replace_input_with(1, _weight(graph, node, scale, f"{name}.{part}_proj"))


def _pair(graph: Any, before: Any, x: Any, scale: torch.Tensor, name: str) -> Any:
    """x quantised and dequantised, put before a node."""
    import onnx_ir as ir

    factor = _initializer(graph, f"{name}.scale", scale.float().numpy())
    zero = _initializer(graph, f"{name}.zero", _as_e4m3(torch.zeros((), dtype=torch.float8_e4m3fn)))
    quantized = ir.Node("", "QuantizeLinear", [x, factor, zero], name=f"{name}.quantize")
    restored = ir.Node("", "DequantizeLinear", [quantized.outputs[0], factor, zero], name=f"{name}.dequantize")
    for node, dtype, kind in ((quantized, ir.DataType.FLOAT8E4M3FN, "q"), (restored, ir.DataType.FLOAT, "dq")):
        value = node.outputs[0]
        value.name, value.dtype, value.shape = f"{name}.{kind}", dtype, x.shape
    graph.insert_before(before, [quantized, restored])
    return restored.outputs[0]


def _weight(graph: Any, node: Any, scale: torch.Tensor, name: str) -> Any:
    """A product's weight [in, out], stored as E4M3 and dequantised."""
    import onnx_ir as ir

    weight = node.inputs[1]
    assert weight.const_value is not None, name
    stored = to_fp8(torch.from_numpy(np.array(weight.const_value.numpy())), scale)
    value = _initializer(graph, f"{name}.weight", _as_e4m3(stored))
    factor = _initializer(graph, f"{name}.weight_scale", scale.float().numpy())
    restored = ir.Node("", "DequantizeLinear", [value, factor], name=f"{name}.dequantize_weight")
    out = restored.outputs[0]
    out.name, out.dtype, out.shape = f"{name}.weight_dq", ir.DataType.FLOAT, weight.shape
    graph.insert_before(node, restored)
    if len(weight.uses()) == 1:  # this node, whose input is about to be replaced
        graph.initializers.pop(weight.name)
    return out


def _initializer(graph: Any, name: str, array: np.ndarray) -> Any:
    import onnx_ir as ir

    tensor = ir.Tensor(array, name=name)
    value = ir.Value(name=name, shape=tensor.shape, type=ir.TensorType(tensor.dtype), const_value=tensor)
    graph.initializers[name] = value
    return value


def _as_e4m3(x: torch.Tensor) -> np.ndarray:
    import ml_dtypes

    return x.view(torch.uint8).numpy().view(ml_dtypes.float8_e4m3fn)


def _only_user(value: Any) -> Any:
    (use,) = value.uses()
    return use.node if hasattr(use, "node") else use[0]
