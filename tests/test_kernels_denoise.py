"""The denoising kernel: its packing on the CPU, its results on a GPU against the loop in plain PyTorch."""

import dataclasses
import re
from pathlib import Path

import pytest
import torch
from conftest import on_hopper
from kernel_turns.problems import (
    CONFIGS,
    FULL,
    GPU,
    Problem,
    has_nvrtc,
    input_scales,
    ordinary_bf16,
    plain,
    problem,
    relative,
)
from kernel_turns.stalls import disassembled
from torch import Tensor

from turbopi.kernels import nvrtc
from turbopi.kernels.portable.quantize import quantize
from turbopi.kernels.sm90.denoise import kernel as denoise
from turbopi.kernels.sm90.denoise import packing
from turbopi.kernels.sm90.denoise.packing import KINDS, PackedExpert
from turbopi.kernels.sm90.denoise.plain import in_e4m3
from turbopi.models.pi0.denoise import euler_step
from turbopi.quantization.directions import directions
from turbopi.support.errors import BackendError, BackendUnavailable

CPU = torch.device("cpu")

# ---- on the CPU


def ones(p: Problem) -> dict[str, float]:
    """Scales of activations that change nothing."""
    return {f"expert.{i}.{kind}": 1.0 for i in range(p.config.expert.depth) for kind in KINDS}


PRECISIONS = pytest.mark.parametrize("precision", ["bf16", "fp8"])
SMALL = pytest.mark.parametrize("name", ["golden", "tiny", "odd", "uneven"])


@SMALL
def test_packing_keeps_every_weight(name: str) -> None:
    p = problem(name, 1, 1, 3, 0, CPU)
    packed = PackedExpert.pack(p.config, p.layers)
    for i, layer in enumerate(p.layers):
        matrices = layer.qkv, layer.out, layer.gate_up, layer.down
        assert all(torch.equal(a, b) for a, b in zip(packed.matrices(i), matrices, strict=True))


@SMALL
def test_packing_in_fp8_keeps_every_weight_as_e4m3_rounds_it(name: str) -> None:
    p = problem(name, 1, 1, 3, 0, CPU, outliers=True)
    p.layers[0].out[2] = 0  # a channel of zeros needs no scale
    packed = PackedExpert.pack(p.config, p.layers, ones(p))
    for i, layer in enumerate(p.layers):
        for found, matrix in zip(packed.matrices(i), (layer.qkv, layer.out, layer.gate_up, layer.down), strict=True):
            expected = quantize(matrix, 1.0).dequantized()
            torch.testing.assert_close(found, expected, rtol=1e-6, atol=0)
            # 4 bits of mantissa: within 2^-4 of each, or of the smallest normal number, 2^-6 / 448 of the largest
            bound = torch.maximum(matrix.abs().float(), matrix.abs().amax(dim=1, keepdim=True).float() / (64 * 448))
            assert ((found - matrix.float()).abs() <= bound / 16 * 1.001).all()


def test_packing_in_fp8_rounds_for_a_sites_directions() -> None:
    p = problem("golden", 1, 1, 3, 0, CPU)
    known = {}
    for kind, width in (("out", 128), ("down", 64)):
        common = directions(torch.rand(50, width))
        assert common is not None
        known[f"expert.1.{kind}"] = common
    packed = PackedExpert.pack(p.config, p.layers, ones(p), known)
    for i, layer in enumerate(p.layers):
        for found, kind in zip(packed.matrices(i), KINDS, strict=True):
            matrix, place = getattr(layer, kind), f"expert.{i}.{kind}"
            expected = quantize(matrix, 1.0, known.get(place)).dequantized()
            torch.testing.assert_close(found, expected, rtol=1e-6, atol=0)
            assert (place in known) != torch.equal(expected, quantize(matrix, 1.0).dequantized())


@SMALL
def test_every_row_has_one_owner(name: str) -> None:
    a = packing.Arrangement(CONFIGS[name])
    g = a.config.expert
    ctas = [(cluster, rank) for cluster in range(a.clusters) for rank in range(packing.RANKS)]
    qkv = torch.cat([rows(*cta).flatten() for cta in ctas for rows in (a.query_rows, a.key_value_rows)])
    assert sorted(qkv.tolist()) == list(range((g.num_heads + 2) * g.head_dim))
    gate_up = torch.cat([a.gate_up_rows(*cta).flatten() for cta in ctas])
    assert sorted(gate_up.tolist()) == list(range(2 * g.mlp_dim))
    stream = torch.cat([a.stream_rows(rank).flatten() for rank in range(packing.RANKS)])
    assert sorted(stream.tolist()) == list(range(g.width))
    assert [unit for cluster in range(a.clusters) for unit in a.hidden(cluster)] == list(range(g.mlp_dim))


