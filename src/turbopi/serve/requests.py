"""A request's life: from a message of a client to the answer that is sent.

    decode   msgpack -> a map
    read     the map -> ClientRequest: the observation, its call options and scheduling options
    run      ClientRequest -> scheduling.schedule.Request, submitted to `Calls`; one Result an observation
    answer   results -> the map to send, or the refusal

docs/dev/request.md follows one observation all the way; docs/serving_sessions.md has the keys as tables.
"""

import asyncio
import re
import time
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal, NamedTuple, Protocol

import numpy as np

from turbopi.policy.watch import READING, Reading, Watch
from turbopi.realtime.messages import (
    MAX_STEP,
    MOST_NOTES,
    NOTES,
    PREFIX,
    SCHEDULING_KEYS,
    Note,
    as_name,
    as_number,
    is_plain,
    notes_in,
)
from turbopi.realtime.wire import Unpacker, WireError, pack
from turbopi.serve.connection import GuardedConnection
from turbopi.serve.memory import Histories
from turbopi.serve.metrics import Metrics
from turbopi.serve.options import MAX_CONTROL_HZ, MAX_DEADLINE_MS, ServerOptions
from turbopi.serve.real_time import GENERATE, MAX_SESSIONS, Plan, RealTime
from turbopi.serve.scheduling.schedule import PRIORITIES, Priority, Request
from turbopi.support.errors import ObservationError

MAX_BATCH_ROWS = 1024  # B of one batch message
LARGE = 4 * 2**20  # bytes of a message that is decoded beside the event loop
TIMING = "policy_timing"
_TRACEPARENT = re.compile(r"[0-9a-f]{2}-[0-9a-f]{32}-[0-9a-f]{16}-[0-9a-f]{2}")
REFUSALS = {  # texts by kind of error; all others are sent as they are
    "observation": "bad observation: {}",
    "actions": "bad actions: {}",
    "lost": "the device is lost: {}",
    "replica": "the replica is lost: {}",
}

ErrorKind = Literal["observation", "actions", "lost", "replica", "policy", "busy", "late", "replaced", "stopping"]


@dataclass(frozen=True)
class Result:
    """Of one observation: the policy's `answer`, or the kind of `error` and its `text`.

    error    "observation": the client's fault; "actions": the model's actions may not reach a robot; "lost": the device
             failed for good; "replica": a fleet's replica gave no answer; "policy": any other failure of the policy,
             `text` is the traceback; "busy", "late", "replaced", "stopping": it got no turn
    seconds  in the policy
    batch    observations in its run
    run      the run's number: observations of one run share it
    began    when its run began, in time.perf_counter(); 0: it had none in this process, or failed
    """

    seconds: float
    answer: dict[str, Any] | None = None
    error: ErrorKind | None = None
    text: str = ""
    batch: int = 1
    run: int = 0
    began: float = 0.0


STOPPING = Result(0.0, error="stopping", text="the server is shutting down")


class Calls(Protocol):
    """Where requests are computed: calls.PolicyCalls, in this process, or the replicas of a fleet."""

    @property
    def waiting(self) -> int:
        """Requests that wait for their turn, as far as this process knows."""

    @property
    def running(self) -> bool: ...

    @property
    def largest(self) -> int:
        """Observations of the largest batch message that isn't split."""

    @property
    def unwell(self) -> str | None:
        """Why no request can be computed at the moment, if known: `/healthz` answers with it."""

    def waits(self, session: str) -> bool:
        """Whether a request of that session waits: a newer one would replace it."""

    async def warm_up(self, **arguments: Any) -> None:
        """Be ready for requests. `arguments` are those of the policy's `warmup`; raises what it raises."""

    def submit(
        self, request: Request, observation: dict[str, Any], arguments: Mapping[str, Any]
    ) -> "asyncio.Future[list[Result]]":
        """One result, once the request had its turn or is refused one. May be cancelled.

        arguments  of the policy's `infer`, besides the observation
        """

    async def submit_batch(
        self, make: Callable[[int, int], Request], row: Callable[[int], dict[str, Any]], rows: int
    ) -> list[Result]:
        """A result of each of `rows` observations, up to the first few that hold an error.

        make  the request for a part: of its rows, and of the rows that follow in later parts
        row   the observation of a row, from 0
        """

    def stop(self) -> None:
        """Refuse the requests that wait, and all new ones; the running turn goes on."""

    async def drain(self) -> None:
        """Wait for what runs. Call `stop` first."""

    def close(self) -> None:
        """Submit nothing more, and end the threads; they aren't waited for long."""


