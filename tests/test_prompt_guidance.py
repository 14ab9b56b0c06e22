"""Classifier-free guidance by a prompt's tag: against the mixture written out plainly, on every backend that has it."""

from typing import Any

import numpy as np
import pytest
import torch
from cli_helpers import text_of, turbopi
from conditioned import conditioned
from conftest import golden_cases, golden_model
from policy_helpers import policy_on
from test_begin import OnCpu, Unrun, on_cpu
from test_engine_batch import observations
from torch import Tensor

from turbopi import UnifiedPolicy
from turbopi.backends.fused_smolvla import FusedSmolVLABackend
from turbopi.backends.onnx.backend import OnnxBackend
from turbopi.backends.pytorch import PyTorchBackend
from turbopi.backends.pytorch_compile import PyTorchCompileBackend
from turbopi.checkpoint import random_checkpoint
from turbopi.config import Kind
from turbopi.models.observation import Observation
from turbopi.models.pi0.conditioning import Conditioning, Form, PromptGuidance
from turbopi.models.pi0.denoise import suffix_mask, suffix_rope, time_embedding, time_grid
from turbopi.models.pi0.reference import Trace
from turbopi.models.pi0.solvers import Integration
from turbopi.preprocess.tokenizer import prompt_texts
from turbopi.realtime.running_chunk import RunningChunk
from turbopi.serve import ServerOptions
from turbopi.serve.metrics import Metrics
from turbopi.serve.real_time import RealTime
from turbopi.support.errors import BackendError, ConfigError, ObservationError

KINDS: list[Kind] = ["pi05", "pi0"]
STEPS, H, A = 3, 7, 32
TAG = "Advantage: positive"
TAGGED = np.array([5, 9, 2, 7, 11], np.int64)
SOLVERS = {
    "ab2": Integration("ab2", (1.0, 0.6, 0.3, 0.0)),
    "midpoint": Integration("midpoint", (1.0, 0.4, 0.0), 3),
    "euler_on_a_grid": Integration("euler", (1.0, 0.5, 0.2, 0.0)),
}


def close(ours: Tensor, exact: Tensor) -> None:
    torch.testing.assert_close(ours, exact, atol=2e-5, rtol=2e-5)


def guided(scale: float, which: str | None = None, tokens: np.ndarray = TAGGED) -> Conditioning:
    given = {} if which is None else vars(conditioned(which, STEPS, H, A))
    return Conditioning(**{**given, "prompt": PromptGuidance(tokens, scale)})


def by_hand(kind: Kind, observation: Observation, tokens: np.ndarray, noise: Tensor, scale: float) -> Tensor:
    """Euler's steps over the reference's parts: both velocities of each x_t, then their mixture."""
    model, config = golden_model(kind), golden_model(kind).config
    ids = torch.from_numpy(tokens)[None]
    other = Observation(
        observation.images, observation.image_mask, ids, torch.ones_like(ids, dtype=torch.bool), observation.state
    )
    caches = [model.prefix(observation), model.prefix(other)]
    x, suffix = noise, H + (kind == "pi0")
    for t in time_grid(STEPS):
        time = time_embedding(np.array([t]), config.expert.width)
        time = model.time_condition(time) if kind == "pi05" else time
        v_u, v_c = (
            model.velocity(
                x,
                one.state,
                time,
                one.k,
                one.v,
                suffix_rope(one, suffix, config.expert.head_dim, config.rope_base),
                suffix_mask(one, suffix, kind == "pi0"),
            )[1]
            for one in caches
        )
        x = x - ((1 - scale) * v_u + scale * v_c) / STEPS
    return x


@pytest.fixture(scope="module", params=KINDS)
def engine(request: Any) -> OnCpu:
    return on_cpu(request.param)


