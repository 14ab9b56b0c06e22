"""Each Triton kernel equals its plain-PyTorch twin.

Without a GPU in float32 through Triton's interpreter (its bfloat16 products are wrong). On a GPU in bfloat16 with large
outliers: the kernel's error may be twice the twin's, both against the twin in float32 on the same numbers.
"""

from collections.abc import Callable

import pytest
import torch
from conftest import gpu_or_interpreter, on_hopper
from torch import Tensor

ON_GPU = torch.cuda.is_available()
pytest.importorskip("triton", reason="Triton isn't installed")

from turbopi.kernels import plain  # noqa: E402
from turbopi.kernels.portable import activations, attention, embedding, norms, rope, transfer  # noqa: E402
from turbopi.kernels.portable import products as portable_products  # noqa: E402
from turbopi.kernels.portable.ops import EmbedPatches  # noqa: E402
from turbopi.kernels.sm90.attention import kernel as attention_hopper  # noqa: E402
from turbopi.kernels.sm90.gemm import products, tiles  # noqa: E402
from turbopi.kernels.sm90.gemm.bf16 import Epilogue, Tile, matmul  # noqa: E402
from turbopi.models.pi0.layers import rope_tables  # noqa: E402

DEVICE = torch.device("cuda" if ON_GPU else "cpu")
DTYPE = torch.bfloat16 if ON_GPU else torch.float32
pytestmark = gpu_or_interpreter()
seeds = iter(range(10**6))


def random(*shape: int, outliers: bool = False, dtype: torch.dtype = DTYPE) -> Tensor:
    g = torch.Generator().manual_seed(next(seeds))
    x = torch.randn(shape, generator=g)
    if outliers:  # a few columns hundreds of times as large, as in trained transformers
        x[..., torch.randint(0, shape[-1], (3,), generator=g)] *= 300
    return x.to(DEVICE, dtype)


def assert_as_good(ours: Tensor, reference: Tensor, exact: Tensor) -> None:
    """`ours` is finite and no worse than twice `twin`'s error against `exact` (float32)."""
    assert ours.shape == reference.shape and ours.dtype == reference.dtype and bool(ours.isfinite().all())
    if ours.dtype == torch.float32:
        torch.testing.assert_close(ours, exact, atol=1e-5 * max(1.0, exact.abs().max().item()), rtol=1e-5)
        return
    assert_error_at_most_double(ours, reference, exact)


def assert_error_at_most_double(ours: Tensor, reference: Tensor, exact: Tensor) -> None:
    def rms(x: Tensor) -> float:
        return float((x.double() - exact.double()).square().mean().sqrt())

    assert rms(ours) <= 2 * rms(reference) + 1e-7 * float(exact.double().square().mean().sqrt())
    largest = (reference.double() - exact.double()).abs().max()
    assert (ours.double() - exact.double()).abs().max() <= 2 * largest + 1e-7 * exact.abs().max()


def poison_allocator() -> None:
    """Leave NaN where the next outputs will be allocated."""
    if ON_GPU:
        for size in (1 << 12, 1 << 16, 1 << 20, 1 << 22, 1 << 24):
            torch.full((size,), torch.nan, device=DEVICE)


@pytest.mark.slow
@pytest.mark.parametrize("width", [32, 96, 1024, 1152, 2048])
@pytest.mark.parametrize("rows", [1, 10, 51, 563])
@pytest.mark.parametrize("form", ["first", "residual", "modulated", "by token", "split", "rounded parts"])
def test_residual_rms_norm(width: int, rows: int, form: str) -> None:
    if not ON_GPU and rows > 51:
        rows = 5
    x, scale = random(rows, width, outliers=True), random(width, dtype=torch.float32)
    y = None if form == "first" else random(rows, width)
    gate, shift = None, None
    if form in ("modulated", "by token"):
        size = (width,) if form == "modulated" else (rows, width)
        gate, scale, shift = (random(*size, dtype=torch.float32) for _ in range(3))
    given = y
    if form == "split":
        assert y is not None
        parts = random(2, rows, width, dtype=torch.float32)
        given = torch.cat((parts, (y.float() - parts.sum(0))[None]))
    exact_y = None if y is None else y.float()
    if form == "rounded parts":
        given = random(4, rows, width)
        exact_y = given.float().sum(0)
        y = exact_y.to(DTYPE)
    poison_allocator()
    ours = norms.residual_rms_norm(x, given, gate, scale, shift, 1e-6)
    reference = plain.residual_rms_norm(x, y, gate, scale, shift, 1e-6)
    exact_gate = None if gate is None else gate.to(DTYPE).float()
    exact = plain.residual_rms_norm(x.float(), exact_y, exact_gate, scale, shift, 1e-6)
    for a, b, c in zip(ours, reference, exact, strict=True):
        assert_as_good(a, b, c)


