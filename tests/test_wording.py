"""Numbers as people read them."""

import math

import pytest

from turbopi.wording import did_you_mean, significant


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