# --- handling ---------------------------------------------------------------------------------------------------------


class Refusal(NamedTuple):
    """Why a request gets no actions: `kind` for the metrics, `text` for the client."""

    kind: str
    text: str


class Reply(NamedTuple):
    """The map to send, with "server_timing", what the request said about scheduling, and the notes for the log.

    state  of the robot, as the policy read it; empty if it doesn't tell, and for a batch
    sent   when the policy's thread has sent it; None: it is still to be sent
    """

    result: dict[str, Any]
    scheduling: "SchedulingOptions"
    notes: Sequence[Note] = ()
    state: Sequence[float] = ()
    sent: float | None = None


class ClientLeft(Exception):
    """The client disconnected before its actions were ready."""


class PolicyFailed(Exception):
    """The policy raised something that isn't the client's fault; holds the traceback's text."""


@dataclass(eq=False)
class ClientRequest:
    """A message that was read: what to run (`plan`), when (`scheduling`), and for whom.

    results    once it is submitted
    submitted  when that was, in time.perf_counter()
    reply      once it is made on the policy's thread
    """

    plan: Plan
    scheduling: "SchedulingOptions"
    connection: GuardedConnection
    arrived: float
    results: "asyncio.Future[list[Result]] | None" = None
    submitted: float = 0.0
    reply: Reply | None = None

    def scheduled(self, rows: int = 1, remaining: int = 0) -> Request:
        """What the schedule gets, for `rows` observations of which `remaining` others follow in later parts."""
        scheduling, connection = self.scheduling, self.connection
        first = rows + remaining == (scheduling.batch or 1)
        # Without a deadline of its own, a message's later part queues behind requests that came meanwhile.
        queued = self.arrived if first or scheduling.firm else time.perf_counter()
        return Request(
            arrived=self.arrived,
            deadline=queued + scheduling.deadline,
            firm=scheduling.firm,
            priority=scheduling.priority,
            source=connection.id.int,  # a UUID is hashed by Python
            slowed=connection.slowed,
            session=self.plan.name,
            rows=rows,
            later=remaining,
            alone=connection.bad_in_a_row
            > 0,  # after a bad request the next is likely bad, too: it must spoil no batch
        )


Begun = ClientRequest | Refusal


