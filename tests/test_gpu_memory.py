"""Pi0.5 with memory on a GPU: backend `cuda_graph` gives LeRobot's actions, call after call."""

from pathlib import Path

import numpy as np
import pytest
from memory_golden import MemoryRuns, make_checkpoint
from smolvla_golden import relative

from turbopi import UnifiedPolicy
from turbopi.support.errors import ObservationError

pytestmark = [pytest.mark.gpu, pytest.mark.filterwarnings("default")]  # Inductor warns of what it does


@pytest.mark.parametrize("name", ["visual", "proprio", "select_action"])
def test_captured_calls_in_order_give_lerobots_actions(name: str, tmp_path: Path) -> None:
    checkpoint = make_checkpoint(name, tmp_path / name)
    policy = UnifiedPolicy(checkpoint, backend="cuda_graph", precision="f32", strict=True)
    golden, queue = MemoryRuns(name), list[np.ndarray]()
    with pytest.raises(ObservationError, match="warmup"):
        policy.infer(golden.observation(0))
    policy.warmup()
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
            assert asks_rarely or relative(actions, theirs["actions"]) <= 2e-5
        assert not asks_rarely or relative(queue.pop(0), theirs["selected"]) <= 2e-5


def test_bfloat16_is_as_near_to_float32_as_ordinary_bfloat16(tmp_path: Path) -> None:
    checkpoint, golden = make_checkpoint("visual", tmp_path / "visual"), MemoryRuns("visual")
    captured, ordinary = (UnifiedPolicy(checkpoint, backend=name) for name in ("cuda_graph", "pytorch"))
    errors = []
    for policy in (captured, ordinary):
        policy.reset()
        for run in range(3):
            if golden.resets(run):
                policy.reset()
            actions = policy.infer(golden.observation(run), noise=golden.noise)["actions"]
        errors.append(relative(actions, golden.expected(2)["actions"]))
    assert 0 < errors[0] <= 2 * errors[1]
