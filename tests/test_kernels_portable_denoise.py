"""The portable denoising kernel: its packing and its machine code on the CPU, its results on any GPU from 8.0 on."""

import dataclasses
from pathlib import Path

import pytest
import torch
from kernel_turns.problems import (
    CONFIGS,
    FULL,
    GPU,
    has_nvrtc,
    input_scales,
    int8_inputs,
    ordinary_bf16,
    plain,
    portable_outputs,
    problem,
    relative,
    standing_for,
)

from turbopi.engine import smolvla
from turbopi.kernels.portable.denoise import kernel as denoise
from turbopi.kernels.portable.denoise import packing
from turbopi.kernels.portable.denoise.packing import PackedExpert, WeightNumbers
from turbopi.kernels.portable.quantize import quantize
from turbopi.kernels.sm90.denoise.plain import in_e4m3
from turbopi.models.pi0.denoise import euler_step
from turbopi.models.smolvla.config import SmolVLAConfig
from turbopi.models.smolvla.family import BASE
from turbopi.quantization.formats import INT8, OF_EIGHT_BITS, Format
from turbopi.support.errors import BackendError, BackendUnavailable

CPU = torch.device("cpu")
SMALL = pytest.mark.parametrize("name", ["golden", "tiny", "odd", "uneven"])


@SMALL
def test_packing_keeps_every_weight(name: str) -> None:
    p = problem(name, 1, 1, 3, 0, CPU)
    packed = PackedExpert.pack(p.config, p.layers)
    for i, layer in enumerate(p.layers):
        matrices = layer.qkv, layer.out, layer.gate_up, layer.down
        assert all(torch.equal(a, b) for a, b in zip(packed.matrices(i), matrices, strict=True))


@SMALL
@pytest.mark.parametrize("format", OF_EIGHT_BITS.values(), ids=OF_EIGHT_BITS)
def test_packing_in_eight_bits_keeps_every_weight_as_it_is_rounded(name: str, format: Format) -> None:
    p = problem(name, 1, 1, 3, 0, CPU, outliers=True)
    packed = PackedExpert.pack(p.config, p.layers, int8_inputs(p), format=format)
    assert packed.numbers == format.name and packed.weights.dtype == format.dtype
    for i, layer in enumerate(p.layers):
        for found, matrix in zip(packed.matrices(i), (layer.qkv, layer.out, layer.gate_up, layer.down), strict=True):
            torch.testing.assert_close(found, quantize(matrix, 1.0, format=format).dequantized(), rtol=1e-6, atol=0)


def test_a_lane_has_16_bytes_of_one_channel_side_by_side() -> None:
    matrix = torch.arange(16 * 48).view(16, 48).to(torch.int16)
    tiles = packing.tiles(matrix).view(2, 2, 8, 4, 8)  # [tile][chunk][channel][lane of four][column]
    assert torch.equal(tiles[1, 0, 3, 2], matrix[11, 16:24])
    assert torch.equal(tiles[0, 1, 5, :2].flatten(), matrix[5, 32:]) and not tiles[:, 1, :, 2:].any()


def test_of_int8_a_lane_has_the_columns_that_it_has_of_bf16_in_both_halves_of_a_chunk() -> None:
    matrix = (torch.arange(8 * 128).view(8, 128) % 64).to(torch.int8)
    tiles = packing.tiles(matrix).view(1, 2, 8, 4, 2, 2, 4)  # [tile][chunk][channel][lane][half][word][byte]
    for half in range(2):
        of_bf16 = matrix[5, 64 + 32 * half + 8 * 3 :][:8].view(2, 4)  # lane 3's
        assert torch.equal(tiles[0, 1, 5, 3, half], of_bf16[:, [0, 2, 1, 3]])


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"width": 1000}, "multiples of 16: width 1000"),
        ({"head_dim": 40, "num_heads": 4}, "multiple of 16 up to 256, it is 40"),
        ({"head_dim": 512}, "multiple of 16 up to 256, it is 512"),
    ],
)
def test_sizes_it_does_not_cover_are_named(changes: dict[str, int], text: str) -> None:
    g = dataclasses.replace(FULL.expert, **changes)
    vlm = dataclasses.replace(FULL.vlm, head_dim=g.head_dim, num_heads=g.num_heads)
    with pytest.raises(BackendError, match=text):
        PackedExpert.pack(dataclasses.replace(FULL, expert=g, vlm=vlm), [])


def test_a_machine_without_gpu_is_refused() -> None:
    p = problem("golden", 1, 4, 3, 0, CPU)
    packed = PackedExpert.pack(p.config, p.layers)
    with pytest.raises(BackendUnavailable, match="needs an NVIDIA GPU"):
        denoise.PortableDenoiser(p.config, packed, p.small, p.table, cache_rows=10, suffix=4, device=CPU)


def test_times_by_token_are_refused() -> None:
    p = problem("golden", 1, 4, 3, 0, CPU)
    packed = PackedExpert.pack(p.config, p.layers)
    with pytest.raises(BackendUnavailable, match="no times by token"):
        denoise.PortableDenoiser(
            *(p.config, packed, p.small, p.table),
            cache_rows=10,
            suffix=4,
            device=CPU,
            num_steps=1,
            by_token=True,
        )


