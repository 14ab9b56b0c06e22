"""`turbopi infer`: every form of observation in, actions and a plot out."""

import errno
import json
import os
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cli_helpers import refusal, turbopi
from file_helpers import no_room
from PIL import Image
from typer.testing import Result

from turbopi.policy.policy import UnifiedPolicy
from turbopi.policy.shipped import FRAMES, SMALL_POLICY, load_frames
from turbopi.recordings import RecordedCall, save_call
from turbopi.support.action_groups import prompt_of

pytestmark = pytest.mark.usefixtures("two_layers")

TINY = ("--random-weights", "pi05_tiny", "--steps", 2, "--no-warmup")


def observation(number: int = 0) -> dict[str, Any]:
    frame = load_frames()[number]
    return {
        "observation/image": frame.base,
        "observation/wrist_image": frame.wrist,
        "observation/state": frame.state,
        "prompt": frame.prompt,
    }


@pytest.fixture
def npz(tmp_path: Path) -> Path:
    file = tmp_path / "observation.npz"
    np.savez(file, **observation())
    return file


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    folder = tmp_path / "recording"
    folder.mkdir()
    for number in range(3):
        result = {"actions": np.zeros((10, 7)), "policy_timing": {}}
        save_call(folder / f"{number:06d}.npz", RecordedCall(observation(number), result, 0.0))
    return folder


def infer(tmp_path: Path, *arguments: object) -> Result:
    result = turbopi("infer", *TINY, *arguments, "-o", tmp_path / "actions.npz")
    assert result.exit_code == 0, result.output
    return result


def actions_in(tmp_path: Path) -> np.ndarray:
    with np.load(tmp_path / "actions.npz") as archive:
        assert set(archive.files) == {"actions", "noise"}
        actions: np.ndarray = archive["actions"]
        return actions


