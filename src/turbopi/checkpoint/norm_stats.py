"""Normalisation statistics: openpi's `norm_stats.json`, Dexbotic's and StarVLA's files, and LeRobot's tensors."""

import filecmp
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from posixpath import normpath

import numpy as np

from turbopi.checkpoint.source import listing
from turbopi.config import Normalization, NormMode
from turbopi.support.errors import CheckpointError, ConfigError
from turbopi.support.reading import files_below, is_finite, read_json, shown

FILE_NAME = "norm_stats.json"
STARVLAS = "dataset_statistics.json"
STATISTICS = ("mean", "std", "q01", "q99", "min", "max", "q10", "q90")
MAX_MAGNITUDE = 1e9  # of a statistic: metres, radians and encoder ticks are far below it, damaged floats mostly above

NEEDS: dict[NormMode, tuple[str, ...]] = {
    "quantile": ("q01", "q99"),
    "zscore": ("mean", "std"),
    "lerobot_quantile": ("q01", "q99"),
    "lerobot_quantile10": ("q10", "q90"),
    "lerobot_zscore": ("mean", "std"),
    "lerobot_min_max": ("min", "max"),
    "identity": (),
}


@dataclass(frozen=True, eq=False)
class FeatureStats:
    """Statistics of one feature: float64[dim] each, or None where the checkpoint has none."""

    mean: np.ndarray | None = None
    std: np.ndarray | None = None
    q01: np.ndarray | None = None  # 1 % and 99 % quantiles
    q99: np.ndarray | None = None
    min: np.ndarray | None = None
    max: np.ndarray | None = None
    q10: np.ndarray | None = None  # 10 % and 90 % quantiles
    q90: np.ndarray | None = None

    @property
    def available(self) -> tuple[str, ...]:
        return tuple(name for name in STATISTICS if getattr(self, name) is not None)

    @property
    def dim(self) -> int:
        return max((len(getattr(self, name)) for name in self.available), default=0)

    def check(self, where: object) -> None:
        """CheckpointError for statistics that no data has, and that would mirror or blow up what they scale.

        Every statistic is float[dim] of finite numbers, |x| <= MAX_MAGNITUDE, and of one length; std >= 0, q01 <= q99,
        min <= max, q10 <= q90. Equal ones are right: that dimension was constant, and the epsilons of normalize.py are
        for it.
        """
        arrays = {name: np.asarray(getattr(self, name)) for name in self.available}
        for name, array in arrays.items():
            if array.ndim != 1 or not len(array) or not np.isfinite(array).all():
                raise CheckpointError(
                    f"{where}: {name} must be a list of finite numbers, but has shape {list(array.shape)}: "
                    f"{shown(array.tolist())}"
                )
            _refuse(np.abs(array) > MAX_MAGNITUDE, where, f"expected at most {MAX_MAGNITUDE:g} in size", {name: array})
        lengths = {name: len(array) for name, array in arrays.items()}
        if len(set(lengths.values())) > 1:
            raise CheckpointError(f"{where}: statistics have different lengths: {lengths}")
        if "std" in arrays:
            _refuse(arrays["std"] < 0, where, "expected a deviation, 0 or more", {"std": arrays["std"]})
        for low, high in (("q01", "q99"), ("min", "max"), ("q10", "q90")):
            if low in arrays and high in arrays:
                pair = {low: arrays[low], high: arrays[high]}
                _refuse(arrays[low] > arrays[high], where, f"expected {low} <= {high}", pair)


def _refuse(wrong: np.ndarray, where: object, expected: str, values: Mapping[str, np.ndarray]) -> None:
    """CheckpointError about the first dimension that is wrong, if there is one."""
    if wrong.any():
        i = int(wrong.argmax())
        named = ", ".join(f"{name}[{i}] is {array[i]:g}" for name, array in values.items())
        raise CheckpointError(
            f"{where}: {named}; {expected} (in {int(wrong.sum())} of {len(wrong)} dimensions). The file is damaged, or "
            "isn't one of statistics"
        )


@dataclass(frozen=True)
class NormStats:
    """Statistics of a policy's state and actions; None where nothing is normalised."""

    state: FeatureStats | None = None
    actions: FeatureStats | None = None

    def check(self, normalization: Normalization, where: object) -> None:
        """CheckpointError unless every statistic that `normalization` uses is there, and all are sound."""
        for feature in fields(self):
            mode: NormMode = getattr(normalization, feature.name)
            stats: FeatureStats | None = getattr(self, feature.name)
            if stats is not None:
                stats.check(f"{where}: {feature.name}")
            available = stats.available if stats else ()
            absent = [name for name in NEEDS[mode] if name not in available]
            if absent:
                raise CheckpointError(
                    f"{where}: {mode} normalisation of {feature.name} needs {' and '.join(absent)}, but there is "
                    f"{', '.join(available) or 'nothing'}. If the model was trained with other statistics, choose them "
                    'with {"normalization": ...} in turbopi.json'
                )