def test_older_gpus_are_refused_by_name(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda device: (8, 6))
    assert denoise.unavailable(GPU) is None
    assert "in FP8 needs compute capability 8.9 or newer, this GPU has 8.6" in str(denoise.unavailable(GPU, "fp8"))


@pytest.mark.parametrize(
    ("blocks", "cache_rows", "suffix", "at_once"),
    [(132, 241, 50, True), (132, 257, 50, False), (131, 241, 50, False), (132, 241, 16, False), (132, 241, 64, True)],
)
def test_layers_across_are_one_phase_where_blocks_and_warps_are_enough(
    blocks: int, cache_rows: int, suffix: int, at_once: bool
) -> None:
    config = BASE.model
    assert isinstance(config, SmolVLAConfig)
    made = smolvla.form(config)
    sizes = denoise.kernel_sizes(
        smolvla.ExpertSizes.of(config),
        blocks=blocks,
        cache_rows=cache_rows,
        suffix=suffix,
        weights="bf16",
        choice=denoise.choices(suffix, made, blocks),
        form=made,
    )
    assert sizes["TP_ACROSS_AT_ONCE"] == at_once


@pytest.mark.slow
@pytest.mark.skipif(not has_nvrtc(), reason="no NVRTC here")
@pytest.mark.parametrize("arch", ["sm_80", "sm_86", "sm_89", "sm_120"])
def test_the_source_compiles_for_gpus_that_are_not_here(tmp_path: Path, arch: str) -> None:
    numbers: tuple[WeightNumbers, ...] = ("bf16", "int8", "fp8") if arch in ("sm_89", "sm_120") else ("bf16", "int8")
    for weights in numbers:
        sizes = denoise.kernel_sizes(
            CONFIGS["golden"], blocks=84, cache_rows=976, suffix=10, weights=weights, choice=denoise.choices(10)
        )
        assert denoise.compiled(arch, sizes, folder=tmp_path)


# ---- on a GPU


SHAPES = pytest.mark.parametrize(
    ("name", "steps", "suffix", "length"),
    [
        ("golden", 3, 10, 37),
        ("golden", 1, 1, 5),
        ("golden", 10, 50, 77),
        ("tiny", 3, 10, 300),
        ("odd", 3, 17, 101),
        ("uneven", 2, 33, 256),
        ("shallow", 3, 10, 571),
        ("shallow", 2, 64, 968),
        ("shallow", 1, 50, 1100),
        ("full", 10, 10, 560),
        ("full", 3, 50, 560),
    ],
)


@pytest.mark.gpu
@SHAPES
def test_kernel_is_as_exact_as_ordinary_bf16(name: str, steps: int, suffix: int, length: int) -> None:
    p = problem(name, steps, suffix, length, steps * 1000 + suffix, GPU)
    x_t, v_t = portable_outputs(p, PackedExpert.pack(p.config, p.layers))
    reference, _ = plain(p, torch.float64)
    assert torch.equal(x_t[0], p.noise)
    torch.testing.assert_close(x_t[1:], euler_step(x_t[:-1], v_t, steps), rtol=0, atol=0)
    assert relative(x_t[-1], reference[-1]) <= 1.1 * relative(ordinary_bf16(p), reference[-1])


@pytest.mark.gpu
@SHAPES
def test_with_int8_weights_it_is_as_exact_as_ordinary_bf16(name: str, steps: int, suffix: int, length: int) -> None:
    p = problem(name, steps, suffix, length, steps * 1000 + suffix, GPU)
    packed = PackedExpert.pack(p.config, p.layers, int8_inputs(p), format=INT8)
    x_t, _ = portable_outputs(p, packed)
    ordinary = relative(ordinary_bf16(p), plain(p, torch.float64)[0][-1])  # of the weights before they were rounded
    p.layers = standing_for(packed, p)
    assert relative(x_t[-1], plain(p, torch.float64)[0][-1]) <= 1.1 * ordinary


@pytest.mark.gpu
@pytest.mark.parametrize("blocks", [1, 7, 40])
def test_any_number_of_blocks_gives_the_same(blocks: int) -> None:
    p = problem("tiny", 2, 20, 100, 5, GPU)
    packed = PackedExpert.pack(p.config, p.layers)
    assert relative(portable_outputs(p, packed, blocks=blocks)[0], portable_outputs(p, packed)[0]) < 5e-3


@pytest.mark.gpu
@SHAPES
def test_in_fp8_it_is_as_exact_as_its_emulation(name: str, steps: int, suffix: int, length: int) -> None:
    """Both against exact activations. Rounded numbers near an edge fall either way, so each problem has some luck."""
    if denoise.unavailable(GPU, "fp8"):
        pytest.skip("this GPU has no FP8")
    ours, emulated = [], []
    for seed in range(4 if name in ("shallow", "full") else 16):
        p = problem(name, steps, suffix, length, seed, GPU)
        packed = PackedExpert.pack(p.config, p.layers, input_scales(p))
        x_t, _ = portable_outputs(p, packed)
        p.layers = standing_for(packed, p)
        reference = plain(p, torch.float64)[0][-1]
        ours.append(relative(x_t[-1], reference))
        emulated.append(relative(plain(p, torch.float64, in_e4m3(packed.inputs))[0][-1], reference))
    assert sum(x * x for x in ours) <= 1.2**2 * sum(x * x for x in emulated)
