"""The portable products equal their twins, their tiles fit every GPU, and TURBOPI_KERNELS chooses them.

Without a GPU in float32 through Triton's interpreter, which takes E4M3 but can't round to it. On a GPU with FP8 each
product is held against the float32 sums of its numbers. INT8 needs no such GPU.
"""

from collections.abc import Callable
from dataclasses import asdict, replace
from functools import partial
from typing import Any

import pytest
import torch
from conftest import gpu_or_interpreter
from torch import Tensor

ON_GPU = torch.cuda.is_available()
pytest.importorskip("triton", reason="Triton isn't installed")

from turbopi.kernels import ops as kernels_ops  # noqa: E402
from turbopi.kernels import plain  # noqa: E402
from turbopi.kernels.portable import activations, attention, norms  # noqa: E402
from turbopi.kernels.portable.gemm import tiles  # noqa: E402
from turbopi.kernels.portable.gemm.kernel import gpu, product  # noqa: E402
from turbopi.kernels.portable.gemm.tiles import Capability, Epilogue, Tile  # noqa: E402
from turbopi.kernels.portable.ops import attend, portable_ops  # noqa: E402
from turbopi.kernels.portable.quantize import quantize  # noqa: E402
from turbopi.kernels.tile_table import LIBRARY, TileKey, TileTable  # noqa: E402
from turbopi.quantization.formats import FP8, INT8, Format  # noqa: E402
from turbopi.quantization.fp8 import E4M3_MAX, ScaledMatrix, to_e4m3  # noqa: E402
from turbopi.support.errors import ConfigError  # noqa: E402

DEVICE = torch.device("cuda" if ON_GPU else "cpu")
DTYPE = torch.bfloat16 if ON_GPU else torch.float32
HERE: Capability = torch.cuda.get_device_capability() if ON_GPU else (8, 9)
FORMATS_HERE = [FP8, INT8] if tiles.fp8_refusal(HERE) is None else [INT8]
FP8_HERE = pytest.mark.skipif(FP8 not in FORMATS_HERE, reason="needs compute capability 8.9")
pytestmark = gpu_or_interpreter()
SMALL = (Tile(32, 64, 4, 6),)  # the interpreter computes whole tiles
EPILOGUES: tuple[Epilogue, ...] = ("plain", "gelu", "geglu", "parts")
seeds = iter(range(10**6))


def on_gpu(test: Callable[..., None]) -> Callable[..., None]:
    return pytest.mark.gpu(pytest.mark.skipif(not ON_GPU, reason="needs an NVIDIA GPU")(test))


def random(*shape: int) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(next(seeds))).to(DEVICE, DTYPE)


def operands(m: int, n: int, k: int, format: Format = FORMATS_HERE[0]) -> tuple[Tensor, ScaledMatrix]:
    matrix = quantize(random(n, k) / k**0.5, 4.0 / format.largest, format=format)
    return format.rounded(random(m, k), matrix.inverse), matrix


def stored(format: Format) -> torch.dtype:
    """What a result that is rounded to it comes as: the interpreter can't round to E4M3."""
    return format.dtype if ON_GPU or format is INT8 else torch.float32


def rounding(exact: Tensor, inverse: float, format: Format) -> float:
    """The relative error that rounding costs."""
    return relative(format.rounded(exact, inverse).float() / inverse, exact) if stored(format) == format.dtype else 0.0


def exactly(x: Tensor, weight: ScaledMatrix, epilogue: str, bias: Tensor | None) -> Tensor:
    sums = weight.product(x, bias)
    return plain.gelu(sums) if epilogue == "gelu" else plain.geglu(sums) if epilogue == "geglu" else sums


def relative(ours: Tensor, exact: Tensor) -> float:
    return float((ours.double() - exact.double()).norm() / exact.double().norm())


def every_tile(epilogue: Epilogue, k: int) -> list[Tile]:
    fitting = tiles.candidates(HERE, True, epilogue, k)
    return fitting if ON_GPU else [tile for tile in fitting if replace(tile, splits=1) in SMALL]