@pytest.mark.parametrize("width", [64, 128, 1152])
@pytest.mark.parametrize("rows", [1, 256, 512])
@pytest.mark.parametrize("residual", [False, True])
def test_residual_layer_norm(width: int, rows: int, residual: bool) -> None:
    if not ON_GPU and rows > 1:
        rows = 5
    x, y = random(rows, width, outliers=True) + 3, random(rows, width) if residual else None
    weight, bias = random(width), random(width)
    poison_allocator()
    ours = norms.residual_layer_norm(x, y, weight, bias, 1e-6)
    reference = plain.residual_layer_norm(x, y, weight, bias, 1e-6)
    exact = plain.residual_layer_norm(x.float(), None if y is None else y.float(), weight.float(), bias.float(), 1e-6)
    for a, b, c in zip(ours, reference, exact, strict=True):
        assert_as_good(a, b, c)


@pytest.mark.parametrize("shape", [(3, 256), (10, 8192), (1, 96), (5, 2 * 4304)])
def test_geglu(shape: tuple[int, int]) -> None:
    x = random(*shape, outliers=True)
    poison_allocator()
    assert_as_good(activations.geglu(x), plain.geglu(x), plain.geglu(x.float()))


@pytest.mark.parametrize(("head_dim", "heads"), [(16, 8), (32, 8), (256, 8), (256, 0), (64, 3)])
@pytest.mark.parametrize("tokens", [1, 11, 563])
def test_rope_split(head_dim: int, heads: int, tokens: int) -> None:
    if not ON_GPU:
        tokens = min(tokens, 11)
    qkv = random(tokens, (heads + 2) * head_dim, outliers=True)
    cos, sin = (t[0, 0] for t in rope_tables(torch.arange(7, 7 + tokens)[None], head_dim, 1e4))
    cos, sin = cos.to(DEVICE), sin.to(DEVICE)

    def cache(dtype: torch.dtype) -> tuple[Tensor, Tensor]:
        whole = torch.full((2, tokens + 2, head_dim), torch.nan, dtype=dtype, device=DEVICE)
        return whole[0, 1:-1], whole[1, 1:-1]

    ours_k, ours_v = cache(DTYPE)
    reference_k, reference_v = cache(DTYPE)
    exact_k, exact_v = cache(torch.float32)
    poison_allocator()
    ours_q = rope.rope_split(qkv, cos, sin, ours_k, ours_v)
    reference_q = plain.rope_split(qkv, cos, sin, reference_k, reference_v)
    exact_q = plain.rope_split(qkv.float(), cos, sin, exact_k, exact_v)
    if heads:
        assert_as_good(ours_q, reference_q, exact_q)
    assert_as_good(ours_k, reference_k, exact_k)
    assert torch.equal(ours_v, reference_v)
    base = ours_k._base
    assert base is not None and bool(base[:, [0, -1]].isnan().all()), "wrote outside its rows"


@pytest.mark.parametrize(("heads", "head_dim"), [(4, 16), (4, 32), (16, 72), (2, 24)])
@pytest.mark.parametrize(("images", "tokens"), [(1, 256), (3, 256), (2, 50)])
def test_vision_attention(heads: int, head_dim: int, images: int, tokens: int) -> None:
    if not ON_GPU:
        images, tokens, heads = min(images, 2), min(tokens, 50), min(heads, 2)
    qkv = random(images * tokens, 3 * heads * head_dim)
    qkv[:, ::17] *= 8
    poison_allocator()
    ours = attention.vision_attention(qkv, images, heads)
    assert_as_good(ours, plain.vision_attention(qkv, images, heads), plain.vision_attention(qkv.float(), images, heads))


