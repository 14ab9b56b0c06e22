"""What LeRobot's own code computed from checkpoints that it saved; see golden_lerobot/README.md."""

from pathlib import Path

import pytest
from checkpoint_helpers import edit_json
from lerobot_golden import GOLDEN, GoldenCase
from safetensors.torch import load_file

CASES = sorted(file.parent.name for file in GOLDEN.glob("*/case.json"))


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_turbopi_computes_what_lerobot_computed(tmp_path: Path, name: str) -> None:
    case = GoldenCase(GOLDEN / name)
    assert case.wrong(case.assemble(tmp_path)) == {}


def test_other_weights_and_inputs_are_noticed(tmp_path: Path) -> None:
    """The comparison's own control."""
    case = GoldenCase(GOLDEN / "mean_std")
    checkpoint = case.assemble(tmp_path)
    other = GoldenCase(GOLDEN / "trained_embedding")
    wrong = other.wrong(checkpoint)
    assert {"tokens", "normalized_state", "keys", "values", "v_1", "actions"} <= wrong.keys()


def test_the_trained_embedding_is_not_the_head(tmp_path: Path) -> None:
    weights = load_file(GoldenCase(GOLDEN / "trained_embedding").assemble(tmp_path) / "model.safetensors")
    paligemma = "model.paligemma_with_expert.paligemma."
    embedding, head = (
        weights[paligemma + name + ".weight"] for name in ("model.language_model.embed_tokens", "lm_head")
    )
    assert (head != embedding).any(1).all()


def test_another_versions_semantics_compute_something_else(tmp_path: Path) -> None:
    """LeRobot 0.4.4 computed this case, and wrote zeros up to 32 behind the state."""
    case = GoldenCase(GOLDEN / "square_lerobot0.4.4")
    checkpoint = case.assemble(tmp_path)
    edit_json(checkpoint / "turbopi.json", lambda content: content.update(lerobot_semantics="0.6"))
    assert {"tokens", "token_mask", "v_1", "actions"} <= case.wrong(checkpoint).keys()
    edit_json(checkpoint / "turbopi.json", lambda content: content.update(lerobot_semantics="0.4"))
    assert case.wrong(checkpoint) == {}


def test_actions_that_stay_relative_are_noticed(tmp_path: Path) -> None:
    case = GoldenCase(GOLDEN / "relative_excluded")
    checkpoint = case.assemble(tmp_path)
    edit_json(
        checkpoint / "policy_postprocessor.json", lambda content: content["steps"][1]["config"].update(enabled=False)
    )
    assert case.wrong(checkpoint).keys() == {"actions"}
