"""What the server has seen of its robots, and the watchers who see it live.

All of `Live` runs in the event loop, in a few microseconds a call; what takes longer is on its thread.
"""

import asyncio
import contextlib
import json
import logging
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Protocol

import msgspec
import numpy as np
from websockets.exceptions import ConnectionClosed
from websockets.frames import CloseCode

from turbopi.realtime.messages import notes_in
from turbopi.serve.connection import GuardedConnection
from turbopi.serve.limited_log import peer
from turbopi.serve.metrics import Metrics
from turbopi.serve.page.device import memory_of
from turbopi.serve.page.messages import (
    FEED_VERSION,
    Frame,
    Hello,
    Memory,
    Preview,
    RobotFrame,
    RobotNote,
    StageTimes,
    Trouble,
    clean,
)
from turbopi.serve.page.preview import make_preview
from turbopi.serve.requests import Reply
from turbopi.support.action_groups import ActionGroup, action_groups, known_groups, names_of
from turbopi.version import turbopi_version

logger = logging.getLogger(__name__)

FRAMES_A_SECOND = 4.0  # to each watcher
PREVIEWS_A_SECOND = 16.0  # of all robots together
MESSAGE_BYTES = 16 * 2**20  # of an observation: a longer one isn't stored for its preview
MAX_PENDING = 4  # previews that are being made or wait: other calls aren't shown
ROBOTS = 16  # shown, of those that are connected
MAX_LOST, LOST_SECONDS = 8, 900.0  # robots that are shown when they are gone, and for how long
TIMES = 60  # of a robot's answers
CALLS = 512  # whose times are stored
TROUBLES = 20
BINS = 60
STAGES = ("preprocess", "queue", "vision", "prefix", "denoise", "infer", "postprocess", "total", "request")

Timing = Mapping[str, float]


@dataclass
class _Robot:
    """A client that is connected, or was. What isn't said here: `RobotFrame`."""

    id: int
    address: str
    connected: float
    name: str = ""
    lost: float | None = None
    how: str = ""
    calls: int = 0
    last: float | None = None
    times: deque[float] = field(default_factory=lambda: deque(maxlen=TIMES))
    deadline: float | None = None
    timed: int = 0
    missed: int = 0
    batch: int = 1
    rows: int | None = None
    preview: Preview | None = None
    previewed: float = -np.inf  # the event loop's time
    pending: bool = False
    notes: list[RobotNote] = field(default_factory=list)
    refusal: RobotNote | None = None

    @property
    def title(self) -> str:
        return clean(self.name) or self.address


@dataclass(frozen=True)
class _Moment:
    """The server's state, for a frame that is put together on the thread."""

    time: float
    requests: int
    clients: int
    waiting: int
    running: bool
    lost: str | None
    errors: dict[str, int]
    troubles: Sequence[Trouble]
    timings: Sequence[Timing]
    batches: Sequence[int]
    timed: int
    missed: int
    robots: Sequence[RobotFrame]


class Queue(Protocol):
    """What the page shows of the requests that wait, and whether one runs."""

    @property
    def waiting(self) -> int: ...

    @property
    def running(self) -> bool: ...


