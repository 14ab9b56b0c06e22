"""What arrives and what leaves is judged: planted mistakes are named at once, and good runs have no note."""

import itertools
import json
import logging
import pickle
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from policy_helpers import policy_on

from turbopi import UnifiedPolicy, open_checkpoint
from turbopi.backends import Sample as Sampled
from turbopi.checkpoint.norm_stats import FeatureStats
from turbopi.policy.known_cameras import KnownCameras
from turbopi.policy.ranges import TrainingRange
from turbopi.policy.readings import Checks, sample
from turbopi.policy.shipped import SMALL_POLICY, load_frames, observations
from turbopi.policy.watch import (
    COMPARED_EVERY,
    FROZEN,
    MOST_CAMERAS,
    READING,
    REPEAT_SECONDS,
    SUSTAINED,
    Reading,
    Sample,
    Watch,
)
from turbopi.realtime import RealTimeExecutor
from turbopi.realtime.client import RealTimeClient
from turbopi.realtime.messages import NOTES, notes_in
from turbopi.robots.labels import Label, action_labels, state_labels
from turbopi.serve import running
from turbopi.support.errors import ActionError, ConfigError

H, D = 16, 32
LOGGER = "turbopi.policy.watch"
GRIPPER = (-1.0, 1.0)  # the shipped policy's training range of the last of its seven actions


class Fixed:
    """A backend that answers with `actions`, normalised, in a microsecond."""

    runs_batches = submits = False

    def __init__(self, backend: Any) -> None:
        self._backend = backend
        self.actions = np.zeros((H, D), np.float32)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._backend, name)

    def sample(self, observation: Any, *_: Any, **__: Any) -> Sampled:
        return Sampled(torch.from_numpy(np.stack([self.actions] * len(observation.state))), {})


@pytest.fixture(scope="module")
def backend() -> Any:
    return UnifiedPolicy(SMALL_POLICY, backend="pytorch", device="cpu", precision="f32").backend


@pytest.fixture
def fixed(backend: Any) -> Fixed:
    return Fixed(backend)


def policy_of(fixed: Fixed, **options: Any) -> UnifiedPolicy:
    return policy_on(lambda *_, **__: fixed, open_checkpoint(SMALL_POLICY), num_denoising_steps=1, **options)


@pytest.fixture
def policy(fixed: Fixed) -> UnifiedPolicy:
    return policy_of(fixed)


def frames(policy: UnifiedPolicy) -> list[dict[str, Any]]:
    return observations(policy, load_frames())


def in_degrees(observation: dict[str, Any]) -> dict[str, Any]:
    state = observation["observation/state"].copy()
    state[3:6] = np.degrees(state[3:6])
    return {**observation, "observation/state": state}


def kinds(answer: Any) -> list[str]:
    return [note.kind for note in notes_in(answer)]


def test_the_metadata_say_which_policy_it_is(policy: UnifiedPolicy) -> None:
    opened = open_checkpoint(SMALL_POLICY)
    about = policy.metadata
    assert about["checkpoint_path"] == str(SMALL_POLICY) and about["weights"] == opened.fingerprint()[:12]
    assert about["random_weights"] is False and about["calibration"] is None and about["out_of_range"] == "warn"
    assert (about["config"], about["num_denoising_steps"]) == ("pi05_tiny", 1)


# --- state ------------------------------------------------------------------------------------------------------------


def test_the_shipped_frames_and_example_observations_have_no_note(policy: UnifiedPolicy) -> None:
    for observation in frames(policy):
        policy.reset()  # each is of another episode
        for _ in range(SUSTAINED + 1):
            assert NOTES not in policy.infer(observation, seed=0)
    assert NOTES not in policy.infer(policy.example_observation(), seed=0)
    assert not any(NOTES in one for one in policy.infer_batch(frames(policy), seed=0))


