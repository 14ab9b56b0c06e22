"""Products that add the residual stream, do the LayerNorm of their input, or add their parts up inside a cluster."""

import dataclasses
from typing import Any

import pytest
import torch
import torch.nn.functional as F
from conftest import on_hopper
from torch import Tensor

pytest.importorskip("triton", reason="Triton isn't installed")

from turbopi.engine.forward import VisionByOps
from turbopi.kernels import plain
from turbopi.kernels.interface import Affine, AffineMatrix, VisionLayer, VisionOps, VisionStream
from turbopi.kernels.ops import fused_ops
from turbopi.kernels.portable import norms
from turbopi.kernels.portable.quantize import quantize
from turbopi.kernels.sm90.attention import kernel as attention_hopper
from turbopi.kernels.sm90.gemm.bf16 import Copy, Folded, Sums, Tile, clusters, matmul
from turbopi.kernels.sm90.gemm.fp8 import GATHERING_SMS, HEADROOM, FoldedFp8, best_tile, matmul_fp8
from turbopi.quantization.fp8 import E4M3, E4M3_MAX, ScaledMatrix, to_e4m3, whole_lines

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
    Tile(1, 96, cluster_m=2, cluster_n=2, splits=2, gather=True),
]
SHAPES = [(512, 1152, 4304), (203, 1152, 4304), (1, 264, 1152), (560, 576, 16384)]


