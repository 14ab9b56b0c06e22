"""The denoising kernel: its packing on the CPU, its results on a GPU against the same loop in plain PyTorch."""

import dataclasses
from functools import lru_cache
from pathlib import Path

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from turbopi.config import GemmaConfig, ModelConfig, preset
from turbopi.engine.weights import GemmaLayer
from turbopi.errors import BackendError, BackendUnavailable
from turbopi.kernels import denoise, nvrtc
from turbopi.model.layers import apply_rope, rms_normalize, rope_tables

FULL = preset("pi05_libero").model
BF16 = torch.bfloat16


def sized(width: int, mlp_dim: int, depth: int, head_dim: int, heads: int = 8) -> ModelConfig:
    expert = GemmaConfig(width=width, mlp_dim=mlp_dim, depth=depth, head_dim=head_dim, num_heads=heads)
    vlm = dataclasses.replace(FULL.vlm, depth=depth, head_dim=head_dim, num_heads=heads)
    return dataclasses.replace(FULL, expert=expert, vlm=vlm)


CONFIGS = {
    "golden": sized(32, 64, 3, 16),
    "tiny": sized(128, 256, 6, 32),
    "odd": sized(160, 224, 2, 48, 4),
    "shallow": sized(1024, 4096, 3, 256),
    "full": FULL,
}


@dataclasses.dataclass
class Problem:
    """Random weights, modulation and inputs; the cache is NaN beyond the valid length."""

    config: ModelConfig
    layers: list[GemmaLayer]
    small: dict[str, Tensor]
    table: Tensor
    noise: Tensor
    cache_k: Tensor
    cache_v: Tensor
    length: int


def problem(
    name: str, steps: int, suffix: int, length: int, seed: int, device: torch.device, *, outliers: bool = False
) -> Problem:
    config = CONFIGS[name]
    g, gen = config.expert, torch.Generator(device).manual_seed(seed)
    heads = g.num_heads * g.head_dim

    def random(*shape: int, std: float = 1.0, dtype: torch.dtype = torch.float32) -> Tensor:
        return (torch.randn(*shape, generator=gen, device=device) * std).to(dtype)

    layers = [
        GemmaLayer(
            qkv=random(heads + 2 * g.head_dim, g.width, std=g.width**-0.5, dtype=BF16),
            out=random(g.width, heads, std=heads**-0.5, dtype=BF16),
            gate_up=random(2 * g.mlp_dim, g.width, std=g.width**-0.5, dtype=BF16),
            down=random(g.width, g.mlp_dim, std=1.5 * g.mlp_dim**-0.5, dtype=BF16),
            norm1=None,
            norm2=None,
        )
        for _ in range(g.depth)
    ]
    if outliers:  # one residual column and one input far above the rest, as in trained models
        for layer in layers:
            layer.down[3] *= 30
            layer.qkv[:, 5] *= 4
    small = {
        "action_in_proj.weight": random(g.width, config.action_dim, std=config.action_dim**-0.5),
        "action_in_proj.bias": random(g.width, std=0.1),
        "action_out_proj.weight": random(config.action_dim, g.width, std=g.width**-0.5),
        "action_out_proj.bias": random(config.action_dim, std=0.1),
    }
    table = random(steps, 2 * g.depth + 1, 3, g.width, std=0.3)
    table[:, :, 0] += 1
    table[:, :, 2] *= 2
    cache = [random(g.depth, length + 7, g.head_dim, dtype=BF16) for _ in "kv"]
    for part in cache:
        part[:, length:] = torch.nan
    noise = random(suffix, config.action_dim)
    return Problem(config, layers, small, table, noise, cache[0], cache[1], length)


def plain(p: Problem, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    noise = p.noise.to(dtype)
    return denoise.denoise_plain(p.config, p.layers, p.small, p.table, noise, p.cache_k, p.cache_v, p.length)


def ordinary_bf16(p: Problem) -> Tensor:
    """The same with PyTorch's bfloat16 operations, as the reference rounds: what the kernel's error is measured by."""
    g, suffix, x_t = p.config.expert, p.noise.shape[0], p.noise
    positions = p.length + torch.arange(suffix, device=x_t.device)
    cos, sin = (t[0, 0][:, None] for t in rope_tables(positions[None], g.head_dim, p.config.rope_base))

    def normed(x: Tensor, modulation: Tensor) -> tuple[Tensor, Tensor]:
        y = rms_normalize(x, p.config.rms_norm_eps) * modulation[0] + modulation[1]
        return y.to(BF16), modulation[2].to(BF16)

    def affine(name: str, x: Tensor) -> Tensor:
        return F.linear(x, p.small[f"{name}.weight"], p.small[f"{name}.bias"])

    for modulation in p.table:
        x = affine("action_in_proj", x_t).to(BF16)
        for i, layer in enumerate(p.layers):
            y, gate = normed(x, modulation[2 * i])
            parts = F.linear(y, layer.qkv).view(suffix, -1, g.head_dim)
            rotated = apply_rope(parts[:, :-1], cos, sin)
            keys = torch.cat((p.cache_k[i, : p.length], rotated[:, -1]))
            values = torch.cat((p.cache_v[i, : p.length], parts[:, -1]))
            q = rotated[:, :-1].reshape(-1, g.head_dim)
            attended = ((q @ keys.T).float() * g.head_dim**-0.5).softmax(-1).to(BF16) @ values
            x = x + F.linear(attended.view(suffix, -1), layer.out) * gate
            y, gate = normed(x, modulation[2 * i + 1])
            up_gate, up = F.linear(y, layer.gate_up).chunk(2, dim=-1)
            x = x + F.linear(F.gelu(up_gate, approximate="tanh") * up, layer.down) * gate
        v_t = affine("action_out_proj", normed(x, modulation[2 * g.depth])[0].float())
        x_t = denoise.euler_step(x_t, v_t, p.table.shape[0])
    return x_t


def relative(x: Tensor, reference: Tensor) -> float:
    return float((x.double() - reference.double()).norm() / reference.double().norm())


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


@lru_cache
def has_nvrtc() -> bool:
    try:
        nvrtc.bindings("nvrtc").nvrtcVersion()
    except (BackendError, RuntimeError):  # no package, or no library behind it
        return False
    return True


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

GPU = torch.device("cuda", 0)


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
