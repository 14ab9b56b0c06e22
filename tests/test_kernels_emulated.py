"""The source of our products, run on a CPU thread by thread: its barriers, its copies, its epilogues, its arguments.

The launch is the production code's; g++ stands for NVRTC and tests/emulator/machine.h for a cluster of Hopper.
"""

from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from emulator import emulate
from emulator.emulate import Machine
from torch import Tensor

pytest.importorskip("triton", reason="Triton isn't installed")

from turbopi.kernels import plain
from turbopi.kernels.portable.quantize import quantize
from turbopi.kernels.sm90.gemm import bf16, fp8
from turbopi.kernels.sm90.gemm.bf16 import Copy, Epilogue, Sums, Tile
from turbopi.quantization.fp8 import E4M3, to_e4m3

pytestmark = pytest.mark.skipif(emulate.COMPILER is None, reason="no g++ here")
CPU = torch.device("cpu")
SEEDS = (0, 1, 2, 3)  # of the order in which threads and copies go; with odd ones products read operands at once


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Compiled kernels."""
    return tmp_path_factory.mktemp("emulated")


@pytest.fixture
def machine(monkeypatch: pytest.MonkeyPatch, folder: Path) -> Iterator[Machine]:
    """Room for two clusters, so that each has several tiles; where sums are gathered, for as many as are needed."""
    made = Machine((bf16, fp8), folder, monkeypatch, lambda defines: 99 if defines["TP_GATHER"] else 2)
    yield made
    made(0)


def random(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed + sum(shape))).bfloat16()


def product(x: Tensor, weight: Tensor, bias: Tensor | None, epilogue: Epilogue) -> Tensor:
    """In float32, of the operands as they are."""
    sums = x.float() @ weight.float().T + (0 if bias is None else bias.float())
    return plain.gelu(sums) if epilogue == "gelu" else plain.geglu(sums) if epilogue == "geglu" else sums


BF16_TILES = [  # a ring of 3 is used again and again; clusters of either kind
    ("plain", Tile(1, 16, ring=3)),
    ("gelu", Tile(1, 24, ring=3)),
    ("geglu", Tile(1, 32, ring=3)),
    ("bias", Tile(1, 16, cluster_m=2, ring=3)),
    ("plain", Tile(1, 16, cluster_n=2, ring=3)),
]
MORE_BF16_TILES = [  # sums gathered; an epilogue overlapped
    ("bias", Tile(1, 16, ring=3)),
    ("bias", Tile(1, 32, splits=2, gather=True, ring=3)),
    ("partial", Tile(1, 16, splits=2, ring=3)),
    ("parts", Tile(1, 16, splits=2, ring=3)),
    ("geglu", Tile(1, 32, ring=3, overlap=True)),
    ("plain", Tile(1, 24, ring=3, overlap=True)),
    ("bias", Tile(1, 16, ring=3, overlap=True)),
    ("gelu", Tile(1, 32, cluster_m=2, ring=3, overlap=True)),
    ("added", Tile(1, 16, ring=3)),
    ("added", Tile(1, 24, ring=3, overlap=True)),
]


@pytest.mark.parametrize(
    ("epilogue", "tile"), [*BF16_TILES, *(pytest.param(*one, marks=pytest.mark.slow) for one in MORE_BF16_TILES)]
)
def test_a_product_in_bf16_is_right_in_whatever_order_its_threads_go(
    machine: Machine, epilogue: Epilogue, tile: Tile
) -> None:
    m, n, k = 136, 40, 504
    x, weight = random(m, k), random(2 * n if epilogue == "geglu" else n, k, seed=1) / k**0.5
    bias = random(n) if epilogue in ("bias", "gelu", "partial", "added") else None
    expected = product(x, weight, bias, epilogue)
    stream = random(m, n, seed=8) if epilogue == "added" else None
    if stream is not None:
        expected = (expected.bfloat16() + stream).float()
    for seed in SEEDS:
        machine(seed)
        residual = sums = None
        if tile.gather:
            residual, sums = random(m, n, seed=9), Sums.allocate(tile, m, n, CPU)
        into = None if stream is None else stream.clone()
        out = bf16.matmul(x, weight, tile, epilogue, bias, into, residual=residual, sums_out=sums).float()
        out = out.sum(0) if epilogue in ("partial", "parts") else out
        wanted = expected if residual is None else expected + residual.float()
        torch.testing.assert_close(out, wanted, rtol=1e-2, atol=1e-2)
        if sums is not None:
            both = torch.stack((out.sum(1), out.square().sum(1)), dim=1)
            torch.testing.assert_close(sums.parts.sum(0), both, rtol=1e-4, atol=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("epilogue", "tile", "inverse"),
    [
        ("plain", Tile(1, 16, ring=3), None),
        ("gelu", Tile(1, 32, ring=3), 20.0),
        ("geglu", Tile(1, 64, ring=3), None),
        ("plain", Tile(1, 24, ring=3, overlap=True), None),
        ("gelu", Tile(1, 16, ring=3, overlap=True), 20.0),
        ("added", Tile(1, 24, ring=3), None),
        ("added", Tile(1, 16, ring=3, overlap=True), None),
    ],
)
def test_a_product_in_fp8_is_right_in_whatever_order_its_threads_go(
    machine: Machine, epilogue: Epilogue, tile: Tile, inverse: float | None
) -> None:
    m, n, k = 72, 40, 1008
    weight = quantize(random(2 * n if epilogue == "geglu" else n, k, seed=1) / k**0.5, 0.01)
    x, bias = to_e4m3(random(m, k), weight.inverse), random(n) if epilogue in ("gelu", "added") else None
    stream = random(m, n, seed=8) if epilogue == "added" else None
    sums = weight.product(x, bias) + (0 if stream is None else stream.float())
    expected = plain.gelu(sums) if epilogue == "gelu" else plain.geglu(sums) if epilogue == "geglu" else sums
    for seed in SEEDS[:2]:
        machine(seed)
        into = None if stream is None else stream.clone()
        out = fp8.matmul_fp8(x, weight, tile, epilogue, bias, into, inverse)
        assert out.dtype == (torch.bfloat16 if inverse is None else E4M3)
        error = (out.float() / (inverse or 1) - expected).norm() / expected.norm()
        assert error < (0.006 if inverse is None else 0.03)


def test_an_fp8_product_leaves_a_copy_that_is_normed_with_the_norms_scale_and_shift(
    machine: Machine,
) -> None:
    m, n, k = 72, 40, 256
    tile = Tile(1, 24, ring=3)
    weight = quantize(random(n, k, seed=1) / k**0.5, 0.01)
    x, bias, residual = to_e4m3(random(m, k), weight.inverse), random(n), 4 * random(m, n, seed=9)
    before = residual.float()
    sums_in = Sums(torch.stack((before.sum(1), before.square().sum(1)), dim=1)[None].contiguous())
    scale, shift = 20 + torch.rand(n), 5 * torch.randn(n)
    made, unmade = Sums.allocate(tile, m, n, CPU), Sums.allocate(tile, m, n, CPU)
    copy = Copy(torch.empty(m, n).to(E4M3), sums_in, scale, shift, 1e-6, unmade)
    machine(0)
    out = fp8.matmul_fp8(x, weight, tile, "bias", bias, residual=residual, sums_out=made, copy=copy).float()
    torch.testing.assert_close(out, weight.product(x, bias) + before, rtol=1e-2, atol=2e-2)
    normed = (out - before.mean(1, keepdim=True)) / before.var(1, correction=0, keepdim=True).sqrt()
    wanted = normed * scale + shift
    assert (copy.out.float() - wanted).norm() / wanted.norm() < 0.03
    torch.testing.assert_close(
        unmade.parts.sum(0), torch.stack((out.sum(1), out.square().sum(1)), dim=1), rtol=1e-4, atol=1e-2
    )


def test_an_instruction_that_the_machine_does_not_know_is_named() -> None:
    with pytest.raises(NotImplementedError, match=r"no instruction for: elect\.sync"):
        emulate.translated('void f() { asm volatile("elect.sync _|p, %0;" ::"r"(1)); }')
