"""Calls of the policy, and what became of them: whose fault it is when there are no actions."""

import logging
import time
import traceback
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Any, Literal, Protocol

from turbopi.errors import ActionError, DeviceLost, ObservationError
from turbopi.serve.metrics import Metrics
from turbopi.serve.worker import Worker

logger = logging.getLogger(__name__)


class Policy(Protocol):
    """What can be served. `warmup()` is called once before the first client, if there is one.

    With a true `pipelined`, requests go to `submit(obs)` instead, which returns a Future of what `infer` returns: the
    next request is handed over while the one before it is still computed.
    """

    @property
    def metadata(self) -> dict[str, Any]: ...

    def infer(self, obs: dict[str, Any], /) -> dict[str, Any]: ...

    # With "real_time" in its metadata, also `previous` and `model_actions`, as `UnifiedPolicy.infer` has them.


@dataclass(frozen=True)
class Outcome:
    """What became of one call: a `result`, or what is `wrong` and the `text` about it.

    wrong   "observation": the client's fault; "actions": the model gave none that a robot may get; "lost": the device
            failed for good; "replica": of several processes the one that had this call gave no answer; "policy":
            anything else, and `text` is the traceback
    seconds in the policy
    """

    seconds: float
    result: dict[str, Any] | None = None
    wrong: Literal["observation", "actions", "lost", "replica", "policy"] | None = None
    text: str = ""


class Calls(Protocol):
    """Where a server has its requests computed: PolicyCalls, in this process, or the replicas of a fleet."""

    async def warm_up(self, **arguments: Any) -> None: ...

    async def run(self, observation: dict[str, Any], arguments: dict[str, Any]) -> Outcome: ...


class PolicyCalls:
    """Runs a policy on `worker`'s thread, one request after the other.

    `on_lost(reason)` is called on that thread when the device fails for good, whether or not the client still waits.
    """

    def __init__(self, policy: Policy, worker: Worker, metrics: Metrics, on_lost: Callable[[str], None]) -> None:
        self._policy = policy
        self._pipelined = bool(getattr(policy, "pipelined", False))
        self._worker = worker
        self._metrics = metrics
        self._on_lost = on_lost

    async def warm_up(self, **arguments: Any) -> None:
        """Call the policy's `warmup`, if it has one, on the thread. Raises what it raises."""
        warmup = getattr(self._policy, "warmup", None)
        if warmup is not None:
            await self._worker.call(lambda _: warmup(**arguments), None)

    async def run(self, observation: dict[str, object], arguments: dict[str, Any]) -> Outcome:
        """Run the policy when it is this request's turn. Raises Busy and Stopping, as the worker does.

        arguments  of `infer`, besides the observation; a pipelined policy isn't given any
        """
        asked = time.perf_counter()

        def call(observation: dict[str, object]) -> Outcome:
            self._metrics.queue_seconds.observe(time.perf_counter() - asked)
            return self._outcome(time.perf_counter(), lambda: self._policy.infer(observation, **arguments))

        def submit(observation: dict[str, object]) -> Future[Outcome]:
            self._metrics.queue_seconds.observe(time.perf_counter() - asked)
            return self._submit(observation)

        if self._pipelined and not arguments:
            return await self._worker.begin(submit, observation)
        return await self._worker.call(call, observation)

    def _submit(self, observation: dict[str, object]) -> "Future[Outcome]":
        """Hand the observation to a pipelined policy. The Future never holds an exception."""
        started = time.perf_counter()
        outcome: Future[Outcome] = Future()
        try:
            answer: Future[dict[str, Any]] = self._policy.submit(observation)  # type: ignore[attr-defined]
        except BaseException as error:
            answer = Future()
            answer.set_exception(error)
        answer.add_done_callback(lambda done: outcome.set_result(self._outcome(started, done.result)))
        return outcome

    def _outcome(self, started: float, get: Callable[[], dict[str, Any]]) -> Outcome:
        """What `get` returns or raises. Never raises: an exception couldn't tell whose fault it is."""

        def seconds() -> float:
            return time.perf_counter() - started

        try:
            result = get()
            if not isinstance(result, dict) or "actions" not in result:
                raise TypeError(f'the policy\'s result must be a dict with "actions", not {type(result).__name__}')
            return Outcome(seconds(), result=result)
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