@pytest.mark.slow
@pytest.mark.parametrize("format", FORMATS_HERE, ids=lambda format: format.name)
@pytest.mark.parametrize("epilogue", EPILOGUES)
@pytest.mark.parametrize("out_rounded", [False, True])
@pytest.mark.parametrize(("m", "n", "k"), [(1, 16, 16), (33, 72, 272), (130, 136, 4304)])
def test_products_in_every_tile(m: int, n: int, k: int, epilogue: Epilogue, out_rounded: bool, format: Format) -> None:
    if not ON_GPU:
        m, k = min(m, 33), min(k, 400)
    x, matrix = operands(m, 2 * n if epilogue == "geglu" else n, k, format)
    bias = None if epilogue == "geglu" else random(n)
    exact, inverse = exactly(x, matrix, epilogue, bias), 30.0 if out_rounded and epilogue != "parts" else None
    for tile in every_tile(epilogue, k):
        ours = product(x, matrix, epilogue, bias, inverse=inverse, tile=tile, numbers=format.dtype)
        assert ours.dtype == (stored(format) if inverse else DTYPE)
        assert ours.shape == ((m, n) if tile.splits == 1 else (tile.splits, m, n))
        ours = (ours.float().sum(0) if tile.splits > 1 else ours.float()) / (inverse or 1)
        lost = rounding(exact, inverse, format) if inverse else 0.0
        assert relative(ours, exact) < (0.006 if ON_GPU else 1e-6) + lost, tile


@pytest.mark.parametrize("k", [16384] if ON_GPU else [272])
def test_int8_products_of_the_largest_numbers_are_exact(k: int) -> None:
    """All of one sign: the sum of 16384 has 29 bits, which float32 hasn't."""
    x = torch.full((4, k), 127, dtype=torch.int8, device=DEVICE)
    x[1], x[2, ::2], x[3, 0] = -127, -127, 126
    one = torch.ones(16, device=DEVICE)
    weight = ScaledMatrix(torch.full((16, k), 127, dtype=torch.int8, device=DEVICE), one, 1.0, torch.float32)
    sums = (x.double() @ weight.data.double().T).float()
    for tile in every_tile("plain", k):
        assert torch.equal(product(x, weight, tile=tile), sums), tile
    assert torch.equal(weight.product(x), sums)


@on_gpu
@pytest.mark.parametrize(
    ("m", "n", "k", "epilogue"),
    [
        *((512, 3456, 1152, "plain"), (512, 1152, 4304, "parts"), (512, 4304, 1152, "gelu")),
        *((560, 2560, 2048, "plain"), (304, 2048, 16384, "parts"), (563, 16384, 2048, "geglu")),
    ],
)
@pytest.mark.parametrize("format", FORMATS_HERE, ids=lambda format: format.name)
def test_products_of_the_full_size(m: int, n: int, k: int, epilogue: Epilogue, format: Format) -> None:
    x, matrix = operands(m, 2 * n if epilogue == "geglu" else n, k, format)
    bias = random(n) if k in (1152, 4304) else None
    exact = exactly(x, matrix, epilogue, bias)
    for tile in tiles.candidates(HERE, True, epilogue, k):
        ours = product(x, matrix, epilogue, bias, tile=tile).float()
        assert relative(ours.sum(0) if tile.splits > 1 else ours, exact) < 0.006, tile


@FP8_HERE
@on_gpu
@pytest.mark.parametrize("k", [1152, 2048, 4304, 16384])
def test_long_sums_lose_little_to_the_tensor_cores(k: int) -> None:
    """Products of one sign are the worst case. Sums up to UNPROMOTED, or between two promotions, may lose 14 bits'
    worth of rounding down for each product: measured on Hopper up to 4e-3 of 2048 such products.
    """
    x, matrix = operands(256, 512, k)
    x, matrix.data[:] = to_e4m3(x.float().abs(), 1.0), to_e4m3(matrix.data.float().abs(), 1.0)
    exact = matrix.product(x)
    assert relative(product(x, replace(matrix, dtype=torch.float32)), exact) < 0.01


@FP8_HERE
@on_gpu
def test_nan_shows_and_too_much_saturates() -> None:
    x, matrix = operands(8, 32, 64)
    x.view(torch.uint8)[2, 5] = 0x7F
    ours = product(x, matrix, inverse=1e9).float()
    assert bool(ours[2].isnan().all())
    assert bool((ours[[0, 1, 3]].abs() == E4M3_MAX).all())