class RequestHandler:
    """Handles the requests of all clients of one policy. For the event loop's thread alone.

    histories  of the robots, for a policy with memory
    strict    a batch message above the largest batch that was measured is refused instead of split
    why_lost  why no request can be served any more; None while all is well
    """

    def __init__(
        self,
        calls: Calls,
        real_time: RealTime,
        metrics: Metrics,
        options: ServerOptions,
        max_bytes: int,
        *,
        histories: Histories | None,
        strict: bool,
        why_lost: Callable[[], str | None],
    ) -> None:
        self._calls, self._real_time, self._metrics, self._options = calls, real_time, metrics, options
        self._max_bytes, self._strict, self._why_lost = max_bytes, strict, why_lost
        self._histories = histories
        self._usual = read_scheduling({}, options.deadline_ms)
        self._watches: OrderedDict[str, Watch] = OrderedDict()  # of named sessions, the last used one at the end
        self._decoder = ThreadPoolExecutor(1, thread_name_prefix="turbopi-decoding")

    async def take(self, connection: GuardedConnection, message: str | bytes | memoryview, arrived: float) -> "Begun":
        """`begin`, of a message of any size."""
        if len(message) < LARGE:
            return self.begin(connection, message, arrived)
        started, loop = time.perf_counter(), asyncio.get_running_loop()
        decoded = loop.run_in_executor(self._decoder, decode, message, self._max_bytes, Unpacker())
        await asyncio.wait((decoded,))
        connection.took(time.perf_counter() - started)
        return self._begin(connection, message, decoded.result, arrived)

    def begin(self, connection: GuardedConnection, message: str | bytes | memoryview, arrived: float) -> "Begun":
        """Submit the request that a message holds, without waiting. For its results call `finish`, or `drop`."""
        return self._begin(connection, message, partial(self._decode, connection, message), arrived)

    def _begin(
        self,
        connection: GuardedConnection,
        message: str | bytes | memoryview,
        received: Callable[[], dict[str, Any]],
        arrived: float,
    ) -> "Begun":
        if (lost := self._why_lost()) is not None:
            return Refusal("lost", REFUSALS["lost"].format(lost))
        try:
            request = self.read(received(), connection, arrived)
        except WireError as error:
            return Refusal("malformed", f"bad request: {error}")
        except ObservationError as error:
            return Refusal("observation", REFUSALS["observation"].format(error))
        request.submitted = time.perf_counter()
        assert not isinstance(message, str)  # else it was refused
        request.results = self._submit(request, message)
        return request

    async def finish(self, request: ClientRequest) -> Reply | Refusal:
        """The reply to a request. Raises PolicyFailed and ClientLeft."""
        try:
            results = await self._results(request)
        except ClientLeft:
            if request.reply is None or request.reply.sent is None:
                raise
            self._metrics.scheduled(request.scheduling.priority, None)
            return request.reply  # it left with its answer, before this task woke: that counts, and is recorded
        failed = first_error(request, results)
        self._metrics.scheduled(request.scheduling.priority, None if failed is None else failed.error)
        if failed is None:
            return request.reply or self._reply(request, results)
        if failed.error == "policy":
            raise PolicyFailed(failed.text)
        assert failed.error is not None
        return Refusal(failed.error, REFUSALS.get(failed.error, "{}").format(failed.text))

    def close(self) -> None:
        """End the decoding thread. It isn't waited for."""
        self._decoder.shutdown(wait=False)

    def _decode(self, connection: GuardedConnection, message: str | bytes | memoryview) -> dict[str, Any]:
        """The message as a map. Raises WireError."""
        started = time.perf_counter()
        try:
            return decode(message, self._max_bytes, connection.unpacker)
        finally:
            connection.took(time.perf_counter() - started)

    def read(self, received: Mapping[str, Any], connection: GuardedConnection, arrived: float) -> ClientRequest:
        """Raises ObservationError for keys and values that can't be right."""
        scheduling = self._usual
        if not is_plain(received):
            scheduling = read_scheduling(received, self._options.deadline_ms, self._options.control_hz)
            connection.robot = read_robot(received) or connection.robot
        if scheduling.batch is None:
            plan = self._real_time.plan(received, connection)
            connection.robot = connection.robot or plan.name or connection.posted
            histories = None if GENERATE in plan.arguments else self._histories
            if connection.posted and plan.name is None and (plan.session or histories):
                self._real_time.release(plan)
                raise ObservationError(
                    f"a POST needs {PREFIX}session here: this server goes on from a robot's earlier requests, and each "
                    "POST is a connection of its own"
                )
            if histories is not None:
                try:
                    histories.begin(plan, connection)
                except ObservationError:
                    self._real_time.release(plan)
                    raise
            return ClientRequest(plan, scheduling, connection, arrived)
        if self._histories is not None:
            raise ObservationError(
                f"{PREFIX}batch came to a policy with memory, which keeps a history of each robot: send the "
                "observations one by one, each robot's in its own session"
            )
        check_batch_keys(received, execution=self._options.execution is not None)
        largest = self._calls.largest
        if self._strict and scheduling.batch > largest:
            raise ObservationError(
                f"{PREFIX}batch is {scheduling.batch}, and the largest batch that warm-up covered is {largest}: a "
                "server with --strict splits none. Send smaller ones, or start it with a larger --max-batch"
            )
        plan = self._real_time.plan(received, connection)
        check_batch_shapes(plan.observation, scheduling.batch)
        return ClientRequest(plan, scheduling, connection, arrived)

    def drop(self, request: ClientRequest) -> None:
        """Its client has left before anybody waited for its results."""
        assert request.results is not None
        request.results.cancel()
        self._release(request.plan)

    def _submit(self, request: ClientRequest, message: bytes | memoryview) -> "asyncio.Future[list[Result]]":
        plan, batch = request.plan, request.scheduling.batch
        if batch is None:
            scheduled = request.scheduled()
            scheduled.message = message
            if plan.session is None and plan.name is None and self._histories is None:
                scheduled.answer = partial(self._answer_at_once, request)
            return self._calls.submit(scheduled, plan.observation, plan.arguments)
        row = partial(batch_row, plan.observation)
        return asyncio.ensure_future(self._calls.submit_batch(request.scheduled, row, batch))

    async def _results(self, request: ClientRequest) -> list[Result]:
        """A result of each observation. Raises ClientLeft if the client leaves first."""
        results, disconnected = request.results, request.connection.connection_lost_waiter
        assert results is not None

        def cancel(_: object) -> None:
            results.cancel()

        disconnected.add_done_callback(cancel)
        try:
            return await results  # without a task of its own, which would cost several turns of the event loop
        except asyncio.CancelledError:
            if disconnected.done():
                raise ClientLeft from None
            raise
        finally:
            disconnected.remove_done_callback(cancel)
            self._release(request.plan)

    def _release(self, plan: Plan) -> None:
        self._real_time.release(plan)
        if self._histories is not None:
            self._histories.release(plan)

    def _reply(self, request: ClientRequest, results: Sequence[Result]) -> Reply:
        """Of results that all have actions. On any thread, if all that it touches is the connection's own."""
        state = _state_of(request, results)
        noted = self._note(request, results)
        return Reply(self._answer(request, results), request.scheduling, noted, state)

    def _answer_at_once(self, request: ClientRequest, result: Result) -> None:
        """Send the reply, if there is one and that can be done now: not by the task of its connection, but sooner."""
        if request.reply is not None or result.error is not None:
            return
        request.reply = reply = self._reply(request, [result])
        try:
            packed = pack(reply.result)
        except WireError:  # the event loop's thread says so
            return
        if request.connection.send_at_once(packed):
            request.reply = reply._replace(sent=time.perf_counter())

    def _note(self, request: ClientRequest, results: Sequence[Result]) -> list[Note]:
        """Put notes in place of the readings of a request's answers. Returns those that the log hasn't said yet."""
        batch, new = request.scheduling.batch, []
        watch = self._watch_of(request) if batch is None else request.connection.batch_watch
        for result in results:
            assert result.answer is not None
            reading = result.answer.get(READING)
            if not isinstance(reading, Reading):
                continue
            del result.answer[READING]
            if not (notes := watch.notes(reading)):
                continue
            result.answer[NOTES] = [note.plain for note in notes]
            new += watch.to_log(notes)
            for note in notes:
                self._metrics.note(note.kind)
        if request.plan.remembered is not None:
            new += self._remember(request, results[0], watch)
        return new

    def _remember(self, request: ClientRequest, result: Result, watch: Watch) -> list[Note]:
        """Put what was recorded into a request's answer. Returns what the log hasn't said yet."""
        assert self._histories is not None and result.answer is not None
        found, note = self._histories.finish(request.plan, result.answer)
        result.answer.update(found)
        if note is None:
            return []
        result.answer[NOTES] = [*result.answer.get(NOTES, ()), note.plain]
        self._metrics.note(note.kind)
        return watch.to_log([note])

    def _watch_of(self, request: ClientRequest) -> Watch:
        """Of the robot: of its session, if that has a name, else of its connection."""
        name, watch = request.plan.name, request.connection.watch
        if name is not None:
            watch = self._watches.setdefault(name, Watch())
            self._watches.move_to_end(name)
            if len(self._watches) > MAX_SESSIONS:
                self._watches.popitem(last=False)
        if request.plan.requested.reset:
            watch.reset()
        return watch

    def _answer(self, request: ClientRequest, results: Sequence[Result]) -> dict[str, Any]:
        """The map to send, of results that all have actions; with "server_timing"."""
        answers = [result.answer for result in results if result.answer is not None]
        runs = list({result.run: result for result in results}.values())
        server_timing: dict[str, float] = {"infer_ms": sum([run.seconds for run in runs]) * 1e3}
        if (largest := max([run.batch for run in runs])) > 1:
            server_timing["batch"] = largest
        if request.connection.cycle_s is not None:
            server_timing["prev_total_ms"] = request.connection.cycle_s * 1e3
        if request.scheduling.batch is None:
            (answer,) = answers
            return {**self._real_time.finish(request.plan, answer), "server_timing": server_timing}
        timing = sum_timings([run.answer.get(TIMING, {}) for run in runs if run.answer is not None])
        stacked = {**stack_answers(answers), TIMING: timing, "server_timing": server_timing}
        noted = [{**note.plain, "row": row} for row, answer in enumerate(answers) for note in notes_in(answer)]
        return {**stacked, NOTES: noted[:MOST_NOTES]} if noted else stacked