class Live:
    """What robots did, for those who watch. `start` it before anybody is let in; `let_go`, then `close` it."""

    def __init__(self, metrics: Metrics, queue: Queue, why_lost: Callable[[], str | None]) -> None:
        self._metrics, self._queue, self._why_lost = metrics, queue, why_lost
        self._robots: dict[GuardedConnection, _Robot] = {}
        self._lost: deque[_Robot] = deque(maxlen=MAX_LOST)
        self._known = self._timed = self._missed = 0
        self._timings: deque[Timing] = deque(maxlen=CALLS)
        self._batches: deque[int] = deque(maxlen=CALLS)
        self._troubles: deque[Trouble] = deque(maxlen=TROUBLES)
        self._watchers = 0
        self._pending: set[asyncio.Task[None]] = set()
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="turbopi-page")
        self._closed = asyncio.Event()
        self._hello = ""
        self._faulty = False
        self._memory: Callable[[], Memory] = memory_of("cpu")

    def start(self, metadata: Mapping[str, Any], queue_limit: int) -> None:
        """The policy is ready; `metadata` is what clients are sent of it."""
        robot, dims = metadata.get("robot", ""), metadata.get("robot_action_dim", 0)
        self._memory = memory_of(str(metadata.get("device", "cpu")))
        hello = Hello(
            feed=FEED_VERSION,
            turbopi=turbopi_version(),
            started=time.time(),
            queue_limit=queue_limit,
            policy=json.loads(json.dumps(metadata, default=_plain, skipkeys=True)),
            actions=_groups(robot, dims, names_of(metadata, "actions")) if isinstance(dims, int) else [],
        )
        self._hello = _json(hello)

    def begin_stop(self) -> None:
        """The server stops: end the watchers' feed, and make no more previews."""
        self._closed.set()

    async def close(self) -> None:
        """End the thread. No watcher may be left."""
        await asyncio.gather(*self._pending)
        self._thread.shutdown(wait=False)

    # --- robots -------------------------------------------------------------------------------------------------------

    def connected(self, connection: GuardedConnection) -> None:
        self._known += 1
        self._robots[connection] = _Robot(self._known, peer(connection), time.time())

    def disconnected(self, connection: GuardedConnection, how: str) -> None:
        """`how`: what the end of the connection said of itself, "" for nothing."""
        robot = self._robots.pop(connection, None)
        if robot is not None and (robot.calls or robot.refusal) and not self._is_back(robot.name):
            robot.lost, robot.how, robot.preview = time.time(), clean(how), None
            self._lost.append(robot)

    def answered(
        self, connection: GuardedConnection, message: bytes | memoryview, reply: Reply, seconds: float
    ) -> None:
        """`reply` was sent, `seconds` after `message` had come. They must not change any more."""
        robot, result, scheduling = self._known_by_name(connection), reply.result, reply.scheduling
        robot.calls += 1
        robot.last = time.time()
        robot.refusal = None
        robot.notes = [
            RobotNote(one.kind, [clean(name, 60) for name in one.names], clean(one.text)) for one in notes_in(result)
        ]
        robot.deadline = scheduling.deadline * 1e3 if scheduling.firm else None
        robot.batch, robot.rows = int(result["server_timing"].get("batch", 1)), scheduling.batch
        if scheduling.firm:
            self._count_deadline(robot, missed=seconds > scheduling.deadline)
        timing = _timing(result, seconds)
        robot.times.append(timing["request"])
        self._timings.append(timing)
        self._batches.append(robot.batch)
        if not self._watchers or robot.pending or len(self._pending) >= MAX_PENDING or self._closed.is_set():
            return
        now = asyncio.get_running_loop().time()
        if now - robot.previewed >= max(1 / FRAMES_A_SECOND, len(self._robots) / PREVIEWS_A_SECOND):
            robot.previewed, robot.pending = now, True
            shown = bytes(message) if len(message) <= MESSAGE_BYTES else None
            task = asyncio.ensure_future(self._make_preview(robot, shown, reply, timing))
            self._pending.add(task)
            task.add_done_callback(self._pending.discard)

    @property
    def watched(self) -> bool:
        """Whether somebody looks at the page."""
        return bool(self._watchers)

    def noted(self, connection: GuardedConnection, kind: str, text: str) -> None:
        """The log has a note on a robot's call."""
        self._troubles.append(Trouble(time.time(), kind, f"{self._known_by_name(connection).title}: {clean(text)}"))

    def refused(self, connection: GuardedConnection, kind: str, text: str) -> None:
        """A request got no actions; `text` is what the client was sent, or its last line."""
        robot = self._known_by_name(connection)
        robot.refusal = RobotNote(kind, [], clean(text))
        if kind == "late":
            self._count_deadline(robot, missed=True)
        self._troubles.append(Trouble(time.time(), kind, f"{robot.title}: {clean(text)}"))

    def _known_by_name(self, connection: GuardedConnection) -> _Robot:
        """The robot of a connection. One that is back under its name goes on where it was."""
        robot = self._robots[connection]
        if robot.name != connection.robot:
            robot.name = connection.robot
            before = next((one for one in self._lost if one.name == robot.name), None)
            if before is not None:
                self._lost.remove(before)
                robot.id, robot.calls = before.id, before.calls + robot.calls
        return robot

    def _is_back(self, name: str) -> bool:
        """Whether a robot of that name is connected: its connection before may end later than the next one begins."""
        return bool(name) and any(robot.name == name for robot in self._robots.values())

    def _count_deadline(self, robot: _Robot, *, missed: bool) -> None:
        robot.timed, robot.missed = robot.timed + 1, robot.missed + missed
        self._timed, self._missed = self._timed + 1, self._missed + missed

    async def _make_preview(self, robot: _Robot, message: bytes | None, reply: Reply, timing: Timing) -> None:
        loop, number, last = asyncio.get_running_loop(), robot.calls, robot.last
        assert last is not None
        make = partial(make_preview, number, last, message, reply.result, reply.state, timing)
        try:
            robot.preview = await loop.run_in_executor(self._thread, make)
        except Exception:  # a fault of the page must not cost a robot anything
            if not self._faulty:  # once: it may come with every call
                logger.exception("the page can't show a call")
            self._faulty = True
        finally:
            robot.pending = False

    # --- watchers -----------------------------------------------------------------------------------------------------

    async def watch(self, connection: GuardedConnection) -> None:
        """Send the feed to one watcher until it leaves or the server stops. It has nothing to say itself."""
        says, closed = asyncio.ensure_future(connection.recv()), asyncio.ensure_future(self._closed.wait())
        sent: dict[int, int] = {}  # robot -> number of the last preview that was sent
        self._watchers += 1
        try:
            await connection.send(self._hello)
            while not (says.done() or closed.done()):
                await connection.send(await self._frame(sent))  # a slow reader is sent fewer
                await asyncio.wait({says, closed}, timeout=1 / FRAMES_A_SECOND, return_when=asyncio.FIRST_COMPLETED)
            if says.done():
                says.result()
                connection.answered("bad")
                await connection.close(CloseCode.POLICY_VIOLATION, "the feed takes no messages")
            else:
                await connection.close(CloseCode.GOING_AWAY, "the server is shutting down")
        except ConnectionClosed:
            pass
        finally:
            self._watchers -= 1
            for wait in (says, closed):
                wait.cancel()
                with contextlib.suppress(asyncio.CancelledError, ConnectionClosed):
                    await wait

    async def _frame(self, sent: dict[int, int]) -> str:
        moment = self._moment(sent)
        sent.update({robot.id: robot.preview.number for robot in moment.robots if robot.preview is not None})
        for robot_id in sent.keys() - {robot.id for robot in moment.robots}:
            del sent[robot_id]
        return await asyncio.get_running_loop().run_in_executor(self._thread, _frame_of, moment, self._memory)

    def _moment(self, sent: Mapping[int, int]) -> _Moment:
        now = time.time()
        while self._lost and now - (self._lost[0].lost or now) > LOST_SECONDS:
            self._lost.popleft()
        latest = sorted(self._robots.values(), key=lambda robot: robot.last or robot.connected)[-ROBOTS:]
        return _Moment(
            time=now,
            requests=self._metrics.requests_so_far(),
            clients=len(self._robots),
            waiting=self._queue.waiting,
            running=self._queue.running,
            lost=self._why_lost(),
            errors=self._metrics.errors_so_far(),
            troubles=tuple(self._troubles),
            timings=tuple(self._timings),
            batches=tuple(self._batches),
            timed=self._timed,
            missed=self._missed,
            robots=[_robot_frame(robot, sent) for robot in sorted([*latest, *self._lost], key=lambda robot: robot.id)],
        )


