"""Robots that don't fit: found when the policy is made, or, at the latest, before the robot gets anything."""

import dataclasses
import itertools
import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cli_helpers import refusal, text_of, turbopi

from turbopi.checkpoint import open_checkpoint, random_checkpoint
from turbopi.policy.policy import UnifiedPolicy
from turbopi.preprocess.pipeline import Pipeline
from turbopi.robots import Robot, RobotInputs
from turbopi.support.errors import ActionError, ConfigError, ObservationError

pytestmark = pytest.mark.usefixtures("two_layers")

TINY = ("--random-weights", "pi05_tiny")
ARM = {
    "name": "my_arm",
    "cameras": {"front": "base_0_rgb"},
    "state": {"joints": 6},
    "action_dim": 6,
    "default_prompt": "fold the towel",
}


class Arm(Robot):
    name = "arm"
    state_dim = 8
    action_dim = 6

    def inputs(self, observation: Mapping[str, Any]) -> RobotInputs:
        return RobotInputs({"base_0_rgb": observation["camera"]}, {}, observation["state"], "go")

    def outputs(self, actions: np.ndarray) -> np.ndarray:
        return actions[:, :6]

    def example(self, rng: np.random.Generator) -> dict[str, Any]:
        return {"camera": np.zeros((8, 8, 3), np.uint8), "state": np.zeros(self.state_dim or 8)}


def pipeline(robot: Robot) -> Pipeline:
    checkpoint = random_checkpoint("pi05_tiny")  # LIBERO's: statistics of 8 and 7 values
    tokenizer: Any = None
    return Pipeline(checkpoint.config, checkpoint.norm_stats, tokenizer, robot=robot)


def robot_giving(result: Any, *, action_dim: int | None = 6) -> Robot:
    class Odd(Arm):
        name = "odd"

        def outputs(self, actions: np.ndarray) -> np.ndarray:
            if isinstance(result, Exception):
                raise result
            given: np.ndarray = result(actions)
            return given

    robot = Odd()
    robot.action_dim = action_dim  # type: ignore[assignment]  # narrower in Arm
    return robot


@pytest.mark.parametrize(
    ("result", "message"),
    [
        (lambda a: a, "robot odd: `outputs` gives 32 actions a step, but its action_dim is 6"),
        (lambda a: a[:, :5], "`outputs` gives 5 actions a step, but its action_dim is 6"),
        (lambda a: a[0, :6], r"`outputs` gives actions of shape \[6\], expected \[10, 6\]"),
        (lambda a: a[:5, :6], r"`outputs` gives actions of shape \[5, 6\], expected \[10, 6\]"),
        (lambda a: a[None], r"of shape \[1, 10, 32\]"),
        (lambda a: None, "`outputs` gives object, expected numbers"),
        (lambda a: a[:, :6].astype(str), "expected numbers"),
        (IndexError("index 40 is out of bounds"), "`outputs` failed on actions .10, 32. .*IndexError: index 40"),
    ],
)
def test_outputs_of_another_shape_are_refused_when_the_policy_is_made(result: Any, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        pipeline(robot_giving(result))


def test_a_policy_refuses_such_a_robot_too() -> None:
    with pytest.raises(ConfigError, match="gives 32 actions a step"):
        UnifiedPolicy(random_checkpoint("pi05_tiny"), device="cpu", robot=robot_giving(lambda a: a))


def test_the_width_of_a_robot_that_names_none_is_found() -> None:
    edges = pipeline(robot_giving(lambda a: a[:, :4], action_dim=None))
    assert edges.metadata["robot_action_dim"] == 4


def test_outputs_that_change_their_shape_later_never_reach_the_robot() -> None:
    calls = []

    def fickle(actions: np.ndarray) -> np.ndarray:
        calls.append(actions)
        return actions[:, :6] if len(calls) < 3 else actions

    edges = pipeline(robot_giving(fickle))
    state, chunk = np.zeros(32), np.zeros((10, 32), np.float32)
    assert edges.after(chunk, state)["actions"].shape == (10, 6)
    with pytest.raises(ActionError, match=r"robot odd: `outputs` gave actions of shape \[10, 32\], expected \[10, 6\]"):
        edges.after(chunk, state)


def _raise(error: Exception) -> np.ndarray:
    raise error


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (lambda a: a, r"robot odd: `outputs` gave actions of shape \[10, 32\], expected \[10, 6\]"),
        (lambda a: a[:, :6] * np.nan, "un-normalised, robot odd gets .*60 of 60 .* row 0, column 0"),
        (lambda a: _raise(ActionError("out of reach")), "out of reach$"),
    ],
)
def test_what_a_robot_does_wrong_in_a_batch_is_said_with_the_observations_number(wrong: Any, message: str) -> None:
    edges, chunks, states = pipeline(Arm()), np.zeros((4, 10, 32), np.float32), [np.zeros(32)] * 4
    calls = itertools.count()
    edges.robot = robot_giving(lambda a: wrong(a) if next(calls) >= 2 else a[:, :6])
    with pytest.raises(ActionError, match=rf"^observation 2 of 4 \(from 0\): {message}"):
        edges.after_all(chunks, states)
    with pytest.raises(ActionError, match=f"^{message}"):
        edges.after(chunks[2], states[2])


