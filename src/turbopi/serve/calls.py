"""Calls of the policy in this process: warm-up, turns on its thread, and whose fault an error is."""

import asyncio
import itertools
import logging
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Protocol

from turbopi.realtime.chunk import checked_answer
from turbopi.realtime.messages import keeps_episode
from turbopi.realtime.queue import of_batch
from turbopi.realtime.running_chunk import RunningChunk
from turbopi.serve.memory import ALONE, OBSERVE
from turbopi.serve.metrics import Metrics
from turbopi.serve.options import ServerOptions
from turbopi.serve.real_time import GENERATE
from turbopi.serve.requests import Result
from turbopi.serve.scheduling.batch_times import BatchTimes
from turbopi.serve.scheduling.schedule import Request, Schedule
from turbopi.serve.worker import Ran, Worker
from turbopi.support.errors import ActionError, ConfigError, DeviceLost, ObservationError

logger = logging.getLogger(__name__)

AUTO_LARGEST = 8  # observations of a batch, unless the options say
MEASURED = 3  # runs of each size at warm-up, after one that may compile or capture
SIZE_SECONDS = 1.0  # that these may take, unless the options set max_batch


class Policy(Protocol):
    """What can be served. `warmup()` is called once before the first client, if there is one.

    With a true `pipelined`, requests go to `submit(obs)` instead, which returns a Future of what `infer` returns: the
    next request is handed over while the one before it is still computed.

    With `infer_batch(list of obs)`, which returns a list of what `infer` returns, and `example_observation()` to
    measure it on, observations of several clients run together where that is sooner. With `batch_modes`, too, so do
    those that join a chunk in one of these modes: `infer_batch` then takes `previous` and `model_actions`, lists with
    one for each observation.

    With "memory" in its metadata it has `new_history()` and `observe(obs, history=…)`, its `infer` takes `history`, and
    requests run one by one. With "subtasks" it has `new_history()`, and its `infer` takes `history` and `subtask`; with
    "text" it has `generate(obs, prompt=…, max_tokens=…)`.

    With a true `reads_in_place` it is done with an observation's images when it returns: the client may write the next
    ones over them.

    With a true `gives_readings`, all three are given `readings=True`, and their results hold a
    `turbopi.policy.readings.Reading` of the call under "reading", of which the server makes notes.
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
    answer: Callable[[Result], object] | None = None


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
        self._readings = {"readings": True} if getattr(policy, "gives_readings", False) else {}
        self._metrics = metrics
        self._on_lost = on_lost
        self._max_batch, self._execution = options.max_batch, options.execution
        self._run_numbers = itertools.count()
        lacking = [name for name in ("infer_batch", "example_observation") if not hasattr(policy, name)]
        batch_modes = getattr(policy, "batch_modes", ())
        remembers = keeps_episode(policy.metadata)
        of_policy: Any = {"batch_modes": batch_modes, "lacking": lacking, "remembers": remembers}
        largest = largest_batch(options, pipelined=self._pipelined, **of_policy)
        self.times = BatchTimes(largest)
        self.joining = BatchTimes(self.times.largest if options.execution is not None else 1)
        turns = BatchTimes() if self._pipelined else None
        schedule = Schedule(options.queue_limit, self.times, turns, self.joining)
        self.worker = worker = Worker(schedule, self._run_turn)
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

        Raises what it raises, and ConfigError if requested batches fail.
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
        """Fill a table with runs of the example. `make_arguments` makes those of `infer`; `what` is for messages."""
        arguments = None
        for size in _sizes(times):
            try:
                arguments = make_arguments() if arguments is None else arguments
                enough = self._measure_size(size, times, arguments)
            except DeviceLost:
                raise
            except Exception as error:  # out of memory, a size that isn't warm, …
                if self._max_batch is not None:
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
        if self._max_batch is not None and times.best(measured, 0.0) == 1 < measured:
            logger.warning(
                "--max-batch is %d, but %s of this policy take as long as their observations one by one, so "
                "none are formed (ms by size: %s)",
                self._max_batch,
                what,
                table,
            )

    def _measure_size(self, size: int, times: BatchTimes, arguments: Mapping[str, Any]) -> bool:
        """Measure one size; False if that would take too long, unless the options set max_batch."""
        example = self._policy.example_observation()  # type: ignore[attr-defined]

        def run() -> float:
            started = time.perf_counter()
            if size == 1:
                self._policy.infer(example, **arguments)
            else:
                self._infer_batch([example] * size, [arguments] * size)
            return time.perf_counter() - started

        requested = self._max_batch is not None
        if not requested and (times.seconds(1, 0.0) or 0.0) * size * MEASURED > SIZE_SECONDS:
            return False
        first = run()
        if not requested and size == 1 and first * MEASURED > SIZE_SECONDS:
            return False
        for _ in range(MEASURED):
            times.measured(size, run())
        return True

    # --- requests -----------------------------------------------------------------------------------------------------

    def submit(
        self, request: Request, observation: dict[str, Any], arguments: Mapping[str, Any]
    ) -> "asyncio.Future[list[Result]]":
        """Run the policy when it is this request's turn.

        arguments  of `infer`, besides the observation; a pipelined policy isn't given any
        """
        request.call = _Call([observation], arguments, request.answer)
        if arguments:
            request.joins = bool(arguments.keys() - {"seed", "guidance", "history", "subtask", *ALONE})
            request.alone = request.alone or not self._may_share(arguments)
        results = self.worker.submit(request)
        if self._pipelined and not arguments:
            results.add_done_callback(self._record_seconds)
        return results

    def _may_share(self, arguments: Mapping[str, Any]) -> bool:
        """Whether a request with arguments may run together with others: if warm-up has measured such batches.

        With a seed it runs alone, so that other clients' requests can't change its answer.
        """
        chunk = arguments.get("previous")
        measured = self.joining.measured_largest > 1 and (chunk is None or chunk.mode == self._execution)
        return measured and arguments.keys() <= {"previous", "model_actions"}

    async def submit_batch(
        self, make: Callable[[int, int], Request], row: Callable[[int], dict[str, Any]], rows: int
    ) -> list[Result]:
        """A result of each of `rows` observations, up to the first part that holds an error.

        They run in parts, each with a turn of its own: other requests have theirs in between.

        make  the request for a part: of its rows, and of the rows that follow in later parts
        row   the observation of a row; called when its part is submitted
        """
        results: list[Result] = []
        while len(results) < rows:
            schedule = self.worker.schedule
            part = schedule.part(rows - len(results), time.perf_counter())
            request = make(part, rows - len(results) - part)
            request.continued = bool(results)
            request.call = _Call([row(len(results) + index) for index in range(part)])
            results += await self.worker.submit(request)
            if any(result.error is not None for result in results):
                break
        return results

    def _record_seconds(self, results: "asyncio.Future[list[Result]]") -> None:
        """Add to T(1) how long a pipelined policy takes to its actions; its turns end sooner."""
        if not results.cancelled() and (result := results.result()[0]).error is None:
            self.times.ran(1, result.seconds, time.perf_counter())

    # --- on the thread ------------------------------------------------------------------------------------------------

    def _run_turn(self, turn: tuple[Request, ...]) -> Ran:
        now = time.perf_counter()
        for request in turn:
            self._metrics.queue_seconds.observe(now - request.queued)
        return self._run_calls([request.call for request in turn])

    def _run_calls(self, calls: Sequence[_Call]) -> Ran:
        if len(calls) == 1:
            return self._run_call(calls[0])
        observations = [observation for call in calls for observation in call.observations]
        self._metrics.batch_size.observe(len(observations))
        results = self._infer_together(observations, [call.arguments for call in calls for _ in call.observations])
        if not results:  # one observation spoils the batch: each request runs again, in a turn of its own
            return Ran([None] * len(calls))
        of_calls, at = [], 0
        for call in calls:
            of_calls.append(results[at : at + len(call.observations)])
            at += len(call.observations)
        return Ran(of_calls, _turn_seconds(results))

    def _run_call(self, call: _Call) -> Ran:
        """One request: of one observation, or of the rows of a batch message.

        If no other waits for this thread, it sends the answer itself: the event loop would do so two turns later.
        """
        rows = len(call.observations)
        if rows > 1:
            self._metrics.batch_size.observe(rows)
            if results := self._infer_together(call.observations, [{}] * rows):
                return Ran([results], _turn_seconds(results))
            return Ran([[self._counted(self._infer(observation, {})) for observation in call.observations]])
        (observation,) = call.observations
        self._metrics.batch_size.observe(1)
        if self._pipelined and not call.arguments:
            started = time.perf_counter()
            future = self._submit_to_policy(observation)
            return Ran([future], time.perf_counter() - started)
        result = self._counted(self._infer(observation, call.arguments))
        if call.answer is not None and result.error is None and not self.waiting:
            call.answer(result)
        return Ran([[result]], None if result.error else result.seconds)

    def _infer(self, observation: dict[str, Any], arguments: Mapping[str, Any]) -> Result:
        if OBSERVE in arguments:
            observe = partial(self._observe, observation, arguments["history"])
            return self._result(time.perf_counter(), observe, arguments)
        if GENERATE in arguments:
            generate = partial(self._generate, observation, arguments[GENERATE])
            return self._result(time.perf_counter(), generate, arguments)
        infer = partial(self._policy.infer, observation, **arguments, **self._readings)
        return self._result(time.perf_counter(), infer, arguments)

    def _observe(self, observation: dict[str, Any], history: Any) -> dict[str, Any]:
        self._policy.observe(observation, history=history)  # type: ignore[attr-defined]
        return {}

    def _generate(self, observation: dict[str, Any], options: Mapping[str, Any]) -> dict[str, Any]:
        return {"text": self._policy.generate(observation, **options)}  # type: ignore[attr-defined]

    def _infer_batch(
        self, observations: Sequence[dict[str, Any]], arguments: Sequence[Mapping[str, Any]]
    ) -> list[dict[str, Any]]:
        """`arguments` of `infer`, for each observation; those that no observation has are left out."""
        of_rows = of_batch(arguments)
        answers = self._policy.infer_batch(list(observations), **of_rows, **self._readings)  # type: ignore[attr-defined]
        if not isinstance(answers, list) or len(answers) != len(observations):
            raise TypeError(f"infer_batch must return a list of {len(observations)} results")
        return answers

    def _infer_together(
        self, observations: Sequence[dict[str, Any]], arguments: Sequence[Mapping[str, Any]]
    ) -> list[Result]:
        """A result of each; none if one of them spoiled the batch, so that each must run on its own."""
        rows, started = len(observations), time.perf_counter()
        try:
            answers = self._infer_batch(observations, arguments)
            seconds = time.perf_counter() - started
            run = next(self._run_numbers)
            each = zip(answers, arguments, strict=True)
            return [_checked(Result(seconds, batch=rows, run=run, began=started), answer, one) for answer, one in each]
        except DeviceLost as error:
            self._on_lost(str(error))
            return [Result(time.perf_counter() - started, error="lost", text=str(error))] * rows
        except (ObservationError, ActionError):
            return []
        except BaseException:
            logger.exception("a batch of %d failed: its observations run one by one", rows)
        finally:
            self._metrics.inference_seconds.observe(time.perf_counter() - started)
        results = [self._counted(self._infer(*one)) for one in zip(observations, arguments, strict=True)]
        if all(result.error != "policy" for result in results):  # it was the batch's fault, not one observation's
            joins = " that join chunks" if any(arguments) else ""
            pause = (self.joining if joins else self.times).failed(rows, time.perf_counter())
            logger.warning("batches of %d and more%s aren't formed for %g s", rows, joins, pause)
        return results

    def _submit_to_policy(self, observation: dict[str, object]) -> "Future[list[Result]]":
        """Hand the observation to a pipelined policy. The Future never holds an exception."""
        started = time.perf_counter()
        results: Future[list[Result]] = Future()
        try:
            answer: Future[dict[str, Any]] = self._policy.submit(observation, **self._readings)  # type: ignore[attr-defined]
        except BaseException as error:
            answer = Future()
            answer.set_exception(error)

        def done(ran: "Future[dict[str, Any]]") -> None:
            results.set_result([self._counted(self._result(started, ran.result, {}))])

        answer.add_done_callback(done)
        return results

    def _result(self, started: float, infer: Callable[[], Any], arguments: Mapping[str, Any]) -> Result:
        """What `infer`, with these arguments, returns or raises.

        Never raises: an exception couldn't say whose fault it is.
        """

        def seconds() -> float:
            return time.perf_counter() - started

        try:
            answer = infer()
            return _checked(Result(seconds(), run=next(self._run_numbers), began=started), answer, arguments)
        except ObservationError as error:
            return Result(seconds(), error="observation", text=str(error))
        except ActionError as error:
            return Result(seconds(), error="actions", text=str(error))
        except DeviceLost as error:
            self._on_lost(str(error))
            return Result(seconds(), error="lost", text=str(error))
        except BaseException:  # sys.exit() in a policy mustn't end the server either
            logger.exception("the policy failed")
            return Result(seconds(), error="policy", text=traceback.format_exc())

    def _counted(self, result: Result) -> Result:
        self._metrics.inference_seconds.observe(result.seconds)
        return result


def _sizes(times: BatchTimes) -> list[int]:
    """The batches to measure: 1, 2, 4, 8, … and the largest one."""
    largest = times.largest
    return [*(2**power for power in range(largest.bit_length()) if 2**power < largest), largest]


def largest_batch(
    options: ServerOptions,
    *,
    pipelined: bool,
    batch_modes: Sequence[str],
    lacking: Sequence[str] = (),
    remembers: bool = False,
) -> int:
    """Observations of a batch, at most, as far as measuring allows. Raises ConfigError.

    pipelined, batch_modes  the policy's
    lacking                 the methods that batches need and it lacks
    remembers               it has memory
    """
    requested, execution = options.max_batch, options.execution
    if remembers:
        if requested is not None and requested > 1:
            raise ConfigError(
                f"max_batch={requested} was asked for, but this policy has memory, and runs requests one by one: leave "
                "it out"
            )
        return 1
    if execution is not None and execution not in batch_modes:
        if requested is not None and requested > 1:
            raise ConfigError(
                f"max_batch={requested} was asked for, but this policy runs requests that join a chunk one by one, and "
                f"with execution={execution!r} all do: leave one of them out"
            )
        return 1
    if not pipelined and not lacking:
        return AUTO_LARGEST if requested is None else requested
    if requested is not None and requested > 1:
        why = "is pipelined, and takes one observation at a time" if pipelined else f"has no {' and no '.join(lacking)}"
        raise ConfigError(f"max_batch={requested} was asked for, but this policy {why}: leave it out")
    return 1


def _checked(result: Result, answer: Any, arguments: Mapping[str, Any]) -> Result:
    """The result with the answer of an `infer` with these arguments, or with the error if no client may get it."""
    if arguments.keys() & ALONE:
        return replace(result, answer=answer)
    try:
        checked = checked_answer(answer, model_actions=bool(arguments.get("model_actions")))
        return Result(
            result.seconds, checked, None, "", result.batch, result.run, result.began
        )  # not `replace`: slower
    except ActionError as error:
        return replace(result, error="actions", text=str(error))


def _turn_seconds(results: Sequence[Result]) -> float | None:
    """The seconds of a turn, if all of it was one run with actions."""
    one_run = all(result.error is None and result.batch == len(results) for result in results)
    return results[0].seconds if one_run else None
