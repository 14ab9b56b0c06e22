"""Films show the chunk that is carried out, from the step at which it takes over, and what happened meanwhile."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from turbopi.evaluate.episode import Execution, NoActions, run_episode
from turbopi.evaluate.frames import Frame, lengths
from turbopi.evaluate.plan import Job
from turbopi.evaluate.video import CARRIED_OUT, MEANWHILE, chunk_groups, draw_frame, write_video
from turbopi.sim.base import Task

TASK = Task(0, "count", "count", 10, 30)
GROUPS = chunk_groups("libero", 7)


class Counter:
    """A world that counts its steps and shows the count."""

    def __init__(self) -> None:
        self.steps = 0

    def reset(self, initial_state: int) -> None:
        self.steps = 0

    def observation(self) -> dict[str, Any]:
        return {"image": self.draw()[0]}

    def step(self, action: np.ndarray, look: bool) -> bool:
        self.steps += 1
        return False

    def draw(self) -> list[np.ndarray]:
        return [np.full((2, 2, 3), self.steps, np.uint8)]

    def close(self) -> None:
        pass


def on_frame(way: str, delay: int, *, steps: int, smooth: bool = False, bad_at: int = -1) -> list[Frame]:
    """Chunks whose row i is 100 * (when it was asked) + i, asked for every 4 actions."""

    def ask(step: int, observation: dict[str, Any], arguments: Mapping[str, Any]) -> dict[str, Any]:
        chunk = np.repeat(100.0 * step + np.arange(12.0)[:, None], 7, axis=1)
        if step == bad_at:
            chunk[3] = np.nan
        return {"actions": chunk, "model_actions": chunk.astype(np.float32)}

    frames: list[Frame] = []
    execution = Execution(way, 4, delay, lambda last: np.full(7, -1.0))
    keys = ("image",)
    run_episode(
        Counter(), Job(TASK, 0), ask, execution, max_steps=steps, image_keys=keys, on_frame=frames.append, smooth=smooth
    )
    assert all(frame.camera_images[0][0, 0, 0] == frame.step for frame in frames)
    return frames


def seen(frames: list[Frame]) -> list[tuple[int, int, int, int, int]]:
    """Of each frame: its step, when its chunk was asked for, and its rows."""
    return [(frame.step, int(frame.chunk[0, 0]) // 100, frame.entered, frame.planned, frame.done) for frame in frames]


def test_without_a_delay_each_look_shows_the_chunk_that_it_asked_for() -> None:
    frames = on_frame("async", 0, steps=10)
    assert seen(frames) == [(0, 0, 0, 4, 0), (4, 4, 0, 4, 0), (8, 8, 0, 2, 0), (10, 8, 0, 2, 2)]
    assert not any(frame.note or len(frame.before) for frame in frames)


@pytest.mark.parametrize("way", ["async", "rtc", "rtc_trained"])
def test_a_chunk_is_shown_from_the_step_at_which_it_takes_over(way: str) -> None:
    frames = on_frame(way, 2, steps=12)
    assert seen(frames) == [
        *((0, 0, 0, 6, 0), (4, 0, 0, 6, 4)),  # looks: the chunk that runs is the one that was asked for before
        *((6, 4, 2, 6, 2), (8, 4, 2, 6, 4)),
        *((10, 8, 2, 4, 2), (12, 8, 2, 4, 4)),
    ]
    assert [frame.note for frame in frames] == ["", "the next chunk is computed"] * 2 + ["", ""]
    assert frames[2].before[:, 0].tolist() == [4, 5]  # what the chunk before commanded in its first two rows' steps
    assert frames[4].before[:, 0].tolist() == [404, 405]


def test_a_robot_that_stands_still_is_said_to() -> None:
    frames = on_frame("sync", 2, steps=8)
    assert seen(frames) == [(0, 0, 0, 4, 0), (4, 0, 0, 4, 4), (6, 4, 0, 2, 0), (8, 4, 0, 2, 2)]
    assert [frame.note for frame in frames] == ["", "stands still: the policy computes", "", ""]


def test_a_smooth_film_has_every_step_once() -> None:
    frames = on_frame("async", 2, steps=9, smooth=True)
    assert [frame.step for frame in frames] == list(range(10))
    assert [frame.done for frame in frames] == [0, 1, 2, 3, 4, 5, 2, 3, 4, 5]


def test_a_chunk_that_cannot_be_carried_out_is_shown_at_the_end() -> None:
    frames = on_frame("async", 0, steps=10, bad_at=4)
    assert [frame.step for frame in frames] == [0, 4]
    assert np.isnan(frames[1].chunk[3]).all() and (frames[1].planned, frames[1].done) == (0, 0)


def test_a_film_of_no_actions_at_all_can_be_drawn() -> None:
    frames: list[Frame] = []

    def ask(step: int, observation: dict[str, Any], arguments: Mapping[str, Any]) -> dict[str, Any]:
        raise NoActions("none")

    run_episode(
        Counter(), Job(TASK, 0), ask, Execution("sync", 4), max_steps=5, image_keys=("image",), on_frame=frames.append
    )
    assert [frame.step for frame in frames] == [0]
    assert draw_frame(frames[0], "x", chunk_groups("libero", 1), "aborted").ndim == 3


def test_the_delay_is_drawn_apart_from_what_is_carried_out() -> None:
    def colored(frame: Frame, color: tuple[int, int, int]) -> int:
        drawn = draw_frame(frame, "x", GROUPS, None, delayed=True)
        return int((drawn == color).all(axis=2).sum())

    camera_image, chunk, before = [np.zeros((8, 8, 3), np.uint8)] * 2, np.zeros((12, 7)), np.ones((2, 7))
    plain, delayed = Frame(6, camera_image, chunk, 6, 2), Frame(6, camera_image, chunk, 6, 2, 2, before)
    assert colored(plain, MEANWHILE) == 0 < colored(delayed, MEANWHILE)
    assert 0 < colored(delayed, CARRIED_OUT) < colored(plain, CARRIED_OUT)
    moved = Frame(6, camera_image, chunk, 6, 2, 2, -before)
    assert (draw_frame(delayed, "x", GROUPS, None) != draw_frame(moved, "x", GROUPS, None)).any()


def test_frames_last_until_the_next_one(tmp_path: Path) -> None:
    imageio = pytest.importorskip("imageio.v2", reason="pip install 'imageio[ffmpeg]'")
    frames = on_frame("async", 2, steps=12)
    assert lengths(frames) == [4, 2, 2, 2, 2, 2]
    write_video(tmp_path / "a.mp4", frames, "x", "success", "libero", 20.0)
    with imageio.get_reader(tmp_path / "a.mp4") as reader:
        fps = reader.get_meta_data()["fps"]
        assert reader.count_frames() / fps == pytest.approx(12 / 20 + 2 / 20 + 1.5)  # the end's own, and its rest
