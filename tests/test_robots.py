"""Robots: openpi's keys exactly, LeRobot's cameras, described and written ones, refusals."""

import json
import re
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import packed_arrays

from turbopi.config import CAMERAS, PRESETS
from turbopi.robots import ROBOTS, Robot, create_robot, import_robot, load_robot, robot_from_dict
from turbopi.robots.base import find, keys_of, read_prompt, read_state
from turbopi.support.errors import ConfigError, ObservationError

FOLDER = Path(__file__).parent / "golden" / "preprocess"
DOCS = Path(__file__).parent.parent / "docs" / "robots.md"
LEROBOT_WRIST = "observation.images.wrist"
LEROBOT = {"image_keys": ["observation.images.top", "observation.images.wrist"], "state_dim": 6, "action_dim": 6}
CREATED = {
    "libero": create_robot("libero"),
    "droid": create_robot("droid"),
    "aloha": create_robot("aloha"),
    "plain": create_robot("plain"),
    "lerobot": create_robot("lerobot", LEROBOT),
}


def golden(robot: str) -> dict[str, dict[str, dict[str, np.ndarray]]]:
    """case -> in | out -> key -> value"""
    cases: dict[str, dict[str, dict[str, np.ndarray]]] = {}
    for name, value in packed_arrays(FOLDER / f"{robot}.npz").items():
        case, side, key = name.split("/", 2)
        cases.setdefault(case, {}).setdefault(side, {})[key] = value
    return cases


INPUTS = [(r, case) for r in ("libero", "droid", "aloha") for case, data in golden(r).items() if "prompt" in data["in"]]
OUTPUTS = [(r, case) for r in ("libero", "droid", "aloha") for case in golden(r) if case.startswith("outputs")]


def robot_of(name: str, case: str) -> Robot:
    return create_robot(name, {"adapt_to_pi": False} if name == "aloha" and "plain" in case else {})


@pytest.mark.parametrize(("name", "case"), INPUTS)
def test_inputs_are_openpis_exactly(name: str, case: str) -> None:
    data = golden(name)[case]
    inputs = robot_of(name, case).inputs(data["in"])
    for camera in CAMERAS:
        np.testing.assert_array_equal(inputs.images[camera], data["out"][f"image/{camera}"], strict=True)
        assert inputs.image_mask[camera] == data["out"][f"image_mask/{camera}"]
    assert inputs.prompt == data["out"]["prompt"].item()
    assert inputs.state.dtype == data["out"]["state"].dtype
    # numpy's arcsin, in ALOHA's grippers, differs by an ulp between its versions
    np.testing.assert_allclose(inputs.state, data["out"]["state"], rtol=4e-16 if name == "aloha" else 0)


@pytest.mark.parametrize(("name", "case"), OUTPUTS)
def test_outputs_are_openpis_exactly(name: str, case: str) -> None:
    data = golden(name)[case]
    actions = data["in"]["actions"]
    before = actions.copy()
    np.testing.assert_array_equal(robot_of(name, case).outputs(actions), data["out"]["actions"], strict=True)
    np.testing.assert_array_equal(actions, before)


def test_golden_cases_cover_what_they_should() -> None:
    assert {("aloha", "missing_cam"), ("droid", "scalar_gripper"), ("libero", "chw_float")} <= set(INPUTS)
    assert len(OUTPUTS) >= 4


@pytest.mark.parametrize("name", CREATED)
def test_a_robot_reads_its_own_example_and_leaves_it_unchanged(name: str) -> None:
    robot = CREATED[name]
    example = robot.example(np.random.default_rng(3))
    again = robot.example(np.random.default_rng(3))
    for key in keys_of(example):
        value = find(example, key)
        if isinstance(value, np.ndarray):
            value.flags.writeable = False  # as decoded messages are
        np.testing.assert_array_equal(value, find(again, key))
    inputs = robot.inputs(example)
    assert any(inputs.image_mask.values())
    assert inputs.prompt
    assert robot.state_dim in (None, len(inputs.state))
    for key in keys_of(example):
        np.testing.assert_array_equal(find(example, key), find(again, key))


def nested(flat: dict[str, Any]) -> dict[str, Any]:
    out: dict[str, Any] = {}
    for key, value in flat.items():
        *parents, leaf = key.split("/")
        inner = out
        for parent in parents:
            inner = inner.setdefault(parent, {})
        inner[leaf] = value
    return out


