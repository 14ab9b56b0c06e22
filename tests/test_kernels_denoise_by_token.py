"""The denoising kernel's form in which every token has its own time: its index arithmetic and its twin on the CPU, the
kernel on a GPU against that twin.
"""

import ctypes
import dataclasses
import itertools
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from conftest import on_hopper
from kernel_turns.problems import (
    CONFIGS,
    GPU,
    WAYS,
    Problem,
    by_token,
    has_nvrtc,
    input_scales,
    ordinary_bf16,
    plain,
    problem,
    relative,
)
from kernel_turns.stalls import disassembled
from torch import Tensor

from turbopi.kernels.sm90.denoise import kernel as denoise
from turbopi.kernels.sm90.denoise import packing
from turbopi.kernels.sm90.denoise.packing import KINDS, PackedExpert
from turbopi.kernels.sm90.denoise.plain import in_e4m3

CPU = torch.device("cpu")
PRECISIONS = pytest.mark.parametrize("precision", ["bf16", "fp8"])

# ---- the twin


def test_with_the_same_times_the_twin_is_as_without_tokens() -> None:
    p = problem("golden", 4, 10, 37, 0, CPU)
    for found, expected in zip(plain(by_token(p, "same"), torch.float32), plain(p, torch.float32), strict=True):
        torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-6)


def test_tokens_take_their_rows_of_the_table() -> None:
    """A token that gets nothing from the others has the result of a loop with its row for all."""
    p = problem("golden", 1, 4, 1, 0, CPU)
    for layer in p.layers:
        layer.out.zero_()  # what tokens get from each other
    q = by_token(p, "distinct", 3)
    assert q.tokens is not None
    v_t = plain(q, torch.float64)[1][0]
    for token, row in enumerate(q.tokens.rows[0].tolist()):
        alone = plain(dataclasses.replace(p, table=q.table[row : row + 1]), torch.float64)[1][0, token]
        x, time, gain = p.noise[token].double(), q.tokens.times[0, token].double(), q.tokens.gain[0, token].double()
        expected = alone - gain * (q.tokens.target[token] - (x - time * alone))
        torch.testing.assert_close(v_t[token], expected)


def test_held_tokens_stay_and_the_others_take_whole_steps() -> None:
    p = by_token(problem("golden", 4, 10, 37, 0, CPU), "held")
    x_t, v_t = plain(p, torch.float32)
    assert torch.equal(x_t[:, :2], p.noise[:2].expand(5, 2, -1))
    torch.testing.assert_close(x_t[-1, 2:] - x_t[0, 2:], -v_t.mean(0)[2:])


# ---- what is compiled


SIZES: dict[str, Any] = {"cache_rows": 976, "shared_bytes": 232448}


def test_the_form_with_one_time_knows_nothing_of_tokens() -> None:
    sizes = denoise.kernel_sizes(packing.Arrangement(CONFIGS["full"]), suffix=50, **SIZES)
    assert "TP_BY_TOKEN" not in sizes
    assert not re.search("token_rows|token_steps", denoise.source(50, False))
    assert "token_rows" in denoise.source(50, False, True)


def local_memory(code: str) -> int:
    """Instructions of the loop that reach for registers' places in memory."""
    loop = code[code.index(".text.turbopi_denoise:") :]
    return len(re.findall(r"\b(?:STL|LDL)\b", loop[: loop.index(".section")] if ".section" in loop else loop))