def prefix_problem(
    heads: int, head_dim: int, slots: int, length: int
) -> tuple[tuple[Tensor, Tensor, Tensor, Tensor], Tensor, Tensor]:
    """Queries, keys, values (NaN beyond the length) and the length; what the twin makes of them, and float32."""
    q, k, v = random(slots * heads, head_dim), random(slots, head_dim), random(slots, head_dim)
    q[:, ::5] *= 8
    k[:, ::7] *= 8
    on_device = torch.tensor([length], device=DEVICE)
    reference = plain.attention(q, k, v, on_device, slots, heads)
    exact = plain.attention(q.float(), k.float(), v.float(), on_device, slots, heads)
    k[length:], v[length:] = torch.nan, torch.nan
    poison_allocator()
    return (q, k, v, on_device), reference, exact


@pytest.mark.parametrize(("heads", "head_dim"), [(8, 16), (8, 32), (8, 256), (4, 48)])
@pytest.mark.parametrize(("slots", "length"), [(16, 1), (272, 261), (560, 560), (816, 803)])
def test_prefix_attention_reads_nothing_beyond_the_length(heads: int, head_dim: int, slots: int, length: int) -> None:
    if not ON_GPU and slots > 16:
        slots, length, heads = slots // 8, length // 8, 2
    inputs, reference, exact = prefix_problem(heads, head_dim, slots, length)
    assert_as_good(attention.prefix_attention(*inputs, heads), reference, exact)


@on_hopper
@pytest.mark.parametrize(("keys", "warpgroups"), [(0, 0), (64, 1), (128, 1), (64, 2), (128, 2)])
@pytest.mark.parametrize(("heads", "head_dim"), [(4, 16), (4, 32), (16, 72), (2, 24), (3, 64)])
@pytest.mark.parametrize(("images", "tokens"), [(1, 256), (3, 256), (2, 50)])
def test_vision_attention_on_hopper(
    heads: int, head_dim: int, images: int, tokens: int, keys: int, warpgroups: int
) -> None:
    qkv = random(images * tokens, 3 * heads * head_dim)
    qkv[:, ::17] *= 8
    poison_allocator()
    tile = attention_hopper.AttentionTile(head_dim, keys, warpgroups) if keys else None
    ours = attention_hopper.vision_attention(qkv, images, heads, tile=tile)
    assert_as_good(ours, plain.vision_attention(qkv, images, heads), plain.vision_attention(qkv.float(), images, heads))


@on_hopper
@pytest.mark.parametrize(
    ("keys", "warpgroups", "queries"), [(64, 1, 1), (64, 2, 2), (128, 2, 1), (128, 3, 2), (64, 4, 2)]
)
@pytest.mark.parametrize(("heads", "head_dim"), [(4, 16), (16, 72), (2, 24)])
@pytest.mark.parametrize(("images", "tokens"), [(1, 256), (16, 256), (2, 50), (40, 116), (3, 1024)])
def test_wide_vision_attention_on_hopper(
    heads: int, head_dim: int, images: int, tokens: int, keys: int, warpgroups: int, queries: int
) -> None:
    """From fewer units of rows than multiprocessors to several for each."""
    qkv = random(images * tokens, 3 * heads * head_dim)
    qkv[:, ::17] *= 8
    poison_allocator()
    tile = attention_hopper.AttentionTile(head_dim, keys, warpgroups, wide=True, queries=queries)
    ours = attention_hopper.vision_attention(qkv, images, heads, tile=tile)
    assert_as_good(ours, plain.vision_attention(qkv, images, heads), plain.vision_attention(qkv.float(), images, heads))
    for _ in range(5):
        assert torch.equal(attention_hopper.vision_attention(qkv, images, heads, tile=tile), ours)


@on_hopper
@pytest.mark.parametrize("warpgroups", [0, 1, 2])
@pytest.mark.parametrize(("heads", "head_dim"), [(8, 16), (8, 32), (8, 256), (4, 48)])
@pytest.mark.parametrize(
    ("slots", "length"), [(16, 1), (272, 261), (304, 64), (560, 560), (560, 547), (816, 803), (976, 960)]
)
def test_prefix_attention_on_hopper(heads: int, head_dim: int, slots: int, length: int, warpgroups: int) -> None:
    inputs, reference, exact = prefix_problem(heads, head_dim, slots, length)
    tile = attention_hopper.AttentionTile(head_dim, 64, warpgroups) if warpgroups else None
    first = attention_hopper.prefix_attention(*inputs, heads, tile=tile)
    assert_as_good(first, reference, exact)
    for _ in range(5):
        assert torch.equal(attention_hopper.prefix_attention(*inputs, heads, tile=tile), first)


