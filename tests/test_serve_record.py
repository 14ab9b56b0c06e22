"""Recordings: what goes in comes out, and the disk never holds the robot up."""

import json
import os
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst
from PIL import Image

from turbopi.recordings import RecordedCall, Recorder, iter_recording, load_call, load_observation, save_call
from turbopi.recordings import recorder as record
from turbopi.recordings.format import RECORD_IMAGES, RecordImages
from turbopi.recordings.limit import RecordLimit, Trimmed
from turbopi.support.errors import ConfigError, ObservationError, OutputError
from turbopi.support.files import append_line

RESULT = {
    "actions": np.arange(14.0).reshape(2, 7),
    "policy_timing": {"infer_ms": 12.5},
    "server_timing": {"infer_ms": 13.0},
}
ALOHA = {
    "images": {"cam_high": np.full((3, 4, 5), 7, np.uint8), "cam_left_wrist": np.zeros((3, 4, 5), np.uint8)},
    "state": np.linspace(0, 1, 14, dtype=np.float32),
    "prompt": "fold the towel ✓",
}


def assert_equal(actual: Any, expected: Any) -> None:
    if isinstance(expected, dict):
        assert list(actual) == list(expected)
        for key in expected:
            assert_equal(actual[key], expected[key])
    elif isinstance(expected, list):
        assert len(actual) == len(expected)
        for a, e in zip(actual, expected, strict=True):
            assert_equal(a, e)
    elif isinstance(expected, np.ndarray | np.generic):
        assert type(actual) is type(expected)
        assert (actual.dtype, actual.shape) == (expected.dtype, expected.shape)
        np.testing.assert_array_equal(actual, expected)
    else:
        assert type(actual) is type(expected)
        assert actual == expected


LEAVES = (
    st.none()
    | st.booleans()
    | st.integers(-(2**63), 2**64 - 1)
    | st.floats(allow_nan=False)
    | st.text()
    | st.binary()
    | npst.arrays(st.sampled_from(["<f4", ">f8", "|u1", "|b1", "|S2", "<M8[s]"]), npst.array_shapes(min_dims=0))
    | npst.arrays(
        "<U3",
        npst.array_shapes(min_dims=0),
        elements=st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=3),
    )
    | st.sampled_from([np.float32(1.5), np.uint8(3), np.bool_(True)])
)
KEYS = st.sampled_from(["a", "b", "a/b", "a.npy", "", "/", "..", "ключ", "x" * 200]) | st.text(max_size=4)
TREES = st.dictionaries(
    KEYS,
    st.recursive(LEAVES, lambda inner: st.lists(inner, max_size=3) | st.dictionaries(KEYS, inner, max_size=3)),
    max_size=5,
)


def test_text_that_could_not_be_read_again_is_not_recorded(tmp_path: Path) -> None:
    call = RecordedCall({"note": np.array(["ok", "\ud800"])}, {"actions": np.zeros((1, 1))}, 0.0)
    with pytest.raises(ObservationError, match=r"can't record .*half a Unicode character"):
        save_call(tmp_path / "call.npz", call)
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
@given(TREES)
@settings(deadline=None, max_examples=100)
def test_any_observation_comes_back_unchanged(
    tmp_path_factory: pytest.TempPathFactory, observation: dict[str, Any]
) -> None:
    path = tmp_path_factory.getbasetemp() / "call.npz"
    save_call(path, RecordedCall(observation, RESULT, 1.5))
    call = load_call(path)
    assert_equal(call.observation, observation)
    assert_equal(call.result, RESULT)
    assert call.time == 1.5


def test_keys_that_join_to_the_same_name_stay_apart(tmp_path: Path) -> None:
    observation = {"a/b": np.zeros(1), "a": {"b": np.ones(2)}}
    save_call(tmp_path / "x.npz", RecordedCall(observation, RESULT, 0.0))
    assert_equal(load_observation(tmp_path / "x.npz"), observation)


def test_plain_numpy_reads_the_arrays_by_their_keys(tmp_path: Path) -> None:
    save_call(tmp_path / "x.npz", RecordedCall({"observation/state": np.arange(8.0)}, RESULT, 0.0))
    with np.load(tmp_path / "x.npz", allow_pickle=False) as archive:
        assert set(archive.files) == {"observation/observation/state", "result/actions", "index"}
        np.testing.assert_array_equal(archive["result/actions"], RESULT["actions"])


