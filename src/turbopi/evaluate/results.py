"""results.json: every episode of a run, written so that an interruption at any moment leaves a valid file."""

import json
import math
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from datetime import datetime, timezone
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from turbopi.errors import ConfigError
from turbopi.evaluate.plan import Protocol
from turbopi.evaluate.statistics import Rate, percentiles
from turbopi.files import write_whole
from turbopi.sim import Task

FORMAT = 1
FILE = "results.json"
_SAVE_EVERY_S = 3.0  # episodes of the last seconds are lost by a kill, and run again

Status = Literal["success", "failure", "aborted", "crash"]
STATUSES: tuple[str, ...] = get_args(Status)


@dataclass(frozen=True)
class Episode:
    """What became of one episode.

    status       success or failure: the simulator's verdict within the step limit; aborted: the policy's actions
                 weren't finite, which counts as a failure; crash: the simulator broke, which counts as nothing
    steps        control steps after the wait
    call_ms      for each time the policy was asked: the whole call, with the requests it was batched with
    infer_ms     the model's part of it, where the policy tells
    """

    task: int
    initial_state: int
    status: Status
    steps: int
    seed: int
    seconds: float
    call_ms: list[float] = field(default_factory=list)
    infer_ms: list[float] = field(default_factory=list)
    batch: list[int] = field(default_factory=list)
    message: str | None = None
    video: str | None = None

    @property
    def key(self) -> tuple[int, int]:
        return self.task, self.initial_state

    @property
    def success(self) -> bool:
        return self.status == "success"

    @property
    def judged(self) -> bool:
        """Whether it counts: a crash says nothing about the policy."""
        return self.status != "crash"


def rate(episodes: Iterable[Episode]) -> Rate:
    judged = [episode for episode in episodes if episode.judged]
    return Rate(sum(episode.success for episode in judged), len(judged))


class Results:
    """A run's episodes and what they were run with, in a folder.

    policy    what was evaluated, as plain values; `policy["identity"]` decides whether a run may be continued
    """

    def __init__(
        self,
        folder: Path,
        protocol: Mapping[str, Any],
        policy: Mapping[str, Any],
        tasks: Sequence[Task],
        versions: Mapping[str, Any],
        options: Mapping[str, Any],
    ) -> None:
        self.folder = folder
        self.protocol, self.policy, self.versions, self.options = protocol, policy, versions, options
        self.tasks = {task.index: task for task in tasks}
        self.episodes: dict[tuple[int, int], Episode] = {}
        self.planned: set[tuple[int, int]] = set()
        self.started = _now()
        self.wall_seconds = 0.0
        self.replaces = False  # what an earlier run left in the folder
        self._saved_at = float("-inf")

    @property
    def path(self) -> Path:
        return self.folder / FILE

    @property
    def label(self) -> str:
        return str(self.policy.get("label", self.folder.name))

    @property
    def complete(self) -> bool:
        judged = {episode.key for episode in self.episodes.values() if episode.judged}
        return self.planned <= judged

    def in_order(self) -> list[Episode]:
        return [self.episodes[key] for key in sorted(self.episodes)]

    def continue_from(self, earlier: "Results") -> None:
        """Take over the episodes of an interrupted run. Raises ConfigError if they were run in another way."""
        mine, theirs = _flat(plain(self._decisive())), _flat(plain(earlier._decisive()))
        for name in sorted({*mine, *theirs}):
            if mine.get(name) != theirs.get(name):
                raise ConfigError(
                    f"{self.folder} holds a run with {name} = {theirs.get(name)!r}, but this one has "
                    f"{mine.get(name)!r}: give another --out, or --restart to begin again"
                )
        self.episodes = dict(earlier.episodes)
        self.planned |= earlier.planned
        self.tasks = {**earlier.tasks, **self.tasks}
        self.started, self.wall_seconds = earlier.started, earlier.wall_seconds

    def add(self, episode: Episode) -> None:
        self.episodes[episode.key] = episode
        if time.monotonic() - self._saved_at > _SAVE_EVERY_S:
            self.save()

    def save(self) -> None:
        """Write the file as a whole: a reader, or a crash, sees the old one or the new one."""
        self.folder.mkdir(parents=True, exist_ok=True)
        write_whole(self.path, json.dumps(self.as_json(), ensure_ascii=False, allow_nan=False))
        self._saved_at = time.monotonic()

    def summary(self) -> dict[str, Any]:
        episodes = self.in_order()
        by_task = {index: [e for e in episodes if e.task == index] for index in sorted(self.tasks)}
        return {
            "success": rate(episodes).as_json(),
            "tasks": [
                {"task": index, "instruction": self.tasks[index].instruction}
                | {"success": rate(own).as_json(), "crashes": sum(not e.judged for e in own)}
                for index, own in by_task.items()
                if own
            ],
            "episodes": len(episodes),
            "planned": len(self.planned),
            "crashes": sum(not e.judged for e in episodes),
            "aborted": sum(e.status == "aborted" for e in episodes),
            "steps_to_success": percentiles([e.steps for e in episodes if e.success]),
            "call_ms": percentiles([ms for e in episodes for ms in e.call_ms]),
            "infer_ms": percentiles([ms for e in episodes for ms in e.infer_ms]),
            "mean_batch": _mean([size for e in episodes for size in e.batch]),
        }

    def as_json(self) -> dict[str, Any]:
        return {
            "format": FORMAT,
            "complete": self.complete,
            "protocol": plain(self.protocol),
            "policy": plain(self.policy),
            "versions": plain(self.versions),
            "options": plain(self.options),
            "started": self.started,
            "updated": _now(),
            "wall_seconds": round(self.wall_seconds, 1),
            "summary": self.summary(),
            "tasks": [asdict(self.tasks[index]) for index in sorted(self.tasks)],
            "planned": sorted(self.planned),
            "episodes": [asdict(episode) for episode in self.in_order()],
        }

    def _decisive(self) -> dict[str, Any]:
        simulator = {name: value for name, value in self.versions.items() if name == "simulator"}
        return {"protocol": self.protocol, "policy": self.policy.get("identity", {}), "versions": simulator}


def protocol_json(protocol: Protocol) -> dict[str, Any]:
    """As it looks after a round trip through JSON, so that it compares equal."""
    value: dict[str, Any] = plain(protocol.as_json())
    return value


def plain(value: Any) -> Any:
    """`value` as JSON has it: arrays as lists, numbers that aren't finite as null, anything else as its text."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return plain(value.tolist())
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value if value is None or isinstance(value, bool | int) else writable(str(value))


def writable(text: str) -> str:
    """`text` without what UTF-8 can't write: halves of characters, from a file's name that isn't UTF-8."""
    return text.encode(errors="replace").decode()


def _flat(value: Any, name: str = "") -> dict[str, Any]:
    if isinstance(value, Mapping):
        found: dict[str, Any] = {}
        for key, item in value.items():
            found |= _flat(item, f"{name}.{key}" if name else str(key))
        return found
    return {name: value}


def _mean(values: Sequence[float]) -> float | None:
    return sum(values) / len(values) if values else None


def _now() -> str:
    return datetime.now(timezone.utc).isoformat(timespec="seconds")
