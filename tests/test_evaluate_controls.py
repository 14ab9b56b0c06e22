"""The controls hand on what they say: another task's prompt, or another task's images."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest

from turbopi.evaluate.controls import Controlled
from turbopi.evaluate.sources import Answer
from turbopi.support.errors import ConfigError

KEYS = ("observation/image", "observation/wrist_image")
TASKS = ["take the red one", "take the green one", "take the blue one"]


class Recorder:
    """Keeps what it is asked."""

    max_batch: int | None = None
    label = "recorder"

    def __init__(self) -> None:
        self.identity: dict[str, Any] = {"weights": "w"}
        self.about: dict[str, Any] = {}
        self.real_time: Mapping[str, Any] = {}
        self.requested: list[Any] = []

    def infer(self, observations: Any, seeds: Any, arguments: Any = None) -> list[Answer]:
        self.requested += list(observations)
        return [Answer(np.zeros((10, 7)), None) for _ in observations]

    def warm_up(self, most: int, mode: Any, tell: Any) -> None:
        self.requested.append((most, mode))

    def close(self) -> None:
        pass


def observation(task: int, brightness: int) -> dict[str, Any]:
    camera_image = np.full((8, 8, 3), brightness, np.uint8)
    return dict.fromkeys(KEYS, camera_image) | {"prompt": TASKS[task], "observation/state": np.zeros(8)}


def test_the_prompt_is_the_next_tasks_and_the_last_tasks_is_the_first() -> None:
    source = Recorder()
    Controlled(source, "prompt", TASKS * 2, KEYS).infer([observation(0, 1), observation(2, 3)], [0, 1])
    assert [one["prompt"] for one in source.requested] == [TASKS[1], TASKS[0]]
    assert [int(one[KEYS[0]][0, 0, 0]) for one in source.requested] == [1, 3]


def test_the_pictures_are_the_newest_of_the_next_task_that_was_seen() -> None:
    source = Recorder()
    controlled = Controlled(source, "pictures", TASKS, KEYS)
    controlled.infer([observation(0, 10)], [0])
    controlled.infer([observation(2, 30)], [0])
    controlled.infer([observation(2, 31), observation(1, 20), observation(0, 11)], [0, 1, 2])
    assert [int(one[KEYS[1]][0, 0, 0]) for one in source.requested] == [128, 10, 10 + 1, 31, 20]
    assert [one["prompt"] for one in source.requested] == [TASKS[0], TASKS[2], TASKS[2], TASKS[1], TASKS[0]]


def test_a_controlled_run_is_another_policy_than_the_same_without() -> None:
    source = Recorder()
    controlled = Controlled(source, "prompt", TASKS, KEYS)
    assert controlled.identity != source.identity
    assert "prompt of another task" in controlled.label


def test_the_policy_behind_a_control_is_warmed_up() -> None:
    source = Recorder()
    Controlled(source, "prompt", TASKS, KEYS).warm_up(4, "rtc", print)
    assert source.requested == [(4, "rtc")]


def test_the_images_of_one_task_alone_are_gray() -> None:
    source = Recorder()
    controlled = Controlled(source, "pictures", TASKS[:1] * 5, KEYS)
    controlled.infer([observation(0, 1), observation(0, 2)], [0, 1])
    assert {int(value) for given in source.requested for value in np.unique(given[KEYS[0]])} == {128}
    assert "gray images" in controlled.label


def test_an_unknown_prompt_passes_as_it_is() -> None:
    source = Recorder()
    example = observation(0, 5) | {"prompt": "something else"}
    Controlled(source, "pictures", TASKS, KEYS).infer([example], [0])
    assert source.requested[0]["prompt"] == "something else"
    assert int(source.requested[0][KEYS[0]].max()) == 5


@pytest.mark.parametrize(("control", "tasks"), [("prompt", TASKS[:1] * 5), ("noise", TASKS)])
def test_a_control_that_is_impossible_is_refused(control: Any, tasks: list[str]) -> None:
    with pytest.raises(ConfigError, match="control"):
        Controlled(Recorder(), control, tasks, KEYS)