def test_a_fragment_consists_of_the_tensor_cores_core_matrices() -> None:
    matrix = torch.arange(16 * 32).view(1, 16, 32)
    cores = packing.fragments(matrix, 1, -1)[: 2 * 256].view(2, 2, 2, 8, 8)  # [block][8 rows][8 columns][row][column]
    assert torch.equal(cores[1, 0, 1], matrix[0, :8, 24:])
    assert torch.equal(cores[1, 1, 0], matrix[0, 8:, 16:24])


def test_a_fragment_of_fp8_has_two_blocks() -> None:
    matrix = torch.arange(16 * 48).view(1, 16, 48)
    cores = packing.fragments(matrix, 1, -1, "fp8")[: 2 * 512].view(
        2, 2, 2, 8, 16
    )  # [pair][8 rows][block][row][column]
    assert torch.equal(cores[0, 1, 1], matrix[0, 8:, 16:32])
    assert torch.equal(cores[1, 0, 0], matrix[0, :8, 32:])
    assert (cores[1, :, 1] == -1).all()  # three blocks make two pairs


def test_shift_table_is_the_shift_through_the_matrices() -> None:
    p = problem("tiny", 2, 1, 3, 1, CPU)
    packed = PackedExpert.pack(p.config, p.layers)
    a = packed.arrangement
    shifted = packing.Tables.make(packed, p.table).shifted
    rows = a.gate_up_rows(5, 3)
    expected = p.layers[4].gate_up.float()[rows] @ p.table[1, 9, 1]
    first = a.max_tiles[0] + a.max_tiles[1]
    torch.testing.assert_close(shifted[1, 4, 5 * packing.RANKS + 3, first : first + len(rows)], expected)


def test_tables_undo_the_scales_of_e4m3_numbers() -> None:
    """A layer's products as the kernel makes them of its tables, against the matrices that the weights stand for."""
    p = problem("tiny", 2, 1, 3, 1, CPU)
    scales = {site: 0.01 * (1 + i) for i, site in enumerate(ones(p))}
    packed = PackedExpert.pack(p.config, p.layers, scales)
    tables, a, layer, step, cta = packing.Tables.make(packed, p.table), packed.arrangement, 4, 1, 5 * packing.RANKS + 3
    g, gen = a.config.expert, torch.Generator().manual_seed(1)
    qkv, _, gate_up, _ = packed.matrices(layer)
    modulation, expected = tables.modulation[step], p.table[step]
    x = torch.randn(g.width, generator=gen)
    times = float(tables.values_times[layer])
    assert torch.tensor(times).log2() % 1 == 0 and 1 / times >= scales["expert.4.out"] > 0.5 / times
    mine = torch.cat((a.query_rows(5, 3), a.key_value_rows(5, 3)))
    for rows, matrix, norm, first, factors in (
        (mine, qkv, 2 * layer, 0, torch.where(mine >= (g.num_heads + 1) * g.head_dim, times, 1.0)),
        (
            a.gate_up_rows(5, 3),
            gate_up,
            2 * layer + 1,
            a.max_tiles[0] + a.max_tiles[1],
            torch.where(a.gate_up_rows(5, 3) >= g.mlp_dim, 1 / scales["expert.4.down"], 1.0),
        ),
    ):
        own = packed.row_scales(layer)[0 if norm % 2 == 0 else 2][rows]
        here = slice(first, first + len(rows))
        product = (matrix[rows] @ (x * modulation[norm, 0])) / own * tables.row_scales[layer, cta, here]
        wanted = matrix[rows] @ (x * expected[norm, 0]) * factors
        torch.testing.assert_close(product, wanted, rtol=1e-5, atol=1e-5)
        torch.testing.assert_close(
            tables.shifted[step, layer, cta, here], matrix[rows] @ expected[norm, 1] * factors, rtol=1e-5, atol=1e-5
        )
    for norm, own, factor in (
        (2 * layer, packed.row_scales(layer)[1], 1 / times),
        (2 * layer + 1, packed.row_scales(layer)[3], scales["expert.4.down"]),
    ):
        torch.testing.assert_close(modulation[norm, 2], expected[norm, 2] * own * factor)
    assert torch.equal(modulation[-1], expected[-1]) and torch.equal(modulation[:, 1], expected[:, 1])


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"width": 1000}, "multiples of 16: width 1000"),
        ({"head_dim": 40, "num_heads": 4}, "multiple of 16 up to 256, it is 40"),
        ({"head_dim": 512}, "multiple of 16 up to 256, it is 512"),
        ({"num_heads": 7}, "an even number of heads, this model has 7"),
    ],
)
def test_sizes_it_does_not_cover_are_named(changes: dict[str, int], text: str) -> None:
    g = dataclasses.replace(FULL.expert, **changes)
    vlm = dataclasses.replace(FULL.vlm, head_dim=g.head_dim, num_heads=g.num_heads)
    with pytest.raises(BackendError, match=text):
        PackedExpert.pack(dataclasses.replace(FULL, expert=g, vlm=vlm), [])


