"""The way back's products in CUDA (kernels/sm90/vjp), thread by thread on a CPU and on a GPU, against their twins."""

from pathlib import Path
from typing import Any

import pytest
import torch
from conftest import on_hopper
from emulator import emulate
from torch import Tensor

pytest.importorskip("triton", reason="Triton isn't installed")

from turbopi.config import GemmaConfig
from turbopi.kernels.backward import PLAIN_BACKWARD
from turbopi.kernels.portable.vjp.ops import BETWEEN_PRODUCTS, FEW_TOKENS
from turbopi.kernels.sm90.vjp import products
from turbopi.kernels.sm90.vjp.products import ACROSS, TAKES, Cut, Mode, backward_form, cut

FULL = GemmaConfig(1024, 4096)


def given(mode: Mode, tokens: int, inner: int, columns: int, device: str) -> tuple[Tensor, Tensor, Tensor]:
    """x, weights; what GeGLU was of, with numbers where tanh is flat."""
    gen = torch.Generator(device).manual_seed(tokens + columns)

    def random(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=gen, device=device)

    product = random(tokens, 2 * columns)
    product[0, 0], product[0, 1] = 30, -30
    x, weights = random(tokens, inner), random(inner, columns) / inner**0.5
    return x.bfloat16(), weights.bfloat16(), product.bfloat16()


def exact(mode: Mode, x: Tensor, weights: Tensor, product: Tensor) -> Tensor:
    x, weights, product = x.double(), weights.double(), product.double()
    if mode == "geglu":
        return PLAIN_BACKWARD.down_vjp(x, weights, product).double()
    return x @ weights


@pytest.mark.slow
@pytest.mark.skipif(emulate.COMPILER is None, reason="no g++ here")
@pytest.mark.parametrize("seed", [0, 5])
@pytest.mark.parametrize(
    ("mode", "tokens", "inner", "one"),
    [
        *(("plain", 10, 512, Cut(512, 16)), ("plain", 16, 1024, Cut(1024, 32))),
        *(("geglu", 10, 512, Cut(512, 32)), ("geglu", 1, 512, Cut(512, 64))),
        *(("parts", 13, 1024, Cut(512, 64)), ("plain", 3, 512, Cut(512, 64))),
    ],
)  # fmt: skip
def test_on_a_cpu_it_is_the_product(mode: Mode, tokens: int, inner: int, one: Cut, seed: int, tmp_path: Path) -> None:
    columns = 2 * one.columns
    x, weights, product = given(mode, tokens, inner, columns, "cpu")
    parts = inner // one.depth
    shape = (parts, tokens, columns) if mode == "parts" else (tokens, columns * (2 if mode == "geglu" else 1))
    out = torch.full(shape, torch.nan, dtype=torch.float32 if mode == "parts" else torch.bfloat16)
    library = emulate.compiled(products.source(), "turbopi_across", TAKES, one.sizes(mode), tmp_path)
    values: dict[str, Any] = {"tokens": tokens, "inner": inner, "columns": columns}
    values |= {"x": x.data_ptr(), "weights": weights.data_ptr(), "product": product.data_ptr(), "out": out.data_ptr()}
    emulated = emulate.EmulatedKernel(library, TAKES, products.WARPS * 32, 1, 1, seed)
    emulated.launch_dependent(2 * parts, values)
    right = exact(mode, x, weights, product)
    if mode == "parts":
        by_part = [slice(i * one.depth, (i + 1) * one.depth) for i in range(parts)]
        right = torch.stack([x[:, at].double() @ weights[at].double() for at in by_part])
    rounding = 1e-5 if mode == "parts" else 2**-8
    torch.testing.assert_close(out.double(), right, rtol=rounding, atol=1e-5)


def test_the_full_models_products_fill_a_hopper_gpu_once() -> None:
    for tokens in (1, 10, 16):
        for mode, inner, columns in (("plain", 1024, 2048), ("geglu", 1024, 4096), ("parts", 8192, 1024)):
            one = cut(mode, tokens, inner, columns)
            blocks = 64 if mode == "plain" else 128  # attention's way back, behind the first, begins on the others
            assert one is not None and columns // one.columns * (inner // one.depth) == blocks
            assert one.shared_bytes <= 129 * 1024, "beside the next kernel's"


def test_other_sizes_and_more_tokens_keep_other_kernels() -> None:
    assert backward_form(FULL, 10) is ACROSS and backward_form(FULL, 17) is FEW_TOKENS is backward_form(FULL, 64)
    assert backward_form(FULL, 65) is BETWEEN_PRODUCTS and backward_form(FULL, 10, masked=True) is BETWEEN_PRODUCTS
    for mode in ("plain", "geglu", "parts"):
        assert cut(mode, 10, 96, 64) is None and cut(mode, 10, 512, 24) is None and cut(mode, 17, 1024, 64) is None


@on_hopper
@pytest.mark.parametrize("tokens", [1, 10, 16])
@pytest.mark.parametrize("name", ["down_vjp", "out_vjp", "gate_up_vjp"])
def test_on_a_gpu_it_is_as_exact_as_tritons(name: str, tokens: int) -> None:
    modes: dict[str, tuple[Mode, int, int]] = {
        "down_vjp": ("geglu", 1024, 4096),
        "out_vjp": ("plain", 1024, 2048),
        "gate_up_vjp": ("parts", 8192, 1024),
    }
    mode, inner, columns = modes[name]
    x, weights, product = given(mode, tokens, inner, columns, "cuda")
    arguments = (x, weights, product) if mode == "geglu" else (x, weights)
    right, errors = exact(mode, x, weights, product), []
    for ops in (ACROSS, FEW_TOKENS):
        found = getattr(ops, name)(*arguments)
        found = found.sum(0) if found.dim() == 3 else found
        errors.append(float((found.double() - right).norm() / right.norm()))
    assert errors[0] <= 1.05 * errors[1] + 1e-6
