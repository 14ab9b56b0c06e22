"""LeRobot's processor pipelines: what Turbo-Pi computes of them, and that nothing else passes unnoticed."""

import copy
import json
import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from checkpoint_helpers import edit_json, lerobot_copy

from turbopi.checkpoint import open_checkpoint
from turbopi.checkpoint.lerobot_pipeline import Pipelines
from turbopi.config import VisionConfig
from turbopi.support.errors import CheckpointError

PRE, POST = "policy_preprocessor.json", "policy_postprocessor.json"
RENAME, BATCH, RELATIVE = "rename_observations_processor", "to_batch_processor", "relative_actions_processor"
NORMALIZER, STATE_STEP = "normalizer_processor", "pi05_prepare_state_tokenizer_processor_step"
TOKENIZER, DEVICE = "tokenizer_processor", "device_processor"
UNNORMALIZER, ABSOLUTE = "unnormalizer_processor", "absolute_actions_processor"
JOINTS = ["shoulder.pos", "elbow.pos", "wrist.pos", "roll.pos", "pitch.pos", "yaw.pos", "Gripper.pos"]


@pytest.fixture(autouse=True)
def standard_heads(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("turbopi.checkpoint.sizes._STANDARD_VISION", VisionConfig(width=64, num_heads=4))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A checkpoint with the steps of LeRobot 0.6, relative actions off."""
    made = lerobot_copy(tmp_path / "c")
    relative = {"enabled": False, "exclude_joints": ["gripper"], "action_names": None}
    edit_json(made / PRE, lambda c: c["steps"].insert(2, {"registry_name": RELATIVE, "config": relative}))
    edit_json(made / POST, lambda c: c["steps"].insert(1, {"registry_name": ABSOLUTE, "config": {"enabled": False}}))
    return made


def entry(content: Any, name: str) -> Any:
    return next(step for step in content["steps"] if step["registry_name"] == name)


def edit(folder: Path, file: str, name: str, **config: Any) -> None:
    edit_json(folder / file, lambda c: entry(c, name)["config"].update(config))


def relative_on(folder: Path, **config: Any) -> None:
    edit(folder, PRE, RELATIVE, enabled=True, **config)
    edit(folder, POST, ABSOLUTE, enabled=True)


def reorder(folder: Path, file: str, names: list[str]) -> None:
    """Some steps change places with each other; the rest stay."""

    def change(content: Any) -> None:
        places = [i for i, step in enumerate(content["steps"]) if step["registry_name"] in names]
        moved = [entry(content, name) for name in names]
        for place, step in zip(places, moved, strict=True):
            content["steps"][place] = step

    edit_json(folder / file, change)


@pytest.mark.parametrize(
    ("file", "order"),
    [
        (PRE, [RELATIVE, RENAME]),
        (PRE, [NORMALIZER, RENAME]),
        (PRE, [NORMALIZER, RELATIVE]),
        (PRE, [STATE_STEP, NORMALIZER]),
        (PRE, [TOKENIZER, STATE_STEP]),
        (PRE, [TOKENIZER, NORMALIZER]),
        (POST, [ABSOLUTE, UNNORMALIZER]),
    ],
)
def test_another_order_of_steps_is_refused(folder: Path, file: str, order: list[str]) -> None:
    reorder(folder, file, order)
    with pytest.raises(CheckpointError, match=rf"{file} has {order[0]} before \w+, which computes something else than"):
        open_checkpoint(folder)


def test_steps_that_change_nothing_may_stand_anywhere(folder: Path) -> None:
    plain = open_checkpoint(folder).config
    harmless = [
        {"registry_name": DEVICE, "config": {"device": "cuda", "float_dtype": "float32"}},
        *({"registry_name": f"{BATCH}{part}"} for part in ("", "_action", "_observation", "_complementary_data")),
        {"registry_name": "smolvla_new_line_processor"},
        {"registry_name": "pi0_new_line_processor", "config": {}},
    ]
    edit_json(folder / PRE, lambda c: c.update(steps=copy.deepcopy(harmless) + c["steps"]))
    edit_json(folder / POST, lambda c: c.update(steps=copy.deepcopy(harmless[:5]) + c["steps"]))
    assert open_checkpoint(folder).config == plain


def test_steps_that_change_nothing_may_be_missing(folder: Path) -> None:
    plain = open_checkpoint(folder).config
    idle = (BATCH, DEVICE, RENAME, RELATIVE, ABSOLUTE)
    for file in (PRE, POST):
        edit_json(folder / file, lambda c: c.update(steps=[s for s in c["steps"] if s["registry_name"] not in idle]))
    assert open_checkpoint(folder).config == plain


@pytest.mark.parametrize("name", [STATE_STEP, TOKENIZER])
def test_a_prompt_without_its_steps_is_refused(folder: Path, name: str) -> None:
    edit_json(folder / PRE, lambda c: c["steps"].remove(entry(c, name)))
    with pytest.raises(CheckpointError, match=f"{PRE} has no step {name}"):
        open_checkpoint(folder)


@pytest.mark.parametrize(("file", "name", "kind"), [(PRE, NORMALIZER, "STATE"), (POST, UNNORMALIZER, "ACTION")])
def test_a_missing_normaliser_is_never_a_silent_identity(folder: Path, file: str, name: str, kind: str) -> None:
    edit_json(folder / file, lambda c: c["steps"].remove(entry(c, name)))
    with pytest.raises(CheckpointError, match=f"normalises {kind} by IDENTITY, but config.json says QUANTILES"):
        open_checkpoint(folder)
    edit_json(folder / "config.json", lambda c: c["normalization_mapping"].update({kind: "IDENTITY"}))
    modes = open_checkpoint(folder).config.normalization
    assert "identity" in (modes.state, modes.actions)


@pytest.mark.parametrize("name", ["smolvla_new_line_processor", "pi0_new_line_processor"])
def test_a_new_line_behind_the_states_step_is_refused(folder: Path, name: str) -> None:
    edit_json(folder / PRE, lambda c: c["steps"].insert(5, {"registry_name": name}))
    with pytest.raises(CheckpointError, match=rf"{STATE_STEP} before {name}|has {name} before"):
        open_checkpoint(folder)


@pytest.mark.parametrize("file", [PRE, POST])
@pytest.mark.parametrize(
    "name",
    [
        *("image_crop_resize_processor", "libero_processor", "observation_processor", "action_tokenizer_processor"),
        *("robot_action_to_policy_action_processor", "map_delta_action_to_robot_action", "gripper_penalty_processor"),
        *("torch2numpy_action_processor", "time_limit_processor", "render_messages_processor", "xvla_image_scale"),
        *("pi0_fast_prepare_state_tokenizer_processor_step", "evo1_pad_state_processor", "map_tensor_to_delta_action"),
    ],
)
def test_other_steps_of_lerobot_are_refused_by_name(folder: Path, file: str, name: str) -> None:
    edit_json(folder / file, lambda c: c["steps"].insert(1, {"registry_name": name, "config": {}}))
    with pytest.raises(CheckpointError, match=f"{file} has a step '{name}' that Turbo-Pi doesn't know"):
        open_checkpoint(folder)


def test_a_step_by_its_class_is_refused_by_name(folder: Path) -> None:
    edit_json(folder / PRE, lambda c: c["steps"].insert(1, {"class": "my_robot.Mirror", "config": {}}))
    with pytest.raises(CheckpointError, match=r"has a step 'my_robot\.Mirror' that Turbo-Pi doesn't know"):
        open_checkpoint(folder)


@pytest.mark.parametrize("name", [RENAME, RELATIVE, NORMALIZER, STATE_STEP, TOKENIZER])
def test_a_step_that_stands_twice_is_refused(folder: Path, name: str) -> None:
    def change(content: Any) -> None:
        place = content["steps"].index(entry(content, name))
        content["steps"].insert(place, copy.deepcopy(content["steps"][place]))

    edit_json(folder / PRE, change)
    with pytest.raises(CheckpointError, match=f"has the step {name} twice"):
        open_checkpoint(folder)


@pytest.mark.parametrize("padding", ["longest", "do_not_pad"])
def test_padding_is_masked_whichever_way_it_goes(folder: Path, padding: str) -> None:
    edit(folder, PRE, TOKENIZER, padding=padding, padding_side="left", truncation=True)
    assert open_checkpoint(folder).config.model.max_prompt_tokens == 180


def test_a_tokenizer_without_a_length_has_lerobots_own(folder: Path) -> None:
    edit_json(folder / PRE, lambda c: entry(c, TOKENIZER)["config"].pop("max_length"))
    checkpoint = open_checkpoint(folder)
    assert checkpoint.config.model.max_prompt_tokens == 512
    assert "says 180 tokens of prompt, but policy_preprocessor.json 512" in checkpoint.info()["notes"][0]


# Relative actions


def mask_of(folder: Path) -> Any:
    return open_checkpoint(folder).config.robot_options.get("relative_dims")


@pytest.mark.parametrize(
    ("names", "excluded", "kept"),
    [
        (JOINTS, ["gripper"], [6]),
        (JOINTS, ["GRIP", "ro"], [3, 6]),
        (JOINTS, [".pos"], [0, 1, 2, 3, 4, 5, 6]),
        (JOINTS, ["", None], []),
        (JOINTS, [], []),
        (JOINTS, None, []),
        (None, ["gripper"], []),
        ([], ["gripper"], []),
        (JOINTS[:2], ["elbow"], [1]),
        ([*JOINTS, "gripper.2"], ["gripper"], [6]),
    ],
)
def test_which_actions_are_relative(folder: Path, names: Any, excluded: Any, kept: list[int]) -> None:
    relative_on(folder, action_names=names, exclude_joints=excluded)
    assert mask_of(folder) == [i not in kept for i in range(7)]


def test_the_step_of_0_5_1_is_the_same(folder: Path) -> None:
    relative_on(folder, action_names=JOINTS)
    expected = open_checkpoint(folder).config
    edit_json(folder / PRE, lambda c: entry(c, RELATIVE).update(registry_name="delta_actions_processor"))
    assert open_checkpoint(folder).config == expected


def test_the_postprocessor_decides_whether_the_state_is_added(folder: Path) -> None:
    edit_json(folder / "config.json", lambda c: c.update(use_relative_actions=True))
    assert mask_of(folder) is None
    (note,) = open_checkpoint(folder).info()["notes"]
    assert "says use_relative_actions = true, but the processors' steps otherwise" in note
    edit(folder, PRE, RELATIVE, enabled=True)
    assert mask_of(folder) is None
    (note,) = open_checkpoint(folder).info()["notes"]
    assert note.startswith("answers are relative to the state")
    edit(folder, PRE, RELATIVE, enabled=False)
    edit(folder, POST, ABSOLUTE, enabled=True)
    assert mask_of(folder) == [True] * 7
    assert open_checkpoint(folder).info()["notes"] == []


def test_a_state_that_nobody_keeps_is_refused(folder: Path) -> None:
    relative_on(folder)
    edit_json(folder / PRE, lambda c: c["steps"].remove(entry(c, RELATIVE)))
    with pytest.raises(CheckpointError, match=f"{ABSOLUTE} is enabled, but {PRE} has no {RELATIVE} whose state"):
        open_checkpoint(folder)


def test_a_state_narrower_than_relative_actions_is_refused(folder: Path) -> None:
    relative_on(folder)
    edit_json(
        folder / PRE, lambda c: entry(c, NORMALIZER)["config"].update(features={})
    )  # no statistics: config.json's
    edit_json(folder / "config.json", lambda c: c["input_features"]["observation.state"].update(shape=[6]))
    with pytest.raises(CheckpointError, match="adds the state to 7 relative actions, but the state has 6 values"):
        open_checkpoint(folder)


@pytest.mark.parametrize(("key", "value"), [("enabled", 1), ("exclude_joints", "gripper"), ("action_names", {"a": 1})])
def test_values_of_the_wrong_type_are_refused(folder: Path, key: str, value: Any) -> None:
    relative_on(folder)
    edit(folder, PRE, RELATIVE, **{key: value})
    with pytest.raises(CheckpointError, match=f"{PRE}: {key} is .*; expected"):
        open_checkpoint(folder)


# Any files


def _mutate(content: Any, rng: random.Random) -> Any:
    """One change somewhere: a value replaced, a key or item removed, repeated, renamed or moved."""
    junk: list[Any] = [None, True, 0, -1, 1e300, "", "x", [], {}, [[]], {"a": None}, "float16", "STATE", 10**18, "../x"]
    places: list[tuple[Any, Any]] = []

    def walk(value: Any) -> None:
        keys = list(value) if isinstance(value, dict) else range(len(value)) if isinstance(value, list) else ()
        for key in keys:
            places.append((value, key))
            walk(value[key])

    walk(content)
    holder, key = rng.choice(places)
    changes: list[Callable[[], Any]] = [lambda: holder.__setitem__(key, rng.choice(junk)), lambda: holder.pop(key)]
    if isinstance(holder, list):
        changes += [lambda: holder.insert(0, copy.deepcopy(holder[key])), lambda: rng.shuffle(holder)]
    else:
        changes.append(lambda: holder.__setitem__(f"{key}2", holder.pop(key)))
    rng.choice(changes)()
    return content


@pytest.mark.slow
def test_any_pipelines_are_read_or_refused_in_one_line(folder: Path) -> None:
    """What is read has the steps that are done in the order that they are done, none of them twice."""
    relative_on(folder, action_names=JOINTS)
    files = {name: json.loads((folder / name).read_text()) for name in (PRE, POST)}
    read, refusals = 0, []
    rng = random.Random(0)
    for _ in range(1500):
        for name, content in files.items():
            changed = copy.deepcopy(content)
            for _ in range(rng.choice((0, 1, 1, 2))):
                changed = _mutate(changed, rng) if changed else changed
            (folder / name).write_text(json.dumps(changed))
        try:
            pipelines = Pipelines(folder)
            mask = pipelines.relative_mask(7)
        except CheckpointError as error:
            refusals.append(str(error))
            continue
        read += 1
        order = [RENAME, RELATIVE, NORMALIZER, STATE_STEP, TOKENIZER, UNNORMALIZER, ABSOLUTE]
        done = list(pipelines.steps)
        assert done == [name for name in order if name in done]
        assert mask is None or np.shape(mask) == (7,)
    assert read > 200
    assert len(refusals) > 500
    assert all("\n" not in reported and (PRE in reported or POST in reported) for reported in refusals)


@pytest.mark.slow
def test_any_config_is_read_or_refused_in_one_line(folder: Path) -> None:
    relative_on(folder)
    files = {name: json.loads((folder / name).read_text()) for name in ("config.json", PRE, POST)}
    rng = random.Random(1)
    opened, refusals = 0, []
    for _ in range(150):
        for name, content in files.items():
            changed = copy.deepcopy(content)
            (folder / name).write_text(json.dumps(_mutate(changed, rng) if rng.random() < 0.5 else changed))
        try:
            open_checkpoint(folder)
            opened += 1
        except CheckpointError as error:
            refusals.append(str(error))
    assert opened > 20
    assert len(refusals) > 20
    assert not any("\n" in reported for reported in refusals)
