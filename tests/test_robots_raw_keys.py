"""Robots that send LeRobot's raw keys: joints by name, cameras by name, for LeRobot's checkpoints and for openpi's."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from checkpoint_helpers import edit_json
from lerobot_golden import GOLDEN, GoldenCase

from turbopi import UnifiedPolicy, serve
from turbopi.checkpoint import open_checkpoint, random_checkpoint
from turbopi.preprocess.tokenizer import TINY_TOKENIZER
from turbopi.recordings import iter_recording
from turbopi.robots import Robot, create_robot, robot_for
from turbopi.robots.raw_keys import ROBOT_TYPES
from turbopi.support.errors import ConfigError, ObservationError

SO101 = ROBOT_TYPES["so101_follower"]
OPTIONS: dict[str, Any] = {
    "image_keys": ["observation.images.front", "observation.images.wrist"],
    "state_dim": 6,
    "action_dim": 6,
}


def robot(name: Any = "so101_follower", **changed: Any) -> Robot:
    return robot_for(name, "lerobot", OPTIONS | changed)


def observation(**changed: Any) -> dict[str, Any]:
    """As LeRobot's SO-101 gives it, with the task beside it."""
    rng = np.random.default_rng(0)
    camera_images = {name: rng.integers(256, size=(48, 64, 3), dtype=np.uint8) for name in ("front", "wrist")}
    made = {**{key: 10.0 * i for i, key in enumerate(SO101)}, **camera_images, "task": "fold the towel"}
    return {key: value for key, value in (made | changed).items() if value is not None}


def written(folder: Path, **fields: Any) -> Path:
    file = folder / "arm.json"
    file.write_text(json.dumps({"robot_type": "so101_follower"} | fields))
    return file


@pytest.mark.parametrize("name", ["so101_follower", "so101", "so100", "so100_follower", "koch_follower"])
def test_raw_keys_are_the_checkpoints_keys(name: str) -> None:
    """To the last bit what the same observation is under LeRobot's own keys."""
    sent = observation()
    raw = robot(name).inputs(sent)
    keyed = {f"observation.images.{camera}": sent[camera] for camera in ("front", "wrist")}
    state = np.array([sent[key] for key in SO101], np.float32)
    own = create_robot("lerobot", OPTIONS).inputs({**keyed, "observation.state": state, "task": sent["task"]})
    np.testing.assert_array_equal(raw.state, own.state, strict=True)
    assert list(raw.images) == list(own.images) and raw.image_mask == own.image_mask
    for camera, camera_image in own.images.items():
        np.testing.assert_array_equal(raw.images[camera], camera_image)
    assert (raw.prompt, raw.in_order) == ("fold the towel", True)


@pytest.mark.parametrize(("name", "joints"), ROBOT_TYPES.items())
def test_every_robot_type_reads_its_own_example(name: str, joints: tuple[str, ...]) -> None:
    made = robot(name, state_dim=len(joints), action_dim=len(joints))
    example = made.example(np.random.default_rng(0))
    assert made.inputs(example).state.tolist() == pytest.approx([example[key] for key in joints])
    assert made.action_keys == joints and made.outputs(np.ones((4, 32))).shape == (4, len(joints))


def test_joints_follow_the_checkpoints_names() -> None:
    names = [*reversed(SO101)]
    made = robot(action_names=names)
    assert made.inputs(observation()).state.tolist() == [50, 40, 30, 20, 10, 0]
    assert made.action_keys == tuple(names)


def test_a_files_order_is_kept(tmp_path: Path) -> None:
    joints = [*SO101[1:], SO101[0]]
    made = robot(written(tmp_path, joints=joints), action_names=list(SO101))
    assert made.inputs(observation()).state.tolist() == [10, 20, 30, 40, 50, 0]
    assert made.action_keys == SO101
    keys = [f"goal_{i}" for i in range(6)]
    assert robot(written(tmp_path, joints=joints, action_keys=keys)).action_keys == tuple(keys)


def test_a_file_maps_cameras_and_the_task(tmp_path: Path) -> None:
    cameras = {"cam_a": "wrist", "cam_b": "observation.images.front"}
    file = written(tmp_path, cameras=cameras, task_key="instruction", named_actions=False)
    made, sent = robot(file), observation()
    raw = {key: sent[key] for key in SO101}
    inputs = made.inputs(raw | {"cam_a": sent["wrist"], "cam_b": sent["front"], "instruction": "wave"})
    for camera in ("front", "wrist"):
        np.testing.assert_array_equal(inputs.images[f"observation.images.{camera}"], sent[camera])
    assert inputs.prompt == "wave" and made.action_keys is None and made.camera_counts == (2,)
    with pytest.raises(ObservationError, match=r"no 'cam_a'\. It has .*front.*; expected .*cam_a, cam_b, instruction"):
        made.inputs(sent)