def test_degrees_for_radians_are_named_at_the_first_call_and_logged_once(
    policy: UnifiedPolicy, caplog: pytest.LogCaptureFixture
) -> None:
    wrong = in_degrees(frames(policy)[0])
    with caplog.at_level(logging.WARNING, LOGGER):
        answers = [policy.infer(wrong, seed=0) for _ in range(10)]
    (note,) = notes_in(answers[0])
    assert note.kind == "state_range" and note.names == ("axis-angle x", "axis-angle z")
    assert "axis-angle x is 180, in the training data 2.187 to 3.166" in note.text and "units" in note.text
    assert all(NOTES in answer for answer in answers)
    assert [record.getMessage() for record in caplog.records] == [note.text]


def test_a_state_of_a_million_is_named_in_every_way_to_call(policy: UnifiedPolicy) -> None:
    seen = frames(policy)[0]
    wrong = {**seen, "observation/state": np.array([1e6, *seen["observation/state"][1:]])}
    single, (good, bad) = policy.infer(wrong, seed=0), policy.infer_batch([seen, wrong], seed=0)
    submitted = policy.submit(wrong, seed=0, serially=True).result()
    for answer in (single, bad, submitted):
        (note,) = notes_in(answer)
        assert note.names == ("x",) and "x is 1e+06, in the training data -0.2711 to 0.1137" in note.text
        assert np.isfinite(answer["actions"]).all()
    assert NOTES not in good


def reading(*values: float, stats: FeatureStats | None = None, **more: Any) -> Reading:
    """Of a robot whose joints were from 0 to 10 in training."""
    stats = stats or FeatureStats(q01=np.zeros(len(values)), q99=np.full(len(values), 10.0))
    known = TrainingRange(stats, [Label(f"joint {i}") for i in range(len(values))])
    return Reading(values, known.widths, known.outside(values), **more)


def test_a_value_somewhat_outside_is_named_once_it_stays_there() -> None:
    watch = Watch()
    assert watch.notes(reading(5.0, 5.0)) == []
    for _ in range(SUSTAINED - 1):
        assert watch.notes(reading(13.0, 5.0)) == []
    (note,) = watch.notes(reading(13.0, 5.0))
    assert note.names == ("joint 0",) and "13, in the training data 0 to 10" in note.text
    assert watch.notes(reading(12.0, 5.0)) == []  # within a quarter of the range: back
    assert watch.notes(reading(13.0, 5.0)) == []


def test_one_that_was_far_stays_named_until_it_is_back_in_range_and_the_log_says_it_once() -> None:
    now = [0.0]
    watch = Watch(clock=lambda: now[0])
    logged = []
    for value in (5.0, 31.0, 29.0, 13.0, 12.0, 29.0, 31.0, 5.0, 31.0):
        notes = watch.notes(reading(value))
        logged += watch.to_log(notes)
        assert bool(notes) == (value in (31.0, 29.0, 13.0)) or value == 29.0
    assert len(logged) == 1  # an outlier, and another one: one line
    now[0] += REPEAT_SECONDS
    assert watch.to_log(watch.notes(reading(31.0))) != []
    assert watch.to_log(watch.notes(reading(31.0))) == []
    watch.reset()
    assert watch.notes(reading(5.0)) == watch.notes(reading(29.0)) == []


def test_a_value_somewhat_outside_is_named_at_once_before_the_robot_moves() -> None:
    watch = Watch()
    for _ in range(2):  # as long as it stays there
        (note,) = watch.notes(reading(13.0, 5.0))
        assert note.names == ("joint 0",) and note.text.startswith("the state is outside the checkpoint's")
    assert watch.notes(reading(5.0, 5.0)) == watch.notes(reading(13.0, 5.0)) == []
    watch.reset()  # a new episode
    assert watch.notes(reading(13.0, 5.0)) != []
    several, one_by_one = Watch(remembers=False), Watch(remembers=False, at_once=True)  # `infer`'s rows, and its files
    assert several.notes(reading(13.0)) == [] and all(one_by_one.notes(reading(13.0)) for _ in range(2))


def test_a_second_joint_is_logged_at_once() -> None:
    watch = Watch(clock=lambda: 0.0)
    assert watch.to_log(watch.notes(reading(99.0, 5.0))) and not watch.to_log(watch.notes(reading(99.0, 5.0)))
    assert watch.to_log(watch.notes(reading(99.0, 99.0)))[0].names == ("joint 0", "joint 1")


