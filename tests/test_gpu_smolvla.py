"""SmolVLA on a GPU: backend `cuda_graph` gives LeRobot's actions, `fused` what the reference does."""

from typing import Any

import numpy as np
import pytest
import torch
from smolvla_golden import GoldenRuns, make_checkpoint, make_hub

from turbopi import UnifiedPolicy
from turbopi.backends.base import StageTimer
from turbopi.backends.captured import CapturedBackend
from turbopi.checkpoint import Checkpoint, open_checkpoint
from turbopi.checkpoint.random_weights import random_checkpoint
from turbopi.models.observation import Observation, Past
from turbopi.models.pi0.conditioning import Conditioning, Guidance
from turbopi.support.errors import ObservationError

pytestmark = [pytest.mark.gpu, pytest.mark.filterwarnings("default")]  # Inductor warns of what it does


@pytest.fixture(scope="module")
def checkpoints(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Checkpoint]:
    root = tmp_path_factory.mktemp("smolvla")
    with pytest.MonkeyPatch.context() as environment:
        environment.setenv("HF_HUB_CACHE", str(make_hub(root / "hub")))
        return {
            name: open_checkpoint(make_checkpoint(name, root / name)) for name in ("base", "missing_camera", "bf16")
        }


def relative(ours: np.ndarray, theirs: np.ndarray) -> float:
    exact = theirs.astype(np.float64)
    return float(np.sqrt(np.square(ours - exact).mean() / np.square(exact).mean()))


@pytest.mark.parametrize("name", ["base", "missing_camera"])
def test_captured_float32_gives_lerobots_actions(name: str, checkpoints: dict[str, Checkpoint]) -> None:
    policy, golden = UnifiedPolicy(checkpoints[name], precision="f32", backend="cuda_graph"), GoldenRuns(name)
    for run in range(len(golden)):
        actions = policy.infer(golden.observation(run), noise=golden.noise)["actions"]
        assert relative(actions, golden.actions(run)) <= 2e-5


def test_captured_bfloat16_is_as_near_to_float32_as_lerobots(checkpoints: dict[str, Checkpoint]) -> None:
    policy, golden = UnifiedPolicy(checkpoints["bf16"], backend="cuda_graph"), GoldenRuns("bf16")
    for run in range(len(golden)):
        actions = policy.infer(golden.observation(run), noise=golden.noise)["actions"]
        exact = golden.actions(run, "float32/")
        assert relative(actions, exact) <= 2 * max(relative(golden.actions(run), exact), 1e-2)


def test_auto_takes_it_and_a_strict_policy_runs_what_was_warmed_up(checkpoints: dict[str, Checkpoint]) -> None:
    policy, golden = UnifiedPolicy(checkpoints["base"], precision="f32", strict=True), GoldenRuns("base")
    assert policy.metadata["backend"] == "cuda_graph"
    with pytest.raises(ObservationError, match="warmup"):
        policy.infer(golden.observation(0), noise=golden.noise)
    policy.warmup(cameras=[1, 2])
    for _ in range(2):
        for run in range(len(golden)):
            actions = policy.infer(golden.observation(run), noise=golden.noise)["actions"]
            assert relative(actions, golden.actions(run)) <= 2e-5


def test_a_conditioned_loop_and_a_batch_equal_the_references(checkpoints: dict[str, Checkpoint]) -> None:
    captured, plain = (
        UnifiedPolicy(checkpoints["base"], precision="f32", backend=name) for name in ("cuda_graph", "pytorch")
    )
    golden = GoldenRuns("base")
    target, weights = np.full((10, 32), 0.5, np.float32), np.linspace(1, 0, 10, dtype=np.float32)
    pull = Conditioning(guidance=Guidance(target, weights, np.ones((10, 10), np.float32), "identity"))
    held = Conditioning(held=np.arange(10) < 3, values=target)
    for one in (pull, held):
        both = [
            policy.infer(golden.observation(0), seed=1, conditioning=one)["actions"] for policy in (captured, plain)
        ]
        assert relative(*both) <= 2e-5
    prepared = Observation.stack([plain.prepare(golden.observation(0))])
    noise = torch.from_numpy(golden.noise)[None]
    traces = [policy.backend.intermediates(prepared, noise, 10) for policy in (captured, plain)]
    for name in ("kv_k", "kv_v", "x_t", "v_t", "actions"):
        ours, exact = (trace[name].cpu().numpy() for trace in traces)
        assert relative(ours, exact) <= 1e-4
    several = [golden.observation(run) for run in range(2)]
    rows = [policy.infer_batch(several, seed=1, conditioning=[None, pull]) for policy in (captured, plain)]
    assert all(relative(a["actions"], b["actions"]) <= 2e-5 for a, b in zip(*rows, strict=True))


