"""Calls of the policy, and what became of them: whose fault it is when there are no actions."""

import asyncio
import itertools
import logging
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

from turbopi.realtime.chunk import checked_answer
from turbopi.realtime.queue import of_batch
from turbopi.realtime.running_chunk import RunningChunk
from turbopi.serve.metrics import Metrics
from turbopi.serve.options import ServerOptions
from turbopi.serve.outcome import Outcome
from turbopi.serve.scheduling.batch_times import BatchTimes
from turbopi.serve.scheduling.schedule import Request, Schedule
from turbopi.serve.scheduling.worker import Ran, Worker
from turbopi.support.errors import ActionError, ConfigError, DeviceLost, ObservationError

logger = logging.getLogger(__name__)

AUTO_LARGEST = 8  # observations of a batch, unless the options say
MEASURED = 3  # runs of each size at warm-up, after one that may compile or capture
SIZE_SECONDS = 1.0  # that these may take, unless the options ask for batches


class Policy(Protocol):
    """What can be served. `warmup()` is called once before the first client, if there is one.

    With a true `pipelined`, requests go to `submit(obs)` instead, which returns a Future of what `infer` returns: the
    next request is handed over while the one before it is still computed.

    With `infer_batch(list of obs)`, which returns a list of what `infer` returns, and `example_observation()` to
    measure it on, observations of several clients run together where that is sooner. With `batch_modes`, too, so do
    those that join a chunk in one of these modes: `infer_batch` then takes `previous` and `model_actions`, lists with
    one for each observation.
    """

    @property
    def metadata(self) -> dict[str, Any]: ...

    def infer(self, obs: dict[str, Any], /) -> dict[str, Any]: ...

    # With "real_time" in its metadata, also `previous`, `model_actions` and `seed`, as `UnifiedPolicy.infer` has them.


@dataclass
class _Call:
    """What a request runs: `infer` for each observation, or all in one `infer_batch`."""

    observations: Sequence[dict[str, Any]]
    arguments: Mapping[str, Any] = field(default_factory=dict)


class Calls(Protocol):
    """Where a server has its requests computed: PolicyCalls, in this process, or the replicas of a fleet."""

    @property
    def waiting(self) -> int:
        """Requests that wait for their turn, as far as this process knows."""

    @property
    def running(self) -> bool: ...

    @property
    def largest(self) -> int:
        """Observations of one batch message that aren't split."""

    @property
    def unwell(self) -> str | None:
        """Why no request can be computed at the moment, if it is known: `/healthz` says it."""

    def waits(self, session: str) -> bool:
        """Whether a request of that session waits: a newer one would replace it."""

    async def warm_up(self, **arguments: Any) -> None:
        """Be ready for requests. `arguments` are those of the policy's `warmup`; raises what it raises."""

    def ask(
        self, request: Request, observation: dict[str, Any], arguments: Mapping[str, Any]
    ) -> "asyncio.Future[list[Outcome]]":
        """One outcome, once the request had its turn: what is wrong if it gets none. May be cancelled.

        arguments  of the policy's `infer`, besides the observation
        """

    async def ask_rows(
        self, make: Callable[[int, int], Request], row: Callable[[int], dict[str, Any]], rows: int
    ) -> list[Outcome]:
        """An outcome of each of `rows` observations, up to the first few among which one is wrong.

        make  the request for some rows: of their number, and of the number that come later
        row   the observation of a row, from 0
        """

    def stop(self) -> None:
        """Turn away the requests that wait, and all that come; what runs goes on."""

    async def drain(self) -> None:
        """Wait for what runs. Call `stop` first."""

    def close(self) -> None:
        """Ask for nothing more, and let go of threads; they aren't waited for long."""


