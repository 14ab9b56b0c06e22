"""The engine's vector-Jacobian product through the action expert equals autograd's through the reference."""

import dataclasses
from collections.abc import Callable
from typing import Any, Literal

import pytest
import torch
import torch.nn.functional as F
from conftest import golden_cases, golden_model
from torch import Tensor

from turbopi import backends
from turbopi.config import Kind
from turbopi.engine.backward import Expert, jacobian_step, jacobian_velocity, suffix_vjp
from turbopi.engine.compiled import compiled
from turbopi.engine.conditioned import Conditioned
from turbopi.engine.forward import expert_output, project, rope_of_all_positions
from turbopi.engine.loops import ConditionedLoop
from turbopi.engine.weights import pack
from turbopi.kernels.backward import PLAIN as PIECES
from turbopi.kernels.backward import PLAIN_BACKWARD, rope_vjp
from turbopi.kernels.interface import BackwardOps, KeptStep, Ops
from turbopi.kernels.plain import PLAIN
from turbopi.models.pi0.denoise import suffix_mask, suffix_rope, time_embedding
from turbopi.models.pi0.kv_cache import KVCache
from turbopi.models.pi0.reference import Pi0Model

CASES: dict[Kind, str] = {"pi05": "b_third_masked", "pi0": "p0_pi0_state"}
KINDS: list[Kind] = ["pi05", "pi0"]
Times = Literal["one time", "by token"]
Evaluation = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]  # x_t [H, A], d_v [H, A] -> v, what comes back to x_t
POISON = 1e4  # in cache rows that aren't valid
BEHIND, BETWEEN = 5, 3  # rows beyond the valid prefix, and between the prefix's slots and the suffix


