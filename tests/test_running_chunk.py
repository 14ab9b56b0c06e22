"""Calls that join a running chunk: what `previous` becomes, relative actions re-anchored, and every refusal."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from checkpoint_helpers import lerobot_copy
from conftest import golden_model
from policy_helpers import policy_on
from test_begin import OnCpu
from test_policy import golden_policy

from turbopi import UnifiedPolicy, open_checkpoint
from turbopi.backends.pytorch import PyTorchBackend
from turbopi.checkpoint import Checkpoint, random_checkpoint
from turbopi.checkpoint.convert import convert
from turbopi.config import RealTime
from turbopi.models.observation import Observation
from turbopi.models.pi0.conditioning import Conditioning, Guidance, TokenTimes, guidance_strength, guidance_weights
from turbopi.models.pi0.denoise import time_grid
from turbopi.models.pi0.solvers import Integration
from turbopi.policy.chunk_conditioning import ChunkConditioning
from turbopi.realtime.running_chunk import RunningChunk
from turbopi.support.errors import CheckpointError, ConfigError, ObservationError

pytestmark = pytest.mark.usefixtures("two_layers")

H, A = 10, 32
TRAINED = RealTime(trained_max_delay=3)


def rows(count: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal((count, A)).astype(np.float32)


def completed(chunk: RunningChunk, options: RealTime = TRAINED, relative: bool = False) -> RunningChunk:
    return chunk.completed(H, A, relative=relative, options=options)


def conditioning(chunk: RunningChunk, options: RealTime = TRAINED) -> Conditioning:
    done = completed(chunk, options)
    return done.conditioning(done.left_over, 4, H, "accumulated")


def trained_policy(engine: type[OnCpu] | None = None) -> UnifiedPolicy:
    """Trained with simulated delays. With an engine without its graphs it runs observations together."""
    checkpoint = random_checkpoint("pi05_tiny")
    checkpoint = dataclasses.replace(checkpoint, config=dataclasses.replace(checkpoint.config, real_time=TRAINED))
    return policy_on(engine or PyTorchBackend, checkpoint, num_denoising_steps=2)


@pytest.fixture(scope="module")
def policy() -> UnifiedPolicy:
    return trained_policy()


def test_guided_modes_pull_towards_the_left_over_before_h_minus_s() -> None:
    left_over = rows(7)
    for mode, guidance in (("rtc", "jacobian"), ("rtc_identity", "identity")):
        requested = conditioning(RunningChunk(left_over, 2, 4, mode=mode))  # type: ignore[arg-type]
        assert requested.guidance is not None and requested.guidance.mode == guidance and requested.held is None
        np.testing.assert_array_equal(requested.guidance.target[:7], left_over)
        np.testing.assert_array_equal(requested.guidance.weights, guidance_weights(H, 2, 4))
        times = np.repeat(time_grid(4)[:, None], H, 1)
        np.testing.assert_array_equal(requested.guidance.strength, guidance_strength(times, 5.0))


def test_nothing_pulls_towards_what_is_not_there() -> None:
    for s in (None, 2):
        requested = conditioning(RunningChunk(rows(6), 2, s))
        assert requested.guidance is not None
        np.testing.assert_array_equal(requested.guidance.weights, guidance_weights(H, 2, 4))
    assert completed(RunningChunk(rows(10), 0)).execution_horizon == 1
    assert completed(RunningChunk(rows(10), 4)).execution_horizon == 4, "as many are carried out meanwhile"


def test_the_policys_options_are_taken_where_the_chunk_says_nothing() -> None:
    options = RealTime(execution_horizon=6, schedule="linear", max_guidance_weight=10.0)
    requested = conditioning(RunningChunk(rows(8), 2), options).guidance
    assert requested is not None
    np.testing.assert_array_equal(requested.weights, guidance_weights(H, 2, 6, "linear"))
    assert requested.strength.max() == 10
    assert completed(RunningChunk(rows(8), 7), options).execution_horizon == 3, "a long delay cuts it"
    own = completed(RunningChunk(rows(8), 2, 3, schedule="ones", max_guidance_weight=1.0), options)
    assert (own.execution_horizon, own.schedule, own.max_guidance_weight) == (3, "ones", 1.0)


@pytest.mark.parametrize(
    ("end", "delay", "left", "expected"),
    [
        (6, 2, 8, [1, 1, 0.8, 0.6, 0.4, 0.2, 0, 0, 0, 0]),
        (6, 7, 8, [1, 1, 1, 1, 1, 1, 0, 0, 0, 0]),  # a delay past the mask's end is cut to it
        (4, 4, 4, [1, 1, 1, 1, 0, 0, 0, 0, 0, 0]),
        (9, 1, 3, [1, 2 / 3, 1 / 3, 0, 0, 0, 0, 0, 0, 0]),  # the left-over ends first
        (10, 0, 4, [0.8, 0.6, 0.4, 0.2, 0, 0, 0, 0, 0, 0]),  # as long as the chunk or longer: the left-over ends it
        (10, 9, 10, [1, 1, 1, 1, 1, 1, 1, 1, 1, 0.5]),
    ],
)
def test_identity_without_an_execution_horizon_has_lerobots_mask(
    end: int, delay: int, left: int, expected: list[float]
) -> None:
    """LeRobot's execution_horizon is the mask's end e, which a checkpoint's options hold as s = H − e, or None."""
    options = RealTime(execution_horizon=H - end if end < H else None, schedule="linear", max_guidance_weight=10.0)
    requested = conditioning(RunningChunk(rows(left), delay, mode="rtc_identity"), options).guidance
    assert requested is not None
    np.testing.assert_allclose(requested.weights, expected, rtol=1e-6)


