"""The denoising kernel of two observations: each must come out as it does alone, on a GPU against plain PyTorch."""

import dataclasses
from pathlib import Path

import pytest
import torch
from conftest import on_hopper
from kernel_turns.problems import (
    CONFIGS,
    GPU,
    Problem,
    has_nvrtc,
    input_scales,
    ordinary_bf16,
    plain,
    problem,
    relative,
)
from torch import Tensor

from turbopi.kernels.sm90.denoise import kernel as denoise
from turbopi.kernels.sm90.denoise import packing
from turbopi.kernels.sm90.denoise.packing import KINDS, PackedExpert
from turbopi.kernels.sm90.denoise.plain import in_e4m3
from turbopi.models.pi0.denoise import euler_step
from turbopi.support.errors import BackendError

BEFORE = 3  # rows of the cache that are another observation's
SHAPES = pytest.mark.parametrize(
    ("name", "steps", "horizon", "lengths"),
    [
        ("golden", 3, 10, (37, 20)),
        ("golden", 2, 10, (0, 77)),
        ("golden", 2, 25, (77, 0)),
        ("tiny", 3, 16, (300, 1)),
        ("odd", 2, 9, (101, 515)),
        ("uneven", 2, 17, (256, 100)),
        ("shallow", 3, 10, (571, 559)),
        ("shallow", 2, 10, (7, 968)),
        ("shallow", 2, 16, (600, 600)),
        ("shallow", 1, 28, (304, 512)),
        ("full", 10, 10, (559, 600)),
    ],
)


@pytest.mark.slow
@pytest.mark.skipif(not has_nvrtc(), reason="no NVRTC here")
@pytest.mark.parametrize(("suffix", "fp8"), [(20, False), (32, True)])
def test_the_source_compiles_for_hopper(cubins: Path, suffix: int, fp8: bool) -> None:
    arrangement = packing.Arrangement(CONFIGS["full"])
    sizes = denoise.kernel_sizes(arrangement, cache_rows=1440, suffix=suffix, shared_bytes=232448, fp8=fp8, pair=True)
    assert denoise.compiled("sm_90a", sizes, folder=cubins)


def pair_of(p: Problem, lengths: tuple[int, int]) -> tuple[Problem, Problem]:
    """Two observations of one model whose rows lie one behind the other in `p`'s cache, behind BEFORE rows of NaN."""
    p.cache_k[:, :BEFORE] = p.cache_v[:, :BEFORE] = torch.nan
    starts = BEFORE, BEFORE + lengths[0]
    other = torch.randn(p.noise.shape, generator=torch.Generator().manual_seed(sum(lengths))).to(p.noise)
    first, second = (
        dataclasses.replace(
            p,
            noise=noise,
            cache_k=p.cache_k[:, start : start + length],
            cache_v=p.cache_v[:, start : start + length],
            length=length,
        )
        for start, length, noise in zip(starts, lengths, (p.noise, other), strict=True)
    )
    return first, second


def run(p: Problem, pair: tuple[Problem, Problem], packed: PackedExpert) -> tuple[Tensor, Tensor]:
    """x_t [N + 1, 2, H, A] and v_t [N, 2, H, A]"""
    noise = torch.stack([one.noise for one in pair])
    kernel = denoise.DenoiseKernel(
        *(p.config, packed, p.small, p.table),
        cache_rows=p.cache_k.shape[1],
        suffix=2 * noise.shape[1],
        device=GPU,
        pair=True,
    )
    x_t = torch.full((len(p.table) + 1, *noise.shape), torch.nan, device=GPU)
    v_t = torch.full_like(x_t[1:], torch.nan)
    starts = [BEFORE, BEFORE + pair[0].length, BEFORE + pair[0].length + pair[1].length]
    segments = torch.tensor(starts, dtype=torch.int32, device=GPU)
    kernel.launch_pair(noise, p.cache_k, p.cache_v, segments, x_t, v_t)
    torch.cuda.synchronize()
    return x_t, v_t