@pytest.mark.parametrize(
    ("stats", "low", "high", "far"),
    [
        ({"q01": [-2.0], "q99": [2.0], "mean": [9.0], "std": [9.0]}, -2, 2, 10.5),
        ({"min": [-2.0], "max": [2.0]}, -2, 2, 10.5),
        ({"mean": [-2.0], "std": [2.0]}, -8, 4, 28.5),
        ({"q01": [-2.0], "q99": [2.0], "min": [-90.0], "max": [90.0]}, -2, 2, 90.5),  # which the data had
    ],
)
def test_the_range_is_made_of_what_statistics_there_are(
    stats: dict[str, list[float]], low: float, high: float, far: float
) -> None:
    known = TrainingRange(FeatureStats(**{name: np.array(one) for name, one in stats.items()}), [Label("a")])
    assert known.outside([low]) == known.outside([high]) == ()
    (one,) = known.outside([far])
    assert (one.low, one.high, one.far) == (low, high, True)
    assert not any(one.far for one in known.outside([far - 1.0]))


def test_constant_dimensions_and_absent_statistics_have_no_range() -> None:
    known = TrainingRange(FeatureStats(q01=np.array([0.0, 1.0]), q99=np.array([0.0, 2.0])), [Label("a"), Label("b")])
    assert [one.name for one in known.outside([1e9, 1e9, 1e9])] == ["b"]
    assert TrainingRange(None, [Label("a")]).outside([1e9]) == ()


# --- actions ----------------------------------------------------------------------------------------------------------


def with_open_gripper(fixed: Fixed) -> None:
    fixed.actions[4, 6] = -25.0  # normalised: the gripper, whose range is -1 to 1
    fixed.actions[:, 7:] = 1e6  # what this robot doesn't have


def test_actions_out_of_range_are_named_and_left_alone(fixed: Fixed) -> None:
    with_open_gripper(fixed)
    answer = policy_of(fixed).infer(frames(policy_of(fixed))[0], seed=0)
    (note,) = notes_in(answer)
    assert note.kind == "action_range" and note.names == ("gripper",)
    assert "gripper reaches -25 at step 4, in the training data -1 to 1" in note.text
    assert answer["actions"][4, 6] == pytest.approx(-25.0, rel=1e-5)


def test_clipped_actions_end_two_widths_beyond_the_range_and_the_answer_says_so(fixed: Fixed) -> None:
    with_open_gripper(fixed)
    policy = policy_of(fixed, out_of_range="clip")
    seen = frames(policy)[0]
    clipped, plain = policy.infer(seen, seed=0, model_actions=True), policy_of(fixed).infer(seen, seed=0)
    assert clipped["actions"][4, 6] == pytest.approx(GRIPPER[0] - 2 * 2, rel=1e-5)
    others = np.delete(clipped["actions"], 4, axis=0)
    np.testing.assert_array_equal(others, np.delete(plain["actions"], 4, axis=0))
    assert clipped["model_actions"][4, 6] == pytest.approx(-5.0, rel=1e-5)  # the next chunk continues this one
    (note,) = notes_in(clipped)
    assert note.kind == "action_clipped" and "gripper reached -25 at step 4" in note.text and "clipped" in note.text
    assert fixed.actions[4, 6] == -25.0  # the backend's own memory


def test_refused_actions_name_joint_value_and_range_and_the_row(fixed: Fixed) -> None:
    with_open_gripper(fixed)
    policy = policy_of(fixed, out_of_range="refuse")
    seen = frames(policy)
    named = "gripper reaches -25 at step 4, in the training data -1 to 1"
    with pytest.raises(ActionError, match=named):
        policy.infer(seen[0], seed=0)
    with pytest.raises(ActionError, match=rf"observation 0 of 2 \(from 0\): .*{named}"):
        policy.infer_batch(seen[:2], seed=0)
    with pytest.raises(ActionError, match=named):
        policy.submit(seen[0], seed=0, serially=True).result()
    with pytest.raises(ActionError, match="The state is far outside, too: axis-angle x is 180, in the training data"):
        policy.infer(in_degrees(seen[0]), seed=0)
    policy.infer(policy.example_observation(), seed=0)  # a made-up one, as in warm-up


