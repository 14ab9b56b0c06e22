"""LeRobotDataset v2.0, v2.1 and v3.0 in a folder, as LeRobot writes it, read without LeRobot.

    meta/info.json                     codebase_version, fps, features, chunks_size, data_path, video_path
    v2.x  meta/tasks.jsonl             {"task_index", "task"}
          meta/episodes.jsonl          {"episode_index", "tasks", "length"}
          meta/episodes_stats.jsonl    {"episode_index", "stats": {feature: {"min", "max", …}}}; v2.0: meta/stats.json
          data_path                    {episode_chunk}, {episode_index}: a file an episode; chunk = index // chunks_size
          video_path                   the same and {video_key}
    v3.0  meta/tasks.parquet           task_index, and the task: a column, or the index that pandas stored
          meta/episodes/*/*.parquet    a row an episode: length, data/chunk_index, data/file_index, and for each video
                                       videos/KEY/chunk_index, file_index, from_timestamp, to_timestamp
          meta/stats.json              {feature: {"min", "max", …}}
          data_path                    {chunk_index}, {file_index}: several episodes a file, by episode_index
          video_path                   the same and {video_key}; an episode begins at its from_timestamp

A feature of dtype `image` lies in the parquet file: {"bytes", "path"}, of PNG or JPEG. One of dtype `video` is looked
up by the row's `timestamp`. Source: LeRobot 0.6.1, `lerobot/datasets`, and its converter from v2.1 to v3.0.
"""

import io
import re
from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from turbopi.replay.episodes import PROMPT, ActionByStep, Episode
from turbopi.replay.video import frames_at
from turbopi.support.errors import ConfigError, ObservationError
from turbopi.support.installation import install_command
from turbopi.support.reading import (
    Fields,
    file_inside,
    is_finite,
    is_integer,
    listing,
    one_line,
    parse_json,
    read_bytes,
    read_json,
    shown,
)
from turbopi.support.reading.images import decode_image

INFO = "meta/info.json"
_OWN = ("timestamp", "frame_index", "episode_index", "index", "task_index")  # LeRobot's own columns
_MAX_BYTES = 512 * 2**20  # of metadata: episodes' statistics of large datasets
_NUMBERS = re.compile(r"(u?int|float)\d+|bool")