@pytest.mark.slow
def test_a_full_disk_keeps_the_earlier_actions_and_plot(
    npz: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    infer(tmp_path, npz, "--seed", 5)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    replace = os.replace
    for name in ("actions.npz", "actions.png"):

        def full(source: Path, target: Path, name: str = name) -> None:
            if Path(target).name == name:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            replace(source, target)

        with monkeypatch.context() as patched:
            patched.setattr(os, "replace", full)
            result = turbopi("infer", *TINY, npz, "--seed", 5, "-o", tmp_path / "actions.npz")
        assert result.exit_code == 2
        assert f"error: can't write {tmp_path / name}: No space left on device; make room" in result.stderr
        assert {path.name for path in tmp_path.iterdir()} == before.keys()
        assert (tmp_path / name).read_bytes() == before[name]


def test_an_npz_becomes_actions_and_a_plot(npz: Path, tmp_path: Path) -> None:
    result = infer(tmp_path, npz, "--seed", 5)
    actions = actions_in(tmp_path)
    assert actions.shape == (10, 7)
    assert actions.dtype == np.float64
    assert "RANDOM WEIGHTS (pi05_tiny, seed 0)" in result.stdout
    assert re.search(r"preprocess .* vision .* prefix .* denoise .* postprocess .* model .* total", result.stdout)
    assert f"actions [10 x 7] written to {tmp_path / 'actions.npz'}\n" in result.stdout
    assert f"plot written to {tmp_path / 'actions.png'}\n" in result.stdout
    with Image.open(tmp_path / "actions.png") as plot:
        assert plot.width > plot.height > 200


def test_the_actions_are_the_policys_own(npz: Path, tmp_path: Path) -> None:
    from turbopi.checkpoint import random_checkpoint

    infer(tmp_path, npz, "--seed", 5, "--no-plot")
    assert not (tmp_path / "actions.png").exists()
    policy = UnifiedPolicy(random_checkpoint("pi05_tiny"), num_denoising_steps=2)
    np.testing.assert_array_equal(actions_in(tmp_path), policy.infer(observation(), seed=5)["actions"])


def test_a_folder_with_pictures_gives_the_same_as_their_arrays(npz: Path, tmp_path: Path) -> None:
    infer(tmp_path, npz, "--seed", 5, "--no-plot")
    expected = actions_in(tmp_path)
    folder = tmp_path / "by_hand"
    folder.mkdir()
    entry = json.loads((FRAMES / "frames.json").read_text())[0]
    for name in ("image", "wrist_image"):
        (folder / entry[name]).write_bytes((FRAMES / entry[name]).read_bytes())
    written = {f"observation/{name}": {"file": entry[name]} for name in ("image", "wrist_image")}
    written |= {"observation/state": entry["state"], "prompt": entry["prompt"]}
    (folder / "observation.json").write_text(json.dumps(written))
    infer(tmp_path, folder, "--seed", 5, "--no-plot")
    np.testing.assert_array_equal(actions_in(tmp_path), expected)


@pytest.mark.slow
def test_a_recording_is_run_call_by_call(npz: Path, recording: Path, tmp_path: Path, drawn: list[Any]) -> None:
    result = infer(tmp_path, recording, "--seed", 5, "--plot", tmp_path / "all.pdf")
    chunks = actions_in(tmp_path)
    assert chunks.shape == (3, 10, 7)
    assert "of 3 calls" in result.stdout
    assert "median" in result.stdout
    assert (tmp_path / "all.pdf").read_bytes().startswith(b"%PDF")
    assert len(drawn[0].subfigs) == 3, "a row for each call"
    for panel, chunk in zip(drawn[0].subfigs, chunks, strict=True):
        lines = [line.get_ydata() for axes in panel.axes for line in axes.get_lines() if len(line.get_xdata()) == 10]
        np.testing.assert_array_equal(lines, chunk.T)
    infer(tmp_path, recording, "--call", 1, "--seed", 6, "--no-plot")
    np.testing.assert_array_equal(actions_in(tmp_path), chunks[1])
    infer(tmp_path, npz, "--seed", 5, "--no-plot")
    np.testing.assert_array_equal(actions_in(tmp_path), chunks[0])


def test_actions_replace_earlier_ones_with_a_note_and_no_other_file(npz: Path, tmp_path: Path) -> None:
    assert "replaced" not in infer(tmp_path, npz, "--no-plot").output
    again = infer(tmp_path, npz, "--no-plot")
    assert f"note: {tmp_path}/actions.npz is there, and will be replaced; --out names another file" in again.output
    mine = tmp_path / "mine.npz"
    np.savez(mine, actions=np.zeros(3))
    refused = refusal(turbopi("infer", *TINY, npz, "-o", mine))
    assert refused == f"{mine} is there and isn't what `turbopi infer` wrote, so it isn't replaced; name another file"
    with np.load(mine) as archive:
        assert archive["actions"].shape == (3,)


def test_no_observation_is_overwritten(npz: Path, recording: Path, tmp_path: Path) -> None:
    folder = tmp_path / "by hand"
    folder.mkdir()
    (folder / "observation.json").write_text('{"observation/image": {"file": "table.png"}}')
    (folder / "table.png").write_bytes(b"image")
    call = next(recording.rglob("*.npz"))
    for source, *targets in (
        (npz, "-o", npz),
        (call.parent, "-o", call, "--no-plot"),
        (folder, "-o", folder / "observation.json", "--no-plot"),
        (folder, "-o", folder / "table.npz"),  # whose plot would be table.png
    ):
        refused = refusal(turbopi("infer", *TINY, source, *targets))
        assert "is the observation itself, or part of it: write to another file" in refused
    assert (folder / "table.png").read_bytes() == b"image"


@pytest.mark.slow
def test_noise_from_a_file_is_what_the_model_starts_from(npz: Path, tmp_path: Path) -> None:
    infer(tmp_path, npz, "--seed", 5, "--no-plot")
    expected = actions_in(tmp_path)
    (tmp_path / "actions.npz").rename(tmp_path / "first.npz")
    infer(tmp_path, npz, "--noise", tmp_path / "first.npz", "--no-plot")
    np.testing.assert_array_equal(actions_in(tmp_path), expected)
    np.save(tmp_path / "noise.npy", np.zeros((10, 32), np.float32))
    infer(tmp_path, npz, "--noise", tmp_path / "noise.npy", "--no-plot")
    assert not np.array_equal(actions_in(tmp_path), expected)


def test_without_a_seed_the_one_drawn_is_told_and_gives_the_same_again(npz: Path, tmp_path: Path) -> None:
    reported = re.search(r"--seed (\d+) gives these actions again", infer(tmp_path, npz, "--no-plot").stdout)
    assert reported is not None
    drawn = actions_in(tmp_path)
    infer(tmp_path, npz, "--no-plot", "--seed", reported[1])
    np.testing.assert_array_equal(actions_in(tmp_path), drawn)


def test_json_is_one_document_on_stdout(npz: Path, tmp_path: Path) -> None:
    result = infer(tmp_path, npz, "--json", "--no-plot")
    document = json.loads(result.stdout)
    np.testing.assert_array_equal(document["actions"], actions_in(tmp_path))
    assert document["policy"]["random_weights"] is True
    assert document["policy_timing"][0]["total_ms"] > document["policy_timing"][0]["infer_ms"] > 0
    assert document["plot"] is None
    assert "RANDOM WEIGHTS" in result.stderr


def test_wrong_paths_are_told_what_infer_takes() -> None:
    assert refusal(turbopi("infer", "a")) == (
        "infer takes two paths, the checkpoint and the observation "
        "(or --random-weights PRESET and the observation alone), but got 1: a"
    )
    assert refusal(turbopi("infer", "a", "b", "c", "--random-weights", "pi05_tiny")) == (
        "infer takes one path, the observation (the weights are random), but got 3: a b c"
    )
    assert "two kinds of weights" in refusal(turbopi("infer", "a", "b", "--random-weights", "pi05_tiny"))


def test_paths_in_the_wrong_order_are_told_so(npz: Path, tmp_path: Path) -> None:
    reported = refusal(turbopi("infer", npz, tmp_path))
    assert reported == f"{npz} is a file, but the checkpoint's folder comes first: is it {tmp_path}?"


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["nowhere.npz"], "nowhere.npz doesn't exist"),
        (["OBS", "--seed", "1", "--noise", "n.npy"], "--noise and --seed were both given; give one of them"),
        (["OBS", "--plot", "x.png", "--no-plot"], "--plot and --no-plot were both given; give one of them"),
        (["OBS", "--plot", "x.xyz"], "the plot x.xyz should end in one of .png, .pdf, .svg"),
        (["OBS", "--noise", "nowhere.npy"], "the noise nowhere.npy can't be read: No such file or directory"),
        (["OBS", "--noise", "OBS"], "has no array named noise, only observation/image"),
        (["OBS", "-o", "OBS"], "is the observation itself, or part of it: write to another file"),
        (["OBS", "-o", "no/folder/actions.npz"], "can't write no/folder/actions.npz: there is no folder"),
        (["OBS", "-o", "."], ". is a folder; give a file's name"),
        (["OBS", "-o", "both.png"], "would both be written to both.png"),
        (["OBS", "--call", "0"], "--call picks one call of a recording's folder"),
        (["REC", "--call", "3"], "there is no call 3: "),
    ],
)
def test_bad_arguments_are_refused_before_anything_is_loaded(
    arguments: list[str], expected: str, npz: Path, recording: Path
) -> None:
    paths = {"OBS": str(npz), "REC": str(recording)}
    result = turbopi("infer", *TINY, *(paths.get(argument, argument) for argument in arguments))
    assert expected in refusal(result)


