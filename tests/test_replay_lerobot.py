"""LeRobotDatasets as `turbopi replay` reads them, beside LeRobot's own reader where LeRobot is installed."""

import json
import os
import subprocess
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from checkpoint_helpers import lerobot_copy, write_json
from cli_helpers import turbopi
from lerobot_datasets import Recorded, write_dataset
from replay_data import EVERY, write_frames

from turbopi.policy.policy import UnifiedPolicy
from turbopi.policy.shipped import SMALL_POLICY
from turbopi.replay.document import ReplayDocument
from turbopi.replay.lerobot_dataset import LeRobotDataset
from turbopi.replay.opening import open_dataset
from turbopi.replay.page import DOCUMENT
from turbopi.replay.run import Replay, Settings, select
from turbopi.support.errors import ConfigError, ObservationError
from turbopi.support.reading import read_document

_ABSENT = [name for name in ("pyarrow", "av") if find_spec(name) is None]
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(bool(_ABSENT), reason=f"needs {' and '.join(_ABSENT)}: scripts/setup replay"),
]
REPOSITORY = Path(__file__).parents[1]
LEROBOT = Path(os.environ.get("TURBOPI_LEROBOT_PYTHON", REPOSITORY / ".venv-lerobot" / "bin" / "python")).absolute()
TOP, SIDE = "observation.images.top", "observation.images.side"
NAMES = ["shoulder.pos", "elbow.pos", "gripper.pos"]
LAYOUTS = [("v2.1", False), ("v2.1", True), ("v3.0", False), ("v3.0", True)]


def episodes() -> list[Recorded]:
    """Five, of 11 to 15 steps and of two tasks. A frame's colour says which one it is."""
    random = np.random.default_rng(5)
    found = []
    for number in range(5):
        count = 11 + number
        greys = np.array([[[[15 * step + 3 * number]]] for step in range(count)], np.uint8)
        images = {
            TOP: np.broadcast_to(greys, (count, 64, 96, 3)),
            SIDE: np.broadcast_to(255 - greys, (count, 64, 64, 3)),
        }
        numbers = {
            "observation.state": random.standard_normal((count, 3)),
            "action": random.standard_normal((count, 3)),
        }
        found.append(Recorded(f"task {number % 2}", images, numbers))
    return found


@pytest.mark.parametrize(("version", "videos"), LAYOUTS)
@pytest.mark.parametrize("every", [1, 4])
def test_every_step_is_read_as_it_was_written(tmp_path: Path, version: str, videos: bool, every: int) -> None:
    truth = episodes()
    names = {"action": NAMES}
    data = open_dataset(
        write_dataset(tmp_path / "data", truth, version=version, videos=videos, chunks_size=2, names=names)
    )
    assert isinstance(data, LeRobotDataset) and data.kind == f"LeRobotDataset {version}" and data.fps == 10
    assert data.action_names == tuple(NAMES)
    assert [episode.length for episode in data.episodes] == [one.length for one in truth]
    for episode, one in zip(data.episodes, truth, strict=True):
        for moment in data.moments(episode, range(0, episode.length, every), 4):
            step, observation = moment.step, moment.observation
            assert observation["prompt"] == one.task
            state = one.numbers["observation.state"][step].astype(np.float32)
            np.testing.assert_array_equal(observation["observation.state"], state)
            actions = one.numbers["action"].astype(np.float32)
            np.testing.assert_array_equal(moment.recorded, actions[step : step + 4])
            if step:
                np.testing.assert_array_equal(moment.previous, actions[step - 1])
            for key in (TOP, SIDE):
                away = np.abs(observation[key].astype(int) - one.images[key][step])
                assert observation[key].shape == one.images[key][step].shape and away.max() <= (4 if videos else 0)
    assert data.notes == []


def test_a_gap_in_a_video_is_jumped_over(tmp_path: Path) -> None:
    count = 100
    greys = np.array([[[[2 * step]]] for step in range(count)], np.uint8)
    numbers = {"observation.state": np.zeros((count, 3)), "action": np.zeros((count, 3))}
    one = Recorded("wait", {TOP: np.broadcast_to(greys, (count, 32, 32, 3))}, numbers)
    data = open_dataset(write_dataset(tmp_path / "data", [one, one], videos=True))
    for step, found in zip((1, 2, 50, 99), data.moments(data.episodes[1], (1, 2, 50, 99), 1), strict=True):
        assert abs(int(found.observation[TOP].mean()) - 2 * step) <= 1


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
def test_the_small_policy_is_right_on_its_frames_as_a_dataset(tmp_path: Path, version: str) -> None:
    report = tmp_path / "report"
    ran = turbopi(
        *("replay", write_frames(tmp_path / "data", version), SMALL_POLICY, "--every", EVERY, "--steps", 2),
        *("--device", "cpu", "--changed", 0, "--report", report),
    )
    assert ran.exit_code == 0, ran.output
    assert "key: observation.images.wrist_image -> observation/wrist_image" in ran.output
    written = read_document(report / DOCUMENT, ReplayDocument)
    assert written.verdict.level == "follows" and written.dataset.fps == 10