@pytest.mark.parametrize("name", ["libero", "droid", "aloha", "plain"])
def test_flat_and_nested_keys_are_the_same(name: str) -> None:
    robot = CREATED[name]
    example = robot.example(np.random.default_rng(0))
    flat = {key: find(example, key) for key in keys_of(example)}
    one, other = robot.inputs(flat), robot.inputs(nested(flat))
    np.testing.assert_array_equal(one.state, other.state)
    for camera in CAMERAS:
        assert one.image_mask[camera] == other.image_mask[camera]
        np.testing.assert_array_equal(one.images[camera], other.images[camera])


@pytest.mark.parametrize("name", CREATED)
def test_unknown_keys_are_accepted(name: str) -> None:
    example = CREATED[name].example(np.random.default_rng(0))
    CREATED[name].inputs({**example, "timestamp": 1.5, "session": "a"})


@pytest.mark.parametrize("name", CREATED)
def test_a_missing_key_is_named_with_those_given_and_expected(name: str) -> None:
    robot = CREATED[name]
    example = robot.example(np.random.default_rng(0))
    flat = {key: find(example, key) for key in keys_of(example)}
    for key in flat:
        rest = {other: value for other, value in flat.items() if other != key}
        if key in ("prompt", "task"):
            assert robot.inputs(rest).prompt is None
        elif ("image" in key and name in ("plain", "lerobot")) or ("wrist" in key and name == "aloha"):
            assert sum(robot.inputs(rest).image_mask.values()) == sum(robot.inputs(flat).image_mask.values()) - 1
        else:
            message = rf"the observation has no '{re.escape(key)}'\. It has .*; expected .*{re.escape(key)}"
            with pytest.raises(ObservationError, match=message):
                robot.inputs(rest)


@pytest.mark.parametrize("name", ["libero", "droid", "aloha", "lerobot"])
def test_states_of_another_width_are_refused(name: str) -> None:
    example = CREATED[name].example(np.random.default_rng(0))
    key = state_key(example)
    width = len(find(example, key))
    with pytest.raises(ObservationError, match=rf"{key} has shape \({width + 1},\), expected shape \({width},\)"):
        CREATED[name].inputs({**example, key: np.zeros(width + 1)})


@pytest.mark.parametrize("name", CREATED)
def test_states_that_arent_vectors_of_finite_numbers_are_refused(name: str) -> None:
    example = CREATED[name].example(np.random.default_rng(0))
    key = state_key(example)
    state = find(example, key)
    broken = state.copy()
    broken[1] = np.nan
    for bad, message in (
        (broken, "isn't finite: value 1 is nan"),
        (state[None], r"has shape \(1, \d+\)"),
        (state.astype(str), "has dtype <U.*; send floats"),
        (state + 1j, "has dtype complex.*; send floats"),
        ([[1, 2], [3]], "isn't an array of numbers"),
    ):
        with pytest.raises(ObservationError, match=rf"{key} {message}"):
            CREATED[name].inputs({**example, key: bad})


def state_key(example: dict[str, Any]) -> str:
    return next(key for key in keys_of(example) if "state" in key or "joint" in key)


def test_messages_stay_short_whatever_is_sent() -> None:
    deep: dict[str, Any] = {}
    for _ in range(5000):
        deep = {"a": deep}
    for junk in ({str(i): i for i in range(100_000)}, {"k" * 1_000_000: 1}, deep, {"images": {"x" * 10**6: 1}}):
        for robot in CREATED.values():
            with pytest.raises(ObservationError) as caught:
                robot.inputs(junk)
            assert len(str(caught.value)) < 4000


def test_infinite_states_are_refused_and_integers_become_floats() -> None:
    with pytest.raises(ObservationError, match="state isn't finite: value 0 is -inf"):
        read_state(np.array([-np.inf, 1.0]), "state", 2)
    assert read_state([1, 2], "state", 2).dtype == np.float64
    with pytest.raises(ObservationError, match=r"state has shape \(0,\), expected one axis, not empty"):
        read_state(np.zeros(0), "state", None)