@FP8_HERE
@pytest.mark.parametrize("epilogue", EPILOGUES)
def test_float16_sums_lose_a_hundredth_of_what_e4m3_does(epilogue: Epilogue) -> None:
    m, n, k = (130, 136, 4304) if ON_GPU else (33, 72, 272)
    x, matrix = operands(m, 2 * n if epilogue == "geglu" else n, k, FP8)
    half, bias = replace(matrix.for_half_sums(), dtype=torch.float32), None if epilogue == "geglu" else random(n)
    assert relative(half.dequantized(), matrix.dequantized()) < 2e-4
    most = max(float(block.float().abs().sum(1).max()) for block in torch.split(half.data, 128, 1)) * E4M3_MAX
    assert most < torch.finfo(torch.float16).max < 3 * most, "whatever x is, none overflows"
    meant = exactly(x, half, epilogue, bias)
    assert 1e-5 < relative(meant, exactly(x, matrix, epilogue, bias)) < 5e-4
    for tile in tiles.candidates(HERE, True, epilogue, k, half_sums=True) if ON_GPU else SMALL:
        ours = product(x, half, epilogue, bias, tile=tile)
        assert relative(ours.sum(0) if tile.splits > 1 else ours, meant) < (2e-3 if ON_GPU else 1e-6), tile


@FP8_HERE
def test_float16_sums_hold_the_largest_numbers_and_nan_shows() -> None:
    k = 4304 if ON_GPU else 272
    x, data = torch.full((4, k), E4M3_MAX, device=DEVICE), torch.full((16, k), E4M3_MAX, device=DEVICE)
    x[1], x[2, ::2], x[3, 5], data[0, 7] = -E4M3_MAX, -E4M3_MAX, torch.nan, torch.nan
    data[1, 5:] = 2.0
    whole = ScaledMatrix(to_e4m3(data, 1.0), torch.ones(16, device=DEVICE), 1.0, torch.float32)
    half = whole.for_half_sums()
    assert torch.equal(half.dequantized()[1:], data[1:]) and half.scale[1:3].tolist() == [32, 512]
    for tile in tiles.candidates(HERE, True, "plain", k, half_sums=True) if ON_GPU else SMALL:
        ours = product(to_e4m3(x, 1.0), half, tile=tile)
        assert bool(ours[3].isnan().all()) or not ON_GPU, "the interpreter has no such NaN"
        assert bool(ours[:, 0].isnan().all()) and not ours[2, 2:].any()
        torch.testing.assert_close(ours[:2, 1:], x[:2] @ data[1:].T, rtol=0.01 if ON_GPU else 4e-4, atol=0)


@on_gpu
def test_the_bfloat16_geglu_in_the_epilogue_is_as_good_as_behind_the_product() -> None:
    x, gate_up = random(203, 2048), random(2 * 4304, 2048) / 2048**0.5
    exact = plain.geglu(x.float() @ gate_up.float().T)
    for tile in tiles.candidates(HERE, False, "geglu", 2048):
        assert relative(product(x, gate_up, "geglu", tile=tile), exact) < 2 * relative(
            plain.linear_geglu(x, gate_up), exact
        )


def test_rows_beyond_the_result_are_left_alone() -> None:
    x, matrix = operands(5, 24, 32)
    whole = torch.full((7, 24), torch.nan, device=DEVICE, dtype=DTYPE)
    product(x, matrix, out=whole[1:6], tile=SMALL[0])
    assert bool(whole[[0, 6]].isnan().all()) and bool(whole[1:6].isfinite().all())


