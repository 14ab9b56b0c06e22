"""Normalisation statistics: openpi's files, read exactly, and missing ones, refused."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from checkpoint_helpers import STATS

from turbopi.checkpoint.norm_stats import (
    FeatureStats,
    NormStats,
    asset_ids,
    dump_norm_stats,
    feature_stats,
    find_norm_stats,
    load_norm_stats,
)
from turbopi.config import Normalization
from turbopi.errors import CheckpointError


@pytest.mark.parametrize("name", ["full", "aloha", "droid", "libero", "no_quantiles"])
def test_openpis_files_are_read_exactly_as_float64(name: str) -> None:
    file = STATS / name / "norm_stats.json"
    stored = json.loads(file.read_text())["norm_stats"]
    stats = load_norm_stats(file)
    for feature in ("state", "actions"):
        for statistic, values in stored[feature].items():
            array = getattr(getattr(stats, feature), statistic)
            if values is None:
                assert array is None
            else:
                assert array.dtype == np.float64
                assert array.tolist() == values


@pytest.mark.parametrize("name", ["full", "no_quantiles"])
def test_statistics_survive_being_written(tmp_path: Path, name: str) -> None:
    stats = load_norm_stats(STATS / name / "norm_stats.json")
    (tmp_path / "norm_stats.json").write_text(dump_norm_stats(stats))
    written = json.loads((tmp_path / "norm_stats.json").read_text())
    assert written == json.loads((STATS / name / "norm_stats.json").read_text())


def test_min_and_max_survive_too(tmp_path: Path) -> None:
    stats = NormStats(FeatureStats(min=np.array([-1.0]), max=np.array([2.0])), FeatureStats(mean=np.zeros(2)))
    (tmp_path / "s.json").write_text(dump_norm_stats(stats))
    again = load_norm_stats(tmp_path / "s.json")
    assert again.state is not None
    assert again.state.available == ("min", "max")
    assert again.state.dim == 1


GOOD = {"mean": [0.0, 1.0], "std": [1.0, 1.0], "q01": None, "q99": None}


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{", "isn't JSON"),
        ([], "expected"),
        ({"state": GOOD, "actions": GOOD}, 'expected {"norm_stats"'),
        ({"norm_stats": {"state": GOOD}}, "has statistics of state; expected state and actions"),
        ({"norm_stats": {"state": GOOD, "actions": GOOD, "depth": GOOD}}, "has statistics of actions, depth, state"),
        (
            {"norm_stats": {"state": GOOD, "actions": GOOD | {"std": [1.0]}}},
            "actions: statistics have different lengths",
        ),
        (
            {"norm_stats": {"state": GOOD | {"mean": [[0.0, 1.0]]}, "actions": GOOD}},
            r"state: mean must be .*\[\[0.0, 1.0\]\]",
        ),
        (
            {"norm_stats": {"state": GOOD | {"mean": [0.0, float("nan")]}, "actions": GOOD}},
            r"norm_stats.state.mean\[1\] is nan",
        ),
        (
            {"norm_stats": {"state": GOOD | {"mean": ["a", "b"]}, "actions": GOOD}},
            "state: mean must be a list of finite numbers, not",
        ),
        ({"norm_stats": {"state": GOOD | {"mean": []}, "actions": GOOD}}, "must be a list of finite"),
    ],
)
def test_broken_files_are_refused(tmp_path: Path, content: Any, message: str) -> None:
    file = tmp_path / "norm_stats.json"
    file.write_text(content if isinstance(content, str) else json.dumps(content))
    with pytest.raises(CheckpointError, match=message):
        load_norm_stats(file)


SOUND = {
    "mean": [0.0, 1.0],
    "std": [1.0, 0.0],
    "q01": [-1.0, 1.0],
    "q99": [1.0, 1.0],
    "min": [-2.0, 1.0],
    "max": [2.0, 1.0],
}
UNSOUND: list[tuple[dict[str, Any], str]] = [
    ({"q01": [-1.0, 1.5]}, r"q01\[1\] is 1.5, q99\[1\] is 1; expected q01 <= q99 \(in 1 of 2 dimensions\)"),
    ({"min": [3.0, 3.0]}, r"min\[0\] is 3, max\[0\] is 2; expected min <= max \(in 2 of 2 dimensions\)"),
    ({"std": [1.0, -0.1]}, r"std\[1\] is -0.1; expected a deviation, 0 or more"),
    ({"q99": [1.0, 1.7e308]}, r"q99\[1\] is 1.7e\+308; expected at most 1e\+09 in size"),
    ({"mean": [-2e9, 0.0]}, r"mean\[0\] is -2e\+09; expected at most 1e\+09 in size"),
    ({"q01": [-1.0]}, "statistics have different lengths"),
]


@pytest.mark.parametrize(("changed", "message"), UNSOUND)
def test_statistics_that_would_mirror_or_blow_up_actions_are_refused(
    tmp_path: Path, changed: dict[str, Any], message: str
) -> None:
    file = tmp_path / "norm_stats.json"
    for feature in ("state", "actions"):
        content = {"state": SOUND, "actions": SOUND} | {feature: SOUND | changed}
        file.write_text(json.dumps({"norm_stats": content}))
        with pytest.raises(CheckpointError, match=f"norm_stats.json: {feature}: {message}"):
            load_norm_stats(file)
    arrays = {name: np.array(values) for name, values in (SOUND | changed).items()}
    with pytest.raises(CheckpointError, match=rf"^stats.safetensors: {message}"):
        feature_stats(arrays, "stats.safetensors")  # LeRobot's come as arrays


@pytest.mark.parametrize(
    "value", [True, 1.0, "0 1", ["0", "1"], [True, 1.0], [None, 1.0], [[0.0], [1.0]], {"0": 1.0}, [10**400, 1], b"01"]
)
def test_statistics_of_other_types_are_refused(value: Any) -> None:
    with pytest.raises(CheckpointError, match=r"^here: std must be a list of finite numbers, not"):
        feature_stats(SOUND | {"std": value}, "here")


@pytest.mark.parametrize("dtype", [np.bool_, np.complex64, "U4"])
def test_tensors_that_hold_no_numbers_are_no_statistics(dtype: Any) -> None:
    with pytest.raises(CheckpointError, match=r"^here: std must be a list of finite numbers, not"):
        feature_stats({"std": np.ones(2).astype(dtype)}, "here")


def test_a_signalling_nan_is_refused_like_any_other() -> None:
    values = np.array([0x7F800001, 0], np.uint32).view(np.float32)
    with pytest.raises(CheckpointError, match=r"^here: mean must be a list of finite numbers"):
        feature_stats({"mean": values}, "here")


def test_constant_dimensions_are_sound() -> None:
    stats = feature_stats(SOUND, "here")
    assert stats.available == ("mean", "std", "q01", "q99", "min", "max") and stats.dim == 2


def test_statistics_made_by_hand_are_checked_too() -> None:
    stats = NormStats(FeatureStats(q01=np.ones(2), q99=np.zeros(2)), FeatureStats(mean=np.zeros(2), std=np.ones(2)))
    with pytest.raises(CheckpointError, match=r"^here: state: q01\[0\] is 1, q99\[0\] is 0"):
        stats.check(Normalization("quantile", "zscore"), "here")


def test_a_normalisation_without_its_statistics_is_refused() -> None:
    stats = load_norm_stats(STATS / "no_quantiles" / "norm_stats.json")
    stats.check(Normalization("zscore", "identity"), "here")
    with pytest.raises(
        CheckpointError, match=r"here: quantile normalisation of actions needs q01 and q99, but .* mean, std"
    ):
        stats.check(Normalization("zscore", "quantile"), "here")
    with pytest.raises(CheckpointError, match="normalisation of state needs mean and std, but there is nothing"):
        NormStats().check(Normalization("zscore", "zscore"), "here")


def test_missing_statistics_name_the_folder_and_are_never_an_identity(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match=f"no {tmp_path}/assets/droid/norm_stats.json, and no other below"):
        find_norm_stats(tmp_path / "assets", "droid", Normalization())
    with pytest.raises(CheckpointError, match=f"no {tmp_path}/assets/<asset id>/norm_stats.json"):
        find_norm_stats(tmp_path / "assets", None, Normalization())


def test_identity_asked_for_needs_no_statistics(tmp_path: Path) -> None:
    stats, _ = find_norm_stats(tmp_path / "assets", None, Normalization("identity", "identity"))
    assert stats.state is None
    assert stats.actions is None


def test_asset_ids_may_contain_a_slash(golden: Path) -> None:
    assert asset_ids(golden / "checkpoints" / "pi05" / "torch" / "assets") == ["physical-intelligence/libero"]