def decode(message: str | bytes | memoryview, max_bytes: int, unpacker: Unpacker) -> dict[str, Any]:
    """The map that a message holds. Raises WireError."""
    if isinstance(message, str):
        raise WireError("a request is a binary frame with a msgpack map, not a text frame")
    observation = unpacker.unpack(message, max_bytes=max_bytes)
    if not isinstance(observation, dict):
        raise WireError(f"a request is a map of observation keys to values, not {type(observation).__name__}")
    if not {str}.issuperset(map(type, observation)):
        raise WireError("the keys of an observation are strings (msgpack str), not bytes (msgpack bin)")
    return observation


def _state_of(request: ClientRequest, results: Sequence[Result]) -> Sequence[float]:
    reading = (results[0].answer or {}).get(READING) if request.scheduling.batch is None else None
    return reading.state if isinstance(reading, Reading) else ()


def first_error(request: ClientRequest, results: Sequence[Result]) -> Result | None:
    """The first result without actions, its row in the text; None if all have actions."""
    batch = request.scheduling.batch
    for row, result in enumerate(results):
        if result.error in ("observation", "actions") and batch is not None:
            return replace(result, text=f"row {row} of {batch} (from 0): {result.text}")
        if result.error == "actions" and (previous := request.plan.requested.previous) is not None:
            largest = float(abs(previous.left_over).max())
            text = f"{result.text}. This request's {PREFIX}previous has values up to {largest:.3g}, and most "
            text += "normalised actions are from -1 to 1: if they are far off, look there first"
            return replace(result, text=text)
        if result.error is not None:
            return result
    return None


