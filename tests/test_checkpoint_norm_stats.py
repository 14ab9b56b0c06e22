"""Normalisation statistics: openpi's files, read exactly, and missing ones, refused."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from checkpoint_helpers import STATS

from turbopi.checkpoint.norm_stats import (
    FeatureStats,
    FoundStats,
    NormStats,
    asset_ids,
    dump_norm_stats,
    feature_stats,
    find_norm_stats,
    load_norm_stats,
)
from turbopi.config import Normalization
from turbopi.support.errors import CheckpointError, ConfigError


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


QUANTILE = Normalization()


def place(folder: Path, *places: str, mean: float = 0.0) -> list[Path]:
    """Statistics at `<place>/norm_stats.json` below a folder, told apart by the state's mean."""
    files = []
    for where in places:
        (folder / where).mkdir(parents=True, exist_ok=True)
        files.append(folder / where / "norm_stats.json")
        content = {"state": SOUND | {"mean": [mean, 1.0]}, "actions": SOUND}
        files[-1].write_text(json.dumps({"norm_stats": content}))
    return files


def mean_of(found: FoundStats) -> float:
    assert found.stats.state is not None and found.stats.state.mean is not None
    return float(found.stats.state.mean[0])


def test_missing_statistics_name_the_folder_and_are_never_an_identity(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match=f"no {tmp_path}/assets/droid/norm_stats.json, and no other below"):
        find_norm_stats(tmp_path, "droid", QUANTILE)
    with pytest.raises(CheckpointError, match=f"no {tmp_path}/assets/<asset id>/norm_stats.json"):
        find_norm_stats(tmp_path, None, QUANTILE)
    (tmp_path / "assets").mkdir()
    (tmp_path / "assets" / "droid").symlink_to("/nowhere")
    with pytest.raises(CheckpointError, match=r"assets/droid is a link to /nowhere, which isn't there"):
        find_norm_stats(tmp_path, "droid", QUANTILE)


def test_identity_asked_for_needs_no_statistics(tmp_path: Path) -> None:
    stats = find_norm_stats(tmp_path, None, Normalization("identity", "identity")).stats
    assert stats.state is None
    assert stats.actions is None


def test_asset_ids_may_contain_a_slash(golden: Path) -> None:
    assert asset_ids(golden / "checkpoints" / "pi05" / "torch" / "assets") == ["physical-intelligence/libero"]


@pytest.mark.parametrize("asset_id", ["my/arm", "my/arm/", "./my/arm", "my//arm", "other/../my/arm"])
def test_the_path_that_an_asset_id_names_is_opened(tmp_path: Path, asset_id: str) -> None:
    place(tmp_path, "assets/my/arm", mean=1.0)
    place(tmp_path, "assets/other", mean=2.0)
    found = find_norm_stats(tmp_path, asset_id, QUANTILE)
    assert (mean_of(found), found.notes) == (1.0, ())


def test_links_are_followed_as_openpi_follows_them(tmp_path: Path) -> None:
    """To a folder, to the file, to all of assets/; a link back to a folder above ends the listing, not the program."""
    folder = tmp_path / "ckpt"
    place(tmp_path, "stats", mean=1.0)
    (folder / "assets").mkdir(parents=True)
    (folder / "assets" / "arm").symlink_to(tmp_path / "stats")
    assert find_norm_stats(folder, "arm", QUANTILE).asset_id == "arm"
    assert find_norm_stats(folder, None, QUANTILE).asset_id == "arm"
    (folder / "assets" / "loop").symlink_to(folder)
    assert [name for name in asset_ids(folder / "assets") if "loop" not in name] == ["arm"]
    (folder / "assets" / "loop").unlink()
    place(folder, "assets/other", mean=2.0)
    with pytest.raises(ConfigError, match=r"has arm, other; choose with"):
        find_norm_stats(folder, None, QUANTILE)
    (tmp_path / "second").mkdir()
    (tmp_path / "second" / "assets").symlink_to(folder / "assets")
    assert mean_of(find_norm_stats(tmp_path / "second", "arm", QUANTILE)) == 1.0


