"""What LeRobot's own code computed from checkpoints that it saved; see golden_lerobot/README.md."""

import json
from pathlib import Path

import numpy as np
import pytest
from checkpoint_helpers import edit_json
from lerobot_golden import GOLDEN, GoldenCase, _observation
from safetensors.torch import load_file

from turbopi import UnifiedPolicy
from turbopi.checkpoint.lerobot import SCHEDULES
from turbopi.preprocess.tokenizer import TINY_TOKENIZER
from turbopi.realtime.running_chunk import RunningChunk

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


def test_running_chunks_are_joined_as_lerobot_joins_its_left_overs(tmp_path: Path) -> None:
    """Of relative actions: moved to the new state here or by LeRobot, padded as any of its versions does."""
    case = GoldenCase(GOLDEN / "relative_excluded")
    checkpoint = case.assemble(tmp_path)
    edit_json(checkpoint / "config.json", lambda content: content.update(rtc_training_max_delay=4))
    policy = UnifiedPolicy(checkpoint, backend="pytorch", precision="f32", device="cpu", tokenizer=TINY_TOKENIZER)
    inputs, stored = np.load(case.folder / "inputs.npz"), np.load(case.folder / "rtc.npz")
    observation = _observation(inputs, 0)
    old, new = observation["observation.state"][:7], stored["state"][:7]  # as wide as the actions
    observation["observation.state"] = stored["state"]
    for index, run in enumerate(json.loads((case.folder / "rtc.json").read_text())["runs"]):
        row, end, trained = run["row"], run["execution_horizon"], run["mode"] == "trained"
        for left_over, anchor in (
            (stored[f"{index}/left_over"], new),
            (stored["first/model_actions"][row : row + end], old),  # none is padded
        ):
            if anchor is old and len(left_over) < end and not trained:
                continue
            previous = RunningChunk(
                np.pad(left_over, ((0, 0), (0, 32 - left_over.shape[1]))),
                min(run["inference_delay"], end),
                None if trained else 10 - end,
                "rtc_trained" if trained else "rtc_identity",
                anchor,
                *(() if trained else (SCHEDULES[run["schedule"]], 10.0)),
            )
            actions = policy.infer(observation, noise=inputs["noise"], previous=previous)["actions"]
            np.testing.assert_allclose(actions, stored[f"{index}/actions"], atol=1e-5, err_msg=str(run))
