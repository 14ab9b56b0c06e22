"""UnifiedPolicy: openpi's actions end to end, its arguments, and every refusal."""

import dataclasses
import json
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from conftest import GOLDEN, golden_folder

from turbopi.checkpoint import Checkpoint, load_norm_stats, open_checkpoint, random_checkpoint
from turbopi.config import Normalization, NormMode, PiKind, PolicyConfig, preset
from turbopi.policy.policy import UnifiedPolicy
from turbopi.support.errors import BackendUnavailable, ConfigError, ObservationError, TokenizerError

pytestmark = pytest.mark.usefixtures("two_layers")
H = 10


class ByteTokenizer:
    """The golden fixtures' stand-in: BOS 2, then 3 + byte % 509."""

    def encode(self, text: str, add_bos: bool) -> list[int]:
        return [2] * add_bos + [3 + byte % 509 for byte in text.encode()]


def golden_policy(name: str, **options: Any) -> tuple[UnifiedPolicy, dict[str, Any], dict[str, np.ndarray]]:
    """The policy of a golden fixture, its observation, and everything the fixture stores."""
    settings = json.loads((GOLDEN / "policy/policy.json").read_text())[name]
    with np.load(GOLDEN / f"policy/{name}.npz") as archive:
        stored = {key: archive[key] for key in archive.files}
    kind: PiKind = settings["model"]
    mode: NormMode = "quantile" if settings["quantile_norm"] else "zscore"
    aloha = settings["robot"] == "aloha"
    config = PolicyConfig(
        name,
        golden_folder().model_config(kind),
        settings["robot"],
        Normalization(mode, mode),
        discrete_state_input=kind == "pi05",
        robot_options={"adapt_to_pi": settings["adapt_to_pi"], "delta_actions": True} if aloha else {},
    ).with_model(action_horizon=settings["action_horizon"])
    opened = open_checkpoint(golden_folder().checkpoint(kind).path, config)  # type: ignore[arg-type]
    stats = load_norm_stats(GOLDEN / f"preprocess/norm_stats/{settings['norm_stats']}/norm_stats.json")
    checkpoint = Checkpoint(**{**vars(opened), "norm_stats": stats})
    observation = {key.removeprefix("in/"): stored[key] for key in stored if key.startswith("in/")}
    if aloha:
        images = {key.removeprefix("images/"): observation.pop(key) for key in list(observation) if "images/" in key}
        observation["images"] = images
    return UnifiedPolicy(checkpoint, tokenizer=ByteTokenizer(), **options), observation, stored


@pytest.mark.parametrize("name", ["libero_pi05", "aloha_pi0"])
def test_the_policy_returns_openpis_actions(name: str) -> None:
    policy, observation, stored = golden_policy(name, precision="f32")
    actions = policy.infer(observation, noise=stored["noise"])["actions"]
    assert actions.dtype == np.float64
    spread = np.abs(stored["torch_fp32/actions"]).max()
    np.testing.assert_allclose(actions, stored["torch_fp32/actions"], rtol=0, atol=1e-5 * max(spread, 1))


@pytest.mark.parametrize("name", ["libero_pi05", "aloha_pi0"])
def test_the_bf16_policy_is_no_further_from_float32_than_openpis(name: str) -> None:
    policy, observation, stored = golden_policy(name, precision="bf16")
    actions = policy.infer(observation, noise=stored["noise"])["actions"]

    def error(ours: np.ndarray, exact: str) -> float:
        return float(np.sqrt(np.mean((ours - stored[exact]) ** 2)))

    openpis = max(error(stored[f"{kind}_bf16/actions"], f"{kind}_fp32/actions") for kind in ("torch", "jax"))
    assert 0 < error(actions, "torch_fp32/actions") <= 1.1 * openpis


@pytest.fixture(scope="module")
def policy() -> UnifiedPolicy:
    return UnifiedPolicy(random_checkpoint("pi05_tiny"), num_denoising_steps=2, precision="f32", device="cpu")


@pytest.mark.slow
def test_a_seed_or_noise_makes_the_result_deterministic(policy: UnifiedPolicy) -> None:
    observation = policy.example_observation()
    by_seed = policy.infer(observation, seed=3)["actions"]
    noise = np.random.default_rng(3).standard_normal((H, 32), dtype=np.float32)
    np.testing.assert_array_equal(by_seed, policy.infer(observation, noise=noise)["actions"])
    np.testing.assert_array_equal(by_seed, policy.infer(observation, seed=3)["actions"])
    assert not np.array_equal(by_seed, policy.infer(observation, seed=4)["actions"])
    assert not np.array_equal(policy.infer(observation)["actions"], policy.infer(observation)["actions"])


