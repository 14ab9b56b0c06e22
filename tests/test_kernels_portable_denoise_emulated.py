"""The portable denoising kernel, run on a CPU thread by thread: a whole loop on a grid of a few blocks.

g++ stands for NVRTC, and tests/emulator/machine.h for the GPU: all blocks of the grid are one of its clusters.
"""

import ctypes
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import pytest
import torch
from emulator import emulate
from kernel_turns.problems import (
    Problem,
    input_scales,
    int8_inputs,
    ordinary_bf16,
    plain,
    problem,
    relative,
    standing_for,
)
from torch import Tensor

from turbopi.kernels.arguments import Parameter, Parameters
from turbopi.kernels.portable.denoise import kernel as denoise
from turbopi.kernels.portable.denoise.packing import PackedExpert
from turbopi.kernels.sm90.denoise.plain import in_e4m3
from turbopi.models.pi0.denoise import euler_step
from turbopi.quantization.formats import INT8

pytestmark = [pytest.mark.slow, pytest.mark.skipif(emulate.COMPILER is None, reason="no g++ here")]
CPU = torch.device("cpu")
TAKES = Parameters((Parameter("Args", "args"), Parameter("int", "prepare")))
BOTH = """
void both(const Args args, int prepare) {
  if (prepare)
    turbopi_portable_denoise_prepare(args);
  else
    turbopi_portable_denoise(args);
}
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Compiled kernels."""
    return tmp_path_factory.mktemp("emulated")


BLOCK_SHARED = 99 * 1024  # bytes, of the GPUs that have least


class Emulated:
    """In place of `Kernel`."""

    def __init__(self, sizes: dict[str, int], folder: Path, seed: int, prepare: bool) -> None:
        self.library = emulate.compiled(denoise.source() + BOTH, "both", TAKES, sizes, folder)
        self.seed, self.prepare, self.missing = seed, ctypes.c_int(prepare), 0  # missing: blocks that aren't launched

    def _launch(self, blocks: int, threads: int, together: int, args: ctypes.Structure) -> None:
        run = ctypes.CDLL(str(self.library)).run
        run.restype = ctypes.c_char_p
        pointers = (ctypes.c_void_p * 2)(ctypes.addressof(args), ctypes.addressof(self.prepare))
        if (why := run(blocks, threads, together, BLOCK_SHARED, self.seed, pointers)) is not None:
            raise RuntimeError(why.decode())

    def launch(self, blocks: int, threads: int, args: ctypes.Structure) -> None:
        self._launch(blocks, threads, 1, args)

    def launch_cooperative(self, blocks: int, threads: int, args: ctypes.Structure) -> None:
        self._launch(blocks - self.missing, threads, blocks - self.missing, args)


def made(
    p: Problem,
    packed: PackedExpert,
    monkeypatch: pytest.MonkeyPatch,
    folder: Path,
    *,
    blocks: int,
    seed: int = 0,
    choice: denoise.Choices | None = None,
) -> denoise.PortableDenoiser:
    def load(device: torch.device, sizes: dict[str, int], arch: str | None) -> tuple[Any, Any]:
        return Emulated(sizes, folder, seed, prepare=False), Emulated(sizes, folder, seed, prepare=True)

    monkeypatch.setattr(denoise, "load", load)
    monkeypatch.setattr(denoise, "unavailable", lambda device, weights: None)
    monkeypatch.setattr(denoise, "has_large_l2", lambda device: True)
    monkeypatch.setattr(torch.cuda, "device", lambda device: nullcontext())
    return denoise.PortableDenoiser(
        *(p.config, packed, p.small, p.table),
        cache_rows=p.cache_k.shape[1],
        suffix=p.noise.shape[0],
        device=CPU,
        choice=choice,
        blocks=blocks,
    )


def run(
    p: Problem, packed: PackedExpert, monkeypatch: pytest.MonkeyPatch, folder: Path, **options: Any
) -> tuple[Tensor, Tensor]:
    """options: of `made`"""
    kernel = made(p, packed, monkeypatch, folder, **options)
    x_t = torch.full((len(p.table) + 1, *p.noise.shape), torch.nan)
    v_t = torch.full((len(p.table), *p.noise.shape), torch.nan)
    kernel.launch(p.noise, p.cache_k, p.cache_v, torch.tensor([p.length]), x_t, v_t)
    return x_t, v_t


@pytest.mark.parametrize(
    ("name", "steps", "suffix", "length", "blocks"),
    [
        ("golden", 2, 1, 5, 1),
        ("golden", 2, 10, 37, 5),
        ("odd", 1, 17, 70, 2),
        ("uneven", 1, 10, 30, 3),
        ("golden", 1, 50, 300, 2),
        ("uneven", 1, 50, 30, 1),  # gate and up in four passes
    ],
)
def test_the_loop_is_as_exact_as_ordinary_bf16(
    monkeypatch: pytest.MonkeyPatch, folder: Path, name: str, steps: int, suffix: int, length: int, blocks: int
) -> None:
    p = problem(name, steps, suffix, length, 1, CPU)
    packed = PackedExpert.pack(p.config, p.layers)
    reference = plain(p, torch.float64)[0]
    x_t, v_t = run(p, packed, monkeypatch, folder, blocks=blocks)
    assert torch.equal(x_t[0], p.noise)
    torch.testing.assert_close(x_t[1:], euler_step(x_t[:-1], v_t, steps), rtol=0, atol=0)
    assert relative(x_t[-1], reference[-1]) <= 1.1 * relative(ordinary_bf16(p), reference[-1])


