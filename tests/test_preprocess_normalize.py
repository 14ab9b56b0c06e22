"""Scaling and its inverse: openpi's numbers exactly, LeRobot's against torch, widths, refusals."""

import json
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
import torch
from conftest import packed_arrays
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from turbopi.checkpoint.norm_stats import FeatureStats, NormStats, load_norm_stats
from turbopi.config import NormMode
from turbopi.preprocess.normalize import Normalizer, pad_last
from turbopi.preprocess.relative_actions import absolute_actions, delta_actions
from turbopi.robots.base import action_mask
from turbopi.support.errors import ConfigError, ObservationError

FOLDER = Path(__file__).parent / "golden" / "preprocess"
NORMALIZED = packed_arrays(FOLDER / "normalize.npz")
DELTA = packed_arrays(FOLDER / "delta_absolute.npz")
PAD = np.load(FOLDER / "pad.npz")
REFUSED: list[str] = json.loads((FOLDER / "normalize_refused.json").read_text())
CASES = [name for name in NORMALIZED if name.split("/")[-2] != "in"]
LEROBOT: list[NormMode] = ["lerobot_quantile", "lerobot_quantile10", "lerobot_zscore", "lerobot_min_max"]


def stats_of(name: str) -> NormStats:
    return load_norm_stats(FOLDER / "norm_stats" / name / "norm_stats.json")


def normalizer(case: str) -> tuple[Normalizer, np.ndarray, str]:
    """A golden case's normaliser, input and direction."""
    *where, direction, feature = case.split("/")
    mode: Any = where[1]
    scale = Normalizer(mode, getattr(stats_of(where[0]), feature), feature)
    return scale, NORMALIZED["/".join([*where, "in", feature])], direction


@pytest.mark.parametrize("case", CASES)
def test_normalising_is_openpis_exactly(case: str) -> None:
    scale, x, direction = normalizer(case)
    out = getattr(scale, direction)(x)
    assert out.dtype == np.float64
    np.testing.assert_array_equal(out, NORMALIZED[case])


def test_golden_cases_cover_both_directions_and_modes() -> None:
    for part in ("/normalize/", "/unnormalize/", "/zscore/", "/quantile/", "/padded/", "/narrow/"):
        assert sum(part in case for case in CASES) > 10


@pytest.mark.parametrize("case", REFUSED)
def test_widths_that_openpi_refuses_are_refused(case: str) -> None:
    refused = 0
    for feature in ("state", "actions"):
        scale, x, direction = normalizer(f"{case}/{feature}")
        if (x.shape[-1] > scale.width) if direction == "normalize" else (x.shape[-1] < scale.width):
            refused += 1
            with pytest.raises((ObservationError, ConfigError), match=f"{feature} has .* statistics cover"):
                getattr(scale, direction)(x)
    assert refused


def test_unnormalising_leaves_dimensions_past_the_statistics_alone() -> None:
    stats = FeatureStats(*(np.array([v, v]) for v in (0.5, 2.0, -1.0, 3.0, -2.0, 4.0, -0.5, 2.5)))
    x = np.array([[0.25, -0.5, 0.75]], np.float32)
    for mode in get_args(NormMode):
        if mode != "zscore":
            assert Normalizer(mode, stats, "actions").unnormalize(x)[0, 2] == 0.75
    assert Normalizer("zscore", stats, "actions").unnormalize(x)[0, 2] == 0.75 * (1 + 1e-6)  # openpi's std + eps


FINITE = st.floats(-1e3, 1e3)


@given(data=st.data(), mode=st.sampled_from(get_args(NormMode)))
@settings(max_examples=80, deadline=None)
def test_unnormalising_undoes_normalising(data: st.DataObject, mode: NormMode) -> None:
    d = data.draw(st.integers(1, 6))
    vector = arrays(np.float64, d, elements=FINITE)
    low, span, x = data.draw(vector), data.draw(arrays(np.float64, d, elements=st.floats(0.1, 50))), data.draw(vector)
    stats = FeatureStats(mean=low, std=span, q01=low, q99=low + span, min=low, max=low + span, q10=low, q90=low + span)
    scale = Normalizer(mode, stats, "state")
    back = scale.unnormalize(scale.normalize(x))
    bound = 2e-3 if mode in LEROBOT else 1e-9  # float32 there, with values of 1e3 to 1e4 on the way
    np.testing.assert_allclose(back, x, atol=bound)