@pytest.mark.parametrize("value", [object(), np.array([None]), {1: 2}])
def test_what_cannot_be_stored_is_refused_and_leaves_no_file(tmp_path: Path, value: Any) -> None:
    with pytest.raises(ObservationError, match="can't record"):
        save_call(tmp_path / "x.npz", RecordedCall({"x": value}, RESULT, 0.0))
    assert list(tmp_path.iterdir()) == []


def test_a_recording_comes_back_in_order_with_its_manifest(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path, {"policy": "fake", "reset_pose": np.zeros(2)})
    for n in range(12):
        recorder.put({**ALOHA, "prompt": str(n)}, RESULT, size=1)
    recorder.close()
    calls = list(iter_recording(tmp_path))
    assert [obs["prompt"] for obs, _ in calls] == [str(n) for n in range(12)]
    assert_equal(calls[0][0], {**ALOHA, "prompt": "0"})
    assert_equal(calls[0][1], RESULT["actions"])
    assert len(list(iter_recording(recorder.folder))) == 12
    assert len(list(iter_recording(recorder.folder / "000003.npz"))) == 1
    manifest = json.loads((recorder.folder / "manifest.json").read_text())
    assert manifest["metadata"] == {"policy": "fake", "reset_pose": [0.0, 0.0]}
    lines = [json.loads(line) for line in (recorder.folder / "index.jsonl").read_text().splitlines()]
    assert [line["file"] for line in lines] == [f"{n:06d}.npz" for n in range(12)]
    assert all(line["infer_ms"] == 13.0 and line["time"] >= manifest["started"] for line in lines)


def test_each_run_has_its_own_folder_and_the_runs_follow_each_other(tmp_path: Path) -> None:
    for run in range(3):
        recorder = Recorder(tmp_path, {})
        recorder.put({"run": run}, RESULT, size=1)
        recorder.close()
    assert [obs["run"] for obs, _ in iter_recording(tmp_path)] == [0, 1, 2]