class Letters:
    """A tokenizer: a token a letter."""

    def encode(self, text: str, add_bos: bool) -> list[int]:
        return [2, *(ord(letter) % 500 for letter in text)]


def test_a_lerobot_checkpoints_keys_fit_as_they_are(tmp_path: Path) -> None:
    """A third camera isn't read, which is noted."""
    count, image = 12, np.zeros((12, 32, 32, 3), np.uint8)
    images = {f"observation.images.{name}": image for name in ("image", "image2", "side")}
    random = np.random.default_rng(0)
    numbers = {"observation.state": random.standard_normal((count, 8)), "action": random.standard_normal((count, 7))}
    data = open_dataset(write_dataset(tmp_path / "data", [Recorded("tidy up", images, numbers)]))
    checkpoint = lerobot_copy(tmp_path / "checkpoint")
    write_json(checkpoint / "turbopi.json", {"vision_heads": 4})
    policy = UnifiedPolicy(checkpoint, device="cpu", precision="f32", tokenizer=Letters())
    replay = Replay(policy, data, data.episodes, Settings({}, changed=0))
    assert replay.keys.described == [] and replay.keys.prompt == "task"
    assert replay.notes == ["cameras of the dataset that the policy doesn't read: observation.images.side"]
    found = replay.run(select(data.episodes, 6, 1), lambda: None)
    assert found.predicted.shape == (2, 30, 7) and np.isfinite(found.recorded[1]).sum() == 6 * 7


# --- what isn't as info.json says -------------------------------------------------------------------------------------


def changed(folder: Path, name: str, change: dict[str, Any]) -> None:
    content = json.loads((folder / name).read_text())
    (folder / name).write_text(json.dumps(content | change))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"codebase_version": "v1.6"}, "codebase_version is 'v1.6'; v2.0, v2.1 and v3.0 are read"),
        ({"fps": 0}, "fps is 0; expected"),
        ({"fps": 25}, "info.json says 25 frames a second, but the steps of episode 0 are 0.1 s apart"),
        ({"data_path": "data/{whatever}.parquet"}, "data_path is .*expected fields"),
        ({"data_path": "../{chunk_index}.parquet"}, "isn't in"),
        ({"data_path": "data/{chunk_index}.parquet"}, "isn't there.*is the download complete"),
        ({"features": {"observation.state": {"dtype": "float32"}}}, "no feature is called action"),
    ],
    ids=lambda value: "" if isinstance(value, str) else next(iter(value)),
)
def test_what_info_json_says_wrongly_is_named(tmp_path: Path, change: dict[str, Any], said: str) -> None:
    folder = write_dataset(tmp_path / "data", episodes()[:1])
    changed(folder, "meta/info.json", change)
    with pytest.raises(ObservationError, match=said):
        read_first(folder)


def read_first(folder: Path) -> None:
    data = open_dataset(folder)
    list(data.moments(data.episodes[0], [0], 2))