@pytest.mark.parametrize("mode", ["warn", "refuse", "clip"])
def test_no_mode_lets_a_number_that_is_not_finite_pass(fixed: Fixed, mode: str) -> None:
    policy = policy_of(fixed, out_of_range=mode)
    for value in (np.nan, np.inf):
        fixed.actions[4, 6] = value
        with pytest.raises(ActionError, match="aren't finite"):
            policy.infer(frames(policy)[0], seed=0)


def test_an_unknown_mode_is_refused(fixed: Fixed) -> None:
    with pytest.raises(ConfigError, match="unknown out_of_range='clamp'; choose one of warn, refuse, clip"):
        policy_of(fixed, out_of_range="clamp")


def test_relative_actions_are_judged_as_the_model_gives_them(backend: Any) -> None:
    """Their statistics are those of differences: the state that they are added to may be anywhere."""
    fixed = Fixed(backend)
    checkpoint = open_checkpoint(SMALL_POLICY)
    config = replace(checkpoint.config, robot_options={"delta_actions": True})
    policy = policy_on(lambda *_, **__: fixed, replace(checkpoint, config=config), out_of_range="clip")
    seen = frames(policy)[0]
    still = policy.infer(seen, seed=0)
    assert NOTES not in still
    fixed.actions[0, 0] = 100.0
    answer = policy.infer(seen, seed=0)
    assert kinds(answer) == ["action_clipped"]
    limit = policy._checks.actions.most[0] + seen["observation/state"][0]
    assert answer["actions"][0, 0] == pytest.approx(limit, rel=1e-5)


# --- cameras ----------------------------------------------------------------------------------------------------------

BASE, WRIST = "observation/image", "observation/wrist_image"


def moving(policy: UnifiedPolicy, calls: int) -> Iterator[dict[str, Any]]:
    """One robot's observations: images drift, as when a camera moves, and so does the state."""
    seen = frames(policy)[0]
    for call in range(calls):
        state = seen["observation/state"].copy()
        state[:3] += 0.02 * call
        images = {key: np.roll(seen[key], call, axis=1) for key in (BASE, WRIST)}
        yield {**seen, **images, "observation/state": state}


def test_cameras_that_move_have_no_note(policy: UnifiedPolicy) -> None:
    assert not any(NOTES in policy.infer(one, seed=0) for one in moving(policy, 12))


def test_an_observation_that_is_sent_again_and_again_is_no_frozen_camera(policy: UnifiedPolicy) -> None:
    seen = frames(policy)[0]
    assert not any(NOTES in policy.infer(seen, seed=0) for _ in range(4 * FROZEN))


def test_a_frozen_camera_is_named_by_the_robots_own_key(policy: UnifiedPolicy) -> None:
    first = next(moving(policy, 1))
    answers = [policy.infer({**one, WRIST: first[WRIST]}, seed=0) for one in moving(policy, FROZEN + 1)]
    assert [kinds(answer) for answer in answers] == [[]] * (FROZEN - 1) + [["camera_frozen"]] * 2
    (note,) = notes_in(answers[-1])
    assert note.names == (WRIST,) and f"same image in {FROZEN + 1} calls" in note.text
    policy.reset()
    assert kinds(policy.infer(first, seed=0)) == []


def test_an_image_that_changes_where_no_pixel_is_looked_at_is_no_frozen_one(policy: UnifiedPolicy) -> None:
    for call, one in enumerate(moving(policy, 4 * FROZEN)):
        still = frames(policy)[0][WRIST].copy()
        still[0, :30] = 10 * call
        assert kinds(policy.infer({**one, WRIST: still}, seed=0)) == []


def test_a_black_camera_and_one_of_a_single_colour_are_named_at_the_first_call(policy: UnifiedPolicy) -> None:
    seen = frames(policy)[0]
    (note,) = notes_in(policy.infer({**seen, BASE: np.full_like(seen[BASE], 3)}, seed=0))
    assert (note.kind, note.names) == ("camera_black", (BASE,)) and note.text.endswith("is black")
    blue = np.zeros_like(seen[BASE])
    blue[..., 2] = 255
    (note,) = notes_in(policy.infer_batch([{**seen, BASE: blue}], seed=0)[0])
    assert note.kind == "camera_black" and "one colour everywhere: (0, 0, 255)" in note.text