@pytest.mark.slow
@pytest.mark.skipif(not has_nvrtc(), reason="no NVRTC here")
@pytest.mark.parametrize(("suffix", "fp8"), [(10, True), (24, False), (50, False), (50, True)])
def test_it_compiles_without_more_memory_traffic_or_waits_than_with_one_time(
    tmp_path: Path, cubins: Path, suffix: int, fp8: bool
) -> None:
    pytest.importorskip("triton")
    arrangement = packing.Arrangement(CONFIGS["full"])
    of_one, of_each = (
        disassembled(
            denoise.compiled(
                "sm_90a",
                denoise.kernel_sizes(arrangement, suffix=suffix, fp8=fp8, by_token=each, **SIZES),
                folder=cubins,
            ),
            tmp_path,
        )
        for each in (False, True)
    )
    assert local_memory(of_each) <= local_memory(of_one) + 6
    for waits in (r"WARPGROUP\.ARRIVE", r"WARPGROUP\.DEPBAR\.LE gsb0, 0x0", r"BRA\.DIV"):
        assert len(re.findall(waits, of_each)) == len(re.findall(waits, of_one))


# ---- token_times.cu on the CPU: which numbers a lane gets

HOST = """
#include <cstddef>
#include <cmath>
#define __host__
#define __device__
#define __forceinline__ inline
typedef unsigned u32; typedef unsigned long long u64;
struct float2 { float x, y; }; struct float4 { float x, y, z, w; }; struct uint4 { u32 x, y, z, w; };
struct ushort2 { unsigned short x, y; };
inline float4 make_float4(float x, float y, float z, float w) { return {x, y, z, w}; }
inline int min(int a, int b) { return a < b ? a : b; }
template <typename V> V __ldg(const V* p) { return *p; }
volatile float rounded;  // g++ may not make one operation of two
inline float __fmul_rn(float a, float b) { rounded = a * b; return rounded; }
inline float __fadd_rn(float a, float b) { rounded = a + b; return rounded; }
inline float __fsub_rn(float a, float b) { rounded = a - b; return rounded; }
inline u32 settled(u32 v) { return v; }
"""
CTA = """
struct Cta {
  const Args& a; byte* smem; u32 cta, thread, n;
  int g() const { return thread / 4 % 8; }
  int t() const { return thread % 4; }
  int lane() const { return thread % 32; }
  int cluster() const { return cta / S; }
  int x0() const { return share(D16, S, cta % S); }
};
const float* of_tiles(const Cta& b, const float* all, u32 layer) {
  return all + (layer * (NC * S) + b.cta) * (TILES * 16);
}
constexpr int GROUPS_GU = plan_groups(GTL);
template <int MT> constexpr int OWN = most(NT, group_parts(group_tiles(MT)));
template <int MT> struct Own { int tile[plan_groups(MT)], n[plan_groups(MT)][OWN<MT>]; };
inline int gate_up_row(const Cta& b, int tile) { return (QTL + KVL + min(tile, GTL - 1)) * 16 + b.g(); }
const float* lines[1 << 16];
int line_count;
void prefetch_line(const float* at) { lines[line_count++] = at; }
"""
ENTRIES = """
byte shared_[1 << 20];
extern "C" void keep(const Args* a, int step) {
  for (u32 thread = 0; thread < 512; ++thread) {
    const Cta b{*a, shared_, 0, thread, 0};
    KeptRow(b, step).keep(b);
  }
}
extern "C" void look_up(const Args* a, int step, int n, int part, int column, int token, int asked, float4* to) {
  const Cta b{*a, shared_, 0, 0, u32(n)};
  *to = factors(layer_table(b, step) + part * D, column, asked ? asked_rows(b, step, token) : rows_of(b, token));
}
extern "C" void shift(const Args* a, int step, int n, int cta, int lane, int tile, int tokens, float4* to) {
  const Cta b{*a, shared_, u32(cta), u32(lane), u32(n)};
  *to = Shifts(b, step)(b, tile * 16 + b.g(), tokens);
}
extern "C" float euler(const Args* a, int step, int token, int number, float x, float* v) {
  const Cta b{*a, shared_, 0, 0, 0};
  *v += action_shifts(b, step, token)[number];
  return EulerStep(b, step, token, number)(b, x, *v);
}
extern "C" int prefetched(const Args* a, int n, int cta, const float*** to) {
  line_count = 0, *to = lines;
  for (u32 lane = 0; lane < 32; ++lane) prefetch({*a, shared_, u32(cta), lane, u32(n)}, n);
  return line_count;
}
"""