@dataclasses.dataclass(frozen=True)
class Problem:
    """One evaluation of the action expert: model, prefix, times."""

    model: Pi0Model
    cache: KVCache  # without padding
    time_embs: Tensor  # [1, D], or [1, H, D] by action
    horizon: int

    @classmethod
    def of(cls, kind: Kind, times: Times, horizon: int = 10) -> "Problem":
        model, case = golden_model(kind), golden_cases()[CASES[kind]]
        cache = model.prefix(case.observation).row(0)
        if cache.mask is not None:
            cache = dataclasses.replace(
                cache, k=cache.k[:, :, :, cache.mask[0]], v=cache.v[:, :, :, cache.mask[0]], mask=None
            )
        t = torch.tensor([0.6]) if times == "one time" else torch.linspace(0, 1, horizon)
        time_embs = time_embedding(t.numpy(), model.config.expert.width)
        return cls(model, cache, time_embs if times == "one time" else time_embs[None], horizon)

    def to(self, dtype: torch.dtype | Callable[[str], torch.dtype]) -> "Problem":
        of = dtype if callable(dtype) else lambda name: dtype
        state = {name: one.to(of(name)) for name, one in self.model.state_dict().items()}
        k, v = self.cache.k.to(of("k")), self.cache.v.to(of("v"))
        cache = dataclasses.replace(self.cache, k=k, v=v, state=self.cache.state.to(of("action_")))
        model = Pi0Model.from_state(self.model.config, state)
        return Problem(model, cache, self.time_embs.to(of("action_")), self.horizon)

    @property
    def cond(self) -> Tensor:
        return self.model.time_condition(self.time_embs) if self.model.config.kind == "pi05" else self.time_embs

    def chunk(self, seed: int) -> Tensor:
        g = torch.Generator().manual_seed(seed)
        return torch.randn(self.horizon, self.model.config.action_dim, generator=g).to(self.time_embs.dtype)

    # -- the reference ------------------------------------------------------------------------------------------------

    def reference(self, x_t: Tensor, d_v: Tensor) -> tuple[Tensor, Tensor]:
        model, cache, pi0 = self.model, self.cache, self.model.config.kind == "pi0"
        suffix = len(x_t) + pi0
        rope = suffix_rope(cache, suffix, model.config.expert.head_dim, model.config.rope_base)
        x = x_t[None].clone().requires_grad_()
        _, v = model.velocity(x, cache.state, self.cond, cache.k, cache.v, rope, suffix_mask(cache, suffix, pi0))
        (gradient,) = torch.autograd.grad(v, x, d_v[None])
        return v.detach()[0], gradient[0]

    # -- the engine ---------------------------------------------------------------------------------------------------

    def table(self) -> Tensor | None:
        """By the reference's norms: [2 * layers + 1, 3, D], or [2 * layers + 1, 3, T, D] by token."""
        if self.model.config.kind == "pi0":
            return None
        layers = self.model.expert.layers
        norms: list[Any] = [n for layer in layers for n in (layer.input_layernorm, layer.post_attention_layernorm)]
        rows = [torch.stack(norm.modulation(self.cond)) for norm in (*norms, self.model.expert.norm)]
        table = torch.stack(rows)[:, :, 0]  # [norms, 3, 1 or T, D]
        table[:, 0] += 1
        return table[:, :, 0] if self.time_embs.dim() == 2 else table

    def expert(self, tokens: int, ops: Ops = PLAIN, back: BackwardOps = PLAIN_BACKWARD) -> Expert:
        """The cache's rows: valid ones, poison up to the bucket's end, zeros, and NaN where the suffix's will be."""
        config, weights = self.model.config, pack(self.model.config, dict(self.model.state_dict()))
        length = int(self.cache.lengths[0])

        def laid_out(valid: Tensor) -> Tensor:
            rows = F.pad(valid[:, 0, 0], (0, 0, 0, BEHIND), value=POISON)
            return F.pad(F.pad(rows, (0, 0, 0, BETWEEN)), (0, 0, 0, tokens), value=torch.nan)

        k, v = laid_out(self.cache.k), laid_out(self.cache.v)
        cos, sin = rope_of_all_positions(config, k.shape[1], torch.device("cpu"))
        suffix = slice(length, length + tokens)
        rope = (cos[suffix].to(self.time_embs.dtype), sin[suffix].to(self.time_embs.dtype))
        return Expert(config, weights, ops, back, self.table(), torch.tensor([length]), k, v, rope)

    def engine(self, ops: Ops = PLAIN, back: BackwardOps = PLAIN_BACKWARD) -> Evaluation:
        model, pi0 = self.model, self.model.config.kind == "pi0"

        def evaluate(x_t: Tensor, d_v: Tensor) -> tuple[Tensor, Tensor]:
            tokens = model.embed_suffix(x_t[None], self.cache.state, self.time_embs)[0]
            expert = self.expert(len(tokens), ops, back)
            small = expert.weights.small
            out, kept, last = expert.forward(tokens)
            v = F.linear(out[-len(x_t) :], small["action_out_proj.weight"], small["action_out_proj.bias"])
            d_out = F.pad(d_v @ small["action_out_proj.weight"], (0, 0, int(pi0), 0))
            d_tokens = expert.vjp(kept, last, d_out)
            return v, suffix_vjp(model.config, small, x_t, self.time_embs[0], d_tokens[-len(x_t) :])

        return evaluate


