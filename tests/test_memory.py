"""Pi0.5 with memory: from LeRobot's folders to its actions, and what becomes of a robot's observations."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from memory_golden import CASES, MemoryRuns, make_checkpoint
from smolvla_golden import relative

from turbopi import UnifiedPolicy
from turbopi.bench.work import Job, stage_work
from turbopi.checkpoint import open_checkpoint
from turbopi.config import ModelConfig
from turbopi.evaluate.sources import LocalPolicy
from turbopi.models import family_of
from turbopi.models.observation import ModelInputs, Observation
from turbopi.models.pi0.memory import frame_places
from turbopi.models.pi0.reference import Trace
from turbopi.policy.examples import prepared as examples_of
from turbopi.policy.history import History
from turbopi.replay.run import Replay
from turbopi.support.errors import BackendUnavailable, CheckpointError, ConfigError, ObservationError

BOUND = 2e-6  # of the rms; seen: 8e-7
STATE_IN_PROMPT: dict[str, object] = {"discrete_state_input": True}  # what LeRobot's reloaded folder computes


def made(name: str, folder: Path, settings: dict[str, object] | None = None, **config: object) -> UnifiedPolicy:
    checkpoint = make_checkpoint(name, folder / "checkpoint", settings, **config)
    return UnifiedPolicy(checkpoint, backend="pytorch", precision="f32", device="cpu")


@pytest.fixture(scope="module")
def policies(tmp_path_factory: pytest.TempPathFactory) -> dict[str, UnifiedPolicy]:
    return {name: made(name, tmp_path_factory.mktemp(name)) for name in CASES}


@pytest.fixture
def visual(policies: dict[str, UnifiedPolicy]) -> UnifiedPolicy:
    policies["visual"].reset()
    return policies["visual"]


def prepared(policy: UnifiedPolicy, observation: dict[str, Any], history: History) -> ModelInputs:
    return policy._call.recorded(policy._call.see(observation), history)


def traced(policy: UnifiedPolicy, inputs: ModelInputs, noise: np.ndarray, *, compact: bool = False) -> Trace:
    trace: Trace = {}
    steps, model = policy.config.num_denoising_steps, policy.backend.model  # type: ignore[attr-defined]
    model.sample(Observation.stack([inputs]), torch.from_numpy(noise)[None], steps, compact=compact, trace=trace)
    return trace


# -- what LeRobot computed ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "part"), [(name, "") for name in CASES] + [("proprio", "training/"), ("select_action", "training/")]
)
def test_every_intermediate_is_lerobots(
    name: str, part: str, policies: dict[str, UnifiedPolicy], tmp_path: Path
) -> None:
    policy, golden = policies[name], MemoryRuns(name)
    if not part and name in ("proprio", "select_action"):
        policy = made(name, tmp_path, STATE_IN_PROMPT)
    history, compared = policy.new_history(), 0
    for run in range(len(golden)):
        if golden.resets(run):
            history.reset()
        inputs, theirs = prepared(policy, golden.observation(run), history), golden.expected(run, part)
        if "v_1" not in theirs:  # a call of select_action that took an action from its queue
            continue
        trace, past = traced(policy, inputs, golden.noise), inputs.past
        assert past is not None
        exact = {
            "tokens": inputs.tokens,
            "token_mask": inputs.token_mask,
            "prefix_pad": trace["prefix_pad_mask"][0].numpy(),
            "image_masks": inputs.image_mask[:, None],
        }
        if past.image_mask is not None:
            exact["image_masks"] = np.concatenate((past.image_mask, inputs.image_mask[:, None]), axis=1)
        near = {
            "normalized_state": inputs.state[:8],
            "prefix_embeddings": trace["prefix_embs"][0, theirs["prefix_rows"]].numpy(),
            "v_1": trace["v_t"][0, 0].numpy(),
        }
        if past.states is not None and past.state_mask is not None:
            exact["state_masks"], near["states"] = past.state_mask, past.states
        if "normalized_actions" in theirs:
            near["normalized_actions"] = trace["actions"][0, :, :7].numpy()
        assert len(trace["prefix_pad_mask"][0]) == theirs["prefix_length"]
        for key, ours in exact.items():
            assert np.array_equal(ours, theirs[key]), (run, key)
        for key, ours in near.items():
            assert relative(ours, theirs[key]) <= BOUND, (run, key)
        others = {"prefix_rows", "prefix_length", "actions", "selected", "selected_normalized"}
        assert theirs.keys() - others == exact.keys() | near.keys()
        compared += 1
    assert compared >= 3


@pytest.mark.parametrize("name", ["visual", "visual_last_layers", "proprio"])
def test_calls_in_order_give_lerobots_actions(name: str, policies: dict[str, UnifiedPolicy]) -> None:
    policy, golden = policies[name], MemoryRuns(name)
    part = "training/" if name == "proprio" else ""
    for run in range(len(golden)):
        if golden.resets(run):
            policy.reset()
        actions = policy.infer(golden.observation(run), noise=golden.noise)["actions"]
        assert relative(actions, golden.expected(run, part)["actions"]) <= BOUND


@pytest.mark.parametrize("part", ["", "training/"])
def test_a_robot_that_shows_each_step_and_asks_at_each_third_gets_lerobots_actions(part: str, tmp_path: Path) -> None:
    policy = made("select_action", tmp_path, {} if part else STATE_IN_PROMPT)
    golden, queue = MemoryRuns("select_action"), list[np.ndarray]()
    for run in range(len(golden)):
        if golden.resets(run):
            policy.reset()
            queue.clear()
        if queue:
            policy.observe(golden.observation(run))
        else:
            queue += list(policy.infer(golden.observation(run), noise=golden.noise)["actions"][:3])
        assert relative(queue.pop(0), golden.expected(run, part)["selected"]) <= BOUND


def test_compacted_and_batched_it_is_the_same(policies: dict[str, UnifiedPolicy]) -> None:
    for name in ("visual_last_layers", "select_action"):  # a masked camera; states that are masked
        policy, golden = policies[name], MemoryRuns(name)
        histories = [policy.new_history() for _ in range(2)]
        policy.observe(golden.observation(3), history=histories[1])
        rows = [golden.observation(run) for run in range(2)]
        together = policy.infer_batch(rows, noise=np.stack([golden.noise] * 2), histories=histories)
        for row, before in enumerate(([], [3])):
            alone = policy.new_history()
            for run in before:
                policy.observe(golden.observation(run), history=alone)
            inputs = prepared(policy, rows[row], alone)
            whole, compact = (traced(policy, inputs, golden.noise, compact=one)["actions"] for one in (False, True))
            assert relative(compact.numpy(), whole.numpy()) <= BOUND
            given = policy.pipeline.after(whole[0].numpy(), policy.pipeline.before(rows[row])[1])["actions"]
            assert relative(together[row]["actions"], given) <= BOUND


# -- traps of the arithmetic -------------------------------------------------------------------------------------------


def test_places_are_sines_and_cosines_less_one_in_turn_and_nothing_for_the_current_frame() -> None:
    places = frame_places(3, 4).numpy()
    slow = 10_000.0 ** (-2 / 4)
    for row, p in enumerate((-2, -1, 0)):
        np.testing.assert_allclose(
            places[row], [np.sin(p), np.cos(p) - 1, np.sin(p * slow), np.cos(p * slow) - 1], atol=1e-7
        )
    assert not places[-1].any()


def test_one_frame_is_the_ordinary_policy(tmp_path: Path) -> None:
    golden = MemoryRuns("visual")
    memory = made("visual", tmp_path / "one", memory_frames=1)
    ordinary = made("visual", tmp_path / "none", use_visual_memory=False)
    for run in range(2):
        both = [one.infer(golden.observation(run), noise=golden.noise)["actions"] for one in (memory, ordinary)]
        assert relative(*both) <= BOUND
    assert family_of(ordinary.config.model).planned


def test_what_is_masked_changes_nothing_and_the_rest_does(visual: UnifiedPolicy) -> None:
    """Images of frames from before the episode, and the order of frames."""
    golden, history = MemoryRuns("visual"), visual.new_history()
    for run in range(4):
        inputs = prepared(visual, golden.observation(run), history)
    images, mask = past_images(inputs)
    assert mask.tolist() == [[False, True]] * 2
    actions = traced(visual, inputs, golden.noise)["actions"].numpy()
    for frame, matters in ((0, False), (1, True)):
        changed = images.copy()
        changed[:, frame] = np.float32(0.5)
        other = traced(visual, _with(inputs, images=changed), golden.noise)["actions"].numpy()
        assert (relative(other, actions) > 1e-4) == matters
    everything = _with(inputs, image_mask=np.ones_like(mask))
    turned = _with(everything, images=images[:, ::-1].copy())
    both = [traced(visual, one, golden.noise)["actions"].numpy() for one in (everything, turned)]
    assert relative(*both) > 1e-4


def past_images(inputs: ModelInputs) -> tuple[np.ndarray, np.ndarray]:
    """And which of them there are."""
    assert inputs.past is not None and inputs.past.images is not None and inputs.past.image_mask is not None
    return inputs.past.images, inputs.past.image_mask


def _with(inputs: ModelInputs, **changed: np.ndarray) -> ModelInputs:
    assert inputs.past is not None
    return replace(inputs, past=replace(inputs.past, **changed))


# -- a robot's observations --------------------------------------------------------------------------------------------


def frames_of(policy: UnifiedPolicy, shown: list[int]) -> tuple[list[float], list[bool]]:
    """Brightness of the frames that the model gets after images of these brightnesses, and which are valid."""
    golden, history = MemoryRuns("visual"), policy.new_history()
    for one in shown:
        sent = {key: np.full((24, 32, 3), one, np.uint8) for key in golden.observation(0) if "images" in key}
        inputs = prepared(policy, golden.observation(0) | sent, history)
    images, mask = past_images(inputs)
    seen = [*images[0, :, 112, 112, 0], inputs.images[0, 112, 112, 0]]
    return [round(float(one + 1) / 2 * 255) for one in seen], mask[0].tolist()


def test_frames_are_a_stride_apart_and_the_first_observation_is_all_that_came_before(visual: UnifiedPolicy) -> None:
    """Three frames, two observations apart."""
    assert frames_of(visual, [10]) == ([10, 10, 10], [False, False])
    assert frames_of(visual, [10, 20]) == ([10, 10, 20], [False, False])
    assert frames_of(visual, [10, 20, 30]) == ([10, 10, 30], [False, True])
    assert frames_of(visual, [10, 20, 30, 40]) == ([10, 20, 40], [False, True])
    assert frames_of(visual, [10, 20, 30, 40, 50]) == ([10, 30, 50], [True, True])
    assert frames_of(visual, [10, 20, 30, 40, 50, 60, 70]) == ([30, 50, 70], [True, True])


def test_a_reset_begins_an_episode_and_other_calls_leave_it_alone(visual: UnifiedPolicy) -> None:
    golden = MemoryRuns("visual")

    def actions(run: int) -> np.ndarray:
        return np.asarray(visual.infer(golden.observation(run), noise=golden.noise)["actions"])

    first = actions(0)
    visual.observe(golden.observation(1))
    later = actions(0)
    assert relative(later, first) > 1e-4
    visual.reset()
    visual.warmup()
    visual.prepare(golden.observation(2))
    visual.infer(golden.observation(2), history=visual.new_history())
    wrong = golden.observation(3)
    del wrong["observation.state"]
    for call in (visual.observe, visual.infer):
        with pytest.raises(ObservationError, match=r"observation\.state"):
            call(wrong)
    with pytest.raises(ObservationError, match="noise has shape"):
        visual.infer(golden.observation(3), noise=golden.noise[:2])
    assert np.array_equal(actions(0), first)


def test_a_missing_camera_is_masked_and_its_history_waits(visual: UnifiedPolicy) -> None:
    golden, history = MemoryRuns("visual"), visual.new_history()
    wrist = "observation.images.wrist"
    for run in range(4):
        one = golden.observation(run)
        if run == 2:
            del one[wrist]
        inputs = prepared(visual, one, history)
        past = past_images(inputs)
        if run == 2:
            assert inputs.image_mask.tolist() == [True, False] and past[1][1].tolist() == [False, False]
            assert (past[0][1] == -1).all()
    whole = visual.new_history()
    for run in (0, 1, 3):
        again = past_images(prepared(visual, golden.observation(run), whole))
    assert np.array_equal(past[0][1, 0], again[0][1, 0])


def test_an_observation_may_bring_its_own_frames(visual: UnifiedPolicy, policies: dict[str, UnifiedPolicy]) -> None:
    """As LeRobot's data sets give them: oldest first, those from before the episode padded."""
    golden, history = MemoryRuns("visual"), visual.new_history()
    for run in range(4):
        visual.observe(golden.observation(run), history=history)
    from_history = visual.infer(golden.observation(1), noise=golden.noise, history=history)["actions"]
    current: dict[str, Any] = golden.observation(1)
    brought = dict(current)
    for key in [key for key in current if "images" in key]:
        brought[key] = np.stack([np.asarray(golden.observation(run)[key]) for run in (0, 2, 1)])  # ages 4, 2 and 0
        brought[f"{key}_is_pad"] = np.array([False, False, False])
    assert relative(visual.infer(brought, noise=golden.noise)["actions"], from_history) <= BOUND
    assert visual._history is not None and visual._history.observations == 0
    padded = brought | {f"{key}_is_pad": np.array([True, False, False]) for key in current if "images" in key}
    assert relative(visual.infer(padded, noise=golden.noise)["actions"], from_history) > 1e-5
    for wrong, message in (
        (brought | {"observation.images.top": brought["observation.images.top"][:2]}, "remembers 3 frames"),
        (brought | {"observation.images.top": current["observation.images.top"]}, "remembers images of 3 frames"),
        (brought | {"observation.images.top_is_pad": np.array([True, False, False])}, "the same of all keys"),
        (padded | {"observation.state": np.zeros((3, 8), np.float32)}, "remembers images"),
    ):
        with pytest.raises(ObservationError, match=message):
            visual.infer(wrong)
    with pytest.raises(ObservationError, match="recorded nowhere"):
        visual.observe(brought)
    both = MemoryRuns("select_action").observation(0)
    with pytest.raises(ObservationError, match="give all of them"):
        policies["select_action"].infer(both | {"observation.state": np.zeros((2, 8), np.float32)})


