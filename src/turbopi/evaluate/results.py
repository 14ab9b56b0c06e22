"""results.json: every episode of a run, written so that an interruption at any moment leaves a valid file."""

import json
import math
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from datetime import datetime, timezone
from pathlib import Path
from typing import Annotated, Final, Literal

import numpy as np
from msgspec import Meta, Struct

from turbopi.evaluate.motion import Motion
from turbopi.evaluate.pacing import Paced, PacedSummary, rate_given, summarise_paced
from turbopi.evaluate.plan import Protocol
from turbopi.evaluate.statistics import Percentiles, Rate, RateDocument, percentiles
from turbopi.sim import Task
from turbopi.support.errors import ConfigError
from turbopi.support.files import write_whole
from turbopi.support.reading import plain_document

FORMAT: Final = 1
FILE = "results.json"
OWN_HZ = "simulator_control_hz"  # among a run's options: control steps a second of the simulator's robot
_SAVE_EVERY_S = 3.0  # episodes of the last seconds are lost by a kill, and run again

Status = Literal["success", "failure", "aborted", "crash"]
Count = Annotated[int, Meta(ge=0, le=10**9)]
Time = Annotated[float, Meta(ge=0, le=1e12)]  # in seconds or milliseconds
Text = Annotated[str, Meta(pattern=r"\S")]
Plain = Mapping[str, object]  # an object of JSON that is shown and compared, whatever it holds


class Episode(Struct, frozen=True):
    """What became of one episode.

    status       success or failure: the simulator's verdict within the step limit; aborted: the policy's actions
                 weren't finite, which counts as a failure; crash: the simulator broke, which counts as nothing
    steps        control steps after the wait
    call_ms      for each time the policy was asked: the whole call, with the requests it was batched with
    infer_ms     the model's part of it, where the policy tells
    batch        for each of these calls, the requests that were answered together
    message      what the simulator or the policy said, if it isn't a plain success or failure
    video        the video's path in the run's folder
    motion       how smooth the commands were; None in files of 0.1
    real_time    what the wall clock showed, where the world advanced with it
    """

    task: Count
    initial_state: Count
    status: Status
    steps: Count
    seed: Annotated[int, Meta(ge=0)]  # below 2**64
    seconds: Time
    call_ms: list[Time] = []
    infer_ms: list[Time] = []
    batch: list[Annotated[int, Meta(ge=1, le=10**9)]] = []
    message: str | None = None
    video: str | None = None
    motion: Motion | None = None
    real_time: Paced | None = None

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


class PolicyDescription(Struct, frozen=True, omit_defaults=True):
    """What was evaluated. `identity` decides whether a run may be continued; `about` is for the report."""

    label: str | None = None  # None: the folder's name
    identity: Plain = {}
    about: Plain = {}


class TaskSummary(Struct, frozen=True):
    task: int
    instruction: str
    success: RateDocument
    crashes: int


class Summary(Struct, frozen=True):
    """What all episodes come to, those of a run that isn't complete too."""

    success: RateDocument
    tasks: list[TaskSummary]  # those with an episode
    episodes: int
    planned: int
    crashes: int
    aborted: int
    steps_to_success: Percentiles | None  # None: of nothing
    call_ms: Percentiles | None
    infer_ms: Percentiles | None
    mean_batch: float | None
    real_time: PacedSummary | None = None


class RunDocument(Struct, frozen=True):
    """results.json of an evaluation. `summary` and `complete` follow from the rest."""

    format: Literal[1]
    complete: bool
    protocol: Plain  # `Protocol`; other versions' may have other fields, which then tell two runs apart
    policy: PolicyDescription
    versions: Plain  # the simulator's, and `Provenance` of the machine that ran it
    options: Plain  # what doesn't change outcomes: workers, batches, videos
    started: Text  # ISO 8601, UTC
    updated: Text
    wall_seconds: Time  # of all processes that worked on it, one after the other
    summary: Summary
    tasks: list[Task]
    planned: list[Annotated[tuple[Count, Count], Meta(description="a task and an initial state")]]
    episodes: list[Episode]