def _robot_frame(robot: _Robot, sent: Mapping[int, int]) -> RobotFrame:
    new = robot.preview if robot.preview is not None and robot.preview.number != sent.get(robot.id) else None
    return RobotFrame(
        id=robot.id,
        name=clean(robot.name),
        address=robot.address,
        connected=robot.connected,
        lost=robot.lost,
        how=robot.how,
        calls=robot.calls,
        last=robot.last,
        times=[round(one, 2) for one in robot.times],
        deadline=robot.deadline,
        timed=robot.timed,
        missed=robot.missed,
        batch=robot.batch,
        rows=robot.rows,
        notes=robot.notes,
        refusal=robot.refusal,
        preview=new,
    )


def _groups(robot: object, dims: int, names: Sequence[str] | None) -> list[ActionGroup]:
    """How the page groups the actions: those of a robot that nobody described are one group."""
    groups = action_groups(str(robot), dims, names)
    if not groups or groups == known_groups(str(robot)):
        return groups
    return [ActionGroup("actions", groups[0].unit, {i: name for one in groups for i, name in one.names.items()})]


def _timing(reply: Mapping[str, object], seconds: float) -> Timing:
    """{stage: milliseconds} of STAGES, as far as the policy reports them."""
    given = reply.get("policy_timing")
    given = given if isinstance(given, Mapping) else {}
    found = {stage: given.get(f"{stage}_ms") for stage in STAGES}
    numbers = {stage: float(value) for stage, value in found.items() if isinstance(value, int | float)}
    return numbers | {"request": seconds * 1e3}


