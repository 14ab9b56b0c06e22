"""`turbopi view`: recordings and live servers as rerun shows them."""

import base64
import io
import json
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cli_helpers import refusal, turbopi
from PIL import Image
from serve_fakes import FakePolicy, observation
from websockets.sync.client import connect
from websockets.sync.server import serve

from turbopi import view
from turbopi.realtime.wire import pack
from turbopi.recordings import RecordedCall, save_call
from turbopi.serve import PolicyServer, running
from turbopi.support.errors import ConfigError, ObservationError
from turbopi.view.calls import ViewedCall, ViewedTrouble
from turbopi.view.live import LiveServer
from turbopi.view.recorded import policy_of, recorded
from turbopi.view.viewer import COMMAND, Viewer, open_viewer

with_rerun = pytest.mark.skipif(find_spec("rerun") is None, reason="needs rerun: pip install -e '.[view]'")
RANDOM = np.random.default_rng(27)
STARTED = 1_790_000_000.25
H = 10


def call(number: int) -> RecordedCall:
    """The robot asks every 0.2 s."""
    return RecordedCall(
        observation={
            "observation/image": RANDOM.integers(0, 256, (12, 16, 3), np.uint8),
            "observation/wrist_image": RANDOM.random((3, 8, 9)).astype(np.float32),
            "observation/state": RANDOM.standard_normal(8).astype(np.float32),
            "prompt": "open the drawer" if number < 3 else "close it",
        },
        result={
            "actions": RANDOM.standard_normal((H, 7)),
            "policy_timing": {"vision_ms": 1.5 + number, "total_ms": 7.25 + number},
            "server_timing": {"infer_ms": 8.5 + number, "prev_total_ms": 20.0},
        },
        time=STARTED + 0.2 * number,
    )


@pytest.fixture
def recording(tmp_path: Path) -> tuple[Path, dict[int, RecordedCall]]:
    """One run of calls 0, 1, 2, 4 and 5; call 3 wasn't written."""
    folder = tmp_path / "recordings" / "20260131T093000Z"
    folder.mkdir(parents=True)
    (folder / "manifest.json").write_text(json.dumps({"metadata": {"robot": "libero"}}))
    calls = {number: call(number) for number in (0, 1, 2, 4, 5)}
    for number, one in calls.items():
        save_call(folder / f"{number:06d}.npz", one)
    return folder, calls


# --- recordings -------------------------------------------------------------------------------------------------------


def test_a_recordings_calls_are_viewed_as_they_were(recording: tuple[Path, dict[int, RecordedCall]]) -> None:
    folder, calls = recording
    for path in (folder, folder.parent):
        assert policy_of(path)["robot"] == "libero"
        viewed = [one for one in recorded(path) if isinstance(one, ViewedCall)]
        assert [one.number for one in viewed] == [1, 2, 3, 5, 6]
        for one, (number, truth) in zip(viewed, calls.items(), strict=True):
            assert (one.time, one.prompt) == (truth.time, truth.observation["prompt"])
            np.testing.assert_array_equal(one.actions, truth.result["actions"])
            np.testing.assert_array_equal(one.numbers["observation/state"], truth.observation["observation/state"])
            assert one.timing == {"vision": 1.5 + number, "total": 7.25 + number, "server": 8.5 + number}
            camera_image = np.asarray(Image.open(io.BytesIO(one.camera_images["observation/image"].data)))
            np.testing.assert_array_equal(camera_image, truth.observation["observation/image"])
            small = np.asarray(Image.open(io.BytesIO(one.camera_images["observation/wrist_image"].data)))
            given = truth.observation["observation/wrist_image"].transpose(1, 2, 0)
            np.testing.assert_allclose(small / 255, given, atol=0.5 / 255 + 1e-6)