class TestReference:
    @pytest.mark.parametrize("kind", KINDS)
    @pytest.mark.parametrize("scale", [1.5, 0.4])
    def test_each_velocity_is_the_mixture_of_both_prompts(self, kind: Kind, scale: float) -> None:
        made, noise = observations(kind, [2], [6], H)
        ours = golden_model(kind).sample(made, noise, STEPS, conditioning=guided(scale))
        close(ours, by_hand(kind, made, TAGGED, noise, scale))
        plain = golden_model(kind).sample(made, noise, STEPS)
        assert (ours - plain).abs().max() > 1e-3, "the tag changes nothing here"

    def test_at_1_and_0_it_is_one_of_the_prompts(self) -> None:
        model, (made, noise) = golden_model("pi05"), observations("pi05", [1], [6], H)
        ids = torch.from_numpy(TAGGED)[None]
        tagged = Observation(made.images, made.image_mask, ids, torch.ones_like(ids, dtype=torch.bool), made.state)
        close(model.sample(made, noise, STEPS, conditioning=guided(1.0)), model.sample(tagged, noise, STEPS))
        close(model.sample(made, noise, STEPS, conditioning=guided(0.0)), model.sample(made, noise, STEPS))

    def test_rows_with_prompts_of_their_own_beside_rows_without(self) -> None:
        model, (made, noise) = golden_model("pi05"), observations("pi05", [2, 1, 0], [6, 3, 9], H)
        rows = [guided(1.5), None, guided(2.5, "held", np.array([3, 1], np.int64))]
        together = model.sample(made, noise, STEPS, conditioning=rows)
        for row, one in enumerate(rows):
            alone = model.sample(made.row(row), noise[row : row + 1], STEPS, conditioning=one)
            close(together[row : row + 1], alone)

    def test_vision_runs_once(self, monkeypatch: pytest.MonkeyPatch) -> None:
        model, (made, noise) = golden_model("pi05"), observations("pi05", [2], [6], H)
        seen, plain = [], model.embed_images

        def counting(images: Tensor) -> Any:
            seen.append(images.shape[1])
            return plain(images)

        monkeypatch.setattr(model, "embed_images", counting)
        model.sample(made, noise, STEPS, conditioning=guided(1.5))
        assert seen == [2]

    def test_guidance_by_the_true_jacobian_goes_back_through_the_mixture(self) -> None:
        """x̂ = x − t v of the mixed v: J by finite differences is the one that autograd takes."""
        from turbopi.models.pi0.integrate import Pull, guided_velocity, mixed_velocity

        v_u, v_c = (lambda x, time, first: (x, x.sin())), (lambda x, time, first: (x, (x * x)))
        both = mixed_velocity(v_u, v_c, PromptGuidance(TAGGED, 1.5))
        x = torch.tensor([[[0.3]]])
        target, weights, strength, times = (torch.full((1, 1), value) for value in (2.0, 1.0, 0.5, 0.8))
        pull = Pull(target, weights, strength, times, through_expert=True)
        _, v = guided_velocity(lambda x: both(x, x, True), x, pull)
        mixed, slope = -0.5 * np.sin(0.3) + 1.5 * 0.09, -0.5 * np.cos(0.3) + 1.5 * 0.6
        expected = mixed - 0.5 * (2.0 - (0.3 - 0.8 * mixed)) * (1 - 0.8 * slope)
        assert float(v) == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("scale", [1.5, 0.4])
@pytest.mark.parametrize("which", [None, "held_and_identity"])
def test_the_engine_computes_the_references(engine: OnCpu, which: str | None, scale: float) -> None:
    kind = engine.config.kind
    made, noise = observations(kind, [2], [6], H)
    wanted = guided(scale, which)
    engine.reported.clear()
    ours = engine.sample(made, noise, STEPS, conditioning=wanted).actions
    close(ours, golden_model(kind).sample(made, noise, STEPS, conditioning=wanted))
    assert engine.reported == ["run"] * 3, "vision of one observation, both prefixes, denoising of both"


@pytest.mark.slow
@pytest.mark.parametrize("name", SOLVERS)
def test_every_solver_goes_on_with_the_mixture(engine: OnCpu, name: str) -> None:
    kind = engine.config.kind
    made, noise = observations(kind, [1], [6], H)
    wanted = Conditioning(integration=SOLVERS[name], prompt=PromptGuidance(TAGGED, 2.0))
    trace: Trace = {}
    exact = golden_model(kind).sample(made, noise, STEPS, conditioning=wanted, trace=trace)
    close(engine.sample(made, noise, STEPS, conditioning=wanted).actions, exact)
    assert trace["v_t"].shape[0] == STEPS and (trace["v_t"][1] - trace["v_t"][0]).abs().max() > 1e-3


