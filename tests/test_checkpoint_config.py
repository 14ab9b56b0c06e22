"""`config=`: presets, turbopi.json, and what is refused because nothing records it."""

import dataclasses
import json
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
from checkpoint_helpers import GOLDEN, LIBERO, jax_copy, read_tree, torch_copy, write_json

from turbopi.checkpoint import inspect_checkpoint, open_checkpoint
from turbopi.checkpoint.settings import parse_values
from turbopi.config import PRESETS, GemmaConfig, ModelConfig, Normalization, RealTime, VisionConfig
from turbopi.policy.policy import UnifiedPolicy
from turbopi.support.errors import CheckpointError, ConfigError

PI05, PI0 = GOLDEN / "pi05" / "jax", GOLDEN / "pi0" / "jax"


def test_auto_without_turbopi_json_lists_the_presets_that_fit() -> None:
    with pytest.raises(ConfigError) as caught:
        open_checkpoint(PI05)
    text = str(caught.value)
    assert "pi05_base, pi05_libero, pi05_droid, pi05_aloha" in text
    assert "pi0_" not in text
    assert f"statistics ({LIBERO}) suggest pi05_libero" in text
    assert "doesn't record its robot, its horizon, or whether the state goes into the prompt" in text
    with pytest.raises(ConfigError, match=r"statistics \(trossen\) suggest pi0_aloha"):
        open_checkpoint(PI0)


@pytest.mark.parametrize(("folder", "preset"), [(PI05, "pi0_libero"), (PI0, "pi05_aloha")])
def test_a_preset_of_the_other_kind_is_refused(folder: Path, preset: str) -> None:
    with pytest.raises(ConfigError, match=f"preset {preset} is for .* weights; presets that fit: "):
        open_checkpoint(folder, preset)
    with pytest.raises(ConfigError, match=f"PolicyConfig {preset} is for"):
        open_checkpoint(folder, PRESETS[preset])


def test_a_presets_edges_are_kept_and_its_sizes_are_not() -> None:
    config, preset = open_checkpoint(PI05, "pi05_libero").config, PRESETS["pi05_libero"]
    assert config.robot == "libero"
    assert config.discrete_state_input is False
    assert config.model.action_horizon == preset.model.action_horizon == 10
    assert config.planned_model.vlm.width == 96


@pytest.mark.parametrize("config", ["pi05_liber0", "", "somewhere/else", 5, None])
def test_an_unknown_config_lists_the_choices(config: Any) -> None:
    expected = r"config='.*' is neither a preset, nor 'auto', nor a path to a .json; .*[Pp]resets are .*pi05_libero"
    with pytest.raises(ConfigError, match=expected):
        open_checkpoint(PI05, config)


def test_turbopi_json_beside_the_weights_is_used_and_config_replaces_it(tmp_path: Path) -> None:
    folder = jax_copy(tmp_path / "c", read_tree(PI05 / "params"))
    write_json(folder / "turbopi.json", {"preset": "pi05_libero", "action_horizon": 25, "default_prompt": "fold it"})
    by_file, by_name = open_checkpoint(folder), open_checkpoint(folder, "pi05_libero")
    assert (by_file.config.model.action_horizon, by_file.config.default_prompt) == (25, "fold it")
    assert by_file.config_source == str(folder / "turbopi.json")
    assert (by_name.config.model.action_horizon, by_name.config.default_prompt) == (10, None)


def test_every_key_of_turbopi_json_reaches_the_config(tmp_path: Path) -> None:
    values = {
        "preset": "pi05_base",
        "name": "mine",
        "robot": "libero",
        "robot_options": {"a": 1},
        "normalization": {"state": "zscore", "actions": "quantile"},
        "discrete_state_input": False,
        "action_horizon": 16,
        "max_prompt_tokens": 64,
        "asset_id": LIBERO,
        "default_prompt": "go",
        "image_resize": "lerobot_0.4",
        "prompt_state_dim": 32,
        "time_grid": "multiplied",
        "num_denoising_steps": 5,
        "vision_heads": 4,
    }
    write_json(tmp_path / "mine.json", values)
    config = open_checkpoint(PI05, str(tmp_path / "mine.json")).config
    assert config.normalization == Normalization("zscore", "quantile")
    model = config.planned_model
    assert (model.action_horizon, model.max_prompt_tokens, model.time_grid) == (16, 64, "multiplied")
    assert model.vision.num_heads == 4
    for key in values.keys() & {field.name for field in dataclasses.fields(config)} - {"normalization"}:
        assert getattr(config, key) == values[key], key


