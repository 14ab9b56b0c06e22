"""Numbers and names as people read them."""

import math
import re
from pathlib import Path

import numpy as np
import pytest

from turbopi.realtime.chunk import too_far
from turbopi.support.action_groups import action_groups
from turbopi.support.text import counted, data_size, denoising, did_you_mean, kind_of, names_known, significant


@pytest.mark.parametrize(
    ("value", "shown"),
    [
        (0.04254, "0.0425"),
        (0.007, "0.00700"),
        (4.6149e-5, "4.61e-05"),
        (1e-12, "1.00e-12"),
        (0, "0"),
        (0.0, "0"),
        (1.5, "1.50"),
        (123.4, "123"),
        (12345.0, "1.23e+04"),
        (None, "not finite"),
        (math.nan, "not finite"),
        (math.inf, "not finite"),
    ],
)
def test_an_error_has_three_significant_digits_however_small(value: float | None, shown: str) -> None:
    assert significant(value) == shown


@pytest.mark.parametrize(
    ("count", "shown"),
    [
        (0, "0 bytes"),
        (999, "999 bytes"),
        (1_000, "1.0 kB"),
        (91_412, "91.4 kB"),
        (11_345_678, "11.35 MB"),
        (7_233_456_789, "7.233 GB"),
        (999_999, "1.00 MB"),
        (999_999_999, "1.000 GB"),
    ],
)
def test_a_size_has_the_unit_that_fits(count: int, shown: str) -> None:
    assert data_size(count) == shown


@pytest.mark.parametrize(
    ("typed", "question"),
    [
        ("actoin_horizon", "did you mean action_horizon?"),
        ("horizon", "did you mean action_horizon or execution_horizon?"),
        ("action_horizon_of_chunks", "did you mean action_horizon?"),
        ("o", ""),  # all contain it
        ("robto", "did you mean robot?"),
        ("qqq", ""),
        ("", ""),
    ],
)
def test_what_was_probably_meant_is_asked(typed: str, question: str) -> None:
    assert did_you_mean(typed, ["action_horizon", "execution_horizon", "robot", "robot_options"]) == question


def test_known_names_come_behind_what_was_probably_meant() -> None:
    assert names_known("robto", "keys are", ["robot", "prompt"]) == "did you mean robot? Keys are robot, prompt"
    assert names_known("qqq", "keys are", ["robot", "prompt"]) == "keys are robot, prompt"


def test_one_of_a_thing_has_no_plural() -> None:
    assert [counted(number, "step") for number in (0, 1, 2)] == ["0 steps", "1 step", "2 steps"]
    assert [denoising({"num_denoising_steps": steps}) for steps in (1, 10)] == ["1 step", "10 steps"]


def test_a_type_has_its_article() -> None:
    values: tuple[object, ...] = (7, [], {}, "a", None, object(), np.zeros(1))
    assert list(map(kind_of, values)) == ["an int", "a list", "a dict", "a str", "None", "an object", "an ndarray"]
    refusing = re.compile(r"\ba \{type\(\w+\)\.__name__\}")
    root = Path(__file__).resolve().parent.parent
    assert not [path for path in (root / "src/turbopi").rglob("*.py") if refusing.search(path.read_text())]


def test_actions_without_names_have_one_name_everywhere() -> None:
    (group,) = action_groups("arm", 3)
    assert list(group.names.values()) == ["action 0", "action 1", "action 2"]
    moved = too_far(np.array([[0.0, 0.0], [0.0, 9.0]]), None, np.array(1.0))
    assert moved is not None and moved.startswith("action 1 moves by 9")