@pytest.mark.slow
def test_another_scale_or_prompt_needs_no_new_graph_and_guided_rows_run_alone(engine: OnCpu) -> None:
    kind = engine.config.kind
    made, noise = observations(kind, [2, 2, 1], [6, 3, 9], H)
    rows = [guided(1.5), None, guided(2.5, tokens=np.array([3, 1], np.int64))]
    engine.reported.clear()
    ours = engine.sample(made, noise, STEPS, conditioning=rows).actions
    close(ours, golden_model(kind).sample(made, noise, STEPS, conditioning=rows))
    assert engine.reported == ["run", "answer", *["run"] * 6]
    captured = len(engine._graphs.entries)
    rows = [guided(2.0, tokens=TAGGED[:2]), None, guided(1.1)]
    close(
        engine.sample(made, noise, STEPS, conditioning=rows).actions,
        golden_model(kind).sample(made, noise, STEPS, conditioning=rows),
    )
    assert len(engine._graphs.entries) == captured
    assert "2 cameras, two prompts, H=7, 3 steps" in engine.describe()["captured"]
    assert not engine._graphs.batch_sizes("plain")


def test_parts_of_a_call_refuse_two_prompts() -> None:
    engine, (made, noise) = on_cpu(cls=Unrun), observations("pi05", [1], [6], H)
    with pytest.raises(BackendError, match="two prompts in `sample` and in batches begun as such alone"):
        engine.intermediates(made, noise, STEPS, conditioning=guided(1.5))


def test_a_strict_engine_has_what_warm_up_prepared() -> None:
    engine, (made, noise) = on_cpu(cls=Unrun), observations("pi05", [2], [6], H)
    engine.warmup(made, STEPS, H, conditioning=guided(1.5))
    engine.strict = True
    engine.sample(made, noise, STEPS, conditioning=guided(1.7))
    with pytest.raises(ObservationError, match=r"2 cameras, two prompts, H=7, 4 steps.*give the policy its guidance"):
        engine.sample(made, noise, 4, conditioning=guided(1.7))


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (PromptGuidance(TAGGED, float("nan")), "the guidance is nan; it should be a number from 0 to 100"),
        (PromptGuidance(TAGGED, -0.5), "the guidance is -0.5"),
        (PromptGuidance(TAGGED[:0], 1.5), r"the second prompt is int64 of shape \[0\]; it should be int64 ids"),
        (PromptGuidance(TAGGED.astype(np.float32), 1.5), "the second prompt is float32"),
    ],
)
def test_what_can_be_no_guidance_is_refused(wrong: PromptGuidance, message: str) -> None:
    with pytest.raises(ObservationError, match=message):
        Conditioning(prompt=wrong).check(STEPS, H, A)


def test_backends_without_it_say_what_to_take() -> None:
    without: list[tuple[Any, Form]] = [(OnnxBackend, "two_prompts"), (PyTorchCompileBackend, "two_prompts")]
    without += [(FusedSmolVLABackend, "two_prompts"), (OnCpu, "two_prompts_jacobian")]
    for backend, form in without:
        assert "second prompt; take" in (backend.refuses_form(form) or ""), backend
    assert PyTorchBackend.refuses_form("two_prompts_jacobian") is None and OnCpu.refuses_form("two_prompts") is None


def made_of(checkpoint: Any, **options: Any) -> UnifiedPolicy:
    return UnifiedPolicy(checkpoint, **{"backend": "pytorch", "precision": "f32", "device": "cpu"} | options)


@pytest.fixture(scope="module")
def tiny() -> Any:
    return random_checkpoint("pi05_tiny")


@pytest.fixture(scope="module")
def plain(tiny: Any) -> UnifiedPolicy:
    return made_of(tiny)