@pytest.mark.parametrize(
    "value", ["fold", np.str_("fold"), np.array("fold"), np.array(["fold"]), b"fold", np.array(b"fold")]
)
def test_prompts_come_in_several_forms(value: Any) -> None:
    prompt = read_prompt(value)
    assert prompt == "fold"
    assert type(prompt) is str


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (None, "prompt is None; leave the key out"),
        (3, "prompt is an int, expected text"),
        (["fold", "open"], "prompt is a list"),
        (np.array(["fold", "open"]), "prompt is an ndarray"),
        (np.array(1.5), "prompt is a float"),
        (b"\xff\xfe", "prompt is bytes that aren't UTF-8"),
    ],
)
def test_prompts_that_arent_text_are_refused(value: Any, message: str) -> None:
    with pytest.raises(ObservationError, match=message):
        read_prompt(value)


# ALOHA


def test_aloha_refuses_cameras_that_openpi_doesnt_know() -> None:
    example = CREATED["aloha"].example(np.random.default_rng(0))
    example["images"]["cam_higher"] = example["images"]["cam_high"]
    with pytest.raises(ObservationError, match="unexpected cameras in images: cam_higher; expected cam_high, "):
        CREATED["aloha"].inputs(example)
    with pytest.raises(ObservationError, match="'images' is a list, expected a dict of images"):
        CREATED["aloha"].inputs({**example, "images": [1]})


def test_aloha_is_relative_and_has_a_reset_pose_unless_told_otherwise() -> None:
    aloha = CREATED["aloha"]
    assert aloha.delta_mask == (*[True] * 6, False, *[True] * 6, False)
    assert aloha.reset_pose == [0, -1.5, 1.5, 0, 0, 0]
    simulator = create_robot("aloha", {"adapt_to_pi": False, "delta_actions": False})
    assert simulator.delta_mask is None
    assert simulator.reset_pose is None


def test_grippers_far_out_of_range_stay_finite() -> None:
    example = CREATED["aloha"].example(np.random.default_rng(0))
    for value in (-0.01844 / (0.058 - 0.01844), 1e300, -1e300):
        example["state"][6] = value
        assert np.isfinite(CREATED["aloha"].inputs(example).state).all()


def test_liberos_actions_are_absolute_unless_told_otherwise() -> None:
    assert CREATED["libero"].delta_mask is None
    assert create_robot("libero", {"delta_actions": True}).delta_mask == (*[True] * 6, False)


# LeRobot


def lerobot_observation() -> dict[str, Any]:
    return CREATED["lerobot"].example(np.random.default_rng(0))


def test_lerobots_present_cameras_come_first_and_missing_ones_last() -> None:
    robot = create_robot("lerobot", {**LEROBOT, "num_missing_cameras": 1})
    observation = lerobot_observation()
    inputs = robot.inputs(observation)
    assert list(inputs.images) == ["observation.images.top", "observation.images.wrist", "missing_0"]
    assert list(inputs.image_mask.values()) == [True, True, False]
    del observation["observation.images.top"]
    inputs = robot.inputs(observation)
    assert list(inputs.images) == ["observation.images.wrist", "observation.images.top", "missing_0"]
    assert list(inputs.image_mask) == list(inputs.images)
    assert list(inputs.image_mask.values()) == [True, False, False]
    assert not inputs.images["observation.images.top"].any()


def test_lerobots_pictures_stay_in_their_precision() -> None:
    observation = lerobot_observation()
    observation["observation.images.top"] = np.full((20, 30, 3), 7, np.uint8)
    inputs = CREATED["lerobot"].inputs(observation)
    assert inputs.images["observation.images.top"].dtype == np.uint8
    wrist = inputs.images["observation.images.wrist"]
    np.testing.assert_array_equal(wrist, observation["observation.images.wrist"].transpose(1, 2, 0))
    assert wrist.dtype == np.float32


def test_lerobot_runs_with_a_camera_too_many_and_one_too_few_and_warns_once(caplog: pytest.LogCaptureFixture) -> None:
    robot = create_robot("lerobot", {**LEROBOT, "image_keys": ["observation.images.warned_about", LEROBOT_WRIST]})
    observation = robot.example(np.random.default_rng(0))
    observation["observation.images.topp"] = observation.pop("observation.images.warned_about")
    for _ in range(3):
        inputs = robot.inputs(observation)
    assert list(inputs.image_mask.items()) == [(LEROBOT_WRIST, True), ("observation.images.warned_about", False)]
    (record,) = caplog.records
    assert "lacks observation.images.warned_about, which is masked" in record.message
    assert (inputs.missing, inputs.unread) == (("observation.images.warned_about",), ("observation.images.topp",))