def test_a_robot_given_without_options_has_none_of_the_presets(tmp_path: Path) -> None:
    write_json(tmp_path / "mine.json", {"preset": "pi05_aloha", "robot": "libero", "asset_id": LIBERO})
    assert open_checkpoint(PI05, tmp_path / "mine.json").config.robot_options == {}


def test_the_presets_robot_named_again_keeps_its_options(tmp_path: Path) -> None:
    write_json(tmp_path / "mine.json", {"preset": "pi05_aloha", "robot": "aloha", "asset_id": LIBERO})
    config = open_checkpoint(PI05, tmp_path / "mine.json").config
    assert config.robot_options == {"adapt_to_pi": True, "delta_actions": True}


def test_a_robots_own_file_is_found_beside_the_json(tmp_path: Path) -> None:
    write_json(tmp_path / "arm.json", {})
    write_json(tmp_path / "mine.json", {"preset": "pi05_base", "robot": "arm.json"})
    assert open_checkpoint(PI05, tmp_path / "mine.json").config.robot == str(tmp_path / "arm.json")
    (tmp_path / "arm.json").unlink()
    with pytest.raises(ConfigError, match=r"robot is 'arm\.json', but there is no file"):
        open_checkpoint(PI05, tmp_path / "mine.json")


WRONG: dict[str, list[Any]] = {
    "preset": ["pi06", 3, None],
    "robot": [None, "", 4, "a\0b"],
    "name": ["a\nb"],
    "robot_options": [[], "x"],
    "normalization": ["median", {"state": "zscore"}, {"state": "zscore", "actions": "x"}, 1],
    "discrete_state_input": [1, "true", None],
    "action_horizon": [0, -1, 2.0, "10", True, 1001, 10**18],
    "max_prompt_tokens": [0, None, 10**18],
    "num_denoising_steps": [0, 2.0, None, 10**18],
    "asset_id": [3, ""],
    "default_prompt": [["a"], ""],
    "image_resize": ["bicubic"],
    "prompt_state_dim": [0, "32", True],
    "lerobot_semantics": ["0.5", 0.4, None],
    "time_grid": ["exact"],
    "vision_heads": [0, "4", 10**18],
    "lora_alpha": [1e300, 10**18, 0, -1, "16", {}, {"llm": 16}, {"vlm": True}],
    "lora_rslora": ["yes"],
}


@pytest.mark.parametrize(("key", "value"), [(key, value) for key, values in WRONG.items() for value in values])
def test_values_of_the_wrong_type_are_refused_by_name(key: str, value: Any) -> None:
    with pytest.raises(ConfigError) as caught:
        parse_values({key: value}, "turbopi.json")
    assert str(caught.value).startswith(f"turbopi.json: {key} is {value!r}; expected ")


@pytest.mark.parametrize(
    "changes",
    [
        {"action_horizon": 10**18},
        {"action_dim": 0},
        {"vocab_size": True},
        {"vlm": GemmaConfig(width=2048, mlp_dim=16384, depth=300_000)},
        {"vision": VisionConfig(image_size=10**9)},
        {"rope_base": float("nan")},
        {"rms_norm_eps": -1.0},
    ],
)
def test_no_model_is_beyond_the_limits(changes: dict[str, Any]) -> None:
    with pytest.raises(ConfigError, match=r"expected a (whole )?number"):
        ModelConfig(**changes)


def test_unknown_keys_are_refused_with_the_known_ones(tmp_path: Path) -> None:
    write_json(tmp_path / "mine.json", {"preset": "pi05_libero", "horizon": 10, "xyz": 1})
    expected = r"unknown keys 'horizon' \(did you mean action_horizon\?\), 'xyz'; known are preset, name, robot"
    with pytest.raises(ConfigError, match=expected):
        open_checkpoint(PI05, tmp_path / "mine.json")