# --- scheduling options -----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class SchedulingOptions:
    """When a request wants its answer, and for whom: optional keys of a message, which the policy never sees.

    deadline  seconds from its arrival to its answer
    firm      the client gave this deadline: a request that can't meet it is refused. False: it is the server's default,
              for which nothing is refused
    priority  robots come before simulators
    batch     B of a batch message; None: one observation, without a batch axis
    traceparent
              of the client's own trace (W3C Trace Context); empty if it gives none
    """

    deadline: float
    firm: bool = False
    priority: Priority = "robot"
    batch: int | None = None
    traceparent: str = ""


def read_robot(received: Mapping[str, Any]) -> str:
    """The name that a robot gives itself, "" for none. Raises ObservationError."""
    key = f"{PREFIX}robot"
    return as_name("robot", received[key], "the robot's name, ") if key in received else ""


def read_scheduling(
    received: Mapping[str, Any], default_ms: float, control_hz: float | None = None
) -> SchedulingOptions:
    """The scheduling options of a message. Raises ObservationError for values that can't be right.

    default_ms  the deadline of a message that gives none
    control_hz  of robots that don't give it; None: unknown
    """
    given = {key: received[PREFIX + key] for key in SCHEDULING_KEYS if PREFIX + key in received}
    if not given:
        return SchedulingOptions(default_ms / 1e3)
    batch = _whole(given, "batch", 1, MAX_BATCH_ROWS)
    priority = given.get("priority", "robot" if batch is None else "simulator")
    if not isinstance(priority, str) or priority not in PRIORITIES:
        raise ObservationError(f"{PREFIX}priority is {priority!r:.100}; it should be one of {', '.join(PRIORITIES)}")
    deadline = _deadline(given, control_hz)
    seconds = default_ms / 1e3 if deadline is None else deadline
    return SchedulingOptions(seconds, deadline is not None, priority, batch, _traceparent(given))