@pytest.mark.parametrize(("horizon", "s"), [(8, 2), (10, 4), (12, 6), (5, 1)])
def test_identitys_mask_ends_where_it_does_in_chunks_of_another_length(
    policy: UnifiedPolicy, horizon: int, s: int
) -> None:
    """Of a policy whose mask ends at 6; a shorter chunk's ends with the left-over of 4."""
    config = dataclasses.replace(policy.config, real_time=RealTime(execution_horizon=H - 6))
    joining = ChunkConditioning(config, policy._pipeline, policy.backend)
    ((_, chunk),) = joining.checked([None], [RunningChunk(rows(4), 1, mode="rtc_identity")], 2, horizon).rows
    assert chunk is not None and chunk.execution_horizon == s


def test_identity_with_an_execution_horizon_of_its_own_needs_room_for_the_delay() -> None:
    with pytest.raises(ObservationError, match="a delay of 4 and an execution horizon of 7 don't fit a chunk of 10"):
        completed(RunningChunk(rows(8), 4, 7, mode="rtc_identity"))


def test_trained_mode_holds_what_will_be_carried_out() -> None:
    left_over = rows(7)
    requested = conditioning(RunningChunk(left_over, 3, mode="rtc_trained"))
    assert requested.guidance is None and requested.held is not None and requested.values is not None
    np.testing.assert_array_equal(requested.held, np.arange(H) < 3)
    np.testing.assert_array_equal(requested.values[:3], left_over[:3])
    assert conditioning(RunningChunk(left_over, 0, mode="rtc_trained")).form == "plain"