@pytest.mark.parametrize(
    ("content", "message"),
    [("{", "isn't JSON"), ("[]", "is a list; expected an object"), ('{"robot": "libero"}', "has no preset")],
)
def test_a_broken_json_is_refused(tmp_path: Path, content: str, message: str) -> None:
    (tmp_path / "mine.json").write_text(content)
    with pytest.raises(ConfigError, match=message):
        open_checkpoint(PI05, tmp_path / "mine.json")
    with pytest.raises(ConfigError, match=r"absent\.json can't be read"):
        open_checkpoint(PI05, tmp_path / "absent.json")


def test_pi0_cannot_have_its_state_in_the_prompt(tmp_path: Path) -> None:
    write_json(tmp_path / "mine.json", {"preset": "pi0_aloha", "discrete_state_input": True})
    with pytest.raises(ConfigError, match="discrete_state_input is true, but Pi0"):
        open_checkpoint(PI0, tmp_path / "mine.json")


def test_the_horizon_is_the_jsons_else_the_presets_and_config_jsons_is_a_note(tmp_path: Path) -> None:
    folder = torch_copy(tmp_path / "c")
    recorded = json.loads((folder / "config.json").read_text())
    write_json(folder / "config.json", recorded | {"action_horizon": 33, "max_token_len": 48})
    for settings, horizon in ({}, 10), ({"action_horizon": 12}, 12):
        values = {"preset": "pi05_libero", "vision_heads": 4} | settings
        write_json(folder / "turbopi.json", values)
        write_json(tmp_path / "given.json", values)
        for config in ("auto", tmp_path / "given.json"):
            opened = open_checkpoint(folder, config)
            assert opened.config.model.action_horizon == horizon
            (note,) = [note for note in opened.info()["notes"] if "config.json" in note]
            assert f"action_horizon = 33 (used: {horizon}), max_token_len = 48 (used: 200)" in note
    write_json(folder / "config.json", recorded | {"action_horizon": 12})
    assert open_checkpoint(folder).info()["notes"] == []


@pytest.mark.parametrize(
    ("content", "note"),
    [
        ({"precision": "bf16"}, None),  # as they are stored
        ({"precision": "fp64"}, "precision = 'fp64' (used: BF16)"),
        ({"precision": 16}, "precision = 16"),
        ({"action_dim": 7}, "action_dim = 7 (used: 32)"),
        ({"action_dim": 10**18, "action_horizon": "16"}, "action_dim = 1000000000000000000"),
        ({"action_horizon": "10"}, "action_horizon = '10' (used: 10)"),
        ({"discrete_state_input": True, "pi05": True}, "discrete_state_input = True (used: False)"),
        ({"paligemma_variant": 2}, "paligemma_variant = 2 (used: 96 wide, 3 layers, an MLP of"),
        ({"action_expert_variant": "gemma_300m_lora"}, "action_expert_variant = 'gemma_300m_lora'"),
        ({"paligemma_variant": "gemma_2b_of_mine", "precision": None}, None),
        ({}, None),
    ],
)
def test_a_config_json_of_any_tool_is_at_most_a_note(tmp_path: Path, content: dict[str, Any], note: str | None) -> None:
    """openpi reads none of it, so sizes are the weights', and all else is the configuration's."""
    folder = torch_copy(tmp_path / "c")
    write_json(folder / "config.json", content)
    opened = open_checkpoint(folder)
    assert (opened.config.model.action_dim, opened.config.model.action_horizon) == (32, 10)
    assert opened.source.notes == [] if note is None else note in opened.source.notes[0]


def test_config_jsons_horizon_is_a_hint_where_no_configuration_is_known(tmp_path: Path) -> None:
    folder = torch_copy(tmp_path / "c")
    (folder / "turbopi.json").unlink()
    write_json(folder / "config.json", {"action_horizon": 33})
    info = inspect_checkpoint(folder)
    assert info["action_dim"] == 32
    assert "action_horizon = 33 (used: the configuration's)" in info["notes"][0]