@on_hopper
def test_prefix_attention_ends_without_keys() -> None:
    """Graphs are captured before there is an observation."""
    q, k = random(64 * 8, 256), random(64, 256)
    attention_hopper.prefix_attention(q, k, k, torch.tensor([0], device=DEVICE), 8)
    torch.cuda.synchronize()


@on_hopper
def test_nan_in_a_query_shows() -> None:
    q, k, v = random(16 * 8, 256), random(16, 256), random(16, 256)
    q[3, 5] = torch.nan
    ours = attention_hopper.prefix_attention(q, k, v, torch.tensor([16], device=DEVICE), 8).view(-1, 256)
    assert bool(ours[3].isnan().all()) and bool(ours[:3].isfinite().all()) and bool(ours[4:].isfinite().all())


@pytest.mark.parametrize("state_token", [False, True])
@pytest.mark.parametrize(("suffix", "slots", "length"), [(10, 560, 549), (51, 16, 1), (1, 272, 272), (7, 0, 0)])
def test_masked_softmax(suffix: int, slots: int, length: int, state_token: bool) -> None:
    heads = 8 if ON_GPU else 2
    logits = random(suffix * heads, slots + suffix, dtype=torch.float32) * 30
    on_device = torch.tensor([length], device=DEVICE)
    args = (on_device, slots, heads, state_token, 0.25)
    exact = plain.masked_softmax(logits, *args, torch.float32)
    reference = plain.masked_softmax(logits, *args, DTYPE)
    logits[:, length:slots] = torch.nan
    poison_allocator()
    assert_as_good(attention.masked_softmax(logits, *args, DTYPE), reference, exact)


@pytest.mark.parametrize("dtype", [torch.uint8, torch.float32])
@pytest.mark.parametrize("images", [1, 3])
def test_patch_rows_are_exact(images: int, dtype: torch.dtype) -> None:
    size = 224 if ON_GPU else 28
    g = torch.Generator().manual_seed(images)
    camera_images = torch.randint(0, 256, (images, size, size, 3), generator=g).to(DEVICE, dtype)
    poison_allocator()
    ours, reference = embedding.patch_rows(camera_images, 14), plain.patch_rows(camera_images, 14)
    torch.testing.assert_close(ours, reference, atol=1.2e-7, rtol=0)


@pytest.mark.skipif(not ON_GPU, reason="a product of the library's with float32 results needs a GPU")
@pytest.mark.parametrize("images", [1, 3])
@pytest.mark.parametrize("dtype", [torch.uint8, torch.float32])
def test_embed_patches_loses_nothing_of_float32(images: int, dtype: torch.dtype) -> None:
    g = torch.Generator().manual_seed(images)
    camera_images = torch.randint(0, 256, (images, 224, 224, 3), generator=g).to(DEVICE, torch.uint8)
    given = camera_images if dtype == torch.uint8 else camera_images.float() / 255 * 2 - 1
    weight, position = random(1152, 588, dtype=torch.float32), random(256, 1152, dtype=torch.float32)
    ours = EmbedPatches()(given, weight, position, torch.float32)
    normalised = camera_images.double() / 255 * 2 - 1
    exact = plain.embed_patches(normalised, weight.double(), position.double(), torch.float64)
    assert (ours - exact).square().mean().sqrt() < 1e-5 * exact.square().mean().sqrt()


def test_odd_rows_are_255_times_the_patches() -> None:
    camera_images = torch.randint(0, 256, (2, 28, 28, 3), dtype=torch.uint8, generator=torch.Generator().manual_seed(3))
    camera_images = camera_images.to(DEVICE)
    ours = embedding.odd_rows(camera_images, 14, DTYPE).float()
    twice = plain.patch_rows(camera_images, 14).repeat(1, 2) * 255
    torch.testing.assert_close(ours, twice.round(), atol=0, rtol=0)


def test_add_position() -> None:
    x, position = random(6, 96, dtype=torch.float32), random(3, 96, dtype=torch.float32)
    exact = x + position.repeat(2, 1)
    assert_as_good(embedding.add_position(x, position, DTYPE), exact.to(DTYPE), exact)


