"""The source of our products, run on a CPU thread by thread: its barriers, its copies, its epilogues, its arguments.

The launch is the production code's; g++ stands for NVRTC and tests/emulator/machine.h for a cluster of Hopper.
"""

import dataclasses
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import pytest
import torch
from emulator import emulate
from torch import Tensor

pytest.importorskip("triton", reason="Triton isn't installed")

from turbopi.kernels import plain
from turbopi.kernels.portable.quantize import quantize
from turbopi.kernels.sm90 import instructions
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
def machine(monkeypatch: pytest.MonkeyPatch, folder: Path) -> Iterator[Callable[[int], None]]:
    """`machine(seed)`: launches go to a machine that takes turns in that order and has room for two clusters, so that
    each has several tiles; where sums are gathered, for as many as are needed.
    """
    order = 0
    takes: dict[bytes, dict[str, int]] = {}

    def compile_cubin(source: str, arch: str, defines: dict[str, int]) -> bytes:
        takes[source.encode()] = defines
        return source.encode()

    def kernel(cubin: bytes, name: str, parameters: Any, *, shared_bytes: int, threads: int, cluster: int) -> Any:
        library = emulate.compiled(cubin.decode(), name, parameters, takes[cubin], folder)
        at_once = 99 if takes[cubin]["TP_GATHER"] else 2
        return emulate.EmulatedKernel(library, parameters, threads, cluster, at_once, order)

    def seeded(seed: int) -> None:
        nonlocal order
        order = seed
        for module in (bf16, fp8):
            module._kernel.cache_clear()

    monkeypatch.setattr(bf16, "compile_cubin", compile_cubin)
    monkeypatch.setattr(bf16, "DependentKernel", kernel)
    monkeypatch.setattr(instructions, "wgmma", emulate.wgmma)
    monkeypatch.setattr(instructions, "tensor_map", emulate.tensor_map)
    monkeypatch.setattr(torch.cuda, "device", lambda device: nullcontext())
    yield seeded
    seeded(0)


def random(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed + sum(shape))).bfloat16()


def product(x: Tensor, weight: Tensor, bias: Tensor | None, epilogue: Epilogue) -> Tensor:
    """In float32, of the operands as they are."""
    sums = x.float() @ weight.float().T + (0 if bias is None else bias.float())
    return plain.gelu(sums) if epilogue == "gelu" else plain.geglu(sums) if epilogue == "geglu" else sums


BF16_TILES = [  # a ring of 3 is used again and again; clusters of either kind; sums gathered; an epilogue overlapped
    ("plain", Tile(1, 16, ring=3)),
    ("bias", Tile(1, 16, ring=3)),
    ("gelu", Tile(1, 24, ring=3)),
    ("geglu", Tile(1, 32, ring=3)),
    ("bias", Tile(1, 16, cluster_m=2, ring=3)),
    ("plain", Tile(1, 16, cluster_n=2, ring=3)),
    ("bias", Tile(1, 32, splits=2, gather=True, ring=3)),
    ("partial", Tile(1, 16, splits=2, ring=3)),
    ("parts", Tile(1, 16, splits=2, ring=3)),
    ("geglu", Tile(1, 32, ring=3, overlap=True)),
]


@pytest.mark.parametrize(("epilogue", "tile"), BF16_TILES)
def test_a_product_in_bf16_is_right_in_whatever_order_its_threads_go(
    machine: Callable[[int], None], epilogue: Epilogue, tile: Tile
) -> None:
    m, n, k = 136, 40, 504
    x, weight = random(m, k), random(2 * n if epilogue == "geglu" else n, k, seed=1) / k**0.5
    bias = random(n) if epilogue in ("bias", "gelu", "partial") else None
    expected = product(x, weight, bias, epilogue)
    for seed in SEEDS:
        machine(seed)
        residual = sums = None
        if tile.gather:
            residual, sums = random(m, n, seed=9), Sums.allocate(tile, m, n, CPU)
        out = bf16.matmul(x, weight, tile, epilogue, bias, residual=residual, sums_out=sums).float()
        out = out.sum(0) if epilogue in ("partial", "parts") else out
        wanted = expected if residual is None else expected + residual.float()
        torch.testing.assert_close(out, wanted, rtol=1e-2, atol=1e-2)
        if sums is not None:
            both = torch.stack((out.sum(1), out.square().sum(1)), dim=1)
            torch.testing.assert_close(sums.parts.sum(0), both, rtol=1e-4, atol=1e-3)


