"""Back through the action expert: each twin equals autograd, each Triton kernel its twin."""

from collections.abc import Callable
from types import ModuleType

import pytest
import torch
from conftest import gpu_or_interpreter
from test_kernels_ops import DEVICE, DTYPE, assert_as_good, poison_allocator, random
from torch import Tensor

from turbopi.kernels import backward as references
from turbopi.kernels import plain
from turbopi.kernels.portable import backward
from turbopi.models.pi0.layers import rope_tables

pytestmark = gpu_or_interpreter()
SIZES = [(1, 8), (10, 1024), (7, 96)]


def autograd(function: Callable[..., Tensor], d_out: Tensor, *inputs: Tensor) -> tuple[Tensor, ...]:
    """The vector-Jacobian product in float64."""
    wide = [one.double().requires_grad_() for one in inputs]
    return torch.autograd.grad(function(*wide), wide, d_out.double())


def close(ours: Tensor, exact: Tensor) -> None:
    torch.testing.assert_close(ours.double(), exact, atol=1e-5 * max(1.0, float(exact.abs().max())), rtol=1e-5)


def as_its_reference(name: str, *arguments: object) -> None:
    """The Triton kernel against its twin on the same numbers, both against the twin in float32."""
    wide = [one.float() if isinstance(one, Tensor) and one.is_floating_point() else one for one in arguments]
    reference, exact = getattr(references, name)(*arguments), getattr(references, name)(*wide)
    poison_allocator()
    ours = getattr(backward, name)(*arguments)
    for found, expected, right in zip(
        *((x if isinstance(x, tuple) else (x,)) for x in (ours, reference, exact)), strict=True
    ):
        if expected is None:
            assert found is None
        else:
            assert_as_good(found, expected, right)


@pytest.mark.parametrize(("tokens", "width"), SIZES)
@pytest.mark.parametrize("by_row", [False, True])
@pytest.mark.parametrize("more", [False, True])
def test_a_norm(tokens: int, width: int, by_row: bool, more: bool) -> None:
    shape = (tokens, width) if by_row else (width,)
    d_normed, x = random(tokens, width), random(tokens, width)
    scale, gate = random(*shape, dtype=torch.float32), random(*shape, dtype=torch.float32)
    d_x = random(tokens, width, dtype=torch.float32)
    given = (d_x, gate) if more else (None, None)
    as_its_reference("rms_norm_vjp", d_normed, x, scale, 1e-6, *given)
    norm = lambda x: x * (x.square().mean(-1, keepdim=True) + 1e-6).rsqrt() * scale.double()  # noqa: E731
    (expected,) = autograd(norm, d_normed, x)
    through, gated = references.rms_norm_vjp(d_normed.float(), x.float(), scale, 1e-6, *given)
    expected = expected + d_x if more else expected
    close(through, expected)
    if gated is not None:
        close(gated, expected * gate)


@pytest.mark.parametrize("back", [references, backward], ids=["reference", "triton"])
@pytest.mark.parametrize("by_row", [False, True])
def test_a_gate_is_rounded_on_the_way_back_as_on_the_way_there(by_row: bool, back: ModuleType) -> None:
    """In bfloat16 1.003 is 1: it changes no bit."""
    ones = torch.ones((5, 64) if by_row else (64,), device=DEVICE)
    d_normed, x = random(5, 64, dtype=torch.bfloat16), random(5, 64, dtype=torch.bfloat16)
    ours, expected = (back.rms_norm_vjp(d_normed, x, ones, 1e-6, None, ones * gate)[1] for gate in (1.003, 1.0))
    assert ours.dtype == torch.bfloat16 and torch.equal(ours, expected)


@pytest.mark.parametrize(("tokens", "hidden"), [(1, 8), (10, 4096), (3, 100)])
def test_geglu(tokens: int, hidden: int) -> None:
    d_hidden, gate_up = random(tokens, hidden), random(tokens, 2 * hidden)
    gate_up[0, 0], gate_up[0, 1] = 30, -30  # where tanh is flat
    as_its_reference("geglu_vjp", d_hidden, gate_up)
    (expected,) = autograd(plain.geglu, d_hidden, gate_up)
    close(references.geglu_vjp(d_hidden.float(), gate_up.float()), expected)


@pytest.mark.parametrize(("rows", "keys"), [(8, 5), (80, 608), (24, 33)])
def test_softmax(rows: int, keys: int) -> None:
    logits, d = random(rows, keys, dtype=torch.float32), random(rows, keys, dtype=torch.float32)
    p = (logits * 0.25).softmax(-1).to(DTYPE)
    as_its_reference("softmax_vjp", p, d, 0.25)
    (expected,) = autograd(lambda x: (x * 0.25).softmax(-1), d, logits)
    close(references.softmax_vjp((logits * 0.25).softmax(-1), d, 0.25), expected)


@pytest.mark.parametrize(("tokens", "heads", "head_dim"), [(1, 1, 8), (10, 8, 256), (7, 4, 16)])
def test_rope(tokens: int, heads: int, head_dim: int) -> None:
    d_q, d_k, d_v = random(tokens * heads, head_dim), random(tokens, head_dim), random(tokens, head_dim)
    cos, sin = (one[0, 0].contiguous() for one in rope_tables(torch.arange(3, 3 + tokens)[None], head_dim, 1e4))
    cos, sin = cos.to(DEVICE), sin.to(DEVICE)
    as_its_reference("rope_vjp", d_q, d_k, d_v, cos, sin)

    def split(qkv: Tensor) -> Tensor:
        x, half = qkv.view(tokens, heads + 2, head_dim), head_dim // 2
        first, second = x[..., :half], x[..., half:]
        c, s = cos.double()[:, None], sin.double()[:, None]
        turned = torch.cat((first * c - second * s, second * c + first * s), -1)
        return torch.cat((turned[:, :-1].reshape(-1, head_dim), x[:, -1]))

    # queries of all tokens, head by head, with the key behind them: so order the gradients
    d_out = torch.cat((torch.cat((d_q.view(tokens, heads, -1), d_k[:, None]), 1).view(-1, head_dim), d_v))
    (expected,) = autograd(split, d_out, random(tokens, (heads + 2) * head_dim))
    close(references.rope_vjp(d_q.float(), d_k.float(), d_v.float(), cos, sin), expected)