@pytest.mark.parametrize("width", [96, 2048])
def test_embed_prompt_is_exact(width: int) -> None:
    table, tokens = random(300, width), torch.tensor([0, 299, 5, 5, 17], device=DEVICE)
    ours, reference = (torch.full((5, width), torch.nan, dtype=DTYPE, device=DEVICE) for _ in range(2))
    embedding.embed_prompt(tokens, table, ours)
    plain.embed_prompt(tokens, table, reference)
    assert torch.equal(ours, reference)


TILES = [
    Tile(3, 192),
    Tile(2, 256, cluster_n=2),
    Tile(2, 128, cluster_m=2, cluster_n=2),
    Tile(1, 80),
]


@on_hopper
@pytest.mark.parametrize("tile", TILES)
@pytest.mark.parametrize("epilogue", ["plain", "bias", "gelu", "geglu"])
@pytest.mark.parametrize(("m", "n", "k"), [(560, 2048, 1152), (1, 8, 8), (203, 4304, 72), (816, 264, 4304)])
def test_matmul(m: int, n: int, k: int, epilogue: Epilogue, tile: Tile) -> None:
    x, weight = random(m, k, outliers=True), random(2 * n if epilogue == "geglu" else n, k)
    bias = random(n) if epilogue in ("bias", "gelu") else None

    def after(y: Tensor) -> Tensor:
        return plain.gelu(y) if epilogue == "gelu" else plain.geglu(y) if epilogue == "geglu" else y

    reference = after(plain.linear(x, weight, bias))
    exact = after(plain.linear(x.float(), weight.float(), None if bias is None else bias.float()))
    out = torch.full((m, n), torch.nan, device=DEVICE, dtype=DTYPE)
    assert_as_good(matmul(x, weight, tile, epilogue, bias, out), reference, exact)


@on_hopper
@pytest.mark.parametrize("shape", tiles.VISION_TILES)
def test_tuned_products_of_the_vision_tower(shape: tuple[int, int, int]) -> None:
    m, n, k = shape
    x, weight, bias = random(m, k, outliers=True), random(n, k), random(n)
    poison_allocator()
    ours = products.tuned_residual_linear(x, weight, bias)
    reference, exact = plain.linear(x, weight, bias), plain.linear(x.float(), weight.float(), bias.float())
    assert_as_good((ours.sum(0) if ours.dim() == 3 else ours).to(DTYPE), reference, exact)
    if tiles.VISION_TILES[shape].splits == 1:
        assert_as_good(products.tuned_linear_gelu(x, weight, bias), plain.gelu(reference), plain.gelu(exact))


@on_hopper
@pytest.mark.parametrize("rows", [11, 304, 352, 560, 816, 976])
def test_tuned_geglu(rows: int) -> None:
    x, weight = random(rows, 2048, outliers=True), random(2 * 16384, 2048) / 45
    poison_allocator()
    reference = plain.geglu(plain.linear(x, weight))
    assert_as_good(
        products.tuned_linear_geglu(x, weight), reference, plain.geglu(plain.linear(x.float(), weight.float()))
    )


@on_hopper
@pytest.mark.parametrize("splits", [1, 3, 4])
@pytest.mark.parametrize("with_bias", [False, True])
def test_partial_sums_add_up(splits: int, with_bias: bool) -> None:
    x, weight, bias = random(531, 4304), random(1152, 4304), random(1152) if with_bias else None
    poison_allocator()
    parts = matmul(x, weight, Tile(2, 144, splits=splits), "partial", bias)
    assert parts.shape == (splits, 531, 1152) and parts.dtype == torch.float32
    exact = plain.linear(x.float(), weight.float(), None if bias is None else bias.float())
    torch.testing.assert_close(parts.sum(0), exact, atol=2e-3, rtol=1e-4)


@on_hopper
@pytest.mark.parametrize("tile", [Tile(3, 192, splits=4), Tile(2, 256, splits=3), Tile(1, 80, splits=2), Tile(2, 136)])
@pytest.mark.parametrize(("m", "n", "k"), [(560, 2048, 16384), (203, 1160, 4304), (1, 8, 1152)])
def test_parts_in_bfloat16_are_the_partial_sums_rounded(m: int, n: int, k: int, tile: Tile) -> None:
    x, weight = random(m, k, outliers=True), random(n, k)
    out = torch.full((tile.splits, m, n), torch.nan, device=DEVICE, dtype=DTYPE)
    ours = matmul(x, weight, tile, "parts", out=out)
    assert torch.equal(ours, matmul(x, weight, tile, "partial").to(DTYPE))
    assert torch.equal(matmul(x, weight, tile, "parts"), ours)