def answer_without_waiting(policy: UnifiedPolicy, conditioning: Conditioning | None) -> None:
    """A call up to where its actions are read; PyTorch raises for what waits for the device before."""
    backend, config = policy.backend, policy.backend.config
    assert isinstance(backend, CapturedBackend)
    images = [np.full((48, 64, 3), fill, np.uint8) for fill in (20, 200)]
    inputs = [np.arange(3)], np.zeros((1, config.state_dim), np.float32)
    noise = np.random.default_rng(1).normal(size=(1, config.action_horizon, config.action_dim)).astype(np.float32)
    answers = []
    for mode in ("default", "error"):  # the first call captures
        torch.cuda.set_sync_debug_mode(mode)
        try:
            turn = backend.see([images], "lerobot", [Past()])
            made = backend.answer(turn, *inputs, noise, 10, conditioning, StageTimer(backend.device))
        finally:
            torch.cuda.set_sync_debug_mode("default")
        answers.append(made.actions.cpu().numpy())
    assert np.isfinite(answers[0]).all() and np.array_equal(answers[0], answers[1])


@pytest.mark.parametrize("form", ["plain", "held", "pulled"])
def test_no_captured_call_waits_for_the_device_before_its_actions(
    checkpoints: dict[str, Checkpoint], form: str
) -> None:
    policy = UnifiedPolicy(checkpoints["base"], precision="f32", backend="cuda_graph")
    target = np.full((10, 32), 0.5, np.float32)
    guidance = Guidance(target, np.linspace(1, 0, 10, dtype=np.float32), np.ones((10, 10), np.float32), "identity")
    given = {"held": Conditioning(held=np.arange(10) < 3, values=target), "pulled": Conditioning(guidance=guidance)}
    answer_without_waiting(policy, given.get(form))


def test_a_captured_batch_of_other_prompts_and_cameras_gives_lerobots_actions(
    checkpoints: dict[str, Checkpoint],
) -> None:
    for name in ("base", "missing_camera"):
        policy, golden = UnifiedPolicy(checkpoints[name], precision="f32", backend="cuda_graph"), GoldenRuns(name)
        runs = [run % len(golden) for run in range(3)]
        noise = np.stack([golden.noise] * len(runs))
        together = policy.infer_batch([golden.observation(run) for run in runs], noise=noise)
        for run, one in zip(runs, together, strict=True):
            assert relative(one["actions"], golden.actions(run)) <= 2e-5
        assert policy.metadata["backend_details"]["batches"]


# -- fused: its kernels take heads of at least 16 columns, which the golden models haven't; so the published sizes -----


@pytest.fixture(scope="module")
def published() -> Checkpoint:
    return random_checkpoint("smolvla_base")


@pytest.fixture(scope="module")
def policies(published: Checkpoint) -> dict[str, UnifiedPolicy]:
    return {
        "exact": UnifiedPolicy(published, backend="pytorch", precision="f32"),
        "ordinary": UnifiedPolicy(published, backend="pytorch"),
        "fused": UnifiedPolicy(published),
    }


def test_fused_waits_for_the_device_as_little(policies: dict[str, UnifiedPolicy]) -> None:
    answer_without_waiting(policies["fused"], None)


def seen(policy: UnifiedPolicy, seed: int, cameras: int, prompt: str) -> dict[str, Any]:
    observation = policy.example_observation(seed)
    (folder,) = {"image", "images"} & observation.keys()
    left = dict(list(observation[folder].items())[:cameras])
    assert len(left) == cameras
    return {**observation, folder: left, "prompt": prompt}


