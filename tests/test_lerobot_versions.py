"""LeRobot 0.4 computed other things from the same files than 0.5 and 0.6: which is done, and what it is."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from checkpoint_helpers import edit_json, edit_tensors, lerobot_copy, write_json
from safetensors.torch import load_file

from turbopi.checkpoint import convert, open_checkpoint
from turbopi.checkpoint.lerobot_versions import FIRST_KEYS, detect
from turbopi.config import PolicyConfig, VisionConfig
from turbopi.preprocess.pipeline import Pipeline
from turbopi.preprocess.tokenizer import TINY_TOKENIZER, load_tokenizer
from turbopi.support.errors import ConfigError

HEAD, EMBEDDING = (
    f"model.paligemma_with_expert.paligemma.{name}.weight" for name in ("lm_head", "model.language_model.embed_tokens")
)
V0_4_3 = {"rtc_config": None, "freeze_vision_encoder": False, "train_expert_only": False}


@pytest.fixture(autouse=True)
def standard_heads(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("turbopi.checkpoint.sizes._STANDARD_VISION", VisionConfig(width=64, num_heads=4))


def written_by(folder: Path, version: str) -> Path:
    """A checkpoint as that LeRobot leaves it."""
    made = lerobot_copy(folder)
    later = {} if version < "0.4.3" else V0_4_3

    def change(config: Any) -> None:
        for key in FIRST_KEYS - config.keys():
            config[key] = None
        config.update(later)
        if version < "0.5.1":
            del config["use_relative_actions"]

    edit_json(made / "config.json", change)
    if version >= "0.5":
        head = load_file(made / "model.safetensors")[HEAD]
        edit_tensors(made, **{EMBEDDING.replace(".", "__"): head.clone()})
    return made


def differing(config: PolicyConfig) -> tuple[Any, ...]:
    return config.image_resize, config.prompt_state_dim, config.model.time_grid


@pytest.mark.parametrize(
    ("version", "expected"),
    [
        ("0.4.0", ("lerobot_0.4", 32, "accumulated")),
        ("0.4.2", ("lerobot_0.4", 32, "accumulated")),
        ("0.4.3", ("lerobot_0.4", 32, "multiplied")),
        ("0.4.4", ("lerobot_0.4", 32, "multiplied")),
        ("0.5.0", ("lerobot", None, "multiplied")),
        ("0.5.1", ("lerobot", None, "multiplied")),
        ("0.6.1", ("lerobot", None, "multiplied")),
    ],
)
def test_done_is_what_the_version_computed_that_wrote_the_files(
    tmp_path: Path, version: str, expected: tuple[Any, ...]
) -> None:
    checkpoint = open_checkpoint(written_by(tmp_path / "c", version))
    assert differing(checkpoint.config) == expected
    notes = checkpoint.info()["notes"]
    if version >= "0.5":
        assert notes == []
    else:
        (note,) = notes
        assert "LeRobot 0.4 wrote this checkpoint: what LeRobot 0.4 computes is done" in note
        assert '{"lerobot_semantics": "0.6"}' in note


def test_a_choice_wins_over_the_files(tmp_path: Path) -> None:
    for version, chosen, expected in (
        ("0.4.0", "0.6", ("lerobot", None, "multiplied")),
        ("0.4.4", "0.6", ("lerobot", None, "multiplied")),
        ("0.6.1", "0.4", ("lerobot_0.4", 32, "multiplied")),
        ("0.4.4", "auto", ("lerobot_0.4", 32, "multiplied")),
    ):
        folder = written_by(tmp_path / f"{version}-{chosen}", version)
        write_json(folder / "turbopi.json", {"lerobot_semantics": chosen})
        checkpoint = open_checkpoint(folder)
        assert differing(checkpoint.config) == expected
        assert (checkpoint.info()["notes"] == []) == (chosen != "auto")


def test_single_values_win_over_the_choice(tmp_path: Path) -> None:
    folder = written_by(tmp_path / "c", "0.4.4")
    write_json(
        folder / "turbopi.json", {"lerobot_semantics": "0.4", "prompt_state_dim": None, "image_resize": "openpi"}
    )
    assert differing(open_checkpoint(folder).config) == ("openpi", None, "multiplied")


def test_where_no_file_tells_a_note_says_what_is_done_and_how_to_choose(tmp_path: Path) -> None:
    folder = lerobot_copy(tmp_path / "c")
    edit_json(folder / "config.json", lambda c: c.pop("use_relative_actions"))
    checkpoint = open_checkpoint(folder)
    assert differing(checkpoint.config) == ("lerobot", None, "multiplied")
    (note,) = checkpoint.info()["notes"]
    assert note.startswith("no file tells which LeRobot wrote this: what LeRobot 0.6 computes is done")
    assert '{"lerobot_semantics": "0.4"}' in note


def test_what_tells_versions_apart() -> None:
    first = FIRST_KEYS
    assert detect(first, untied=False) == detect(first, untied=True) == "0.4"
    assert detect(first | V0_4_3.keys(), untied=False) == "0.4"
    assert detect(first | V0_4_3.keys(), untied=True) == "0.6"
    assert detect(first | {"use_relative_actions"}, untied=False) == "0.6"
    assert detect(first - {"optimizer_lr"}, untied=False) is None


def test_the_choice_is_for_lerobots_checkpoints_alone(tmp_path: Path) -> None:
    folder = tmp_path / "c"
    convert(written_by(tmp_path / "source", "0.4.4"), folder, precision="f32")
    again = open_checkpoint(folder).config
    assert differing(again) == ("lerobot_0.4", 32, "multiplied")  # what is done is kept
    edit_json(folder / "turbopi.json", lambda c: c.update(lerobot_semantics="0.6"))
    with pytest.raises(ConfigError, match="lerobot_semantics only applies to LeRobot's own checkpoints"):
        open_checkpoint(folder)


@pytest.mark.usefixtures("two_threads")
def test_0_4_writes_zeros_into_the_prompt_and_pads_pictures_with_minus_three(tmp_path: Path) -> None:
    pipelines = {}
    for version in ("0.4.4", "0.6.1"):
        checkpoint = open_checkpoint(written_by(tmp_path / version, version))
        tokenizer = load_tokenizer(TINY_TOKENIZER, vocab_size=257_152)
        pipelines[version] = Pipeline(checkpoint.config, checkpoint.norm_stats, tokenizer)
    tokenizer = load_tokenizer(TINY_TOKENIZER, vocab_size=257_152)
    observation = pipelines["0.6.1"].example()
    observation["observation.images.image"] = np.full((3, 100, 200), 255, np.uint8)
    old, new = (pipelines[version].before(observation)[0] for version in ("0.4.4", "0.6.1"))
    normalized = pipelines["0.6.1"].state_scale.normalize(observation["observation.state"])
    for inputs, state in ((old, np.pad(normalized, (0, 24))), (new, normalized)):
        expected = tokenizer.encode(observation["task"], state)[:180]
        assert inputs.tokens[inputs.token_mask].tolist() == expected
    assert old.token_mask.sum() > new.token_mask.sum()
    assert {float(value) for value in np.unique(old.images[0])} == {-3.0, 1.0}
    assert {float(value) for value in np.unique(new.images[0])} == {-1.0, 1.0}
    assert np.array_equal(old.images[0] == -3, new.images[0] == -1)
    np.testing.assert_array_equal(old.images[1], new.images[1])  # square: nothing is padded


def test_a_width_of_the_states_step_is_the_prompts_in_0_4(tmp_path: Path) -> None:
    folder = written_by(tmp_path / "c", "0.4.4")
    edit_json(folder / "policy_preprocessor.json", lambda c: c["steps"][3].update(config={"max_state_dim": 6}))
    checkpoint = open_checkpoint(folder)
    assert checkpoint.config.prompt_state_dim == 6
    tokenizer = load_tokenizer(TINY_TOKENIZER, vocab_size=257_152)
    pipeline = Pipeline(checkpoint.config, checkpoint.norm_stats, tokenizer)
    observation = pipeline.example()
    normalized = pipeline.state_scale.normalize(observation["observation.state"])  # 8 wide: nothing is cut
    inputs = pipeline.before(observation)[0]
    assert inputs.tokens[inputs.token_mask].tolist() == tokenizer.encode(observation["task"], normalized)[:180]