@pytest.mark.parametrize("mode", LEROBOT)
def test_lerobots_modes_compute_what_torch_does_in_float32(mode: NormMode) -> None:
    rng = np.random.default_rng(0)
    a, b, x = rng.normal(size=(3, 8)).astype(np.float32)
    b = np.abs(b)
    b[3] = a[3] if mode != "lerobot_zscore" else 0.0  # a constant dimension
    stats = FeatureStats(mean=a, std=b, q01=a, q99=b, min=a, max=b, q10=a, q90=b)
    ta, tb, tx = map(torch.from_numpy, (a, b, x))
    span = torch.where(tb - ta == 0, torch.tensor(1e-8), tb - ta)
    if mode == "lerobot_zscore":
        forward, back = (tx - ta) / (tb + 1e-8), tx * tb + ta
    else:
        forward = 2 * (tx - ta) / span - 1
        back = (tx + 1) * span / 2 + ta if "quantile" in mode else (tx + 1) / 2 * span + ta
    scale = Normalizer(mode, stats, "state")
    for ours, theirs in ((scale.normalize(x), forward), (scale.unnormalize(x), back)):
        assert ours.dtype == np.float64
        np.testing.assert_array_equal(ours, theirs.numpy().astype(np.float64))


@pytest.mark.parametrize("mode", LEROBOT)
def test_lerobots_modes_want_the_statistics_width(mode: NormMode) -> None:
    stats = FeatureStats(*(np.array([v, v]) for v in (0.5, 2.0, -1.0, 3.0, -2.0, 4.0, -0.5, 2.5)))
    with pytest.raises(ObservationError, match="state has 1 values, but the checkpoint's statistics cover 2"):
        Normalizer(mode, stats, "state").normalize(np.zeros(1))


def test_modes_differ_where_their_epsilons_do() -> None:
    stats = FeatureStats(mean=np.zeros(1), std=np.full(1, 1e-4), q01=np.zeros(1), q99=np.full(1, 1e-4))
    x = np.full(1, 1e-4)
    for openpis, lerobots in (("quantile", "lerobot_quantile"), ("zscore", "lerobot_zscore")):
        ours, theirs = (Normalizer(mode, stats, "state").normalize(x)[0] for mode in (openpis, lerobots))  # type: ignore[arg-type]
        assert 0.005 < abs(ours - theirs) < 0.03


def test_missing_statistics_are_refused_by_name() -> None:
    stats = stats_of("no_quantiles")
    with pytest.raises(
        ConfigError, match=r"quantile normalisation of state needs q01 and q99.*have mean, std for state"
    ):
        Normalizer("quantile", stats.state, "state")
    with pytest.raises(ConfigError, match=r"needs mean and std.*have nothing for actions"):
        Normalizer("zscore", None, "actions")
    with pytest.raises(ConfigError, match="unknown normalisation 'z-score'; choose one of quantile, zscore"):
        Normalizer("z-score", stats.state, "state")  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match=r"statistics mean \(2,\) and std \(3,\) don't match"):
        Normalizer("zscore", FeatureStats(mean=np.zeros(2), std=np.ones(3)), "state")


def test_identity_needs_no_statistics() -> None:
    scale = Normalizer("identity", None, "state")
    x = np.array([1.5, -2.0], np.float32)
    np.testing.assert_array_equal(scale.normalize(x), x)
    np.testing.assert_array_equal(scale.unnormalize(x), x)
    assert scale.normalize(x).dtype == np.float64


@pytest.mark.parametrize("name", [name for name in DELTA if name.endswith("/actions") and "/in/" not in name])
def test_relative_and_absolute_actions_are_openpis_exactly(name: str) -> None:
    robot, dtype, direction, _ = name.split("/")
    mask = action_mask(DELTA[f"{robot}/mask_dims"].tolist())
    assert mask == tuple(DELTA[f"{robot}/mask"])
    actions = DELTA[f"{robot}/{dtype}/in/actions"]
    before = actions.copy()
    convert = delta_actions if direction == "delta" else absolute_actions
    out = convert(actions, DELTA[f"{robot}/{dtype}/in/state"], mask)
    np.testing.assert_array_equal(out, DELTA[name], strict=True)
    np.testing.assert_array_equal(actions, before)


@pytest.mark.parametrize("name", [name for name in PAD.files if "/out/" in name])
def test_padding_is_openpis_exactly(name: str) -> None:
    np.testing.assert_array_equal(pad_last(PAD[name.replace("/out/", "/in/")], 32), PAD[name], strict=True)
