"""Products that add the residual stream, do the LayerNorm of their input, or add their parts up inside a cluster."""

import pytest
import torch
import torch.nn.functional as F
from conftest import on_hopper
from torch import Tensor

pytest.importorskip("triton", reason="Triton isn't installed")

from turbopi.engine import ops as plain
from turbopi.engine.fp8 import Fp8Matrix, to_e4m3
from turbopi.kernels import attention_hopper, norms
from turbopi.kernels import ops as fused
from turbopi.kernels.gemm import Folded, Sums, Tile, clusters, matmul
from turbopi.kernels.gemm_fp8 import GATHERING_SMS, best_tile, matmul_fp8

DEVICE = torch.device("cuda" if torch.cuda.is_available() else "cpu")
EPS = 1e-6
WIDTH, HIDDEN = 1152, 4304
seeds = iter(range(10**6))


def random(*shape: int, dtype: torch.dtype = torch.bfloat16) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(next(seeds))).to(DEVICE, dtype)


def stream(kind: str, rows: int, dtype: torch.dtype = torch.bfloat16) -> Tensor:
    """A residual stream as hard to normalise as trained ones, or harder."""
    x = random(rows, WIDTH, dtype=torch.float32) + {"mean": 8, "large mean": 30}.get(kind, 0)
    if kind == "outliers":
        x[:, ::200] *= 20
    return x.to(dtype)


def sums_of(x: Tensor, parts: int) -> Sums:
    pieces = x.float().tensor_split(parts, 1)
    return Sums(torch.stack([torch.stack((p.sum(1), p.square().sum(1)), -1) for p in pieces]))


def error(ours: Tensor, exact: Tensor) -> float:
    return float((ours.double() - exact.double()).norm() / exact.double().norm())


KINDS = ["random", "mean", "large mean", "outliers"]
GATHERED = [
    Tile(2, 72, splits=2, gather=True),
    Tile(2, 96, cluster_m=2, cluster_n=2, splits=2, gather=True),
    Tile(2, 128, splits=3, gather=True),
]
SHAPES = [(512, 1152, 4304), (203, 1152, 4304), (1, 264, 1152), (560, 576, 16384)]


@pytest.mark.parametrize("kind", KINDS)
def test_a_folded_norm_is_the_norm_and_the_product(kind: str) -> None:
    x, scale, shift = stream(kind, 7, torch.float64), *(random(WIDTH, dtype=torch.float32) for _ in range(2))
    weight, bias = random(24, WIDTH, dtype=torch.float32), random(24, dtype=torch.float32)
    folded = Folded.fold(weight, bias, scale, shift)
    mean, deviation = x.mean(1, keepdim=True), (x.var(1, correction=0, keepdim=True) + EPS).sqrt()
    ours = (x @ folded.data.double().T - mean * folded.sums) / deviation + folded.offset
    normed = F.layer_norm(x, (WIDTH,), scale.double(), shift.double(), EPS)
    assert error(ours, normed @ weight.double().T + bias) < 2e-5


def test_a_tile_is_gathered_at_once_or_not_at_all() -> None:
    assert clusters(GATHERED[1], 12, 15) == 12 and clusters(Tile(2, 96, splits=2), 12, 15) == 15
    with pytest.raises(AssertionError, match="no room"):
        clusters(GATHERED[1], 16, 15)


def test_smaller_gpus_gather_nothing() -> None:
    assert best_tile(512, WIDTH, HIDDEN, "partial", GATHERING_SMS).gather
    assert not best_tile(512, WIDTH, HIDDEN, "partial", GATHERING_SMS - 1).gather


@on_hopper
@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("tile", GATHERED)
def test_sums_gathered_in_a_cluster(shape: tuple[int, int, int], tile: Tile) -> None:
    m, n, k = shape
    x, weight, bias = random(m, k), random(n, k), random(n)
    x[:, ::300] *= 300
    exact = plain.linear(x.float(), weight.float(), bias.float())
    out = torch.full((m, n), torch.nan, device=DEVICE, dtype=x.dtype)
    assert error(matmul(x, weight, tile, "bias", bias, out), exact) < 0.0025
    assert all(torch.equal(matmul(x, weight, tile, "bias", bias), out) for _ in range(3))


@on_hopper
@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("tile", [*GATHERED, Tile(3, 96, splits=2, gather=True)])
def test_sums_of_e4m3_gathered_in_a_cluster(shape: tuple[int, int, int], tile: Tile) -> None:
    m, n, k = shape
    matrix, bias = Fp8Matrix.quantize(random(n, k), 0.02), random(n)
    x = to_e4m3(random(m, k), matrix.inverse)
    out = torch.full((m, n), torch.nan, device=DEVICE, dtype=torch.bfloat16)
    assert error(matmul_fp8(x, matrix, tile, "bias", bias, out), matrix.product(x, bias)) < 0.006
    assert all(torch.equal(matmul_fp8(x, matrix, tile, "bias", bias), out) for _ in range(3))


