"""LeRobot's pi05 checkpoints: described by their own files, and refused where Turbo-Pi would compute something else."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from checkpoint_helpers import GOLDEN, edit_json, edit_tensors, lerobot_copy, lerobot_statistics, write_json
from lerobot_cases import tokenizer_folder
from safetensors.torch import load_file, save_file

from turbopi.checkpoint import inspect_checkpoint, open_checkpoint
from turbopi.checkpoint.convert import convert
from turbopi.config import PRESETS, GemmaConfig, Normalization, RealTime, VisionConfig
from turbopi.preprocess.tokenizer import prompt_texts
from turbopi.robots import create_robot
from turbopi.support.errors import CheckpointError, ConfigError, ObservationError

PRE, POST = "policy_preprocessor.json", "policy_postprocessor.json"
EMBEDDING = "model__paligemma_with_expert__paligemma__model__language_model__embed_tokens__weight"


@pytest.fixture(autouse=True)
def standard_heads(monkeypatch: pytest.MonkeyPatch) -> None:
    """LeRobot only has full-size models, whose 16 heads are known: let the golden width be the standard one here."""
    monkeypatch.setattr("turbopi.checkpoint.sizes._STANDARD_VISION", VisionConfig(width=64, num_heads=4))


def step(content: Any, name: str) -> Any:
    return next(entry for entry in content["steps"] if entry["registry_name"] == name)


def test_a_lerobot_folder_describes_itself(tmp_path: Path) -> None:
    checkpoint = open_checkpoint(lerobot_copy(tmp_path / "c"))
    config = checkpoint.config
    assert checkpoint.format == "lerobot"
    assert (config.robot, config.image_resize, config.discrete_state_input) == ("lerobot", "lerobot", True)
    assert config.normalization == Normalization("lerobot_quantile", "lerobot_quantile")
    assert (config.model.action_horizon, config.model.max_prompt_tokens) == (30, 180)
    assert config.model.time_grid == "multiplied"
    assert config.planned_model.expert == GemmaConfig(width=32, mlp_dim=64, depth=3, head_dim=16)
    assert config.robot_options == {
        "image_keys": ["observation.images.image", "observation.images.image2"],
        "num_missing_cameras": 1,
        "state_dim": 8,
        "action_dim": 7,
    }
    assert config.num_denoising_steps == checkpoint.info()["num_denoising_steps"] == 7  # its num_inference_steps


def test_its_weights_are_openpis(tmp_path: Path) -> None:
    ours = open_checkpoint(lerobot_copy(tmp_path / "c"))
    assert ours.fingerprint() == open_checkpoint(GOLDEN / "pi05" / "jax", "pi05_libero").fingerprint()


@pytest.mark.parametrize(
    ("mode", "expected", "used"),
    [
        ("QUANTILES", "lerobot_quantile", ("q01", "q99")),
        ("QUANTILE10", "lerobot_quantile10", ("q10", "q90")),
        ("MEAN_STD", "lerobot_zscore", ("mean", "std")),
        ("MIN_MAX", "lerobot_min_max", ("min", "max")),
        ("IDENTITY", "identity", ()),
    ],
)
def test_every_normalisation_finds_its_statistics_by_state_file(
    tmp_path: Path, mode: str, expected: str, used: tuple[str, ...]
) -> None:
    checkpoint = open_checkpoint(lerobot_copy(tmp_path / "c", mode))
    stored = lerobot_statistics()
    assert checkpoint.config.normalization == Normalization(expected, expected)  # type: ignore[arg-type]
    stats = checkpoint.norm_stats
    assert stats.state is not None
    assert stats.actions is not None
    for name in used:
        assert np.array_equal(getattr(stats.state, name), stored[f"observation.state.{name}"].double().numpy())
        assert np.array_equal(getattr(stats.actions, name), stored[f"action.{name}"].double().numpy())


def test_the_training_outputs_folder_is_understood(tmp_path: Path) -> None:
    (tmp_path / "020000").mkdir()
    folder = lerobot_copy(tmp_path / "020000" / "pretrained_model")
    assert open_checkpoint(tmp_path / "020000").path == folder


def test_cameras_are_called_what_observations_call_them_or_what_the_policy_does(tmp_path: Path) -> None:
    folder = lerobot_copy(tmp_path / "c")
    renames = {"observation.images.top": "observation.images.image"}
    edit_json(folder / PRE, lambda c: step(c, "rename_observations_processor")["config"].update(rename_map=renames))
    options = open_checkpoint(folder).config.robot_options
    assert options["image_keys"] == ["observation.images.image", "observation.images.image2"]
    assert options["rename_map"] == renames
    robot = create_robot("lerobot", options)
    example = robot.example(np.random.default_rng(0))
    assert set(example) == {"observation.images.top", "observation.images.image2", "observation.state", "task"}
    sent = robot.inputs(example)
    assert list(sent.images)[:2] == options["image_keys"]
    named = {renames.get(key, key): value for key, value in example.items()}
    again = robot.inputs(named)
    assert all(np.array_equal(sent.images[key], again.images[key]) for key in options["image_keys"])


def test_empty_cameras_count_even_if_the_features_leave_them_out(tmp_path: Path) -> None:
    checkpoint = open_checkpoint(lerobot_copy(tmp_path / "c", empty_cameras=3))
    assert checkpoint.config.robot_options["num_missing_cameras"] == 3


def test_an_empty_camera_that_the_features_list_first_comes_first(tmp_path: Path) -> None:
    """A sorted config.json: LeRobot's cameras are in its order, empty ones too. "empty_camera_left" isn't one."""
    folder = lerobot_copy(tmp_path / "c", empty_cameras=2)
    edit_json(
        folder / "config.json",
        lambda content: content.update(
            input_features=dict(sorted(content["input_features"].items()))
            | {f"observation.images.empty_camera_{name}": {"type": "VISUAL"} for name in ("left", "5")}
        ),
    )
    options = open_checkpoint(folder).config.robot_options
    one, two, left, five, added = (
        f"observation.images.{name}"
        for name in ("image", "image2", "empty_camera_left", "empty_camera_5", "empty_camera_1")
    )
    assert options["image_keys"] == [one, two, left]
    assert options["camera_order"] == ["observation.images.empty_camera_0", one, two, left, five, added]
    assert options["num_missing_cameras"] == 3


def test_turbopi_json_puts_single_differences_over_the_description(tmp_path: Path) -> None:
    folder = lerobot_copy(tmp_path / "c")
    write_json(folder / "turbopi.json", {"robot": "libero", "action_horizon": 12})
    config = open_checkpoint(folder).config
    assert (config.robot, config.robot_options, config.model.action_horizon) == ("libero", {}, 12)
    assert config.normalization.state == "lerobot_quantile"
    assert config.model.time_grid == "multiplied"


def test_lerobots_mask_ends_where_it_did_in_a_chunk_of_another_length(tmp_path: Path) -> None:
    """And of the delays that training simulated, those count that leave an action to compute."""
    folder = lerobot_copy(
        tmp_path / "c", rtc_config={"enabled": True, "execution_horizon": 3}, rtc_training_max_delay=6
    )
    for horizon, expected in ((12, RealTime(6, 9, "linear", 10.0)), (5, RealTime(4, 2, "linear", 10.0))):
        write_json(folder / "turbopi.json", {"action_horizon": horizon})
        assert open_checkpoint(folder).config.real_time == expected
    write_json(folder / "turbopi.json", {"action_horizon": 5, "real_time": {"trained_max_delay": 6}})
    with pytest.raises(ConfigError, match="trained_max_delay = 6, but a chunk has 5 actions; expected at most 4"):
        open_checkpoint(folder)


def test_a_preset_does_not_fit_a_lerobot_folder(tmp_path: Path) -> None:
    folder = lerobot_copy(tmp_path / "c")
    with pytest.raises(ConfigError, match='describes itself, so preset pi05_libero doesn\'t fit: use config="auto"'):
        open_checkpoint(folder, "pi05_libero")
    assert "describes itself" in inspect_checkpoint(folder, "pi05_libero")["config_error"]
    assert open_checkpoint(folder, PRESETS["pi05_base"].with_model(action_horizon=9)).config.model.action_horizon == 9


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"type": "act"}, "of type 'act'; Turbo-Pi reads LeRobot's 'pi05' and 'pi0' and 'pi0_fast' and 'smolvla'"),
        ({"type": ["pi0"]}, r"of type \['pi0'\]"),
        ({"image_resolution": [448, 448]}, r"image_resolution = \[448, 448\], which Turbo-Pi doesn't compute"),
        ({"min_period": 0.001}, "min_period = 0.001"),
        ({"dtype": "float8"}, "dtype is 'float8'; expected one of bfloat16, float32"),
        ({"paligemma_variant": "gemma_9b"}, "paligemma_variant is 'gemma_9b'; expected one of gemma_300m, gemma_2b"),
        ({"action_expert_variant": 300}, "action_expert_variant is 300; expected one of gemma_300m, gemma_2b"),
        ({"max_period": 8.0}, "max_period = 8.0"),
        ({"rtc_config": {"mode": "hard", "enabled": True}}, "mode is 'hard'; expected one of guided, trained"),
        ({"chunk_size": None}, "chunk_size is None; expected a whole number from 1"),
        ({"chunk_size": "50"}, "chunk_size is '50'; expected a whole number"),
        ({"empty_cameras": -1}, "empty_cameras is -1; expected a whole number from 0"),
        ({"input_features": {"observation.state": [8]}}, "expected features with type and shape"),
        ({"output_features": {"action": {"type": "ACTION", "shape": [2, 7]}}}, r"action has shape \[2, 7\]"),
        ({"tokenizer_max_length": 0}, "tokenizer_max_length is 0; expected a whole number from 1"),
        (
            {"output_features": {"action": {"type": "ACTION", "shape": [6]}}},
            "says 6 values of action.*statistics have 7",
        ),
        ({"output_features": None}, "says 32 values of action, but the statistics have 7; LeRobot can't run it either"),
        ({"input_features": {}}, "lists no camera"),
        (
            {"normalization_mapping": {"STATE": "MEAN_STD"}},
            "normalises STATE by QUANTILES, but config.json says MEAN_STD",
        ),
        ({"normalization_mapping": None}, "config.json: normalization_mapping is None; expected an object"),
        (
            {"input_features": {"observation.images.a": {"type": None, "shape": [3, 224, 224]}}},
            "observation.images.a has type None; expected one of STATE, VISUAL",
        ),
    ],
)
def test_what_turbopi_does_not_compute_is_refused(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    folder = lerobot_copy(tmp_path / "c", **change)
    with pytest.raises(CheckpointError, match=message):
        open_checkpoint(folder)


@pytest.mark.parametrize(
    ("file", "name", "change", "message"),
    [
        (PRE, "normalizer_processor", {"eps": 1e-6}, "normalizer_processor has eps 1e-06"),
        (
            PRE,
            "normalizer_processor",
            {"norm_map": {"STATE": "QUANTILE5"}},
            "STATE by QUANTILE5; .*LeRobot's own policy",
        ),
        (POST, "unnormalizer_processor", {"norm_map": {"ACTION": "MEAN_STD"}}, "ACTION by MEAN_STD, but config.json"),
        (
            PRE,
            "normalizer_processor",
            {"norm_map": {"STATE": "QUANTILES", "VISUAL": "MEAN_STD"}},
            "normalises images by MEAN_STD",
        ),
        (PRE, "normalizer_processor", {"features": {}}, "features leave out observation.state.*needs q01 and q99"),
        (PRE, "normalizer_processor", {"normalize_observation_keys": ["a"]}, "features leave out observation.state"),
        (PRE, "tokenizer_processor", {"tokenizer_name": "bert"}, "tokenises with bert"),
        (
            PRE,
            "rename_observations_processor",
            {"rename_map": {"state": "observation.state"}},
            "observations call observation.state 'state', which LeRobot never reads",
        ),
        (PRE, "rename_observations_processor", {"rename_map": [1]}, r"rename_map is \[1\]; expected an object"),
        (PRE, "rename_observations_processor", {"rename_map": {"a": [1]}}, "rename_map is .*; expected a new name"),
        (
            PRE,
            "rename_observations_processor",
            {"rename_map": {"observation.state": "observation.joints"}},
            "makes observation.state 'observation.joints', so there is no state",
        ),
        (PRE, "tokenizer_processor", {"truncation": False}, "truncation is false, so LeRobot's prompts may be longer"),
        (PRE, "tokenizer_processor", {"padding": False}, "padding is False; expected one of max_length, longest"),
        (PRE, "tokenizer_processor", {"task_key": "subtask"}, "task_key is 'subtask'; expected task"),
        (PRE, "tokenizer_processor", {"max_length": None}, "max_length is None; expected a whole number"),
        (PRE, "pi05_prepare_state_tokenizer_processor_step", {"task_key": "subtask"}, "task_key is 'subtask'"),
        (PRE, "device_processor", {"float_dtype": "bfloat16"}, "float_dtype is 'bfloat16'; expected null or float32"),
        (POST, "device_processor", {"float_dtype": "float16"}, "float_dtype is 'float16'; expected null or float32"),
        (
            PRE,
            "normalizer_processor",
            {"stats": {}},
            "normalizer_processor has stats = {}, which Turbo-Pi doesn't know",
        ),
        (PRE, "to_batch_processor", {"size": 2}, "to_batch_processor has size = 2.*knows no key of this step"),
        (PRE, "normalizer_processor", {"norm_map": None}, "policy_preprocessor.json: norm_map is None; expected"),
        (PRE, "normalizer_processor", {"norm_map": {"STATE": []}}, r"normalises STATE by \[\]"),
        (PRE, "normalizer_processor", {"features": True}, "features is True; expected an object"),
        (PRE, "normalizer_processor", {"normalize_observation_keys": 3}, "normalize_observation_keys is 3; expected a"),
    ],
)
def test_processors_that_do_something_else_are_refused(
    tmp_path: Path, file: str, name: str, change: dict[str, Any], message: str
) -> None:
    folder = lerobot_copy(tmp_path / "c")
    edit_json(folder / file, lambda c: step(c, name)["config"].update(change))
    with pytest.raises(CheckpointError, match=message):
        open_checkpoint(folder)


@pytest.mark.parametrize("value", [None, [], 3, "x"])
def test_a_steps_config_is_an_object(tmp_path: Path, value: Any) -> None:
    folder = lerobot_copy(tmp_path / "c")
    edit_json(folder / PRE, lambda c: c["steps"][0].update(config=value))
    with pytest.raises(CheckpointError, match=r"policy_preprocessor\.json: config is .*; expected an object"):
        open_checkpoint(folder)


def test_what_the_config_asks_for_and_isnt_done_is_noted(tmp_path: Path) -> None:
    plain = lerobot_copy(tmp_path / "a", rtc_config=None, pretrained_revision=None, n_obs_steps=2)
    assert open_checkpoint(plain).info()["notes"] == []
    asks = lerobot_copy(tmp_path / "b", rtc_config={"enabled": True}, mixture="x")
    unknown, rtc = open_checkpoint(asks).info()["notes"]
    assert "doesn't know or follow: mixture" in unknown
    assert "enables rtc_config" in rtc


def test_the_preprocessors_prompt_length_wins(tmp_path: Path) -> None:
    checkpoint = open_checkpoint(lerobot_copy(tmp_path / "c", tokenizer_max_length=64))
    assert checkpoint.config.model.max_prompt_tokens == 180
    assert checkpoint.info()["notes"] == [
        "config.json says 64 tokens of prompt, but policy_preprocessor.json 180: so many are read, as LeRobot runs it"
    ]


def test_the_statistics_width_wins_over_the_state_feature(tmp_path: Path) -> None:
    folder = lerobot_copy(tmp_path / "c")
    edit_json(folder / "config.json", lambda c: c["input_features"]["observation.state"].update(shape=[32]))
    checkpoint = open_checkpoint(folder)
    assert checkpoint.config.robot_options["state_dim"] == 8
    assert checkpoint.info()["notes"] == [
        "config.json says 32 values of state, but the statistics have 8: observations have 8, as LeRobot runs it"
    ]
    robot = create_robot("lerobot", checkpoint.config.robot_options)
    observation = robot.example(np.random.default_rng(0))
    for width in (1, 7, 32):  # where LeRobot's subtraction fails, or repeats one value
        with pytest.raises(ObservationError, match=rf"observation.state has shape \({width},\), expected shape \(8,\)"):
            robot.inputs({**observation, "observation.state": np.zeros(width, np.float32)})


def test_lm_head_that_differs_from_the_embedding_is_said(tmp_path: Path) -> None:
    folder = lerobot_copy(tmp_path / "c")
    head = load_file(folder / "model.safetensors")["model.paligemma_with_expert.paligemma.lm_head.weight"]
    edit_tensors(folder, **{EMBEDDING: head.clone()})
    assert open_checkpoint(folder).info()["notes"] == []
    edit_tensors(folder, **{EMBEDDING: head + 1})
    (note,) = open_checkpoint(folder).info()["notes"]
    assert note == "lm_head and embed_tokens differ: prompts are embedded by embed_tokens, as LeRobot does"


def test_a_base_model_without_statistics_is_never_a_silent_identity(tmp_path: Path) -> None:
    folder = lerobot_copy(tmp_path / "c")
    edit_json(folder / PRE, lambda c: step(c, "normalizer_processor").pop("state_file"))
    with pytest.raises(CheckpointError, match=r"has no state_file.*needs q01 and q99, but there is nothing"):
        open_checkpoint(folder)
    write_json(folder / "turbopi.json", {"normalization": {"state": "identity", "actions": "lerobot_quantile"}})
    assert open_checkpoint(folder).norm_stats.state is None


def test_the_embedding_is_read_where_the_head_differs(tmp_path: Path) -> None:
    folder = lerobot_copy(tmp_path / "c")
    head = load_file(folder / "model.safetensors")["model.paligemma_with_expert.paligemma.lm_head.weight"]
    edit_tensors(folder, **{EMBEDDING: head + 1})
    assert torch.equal(open_checkpoint(folder).load("cpu", "f32").state["vlm.embed_tokens.weight"], (head + 1).float())
    edit_tensors(folder, **{EMBEDDING: head.double()})
    with pytest.raises(CheckpointError, match="tied in the model but differ"):
        open_checkpoint(folder)


def test_missing_files_are_named(tmp_path: Path) -> None:
    for index, name in enumerate(("post.safetensors", POST, PRE)):
        folder = lerobot_copy(tmp_path / str(index))
        (folder / name).unlink()
        with pytest.raises(CheckpointError, match=name):
            open_checkpoint(folder)


def test_a_state_file_never_leads_out_of_the_folder(tmp_path: Path) -> None:
    folder = lerobot_copy(tmp_path / "c")
    (folder / "pre_stats.safetensors").rename(tmp_path / "pre_stats.safetensors")
    edit_json(folder / PRE, lambda c: step(c, "normalizer_processor").update(state_file="../pre_stats.safetensors"))
    with pytest.raises(CheckpointError, match=r"names the file '\.\./pre_stats.safetensors', which isn't in"):
        open_checkpoint(folder)


def test_keys_that_lerobot_does_not_have_are_pointed_out(tmp_path: Path) -> None:
    checkpoint = open_checkpoint(lerobot_copy(tmp_path / "c", state_cond=True))
    assert checkpoint.info()["notes"] == [
        "config.json has keys that Turbo-Pi doesn't know or follow: state_cond = True"
    ]


def test_keys_with_neutral_values_are_silent(tmp_path: Path) -> None:
    """All that LeRobot's main branch writes beside 0.6.1's keys."""
    newer: dict[str, Any] = {
        "use_visual_memory": False,
        "use_proprioceptive_memory": False,
        "rtc_training_max_delay": 0,
    }
    newer |= {"memory_frames": 6, "memory_stride": 30, "memory_temporal_attention_every": 4}
    assert open_checkpoint(lerobot_copy(tmp_path / "c", **newer)).info()["notes"] == []


def test_keys_within_rtc_config_are_judged_too(tmp_path: Path) -> None:
    rtc = {"enabled": True, "mode": "trained", "debug": True, "debug_maxlen": 100, "blend": 0.5}
    unknown, trained = open_checkpoint(lerobot_copy(tmp_path / "c", rtc_config=rtc)).info()["notes"]
    assert unknown.endswith("follow: rtc_config.blend = 0.5")
    assert 'says mode "trained"' in trained and '"rtc_trained"' in trained


STORED: list[Callable[[torch.Tensor], torch.Tensor]] = [
    lambda tensor: tensor.bfloat16(),
    lambda tensor: tensor.half(),
    lambda tensor: tensor.double(),
    lambda tensor: tensor[None],
    lambda tensor: tensor[None].bfloat16(),
]


def rewrite_statistics(folder: Path, change: Callable[[torch.Tensor], torch.Tensor]) -> None:
    for file in set(folder.glob("*.safetensors")) - {folder / "model.safetensors"}:
        kept = {
            name: tensor for name, tensor in load_file(file).items() if name.startswith(("observation.state", "action"))
        }
        save_file({name: change(tensor).contiguous() for name, tensor in kept.items()}, file)


@pytest.mark.parametrize("stored", STORED)
def test_statistics_of_any_number_type_are_read_as_lerobot_broadcasts_them(
    tmp_path: Path, stored: Callable[[torch.Tensor], torch.Tensor]
) -> None:
    folder = lerobot_copy(tmp_path / "c")
    rewrite_statistics(folder, stored)
    stats = open_checkpoint(folder).norm_stats
    for feature, theirs in (("state", "observation.state"), ("actions", "action")):
        for name in ("q01", "q99"):
            expected = stored(lerobot_statistics()[f"{theirs}.{name}"]).double().reshape(-1).numpy()
            assert np.array_equal(getattr(getattr(stats, feature), name), expected)


def test_one_number_is_the_statistic_of_all_values_of_a_feature(tmp_path: Path) -> None:
    folder = lerobot_copy(tmp_path / "c")
    rewrite_statistics(folder, lambda tensor: tensor[:1].to(torch.int32))
    stats = open_checkpoint(folder).norm_stats
    assert stats.state is not None and stats.actions is not None
    assert (stats.state.dim, stats.actions.dim) == (8, 7)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda tensor: torch.stack([tensor, tensor]),
            r"observation\.state: mean is float32\[2, 8\]; expected numbers",
        ),
        (lambda tensor: tensor > 0, r"mean is bool\[8\]"),
        (lambda tensor: tensor * torch.nan, "must be a list of finite numbers"),
    ],
)
def test_statistics_that_scale_nothing_are_refused(tmp_path: Path, change: Any, message: str) -> None:
    folder = lerobot_copy(tmp_path / "c")
    rewrite_statistics(folder, change)
    with pytest.raises(CheckpointError, match=message):
        open_checkpoint(folder)


# -- the tokenizer that LeRobot's main branch saves beside the processors ----------------------------------------------


def name_tokenizer(folder: Path, name: str, *, declared: bool) -> None:
    entry = {"artifacts": {"tokenizer_name": name}} if declared else {}
    edit_json(
        folder / PRE,
        lambda c: (
            step(c, "tokenizer_processor").update(entry),
            step(c, "tokenizer_processor")["config"].update(tokenizer_name=name),
        ),
    )


@pytest.mark.parametrize("declared", [True, False])
def test_a_tokenizers_name_is_the_folder_beside_the_processors(tmp_path: Path, declared: bool) -> None:
    folder = lerobot_copy(tmp_path / "c")
    tokenizer_folder.write(folder / "tokenizer")
    name_tokenizer(folder, "tokenizer", declared=declared)
    checkpoint = open_checkpoint(folder)
    assert checkpoint.named_tokenizer == folder / "tokenizer"
    assert checkpoint.info()["notes"] == []


def test_a_converted_checkpoint_keeps_the_tokenizer_that_was_named(tmp_path: Path) -> None:
    folder = lerobot_copy(tmp_path / "c")
    name_tokenizer(folder, str(tokenizer_folder.write(tmp_path / "elsewhere")), declared=False)
    convert(folder, tmp_path / "converted", precision="f32")
    assert (
        tmp_path / "converted" / "tokenizer" / "tokenizer.json"
        in open_checkpoint(tmp_path / "converted").tokenizer_candidates
    )


def test_a_tokenizer_elsewhere_on_this_machine_is_the_one_that_is_there_whatever_it_is_called(tmp_path: Path) -> None:
    folder, other = lerobot_copy(tmp_path / "c"), tokenizer_folder.write(tmp_path / "paligemma")
    name_tokenizer(folder, str(other), declared=False)
    assert open_checkpoint(folder).named_tokenizer == other
    name_tokenizer(folder, "/models/paligemma", declared=False)  # not here
    checkpoint = open_checkpoint(folder)
    assert checkpoint.named_tokenizer is None
    (note,) = checkpoint.info()["notes"]
    assert "tokenises with /models/paligemma, which isn't here: PaliGemma's is taken for it" in note


def test_a_declared_tokenizer_that_is_missing_or_outside_is_refused(tmp_path: Path) -> None:
    folder = lerobot_copy(tmp_path / "c")
    for name, message in (("tokenizer", "names the tokenizer tokenizer beside it"), ("../t", "which isn't in")):
        name_tokenizer(folder, name, declared=True)
        with pytest.raises(CheckpointError, match=message):
            open_checkpoint(folder)


def test_a_prompt_has_the_state_or_not_as_the_preprocessor_says(tmp_path: Path) -> None:
    """LeRobot's main branch leaves it out where the state has tokens of its own. A turbopi.json chooses the other."""
    folder, name = lerobot_copy(tmp_path / "c"), "pi05_prepare_state_tokenizer_processor_step"
    texts = []
    for included, settings in ((True, {}), (False, {}), (False, {"discrete_state_input": True})):
        edit_json(folder / PRE, lambda c, to=included: step(c, name)["config"].update(include_state_in_prompt=to))
        write_json(folder / "turbopi.json", settings)
        checkpoint = open_checkpoint(folder)
        config = checkpoint.config
        state = np.zeros(2) if config.discrete_state_input else None
        texts += prompt_texts(" pick_it up\n", state, as_is=config.prompt_as_is, labels=config.prompt_labels)
        assert any("include_state_in_prompt = false" in note for note in checkpoint.info()["notes"]) is not included
    with_state = ("Task: pick it up, State: 128 128;\nAction: ", True)
    assert texts == [with_state, ("Task: pick it up;\nAction: ", True), with_state]
    write_json(folder / "turbopi.json", {})
    convert(folder, tmp_path / "converted", precision="f32")
    again = open_checkpoint(tmp_path / "converted").config
    assert (again.discrete_state_input, again.prompt_labels) == (False, True)