def test_pi0_is_refused_by_name() -> None:
    with pytest.raises(BackendError, match="this model is pi0"):
        PackedExpert.pack(dataclasses.replace(FULL, kind="pi0"), [])


def test_a_machine_without_gpu_is_refused() -> None:
    p = problem("golden", 1, 4, 3, 0, CPU)
    with pytest.raises(BackendUnavailable, match="needs an NVIDIA GPU"):
        denoise.DenoiseKernel(
            p.config,
            PackedExpert.pack(p.config, p.layers),
            p.small,
            p.table,
            cache_rows=10,
            suffix=4,
            device=CPU,
        )


@pytest.mark.slow
@pytest.mark.skipif(not has_nvrtc(), reason="no NVRTC here")
@pytest.mark.parametrize(("name", "suffix", "fp8"), [("golden", 10, False), ("uneven", 33, True)])
def test_the_source_compiles_for_hopper(tmp_path: Path, name: str, suffix: int, fp8: bool) -> None:
    """Of full size: in the tests of the machine code."""
    arrangement = packing.Arrangement(CONFIGS[name])
    sizes = denoise.kernel_sizes(arrangement, cache_rows=968, suffix=suffix, shared_bytes=232448, fp8=fp8)
    code = denoise.compiled("sm_90a", sizes, folder=tmp_path)
    assert [path.read_bytes() for path in tmp_path.iterdir()] == [code]  # kept for the next start


def machine_code(name: str, folder: Path, cubins: Path, *, suffix: int, fp8: bool = False) -> str:
    """The kernel's, as text. `folder` is for the disassembler, `cubins` keeps what was compiled in this session: the
    same kernels as in tools/machine_code.py.
    """
    arrangement = packing.Arrangement(CONFIGS[name])
    sizes = denoise.kernel_sizes(arrangement, cache_rows=976, suffix=suffix, shared_bytes=232448, fp8=fp8)
    pytest.importorskip("triton")
    return disassembled(denoise.compiled("sm_90a", sizes, folder=cubins), folder)


@pytest.mark.slow
@pytest.mark.skipif(not has_nvrtc(), reason="no NVRTC here")
def test_the_product_that_keeps_tensor_cores_awake_is_in_the_machine_code(tmp_path: Path, cubins: Path) -> None:
    # ptxas leaves out products whose sums nobody reads
    code = machine_code("golden", tmp_path, cubins, suffix=10)
    assert re.search(r"HMMA[^\n]*\n[^\n]*NANOSLEEP 0x64", code), "100 ns without a product before them"


@pytest.mark.slow
@pytest.mark.skipif(not has_nvrtc(), reason="no NVRTC here")
@pytest.mark.parametrize(
    ("suffix", "fp8", "together"),  # rounds are of two products where slots are small
    [(10, False, 3), (10, True, 3), (24, True, 3), (50, False, 2), (50, True, 2)],
)
def test_products_do_not_wait_for_each_other(
    tmp_path: Path, cubins: Path, suffix: int, fp8: bool, together: int
) -> None:
    # where ptxas can't tell who touches their registers it puts a fence and a wait around every single one
    code = machine_code("full", tmp_path, cubins, suffix=suffix, fp8=fp8)
    products, fences = len(re.findall("[HQ]GMMA", code)), len(re.findall("WARPGROUP.ARRIVE", code))
    assert products >= together * fences > 0
    assert products >= 3 * len(re.findall(r"WARPGROUP\.DEPBAR\.LE gsb0, 0x0", code)) > 0


@pytest.mark.slow
@pytest.mark.skipif(not has_nvrtc(), reason="no NVRTC here")
@pytest.mark.parametrize(("suffix", "fp8"), [(10, False), (10, True), (24, False), (50, True)])
def test_ptxas_knows_that_the_lanes_of_a_warp_stay_together(
    tmp_path: Path, cubins: Path, suffix: int, fp8: bool
) -> None:
    # else products find their operands' places lane by lane: see `of_warp`. With few tokens those of a spare warp may
    # part, and the others' at the very end
    code = machine_code("full", tmp_path, cubins, suffix=suffix, fp8=fp8)
    assert len(re.findall(r"BRA\.DIV", code)) <= (2 if suffix <= denoise.FEW else 0)