def test_a_camera_that_lerobots_observation_lacks_is_warned_of_once_by_each_robot(
    caplog: pytest.LogCaptureFixture,
) -> None:
    for _ in range(2):  # two policies of one process
        caplog.clear()
        robot = create_robot("lerobot", {**LEROBOT, "image_keys": ["observation.images.unplugged", LEROBOT_WRIST]})
        observation = robot.example(np.random.default_rng(0))
        robot.inputs(observation)
        assert not caplog.records
        del observation["observation.images.unplugged"]
        for _ in range(3):
            robot.inputs(observation)
        (record,) = caplog.records
        assert "the observation lacks observation.images.unplugged, which is masked" in record.message


def test_an_observation_without_any_of_lerobots_cameras_is_refused() -> None:
    none = {key: value for key, value in lerobot_observation().items() if "images" not in key}
    with pytest.raises(ObservationError, match=r"has no camera; this checkpoint's are observation\.images\.top"):
        CREATED["lerobot"].inputs(none)
    with pytest.raises(ObservationError, match=r"cameras are observation\.images\.x; this checkpoint's are"):
        CREATED["lerobot"].inputs({**none, "observation.images.x": np.zeros((3, 8, 8), np.uint8)})


def test_lerobots_names_and_new_names_are_both_read_and_the_later_wins() -> None:
    renames = {"observation.images.a": "observation.images.top", "observation.joints": "observation.state"}
    robot = create_robot("lerobot", {**LEROBOT, "rename_map": renames})
    example = robot.example(np.random.default_rng(0))
    assert set(example) == {"observation.images.a", LEROBOT_WRIST, "observation.joints", "task"}
    shades = {"observation.images.a": 10, "observation.images.top": 20}
    for names in (
        ("observation.images.a", "observation.images.top"),
        ("observation.images.top", "observation.images.a"),
    ):
        camera_images = {name: np.full((3, 8, 8), shades[name], np.uint8) for name in names}
        inputs = robot.inputs({**camera_images, "observation.state": np.arange(6.0), "task": "go"})
        assert inputs.images["observation.images.top"].max() == shades[names[-1]]
        assert inputs.state.tolist() == [0, 1, 2, 3, 4, 5]
    with pytest.raises(ObservationError, match=r"expected .*observation\.joints"):
        robot.inputs({"observation.images.a": np.zeros((3, 8, 8), np.uint8), "task": "go"})


def test_lerobots_names_can_be_swapped() -> None:
    top = "observation.images.top"
    robot = create_robot("lerobot", {**LEROBOT, "rename_map": {top: LEROBOT_WRIST, LEROBOT_WRIST: top}})
    example = robot.example(np.random.default_rng(0))
    inputs = robot.inputs(example)
    assert np.array_equal(inputs.images[top], example[LEROBOT_WRIST].transpose(1, 2, 0))
    assert np.array_equal(inputs.images[LEROBOT_WRIST], example[top].transpose(1, 2, 0))


def test_a_picture_of_an_empty_camera_is_read_as_lerobot_reads_it() -> None:
    robot = create_robot("lerobot", {**LEROBOT, "num_missing_cameras": 2})
    extra = {"observation.images.empty_camera_1": np.full((3, 8, 8), 9, np.uint8)}
    inputs = robot.inputs(lerobot_observation() | extra)
    assert list(inputs.image_mask.values()) == [True, True, True, False]
    assert list(inputs.images)[2:] == ["observation.images.empty_camera_1", "missing_0"]
    present = [*extra, "observation.images.top", LEROBOT_WRIST]
    order = [*present, "observation.images.empty_camera_7"]
    robot = create_robot("lerobot", {**LEROBOT, "num_missing_cameras": 2, "camera_order": order})
    inputs = robot.inputs(lerobot_observation() | extra)
    assert inputs.image_mask == dict.fromkeys(present, True) | {"missing_1": False}
    assert list(inputs.images)[:3] == present


