"""`turbopi replay`: the small policy on its own frames is right, and planted mistakes show."""

import functools
import io
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from checkpoint_helpers import lerobot_copy, write_json
from cli_helpers import refusal, turbopi
from PIL import Image
from replay_data import EVERY, write_npz

from turbopi.checkpoint import open_checkpoint
from turbopi.cli.replay import parse_numbers
from turbopi.config import Normalization
from turbopi.policy.known_cameras import KnownCameras
from turbopi.policy.policy import UnifiedPolicy
from turbopi.policy.shipped import CHASE_POLICY, SMALL_POLICY
from turbopi.recordings import RecordedCall, save_call
from turbopi.replay import compare
from turbopi.replay.document import Control, ReplayDocument, Verdict
from turbopi.replay.episodes import Episode
from turbopi.replay.judge import judge
from turbopi.replay.keys import KeyMap
from turbopi.replay.opening import open_dataset
from turbopi.replay.page import DOCUMENT, PAGE
from turbopi.replay.report import CAMERAS, Report, Second
from turbopi.replay.run import OF_AN_EPISODE, Replay, Replayed, Settings, affordable, select, variations_of
from turbopi.robots import robot_from_dict
from turbopi.support.errors import ActionError, ConfigError, ObservationError
from turbopi.support.reading import read_document


class Remembering(UnifiedPolicy):
    """The small policy, which doesn't read the state. What it was given before isn't computed again."""

    answers: dict[tuple[Any, ...], dict[str, Any]]

    def infer(self, obs: Mapping[str, Any], **options: Any) -> dict[str, Any]:
        images = [obs[key].tobytes() for key in ("observation/image", "observation/wrist_image")]
        case = (*images, obs["prompt"], *sorted(options.items()))
        if case not in self.answers:
            self.answers[case] = super().infer(obs, **options)
        return self.answers[case]


@pytest.fixture(scope="module")
def policy() -> UnifiedPolicy:
    made = Remembering(SMALL_POLICY, device="cpu", precision="f32", num_denoising_steps=1)
    made.answers = {}
    return made


def document_of(path: Path, policy: UnifiedPolicy, every: int = EVERY, variations: int = 0) -> ReplayDocument:
    """Of the inputs changed on purpose the first `variations`."""
    data, settings = open_dataset(path), Settings({}, changed=4)
    replay = Replay(policy, data, data.episodes, settings)
    replay.variations = replay.variations[:variations]
    selection = select(data.episodes, every, 1)
    found = replay.run(selection, lambda: None)
    return Report(data, selection, settings, replay, found, open_checkpoint(SMALL_POLICY)).document()


@pytest.fixture
def replayed(policy: UnifiedPolicy) -> Callable[..., ReplayDocument]:
    """The document of the small policy on a dataset."""
    return functools.partial(document_of, policy=policy)


# --- right, and planted mistakes --------------------------------------------------------------------------------------


def test_the_small_policy_follows_its_expert(replayed: Callable[..., ReplayDocument], tmp_path: Path) -> None:
    document = replayed(write_npz(tmp_path / "data"), variations=2)
    assert document.verdict.level == "follows" and not document.verdict.hints
    assert "isn't a success rate" in document.verdict.text
    own = document.policies[0]
    controls = {control.name: control.relative for control in document.controls}
    assert own.relative.mean < 0.5 * min(controls[compare.OTHERS], controls[compare.MEAN])
    assert len(own.changed) == 2 and all(one.nearer == 0 for one in own.changed), "what a mistake looks like"
    assert len(own.by_index) == 10 and [joint.name for joint in own.joints][-1] == "gripper"
    assert document.dataset.moments_taken == 6 and not any(state.outside for state in document.states)


def test_exchanged_cameras_are_named(replayed: Callable[..., ReplayDocument], tmp_path: Path) -> None:
    document = replayed(write_npz(tmp_path / "data", swap=True), variations=1)
    assert document.verdict.level != "follows"
    assert any("image and observation/wrist_image exchanged the error falls" in one for one in document.verdict.hints)