def test_a_dry_run_does_not_warn_of_what_middling_actions_do() -> None:
    pipeline(robot_giving(lambda a: (a / (a - a))[:, :6]))  # 0 / 0; warnings are errors here


@pytest.mark.parametrize(
    ("code", "name", "message"),
    [
        ("1 / 0", "Arm", "broken_arm failed: ZeroDivisionError: division by zero (broken_arm.py, line 1)"),
        ("import sys\nsys.exit(3)", "Arm", "broken_arm failed: SystemExit: 3"),
        ("def", "Arm", "broken_arm failed: SyntaxError"),
        ("class Arm:\n  def __init__(self):\n    {}['joints']", "Arm", "KeyError: 'joints' (broken_arm.py, line 3)"),
        ("arm = 3", "arm", "robot 3 has no inputs, outputs, example"),
        ("", "Arm", "has no attribute 'Arm'"),
    ],
)
def test_a_robots_own_code_that_fails_is_one_line(
    code: str, name: str, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "broken_arm.py").write_text(code)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "broken_arm", raising=False)
    assert message in refusal(turbopi("inspect", *TINY, "--robot", f"broken_arm:{name}"))


def test_inputs_that_fail_on_an_observation_refuse_it_by_the_robots_name() -> None:
    edges = pipeline(Arm())
    with pytest.raises(ObservationError, match="robot arm: `inputs` failed on this observation: KeyError: 'camera'"):
        edges.see({"state": np.zeros(8)})

    class Loose(Arm):
        name = "loose"

        def inputs(self, observation: Mapping[str, Any]) -> Any:
            return {"images": {}}

    with pytest.raises(ObservationError, match="robot loose: `inputs` gives a dict, expected RobotInputs"):
        pipeline(Loose()).see({})


# --- narrower than the statistics -------------------------------------------------------------------------------------


def test_a_robot_narrower_than_the_statistics_runs_as_in_openpi_and_the_user_is_told() -> None:
    arm = Arm()
    arm.state_dim = 6
    edges = pipeline(arm)
    assert edges.notes == [
        "robot arm has 6 values of state, but the checkpoint's statistics cover 8: the first 6 are used, as openpi "
        "does. Are they this robot's statistics?",
        "robot arm has 6 values of actions, but the checkpoint's statistics cover 7: the model's other 1 are dropped, "
        "as openpi does. Are they this robot's statistics?",
    ]
    stats = random_checkpoint("pi05_tiny").norm_stats
    assert stats.state is not None and stats.state.q01 is not None and stats.state.q99 is not None
    assert stats.actions is not None and stats.actions.q01 is not None and stats.actions.q99 is not None
    state = np.linspace(-1, 1, 6)
    low, high = stats.state.q01[:6], stats.state.q99[:6]
    sample = edges.see({"camera": np.zeros((8, 8, 3), np.uint8), "state": state})
    edges._normalize_state(sample)
    np.testing.assert_array_equal(sample.state, (state - low) / (high - low + 1e-6) * 2 - 1)
    low, high = stats.actions.q01, stats.actions.q99
    chunk = np.random.default_rng(0).standard_normal((10, 32)).astype(np.float32)
    expected = (chunk[:, :7] + 1.0) / 2.0 * (high - low + 1e-6) + low
    np.testing.assert_array_equal(edges.after(chunk, np.zeros(32))["actions"], expected[:, :6])


def test_statistics_that_are_padded_with_zeros_need_no_note() -> None:
    checkpoint = random_checkpoint("pi05_tiny")
    stats = checkpoint.norm_stats
    assert stats.state is not None and stats.actions is not None

    def padded(feature: Any) -> Any:
        values = {f.name: getattr(feature, f.name) for f in dataclasses.fields(feature)}
        return dataclasses.replace(
            feature, **{k: np.pad(v, (0, 3)) for k, v in values.items() if isinstance(v, np.ndarray)}
        )

    wide = dataclasses.replace(stats, state=padded(stats.state), actions=padded(stats.actions))
    tokenizer: Any = None
    assert Pipeline(checkpoint.config, wide, tokenizer).notes == []