@pytest.fixture(scope="module")
def policy(tiny: Any) -> UnifiedPolicy:
    return made_of(tiny, guidance=1.5, guidance_tag=TAG)


class TestPolicy:
    def test_the_tag_goes_the_prompts_own_way(self, plain: UnifiedPolicy, policy: UnifiedPolicy) -> None:
        """openpi makes a space of the new line, LeRobot's Pi0 leaves it: each as in its training."""
        observation = policy.example_observation() | {"prompt": "pick_up the cup "}
        typed = observation | {"prompt": f"pick_up the cup \n{TAG}"}
        tagged = policy.infer(observation, seed=0, guidance=1)["actions"]
        np.testing.assert_array_equal(tagged, plain.infer(typed, seed=0)["actions"])
        alone = policy.infer(observation, seed=0, guidance=0)["actions"]
        np.testing.assert_array_equal(alone, plain.infer(observation, seed=0)["actions"])
        state = np.zeros(2)
        assert prompt_texts(f"pick\n{TAG}", state)[0][0] == f"Task: pick {TAG}, State: 128 128;\nAction: "
        assert prompt_texts(f"pick\n{TAG}", None, as_is=True)[0][0] == f"pick\n{TAG}\n"

    @pytest.mark.parametrize("guidance", [1, 1.5])
    def test_a_tag_that_would_be_cut_is_refused(self, policy: UnifiedPolicy, guidance: float) -> None:
        long = policy.example_observation() | {"prompt": "pick up the cup " * 100}
        with pytest.raises(ObservationError, match=r"guidance's tag take \d+ tokens, but the model reads 200"):
            policy.infer(long, guidance=guidance)
        assert np.isfinite(policy.infer(long, guidance=0)["actions"]).all(), "cut, as openpi does, with a warning"

    def test_a_policys_guidance_is_the_backends(self, policy: UnifiedPolicy) -> None:
        observation = policy.example_observation()
        found = policy.infer(observation, seed=3)["actions"]
        seen = policy.pipeline.see(observation, guidance=1.5)
        inputs = Observation.stack([policy.pipeline.complete(seen)])
        assert seen.tagged is not None
        x_1 = torch.from_numpy(np.random.default_rng(3).standard_normal((1, 10, 32), dtype=np.float32))
        wanted = Conditioning(prompt=PromptGuidance(seen.tagged, 1.5))
        exact = policy.backend.sample(inputs, x_1, 10, conditioning=wanted).actions[0].numpy()
        np.testing.assert_array_equal(found, policy.pipeline.after(exact, seen.state)["actions"])
        assert {"guidance": 1.5, "guidance_tag": TAG}.items() <= policy.metadata.items()
        (both, _) = policy.infer_batch([observation, policy.example_observation(1)], seed=3)
        np.testing.assert_allclose(both["actions"], found, rtol=0, atol=1e-4)
        assert not policy.runs_batches and policy.batch_modes == ()

    @pytest.mark.slow
    def test_the_captured_backend_computes_the_references(self, tiny: Any, policy: UnifiedPolicy) -> None:
        ours, observation = policy_on(OnCpu, tiny, guidance=1.5, guidance_tag=TAG), policy.example_observation()
        expected = policy.infer(observation, seed=0, solver="ab2", num_steps=4)["actions"]
        found = ours.infer(observation, seed=0, solver="ab2", num_steps=4)["actions"]
        np.testing.assert_allclose(found, expected, rtol=0, atol=2e-5)
        left_over = np.ones((8, 32), np.float32)
        chunk = RunningChunk(left_over, delay=2, execution_horizon=3, mode="rtc_identity")
        np.testing.assert_allclose(
            ours.infer(observation, seed=0, previous=chunk)["actions"],
            policy.infer(observation, seed=0, previous=chunk)["actions"],
            rtol=0,
            atol=2e-4,
        )
        assert "rtc" in policy.metadata["real_time"]["modes"]
        assert "rtc" not in ours.metadata["real_time"]["modes"]
        jacobian = RunningChunk(left_over, delay=2, execution_horizon=3, mode="rtc")
        with pytest.raises(ObservationError, match=r"no guidance by the true Jacobian .* take mode rtc_identity"):
            ours.infer(observation, previous=jacobian)
        assert np.isfinite(ours.infer(observation, previous=jacobian, guidance=1)["actions"]).all()

    def test_warm_up_covers_the_policys_own_calls(self, tiny: Any) -> None:
        policy = policy_on(Unrun, tiny, guidance=1.5, guidance_tag=TAG, strict=True)
        policy.warmup(cameras=2)
        policy.infer(policy.example_observation(), guidance=2)
        with pytest.raises(ObservationError, match="strict"):
            policy.infer(policy.example_observation(), guidance=1)

    @pytest.mark.parametrize(
        ("options", "message"),
        [
            ({"guidance": 1.5}, "guidance=1.5 was asked for, .* give guidance_tag=TEXT, too"),
            ({"guidance": 101, "guidance_tag": TAG}, "the guidance is 101; it should be a number from 0 to 100"),
            ({"guidance_tag": " "}, "guidance_tag is ' '"),
        ],
    )
    def test_what_can_be_no_guidance_is_refused_before_weights_are_read(
        self, tiny: Any, options: Any, message: str
    ) -> None:
        with pytest.raises(ConfigError, match=message):
            made_of(tiny, **options)

    def test_calls_of_a_policy_without_a_tag_and_other_families_refuse(
        self, plain: UnifiedPolicy, policy: UnifiedPolicy
    ) -> None:
        with pytest.raises(ObservationError, match="this policy has no tag: give guidance_tag=TEXT where it is made"):
            plain.infer(plain.example_observation(), guidance=1.5)
        with pytest.raises(ObservationError, match="guidance was given twice"):
            policy.infer(policy.example_observation(), conditioning=Conditioning(prompt=PromptGuidance(TAGGED, 2.0)))
        with pytest.raises(ConfigError, match=r"is for Pi0\.5 and Pi0, not for Pi0-FAST"):
            made_of(random_checkpoint("pi0_fast_tiny"), guidance_tag=TAG)

    def test_the_command_line_says_it_in_its_own_words(self) -> None:
        options = ("--random-weights", "pi05_tiny", "--device", "cpu", "--guidance", "2")
        found = text_of(turbopi("verify", *options).stderr)
        assert "error: --guidance 2.0 was asked for" in found and "give --guidance-tag TEXT, too" in found