@on_hopper
@pytest.mark.parametrize("tile", [Tile(1, 72), Tile(2, 40, cluster_n=2), GATHERED[0], GATHERED[1]])
@pytest.mark.parametrize(("rows", "inner"), [(512, 4304), (203, 1152), (1, 1152)])
@pytest.mark.parametrize("fp8", [False, True])
def test_a_product_adds_the_stream_and_its_rows_sums(fp8: bool, rows: int, inner: int, tile: Tile) -> None:
    residual, bias, weight = stream("outliers", rows), random(WIDTH), random(WIDTH, inner) / inner**0.5
    sums, again = (Sums.allocate(tile, rows, WIDTH, DEVICE) for _ in range(2))
    sums.parts.fill_(torch.nan)
    if fp8:
        matrix = Fp8Matrix.quantize(weight, 0.02)
        x = to_e4m3(random(rows, inner), matrix.inverse)
        exact = matrix.product(x, bias) + residual.float()
        out = matmul_fp8(x, matrix, tile, "bias", bias, residual=residual, sums_out=sums)
        repeated = matmul_fp8(x, matrix, tile, "bias", bias, residual=residual, sums_out=again)
    else:
        x = random(rows, inner)
        exact = plain.linear(x.float(), weight.float(), bias.float()) + residual.float()
        out = matmul(x, weight, tile, "bias", bias, residual=residual, sums_out=sums)
        repeated = matmul(x, weight, tile, "bias", bias, residual=residual, sums_out=again)
    assert error(out, exact) < (0.004 if fp8 else 0.0025)
    rounded = torch.stack((out.double().sum(1), out.double().square().sum(1)), -1)  # of what the next product reads
    scale = torch.stack((out.double().abs().sum(1), rounded[:, 1]), -1)
    assert bool(((sums.parts.double().sum(0) - rounded).abs() < 1e-5 * scale).all())
    assert torch.equal(repeated, out) and torch.equal(again.parts, sums.parts)


@on_hopper
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("rows", [512, 203])
@pytest.mark.parametrize("parts", [1, 16, 24])
def test_a_folded_norm_errs_no_more_than_one_before_the_product(kind: str, rows: int, parts: int) -> None:
    x, scale, shift = stream(kind, rows), random(WIDTH), random(WIDTH)
    weight, bias = random(HIDDEN, WIDTH) / WIDTH**0.5, random(HIDDEN)
    normed = F.layer_norm(x.double(), (WIDTH,), scale.double(), shift.double(), EPS)
    exact = normed @ weight.double().T + bias.double()
    before = norms.residual_layer_norm(x, None, scale, shift, EPS)[1]
    folded = Folded.fold(weight, bias, scale, shift)
    for tile in (Tile(2, 112), Tile(2, 136), Tile(2, 128, cluster_n=2)):
        ours = matmul(x, folded, tile, "bias", sums=sums_of(x, parts), eps=EPS)
        assert error(ours, exact) < 1.25 * error(matmul(before, weight, tile, "bias", bias), exact)
        ours = matmul(x, folded, tile, "gelu", sums=sums_of(x, parts), eps=EPS)
        activated = matmul(before, weight, tile, "gelu", bias)
        assert error(ours, plain.gelu(exact)) < 1.25 * error(activated, plain.gelu(exact))


@on_hopper
@pytest.mark.parametrize("rows", [203, 256, 512, 768])
@pytest.mark.parametrize("fp8", ["", "fc2", "fc1 fc2"])
def test_layers_of_the_vision_tower_in_fused_operations(fp8: str, rows: int) -> None:
    """What the operations hand over to each other, in any mixture; twice, as weights are folded the first time."""
    ops = fused.fused_ops(DEVICE)
    scales, shifts = [random(WIDTH) for _ in range(4)], [random(WIDTH) for _ in range(4)]
    sizes = {"out": (WIDTH, WIDTH), "fc1": (HIDDEN, WIDTH), "fc2": (WIDTH, HIDDEN), "qkv": (3 * WIDTH, WIDTH)}
    weights = {name: random(*size) / size[1] ** 0.5 for name, size in sizes.items()}
    biases = {name: random(size[0]) for name, size in sizes.items()}
    matrices = {name: Fp8Matrix.quantize(w, 0.05) if name in fp8.split() else w for name, w in weights.items()}
    x, attended = stream("outliers", rows), random(rows, WIDTH)

    def layer(o: plain.Ops, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
        def affine(name: str) -> tuple[Tensor | Fp8Matrix, Tensor]:
            matrix = matrices[name]
            return matrix if isinstance(matrix, Fp8Matrix) else matrix.to(dtype), biases[name].to(dtype)

        def inverse(name: str) -> float | None:
            matrix = matrices[name]
            return matrix.inverse if isinstance(matrix, Fp8Matrix) else None

        scale, shift = [s.to(dtype) for s in scales], [s.to(dtype) for s in shifts]
        y = o.residual_linear(attended.to(dtype), *affine("out"))
        h, normed = o.residual_layer_norm(x.to(dtype), y, scale[0], shift[0], EPS, inverse("fc1"))
        y = o.residual_linear(o.linear_gelu(normed, *affine("fc1"), inverse("fc2")), *affine("fc2"))
        h, normed = o.residual_layer_norm(h, y, scale[1], shift[1], EPS)
        return h, o.linear(normed, *affine("qkv"))

    exact, twin = layer(plain.PLAIN, torch.float32), layer(plain.PLAIN, torch.bfloat16)
    first = layer(ops, torch.bfloat16)
    for ours, plainly, should in zip(first, twin, exact, strict=True):
        assert ours.shape == should.shape and error(ours, should) < 1.25 * error(plainly, should)
    for ours, before in zip(layer(ops, torch.bfloat16), first, strict=True):
        assert torch.equal(ours, before)


@on_hopper
@pytest.mark.parametrize(("images", "tokens", "dim"), [(1, 256, 72), (3, 256, 72), (2, 128, 64), (2, 116, 24)])
@pytest.mark.parametrize("keys", [64, 128])
def test_keys_loaded_together_are_the_same_keys(images: int, tokens: int, dim: int, keys: int) -> None:
    qkv = random(images * tokens, 3 * 4 * dim)
    alone, pair = (attention_hopper.Tile(dim, keys, sharing=sharing) for sharing in (1, 2))
    expected = attention_hopper.vision_attention(qkv, images, 4, tile=alone)
    for _ in range(5):
        assert torch.equal(attention_hopper.vision_attention(qkv, images, 4, tile=pair), expected)
