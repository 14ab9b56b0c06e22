"""E4M3: the rounding itself, the kernels that round to it, and the products of its numbers, on Hopper of int8, too.

Triton's interpreter can't round to E4M3, so without a GPU the kernels are shown to hand over the right float32; on a
GPU the bits are compared with PyTorch's.
"""

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from conftest import gpu_or_interpreter, on_hopper
from torch import Tensor

ON_GPU = torch.cuda.is_available()
pytest.importorskip("triton", reason="Triton isn't installed")

from turbopi.kernels import plain  # noqa: E402
from turbopi.kernels.portable import attention, norms  # noqa: E402
from turbopi.kernels.portable.quantize import quantize  # noqa: E402
from turbopi.kernels.sm90.attention import kernel as attention_hopper  # noqa: E402
from turbopi.kernels.sm90.gemm import fp8 as gemm_fp8  # noqa: E402
from turbopi.kernels.sm90.gemm.bf16 import Epilogue, Tile, matmul  # noqa: E402
from turbopi.kernels.sm90.instructions import SHARED_BYTES  # noqa: E402
from turbopi.quantization.formats import INT8  # noqa: E402
from turbopi.quantization.fp8 import E4M3, E4M3_MAX, ScaledMatrix, input_of, to_e4m3  # noqa: E402
from turbopi.quantization.int8 import to_int8  # noqa: E402

DEVICE = torch.device("cuda" if ON_GPU else "cpu")
DTYPE = torch.bfloat16 if ON_GPU else torch.float32
pytestmark = gpu_or_interpreter()
seeds = iter(range(10**6))


def random(*shape: int, dtype: torch.dtype = DTYPE) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(next(seeds))).to(DEVICE, dtype)


def all_e4m3() -> Tensor:
    """The 254 finite values and both NaN, as E4M3."""
    return torch.arange(256, dtype=torch.uint8, device=DEVICE).view(E4M3)


# The numbers


def test_every_number_of_e4m3_survives() -> None:
    numbers = all_e4m3()
    back = to_e4m3(numbers.float(), 1.0)
    finite = numbers.float().isfinite()
    assert int(finite.sum()) == 254
    assert torch.equal(back.view(torch.uint8)[finite], numbers.view(torch.uint8)[finite])
    assert bool(back.float()[~finite].isnan().all())


def test_halves_go_to_even_beyond_goes_to_the_largest_and_nan_stays() -> None:
    x = torch.tensor([17.0, 19.0, 449.0, 1e30, torch.inf, -torch.inf, torch.nan, 2.0**-10, -(2.0**-9)], device=DEVICE)
    expected = [16, 20, 448, 448, 448, -448, torch.nan, 0, -(2.0**-9)]
    torch.testing.assert_close(to_e4m3(x, 1.0).float().cpu(), torch.tensor(expected), equal_nan=True, atol=0, rtol=0)


def test_rounding_is_to_the_nearest_number() -> None:
    numbers = all_e4m3().float()
    numbers = numbers[numbers.isfinite()]
    x = random(2000, dtype=torch.float32) * 100
    nearest = (x[:, None] - numbers).abs().amin(dim=1)
    assert torch.equal((to_e4m3(x, 1.0).float() - x).abs(), nearest)


def test_a_matrix_has_a_scale_for_each_channel() -> None:
    weight = random(24, 32) * torch.logspace(-6, 3, 24, device=DEVICE)[:, None].to(DTYPE)
    weight[3] = 0
    matrix = quantize(weight, 0.5)
    assert matrix.inverse == 2 and matrix.shape == (24, 32)
    largest = matrix.data.float().abs().amax(dim=1)
    assert bool((largest == torch.where(weight.any(1), E4M3_MAX, 0)).all())
    relative = (matrix.dequantized() - weight.float()).norm(dim=1) / weight.float().norm(dim=1).clamp(min=1e-30)
    assert float(relative.max()) < 0.045
    assert input_of(matrix) == {"inverse": 2.0} and input_of(weight) == {}
    torch.testing.assert_close(matrix[-8:].dequantized(), matrix.dequantized()[-8:], atol=0, rtol=0)


