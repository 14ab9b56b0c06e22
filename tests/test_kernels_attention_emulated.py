"""The source of Hopper's attention, run on a CPU thread by thread: see test_kernels_emulated.py."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from emulator import emulate
from emulator.emulate import Machine
from torch import Tensor

pytest.importorskip("triton", reason="Triton isn't installed")

from turbopi.engine.packing import pack_rows
from turbopi.kernels import plain, plain_batch
from turbopi.kernels.interface import Segments
from turbopi.kernels.sm90.attention import kernel as attention
from turbopi.kernels.sm90.attention import suffix
from turbopi.kernels.sm90.attention.kernel import AttentionTile
from turbopi.kernels.sm90.attention.suffix_tile import SuffixTile
from turbopi.quantization.fp8 import E4M3

pytestmark = pytest.mark.skipif(emulate.COMPILER is None, reason="no g++ here")
SEEDS = (0, 1, 5)  # of the order in which threads go; with 1 and 5 products read at once, with 5 a CTA stands still


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Compiled kernels."""
    return tmp_path_factory.mktemp("emulated")


@pytest.fixture
def machine(monkeypatch: pytest.MonkeyPatch, folder: Path) -> Iterator[Machine]:
    """Room for two clusters, so that wide kernels go from unit to unit."""
    made = Machine((attention, suffix), folder, monkeypatch)
    yield made
    made(0)


def random(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed)).bfloat16()


def assert_close(ours: Tensor, exact: Tensor) -> None:
    torch.testing.assert_close(ours.float(), exact.float(), atol=1e-2, rtol=1e-2)


@pytest.mark.parametrize(
    ("tile", "tokens"),
    [
        (AttentionTile(24, 16, wide=True, queries=2), 300),
        (AttentionTile(24, 32, 1, wide=True), 150),
        (AttentionTile(72, 64, 4, wide=True), 256),
        (AttentionTile(24, 64, sharing=2), 128),
        (AttentionTile(24, 32), 64),
    ],
)
def test_vision(machine: Machine, tile: AttentionTile, tokens: int) -> None:
    images, heads = 1, 2
    qkv = random(images * tokens, 3 * heads * tile.dim)
    qkv[:, ::17] *= 8
    exact = plain.vision_attention(qkv.float(), images, heads)
    for seed in SEEDS[: 1 if tokens > 200 else 3]:
        machine(seed)
        assert_close(attention.vision_attention(qkv, images, heads, tile=tile), exact)


def test_packed(machine: Machine) -> None:
    """Observations of which one ends in the middle of a pair of tiles, and NaN that others must not see."""
    tile, heads, lengths, spare = AttentionTile(24, 16, wide=True), 4, [33, 3, 20], 5
    rows = sum(lengths) + spare
    prompts = [np.arange(length, dtype=np.int64) for length in lengths]
    made = pack_rows([0] * 3, prompts, batch=3, rows=rows, per_picture=1, heads=heads)
    starts, sizes = torch.from_numpy(made.segments)
    segments = Segments(starts, sizes, torch.from_numpy(made.tiles))
    q, k, v = random(rows * heads, tile.dim), random(rows, tile.dim, seed=1), random(rows, tile.dim, seed=2)
    exact = plain_batch.packed_attention(q.float(), k.float(), v.float(), segments, heads)
    k[33:36], v[33:36] = torch.nan, torch.nan
    others = [*range(33), *range(36, rows)]
    for seed in SEEDS:
        machine(seed)
        ours = attention.packed_attention(q, k, v, segments, heads, tile=tile)
        assert_close(ours[others], exact[others])
        assert ours[33:36].isnan().all()


@pytest.mark.parametrize("state_token", [False, True])
@pytest.mark.parametrize(
    ("tile", "lengths", "tokens"),
    [
        (SuffixTile(64, 40, 2, 16), [40, 0, 5], 10),  # two tiles of rows a rank
        (SuffixTile(64, 40, 4, 16), [60, 7], 10),  # ranks without keys
        (SuffixTile(64, 72, 1, 16), [33], 18),  # two warpgroups
        (SuffixTile(128, 24, 2, 32), [50], 11),  # two clusters an observation, the second one not full
    ],
)
def test_suffix(machine: Machine, tile: SuffixTile, lengths: list[int], tokens: int, state_token: bool) -> None:
    """NaN beyond an observation's rows, and in another observation's, never counts."""
    heads, batch, rows = 4, len(lengths), sum(lengths)
    qkv = random(batch * tokens, (heads + 2) * tile.dim)
    k, v = random(rows + 40, tile.dim, seed=1), random(rows + 40, tile.dim, seed=2)
    k[rows:] = v[rows:] = torch.nan
    angles = 6 * torch.rand(batch * tokens, tile.dim // 2, generator=torch.Generator().manual_seed(3))
    sizes = torch.tensor([*lengths, 0], dtype=torch.int32)
    starts = (sizes.cumsum(0) - sizes).int()
    given = (angles.cos(), angles.sin(), k, v, starts, sizes, heads, state_token)
    exact = plain_batch.suffix_attention(qkv, *given)
    if batch > 1:
        k[lengths[0] : sum(lengths[:2])] = torch.nan
    for seed in SEEDS:
        machine(seed)
        ours = suffix.suffix_attention(qkv, *given, tile=tile)
        assert_close(ours[:tokens], exact[:tokens])
        if batch > 2:
            assert_close(ours[2 * tokens :], exact[2 * tokens :])


def test_what_leaves_in_fp8_is_scaled(machine: Machine, monkeypatch: pytest.MonkeyPatch) -> None:
    for module in (attention, suffix):
        monkeypatch.setattr(module, "result_dtype", lambda x, inverse: E4M3)  # as on a GPU
    heads, tokens, length = 4, 10, 40
    machine(0)
    qkv = random(tokens, 3 * heads * 24)
    ours = attention.vision_attention(qkv, 1, heads, 30.0, tile=AttentionTile(24, 16, wide=True))
    assert ours.dtype == E4M3
    exact = 30 * plain.vision_attention(qkv.float(), 1, heads)
    torch.testing.assert_close(ours.float(), exact, atol=0.1, rtol=0.07)
    qkv, cache = random(tokens, (heads + 2) * 64), random(length, 64, seed=1)
    angles = torch.rand(tokens, 32, generator=torch.Generator().manual_seed(3))
    starts, sizes = torch.tensor([0, length], dtype=torch.int32), torch.tensor([length, 0], dtype=torch.int32)
    given = (qkv, angles.cos(), angles.sin(), cache, cache, starts, sizes, heads)
    ours = suffix.suffix_attention(*given, inverse=30.0, tile=SuffixTile(64, 40, 2, 32))
    assert ours.dtype == E4M3
    torch.testing.assert_close(ours.float(), 30 * plain_batch.suffix_attention(*given).float(), atol=0.1, rtol=0.07)