class SlowDisk:
    """Stands in for `save_call`: waits until it may write."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.writing, self.may_write = threading.Event(), threading.Event()
        monkeypatch.setattr(record, "save_call", self)

    def __call__(self, path: Path, call: RecordedCall, images: RecordImages) -> None:
        self.writing.set()
        assert self.may_write.wait(30)
        save_call(path, call, images)


@pytest.mark.parametrize(
    ("limits", "sizes"),
    [({"queue_calls": 2, "queue_bytes": 500}, [100] * 6), ({"queue_bytes": 300}, [100] * 6)],
    ids=["calls", "bytes"],
)
def test_a_slow_disk_drops_calls_with_a_counted_warning(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    limits: dict[str, Any],
    sizes: list[int],
) -> None:
    disk = SlowDisk(monkeypatch)
    counted: list[str] = []
    recorder = Recorder(tmp_path, {}, count=counted.append, **limits)
    for n, size in enumerate(sizes):
        recorder.put({"n": n}, RESULT, size=size)
        assert disk.writing.wait(120)  # the first call is out of the queue before the second comes
    assert recorder.dropped == 3
    assert "2 calls weren't recorded: the disk can't keep up" in caplog.text
    disk.may_write.set()
    while recorder.written < 3:
        threading.Event().wait(0.01)
    recorder.put({"n": 6}, RESULT, size=400)
    recorder.close()
    assert [obs["n"] for obs, _ in iter_recording(tmp_path)] == [0, 1, 2, 6]
    assert sorted(counted) == ["dropped"] * 3 + ["written"] * 4


def test_one_call_larger_than_the_queue_is_still_recorded(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path, {}, queue_bytes=10)
    recorder.put({"n": 1}, RESULT, size=100)
    recorder.close()
    assert (recorder.written, recorder.dropped) == (1, 0)


def test_a_full_disk_loses_calls_and_not_the_server(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    real, full = np.savez, threading.Event()
    full.set()

    def savez(file: Any, **members: Any) -> None:
        file.write(b"half")
        if full.is_set():
            raise OSError(28, "No space left on device")
        file.seek(0)
        real(file, **members)

    monkeypatch.setattr(np, "savez", savez)
    counted: list[str] = []
    caplog.set_level("INFO", "turbopi")
    recorder = Recorder(tmp_path, {}, count=counted.append)
    recorder.put({"n": 0}, RESULT, size=1)
    recorder.put({"n": object()}, RESULT, size=1)
    while recorder.failed < 2:
        threading.Event().wait(0.01)
    full.clear()
    recorder.put({"n": 2}, RESULT, size=1)
    recorder.close()
    assert counted == ["failed", "failed", "written"]
    assert "1 calls couldn't be recorded" in caplog.text and "; 2 are lost" in caplog.text
    assert "No space left on device" in caplog.text
    assert sorted(path.name for path in recorder.folder.iterdir()) == ["000002.npz", "index.jsonl", "manifest.json"]


def test_a_folder_that_vanishes_ends_no_thread(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path, {})
    recorder.folder.rename(tmp_path / "moved")
    recorder.put({"n": 0}, RESULT, size=1)
    recorder.close()
    assert recorder.failed == 1


def test_a_folder_that_cannot_be_made_is_refused_at_once(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(ConfigError, match=r"can't record into .*file"):
        Recorder(tmp_path / "file", {})


# --- loading one observation ------------------------------------------------------------------------------------------


def test_an_observation_is_read_from_a_recording(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path, {})
    recorder.put(ALOHA, RESULT, size=1)
    recorder.close()
    assert_equal(load_observation(tmp_path), ALOHA)
    assert_equal(load_observation(recorder.folder / "000000.npz"), ALOHA)


def test_an_observation_is_read_from_a_plain_npz(tmp_path: Path) -> None:
    np.savez(tmp_path / "x.npz", **{"observation/state": np.zeros(8), "prompt": np.array("go")})  # type: ignore[arg-type]
    assert_equal(load_observation(tmp_path / "x.npz"), {"observation/state": np.zeros(8), "prompt": "go"})


def test_an_observation_is_read_from_a_folder_of_pictures(tmp_path: Path) -> None:
    pixels = np.arange(24, dtype=np.uint8).reshape(2, 4, 3)
    Image.fromarray(pixels).save(tmp_path / "high.png")
    np.save(tmp_path / "wrist.npy", pixels)
    description = {
        "images": {"cam_high": {"file": "high.png", "layout": "chw"}, "cam_left_wrist": {"file": "wrist.npy"}},
        "observation/image": {"file": "high.png"},
        "state": [0, 0.5],
        "prompt": "go",
    }
    (tmp_path / "observation.json").write_text(json.dumps(description))
    expected = {
        "images": {"cam_high": pixels.transpose(2, 0, 1), "cam_left_wrist": pixels},
        "observation/image": pixels,
        "state": np.array([0, 0.5]),
        "prompt": "go",
    }
    assert_equal(load_observation(tmp_path), expected)


@pytest.mark.parametrize(
    ("description", "message"),
    [
        ("{", "isn't JSON"),
        ("[]", r"observation\.json is a list; expected an object"),
        ('{"a": {"file": "none.png"}}', "'a' names the file 'none.png', which isn't in"),
        ('{"a": {"file": "../secret.npy"}}', "which isn't in"),
        ('{"a": {"file": "text.png"}}', "is neither a readable image nor .npy"),
        ('{"a": {"file": "text.npy"}}', "isn't a readable .npy file"),
        ('{"a": {"file": "text.png", "layout": "nchw"}}', "'a' must be"),
        ('{"a": {"file": "text.png", "size": 3}}', "'a' must be"),
        ('{"a": ["x"]}', "'a' must be a list of numbers"),
        ('{"a": {"b": [[1], [2, 3]]}}', "'a/b' must be a list of numbers"),
    ],
)
def test_a_wrong_observation_folder_is_refused(tmp_path: Path, description: str, message: str) -> None:
    folder = tmp_path / "folder"
    folder.mkdir()
    np.save(tmp_path / "secret.npy", np.zeros(1))
    (folder / "text.png").write_text("text")
    (folder / "text.npy").write_text("text")
    (folder / "observation.json").write_text(description)
    with pytest.raises(ObservationError, match=message):
        load_observation(folder)


def test_files_that_are_no_recordings_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ObservationError, match="doesn't exist"):
        load_observation(tmp_path / "none.npz")
    with pytest.raises(ObservationError, match="holds no recording"):
        load_observation(tmp_path)
    (tmp_path / "text.npz").write_text("text")
    with pytest.raises(ObservationError, match=r"text\.npz isn't a readable \.npz file: it is no zip archive"):
        load_observation(tmp_path / "text.npz")
    np.save(tmp_path / "array.npy", np.zeros(2))
    with pytest.raises(ObservationError, match=r"array\.npy isn't an \.npz file"):
        load_observation(tmp_path / "array.npy")
    np.savez(tmp_path / "pickle.npz", x=np.array([{}], object))
    with pytest.raises(ObservationError, match="isn't a readable"):
        load_observation(tmp_path / "pickle.npz")
    np.savez(tmp_path / "plain.npz", x=np.zeros(1))
    with pytest.raises(ObservationError, match="without an index"):
        load_call(tmp_path / "plain.npz")


@pytest.mark.parametrize(
    ("index", "message"),
    [
        (b"{", "damaged index"),
        (b"[]", "damaged index"),
        (b'{"format":"turbopi-recording","version":1,"time":1,"observation":[],"result":{"dict":[]}}', "damaged index"),
        (b'{"format": "turbopi-recording", "version": 3}', "version 3; this reads turbopi-recording of version 1 or 2"),
        (b'{"format": "turbopi-recording", "version": 1, "time": 0, "observation": {"array": "x"}}', "damaged index"),
        (b'{"format": "turbopi-recording", "version": 1, "time": 0, "observation": {"what": "x"}}', "damaged index"),
    ],
)
def test_a_damaged_index_is_refused(tmp_path: Path, index: bytes, message: str) -> None:
    np.savez(tmp_path / "x.npz", index=np.frombuffer(index, np.uint8))
    with pytest.raises(ObservationError, match=message):
        load_call(tmp_path / "x.npz")


def test_an_index_that_a_full_disk_did_not_take_is_whole_in_the_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    full, tried = threading.Event(), threading.Event()
    full.set()

    def append(file: Path, line: str) -> None:
        if full.is_set():
            tried.set()
            raise OutputError(f"can't write {file}: the disk is full")
        append_line(file, line)

    monkeypatch.setattr(record, "append_line", append)
    recorder = Recorder(tmp_path, {})
    recorder.put({"n": 0}, RESULT, size=1)
    assert tried.wait(30)
    full.clear()
    recorder.put({"n": 1}, RESULT, size=1)
    recorder.close()
    assert (recorder.written, recorder.failed) == (2, 0)
    lines = (recorder.folder / "index.jsonl").read_text().splitlines()
    assert [json.loads(line)["file"] for line in lines] == ["000000.npz", "000001.npz"]
    assert "1 calls are recorded and not in the index yet: can't write" in caplog.text


def test_an_index_catches_up_when_recording_ends(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    failures = iter([OutputError("the disk is full")])

    def append(file: Path, line: str) -> None:
        if failure := next(failures, None):
            raise failure
        append_line(file, line)

    monkeypatch.setattr(record, "append_line", append)
    recorder = Recorder(tmp_path, {})
    recorder.put({"n": 0}, RESULT, size=1)
    recorder.close()
    (line,) = (recorder.folder / "index.jsonl").read_text().splitlines()
    assert json.loads(line)["file"] == "000000.npz"


def test_a_call_that_cannot_be_recorded_is_named_by_its_file(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    recorder = Recorder(tmp_path, {})
    (recorder.folder / "000000.npz").mkdir()
    recorder.put({"n": 0}, RESULT, size=1)
    recorder.close()
    assert recorder.failed == 1
    assert "000000.npz" in caplog.text


def test_a_manifest_that_cannot_be_written_ends_the_start(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("turbopi.support.files.os.replace", full)
    with pytest.raises(ConfigError, match=r"manifest\.json"):
        Recorder(tmp_path, {})


# --- images as files --------------------------------------------------------------------------------------------------


def smooth(height: int, width: int) -> np.ndarray:
    """uint8[h, w, 3], a gradient: JPEG keeps such images within a few of 255."""
    rows, columns = np.mgrid[:height, :width]
    return np.stack([rows * 255 // height, columns * 255 // width, (rows + columns) % 256 // 2], 2).astype(np.uint8)


@pytest.mark.parametrize("images", RECORD_IMAGES)
def test_images_come_back_in_their_layout_whatever_they_are_written_as(tmp_path: Path, images: RecordImages) -> None:
    """Depth, masks and single channels are no images, and stay as they are."""
    image, depth = smooth(40, 60), np.arange(12, dtype=np.uint16).reshape(3, 4)
    kept = {
        "depth": depth,
        "mask": np.zeros((3, 4), np.uint8),
        "grey": np.zeros((5, 4, 1), np.uint8),
        "state": np.ones(8),
    }
    observation: dict[str, Any] = {"hwc": image, "chw": np.ascontiguousarray(image.transpose(2, 0, 1)), **kept}
    save_call(tmp_path / "x.npz", RecordedCall(observation, RESULT, 1.0), images)
    read = load_call(tmp_path / "x.npz")
    assert_equal(read.result, RESULT)
    assert_equal({key: read.observation[key] for key in kept}, kept)
    for key in ("hwc", "chw"):
        found, expected = read.observation[key], observation[key]
        assert (found.dtype, found.shape) == (expected.dtype, expected.shape)
        difference = np.abs(found.astype(int) - expected)
        assert difference.max() <= (12 if images == "jpeg" else 0)
    assert_equal(load_observation(tmp_path / "x.npz")["state"], np.ones(8))


def test_a_recorded_image_that_is_damaged_is_refused(tmp_path: Path) -> None:
    index = {
        "format": "turbopi-recording",
        "version": 2,
        "time": 1.0,
        "observation": {"dict": [["image", {"image": "x"}]]},
        "result": {"dict": []},
    }
    np.savez(
        tmp_path / "x.npz", x=np.arange(9, dtype=np.uint8), index=np.frombuffer(json.dumps(index).encode(), np.uint8)
    )
    with pytest.raises(ObservationError, match="x is neither a readable image"):
        load_call(tmp_path / "x.npz")


# --- the limit --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "limit"),
    [
        ("20GB", RecordLimit(20 * 10**9)),
        ("1.5TB, 7d", RecordLimit(15 * 10**11, 7 * 86400)),
        ("12h,300MB", RecordLimit(300 * 10**6, 12 * 3600)),
    ],
)
def test_a_limit_is_a_size_an_age_or_both(text: str, limit: RecordLimit) -> None:
    assert RecordLimit.of(text) == limit


@pytest.mark.parametrize(
    "text", ["", "20", "20 gigabytes", "-1GB", "0GB", "1GB,2GB", "7d,8h", "nanGB", "1e3GB", "20GiB"]
)
def test_what_is_no_limit_is_refused(text: str) -> None:
    with pytest.raises(ConfigError, match="should be a size, an age, or both: 20GB, 7d or 20GB,7d"):
        RecordLimit.of(text)


def test_the_oldest_calls_of_all_runs_go_and_the_log_says_so(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO")
    first = Recorder(tmp_path, {})
    for number in range(3):
        first.put({"n": number}, RESULT, size=1)
    first.close()
    size = (first.folder / "000000.npz").stat().st_size
    (first.folder / "notes.txt").write_text("mine")
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "000000.npz").write_bytes(bytes(10 * size))  # of no recording: there is no manifest
    counted: list[str] = []
    second = Recorder(tmp_path, {}, count=counted.append, limit=RecordLimit(int(3.5 * size)))
    for number in range(3, 5):
        second.put({"n": number}, RESULT, size=1)
    second.close()
    assert sorted(counted) == ["removed", "removed", "written", "written"]
    assert [obs["n"] for obs, _ in iter_recording(first.folder)] == [2]
    assert [obs["n"] for obs, _ in iter_recording(second.folder)] == [3, 4]
    assert (first.folder / "notes.txt").exists() and (tmp_path / "other" / "000000.npz").exists()
    assert "--record-limit: the 2 oldest recorded calls (0 MB) were removed; 3 calls (0 MB) are left" in caplog.text


def test_calls_beyond_an_age_go_and_the_newest_one_stays(tmp_path: Path) -> None:
    run = tmp_path / "run"
    run.mkdir()
    (run / "manifest.json").write_text("{}")
    for number, days in enumerate((9, 8, 1)):
        file = run / f"{number:06d}.npz"
        file.write_bytes(b"x")
        moment = time.time() - 86400 * days
        os.utime(file, (moment, moment))
    trimmed = Trimmed(tmp_path, RecordLimit(seconds=7 * 86400))
    assert trimmed.trim() == 2 and [file.name for file in run.glob("*.npz")] == ["000002.npz"]
    assert Trimmed(tmp_path, RecordLimit(bytes=0, seconds=1)).trim() == 0