@pytest.mark.parametrize(
    ("epilogue", "tile", "inverse"),
    [
        ("plain", Tile(1, 16, ring=3), None),
        ("gelu", Tile(1, 32, ring=3), 20.0),
        ("geglu", Tile(1, 64, ring=3), None),
    ],
)
def test_a_product_in_fp8_is_right_in_whatever_order_its_threads_go(
    machine: Callable[[int], None], epilogue: Epilogue, tile: Tile, inverse: float | None
) -> None:
    m, n, k = 72, 40, 1008
    weight = quantize(random(2 * n if epilogue == "geglu" else n, k, seed=1) / k**0.5, 0.01)
    x, bias = to_e4m3(random(m, k), weight.inverse), random(n) if epilogue == "gelu" else None
    sums = weight.product(x, bias)
    expected = plain.gelu(sums) if epilogue == "gelu" else plain.geglu(sums) if epilogue == "geglu" else sums
    for seed in SEEDS[:2]:
        machine(seed)
        out = fp8.matmul_fp8(x, weight, tile, epilogue, bias, inverse=inverse)
        assert out.dtype == (torch.bfloat16 if inverse is None else E4M3)
        error = (out.float() / (inverse or 1) - expected).norm() / expected.norm()
        assert error < (0.006 if inverse is None else 0.03)


def test_an_fp8_product_leaves_a_copy_that_is_normed_with_the_norms_scale_and_shift(
    machine: Callable[[int], None],
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


@pytest.mark.parametrize("in_fp8", [False, True], ids=["bf16", "fp8"])
def test_geglu_makes_up_for_what_a_copy_lacks_of_its_rmsnorm(machine: Callable[[int], None], in_fp8: bool) -> None:
    m, n, k, hidden, eps = 120, 528 if in_fp8 else 200, 256, 40, 1e-6
    out_tile, geglu_tile = Tile(1, 24, ring=3), Tile(1, 32, ring=3, overlap=True)
    weight, gate_up = random(n, k, seed=1) / k**0.5, random(2 * hidden, n, seed=2) / n**0.5
    x, residual, scale = random(m, k), 4 * random(m, n, seed=9), 1 + torch.rand(n)
    residual[3] *= 30  # a row whose numbers E4M3 wouldn't hold
    squares = residual.float().square().sum(1) if in_fp8 else torch.full((m,), n * (1 - eps))
    before = Sums(torch.stack((torch.zeros(m), squares), dim=1)[None].contiguous())
    sums, unread = Sums.allocate(out_tile, m, n, CPU), Sums.allocate(out_tile, m, n, CPU)
    matrix, by = quantize(gate_up, 0.02), 1.0
    if in_fp8:
        by = matrix.inverse / fp8.HEADROOM
        gate_up = matrix.dequantized().bfloat16()
    numbers = E4M3 if in_fp8 else torch.bfloat16
    copy = Copy(torch.empty(m, n).to(numbers), before, scale * by, torch.zeros(n), eps, unread)
    for seed in SEEDS[:2]:
        machine(seed)
        stream = bf16.matmul(x, weight, out_tile, "bias", residual=residual, sums_out=sums, copy=copy)
        if in_fp8:
            larger = dataclasses.replace(matrix, scale=matrix.scale * fp8.HEADROOM)
            out = fp8.matmul_fp8(copy.out, larger, geglu_tile, "geglu", inverse=10.0, sums=sums).float() / 10
        else:
            out = bf16.matmul(copy.out, gate_up, geglu_tile, "geglu", sums=sums, eps=fp8.NO_EPS).float()
        wide = stream.float()
        torch.testing.assert_close(wide, x.float() @ weight.float().T + residual.float(), rtol=1e-2, atol=2e-2)
        normed = wide * (wide.square().mean(1, keepdim=True) + eps).rsqrt() * scale
        wanted = product(normed, gate_up, None, "geglu")
        usual = product(normed.bfloat16(), gate_up, None, "geglu").bfloat16()
        if in_fp8:
            usual = to_e4m3(plain.geglu(matrix.product(to_e4m3(normed, matrix.inverse))), 10.0).float() / 10
        ours, theirs = ((one.float() - wanted).norm(dim=1) / wanted.norm(dim=1) for one in (out, usual))
        assert ours.mean() < 1.1 * theirs.mean() and ours.max() < 1.3 * theirs.max(), (ours.max(), theirs.max())


def test_an_instruction_that_the_machine_does_not_know_is_named() -> None:
    with pytest.raises(NotImplementedError, match=r"no instruction for: elect\.sync"):
        emulate.translated('void f() { asm volatile("elect.sync _|p, %0;" ::"r"(1)); }')