@pytest.mark.parametrize(
    ("chunk", "message"),
    [
        (RunningChunk(rows(7)[:, :7], 1), "actions have 7 values, but this model's have 32: .* model_actions"),
        (RunningChunk(rows(11), 1), "the left-over has 11 actions; it should be 1 to the chunk's 10"),
        (RunningChunk(rows(0), 0), "has 0 actions; .* leave `previous` out"),
        (RunningChunk(rows(7)[0], 1), r"has shape \[32\]"),
        (RunningChunk(np.full((2, A), np.nan), 1), "aren't finite"),
        (RunningChunk(np.full((2, A), 1e300), 1), "aren't finite"),
        (RunningChunk("abc", 1), "it should be numbers"),  # type: ignore[arg-type]
        (RunningChunk(rows(4), 5), "the delay is 5 control steps, but 4 actions are left over"),
        (RunningChunk(rows(4), -1), "the delay is -1"),
        (RunningChunk(rows(4), True), "the delay is True"),
        (RunningChunk(rows(4), 1.0), "the delay is 1.0"),  # type: ignore[arg-type]
        (RunningChunk(rows(8), 6), "a delay of 6 and an execution horizon of 6 don't fit a chunk of 10"),
        (RunningChunk(rows(8), 4, 7), "a delay of 4 and an execution horizon of 7 don't fit a chunk of 10"),
        (RunningChunk(rows(8), 1, 0), "the execution horizon is 0; .* from 1 on"),
        (RunningChunk(rows(8), 4, mode="rtc_trained"), "the delay is 4 .* trained with delays up to 3"),
        (RunningChunk(rows(8), 1, mode="other"), "the mode is 'other'"),  # type: ignore[arg-type]
        (RunningChunk(rows(8), 1, schedule="cosine"), "the schedule is 'cosine'"),  # type: ignore[arg-type]
        (RunningChunk(rows(8), 1, max_guidance_weight=-1.0), "max_guidance_weight is -1.0"),
        (RunningChunk(rows(8), 1, max_guidance_weight=float("nan")), "max_guidance_weight is nan"),
        *(
            (RunningChunk(rows(8), 1, mode=mode, schedule="linear"), f"{mode} doesn't guide")
            for mode in ("rtc_trained", "paint")
        ),
        (RunningChunk(rows(8), 1, anchor=np.zeros(8)), "aren't relative to the state: leave the anchor out"),
        (rows(8), "its previous is of type ndarray; it should be a RunningChunk, or None"),
    ],
)
def test_what_cannot_be_joined_is_refused(policy: UnifiedPolicy, chunk: RunningChunk, message: str) -> None:
    with pytest.raises(ObservationError, match=message):
        policy.infer(policy.example_observation(), previous=chunk)


def test_trained_mode_needs_weights_that_were_trained_so() -> None:
    with pytest.raises(ObservationError, match=r'trained with simulated delays.*mode "rtc".*trained_max_delay'):
        completed(RunningChunk(rows(7), 0, mode="rtc_trained"), RealTime())


def test_relative_actions_need_their_anchor() -> None:
    with pytest.raises(ObservationError, match="give the anchor that came with the left-over"):
        completed(RunningChunk(rows(7), 1), relative=True)


# -- the policy --------------------------------------------------------------------------------------------------------


def test_a_calls_model_actions_are_the_next_ones_left_over(policy: UnifiedPolicy) -> None:
    observation = policy.example_observation()
    first = policy.infer(observation, seed=0, model_actions=True)
    assert first["model_actions"].dtype == np.float32 and first["model_actions"].shape == (H, A)
    assert "anchor" not in first and "model_actions" not in policy.infer(observation, seed=0)
    left_over = first["model_actions"][4:]
    joined = policy.infer(
        observation, seed=1, previous=RunningChunk(left_over, 3, mode="rtc_trained"), model_actions=True
    )
    np.testing.assert_array_equal(joined["model_actions"][:3], left_over[:3])
    np.testing.assert_array_equal(joined["actions"][:3], first["actions"][4:7])
    fresh = policy.infer(observation, seed=1, model_actions=True)["model_actions"]
    for mode in ("rtc", "rtc_identity"):
        pulled = policy.infer(
            observation,
            seed=1,
            num_steps=5,
            previous=RunningChunk(left_over, 3, mode=mode),
            model_actions=True,
        )["model_actions"]
        seams = [np.linalg.norm(chunk[:3] - left_over[:3]) for chunk in (pulled, fresh)]
        assert seams[0] < 0.5 * seams[1], mode


def test_a_plain_call_keeps_its_bits_beside_joined_ones(policy: UnifiedPolicy) -> None:
    observation = policy.example_observation()
    before = policy.infer(observation, seed=3)["actions"]
    policy.infer(observation, seed=3, previous=RunningChunk(rows(8), 2))
    np.testing.assert_array_equal(policy.infer(observation, seed=3)["actions"], before)
    np.testing.assert_array_equal(policy.infer(observation, seed=3, conditioning=Conditioning())["actions"], before)
    nothing_held = RunningChunk(rows(8), 0, mode="rtc_trained")
    np.testing.assert_array_equal(policy.infer(observation, seed=3, previous=nothing_held)["actions"], before)