def test_a_policy_logs_what_its_checkpoint_says_twice(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    folder = torch_copy(tmp_path / "c")
    write_json(folder / "config.json", {"action_dim": 7})
    UnifiedPolicy(folder, backend="pytorch", device="cpu", tokenizer=Mock())
    assert "config.json isn't read, nor does openpi read it. It says action_dim = 7 (used: 32)" in caplog.text


def test_a_turbopi_json_that_config_replaces_is_a_note_where_it_differs(tmp_path: Path) -> None:
    folder = torch_copy(tmp_path / "c", action_horizon=25, weights_sha256="0" * 64)
    given = tmp_path / "given.json"
    (folder / "config.json").unlink()
    write_json(given, {"preset": "pi05_libero", "vision_heads": 4, "real_time": {"schedule": "linear"}})
    (note,) = open_checkpoint(folder, given).source.notes
    assert (
        f"turbopi.json isn't read: {given} replaces it. With it: " in note and "action_horizon = 25 (used: 10)" in note
    )
    assert "real_time.schedule = 'exponential' (used: 'linear')" in note
    assert "weights_sha256 = '0000" in note and "vision_heads" not in note
    assert open_checkpoint(folder, folder / "turbopi.json").source.notes == []  # the file itself
    write_json(given, json.loads((folder / "turbopi.json").read_text()))
    assert open_checkpoint(folder, given).source.notes == []
    (folder / "turbopi.json").write_text("{")
    (note,) = open_checkpoint(folder, given).source.notes
    assert "By itself it is refused: " in note and "isn't JSON" in note


@pytest.mark.parametrize(
    ("real_time", "horizon", "message"),
    [
        ({"execution_horizon": 17}, 16, "execution_horizon = 17, but a chunk has 16 actions; expected at most 16"),
        ({"trained_max_delay": 16}, 16, "trained_max_delay = 16, but a chunk has 16 actions; expected at most 15"),
        ({"execution_horizon": 16, "trained_max_delay": 15}, 16, None),
    ],
)
def test_real_time_options_fit_the_chunk(
    tmp_path: Path, real_time: dict[str, Any], horizon: int, message: str | None
) -> None:
    """A joined call would cut them in silence."""
    folder = torch_copy(tmp_path / "c")
    settings = {"preset": "pi05_libero", "vision_heads": 4, "action_horizon": horizon, "real_time": real_time}
    write_json(folder / "turbopi.json", settings)
    own = PRESETS["pi05_libero"].with_model(action_horizon=horizon)
    own = dataclasses.replace(own, real_time=RealTime(**real_time))
    if message is None:
        assert open_checkpoint(folder).config.real_time == RealTime(15, 16)
        return
    with pytest.raises(ConfigError, match=f"turbopi.json: real_time has {message}"):
        open_checkpoint(folder)
    with pytest.raises(ConfigError, match=f"PolicyConfig pi05_libero: real_time has {message}"):
        open_checkpoint(folder, own)


def test_one_of_several_assets_must_be_chosen(tmp_path: Path) -> None:
    folder = jax_copy(tmp_path / "c", read_tree(PI05 / "params"))
    only = open_checkpoint(folder, "pi05_base")  # names no asset: the only one
    assert only.asset_id == LIBERO
    (folder / "assets" / "mine").mkdir()
    stats = (folder / "assets" / LIBERO / "norm_stats.json").read_text()
    (folder / "assets" / "mine" / "norm_stats.json").write_text(stats)
    with pytest.raises(ConfigError, match=f'has mine, {LIBERO}; choose with {{"asset_id": ...}}'):
        open_checkpoint(folder, "pi05_base")
    write_json(folder / "turbopi.json", {"preset": "pi05_base", "asset_id": "mine"})
    assert open_checkpoint(folder).asset_id == "mine"
    with pytest.raises(
        CheckpointError, match=f"no .*assets/droid/norm_stats.json; there are statistics of mine, {LIBERO}"
    ):
        open_checkpoint(folder, "pi05_droid")