def test_a_renamed_camera_is_sent_by_its_own_name() -> None:
    made = robot(rename_map={"observation.images.top": "observation.images.front"})
    sent = observation(front=None, top=observation()["front"])
    np.testing.assert_array_equal(made.inputs(sent).images["observation.images.front"], sent["top"])


def test_a_camera_that_the_robot_lacks_is_masked_and_said(caplog: pytest.LogCaptureFixture) -> None:
    inputs = robot().inputs(observation(wrist=None, wirst=observation()["wrist"]))
    assert inputs.image_mask == {"observation.images.front": True, "observation.images.wrist": False}
    assert (inputs.missing, inputs.unread) == (("observation.images.wrist",), ("observation.images.wirst",))
    assert "observation.images.wrist, which is masked" in caplog.text


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        (
            {"elbow_flex.pos": None, "elbow.pos": 3.0},
            r"no 'elbow_flex\.pos'\. It has .*elbow\.pos.*; expected shoulder_pan\.pos, .*front, wrist, task",
        ),
        ({"base.vel": 1.0}, r"has base\.vel, which robot so101_follower doesn't; its joints are shoulder_pan\.pos"),
        ({"gripper.pos": np.zeros(2)}, r"gripper\.pos has shape \(2,\), expected shape \(1,\)"),
        ({"gripper.pos": np.nan}, r"gripper\.pos isn't finite"),
        ({"gripper.pos": "open"}, r"gripper\.pos has dtype"),
        (
            {"front": None, "wrist": None, "side": np.zeros((4, 4, 3), np.uint8)},
            r"none of the checkpoint's cameras, front, wrist\. It has .*side",
        ),
        ({"front": np.zeros((4, 4), np.uint8)}, r"observation\.images\.front"),
    ],
)
def test_bad_observations_say_what_came_and_what_was_expected(changed: dict[str, Any], message: str) -> None:
    with pytest.raises(ObservationError, match=message):
        robot().inputs(observation(**changed))


@pytest.mark.parametrize(
    ("fields", "options", "message"),
    [
        ({}, {"state_dim": 8}, r"so101_follower has 6 numbers of state, shoulder_pan\.pos.*, but the checkpoint has 8"),
        ({}, {"action_dim": 7}, "has 6 actions, .* but the checkpoint has 7"),
        ({}, {"action_names": list("abcdef")}, "but the checkpoint's actions are a, b, c, d, e, f. Is it for another"),
        ({"cameras": {"a": "side"}}, {}, r"cameras\['a'\] is 'side', but the checkpoint's cameras are front, wrist"),
        ({"cameras": {"a": "front", "b": "front"}}, {}, "one of the checkpoint's cameras to two names"),
        ({"cameras": {}}, {}, r"arm\.json: cameras must be an object"),
        ({"robot_type": "my_arm"}, {}, r"arm\.json: robot_type 'my_arm' needs `joints`; known without are so100"),
        ({"joints": ["a", "a"]}, {}, "joints must be a list of different keys"),
        ({"action_keys": []}, {}, "action_keys must be a list of different keys"),
        ({"named_actions": "yes"}, {}, "named_actions must be true or false, got 'yes'"),
        ({"task_key": ""}, {}, "task_key must be text"),
        ({"state": {}}, {}, r"arm\.json: unknown field .*state.*; a robot with robot_type has robot_type, joints"),
    ],
)
def test_descriptions_that_cannot_be_say_why(
    tmp_path: Path, fields: dict[str, Any], options: dict[str, Any], message: str
) -> None:
    with pytest.raises(ConfigError, match=message):
        robot(written(tmp_path, **fields), **options)


def test_without_a_lerobot_checkpoint_it_says_what_to_write_instead(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"this one is for robot libero\. Describe its cameras and state in a \.json"):
        robot_for("so101", "libero", {})
    for name in ("so101_follower", str(written(tmp_path))):
        with pytest.raises(ConfigError, match=r"only a LeRobot checkpoint's own description can place: .*--robot"):
            create_robot(name)


# -- in a policy -------------------------------------------------------------------------------------------------------