def test_histories_are_of_one_robot_each_and_of_policies_with_memory(visual: UnifiedPolicy, tmp_path: Path) -> None:
    golden = MemoryRuns("visual")
    two = [golden.observation(0)] * 2
    one = visual.new_history()
    for histories in (None, [one], [one, one]):
        with pytest.raises(ObservationError, match="a history for each of 2 robots"):
            visual.infer_batch(two, histories=histories)
    ordinary = made("visual", tmp_path, use_visual_memory=False)
    with pytest.raises(ObservationError, match="has no memory: leave it out"):
        ordinary.infer(two[0], history=one)
    with pytest.raises(ObservationError, match="has no memory: it sees"):
        ordinary.observe(two[0])
    with pytest.raises(ObservationError, match="takes no history"):
        ordinary.new_history()
    assert "memory" not in ordinary.metadata and visual.metadata["memory"]["frames"] == 3


# -- checkpoints and what can't be done with them ----------------------------------------------------------------------


def test_the_trained_prompt_is_said_and_what_the_file_says_is_done(tmp_path: Path) -> None:
    from checkpoint_helpers import edit_json

    folder = make_checkpoint("proprio", tmp_path / "one")
    opened = open_checkpoint(folder)
    assert not opened.config.discrete_state_input and opened.config.prompt_labels
    assert any("as in training with proprioceptive memory" in note for note in opened.source.notes)
    for said in (True, False):

        def say(content: Any, said: bool = said) -> None:
            for step in content["steps"]:
                if step.get("registry_name", "").startswith("pi05_prepare_state"):
                    step["config"]["include_state_in_prompt"] = said

        edit_json(folder / "policy_preprocessor.json", say)
        opened = open_checkpoint(folder)
        assert opened.config.discrete_state_input == said
        assert not any("as in training" in note for note in opened.source.notes)


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("visual", {"memory_frames": 0}, "memory_frames is 0"),
        ("visual", {"memory_stride": "often"}, "memory_stride is 'often'"),
        (
            "visual",
            {"memory_frames": 60, "memory_stride": 60},
            "the last 3541 observations, and Turbo-Pi keeps at most",
        ),
        (
            "visual",
            {"memory_temporal_attention_every": 5},
            "every 5th layer of vision attends over frames, but there are 4",
        ),
        ("visual", {"use_visual_memory": "yes"}, "use_visual_memory is 'yes'"),
        ("visual", {"use_proprioceptive_memory": True}, "proprio_history_proj"),
        ("proprio", {"use_proprioceptive_memory": False}, "proprio_history_proj"),
        ("proprio", {"max_state_dim": 31}, "proprio_history_proj"),
        ("visual", {"type": "pi0"}, "LeRobot has memory in pi05 alone"),
    ],
)
def test_settings_that_cannot_be_are_refused_by_name(
    name: str, change: dict[str, Any], message: str, tmp_path: Path
) -> None:
    with pytest.raises(CheckpointError, match=message):
        open_checkpoint(make_checkpoint(name, tmp_path / "changed", **change))


