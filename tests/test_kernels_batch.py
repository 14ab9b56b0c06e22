"""Triton's kernels for several observations' rows equal their plain twins, and keep observations apart.

In float32 through Triton's interpreter, or on a GPU in bfloat16: see test_kernels_ops.py.
"""

import itertools
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch
from conftest import gpu_or_interpreter, on_hopper
from torch import Tensor

ON_GPU = torch.cuda.is_available()
pytest.importorskip("triton", reason="Triton isn't installed")

from turbopi.engine.packing import pack_rows  # noqa: E402
from turbopi.kernels import plain, plain_batch  # noqa: E402
from turbopi.kernels.interface import Segments, StepEnd  # noqa: E402
from turbopi.kernels.portable import batch as portable_batch  # noqa: E402
from turbopi.kernels.portable import batch_steps, norms  # noqa: E402
from turbopi.kernels.sm90.attention import kernel as attention  # noqa: E402
from turbopi.kernels.sm90.attention import suffix  # noqa: E402
from turbopi.kernels.sm90.attention.suffix_tile import KEYS, RANKS, FewTile, SuffixTile  # noqa: E402
from turbopi.quantization.fp8 import E4M3  # noqa: E402

DEVICE = torch.device("cuda" if ON_GPU else "cpu")
DTYPE = torch.bfloat16 if ON_GPU else torch.float32
TOLERANCE = 2e-2 if ON_GPU else 2e-5
pytestmark = gpu_or_interpreter()
HEADS, DIM = 4, 24


def random(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed)).to(DEVICE, DTYPE)


def packed(lengths: list[int], spare: int, batch: int) -> tuple[Segments, Tensor]:
    """Segments of observations of prompts alone, and where their rows come from."""
    prompts = [np.arange(length, dtype=np.int64) for length in lengths]
    rows = sum(lengths) + spare
    made = pack_rows([0] * len(lengths), prompts, batch=batch, rows=rows, per_image=1, heads=HEADS)
    segments, tiles = torch.from_numpy(made.segments).to(DEVICE), torch.from_numpy(made.tiles).to(DEVICE)
    return Segments(segments[0], segments[1], tiles), torch.from_numpy(made.source).to(DEVICE)


LENGTHS = pytest.mark.parametrize(
    ("lengths", "spare", "batch"), [([70, 3, 33], 5, 4), ([1], 0, 1), ([16, 16], 16, 2), ([9] * 8, 0, 8)]
)


@LENGTHS
def test_packed_attention(lengths: list[int], spare: int, batch: int) -> None:
    check_packed(portable_batch.packed_attention, lengths, spare, batch)


@LENGTHS
def test_packed_attention_leaves_in_int8(lengths: list[int], spare: int, batch: int) -> None:
    segments, _ = packed(lengths, spare, batch)
    rows = sum(lengths)
    q, k, v = random((rows + spare) * HEADS, DIM), random(rows + spare, DIM, seed=1), random(rows + spare, DIM, seed=2)
    to: dict[str, Any] = {"inverse": 40.0, "numbers": torch.int8}
    ours = portable_batch.packed_attention(q, k, v, segments, HEADS, **to)[:rows]
    reference = plain_batch.packed_attention(q, k, v, segments, HEADS)[:rows].float()
    assert ours.dtype == torch.int8 and int(ours.abs().max()) > 30
    rounding, before = 0.5, 40 * TOLERANCE * (1 + reference.abs())  # as `check_packed` allows before it is rounded
    assert bool(((ours.float() - 40 * reference).abs() <= rounding + before).all())


def test_damage_in_int8_shows_in_the_values_of_its_own_observation() -> None:
    segments, _ = packed([5, 3], 1, 2)
    q, k, v = random(9 * HEADS, DIM), random(9, DIM, seed=1), random(9, DIM, seed=2)
    q[6 * HEADS + 1, 4] = torch.nan
    portable_batch.packed_attention(q, k, v, segments, HEADS, inverse=40.0, numbers=torch.int8)
    assert v.isnan().nonzero().tolist() == [[6, 0]]


@on_hopper
@LENGTHS
def test_packed_attention_on_hopper(lengths: list[int], spare: int, batch: int) -> None:
    check_packed(attention.packed_attention, lengths, spare, batch)