def test_a_product_is_what_its_numbers_stand_for() -> None:
    weight, x, bias = random(48, 32), random(5, 32), random(48)
    matrix = quantize(weight, 0.02)
    given = to_e4m3(x, matrix.inverse)
    expected = (given.float() * 0.02) @ matrix.dequantized().T + bias.float()
    torch.testing.assert_close(plain.linear(given, matrix, bias), expected.to(DTYPE), atol=1e-4, rtol=1e-2)
    activated = plain.linear_gelu(given, matrix, bias, inverse=100.0)
    assert activated.dtype == E4M3
    assert_rounded(activated, plain.gelu(expected), 100.0)


# The kernels that round


def assert_rounded(ours: Tensor, exact: Tensor, inverse: float) -> None:
    """`ours` is `exact * inverse` in E4M3, up to the float32 rounding of `exact` (which tips a few over an edge)."""
    if ours.dtype == torch.float32:
        torch.testing.assert_close(ours, exact.float() * inverse, atol=1e-4, rtol=1e-4)
        return
    assert ours.dtype == E4M3 and ours.shape == exact.shape
    expected = to_e4m3(exact, inverse)
    same = ours.view(torch.uint8) == expected.view(torch.uint8)
    assert float(same.float().mean()) > 0.98
    step = expected.float().abs().clamp(min=2.0**-6) / 8  # at least one step of E4M3 there
    assert bool(((ours.float() - expected.float()).abs() <= step).all())


@pytest.mark.parametrize(("width", "rows"), [(96, 3), (1152, 5), (2048, 2)])
@pytest.mark.parametrize("splits", [None, 0, 3])
def test_norms_leave_in_e4m3(width: int, rows: int, splits: int | None) -> None:
    x, scale = random(rows, width), random(width, dtype=torch.float32)
    weight, bias = random(width), random(width)
    parts = None if splits is None else random(max(splits, 1), rows, width, dtype=torch.float32)
    y = None if parts is None else parts.sum(0).to(DTYPE) if splits == 0 else parts
    total = x if y is None else x + (y if splits == 0 else parts.sum(0).to(DTYPE))  # type: ignore[union-attr]
    for ours, exact in (
        (norms.residual_rms_norm(x, y, None, scale, None, 1e-6, 37.0), plain.rms_normalize(total, 1e-6) * scale),
        (
            norms.residual_layer_norm(x, y, weight, bias, 1e-6, 37.0),
            torch.nn.functional.layer_norm(total.float(), (width,), weight.float(), bias.float(), 1e-6),
        ),
    ):
        if splits != 3:  # the kernel rounds once less than this sum
            torch.testing.assert_close(ours[0], total, atol=0, rtol=0)
            assert_rounded(ours[1], exact, 37.0)
        assert bool(ours[1].float().isfinite().all())


@pytest.mark.gpu  # Triton's interpreter can't round to E4M3
def test_kernels_saturate_and_keep_nan() -> None:
    x = random(4, 64)
    x[1, 3] = torch.nan
    scale = torch.ones(64, device=DEVICE)
    _, normed = norms.residual_rms_norm(x, None, None, scale, None, 1e-6, 1e6)
    assert bool((normed[[0, 2, 3]].float().abs() == E4M3_MAX).all())
    assert bool(normed[1].float().isnan().all())


@pytest.mark.parametrize(("heads", "head_dim"), [(2, 24), (2, 32)])
def test_attention_leaves_in_e4m3(heads: int, head_dim: int) -> None:
    qkv = random(2 * 50, 3 * heads * head_dim)
    exact = plain.vision_attention(qkv.float(), 2, heads)
    ours = attention.vision_attention(qkv, 2, heads, 55.0)
    assert ours.dtype == (E4M3 if ON_GPU else torch.float32)
    relative = (ours.float() / 55 - exact).norm() / exact.norm()
    assert float(relative) < (0.035 if ON_GPU else 1e-5)
    q, k, v, length = random(20 * heads, head_dim), random(20, head_dim), random(20, head_dim), torch.tensor([17])
    exact = plain.attention(q.float(), k.float(), v.float(), length.to(DEVICE), 20, heads)
    ours = attention.prefix_attention(q, k, v, length.to(DEVICE), heads, 55.0)
    assert float((ours.float() / 55 - exact).norm() / exact.norm()) < (0.035 if ON_GPU else 1e-5)


