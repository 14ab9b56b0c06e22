"""Intervals and tests against published values."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from turbopi.evaluate.statistics import Paired, Rate, percentiles, wilson


@pytest.mark.parametrize(
    ("successes", "trials", "low", "high"),
    [(81, 263, 0.2553, 0.3662), (15, 148, 0.0624, 0.1605), (0, 20, 0.0, 0.1611), (1, 29, 0.0061, 0.1718)],
)
def test_wilson_gives_the_intervals_of_newcombes_table(successes: int, trials: int, low: float, high: float) -> None:
    # Newcombe, Statistics in Medicine 17 (1998), table I, method 3
    assert wilson(successes, trials) == pytest.approx((low, high), abs=5e-5)


@given(st.integers(1, 600).flatmap(lambda n: st.tuples(st.integers(0, n), st.just(n))))
def test_wilson_holds_the_rate_and_mirrors(case: tuple[int, int]) -> None:
    successes, trials = case
    low, high = wilson(successes, trials)
    assert 0 <= low <= successes / trials <= high <= 1
    assert wilson(trials - successes, trials) == pytest.approx((1 - high, 1 - low))


def test_nothing_tried_means_nothing_known() -> None:
    assert wilson(0, 0) == (0, 1)
    assert Rate(0, 0).value is None and str(Rate(0, 0)) == "-"
    assert str(Rate(9, 10)) == "90.0 % [59.6, 98.2]"


def test_mcnemar_and_bonett_price_give_the_published_values() -> None:
    # Airway hyper-responsiveness before and after transplantation: Fagerland, Lydersen, Laake,
    # BMC Medical Research Methodology 13:91 (2013) and Statistics in Medicine 33 (2014)
    paired = Paired(both=1, only_first=1, only_second=7, neither=12)
    assert paired.p_value == pytest.approx(0.0703, abs=5e-5)
    assert paired.difference == pytest.approx(6 / 21)
    assert paired.interval == pytest.approx((0.0133, 0.508), abs=5e-4)


def test_paired_counts_each_pair_in_its_cell() -> None:
    outcomes = [(True, True)] * 4 + [(True, False)] * 3 + [(False, True)] * 2 + [(False, False)]
    assert Paired.of(outcomes) == Paired(both=4, only_first=3, only_second=2, neither=1)


def test_equal_runs_differ_by_nothing() -> None:
    same = Paired(both=7, only_first=0, only_second=0, neither=3)
    assert same.p_value == 1 and same.difference == 0
    low, high = same.interval
    assert low == -high < 0


@given(st.integers(0, 60), st.integers(0, 60))
def test_mcnemar_is_the_two_sided_binomial_test(first: int, second: int) -> None:
    n = first + second
    likely = [math.comb(n, k) for k in range(n + 1)]
    expected = sum(ways for ways in likely if ways <= likely[first]) / 2**n  # outcomes at most as likely
    assert Paired(5, first, second, 5).p_value == pytest.approx(expected)


def test_percentiles_are_numpys() -> None:
    values = list(np.random.default_rng(0).exponential(10, 501))
    found = percentiles(values)
    assert found is not None
    assert found.p50 == np.median(values) and found.p99 == np.percentile(values, 99)
    assert found.max == max(values) and found.count == 501
    assert percentiles([]) is None