def test_it_is_right_in_whatever_order_its_threads_go(monkeypatch: pytest.MonkeyPatch, folder: Path) -> None:
    p = problem("golden", 2, 10, 37, 1, CPU)
    packed = PackedExpert.pack(p.config, p.layers)
    first = run(p, packed, monkeypatch, folder, blocks=5)
    for seed in (4, 5, 6):  # blocks stand still for a while, so that others run ahead
        again = run(p, packed, monkeypatch, folder, blocks=5, seed=seed)
        assert all(torch.equal(a, b) for a, b in zip(first, again, strict=True)), seed


def test_blocks_that_wait_in_vain_give_up_and_say_where(monkeypatch: pytest.MonkeyPatch, folder: Path) -> None:
    p = problem("golden", 1, 1, 5, 1, CPU)
    monkeypatch.setattr(denoise, "LOOKS", 75)
    kernel = made(p, PackedExpert.pack(p.config, p.layers), monkeypatch, folder, blocks=2)
    launch = p.noise, p.cache_k, p.cache_v, torch.tensor([p.length])
    steps = torch.zeros(2, *p.noise.shape), torch.zeros(1, *p.noise.shape)
    kernel.launch(*launch, *steps)
    assert kernel.why_it_trapped() is None
    kernel._loop.kernel.missing = 1  # type: ignore[attr-defined]
    with pytest.raises(RuntimeError, match="a trap"):
        kernel.launch(*launch, *steps)
    assert "waited for seconds for one another behind embed in step 0" in str(kernel.why_it_trapped())


def test_a_barriers_number_names_its_place() -> None:
    sizes = {"TP_SPLITS": 2, "TP_DEPTH": 3, "TP_MODULATED": 1}
    a_step = denoise.phases(sizes)
    assert a_step == [
        "embed",
        *(f"phase {one} of layer {i}" for i in range(3) for one in denoise.PHASES[:6]),
        "advance",
    ]
    for number, where in enumerate([*a_step, *a_step], 1):
        step = (number - 1) // len(a_step)
        assert str(denoise.stuck(number, a_step)).endswith(f"behind {where} in step {step}")
    assert denoise.stuck(0, a_step) is None
    mixed = denoise.phases(sizes | {"TP_SPLITS": 1, "TP_MODULATED": 0})
    assert mixed[:3] == ["embed", "mix", "phase qkv of layer 0"] and len(mixed) == 2 + 5 * 3 + 1


def test_choices_of_a_launch_change_no_more_than_the_order_of_sums(
    monkeypatch: pytest.MonkeyPatch, folder: Path
) -> None:
    p = problem("golden", 1, 10, 37, 1, CPU)
    packed = PackedExpert.pack(p.config, p.layers)
    usual = run(p, packed, monkeypatch, folder, blocks=3)[0]
    choice = denoise.Choices(warps=8, sums=2, weights=2, activations=2, ahead=False)
    assert relative(run(p, packed, monkeypatch, folder, blocks=3, choice=choice)[0], usual) < 3e-3


def test_a_block_with_half_of_the_tokens_adds_up_in_the_same_order(
    monkeypatch: pytest.MonkeyPatch, folder: Path
) -> None:
    p = problem("golden", 1, 50, 77, 1, CPU)
    packed = PackedExpert.pack(p.config, p.layers, int8_inputs(p), format=INT8)
    whole, half = (
        run(p, packed, monkeypatch, folder, blocks=13, choice=choice)
        for choice in (denoise.MANY, denoise.MANY_IN_RANGES)
    )
    assert all(torch.equal(a, b) for a, b in zip(whole, half, strict=True))
    assert denoise.choices(50, blocks=denoise.MANY_BLOCKS) == denoise.MANY_IN_RANGES


@pytest.mark.parametrize(
    ("name", "steps", "suffix", "length", "blocks"),
    [("golden", 2, 1, 5, 1), ("golden", 2, 10, 37, 3), ("odd", 1, 17, 70, 2), ("uneven", 1, 10, 30, 3)],
)
def test_with_int8_weights_it_is_as_exact_as_ordinary_bf16(
    monkeypatch: pytest.MonkeyPatch, folder: Path, name: str, steps: int, suffix: int, length: int, blocks: int
) -> None:
    p = problem(name, steps, suffix, length, 1, CPU)
    packed = PackedExpert.pack(p.config, p.layers, int8_inputs(p), format=INT8)
    x_t, _ = run(p, packed, monkeypatch, folder, blocks=blocks)
    ordinary = relative(ordinary_bf16(p), plain(p, torch.float64)[0][-1])  # of the weights before they were rounded
    p.layers = standing_for(packed, p)
    assert relative(x_t[-1], plain(p, torch.float64)[0][-1]) <= 1.1 * ordinary


def test_in_fp8_it_is_as_exact_as_its_emulation(monkeypatch: pytest.MonkeyPatch, folder: Path) -> None:
    """Both against exact activations. Rounded numbers near an edge fall either way, so each problem has some luck."""
    ours, emulated = [], []
    for seed in range(2):
        p = problem("golden", 1, 10, 37, seed, CPU)
        packed = PackedExpert.pack(p.config, p.layers, input_scales(p))
        x_t, _ = run(p, packed, monkeypatch, folder, blocks=3)
        p.layers = standing_for(packed, p)
        reference = plain(p, torch.float64)[0][-1]
        ours.append(relative(x_t[-1], reference))
        emulated.append(relative(plain(p, torch.float64, in_e4m3(packed.inputs))[0][-1], reference))
    assert sum(x * x for x in ours) <= 1.2**2 * sum(x * x for x in emulated)