@on_hopper
@pytest.mark.parametrize(("heads", "head_dim"), [(2, 24), (16, 72), (8, 256)])
@pytest.mark.parametrize("tokens", [50, 128, 256])
def test_attention_of_hopper_leaves_in_e4m3(tokens: int, heads: int, head_dim: int) -> None:
    qkv = random(2 * tokens, 3 * heads * head_dim)
    exact = plain.vision_attention(qkv.float(), 2, heads)
    ours = attention_hopper.vision_attention(qkv, 2, heads, 55.0)
    assert ours.dtype == E4M3 and float((ours.float() / 55 - exact).norm() / exact.norm()) < 0.035
    q, k, v, length = random(80 * heads, head_dim), random(80, head_dim), random(80, head_dim), torch.tensor([77])
    exact = plain.attention(q.float(), k.float(), v.float(), length.to(DEVICE), 80, heads)
    ours = attention_hopper.prefix_attention(q, k, v, length.to(DEVICE), heads, 55.0)
    assert ours.dtype == E4M3 and float((ours.float() / 55 - exact).norm() / exact.norm()) < 0.035


# The products

TILES = [Tile(2, 112), Tile(3, 192), Tile(2, 256), Tile(1, 80), Tile(3, 96), Tile(2, 96, cluster_m=2, cluster_n=2)]


def operands(m: int, n: int, k: int) -> tuple[Tensor, ScaledMatrix]:
    matrix = quantize(random(n, k) / k**0.5, 0.01)
    return to_e4m3(random(m, k), matrix.inverse), matrix


@on_hopper
@pytest.mark.parametrize("tile", TILES)
@pytest.mark.parametrize("epilogue", ["plain", "bias", "gelu", "geglu"])
@pytest.mark.parametrize("out_fp8", [False, True])
@pytest.mark.parametrize(("m", "n", "k"), [(560, 2048, 1152), (1, 16, 16), (203, 4304, 80), (130, 264, 4304)])
def test_products(m: int, n: int, k: int, epilogue: Epilogue, tile: Tile, out_fp8: bool) -> None:
    x, matrix = operands(m, 2 * n if epilogue == "geglu" else n, k)
    bias = random(n) if epilogue in ("bias", "gelu") else None
    sums = matrix.product(x, bias)
    exact = plain.gelu(sums) if epilogue == "gelu" else plain.geglu(sums) if epilogue == "geglu" else sums
    inverse = 30.0 if out_fp8 else None
    out = torch.full((m, n), torch.nan, device=DEVICE, dtype=E4M3 if out_fp8 else DTYPE)
    ours = gemm_fp8.matmul_fp8(x, matrix, tile, epilogue, bias, out, inverse)

    def error(result: Tensor) -> float:
        return float((result.float() / (inverse or 1) - exact).norm() / exact.norm())

    # E4M3 can't say it better than the exact result, rounded; of few numbers that error varies much
    assert error(ours) < 0.006 + (error(to_e4m3(exact, inverse)) if inverse else 0)


@on_hopper
@pytest.mark.parametrize("tile", [Tile(3, 128), Tile(2, 176, cluster_n=2), Tile(1, 96)])
@pytest.mark.parametrize("epilogue", ["plain", "bias", "gelu", "geglu"])
@pytest.mark.parametrize(("m", "n", "k"), [(560, 16384, 2048), (203, 4304, 1152), (1, 16, 992)])
def test_an_epilogue_during_the_next_tiles_products_is_the_same(
    m: int, n: int, k: int, epilogue: Epilogue, tile: Tile
) -> None:
    x, matrix = operands(m, 2 * n if epilogue == "geglu" else n, k)
    bias = random(n) if epilogue in ("bias", "gelu") else None
    tiles = tile, replace(tile, overlap=True)
    for inverse in (None, 30.0):
        one, other = (gemm_fp8.matmul_fp8(x, matrix, t, epilogue, bias, inverse=inverse).float() for t in tiles)
        assert torch.equal(one, other)
    one, other = (matmul(x.to(DTYPE), matrix.data.to(DTYPE), t, epilogue, bias) for t in tiles)
    assert torch.equal(one, other)