def test_lerobots_task_may_be_a_list_of_one() -> None:
    assert CREATED["lerobot"].inputs({**lerobot_observation(), "task": ["fold"]}).prompt == "fold"
    with pytest.raises(ObservationError, match="task is a list, expected text"):
        CREATED["lerobot"].inputs({**lerobot_observation(), "task": ["fold", "open"]})


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"image_keys": []}, "image_keys must be a list of different keys"),
        ({"image_keys": "observation.images.top"}, "image_keys must be a list"),
        ({"image_keys": ["a", "a"]}, "image_keys must be a list of different keys"),
        (
            {"camera_order": ["a", "b"]},
            r"camera_order must be a list of 2 different keys: image_keys and .*\['a', 'b'\]",
        ),
        ({"state_dim": 0}, "state_dim must be an integer of at least 1, got 0"),
        ({"rename_map": {"a": 1}}, "rename_map must be an object of keys and their new names, got {'a': 1}"),
        ({"rename_map": ["a"]}, "rename_map must be an object"),
        ({"relative_dims": [1, 0]}, r"relative_dims must be a list of true and false, got \[1, 0\]"),
        (
            {"relative_dims": [True] * 7},
            "relative_dims has 7 dimensions, but there are 6 of actions and 6 of the state",
        ),
        ({"num_missing_cameras": -1}, "num_missing_cameras must be an integer of at least 0"),
    ],
)
def test_lerobot_options_that_cant_be_right_are_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        create_robot("lerobot", {**LEROBOT, **options})


# Plain


def test_the_plain_robot_masks_what_it_isnt_given_and_refuses_other_names() -> None:
    robot, image = CREATED["plain"], np.full((8, 9, 3), 5, np.uint8)
    inputs = robot.inputs({"image": {"left_wrist_0_rgb": image}, "state": np.zeros(3)})
    assert inputs.image_mask == {"base_0_rgb": False, "left_wrist_0_rgb": True, "right_wrist_0_rgb": False}
    with pytest.raises(ObservationError, match="images has base; expected at least one of base_0_rgb"):
        robot.inputs({"images": {"base": image}, "state": np.zeros(3)})
    with pytest.raises(ObservationError, match="images has no camera; expected at least one"):
        robot.inputs({"state": np.zeros(3)})
    with pytest.raises(ObservationError, match="both `images` and `image`"):
        robot.inputs({"images": {"base_0_rgb": image}, "image/base_0_rgb": image, "state": np.zeros(3)})


# Names and options


def test_the_plain_robots_masked_cameras_are_as_if_not_sent() -> None:
    plain = create_robot("plain")
    example = plain.example(np.random.default_rng(0))
    camera_images, rest = example.pop("images"), example
    for mask in (
        {"image_mask": {"base_0_rgb": True, "right_wrist_0_rgb": False}},
        {"image_mask/right_wrist_0_rgb": np.False_},
        {"image_mask": {"right_wrist_0_rgb": np.array([False])}},
    ):
        inputs = plain.inputs({"image": camera_images, **rest, **mask})
        assert inputs.image_mask == {"base_0_rgb": True, "left_wrist_0_rgb": True, "right_wrist_0_rgb": False}
        assert not inputs.images["right_wrist_0_rgb"].any()
    del camera_images["left_wrist_0_rgb"]
    for wrong, message in (
        ({"left_wrist_0_rgb": True}, "image_mask/left_wrist_0_rgb is True, but image has no left_wrist_0_rgb"),
        ({"wrist": True}, "image_mask/wrist is of no camera; the model's are base_0_rgb"),
        ({"base_0_rgb": 1}, "image_mask/base_0_rgb is 1; expected true or false"),
        ({"base_0_rgb": np.zeros(2, bool)}, r"image_mask/base_0_rgb is \[False False\]; expected"),
        ({"base_0_rgb": [[1], [2, 3]]}, r"image_mask/base_0_rgb is \[\[1\], \[2, 3\]\]; expected true or false"),
        ({"base_0_rgb": False, "right_wrist_0_rgb": False}, "image_mask leaves out all of base_0_rgb, right_wrist"),
        (3, "'image_mask' is an int, expected a dict"),
    ):
        with pytest.raises(ObservationError, match=message):
            plain.inputs({"image": camera_images, **rest, "image_mask": wrong})


@pytest.mark.parametrize("value", ["no", "false", None, 0, 0.0, []])
def test_options_that_are_true_or_false_are_nothing_else(value: Any) -> None:
    for robot, option in (("aloha", "adapt_to_pi"), ("aloha", "delta_actions"), ("libero", "delta_actions")):
        with pytest.raises(ConfigError, match=f"robot {robot}: the option {option} is .*; expected true or false"):
            create_robot(robot, {option: value})