@on_hopper
@pytest.mark.parametrize("inverse", [None, 55.0])
def test_packed_attention_on_hopper_of_heads_of_256(inverse: float | None) -> None:
    """NaN in the padding's rows, which lie in the last observation's last tile of keys, never counts."""
    dim, rows = 256, 473
    segments, _ = packed([300, 3, 170], 7, 4)
    q, k, v = random(480 * HEADS, dim), random(480, dim, seed=1), random(480, dim, seed=2)
    reference = plain_batch.packed_attention(q, k, v, segments, HEADS)[:rows].float()
    k[rows:], v[rows:] = torch.nan, torch.nan
    ours = attention.packed_attention(q, k, v, segments, HEADS, inverse).float()
    assert bool(ours[rows:].isnan().all())
    if inverse is None:
        torch.testing.assert_close(ours[:rows], reference, atol=TOLERANCE, rtol=TOLERANCE)
    else:
        assert_rounded_to_e4m3(ours[:rows] / inverse, reference)


def assert_rounded_to_e4m3(ours: Tensor, reference: Tensor) -> None:
    assert float((ours - reference).norm() / reference.norm()) < 0.035


def check_packed(attend: Callable[..., Tensor], lengths: list[int], spare: int, batch: int) -> None:
    segments, _ = packed(lengths, spare, batch)
    rows = sum(lengths) + spare
    q, k, v = random(rows * HEADS, DIM), random(rows, DIM, seed=1), random(rows, DIM, seed=2)
    ours = attend(q, k, v, segments, HEADS)
    torch.testing.assert_close(
        ours, plain_batch.packed_attention(q, k, v, segments, HEADS), atol=TOLERANCE, rtol=TOLERANCE
    )
    at = 0
    for length in lengths:  # and what each gets alone
        own = slice(at, at + length)
        logits = q.view(rows, HEADS, DIM)[own].flatten(0, 1).float() @ k[own].float().T * DIM**-0.5
        alone = (logits.softmax(-1) @ v[own].float()).view(length, HEADS * DIM)
        torch.testing.assert_close(ours[own].float(), alone, atol=TOLERANCE, rtol=TOLERANCE)
        at += length