@pytest.mark.parametrize("format", FORMATS_HERE, ids=lambda format: format.name)
def test_operations_take_both_kinds_of_matrix(monkeypatch: pytest.MonkeyPatch, format: Format) -> None:
    monkeypatch.setattr("turbopi.kernels.portable.gemm.kernel.best_tile", lambda *_: SMALL[0])
    ops, bias = portable_ops(), random(24)
    x, matrix = operands(5, 48, 32, format)
    half = matrix[:24]
    tolerance = 0.006 if ON_GPU else 1e-6
    for ours, reference in (
        (ops.linear(x, half, bias), plain.linear(x, half, bias)),
        (ops.linear(x, half, None, random(5, 24)), plain.linear(x, half)),
        (ops.residual_linear(x, half, bias), plain.linear(x, half, bias)),
        (ops.linear_gelu(x, half, bias), plain.linear_gelu(x, half, bias)),
        (ops.linear_geglu(x, matrix), plain.linear_geglu(x, matrix)),
    ):
        assert ours.shape == reference.shape and relative(ours, reference) < tolerance
    wide, gate_up = random(5, 32), random(48, 32)
    assert relative(ops.linear_geglu(wide, gate_up), plain.linear_geglu(wide, gate_up)) < tolerance
    reference = plain.linear_geglu(wide, gate_up)
    inverse = 0.9 * format.largest / float(reference.abs().max())
    rounded = ops.linear_geglu(wide, gate_up, inverse=inverse, numbers=format.dtype)
    assert rounded.dtype == stored(format) and relative(rounded.float() / inverse, reference) < 0.04


def test_parts_are_what_the_norms_add_up() -> None:
    x, matrix = operands(9, 32, 800)
    stream, scale = random(9, 32), torch.ones(32, device=DEVICE)
    parts = product(x, matrix, "parts", tile=Tile(32, 64, 4, 6, splits=3))
    ours = norms.residual_rms_norm(stream, parts, None, scale, None, 1e-6)
    reference = plain.residual_rms_norm(stream, plain.linear(x, matrix), None, scale, None, 1e-6)
    assert all(relative(a, b) < (0.01 if ON_GPU else 1e-6) for a, b in zip(ours, reference, strict=True))


@pytest.mark.parametrize("format", FORMATS_HERE, ids=lambda format: format.name)
def test_whatever_stands_before_a_product_leaves_in_its_numbers(format: Format) -> None:
    """Exactly as the twin rounds it, but where a sum's last bit decides."""
    x, qkv, ones = random(5, 96), random(8, 96), torch.ones(96, device=DEVICE, dtype=DTYPE)
    keys, length = random(8, 16), torch.tensor([7], device=DEVICE)
    to: dict[str, Any] = {"inverse": format.largest / 9, "numbers": format.dtype}
    norm, layer_norm = (x, None, None, ones.float(), None, 1e-6), (x, x, ones, ones, 1e-6)
    camera_images, prefix = (qkv, 2, 2), (qkv.view(-1, 16), keys, keys, length, 8, 6)
    for ours, reference in (
        (activations.geglu(x, **to), plain.as_input(plain.geglu(x.float()), DTYPE, **to)),
        (norms.residual_rms_norm(*norm, **to)[1], plain.residual_rms_norm(*norm, **to)[1]),
        (norms.residual_layer_norm(*layer_norm, **to)[1], plain.residual_layer_norm(*layer_norm, **to)[1]),
        (attention.vision_attention(*camera_images, **to), plain.vision_attention(*camera_images, **to)),
        (attend(*prefix, **to), plain.attention(*prefix, **to)),
    ):
        assert ours.dtype == stored(format) and reference.dtype == format.dtype
        if ours.dtype == torch.int8:
            assert (
                int((ours.int() - reference.int()).abs().max()) <= 1
                and float((ours != reference).float().mean()) < 0.02
            )
        else:
            assert relative(ours.float(), reference.float()) < 0.05


