"""Each GEMM of the vision tower fetches the next one's matrix into L2, and no call depends on those before."""

import itertools
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor

pytest.importorskip("triton", reason="Triton isn't installed")

from turbopi.engine.forward import vision_tokens
from turbopi.kernels.interface import VisionLayer
from turbopi.kernels.sm90 import vision
from turbopi.kernels.sm90.gemm.bf16 import Folded, Tile
from turbopi.kernels.sm90.norms import layer_norm
from turbopi.kernels.sm90.vision import FusedVision

WIDTH, HIDDEN, LAYERS, TOKENS = 16, 32, 2, 4
Ran = list[tuple[str, str | None]]  # the matrix that is multiplied, the one that is fetched into L2


class Tower:
    def __init__(self) -> None:
        sizes = {"qkv": (3 * WIDTH, WIDTH), "out": (WIDTH, WIDTH), "fc1": (HIDDEN, WIDTH), "fc2": (WIDTH, HIDDEN)}
        self.matrices = {f"{name} {i}": torch.zeros(size) for i in range(LAYERS) for name, size in sizes.items()}
        self.matrices["projector"] = torch.zeros(WIDTH, WIDTH)
        norm = torch.ones(WIDTH), torch.zeros(WIDTH)
        self.weights: Any = SimpleNamespace(patch=None, position=None, post_layernorm=norm)
        self.weights.vision = [
            VisionLayer(norm, norm2=norm, **{name: self.affine(f"{name} {i}") for name in sizes}) for i in range(LAYERS)
        ]
        self.weights.projector = self.affine("projector")

    def affine(self, name: str) -> tuple[Tensor, Tensor]:
        return self.matrices[name], torch.zeros(len(self.matrices[name]))

    def name(self, matrix: Tensor | Folded | None) -> str | None:
        if isinstance(matrix, Folded):
            matrix = matrix.data
        return next((name for name, one in self.matrices.items() if one is matrix), None)

    def run(self, ops: Any, *images: int) -> None:
        config: Any = SimpleNamespace(vision=SimpleNamespace(layer_norm_eps=1e-6, num_tokens=TOKENS, num_heads=2))
        parts = [lambda n=n: torch.zeros(n * TOKENS, WIDTH) for n in images]
        vision_tokens(config, self.weights, ops, parts, torch.zeros(sum(images) * TOKENS, WIDTH))


@pytest.fixture
def tower() -> Tower:
    return Tower()


@pytest.fixture
def ran(tower: Tower, monkeypatch: pytest.MonkeyPatch) -> Ran:
    """The GEMMs as they run; nothing is multiplied."""
    ran: Ran = []

    def tuned(x: Tensor, weight: Tensor, bias: Tensor, *rest: Any, **more: Any) -> Tensor:
        ran.append((str(tower.name(weight)), tower.name(rest[-1])))
        return x.new_zeros(len(x), len(weight))

    def gemm(x: Tensor, weight: Any, *rest: Any, ahead: Tensor | None, **more: Any) -> Tensor:
        ran.append((str(tower.name(weight)), tower.name(ahead)))
        return x.new_zeros(len(x), len(weight.data))

    for name in ("tuned_linear", "tuned_residual_linear", "tuned_linear_gelu"):
        monkeypatch.setattr(vision, name, tuned)
    monkeypatch.setattr(vision, "matmul", gemm)
    monkeypatch.setattr(vision, "multiprocessors", lambda device: 132)
    monkeypatch.setattr(layer_norm, "residual_layer_norm", lambda x, y, *norm: (x, x))
    return ran


def ops() -> Any:
    def attention(qkv: Tensor, images: int, heads: int) -> Tensor:
        return qkv[:, :WIDTH]

    return SimpleNamespace(embed_patches=lambda x, *rest: x, vision=FusedVision(attention))


@pytest.fixture
def fused(tower: Tower, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each GEMM in front of a norm adds the stream, each behind one normalises its input."""
    monkeypatch.setattr(vision, "bf16_tile", lambda *given: Tile(1, 32))

    def fold(weight: Tensor, *given: Tensor) -> Folded:
        return Folded(weight, *given[:2])

    monkeypatch.setattr(Folded, "fold", fold)


def expected(tower: Tower) -> Ran:
    order = list(tower.matrices)
    return [*itertools.pairwise(order), ("projector", None)]


def test_each_matmul_fetches_the_next_ones_matrix(tower: Tower, ran: Ran) -> None:
    tower.run(ops(), 1)
    assert ran == expected(tower)


@pytest.mark.usefixtures("fused")
def test_so_it_is_where_matmuls_are_deferred_until_the_norm(tower: Tower, ran: Ran) -> None:
    tower.run(ops(), 1)
    assert ran == expected(tower)


@pytest.mark.usefixtures("fused")
def test_what_a_call_does_does_not_depend_on_the_calls_before(tower: Tower, ran: Ran) -> None:
    used = ops()
    for images in ((1,), (1, 2), (1,)):
        tower.run(used, *images)
        before = list(ran)
        ran.clear()
        tower.run(ops(), *images)
        assert ran == before
        ran.clear()
