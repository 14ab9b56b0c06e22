"""How work is cut into blocks and clusters, and what a launch is given: on a CPU, for every tile that is chosen."""

import ctypes
import dataclasses
import hashlib
import itertools
from collections.abc import Iterator, Mapping
from contextlib import nullcontext
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from kernel_turns.problems import Problem, by_token, problem
from torch import Tensor

pytest.importorskip("triton", reason="Triton isn't installed")

from turbopi.kernels.sm90 import instructions
from turbopi.kernels.sm90.attention import kernel as attention_hopper
from turbopi.kernels.sm90.attention import suffix, suffix_tile
from turbopi.kernels.sm90.attention.suffix_tile import FewTile, SuffixTile
from turbopi.kernels.sm90.denoise import kernel as denoise
from turbopi.kernels.sm90.denoise.packing import RANKS, PackedExpert, Tables
from turbopi.kernels.sm90.gemm import bf16 as gemm
from turbopi.kernels.sm90.gemm import fp8 as gemm_fp8
from turbopi.kernels.sm90.gemm import tiles
from turbopi.kernels.sm90.gemm.bf16 import Epilogue, Tile
from turbopi.quantization.fp8 import E4M3, ScaledMatrix
from turbopi.support.errors import BackendUnavailable

GPU = torch.device("cuda", 0)
CPU = torch.device("cpu")
H200_SMS = 132


# ---- products


def chosen() -> Iterator[tuple[Tile, int, int, int, Epilogue, bool]]:
    """(tile, rows, columns, inner, epilogue, FP8) of every product that has a tile of its own, and of odd sizes."""
    tables: list[tuple[Mapping[tuple[int, int, int], Any], bool]] = [
        (tiles.VISION_TILES, False),
        (tiles.PARTS_TILES, False),
        (tiles.RESIDUAL_TILES, False),
        (tiles.RESIDUAL_TILES_FP8, True),
        (tiles.TILES_FP8, True),
    ]
    for table, fp8 in tables:
        for (m, n, k), tile in table.items():
            if isinstance(tile, Tile):
                geglu = tile.overlap
                epilogue: Epilogue = "geglu" if geglu else "parts" if tile.splits > 1 and not tile.gather else "bias"
                yield tile, m, n, k, epilogue, fp8
    for tile in tiles.GEGLU_TILES:
        yield tile, 560, 16384, 2048, "geglu", False
    for m in (1, 11, 203, 816, 976):
        yield gemm_fp8.best_tile(m, 2048, 16384, "parts", H200_SMS), m, 2048, 16384, "parts", True
        yield gemm_fp8.best_tile(m, 4352, 1152, "gelu", H200_SMS), m, 4352, 1152, "gelu", True
        yield gemm_fp8.best_tile(m, 16384, 2048, "geglu", H200_SMS), m, 16384, 2048, "geglu", True


def test_another_tile_is_chosen_only_on_purpose() -> None:
    """Its hash is that of the tiles that were measured (docs/dev/log.md). Measure before it is changed."""
    tables = tiles.VISION_TILES, tiles.PARTS_TILES, tiles.FEW_TILES, tiles.FEW_GEGLU_TILES, tiles.GEGLU_TILES
    of_the_stream = tiles.RESIDUAL_TILES, tiles.RESIDUAL_TILES_FP8, tiles.TILES_FP8
    shapes = (
        *((3456, 1152), (1152, 1152), (4352, 1152), (1152, 4352), (2048, 1152)),
        *((2560, 2048), (2048, 2048), (16384, 2048), (2048, 16384), (512, 2048)),
    )
    rows, epilogues = (1, *range(64, 1025, 64), 1000), ("plain", "bias", "gelu", "geglu", "partial", "parts")
    estimated = [
        repr(gemm_fp8.best_tile(m, n, k, epilogue, sms))
        for m, (n, k), epilogue, sms in itertools.product(rows, shapes, epilogues, (66, H200_SMS))
    ]
    choices = "\n".join([repr((*tables, *of_the_stream)), *estimated])
    assert hashlib.sha256(choices.encode()).hexdigest()[:16] == "815b89c884eda7ef"


CHOSEN = sorted(set(chosen()), key=str)
PRODUCTS = pytest.mark.parametrize(("tile", "m", "n", "k", "epilogue", "fp8"), CHOSEN)


