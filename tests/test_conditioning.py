"""The reference's conditioned denoising: times by token, held actions, guidance with the true Jacobian and without."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from conftest import golden_cases, golden_model
from lerobot_golden import GOLDEN, GoldenCase, _observation
from torch import Tensor

from turbopi import UnifiedPolicy
from turbopi.checkpoint import open_checkpoint
from turbopi.config import Kind
from turbopi.models.observation import Observation
from turbopi.models.pi0.conditioning import (
    Conditioning,
    Conditionings,
    Guidance,
    GuidanceMode,
    Schedule,
    TokenTimes,
    guidance_strength,
    guidance_weights,
    lerobot_guidance_weights,
)
from turbopi.models.pi0.denoise import time_grid
from turbopi.models.pi0.kv_cache import KVCache
from turbopi.models.pi0.layers import AdaRMSNorm
from turbopi.models.pi0.reference import Pi0Model, Trace
from turbopi.preprocess.tokenizer import TINY_TOKENIZER
from turbopi.support.errors import ObservationError

CASES: dict[Kind, str] = {"pi05": "b_third_masked", "pi0": "p0_pi0_state"}
KINDS: list[Kind] = ["pi05", "pi0"]
N = 4


def cached(kind: Kind) -> tuple[Pi0Model, KVCache, Tensor]:
    case, model = golden_cases()[CASES[kind]], golden_model(kind)
    return model, model.prefix(case.observation), case.noise


def chunk(seed: int, horizon: int = 10, width: int = 32) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal((horizon, width)).astype(np.float32)


def guidance(mode: GuidanceMode, horizon: int = 10, steps: int = N, kind: str = "accumulated") -> Guidance:
    times = TokenTimes.plain(steps, horizon, kind).times
    return Guidance(chunk(5, horizon), guidance_weights(horizon, 2, 3), guidance_strength(times, 5.0), mode)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("precision", ["f32", "bf16"])
def test_what_asks_for_nothing_changes_no_bit(kind: Kind, precision: Any) -> None:
    case, model = golden_cases()[CASES[kind]], golden_model(kind, precision)
    cache, noise = model.prefix(case.observation), case.noise
    plain: Trace = {}
    model.denoise(cache, noise, N, trace=plain)
    nothing = [
        Conditioning(),
        Conditioning(held=np.zeros(10, bool)),
        Conditioning(tokens=TokenTimes.plain(N, 10, model.config.time_grid)),
    ]
    one_each: list[Conditionings] = [[None], [nothing[2]]]
    for requested in (*nothing, *one_each):
        trace: Trace = {}
        assert torch.equal(model.denoise(cache, noise, N, conditioning=requested, trace=trace), plain["actions"])
        assert torch.equal(trace["v_t"], plain["v_t"])


@pytest.mark.parametrize("kind", KINDS)
def test_held_actions_equal_a_loop_that_sets_them_before_and_after_every_step(kind: Kind) -> None:
    model, cache, noise = cached(kind)
    held, values = np.arange(10) < 3, chunk(1)
    trace: Trace = {}
    actions = model.denoise(cache, noise, N, conditioning=Conditioning(held=held, values=values), trace=trace)
    assert torch.equal(actions[0, :3], torch.from_numpy(values[:3]))
    x, given = noise.clone(), torch.from_numpy(values)
    for t in time_grid(N):
        x[:, :3] = given[:3]
        tokens = TokenTimes(np.where(held, np.float32(0), t)[None], np.full((1, 10), np.float32(-1 / N)))
        x = model.denoise(cache, x, 1, conditioning=Conditioning(tokens))
        x[:, :3] = given[:3]
    torch.testing.assert_close(actions, x, rtol=1e-5, atol=1e-6)
    others = model.denoise(cache, noise, N, conditioning=Conditioning(held=held, values=values + 1))
    assert not torch.equal(actions[0, 3:], others[0, 3:]), "nobody attends to what is held"
    assert torch.equal(trace["x_t"][1:, 0, :3], given[:3].expand(N, -1, -1)), "streamed actions hold them, too"


@pytest.mark.parametrize("kind", KINDS)
def test_a_tokens_time_changes_its_own_modulation_alone(kind: Kind) -> None:
    """With attention cut, every action is what it would be if all had its time."""
    model, cache, noise = cached(kind)
    late, early = np.float32(0.75), np.float32(0.25)
    times = np.full((1, 10), late)
    times[:, 4:7] = early
    steps = np.full((1, 10), np.float32(-0.25))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("turbopi.models.pi0.gemma.attention", lambda q, k, v, mask: q * 0)

        def at(t: np.ndarray) -> Tensor:
            return model.denoise(cache, noise, 1, conditioning=Conditioning(TokenTimes(t, steps)))

        mixed, all_late, all_early = at(times), at(np.full_like(times, late)), at(np.full_like(times, early))
    torch.testing.assert_close(mixed[:, 4:7], all_early[:, 4:7], rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(mixed[:, :4], all_late[:, :4], rtol=1e-5, atol=1e-6)
    assert float((all_late - all_early).abs().max()) > 1e-2


def test_a_modulation_by_token_has_each_tokens_row() -> None:
    norm = AdaRMSNorm(8, 1e-6)
    x, cond = torch.randn(2, 5, 8), torch.randn(1, 5, 8)
    normed, gate = norm(x, cond)
    for token in range(5):
        alone, its_gate = norm(x[:, token : token + 1], cond[:, token])
        torch.testing.assert_close(normed[:, token : token + 1], alone)
        torch.testing.assert_close(gate[:, token : token + 1], its_gate)


def test_a_warm_start_is_the_end_of_a_loop() -> None:
    model, cache, noise = cached("pi05")
    trace: Trace = {}
    whole = model.denoise(cache, noise, N, trace=trace)
    grid = np.append(time_grid(N), np.float32(0))
    rest = TokenTimes.of(np.repeat(grid[1:, None], 10, 1))
    torch.testing.assert_close(
        model.denoise(cache, trace["x_t"][1], N - 1, conditioning=Conditioning(rest)), whole, rtol=1e-5, atol=1e-6
    )


def test_actions_come_out_after_any_step_whatever_follows() -> None:
    """A staircase of times: the first action ends in the second step, and keeps its value."""
    model, cache, noise = cached("pi05")
    speed = np.linspace(2, 1, 10)
    t = np.maximum(1 - np.arange(N + 1)[:, None] / N * speed, 0).astype(np.float32)
    trace: Trace = {}
    model.denoise(cache, noise, N, conditioning=Conditioning(TokenTimes.of(t)), trace=trace)
    assert trace["times"].shape == (N, 1, 10) and trace["cond"].shape[:3] == (N, 1, 10)
    x_t = trace["x_t"][:, 0]
    assert torch.equal(x_t[2, 0], x_t[4, 0]) and not torch.equal(x_t[1, 0], x_t[2, 0])
    assert not torch.equal(x_t[3, 9], x_t[4, 9])


@pytest.mark.parametrize("kind", KINDS)
def test_the_vector_jacobian_product_is_that_of_finite_differences(kind: Kind, monkeypatch: pytest.MonkeyPatch) -> None:
    """In float64 throughout: what the model casts to float32 it casts to float64 here."""
    model, narrow, noise = cached(kind)
    cache = dataclasses.replace(narrow, k=narrow.k.double(), v=narrow.v.double(), state=narrow.state.double())
    double = Pi0Model.from_state(model.config, {name: one.double() for name, one in model.state_dict().items()})
    monkeypatch.setattr(torch.Tensor, "float", torch.Tensor.double)
    noise, t = noise.double(), np.full((1, 10), np.float32(0.6))
    still = TokenTimes(t, np.zeros((1, 10), np.float32))  # so that the trace's v is all that happens

    def v_of(x: Tensor, pull: Guidance | None = None) -> Tensor:
        trace: Trace = {}
        double.denoise(cache, x, 1, conditioning=Conditioning(still, guidance=pull), trace=trace)
        return trace["v_t"][0]

    weights = guidance_weights(10, 2, 3)
    pull = Guidance(chunk(3), weights, np.full((1, 10), np.float32(2)), "jacobian")
    v = v_of(noise)
    assert v.dtype == torch.float64
    error = (torch.from_numpy(pull.target).double() - (noise - float(t[0, 0]) * v)) * torch.from_numpy(weights)[:, None]
    correction = (v - v_of(noise, pull)) / 2  # Jᵀ error
    for seed in range(3):
        direction, eps = torch.from_numpy(chunk(seed)).double()[None], 1e-5
        ahead, behind = (noise + sign * eps * direction for sign in (1, -1))
        x_hat = [x - float(t[0, 0]) * v_of(x) for x in (ahead, behind)]
        along = (x_hat[0] - x_hat[1]) / (2 * eps)  # J direction
        torch.testing.assert_close((correction * direction).sum(), (error * along).sum(), rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize("kind", KINDS)
def test_guidance_is_the_gradient_of_the_whole_function(kind: Kind) -> None:
    """−∂/∂x ½ ‖(target − x̂(x)) ⊙ √weights‖² by autograd, in a loop written out."""
    model, cache, noise = cached(kind)
    pull = guidance("jacobian")
    target, weights = torch.from_numpy(pull.target), torch.from_numpy(pull.weights)[:, None]
    x = noise.clone()
    for i, t in enumerate(time_grid(N)):
        with torch.enable_grad():
            leaf = x.clone().requires_grad_()
            v = velocity(model, cache, leaf, float(t))
            loss = 0.5 * (((target - (leaf - float(t) * v)) ** 2) * weights).sum()
            (gradient,) = torch.autograd.grad(loss, leaf)
        x = x + float(np.float32(-1 / N)) * (v.detach() + torch.from_numpy(pull.strength[i])[:, None] * gradient)
    ours = model.denoise(cache, noise, N, conditioning=Conditioning(guidance=pull))
    torch.testing.assert_close(ours, x, rtol=1e-5, atol=1e-5)
    identity = model.denoise(cache, noise, N, conditioning=Conditioning(guidance=guidance("identity")))
    assert float((ours - identity).abs().max()) > 1e-2, "the two modes are the same here: nothing is shown"


def velocity(model: Pi0Model, cache: KVCache, x: Tensor, t: float) -> Tensor:
    from turbopi.models.pi0.denoise import suffix_mask, suffix_rope, time_embedding

    config = model.config
    emb = time_embedding(np.array([t], np.float32), config.expert.width)
    time = model.time_condition(emb) if config.kind == "pi05" else emb
    suffix = x.shape[1] + (config.kind == "pi0")
    rope = suffix_rope(cache, suffix, config.expert.head_dim, config.rope_base)
    mask = suffix_mask(cache, suffix, config.kind == "pi0")
    return model.velocity(x, cache.state, time, cache.k, cache.v, rope, mask)[1]


def test_guidance_pulls_towards_the_target() -> None:
    model, cache, noise = cached("pi05")
    plain = model.denoise(cache, noise, N)
    mine = guidance("jacobian")
    for mode in ("jacobian", "identity"):
        pulled = model.denoise(
            cache, noise, N, conditioning=Conditioning(guidance=dataclasses.replace(mine, mode=mode))
        )
        target = torch.from_numpy(mine.target)
        assert float((pulled - target)[0, :2].norm()) < 0.5 * float((plain - target)[0, :2].norm()), mode


@pytest.mark.parametrize("kind", KINDS)
def test_rows_of_a_batch_have_conditionings_of_their_own(kind: Kind) -> None:
    case, model = golden_cases()[CASES[kind]], golden_model(kind)
    short = dataclasses.replace(case.observation, token_mask=case.observation.token_mask.clone())
    short.token_mask[:, 3:] = False
    both = Observation(*(torch.cat((getattr(case.observation, f.name), getattr(short, f.name))) for f in fields()))
    noise = torch.cat((case.noise, -case.noise))
    requested = [
        Conditioning(held=np.arange(10) < 2, values=chunk(1)),
        Conditioning(guidance=guidance("jacobian", kind=model.config.time_grid)),
    ]
    trace: Trace = {}
    together = model.sample(both, noise, N, conditioning=requested, trace=trace)
    assert trace["v_t"].shape == (N, 2, 10, 32) and trace["times"].shape == (N, 2, 10)
    for row, one in enumerate((case.observation, short)):
        alone = model.sample(one, noise[row : row + 1], N, conditioning=requested[row])
        torch.testing.assert_close(together[row : row + 1], alone, rtol=1e-5, atol=1e-5)
    for all_rows in (requested[0], requested[1]):
        together = model.sample(both, noise, N, conditioning=all_rows)
        alone = model.sample(short, noise[1:], N, conditioning=all_rows)
        torch.testing.assert_close(together[1:], alone, rtol=1e-5, atol=1e-5)
    with pytest.raises(ObservationError, match="1 conditionings were given for 2 observations"):
        model.sample(both, noise, N, conditioning=requested[:1])


def fields() -> Any:
    return dataclasses.fields(Observation)


# -- weights -----------------------------------------------------------------------------------------------------------


def test_published_weights() -> None:
    expected = [1.0, 1.0]
    for i in range(2, 7):
        c = (7 - i) / (7 - 2 + 1)
        expected.append(c * (np.exp(c) - 1) / (np.e - 1))
    np.testing.assert_allclose(guidance_weights(10, 2, 3), [*expected, 0, 0, 0], rtol=1e-6)
    np.testing.assert_allclose(guidance_weights(6, 1, 2, "linear"), [1, 0.75, 0.5, 0.25, 0, 0])
    np.testing.assert_array_equal(guidance_weights(6, 1, 2, "ones"), [1, 1, 1, 1, 0, 0])
    np.testing.assert_array_equal(guidance_weights(6, 1, 2, "zeros"), [1, 0, 0, 0, 0, 0])
    np.testing.assert_array_equal(guidance_weights(6, 4, 2), [1, 1, 1, 1, 0, 0])
    with pytest.raises(ObservationError, match="a delay of 5 and an execution horizon of 2 don't fit a chunk of 6"):
        guidance_weights(6, 5, 2)
    with pytest.raises(ObservationError, match="the schedule is 'cosine'"):
        guidance_weights(6, 1, 2, "cosine")  # type: ignore[arg-type]


def test_lerobots_execution_horizon_is_the_masks_end() -> None:
    np.testing.assert_allclose(lerobot_guidance_weights(10, 2, 6, 8), guidance_weights(10, 2, 4, "linear"))
    np.testing.assert_array_equal(lerobot_guidance_weights(10, 8, 6, 10, "exponential"), [1] * 6 + [0] * 4)
    assert lerobot_guidance_weights(10, 2, 6, 0).sum() == 0


def test_strength() -> None:
    strength = guidance_strength(np.array([1, 0.8, 0.5, 0.01, 0], np.float32), 5.0)
    np.testing.assert_allclose(strength, [5, (0.64 + 0.04) / 0.16, 2, 5, 5], rtol=1e-5)


# -- LeRobot's numbers -------------------------------------------------------------------------------------------------

SCHEDULES: dict[str, Schedule] = {"ZEROS": "zeros", "ONES": "ones", "LINEAR": "linear", "EXP": "exponential"}


def lerobot_guidance(run: dict[str, Any], previous: np.ndarray | None, horizon: int = 10) -> Guidance | None:
    """What LeRobot 0.6.1 computes with: the padded dimensions are pulled to 0, too."""
    if previous is None:
        return None
    target = np.zeros((horizon, 32), np.float32)
    target[: len(previous), : previous.shape[1]] = previous
    times = TokenTimes.plain(run["num_steps"], horizon, "multiplied").times
    weights = lerobot_guidance_weights(
        horizon, run["inference_delay"], run["execution_horizon"], len(previous), SCHEDULES[run["schedule"]]
    )
    return Guidance(target, weights, guidance_strength(times, run["max_guidance_weight"]), "identity")


def test_identity_guidance_is_lerobots(tmp_path: Path) -> None:
    """All twenty runs of LeRobot 0.6.1's RTC, within float32 rounding."""
    case = GoldenCase(GOLDEN / "rtc")
    checkpoint = case.assemble(tmp_path)
    policy = UnifiedPolicy(checkpoint, backend="pytorch", precision="f32", device="cpu", tokenizer=TINY_TOKENIZER)
    opened = open_checkpoint(checkpoint)
    model = Pi0Model.from_state(opened.config.planned_model, opened.load("cpu", "f32").state)
    inputs, stored = np.load(GOLDEN / "rtc/inputs.npz"), np.load(GOLDEN / "rtc/rtc.npz")
    observation = _observation(inputs, 0)
    cache = model.prefix(Observation.stack([policy.prepare(observation)]))
    runs = json.loads((GOLDEN / "rtc/rtc.json").read_text())
    assert len(runs) == 20
    plain = {n: model.denoise(cache, torch.from_numpy(inputs["noise"])[None], n) for n in (3, 5, 10)}
    for index, run in enumerate(runs):
        previous = stored[f"{index}/prev"] if run["prev_rows"] else None
        requested = Conditioning(guidance=lerobot_guidance(run, previous))
        noise = torch.from_numpy(inputs["noise"])[None]
        ours = model.denoise(cache, noise, run["num_steps"], conditioning=requested)[0, :, :7]
        theirs = torch.from_numpy(stored[f"{index}/normalized_actions"])
        assert float((ours - theirs).abs().max()) <= 1e-5, run
        if previous is not None and run["inference_delay"]:
            assert float((plain[run["num_steps"]][0, :, :7] - theirs).abs().max()) > 1e-2
        if previous is not None:
            given = policy.infer(observation, noise=inputs["noise"], conditioning=requested, num_steps=run["num_steps"])
            np.testing.assert_allclose(given["actions"], stored[f"{index}/actions"], rtol=1e-4, atol=1e-4)


