"""SmolVLA on a GPU: backend `cuda_graph` gives what the reference does, and LeRobot's actions."""

import numpy as np
import pytest
import torch
from smolvla_golden import GoldenRuns, make_checkpoint, make_hub

from turbopi import UnifiedPolicy
from turbopi.checkpoint import Checkpoint, open_checkpoint
from turbopi.models.observation import Observation
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
