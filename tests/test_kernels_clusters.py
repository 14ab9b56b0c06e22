"""Products in clusters among other kernels: no CTA ends before the signals that others send it.

Before its producer waited for them, a graph of these layers failed ("unspecified launch failure") in a few hundred runs
where a CTA of the next kernel found room beside each. A product alone never did.
"""

import pytest
import torch

pytest.importorskip("triton", reason="Triton isn't installed")

from conftest import on_hopper

from turbopi.config import preset
from turbopi.kernels.sm90.gemm.bf16 import Tile
from turbopi.kernels.sm90.gemm.products import to_knobs
from turbopi.kernels.tile_table import NO_TILES, TileKey
from turbopi.tune.in_layers import ExpertLayers, LayersOf

BATCH, TOKENS, PREFIX = 8, 50, 560
RUNS = 600


@pytest.mark.gpu
@on_hopper
@pytest.mark.parametrize("clusters", [(2, 1), (1, 2), (2, 2)])
@pytest.mark.parametrize("columns", [128, 176])  # with room for the next kernel's CTA, and without
@pytest.mark.parametrize("fp8", [False, True])
def test_layers_with_products_in_clusters_go_on_and_on(fp8: bool, columns: int, clusters: tuple[int, int]) -> None:
    config, device = preset("pi05_aloha").planned_model, torch.device("cuda", 0)
    g, tile = config.expert, Tile(1, columns, *clusters, splits=2)
    assert tile.leaves_room == (columns == 128)
    key = TileKey("hopper", "parts", "fp8" if fp8 else "bf16", 448, g.width, g.num_heads * g.head_dim)
    layers = ExpertLayers(config, LayersOf("hopper", fp8, BATCH, TOKENS, PREFIX), device)
    ops = layers.ops(NO_TILES.with_tile(key, to_knobs(tile)))
    expected = layers.run(ops)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        result = layers.run(ops)
    for _ in range(RUNS):
        graph.replay()
    torch.cuda.synchronize()
    assert bool(expected.isfinite().all()) and torch.equal(result, expected)
