"""Products that are added to the residual stream in place: which are, and what comes of it."""

import dataclasses
from typing import Any

import numpy as np
import pytest
import torch
from conftest import on_hopper
from torch import Tensor

pytest.importorskip("triton", reason="Triton isn't installed")

from test_gpu_vision_head import runner_of

from turbopi.backends import Precision
from turbopi.engine.batch import BatchBuffers, BatchSize, PackedPrefix
from turbopi.engine.call import Images
from turbopi.kernels import plain
from turbopi.kernels.interface import VisionStream
from turbopi.kernels.portable.quantize import quantize
from turbopi.kernels.sm90 import vision
from turbopi.kernels.sm90.gemm import bf16, fp8, products
from turbopi.kernels.sm90.gemm.bf16 import Tile
from turbopi.kernels.sm90.gemm.products import ADDING_ROWS, to_knobs
from turbopi.kernels.sm90.gemm.tiles import RESIDUAL_TILES
from turbopi.kernels.sm90.ops import hopper_ops
from turbopi.kernels.sm90.vision import Deferred, FusedVision
from turbopi.kernels.tile_table import TileKey, TileTable
from turbopi.quantization.fp8 import Matrix, to_e4m3

WIDTH, INNER = 64, 128
Ran = list[tuple[str, Tile, str]]


@pytest.fixture
def ran(monkeypatch: pytest.MonkeyPatch) -> Ran:
    """Products as they are called: numbers, tile, epilogue. Nothing is multiplied."""
    called: Ran = []

    def recording(name: str) -> Any:
        def run(x: Tensor, weight: Any, tile: Tile, epilogue: str, *rest: Any, **more: Any) -> Tensor:
            called.append((name, tile, epilogue))
            return x

        return run

    monkeypatch.setattr(products, "matmul", recording("bf16"))
    monkeypatch.setattr(products, "matmul_fp8", recording("fp8"))
    for module in (products, vision):
        monkeypatch.setattr(module, "multiprocessors", lambda device: 132)
    return called


def table(operation: str, numbers: Any, rows: int, tile: Tile | None) -> TileTable:
    return TileTable({TileKey("hopper", operation, numbers, rows, WIDTH, INNER): to_knobs(tile)})


def operands(numbers: str, rows: int) -> tuple[Tensor, Tensor, Matrix]:
    """The stream, what is multiplied, the matrix."""
    x, weight = torch.zeros(rows, INNER), torch.zeros(WIDTH, INNER)
    if numbers == "fp8":
        return torch.zeros(rows, WIDTH), to_e4m3(x, 1.0), quantize(weight + 1, 1.0)
    return torch.zeros(rows, WIDTH), x, weight


@pytest.mark.parametrize("numbers", ["bf16", "fp8"])
@pytest.mark.parametrize(("operation", "with_bias"), [("partial", True), ("parts", False)])
def test_a_whole_product_of_many_rows_is_added(numbers: str, operation: str, with_bias: bool, ran: Ran) -> None:
    tile, bias = Tile(1, 32, overlap=True), torch.zeros(WIDTH) if with_bias else None
    for rows, into_stream in ((ADDING_ROWS, True), (ADDING_ROWS - 64, False)):
        stream, x, weight = operands(numbers, rows)
        measured = table(operation, numbers, rows, tile)
        assert products.added(stream, x, weight, bias, tiles=measured) == into_stream
        assert ran == [(numbers, tile, "added")] * into_stream, "few rows are left to the norm"
        ran.clear()


def test_parts_and_what_the_library_multiplies_are_left_to_the_norm(ran: Ran) -> None:
    given = operands("bf16", ADDING_ROWS)
    for tile in (None, Tile(1, 32, splits=2)):
        assert not products.added(*given, tiles=table("parts", "bf16", ADDING_ROWS, tile))
    gathered = table("partial", "bf16", ADDING_ROWS, Tile(1, 32, splits=2, gather=True))
    assert not products.added(*given, torch.zeros(WIDTH), tiles=gathered) and not ran


def test_a_tile_that_overlaps_also_makes_what_is_not_added(ran: Ran) -> None:
    """The prefix of one observation with four cameras has as many rows, and its embeddings stay."""
    _, x, weight = operands("bf16", ADDING_ROWS)
    tile = Tile(1, 32, overlap=True)
    products.tuned_residual_linear(x, weight, tiles=table("parts", "bf16", ADDING_ROWS, tile))
    assert ran == [("bf16", tile, "plain")] and not tile.takes("parts", 100) and tile.takes("plain", 100)