def test_verify_and_bench_take_it_and_what_keeps_no_history_refuses_it_by_name(visual: UnifiedPolicy) -> None:
    examples = list(examples_of(visual, [(str(run), MemoryRuns("visual").observation(run)) for run in range(3)]))
    masks = [past_images(one.inputs)[1][0].tolist() for one in examples]
    assert masks == [[False, False], [False, True], [True, True]], "those before are its past frames"
    assert len({one.sha256 for one in examples}) == 3
    config = visual.config.model
    assert isinstance(config, ModelConfig) and config.memory is not None
    ours, plain = (stage_work(one, Job(), 2)["vision"] for one in (config, replace(config, memory=None)))
    assert ours.bytes == plain.bytes and 2.9 < ours.flops / plain.flops < 3.1, "three frames in all four layers"
    nothing: Any = None
    for refused in (LocalPolicy, lambda policy: Replay(policy, nothing, (), nothing)):
        with pytest.raises(ConfigError, match=r"this policy has memory, and (an evaluation|a replay) doesn't keep"):
            refused(visual)


def test_what_has_no_plan_for_memory_says_so(tmp_path: Path) -> None:
    checkpoint = make_checkpoint("visual", tmp_path / "one")
    with pytest.raises(BackendUnavailable, match=r"has no plan for Pi0.5 with memory; take backend 'auto'"):
        UnifiedPolicy(checkpoint, backend="pytorch_compile", device="cpu")
    with pytest.raises(BackendUnavailable, match=r"has no plan for Pi0.5 with memory"):
        UnifiedPolicy(checkpoint, backend="onnx", precision="f32", device="cpu")
    with pytest.raises(ConfigError, match="is a pi05 with memory policy"):
        _ = open_checkpoint(checkpoint).config.planned_model