def test_a_policy_logs_the_notes(caplog: pytest.LogCaptureFixture) -> None:
    UnifiedPolicy(random_checkpoint("pi05_tiny"), device="cpu", robot=Arm())
    assert "robot arm has 6 values of actions" in caplog.text


# --- --robot ----------------------------------------------------------------------------------------------------------


@pytest.fixture
def arm_json(tmp_path: Path) -> Path:
    file = tmp_path / "my_arm.json"
    file.write_text(json.dumps(ARM))
    return file


@pytest.mark.parametrize("command", ["inspect", "convert", "calibrate", "infer", "serve", "demo", "verify"])
def test_the_option_is_the_same_text_everywhere(command: str) -> None:
    shown = text_of(turbopi(command, "--help").stdout)
    assert "--robot NAME|FILE|CLASS" in shown
    reported = (
        "Instead of the configuration's robot: a built-in one, a type of LeRobot's (so101_follower), a description"
    )
    assert reported in shown


def test_inspect_shows_the_robots_keys_and_what_to_look_at(arm_json: Path) -> None:
    shown = text_of(turbopi("inspect", *TINY, "--robot", arm_json).stdout)
    assert "my_arm" in shown
    for key, what in (("front", "uint8[224, 224, 3]"), ("joints", "float64[6]"), ("prompt", "text")):
        assert f"its {key} " in shown
        assert what in shown
    assert "note: robot my_arm has 6 values of state" in shown
    document = json.loads(turbopi("inspect", *TINY, "--robot", arm_json, "--json").stdout)
    assert document["observation"] == {"front": "uint8[224, 224, 3]", "joints": "float64[6]", "prompt": "text"}
    assert (document["robot"], document["robot_action_dim"]) == ("my_arm", 6)


@pytest.mark.parametrize("command", [("inspect",), ("calibrate", "--out", "never.json")])
def test_a_robot_that_does_not_fit_is_refused(command: tuple[str, ...], tmp_path: Path) -> None:
    (tmp_path / "wide.json").write_text(json.dumps(ARM | {"action_dim": 9}))
    message = refusal(turbopi(*command, "--json", *TINY, "--robot", tmp_path / "wide.json"), whole=False)
    assert "robot my_arm has 9 values of actions, but the statistics cover 7" in message
    assert "unknown robot 'r2d2'" in refusal(turbopi(*command, "--json", *TINY, "--robot", "r2d2"), whole=False)


def test_convert_records_the_robot(arm_json: Path, tmp_path: Path) -> None:
    target = tmp_path / "converted"
    result = turbopi("convert", *TINY, "--robot", arm_json, target)
    assert result.exit_code == 0, result.output
    assert json.loads((target / "turbopi.json").read_text())["robot"] == "my_arm.json"
    arm_json.unlink()  # the folder has its own
    policy = UnifiedPolicy(target, device="cpu")
    assert policy.metadata["robot"] == "my_arm"
    assert policy.infer(policy.example_observation(), seed=0, num_steps=1)["actions"].shape == (10, 6)


def test_convert_records_a_built_in_robot_and_no_class(tmp_path: Path) -> None:
    assert turbopi("convert", *TINY, "--robot", "plain", tmp_path / "plain").exit_code == 0
    assert open_checkpoint(tmp_path / "plain").config.robot == "plain"
    message = refusal(turbopi("convert", *TINY, "--robot", "my_package.arms:Arm", tmp_path / "class"))
    assert message.startswith("--robot my_package.arms:Arm is a class, and no turbopi.json can name one")
    assert not (tmp_path / "class").exists()


@pytest.mark.slow
def test_calibrate_reads_the_robots_keys(arm_json: Path, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    for number in range(3):
        camera_image, joints = rng.integers(256, size=(32, 32, 3), dtype=np.uint8), rng.uniform(-1, 1, 6)
        np.savez(tmp_path / f"{number}.npz", front=camera_image, joints=joints)
    recording = tmp_path / "observations"
    recording.mkdir()
    for number in range(3):
        (tmp_path / f"{number}.npz").rename(recording / f"{number:06d}.npz")
    out = tmp_path / "fp8.json"
    options = ("--observations", recording, "--steps", 1, "--device", "cpu", "--target", 0, "--out", out)
    result = turbopi("calibrate", *TINY, "--robot", arm_json, *options)
    assert result.exit_code == 0, result.output
    assert out.exists()