def _traceparent(given: Mapping[str, Any]) -> str:
    value = given.get("traceparent", "")
    if not isinstance(value, str) or ("traceparent" in given and not _TRACEPARENT.fullmatch(value)):
        raise ObservationError(
            f"{PREFIX}traceparent is {value!r:.100}; it should be as in W3C's Trace Context, such as "
            "'00-0af7651916cd43dd8448eb211c80319c-b7ad6b7169203331-01'"
        )
    return value


def _deadline(given: Mapping[str, Any], control_hz: float | None) -> float | None:
    """Seconds; None if the message gives no deadline."""
    if "deadline_ms" in given:
        for other in ("left", "control_hz"):
            if other in given:
                raise ObservationError(f"{PREFIX}deadline_ms and {PREFIX}{other} were both given: one deadline will do")
        milliseconds = _number(given, "deadline_ms", MAX_DEADLINE_MS)
        if milliseconds <= 0:
            raise ObservationError(
                f"{PREFIX}deadline_ms is {milliseconds:g}: that has passed when the request comes. It should be the "
                f"milliseconds from its arrival to its answer, more than 0 and at most {MAX_DEADLINE_MS:g}"
            )
        return milliseconds / 1e3
    hz = _number(given, "control_hz", MAX_CONTROL_HZ) if "control_hz" in given else control_hz
    if "control_hz" in given and (hz is None or hz <= 0):
        raise ObservationError(f"{PREFIX}control_hz is {hz:g}; it should be more than 0")
    if "left" not in given:
        if "control_hz" in given:
            raise ObservationError(
                f"{PREFIX}control_hz came without {PREFIX}left, the actions that the robot has left to carry out"
            )
        return None
    left = _whole(given, "left", 0, MAX_STEP)
    assert left is not None
    if hz is None:
        raise ObservationError(
            f"{PREFIX}left came without {PREFIX}control_hz, the actions that the robot carries out in a second"
        )
    if left == 0:
        raise ObservationError(
            f"{PREFIX}left is 0, so the deadline has passed when the request comes: a robot that has nothing left to "
            "carry out leaves the key out"
        )
    return min(left / hz, MAX_DEADLINE_MS / 1e3)


