"""The expert's kernels for few tokens, forward and back, each against its twin; together against autograd."""

from typing import Any

import pytest
import torch
from conftest import gpu_or_interpreter
from test_kernels_ops import DEVICE, DTYPE, ON_GPU, assert_as_good, poison_allocator, random
from torch import Tensor

from turbopi.config import GemmaConfig
from turbopi.kernels.backward import PLAIN_BACKWARD
from turbopi.kernels.portable.vjp import attention
from turbopi.kernels.portable.vjp.ops import BETWEEN_PRODUCTS, FEW_TOKENS, backward_form
from turbopi.kernels.portable.vjp.tiles import LEAST_ROWS, attention_span, row_block, streaming
from turbopi.models.pi0.layers import rope_tables

pytestmark = gpu_or_interpreter()
FULL, SMALL, NARROW = GemmaConfig(1024, 4096), GemmaConfig(64, 160, 1, 3, 1, 32), GemmaConfig(32, 64, 1, 8, 1, 16)
TOKENS = [1, 10, 16, 17, 50, 64]
SIZES = [(SMALL, 10), (SMALL, 50), (NARROW, 17), (NARROW, 1)]
if ON_GPU:
    SIZES += [(FULL, tokens) for tokens in TOKENS]


def cdiv(size: int, by: int) -> int:
    return -(-size // by)


def whole(product: Tensor) -> Tensor:
    """A product that may be parts."""
    return product.float().sum(0).to(DTYPE) if product.dim() == 3 else product


def as_its_reference(name: str, *arguments: Any) -> None:
    """The kernel against its twin, both against the twin in float32. Outputs of several are compared one by one."""
    wide = [one.float() if isinstance(one, Tensor) and one.is_floating_point() else one for one in arguments]
    reference, exact = getattr(PLAIN_BACKWARD, name)(*arguments), getattr(PLAIN_BACKWARD, name)(*wide)
    poison_allocator()
    ours = getattr(FEW_TOKENS, name)(*arguments)
    for found, expected, right in zip(
        *((x if isinstance(x, tuple) else (x,)) for x in (ours, reference, exact)), strict=True
    ):
        assert_as_good(whole(found), expected, right)


@pytest.mark.parametrize(("expert", "tokens"), SIZES)
def test_feed_forward_and_back(expert: GemmaConfig, tokens: int) -> None:
    d, f = expert.width, expert.mlp_dim
    gate_up, down = random(2 * f, d) / d**0.5, random(d, f) / f**0.5
    as_its_reference("gate_up", random(tokens, d, outliers=True), gate_up)
    as_its_reference("down", random(tokens, f, outliers=True), down)
    product = random(tokens, 2 * f)
    product[0, 0], product[0, 1] = 30, -30  # where tanh is flat
    as_its_reference("down_vjp", random(tokens, d), down, product)
    as_its_reference("gate_up_vjp", random(tokens, 2 * f, outliers=True), gate_up)
    as_its_reference("out_vjp", random(tokens, d), random(d, expert.num_heads * expert.head_dim) / d**0.5)


def rope(tokens: int, head_dim: int) -> list[Tensor]:
    tables = rope_tables(torch.arange(600, 600 + tokens)[None], head_dim, 1e4)
    return [one[0, 0].contiguous().to(DEVICE) for one in tables]


@pytest.mark.parametrize(("expert", "tokens"), SIZES)
def test_queries_keys_and_values(expert: GemmaConfig, tokens: int) -> None:
    n, dim = expert.num_heads, expert.head_dim
    x, weight, turn = random(tokens, expert.width), random((n + 2) * dim, expert.width), rope(tokens, dim)

    def of(ops: Any, *given: Tensor) -> list[Tensor]:
        k, v = (torch.full((tokens, dim), torch.nan, device=DEVICE, dtype=given[0].dtype) for _ in range(2))
        poison_allocator()
        return [ops.qkv(*given, *turn, k, v), k, v]

    ours, reference, exact = (
        of(FEW_TOKENS, x, weight),
        of(PLAIN_BACKWARD, x, weight),
        of(PLAIN_BACKWARD, x.float(), weight.float()),
    )
    for found, expected, right in zip(ours, reference, exact, strict=True):
        assert_as_good(found, expected, right)


def attention_and_back(ops: Any, given: tuple[Tensor, ...], turn: list[Tensor], seen: Any) -> tuple[Tensor, Tensor]:
    """The product behind attention, and what comes back to the norm before it.

    given: q, k, v; the matrices `out` and `qkv`; what comes back to attention's result
    """
    q, k, v, out, qkv, d = given
    poison_allocator()
    attended, kept = ops.attention(q, k, v, *seen)
    y = ops.out(attended, out)
    poison_allocator()  # and kernels between: `attention_vjp` may not follow `out` at once
    gradients = ops.attention_vjp(kept, d, k, v, *seen)
    return whole(y), whole(ops.qkv_vjp(gradients, *turn, qkv))


@pytest.mark.slow
@pytest.mark.parametrize(("expert", "tokens"), SIZES)
@pytest.mark.parametrize("state_token", [False, True])
@pytest.mark.parametrize(("length", "slots"), [(37, 40), (560, 566), (200, 566)])
def test_attention_and_back(expert: GemmaConfig, tokens: int, state_token: bool, length: int, slots: int) -> None:
    """Keys between the prefix's end and the suffix are finite and large; whole splits of them are seen by nobody."""
    n, dim, width = expert.num_heads, expert.head_dim, expert.width
    if not ON_GPU and slots > 100 and tokens > 20:
        pytest.skip("minutes in the interpreter, and smaller cases have all its ways")
    q, k, v = random(tokens * n, dim), random(slots + tokens, dim), random(slots + tokens, dim)
    k[length:slots], v[length:slots] = 100, 1e4
    out, qkv = random(width, n * dim) / (n * dim) ** 0.5, random((n + 2) * dim, width) / (n * dim) ** 0.5
    d, turn = random(tokens, n * dim), rope(tokens, dim)
    seen = (torch.tensor([length], device=DEVICE), slots, n, state_token)
    given = (q, k, v, out, qkv, d)
    wide = tuple(one.float() for one in given)
    ours, reference = (attention_and_back(ops, given, turn, seen) for ops in (FEW_TOKENS, PLAIN_BACKWARD))
    exact = attention_and_back(PLAIN_BACKWARD, wide, turn, seen)
    for found, expected, right in zip(ours, reference, exact, strict=True):
        assert_as_good(found, expected, right)


@pytest.mark.slow
@pytest.mark.parametrize(("expert", "tokens"), SIZES)
@pytest.mark.parametrize("state_token", [False, True])
def test_what_attention_keeps_of_all_layers_at_once(expert: GemmaConfig, tokens: int, state_token: bool) -> None:
    """As of one at a time, from a cache whose layers lie apart."""
    n, dim, slots, length, layers = expert.num_heads, expert.head_dim, 140, 131, 3
    q, cache = random(layers, tokens * n, dim), random(2, layers, slots + tokens + 7, dim)
    cache[:, :, length:slots] = 100
    k, v = cache[:, :, : slots + tokens]
    seen = (torch.tensor([length], device=DEVICE), slots, n, state_token)
    poison_allocator()
    for i, kept in enumerate(attention.kept_attention(q, k, v, *seen)):
        attended, expected = FEW_TOKENS.attention(q[i], k[i], v[i], *seen)
        FEW_TOKENS.out(attended, random(expert.width, n * dim))
        assert kept.q.data_ptr() == q[i].data_ptr()
        torch.testing.assert_close(kept.lse, expected.lse, atol=1e-5, rtol=1e-5)
        exact = PLAIN_BACKWARD.attention(q[i].float(), k[i].float(), v[i].float(), *seen)[0].view(q[i].shape)
        assert_as_good(kept.attended, expected.attended, exact)


@pytest.mark.slow
@pytest.mark.parametrize("tokens", [3, 20])
def test_attention_equals_autograd(tokens: int) -> None:
    """In float64, of everything between q|k|v and the product behind attention."""
    n, dim, width, slots, length = 3, 32, 64, 21, 18
    q, k, v = random(tokens * n, dim), random(slots + tokens, dim), random(slots + tokens, dim)
    out, d_y = random(width, n * dim), random(tokens, width)
    qkv = torch.eye((n + 2) * dim, device=DEVICE, dtype=DTYPE)  # lets the gradients through
    seen = (torch.tensor([length], device=DEVICE), slots, n, False)
    upright = [torch.ones(tokens, dim // 2, device=DEVICE), torch.zeros(tokens, dim // 2, device=DEVICE)]
    given = (q, k, v, out, qkv, (d_y.float() @ out.float()).to(DTYPE))
    found = attention_and_back(FEW_TOKENS, given, upright, seen)[1]

    q, k, v, out, d_y, found = (one.double().cpu() for one in (q, k, v, out, d_y, found))
    wide = [one.clone().requires_grad_() for one in (q, k[slots:], v[slots:])]
    keys, values = (torch.cat((x[:slots], own)) for x, own in ((k, wide[1]), (v, wide[2])))
    logits = wide[0] @ keys.T * dim**-0.5
    logits[:, length:slots] = -torch.inf
    y = (logits.softmax(-1) @ values).view(tokens, -1) @ out.T
    d_q, d_k, d_v = torch.autograd.grad(y, wide, d_y)
    exact = torch.cat((d_q.view(tokens, -1), d_k, d_v), 1)
    assert float((found - exact).norm() / exact.norm()) < (2e-2 if ON_GPU else 1e-5)


@pytest.mark.parametrize("parts", [1, 4])
def test_a_norm_adds_up_parts(parts: int) -> None:
    x, scale, d = random(7, 96), random(7, 96, dtype=torch.float32), random(parts, 7, 96, dtype=torch.float32)
    for ops in (FEW_TOKENS, PLAIN_BACKWARD):
        found, expected = (ops.rms_norm_vjp(one, x.float(), scale, 1e-6, None, None)[0] for one in (d, d.sum(0)))
        torch.testing.assert_close(found, expected, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("tokens", [10, 16, 17, 50, 64])
def test_hopper_has_all_programs_of_attentions_way_back_at_once(tokens: int) -> None:
    """One fills a multiprocessor, of which there are 132; two cameras and a prompt."""
    rows, keys, span = tokens * 8, 2 * 256 + 64 + tokens, attention_span((9, 0))
    programs = cdiv(rows, row_block(tokens)) * cdiv(keys, span) + cdiv(rows, span) * cdiv(tokens, LEAST_ROWS)
    assert programs <= 132


@pytest.mark.parametrize("tokens", [1, 10, 16])
def test_few_tokens_take_32_columns(tokens: int) -> None:
    one, two = (streaming((9, 0), tokens, 4096, 1024, 64, matrices=n) for n in (1, 2))
    assert one.columns == 2 * two.columns == 32 and one.stages == two.stages == 4


@pytest.mark.parametrize(("expert", "tokens"), SIZES)
def test_the_ends_of_a_guided_step(expert: GemmaConfig, tokens: int) -> None:
    actions, width = 12, expert.width
    f32 = torch.float32
    x_t, v_t, target, times, weights = (random(tokens, n, dtype=f32) for n in (actions, actions, actions, 1, 1))
    out, into = random(actions, width, dtype=f32), random(width, actions, dtype=f32)
    d_tokens, gain, steps = (random(tokens, n, dtype=f32) for n in (width, 1, 1))
    steps[0] = 0
    results = []
    for ops in (FEW_TOKENS, PLAIN_BACKWARD):
        v, next_x = v_t.clone(), torch.full_like(x_t, torch.nan)
        error, d_out = ops.pull(x_t, v, times[:, 0], target, weights, out, torch.float32)
        poison_allocator()
        ops.move(d_tokens, into, x_t, v, error, gain[:, 0], steps[:, 0], next_x)
        results.append((error, d_out, v, next_x))
    assert torch.equal(results[0][3][0], x_t[0]), "what is held stays to the last bit"
    for found, expected in zip(*results, strict=True):
        torch.testing.assert_close(found, expected, atol=1e-3, rtol=1e-4)


@pytest.mark.parametrize("gated", [False, True])
def test_a_norm_takes_rows_of_a_table(gated: bool) -> None:
    x, d, rows = random(7, 96), random(7, 96), torch.tensor([2, 0, 1, 2, 2, 1, 0], device=DEVICE, dtype=torch.int32)
    scale, _, gate = random(3, 5, 3, 96, dtype=torch.float32)[:, 2].movedim(1, 0).unbind(0)
    gates = gate if gated else None
    expected = FEW_TOKENS.rms_norm_vjp(d, x, scale[rows], 1e-6, None, None if gates is None else gates[rows])
    for ops in (FEW_TOKENS, PLAIN_BACKWARD):
        found = ops.rms_norm_vjp(d, x, scale, 1e-6, None, gates, rows)
        torch.testing.assert_close(found[0], expected[0], atol=1e-5, rtol=1e-5)
        assert gates is None or torch.testing.assert_close(found[1], expected[1], atol=2e-2, rtol=2e-2) is None


def test_other_sizes_keep_the_librarys_products() -> None:
    assert backward_form(FULL, 64) is FEW_TOKENS and backward_form(NARROW, 1) is FEW_TOKENS
    assert backward_form(FULL, 65) is BETWEEN_PRODUCTS
    for odd in (GemmaConfig(1000, 4096), GemmaConfig(1024, 4100), GemmaConfig(64, 64, 1, 4, 1, 24)):
        assert backward_form(odd, 10) is BETWEEN_PRODUCTS