def at_once(tile: Tile, rows: int, columns: int) -> int:
    """As many of `rows` as the tile's clusters take at once: an H200 has room for 15 of eight blocks."""
    across = -(-columns // (tile.columns * tile.cluster_n))
    return min(rows, 15 // across * tile.rows * tile.cluster_m) if tile.cluster == 8 else rows


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
    assert best_tile(512, WIDTH, whole_lines(HIDDEN), "partial", GATHERING_SMS).gather
    assert not best_tile(512, WIDTH, whole_lines(HIDDEN), "partial", GATHERING_SMS - 1).gather


@on_hopper
@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("tile", GATHERED)
def test_sums_gathered_in_a_cluster(shape: tuple[int, int, int], tile: Tile) -> None:
    _, n, k = shape
    m = at_once(tile, shape[0], n)
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
    _, n, k = shape
    m = at_once(tile, shape[0], n)
    matrix, bias = quantize(random(n, k), 0.02), random(n)
    x = to_e4m3(random(m, k), matrix.inverse)
    out = torch.full((m, n), torch.nan, device=DEVICE, dtype=torch.bfloat16)
    assert error(matmul_fp8(x, matrix, tile, "bias", bias, out), matrix.product(x, bias)) < 0.006
    assert all(torch.equal(matmul_fp8(x, matrix, tile, "bias", bias), out) for _ in range(3))


@on_hopper
@pytest.mark.parametrize("tile", [Tile(1, 96, cluster_n=4), Tile(2, 40, cluster_n=2), *GATHERED[:2], GATHERED[3]])
@pytest.mark.parametrize(("rows", "inner"), [(512, 4304), (203, 1152), (1, 1152)])
@pytest.mark.parametrize("fp8", [False, True])
def test_a_product_adds_the_stream_and_its_rows_sums(fp8: bool, rows: int, inner: int, tile: Tile) -> None:
    rows = at_once(tile, rows, WIDTH)
    residual, bias, weight = stream("outliers", rows), random(WIDTH), random(WIDTH, inner) / inner**0.5
    sums, again = (Sums.allocate(tile, rows, WIDTH, DEVICE) for _ in range(2))
    sums.parts.fill_(torch.nan)
    if fp8:
        matrix = quantize(weight, 0.02)
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
    for tile in (Tile(2, 112), Tile(2, 144, cluster_m=2), Tile(2, 128, cluster_n=2)):
        ours = matmul(x, folded, tile, "bias", sums=sums_of(x, parts), eps=EPS)
        assert error(ours, exact) < 1.25 * error(matmul(before, weight, tile, "bias", bias), exact)
        ours = matmul(x, folded, tile, "gelu", sums=sums_of(x, parts), eps=EPS)
        activated = matmul(before, weight, tile, "gelu", bias)
        assert error(ours, plain.gelu(exact)) < 1.25 * error(activated, plain.gelu(exact))


def deviations(x: Tensor, eps: Tensor | float = EPS) -> tuple[Tensor, Tensor]:
    """Each row's mean and 1 / deviation in float64."""
    wide = x.double()
    return wide.mean(1, keepdim=True), (wide.var(1, correction=0, keepdim=True) + eps).rsqrt()


@pytest.mark.parametrize("growth", [0.1, 1.0, 10.0])
@pytest.mark.parametrize("kind", KINDS)
def test_a_norm_made_of_a_copy_in_other_units_is_the_norm(kind: str, growth: float) -> None:
    """The algebra of `FoldedFp8`: any mean and deviation will do for the copy."""
    residual = stream(kind, 7, torch.float64)
    x = residual + growth * random(7, WIDTH, dtype=torch.float64) + growth
    scale, shift = random(WIDTH, dtype=torch.float32), random(WIDTH, dtype=torch.float32)
    matrix, bias = quantize(random(24, WIDTH, dtype=torch.float32), 0.5), random(24, dtype=torch.float32)
    folded = FoldedFp8.fold(matrix, scale, shift)
    mean, factor = deviations(residual)
    units = (x - mean) * factor
    copy = (units * scale + shift) * matrix.inverse / HEADROOM
    own, by = deviations(units, EPS * factor.square())
    ours = (copy @ matrix.data.double().T * folded.scale - own * folded.of_scale - folded.of_shift) * by
    normed = F.layer_norm(x, (WIDTH,), scale.double(), shift.double(), EPS)
    assert error(ours + folded.of_shift + bias, normed @ matrix.dequantized().double().T + bias) < 1e-5


@on_hopper
@pytest.mark.parametrize("fp8", [False, True])
@pytest.mark.parametrize("tile", [Tile(1, 72), Tile(1, 96, cluster_n=4), Tile(2, 64, cluster_n=2), *GATHERED[:2]])
@pytest.mark.parametrize("rows", [512, 203, 1])
@pytest.mark.parametrize("kind", KINDS)
def test_a_product_leaves_a_copy_in_e4m3_in_the_units_of_the_stream_before(
    kind: str, rows: int, tile: Tile, fp8: bool
) -> None:
    rows = at_once(tile, rows, WIDTH)
    residual, bias, weight = stream(kind, rows), random(WIDTH), random(WIDTH, WIDTH) / WIDTH**0.5
    scale, shift, x = random(WIDTH), random(WIDTH), random(rows, WIDTH)
    matrix = quantize(weight, 0.02)
    given = to_e4m3(x, matrix.inverse)

    def product(copied: bool) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        sums, plain = (Sums.allocate(tile, rows, WIDTH, DEVICE) for _ in range(2))
        sums.parts.fill_(torch.nan)
        plain.parts.fill_(torch.nan)
        out = torch.full((rows, WIDTH), torch.nan, device=DEVICE, dtype=torch.bfloat16)
        copy = out.to(E4M3)
        made = Copy(copy, sums_of(residual, 24), scale.float() * 20, shift.float() * 20, EPS, plain) if copied else None
        if fp8:
            matmul_fp8(given, matrix, tile, "bias", bias, out, residual=residual, sums_out=sums, copy=made)
        else:
            matmul(x, weight, tile, "bias", bias, out, residual=residual, sums_out=sums, copy=made)
        return out, copy, sums.parts, plain.parts

    out, copy, parts, plain_parts = product(True)
    without, _, sums_without, _ = product(False)
    assert torch.equal(out, without) and torch.equal(plain_parts, sums_without)
    mean, factor = deviations(residual)
    units = (out.double() - mean) * factor
    expected = to_e4m3(units * scale.double() + shift.double(), 20.0)
    same = copy.view(torch.uint8) == expected.view(torch.uint8)
    assert float(same.float().mean()) > 0.98  # the others' mean or deviation was rounded across an edge
    # a step of E4M3, and what float32 leaves of the variance beside the mean's square, where scale and shift cancel
    step, rounding = expected.float().abs().clamp(min=2.0**-6) / 8, 2.0**-22 * (1 + (mean * factor).square())
    assert bool(
        ((copy.float() - expected.float()).abs() <= step + rounding * (units * scale.double() * 20).abs()).all()
    )
    squares = units.square().sum(1) + WIDTH * EPS * factor[:, 0].square()
    total = parts.double().sum(0)
    assert bool(((total[:, 0] - units.sum(1)).abs() < 2e-4 * units.abs().sum(1)).all())
    assert bool(((total[:, 1] - squares).abs() < 1e-3 * squares).all())
    for ours, again in zip((out, copy.view(torch.uint8), parts, plain_parts), product(True), strict=True):
        assert torch.equal(ours, again.view(ours.dtype))


@on_hopper
@pytest.mark.parametrize("kind", [*KINDS, "cancelled outliers", "constant rows"])
@pytest.mark.parametrize("growth", [0.1, 1.0, 6.0])
@pytest.mark.parametrize("rows", [512, 203])
@pytest.mark.parametrize("out_tile", [Tile(1, 72), Tile(1, 96, cluster_n=4)])
def test_a_norm_of_a_copy_errs_no_more_than_one_before_the_product(
    out_tile: Tile, rows: int, growth: float, kind: str
) -> None:
    residual, scale, shift = stream(kind, rows), random(WIDTH), random(WIDTH)
    if kind == "constant rows":  # of some images the first layers' streams; nothing that was there before counts
        residual[::3] = residual[::3, :1]
        growth = 1.0
    if kind == "cancelled outliers":  # the shift takes away what is always there
        residual[:, ::200] += 20
    x = random(rows, WIDTH)
    weight = random(WIDTH, WIDTH) * (growth / WIDTH**0.5)
    sums = Sums.allocate(out_tile, rows, WIDTH, DEVICE)
    bias = torch.full((WIDTH,), 0.3 * growth, device=DEVICE, dtype=torch.bfloat16)
    copy = torch.empty(rows, WIDTH, device=DEVICE, dtype=E4M3)

    def stream_behind(inverse: float) -> Tensor:
        by = inverse / HEADROOM
        plain_sums = Sums.allocate(out_tile, rows, WIDTH, DEVICE)
        made = Copy(copy, sums_of(residual, 24), scale.float() * by, shift.float() * by, EPS, plain_sums)
        return matmul(x, weight, out_tile, "bias", bias, residual=residual, sums_out=sums, copy=made)

    if kind == "cancelled outliers":
        usual = F.layer_norm(stream_behind(1.0).float(), (WIDTH,)).mean(0)
        shift[::200] = -(usual * scale)[::200].bfloat16()
    behind = stream_behind(1.0)
    normed = F.layer_norm(behind.double(), (WIDTH,), scale.double(), shift.double(), EPS)
    matrix = quantize(random(HIDDEN, WIDTH) / WIDTH**0.5, float(normed.abs().max()) / E4M3_MAX)
    assert torch.equal(stream_behind(matrix.inverse), behind)
    offset = random(HIDDEN)
    exact = normed @ matrix.dequantized().double().T + offset.double()
    before = norms.residual_layer_norm(behind, None, scale, shift, EPS, matrix.inverse)[1]
    folded = FoldedFp8.fold(matrix, scale, shift)
    for tile in (Tile(2, 136), Tile(1, 128), Tile(2, 144, cluster_m=2)):
        out = torch.full((rows, HIDDEN), torch.nan, device=DEVICE, dtype=torch.bfloat16)
        ours = matmul_fp8(copy, folded, tile, "bias", offset, out, sums=sums)
        plainly = matmul_fp8(before, matrix, tile, "bias", offset)
        if kind != "constant rows":
            assert error(ours, exact) < 1.1 * error(plainly, exact)
        else:
            fine = torch.arange(rows, device=DEVICE) % 3 > 0
            assert bool(ours.isfinite().all())
            assert error(ours[fine], exact[fine]) < 1.1 * error(plainly[fine], exact[fine])
        ours = matmul_fp8(copy, folded, tile, "gelu", offset, inverse=20.0, sums=sums)
        plainly = matmul_fp8(before, matrix, tile, "gelu", offset, inverse=20.0)
        activated = plain.gelu(exact)
        if kind != "constant rows":
            assert error(ours.float() / 20, activated) < 1.1 * error(plainly.float() / 20, activated)
        again = matmul_fp8(copy, folded, tile, "gelu", offset, inverse=20.0, sums=sums)
        assert torch.equal(again.view(torch.uint8), ours.view(torch.uint8))


@on_hopper
@pytest.mark.parametrize(("rows", "bound"), [(203, 1.25), (256, 1.1), (512, 1.1), (768, 1.1)])
@pytest.mark.parametrize("fp8", ["", "fc1", "fc2", "fc1 fc2", "qkv", "qkv out", "qkv out fc1 fc2", "fc1 fc2 projector"])
def test_two_layers_and_the_projector_in_fused_operations(fp8: str, rows: int, bound: float) -> None:
    """What the second layer gets from the first; the float32 reference has the same E4M3 matrices, but exact inputs."""
    sizes = {"qkv": (3 * WIDTH, WIDTH), "out": (WIDTH, WIDTH), "fc1": (HIDDEN, WIDTH), "fc2": (WIDTH, HIDDEN)}

    def made(name: str, size: tuple[int, int]) -> AffineMatrix:
        weight = random(*size) / size[1] ** 0.5
        return (quantize(weight, 0.035) if name in fp8.split() else weight), random(size[0])

    def norm() -> Affine:
        return random(WIDTH), random(WIDTH)

    layers = [
        VisionLayer(norm1=norm(), norm2=norm(), **{name: made(name, size) for name, size in sizes.items()})
        for _ in range(2)
    ]
    last, projector = norm(), made("projector", (2048, WIDTH))
    start, out = stream("outliers", rows), torch.full((rows, 2048), torch.nan, device=DEVICE, dtype=torch.bfloat16)

    def of(dtype: torch.dtype, affine: AffineMatrix) -> AffineMatrix:
        matrix, bias = affine
        if isinstance(matrix, ScaledMatrix):
            return (matrix if dtype == torch.bfloat16 else matrix.dequantized()), bias.to(dtype)
        return matrix.to(dtype), bias.to(dtype)

    def tower(vision: VisionOps, dtype: torch.dtype, into: Tensor) -> Tensor:
        x = VisionStream(start.to(dtype))
        for layer, following in zip(layers, (layers[1].qkv[0], projector[0]), strict=True):
            parts: dict[str, Any] = {one.name: of(dtype, getattr(layer, one.name)) for one in dataclasses.fields(layer)}
            typed = VisionLayer(**parts)
            x = vision.layer(typed, x, images=max(rows // 256, 1), heads=16, eps=EPS, following=following)
        (weight, bias) = last
        vision.project(x, (weight.to(dtype), bias.to(dtype)), of(dtype, projector), EPS, into)
        return into

    ours_by, by_plain = fused_ops(DEVICE).vision, VisionByOps(plain.PLAIN)
    assert ours_by is not None
    exact = tower(by_plain, torch.float32, out.float())
    reference = tower(by_plain, torch.bfloat16, out.clone())
    for _ in range(3):
        ours = tower(ours_by, torch.bfloat16, out.clone())
        assert error(ours, exact) < bound * error(reference, exact)
        assert torch.equal(tower(ours_by, torch.bfloat16, out.clone()), ours)


@on_hopper
@pytest.mark.parametrize(("images", "tokens", "dim"), [(1, 256, 72), (3, 256, 72), (2, 128, 64), (2, 116, 24)])
@pytest.mark.parametrize("keys", [64, 128])
def test_keys_loaded_together_are_the_same_keys(images: int, tokens: int, dim: int, keys: int) -> None:
    qkv = random(images * tokens, 3 * 4 * dim)
    alone, pair = (attention_hopper.AttentionTile(dim, keys, sharing=sharing) for sharing in (1, 2))
    expected = attention_hopper.vision_attention(qkv, images, 4, tile=alone)
    for _ in range(5):
        assert torch.equal(attention_hopper.vision_attention(qkv, images, 4, tile=pair), expected)