def feature_stats(values: Mapping[str, object], where: str) -> FeatureStats:
    """FeatureStats from lists or arrays by name; absent or null ones stay None.

    Raises CheckpointError for anything but numbers (text and booleans aren't), and for what `FeatureStats.check` does.
    """
    arrays: dict[str, np.ndarray] = {}
    for name in STATISTICS:
        value = values.get(name)
        if value is None:
            continue
        if isinstance(value, np.ndarray):
            is_numbers = value.dtype.kind in "fiu"
        else:
            is_numbers = isinstance(value, list) and all(map(is_finite, value))
        if not is_numbers:
            raise CheckpointError(f"{where}: {name} must be a list of finite numbers, not {shown(value)}")
        with np.errstate(invalid="ignore"):  # NaN, refused below
            arrays[name] = np.asarray(value, dtype=np.float64)
    stats = FeatureStats(**arrays)
    stats.check(where)
    return stats


def load_norm_stats(file: str | Path) -> NormStats:
    """Read openpi's `norm_stats.json`, Dexbotic's or StarVLA's file. CheckpointError if it isn't one.

    Quantiles may be null (Pi0's files). Dexbotic calls q01 and q99 min and max.

    Statistics of actions may have shape [1, n]: openpi broadcasts them over the chunk [H, n]. Those of the state must
    be [n]: of others openpi makes a state of two axes, which its `Observation` refuses.
    """
    file = Path(file)
    content = read_json(file)
    stats = _one_dataset(content, file) if file.name == STARVLAS else content.get("norm_stats")
    if not isinstance(stats, dict) or not all(isinstance(entry, dict) for entry in stats.values()):
        raise CheckpointError(f'{file}: expected {{"norm_stats": {{"state": {{...}}, "actions": {{...}}}}}}')
    if set(stats) - {"default"} == {"state", "action"}:
        names = {"min": "q01", "max": "q99"} if "default" in stats else {}
        stats = {
            feature.replace("action", "actions"): {names.get(name, name): values for name, values in entry.items()}
            for feature, entry in stats.items()
            if feature != "default"
        }
    if set(stats) != {"state", "actions"}:
        found = listing(sorted(stats)) or "nothing"
        raise CheckpointError(f"{file} has statistics of {found}; expected state and actions")
    actions = {name: values[0] if _is_row(values) else values for name, values in stats["actions"].items()}
    return NormStats(
        **{name: feature_stats(entry, f"{file}: {name}") for name, entry in (stats | {"actions": actions}).items()}
    )


def _one_dataset(content: Mapping[str, object], file: Path) -> object:
    if len(content) != 1:
        raise CheckpointError(f"{file} has statistics of {listing(sorted(content)) or 'nothing'}; expected one dataset")
    (stats,) = content.values()
    if not isinstance(stats, dict):
        return stats
    return {name: entry for name, entry in stats.items() if name in ("state", "action")}


def _is_row(values: object) -> bool:
    return isinstance(values, list) and len(values) == 1 and isinstance(values[0], list)


def dump_norm_stats(stats: NormStats) -> str:
    """The text of a `norm_stats.json`; what openpi doesn't know and skips, such as min, is written if there."""
    content: dict[str, dict[str, list[float] | None]] = {}
    for feature in fields(stats):
        found: FeatureStats = getattr(stats, feature.name) or FeatureStats()
        names = [*STATISTICS[:4], *(name for name in STATISTICS[4:] if name in found.available)]
        content[feature.name] = {
            name: None if getattr(found, name) is None else getattr(found, name).tolist() for name in names
        }
    return json.dumps({"norm_stats": content}, indent=2)


# -- where they are ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class FoundStats:
    """A checkpoint's statistics."""

    stats: NormStats
    asset_id: str | None = None  # None: of no asset
    notes: tuple[str, ...] = ()  # where they are, if openpi wouldn't find them; others that differ


def asset_ids(assets: Path) -> list[str]:
    """The folders below `assets` that hold statistics, as openpi names them (they may contain a /)."""
    return sorted(file.parent.relative_to(assets).as_posix() for file in _below(assets))


def find_norm_stats(folder: Path, asset_id: str | None, normalization: Normalization) -> FoundStats:
    """The statistics of the openpi checkpoint in `folder`.

    Of an asset id that is given, assets/<asset id>/norm_stats.json is opened, as openpi does, whatever a listing shows.
    Where that isn't there: what other programs leave in <asset id>/, assets/ or the folder itself, with a note.

    Raises CheckpointError if they are missing, naming the folder and what it holds, and ConfigError that names all of
    them if there are several to choose from.
    """
    if not NEEDS[normalization.state] and not NEEDS[normalization.actions]:
        return FoundStats(NormStats(), asset_id)
    file, asset_id = _only(folder) if asset_id is None else _of_asset(folder, asset_id)
    stats = load_norm_stats(file)
    stats.check(normalization, file)
    return FoundStats(stats, asset_id, tuple(_notes(folder, file, asset_id)))