@on_hopper
@pytest.mark.parametrize("rows", [16, 304, 464, 560, 531, 720, 816, 976])
def test_the_product_behind_geglu(rows: int) -> None:
    x, weight = random(rows, 16384, outliers=True), random(2048, 16384) / 128
    poison_allocator()
    ours = products.tuned_residual_linear(x, weight)
    reference, exact = plain.linear(x, weight), plain.linear(x.float(), weight.float())
    assert_error_at_most_double(ours.float().sum(0) if ours.dim() == 3 else ours, reference, exact)
    assert (ours.dim() == 3) == ((-(-rows // 64) * 64, 2048, 16384) in tiles.PARTS_TILES)


@pytest.mark.parametrize("count", [1, 2, 4])
def test_parts_made_at_once_add_up(count: int) -> None:
    x, weight = random(5, 64), random(24, 64)
    parts = products.parts_at_once(x, weight, count)
    assert parts.shape == (count, 5, 24) and parts.is_contiguous()
    exact = plain.linear(x.float(), weight.float())
    assert_error_at_most_double(parts.float().sum(0), exact.to(torch.bfloat16), exact)


@on_hopper
def test_matmul_waits_for_the_kernel_before_it() -> None:
    """Its blocks start early; a long chain in one graph, each product reading the last one's result."""
    weights = [random(1024, 1024) / 32 for _ in range(8)]
    start = random(512, 1024)

    scale = torch.ones(1024, device=DEVICE)

    def ours(y: Tensor, weight: Tensor) -> Tensor:
        product = matmul(y, weight, Tile(2, 128), "plain")
        return norms.residual_rms_norm(product, None, None, scale, None, 1e-6)[1]

    def reference(y: Tensor, weight: Tensor) -> Tensor:
        return plain.residual_rms_norm(plain.linear(y, weight), None, None, scale, None, 1e-6)[1]

    def chain(step: Callable[[Tensor, Tensor], Tensor]) -> Tensor:
        y = start
        for weight in weights:
            y = step(y, weight)
        return y

    first = chain(ours)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        captured = chain(ours)
    for _ in range(20):
        captured.fill_(torch.nan)
        graph.replay()
        assert torch.equal(captured, first)
    assert (first.float() - chain(reference).float()).abs().mean() < 0.05


@pytest.mark.skipif(not ON_GPU, reason="cuBLAS's epilogue needs a GPU")
@pytest.mark.parametrize(("m", "n", "k"), [(512, 4304, 1152), (256, 128, 64), (3, 64, 32)])
def test_linear_gelu_is_tanhs(m: int, n: int, k: int) -> None:
    x, weight, bias = random(m, k, outliers=True), random(n, k), random(n)
    exact = plain.gelu(plain.linear(x.float(), weight.float(), bias.float()))
    assert_as_good(portable_products.linear_gelu(x, weight, bias), plain.gelu(plain.linear(x, weight, bias)), exact)


@pytest.mark.parametrize(
    ("shape", "dtype"),
    [((2, 28, 28, 3), torch.uint8), *((shape, torch.float32) for shape in ((2, 28, 28, 3), (10, 32), (1,)))],
)
def test_a_transfer_brings_all_and_nothing_else(shape: tuple[int, ...], dtype: torch.dtype) -> None:
    """On a GPU from pinned memory of the host and back to it. Whole words of four bytes."""
    host = torch.randint(0, 256, shape).to(dtype)
    host = host.pin_memory() if ON_GPU else host
    on_device = torch.zeros(2, *shape, dtype=dtype, device=DEVICE)
    back = torch.zeros(shape, dtype=dtype, pin_memory=ON_GPU)
    reference = torch.zeros_like(on_device)
    transfer.transfer(host, on_device[0])
    plain.transfer(host, reference[0])
    transfer.transfer(on_device[0], back)
    if ON_GPU:
        torch.cuda.synchronize()
    assert torch.equal(on_device, reference) and torch.equal(back, host)