class OnCpu:
    """The file's functions, and what they are given: random numbers of a small model, laid out as on a GPU."""

    def __init__(self, name: str, suffix: int, folder: Path) -> None:
        p = by_token(problem(name, 3, suffix, 5, 0, CPU), "distinct", 1)
        assert p.tokens is not None
        arrangement = packing.Arrangement(p.config)
        sizes = denoise.kernel_sizes(arrangement, suffix=suffix, by_token=True, **SIZES)
        here = denoise.FOLDER / "denoise"
        form = "few" if suffix <= denoise.FEW else "many"
        text = [
            HOST,
            *((here / f"{name}.cu").read_text() for name in ("sizes", "barriers")),
            denoise.ARGS_BY_TOKEN.source,
        ]
        text += [(here / form / "memory.cu").read_text(), CTA, (here / "token_times.cu").read_text(), ENTRIES]
        (folder / "times.cpp").write_text("\n".join(text))
        library = folder / "times.so"
        options = ["-std=c++17", "-w", "-O1", "-shared", "-fPIC", *(f"-D{key}={value}" for key, value in sizes.items())]
        subprocess.run(["g++", *options, "-o", str(library), str(folder / "times.cpp")], check=True)
        self.library = ctypes.CDLL(str(library))
        self.library.euler.restype = ctypes.c_float
        self.p, self.tokens, self.arrangement = p, p.tokens, arrangement
        packed = PackedExpert.pack(p.config, p.layers)
        tables = packing.Tables.make(packed, p.table)
        self.table, self.shifted = tables.modulation.numpy(), tables.shifted.numpy()
        self.out_shift = torch.randn(len(p.table), p.config.action_dim)
        self.kept = {
            "table": tables.modulation,
            "shifted": denoise._beside_each_other(tables.shifted),
            "out_shift": self.out_shift,
            "token_rows": self.tokens.rows,
            "token_steps": self.tokens.steps,
            "token_times": self.tokens.times,
            "target": self.tokens.target,
            "gain": self.tokens.gain,
        }
        numbers = {"steps": 3, "layer_stride": 0, "layer_bytes": 0, "dt": 0.0, "eps": 0.0, "zero": 0}
        given = {name: tensor.data_ptr() for name, tensor in self.kept.items()} | numbers
        args = {field.name: given.get(field.name) for field in denoise.ARGS_BY_TOKEN.fields}
        self.args = denoise.ARGS_BY_TOKEN.value(args)

    def call(self, name: str, *numbers: int) -> list[float]:
        four = (ctypes.c_float * 4)()
        getattr(self.library, name)(ctypes.byref(self.args), *numbers, four)
        return list(four)


@pytest.fixture(params=[("golden", 10), ("odd", 33), ("uneven", 16)], ids=str)
def on_cpu(request: pytest.FixtureRequest, tmp_path: Path) -> OnCpu:
    if shutil.which("g++") is None:
        pytest.skip("no g++ here")
    name, suffix = request.param
    return OnCpu(name, suffix, tmp_path)


def test_a_lane_gets_its_tokens_factors_of_its_columns(on_cpu: OnCpu) -> None:
    depth, suffix = on_cpu.p.config.expert.depth, len(on_cpu.p.noise)
    for step, layer, part in itertools.product(range(3), range(depth), (2, 3, 5, 6)):
        on_cpu.library.keep(ctypes.byref(on_cpu.args), step)
        norm, kind = 2 * layer + part // 3, part % 3
        for token in range(0, suffix, 2):
            both = on_cpu.tokens.rows[step, [token, min(token + 1, suffix - 1)]].tolist()
            expected = [on_cpu.table[row, norm, kind, 6 + i] for i in (0, 1) for row in both]
            for requested in (0, 1):
                assert on_cpu.call("look_up", step, step * depth + layer, part, 6, token, requested) == expected