def test_every_presets_robot_can_be_made() -> None:
    for preset in PRESETS.values():
        assert create_robot(preset.robot, preset.robot_options).name == preset.robot


@pytest.mark.parametrize(
    ("robot", "options", "message"),
    [
        ("libro", {}, "unknown robot 'libro'; choose one of libero, droid, aloha, lerobot, plain"),
        ("os:system", {}, "robots in Python code are given as objects"),
        ("droid", {"delta": True}, "robot droid has no option delta; it has wrist_last"),
        ("aloha", {"adapt": True}, "robot aloha has no option adapt; it has adapt_to_pi, delta_actions"),
        ("lerobot", {"state_dim": 3}, "robot lerobot needs the option image_keys, action_dim"),
        ("absent.json", {}, r"absent\.json can't be read: No such file"),
        ("arm.json", {"a": 1}, "a robot described by a file takes no robot_options, got a"),
        (CREATED["libero"], {"a": 1}, "a robot given as an object takes no robot_options"),
        (ROBOTS["libero"], {}, "is a class; pass an instance"),
        (object(), {}, "has no inputs, outputs, example, name"),
    ],
)
def test_robots_that_cant_be_made_say_why(robot: Any, options: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        create_robot(robot, options)


# Described in a file, written in Python: the examples of docs/robots.md


def documented(language: str) -> str:
    blocks = re.findall(rf"```{language}\n(.*?)```", DOCS.read_text(encoding="utf-8"), re.DOTALL)
    assert len(blocks) == 1
    return str(blocks[0])


def description(**changes: Any) -> dict[str, Any]:
    return {**json.loads(documented("json")), **changes}


def test_the_documented_description_works(tmp_path: Path) -> None:
    path = tmp_path / "my_arm.json"
    path.write_text(documented("json"))
    robot = create_robot(str(path))
    assert (robot.name, robot.state_dim, robot.action_dim) == ("my_arm", 7, 7)
    assert robot.delta_mask == (*[True] * 6, False)
    assert robot.default_prompt == "fold the towel"
    observation = robot.example(np.random.default_rng(0))
    observation["gripper_position"] = 0.25
    del observation["prompt"]
    inputs = robot.inputs(observation)
    np.testing.assert_array_equal(inputs.state, [*observation["joint_position"], 0.25])
    np.testing.assert_array_equal(inputs.images["base_0_rgb"], observation["front_camera"])
    np.testing.assert_array_equal(inputs.images["left_wrist_0_rgb"], observation["wrist_camera"])
    assert inputs.image_mask == {"base_0_rgb": True, "left_wrist_0_rgb": True, "right_wrist_0_rgb": False}
    assert inputs.prompt is None
    assert robot.outputs(np.zeros((5, 32))).shape == (5, 7)
    with pytest.raises(
        ObservationError, match=r"no 'wrist_camera'\. It has .*expected front_camera, wrist_camera, joint"
    ):
        robot.inputs({key: value for key, value in observation.items() if key != "wrist_camera"})


def test_a_description_may_name_its_prompt_key_and_reset_pose() -> None:
    robot = robot_from_dict(description(prompt_key="task", reset_pose=[0, 1.5]))
    observation = robot.example(np.random.default_rng(0))
    assert robot.inputs(observation).prompt == observation["task"]
    assert robot.reset_pose == [0, 1.5]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"camera": {}}, "unknown field camera; a robot has name, cameras"),
        ({"name": ""}, "name must be text, got ''"),
        ({"name": None}, "name must be text, got None"),
        ({"prompt_key": 3}, "prompt_key must be text, got 3"),
        ({"cameras": []}, "cameras must be an object"),
        ({"cameras": {}}, "cameras must be an object"),
        ({"cameras": {"a": "base"}}, r"cameras\['a'\] must be one of base_0_rgb, .*, got 'base'"),
        ({"cameras": {"a": "base_0_rgb", "b": "base_0_rgb"}}, "gives one of the model's cameras to two keys"),
        ({"cameras": {"a": ["base_0_rgb"]}}, r"cameras\['a'\] must be one of"),
        ({"state": {}}, "state must be an object: key -> width"),
        ({"state": {"a": 0}}, r"state\['a'\] must be a whole number from 1 to 1024, got 0"),
        ({"state": {"a": True}}, r"state\['a'\] must be a whole number from 1 to 1024, got True"),
        ({"action_dim": 7.0}, "action_dim must be a whole number from 1 to 1024, got 7.0"),
        ({"delta_action_dims": 6}, "delta_action_dims must be a list such as"),
        ({"delta_action_dims": [6, 0]}, "delta_action_dims must be a list such as"),
        ({"delta_action_dims": [6, -2]}, r"delta_action_dims \[6, -2\] covers 8 dimensions, but action_dim is 7"),
        ({"delta_action_dims": [4], "state": {"a": 3}}, "covers 4 dimensions, but the state's width is 3"),
        ({"delta_action_dims": [10**12]}, "covers 1000000000000 dimensions, but action_dim is 7"),
        ({"default_prompt": 3}, "default_prompt must be text"),
        ({"reset_pose": ["a"]}, "reset_pose must be a list of numbers"),
        ({"reset_pose": [float("nan")]}, "reset_pose must be a list of numbers"),
        ({"reset_pose": [10**400]}, "reset_pose must be a list of numbers"),
    ],
)
def test_wrong_descriptions_name_the_field(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        robot_from_dict(description(**changes))


@pytest.mark.parametrize("field", ["name", "cameras", "state", "action_dim"])
def test_a_description_without_a_needed_field_is_refused(field: str) -> None:
    rest = {name: value for name, value in description().items() if name != field}
    with pytest.raises(ConfigError, match=f"{field} missing; a robot needs name, cameras, state, action_dim"):
        robot_from_dict(rest)


@pytest.mark.parametrize(
    ("content", "message"), [("{", "isn't JSON"), ("[]", "is a list; expected an object"), ("\xff", "isn't JSON")]
)
def test_files_that_arent_descriptions_are_refused_by_name(tmp_path: Path, content: str, message: str) -> None:
    path = tmp_path / "arm.json"
    path.write_text(content, encoding="latin-1")
    with pytest.raises(ConfigError, match=rf"arm\.json.*{message}"):
        load_robot(path)


def test_the_documented_class_works(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "documented_arms.py").write_text(documented("python"))
    monkeypatch.syspath_prepend(tmp_path)
    robot = import_robot("documented_arms:DegreeArm")
    sys.modules.pop("documented_arms")
    observation = {**robot.example(np.random.default_rng(0)), "degrees": np.full(6, 90.0), "gripper": [51]}
    inputs = robot.inputs(observation)
    np.testing.assert_allclose(inputs.state, [*[np.pi / 2] * 6, 0.8])
    np.testing.assert_allclose(robot.outputs(np.full((4, 32), 0.8))[:, 6], 51)
    assert robot.delta_mask is None  # a default of the protocol
    with pytest.raises(ObservationError, match=r"degrees has shape \(5,\), expected shape \(6,\)"):
        robot.inputs({**observation, "degrees": np.zeros(5)})


@pytest.mark.parametrize(
    ("path", "message"),
    [
        ("no_such_module:Arm", "can't import the robot 'no_such_module:Arm'"),
        ("turbopi.robots:Arm", "can't import the robot"),
        ("turbopi.robots", "a robot's path is module:Class"),
        ("pathlib:Path", "has no inputs, outputs"),
        ("turbopi.robots:LeRobot", "can't make the robot .*image_keys"),
        ("turbopi.robots:Robot", "can't make the robot"),
    ],
)
def test_paths_that_lead_to_no_robot_are_refused(path: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        import_robot(path)


def test_the_example_of_droid_by_joint_positions_reads_droids_keys() -> None:
    """As Isaac Lab-Arena's client sends them, in float32; its checkpoints' joint actions are relative to the state."""
    robot, droid = load_robot(FOLDER.parents[2] / "examples" / "droid_jointpos.json"), CREATED["droid"]
    sent = droid.example(np.random.default_rng(0))
    sent |= {key: value.astype(np.float32) for key, value in sent.items() if "position" in key}
    ours, theirs = robot.inputs(sent), droid.inputs(sent)
    assert (ours.image_mask, ours.prompt) == (theirs.image_mask, theirs.prompt)
    for camera, image in theirs.images.items():
        np.testing.assert_array_equal(ours.images[camera], image)
    np.testing.assert_array_equal(ours.state, theirs.state)
    assert robot.delta_mask == (True,) * 7 + (False,) and droid.delta_mask is None
    assert robot.action_dim == droid.action_dim
