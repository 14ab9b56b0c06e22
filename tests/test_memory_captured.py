"""Backend `cuda_graph` of Pi0.5 with memory, its graphs run again on a CPU: what a capture holds asks no host."""

from pathlib import Path

import numpy as np
import pytest
from memory_golden import CASES, MemoryRuns, make_checkpoint
from replayed_graphs import replay_on_cpu
from smolvla_golden import relative

from turbopi import UnifiedPolicy
from turbopi.support.errors import ObservationError


@pytest.fixture
def on_cpu(monkeypatch: pytest.MonkeyPatch) -> None:
    replay_on_cpu(monkeypatch)


@pytest.mark.parametrize("name", CASES)
def test_captured_calls_in_order_give_lerobots_actions(name: str, tmp_path: Path, on_cpu: None) -> None:
    checkpoint = make_checkpoint(name, tmp_path / name)
    policy = UnifiedPolicy(checkpoint, backend="cuda_graph", precision="f32", device="cpu", strict=True)
    golden, queue = MemoryRuns(name), list[np.ndarray]()
    with pytest.raises(ObservationError, match="warmup"):
        policy.infer(golden.observation(0))
    policy.warmup()
    policy.reset()
    part, asks_rarely = "training/" if "proprio" in name or name == "select_action" else "", name == "select_action"
    for run in range(len(golden)):
        if golden.resets(run):
            policy.reset()
            queue.clear()
        theirs = golden.expected(run, part)
        if queue:
            policy.observe(golden.observation(run))
        else:
            actions = policy.infer(golden.observation(run), noise=golden.noise)["actions"]
            queue += list(actions[:3]) if asks_rarely else []
            assert asks_rarely or relative(actions, theirs["actions"]) <= 2e-6
        assert not asks_rarely or relative(queue.pop(0), theirs["selected"]) <= 2e-6


@pytest.mark.parametrize("name", CASES)
def test_a_batch_with_memories_is_its_observations_alone(name: str, tmp_path: Path, on_cpu: None) -> None:
    golden = MemoryRuns(name)
    policy = UnifiedPolicy(make_checkpoint(name, tmp_path / name), backend="cuda_graph", precision="f32", device="cpu")
    together, alone = ([policy.new_history() for _ in range(3)] for _ in range(2))
    for run in range(2):
        for one in (together[run], alone[run]):
            policy.observe(golden.observation(run), history=one)
    several = [golden.observation(2 - row) for row in range(3)]
    actions = [one["actions"] for one in policy.infer_batch(several, seed=1, histories=together)]
    for row, its in enumerate(actions):
        expected = policy.infer(several[row], seed=1 + row, history=alone[row])["actions"]
        assert relative(its, expected) <= 2e-6
    assert policy.metadata["backend_details"]["batches"]
