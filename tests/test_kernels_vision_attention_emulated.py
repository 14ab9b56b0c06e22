"""The source of vision's q|k|v product and attention in one kernel, run on a CPU thread by thread."""

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
from turbopi.kernels.sm90.gemm.bf16 import Folded, Sums
from turbopi.kernels.sm90.gemm.fp8 import HEADROOM, FoldedFp8
from turbopi.kernels.sm90.vision_attention import kernel as fused
from turbopi.kernels.sm90.vision_attention.kernel import Cut, Exchange
from turbopi.quantization.fp8 import E4M3, to_e4m3

pytestmark = pytest.mark.skipif(emulate.COMPILER is None, reason="no g++ here")
CPU = torch.device("cpu")
TOKENS, EPS = 256, 1e-6


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Compiled kernels."""
    return tmp_path_factory.mktemp("emulated")


@pytest.fixture
def machine(monkeypatch: pytest.MonkeyPatch, folder: Path) -> Iterator[Callable[[int], None]]:
    """`machine(seed)`: launches go to a machine that takes turns in that order, four blocks at once."""
    order = 0
    takes: dict[bytes, dict[str, int]] = {}

    def compile_cubin(source: str, arch: str, defines: dict[str, int]) -> bytes:
        takes[source.encode()] = defines
        return source.encode()

    def kernel(cubin: bytes, name: str, parameters: Any, *, shared_bytes: int, threads: int, cluster: int) -> Any:
        library = emulate.compiled(cubin.decode(), name, parameters, takes[cubin], folder)
        return emulate.EmulatedKernel(library, parameters, threads, cluster, 99, order, 4 // cluster)

    def seeded(seed: int) -> None:
        nonlocal order
        order = seed
        fused._kernel.cache_clear()

    monkeypatch.setattr(fused, "compile_cubin", compile_cubin)
    monkeypatch.setattr(fused, "DependentKernel", kernel)
    monkeypatch.setattr(instructions, "wgmma", emulate.wgmma)
    monkeypatch.setattr(instructions, "tensor_map", emulate.tensor_map)
    monkeypatch.setattr(torch.cuda, "device", lambda device: nullcontext())
    yield seeded
    seeded(0)


def random(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed + sum(shape)))


def sums_of(x: Tensor, parts: int) -> Sums:
    """A row's sum and sum of squares, in `parts` of its columns."""
    pieces = x.float().tensor_split(parts, dim=1)
    return Sums(torch.stack([torch.stack((p.sum(1), p.square().sum(1)), dim=1) for p in pieces]))


def relative(x: Tensor, expected: Tensor) -> float:
    return float((x.float() - expected).norm() / expected.norm())


@pytest.mark.parametrize("ranks", [2, 4])
@pytest.mark.parametrize(("dim", "heads"), [(24, 2), (16, 1)])
@pytest.mark.parametrize("seed", [0, 1, 4])
def test_in_bf16_it_is_attention_of_the_normed_product(
    machine: Callable[[int], None], ranks: int, dim: int, heads: int, seed: int
) -> None:
    width, inner = heads * dim, 328
    x = (3 * random(TOKENS, inner) + 1).bfloat16()
    weight, bias = (random(3 * width, inner, seed=1) / 12).bfloat16(), random(3 * width).bfloat16()
    scale, shift = 1 + 0.1 * random(inner, seed=2), random(inner, seed=3)
    normed = torch.nn.functional.layer_norm(x.float(), (inner,), scale, shift, EPS)
    expected = plain.vision_attention(normed @ weight.float().T + bias.float(), 1, heads)
    exchange = Exchange.allocate(1, heads, dim, CPU)
    folded = Folded.fold(weight, bias, scale, shift)
    machine(seed)
    cut = Cut(dim, ranks, ring=3)
    out = fused.projected_attention(x, folded, sums_of(x, 3), 1, heads, exchange, eps=EPS, cut=cut)
    assert out.dtype == torch.bfloat16 and relative(out, expected) < 0.012
    assert not exchange.flags.any()


@pytest.mark.parametrize("ranks", [2, 4])
def test_in_fp8_it_is_attention_of_the_normed_product(machine: Callable[[int], None], ranks: int) -> None:
    dim = width = 24
    inner = 400
    x = (2 * random(TOKENS, inner) + 0.5).bfloat16()
    scale, shift = 1 + 0.1 * random(inner, seed=2), 0.5 * random(inner, seed=3)
    weight, bias = quantize((random(3 * width, inner, seed=1) / 12).bfloat16(), 0.05), random(3 * width).bfloat16()
    wide = x.float()
    mean, deviation = wide.mean(1, keepdim=True) * 0.9, wide.std(1, keepdim=True) * 1.1  # nearly x's own
    units = (wide - mean) / deviation
    copy = to_e4m3(units * scale + shift, weight.inverse / HEADROOM)
    normed = torch.nn.functional.layer_norm(wide, (inner,), scale, shift, 0)
    expected = plain.vision_attention(normed @ weight.dequantized().T + bias.float(), 1, 1)
    exchange = Exchange.allocate(1, 1, dim, CPU)
    machine(0)
    out = fused.projected_attention(
        copy,
        FoldedFp8.fold(weight, scale, shift),
        sums_of(units, 5),
        1,
        1,
        exchange,
        bias=bias,
        inverse=40.0,
        cut=Cut(dim, ranks, ring=3),
    )
    assert out.dtype == E4M3 and relative(out.float() / 40, expected) < 0.08
    assert not exchange.flags.any()