class Launched:
    """Stands for a compiled kernel on an H200; keeps what it was launched with."""

    def __init__(self, cluster: int) -> None:
        self.max_clusters = {1: 132, 2: 66, 4: 30, 6: 17, 8: 15}[cluster]
        self.blocks = 0
        self.given: dict[str, Any] = {}

    def launch_dependent(self, blocks: int, given: dict[str, Any]) -> None:
        self.blocks, self.given = blocks, given


def on_meta(*shape: int, dtype: torch.dtype = torch.bfloat16) -> Tensor:
    return torch.empty(*shape, dtype=dtype, device="meta")


@pytest.fixture(autouse=True)
def h200(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(instructions, "multiprocessors", lambda device: H200_SMS)


@pytest.fixture
def maps(monkeypatch: pytest.MonkeyPatch) -> None:
    """TMA's maps as what they were made of."""
    monkeypatch.setattr(
        instructions, "tensor_map", lambda address, sizes, strides, box, fp8=False: SimpleNamespace(**vars_of(locals()))
    )


def vars_of(names: dict[str, Any]) -> dict[str, Any]:
    return {name: names[name] for name in ("sizes", "strides", "box", "fp8")}


def launched(tile: Tile, m: int, n: int, k: int, epilogue: Epilogue, fp8: bool, monkeypatch: Any) -> Launched:
    """The launch of that product. Its operands have no memory: sizes alone count."""
    kernel = Launched(tile.cluster)
    rows = 2 * n if epilogue == "geglu" else n
    bias = on_meta(n) if epilogue in ("bias", "gelu") else None
    for module in (gemm, gemm_fp8):
        monkeypatch.setattr(module, "_kernel", lambda *args: kernel)
    if fp8:
        weight = ScaledMatrix(on_meta(rows, k, dtype=E4M3), on_meta(rows, dtype=torch.float32), 1.0, torch.bfloat16)
        gemm_fp8.matmul_fp8(on_meta(m, k, dtype=E4M3), weight, tile, epilogue, bias)
    else:
        gemm.matmul(on_meta(m, k), on_meta(rows, k), tile, epilogue, bias)
    return kernel


@PRODUCTS
def test_tiles_cover_the_result_and_none_lies_outside(
    tile: Tile, m: int, n: int, k: int, epilogue: Epilogue, fp8: bool, maps: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    given = launched(tile, m, n, k, epilogue, fp8, monkeypatch).given
    columns = tile.columns // 2 if epilogue == "geglu" else tile.columns  # of the result: the others are its gate
    for size, groups, of_group in (
        (m, given["m_groups"], tile.rows * tile.cluster_m),
        (n, given["n_groups"], columns * tile.cluster_n),
    ):
        assert (groups - 1) * of_group < size <= groups * of_group
    assert (given["M"], given["N"]) == (m, n)
    step = 128 if fp8 else 64
    assert (given["k_blocks"] - 1) * step < k <= given["k_blocks"] * step


@PRODUCTS
def test_blocks_are_whole_clusters_that_the_gpu_holds_and_each_has_work(
    tile: Tile, m: int, n: int, k: int, epilogue: Epilogue, fp8: bool, maps: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    kernel = launched(tile, m, n, k, epilogue, fp8, monkeypatch)
    clusters, rest = divmod(kernel.blocks, tile.cluster)
    units = kernel.given["m_groups"] * kernel.given["n_groups"] * (1 if tile.gather else tile.splits)
    assert rest == 0 and 1 <= clusters == min(units, kernel.max_clusters)
    if tile.gather:
        assert clusters == units, "who gathers has no second tile"


@PRODUCTS
def test_loads_fill_a_tile_and_its_stages_fit_into_shared_memory(
    tile: Tile, m: int, n: int, k: int, epilogue: Epilogue, fp8: bool, maps: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    given = launched(tile, m, n, k, epilogue, fp8, monkeypatch).given
    inner = 128 if fp8 else 64  # numbers of a row of 128 bytes
    a, w = given["map_a"], given["map_w"]
    halves = 2 if epilogue == "geglu" else 1
    assert (a.sizes, w.sizes) == ((k, m), (k, halves * n)) and a.fp8 == w.fp8 == fp8
    assert a.strides == w.strides == (k,)
    assert a.box == (inner, tile.rows // tile.cluster_n), "the CTAs of a row share its loads"
    assert w.box == (inner, tile.columns // halves // tile.cluster_m), "gate and up come apart"
    sizes = gemm_fp8.constants(tile, epilogue, False, 0) if fp8 else gemm.constants(tile, epilogue)
    stages = sizes["TP_STAGES"] * (tile.rows + tile.columns) * 128
    barriers = 16 * sizes["TP_STAGES"] + 16
    factors = 8 * tile.warpgroups * tile.columns if fp8 else 0
    lines = tile.warpgroups * 4 * 16 * 128 if epilogue in ("parts", "added") and not tile.overlap else 0
    assert sizes["TP_STAGES"] >= 3
    assert 1024 + stages + barriers + factors + lines <= sizes["TP_SHARED_BYTES"] <= instructions.SHARED_BYTES
    assert instructions.SHARED_BYTES == 227 * 1024


def test_one_tile_of_few_steps_leaves_the_rest_of_shared_memory_to_the_next_kernel() -> None:
    """Rows of a batch's suffixes, and twice as many tiles; what needs all registers keeps its ring."""
    tile = Tile(1, 64, splits=4)
    alone = gemm.fitted(tile, (2, 16), 16, GPU)
    assert alone == dataclasses.replace(tile, ring=4) and gemm.fitted(tile, (4, 16), 16, GPU) == tile
    assert gemm.fitted(Tile(2, 64), (1, 16), 4, GPU) == Tile(2, 64), "no CTA fits beside two warpgroups' registers"
    gathered = Tile(1, 64, splits=4, gather=True)
    assert gemm.fitted(gathered, (1, 4), 16, GPU) == gathered, "sums are gathered where operands were"
    needed = [gemm_fp8.constants(one, "parts", False, 0)["TP_SHARED_BYTES"] for one in (tile, alone)]
    assert needed[1] < needed[0] <= instructions.SHARED_BYTES
    assert (
        gemm.constants(tile, "parts")["TP_LEAVES_ROOM"] == 1
        and gemm.constants(Tile(2, 64), "parts")["TP_LEAVES_ROOM"] == 0
    )
    assert gemm_fp8.constants(tile, "bias", False, 4, residual=True)["TP_LEAVES_ROOM"] == 0, (
        "sums twice beside a stream"
    )


def test_a_halved_tile_fits_a_multiprocessor_twice() -> None:
    for columns, lines in ((72, False), (128, True)):
        tile = Tile(1, columns).halved(factors=1, lines=lines)
        bytes_of = [
            one.shared_bytes(factors=1, lines=lines) for one in (tile, dataclasses.replace(tile, ring=tile.ring + 1))
        ]
        assert bytes_of[0] <= gemm.HALF_SHARED_BYTES < bytes_of[1]
    short = Tile(1, 16, ring=4)
    assert short.halved(factors=1, lines=False) == short, "a ring that is shorter already stays"


def test_what_is_fetched_ahead_is_shared_out_and_never_reaches_beyond_the_matrix(
    maps: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    kernel = Launched(1)
    monkeypatch.setattr(gemm, "_kernel", lambda *args: kernel)
    ahead = torch.zeros(1000, 7, dtype=torch.bfloat16)
    gemm.matmul(on_meta(256, 64), on_meta(1152, 64), Tile(1, 96), "plain", ahead=ahead)
    share = kernel.given["ahead_bytes"]
    assert kernel.given["ahead"] == ahead.data_ptr() and share % 16 == 0
    assert 0 <= ahead.numel() * 2 - share * kernel.blocks < 16 * kernel.blocks
    gemm.matmul(on_meta(256, 64), on_meta(1152, 64), Tile(1, 96), "plain", ahead=ahead[:1, :1])
    assert (kernel.given["ahead"], kernel.given["ahead_bytes"]) == (None, 0), "less than 16 bytes a block"


# ---- attention


@pytest.mark.parametrize(
    ("images", "tokens", "heads", "dim", "rows"),
    [(2, 256, 16, 72, 64), (3, 256, 16, 72, 128), (8, 256, 16, 72, 256), (8, 256, 16, 128, 128), (2, 50, 2, 24, 64)],
)
def test_visions_attention_has_a_unit_for_so_many_queries_of_a_head_of_a_picture(
    images: int, tokens: int, heads: int, dim: int, rows: int, maps: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    kernel, tiles = Launched(1), list[attention_hopper.AttentionTile]()

    def compiled(tile: attention_hopper.AttentionTile, *rest: Any) -> Launched:
        tiles.append(tile)
        return kernel

    monkeypatch.setattr(attention_hopper, "_kernel", compiled)
    attention_hopper.vision_attention(on_meta(images * tokens, 3 * heads * dim), images, heads)
    given, (tile,) = kernel.given, tiles
    assert tile.rows == rows and tile.wide == (rows > 64) and tile.stages >= 2
    assert given["units"] == images * heads * given["tiles"] and kernel.blocks % tile.sharing == 0
    assert kernel.blocks == (min(given["units"], 132) if tile.wide else given["units"]), "a wide one has several units"
    assert (given["tiles"] - 1) * rows < tokens <= given["tiles"] * rows
    assert (given["rows"], given["keys"], given["heads"], given["length"]) == (tokens, tokens, heads, None)
    assert (given["k_first"], given["v_first"]) == (heads, 2 * heads), "q, k and v lie side by side"
    for name, box in (("map_q", 64), ("map_k", tile.keys // tile.sharing), ("map_v", tile.keys // tile.sharing)):
        assert given[name].sizes == (dim, 3 * heads, images * tokens)
        assert given[name].strides == (dim, 3 * heads * dim) and given[name].box == (64, 1, box)
    assert given["scale"] == pytest.approx(dim**-0.5 / np.log(2))


@pytest.mark.parametrize(
    ("batch", "tokens", "tile"),
    [
        (1, 1, FewTile(256, 8, 8, 80, 2)),
        (4, 10, FewTile(256, 40, 8, 80, 2)),
        (8, 10, FewTile(256, 40, 6, 96, 2)),  # of clusters of eight there is no room for sixteen
        (16, 10, FewTile(256, 80, 6, 96, 4)),
        (4, 50, FewTile(256, 104, 6, 112, 4)),
        (8, 50, SuffixTile(256, 104, 2, 64)),
        (64, 50, SuffixTile(256, 104, 1, 64)),
    ],
)
def test_a_suffixs_clusters_are_as_large_as_all_of_them_fit(
    batch: int, tokens: int, tile: SuffixTile | FewTile, maps: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: dict[SuffixTile | FewTile, Launched] = {}

    def compiled(one: SuffixTile | FewTile, *rest: Any) -> Launched:
        return made.setdefault(one, Launched(one.ranks))

    monkeypatch.setattr(suffix, "_kernel_or_why_not", compiled)
    heads, dim, prefix = 8, 256, 560 * batch
    qkv, angles = on_meta(batch * tokens, (heads + 2) * dim), on_meta(batch * tokens, dim // 2, dtype=torch.float32)
    cache, segments = on_meta(prefix, dim), on_meta(batch + 1, dtype=torch.int32)
    suffix.suffix_attention(qkv, angles, angles, cache, cache, segments, segments, heads)
    kernel = made[tile]
    assert kernel.blocks == batch * kernel.given["tiles"] * tile.ranks
    assert (kernel.given["tiles"] - 1) * tile.rows < tokens * heads <= kernel.given["tiles"] * tile.rows
    assert kernel.given["map_k"].sizes == (dim, 1, prefix) and kernel.given["map_k"].box == (64, 1, tile.keys)
    assert tile.stages >= 2 and {one.name for one in suffix.PARAMETERS.all} == kernel.given.keys()
    assert tile.shared_bytes <= instructions.SHARED_BYTES


def test_where_no_cluster_of_eight_fits_smaller_ones_are_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    def compiled(one: SuffixTile | FewTile, *rest: Any) -> Launched | BackendUnavailable:
        return BackendUnavailable("no room for one") if one.ranks > 2 else Launched(one.ranks)

    monkeypatch.setattr(suffix, "_kernel_or_why_not", compiled)
    assert suffix.chosen_tile(256, 80, 16, 570, False, torch.device("meta")).ranks == 2


@pytest.mark.parametrize("dim", [64, 128, 192, 256])
def test_every_suffix_has_tiles_that_fit(dim: int) -> None:
    """Whatever its rows, its prefix and the batch: the last one has clusters of one CTA."""
    for rows, batch, keys in itertools.product((8, 40, 80, 104, 128, 136, 408), (1, 4, 16), (1, 57, 570, 978, 3000)):
        tiles = [tile for tile, _ in suffix_tile.tiles(dim, rows, batch, keys)]
        assert tiles[-1].ranks == 1
        for tile in tiles:
            assert tile.shared_bytes <= instructions.SHARED_BYTES and tile.rows % 8 == 0 and tile.stages >= 2
            if isinstance(tile, FewTile):
                assert tile.keys % 16 == 0 and tile.sent_rows <= tile.keys, "what is sent lies where keys were"
                assert tile.members * tile.part >= tile.keys and tile.members * tile.columns >= dim


@pytest.mark.parametrize("dim", [64, 128, 192, 256])
def test_a_suffixs_products_read_only_what_their_cta_has(dim: int) -> None:
    """By suffix_few.cu's layout, for all rows and sizes of tiles that `suffix_tile.tiles` yields, and for others.

    Products read whole blocks of 64 rows and whole panels of 64 columns, of which some are nobody's.
    """
    sizes = range(16, suffix_tile.FEW_KEYS + 1, 16)
    for rows, ranks, keys, warpgroups in itertools.product(range(8, 113, 8), (1, 6, 8), sizes, (2, 4)):
        tile, blocks = FewTile(dim, rows, ranks, keys, warpgroups), -(-rows // 64)
        if blocks > warpgroups or tile.sent_rows > keys:
            continue
        panels, key_panel, row_panel = dim // 64, keys * 128, rows * 128
        values = panels * key_panel
        queries = values + panels * key_panel
        weights = queries + panels * row_panel
        barriers = weights + -(-keys // 64) * row_panel + (64 * blocks - rows) * 128
        ends = barriers + 16 + 2 * tile.members * 64 * blocks * 4
        used = -(-dim // tile.columns)  # members that have columns
        furthest = (
            (panels - 1) * key_panel + tile.members * tile.part * 128,  # keys
            values + used * tile.columns // 64 * key_panel,
            queries + (panels - 1) * row_panel + 64 * blocks * 128,
            weights + (-(-keys // 64) - 1) * row_panel + 64 * blocks * 128,
            ends + tile.sent_rows * 8,
        )
        assert 1024 + max(furthest) == tile.shared_bytes, f"{tile}: beside what aligns its first byte"


def test_four_warpgroups_are_tried_only_where_they_need_fewer_clusters() -> None:
    for rows, batch in itertools.product(range(8, 417, 8), (1, 4, 8, 16)):
        few = [
            (tile, clusters)
            for tile, clusters in suffix_tile.tiles(256, rows, batch, 570)
            if tile.source == "suffix_few"
        ]
        needed = {tile.warpgroups: clusters for tile, clusters in few}
        assert list(needed.values()) == sorted(set(needed.values()), reverse=True), f"{rows} rows of {batch}: {needed}"
        assert all(tile.warpgroups == (2 if tile.rows <= 64 else 4) for tile, _ in few)


def test_heads_that_the_suffixs_kernels_refuse_have_no_tiles() -> None:
    for dim in (72, 320, 512):
        with pytest.raises(AssertionError, match=f"no heads of {dim} columns"):
            next(suffix_tile.tiles(dim, 80, 1, 570))


# ---- the denoising kernel: what its launch is given, read back as the GPU reads it


class FakeKernel:
    """Stands for a loaded function; `launches` has (name, blocks, threads, the struct) of all of them."""

    launches: list[tuple[str, int, int, Any]]
    clusters = 16

    def __init__(self, cubin: bytes, name: str, shared_bytes: int) -> None:
        self.name, self.shared_bytes = name, shared_bytes

    def max_active_clusters(self, ranks: int, threads: int) -> int:
        return self.clusters

    def launch(self, blocks: int, threads: int, args: Any) -> None:
        self.launches.append((self.name, blocks, threads, args))

    launch_cooperative = launch


@pytest.fixture
def loaded(monkeypatch: pytest.MonkeyPatch) -> type[FakeKernel]:
    """A GPU that isn't there: kernels load and launch, their structs' memory is the host's."""
    cls = type("Kernel", (FakeKernel,), {"launches": []})
    properties = SimpleNamespace(major=9, minor=0, shared_memory_per_block_optin=232448)
    zeros = torch.zeros
    monkeypatch.setattr(denoise, "unavailable", lambda device: None)
    monkeypatch.setattr(denoise, "compiled", lambda arch, sizes: b"")
    monkeypatch.setattr(denoise, "Kernel", cls)
    monkeypatch.setattr(torch.cuda, "get_device_properties", lambda device: properties)
    monkeypatch.setattr(torch.cuda, "device", lambda device: nullcontext())
    monkeypatch.setattr(torch, "zeros", lambda *args, pin_memory=False, **options: zeros(*args, **options))
    return cls


def made(p: Problem, packed: PackedExpert) -> denoise.DenoiseKernel:
    rows, suffix = p.cache_k.shape[1], p.noise.shape[0]
    form: dict[str, Any] = {} if p.tokens is None else {"num_steps": len(p.tokens.rows), "by_token": True}
    return denoise.DenoiseKernel(p.config, packed, p.small, p.table, cache_rows=rows, suffix=suffix, device=CPU, **form)


def memory(address: int, *shape: int, kind: Any = np.float32) -> np.ndarray:
    count = int(np.prod(shape)) * np.dtype(kind).itemsize
    return np.frombuffer((ctypes.c_char * count).from_address(address), kind).reshape(shape)


@pytest.mark.parametrize("fp8", [False, True])
def test_the_denoising_kernels_struct_points_to_what_its_fields_say(loaded: type[FakeKernel], fp8: bool) -> None:
    p = problem("golden", 3, 10, 37, 0, CPU)
    scales = {f"expert.{i}.{kind}": 0.5 + i for i in range(3) for kind in ("qkv", "out", "gate_up", "down")}
    packed = PackedExpert.pack(p.config, p.layers, scales if fp8 else None)
    kernel, length = made(p, packed), torch.tensor([p.length])
    x_t, v_t = torch.zeros(4, 10, 32), torch.zeros(3, 10, 32)
    kernel.launch(p.noise, p.cache_k, p.cache_v, length, x_t, v_t)
    (_, _, _, a), (_, _, _, again) = loaded.launches
    assert bytes(a) == bytes(again)
    given = {"noise": p.noise, "cache_k": p.cache_k, "cache_v": p.cache_v, "length": length, "x_t": x_t, "v_t": v_t}
    assert {name: getattr(a, name) for name in given} == {name: tensor.data_ptr() for name, tensor in given.items()}
    assert (a.weights, a.starts) == (packed.weights.data_ptr(), packed.starts.data_ptr())
    assert a.layer_bytes == packed.weights[1].data_ptr() - packed.weights[0].data_ptr()
    assert a.layer_stride == p.cache_k[1].data_ptr() - p.cache_k[0].data_ptr()
    assert (a.steps, a.dt, a.eps, a.zero) == (3, np.float32(-1 / 3), np.float32(p.config.rms_norm_eps), 0)
    width, actions, depth = p.config.expert.width, p.config.action_dim, p.config.expert.depth
    tables, small = Tables.make(packed, p.table), p.small

    def same(address: int, expected: Tensor) -> None:
        np.testing.assert_array_equal(memory(address, *expected.shape), expected.float().numpy())

    same(a.table, tables.modulation)
    same(a.shifted, tables.shifted)
    if fp8:
        same(a.row_scales, tables.row_scales)
        same(a.values_times, tables.values_times)
    same(a.in_w, small["action_in_proj.weight"])  # [D][A]
    same(a.in_b, small["action_in_proj.bias"])
    same(a.out_w, small["action_out_proj.weight"].T)  # [D][A]
    assert small["action_in_proj.weight"].shape == (width, actions)
    shift = p.table[:, 2 * depth, 1] @ small["action_out_proj.weight"].T + small["action_out_proj.bias"]
    np.testing.assert_allclose(memory(a.out_shift, 3, actions), shift.numpy(), rtol=1e-5, atol=1e-5)
    half = p.config.expert.head_dim // 2
    frequencies = p.config.rope_base ** -(np.arange(half) / half)
    np.testing.assert_allclose(memory(a.inv_freq, half), frequencies, rtol=1e-5)


def test_by_token_the_struct_also_points_to_what_the_tokens_are_told(loaded: type[FakeKernel]) -> None:
    p = by_token(problem("golden", 3, 10, 37, 0, CPU), "distinct")
    packed = PackedExpert.pack(p.config, p.layers)
    t, kernel = p.tokens, made(p, packed)
    assert t is not None
    call = p.noise, p.cache_k, p.cache_v, torch.tensor([p.length]), torch.zeros(4, 10, 32), torch.zeros(3, 10, 32)
    kernel.launch(*call, t)
    a = loaded.launches[-1][3]
    assert (a.steps, a.noise, a.x_t, a.v_t) == (3, *(call[i].data_ptr() for i in (0, 4, 5)))
    for address, expected in (
        *((a.token_steps, t.steps), (a.token_times, t.times), (a.gain, t.gain), (a.target, t.target)),
        (a.table, p.table),
        (a.out_shift, p.table[:, -1, 1] @ p.small["action_out_proj.weight"].T + p.small["action_out_proj.bias"]),
    ):
        np.testing.assert_allclose(memory(address, *expected.shape), expected.numpy(), rtol=1e-5, atol=1e-5)
    np.testing.assert_array_equal(memory(a.token_rows, 3, 10, kind=np.int32), t.rows.numpy())
    shifted = Tables.make(packed, p.table).shifted  # a lane's two rows of a tile, i and i + 8, beside each other
    found = memory(a.shifted, *shifted.shape).reshape(*shifted.shape[:-1], 8, 2)
    np.testing.assert_array_equal(found, np.stack((shifted[..., :8], shifted[..., 8:]), axis=-1))


def test_a_launch_takes_tokens_if_its_kernel_is_by_token_and_only_then(loaded: type[FakeKernel]) -> None:
    p = problem("golden", 3, 10, 37, 0, CPU)
    packed, q = PackedExpert.pack(p.config, p.layers), by_token(p, "held")
    call = p.noise, p.cache_k, p.cache_v, torch.tensor([p.length]), torch.zeros(4, 10, 32), torch.zeros(3, 10, 32)
    with pytest.raises(AssertionError, match="by token"):
        made(p, packed).launch(*call, q.tokens)
    with pytest.raises(AssertionError, match="by token"):
        made(q, packed).launch(*call)
    assert q.tokens is not None
    for name, wrong in (("rows", q.tokens.rows.long()), ("gain", q.tokens.gain[:2]), ("target", q.tokens.target.T)):
        with pytest.raises(AssertionError, match=name):
            made(q, packed).launch(*call, dataclasses.replace(q.tokens, **{name: wrong}))


def test_the_host_reads_back_what_the_kernel_writes_for_it(loaded: type[FakeKernel]) -> None:
    p = problem("golden", 1, 4, 3, 0, CPU)
    kernel = made(p, PackedExpert.pack(p.config, p.layers))
    kernel.launch(p.noise, p.cache_k, p.cache_v, torch.tensor([3]), torch.zeros(2, 4, 32), torch.zeros(1, 4, 32))
    args = loaded.launches[-1][3]
    assert kernel.clock_mhz() is None and kernel.why_it_trapped() is None
    memory(args.clock, 2, kind=np.int64)[:] = (4_500_000, 2_500_000)
    blocks = p.config.expert.num_heads * RANKS
    memory(args.hang, blocks, kind=np.uint32)[blocks - 1] = 1 << 31 | 4 << 20 | 2
    assert kernel.clock_mhz() == 1800
    assert str(kernel.why_it_trapped()).endswith("layer 2 for outputs")


@pytest.mark.parametrize(("name", "clusters"), [("golden", 8), ("uneven", 10)])
def test_the_denoising_kernel_is_launched_behind_what_prepares_its_keys(
    loaded: type[FakeKernel], name: str, clusters: int
) -> None:
    p = problem(name, 1, 4, 40, 0, CPU)
    kernel = made(p, PackedExpert.pack(p.config, p.layers))
    kernel.launch(p.noise, p.cache_k, p.cache_v, torch.tensor([40]), torch.zeros(2, 4, 32), torch.zeros(1, 4, 32))
    tiles = -(-p.cache_k.shape[1] // 16) * p.config.expert.depth  # 16 keys of a layer
    # 16 warps that multiply, and four beside them
    expected = [("turbopi_denoise_prepare", tiles, 256), ("turbopi_denoise", clusters * 8, 640)]
    assert [launch[:3] for launch in loaded.launches] == expected


def test_a_gpu_that_holds_too_few_clusters_says_so(loaded: type[FakeKernel], monkeypatch: pytest.MonkeyPatch) -> None:
    p = problem("golden", 1, 4, 3, 0, CPU)
    monkeypatch.setattr(loaded, "clusters", 7)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda device: "half a GPU")
    with pytest.raises(denoise.BackendUnavailable, match=r"needs 8 clusters of 8 .*half a GPU holds 7"):
        made(p, PackedExpert.pack(p.config, p.layers))