def test_token_times_bring_their_number_of_steps(policy: UnifiedPolicy) -> None:
    observation, requested = policy.example_observation(), Conditioning(TokenTimes.plain(5, H))
    expected = policy.infer(observation, seed=0, num_steps=5)["actions"]
    np.testing.assert_array_equal(policy.infer(observation, seed=0, conditioning=requested)["actions"], expected)
    with pytest.raises(ObservationError, match="token times"):
        policy.infer(observation, conditioning=requested, num_steps=4)
    with pytest.raises(ObservationError, match="both given"):
        policy.infer(observation, conditioning=requested, previous=RunningChunk(rows(8), 2))


@pytest.mark.parametrize("how", [{}, {"solver": "ab2", "num_steps": 3}, {"time_grid": (1.0, 0.7, 0.2, 0.0)}], ids=str)
def test_a_warm_start_begins_with_the_left_over_at_60_percent_noise(
    policy: UnifiedPolicy, engine: UnifiedPolicy, how: dict[str, Any]
) -> None:
    """By every solver, alone and in batches, beside plain observations; without it noise is noise."""
    observation, left_over = policy.example_observation(), rows(8)
    joined = RunningChunk(left_over, 2, mode="warm_start")
    found = policy.infer(observation, seed=4, previous=joined, **how)["actions"]
    noise = np.random.default_rng(4).standard_normal((H, A), dtype=np.float32)
    begun = np.float32(0.6) * noise + np.float32(0.4) * left_over[[*range(8), 7, 7]]
    times = {"ab2": [1, 2 / 3, 1 / 3, 0]}.get(how.get("solver", ""), how.get("time_grid", [1, 0.5, 0]))
    integration = Integration(how.get("solver", "euler"), tuple(0.6 * t for t in times))
    inputs = Observation.stack([policy.prepare(observation)])
    x_t, loop = torch.from_numpy(begun)[None], Conditioning(integration=integration)
    exact = policy.backend.sample(inputs, x_t, integration.evaluations, conditioning=loop).actions[0]
    np.testing.assert_allclose(found, policy.pipeline.after(exact.numpy(), np.zeros(8))["actions"], rtol=0, atol=1e-5)
    both = engine.infer_batch([observation] * 2, seed=[4, 4], previous=[joined, None], **how)
    np.testing.assert_allclose(both[0]["actions"], found, rtol=0, atol=1e-4)
    plain = policy.infer(observation, seed=4, **how)["actions"]
    np.testing.assert_allclose(both[1]["actions"], plain, rtol=0, atol=1e-4)
    assert np.abs(found - plain).max() > 1e-3


def test_weights_of_one_step_have_no_warm_start(policy: UnifiedPolicy, monkeypatch: pytest.MonkeyPatch) -> None:
    one_step = dataclasses.replace(policy.config, one_step=True)
    monkeypatch.setattr(policy._conditioning, "_config", one_step)
    assert "warm_start" not in policy.metadata["real_time"]["modes"]
    with pytest.raises(ObservationError, match="distilled for one step from noise alone"):
        policy.infer(policy.example_observation(), previous=RunningChunk(rows(8), 2, mode="warm_start"))


def test_metadata_says_what_can_be_joined(policy: UnifiedPolicy, monkeypatch: pytest.MonkeyPatch) -> None:
    said = policy.metadata["real_time"]
    assert (
        said["modes"] == ["rtc", "rtc_identity", "rtc_trained", "warm_start", "paint"]
        and said["trained_max_delay"] == 3
    )
    monkeypatch.setattr(type(policy.backend), "forms", ("tokens",))
    assert policy.metadata["real_time"]["modes"] == ["rtc_identity", "rtc_trained"]


