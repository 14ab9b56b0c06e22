"""The prefix's second norm in the products around it gives what the norm gives; what it doesn't take goes to others."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from conftest import gpu_or_interpreter
from emulator import emulate
from test_kernels_emulated import machine, random
from torch import Tensor

pytest.importorskip("triton", reason="Triton isn't installed")

from turbopi.kernels import plain
from turbopi.kernels.portable.quantize import quantize
from turbopi.kernels.sm90 import prefix_norms
from turbopi.kernels.sm90.gemm.bf16 import Sums, Tile
from turbopi.kernels.sm90.prefix_norms import NearlyNormed, OutProduct, PrefixNorms, norm_and_squares
from turbopi.quantization.fp8 import Matrix, input_of

ROWS, WIDTH, INNER, HIDDEN, EPS = 100, 528, 128, 40, 1e-6
CPU = torch.device("cpu")
assert machine  # a fixture
pytestmark = gpu_or_interpreter()


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Compiled kernels."""
    return tmp_path_factory.mktemp("emulated")


@pytest.fixture
def ops(monkeypatch: pytest.MonkeyPatch) -> PrefixNorms:
    """Around plain operations, for small sizes, on a GPU of two multiprocessors."""
    tile = Tile(1, 32, ring=3, overlap=True)
    monkeypatch.setattr(prefix_norms, "OUT_TILES", {(128, WIDTH, INNER): Tile(1, 48, ring=3)})
    monkeypatch.setattr(prefix_norms, "num_sms", lambda device: 2)
    monkeypatch.setattr(prefix_norms, "chosen_geglu", lambda *sizes: tile)
    monkeypatch.setattr(prefix_norms, "chosen_fp8", lambda *sizes: tile)
    monkeypatch.setattr(prefix_norms, "norm_and_squares", plain_norm_and_squares)  # the interpreter cuts bfloat16 off
    return PrefixNorms(plain.PLAIN)


def plain_norm_and_squares(
    x: Tensor, y: Tensor | None, scale: Tensor, eps: float, inverse: float | None, sums: Sums
) -> tuple[Tensor, Tensor]:
    out, normed = plain.residual_rms_norm(x, y, None, scale, None, eps, inverse)
    sums.parts[0, :, 1] = out.float().square().sum(1)
    return out, normed


def half_a_layer(ops: Any, x: Tensor, y: Tensor, attended: Tensor, out: Tensor, gate_up: Matrix) -> tuple[Tensor, ...]:
    """From the norm in front of attention to GeGLU: the stream, and hidden units."""
    scale = 1 + torch.rand(WIDTH, generator=torch.Generator().manual_seed(3))
    x, _ = ops.residual_rms_norm(x, y, None, scale, None, EPS, **input_of(gate_up))
    x, normed = ops.residual_rms_norm(
        x, ops.residual_linear(attended, out), None, scale, None, EPS, **input_of(gate_up)
    )
    return x, ops.linear_geglu(normed, gate_up)


@pytest.mark.skipif(emulate.COMPILER is None, reason="no g++ here")
@pytest.mark.parametrize("in_fp8", [False, True], ids=["bf16", "fp8"])
def test_half_a_layer_is_as_with_a_norm_of_its_own(
    machine: Callable[[int], None], ops: PrefixNorms, in_fp8: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    x, y, attended = random(ROWS, WIDTH), random(ROWS, WIDTH, seed=5), random(ROWS, INNER)
    x[3] *= 30
    out, weight = random(WIDTH, INNER, seed=1) / INNER**0.5, random(2 * HIDDEN, WIDTH, seed=2) / WIDTH**0.5
    gate_up: Matrix = quantize(weight, 0.02) if in_fp8 else weight
    machine(0)
    taken = []
    geglu = ops.linear_geglu

    def seen(x: Any, matrix: Matrix) -> Tensor:
        taken.append(isinstance(x, NearlyNormed))
        return geglu(x, matrix)

    monkeypatch.setattr(ops, "linear_geglu", seen)
    stream, hidden = half_a_layer(ops, x, y, attended, out, gate_up)
    wide = (t.float() for t in (x, y, attended, out, weight))
    wanted_stream, wanted = half_a_layer(plain.PLAIN, *wide)
    usual_stream, usual = half_a_layer(plain.PLAIN, x, y, attended, out, gate_up)
    assert taken == [True]
    for ours, theirs, exact in ((stream, usual_stream, wanted_stream), (hidden, usual, wanted)):
        assert (ours.float() - exact).norm() < 1.1 * (theirs.float() - exact).norm()


def test_other_sizes_and_norms_with_a_gate_go_to_the_other_operations(ops: PrefixNorms) -> None:
    told: list[str] = []

    def spy(name: str) -> Any:
        return lambda *given: told.append(name)

    names = ("residual_linear", "residual_rms_norm", "linear_geglu")
    spied = dataclasses.replace(plain.PLAIN, **{name: spy(name) for name in names})
    ours = PrefixNorms(spied)
    x, by_token = random(ROWS, WIDTH), torch.ones(ROWS, WIDTH)
    ours.residual_linear(random(ROWS, INNER), random(WIDTH + 8, INNER))
    ours.residual_rms_norm(x, x, by_token, by_token, by_token, EPS)
    ours.linear_geglu(x, random(2 * HIDDEN, WIDTH))
    assert told == list(names)
    assert isinstance(ours.residual_linear(random(ROWS, INNER), random(WIDTH, INNER)), OutProduct)


@pytest.mark.parametrize("parts", [None, 0, 3])
def test_the_norm_that_tells_squares_is_the_norm(parts: int | None) -> None:
    device, dtype = (torch.device("cuda"), torch.bfloat16) if torch.cuda.is_available() else (CPU, torch.float32)
    x, scale = random(ROWS, WIDTH).to(device, dtype), 1 + torch.rand(WIDTH, device=device)
    y = None if parts is None else random(*((parts,) if parts else ()), ROWS, WIDTH, seed=5).to(device, dtype)
    sums = Sums(torch.zeros(1, ROWS, 2, device=device))
    out, normed = norm_and_squares(x, y, scale, EPS, None, sums)
    added = x if y is None else (x.float() + (y.float().sum(0) if parts else y.float())).to(dtype)
    torch.testing.assert_close(out, added)
    wanted = plain.residual_rms_norm(added, None, None, scale, None, EPS)[1]
    torch.testing.assert_close(normed, wanted)
    squares = added.float().square().sum(1)
    torch.testing.assert_close(sums.parts[0], torch.stack((torch.zeros_like(squares), squares), dim=1))