@pytest.mark.skipif(not has_nvrtc(), reason="no NVRTC here")
def test_too_many_keys_for_shared_memory_are_refused_by_name(tmp_path: Path) -> None:
    arrangement = packing.Arrangement(CONFIGS["full"])
    sizes = denoise.kernel_sizes(arrangement, cache_rows=20000, suffix=56, shared_bytes=232448)
    with pytest.raises(BackendUnavailable, match=r"56 suffix tokens and 20000 cache rows leave .* 232448 bytes"):
        denoise.compiled("sm_90a", sizes, folder=tmp_path)


@pytest.mark.skipif(not has_nvrtc(), reason="no NVRTC here")
def test_a_source_that_does_not_compile_shows_the_compilers_log(tmp_path: Path) -> None:
    with pytest.raises(BackendError, match=r"SIZE=3.*\n.*undefined_thing"):
        nvrtc.compile_cubin("__global__ void f() { undefined_thing(); }", "sm_90a", {"SIZE": 3}, folder=tmp_path)
    assert not list(tmp_path.iterdir())


def test_other_gpus_are_refused_by_name(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda device: (12, 0))
    assert denoise.unavailable(GPU) == "the denoising kernel is written for compute capability 9.0, this GPU has 12.0"


def test_the_clock_is_cycles_by_time() -> None:
    assert denoise.megahertz(0, 0) is None
    assert denoise.megahertz(4_500_000, 2_500_000) == 1800


def test_blocks_that_gave_up_say_where() -> None:
    assert denoise.stuck([0, 0]) is None
    word = (1 << 31 | 4 << 20 | 37) - (1 << 32)  # as int32
    assert str(denoise.stuck([0, word, word])).endswith("layer 37 for outputs")


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


def kernel_of(
    p: Problem, precision: packing.Precision = "bf16", packed: PackedExpert | None = None
) -> denoise.DenoiseKernel:
    rows, suffix = p.cache_k.shape[1], p.noise.shape[0]
    if packed is None:
        packed = PackedExpert.pack(p.config, p.layers, input_scales(p) if precision == "fp8" else None)
    return denoise.DenoiseKernel(p.config, packed, p.small, p.table, cache_rows=rows, suffix=suffix, device=GPU)


SHAPES = pytest.mark.parametrize(
    ("name", "steps", "suffix", "length"),
    [
        ("golden", 3, 10, 37),
        ("golden", 1, 1, 5),
        ("golden", 10, 50, 77),
        ("golden", 2, 50, 1100),
        ("tiny", 3, 10, 300),
        ("odd", 3, 16, 101),
        ("uneven", 2, 33, 256),
        ("odd", 2, 50, 1100),
        ("uneven", 2, 50, 100),
        ("uneven", 2, 10, 100),
        ("shallow", 1, 1, 304),
        ("shallow", 3, 10, 571),
        ("shallow", 2, 16, 968),
        ("shallow", 2, 17, 77),
        ("shallow", 2, 24, 968),
        ("shallow", 2, 40, 560),
        ("shallow", 2, 50, 120),
        ("shallow", 2, 50, 600),
        ("shallow", 1, 48, 1000),
        ("shallow", 3, 50, 968),
        ("shallow", 1, 50, 1100),
        ("shallow", 1, 56, 1000),
        ("shallow", 3, 10, 1),
        ("full", 10, 10, 559),
        ("full", 3, 50, 560),
    ],
)


@on_hopper
def test_it_tells_its_clock() -> None:
    p = problem("shallow", 2, 10, 100, 1, GPU)
    kernel = kernel_of(p)
    assert kernel.clock_mhz() is None
    run(p, kernel)
    clock = kernel.clock_mhz()
    assert clock is not None and 300 < clock < 3000  # between idle and more than any has


@on_hopper
@SHAPES
@pytest.mark.parametrize("outliers", [False, True])
def test_kernel_is_as_exact_as_ordinary_bf16(name: str, steps: int, suffix: int, length: int, outliers: bool) -> None:
    p = problem(name, steps, suffix, length, steps * 1000 + suffix, GPU, outliers=outliers)
    x_t, v_t = run(p, kernel_of(p))
    reference, _ = plain(p, torch.float64)
    assert x_t.isfinite().all() and v_t.isfinite().all()
    assert torch.equal(x_t[0], p.noise)
    torch.testing.assert_close(x_t[1:], euler_step(x_t[:-1], v_t, steps), rtol=0, atol=0)
    assert relative(x_t[-1], reference[-1]) <= 1.1 * relative(ordinary_bf16(p), reference[-1])