def test_another_resolution_is_named(policy: UnifiedPolicy) -> None:
    seen = frames(policy)[0]
    policy.infer(seen, seed=0)
    (note,) = notes_in(policy.infer({**seen, BASE: seen[BASE][::2, ::2].copy()}, seed=0))
    assert note.kind == "camera_size" and "128 x 128 pixels, before they were 256 x 256" in note.text


def test_a_camera_that_drops_out_is_named_until_it_is_back_or_a_new_episode_begins() -> None:
    watch, calls = Watch(), itertools.count()

    def notes(*cameras: str) -> list[Any]:
        pixels = bytes(range(first := next(calls), first + 12))
        return watch.notes(Reading((0.0,), images={name: Sample((2, 2), pixels) for name in cameras}))

    assert notes("top") == [], "a robot may have fewer cameras than its checkpoint"
    assert notes("top", "wrist") == []
    for _ in range(2):
        (note,) = notes("top")
        assert (note.kind, note.names) == ("camera_missing", ("wrist",)) and "no image of camera wrist" in note.text
    assert notes("top", "wrist") == []
    watch.reset()
    assert notes("top") == []


def test_a_camera_under_a_name_that_is_not_read_is_named_while_one_is_missing() -> None:
    watch = Watch()
    for _ in range(2):
        (note,) = watch.notes(Reading((0.0,), missing=("wrist",), unread=("hand",)))
        assert (note.kind, note.names) == ("camera_missing", ("wrist",))
        assert "has hand, which isn't read, and lacks wrist" in note.text
    for reading in (Reading((0.0,), missing=("wrist",)), Reading((0.0,), unread=("hand",))):
        assert watch.notes(reading) == []


def test_exchanged_cameras_are_named_when_they_are_exchanged_after_the_start(policy: UnifiedPolicy) -> None:
    for one in moving(policy, 5):
        assert kinds(policy.infer(one, seed=0)) == []
    swapped = ({**one, BASE: one[WRIST], WRIST: one[BASE]} for one in moving(policy, COMPARED_EVERY - 3))
    found = [kinds(policy.infer(one, seed=0)) for one in swapped]
    assert found == [[]] * (COMPARED_EVERY - 4) + [
        ["camera_exchanged"]
    ]  # the second comparison, a call after the first
    again = [kinds(policy.infer(one, seed=0)) for one in moving(policy, 4)]
    assert again[-1] == []


def test_exchanged_channels_are_named_when_they_are_exchanged_after_the_start(policy: UnifiedPolicy) -> None:
    colourful = [
        {**one, BASE: (one[BASE] * np.array([1.0, 0.7, 0.3])).astype(np.uint8)}
        for one in moving(policy, COMPARED_EVERY - 3)
    ]
    for one in colourful[:5]:
        assert kinds(policy.infer(one, seed=0)) == []
    found = [notes_in(policy.infer({**one, BASE: one[BASE][..., ::-1].copy()}, seed=0)) for one in colourful]
    assert [(note.kind, note.names) for note in found[-1]] == [("camera_channels", (BASE,))]