@on_hopper
@SHAPES
@pytest.mark.parametrize("outliers", [False, True])
def test_each_observation_is_as_exact_as_ordinary_bf16(
    name: str, steps: int, horizon: int, lengths: tuple[int, int], outliers: bool
) -> None:
    """Of small models over several problems, as each has some luck."""
    ours: list[list[float]] = [[], []]
    ordinary: list[list[float]] = [[], []]
    for seed in range(1 if name in ("shallow", "full") else 24):
        p = problem(name, steps, horizon, BEFORE + sum(lengths), seed * 1000 + horizon, GPU, outliers=outliers)
        pair = pair_of(p, lengths)
        x_t, v_t = run(p, pair, PackedExpert.pack(p.config, p.layers))
        assert x_t.isfinite().all() and v_t.isfinite().all()
        torch.testing.assert_close(x_t[1:], euler_step(x_t[:-1], v_t, steps), rtol=0, atol=0)
        for row, one in enumerate(pair):
            reference = plain(one, torch.float64)[0][-1]
            assert torch.equal(x_t[0, row], one.noise)
            ours[row].append(relative(x_t[-1, row], reference))
            ordinary[row].append(relative(ordinary_bf16(one), reference))
    for row in range(2):
        assert sum(x * x for x in ours[row]) <= 1.1**2 * sum(x * x for x in ordinary[row])


@on_hopper
@pytest.mark.parametrize(("name", "lengths"), [("tiny", (300, 120)), ("shallow", (571, 559))])
def test_in_fp8_each_is_as_exact_as_its_emulation(name: str, lengths: tuple[int, int]) -> None:
    """Over several problems, as in `test_kernels_denoise`."""
    ours, emulated = [], []
    for seed in range(4):
        p = problem(name, 2, 10, BEFORE + sum(lengths), seed, GPU)
        pair = pair_of(p, lengths)
        packed = PackedExpert.pack(p.config, p.layers, input_scales(pair[0]))
        x_t, _ = run(p, pair, packed)
        stood_for = [dict(zip(KINDS, packed.matrices(i), strict=True)) for i in range(p.config.expert.depth)]
        layers = [dataclasses.replace(layer, **new) for layer, new in zip(p.layers, stood_for, strict=True)]
        for row, one in enumerate(pair):
            exact = dataclasses.replace(one, layers=layers)
            reference = plain(exact, torch.float64)[0][-1]
            ours.append(relative(x_t[-1, row], reference))
            emulated.append(relative(plain(exact, torch.float64, in_e4m3(packed.inputs))[0][-1], reference))
    assert sum(x * x for x in ours) <= 1.2**2 * sum(x * x for x in emulated)


@on_hopper
def test_what_one_observation_is_changes_nothing_for_the_other() -> None:
    p = problem("shallow", 2, 10, BEFORE + 1100, 5, GPU)
    first, second = pair_of(p, (560, 540))
    packed = PackedExpert.pack(p.config, p.layers)
    before = run(p, (first, second), packed)[0]
    second.cache_k.mul_(3), second.cache_v.neg_(), second.noise.neg_()
    after = run(p, (first, second), packed)[0]
    assert torch.equal(before[:, 0], after[:, 0]) and not torch.equal(before[:, 1], after[:, 1])


@on_hopper
@pytest.mark.parametrize("suffix", [16, 21])
def test_tokens_that_are_no_two_halves_are_refused(suffix: int) -> None:
    p = problem("golden", 1, suffix, 3, 0, GPU)
    with pytest.raises(BackendError, match=f"an even number of tokens above 16, not {suffix}"):
        denoise.DenoiseKernel(
            *(p.config, PackedExpert.pack(p.config, p.layers), p.small, p.table),
            cache_rows=10,
            suffix=suffix,
            device=GPU,
            pair=True,
        )
