"""The expert's products on several observations' tokens: the usual ones, each with the next matrix to fetch."""

from itertools import pairwise
from typing import Any

import pytest
import torch
from conftest import on_hopper
from torch import Tensor

pytest.importorskip("triton", reason="Triton isn't installed")

from turbopi.kernels.interface import GemmaLayer
from turbopi.kernels.plain import PLAIN
from turbopi.kernels.sm90 import expert
from turbopi.kernels.sm90.gemm.bf16 import Tile
from turbopi.kernels.tile_table import TileKey, TileTable
from turbopi.quantization.fp8 import E4M3, Matrix, ScaledMatrix, to_e4m3

WIDTH, HEADS, DIM, HIDDEN, ROWS = 1024, 8, 256, 4096, 80
SHAPES = {
    "qkv": ((HEADS + 2) * DIM, WIDTH),
    "out": (WIDTH, HEADS * DIM),
    "gate_up": (2 * HIDDEN, WIDTH),
    "down": (WIDTH, HIDDEN),
}


def layers(count: int, scaled: bool, device: str) -> list[GemmaLayer[Any]]:
    def matrix(rows: int, inner: int) -> Matrix:
        made = torch.randn(rows, inner, device=device).to(torch.bfloat16) / inner**0.5
        if not scaled:
            return made
        return ScaledMatrix(to_e4m3(made, 50), torch.full((rows,), 0.02 / 60, device=device), 60.0, torch.bfloat16)

    return [
        GemmaLayer(**{name: matrix(*shape) for name, shape in SHAPES.items()}, norm1=None, norm2=None)
        for _ in range(count)
    ]


def in_order(made: list[GemmaLayer[Any]]) -> list[Matrix]:
    return [getattr(layer, name) for layer in made for name in SHAPES]


@pytest.mark.parametrize("scaled", [False, True])
def test_each_product_asks_for_the_matrix_behind_it(scaled: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of the last one that is the first: another step begins."""
    asked: list[tuple[Tensor, Tensor | None]] = []

    def told(x: Tensor, weight: Matrix, *_: Any, ahead: Tensor | None = None, **__: Any) -> Tensor:
        asked.append((expert.numbers(weight), ahead))
        return x

    monkeypatch.setattr(expert, "num_sms", lambda device: 132)
    for name in ("matmul", "matmul_fp8", "tuned_residual_linear"):
        monkeypatch.setattr(expert, name, told)
    made = layers(2, scaled, "cpu")
    ops = expert.expert(PLAIN, made)
    for layer in made:
        for run, name in ((ops.linear, "qkv"), (ops.residual_linear, "out"), (ops.linear_geglu, "gate_up")):
            run(torch.zeros(ROWS, SHAPES[name][1]), getattr(layer, name))
        ops.residual_linear(torch.zeros(ROWS, HIDDEN), layer.down)
    matrices = [expert.numbers(one) for one in in_order(made)]
    assert [weight.data_ptr() for weight, _ in asked] == [one.data_ptr() for one in matrices]
    behind = [one for _, one in asked]
    assert all(one is not None for one in behind)
    assert all(found is then for found, (_, then) in zip(behind, pairwise([*matrices, matrices[0]]), strict=True))


def test_what_the_library_multiplies_asks_for_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(expert, "matmul", lambda *_, **__: pytest.fail("the library is the faster one here"))
    made = layers(1, False, "cpu")
    key = TileKey("hopper", "plain", "bf16", 128, *SHAPES["qkv"])
    x = torch.randn(ROWS, WIDTH).to(torch.bfloat16)
    ours = expert.ExpertProducts(made, TileTable({key: {"library": 1}})).linear(x, made[0].qkv)
    assert torch.equal(ours, torch.nn.functional.linear(x, made[0].qkv))


def test_measured_tiles_are_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    taken: list[Tile] = []

    def told(x: Tensor, weight: Tensor, tile: Tile, *_: Any, **__: Any) -> Tensor:
        taken.append(tile)
        return x

    monkeypatch.setattr(expert, "matmul", told)
    made, wanted = layers(1, False, "cpu"), {"warpgroups": 1, "columns": 96}
    key = TileKey("hopper", "plain", "bf16", 128, *SHAPES["qkv"])
    expert.ExpertProducts(made, TileTable({key: wanted})).linear(torch.zeros(ROWS, WIDTH), made[0].qkv)
    assert taken == [Tile(1, 96)]


@on_hopper
@pytest.mark.parametrize("rows", [20, 80, 160, 400])
@pytest.mark.parametrize("scaled", [False, True])
def test_a_fetched_matrix_changes_no_result(scaled: bool, rows: int) -> None:
    from turbopi.kernels.sm90.ops import hopper_ops

    device = torch.device("cuda")
    usual, made = hopper_ops(device), layers(2, scaled, "cuda")
    ours = expert.expert(usual, made)
    inverse = {"inverse": 60.0} if scaled else {}

    def run(ops: Any) -> list[Tensor]:
        found, x = [], torch.randn(rows, WIDTH, device=device, generator=torch.Generator(device).manual_seed(1))
        for layer in made:
            normed = x.to(E4M3) if scaled else x.to(torch.bfloat16)
            attended = ops.linear(normed, layer.qkv)[:, : HEADS * DIM].contiguous()
            found += [attended, ops.residual_linear(attended.to(normed.dtype), layer.out)]
            hidden = ops.linear_geglu(normed, layer.gate_up, **inverse)
            found += [hidden.float(), ops.residual_linear(hidden, layer.down)]
        return found

    for one, other in zip(run(ours), run(usual), strict=True):
        assert torch.equal(one, other) and bool(one.isfinite().all())
