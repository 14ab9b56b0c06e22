"""The source of Hopper's attention, run on a CPU thread by thread: see test_kernels_emulated.py."""

import re
import subprocess
from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest
import torch
from emulator import emulate
from emulator.emulate import Machine
from torch import Tensor

pytest.importorskip("triton", reason="Triton isn't installed")

import machine_code

from turbopi.engine.packing import pack_rows
from turbopi.kernels import nvrtc, plain, plain_batch
from turbopi.kernels.interface import Segments
from turbopi.kernels.sm90.attention import kernel as attention
from turbopi.kernels.sm90.attention import suffix
from turbopi.kernels.sm90.attention.kernel import AttentionTile
from turbopi.kernels.sm90.attention.suffix_tile import FewTile, SuffixTile
from turbopi.quantization.fp8 import E4M3
from turbopi.support.errors import BackendUnavailable

pytestmark = [pytest.mark.slow, pytest.mark.skipif(emulate.COMPILER is None, reason="no g++ here")]
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


@pytest.mark.parametrize(
    ("tile", "length"), [(AttentionTile(24, 16), 1), (AttentionTile(24, 16), 70), (AttentionTile(24, 32, 1), 80)]
)
def test_prefix(machine: Machine, tile: AttentionTile, length: int) -> None:
    """NaN beyond the length never counts; a query's shows in its own row alone."""
    heads, slots = 2, 80
    q, k, v = random(slots * heads, tile.dim), random(slots, tile.dim, seed=1), random(slots, tile.dim, seed=2)
    k[:, ::7] *= 8
    on_device = torch.tensor([length])
    exact = plain.attention(q.float(), k.float(), v.float(), on_device, slots, heads).view_as(q)
    k[length:], v[length:], q[3, 5] = torch.nan, torch.nan, torch.nan
    others = [row for row in range(len(q)) if row != 3]
    for seed in SEEDS:
        machine(seed)
        ours = attention.prefix_attention(q, k, v, on_device, heads, tile=tile).view_as(q)
        assert_close(ours[others], exact[others])
        assert ours[3].isnan().all()


def test_packed(machine: Machine) -> None:
    """Observations of which one ends in the middle of a pair of tiles, and NaN that others must not see."""
    tile, heads, lengths, spare = AttentionTile(24, 16, wide=True), 4, [33, 3, 20], 5
    rows = sum(lengths) + spare
    prompts = [np.arange(length, dtype=np.int64) for length in lengths]
    made = pack_rows([0] * 3, prompts, batch=3, rows=rows, per_image=1, heads=heads)
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
        (SuffixTile(192, 24, 8, 16), [150], 6),  # 24 columns a rank
        (FewTile(64, 40, 2, 80, 2), [40, 0, 5], 10),
        (FewTile(64, 40, 4, 80, 2), [330, 7], 10),  # two tiles of keys a rank
        (FewTile(64, 40, 8, 80, 4), [6], 10),  # ranks without keys; warpgroups without columns
        (FewTile(128, 24, 2, 64, 4), [50], 11),  # two clusters an observation, the second one not full
        (FewTile(192, 72, 2, 80, 4), [50], 18),  # two blocks of rows
        (FewTile(192, 8, 1, 144, 2), [140], 2),  # a product reads a panel behind the values'
        (FewTile(256, 40, 6, 80, 2), [150], 20),  # of the suffix's keys more than are loaded beside queries
    ],
)
def test_suffix(
    machine: Machine, tile: SuffixTile | FewTile, lengths: list[int], tokens: int, state_token: bool
) -> None:
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


@pytest.mark.parametrize("tile", [SuffixTile(64, 40, 4, 16), FewTile(64, 40, 4, 48, 2)])
def test_nan_in_a_token_shows_in_its_row_alone(machine: Machine, tile: SuffixTile | FewTile) -> None:
    heads, tokens = 4, 10
    qkv, cache = random(tokens, (heads + 2) * tile.dim), random(90, tile.dim, seed=1)
    qkv[2, tile.dim + 5] = torch.nan  # of its second head's query
    angles = torch.ones(tokens, tile.dim // 2)
    starts, sizes = torch.tensor([0, 90], dtype=torch.int32), torch.tensor([90, 0], dtype=torch.int32)
    for seed in SEEDS:
        machine(seed)
        ours = suffix.suffix_attention(qkv, angles, angles, cache, cache, starts, sizes, heads, tile=tile)
        assert torch.equal(ours.view(-1, tile.dim).isnan().any(1).nonzero(), torch.tensor([[2 * heads + 1]]))
        assert ours.view(-1, tile.dim)[2 * heads + 1].isnan().all()


def test_where_no_cluster_fits_it_is_asked_once(monkeypatch: pytest.MonkeyPatch) -> None:
    requested = []

    def no_room(*given: object, cluster: int, **rest: object) -> None:
        requested.append(cluster)
        raise BackendUnavailable("no room for one")

    monkeypatch.setattr(suffix, "compile_cubin", lambda *given: b"")
    monkeypatch.setattr(suffix, "DependentKernel", no_room)
    monkeypatch.setattr(torch.cuda, "device", lambda device: nullcontext())
    for _ in range(2):
        tile = suffix.chosen_tile(64, 40, 3, 100, False, torch.device("meta"))
        with pytest.raises(BackendUnavailable, match="no room for one"):
            suffix._kernel(tile, False, torch.device("meta"))
    suffix._kernel_or_why_not.cache_clear()
    assert requested == [8, 6, 8, 4, 2, 1], (
        "of two warpgroups, of suffix.cu; never of four, which have as many clusters"
    )


def test_what_leaves_in_fp8_is_scaled(machine: Machine, monkeypatch: pytest.MonkeyPatch) -> None:
    for module in (attention, suffix):
        monkeypatch.setattr(module, "result_dtype", lambda x, inverse, numbers=E4M3: numbers)  # as on a GPU
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
    for tile in (SuffixTile(64, 40, 2, 32), FewTile(64, 40, 2, 48, 2)):
        ours = suffix.suffix_attention(*given, inverse=30.0, tile=tile)
        assert ours.dtype == E4M3
        torch.testing.assert_close(ours.float(), 30 * plain_batch.suffix_attention(*given).float(), atol=0.1, rtol=0.07)


@pytest.mark.skipif(machine_code.compiler() is None, reason="no NVRTC here")
def test_weights_are_made_while_values_are_multiplied(folder: Path) -> None:
    """In wide.cu's machine code for two warpgroups: where ptxas waits for values first, nothing hides the weights."""
    import triton

    tile = AttentionTile(256, 80, wide=True)
    made = nvrtc.compile_cubin(attention.source(tile), "sm_90a", attention.constants(tile, False), folder=folder)
    file = folder / "wide.cubin"
    file.write_bytes(made)
    command = [triton.knobs.nvidia.cuobjdump.path, "-sass", file]
    code = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    logits_there, values_there = (rf"WARPGROUP\.DEPBAR\.LE gsb0, 0x{left}" for left in (1, 0))
    between = re.search(f"{logits_there}(.*?){values_there}", code, re.DOTALL)
    assert between is not None and between[1].count("MUFU.EX2") >= tile.keys // 2