@pytest.mark.parametrize(("cameras", "prompt"), [(1, "a"), (2, "put the red cup on the plate " * 3), (3, "open it")])
def test_fused_is_as_near_to_float32_as_ordinary_bfloat16(
    policies: dict[str, UnifiedPolicy], cameras: int, prompt: str
) -> None:
    observation = seen(policies["exact"], 3, cameras, prompt)
    noise = np.random.default_rng(5).normal(size=(50, 32)).astype(np.float32)
    exact, ordinary, fused = (policies[name].infer(observation, noise=noise)["actions"] for name in policies)
    assert 0 < relative(fused, exact) <= 1.5 * relative(ordinary, exact)
    assert policies["fused"].metadata["backend"] == "fused"


def test_every_intermediate_of_fused_is_as_near(policies: dict[str, UnifiedPolicy]) -> None:
    observation = Observation.stack([policies["exact"].prepare(seen(policies["exact"], 7, 2, "go there"))])
    noise = torch.from_numpy(np.random.default_rng(6).normal(size=(1, 50, 32)).astype(np.float32))
    policies["fused"].backend.sample(observation, torch.full_like(noise, torch.nan), 10)  # which leaves nothing behind
    traces = [policies[name].backend.intermediates(observation, noise, 10) for name in policies]
    for name in ("kv_k", "kv_v", "x_t", "v_t", "actions"):
        exact, ordinary, fused = (trace[name].float().cpu().numpy() for trace in traces)
        assert relative(fused, exact) <= 1.5 * relative(ordinary, exact), name


def test_a_loop_of_other_steps_and_actions_and_a_conditioned_one(policies: dict[str, UnifiedPolicy]) -> None:
    observation = seen(policies["exact"], 4, 2, "close it")
    target, weights = np.full((50, 32), 0.3, np.float32), np.linspace(1, 0, 50, dtype=np.float32)
    pull = Conditioning(guidance=Guidance(target, weights, np.ones((10, 50), np.float32), "identity"))
    every: tuple[dict[str, Any], ...] = ({"num_steps": 3}, {"horizon": 20}, {"conditioning": pull})
    for options in every:
        exact, ordinary, fused = (policies[name].infer(observation, seed=2, **options)["actions"] for name in policies)
        assert relative(fused, exact) <= 1.5 * relative(ordinary, exact), options
    again = [policies["fused"].infer(observation, seed=2)["actions"] for _ in range(2)]
    assert np.array_equal(*again)


def test_a_strict_fused_policy_runs_what_was_warmed_up(published: Checkpoint) -> None:
    policy = UnifiedPolicy(published, backend="fused", strict=True)
    observation = seen(policy, 1, 2, "go")
    with pytest.raises(ObservationError, match="warmup"):
        policy.infer(observation)
    policy.warmup(cameras=[2])
    assert np.isfinite(policy.infer(observation)["actions"]).all()
    with pytest.raises(ObservationError, match="warmup"):
        policy.infer(observation, num_steps=7)
    policy.warmup(cameras=[2], batches=8)
    for count in (2, 5, 8):
        assert all(np.isfinite(one["actions"]).all() for one in policy.infer_batch([observation] * count, seed=1))


def test_a_fused_batch_of_other_prompts_and_cameras_is_as_near(policies: dict[str, UnifiedPolicy]) -> None:
    prompts = ["a", "put the red cup on the plate " * 3, "open it"]
    several = [seen(policies["exact"], 8 + row, 3 - row, prompt) for row, prompt in enumerate(prompts)]
    for count in (2, 3):
        exact, ordinary = (
            [policies[name].infer(one, seed=1 + row)["actions"] for row, one in enumerate(several[:count])]
            for name in ("exact", "ordinary")
        )
        for _ in range(2):
            fused = [one["actions"] for one in policies["fused"].infer_batch(several[:count], seed=1)]
            for ours, usual, right in zip(fused, ordinary, exact, strict=True):
                assert 0 < relative(ours, right) <= 1.5 * relative(usual, right)
    sizes = policies["fused"].metadata["backend_details"]["batches"]
    assert sizes == ["2 observations with up to 3 cameras", "4 observations with up to 3 cameras"]
