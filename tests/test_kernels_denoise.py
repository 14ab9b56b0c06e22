"""The denoising kernel: its packing on the CPU, its results on a GPU against the same loop in plain PyTorch."""

import dataclasses
from pathlib import Path

import pytest
import torch
from denoise_helpers import CONFIGS, FULL, GPU, Problem, has_nvrtc, ordinary_bf16, plain, problem, relative
from torch import Tensor

from turbopi.errors import BackendError, BackendUnavailable
from turbopi.kernels import denoise, nvrtc

# ---- on the CPU


@pytest.mark.parametrize("name", ["golden", "tiny", "odd"])
def test_packing_keeps_every_weight_in_its_place(name: str) -> None:
    p = problem(name, 1, 1, 3, 0, torch.device("cpu"))
    g = p.config.expert
    packed = denoise.PackedExpert.pack(p.config, p.layers)
    qkv_rows, gate_up_rows = denoise.rope_pairs(g.num_heads, g.head_dim), denoise.gate_up_pairs(g.mlp_dim)
    assert sorted(qkv_rows.tolist()) == list(range(len(qkv_rows)))
    assert sorted(gate_up_rows.tolist()) == list(range(len(gate_up_rows)))
    for i, layer in enumerate(p.layers):
        qkv, out, gate_up, down = packed.matrices(p.config, i)
        assert torch.equal(qkv, layer.qkv[qkv_rows])
        assert torch.equal(out, layer.out)
        assert torch.equal(gate_up, layer.gate_up[gate_up_rows])
        assert torch.equal(down, layer.down)


def test_a_tile_is_blocks_of_32_columns_row_by_row() -> None:
    matrix = torch.arange(16 * 64).view(16, 64)
    flat = denoise.tiles(matrix).view(2, 2, 8, 32)
    assert torch.equal(flat[1, 0, 3], matrix[11, :32])
    assert torch.equal(flat[0, 1, 7], matrix[7, 32:])


def test_rope_partners_sit_side_by_side() -> None:
    rows = denoise.rope_pairs(num_heads=2, head_dim=16).view(4, 16)
    assert rows[0].tolist()[:6] == [0, 8, 1, 9, 2, 10]
    assert rows[2].tolist()[:4] == [32, 40, 33, 41]  # the key head
    assert rows[3].tolist() == list(range(48, 64))  # values: as they are


def test_shift_table_is_the_shift_through_the_matrices() -> None:
    p = problem("tiny", 2, 1, 3, 1, torch.device("cpu"))
    packed = denoise.PackedExpert.pack(p.config, p.layers)
    shifted = denoise.shifted_rows(p.config, packed, p.table)
    rows = denoise.gate_up_pairs(p.config.expert.mlp_dim)
    expected = p.layers[4].gate_up[rows].float() @ p.table[1, 9, 1]
    torch.testing.assert_close(shifted[1, 4, -len(rows) :], expected, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"width": 1000}, "multiples of 32: width 1000"),
        ({"head_dim": 40, "num_heads": 4}, "multiple of 16 up to 256, it is 40"),
        ({"head_dim": 512}, "multiple of 16 up to 256, it is 512"),
    ],
)
def test_sizes_it_does_not_cover_are_named(changes: dict[str, int], text: str) -> None:
    g = dataclasses.replace(FULL.expert, **changes)
    vlm = dataclasses.replace(FULL.vlm, head_dim=g.head_dim, num_heads=g.num_heads)
    config = dataclasses.replace(FULL, expert=g, vlm=vlm)
    with pytest.raises(BackendError, match=text):
        denoise.PackedExpert.pack(config, [])


def test_pi0_is_refused_by_name() -> None:
    with pytest.raises(BackendError, match="this model is pi0"):
        denoise.PackedExpert.pack(dataclasses.replace(FULL, kind="pi0"), [])


def test_a_machine_without_gpu_is_refused() -> None:
    p = problem("golden", 1, 4, 3, 0, torch.device("cpu"))
    with pytest.raises(BackendUnavailable, match="needs an NVIDIA GPU"):
        denoise.DenoiseKernel(p.config, p.layers, p.small, p.table, cache_rows=10, suffix=4, device=torch.device("cpu"))


@pytest.mark.skipif(not has_nvrtc(), reason="no NVRTC here")
def test_the_source_compiles_for_hopper_and_is_kept(tmp_path: Path) -> None:
    sizes = denoise.kernel_sizes(CONFIGS["golden"], cache_rows=100, suffix=10, num_sms=132, shared_bytes=232448)
    code = nvrtc.compile_cubin(denoise.source(), "sm_90a", sizes, folder=tmp_path)
    assert [path.read_bytes() for path in tmp_path.iterdir()] == [code]
    assert nvrtc.compile_cubin(denoise.source(), "sm_90a", sizes, folder=tmp_path) == code