def test_blue_for_red_is_named(replayed: Callable[..., ReplayDocument], tmp_path: Path) -> None:
    path = write_npz(tmp_path / "data")
    for file in path.glob("*.npz"):
        with np.load(file) as stored:
            arrays = {key: value[..., ::-1] if value.ndim == 4 else value for key, value in stored.items()}
        np.savez(file, **arrays)
    document = replayed(path, variations=2)
    assert document.verdict.level != "follows"
    assert any("red and blue exchanged the error falls" in one for one in document.verdict.hints)


def test_degrees_for_radians_are_named(replayed: Callable[..., ReplayDocument], tmp_path: Path) -> None:
    document = replayed(write_npz(tmp_path / "data", degrees=True))
    assert document.verdict.level == "differs"
    assert sum("in degrees, and the checkpoint was trained on radians" in one for one in document.verdict.hints) == 2
    assert any(state.outside for state in document.states)


def judged(
    change: Callable[[np.ndarray], np.ndarray], reach: float = 1.0, state: float = 0.0, held: float | None = None
) -> Verdict:
    """What is said where `change` of four independent predicted actions was recorded.

    state   how widely the state ranges that both are relative to
    held    the error of the action before, held; None: it isn't known
    """
    random = np.random.default_rng(1)
    predicted = random.uniform(-0.9, 0.9, (40, 6, 4))
    recorded = change(predicted + random.normal(0, 0.02, predicted.shape))
    middle = state * random.standard_normal((40, 4))
    run = Replayed(
        about={"robot": "arm", "random_weights": False},
        keys=KeyMap({}, (), frozenset(), "prompt", (), ()),
        moments=[(Episode(number // 8, 80, str(number // 8)), number % 8 * 10) for number in range(40)],
        predicted=predicted + middle[:, None],
        recorded=recorded + middle[:, None],
        previous=np.full((40, 4), np.nan),
        units=np.full(4, reach),
        middle=middle,
        ends=np.stack([middle - reach, middle + reach]),
        states=np.zeros((40, 3)),
        state_range=(np.empty(0), np.empty(0)),
        call_ms=[1.0],
        changed=(),
        variations={},
        cameras={},
    )
    one = compare.compared("the policy", run)
    document = compare.policy_document(one, "here", ("a", "b", "c", "d"))
    beside = [*compare.controls(one), *([] if held is None else [Control(compare.HELD, held, [])])]
    return judge(one, document, beside, compare.state_documents(run, None), "tidy up")


def hints_of(change: Callable[[np.ndarray], np.ndarray], reach: float = 1.0, state: float = 0.0) -> list[str]:
    verdict = judged(change, reach, state)
    assert (verdict.level == "follows") == (not verdict.hints)
    return verdict.hints


def test_another_checkpoint_is_no_match(tmp_path: Path) -> None:
    """For the same robot, by its name, with statistics of its own."""
    other = UnifiedPolicy(CHASE_POLICY, device="cpu", precision="f32", num_denoising_steps=1)
    verdict = document_of(write_npz(tmp_path / "data"), other).verdict
    assert verdict.level == "differs" and "States are outside of the checkpoint's statistics" in verdict.hints[0]


@pytest.mark.parametrize("mode", ["zscore", "quantile"])
def test_the_training_range_is_that_of_every_call_and_of_inspect(tmp_path: Path, mode: Any) -> None:
    """q01 to q99 where the statistics have them, whatever normalises."""
    opened = open_checkpoint(CHASE_POLICY)
    config = replace(opened.config, normalization=Normalization(mode, mode))
    one = UnifiedPolicy(
        replace(opened, config=config), backend="pytorch", precision="f32", device="cpu", num_denoising_steps=1
    )
    document = document_of(write_npz(tmp_path / "data"), one)
    features = one.metadata["features"]
    for found, feature in ((document.states, "state"), (document.policies[0].joints, "actions")):
        expected = [(each["low"], each["high"]) for each in features[feature]]
        np.testing.assert_allclose(np.array([each.trained for each in found]), expected, rtol=1e-5, atol=1e-6)


def test_what_the_actions_show_is_named() -> None:
    assert hints_of(lambda actions: actions) == []
    assert "against each other in a, b, c, d" in hints_of(lambda actions: -actions)[0]
    (first, second) = hints_of(lambda actions: actions[..., [2, 1, 0, 3]] * [1, 0, 1, 0] + [0, 0.5, 0, 0.5])
    assert "predicted of a goes with what was recorded of c" in first and "of c goes with" in second
    assert "are 3 times as large" in hints_of(lambda actions: 3 * actions, reach=3.0)[0]
    (units, scale) = hints_of(np.degrees)
    assert "The recorded actions look as if they were in degrees" in units and "times as large" in scale
    assert "in radians, and the checkpoint was trained on degrees" in hints_of(np.radians)[0]
    (other, *_) = hints_of(lambda actions: actions + 7)
    assert "outside of the checkpoint's statistics (4 of 4 dimensions" in other
    (nothing,) = hints_of(lambda actions: np.random.default_rng(2).uniform(-1, 1, actions.shape))
    assert "Nothing in the numbers shows why" in nothing and "“tidy up”" in nothing


def test_a_policy_that_standing_still_beats_follows_in_part() -> None:
    right = judged(lambda actions: actions, held=0.1)
    assert right.level == "follows" and "0.100 of the action before, held" in right.text
    assert judged(lambda actions: actions, held=0.001).level == "partly"


def test_relative_actions_are_judged_by_their_motion() -> None:
    """The state is in every chunk of such a policy: what it adds to that decides."""
    assert hints_of(lambda actions: actions, state=50.0) == []
    assert "against each other in a, b, c, d" in hints_of(lambda actions: -actions, state=50.0)[0]
    (nothing,) = hints_of(lambda actions: np.random.default_rng(2).uniform(-1, 1, actions.shape), state=50.0)
    assert "Nothing in the numbers shows why" in nothing


def test_images_changed_on_purpose() -> None:
    """Whatever their layout: red and blue, and the corners, change places."""
    image = np.arange(24, dtype=np.uint8).reshape(2, 4, 3)
    keys = KeyMap({}, ("top", "side"), frozenset({"side"}), "prompt", (), ())
    given = {"top": image, "side": image.transpose(2, 0, 1), "state": np.zeros(2)}
    found = {one.name: one.change(given) for one in variations_of(keys)}
    assert list(found) == ["top and side exchanged", "red and blue exchanged", "images turned by 180 degrees"]
    np.testing.assert_array_equal(found["top and side exchanged"]["side"], image)
    for name, change in (
        ("red and blue exchanged", image[..., ::-1]),
        ("images turned by 180 degrees", image[::-1, ::-1]),
    ):
        np.testing.assert_array_equal(found[name]["top"], change)
        np.testing.assert_array_equal(found[name]["side"], change.transpose(2, 0, 1))
        assert found[name]["state"] is given["state"]


def test_batches_change_nothing(
    policy: UnifiedPolicy, replayed: Callable[..., ReplayDocument], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A backend that runs several observations together gets them so, each with the noise that it has alone."""
    path, sizes = write_npz(tmp_path / "data"), []

    def infer_batch(observations: Sequence[Mapping[str, Any]], *, seed: Sequence[int]) -> list[dict[str, Any]]:
        sizes.append(len(observations))
        return [policy.infer(one, seed=own) for one, own in zip(observations, seed, strict=True)]

    alone = replayed(path)
    monkeypatch.setattr(UnifiedPolicy, "runs_batches", True)
    monkeypatch.setattr(policy, "infer_batch", infer_batch)
    together = replayed(path)
    assert sizes == [6]
    assert together.policies[0].joints == alone.policies[0].joints and together.worst == alone.worst


def breaking(policy: UnifiedPolicy, seeds: set[int], monkeypatch: pytest.MonkeyPatch, *, together: bool) -> None:
    """A policy whose answers with the noise of these seeds are no chunks."""
    whole = policy.infer

    def infer(observation: Mapping[str, Any], *, seed: int) -> dict[str, Any]:
        if seed in seeds:
            raise ActionError("it has a cut character")
        return whole(observation, seed=seed)

    def infer_batch(observations: Sequence[Mapping[str, Any]], *, seed: Sequence[int]) -> list[dict[str, Any]]:
        return [infer(one, seed=own) for one, own in zip(observations, seed, strict=True)]

    monkeypatch.setattr(UnifiedPolicy, "runs_batches", together)
    monkeypatch.setattr(policy, "infer", infer)
    monkeypatch.setattr(policy, "infer_batch", infer_batch)


@pytest.mark.parametrize("together", [False, True])
def test_broken_answers_are_counted_and_the_others_judged(
    policy: UnifiedPolicy,
    replayed: Callable[..., ReplayDocument],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    together: bool,
) -> None:
    path = write_npz(tmp_path / "data")
    sound = replayed(path)
    breaking(policy, {2}, monkeypatch, together=together)
    document = replayed(path, variations=1)
    (broken,) = document.policies[0].broken
    assert (broken.episode, broken.step, broken.why) == ("episode_2", 0, "it has a cut character")
    assert not document.verdict.passed and document.verdict.hints == [
        "1 of 6 answers are no chunk that a robot may be given, and are left out of the errors: there the robot would "
        "hold. The first: episode episode_2, step 0: it has a cut character"
    ]
    errors = {one.episode: one.relative for one in sound.worst}
    assert {one.episode: one.relative for one in document.worst}.items() >= {
        episode: error for episode, error in errors.items() if episode != "episode_2"
    }.items()
    assert document.policies[0].changed[0].moments == 3, "of four, one of them broken"
    breaking(policy, set(range(6)), monkeypatch, together=together)
    with pytest.raises(
        ActionError, match=r"none of the policy's 6 answers .* The first: episode episode_0, step 0: it"
    ):
        replayed(path)


def test_two_policies_are_compared_where_both_answered(
    policy: UnifiedPolicy, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    data, settings = open_dataset(write_npz(tmp_path / "data")), Settings({}, changed=2)
    replay = Replay(policy, data, data.episodes, settings)
    selection = select(data.episodes, EVERY, 1)
    runs = []
    for seeds in ({2}, {0, 5}):
        with monkeypatch.context() as patch:
            breaking(policy, seeds, patch, together=False)
            runs.append(replay.run(selection, lambda: None))
    checkpoint = open_checkpoint(SMALL_POLICY)
    report = Report(data, selection, settings, replay, runs[0], checkpoint)
    report.add(Second(None, checkpoint, "the other"), runs[1])
    document = report.document()
    assert document.against is not None and document.against.moments == 3 and document.against.chunks.max == 0
    assert [len(one.broken) for one in document.policies] == [1, 2]
    assert {one.episode for one in document.worst} == {"episode_1", "episode_3", "episode_4"}
    assert any(
        note.startswith("2 answers of the other are no chunk; the first: episode episode_0") for note in document.notes
    )


# --- which moments ----------------------------------------------------------------------------------------------------


def test_moments_are_spread_over_episodes_and_affordable() -> None:
    episodes = [Episode(number, 100, str(number)) for number in range(50)]
    few = select(episodes, None, 120)
    assert len(few.episodes) == 120 // OF_AN_EPISODE and few.episodes[0].number == 0 and few.episodes[-1].number == 49
    assert 100 <= few.count <= 120 and (few.of_episodes, few.of_moments) == (50, 5000)
    assert select(episodes, None, 100_000).count == 5000
    assert select(episodes[:2], 30, 1).count == 8, "--every is what it says, whatever it costs"
    assert affordable(0.01, 36) > affordable(0.1, 36) > affordable(100.0, 36) > 0


def test_numbers_of_episodes() -> None:
    assert parse_numbers("0,3, 7-9") == [0, 3, 7, 8, 9]
    for wrong in ("", "a", "3-1", "-1", "1-999999999"):
        with pytest.raises(ConfigError, match="--episodes"):
            parse_numbers(wrong)


def test_an_episodes_end_is_no_error() -> None:
    """Behind it nothing is recorded, and nothing counts."""
    errors = np.array([[[1.0], [np.nan]], [[3.0], [5.0]]])
    assert compare.spread(errors).mean == 3.0 and compare.spread(errors[:1, 1]).max == 0.0
    assert np.isnan(compare.relative(np.ones(1), np.zeros(1))), "an action that never moved in training"


# --- the command ------------------------------------------------------------------------------------------------------


QUICK = ("--device", "cpu", "--precision", "f32", "--steps", 1, "--changed", 0, "--every", EVERY)


@pytest.mark.usefixtures("unseen_plots")
def test_the_command_writes_its_report(tmp_path: Path) -> None:
    data, report = write_npz(tmp_path / "data"), tmp_path / "report"
    arguments = (*QUICK, "--episodes", "1,4-5", "--against", "pytorch:f32:2", "--report", report)
    ran = turbopi("replay", data, SMALL_POLICY, *arguments, "--json")
    assert ran.exit_code == 0, ran.output
    printed = json.loads(ran.stdout)
    written = read_document(report / DOCUMENT, ReplayDocument)
    assert printed["verdict"]["level"] == written.verdict.level == "too few"
    assert [policy.label for policy in written.policies] == ["pytorch f32", "pytorch f32, 2 steps"]
    assert written.dataset.episodes_taken == [1, 4, 5] and written.dataset.moments_taken == 3
    assert written.against is not None and written.against.interval is not None and written.against.moments == 3
    page = (report / PAGE).read_text()
    assert "default-src 'none'" in page and "pytorch f32, 2 steps beside pytorch f32" in page
    for name in ("by_index", "joints", "episode", "worst"):
        assert f'src="{name}.png"' in page and (report / f"{name}.png").is_file()
    assert "--known-cameras" not in ran.stdout  # which is JSON
    known = KnownCameras.load(report / CAMERAS)
    assert {name: len(images) for name, images in known.images.items()} == {
        "observation/image": 3,
        "observation/wrist_image": 3,
    }


@pytest.mark.usefixtures("unseen_plots")
def test_random_weights_fail(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data = write_npz(tmp_path / "data")
    monkeypatch.setenv("COLUMNS", "80")
    ran = turbopi("replay", data, "--random-weights", "pi05_tiny", *QUICK, "--report", tmp_path / "report")
    tables = [line for line in ran.output.splitlines() if set(line) & set("│┃━")]
    assert len(tables) > 20 and max(map(len, tables)) <= 80 and "…" not in "".join(tables).replace(" … ", "")
    assert ran.exit_code == 1 and "don't follow" in ran.output and "weights are random" in ran.output
    assert not (tmp_path / "report" / CAMERAS).exists(), "what is wrong isn't kept as known"


def refused(*arguments: object) -> str:
    return refusal(turbopi("replay", *arguments), whole=False)


def test_what_is_no_dataset_is_refused(tmp_path: Path) -> None:
    data = write_npz(tmp_path / "data")
    report = ("--report", tmp_path / "report")
    assert "there is no dataset" in refused(tmp_path / "absent", SMALL_POLICY, *report)
    fetch = "hf download --repo-type dataset lerobot/absent --local-dir DIR"
    assert fetch in refused("lerobot/absent", SMALL_POLICY, *report)
    (tmp_path / "lerobots" / "meta").mkdir(parents=True)
    (tmp_path / "lerobots" / "meta" / "info.json").write_text("{}")
    inside = refused(tmp_path / "lerobots" / "meta", SMALL_POLICY, *report)
    assert f"is inside a LeRobotDataset; give its folder, {tmp_path / 'lerobots'}" in inside
    assert "the dataset comes first" in refused(SMALL_POLICY, data, *report)
    (tmp_path / "empty").mkdir()
    assert "is no dataset; expected a LeRobotDataset" in refused(tmp_path / "empty", SMALL_POLICY, *report)
    assert "there is no episode 6; " in refused(data, SMALL_POLICY, "--episodes", 6, *report)
    assert "--rename top is no pair" in refused(data, SMALL_POLICY, "--rename", "top", *report)
    assert "neither a checkpoint's folder nor a way to run" in refused(
        data, SMALL_POLICY, "--against", "nowhere", *report
    )


def written(folder: Path, **arrays: np.ndarray) -> Path:
    folder.mkdir(exist_ok=True)
    np.savez(folder / "episode.npz", **arrays)  # type: ignore[arg-type]
    return folder


def steps(**others: np.ndarray) -> dict[str, np.ndarray]:
    """An episode of three, with other arrays."""
    images = np.zeros((3, 8, 8, 3), np.uint8)
    found: dict[str, np.ndarray] = {
        "observation/image": images,
        "observation/wrist_image": images,
        "observation/state": np.zeros((3, 8)),
    }
    return {**found, "actions": np.zeros((3, 7)), "prompt": np.array("tidy up")} | others


def test_a_state_in_one_array_is_described_once_more(tmp_path: Path) -> None:
    """LeRobot's datasets have one observation.state, where the robot that is served may have joints and a gripper."""
    cameras = {"observation/image": "base_0_rgb", "observation/wrist_image": "left_wrist_0_rgb"}
    data = open_dataset(written(tmp_path / "data", **steps()))

    def keys(state: Mapping[str, int]) -> KeyMap:
        robot = robot_from_dict({"name": "arm", "cameras": cameras, "state": state, "action_dim": 7})
        policy = UnifiedPolicy(SMALL_POLICY, device="cpu", robot=robot)
        return Replay(policy, data, data.episodes, Settings({})).keys

    with pytest.raises(ObservationError, match=r'observation/state\. Describe .* "state": \{"state": 8\}'):
        keys({"joint_position": 7, "gripper_position": 1})
    with pytest.raises(ObservationError, match="--rename DATASET_KEY=joint_position"):
        keys({"joint_position": 6, "gripper_position": 1})
    assert keys({"state": 8}).joined["state"] == "observation/state"


def test_keys_that_fit_nowhere_are_named_with_what_to_do(policy: UnifiedPolicy, tmp_path: Path) -> None:
    def ready(path: Path, renames: dict[str, str]) -> Replay:
        data = open_dataset(path)
        return Replay(policy, data, data.episodes, Settings(renames))

    other = steps()
    other["cameras/top"] = other.pop("observation/image")
    other["cameras/wrist_image"] = other.pop("observation/wrist_image")
    other["qpos"] = other.pop("observation/state")
    path = written(tmp_path / "data", **other)
    with pytest.raises(ObservationError, match=r"cameras/top.*--rename cameras/top=observation/image"):
        ready(path, {})
    made = ready(path, {"observation/image": "cameras/top"})
    assert made.keys.described == [
        "cameras/top -> observation/image",
        "cameras/wrist_image -> observation/wrist_image",
        "qpos -> observation/state",
    ]
    assert ready(path, {"observation/image": "top"}).keys == made.keys
    with pytest.raises(ConfigError, match="the dataset has no front; it has"):
        ready(path, {"observation/image": "front"})
    with pytest.raises(ConfigError, match="robot libero has no front; it has"):
        ready(path, {"front": "cameras/top"})
    state = np.zeros((3, 8))
    state[2, 1] = np.nan
    last = ready(written(tmp_path / "nan", **steps(**{"observation/state": state})), {})
    with pytest.raises(ObservationError, match="episode episode, step 2: observation/state isn't finite: value 1"):
        last.run(select(last.dataset.episodes, 2, 1), lambda: None)
    with pytest.raises(ConfigError, match="6 actions a step, but robot libero has 7"):
        ready(written(tmp_path / "six", **steps(actions=np.zeros((3, 6)))), {})


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"actions": np.full((3, 7), np.nan)}, "action 0 of step 0 is nan"),
        ({"actions": np.zeros((0, 7))}, "its actions have shape"),
        ({"observation/state": np.zeros((2, 8))}, "expected time as its first axis"),
    ],
)
def test_episodes_that_are_damaged_are_refused(tmp_path: Path, change: dict[str, Any], said: str) -> None:
    data = open_dataset(written(tmp_path / "data", **steps(**change)))
    with pytest.raises(ObservationError, match=said):
        list(data.moments(data.episodes[0], [0], 2))