def test_tensors_are_named_with_lerobots_prefix(tmp_path: Path) -> None:
    folder = lerobot_copy(tmp_path / "c")
    edit_tensors(folder, model__critic__bias=torch.zeros(32), model__time_mlp_in__bias=None)
    with pytest.raises(
        CheckpointError, match=r"missing model.time_mlp_in.bias; not a part of the model: model.critic.b"
    ):
        open_checkpoint(folder)


def test_averaged_weights_beside_a_checkpoint_are_read_and_named(tmp_path: Path) -> None:
    """LeRobot's training with --ema.enable=true saves both."""
    training = tmp_path / "005000"
    training.mkdir()
    for name in ("pretrained_model", "pretrained_model_ema"):
        lerobot_copy(training / name)
    (note,) = [note for note in open_checkpoint(training).info()["notes"] if "EMA" in note]
    assert note == f"training also kept averaged weights (EMA): to run these, give {training / 'pretrained_model_ema'}"
    averaged = open_checkpoint(training / "pretrained_model_ema")
    assert averaged.path == training / "pretrained_model_ema" and not any(
        "EMA" in note for note in averaged.info()["notes"]
    )


def test_shards_of_distributed_training_are_refused_with_the_command_that_converts_them(tmp_path: Path) -> None:
    (tmp_path / "005000").mkdir()
    folder = lerobot_copy(tmp_path / "005000" / "pretrained_model")
    (folder / "model.safetensors").unlink()
    (folder / "pytorch_model_fsdp_0").mkdir()
    (folder / "pytorch_model_fsdp_0" / "__0_0.distcp").touch()
    for given in (folder, folder.parent):
        with pytest.raises(CheckpointError, match=f"lerobot-convert-dcp --checkpoint_dir={folder}"):
            open_checkpoint(given)