def test_over_the_wire_it_is_a_key_beside_the_observation() -> None:
    guided_one = RealTime({"guidance": 1.5}, ServerOptions(), Metrics())
    plain_one = RealTime({}, ServerOptions(), Metrics())
    plan = guided_one.plan({"place": 0, "turbopi/guidance": 2}, "c")
    assert plan.observation == {"place": 0} and plan.arguments == {"guidance": 2.0}
    joins = RealTime({"guidance": 1.0, "real_time": {"modes": ["rtc"]}}, ServerOptions(), Metrics())
    more = joins.plan({"place": 0, "turbopi/guidance": 2, "turbopi/seed": 1, "turbopi/model_actions": True}, "c")
    assert more.arguments == {"guidance": 2.0, "seed": 1, "previous": None, "model_actions": True}
    with pytest.raises(ObservationError, match=r"turbopi/guidance is for a policy with a tag.* --guidance-tag"):
        plain_one.plan({"place": 0, "turbopi/guidance": 2}, "c")
    with pytest.raises(ObservationError, match="turbopi/guidance is 'much'; it should be a number"):
        guided_one.plan({"place": 0, "turbopi/guidance": "much"}, "c")


def test_a_golden_case_is_the_plain_one_at_0() -> None:
    """openpi's own numbers, through the path of two prompts."""
    case = golden_cases()["b_third_masked"]
    rows = case.noise.shape[0]
    zero = [Conditioning(prompt=PromptGuidance(TAGGED, 0.0))] * rows
    ours = golden_model("pi05").sample(case.observation, case.noise, 10, conditioning=zero)
    close(ours, golden_model("pi05").sample(case.observation, case.noise, 10))