def relative(ours: Tensor, exact: Tensor) -> float:
    return float((ours - exact).norm() / exact.norm())


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("times", ["one time", "by token"])
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 1e-5), (torch.float64, 1e-10)])
def test_equals_autograd_of_the_reference(
    kind: Kind, times: Times, dtype: torch.dtype, tolerance: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    problem = Problem.of(kind, times).to(dtype)
    if dtype == torch.float64:  # what the model and the engine cast to float32 they cast to float64 here
        monkeypatch.setattr(Tensor, "float", Tensor.double)
    evaluate = problem.engine()
    for seed in range(3):
        x_t, d_v = problem.chunk(seed), problem.chunk(seed + 10)
        v, gradient = evaluate(x_t, d_v)
        exact_v, exact = problem.reference(x_t, d_v)
        assert gradient.dtype == dtype and relative(v, exact_v) < tolerance
        assert relative(gradient, exact) < tolerance


def few_tokens() -> tuple[Ops, BackwardOps]:
    pytest.importorskip("triton", reason="Triton isn't installed")
    from turbopi.kernels.portable.norms import residual_rms_norm
    from turbopi.kernels.portable.vjp.ops import FEW_TOKENS

    return dataclasses.replace(PLAIN, residual_rms_norm=residual_rms_norm), FEW_TOKENS


IN_THE_INTERPRETER = (
    pytest.mark.skipif(torch.cuda.is_available(), reason="Triton interprets where there is no GPU"),
    pytest.mark.filterwarnings("ignore::RuntimeWarning", "ignore::DeprecationWarning"),  # it is NumPy
)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("times", [pytest.param(one, marks=IN_THE_INTERPRETER) for one in ("one time", "by token")])
def test_kernels_for_few_tokens_equal_autograd(kind: Kind, times: Times) -> None:
    problem = Problem.of(kind, times)
    given = (problem.chunk(0), problem.chunk(1))
    v, gradient = problem.engine(*few_tokens())(*given)
    exact_v, exact = problem.reference(*given)
    assert relative(v, exact_v) < 1e-5 and relative(gradient, exact) < 1e-5


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("times", ["one time", "by token"])
def test_bfloat16_is_as_close_to_float32_as_autograd_is(kind: Kind, times: Times) -> None:
    """Both with the same rounded weights and prefix."""
    dtypes = {name: one.dtype for name, one in golden_model(kind, "bf16").state_dict().items()}
    dtypes |= {"k": torch.bfloat16, "v": torch.bfloat16, "action_": torch.float32}
    rounded = Problem.of(kind, times).to(dtypes.__getitem__)
    exactly, evaluate = rounded.to(torch.float32), rounded.engine()
    ours, reference = 0.0, 0.0
    for seed in range(4):
        x_t, d_v = rounded.chunk(seed), rounded.chunk(seed + 10)
        exact = exactly.reference(x_t, d_v)[1]
        ours += relative(evaluate(x_t, d_v)[1], exact)
        reference += relative(rounded.reference(x_t, d_v)[1], exact)
    assert 0 < ours <= 1.25 * reference


@pytest.mark.parametrize("kind", KINDS)
def test_the_forward_pass_is_that_without_a_way_back(kind: Kind) -> None:
    problem = Problem.of(kind, "by token")
    tokens = problem.model.embed_suffix(problem.chunk(0)[None], problem.cache.state, problem.time_embs)[0]
    expert = problem.expert(len(tokens))
    out = expert.forward(tokens)[0]
    rest = (expert.table, expert.length, expert.cache_k, expert.cache_v, expert.rope)
    assert torch.equal(out, expert_output(problem.model.config, expert.weights, PLAIN, tokens, *rest))


class GoesForward:
    """A `KeepingDenoiser` of `Expert.forward`."""

    def __init__(self, problem: Problem, expert: Expert) -> None:
        self.problem, self.expert = problem, expert

    def launch_step(
        self, step: int, x_t: Tensor, k: Tensor, v: Tensor, length: Tensor, v_t: Tensor, _: Any
    ) -> KeptStep:
        assert k is self.expert.cache_k and v is self.expert.cache_v and length is self.expert.length
        problem = self.problem
        tokens = problem.model.embed_suffix(x_t[None], problem.cache.state, problem.time_embs)[0]
        out, kept, last = self.expert.forward(tokens)
        v_t.copy_(project(self.expert.weights.small, "action_out_proj", out))
        stream = torch.stack([*(x for one in kept for x in (one.x, one.middle)), last])
        q = [one.attention.q if hasattr(one.attention, "q") else one.attention[0] for one in kept]
        return KeptStep(stream, torch.stack(q), torch.stack([one.gate_up for one in kept]))


def in_rows(expert: Expert) -> Expert:
    """The same with a table of rows in another order, of which tokens take theirs."""
    assert expert.table is not None
    table = expert.table if expert.table.dim() == 4 else expert.table[:, :, None].expand(-1, -1, 10, -1)
    rows = torch.arange(10, dtype=torch.int32)
    by_time = table.flip(2).movedim(2, 0).contiguous()  # as loops have it
    return dataclasses.replace(expert, table=by_time.movedim(0, 2), rows=rows.flip(0))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("times", "kernels"),
    [("one time", False), ("by token", False), pytest.param("by token", True, marks=IN_THE_INTERPRETER)],
)
def test_what_a_denoiser_keeps_serves_as_what_the_operations_keep(times: Times, kernels: bool) -> None:
    problem = Problem.of("pi05", times)
    ops, back = few_tokens() if kernels else (PLAIN, PLAIN_BACKWARD)
    x_t, horizon, config = problem.chunk(0), problem.horizon, problem.model.config
    requested = Conditioned.allocate(config, ConditionedLoop(1, horizon, (1.0, 0.0), True), torch.device("cpu"))
    requested.tokens.times.fill_(0.6), requested.tokens.gain.fill_(0.7)
    requested.tokens.target.copy_(problem.chunk(1)), requested.weights.copy_(torch.linspace(1, 0, horizon)[:, None])
    requested.tokens.steps.copy_(-torch.linspace(0, 1, horizon))
    tokens = problem.model.embed_suffix(x_t[None], problem.cache.state, problem.time_embs)[0]
    expected = jacobian_velocity(problem.expert(horizon, ops, back), requested, 0, x_t, tokens, problem.time_embs[0])
    v_t, next_x = torch.full_like(x_t, torch.nan), torch.full_like(x_t, torch.nan)
    expert = problem.expert(horizon, ops, back)
    forward = GoesForward(problem, expert)
    jacobian_step(in_rows(expert), requested, 0, forward, x_t, v_t, next_x)
    assert expected.isfinite().all() and relative(v_t, expected) < 1e-6
    assert relative(next_x, requested.next_x(0, x_t, expected)) < 1e-6