# -- what is refused ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("requested", "message"),
    [
        (Conditioning(TokenTimes.plain(3, 10)), r"token times are float32 of shape \[3, 10\]; .* shape \[4, 10\]"),
        (Conditioning(held=np.ones(9, bool), values=chunk(0)), r"held is bool of shape \[9\]; .* shape \[10\]"),
        (Conditioning(held=np.ones(10, bool)), "held actions need values"),
        (Conditioning(held=np.ones(10, bool), values=chunk(0, width=7)), r"shape \[10, 7\]; .* shape \[10, 32\]"),
        (Conditioning(held=np.ones(10, bool), values=chunk(0) * np.nan), "values that aren't finite"),
        (
            Conditioning(guidance=dataclasses.replace(guidance("jacobian"), weights=np.ones(9, np.float32))),
            r"weights are float32 of shape \[9\]",
        ),
        (
            Conditioning(guidance=dataclasses.replace(guidance("jacobian"), mode="both")),  # type: ignore[arg-type]
            "guidance mode is 'both'",
        ),
    ],
)
def test_what_does_not_fit_is_refused(requested: Conditioning, message: str) -> None:
    model, cache, noise = cached("pi05")
    with pytest.raises(ObservationError, match=message):
        model.denoise(cache, noise, N, conditioning=requested)


def test_token_times_are_checked() -> None:
    for t, message in (
        (np.ones((1, 10)), "numbers"),
        (np.full((2, 10), 1.1), "between 0"),
        (np.full((2, 10), np.nan), "between 0"),
        (np.array([[0.5], [0.6]]), "never grow"),
    ):
        with pytest.raises(ObservationError, match=message):
            TokenTimes.of(t)
    times = np.array([[0.5, 0, 0.5], [0.25, 0, 0.1]], np.float32)
    tokens = TokenTimes(times, times * 0)
    np.testing.assert_array_equal(tokens.distinct(), np.array([0.5, 0, 0.25, 0.1], np.float32))
    np.testing.assert_array_equal(tokens.rows(tokens.distinct()), [[0, 1, 0], [2, 1, 3]])
    with pytest.raises(AssertionError, match="isn't in the table"):
        tokens.rows(np.array([0.5, 0], np.float32))