@on_hopper
@SHAPES
@pytest.mark.parametrize("outliers", [False, True])
def test_in_fp8_it_is_as_exact_as_its_emulation(
    name: str, steps: int, suffix: int, length: int, outliers: bool
) -> None:
    """Both against exact activations. Rounded numbers near an edge fall either way, so each problem has some luck."""
    ours, emulated = [], []
    for seed in range(4 if name in ("shallow", "full") else 16):
        p = problem(name, steps, suffix, length, seed, GPU, outliers=outliers)
        packed = PackedExpert.pack(p.config, p.layers, input_scales(p))
        x_t, v_t = run(p, kernel_of(p, packed=packed))
        assert x_t.isfinite().all() and v_t.isfinite().all()
        stood_for = [dict(zip(KINDS, packed.matrices(i), strict=True)) for i in range(p.config.expert.depth)]
        p.layers = [dataclasses.replace(layer, **new) for layer, new in zip(p.layers, stood_for, strict=True)]
        reference = plain(p, torch.float64)[0][-1]
        ours.append(relative(x_t[-1], reference))
        emulated.append(relative(plain(p, torch.float64, in_e4m3(packed.inputs))[0][-1], reference))
    print(f"{name} {suffix} {outliers}: {[f'{a:.3f}/{b:.3f}' for a, b in zip(ours, emulated, strict=True)]}")
    assert sum(x * x for x in ours) <= 1.2**2 * sum(x * x for x in emulated)


@on_hopper
@pytest.mark.parametrize("times", [20, 60])
@pytest.mark.parametrize("suffix", [10, 50])
def test_weights_of_suffix_keys_far_above_the_prefixs_do_not_overflow(suffix: int, times: int) -> None:
    p = problem("shallow", 1, suffix, 300, 3, GPU)
    p.cache_k[:, :300] = 0
    for layer in p.layers:  # weights of the suffix reach some 2^70 (2^210) times the prefix's
        layer.qkv[-2 * p.config.expert.head_dim : -p.config.expert.head_dim] *= times
    x_t, v_t = run(p, kernel_of(p))
    assert x_t.isfinite().all() and v_t.isfinite().all()


@on_hopper
@PRECISIONS
@pytest.mark.parametrize("suffix", [10, 24, 50])
def test_numbers_that_are_none_come_out_as_such_and_nobody_waits_for_others(
    suffix: int, precision: packing.Precision
) -> None:
    p = problem("shallow", 2, suffix, 300, 4, GPU)
    kernel = kernel_of(p, precision=precision)
    p.noise[-1] = torch.nan  # every token sees the last one
    x_t, v_t = run(p, kernel)
    assert x_t[1:].isnan().all() and v_t.isnan().all()
    p.noise[-1] = 0
    assert all(t.isfinite().all() for t in run(p, kernel))


@on_hopper
@PRECISIONS
@pytest.mark.parametrize("suffix", [10, 33, 50])
def test_it_repeats_itself_bit_by_bit(suffix: int, precision: packing.Precision) -> None:
    p = problem("shallow", 2, suffix, 600, 5, GPU)
    kernel = kernel_of(p, precision=precision)
    first = run(p, kernel)
    assert all(torch.equal(a, b) for _ in range(20) for a, b in zip(first, run(p, kernel), strict=True))


@on_hopper
@pytest.mark.parametrize("suffix", [10, 50])
def test_one_kernel_serves_many_lengths(suffix: int) -> None:
    p = problem("shallow", 3, suffix, 600, 5, GPU)
    kernel = kernel_of(p)
    for p.length in (600, 1, 7, 8, 15, 16, 17, 128, 304, 512, 513, 599):
        p.noise = torch.randn_like(p.noise)
        assert relative(run(p, kernel)[0][-1], plain(p, torch.float64)[0][-1]) < 0.01


@on_hopper
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


@on_hopper
def test_too_many_suffix_tokens_are_refused() -> None:
    p = problem("golden", 1, 57, 3, 0, GPU)
    with pytest.raises(BackendError, match="1 to 56 suffix tokens, not 57"):
        kernel_of(p)


@on_hopper
def test_more_clusters_than_fit_are_refused() -> None:
    with pytest.raises(BackendUnavailable, match="needs 32 clusters of 8 multiprocessors at once"):
        kernel_of(problem("crowd", 1, 10, 77, 0, GPU))
