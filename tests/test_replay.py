"""`turbopi replay`: the small policy on its own frames is right, and planted mistakes show."""

from collections.abc import Callable
from pathlib import Path

import pytest
from replay_data import write_npz

from turbopi.policy.policy import UnifiedPolicy
from turbopi.policy.shipped import SMALL_POLICY
from turbopi.replay import compare
from turbopi.replay.document import ReplayDocument
from turbopi.replay.opening import open_dataset
from turbopi.replay.report import Report
from turbopi.replay.run import Replay, Settings, select

EVERY = 10  # steps of an episode of the frames: its first alone has the observation of its images


@pytest.fixture(scope="module")
def policy() -> UnifiedPolicy:
    return UnifiedPolicy(SMALL_POLICY, device="cpu", precision="f32", num_denoising_steps=3)


@pytest.fixture
def replayed(policy: UnifiedPolicy, tmp_path: Path) -> Callable[..., ReplayDocument]:
    """The document of the small policy on a dataset."""

    def run(path: Path, every: int = EVERY, changed: int = 6, task: str | None = None) -> ReplayDocument:
        data, settings = open_dataset(path), Settings({}, task=task, changed=changed)
        replay = Replay(policy, data, data.episodes, settings)
        selection = select(data.episodes, every, 1)
        found = replay.run(selection, lambda: None)
        return Report(data, selection, settings, replay, found, None).write(tmp_path / "report")

    return run


# --- right, and planted mistakes --------------------------------------------------------------------------------------


def test_the_small_policy_follows_its_expert(replayed: Callable[..., ReplayDocument], tmp_path: Path) -> None:
    document = replayed(write_npz(tmp_path / "data"))
    assert document.verdict.level == "follows" and not document.verdict.hints
    assert "isn't a success rate" in document.verdict.text
    own = document.policies[0]
    controls = {control.name: control.relative for control in document.controls}
    assert own.relative.mean < 0.5 * min(controls[compare.OTHERS], controls[compare.MEAN])
    assert all(one.relative > own.relative.mean for one in own.changed), "what a mistake looks like"
    assert len(own.by_index) == 10 and [joint.name for joint in own.joints][-1] == "gripper"
    assert document.dataset.moments_taken == 6 and not any(state.outside for state in document.states)


def test_exchanged_cameras_are_named(replayed: Callable[..., ReplayDocument], tmp_path: Path) -> None:
    document = replayed(write_npz(tmp_path / "data", swap=True))
    assert document.verdict.level != "follows"
    assert any("image and observation/wrist_image exchanged the error falls" in one for one in document.verdict.hints)


def test_degrees_for_radians_are_named(replayed: Callable[..., ReplayDocument], tmp_path: Path) -> None:
    document = replayed(write_npz(tmp_path / "data", degrees=True))
    assert document.verdict.level == "differs"
    assert sum("in degrees, and the checkpoint was trained on radians" in one for one in document.verdict.hints) == 2
    assert any(state.outside for state in document.states)


def test_another_task_is_no_match(replayed: Callable[..., ReplayDocument], tmp_path: Path) -> None:
    path = write_npz(tmp_path / "data")
    right, wrong = replayed(path, changed=0), replayed(path, changed=0, task="pick up the cookie box")
    assert wrong.policies[0].relative.mean > right.policies[0].relative.mean