@pytest.fixture(scope="module")
def cameras_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of two tasks: the observations of the third are new to it."""
    file = tmp_path_factory.mktemp("replay") / "cameras.npz"
    known = load_frames()[2:]
    samples = {BASE: [sample(frame.base) for frame in known], WRIST: [sample(frame.wrist) for frame in known]}
    made = KnownCameras.of_samples(samples)
    assert made is not None
    made.save(file)
    return file


def test_known_cameras_show_a_mistake_in_the_first_call(fixed: Fixed, cameras_file: Path) -> None:
    policy = policy_of(fixed, known_cameras=cameras_file)
    seen = frames(policy)[0]
    assert NOTES not in policy.infer(seen, seed=0)
    policy.reset()
    exchanged = {**seen, BASE: seen[WRIST], WRIST: seen[BASE]}
    for _ in range(2):  # as long as they are
        (note,) = notes_in(policy.infer(exchanged, seed=0))
        assert (note.kind, note.names) == ("camera_exchanged", (BASE, WRIST)) and str(cameras_file) in note.text
    policy.reset()
    (note,) = notes_in(policy.infer({**seen, BASE: seen[BASE][..., ::-1].copy()}, seed=0))
    assert (note.kind, note.names) == ("camera_channels", (BASE,)) and str(cameras_file) in note.text
    policy.reset()
    (note,) = notes_in(policy.infer({**seen, WRIST: seen[WRIST][::-1, ::-1].copy()}, seed=0))
    assert (note.kind, note.names) == ("camera_turned", (WRIST,)) and "by 180 degrees" in note.text
    both = {key: image[..., ::-1].copy() for key, image in exchanged.items() if key in (BASE, WRIST)}
    rows = policy.infer_batch([exchanged, seen, {**seen, **both}], seed=0)
    found = [["camera_exchanged"], [], ["camera_exchanged", "camera_channels", "camera_channels"]]
    assert [kinds(row) for row in rows] == found


def test_one_image_later_on_that_looks_mistaken_is_no_note(fixed: Fixed, cameras_file: Path) -> None:
    policy = policy_of(fixed, known_cameras=cameras_file)
    seen = frames(policy)[0]
    exchanged = {**seen, BASE: seen[WRIST], WRIST: seen[BASE]}
    calls = [*[seen] * COMPARED_EVERY, exchanged, seen, *[exchanged] * COMPARED_EVERY]
    found = [kinds(policy.infer(one, seed=0)) for one in calls]
    assert found[-1] == ["camera_exchanged"] and not any(found[: COMPARED_EVERY + 3])


def test_a_comparison_is_sent_with_its_notes(fixed: Fixed, cameras_file: Path) -> None:
    """A fleet's front makes the notes of what a replica saw."""
    policy = policy_of(fixed, known_cameras=cameras_file)
    seen = frames(policy)[0]
    wrong = {**seen, BASE: seen[WRIST], WRIST: seen[BASE]}
    sent = pickle.dumps(policy.infer(wrong, seed=0, readings=True)[READING])
    assert len(sent) < 4096
    assert [note.kind for note in Watch().notes(pickle.loads(sent))] == ["camera_exchanged"]


def test_grey_images_and_unknown_cameras_are_compared_with_nothing(cameras_file: Path) -> None:
    grey = sample(np.arange(32 * 32, dtype=np.int64).reshape(32, 32, 1).repeat(3, 2).astype(np.uint8))
    assert KnownCameras.load(cameras_file).notes({"another": grey}) == ()
    known = KnownCameras.of_samples({"a": [grey]})
    assert known is not None and known.notes({"a": grey}) == ()
    assert KnownCameras.of_samples({"a": [sample(np.zeros((3, 5, 3), np.uint8))]}) is None


def test_a_file_of_something_else_is_refused(fixed: Fixed, tmp_path: Path) -> None:
    file = tmp_path / "cameras.npz"
    expected = "expected the cameras.npz that `turbopi replay` writes"
    with pytest.raises(ConfigError, match=f"cameras.npz can't be read .*{expected}"):
        policy_of(fixed, known_cameras=file)
    for content, said in (({}, "has no camera"), ({"top": np.zeros(3)}, r"top is float64\[3\], not uint8\[K, 432\]")):
        np.savez(file, **content)  # type: ignore[arg-type]  # names are keywords
        with pytest.raises(ConfigError, match=f"{said}; {expected}"):
            policy_of(fixed, known_cameras=file)
    np.savez(file, top=np.zeros((1, 432), np.uint8))
    whole = file.read_bytes()
    for damaged in (b"PK nothing", whole[:-40], whole[:60]):
        file.write_bytes(damaged)
        with pytest.raises(ConfigError, match=expected):
            policy_of(fixed, known_cameras=file)