def _frame_of(moment: _Moment, memory: Callable[[], Memory]) -> str:
    width, latency = stage_times(moment.timings)
    return _json(
        Frame(
            time=moment.time,
            requests=moment.requests,
            clients=moment.clients,
            waiting=moment.waiting,
            running=moment.running,
            lost=moment.lost,
            memory=memory(),
            errors=moment.errors,
            troubles=list(moment.troubles),
            latency_bin_ms=width,
            latency=latency,
            batches=dict(Counter(moment.batches)),
            timed=moment.timed,
            missed=moment.missed,
            robots=list(moment.robots),
        )
    )


def stage_times(timings: Sequence[Timing]) -> tuple[float, list[StageTimes]]:
    """Width of a bin in milliseconds, and the times of each stage that was reported: all stages share the bins.

    They reach somewhat beyond the longest stage's 99th percentile, so that one slow call doesn't squeeze all others.
    """
    of_stage = {stage: _finite(timing[stage] for timing in timings if stage in timing) for stage in STAGES}
    of_stage = {stage: values for stage, values in of_stage.items() if len(values)}
    longest = max((float(np.percentile(values, 99)) for values in of_stage.values()), default=0.0)
    width = max(1.2 * longest, 1e-3) / BINS
    found = []
    for stage, values in of_stage.items():
        bins = np.bincount(np.clip(values // width, 0, BINS - 1).astype(np.int64), minlength=BINS)
        p50, p95 = np.percentile(values, (50, 95))
        found.append(StageTimes(stage, len(values), float(p50), float(p95), float(values.max()), bins.tolist()))
    return width, found


def _finite(values: Iterable[float]) -> np.ndarray:
    array = np.array(list(values), np.float64)
    return array[np.isfinite(array)]


def _json(message: Hello | Frame) -> str:
    return msgspec.json.encode(message).decode()


def _plain(value: object) -> object:
    """Metadata that JSON doesn't know: NumPy's as lists and numbers, all else as its text."""
    return value.tolist() if hasattr(value, "tolist") else str(value)