@on_hopper
@pytest.mark.parametrize("splits", [1, 2, 4])
def test_partial_sums_add_up(splits: int) -> None:
    x, matrix = operands(531, 1152, 4304)
    bias = random(1152)
    parts = gemm_fp8.matmul_fp8(x, matrix, Tile(2, 144, splits=splits), "partial", bias)
    assert parts.shape == (splits, 531, 1152) and parts.dtype == torch.float32
    exact = matrix.product(x, bias)
    assert float((parts.sum(0) - exact).norm() / exact.norm()) < 1e-3


@on_hopper
@pytest.mark.parametrize("tile", [Tile(3, 96, splits=2), Tile(2, 144, splits=3), Tile(1, 256, splits=2)])
@pytest.mark.parametrize(("m", "n", "k"), [(560, 2048, 16384), (203, 1160, 4304), (1, 16, 1152)])
def test_parts_in_bfloat16_are_the_partial_sums_rounded(m: int, n: int, k: int, tile: Tile) -> None:
    x, matrix = operands(m, n, k)
    out = torch.full((tile.splits, m, n), torch.nan, device=DEVICE, dtype=DTYPE)
    ours = gemm_fp8.matmul_fp8(x, matrix, tile, "parts", out=out)
    assert torch.equal(ours, gemm_fp8.matmul_fp8(x, matrix, tile, "partial").to(DTYPE))


@on_hopper
def test_promoted_sums_lose_less_than_the_tensor_cores_own() -> None:
    x, matrix = operands(256, 512, 16384)
    x, matrix.data[:] = to_e4m3(x.float().abs(), 1.0), to_e4m3(matrix.data.float().abs(), 1.0)  # the worst: one sign
    exact = matrix.product(x)

    def error(promote: int) -> float:
        ours = gemm_fp8.matmul_fp8(x, matrix, Tile(2, 128), "partial", promote=promote)[0]
        return float((ours - exact).norm() / exact.norm())

    # each product is cut off at the running sum's last bit, so the share that is lost grows with the unpromoted length
    assert error(gemm_fp8.PROMOTE) < error(0) * gemm_fp8.PROMOTE * gemm_fp8.DEPTH / 16384


@on_hopper
def test_nan_shows_and_too_much_saturates() -> None:
    x, matrix = operands(8, 32, 64)
    x.view(torch.uint8)[2, 5] = 0x7F
    ours = gemm_fp8.matmul_fp8(x, matrix, Tile(1, 80), "plain", inverse=1e9).float()
    assert bool(ours[2].isnan().all())
    assert bool((ours[[0, 1, 3]].abs() == E4M3_MAX).all())


@on_hopper
def test_repetition_is_bit_identical() -> None:
    x, matrix = operands(560, 2048, 16384)
    run: Callable[[], Tensor] = lambda: gemm_fp8.matmul_fp8(x, matrix, Tile(3, 192, splits=4), "partial")  # noqa: E731
    first = run()
    assert all(torch.equal(run(), first) for _ in range(5))


# Whole numbers


def whole_operands(m: int, n: int, k: int) -> tuple[Tensor, ScaledMatrix]:
    matrix = quantize(random(n, k) / k**0.5, 0.02, format=INT8)
    return to_int8(random(m, k), matrix.inverse), matrix


WHOLE_TILES = [Tile(2, 112), Tile(2, 256), Tile(1, 80), Tile(2, 96, cluster_m=2, cluster_n=2), Tile(3, 192, ring=5)]