@pytest.mark.parametrize("damage", [torch.nan, torch.inf])
def test_damage_that_int8_cannot_hold_shows_in_its_row_of_the_stream(damage: float) -> None:
    to: dict[str, Any] = {"inverse": 30.0, "numbers": torch.int8}

    def ones(*shape: int) -> Tensor:
        return torch.ones(shape, device=DEVICE, dtype=DTYPE)

    def bad(row: int, column: int, *shape: int) -> Tensor:
        x = random(*shape)
        x[row, column] = damage
        return x

    def marked(operation: Callable[[Tensor], Any]) -> list[int]:
        stream = ones(8, 32)
        operation(stream)
        assert bool(stream[:, 1:].isfinite().all()), "one number of a row is enough"
        return [int(row) for row in stream[:, 0].isnan().nonzero()]

    numbers, matrix = operands(8, 32, 64, INT8)
    gated = replace(matrix, data=torch.cat((matrix.data, matrix.data)), scale=torch.cat((matrix.scale, matrix.scale)))
    bias, x, qkv = ones(32), bad(3, 7, 8, 64), bad(3, 90, 8, 96)  # a value of the first of two images
    bias[5] = damage
    gated.scale[5] = damage
    every = list(range(8))
    for ours, reference, rows in (
        (lambda s: product(numbers, matrix, "gelu", bias, stream=s, tile=SMALL[0], **to), plain.linear_gelu, every),
        (lambda s: product(numbers, gated, "geglu", stream=s, tile=SMALL[0], **to), plain.linear_geglu, every),
    ):
        given = (numbers, matrix, bias) if reference is plain.linear_gelu else (numbers, gated)
        theirs = partial(reference, *given, **to)
        assert marked(ours) == marked(lambda s, theirs=theirs: theirs(stream=s)) == rows  # type: ignore[misc]
    assert marked(lambda s: activations.geglu(x, **to, stream=s)) == [3]
    for attended in (attention.vision_attention, plain.vision_attention):
        assert marked(lambda s, attended=attended: attended(qkv, 2, 2, **to, stream=s)) == [0, 1, 2, 3]  # type: ignore[misc]
    for normed in (norms.residual_rms_norm, plain.residual_rms_norm):
        stream, _ = normed(bad(3, 7, 8, 32), random(8, 32), None, ones(32).float(), None, 1e-6, **to)
        assert stream[:, 0].isnan().nonzero().flatten().tolist() == [3], "its other numbers hide it"
        stream, _ = normed(random(8, 32), None, None, bias.float(), None, 1e-6, **to)
        assert stream[:, 0].isnan().all()
    for layer_norm in (norms.residual_layer_norm, plain.residual_layer_norm):
        stream, _ = layer_norm(bad(3, 7, 8, 32), random(8, 32), ones(32), ones(32), 1e-6, **to)
        assert stream[:, 0].isnan().nonzero().flatten().tolist() == [3]
    for prefix in (attend, plain.attention):  # two heads of four tokens; the values are the cache's rows
        values, queries = random(4, 16), bad(5, 7, 8, 16)
        prefix(queries, random(4, 16), values, torch.tensor([3], device=DEVICE), 4, 2, **to)
        assert values[:, 0].isnan().nonzero().flatten().tolist() == [2]


# Which tile


@pytest.mark.parametrize("capability", tiles.BLOCK_SHARED)
@pytest.mark.parametrize("rows", [1, 11, 304, 512, 560, 976, 4480])
@pytest.mark.parametrize(
    ("n", "k", "epilogue"),
    [(3456, 1152, "plain"), (1152, 4304, "parts"), (2048, 16384, "parts"), (16384, 2048, "geglu"), (16, 16, "gelu")],
)
def test_the_chosen_tile_fits_the_gpu(capability: Capability, rows: int, n: int, k: int, epilogue: Epilogue) -> None:
    for fp8 in (False, True):
        tile = tiles.best_tile(capability, fp8, epilogue, rows, n, k, 100)
        assert tile.takes(capability, epilogue, fp8 and tiles.promotes(capability, k))
        assert tile.splits == 1 or epilogue == "parts"
    assert tiles.best_tile(capability, True, epilogue, rows, n, k, 100, True).takes(capability, epilogue, True)


def test_a_gpu_nobody_has_seen_gets_tiles_that_fit_the_smallest() -> None:
    for epilogue in EPILOGUES:
        for tile in tiles.candidates((12, 9), True, epilogue, 16384):
            assert tile.shared_bytes((12, 9)) <= 99 * 1024


def test_a_measured_tile_is_taken() -> None:
    """In 24 columns of 33 rows: the cost model's tile would give parts of another number."""
    x, matrix = operands(33, 24, 800)
    table = TileTable({TileKey("portable", "parts", "fp8", 64, 24, 800): asdict(Tile(32, 64, 4, 6, splits=3))})
    ours = portable_ops(table).residual_linear(x, matrix)
    assert ours.shape == (3, 33, 24)
    assert relative(ours.float().sum(0), matrix.product(x)) < (0.006 if ON_GPU else 1e-6)