@pytest.mark.parametrize(
    ("wrong", "reported"),
    [
        ({"observation/wrist_image": None}, "the observation has no 'observation/wrist_image'"),
        ({"observation/state": np.zeros(7)}, "observation/state has shape (7,), expected shape (8,)"),
        ({"observation/image": np.zeros((4, 4, 3), np.int64)}, "observation/image has dtype int64"),
        ({"prompt": None}, "the observation has no prompt"),
    ],
)
def test_an_observation_the_robot_cannot_use_is_refused_before_weights_are_loaded(
    wrong: dict[str, Any], reported: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delattr(UnifiedPolicy, "__init__")
    content = {key: value for key, value in (observation() | wrong).items() if value is not None}
    np.savez(npz := tmp_path / "observation.npz", **content)
    result = turbopi("infer", *TINY, npz, "-o", tmp_path / "actions.npz")
    assert result.exit_code == 2
    assert f"error: {npz}: {reported}" in result.stderr
    assert not (tmp_path / "actions.npz").exists()


def test_a_default_prompt_stands_in_for_one_that_an_observation_lacks(tmp_path: Path) -> None:
    content = observation()
    del content["prompt"]
    np.savez(npz := tmp_path / "observation.npz", **content)
    infer(tmp_path, npz, "--no-plot", "--default-prompt", "open the drawer")


def test_a_later_call_of_a_recording_that_is_wrong_is_named(recording: Path, tmp_path: Path) -> None:
    content = observation() | {"observation/state": np.zeros(7)}
    save_call(recording / "000001.npz", RecordedCall(content, {"actions": np.zeros((10, 7)), "policy_timing": {}}, 0.0))
    result = turbopi("infer", *TINY, recording, "-o", tmp_path / "actions.npz")
    assert result.exit_code == 2
    assert "000001.npz: observation/state has shape (7,)" in result.stderr


def test_noise_of_another_shape_is_refused_before_weights_are_loaded(
    npz: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delattr(UnifiedPolicy, "__init__")
    np.save(tmp_path / "noise.npy", np.zeros((9, 32), np.float32))
    result = turbopi("infer", *TINY, npz, "--noise", tmp_path / "noise.npy", "-o", tmp_path / "actions.npz")
    assert result.exit_code == 2
    assert "noise has shape [9, 32], but this policy needs [10, 32]" in result.stderr


def test_a_full_disk_keeps_the_earlier_actions_and_names_the_file(npz: Path, tmp_path: Path) -> None:
    infer(tmp_path, npz, "--seed", 1, "--no-plot")
    earlier = (tmp_path / "actions.npz").read_bytes()
    with no_room(1000):
        result = turbopi("infer", *TINY, npz, "--seed", 2, "--no-plot", "-o", tmp_path / "actions.npz")
    assert result.exit_code == 2
    assert f"can't write {tmp_path / 'actions.npz'}: " in result.stderr
    assert "full" in result.stderr
    assert "Traceback" not in result.stderr
    assert (tmp_path / "actions.npz").read_bytes() == earlier
    assert sorted(file.name for file in tmp_path.iterdir()) == ["actions.npz", "observation.npz"]


def test_a_state_in_other_units_than_the_training_datas_is_doubted(tmp_path: Path) -> None:
    seen, file = observation(), tmp_path / "degrees.npz"
    options = (SMALL_POLICY, file, "--steps", 1, "--no-warmup", "--no-plot", "-o", tmp_path / "actions.npz")
    np.savez(file, **seen)
    assert "note" not in turbopi("infer", *options).output
    np.savez(file, **seen | {"observation/state": np.degrees(seen["observation/state"])})
    result = turbopi("infer", *options, "--json")
    shown = " ".join(result.stderr.split())
    assert shown.count("degrees.npz: the state is far") == 1
    assert re.search(r"note: .*degrees.npz: the state is far .*: x is .*, in the training data .* units", shown)
    ((note,),) = json.loads(result.stdout)["notes"]
    assert note["kind"] == "state_range" and note["names"][0] == "x"


def test_actions_out_of_range_are_refused_if_so_requested(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("turbopi.policy.ranges.FAR", -0.49)  # all but the middle of the training range is far outside
    file = tmp_path / "observation.npz"
    np.savez(file, **observation())
    options = (SMALL_POLICY, file, "--steps", 1, "--no-warmup", "--no-plot", "-o", tmp_path / "actions.npz")
    message = refusal(turbopi("infer", *options, "--json", "--out-of-range", "refuse"), whole=False)
    assert re.search(r"\w+ reaches \S+ at step \d+, in the training data \S+ to \S+", message)
    assert not (tmp_path / "actions.npz").exists()
    shown = " ".join(turbopi("infer", *options, "--out-of-range", "clip").output.split())
    assert "They were clipped" in shown
    message = refusal(turbopi("infer", *options, "--json", "--out-of-range", "clamp"), whole=False)
    assert "unknown --out-of-range clamp; choose one of warn, refuse, clip" in message


@pytest.mark.parametrize(
    ("observation", "expected"),
    [
        ({"prompt": "fold", "label": "x"}, "fold"),
        ({"task": "fold", "label": "x"}, "fold"),
        ({"instruction": "fold", "turbopi/session": "arm 1", "state": np.zeros(2)}, "fold"),
        ({"instruction": "fold", "label": "x"}, ""),
        ({"state": np.zeros(2)}, ""),
    ],
)
def test_the_task_is_shown_whatever_its_key(observation: dict[str, Any], expected: str) -> None:
    assert prompt_of(observation) == expected