def test_gaps_and_damaged_calls_are_told(recording: tuple[Path, dict[int, RecordedCall]]) -> None:
    folder, calls = recording
    damaged = bytearray((folder / "000001.npz").read_bytes())
    damaged[len(damaged) // 2] ^= 0xFF
    (folder / "000001.npz").write_bytes(damaged)
    broken, gap = (one for one in recorded(folder) if isinstance(one, ViewedTrouble))
    assert broken.serious and "000001.npz" in broken.text and broken.time == calls[0].time
    assert gap == ViewedTrouble(calls[4].time, "1 call is missing before 000004.npz", serious=False)
    assert [one.number for one in recorded(folder) if isinstance(one, ViewedCall)] == [1, 3, 5, 6]
    with pytest.raises(ObservationError, match="000001"):
        list(recorded(folder / "000001.npz"))
    with pytest.raises(ObservationError, match="holds no recording"):
        list(recorded(folder.parent.parent))


# --- live servers -----------------------------------------------------------------------------------------------------


class Arm(FakePolicy):
    def __init__(self) -> None:
        super().__init__()
        self.metadata |= {"robot": "libero", "robot_action_dim": 7}

    def infer(self, obs: dict[str, Any]) -> dict[str, Any]:
        actions = np.full((H, 7), 0.25)
        actions[0, 0] = 0.5
        return {**super().infer(obs), "actions": actions, "policy_timing": {"infer_ms": 2.0}}


@contextmanager
def requesting(server: PolicyServer) -> Iterator[None]:
    """A robot that asks on and on, once wrongly."""
    done = threading.Event()
    camera_image = np.full((20, 30, 3), 99, np.uint8)

    def run() -> None:
        with connect(server.url, compression=None) as robot:
            robot.recv()
            robot.send(pack({"prompt": "lacks its state"}))
            robot.recv()
            while not done.wait(0.02):
                robot.send(pack(observation("go on") | {"front": camera_image}))
                robot.recv()

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join(60)


def test_a_live_servers_calls_and_errors_are_viewed() -> None:
    with running(Arm()) as server, requesting(server):
        watched = LiveServer(server.url.replace("ws://", "http://"))
        try:
            assert watched.hello.policy["robot"] == "libero"
            calls, troubles = list[ViewedCall](), list[ViewedTrouble]()
            for one in watched.watch():
                calls += [one] if isinstance(one, ViewedCall) else []
                troubles += [one] if isinstance(one, ViewedTrouble) else []
                if len(calls) == 3:
                    break
        finally:
            watched.close()
    first = calls[0]
    assert first.robot.startswith("127.0.0.1:") and first.prompt == "go on"
    assert sorted({one.number for one in calls}) == [one.number for one in calls]
    assert first.actions is not None and first.actions[0, 0] == 0.5 and (first.actions[1:] == 0.25).all()
    np.testing.assert_array_equal(first.numbers["observation/state"], observation()["observation/state"])
    assert np.asarray(Image.open(io.BytesIO(first.camera_images["front"].data))).shape == (20, 30, 3)
    assert first.timing["infer"] == 2.0
    (trouble,) = troubles  # once, though every frame has it
    assert trouble.serious and "observation/state" in trouble.text


def test_watching_ends_with_the_server_and_after_its_time() -> None:
    with running(Arm()) as server:
        watched = LiveServer(server.url)
        assert list(watched.watch(seconds=0.5)) == []
    assert list(watched.watch()) == []
    watched.close()


def test_a_server_that_cannot_be_watched_says_why() -> None:
    with running(Arm(), api_key="k") as server:
        with pytest.raises(ConfigError, match="wants its API key"):
            LiveServer(server.url)
        with pytest.raises(ConfigError, match="wants its API key"):
            LiveServer(server.url, "wrong")
        LiveServer(server.url, "k").close()
    with pytest.raises(ConfigError, match="Is `turbopi serve` running there"):
        LiveServer(server.url, "k")
    with running(Arm(), page=False) as server, pytest.raises(ConfigError, match="page is off; --page"):
        LiveServer(server.url)
    for url in ("ftp://a", "http://", "http://a:b", "http://me@a", "http://[::1"):
        with pytest.raises(ConfigError, match="no address"):
            LiveServer(url)


@pytest.mark.parametrize(
    "said",
    [b"\x80", "{}", "nonsense", '{"kind": "hello", "feed": 99, "turbopi": "9", "started": 0, "queue_limit": 1, '
     '"policy": {}, "actions": []}'],
    ids=["a policy", "empty", "no JSON", "another version"],
)  # fmt: skip
def test_another_servers_feed_is_refused(said: bytes | str) -> None:
    with serve(lambda client: client.send(said), "127.0.0.1", 0) as other:
        threading.Thread(target=other.serve_forever, daemon=True).start()
        with pytest.raises(ConfigError, match="isn't a server of this Turbo-Pi's version"):
            LiveServer(f"ws://127.0.0.1:{other.socket.getsockname()[1]}")


# --- the command ------------------------------------------------------------------------------------------------------


def test_without_rerun_the_command_says_what_to_install(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(view, "find_spec", lambda name: None)
    said = refusal(turbopi("view", tmp_path, "--save", tmp_path / "a.rrd"))
    assert "rerun isn't installed" in said and said.endswith("[view]'")


def test_a_file_that_no_viewer_would_know_is_refused(tmp_path: Path) -> None:
    assert "ends in .rrd" in refusal(turbopi("view", tmp_path, "--save", tmp_path / "a.png"))
    assert "no folder" in refusal(turbopi("view", tmp_path, "--save", tmp_path / "b" / "a.rrd"))


LISTENS = """
import socket, sys
with socket.create_server(("127.0.0.1", int(sys.argv[-1].removeprefix("--port=")))) as here:
    here.accept()
"""


def test_the_viewer_listens_on_this_machine_alone() -> None:
    assert "--bind=127.0.0.1" in COMMAND
    opened = open_viewer([sys.executable, "-c", LISTENS])
    assert opened.process.wait(60) == 0
    assert isinstance(opened.process.args, list)
    port = opened.process.args[-1].removeprefix("--port=")
    assert opened.address == f"rerun+http://127.0.0.1:{port}/proxy"


def test_a_viewer_that_cannot_open_says_so() -> None:
    with pytest.raises(ConfigError, match=r"exit code 3: it needs a screen. --save FILE.rrd"):
        open_viewer([sys.executable, "-c", "raise SystemExit(3)"])


def read_back(file: Path) -> dict[str, list[dict[str, Any]]]:
    """{entity: rows}, in the order of "call", then "time"; what is static has neither."""
    from rerun.chunk import RrdReader

    (store,) = RrdReader(file).recordings()
    assert store.application_id == "turbopi"
    found: dict[str, list[dict[str, Any]]] = {}
    for chunk in RrdReader(file).stream().to_chunks():
        batch = chunk.to_record_batch()
        columns = {
            name: (column.cast("int64") if str(column.type).startswith("timestamp") else column).to_pylist()
            for name, column in zip(batch.schema.names, batch.columns, strict=True)
        }
        rows = found.setdefault(chunk.entity_path, [])
        rows += [dict(zip(columns, values, strict=True)) for values in zip(*columns.values(), strict=True)]
    return {
        entity: sorted(rows, key=lambda row: (row.get("call", 0), row.get("time", 0))) for entity, rows in found.items()
    }


def at(row: dict[str, Any]) -> float:
    """The row's time in seconds since 1970; rerun has nanoseconds."""
    return float(row["time"] / 1e9)


@pytest.mark.slow
@with_rerun
def test_a_saved_recording_holds_what_was_recorded(
    recording: tuple[Path, dict[int, RecordedCall]], tmp_path: Path
) -> None:
    folder, calls = recording
    file = tmp_path / "out.rrd"
    ended = turbopi("view", folder, "--save", file, "--rate", 20, "--json")
    assert ended.exit_code == 0, ended.output
    assert json.loads(ended.stdout) == {"calls": 5, "troubles": 1, "saved": str(file)}
    found = read_back(file)
    numbers = [number + 1 for number in calls]
    times = [one.time for one in calls.values()]

    def rows(entity: str) -> list[dict[str, Any]]:
        return [row for row in found[entity] if "time" in row]

    logged = ["/cameras/observation/image", "/cameras/observation/wrist_image", "/state/observation/state"]
    logged += [f"/latency/{stage}" for stage in ("vision", "total", "server")]
    logged += [f"/chunk/{part}" for part in ("values", "translation", "rotation", "gripper")]
    for entity in logged:
        assert [row["call"] for row in rows(entity)] == numbers, entity
        np.testing.assert_allclose([at(row) for row in rows(entity)], times, rtol=0, atol=1e-6)
    for position, one in enumerate(calls.values()):
        (blob,) = rows("/cameras/observation/image")[position]["EncodedImage:blob"]
        data = blob if isinstance(blob, bytes) else bytes(blob)
        np.testing.assert_array_equal(np.asarray(Image.open(io.BytesIO(data))), one.observation["observation/image"])
        state = rows("/state/observation/state")[position]["Scalars:scalars"]
        np.testing.assert_array_equal(state, one.observation["observation/state"])
        (tensor,) = rows("/chunk/values")[position]["Tensor:data"]
        assert tensor["shape"] == [H, 7]
        np.testing.assert_array_equal(np.reshape(tensor["buffer"], (H, 7)), one.result["actions"])
        strips = np.array(rows("/chunk/translation")[position]["LineStrips2D:strips"])
        assert strips.shape == (3, H, 2)
        np.testing.assert_allclose(1 - 2 * strips[..., 1] / 60, one.result["actions"][:, :3].T, atol=1e-5)
    latencies = [row["Scalars:scalars"] for row in rows("/latency/server")]
    assert latencies == [[8.5 + number] for number in calls]
    assert [row["TextDocument:text"] for row in rows("/prompt")] == [["open the drawer"], ["close it"]]
    (error,) = rows("/errors")
    assert "before 000004.npz" in error["TextLog:text"][0] and error["TextLog:level"] == ["WARN"]

    # executed: at 20 Hz four actions until the next call comes, and all of the last one's. After call 2 one is missing
    executed = rows("/executed/gripper")
    expected = [(number, step) for number in (0, 1, 4) for step in range(4)] + [(5, step) for step in range(H)]
    assert len(executed) == len(expected)
    for row, (number, step) in zip(executed, expected, strict=True):
        assert at(row) == pytest.approx(calls[number].time + step / 20, abs=1e-6)
        assert row["Scalars:scalars"] == [calls[number].result["actions"][step, 6]]
    (names,) = (row for row in found["/executed/translation"] if "SeriesLines:names" in row)
    assert names["SeriesLines:names"] == ["x", "y", "z"]


@pytest.mark.slow
@with_rerun
def test_without_a_rate_no_action_is_said_to_be_executed(
    recording: tuple[Path, dict[int, RecordedCall]], tmp_path: Path
) -> None:
    assert turbopi("view", recording[0], "--save", tmp_path / "out.rrd").exit_code == 0
    assert not any(entity.startswith("/executed") for entity in read_back(tmp_path / "out.rrd"))


@pytest.mark.slow
@with_rerun
def test_a_live_server_is_saved_below_each_robots_address(tmp_path: Path) -> None:
    file = tmp_path / "live.rrd"
    with running(Arm()) as server, requesting(server):
        ended = turbopi("view", server.url, "--save", file, "--seconds", 3, "--json")
    assert ended.exit_code == 0, ended.output
    reported = json.loads(ended.stdout)
    assert reported["calls"] > 0 and reported["troubles"] == 1
    found = read_back(file)
    (camera,) = (entity for entity in found if entity.endswith("/cameras/front"))
    assert camera.replace("\\", "").startswith("/127.0.0.1:")
    assert len(found[camera]) == reported["calls"]
    assert base64.b64encode(bytes(found[camera][0]["EncodedImage:blob"][0])).startswith(b"/9j/")  # a JPEG
    assert len(found["/errors"]) == 1


@pytest.mark.slow
@with_rerun
@pytest.mark.filterwarnings("ignore:RRD file has no footer")  # it is still being written
def test_a_viewer_gets_the_whole_recording(
    recording: tuple[Path, dict[int, RecordedCall]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Over the connection that a viewer has; this one writes what it gets instead of showing it."""
    from turbopi.view import drawing

    opened: list[Viewer] = []

    def open_writer() -> Viewer:
        opened.append(open_viewer([*COMMAND, "--save", str(tmp_path / "got.rrd")]))
        return opened[0]

    monkeypatch.setattr(drawing, "open_viewer", open_writer)
    ended = turbopi("view", recording[0], "--rate", 20)
    assert ended.exit_code == 0 and "5 calls, 1 errors and gaps, shown in the viewer" in ended.output
    try:
        deadline, executed = time.monotonic() + 60, list[dict[str, Any]]()
        while len(executed) < 3 * 4 + H and time.monotonic() < deadline:  # the last of what was sent
            time.sleep(0.2)
            found = read_back(tmp_path / "got.rrd")
            executed = [row for row in found.get("/executed/gripper", []) if "time" in row]
    finally:
        opened[0].process.send_signal(signal.SIGINT)
        opened[0].process.wait(60)
    assert len(executed) == 3 * 4 + H
    assert len(found["/chunk/values"]) == len(found["/cameras/observation/image"]) == 5