class PolicyCalls:
    """Runs a policy in the turns of a schedule, on the thread of `worker`.

    `on_lost(reason)` is called on that thread when the device fails for good, whether or not the client still waits.
    Raises ConfigError for a `max_batch` of the options that this policy can't have.
    """

    unwell = None  # it computes, or is lost for good

    def __init__(
        self, policy: Policy, options: ServerOptions, metrics: Metrics, on_lost: Callable[[str], None]
    ) -> None:
        self._policy = policy
        self._pipelined = bool(getattr(policy, "pipelined", False))
        self._metrics = metrics
        self._on_lost = on_lost
        self._asked_for, self._execution = options.max_batch, options.execution
        self._numbers = itertools.count()  # of runs
        lacking = [name for name in ("infer_batch", "example_observation") if not hasattr(policy, name)]
        batch_modes = getattr(policy, "batch_modes", ())
        largest = largest_batch(options, pipelined=self._pipelined, batch_modes=batch_modes, lacking=lacking)
        self.times = BatchTimes(largest)
        self.joining = BatchTimes(self.times.largest if options.execution is not None else 1)
        turns = BatchTimes() if self._pipelined else None
        schedule = Schedule(options.queue_limit, self.times, turns, self.joining)
        self.worker = worker = Worker(schedule, self._run)
        self.waits, self.stop, self.drain, self.close = worker.schedule.waits, worker.stop, worker.drain, worker.close

    @property
    def waiting(self) -> int:
        return self.worker.waiting

    @property
    def running(self) -> bool:
        return self.worker.running

    @property
    def largest(self) -> int:
        return self.times.measured_largest

    # --- warm-up ------------------------------------------------------------------------------------------------------

    async def warm_up(self, **arguments: Any) -> None:
        """Call the policy's `warmup`, if it has one, on the thread, and measure its batches.

        Raises what it raises, and ConfigError if batches were asked for and fail.
        """
        warmup = getattr(self._policy, "warmup", None)
        if self.times.largest > 1 and getattr(self._policy, "runs_batches", False):
            arguments["batches"] = _sizes(self.times)
        if warmup is not None:
            await self.worker.call(lambda: warmup(**arguments))
        if self.times.largest > 1:
            await self.worker.call(self._measure)

    def _measure(self) -> None:
        """Fill the tables T(B), as far as the time for it allows."""
        self._fill(self.times, dict, "batches")
        if self.joining.largest > 1:
            self._fill(self.joining, self._example_of_joining, "batches that join chunks")

    def _example_of_joining(self) -> dict[str, Any]:
        """Arguments of an `infer` that joins a chunk in the server's mode."""
        result = self._policy.infer(self._policy.example_observation(), model_actions=True)  # type: ignore[attr-defined, call-arg]
        left_over = result["model_actions"]
        assert self._execution is not None
        chunk = RunningChunk(left_over, min(1, len(left_over) - 1), mode=self._execution, anchor=result.get("anchor"))
        return {"previous": chunk, "model_actions": True}

    def _fill(self, times: BatchTimes, make_arguments: Callable[[], dict[str, Any]], what: str) -> None:
        """Fill a table with runs of the example, with made arguments of `infer`. `what` they are, in messages."""
        asked_for, arguments = self._asked_for, None
        for size in _sizes(times):
            try:
                arguments = make_arguments() if arguments is None else arguments
                enough = self._measure_size(size, times, arguments)
            except DeviceLost:
                raise
            except Exception as error:  # out of memory, a size that isn't warm, …
                if asked_for is not None:
                    raise ConfigError(
                        f"{what} of {size} fail: {type(error).__name__}: {error}. Choose a smaller --max-batch"
                    ) from error
                logger.warning("no %s of %d and more: %s: %s", what, size, type(error).__name__, error)
                enough = False
            if not enough:
                times.limit(size - 1)
                break
        measured = times.measured_largest
        table = ", ".join(f"{size}: {(times.seconds(size, 0.0) or 0) * 1e3:.1f}" for size in times.sizes)
        if measured > 1:
            logger.info("%s take, by their size, in ms: %s", what, table)
        if asked_for is not None and times.best(measured, 0.0) == 1 < measured:
            logger.warning(
                "--max-batch is %d, but %s of this policy take as long as their observations one by one, so "
                "none are formed (ms by size: %s)",
                asked_for,
                what,
                table,
            )

    def _measure_size(self, size: int, times: BatchTimes, arguments: Mapping[str, Any]) -> bool:
        """Measure one size; False if that would take too long, unless the options ask for batches."""
        example = self._policy.example_observation()  # type: ignore[attr-defined]

        def run() -> float:
            started = time.perf_counter()
            if size == 1:
                self._policy.infer(example, **arguments)
            else:
                self._infer_batch([example] * size, [arguments] * size)
            return time.perf_counter() - started

        asked_for = self._asked_for is not None
        if not asked_for and (times.seconds(1, 0.0) or 0.0) * size * MEASURED > SIZE_SECONDS:
            return False
        first = run()
        if not asked_for and size == 1 and first * MEASURED > SIZE_SECONDS:
            return False
        for _ in range(MEASURED):
            times.measured(size, run())
        return True

    # --- requests -----------------------------------------------------------------------------------------------------

    def ask(
        self, request: Request, observation: dict[str, Any], arguments: Mapping[str, Any]
    ) -> "asyncio.Future[list[Outcome]]":
        """Run the policy when it is this request's turn.

        arguments  of `infer`, besides the observation; a pipelined policy isn't given any
        """
        request.call = _Call([observation], arguments)
        request.joins = bool(arguments.keys() - {"seed"})
        request.alone = request.alone or (bool(arguments) and not self._may_share(arguments))
        answer = self.worker.ask(request)
        if self._pipelined and not arguments:
            answer.add_done_callback(self._learn)
        return answer

    def _may_share(self, arguments: Mapping[str, Any]) -> bool:
        """Whether a request with arguments may run together with others: if warm-up has measured such batches.

        With a seed it runs alone, so that it has the same answer whoever asks meanwhile.
        """
        chunk = arguments.get("previous")
        measured = self.joining.measured_largest > 1 and (chunk is None or chunk.mode == self._execution)
        return measured and arguments.keys() <= {"previous", "model_actions"}

    async def ask_rows(
        self, make: Callable[[int, int], Request], row: Callable[[int], dict[str, Any]], rows: int
    ) -> list[Outcome]:
        """An outcome of each of `rows` observations, up to the first part in which one is wrong.

        They run in parts, each with a turn of its own: others have theirs in between.

        make  the request for a part, of its number of rows and of those that come later
        row   the observation of a row; called when its part is asked for
        """
        outcomes: list[Outcome] = []
        while len(outcomes) < rows:
            schedule = self.worker.schedule
            part = schedule.part(rows - len(outcomes), time.perf_counter())
            request = make(part, rows - len(outcomes) - part)
            request.continued = bool(outcomes)
            request.call = _Call([row(len(outcomes) + index) for index in range(part)])
            outcomes += await self.worker.ask(request)
            if any(outcome.wrong is not None for outcome in outcomes):
                break
        return outcomes

    def _learn(self, answer: "asyncio.Future[list[Outcome]]") -> None:
        """How long a pipelined policy takes to its actions; its turns end sooner."""
        if not answer.cancelled() and (outcome := answer.result()[0]).wrong is None:
            self.times.ran(1, outcome.seconds, time.perf_counter())

    # --- on the thread ------------------------------------------------------------------------------------------------

    def _run(self, turn: tuple[Request, ...]) -> Ran:
        now = time.perf_counter()
        for request in turn:
            self._metrics.queue_seconds.observe(now - request.queued)
        calls: list[_Call] = [request.call for request in turn]
        if len(calls) == 1:
            return self._run_one(calls[0])
        observations = [observation for call in calls for observation in call.observations]
        self._metrics.batch_size.observe(len(observations))
        outcomes = self._together(observations, [call.arguments for call in calls for _ in call.observations])
        if not outcomes:  # one spoils it: the others don't pay for it, nor does who asks meanwhile
            return Ran([None] * len(turn))
        answers, at = [], 0
        for call in calls:
            answers.append(outcomes[at : at + len(call.observations)])
            at += len(call.observations)
        return Ran(answers, _turn_seconds(outcomes))

    def _run_one(self, call: _Call) -> Ran:
        if len(call.observations) > 1:
            self._metrics.batch_size.observe(len(call.observations))
            if outcomes := self._together(call.observations, [{}] * len(call.observations)):
                return Ran([outcomes], _turn_seconds(outcomes))
            return Ran([[self._infer(observation, {}) for observation in call.observations]])
        self._metrics.batch_size.observe(1)
        (observation,) = call.observations
        if self._pipelined and not call.arguments:
            started = time.perf_counter()
            future = self._submit(observation)
            return Ran([future], time.perf_counter() - started)
        outcome = self._infer(observation, call.arguments)
        return Ran([[outcome]], _turn_seconds([outcome]))

    def _infer(self, observation: dict[str, Any], arguments: Mapping[str, Any]) -> Outcome:
        return self._outcome(time.perf_counter(), lambda: self._policy.infer(observation, **arguments), arguments)

    def _infer_batch(
        self, observations: Sequence[dict[str, Any]], arguments: Sequence[Mapping[str, Any]]
    ) -> list[dict[str, Any]]:
        """`arguments` of `infer`, for each observation; what isn't asked for by any isn't said."""
        results = self._policy.infer_batch(list(observations), **of_batch(arguments))  # type: ignore[attr-defined]
        if not isinstance(results, list) or len(results) != len(observations):
            raise TypeError(f"infer_batch must return a list of {len(observations)} results")
        return results

    def _together(
        self, observations: Sequence[dict[str, Any]], arguments: Sequence[Mapping[str, Any]]
    ) -> list[Outcome]:
        """An outcome of each; none if one of them spoiled the batch, so that each shall run for itself."""
        rows, started = len(observations), time.perf_counter()
        try:
            results = self._infer_batch(observations, arguments)
            seconds = time.perf_counter() - started
            run = next(self._numbers)
            each = zip(results, arguments, strict=True)
            return [_checked(Outcome(seconds, together=rows, run=run), result, one) for result, one in each]
        except DeviceLost as error:
            self._on_lost(str(error))
            return [Outcome(time.perf_counter() - started, wrong="lost", text=str(error))] * rows
        except (ObservationError, ActionError):
            return []
        except BaseException:
            logger.exception("a batch of %d failed: its observations run one by one", rows)
        finally:
            self._metrics.inference_seconds.observe(time.perf_counter() - started)
        outcomes = [self._infer(*one) for one in zip(observations, arguments, strict=True)]
        if all(outcome.wrong != "policy" for outcome in outcomes):  # it was the batch's fault, not one observation's
            joins = " that join chunks" if any(arguments) else ""
            pause = (self.joining if joins else self.times).failed(rows, time.perf_counter())
            logger.warning("batches of %d and more%s aren't formed for %g s", rows, joins, pause)
        return outcomes

    def _submit(self, observation: dict[str, object]) -> "Future[list[Outcome]]":
        """Hand the observation to a pipelined policy. The Future never holds an exception."""
        started = time.perf_counter()
        outcome: Future[list[Outcome]] = Future()
        try:
            answer: Future[dict[str, Any]] = self._policy.submit(observation)  # type: ignore[attr-defined]
        except BaseException as error:
            answer = Future()
            answer.set_exception(error)

        def done(ran: "Future[dict[str, Any]]") -> None:
            outcome.set_result([self._outcome(started, ran.result, {})])

        answer.add_done_callback(done)
        return outcome

    def _outcome(self, started: float, get: Callable[[], Any], arguments: Mapping[str, Any]) -> Outcome:
        """What `get`, an `infer` with these arguments, returns or raises.

        Never raises: an exception couldn't tell whose fault it is.
        """

        def seconds() -> float:
            return time.perf_counter() - started

        try:
            result = get()
            return _checked(Outcome(seconds(), run=next(self._numbers)), result, arguments)
        except ObservationError as error:
            return Outcome(seconds(), wrong="observation", text=str(error))
        except ActionError as error:
            return Outcome(seconds(), wrong="actions", text=str(error))
        except DeviceLost as error:
            self._on_lost(str(error))
            return Outcome(seconds(), wrong="lost", text=str(error))
        except BaseException:  # sys.exit() in a policy mustn't end the server either
            logger.exception("the policy failed")
            return Outcome(seconds(), wrong="policy", text=traceback.format_exc())
        finally:
            self._metrics.inference_seconds.observe(seconds())