def test_a_damaged_file_is_named(tmp_path: Path) -> None:
    folder = write_dataset(tmp_path / "data", episodes()[:2], videos=True)
    data = open_dataset(folder)
    (video,) = folder.glob(f"videos/{TOP}/*/*.mp4")
    whole = video.read_bytes()
    for content in (b"", whole[: len(whole) // 2], bytes(len(whole))):
        video.write_bytes(content)
        with pytest.raises(ObservationError, match=r"file-000\.mp4"):
            list(data.moments(data.episodes[0], [0, 9], 2))
    (table,) = folder.glob("data/*/*.parquet")
    table.write_bytes(table.read_bytes()[:-20])
    with pytest.raises(ObservationError, match=r"file-000\.parquet isn't a readable parquet file"):
        read_first(folder)


def test_a_video_that_ends_too_early_is_named(tmp_path: Path) -> None:
    truth = episodes()[:1]
    folder = write_dataset(tmp_path / "data", truth, videos=True)
    short = Recorded("task 0", {key: images[:6] for key, images in truth[0].images.items()}, truth[0].numbers)
    write_dataset(tmp_path / "short", [short], videos=True)
    (video,) = folder.glob(f"videos/{TOP}/*/*.mp4")
    (other,) = (tmp_path / "short").glob(f"videos/{TOP}/*/*.mp4")
    video.write_bytes(other.read_bytes())
    data = open_dataset(folder)
    with pytest.raises(ObservationError, match=r"has no frame at 0\.8000 s \(it ends before\)"):
        list(data.moments(data.episodes[0], [0, 8], 2))


def test_statistics_of_other_data_are_noted(tmp_path: Path) -> None:
    folder = write_dataset(tmp_path / "data", episodes()[:1])
    stats = json.loads((folder / "meta/stats.json").read_text())
    for low, noted in (([-0.1] * 3, True), ([[-0.1], 1, 2], False), (None, False)):
        stats["action"] |= {"min": low, "max": [0.1] * 3}
        (folder / "meta/stats.json").write_text(json.dumps(stats))
        data = open_dataset(folder)
        list(data.moments(data.episodes[0], [0], 2))
        assert len(data.notes) == noted, "what are no statistics is left alone"
        assert all("meta/ says that action 0 ranges from -0.1 to 0.1" in note for note in data.notes)


def test_a_folder_of_datasets_is_refused(tmp_path: Path) -> None:
    write_dataset(tmp_path / "one", episodes()[:1])
    with pytest.raises(ConfigError, match="a folder of datasets; give one of them, such as"):
        open_dataset(tmp_path)


# --- LeRobot itself ---------------------------------------------------------------------------------------------------

_READ = """
import sys
import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset
folder, out, *backend = sys.argv[1:]
data = LeRobotDataset("local/data", root=folder, **({"video_backend": backend[0]} if backend else {}))
found = {}
for row in range(len(data)):
    one = data[row]
    where = f"{int(one['episode_index'])}/{int(one['frame_index'])}"
    for key in ("observation.images.top", "observation.state", "action"):
        found[f"{where}/{key}"] = one[key].numpy()
    found[f"{where}/prompt"] = np.array(one["task"])
np.savez(out, **found)
"""


def lerobot(*words: object) -> None:
    if not LEROBOT.is_file():
        hint = f"LeRobot isn't installed at {LEROBOT}; scripts/lerobot_env installs it (about 3 GB)"
        if os.environ.get("TURBOPI_REQUIRE_LEROBOT"):
            pytest.fail(hint)
        pytest.skip(hint)
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"} | {"HF_HUB_OFFLINE": "1"}
    ran = subprocess.run([LEROBOT, *map(str, words)], capture_output=True, text=True, env=environment, timeout=600)
    assert ran.returncode == 0, ran.stderr[-4000:]


@pytest.mark.parametrize(("version", "videos"), LAYOUTS)
def test_lerobot_reads_the_same(tmp_path: Path, version: str, videos: bool) -> None:
    """LeRobot reads v3.0, and brings v2.1 there with its own converter: frames and numbers are the same to the bit."""
    folder = write_dataset(tmp_path / "data", episodes(), version=version, videos=videos, chunks_size=2)
    before = open_dataset(folder)
    first = list(before.moments(before.episodes[1], range(12), 1))
    if version == "v2.1":
        converter = ("-m", "lerobot.scripts.convert_dataset_v21_to_v30", "--repo-id=local/data", "--push-to-hub=false")
        lerobot(*converter, f"--root={folder}")
        assert open_dataset(folder).kind == "LeRobotDataset v3.0"
    lerobot("-c", _READ, folder, tmp_path / "theirs.npz", *(["pyav"] if videos else []))
    data = open_dataset(folder)
    with np.load(tmp_path / "theirs.npz") as theirs:
        for episode in data.episodes:
            for moment in data.moments(episode, range(episode.length), 1):
                where = f"{episode.number}/{moment.step}/"
                image = (theirs[where + TOP].transpose(1, 2, 0) * 255).round().astype(np.uint8)
                np.testing.assert_array_equal(moment.observation[TOP], image)
                np.testing.assert_array_equal(
                    moment.observation["observation.state"], theirs[f"{where}observation.state"]
                )
                np.testing.assert_array_equal(moment.recorded[0], theirs[f"{where}action"])
                assert moment.observation["prompt"] == str(theirs[f"{where}prompt"])
                if episode.number == 1:
                    np.testing.assert_array_equal(moment.observation[TOP], first[moment.step].observation[TOP])
