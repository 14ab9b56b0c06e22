"""Normalisation statistics: openpi's `norm_stats.json`, and LeRobot's tensors."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np

from turbopi.checkpoint.source import listing
from turbopi.config import Normalization, NormMode
from turbopi.errors import CheckpointError, ConfigError
from turbopi.reading import is_finite, read_json, shown

FILE_NAME = "norm_stats.json"
STATISTICS = ("mean", "std", "q01", "q99", "min", "max")
MAX_MAGNITUDE = 1e9  # of a statistic: metres, radians and encoder ticks are far below it, damaged floats mostly above

NEEDS: dict[NormMode, tuple[str, ...]] = {
    "quantile": ("q01", "q99"),
    "zscore": ("mean", "std"),
    "lerobot_quantile": ("q01", "q99"),
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

    @property
    def available(self) -> tuple[str, ...]:
        return tuple(name for name in STATISTICS if getattr(self, name) is not None)

    @property
    def dim(self) -> int:
        return max((len(getattr(self, name)) for name in self.available), default=0)

    def check(self, where: object) -> None:
        """CheckpointError for statistics that no data has, and that would mirror or blow up what they scale.

        Every statistic is float[dim] of finite numbers, |x| <= MAX_MAGNITUDE, and of one length; std >= 0, q01 <= q99,
        min <= max. Equal ones are right: that dimension was constant, and the epsilons of normalize.py are for it.
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
        for low, high in (("q01", "q99"), ("min", "max")):
            if low in arrays and high in arrays:
                pair = {low: arrays[low], high: arrays[high]}
                _refuse(arrays[low] > arrays[high], where, f"expected {low} <= {high}", pair)


def _refuse(wrong: np.ndarray, where: object, expected: str, values: Mapping[str, np.ndarray]) -> None:
    """CheckpointError about the first dimension that is wrong, if there is one."""
    if wrong.any():
        i = int(wrong.argmax())
        told = ", ".join(f"{name}[{i}] is {array[i]:g}" for name, array in values.items())
        raise CheckpointError(
            f"{where}: {told}; {expected} (in {int(wrong.sum())} of {len(wrong)} dimensions). The file is damaged, or "
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
    """Read openpi's `norm_stats.json`. Quantiles may be null (Pi0's files). CheckpointError if it isn't one."""
    file = Path(file)
    stats = read_json(file).get("norm_stats")
    if not isinstance(stats, dict) or not all(isinstance(entry, dict) for entry in stats.values()):
        raise CheckpointError(f'{file}: expected {{"norm_stats": {{"state": {{...}}, "actions": {{...}}}}}}')
    if set(stats) != {"state", "actions"}:
        found = listing(sorted(stats)) or "nothing"
        raise CheckpointError(f"{file} has statistics of {found}; expected state and actions")
    return NormStats(**{name: feature_stats(entry, f"{file}: {name}") for name, entry in stats.items()})


def dump_norm_stats(stats: NormStats) -> str:
    """The text of a `norm_stats.json`; min and max, which openpi doesn't know and skips, are written if there."""
    content: dict[str, dict[str, list[float] | None]] = {}
    for feature in fields(stats):
        found: FeatureStats = getattr(stats, feature.name) or FeatureStats()
        names = [*STATISTICS[:4], *(name for name in STATISTICS[4:] if name in found.available)]
        content[feature.name] = {
            name: None if getattr(found, name) is None else getattr(found, name).tolist() for name in names
        }
    return json.dumps({"norm_stats": content}, indent=2)


def asset_ids(assets: Path) -> list[str]:
    """The folders below `assets` that hold statistics, as openpi names them (they may contain a /)."""
    if not assets.is_dir():
        return []
    return sorted(file.parent.relative_to(assets).as_posix() for file in assets.rglob(FILE_NAME))


def find_norm_stats(assets: Path, asset_id: str | None, normalization: Normalization) -> tuple[NormStats, str | None]:
    """The statistics of an openpi checkpoint and the asset id they come from.

    Raises CheckpointError if they are missing, naming the folder and what it holds, and ConfigError if asset_id is None
    and there are several.
    """
    if not NEEDS[normalization.state] and not NEEDS[normalization.actions]:
        return NormStats(), asset_id
    found = asset_ids(assets)
    if asset_id is None and len(found) > 1:
        raise ConfigError(f'{assets} has {", ".join(found)}; choose with {{"asset_id": ...}} in turbopi.json')
    if asset_id is None and found:
        asset_id = found[0]
    if asset_id not in found:
        raise CheckpointError(_missing(assets, asset_id, found))
    file = assets / str(asset_id) / FILE_NAME
    stats = load_norm_stats(file)
    stats.check(normalization, file)
    return stats, asset_id


def _missing(assets: Path, asset_id: str | None, found: Sequence[str]) -> str:
    wanted = assets / (asset_id or "<asset id>") / FILE_NAME
    if found:
        return (
            f"norm stats are missing: no {wanted}; there are statistics of {', '.join(found)}. If one of them is "
            'right, choose it with {"asset_id": ...} in turbopi.json beside the weights'
        )
    return (
        f"norm stats are missing: no {wanted}, and no other below {assets}. openpi saves them there when it trains; "
        "copy the folder assets/ of the training checkpoint. Without them actions would have the wrong scale"
    )