@pytest.mark.slow
def test_a_batch_equals_its_observations(policy: UnifiedPolicy) -> None:
    observations = [policy.example_observation(seed) for seed in range(3)]
    together = policy.infer_batch(observations, seed=[7, 8, 9])
    for i, observation in enumerate(observations):
        alone = policy.infer(observation, seed=7 + i)["actions"]
        np.testing.assert_allclose(together[i]["actions"], alone, rtol=0, atol=2e-5)
    np.testing.assert_array_equal(policy.infer_batch(observations, seed=7)[2]["actions"], together[2]["actions"])


def test_the_result_has_openpis_keys_and_true_times(policy: UnifiedPolicy) -> None:
    result = policy.infer(policy.example_observation(), seed=0)
    assert set(result) == {"actions", "policy_timing"}
    assert result["actions"].shape == (H, 7)
    timing = result["policy_timing"]
    stages = timing["vision_ms"] + timing["prefix_ms"] + timing["denoise_ms"]
    assert 0 < stages <= timing["infer_ms"] < timing["total_ms"]
    assert _sum_of_parts(timing) == pytest.approx(timing["total_ms"], rel=1e-6)


def _sum_of_parts(timing: dict[str, float]) -> float:
    return sum(timing[f"{part}_ms"] for part in ("preprocess", "queue", "infer", "postprocess"))


def test_openpis_brokers_and_agents_may_reset_it_and_write_to_its_actions(policy: UnifiedPolicy) -> None:
    before = policy.infer(policy.example_observation(), seed=1, model_actions=True)
    assert all(before[name].flags.writeable for name in ("actions", "model_actions"))
    policy.reset()
    np.testing.assert_array_equal(policy.infer(policy.example_observation(), seed=1)["actions"], before["actions"])


def test_num_steps_may_change_with_the_call(policy: UnifiedPolicy) -> None:
    observation = policy.example_observation()
    assert not np.array_equal(
        policy.infer(observation, seed=0)["actions"], policy.infer(observation, seed=0, num_steps=1)["actions"]
    )


def test_the_observation_is_left_as_it_was(policy: UnifiedPolicy) -> None:
    observation = policy.example_observation()
    before = {key: np.array(value, copy=True) for key, value in observation.items()}
    policy.infer(observation, seed=0)
    assert list(observation) == list(before)
    for key, value in before.items():
        np.testing.assert_array_equal(observation[key], value)


def test_metadata_says_what_runs_and_why(policy: UnifiedPolicy) -> None:
    metadata = json.loads(json.dumps(policy.metadata))
    assert metadata["backend"] == "pytorch"
    assert metadata["backend_reason"].startswith("auto: ")
    assert metadata["random_weights"] is True
    assert metadata["precision"] == "f32"
    assert metadata["action_horizon"] == H
    assert metadata["robot"] == "libero"
    assert metadata["load_seconds"] > 0


def test_aloha_metadata_has_its_reset_pose() -> None:
    policy, _, _ = golden_policy("aloha_pi0")
    assert policy.metadata["reset_pose"] == [0, -1.5, 1.5, 0, 0, 0]


def test_warmup_runs_all_that_a_call_runs_and_tells_the_seconds(monkeypatch: pytest.MonkeyPatch) -> None:
    policy = UnifiedPolicy(random_checkpoint("pi05_tiny"), backend="pytorch", device="cpu", num_denoising_steps=3)
    now, ran = 100.0, list[str]()

    def taking(name: str, seconds: float) -> Any:
        real = getattr(policy.backend, name)

        def run(observation: Any, *arguments: Any, **options: Any) -> Any:
            nonlocal now
            now += seconds
            steps = next(argument for argument in arguments if isinstance(argument, int))
            ran.append(f"{name}, {int(observation.image_mask.sum())} cameras, {steps} steps")
            return real(observation, *arguments, **options)

        return run

    for name, seconds in (("warmup", 20.0), ("sample", 0.5)):
        monkeypatch.setattr(policy.backend, name, taking(name, seconds))
    monkeypatch.setattr(time, "perf_counter", lambda: now)
    assert policy.warmup() == now - 100 >= 20.5
    assert ran[0] == "warmup, 2 cameras, 3 steps" and ran[-1] == "sample, 2 cameras, 3 steps"


