"""LayerNorm of many rows: a warp for each, run on a CPU thread by thread, and on a GPU."""

from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from conftest import on_hopper
from emulator import emulate
from emulator.emulate import Machine
from torch import Tensor

pytest.importorskip("triton", reason="Triton isn't installed")

from turbopi.kernels import plain
from turbopi.kernels.sm90.norms import layer_norm

EPS, INVERSE = 1e-6, 20.0


@pytest.fixture
def machine(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Machine]:
    if emulate.COMPILER is None:
        pytest.skip("no g++ here")
    monkeypatch.setattr(layer_norm, "ROWS", 1)
    made = Machine((layer_norm,), tmp_path, monkeypatch, lambda defines: 99)
    yield made
    made(0)


def inputs(rows: int, width: int, device: str, with_y: bool) -> tuple[Tensor, Tensor | None, Tensor, Tensor]:
    """The stream, whose mean is far from zero, what is added to it, the norm's weight and bias."""
    generator = torch.Generator().manual_seed(rows + width)

    def random(*shape: int) -> Tensor:
        return torch.randn(shape, generator=generator).bfloat16().to(device)

    return random(rows, width) + 3, random(rows, width) if with_y else None, random(width), random(width)


def check(rows: int, width: int, with_y: bool, inverse: float | None, device: str) -> None:
    x, y, weight, bias = inputs(rows, width, device, with_y)
    total, normed = layer_norm.residual_layer_norm(x, y, weight, bias, EPS, inverse)
    expected, wanted = plain.residual_layer_norm(x, y, weight, bias, EPS, inverse)
    assert torch.equal(total, expected) and normed.dtype == wanted.dtype
    error = (normed.float() - wanted.float()).norm() / wanted.float().norm()
    assert error < (2e-3 if inverse is None else 1e-2), "they differ where a sum is close to the middle of two numbers"


@pytest.mark.slow
@pytest.mark.parametrize("width", [1152, 256, 40])
@pytest.mark.parametrize("with_y", [False, True])
@pytest.mark.parametrize("inverse", [None, INVERSE])
def test_a_norm_is_its_twin(machine: Machine, width: int, with_y: bool, inverse: float | None) -> None:
    """Of rows that don't fill the last block, and that don't fill a warp's lanes."""
    machine(1)
    check(7, width, with_y, inverse, "cpu")


@on_hopper
@pytest.mark.parametrize(("rows", "width"), [(1024, 1152), (4093, 1152), (8192, 1152), (1030, 2048)])
@pytest.mark.parametrize("with_y", [False, True])
@pytest.mark.parametrize("inverse", [None, INVERSE])
def test_a_norm_is_its_twin_on_a_gpu(rows: int, width: int, with_y: bool, inverse: float | None) -> None:
    check(rows, width, with_y, inverse, "cuda")


def test_it_takes_many_rows_of_whole_chunks_and_one_matrix_to_add() -> None:
    x, y, weight, _ = inputs(layer_norm.ROWS, 64, "cpu", True)
    assert y is not None and layer_norm.takes(x, y, weight) and layer_norm.takes(x, None, weight)
    assert not layer_norm.takes(x[1:], None, weight), "few rows"
    assert not layer_norm.takes(x, y[None], weight), "parts of a product"
    assert not layer_norm.takes(x, y.float(), weight) and not layer_norm.takes(x.float(), None, weight)
    assert not layer_norm.takes(x[:, :60], None, weight[:60]), "a row that isn't whole chunks"
    wide = torch.empty(layer_norm.ROWS, 2056, dtype=torch.bfloat16)
    assert not layer_norm.takes(wide, None, wide[0]), "a row that a warp doesn't hold"
