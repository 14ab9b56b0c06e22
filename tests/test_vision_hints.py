"""Each product of the vision tower is told which matrix comes next, so that it is in L2 by then."""

import itertools
from typing import Any

import pytest
import torch
from torch import Tensor

pytest.importorskip("triton", reason="Triton isn't installed")

from turbopi.kernels.sm90.gemm import vision_products
from turbopi.kernels.sm90.gemm.vision_products import VisionProducts

WIDTH, HIDDEN, LAYERS = 16, 32, 2
Told = list[tuple[str, str | None]]  # the matrix that was multiplied, the one that it was told of


class Tower:
    """Its weights, and `run`: the products of one call, without the norms between them."""

    def __init__(self) -> None:
        sizes = {"qkv": (3 * WIDTH, WIDTH), "out": (WIDTH, WIDTH), "fc1": (HIDDEN, WIDTH), "fc2": (WIDTH, HIDDEN)}
        self.weights = {f"{name} {i}": torch.zeros(size) for i in range(LAYERS) for name, size in sizes.items()}
        self.weights["projector"] = torch.zeros(WIDTH, WIDTH)
        self.prefix = torch.zeros(WIDTH, WIDTH)

    def name(self, matrix: Tensor | None) -> str | None:
        return next((name for name, weight in self.weights.items() if weight is matrix), None)

    def run(self, ops: VisionProducts) -> None:
        x, hidden = torch.zeros(4, WIDTH), torch.zeros(4, HIDDEN)
        for i in range(LAYERS):
            ops.linear(x, self.weights[f"qkv {i}"], torch.zeros(3 * WIDTH))
            ops.residual_linear(x, self.weights[f"out {i}"], torch.zeros(WIDTH))
            ops.linear_gelu(x, self.weights[f"fc1 {i}"], torch.zeros(HIDDEN))
            ops.residual_linear(hidden, self.weights[f"fc2 {i}"], torch.zeros(WIDTH))
        ops.linear(x, self.weights["projector"], torch.zeros(WIDTH), torch.zeros(4, WIDTH))
        ops.linear(x, self.prefix)  # without a bias: not the tower's


@pytest.fixture
def tower() -> Tower:
    return Tower()


@pytest.fixture
def told(tower: Tower, monkeypatch: pytest.MonkeyPatch) -> Told:
    """What the products are told, as they are called; nothing is multiplied."""
    told: Told = []

    def product(x: Tensor, weight: Tensor, *rest: Any, **more: Any) -> Tensor:
        if weight is tower.prefix:
            assert rest[-1] is None
        else:
            told.append((str(tower.name(weight)), tower.name(rest[-1])))
        return x

    for name in ("tuned_linear", "tuned_residual_linear", "tuned_linear_gelu"):
        monkeypatch.setattr(vision_products, name, product)
    monkeypatch.setattr(vision_products, "multiprocessors", lambda device: 132)
    return told


def test_from_the_second_call_on_each_product_is_told_of_the_next_ones_matrix(tower: Tower, told: Told) -> None:
    ops, order = VisionProducts(), list(tower.weights)
    tower.run(ops)
    assert told == [(name, None) for name in order]
    told.clear()
    tower.run(ops)
    assert told == [*itertools.pairwise(order), ("projector", None)]


def test_what_is_told_goes_by_the_order_of_the_call_before(tower: Tower, told: Told) -> None:
    ops = VisionProducts()
    tower.run(ops)
    first = tower.weights["fc1 0"]
    ops.linear_gelu(torch.zeros(4, WIDTH), first, torch.zeros(HIDDEN))
    ops.linear_gelu(torch.zeros(4, WIDTH), tower.weights["fc1 1"], torch.zeros(HIDDEN))
    told.clear()
    ops.linear_gelu(torch.zeros(4, WIDTH), first, torch.zeros(HIDDEN))
    assert told == [("fc1 0", "fc1 1")]