def test_a_policy_answers_raw_keys_as_it_answers_its_own(tmp_path: Path) -> None:
    """The same observation, the same noise: the same actions, and each under its robot's name."""
    case = GoldenCase(GOLDEN / "relative_excluded")
    checkpoint = case.assemble(tmp_path)
    edit_json(checkpoint / "config.json", lambda content: content.update(action_feature_names=None))
    joints = [f"joint_{i}.pos" for i in range(8)]
    file = written(tmp_path, robot_type="eight", joints=joints, action_keys=joints[:7])
    inputs = np.load(case.folder / "inputs.npz")
    keyed = {key[2:]: inputs[key] for key in inputs.files if key.startswith("0/")}
    task = str(keyed.pop("task")[0])
    raw = {key: float(value) for key, value in zip(joints, keyed["observation.state"], strict=True)}
    raw |= {key.rpartition(".")[2]: value for key, value in keyed.items() if "images" in key}
    about: dict[str, Any] = {"precision": "f32", "device": "cpu", "backend": "pytorch", "tokenizer": TINY_TOKENIZER}
    own = UnifiedPolicy(checkpoint, **about).infer({**keyed, "task": task}, noise=inputs["noise"])
    policy = UnifiedPolicy(checkpoint, robot=str(file), **about)
    answer = policy.infer({**raw, "task": task}, noise=inputs["noise"])
    np.testing.assert_array_equal(answer["actions"], own["actions"])
    assert list(answer["named_actions"]) == joints[:7] and "named_actions" not in own
    np.testing.assert_array_equal(np.stack([*answer["named_actions"].values()], axis=1), answer["actions"])
    assert policy.metadata["robot"] == "eight" and policy.metadata["robot_state_dim"] == 8
    assert policy.warmup() > 0


def test_a_checkpoint_tells_its_actions_names(tmp_path: Path) -> None:
    named, unnamed = (
        open_checkpoint(GoldenCase(GOLDEN / name).assemble(tmp_path / name)).config.robot_options
        for name in ("relative_excluded", "mean_std")
    )
    assert named["action_names"][0] == "shoulder.pos" and len(named["action_names"]) == 7
    assert "action_names" not in unnamed


def test_an_openpi_checkpoint_takes_raw_keys_by_a_description(tmp_path: Path) -> None:
    file = tmp_path / "so101.json"
    described = {
        "name": "so101",
        "cameras": {"front": "base_0_rgb", "wrist": "left_wrist_0_rgb"},
        "state": dict.fromkeys(SO101, 1),
        "action_dim": 6,
        "prompt_key": "task",
        "action_keys": list(SO101),
    }
    file.write_text(json.dumps(described))
    policy = UnifiedPolicy(random_checkpoint("pi05_tiny"), robot=str(file), device="cpu", precision="f32")
    answer = policy.infer(observation(), seed=0)
    np.testing.assert_array_equal(answer["named_actions"]["gripper.pos"], answer["actions"][:, 5])
    file.write_text(json.dumps(described | {"action_keys": ["a", "b"]}))
    with pytest.raises(ConfigError, match="action_keys must be a list of 6 different names, one for each action"):
        create_robot(str(file))


def test_a_served_policy_answers_by_name_and_records_raw_keys(tmp_path: Path) -> None:
    from websockets.sync.client import connect

    from turbopi.realtime.wire import pack, unpack

    checkpoint = random_checkpoint("pi05_tiny")
    file = tmp_path / "so101.json"
    fields = {"name": "so101", "cameras": {"front": "base_0_rgb"}, "state": dict.fromkeys(SO101, 1), "action_dim": 6}
    file.write_text(json.dumps({**fields, "prompt_key": "task", "action_keys": list(SO101)}))
    policy = UnifiedPolicy(checkpoint, robot=str(file), device="cpu")
    with serve.running(policy, record_dir=tmp_path / "calls") as server, connect(server.url, max_size=None) as client:
        client.recv()
        client.send(pack(observation()))
        answer: Any = unpack(client.recv())  # type: ignore[arg-type]
        assert list(answer["named_actions"]) == list(SO101)
        np.testing.assert_array_equal(answer["named_actions"]["gripper.pos"], answer["actions"][:, 5])
        client.send(pack(observation(**{"gripper.pos": None})))
        assert "no 'gripper.pos'" in str(client.recv())
    ((recorded, actions),) = iter_recording(tmp_path / "calls")
    assert recorded["shoulder_lift.pos"] == 10.0 and actions.shape == answer["actions"].shape