def test_bfloat16_takes_geglu_into_the_epilogue_where_that_was_measured_to_be_faster() -> None:
    table = TileTable({TileKey("portable", "geglu", "bf16", 64, 24, 32): asdict(SMALL[0])})
    tuned = portable_ops(table)
    assert tuned.origin["GeGLU of the prefix"] == "Triton, in its product's epilogue for 64 rows, else behind cuBLAS"
    x, gate_up = random(5, 32), random(48, 32)
    ours, usual = tuned.linear_geglu(x, gate_up), portable_ops().linear_geglu(x, gate_up)
    assert relative(ours, usual) < (0.01 if ON_GPU else 1e-6)
    with pytest.MonkeyPatch.context() as patched:  # a product that isn't made by the library
        patched.setattr("turbopi.kernels.portable.products.F.linear", None)
        assert torch.equal(tuned.linear_geglu(x, gate_up), ours)


def test_few_rows_do_not_take_the_tallest_tile_and_long_sums_are_split() -> None:
    assert tiles.best_tile((9, 0), True, "plain", 11, 2560, 2048, 132).rows < 128
    assert tiles.best_tile((9, 0), True, "parts", 560, 2048, 16384, 132).splits > 1


def test_int8_is_refused_where_triton_takes_a_slow_instruction_for_it() -> None:
    for capability in tiles.BLOCK_SHARED:
        assert (tiles.int8_refusal(capability) is None) == (capability[0] in (8, 9, 12))


def test_fp8_is_refused_below_8_9_and_says_why() -> None:
    assert all(tiles.fp8_refusal(one) is None for one in ((8, 9), (9, 0), (12, 0)))
    for capability in ((8, 0), (8, 6), (8, 7)):
        why = tiles.fp8_refusal(capability)
        assert why is not None and f"this GPU has {capability[0]}.{capability[1]}" in why
        assert tiles.half_sums_refusal(capability) == why
    for capability in tiles.BLOCK_SHARED:
        if capability >= (8, 9):
            assert (tiles.half_sums_refusal(capability) is None) == (capability[0] in (8, 9, 12))


# Which kernels


@pytest.fixture
def hopper(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kernels_ops, "capability", lambda device: (9, 0))
    monkeypatch.setattr(
        kernels_ops, "hopper_ops", lambda device, tiles: replace(portable_ops(tiles), origin={"all": "Hopper's"})
    )


def test_the_variable_forces_the_portable_kernels(hopper: None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TURBOPI_KERNELS", "portable")
    assert kernels_ops.forced_portable()
    assert kernels_ops.fused_ops(DEVICE).origin["FP8 products"].startswith("Triton")
    for value in ("auto", None):
        if value is None:
            monkeypatch.delenv("TURBOPI_KERNELS")
        else:
            monkeypatch.setenv("TURBOPI_KERNELS", value)
        assert not kernels_ops.forced_portable()
        origin = kernels_ops.fused_ops(DEVICE).origin
        assert origin["all"] == "Hopper's" and origin["FP8 products"].startswith("CUDA")
        origin = kernels_ops.fused_ops(DEVICE, precision="int8").origin
        assert origin["all"] == "Hopper's" and origin["INT8 products"].startswith("CUDA")


@pytest.mark.parametrize("value", ["hopper", "", "Portable"])
def test_another_value_is_an_error_that_names_it(hopper: None, value: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TURBOPI_KERNELS", value)
    with pytest.raises(ConfigError, match=f"TURBOPI_KERNELS is '{value}'; expected 'auto' .* or 'portable'"):
        kernels_ops.fused_ops(DEVICE)


def test_the_origin_says_where_geglu_is() -> None:
    by_library = TileTable({TileKey("portable", "geglu", "bf16", 576, 16384, 2048): {LIBRARY: 1}})
    for ops in (portable_ops(), portable_ops(by_library)):
        assert ops.origin["GeGLU of the prefix"] == "Triton behind cuBLAS"


def test_the_interpreter_chooses_as_one_gpu_would() -> None:
    assert gpu(torch.device("cpu"))[0] == (9, 0)
