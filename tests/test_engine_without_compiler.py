"""What differs by device, dtype or rows; the whole is tested where the engine is."""

import pytest
import torch
from torch import Tensor

from turbopi.engine.without_compiler import FEW, OPS, linear_geglu, matmul
from turbopi.kernels.plain import PLAIN

NO_GPU = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
DEVICES = ["cpu", pytest.param("cuda", marks=[pytest.mark.gpu, NO_GPU])]
BOTH = pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16], ids=["f32", "bf16"])


@pytest.fixture(params=DEVICES)
def g(request: pytest.FixtureRequest) -> torch.Generator:
    return torch.Generator(request.param).manual_seed(1)


def randn(g: torch.Generator, *size: int, dtype: torch.dtype = torch.float32) -> Tensor:
    return torch.randn(size, generator=g, device=g.device).to(dtype)


def close(a: Tensor, b: Tensor, dtype: torch.dtype) -> None:
    tolerance = 1e-5 if dtype == torch.float32 else 2e-2
    torch.testing.assert_close(a, b, atol=tolerance, rtol=tolerance)


@BOTH
def test_products_keep_their_sums_and_change_what_they_start_from(dtype: torch.dtype, g: torch.Generator) -> None:
    a, weight, start = randn(g, 7, 64, dtype=dtype), randn(g, 96, 64, dtype=dtype) / 8, randn(g, 7, 96)
    start[:, 5] = -torch.inf
    exact, given = a.float() @ weight.float().t(), start.clone()
    close(matmul(a, weight), exact, torch.float32)
    assert matmul(a, weight, given, alpha=0.25) is given
    close(given, start + exact / 4, torch.float32)


@BOTH
@pytest.mark.parametrize("rows", [5, FEW + 1])
def test_mlps_equal_plain(rows: int, dtype: torch.dtype, g: torch.Generator) -> None:
    x, weight, bias = randn(g, rows, 32, dtype=dtype), randn(g, 128, 32, dtype=dtype) / 4, randn(g, 128, dtype=dtype)
    close(linear_geglu(x, weight, None), PLAIN.linear_geglu(x, weight), dtype)
    close(OPS.linear_gelu(x, weight, bias), PLAIN.linear_gelu(x, weight, bias), dtype)
