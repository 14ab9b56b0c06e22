"""Queries, keys and values that leave their product after RoPE are those of RoPE in a pass of its own."""

from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from emulator import emulate
from test_kernels_emulated import machine, random
from torch import Tensor

pytest.importorskip("triton", reason="Triton isn't installed")

from turbopi.kernels import plain
from turbopi.kernels.portable.quantize import quantize
from turbopi.kernels.sm90 import rope_products
from turbopi.kernels.sm90.gemm.bf16 import Tile, beside_each_other
from turbopi.kernels.sm90.rope_products import QkvProduct, RopeProducts
from turbopi.model.layers import rope_tables
from turbopi.quantization.fp8 import Matrix, to_e4m3

ROWS, HEAD_DIM, INNER = 136, 32, 256
pytestmark = pytest.mark.skipif(emulate.COMPILER is None, reason="no g++ here")
assert machine  # a fixture


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Compiled kernels."""
    return tmp_path_factory.mktemp("emulated")


def turns(rows: int, head_dim: int) -> tuple[Tensor, Tensor]:
    cos, sin = rope_tables(torch.arange(rows)[None], head_dim, 10_000.0)
    return cos[0, 0].contiguous(), sin[0, 0].contiguous()


@pytest.mark.parametrize("heads", [0, 2])
@pytest.mark.parametrize("in_fp8", [False, True], ids=["bf16", "fp8"])
def test_the_product_leaves_what_rope_split_makes_of_it(
    machine: Callable[[int], None], monkeypatch: pytest.MonkeyPatch, heads: int, in_fp8: bool
) -> None:
    columns = (heads + 2) * HEAD_DIM
    monkeypatch.setattr(rope_products, "ROPE_TILES", {(192, columns, INNER): Tile(1, 16, ring=3)})
    wide = random(columns, INNER, seed=1) / INNER**0.5
    weight: Matrix = quantize(wide, 0.02) if in_fp8 else wide
    x = random(ROWS, INNER)
    given = to_e4m3(x, weight.inverse) if not isinstance(weight, Tensor) else x
    cos, sin = turns(ROWS, HEAD_DIM)
    ops = RopeProducts(plain.PLAIN)
    for seed in range(2):
        machine(seed)
        keys, values = (torch.full((ROWS, HEAD_DIM), torch.nan).bfloat16() for _ in range(2))
        product = ops.linear(given, weight)
        assert isinstance(product, QkvProduct)
        queries = ops.rope_split(product, cos, sin, keys, values)
        exact = weight.product(given) if not isinstance(weight, Tensor) else x.float() @ weight.float().T
        wanted_keys, wanted_values = torch.empty(ROWS, HEAD_DIM), torch.empty(ROWS, HEAD_DIM)
        wanted = plain.rope_split(exact, cos, sin, wanted_keys, wanted_values)
        for ours, theirs in ((queries, wanted), (keys, wanted_keys), (values, wanted_values)):
            torch.testing.assert_close(ours.float(), theirs, rtol=1e-2, atol=1e-2)


def test_other_sizes_go_to_the_other_operations() -> None:
    ops, x, weight = RopeProducts(plain.PLAIN), random(4, 16), random(24, 16)
    made = ops.linear(x, weight)
    torch.testing.assert_close(made, plain.linear(x, weight))
    cos, sin = turns(4, 8)
    ours, theirs = ([torch.empty(4, 8).bfloat16() for _ in range(2)] for _ in range(2))
    torch.testing.assert_close(ops.rope_split(made, cos, sin, *ours), plain.rope_split(made, cos, sin, *theirs))
    torch.testing.assert_close(ours, theirs)


def test_rows_that_rope_turns_together_become_neighbours_and_values_stay() -> None:
    order = beside_each_other(12, 4, torch.device("cpu")).tolist()
    assert order == [0, 2, 1, 3, 4, 6, 5, 7, 8, 9, 10, 11]