def test_masked_cameras_and_float_images_are_judged_as_they_are() -> None:
    bright, dark = np.full((32, 48, 3), 0.5, np.float32), np.zeros((480, 640, 3), np.float32)
    bright[::3] = 0.9
    assert sample(dark).pixels.strip(b"\0") == b"" and sample(dark).shape == (480, 640)
    assert set(sample(bright).pixels) == {127, 229} and len(sample(bright).pixels) == 12 * 12 * 3
    assert len(sample(np.zeros((3, 5, 3), np.uint8)).pixels) == 3 * 5 * 3
    watch = Watch()
    odd = {"a": sample(np.ones((3, 5, 3), np.uint8) * 99), "b": sample(np.arange(32 * 32 * 3).reshape(32, 32, 3) % 251)}
    assert [note.kind for note in watch.notes(reading(5.0, images=odd))] == ["camera_black"]


def test_names_that_a_client_makes_up_take_no_memory() -> None:
    watch, image = Watch(), sample(np.arange(32 * 32 * 3, dtype=np.uint8).reshape(32, 32, 3))
    for number in range(3 * MOST_CAMERAS):
        assert watch.notes(reading(5.0, images={f"camera {number}": image})) == []
    assert len(watch._cameras._cameras) <= MOST_CAMERAS


# --- over the wire ----------------------------------------------------------------------------------------------------


def metric(server: Any, kind: str) -> float:
    value = server.metrics.registry.get_sample_value("turbopi_notes_total", {"kind": kind})
    assert value is not None
    return float(value)


def test_the_server_answers_logs_and_counts_notes_by_robot(
    policy: UnifiedPolicy, caplog: pytest.LogCaptureFixture, tmp_path: Path
) -> None:
    seen = frames(policy)[0]
    with caplog.at_level(logging.INFO, "turbopi"), running(policy, record_dir=tmp_path) as server:
        with RealTimeClient(port=server.port) as one, RealTimeClient(port=server.port) as other:
            assert NOTES not in one.infer(seen)
            wrong = [one.infer(in_degrees(seen)) for _ in range(3)]
            assert NOTES not in other.infer(seen) and "reading" not in other.infer(seen)
            half = {**seen, BASE: seen[BASE][::2, ::2].copy()}
            assert NOTES not in other.infer(
                half | {"turbopi/session": "arm", "turbopi/mode": "none"}
            )  # another robot: its first image
            assert kinds(other.infer(half)) == ["camera_size"]
            named = other.infer(seen | {"turbopi/session": "arm", "turbopi/mode": "none"})
            assert kinds(named) == ["camera_size"]
        assert metric(server, "state_range") == 3 and metric(server, "camera_size") == 2
    assert [kinds(answer) for answer in wrong] == [["state_range"]] * 3
    logged = [record.getMessage() for record in caplog.records if "far from" in record.getMessage()]
    assert len(logged) == 1 and logged[0].startswith("127.0.0.1:") and "axis-angle x is 180" in logged[0]
    assert not [record for record in caplog.records if record.name == LOGGER]
    recorded = sorted(tmp_path.glob("*/*.npz"))
    assert sum("state_range" in np.load(file)["index"].tobytes().decode() for file in recorded) == 3


def test_a_batch_message_names_the_row(policy: UnifiedPolicy) -> None:
    rows = [frames(policy)[0], in_degrees(frames(policy)[0])]
    message = {key: np.stack([row[key] for row in rows]) for key in rows[0] if key != "prompt"}
    with running(policy) as server, RealTimeClient(port=server.port) as client:
        answer = client.infer({**message, "prompt": rows[0]["prompt"], "turbopi/batch": 2})
        assert [(note["kind"], note["row"]) for note in answer[NOTES]] == [("state_range", 1)]
        right = {**message, "observation/state": message["observation/state"][[0, 0]]}
        assert NOTES not in client.infer({**right, "prompt": "go", "turbopi/batch": 2})


