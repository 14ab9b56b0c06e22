"""Pi0 in LeRobot's format. That its numbers are LeRobot's is shown by test_lerobot_golden.py."""

from pathlib import Path
from typing import Any

import pytest
from checkpoint_helpers import edit_json, write_json
from lerobot_golden import GOLDEN, GoldenCase

from turbopi import UnifiedPolicy
from turbopi.checkpoint import convert, inspect_checkpoint, open_checkpoint
from turbopi.config import Normalization
from turbopi.preprocess.tokenizer import TINY_TOKENIZER
from turbopi.support.errors import CheckpointError, ConfigError

PRE = "policy_preprocessor.json"
NEW_LINE, TOKENIZER, RENAME = "pi0_new_line_processor", "tokenizer_processor", "rename_observations_processor"
STATE_STEP = "pi05_prepare_state_tokenizer_processor_step"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return GoldenCase(GOLDEN / "pi0").assemble(tmp_path)


def edit_steps(folder: Path, change: Any) -> None:
    def edit(content: Any) -> None:
        content["steps"] = change({step["registry_name"]: step for step in content["steps"]})

    edit_json(folder / PRE, edit)


def test_a_folder_of_pi0_describes_itself(folder: Path) -> None:
    checkpoint = open_checkpoint(folder)
    config = checkpoint.config
    assert (config.name, config.model.kind, config.robot) == ("lerobot_pi0", "pi0", "lerobot")
    assert (config.discrete_state_input, config.prompt_as_is, config.prompt_state_dim) == (False, True, None)
    assert config.normalization == Normalization("lerobot_zscore", "lerobot_zscore")
    assert (config.model.max_prompt_tokens, config.model.time_grid, config.image_resize) == (
        48,
        "multiplied",
        "lerobot",
    )
    (note,) = checkpoint.info()["notes"]
    assert "prompts are embedded by embed_tokens" in note


def test_a_converted_pi0_computes_the_same(folder: Path, tmp_path: Path) -> None:
    converted = convert(folder, tmp_path / "converted", precision="f32")
    assert open_checkpoint(converted).config.prompt_as_is
    assert GoldenCase(GOLDEN / "pi0").wrong(converted) == {}


def test_an_openpi_checkpoints_prompt_is_cleaned_unless_it_says_otherwise(folder: Path) -> None:
    """The setting's own control: what a wrong one would change."""
    write_json(folder / "turbopi.json", {"vision_heads": 2, "prompt_as_is": False})
    assert "tokens" in GoldenCase(GOLDEN / "pi0").wrong(folder)


def test_steps_about_the_prompt_may_stand_behind_those_about_the_state(folder: Path) -> None:
    edit_steps(folder, lambda steps: [*(steps[k] for k in steps if k not in (NEW_LINE, TOKENIZER)), steps[NEW_LINE],
                                      steps[TOKENIZER]])  # fmt: skip
    assert GoldenCase(GOLDEN / "pi0").wrong(folder) == {}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda steps: [s for k, s in steps.items() if k != NEW_LINE], f"has no step {NEW_LINE}, .* type pi0"),
        (lambda steps: [s for k, s in steps.items() if k != TOKENIZER], f"has no step {TOKENIZER}"),
        (lambda steps: [steps[TOKENIZER], *(s for k, s in steps.items() if k != TOKENIZER)], f"{TOKENIZER} before"),
        (lambda steps: [*steps.values(), {"registry_name": STATE_STEP, "config": {}}], f"a step '{STATE_STEP}' that"),
        (lambda steps: [s for k, s in steps.items() if k != RENAME] + [steps[RENAME]], f"before {RENAME}"),
    ],
)
def test_pipelines_that_compute_something_else_are_refused(folder: Path, change: Any, message: str) -> None:
    edit_steps(folder, change)
    with pytest.raises(CheckpointError, match=message):
        open_checkpoint(folder)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"type": "pi05"}, f"{TOKENIZER} before .*{STATE_STEP}, {TOKENIZER}"),
        ({"max_state_dim": 24}, "max_state_dim = 24 and max_action_dim = 32; Turbo-Pi's Pi0 has one width for both"),
        ({"resize_imgs_with_padding": [224, 224]}, r"is of a LeRobot before 0\.4, whose Pi0 had other tensors"),
    ],
)
def test_what_is_not_computed_is_refused(folder: Path, change: dict[str, Any], message: str) -> None:
    edit_json(folder / "config.json", lambda content: content.update(change))
    with pytest.raises(CheckpointError, match=message):
        open_checkpoint(folder)


def test_weights_of_the_other_kind_are_refused(folder: Path, tmp_path: Path) -> None:
    pi05 = GoldenCase(GOLDEN / "mean_std").assemble(tmp_path / "pi05")
    (folder / "model.safetensors").write_bytes((pi05 / "model.safetensors").read_bytes())
    with pytest.raises(CheckpointError, match=r"config\.json says pi0, but these are pi05 weights"):
        open_checkpoint(folder)


def test_a_state_in_the_prompt_is_refused(folder: Path) -> None:
    write_json(folder / "turbopi.json", {"vision_heads": 2, "discrete_state_input": True})
    with pytest.raises(ConfigError, match="Pi0 reads its state as a number token"):
        open_checkpoint(folder)
    assert "number token" in inspect_checkpoint(folder)["config_error"]


def test_what_0_4_wrote_is_padded_as_0_4_did(folder: Path) -> None:
    later = ("use_relative_actions", "relative_exclude_joints", "action_feature_names")
    edit_json(folder / "config.json", lambda content: [content.pop(key) for key in later])
    checkpoint = open_checkpoint(folder)
    assert checkpoint.config.image_resize == "lerobot"  # lm_head beside the embedding: 0.5
    write_json(folder / "turbopi.json", {"vision_heads": 2, "lerobot_semantics": "0.4"})
    config = open_checkpoint(folder).config
    assert (config.image_resize, config.prompt_state_dim, config.prompt_as_is) == ("lerobot_0.4", None, True)


def test_its_example_runs(folder: Path) -> None:
    policy = UnifiedPolicy(
        folder, backend="pytorch", precision="f32", device="cpu", tokenizer=TINY_TOKENIZER, num_denoising_steps=1
    )
    assert policy.infer(policy.example_observation())["actions"].shape == (10, 7)