def test_a_backend_that_cannot_says_which_can(policy: UnifiedPolicy, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(type(policy.backend), "forms", ("tokens",))
    observation = policy.example_observation()
    policy.infer(observation, previous=RunningChunk(rows(8), 2, mode="rtc_identity"))
    message = "backend 'pytorch' has no guidance by the true Jacobian; leave out conditioning and previous"
    with pytest.raises(ObservationError, match=message):
        policy.infer(observation, previous=RunningChunk(rows(8), 2))
    with pytest.raises(ConfigError, match="real-time mode 'rtc'; this policy has rtc_identity, rtc_trained"):
        policy.warmup(real_time="rtc")
    monkeypatch.setattr(type(policy.backend), "forms", ())
    with pytest.raises(ObservationError, match="held actions or guidance by token"):
        policy.infer(observation, conditioning=Conditioning(held=np.ones(H, bool), values=rows(H)))
    requested = Conditioning(TokenTimes.plain(2, H))
    with pytest.raises(ConfigError, match="warm-up: backend 'pytorch' has no times"):
        policy.warmup(conditioning=[requested])


def test_warm_up_takes_modes_and_examples(policy: UnifiedPolicy, monkeypatch: pytest.MonkeyPatch) -> None:
    requested: list[Any] = []
    monkeypatch.setattr(policy.backend, "warmup", lambda *args, **options: requested.append((args[1:], options)))
    own = Conditioning(TokenTimes.plain(7, H))
    policy.warmup(cameras=2, steps=[2, 3], real_time=["rtc", "rtc_trained"], conditioning=[own])
    loops = [(loop, options.get("conditioning")) for loop, options in requested]
    forms = [(loop, None if one is None else one.form) for loop, one in loops]
    assert forms == [
        *(((2, H), None), ((3, H), None), ((2, H), "jacobian"), ((3, H), "jacobian")),
        *(((2, H), "tokens"), ((3, H), "tokens"), ((7, H), "tokens")),
    ]
    assert [options["last"] for _, options in requested] == [False] * 6 + [True]


# -- relative actions --------------------------------------------------------------------------------------------------


def test_a_left_over_keeps_its_absolute_actions_when_the_state_has_moved() -> None:
    policy, observation, _ = golden_policy("aloha_pi0", precision="f32")
    pipeline = policy.pipeline
    first = policy.infer(observation, seed=0, model_actions=True)
    old, mask = first["anchor"], np.array(pipeline.robot.delta_mask)
    assert old.shape == mask.shape and old.dtype == np.float64
    moved = dict(observation) | {"state": np.asarray(observation["state"]) + np.linspace(0.01, 0.2, 14)}
    _, state = pipeline.before(moved)
    left_over = first["model_actions"][3:]
    again = pipeline.reanchored(left_over, old, state)
    assert again.dtype == np.float32 and again.shape == left_over.shape
    _, before = pipeline.before(observation)
    expected = pipeline.after(left_over, before)["actions"]
    np.testing.assert_allclose(pipeline.after(again, state)["actions"], expected, atol=1e-5)
    assert np.abs(pipeline.after(left_over, state)["actions"] - expected).max() > 0.1
    unchanged = np.ones(A, bool)
    unchanged[np.flatnonzero(mask)] = False
    np.testing.assert_array_equal(again[:, unchanged], left_over[:, unchanged])
    joined = policy.infer(moved, seed=1, previous=RunningChunk(left_over, 2, anchor=old), model_actions=True)
    np.testing.assert_array_equal(joined["anchor"], np.asarray(pipeline.anchor(state)))
    far = np.where(mask, 1e300, 0.0)
    for anchor, message in (
        (old[:3], r"shape \[3\]"),
        (old * np.nan, "14 finite numbers"),
        (far, r"moved from its anchor to the new state, isn't finite in float32 at \[0, 0\]: .* the anchor 1e\+300"),
    ):
        with pytest.raises(ObservationError, match=message):
            policy.infer(moved, previous=RunningChunk(left_over, 2, anchor=anchor))


# -- LeRobot's config --------------------------------------------------------------------------------------------------


def lerobot(folder: Path, settings: dict[str, Any] | None = None, **config: Any) -> Checkpoint:
    lerobot_copy(folder, **config)
    heads = golden_model("pi05").config.vision.num_heads
    (folder / "turbopi.json").write_text(json.dumps({"vision_heads": heads, **(settings or {})}))
    return open_checkpoint(folder)


def test_lerobots_rtc_config_is_the_default(tmp_path: Path) -> None:
    rtc = {"enabled": True, "execution_horizon": 6, "prefix_attention_schedule": "EXP", "max_guidance_weight": 3}
    asks = lerobot(tmp_path / "a", rtc_config=rtc, rtc_training_max_delay=4)
    horizon = asks.config.model.action_horizon
    assert asks.config.real_time == RealTime(4, horizon - 6, "exponential", 3.0)
    assert "rtc_config" in " ".join(asks.info()["notes"]) and "rtc_training" not in " ".join(asks.info()["notes"])
    off = lerobot(tmp_path / "b", rtc_config=rtc | {"enabled": False})
    assert off.config.real_time == RealTime()
    long = lerobot(tmp_path / "c", rtc_config={"enabled": True, "execution_horizon": 999})
    assert long.config.real_time == RealTime(0, None, "linear", 10.0)
    for name, value in (("prefix_attention_schedule", "COS"), ("max_guidance_weight", "x"), ("execution_horizon", 0)):
        with pytest.raises(CheckpointError, match=name):
            lerobot(tmp_path / name, rtc_config={"enabled": True, name: value})


def test_a_turbopi_json_says_how_the_weights_were_trained(tmp_path: Path) -> None:
    said = {"trained_max_delay": 6, "schedule": "linear", "execution_horizon": None}
    mine = lerobot(tmp_path / "a", {"real_time": said}, rtc_training_max_delay=4)
    assert mine.config.real_time == RealTime(6, None, "linear", 5.0)
    for wrong in ({"trained_max_delay": -1}, {"trained": 3}, {"schedule": "cosine"}, 3, {"max_guidance_weight": "x"}):
        with pytest.raises(ConfigError, match=r"real_time is .* expected an object with trained_max_delay"):
            lerobot(tmp_path / str(wrong), {"real_time": wrong})


def test_conversion_keeps_how_the_weights_were_trained(tmp_path: Path) -> None:
    mine = lerobot(tmp_path / "a", rtc_training_max_delay=4)
    convert(mine, tmp_path / "b", precision="f32")
    assert open_checkpoint(tmp_path / "b").config.real_time == RealTime(4)


def test_guidance_of_an_unused_dimension_is_the_left_overs_own(policy: UnifiedPolicy) -> None:
    """Dimensions past the robot's are the model's, too: they are returned, and pulled to what they were."""
    first = policy.infer(policy.example_observation(), seed=0, model_actions=True)["model_actions"]
    assert np.abs(first[:, 7:]).max() > 0
    requested = conditioning(RunningChunk(first[2:], 1))
    assert isinstance(requested.guidance, Guidance)
    np.testing.assert_array_equal(requested.guidance.target[: H - 2, 7:], first[2:, 7:])
    assert torch.from_numpy(requested.guidance.target[H - 2 :]).abs().max() == 0


# -- batches -----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def engine() -> UnifiedPolicy:
    return trained_policy(OnCpu)


CHUNKS = [
    RunningChunk(rows(8), 2, 4, "rtc_identity"),
    None,
    RunningChunk(rows(6, 1), 3, mode="rtc_trained"),
    RunningChunk(rows(7, 2), 1, 5, "rtc"),
    RunningChunk(rows(7, 3), 0, mode="rtc_trained"),
]


@pytest.mark.slow
@pytest.mark.parametrize("which", ["policy", "engine"])
def test_a_batch_joins_a_chunk_in_each_row_as_infer_does(which: str, request: pytest.FixtureRequest) -> None:
    policy: UnifiedPolicy = request.getfixturevalue(which)
    seen = [policy.example_observation(seed) for seed in range(5)]
    reported = [True, False, True, False, True]
    together = policy.infer_batch(seen, seed=[4, 5, 6, 7, 8], previous=CHUNKS, model_actions=reported)
    for i, (one, obs, chunk) in enumerate(zip(together, seen, CHUNKS, strict=True)):
        alone = policy.infer(obs, seed=4 + i, previous=chunk, model_actions=True)
        np.testing.assert_allclose(one["actions"], alone["actions"], atol=1e-4)
        assert ("model_actions" in one) == reported[i]
        if reported[i]:
            np.testing.assert_allclose(one["model_actions"], alone["model_actions"], atol=1e-4)
    np.testing.assert_array_equal(together[2]["model_actions"][:3], CHUNKS[2].left_over[:3])  # type: ignore[union-attr]
    plain = policy.infer_batch(seen, seed=4)
    assert all("model_actions" not in one for one in plain)
    if isinstance(policy.backend, OnCpu):
        batches = policy.backend.describe()["batches"]
        assert any(one.startswith("4 observations") and "by token" in one for one in batches), "all but the one guided"


@pytest.mark.slow
def test_a_batch_takes_conditionings_beside_running_chunks(engine: UnifiedPolicy) -> None:
    """Times of its own bring the number of steps, for all rows."""
    seen = [engine.example_observation(seed) for seed in range(3)]
    warm = Conditioning(tokens=TokenTimes.of(np.linspace(0.5, 0, 4)[:, None].repeat(H, 1)))
    reported: list[Conditioning | None] = [None, warm, None]
    together = engine.infer_batch(seen, seed=1, conditioning=reported, previous=[CHUNKS[0], None, None])
    alone = [
        engine.infer(seen[0], seed=1, previous=CHUNKS[0], num_steps=3),
        engine.infer(seen[1], seed=2, conditioning=warm),
        engine.infer(seen[2], seed=3, num_steps=3),
    ]
    for one, expected in zip(together, alone, strict=True):
        np.testing.assert_allclose(one["actions"], expected["actions"], atol=1e-4)


@pytest.mark.slow
def test_relative_actions_of_a_batch_are_moved_to_each_rows_own_state(engine: UnifiedPolicy) -> None:
    moved: list[np.ndarray] = []
    pipeline = engine.pipeline

    def noted(left_over: np.ndarray, _: Any, state: np.ndarray) -> np.ndarray:
        moved.append(state)
        return left_over

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pipeline, "reanchored", noted)
        seen = [engine.example_observation(seed) for seed in range(3)]
        engine.infer_batch(seen, seed=0, previous=[CHUNKS[0], None, CHUNKS[3]])
    states = [pipeline.before(one)[1] for one in seen]
    np.testing.assert_array_equal(moved, [states[0], states[2]])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            {"previous": [CHUNKS[0]]},
            "previous has 1 entries for 2 observations; it should have one for each: a Run",
        ),
        (
            {"previous": CHUNKS[0]},
            "previous is of type RunningChunk; for a batch it should be a list of a Run",
        ),
        ({"previous": [None, {}]}, r"observation 1 of 2 \(from 0\): its previous is of type dict; it should be a Runn"),
        ({"conditioning": [None] * 3}, "conditioning has 3 entries for 2 observations"),
        (
            {"previous": [None, RunningChunk(rows(3), 5)]},
            r"observation 1 of 2 \(from 0\): the delay is 5 control",
        ),
        (
            {"conditioning": [Conditioning(held=np.ones(3, bool)), None]},
            r"observation 0 of 2 \(from 0\): held is bool of shape \[3\]; it should be bool of shape \[10\]",
        ),
        (
            {"previous": [None, CHUNKS[0]], "conditioning": [None, Conditioning()]},
            r"observation 1 of 2 \(from 0\): conditioning and previous were both given",
        ),
        (
            {"previous": [CHUNKS[0], None], "solver": "ab2"},
            r"observation 0 of 2 \(from 0\): a running chunk and solver 'ab2' were both given",
        ),
        ({"model_actions": [True]}, r"model_actions is \[True\]; it should be true or false, or a list of 2 of these"),
        ({"model_actions": "yes"}, "model_actions is 'yes'"),
    ],
)
def test_what_a_row_cannot_join_is_refused_with_its_number(
    engine: UnifiedPolicy, arguments: dict[str, Any], message: str
) -> None:
    with pytest.raises(ObservationError, match=message):
        engine.infer_batch([engine.example_observation()] * 2, seed=0, **arguments)


def test_warm_up_captures_batches_of_each_mode(engine: UnifiedPolicy, monkeypatch: pytest.MonkeyPatch) -> None:
    requested: list[tuple[Any, ...]] = []
    monkeypatch.setattr(engine.backend, "warmup", lambda *_, **__: None)
    monkeypatch.setattr(engine.backend, "warmup_batches", lambda _, *rest: requested.append(rest))
    engine.warmup(cameras=2, batches=[1, 4], real_time=["rtc", "rtc_trained"])
    forms = [None if one is None else one.form for *_, one in requested]
    assert forms == [None, "jacobian", "tokens"] and {rest[:2] for rest in requested} == {(2, H)}
    assert all(rest[2] == [1, 4] for rest in requested)
    assert engine.batch_modes == ("rtc", "rtc_identity", "rtc_trained", "warm_start")


def test_a_backend_that_runs_observations_one_by_one_has_no_modes_for_batches(policy: UnifiedPolicy) -> None:
    assert policy.batch_modes == () and not policy.runs_batches