@on_hopper
@pytest.mark.parametrize("tile", WHOLE_TILES)
@pytest.mark.parametrize("epilogue", ["plain", "bias", "gelu", "geglu"])
@pytest.mark.parametrize("out_int8", [False, True])
@pytest.mark.parametrize(("m", "n", "k"), [(560, 2048, 1152), (1, 16, 16), (203, 4304, 80), (130, 264, 4304)])
def test_products_of_int8(m: int, n: int, k: int, epilogue: Epilogue, tile: Tile, out_int8: bool) -> None:
    x, matrix = whole_operands(m, 2 * n if epilogue == "geglu" else n, k)
    bias = random(n) if epilogue in ("bias", "gelu") else None
    sums = matrix.product(x, bias)
    exact = plain.gelu(sums) if epilogue == "gelu" else plain.geglu(sums) if epilogue == "geglu" else sums
    inverse = 127 / float(exact.abs().max()) if out_int8 else None
    ours = gemm_fp8.matmul_fp8(x, matrix, tile, epilogue, bias, inverse=inverse)
    if inverse is not None:
        off = (ours.int() - to_int8(exact, inverse).int()).abs()
        assert ours.dtype == torch.int8 and int(off.max()) <= 1 and float((off > 0).float().mean()) < 0.02
    else:
        # the sums are exact: what is left is bfloat16's rounding, and the approximate tanh of GELU
        assert ours.dtype == DTYPE
        bound = 2.0**-8 * exact.abs() + (2.0**-10 if epilogue in ("gelu", "geglu") else 1e-6) * sums.abs().max()
        assert bool(((ours.float() - exact).abs() <= bound).all())


@on_hopper
def test_int8s_largest_sums_and_parts_are_exact() -> None:
    m, n, k = 130, 264, 16384
    matrix = ScaledMatrix(
        torch.full((n, k), 127, dtype=torch.int8, device=DEVICE), torch.ones(n, device=DEVICE), 1.0, torch.bfloat16
    )
    x = torch.full((m, k), -127, dtype=torch.int8, device=DEVICE)
    x[3] = 1
    expected = matrix.product(x)
    parts = gemm_fp8.matmul_fp8(x, matrix, Tile(2, 96, splits=2), "partial")
    assert torch.equal(parts.sum(0), expected)
    gathered = Tile(2, 96, cluster_m=2, cluster_n=2, splits=2, gather=True)
    assert torch.equal(gemm_fp8.matmul_fp8(x, matrix, gathered, "bias"), expected.to(DTYPE))
    stream = torch.zeros(m, n, dtype=DTYPE, device=DEVICE)
    gemm_fp8.matmul_fp8(x, matrix, Tile(2, 96), "added", None, stream)
    assert torch.equal(stream, expected.to(DTYPE))


@on_hopper
@pytest.mark.parametrize(("heads", "head_dim"), [(2, 24), (16, 72), (8, 256)])
@pytest.mark.parametrize(("tokens", "images"), [(50, 2), (256, 2), (256, 16)])
def test_attention_of_hopper_leaves_in_int8_and_marks_damage(
    tokens: int, images: int, heads: int, head_dim: int
) -> None:
    """A value that isn't finite damages all that see it: an image's tokens; of a prefix those whose head it is."""
    qkv, stream = random(images * tokens, 3 * heads * head_dim), random(images * tokens, 8)
    to = {"inverse": 40.0, "numbers": torch.int8}
    attend = attention_hopper.vision_attention
    exact = plain.vision_attention(qkv.float(), images, heads)
    ours = attend(qkv, images, heads, 40.0, numbers=torch.int8, stream=stream)
    assert ours.dtype == torch.int8 and bool(stream.isfinite().all())
    assert int((ours.int() - plain.as_input(exact, DTYPE, **to).int()).abs().max()) <= 1  # type: ignore[arg-type]
    qkv[3, -1] = torch.nan  # a value of the last head, in the first image
    attend(qkv, images, heads, 40.0, numbers=torch.int8, stream=stream)
    assert stream[:, 0].isnan().tolist() == [True] * tokens + [False] * (images - 1) * tokens
    assert bool(stream[:, 1:].isfinite().all())

    q, k, v, length = random(80 * heads, head_dim), random(80, head_dim), random(80, head_dim), torch.tensor([77])
    exact = plain.attention(q.float(), k.float(), v.float(), length.to(DEVICE), 80, heads)
    ours = attention_hopper.prefix_attention(q, k, v, length.to(DEVICE), heads, 40.0, numbers=torch.int8)
    assert int((ours.int() - plain.as_input(exact, DTYPE, **to).int()).abs().max()) <= 1  # type: ignore[arg-type]
    q[5 * heads + 1] = torch.inf  # a query of the sixth token
    attention_hopper.prefix_attention(q, k, v, length.to(DEVICE), heads, 40.0, numbers=torch.int8)
    assert v[:, 0].isnan().nonzero().flatten().tolist() == [5]