@pytest.mark.slow
@pytest.mark.parametrize("state_token", [False, True])
@pytest.mark.parametrize("blocks", [1, 1000])
@pytest.mark.parametrize("lengths", [[300, 0, 5], [64, 129]])
def test_suffix_attention(lengths: list[int], blocks: int, state_token: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """With keys in one block or split over several."""
    monkeypatch.setattr(portable_batch, "BLOCKS_AT_ONCE", blocks)
    check_suffix(portable_batch.suffix_attention, lengths, 3, state_token, HEADS, DIM)


@pytest.mark.parametrize("damage", [torch.nan, torch.inf])
def test_a_damaged_value_shows_in_its_own_observation_alone(damage: float) -> None:
    sizes = torch.tensor([5, 4, 0], dtype=torch.int32)
    starts, sizes = (sizes.cumsum(0) - sizes).int().to(DEVICE), sizes.to(DEVICE)
    qkv, k, v = random(6, (HEADS + 2) * DIM), random(12, DIM, seed=1), random(12, DIM, seed=2)
    v[3, 0] = damage  # of the first one
    for attend in (portable_batch.suffix_attention, plain_batch.suffix_attention):
        rows = attend(qkv, *angles(6, DIM), k, v, starts, sizes, HEADS).isfinite().all(1)
        assert rows.tolist() == [False] * 3 + [True] * 3


@on_hopper
@pytest.mark.parametrize("state_token", [False, True])
@pytest.mark.parametrize("tokens", [3, 10, 51])
@pytest.mark.parametrize(("heads", "dim"), [(4, 64), (8, 256)])
@pytest.mark.parametrize("lengths", [[300, 0, 5], [64, 129], [560, 547, 816, 1] * 4])
def test_suffix_attention_on_hopper(lengths: list[int], heads: int, dim: int, tokens: int, state_token: bool) -> None:
    check_suffix(suffix.suffix_attention, lengths, tokens, state_token, heads, dim)


@on_hopper
@pytest.mark.parametrize("state_token", [False, True])
@pytest.mark.parametrize(
    "tile",
    [
        *(SuffixTile(256, 80, ranks, keys) for ranks, keys in itertools.product(RANKS, KEYS)),
        *(FewTile(256, 40, ranks, keys, 2) for ranks, keys in ((8, 80), (6, 96), (6, 64), (6, 144), (1, 80))),
        *(FewTile(256, 80, ranks, keys, 4) for ranks, keys in ((8, 80), (6, 96), (6, 144), (3, 96))),
    ],
    ids=str,
)
def test_suffix_attention_on_hopper_in_clusters_of_any_size(tile: SuffixTile | FewTile, state_token: bool) -> None:
    check_suffix(partial(suffix.suffix_attention, tile=tile), [560, 0, 547], 10, state_token, 8, 256)


@on_hopper
@pytest.mark.parametrize("dim", [64, 128, 192])
def test_suffix_attention_of_many_queries_on_hopper_of_other_heads(dim: int) -> None:
    tile = SuffixTile(dim, 104, 2, 64)
    check_suffix(partial(suffix.suffix_attention, tile=tile), [300, 0, 129], 51, True, 8, dim)


@on_hopper
@pytest.mark.parametrize("state_token", [False, True])
@pytest.mark.parametrize("dim", [128, 192])
def test_suffix_attention_on_hopper_of_other_heads(dim: int, state_token: bool) -> None:
    check_suffix(suffix.suffix_attention, [300, 0, 129], 10, state_token, 4, dim)


@on_hopper
@pytest.mark.parametrize("dim", [64, 192, 256])
def test_suffix_attention_on_hopper_leaves_in_e4m3(dim: int) -> None:
    heads, tokens, sizes = 8, 10, torch.tensor([300, 0, 129, 0], dtype=torch.int32)
    starts, sizes = (sizes.cumsum(0) - sizes).int().to(DEVICE), sizes.to(DEVICE)
    qkv, cache = random(3 * tokens, (heads + 2) * dim), random(429, dim, seed=1)
    given = (qkv, *angles(3 * tokens, dim), cache, cache, starts, sizes, heads)
    ours = suffix.suffix_attention(*given, inverse=55.0)
    assert ours.dtype == E4M3
    assert_rounded_to_e4m3(ours.float() / 55, plain_batch.suffix_attention(*given).float())


def check_suffix(
    attend: Callable[..., Tensor], lengths: list[int], tokens: int, state_token: bool, heads: int, dim: int
) -> None:
    """As the twin, and as each observation alone; the same again; NaN beyond an observation's rows never counts."""
    sizes = torch.tensor([*lengths, 0], dtype=torch.int32)
    starts, sizes, batch = (sizes.cumsum(0) - sizes).int().to(DEVICE), sizes.to(DEVICE), len(lengths)
    prefix_k, prefix_v = random(sum(lengths) + 400, dim), random(sum(lengths) + 400, dim, seed=1)
    prefix_k[sum(lengths) :] = prefix_v[sum(lengths) :] = torch.nan
    turn, qkv = angles(batch * tokens, dim), random(batch * tokens, (heads + 2) * dim, seed=2)
    given = (qkv, *turn, prefix_k, prefix_v, starts, sizes, heads, state_token)
    ours = attend(*given)
    torch.testing.assert_close(ours, plain_batch.suffix_attention(*given), atol=TOLERANCE, rtol=TOLERANCE)
    assert torch.equal(attend(*given), ours)
    k, v = torch.empty(batch * tokens, dim, device=DEVICE, dtype=DTYPE), qkv[:, -dim:]
    q = plain.rope_split(qkv, *turn, k, torch.empty_like(k))
    at = 0
    for row, length in enumerate(lengths):
        own, mine = slice(at, at + length), slice(row * tokens, (row + 1) * tokens)
        keys, values = (torch.cat((x[own], y[mine])).float() for x, y in ((prefix_k, k), (prefix_v, v)))
        logits = q.view(-1, heads, dim)[mine].float() @ keys.T * dim**-0.5  # [T, n, keys]
        if state_token:
            logits[0, :, length + 1 :] = -torch.inf
        torch.testing.assert_close(
            ours[mine].float(), (logits.softmax(-1) @ values).flatten(1), atol=TOLERANCE, rtol=TOLERANCE
        )
        at += length


def angles(tokens: int, dim: int) -> tuple[Tensor, Tensor]:
    """Cosines and sines float32[tokens, K/2]: other ones for each token, so that a row's neighbour's show."""
    turned = torch.rand(tokens, dim // 2, generator=torch.Generator().manual_seed(9)).to(DEVICE) * 6
    return turned.cos(), turned.sin()


def test_keys_are_split_as_there_are_blocks_to_fill() -> None:
    assert portable_batch.suffix_splits(40, 720, 64) == 6
    assert portable_batch.suffix_splits(40, 100, 64) == 1 and portable_batch.suffix_splits(1000, 720, 64) == 1


def test_embedding_rows() -> None:
    camera_images, table, source = random(6, 20), random(9, 20, seed=1), torch.tensor([2, -1, -9, 5, 0], device=DEVICE)
    ours, reference = torch.empty(5, 20, device=DEVICE, dtype=DTYPE), torch.empty(5, 20, device=DEVICE, dtype=DTYPE)
    portable_batch.embed_rows(source, camera_images, table, ours)
    plain_batch.embed_rows(source, camera_images, table, reference)
    assert torch.equal(ours, reference) and torch.equal(ours[[0, 3, 4]], camera_images[[2, 5, 0]])


@pytest.mark.slow
@pytest.mark.parametrize("parts", [None, 0, 3])
@pytest.mark.parametrize(("gated", "shifted"), [(True, True), (False, True), (False, False)])
@pytest.mark.parametrize("width", [64, 96])
def test_the_experts_norm_is_that_of_one_observation(parts: int | None, gated: bool, shifted: bool, width: int) -> None:
    """`norms.residual_rms_norm`, whose twin is compared with it elsewhere: the same to the last bit."""
    tokens = 5
    y = None if parts is None else random(*([parts] if parts else []), tokens, width, seed=1)
    gate, scale, shift = (random(width, seed=seed).float() for seed in (2, 3, 4))
    given = (random(tokens, width), y, gate if gated and y is not None else None, scale, shift if shifted else None)
    for rounded in ({}, {"inverse": 30.0, "numbers": torch.int8}):
        ours, theirs = (one.residual_rms_norm(*given, 1e-6, **rounded) for one in (batch_steps, norms))
        assert torch.equal(ours[0], theirs[0]) and torch.equal(ours[1], theirs[1])
        assert ours[1].dtype == rounded.get("numbers", DTYPE) and bool(ours[1].float().abs().max() > 0)


def test_the_experts_norm_of_rows_with_their_own_modulation() -> None:
    x, y = random(5, 64), random(5, 64, seed=1)
    gate, scale, shift = (random(5, 64, seed=seed).float() for seed in (2, 3, 4))
    ours = batch_steps.residual_rms_norm(x, y, gate, scale, shift, 1e-6)
    reference = plain.residual_rms_norm(x, y, gate, scale, shift, 1e-6)
    torch.testing.assert_close(ours, reference, atol=TOLERANCE, rtol=TOLERANCE)


@pytest.mark.parametrize("parts", [0, 2])
@pytest.mark.parametrize("gated", [False, True])
@pytest.mark.parametrize(("rows", "width", "actions"), [(6, 64, 32), (3, 96, 7), (265, 64, 8)])
def test_a_steps_end(rows: int, width: int, actions: int, gated: bool, parts: int) -> None:
    x, y = random(rows, width), random(*([parts] if parts else []), rows, width, seed=1)
    gate, scale, shift = (random(width, seed=seed).float() for seed in (2, 3, 4))
    out = random(actions, width, seed=5).float() / width**0.5, random(actions, seed=6).float()
    into = random(width, actions, seed=7).float() / actions**0.5, random(width, seed=8).float()
    end = StepEnd(scale, shift, 1e-6, out, -0.1, into)
    x_t = random(rows, actions, seed=9).float()
    ours, reference = ([torch.full((rows, actions), torch.nan, device=DEVICE) for _ in range(2)] for _ in range(2))
    given = gate if gated else None, end, x_t
    tokens = batch_steps.end_step(x.clone(), y, *given, *ours)
    whole = y.float().sum(0).to(DTYPE) if parts else y
    expected = plain_batch.end_step(x, whole, *given, *reference)
    torch.testing.assert_close(ours, reference, atol=TOLERANCE, rtol=TOLERANCE)
    torch.testing.assert_close(tokens, expected, atol=TOLERANCE, rtol=TOLERANCE)
    assert tokens.dtype == x.dtype and torch.equal(ours[0], ours[0]) and bool((ours[0] != x_t).any())
