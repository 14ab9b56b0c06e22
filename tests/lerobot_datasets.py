"""Small LeRobotDatasets, v2.1 and v3.0, written from arrays as LeRobot lays them out; test_replay_lerobot.py holds the
reader against LeRobot's own files where LeRobot is installed."""

import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image


@dataclass(frozen=True)
class Recorded:
    """One episode. images: key -> uint8[T, h, w, 3]; numbers: key -> float[T, d], the action among them."""

    task: str
    images: Mapping[str, np.ndarray]
    numbers: Mapping[str, np.ndarray]

    @property
    def length(self) -> int:
        return len(next(iter(self.numbers.values())))


def write_dataset(
    folder: Path,
    episodes: Sequence[Recorded],
    *,
    version: str = "v3.0",
    fps: int = 10,
    videos: bool = False,
    episodes_a_file: int = 2,
    chunks_size: int = 1000,
    names: Mapping[str, Sequence[str]] | None = None,
) -> Path:
    """A dataset in `folder`. Of v3.0 with `episodes_a_file`; of v2.1 with `chunks_size` episodes a chunk."""
    info = _info(episodes[0], version, fps, videos, chunks_size, names or {})
    tasks = list(dict.fromkeys(one.task for one in episodes))
    info |= {"total_episodes": len(episodes), "total_frames": sum(one.length for one in episodes)}
    info |= {"total_tasks": len(tasks)}
    if version != "v3.0":
        files = len(episodes) * len(episodes[0].images) if videos else 0
        info |= {"total_videos": files, "total_chunks": -(-len(episodes) // chunks_size)}
    _write_json(folder / "meta/info.json", info)
    writer = _write_v3 if version == "v3.0" else _write_v2
    writer(folder, episodes, tasks, info, episodes_a_file)
    return folder


def _info(
    example: Recorded, version: str, fps: int, videos: bool, chunks_size: int, names: Mapping[str, Sequence[str]]
) -> dict[str, Any]:
    features: dict[str, Any] = {
        key: {"dtype": "float32", "shape": [value.shape[1]], "names": list(names[key]) if key in names else None}
        for key, value in example.numbers.items()
    }
    for key, value in example.images.items():
        features[key] = {
            "dtype": "video" if videos else "image",
            "shape": list(value.shape[1:]),
            "names": ["height", "width", "channels"],
        }
    for key in ("timestamp", "frame_index", "episode_index", "index", "task_index"):
        features[key] = {"dtype": "float32" if key == "timestamp" else "int64", "shape": [1], "names": None}
    if version == "v3.0":
        place = "chunk-{chunk_index:03d}/file-{file_index:03d}"
        paths = {"data_path": f"data/{place}.parquet", "video_path": "videos/{video_key}/" + place + ".mp4"}
    else:
        place = "episode_{episode_index:06d}"
        chunk = "chunk-{episode_chunk:03d}"
        paths = {
            "data_path": f"data/{chunk}/{place}.parquet",
            "video_path": f"videos/{chunk}/" + "{video_key}/" + place + ".mp4",
        }
    if not videos:
        paths["video_path"] = None  # type: ignore[assignment]
    return {
        "codebase_version": version,
        "robot_type": "so101",
        "chunks_size": chunks_size,
        "fps": fps,
        "splits": {"train": "0:1"},
        **paths,
        "features": features,
    }


def _rows(one: Recorded, index: int, first: int, tasks: Sequence[str], fps: int, videos: bool) -> dict[str, list[Any]]:
    """The columns of an episode's rows."""
    count = one.length
    columns: dict[str, list[Any]] = {key: value.astype(np.float32).tolist() for key, value in one.numbers.items()}
    if not videos:
        columns |= {key: [_png(image) for image in images] for key, images in one.images.items()}
    return columns | {
        "timestamp": (np.arange(count) / fps).astype(np.float32).tolist(),
        "frame_index": list(range(count)),
        "episode_index": [index] * count,
        "index": list(range(first, first + count)),
        "task_index": [tasks.index(one.task)] * count,
    }


def _write_v2(folder: Path, episodes: Sequence[Recorded], tasks: Sequence[str], info: Any, _: int) -> None:
    first, lines, stats = 0, [], []
    for index, one in enumerate(episodes):
        chunk = f"chunk-{index // info['chunks_size']:03d}"
        videos = info["video_path"] is not None
        rows = _rows(one, index, first, tasks, info["fps"], videos)
        _write_parquet(folder / f"data/{chunk}/episode_{index:06d}.parquet", rows)
        if videos:
            for key, images in one.images.items():
                write_video(folder / f"videos/{chunk}/{key}/episode_{index:06d}.mp4", images, info["fps"])
        first += one.length
        lines.append({"episode_index": index, "tasks": [one.task], "length": one.length})
        stats.append({"episode_index": index, "stats": _stats([one])})
    _write_lines(folder / "meta/tasks.jsonl", [{"task_index": n, "task": task} for n, task in enumerate(tasks)])
    _write_lines(folder / "meta/episodes.jsonl", lines)
    _write_lines(folder / "meta/episodes_stats.jsonl", stats)


def _write_v3(folder: Path, episodes: Sequence[Recorded], tasks: Sequence[str], info: Any, a_file: int) -> None:
    videos, first, lines = info["video_path"] is not None, 0, []
    for file in range(-(-len(episodes) // a_file)):
        own = list(enumerate(episodes))[file * a_file : (file + 1) * a_file]
        columns: dict[str, list[Any]] = {}
        time = 0.0
        for index, one in own:
            for key, values in _rows(one, index, first, tasks, info["fps"], videos).items():
                columns.setdefault(key, []).extend(values)
            line: dict[str, Any] = {"episode_index": index, "tasks": [one.task], "length": one.length}
            line |= {"data/chunk_index": 0, "data/file_index": file, "stats/action/min": [0.0]}
            line |= {"dataset_from_index": first, "dataset_to_index": first + one.length}
            for key in one.images if videos else ():
                place = {"chunk_index": 0, "file_index": file, "from_timestamp": time}
                line |= {f"videos/{key}/{name}": value for name, value in place.items()}
                line[f"videos/{key}/to_timestamp"] = time + one.length / info["fps"]
            time, first = time + one.length / info["fps"], first + one.length
            lines.append(line)
        _write_parquet(folder / f"data/chunk-000/file-{file:03d}.parquet", columns)
        for key in episodes[0].images if videos else ():
            images = np.concatenate([one.images[key] for _, one in own])
            write_video(folder / f"videos/{key}/chunk-000/file-{file:03d}.mp4", images, info["fps"])
    of_episodes = {key: [line[key] for line in lines] for key in lines[0]}
    _write_parquet(folder / "meta/episodes/chunk-000/file-000.parquet", of_episodes)
    of_tasks: dict[str, list[Any]] = {"task_index": list(range(len(tasks))), "task": list(tasks)}
    _write_parquet(folder / "meta/tasks.parquet", of_tasks, index="task")  # pandas' index, as LeRobot stores it
    _write_json(folder / "meta/stats.json", _stats(episodes))


def _stats(episodes: Sequence[Recorded]) -> dict[str, Any]:
    found = {}
    for key in episodes[0].numbers:
        values = np.concatenate([one.numbers[key] for one in episodes]).astype(np.float64)
        named = {"min": values.min(0), "max": values.max(0), "mean": values.mean(0), "std": values.std(0)}
        found[key] = {name: value.tolist() for name, value in named.items()} | {"count": [len(values)]}
    return found


def _png(image: np.ndarray) -> dict[str, Any]:
    stream = io.BytesIO()
    Image.fromarray(image).save(stream, "PNG")
    return {"bytes": stream.getvalue(), "path": None}


def write_video(file: Path, images: np.ndarray, fps: int) -> None:
    """An MP4 with a key frame every second frame, as LeRobot's."""
    import av

    file.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(file), "w") as container:
        stream: Any = container.add_stream("libx264", rate=fps, options={"g": "2", "crf": "10"})
        stream.height, stream.width = images.shape[1:3]
        stream.pix_fmt = "yuv420p"
        for image in images:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        container.mux(stream.encode())


def _write_parquet(file: Path, columns: Mapping[str, list[Any]], index: str | None = None) -> None:
    """`index`: the column that pandas would take as its index."""
    import pyarrow
    from pyarrow import parquet

    file.parent.mkdir(parents=True, exist_ok=True)
    table = pyarrow.table(dict(columns))
    if index is not None:
        named = [{"name": name, "field_name": name, "pandas_type": None, "numpy_type": "object"} for name in columns]
        stored = {"index_columns": [index], "column_indexes": [], "columns": named}
        table = table.replace_schema_metadata({"pandas": json.dumps(stored)})
    parquet.write_table(table, file)


def _write_json(file: Path, content: object) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(json.dumps(content))


def _write_lines(file: Path, lines: Sequence[object]) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text("".join(json.dumps(line) + "\n" for line in lines))