def _number(given: Mapping[str, Any], key: str, most: float) -> float:
    value = as_number(given[key])
    if value is None or not -MAX_STEP <= value <= most:  # NaN isn't, nor a whole number too large for a float
        shown = f"{PREFIX}{key} is {given[key]!r:.100}"
        raise ObservationError(f"{shown}; it should be a number, more than 0 and at most {most:g}")
    return float(value)


def _whole(given: Mapping[str, Any], key: str, least: int, most: int) -> int | None:
    if key not in given:
        return None
    value = as_number(given[key])
    if not isinstance(value, int) or not least <= value <= most:
        shown = f"{PREFIX}{key} is {given[key]!r:.100}"
        raise ObservationError(f"{shown}; it should be a whole number from {least} to {most}")
    return value


# --- batch messages ---------------------------------------------------------------------------------------------------
# B observations in one map, and their B answers in one. Arrays have the batch axis in front, [B, …]. A text holds for
# all rows; a list of B texts has one for each.


def check_batch_keys(received: Mapping[str, Any], execution: bool) -> None:
    """Raise ObservationError for a batch message with keys that a batch can't have.

    execution  the server conditions plain requests on their previous chunks (--execution)
    """
    others = [key for key in received if key.startswith(PREFIX) and key.removeprefix(PREFIX) not in SCHEDULING_KEYS]
    if others:
        raise ObservationError(
            f"{PREFIX}batch and {others[0]} were both given: a batch of observations joins no chunks and has no "
            "session. Send such observations one by one"
        )
    if execution:
        raise ObservationError(
            f"{PREFIX}batch came to a server that joins each client's chunks (--execution): a batch joins none. Send "
            "the observations one by one, or to a server without --execution"
        )


def check_batch_shapes(observations: Mapping[str, Any], batch: int, parent: str = "") -> None:
    """Raise ObservationError unless each entry has `batch` rows, or one value for all."""
    for key, value in observations.items():
        name = f"{parent}{key}"
        if isinstance(value, Mapping):
            check_batch_shapes(value, batch, f"{name}/")
        elif isinstance(value, np.ndarray) and value.ndim:
            if len(value) != batch:
                raise ObservationError(
                    f"{name!r} has shape {list(value.shape)}, but {PREFIX}batch is {batch}: its first axis should be "
                    f"the one of the rows, [{batch}, …]"
                )
        elif isinstance(value, list):
            if not all(isinstance(item, str) for item in value):
                raise ObservationError(
                    f"{name!r} is a list; in a batch it should be an array [{batch}, …], a text for all rows, or a "
                    f"list of {batch} texts"
                )
            if len(value) != batch:
                raise ObservationError(f"{name!r} has {len(value)} texts, but {PREFIX}batch is {batch}")


def batch_row(batch: Mapping[str, Any], index: int) -> dict[str, Any]:
    """One row's observation, or its answer. Arrays are views."""
    return {key: _row_value(value, index) for key, value in batch.items()}


def _row_value(value: Any, index: int) -> Any:
    if isinstance(value, Mapping):
        return batch_row(value, index)
    if isinstance(value, list) or (isinstance(value, np.ndarray) and value.ndim):
        return value[index]
    return value


def stack_answers(answers: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """The rows' answers as one map: arrays of one shape as [B, …], maps by their keys, all else as lists.

    Their `policy_timing` is left out, as rows of one run share it, and their notes.
    """
    keys = [key for key in answers[0] if key not in (TIMING, NOTES) and all(key in answer for answer in answers)]
    return {key: _stack([answer[key] for answer in answers]) for key in keys}


def _stack(values: list[Any]) -> Any:
    if all(isinstance(value, Mapping) for value in values):
        return stack_answers(values)
    if all(isinstance(value, np.ndarray) for value in values) and len({value.shape for value in values}) == 1:
        return np.stack(values)
    return values


def sum_timings(timings: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """The times of several runs of the policy, together."""
    return {key: sum(timing.get(key, 0.0) for timing in timings) for key in (timings[0] if timings else ())}