def _below(folder: Path) -> list[Path]:
    """norm_stats.json in a folder and below it. Hidden folders, such as .ipynb_checkpoints, hold copies."""
    return [file for file in files_below(folder, depth=5) if file.name == FILE_NAME]


def _only(folder: Path) -> tuple[Path, str | None]:
    """The only statistics there are: below assets/, or else anywhere in the checkpoint."""
    places = _below(folder / "assets") or _below(folder)
    places = places or _starvlas(folder)
    if len(places) > 1:
        raise ConfigError(_ambiguous(folder, places))
    if not places:
        raise CheckpointError(_missing(folder, None))
    (file,) = places
    return file, _name(file.parent.relative_to(folder).as_posix().removeprefix("assets").removeprefix("/"))


def _of_asset(folder: Path, asset_id: str) -> tuple[Path, str | None]:
    """The statistics of an asset; a path that leads out of the checkpoint isn't opened."""
    if asset_id.startswith("/") or _leads_out(f"assets/{asset_id}"):
        raise CheckpointError(
            f"asset_id is {shown(asset_id)}, which leads out of {folder}; expected a folder below assets/"
        )
    own = folder / "assets" / asset_id / FILE_NAME
    if own.is_file():
        return own, _name(asset_id)
    named, unnamed = _elsewhere(folder, asset_id)
    # without a name in their path they may be those of any asset that is there
    places = [*named, *unnamed, *([] if named or not unnamed else _below(folder))] or _starvlas(folder)
    if not places:
        raise CheckpointError(_missing(folder, asset_id))
    if not _all_alike(places):
        raise ConfigError(f"no {own}; " + _ambiguous(folder, list(dict.fromkeys(places))))
    return places[0], _name(asset_id)


def _elsewhere(folder: Path, asset_id: str | None) -> tuple[list[Path], list[Path]]:
    """What other programs leave: statistics (under the asset's name, without a name)."""
    named = [] if asset_id is None or _leads_out(asset_id) else [folder / asset_id / FILE_NAME]
    unnamed = [folder / "assets" / FILE_NAME, folder / FILE_NAME]
    return [file for file in named if file.is_file()], [file for file in unnamed if file.is_file()]


def _starvlas(folder: Path) -> list[Path]:
    return [file for file in [folder / STARVLAS] if file.is_file()]


def _leads_out(path: str) -> bool:
    return normpath(path).split("/")[0] == ".."


def _notes(folder: Path, file: Path, asset_id: str | None) -> Iterator[str]:
    if folder / "assets" not in file.parents:
        yield f"the statistics are those of {file}: openpi, which looks for them below assets/, wouldn't find them"
    named, unnamed = _elsewhere(folder, asset_id)
    for other in dict.fromkeys([*named, *unnamed]):
        if not _all_alike([file, other]):
            yield f"two sources of statistics: those of {file} are used, and {other} has others"


def _all_alike(files: Sequence[Path]) -> bool:
    return all(filecmp.cmp(files[0], file, shallow=False) for file in files[1:])


def _name(asset_id: str) -> str | None:
    """An asset id without what leads to it; None if that is all it is."""
    return "/".join(part for part in asset_id.split("/") if part not in ("", ".", "..")) or None


def _ambiguous(folder: Path, places: Sequence[Path]) -> str:
    """Names all of them by what `asset_id` would be."""
    assets = folder / "assets"
    in_assets = all(assets in file.parents for file in places)
    names = [file.parent.relative_to(assets if assets in file.parents else folder).as_posix() for file in places]
    where = "" if in_assets else f" (statistics in {', '.join(map(str, places))})"
    owner = assets if in_assets else folder
    return f'{owner} has {", ".join(names)}; choose with {{"asset_id": ...}} in turbopi.json{where}'


def _missing(folder: Path, asset_id: str | None) -> str:
    assets = folder / "assets"
    wanted = assets / (asset_id or "<asset id>") / FILE_NAME
    for link in (wanted, *wanted.parents):
        if link.is_symlink() and not link.exists():
            return f"norm stats are missing: {link} is a link to {link.readlink()}, which isn't there"
    if found := asset_ids(assets) or asset_ids(folder):
        return (
            f"norm stats are missing: no {wanted}; there are statistics of {', '.join(found)}. If one of them is "
            'right, choose it with {"asset_id": ...} in turbopi.json beside the weights'
        )
    return (
        f"norm stats are missing: no {wanted}, and no other below {folder}. openpi saves them there when it trains; "
        "copy the folder assets/ of the training checkpoint. Without them actions would have the wrong scale"
    )