def test_a_lane_gets_its_tokens_shifts_of_its_rows(on_cpu: OnCpu) -> None:
    depth, suffix = on_cpu.p.config.expert.depth, len(on_cpu.p.noise)
    ctas, tiles = on_cpu.shifted.shape[2:4]
    for step, layer, lane in itertools.product((0, 2), range(depth), (0, 5, 30)):
        on_cpu.library.keep(ctypes.byref(on_cpu.args), step)
        for cta, tile, n in itertools.product((0, 11, ctas - 1), range(tiles), range(-(-suffix // 8))):
            token, row = n * 8 + lane % 4 * 2, lane // 4
            both = on_cpu.tokens.rows[step, [min(token + i, suffix - 1) for i in (0, 1)]].tolist()
            expected = [on_cpu.shifted[at, layer, cta, tile, row + i] for i in (0, 8) for at in both]
            assert on_cpu.call("shift", step, step * depth + layer, cta, lane, tile, n) == expected


def test_a_number_is_guided_and_moved_as_pytorch_would(on_cpu: OnCpu) -> None:
    t, gen = on_cpu.tokens, np.random.default_rng(0)
    for step, token in itertools.product(range(3), range(len(on_cpu.p.noise))):
        x, v = (torch.tensor(gen.normal(), dtype=torch.float32) for _ in "xv")
        changed = ctypes.c_float(float(v))
        following = on_cpu.library.euler(
            ctypes.byref(on_cpu.args), step, token, 7, ctypes.c_float(float(x)), ctypes.byref(changed)
        )
        v = v + on_cpu.out_shift[t.rows[step, token], 7]
        v = v - t.gain[step, token] * (t.target[token, 7] - (x - t.times[step, token] * v))
        assert (changed.value, following) == (float(v), float(x + t.steps[step, token] * v))


@pytest.mark.slow
def test_what_a_cta_takes_of_the_tables_is_prefetched(on_cpu: OnCpu) -> None:
    g, suffix = on_cpu.p.config.expert, len(on_cpu.p.noise)
    table, shifted = on_cpu.kept["table"], on_cpu.kept["shifted"]
    for step, layer, cta in itertools.product((0, 2), range(g.depth), (0, 9)):
        lines = ctypes.POINTER(ctypes.c_void_p)()
        count = on_cpu.library.prefetched(ctypes.byref(on_cpu.args), step * g.depth + layer, cta, ctypes.byref(lines))
        found = {lines[i] for i in range(count)}
        cluster, rank = divmod(cta, packing.RANKS)
        columns = on_cpu.arrangement.stream_rows(rank).flatten().tolist()  # small models' ranks may have none
        for token in range(suffix):
            row = int(on_cpu.tokens.rows[step, token])
            assert shifted[row, layer, cta].data_ptr() in found
            kept = suffix <= denoise.FEW or token // 8 % g.num_heads == cluster
            for norm, kind in ((0, 2), (1, 0), (1, 2), (2, 0)) if columns else ():
                assert (table[row, 2 * layer + norm, kind, columns[0] :].data_ptr() in found) == kept


# ---- on a GPU


def run(p: Problem, kernel: denoise.DenoiseKernel) -> tuple[Tensor, Tensor]:
    """Both outputs, poisoned before."""
    steps, chunk = len(p.table) if p.tokens is None else len(p.tokens.rows), p.noise.shape
    x_t = torch.full((steps + 1, *chunk), torch.nan, device=GPU)
    v_t = torch.full((steps, *chunk), torch.nan, device=GPU)
    length = torch.tensor([p.length], device=GPU)
    kernel.launch(p.noise, p.cache_k, p.cache_v, length, x_t, v_t, p.tokens)
    torch.cuda.synchronize()
    return x_t, v_t


def kernel_of(p: Problem, packed: PackedExpert) -> denoise.DenoiseKernel:
    form: dict[str, Any] = {} if p.tokens is None else {"by_token": True, "num_steps": len(p.tokens.rows)}
    rows, suffix = p.cache_k.shape[1], p.noise.shape[0]
    return denoise.DenoiseKernel(p.config, packed, p.small, p.table, cache_rows=rows, suffix=suffix, device=GPU, **form)


def packed_of(p: Problem, precision: packing.Precision) -> PackedExpert:
    return PackedExpert.pack(p.config, p.layers, input_scales(p) if precision == "fp8" else None)


SHAPES = pytest.mark.parametrize(  # the same length where it doesn't matter: fewer kernels to compile
    ("name", "steps", "suffix", "length"),
    [
        ("golden", 3, 10, 37),
        ("golden", 2, 6, 5),
        ("odd", 3, 16, 101),
        ("uneven", 2, 33, 256),
        ("golden", 2, 50, 1100),
        ("shallow", 3, 10, 560),
        ("shallow", 2, 16, 560),
        ("shallow", 2, 24, 560),
        ("shallow", 3, 33, 560),
        ("shallow", 3, 50, 560),
        ("shallow", 1, 56, 1000),
        ("full", 10, 10, 560),
        ("full", 3, 50, 560),
    ],
)


@on_hopper
@SHAPES
@pytest.mark.parametrize("way", ["held", "distinct"])
def test_by_token_it_is_as_exact_as_ordinary_bf16(name: str, steps: int, suffix: int, length: int, way: str) -> None:
    p = by_token(problem(name, steps, suffix, length, steps * 1000 + suffix, GPU), way, suffix)
    x_t, v_t = run(p, kernel_of(p, packed_of(p, "bf16")))
    reference, _ = plain(p, torch.float64)
    assert p.tokens is not None and x_t.isfinite().all() and v_t.isfinite().all()
    assert torch.equal(x_t[0], p.noise)
    torch.testing.assert_close(x_t[1:], x_t[:-1] + p.tokens.steps[..., None] * v_t, rtol=0, atol=0)
    assert relative(x_t[-1], reference[-1]) <= 1.1 * relative(ordinary_bf16(p), reference[-1])


@on_hopper
@SHAPES
def test_by_token_in_fp8_it_is_as_exact_as_its_emulation(name: str, steps: int, suffix: int, length: int) -> None:
    """Both against exact activations, as the test of the form with one time: each problem has some luck."""
    ours, emulated = [], []
    for seed in range(4 if name in ("shallow", "full") else 16):
        p = by_token(problem(name, steps, suffix, length, seed, GPU), "distinct", seed)
        packed = packed_of(p, "fp8")
        x_t, v_t = run(p, kernel_of(p, packed))
        assert x_t.isfinite().all() and v_t.isfinite().all()
        stood_for = [dict(zip(KINDS, packed.matrices(i), strict=True)) for i in range(p.config.expert.depth)]
        p.layers = [dataclasses.replace(layer, **new) for layer, new in zip(p.layers, stood_for, strict=True)]
        reference = plain(p, torch.float64)[0][-1]
        ours.append(relative(x_t[-1], reference))
        emulated.append(relative(plain(p, torch.float64, in_e4m3(packed.inputs))[0][-1], reference))
    print(f"{name} {suffix}: {[f'{a:.3f}/{b:.3f}' for a, b in zip(ours, emulated, strict=True)]}")
    assert sum(x * x for x in ours) <= 1.2**2 * sum(x * x for x in emulated)


@on_hopper
@PRECISIONS
@pytest.mark.parametrize("suffix", [10, 24, 50])
def test_with_the_same_times_it_is_the_kernel_with_one_time_bit_by_bit(
    suffix: int, precision: packing.Precision
) -> None:
    p = problem("shallow", 3, suffix, 560, 7, GPU)
    packed = packed_of(p, precision)
    expected, same = run(p, kernel_of(p, packed)), by_token(p, "same")
    found = run(same, kernel_of(same, packed))
    print(f"{suffix} {precision}: {relative(found[0][-1], expected[0][-1]):.2e}")
    assert all(torch.equal(a, b) for a, b in zip(found, expected, strict=True))


@on_hopper
@PRECISIONS
@pytest.mark.parametrize("suffix", [10, 50])
def test_held_tokens_stay_to_the_last_bit_and_the_others_see_them(suffix: int, precision: packing.Precision) -> None:
    p = by_token(problem("shallow", 4, suffix, 560, 8, GPU), "held")
    assert p.tokens is not None
    packed, held = packed_of(p, precision), p.tokens.steps[0] == 0
    kernel = kernel_of(p, packed)
    x_t, _ = run(p, kernel)
    assert held.any() and torch.equal(x_t[:, held], p.noise[held].expand(5, -1, -1))
    p.noise[held] += 1
    assert (run(p, kernel)[0][-1, ~held] != x_t[-1, ~held]).any(dim=-1).all()


@on_hopper
@PRECISIONS
@pytest.mark.parametrize("suffix", [10, 50])
def test_replays_of_a_captured_graph_read_times_and_targets_anew(suffix: int, precision: packing.Precision) -> None:
    p = problem("shallow", 3, suffix, 560, 6, GPU)
    ways = [by_token(p, "distinct", seed) for seed in (1, 2, 3)]
    for way in ways[1:]:
        way.table = ways[0].table
    (tokens,) = [way.tokens for way in ways[:1] if way.tokens is not None]
    kernel, length = kernel_of(ways[0], packed_of(ways[0], precision)), torch.tensor([560], device=GPU)
    x_t, v_t = torch.empty(4, suffix, 32, device=GPU), torch.empty(3, suffix, 32, device=GPU)
    captured = dataclasses.replace(tokens, **{k: v.clone() for k, v in vars(tokens).items()})
    stream = torch.cuda.Stream()  # type: ignore[no-untyped-call]
    with torch.cuda.stream(stream):
        kernel.launch(p.noise, p.cache_k, p.cache_v, length, x_t, v_t, captured)
    stream.synchronize()
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph, stream=stream):
        kernel.launch(p.noise, p.cache_k, p.cache_v, length, x_t, v_t, captured)
    results = []
    for way in ways:
        for name, tensor in vars(captured).items():
            tensor.copy_(getattr(way.tokens, name))
        x_t.fill_(torch.nan)
        graph.replay()
        torch.cuda.synchronize()
        assert torch.equal(x_t, run(way, kernel)[0])
        results.append(x_t.clone())
    assert not torch.equal(results[0], results[1]) and not torch.equal(results[1], results[2])


@on_hopper
@PRECISIONS
@pytest.mark.parametrize("suffix", [10, 33, 50])
def test_by_token_it_repeats_itself_bit_by_bit(suffix: int, precision: packing.Precision) -> None:
    p = by_token(problem("shallow", 4, suffix, 560, 5, GPU), "distinct")
    kernel = kernel_of(p, packed_of(p, precision))
    first = run(p, kernel)
    assert all(torch.equal(a, b) for _ in range(20) for a, b in zip(first, run(p, kernel), strict=True))


def test_every_way_is_a_problem_and_others_are_refused() -> None:
    p = problem("golden", 3, 10, 5, 0, CPU)
    for way in WAYS:
        q = by_token(p, way)
        assert q.tokens is not None and q.tokens.rows.shape == q.tokens.steps.shape == q.tokens.gain.shape == (3, 10)
        assert int(q.tokens.rows.min()) >= 0 and int(q.tokens.rows.max()) < len(q.table)
    with pytest.raises(ValueError, match="'all': expected one of same, held"):
        by_token(p, "all")