def test_a_recording_is_compared_with_its_own_answers(
    policy: UnifiedPolicy, replayed: Callable[..., ReplayDocument], tmp_path: Path
) -> None:
    run = tmp_path / "recordings" / "20260101T000000Z"
    run.mkdir(parents=True)
    data = open_dataset(write_npz(tmp_path / "data"))
    for number, episode in enumerate(data.episodes):
        (moment,) = data.moments(episode, [0], 10)
        answer = policy.infer(moment.observation, seed=number)
        save_call(run / f"{number:06d}.npz", RecordedCall(moment.observation, answer, 0.0))
    document = replayed(run.parent, every=1)
    assert document.policies[0].relative.max == 0, "the same weights, inputs and noise"
    assert document.verdict.level == "follows" and any("not what a person did" in note for note in document.notes)


class _Letters:
    """A tokenizer: a token a letter."""

    def encode(self, text: str, add_bos: bool) -> list[int]:
        return [2, *(ord(letter) % 500 for letter in text)]


def test_calls_without_a_camera_are_answered_as_they_were_served(tmp_path: Path) -> None:
    """It came late, or dropped out: LeRobot masks it."""
    checkpoint, run = lerobot_copy(tmp_path / "checkpoint"), tmp_path / "recordings" / "20260101T000000Z"
    write_json(checkpoint / "turbopi.json", {"vision_heads": 4})
    policy = UnifiedPolicy(checkpoint, device="cpu", precision="f32", tokenizer=_Letters(), num_denoising_steps=1)
    run.mkdir(parents=True)
    for number, without in enumerate(["image2", None, "image", None]):
        observation = policy.example_observation(number)
        observation.pop(f"observation.images.{without}", None)
        answer = policy.infer(observation, seed=number)
        save_call(run / f"{number:06d}.npz", RecordedCall(observation, answer, 0.0))
    data = open_dataset(run.parent)
    replay = Replay(policy, data, data.episodes, Settings({}, changed=4))
    found = replay.run(select(data.episodes, 1, 1), lambda: None)
    np.testing.assert_allclose(found.predicted, found.recorded, atol=1e-5)
    assert found.changed == [0, 1, 3] and "the first observation has nothing called" in replay.notes[0]


