"""Text of Pi0.5 on a GPU: backends write the subtasks, and act on them, as LeRobot's code does."""

from pathlib import Path

import pytest
from smolvla_golden import relative
from test_policy_text import make_folder, policy_of, runs

pytestmark = [pytest.mark.gpu, pytest.mark.filterwarnings("default")]  # Inductor warns of what it does


@pytest.mark.parametrize("name", ["subtasks", "joint"])
@pytest.mark.parametrize("backend", ["cuda_graph", "pytorch"])
def test_float32_gives_lerobots_subtasks_and_actions(name: str, backend: str, tmp_path: Path) -> None:
    policy, golden = policy_of(make_folder(name, tmp_path / "c"), device="cuda", backend=backend), runs(name)
    policy.warmup()
    for run, described in enumerate(golden.described["runs"]):
        if described["begins"]:
            policy.reset()
        answer = policy.infer(golden.observation(run), noise=golden.noise)
        assert answer["subtask"] == str(golden.expected(run)["subtask"])
        assert relative(answer["actions"], golden.actions(run)) <= 1e-5


@pytest.mark.parametrize("name", ["subtasks", "joint"])
def test_bfloat16_is_as_near_to_float32_as_ordinary_bfloat16(name: str, tmp_path: Path) -> None:
    folder, golden, errors = make_folder(name, tmp_path / "c"), runs(name), []
    for backend in ("cuda_graph", "pytorch"):
        policy = policy_of(folder, device="cuda", backend=backend, precision="bf16")
        subtask = str(golden.expected(0)["subtask"])
        answer = policy.infer(golden.observation(0), noise=golden.noise, subtask=subtask)
        errors.append(relative(answer["actions"], golden.actions(0)))
    assert 0 < errors[0] <= 1.5 * errors[1]