@pytest.mark.skipif(not has_nvrtc(), reason="no NVRTC here")
def test_a_source_that_does_not_compile_shows_the_compilers_log(tmp_path: Path) -> None:
    with pytest.raises(BackendError, match=r"SIZE=3.*\n.*undefined_thing"):
        nvrtc.compile_cubin("__global__ void f() { undefined_thing(); }", "sm_90a", {"SIZE": 3}, folder=tmp_path)
    assert not list(tmp_path.iterdir())


# ---- on a GPU


def run(p: Problem, kernel: denoise.DenoiseKernel) -> tuple[Tensor, Tensor]:
    """Both outputs, poisoned before."""
    steps, chunk = p.table.shape[0], p.noise.shape
    x_t = torch.full((steps + 1, *chunk), torch.nan, device=GPU)
    v_t = torch.full((steps, *chunk), torch.nan, device=GPU)
    length = torch.tensor([p.length], device=GPU)
    kernel.launch(p.noise, p.cache_k, p.cache_v, length, x_t, v_t)
    torch.cuda.synchronize()
    return x_t, v_t


def kernel_of(p: Problem, rows: int | None = None) -> denoise.DenoiseKernel:
    return denoise.DenoiseKernel(
        p.config,
        p.layers,
        p.small,
        p.table,
        cache_rows=rows or p.cache_k.shape[1],
        suffix=p.noise.shape[0],
        device=GPU,
    )


@pytest.mark.gpu
@pytest.mark.parametrize(
    ("name", "steps", "suffix", "length"),
    [
        ("golden", 3, 10, 37),
        ("golden", 1, 1, 5),
        ("golden", 10, 50, 77),
        ("tiny", 3, 10, 300),
        ("odd", 3, 16, 101),
        ("odd", 2, 33, 256),
        ("shallow", 1, 1, 304),
        ("shallow", 3, 10, 571),
        ("shallow", 2, 16, 968),
        ("shallow", 2, 17, 77),
        ("shallow", 3, 50, 968),
        ("shallow", 1, 64, 1000),
        ("shallow", 3, 10, 1),
        ("full", 10, 10, 559),
        ("full", 3, 50, 560),
    ],
)
@pytest.mark.parametrize("outliers", [False, True])
def test_kernel_is_as_exact_as_ordinary_bf16(name: str, steps: int, suffix: int, length: int, outliers: bool) -> None:
    p = problem(name, steps, suffix, length, steps * 1000 + suffix, GPU, outliers=outliers)
    x_t, v_t = run(p, kernel_of(p))
    reference, _ = plain(p, torch.float64)
    assert x_t.isfinite().all() and v_t.isfinite().all()
    assert torch.equal(x_t[0], p.noise)
    torch.testing.assert_close(x_t[1:], denoise.euler_step(x_t[:-1], v_t, steps), rtol=0, atol=0)
    assert relative(x_t[-1], reference[-1]) <= 1.1 * relative(ordinary_bf16(p), reference[-1])


@pytest.mark.gpu
def test_one_kernel_serves_many_lengths_and_repeats_itself_bit_by_bit() -> None:
    p = problem("shallow", 3, 10, 600, 5, GPU)
    kernel = kernel_of(p)
    for length in (600, 1, 15, 16, 17, 304, 599):
        p.length = length
        p.noise = torch.randn_like(p.noise)
        first, again = run(p, kernel), run(p, kernel)
        assert torch.equal(first[0], again[0]) and torch.equal(first[1], again[1])
        assert relative(first[0][-1], plain(p, torch.float64)[0][-1]) < 0.01


@pytest.mark.gpu
def test_replays_of_a_captured_graph_read_inputs_anew() -> None:
    p = problem("shallow", 3, 10, 500, 6, GPU)
    kernel, length = kernel_of(p), torch.tensor([500], device=GPU)
    x_t, v_t = torch.empty(4, 10, 32, device=GPU), torch.empty(3, 10, 32, device=GPU)
    stream = torch.cuda.Stream()  # type: ignore[no-untyped-call]
    with torch.cuda.stream(stream):
        kernel.launch(p.noise, p.cache_k, p.cache_v, length, x_t, v_t)
    stream.synchronize()
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph, stream=stream):
        kernel.launch(p.noise, p.cache_k, p.cache_v, length, x_t, v_t)
    for p.length in (500, 123):
        p.noise.normal_()
        length.fill_(p.length)
        x_t.fill_(torch.nan)
        graph.replay()
        torch.cuda.synchronize()
        assert torch.equal(x_t, run(p, kernel)[0])
        assert relative(x_t[-1], plain(p, torch.float64)[0][-1]) < 0.01


@pytest.mark.gpu
def test_too_many_suffix_tokens_are_refused() -> None:
    p = problem("golden", 1, 65, 3, 0, GPU)
    with pytest.raises(BackendError, match="1 to 64 suffix tokens, not 65"):
        kernel_of(p)