@on_hopper
@pytest.mark.parametrize("epilogue", ["gelu", "geglu"])
def test_what_int8_cannot_hold_is_marked_in_its_row(epilogue: Epilogue) -> None:
    """Of a channel that is damaged in every row; of one whose sums are 0 but where its row isn't."""
    x, matrix = whole_operands(70, 64 if epilogue == "geglu" else 32, 128)
    bias = random(32) if epilogue == "gelu" else None

    def marked() -> list[int]:
        stream = torch.ones(70, 48, dtype=DTYPE, device=DEVICE)
        gemm_fp8.matmul_fp8(x, matrix, Tile(1, 80), epilogue, bias, inverse=30.0, stream=stream)
        assert bool(stream[:, 1:].isfinite().all())
        return [int(row) for row in stream[:, 0].isnan().nonzero()]

    assert marked() == []
    matrix.scale[5] = torch.nan
    assert marked() == list(range(70))
    matrix.scale[5] = torch.inf
    x[:, :] = torch.where(torch.arange(70, device=DEVICE)[:, None] == 66, x, 0)
    assert 66 in marked()


@pytest.mark.parametrize("rows", [11, 256, 512, 560, 976])
@pytest.mark.parametrize(
    ("n", "k", "epilogue"),
    [
        (3456, 1152, "bias"),
        (1152, 4352, "partial"),
        (2048, 16384, "parts"),
        (16384, 2048, "geglu"),
        (4352, 1152, "gelu"),
    ],
)
def test_int8s_tile_has_a_width_of_its_instruction_and_no_overlap(
    rows: int, n: int, k: int, epilogue: Epilogue
) -> None:
    tile = gemm_fp8.best_tile(rows, n, k, epilogue, 132, whole=True)
    assert gemm_fp8.takes_whole(tile) and tile.splits <= -(-k // gemm_fp8.DEPTH)


# Which tile


@pytest.mark.parametrize("rows", [11, 256, 304, 512, 560, 768, 816, 976])
@pytest.mark.parametrize(
    ("n", "k", "epilogue"),
    [(3456, 1152, "bias"), (1152, 4304, "partial"), (2048, 16384, "parts"), (16384, 2048, "geglu")],
)
def test_the_chosen_tile_is_one_that_the_kernel_takes(rows: int, n: int, k: int, epilogue: Epilogue) -> None:
    tile = gemm_fp8.best_tile(rows, n, k, epilogue, 132)
    stages = tile.stages(factors=1, lines=epilogue == "parts")
    assert stages >= 3
    assert tile.columns % (16 if epilogue == "geglu" else 8) == 0 and tile.columns <= 256
    assert tile.splits == 1 or epilogue in ("partial", "parts")
    steps = -(-k // gemm_fp8.DEPTH)
    assert tile.splits <= steps and tile.takes(epilogue, steps)
    assert gemm_fp8.promotion(tile, k) or steps <= gemm_fp8.UNPROMOTED_STEPS * tile.splits
    used = stages * (tile.rows + tile.columns) * 128 + 16 * 16 + 8 * tile.warpgroups * tile.columns
    used += tile.warpgroups * 4 * 16 * 128 if epilogue == "parts" else 0
    assert used + 1024 <= SHARED_BYTES