@pytest.mark.parametrize("value", [0, -1, 1001, 2.5, True, "10"])
def test_a_wrong_number_of_steps_is_refused_at_construction(value: Any) -> None:
    with pytest.raises(ConfigError, match="whole number from 1 to 1000"):
        UnifiedPolicy(random_checkpoint("pi05_tiny"), num_denoising_steps=value)


def test_the_number_of_steps_is_the_configs_unless_it_is_given() -> None:
    checkpoint = random_checkpoint(dataclasses.replace(preset("pi05_tiny"), num_denoising_steps=7))
    assert UnifiedPolicy(checkpoint).metadata["num_denoising_steps"] == 7
    assert UnifiedPolicy(checkpoint, num_denoising_steps=3).metadata["num_denoising_steps"] == 3
    wrong = random_checkpoint(dataclasses.replace(preset("pi05_tiny"), num_denoising_steps=0))
    with pytest.raises(ConfigError, match="whole number from 1 to 1000"):
        UnifiedPolicy(wrong)


def test_noise_may_bring_its_batch_axis(policy: UnifiedPolicy) -> None:
    noise = np.random.default_rng(0).standard_normal((1, 10, 32))
    with_axis, without = (policy.infer(policy.example_observation(), noise=n)["actions"] for n in (noise, noise[0]))
    np.testing.assert_array_equal(with_axis, without)


@pytest.mark.parametrize(
    ("noise", "message"),
    [
        (0.5, r"noise has shape \[\]"),
        ([], r"noise has shape \[0\]"),
        (np.zeros((1, 10, 32), np.complex64), "noise isn't an array of numbers: its dtype is complex64"),
        (torch.zeros(1, 10, 32, requires_grad=True), "noise isn't an array of numbers: Can't call numpy"),
    ],
)
def test_odd_noise_of_a_batch_is_refused(policy: UnifiedPolicy, noise: Any, message: str) -> None:
    with pytest.raises(ObservationError, match=message):
        policy.infer_batch([policy.example_observation()], noise=noise)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"num_steps": 0}, "number of denoising steps is 0"),
        ({"noise": np.zeros((9, 32), np.float32)}, r"noise has shape \[9, 32\], but this policy needs \[10, 32\]"),
        ({"noise": np.full((10, 32), np.nan, np.float32)}, "noise has values that aren't finite"),
        ({"noise": "loud"}, "noise isn't an array of numbers"),
        ({"noise": np.zeros((10, 32), np.float32), "seed": 1}, "noise and seed were both given"),
        ({"seed": -1}, "seed -1 should be a whole number"),
        ({"seed": 1.5}, "seed 1.5 should be a whole number"),
    ],
)
def test_wrong_arguments_of_a_call_are_refused(policy: UnifiedPolicy, arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ObservationError, match=message):
        policy.infer(policy.example_observation(), **arguments)


ODD_VALUES = ["text", b"bytes", True, None, [], {}, np.zeros(0), np.float32(1), np.array("a"), np.zeros((2, 2)), 1j]


@pytest.mark.parametrize("key", ["observation/image", "observation/wrist_image", "observation/state", "prompt"])
@pytest.mark.parametrize("value", ODD_VALUES, ids=lambda value: repr(value)[:20])
def test_odd_values_are_the_callers_fault(policy: UnifiedPolicy, key: str, value: Any) -> None:
    if key == "prompt" and isinstance(value, str | bytes | np.ndarray) and np.ndim(value) == 0:
        pytest.skip("a prompt may be that")
    with pytest.raises(ObservationError):
        policy.infer({**policy.example_observation(), key: value}, seed=0)


def test_no_observation_at_all_is_refused(policy: UnifiedPolicy) -> None:
    with pytest.raises(ObservationError, match="given no observation"):
        policy.infer_batch([])


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"backend": "warp"}, ConfigError, "unknown backend 'warp'; choose one of pytorch"),
        ({"precision": "fp64"}, ConfigError, "unknown precision 'fp64'; choose one of bf16, f32"),
        ({"device": "tpu"}, ConfigError, "device 'tpu'"),
        ({"backend": "cuda_graph", "device": "cpu"}, BackendUnavailable, "CUDA graphs need an NVIDIA GPU"),
        ({"tokenizer": "/nowhere/tokenizer.model"}, TokenizerError, "/nowhere/tokenizer.model"),
    ],
)
def test_wrong_options_are_refused(options: dict[str, Any], error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        UnifiedPolicy(random_checkpoint("pi05_tiny"), **options)


def test_a_missing_checkpoint_is_named(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="nothing-here"):
        UnifiedPolicy(tmp_path / "nothing-here")
