"""NVFP4's numbers and matrices, on a CPU."""

import pytest
import torch
from torch import Tensor

from turbopi.quantization import nvfp4
from turbopi.quantization.directions import directions
from turbopi.quantization.fp8 import E4M3
from turbopi.quantization.nvfp4 import BLOCK, E2M1, NVFP4_MAX, Nvfp4Matrix, round_e2m1, round_nvfp4


def random(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed))


def by_hand(x: Tensor) -> Tensor:
    """The format's definition, block by block, nearest by search."""
    whole, numbers = x.abs().max() / NVFP4_MAX, torch.tensor(E2M1)
    found = torch.zeros_like(x)
    for row in range(len(x)):
        for at in range(0, x.shape[1], BLOCK):
            block = x[row, at : at + BLOCK]
            scale = (block.abs().max() / 6 * (1 / whole)).clamp(max=448).to(E4M3).float() * whole
            if scale > 0:
                nearest = (block.abs()[:, None] / scale - numbers).abs().argmin(1)
                found[row, at : at + BLOCK] = block.sign() * numbers[nearest] * scale
    return found


def test_e2m1_rounds_to_its_numbers_and_halves_to_even() -> None:
    numbers = torch.tensor(E2M1)
    assert torch.equal(round_e2m1(numbers), numbers)
    halves = torch.tensor([0.25, 0.75, 1.25, 1.75, 2.5, 3.5, 5.0, 7.0, -0.75])
    assert round_e2m1(halves).tolist() == [0, 1, 1, 2, 2, 4, 4, 6, -1]
    x = torch.rand(1000, generator=torch.Generator().manual_seed(0)) * 6
    nearest = (x[:, None] - numbers).abs().amin(1)
    assert torch.equal((round_e2m1(x) - x).abs(), nearest)


def test_blocks_of_sixteen_have_scales() -> None:
    x = random(8, 64)
    x[:, :16] *= 1000
    x[3, 32:48] = 0
    assert torch.equal(round_nvfp4(x), by_hand(x))
    error = (round_nvfp4(x) - x).view(8, 4, 16).norm(dim=-1) / x.view(8, 4, 16).norm(dim=-1).clamp(min=1e-9)
    assert 0.05 < float(error.mean()) < float(error.max()) < 0.2
    assert torch.equal(round_nvfp4(torch.zeros(2, 32)), torch.zeros(2, 32))


def test_two_numbers_are_packed_into_a_byte_the_first_one_low() -> None:
    numbers = torch.tensor([*E2M1, *(-one for one in E2M1)])
    packed = nvfp4.pack(numbers)
    assert packed.tolist() == [16 * (2 * i + 1) + 2 * i for i in range(8)]  # codes 0 to 15, of E2M1's bits
    assert torch.equal(nvfp4.unpack(packed), numbers)


@pytest.mark.parametrize(("rows", "inner"), [(5, 16), (12, 144), (3, 4304 // 16)])
@pytest.mark.parametrize("known", [False, True])
def test_a_matrix_holds_what_the_study_rounds_to(rows: int, inner: int, known: bool) -> None:
    inner = inner // BLOCK * BLOCK
    weight, common = random(rows, inner).bfloat16(), directions(random(200, inner, seed=1)) if known else None
    matrix = Nvfp4Matrix.of(weight, 0.01, common)
    assert torch.equal(matrix.dequantized().bfloat16(), round_nvfp4(weight, common))
    assert matrix.shape == weight.shape and matrix.codes.shape[1] % 64 == 0
    assert torch.equal(matrix[1:3].dequantized(), matrix.dequantized()[1:3])
    assert not Nvfp4Matrix.of(0 * weight, 0.01).dequantized().any()


def test_joined_tensors_keep_their_own_scales() -> None:
    one, other = random(8, 32), random(24, 32, seed=1) / 900
    joined = Nvfp4Matrix.of(torch.cat((one, other)), 0.01, parts=[8, 24])
    assert torch.equal(joined.dequantized(), torch.cat((round_nvfp4(one), round_nvfp4(other))))


def test_a_product_is_that_of_the_numbers() -> None:
    weight, x, bias = random(24, 80), random(7, 80, seed=1), random(24, seed=2)
    exact = nvfp4.held(x, 0.002).double() @ round_nvfp4(weight).double().T + bias
    torch.testing.assert_close(Nvfp4Matrix.of(weight, 0.002).product(x, bias).double(), exact, rtol=1e-5, atol=1e-5)


def test_errors_of_weights_cancel_where_activations_lie() -> None:
    weight, common = random(20, 64) / 50, random(4, 64, seed=7)
    common[:, [5, 20, 33]] *= 20
    seen = random(200, 4, seed=1) @ common + 0.3 * random(200, 64, seed=2)
    exact = seen @ weight.T
    spared, nearest = (float((seen @ round_nvfp4(weight, one).T - exact).norm()) for one in (directions(seen), None))
    assert spared < 0.3 * nearest


def test_damage_is_a_nan_in_the_rows_scale_and_what_is_too_large_saturates() -> None:
    x = random(4, 64)
    x[1, 20], x[2, 40] = float("nan"), float("-inf")
    held = nvfp4.held(x, 0.001)
    assert held.isnan().sum(1).tolist() == [0, BLOCK, 0, 0] and not held.isinf().any()
    assert float(held[2, 40]) == pytest.approx(-NVFP4_MAX * 0.001)
    product = Nvfp4Matrix.of(random(8, 64), 0.001).product(x)
    assert product.isnan().all(1).tolist() == [False, True, False, False] and product.isnan().sum() == 8
    assert Nvfp4Matrix.of(torch.full((2, 32), torch.nan), 0.1).dequantized().isnan().all()
