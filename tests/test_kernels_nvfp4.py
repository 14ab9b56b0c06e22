"""NVFP4's kernels beside the emulation: exact where numbers are rounded, to float32's rounding where they are added.

In the interpreter the product decodes the same bytes. On a GPU that has the instruction `turbopi doctor --qualify`
compares the same.
"""

from dataclasses import replace

import pytest
import torch
import torch.nn.functional as F
from conftest import gpu_or_interpreter
from torch import Tensor

pytest.importorskip("triton", reason="Triton isn't installed")

from turbopi.kernels import plain
from turbopi.kernels.portable import nvfp4 as kernels
from turbopi.kernels.portable.gemm.tiles import nvfp4_refusal
from turbopi.kernels.portable.ops import portable_ops
from turbopi.quantization import nvfp4
from turbopi.quantization.nvfp4 import BLOCK, Nvfp4Matrix

DEVICE = torch.device("cuda" if torch.cuda.is_available() else "cpu")
pytestmark = gpu_or_interpreter()
WITHOUT = torch.cuda.is_available() and nvfp4_refusal(torch.cuda.get_device_capability()) is not None
where_it_is = pytest.mark.skipif(WITHOUT, reason="this GPU hasn't the instruction")


def random(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed)).to(DEVICE)


@pytest.mark.parametrize(("rows", "inner"), [(6, 16), (3, 1152), (130, 4304)])
@pytest.mark.parametrize("scale", [1e-6, 0.003, 0.3])
def test_an_activation_is_rounded_exactly(rows: int, inner: int, scale: float) -> None:
    x = random(rows, inner) * torch.exp2(8 * random(rows, 1, seed=1))
    x[0, :16] = 0
    x[1, 5], x[2, 9] = float("nan"), float("-inf")
    x = x.bfloat16()
    codes, blocks = kernels.round_activation(x, scale)
    expected = nvfp4.block_scales(x, scale)
    count = inner // BLOCK
    assert torch.equal(blocks.view(torch.uint8)[:, :count], expected.view(torch.uint8))
    assert torch.equal(codes[:, : inner // 2], nvfp4.pack(nvfp4.round_blocks(x, scale, expected)))
    assert not codes[:, inner // 2 :].any() and not blocks.view(torch.uint8)[:, count:].any()


def activated(epilogue: str, product: Tensor) -> Tensor:
    return {"plain": lambda x: x, "gelu": plain.gelu, "geglu": plain.geglu}[epilogue](product)


@where_it_is
@pytest.mark.parametrize(
    ("epilogue", "rows", "inner", "out"),
    [("plain", 5, 48, 40), ("gelu", 130, 144, 200), ("geglu", 20, 256, 136), ("geglu", 3, 128, 40)],
)
def test_a_product_is_the_emulations(epilogue: kernels.Epilogue, rows: int, inner: int, out: int) -> None:
    weight = random(2 * out if epilogue == "geglu" else out, inner) / 8
    bias = None if epilogue == "geglu" else random(out, seed=1)
    matrix = replace(Nvfp4Matrix.of(weight, 0.002), dtype=torch.float32)
    x = random(rows, inner, seed=2).bfloat16()
    x[2, 3] = float("nan")
    exact = activated(epilogue, matrix.product(x, bias))
    found = kernels.product(x, matrix, epilogue, bias)
    assert found[2].isnan().all() and not found[[0, 1]].isnan().any()
    torch.testing.assert_close(
        found, exact, rtol=1e-5, atol=1e-6 * float(exact.nan_to_num().abs().max()), equal_nan=True
    )


@where_it_is
def test_operations_take_it_beside_other_matrices() -> None:
    ops, x, weight, bias = kernels.in_nvfp4(portable_ops()), *(random(*one) for one in ((4, 64), (32, 64), (32,)))
    x, weight, bias = x.bfloat16(), weight.bfloat16(), bias.bfloat16()
    matrix = Nvfp4Matrix.of(weight, 0.002)
    for name in ("linear", "residual_linear", "linear_gelu", "linear_geglu"):
        given = () if name == "linear_geglu" else (bias,)
        found, exact = (getattr(some, name)(x, matrix, *given) for some in (ops, plain.PLAIN))
        assert found.dtype == exact.dtype == torch.bfloat16
        assert float((found - exact).float().norm() / exact.float().norm()) < 0.01
    assert torch.equal(ops.residual_linear(x, weight, bias), F.linear(x, weight, bias))
    out = torch.empty(4, 32, dtype=torch.bfloat16, device=DEVICE)
    assert ops.linear(x, matrix, bias, out) is out


@pytest.mark.parametrize("capability", [(8, 0), (8, 9), (9, 0)])
def test_other_gpus_are_refused_by_their_number(capability: tuple[int, int]) -> None:
    why = nvfp4_refusal(capability)
    assert why is not None and f"this GPU has {capability[0]}.{capability[1]}" in why