def test_the_tower_adds_where_the_norm_does_not_bring_the_stream(ran: Ran) -> None:
    tower = FusedVision(plain.vision_attention, table("partial", "bf16", ADDING_ROWS, Tile(1, 32)))
    stream, x, weight = operands("bf16", ADDING_ROWS)
    after = tower._add(VisionStream(stream), x, (weight, torch.zeros(WIDTH)), weight)
    assert after == VisionStream(stream) and [one[2] for one in ran] == ["added"]
    rows, width, inner = next(iter(RESIDUAL_TILES))
    few = torch.zeros(rows, inner), (torch.zeros(width, inner), torch.zeros(width))
    after = tower._add(VisionStream(torch.zeros(rows, width), sums="known"), *few, weight)
    assert isinstance(after.pending, Deferred) and after.sums == "known" and len(ran) == 1, "it runs with the norm"


@on_hopper
@pytest.mark.parametrize("numbers", ["bf16", "fp8"])
@pytest.mark.parametrize("with_bias", [False, True])
@pytest.mark.parametrize(
    "tile",
    [Tile(3, 192), Tile(2, 144, overlap=True), Tile(3, 96, cluster_n=2), Tile(1, 128), Tile(2, 192, 2, overlap=True)],
)
def test_a_product_is_rounded_and_added(numbers: str, with_bias: bool, tile: Tile) -> None:
    """As often as it is run, and to no row or column but its own."""
    m, n, k = 1000, 1160, 1152
    generator = torch.Generator("cuda").manual_seed(0)

    def random(*shape: int) -> Tensor:
        return torch.randn(shape, generator=generator, device="cuda").bfloat16()

    x, weight, bias = random(m, k), random(n, k) / k**0.5, random(n) if with_bias else None
    room = torch.full((m + 64, n), 7.0, device="cuda", dtype=torch.bfloat16)
    stream = room[:m]
    stream.copy_(random(m, n))
    before = stream.clone()
    if numbers == "fp8":
        matrix = quantize(weight, 0.02)
        given = to_e4m3(x, matrix.inverse), matrix, tile
        product = fp8.matmul_fp8(*given, "bias", bias if with_bias else torch.zeros_like(weight[:, 0]))
    else:
        product = bf16.matmul(x, weight, tile, "bias", bias if with_bias else torch.zeros_like(weight[:, 0]))
    expected = before
    for _ in range(2):
        if numbers == "fp8":
            assert fp8.matmul_fp8(*given, "added", bias, stream) is stream
        else:
            assert bf16.matmul(x, weight, tile, "added", bias, stream) is stream
        expected = expected + product
    assert torch.equal(stream, expected) and bool((room[m:] == 7).all())


@on_hopper
@pytest.mark.parametrize("precision", ["bf16", "fp8"])
def test_a_batchs_prefix_of_full_size_is_as_without(precision: Precision) -> None:
    """In the same tiles, whose sums are the same; and the same again on what the run before has left."""
    runner = runner_of(precision)
    config, weights, answers = runner.config, runner._weights, list[bool]()
    sizes = (2240, 2048, 2048), (2240, 2048, 16384)
    whole = TileTable({TileKey("hopper", "parts", "bf16", *size): to_knobs(Tile(3, 192)) for size in sizes})
    usual = hopper_ops(torch.device("cuda", 0), whole)

    def recording(*given: Any) -> bool:
        assert usual.add_linear is not None
        answers.append(usual.add_linear(*given))
        return answers[-1]

    found: list[Tensor] = []
    for add_linear in (None, recording, recording):
        ops = dataclasses.replace(usual, add_linear=add_linear)
        camera_images = Images(config, weights, ops, 8, False, 0)
        camera_images.embs.copy_(torch.randn(camera_images.embs.shape, generator=torch.Generator().manual_seed(0)))
        buffers = BatchBuffers(config, weights, ops, BatchSize(4, 8), camera_images, 4 * 48)
        prefix = PackedPrefix(buffers, 4 * 48)
        prefix.write([2] * 4, [np.arange(1, count) for count in (40, 47, 20, 30)])
        with torch.inference_mode():
            for _ in range(1 + len(found)):
                prefix.run()
        torch.cuda.synchronize()
        rows = int(buffers.segments[:, :4].sum(0)[-1])  # of the observations: behind them lies padding
        found.append(torch.stack((buffers.cache.k[:, :rows], buffers.cache.v[:, :rows])).float())
    assert answers == [True] * 5 * 2 * (config.vlm.depth - 1)
    without, once, again = found
    assert bool(without.isfinite().all()) and torch.equal(once, again)
    far = float((once - without).norm() / without.norm())
    print(f"{precision}: {far:.4f}")
    assert far < (0.02 if precision == "bf16" else 0.08)