class Results:
    """A run's episodes and what they were run with, in a folder."""

    def __init__(
        self,
        folder: Path,
        protocol: Plain,
        policy: PolicyDescription,
        tasks: Sequence[Task],
        versions: Plain,
        options: Plain,
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
        return self.folder.name if self.policy.label is None else self.policy.label

    @property
    def suite(self) -> str:
        return str(self.protocol["suite"])

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
            own, other = (one.get(name, _UNDELAYED.get(name)) for one in (mine, theirs))
            if own != other:
                raise ConfigError(
                    f"{self.folder} holds a run with {name} = {other!r}, but this one has {own!r}: give another --out, "
                    "or begin again (of `turbopi eval` with --restart, of a study by deleting that folder)"
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

    def summary(self) -> Summary:
        episodes = self.in_order()
        by_task = {index: [e for e in episodes if e.task == index] for index in sorted(self.tasks)}
        return Summary(
            success=rate(episodes).document,
            tasks=[
                TaskSummary(index, self.tasks[index].instruction, rate(own).document, sum(not e.judged for e in own))
                for index, own in by_task.items()
                if own
            ],
            episodes=len(episodes),
            planned=len(self.planned),
            crashes=sum(not e.judged for e in episodes),
            aborted=sum(e.status == "aborted" for e in episodes),
            steps_to_success=percentiles([e.steps for e in episodes if e.success]),
            call_ms=percentiles([ms for e in episodes for ms in e.call_ms]),
            infer_ms=percentiles([ms for e in episodes for ms in e.infer_ms]),
            mean_batch=_mean([size for e in episodes for size in e.batch]),
            real_time=self.real_time(),
        )

    @property
    def control_hz(self) -> float | None:
        """Control steps in a second of the wall clock, of a run in real time."""
        found = self.protocol.get("control_hz")
        return float(found) if isinstance(found, int | float) else None

    @property
    def rate(self) -> str:
        """How fast the world of a run in real time was."""
        assert self.control_hz is not None
        own = self.options.get(OWN_HZ)
        return rate_given(self.control_hz, float(own) if isinstance(own, int | float) else None)

    def real_time(self) -> PacedSummary | None:
        """What the wall clock showed; None if the world waited for the policy."""
        if self.control_hz is None:
            return None
        paced = [(e.steps, e.real_time) for e in self.episodes.values() if e.real_time is not None]
        return summarise_paced(paced, self.control_hz)

    def document(self) -> RunDocument:
        about = PolicyDescription(
            self.policy.label, plain_object(self.policy.identity), plain_object(self.policy.about)
        )
        return RunDocument(
            format=FORMAT,
            complete=self.complete,
            protocol=plain_object(self.protocol),
            policy=about,
            versions=plain_object(self.versions),
            options=plain_object(self.options),
            started=self.started,
            updated=_now(),
            wall_seconds=round(self.wall_seconds, 1),
            summary=self.summary(),
            tasks=[self.tasks[index] for index in sorted(self.tasks)],
            planned=sorted(self.planned),
            episodes=self.in_order(),
        )

    def as_json(self) -> dict[str, object]:
        return plain_document(self.document())

    def _decisive(self) -> Plain:
        simulator = {name: value for name, value in self.versions.items() if name == "simulator"}
        return {"protocol": self.protocol, "policy": self.policy.identity, "versions": simulator}


_UNDELAYED = {"protocol.execution": "sync", "protocol.delay": 0}  # what `protocol_json` leaves out


def protocol_json(protocol: Protocol) -> Plain:
    """As it looks after a round trip through JSON, so that it compares equal.

    What says that nothing is delayed is left out, as in files of 0.1, whose runs can be continued.
    """
    values = asdict(protocol)
    if protocol.control_hz is None:
        del values["control_hz"]
    if (protocol.execution, protocol.delay, protocol.control_hz) == ("sync", 0, None):
        del values["execution"], values["delay"]
    return plain_object(values)


def plain_object(values: Plain) -> dict[str, object]:
    """`values` as `plain` has them."""
    return {str(key): plain(item) for key, item in values.items()}


def plain(value: object) -> object:
    """`value` as JSON has it: arrays as lists, numbers that aren't finite as null, anything else as its text."""
    if isinstance(value, Mapping):
        return plain_object(value)
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


def _flat(value: object, name: str = "") -> dict[str, object]:
    if isinstance(value, Mapping):
        found: dict[str, object] = {}
        for key, item in value.items():
            found |= _flat(item, f"{name}.{key}" if name else str(key))
        return found
    return {name: value}


def _mean(values: Sequence[float]) -> float | None:
    return sum(values) / len(values) if values else None


def _now() -> str:
    return datetime.now(timezone.utc).isoformat(timespec="seconds")