def test_hdf5_episodes_are_alohas(tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py", reason="needs h5py: pip install h5py")
    red = np.zeros((16, 16, 3), np.uint8)
    red[..., 0] = 200
    stream = io.BytesIO()
    Image.fromarray(red).save(stream, "JPEG")
    packed = np.frombuffer(stream.getvalue() + bytes(50), np.uint8)
    with h5py.File(tmp_path / "episode_0.hdf5", "w") as file:
        file["observations/qpos"] = np.arange(28.0).reshape(2, 14)
        file["observations/images/cam_high"] = np.full((2, 16, 16, 3), 7, np.uint8)
        file["observations/images/cam_left_wrist"] = np.stack([packed, packed])
        file["observations/images/depth_high"] = np.zeros((2, 16, 16))
        file["action"] = np.ones((2, 14))
        file["extra"] = 3
        file.attrs["task"] = "transfer cube"
    data = open_dataset(tmp_path)
    (moment,) = data.moments(data.episodes[0], [1], 10)
    assert moment.observation.keys() == {"state", "images/cam_high", "images/cam_left_wrist", "prompt"}
    np.testing.assert_array_equal(moment.observation["state"], np.arange(14.0, 28.0))
    np.testing.assert_allclose(moment.observation["images/cam_left_wrist"], red, atol=3)
    assert moment.observation["prompt"] == "transfer cube" and moment.recorded.shape == (1, 14)
    assert moment.previous is not None


def test_without_h5py_the_error_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "episode_0.hdf5").touch()
    monkeypatch.setattr("turbopi.replay.episode_files.find_spec", lambda name: None)
    with pytest.raises(ConfigError, match="pip install h5py"):
        open_dataset(tmp_path)


def test_without_pyarrow_the_error_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "meta").mkdir()
    (tmp_path / "meta/info.json").write_text("{}")
    monkeypatch.setattr("turbopi.replay.lerobot_dataset.find_spec", lambda name: None)
    with pytest.raises(ConfigError, match=r"pyarrow reads.*\[replay\]"):
        open_dataset(tmp_path)
