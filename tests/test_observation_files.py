"""Files that observations, noise and samples of requests are read from: damaged, hostile and absurd ones."""

import json
import os
import re
import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from turbopi.cli.files import load_noise
from turbopi.evaluate.visited import FILE, Visited
from turbopi.recordings import RecordedCall, iter_recording, load_call, load_observation, save_call
from turbopi.support.errors import ConfigError, ObservationError
from turbopi.support.reading.images import read_image

PIXELS = np.arange(48, dtype=np.uint8).reshape(4, 4, 3)


def _refused(call: Any) -> str:
    with pytest.raises(ObservationError) as caught:
        call()
    assert "\n" not in str(caught.value)
    return str(caught.value)


# -- images ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", ["png", "webp", "bmp", "ppm"])
def test_pictures_without_loss_come_back_by_their_content_not_their_name(tmp_path: Path, suffix: str) -> None:
    file = tmp_path / f"a.{suffix}"
    Image.fromarray(PIXELS).save(file, lossless=True)  # WebP's; the others have no such thing
    os.rename(file, tmp_path / "image")
    assert np.array_equal(read_image(tmp_path / "image"), PIXELS)


def test_an_eps_never_reaches_ghostscript(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Pillow would start `gs` on a file of any name that begins as PostScript."""
    started = tmp_path / "started"
    (tmp_path / "gs").write_text(f"#!/bin/sh\necho started > {started}\n")
    (tmp_path / "gs").chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
    (tmp_path / "wrist.png").write_bytes(
        b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 8 8\n%%EndComments\nshowpage\n%%EOF\n"
    )
    (tmp_path / "observation.json").write_text('{"image": {"file": "wrist.png"}}')
    message = _refused(lambda: load_observation(tmp_path))
    assert "wrist.png is neither a readable image nor .npy" in message and "PNG, JPEG" in message
    assert not started.exists()


def _png(width: int, height: int, data: bytes) -> bytes:
    def chunk(kind: bytes, content: bytes) -> bytes:
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", data) + chunk(b"IEND", b"")


@pytest.mark.parametrize("side", [10_000, 14_000, 60_000])
def test_a_decompression_bomb_is_refused_before_it_is_decoded(tmp_path: Path, side: int) -> None:
    """Up to 10 GB of pixels in a file of 80 bytes; of the second Pillow only warns, the last it refuses itself."""
    (tmp_path / "a.png").write_bytes(_png(side, side, zlib.compress(b"")))
    message = _refused(lambda: read_image(tmp_path / "a.png"))
    assert "pixels" in message


@pytest.mark.parametrize("kind", ["png", "jpeg", "webp", "bmp"])
def test_a_cut_picture_is_refused(tmp_path: Path, kind: str) -> None:
    Image.fromarray(np.random.default_rng(0).integers(0, 255, (32, 32, 3)).astype(np.uint8)).save(tmp_path / "a", kind)
    data = (tmp_path / "a").read_bytes()
    for length in (0, 1, 10, 40, len(data) // 2):
        (tmp_path / "a").write_bytes(data[:length])
        assert "is neither a readable image" in _refused(lambda: read_image(tmp_path / "a"))


def test_sixteen_bits_a_channel_are_refused_rather_than_clipped(tmp_path: Path) -> None:
    Image.fromarray(np.full((4, 4), 40_000, np.uint16)).save(tmp_path / "depth.png")
    refused = _refused(lambda: read_image(tmp_path / "depth.png"))
    assert re.search("mode I(;16)?; expected 8 bits a channel", refused), refused  # older Pillows: I


# -- observations ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "observation.json isn't JSON: it is empty"),
        (b"\xff", "isn't JSON: 'utf-8' codec"),
        (b'{"state": [1, NaN]}', "state[1] is nan, which no JSON has"),
        (b'{"state": ' + b"[" * 100_000 + b"]" * 100_000 + b"}", "more than 64 deep"),
        (b'{"state": [true, 1]}', "'state' must be a list of numbers, but holds True"),
        (b'{"state": ["1", 1]}', "'state' must be a list of numbers, but holds '1'"),
        (b'{"state": [null, 1]}', "'state' must be a list of numbers, but holds None"),
        (b'{"state": [1, 2], "state": [3, 4]}', "the key 'state' is given twice"),
        (b'{"image": {"file": null}}', "names the file None"),
        (b'{"image": {"file": "a\\u0000.png"}}', "names the file 'a\\x00.png'"),
        (b'{"image": {"file": "/etc/passwd"}}', "which isn't in"),
        (b'{"image": {"file": "x.npy", "layout": "chw"}}', "without a layout for .npy"),
    ],
)
def test_an_observation_json_that_cannot_be_right_is_refused(tmp_path: Path, content: bytes, message: str) -> None:
    (tmp_path / "observation.json").write_bytes(content)
    assert message in _refused(lambda: load_observation(tmp_path))


def test_a_link_out_of_the_folder_is_not_followed(tmp_path: Path) -> None:
    np.save(tmp_path / "secret.npy", np.zeros(3))
    folder = tmp_path / "observation"
    folder.mkdir()
    (folder / "x.npy").symlink_to(tmp_path / "secret.npy")
    (folder / "observation.json").write_text('{"state": {"file": "x.npy"}}')
    assert "which isn't in" in _refused(lambda: load_observation(folder))


def test_an_array_of_the_answer_is_not_read_with_the_observation(tmp_path: Path) -> None:
    """Its damage doesn't matter then, and neither does its size."""
    file = tmp_path / "000000.npz"
    save_call(file, RecordedCall({"state": np.ones(3)}, {"actions": np.full((2, 3), 1.25)}, 1.0))
    data = file.read_bytes()
    numbers = np.full((2, 3), 1.25).tobytes()
    assert data.count(numbers) == 1
    file.write_bytes(data.replace(numbers, numbers[:-1] + b"\0"))
    assert load_observation(file)["state"].tolist() == [1, 1, 1]
    assert "its 'result/actions' is damaged: BadZipFile Bad CRC-32" in _refused(lambda: load_call(file))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"time": None}, "the time a number"),
        ({"observation": {"list": []}}, "should be dicts"),
        ({"observation": {"dict": {"a": 1}}}, "is no value of a recording"),
        ({"observation": {"dict": [["a"]]}}, "should be pairs"),
        ({"observation": {"dict": [["a", {"value": 1}], ["a", {"value": 2}]]}}, "is there twice"),
        ({"observation": {"dict": [["a", {"value": [1]}]]}}, "is no value of a recording"),
        ({"observation": {"dict": [["a", {"bytes": "?"}]]}}, "damaged index"),
        ({"observation": {"dict": [["a", {"array": 1}]]}}, "is no value of a recording"),
        ({"observation": {"dict": [["a", {"array": "x"}]]}}, "damaged index: KeyError"),
        ({"observation": {"dict": [["a", {"scalar": "result/actions"}]]}}, "expected a single value"),
        ({"observation": None}, "should have one kind"),
        ({"version": [1]}, "of version [1]"),
    ],
)
def test_an_index_that_save_call_did_not_write_is_refused(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    file = tmp_path / "000000.npz"
    save_call(file, RecordedCall({"state": np.ones(3)}, {"actions": np.ones((2, 3))}, 1.0))
    with np.load(file) as stored:
        arrays = dict(stored)
    index = json.loads(arrays["index"].tobytes()) | change
    arrays["index"] = np.frombuffer(json.dumps(index).encode(), np.uint8)
    np.savez(file, **arrays)
    assert message in _refused(lambda: load_call(file))


@pytest.mark.parametrize("actions", ["none", None, np.ones(3), np.ones((1, 2), np.int64), [[1.0]]])
def test_recorded_actions_are_an_array(tmp_path: Path, actions: Any) -> None:
    save_call(tmp_path / "000000.npz", RecordedCall({"state": np.ones(3)}, {"actions": actions}, 1.0))
    assert "expected an array of numbers [H, d]" in _refused(lambda: list(iter_recording(tmp_path)))


# -- noise, and samples of requests ------------------------------------------------------------------------------------


@pytest.mark.parametrize("damage", ["cut", "flipped", "empty", "text", "pickle", "folder", "absurd"])
@pytest.mark.parametrize("suffix", ["npy", "npz"])
def test_damaged_noise_is_refused(tmp_path: Path, suffix: str, damage: str) -> None:
    file, noise = tmp_path / f"noise.{suffix}", np.random.default_rng(0).normal(size=(10, 32)).astype(np.float32)
    save: Any = np.save if suffix == "npy" else lambda path, array: np.savez(path, noise=array)
    save(file, noise)
    assert np.array_equal(load_noise(file), noise)
    good = file.read_bytes()
    match damage:
        case "cut":
            file.write_bytes(good[: len(good) // 2])
        case "flipped":  # in the header; damaged numbers of an .npy can't be told
            place = good.index(b"'shape'")
            file.write_bytes(good[:place] + b"\xff" + good[place + 1 :])
        case "empty" | "text":
            file.write_text("" if damage == "empty" else "noise")
        case "pickle":
            save(file, np.array([{}], object))
        case "folder":
            file.unlink()
            file.mkdir()
        case "absurd":
            save(file, np.zeros(17 * 2**20, np.uint8))
    assert _refused(lambda: load_noise(file)).startswith(f"the noise {file}")


@pytest.mark.parametrize(
    "arrays",
    [
        {"seen": np.array(2), "count": np.array(1)},
        {"seen": np.array(2), "count": np.array(10**9), "0|seed": np.array(1), "0|actions": np.ones((1, 1))},
        {"seen": np.array(0), "count": np.array(1), "0|seed": np.array(1), "0|actions": np.ones((1, 1))},
        {"seen": np.array("x"), "count": np.array(0)},
        {"seen": np.array([1, 2]), "count": np.array(0)},
        {"count": np.array(0)},
        {"seen": np.array(2), "count": np.array(2), "0|seed": np.array(1), "0|actions": np.ones((1, 1))},
    ],
)
def test_a_sample_of_requests_that_eval_did_not_write_is_refused(tmp_path: Path, arrays: dict[str, Any]) -> None:
    np.savez(tmp_path / FILE, **arrays)
    with pytest.raises(ConfigError, match=r"visited\.npz (isn't a sample|lacks)"):
        Visited(tmp_path)
    (tmp_path / FILE).write_bytes((tmp_path / FILE).read_bytes()[:-30])
    with pytest.raises(ConfigError, match=r"visited\.npz isn't a readable"):
        Visited(tmp_path)