def test_a_server_refuses_or_clips_and_the_connection_stays(fixed: Fixed) -> None:
    for mode in ("refuse", "clip"):
        policy = policy_of(fixed, out_of_range=mode)
        seen = frames(policy)[0]
        fixed.actions[:] = 0
        with running(policy) as server, RealTimeClient(port=server.port) as client:
            with_open_gripper(fixed)
            if mode == "refuse":
                with pytest.raises(ActionError, match="gripper reaches -25 at step 4, in the training data -1 to 1"):
                    client.infer(seen)
                fixed.actions[:] = 0
                assert NOTES not in client.infer(seen)
                assert server.metrics.errors_so_far() == {"actions": 1}
            else:
                answer = client.infer(seen)
                assert kinds(answer) == ["action_clipped"] and answer["actions"][4, 6] == pytest.approx(-5, rel=1e-5)


def test_the_executors_report_has_the_notes(policy: UnifiedPolicy) -> None:
    wrong = in_degrees(frames(policy)[0])
    with RealTimeExecutor(policy, control_hz=50, execution="sync") as executor:
        executor.warm_up(wrong)
        assert executor.observe(wrong)
        while executor.next_action().kind == "waiting":
            pass
        (note,) = executor.report()["notes"]
    assert (
        note["kind"] == "state_range" and note["names"] == ("axis-angle x", "axis-angle z") and "is 180" in note["text"]
    )
    assert (note["chunks"], note["first"], note["last"]) == (1, 0, 0)
    json.dumps(note)


@pytest.mark.parametrize("notes", [None, 3, "text", [1], [{"kind": 1}], [{"kind": "a", "names": None}], [{}]])
def test_what_another_policy_calls_notes_harms_nobody(notes: object) -> None:
    assert notes_in({NOTES: notes}) == [] and notes_in(notes) == []


def test_readings_travel_to_the_server_in_front(policy: UnifiedPolicy) -> None:
    """A fleet's replica makes them; the server in front remembers."""
    made = policy.infer(in_degrees(frames(policy)[0]), seed=0, readings=True)
    assert NOTES not in made
    copied = pickle.loads(pickle.dumps(made["reading"]))
    assert len(pickle.dumps(made["reading"])) < 3000
    assert [note.kind for note in Watch().notes(copied)] == ["state_range"]


# --- names ------------------------------------------------------------------------------------------------------------


def test_every_robot_that_comes_along_names_its_state_and_actions() -> None:
    from turbopi.robots import create_robot

    for name, states, actions in (("libero", 8, 7), ("droid", 8, 8), ("aloha", 14, 14)):
        robot = create_robot(name)
        for labels, width in ((state_labels(robot, states), states), (action_labels(robot, actions), actions)):
            assert len({label.name for label in labels}) == width and all(label.unit for label in labels)
    own: Any = SimpleNamespace(name="libero", action_keys=("a",))
    assert [label.name for label in action_labels(own, 2)] == ["action 0", "action 1"]
    assert [label.name for label in state_labels(own, 2)] == ["value 0", "value 1"]


def test_statistics_that_are_made_up_doubt_no_state_but_may_bound_actions(policy: UnifiedPolicy) -> None:
    stats = open_checkpoint(SMALL_POLICY).norm_stats
    warning = Checks(policy.pipeline, stats, judges_ranges=False)
    assert warning.state.outside([1e9] * 8) == () and not len(warning.actions.low)
    assert len(Checks(policy.pipeline, stats, "clip", judges_ranges=False).actions.low) == 7


def test_metadata_has_names_units_and_training_ranges_where_they_are_known(policy: UnifiedPolicy) -> None:
    stats = open_checkpoint(SMALL_POLICY).norm_stats
    features = json.loads(json.dumps(policy.metadata["features"]))
    assert {key: len(found) for key, found in features.items()} == {"state": 8, "actions": 7}
    z, about_x = features["state"][2], features["actions"][3]
    assert (z["name"], z["unit"], about_x["name"]) == ("z", "m", "about x")
    assert stats.state is not None and stats.state.q01 is not None and stats.state.q99 is not None
    assert (z["low"], z["high"]) == (stats.state.q01[2], stats.state.q99[2]) and about_x["low"] < about_x["high"]
    made_up = Checks(policy.pipeline, stats, judges_ranges=False).features
    assert [one["name"] for one in made_up["state"]] == [one["name"] for one in features["state"]]
    assert {one[end] for found in made_up.values() for one in found for end in ("low", "high")} == {None}