def _sizes(times: BatchTimes) -> list[int]:
    """The batches to measure: 1, 2, 4, 8, … and the largest one."""
    largest = times.largest
    return [*(2**power for power in range(largest.bit_length()) if 2**power < largest), largest]


def largest_batch(
    options: ServerOptions, *, pipelined: bool, batch_modes: Sequence[str], lacking: Sequence[str] = ()
) -> int:
    """Observations of a batch, at most, as far as measuring allows. Raises ConfigError.

    pipelined, batch_modes  the policy's
    lacking                 what it would need for batches, and hasn't
    """
    asked_for, execution = options.max_batch, options.execution
    if execution is not None and execution not in batch_modes:
        if asked_for is not None and asked_for > 1:
            raise ConfigError(
                f"max_batch={asked_for} was asked for, but this policy runs requests that join a chunk one by one, and "
                f"with execution={execution!r} all do: leave one of them out"
            )
        return 1
    if not pipelined and not lacking:
        return AUTO_LARGEST if asked_for is None else asked_for
    if asked_for is not None and asked_for > 1:
        why = "is pipelined, and takes one observation at a time" if pipelined else f"has no {' and no '.join(lacking)}"
        raise ConfigError(f"max_batch={asked_for} was asked for, but this policy {why}: leave it out")
    return 1


def _checked(outcome: Outcome, result: Any, arguments: Mapping[str, Any]) -> Outcome:
    """The outcome with the result of an `infer` with these arguments, if a client may get that."""
    try:
        return replace(outcome, result=checked_answer(result, model_actions=bool(arguments.get("model_actions"))))
    except ActionError as error:
        return replace(outcome, wrong="actions", text=str(error))


def _turn_seconds(outcomes: Sequence[Outcome]) -> float | None:
    """The seconds of a turn, if all of it was one run with actions."""
    good = all(outcome.wrong is None and outcome.together == len(outcomes) for outcome in outcomes)
    return outcomes[0].seconds if good else None