def without_keys(d_q: Tensor, d_k: Tensor, d_v: Tensor, cos: Tensor, sin: Tensor) -> Tensor:
    return rope_vjp(d_q, d_k * 0, d_v, cos, sin)


def without_values(d_q: Tensor, d_k: Tensor, d_v: Tensor, cos: Tensor, sin: Tensor) -> Tensor:
    return rope_vjp(d_q, d_k, d_v * 0, cos, sin)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("broken", [without_keys, without_values])
def test_the_suffixs_own_keys_and_values_carry_gradient(kind: Kind, broken: Callable[..., Tensor]) -> None:
    problem = Problem.of(kind, "one time")

    given = (problem.chunk(0), problem.chunk(1))
    whole = problem.engine()(*given)[1]
    cut = problem.engine(back=dataclasses.replace(PIECES, rope_vjp=broken).ops(""))(*given)[1]
    assert relative(cut, whole) > 1e-4, "ten times what the comparison with autograd lets pass"


@pytest.mark.slow
@pytest.mark.filterwarnings("default")  # the compiler's own
@pytest.mark.skipif(
    backends.availability("pytorch_compile", torch.device("cpu")) is not None,
    reason="torch.compile needs a C++ compiler",
)
@pytest.mark.parametrize("times", ["one time", "by token"])
def test_compiled_operations_equal_autograd_and_compile_nothing_for_another_horizon(times: Times) -> None:
    made = compiled().backward
    assert made is not None
    back = made(Problem.of("pi05", times).model.config.expert, 10)
    for horizon, stance in ((10, "default"), (13, "fail_on_recompile")):
        problem = Problem.of("pi05", times, horizon)
        given = (problem.chunk(0), problem.chunk(1))
        with torch.compiler.set_stance(stance):
            gradient = problem.engine(PLAIN, back)(*given)[1]
        assert relative(gradient, problem.reference(*given)[1]) < 1e-5