def test_copies_in_hidden_folders_are_no_assets(tmp_path: Path) -> None:
    place(tmp_path, "assets/arm", mean=1.0)
    place(tmp_path, "assets/.ipynb_checkpoints", "assets/arm/.ipynb_checkpoints", ".cache", mean=2.0)
    found = find_norm_stats(tmp_path, None, QUANTILE)
    assert (found.asset_id, mean_of(found), found.notes) == ("arm", 1.0, ())


@pytest.mark.parametrize("asset_id", ["../..", "../../other", "/etc", "a/../../.."])
def test_an_asset_id_never_leads_out_of_the_checkpoint(tmp_path: Path, asset_id: str) -> None:
    place(tmp_path, ".", "other", "ckpt/assets/a")
    with pytest.raises(CheckpointError, match=rf"asset_id is '{asset_id}', which leads out of"):
        find_norm_stats(tmp_path / "ckpt", asset_id, QUANTILE)


@pytest.mark.parametrize("where", ["my/arm", ".", "assets"])
@pytest.mark.parametrize("asset_id", ["my/arm", None])
def test_statistics_of_other_programs_places_are_found_and_said_to_be_there(
    tmp_path: Path, where: str, asset_id: str | None
) -> None:
    (file,) = place(tmp_path, where, mean=1.0)
    found = find_norm_stats(tmp_path, asset_id, QUANTILE)
    assert mean_of(found) == 1.0
    if where != "assets":
        assert found.notes == (f"the statistics are those of {file}: openpi, which looks for them below assets/, "
                               "wouldn't find them",)  # fmt: skip
    assert found.asset_id == ("my/arm" if asset_id or where == "my/arm" else None)


def test_where_openpi_looks_comes_first_and_others_that_differ_are_noted(tmp_path: Path) -> None:
    place(tmp_path, "assets/arm", mean=1.0)
    place(tmp_path, "arm", mean=1.0)
    (other,) = place(tmp_path, ".", mean=2.0)
    for asset_id in ("arm", None):
        found = find_norm_stats(tmp_path, asset_id, QUANTILE)
        assert mean_of(found) == 1.0
        (note,) = found.notes  # the equal copy is none
        assert note.startswith("two sources of statistics: ") and note.endswith(f"{other} has others")


@pytest.mark.parametrize(
    ("places", "asset_id"),
    [
        (("arm", "."), "arm"),
        ((".", "assets"), "arm"),
        ((".", "assets/other"), "arm"),  # whose are those without a name?
        (("arm", "other"), None),
        (("assets/arm", "assets/other"), None),
    ],
)
def test_several_that_differ_are_an_error_that_names_all(
    tmp_path: Path, places: tuple[str, ...], asset_id: str | None
) -> None:
    files = [place(tmp_path, where, mean=float(number))[0] for number, where in enumerate(places)]
    with pytest.raises(ConfigError) as caught:
        find_norm_stats(tmp_path, asset_id, QUANTILE)
    for file in files:
        name = file.parent.relative_to(tmp_path).as_posix().removeprefix("assets/")
        assert str(file) in str(caught.value) or name in str(caught.value).split("; choose")[0]


def test_statistics_of_another_asset_are_never_taken_for_the_named_one(tmp_path: Path) -> None:
    place(tmp_path, "assets/other", "elsewhere")
    with pytest.raises(CheckpointError, match=r"no .*assets/arm/norm_stats.json; there are statistics of other"):
        find_norm_stats(tmp_path, "arm", QUANTILE)


def test_a_row_of_statistics_is_broadcast_over_actions_and_refused_for_the_state(tmp_path: Path) -> None:
    """As in openpi: x [H, n] * std [1, n] is [H, n], but a state of [1, n] doesn't fit its Observation."""
    file, rows = tmp_path / "norm_stats.json", {name: [values] for name, values in SOUND.items()}
    file.write_text(json.dumps({"norm_stats": {"state": SOUND, "actions": rows}}))
    stats = load_norm_stats(file)
    assert stats.actions is not None and stats.actions.q99 is not None
    assert stats.actions.q99.tolist() == SOUND["q99"]
    for broken in ({"state": rows, "actions": SOUND}, {"state": SOUND, "actions": rows | {"mean": [[0, 1], [0, 1]]}}):
        file.write_text(json.dumps({"norm_stats": broken}))
        with pytest.raises(CheckpointError, match="mean must be a list of finite numbers"):
            load_norm_stats(file)