class LeRobotDataset(ActionByStep):
    """A LeRobotDataset. Raises ConfigError without pyarrow, ObservationError for what isn't as its info.json says."""

    def __init__(self, path: Path, action: str | None = None) -> None:
        super().__init__(path)
        if find_spec("pyarrow") is None:
            raise ConfigError(
                f"{path} is a LeRobotDataset, whose tables pyarrow reads, which isn't installed; install it with: "
                f"{install_command('replay')}"
            )
        self._info = Fields(read_json(path / INFO, ObservationError, nan=True), path / INFO, ObservationError)
        version = self._info.values.get("codebase_version")
        if version not in ("v2.0", "v2.1", "v3.0"):
            raise ObservationError(
                f"{path / INFO}: codebase_version is {shown(version)}; v2.0, v2.1 and v3.0 are read. LeRobot's own "
                "converters bring older datasets to v3.0"
            )
        self._is_v3 = version == "v3.0"
        self.kind = f"LeRobotDataset {version}"
        self.fps = self._info.number("fps", 0.01, 10_000)
        self._features = self._read_features()
        found = [name for name in ([action] if action else ["action", "actions"]) if name in self._features]
        if not found:
            raise ObservationError(
                f"{path / INFO}: no feature is called {action or 'action'}; there are "
                f"{listing(list(self._features), 20)}. Say which holds the actions: --rename KEY=actions"
            )
        self._action = found[0]
        self.action_names = self.names_of(self._action)
        self._range = self._read_range()

    # Metadata

    def _read_features(self) -> dict[str, dict[str, Any]]:
        features = self._info.values.get("features")
        if not isinstance(features, dict) or not all(isinstance(one, dict) for one in features.values()):
            self._info.refuse("features", "an object of objects with dtype and shape")
        return features

    def names_of(self, key: str) -> tuple[str, ...] | None:
        """As info.json has them: a list, or lists by group."""
        named = self._features.get(key, {}).get("names")
        if isinstance(named, Mapping):
            named = [name for group in named.values() if isinstance(group, list) for name in group]
        width = self._width(key)
        if isinstance(named, list) and len(named) == width and all(isinstance(one, str) for one in named):
            return tuple(named)
        return None

    def _width(self, feature: str) -> int | None:
        shape = self._features.get(feature, {}).get("shape")
        return shape[0] if isinstance(shape, list) and len(shape) == 1 and is_integer(shape[0]) else None

    def _of_dtype(self, dtype: str) -> list[str]:
        """The features of images or videos that are read."""
        found = [key for key, one in self._features.items() if one.get("dtype") == dtype and not _is_depth(one)]
        return [key for key in found if self.wanted is None or key in self.wanted]

    @cached_property
    def _numbers(self) -> list[str]:
        """Features that are numbers, but for LeRobot's own columns and the actions."""
        return [
            key
            for key, feature in self._features.items()
            if key not in (*_OWN, self._action) and _NUMBERS.fullmatch(str(feature.get("dtype")))
        ]

    @cached_property
    def _tasks(self) -> dict[int, str]:
        if self._is_v3:
            rows = self._table(self.path / "meta/tasks.parquet").to_pylist()
            pairs = [
                (row.get("task_index"), next((v for v in row.values() if isinstance(v, str)), None)) for row in rows
            ]
        else:
            pairs = [(row.get("task_index"), row.get("task")) for row in self._lines("meta/tasks.jsonl")]
        for number, task in pairs:
            if not is_integer(number) or not isinstance(task, str):
                raise ObservationError(f"{self.path}/meta: task {shown(number)} is {shown(task)}; expected a text")
        return dict(pairs)

    @cached_property
    def _rows(self) -> dict[int, dict[str, Any]]:
        """What is known of each episode, by its index."""
        if self._is_v3:
            folder = self.path / "meta/episodes"
            files = sorted(folder.glob("*/*.parquet"))
            if not files:
                raise ObservationError(f"{folder} holds no chunk-…/file-….parquet: is the download complete?")
            rows = [
                row
                for file in files
                for row in self._table(file, lambda name: not name.startswith("stats/")).to_pylist()
            ]
        else:
            rows = self._lines("meta/episodes.jsonl")
        for row in rows:
            index, length = row.get("episode_index"), row.get("length")
            if not is_integer(index) or not is_integer(length) or length < 1:
                raise ObservationError(
                    f"{self.path}/meta: episode {shown(index)} has the length {shown(length)}; expected whole numbers"
                )
        if not rows:
            raise ObservationError(f"{self.path}/meta lists no episode")
        return {row["episode_index"]: row for row in sorted(rows, key=lambda row: row["episode_index"])}

    @cached_property
    def episodes(self) -> Sequence[Episode]:
        return tuple(Episode(index, row["length"], str(index)) for index, row in self._rows.items())

    def _read_range(self) -> tuple[np.ndarray, np.ndarray] | None:
        """The least and the largest actions, as the statistics in meta/ have them."""
        found: list[Any] = []
        if (self.path / "meta/stats.json").is_file():
            found = [read_json(self.path / "meta/stats.json", ObservationError, limit=_MAX_BYTES, nan=True)]
        elif (self.path / "meta/episodes_stats.jsonl").is_file():
            found = [row.get("stats") for row in self._lines("meta/episodes_stats.jsonl")]
        of_actions = [one.get(self._action) for one in found if isinstance(one, dict)]
        ranges = [(one.get("min"), one.get("max")) for one in of_actions if isinstance(one, dict)]
        width = self._width(self._action)
        right = ranges and all(_are_numbers(one, width) for pair in ranges for one in pair)
        lows, highs = zip(*ranges, strict=True) if right else ((), ())
        return (np.min(lows, 0), np.max(highs, 0)) if right else None

    # Data

    def _table(self, file: Path, keep: Any = None, **options: Any) -> Any:
        """A parquet file as pyarrow's table; `keep(name)` chooses columns."""
        import pyarrow
        from pyarrow import parquet

        if not file.is_file():
            raise ObservationError(f"{file} isn't there, though {self.path / INFO} says so: is the download complete?")
        try:
            if keep is not None:
                options["columns"] = [name for name in parquet.read_schema(file).names if keep(name)]
            return parquet.read_table(file, partitioning=None, **options)
        except (pyarrow.ArrowException, OSError, ValueError) as error:
            raise ObservationError(f"{file} isn't a readable parquet file: {one_line(error)}") from error

    def _lines(self, name: str) -> list[dict[str, Any]]:
        file = self.path / name
        data = read_bytes(file, ObservationError, limit=_MAX_BYTES)
        rows = [
            parse_json(line, f"a line of {file}", ObservationError, nan=True)
            for line in data.split(b"\n")
            if line.strip()
        ]
        if not all(isinstance(row, dict) for row in rows):
            raise ObservationError(f"{file}: expected a JSON object a line")
        return rows

    def _file(self, template: str, values: Mapping[str, object]) -> Path:
        """A template of info.json, such as "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet", filled in."""
        text = self._info.values.get(template)
        if not isinstance(text, str):
            self._info.refuse(template, "a text such as data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet")

        def filled(field: "re.Match[str]") -> str:
            name, digits = field[1], int(field[2] or 0)
            if name not in values or digits > 20:
                self._info.refuse(template, f"fields {', '.join(values)}")
            return str(values[name]).zfill(digits)

        name = re.sub(r"\{(\w+)(?::0(\d{1,2})d)?\}", filled, text)
        return file_inside(self.path, name, f"{self.path / INFO}: {template}", ObservationError)

    def _place(self, episode: Episode, of: str) -> dict[str, object]:
        """The fields that say where an episode's data or a video's are; `of` is "data" or "videos/KEY"."""
        if not self._is_v3:
            size = self._info.integer("chunks_size", 1, 10**9)
            return {"episode_chunk": episode.number // size, "episode_index": episode.number}
        row = self._rows[episode.number]
        place = {name: row.get(f"{of}/{name}") for name in ("chunk_index", "file_index")}
        if not all(is_integer(value) for value in place.values()):
            raise ObservationError(f"{self.path}/meta/episodes: episode {episode.number} doesn't say {of}/chunk_index")
        return place

    def _columns(self, episode: Episode, columns: Sequence[str]) -> Any:
        """An episode's rows, in order of time."""
        file = self._file("data_path", self._place(episode, "data"))
        wanted = {*columns, "frame_index"}
        table = self._table(file, wanted.__contains__, filters=[("episode_index", "=", episode.number)])
        missing = [name for name in wanted if name not in table.column_names]
        if missing:
            raise ObservationError(
                f"{file} has no column {listing(sorted(missing))}, though {self.path / INFO} lists it"
            )
        if len(table) != episode.length:
            raise ObservationError(
                f"{file} has {len(table)} rows of episode {episode.number}, but meta/ says that it has {episode.length}"
            )
        return table.sort_by("frame_index")

    def _array(self, table: Any, name: str, episode: Episode) -> np.ndarray:
        """A column of numbers, [length] or [length, d]."""
        try:
            array = np.array(table[name].to_pylist())
        except ValueError:
            array = np.empty(0, object)
        if array.dtype.kind not in "fiub" or len(array) != episode.length:
            raise ObservationError(f"{self.path}: {name} of episode {episode.number} isn't numbers of one width a step")
        return array

    def read_actions(self, episode: Episode) -> np.ndarray:
        actions = self._array(self._columns(episode, [self._action]), self._action, episode)
        self._compare_range(actions if actions.ndim > 1 else actions[:, None], episode)
        return actions

    def _compare_range(self, actions: np.ndarray, episode: Episode) -> None:
        """Note once that the statistics in meta/ are of other data."""
        if self._range is None or actions.shape[1] != len(self._range[0]):
            return
        low, high = self._range
        beyond = np.maximum(low - actions.min(0), actions.max(0) - high) > 0.01 * (high - low) + 1e-6
        if beyond.any():
            self._range, at = None, int(beyond.argmax())
            self.notes.append(
                f"meta/ says that action {at} ranges from {low[at]:.4g} to {high[at]:.4g}, but episode "
                f"{episode.number} has {actions[:, at].min():.4g} to {actions[:, at].max():.4g}: its statistics are of "
                "other data. Was the checkpoint trained with them?"
            )

    def observations(self, episode: Episode, steps: Sequence[int]) -> Iterator[dict[str, Any]]:
        images, videos = self._of_dtype("image"), self._of_dtype("video")
        table = self._columns(episode, ["timestamp", "task_index", *self._numbers, *images])
        times = self._array(table, "timestamp", episode).astype(np.float64).reshape(episode.length)
        self._check_rate(times, episode)
        tasks = self._array(table, "task_index", episode).reshape(episode.length)
        numbers = {key: self._number(self._array(table, key, episode), key) for key in self._numbers}
        streams = {key: self._frames(key, episode, times[list(steps)]) for key in videos}
        for step in steps:
            observation: dict[str, Any] = {key: column[step] for key, column in numbers.items()}
            observation |= {key: self._image(table[key][step].as_py(), key) for key in images}
            observation |= {key: next(stream) for key, stream in streams.items()}
            task = self._tasks.get(int(tasks[step]))
            if task is None:
                raise ObservationError(
                    f"{self.path}: episode {episode.number} has the task {tasks[step]}, which meta/tasks doesn't list"
                )
            yield observation | {PROMPT: task}

    def _number(self, column: np.ndarray, key: str) -> np.ndarray:
        dtype = str(self._features[key]["dtype"])
        return column.astype(dtype if dtype != "bool" else np.uint8)

    def _check_rate(self, times: np.ndarray, episode: Episode) -> None:
        assert self.fps is not None
        if episode.length > 1 and abs(float(np.median(np.diff(times))) * self.fps - 1) > 0.05:
            raise ObservationError(
                f"{self.path}: info.json says {self.fps:g} frames a second, but the steps of episode {episode.number} "
                f"are {float(np.median(np.diff(times))):.4g} s apart"
            )

    def _frames(self, key: str, episode: Episode, times: np.ndarray) -> Iterator[np.ndarray]:
        begin = 0.0
        if self._is_v3:
            found = self._rows[episode.number].get(f"videos/{key}/from_timestamp")
            if not isinstance(found, float | int):
                raise ObservationError(
                    f"{self.path}/meta/episodes: episode {episode.number} doesn't say videos/{key}/from_timestamp"
                )
            begin = float(found)
        file = self._file("video_path", {**self._place(episode, f"videos/{key}"), "video_key": key})
        if not file.is_file():
            raise ObservationError(f"{file} isn't there, though {self.path / INFO} says so: is the download complete?")
        assert self.fps is not None
        return frames_at(file, [begin + float(time) for time in times], self.fps)

    def _image(self, stored: object, key: str) -> np.ndarray:
        """An image of a parquet file, uint8[h, w, 3]."""
        data = stored.get("bytes") if isinstance(stored, dict) else None
        if data is None and isinstance(stored, dict) and isinstance(stored.get("path"), str):
            where = f"{self.path}: an image of {key}"
            data = read_bytes(
                file_inside(self.path, stored["path"], where, ObservationError), ObservationError, limit=2**28
            )
        if not isinstance(data, bytes):
            raise ObservationError(f"{self.path}: an image of {key} is {shown(stored)}; expected its bytes, or a path")
        return decode_image(io.BytesIO(data), f"{self.path}: an image of {key}")


def _are_numbers(value: object, width: int | None) -> bool:
    return isinstance(value, list) and len(value) == width and all(map(is_finite, value))


def _is_depth(feature: Mapping[str, Any]) -> bool:
    """LeRobot says it in `info`, or in older datasets in `video_info`."""
    places = [place for place in (feature.get("info"), feature.get("video_info")) if isinstance(place, dict)]
    return any(place.get(name) for place in places for name in ("is_depth_map", "video.is_depth_map"))
